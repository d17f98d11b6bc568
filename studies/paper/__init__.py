"""Reproduction of the paper: its eight case scenarios, figures and statements.

study.py     drives, trainings, scores
claims.py    statements of the paper, compared with the results
figures.py   Figures 1, 2, 3(b), 6-11 and A.1-A.6, and the spread of the trainings
report.py    the report as a page
"""
