"""What estimators share that drive the nonlinear car over an unknown road: its way, step by step
(`course.py`); what was sensed on it (`readings.py`); the road as a spline of even nodes
(`spline.py`) and how likely each rise of it is (`rises.py`).
"""
