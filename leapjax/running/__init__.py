"""A run of a user's own: its configuration, training, evaluation and record."""
