"""The paper reproduced: its eight case scenarios, many trainings of each, its figures, its claims.

study.py      drives, trainings, scores
claims.py     what the paper says, what came out, whether they agree and why
figures.py    Figures 1, 2, 3(b), 6-11 and A.1-A.6 in their form, and the spread of trainings
report.py     all of it as HTML and PDF
"""
