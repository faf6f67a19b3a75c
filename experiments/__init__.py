"""Programs that reproduce the paper, and its tables; to import them changes nothing."""

from leapjax.running import startup

if startup.is_program():
    startup.prepare()
