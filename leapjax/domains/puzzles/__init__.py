"""Puzzles whose whole solution is one plan: star graphs, Sudoku and Countdown."""
