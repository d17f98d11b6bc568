"""Ride comfort after ISO 2631-1: vertical weighting Wk, weighted RMS and vibration dose value.

The weighting is the product of four second-order sections (ISO 2631-1, annex A; s = 2 pi i f):

    band limits   s² / (s² + w1 s √2 + w1²),   1 / (1 + √2 s/w2 + (s/w2)²)
    transition    (1 + s/w3) / (1 + s/(Q4 w4) + (s/w4)²)
    upward step   (w5² + s w5/Q5 + s²) / (w6² + s w6/Q6 + s²)

Each becomes digital by the bilinear transform with its own corners prewarped.
"""

import numpy as np
from scipy.signal import bilinear_zpk

