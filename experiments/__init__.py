"""Programs that reproduce the paper and its tables. Importing them leaves the process as it is."""

from leapjax.running import startup

if startup.is_program():
    startup.prepare()
