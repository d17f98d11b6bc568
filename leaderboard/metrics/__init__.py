"""Scores of estimates."""

UNDEFINED = "–"  # how a number that is not defined is shown
