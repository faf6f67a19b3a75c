"""What a run of one's own needs: its command line, data, training, evaluation and record."""
