"""Programs that reproduce the paper, and its tables; to import them changes nothing."""

from experiments.common import startup

if startup.is_program():
    startup.prepare()
