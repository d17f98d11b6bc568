"""Roughness of a profile."""

N_0 = 0.1
"""Reference spatial frequency of ISO 8608 [cycles/m]."""

CLASSES = {name: 16e-6 * 4.0**k for k, name in enumerate("ABCDEFGH")}
"""Geometric mean of G_d(n0) [m³] of each class (ISO 8608, table C.1); a class ends at twice it."""
