"""Runs a configuration: command line, data, training, evaluation and record."""
