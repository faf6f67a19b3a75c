"""Puzzles whose whole solution is one plan: star graphs and Sudoku."""
