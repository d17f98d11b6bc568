"""Results of sensors that tell no roll: the mean of both wheel paths, its HRI, and an IRI.

Accelerometers on the centre line of the body, or one of them, feel the mean path; the difference of
the paths rolls the vehicle, which they do not see. The golden car over the mean path gives the
half-car roughness index (HRI; Sayers, Transp. Res. Rec. 1215, 1989), which is below the IRI, the
mean of the indices of both paths. For a road whose slopes are white and whose paths have the
coherence of an isotropic surface the ratio follows from the gain H of the golden car:

    (IRI / HRI)² = ∫ |H|² dn / ∫ |H|² (1 + gamma(n)) / 2 dn,     gamma = root_coherence(n, w, track)

It is 1.30 for w = 2 and paths 1.5 m apart, 1.24 to 1.34 for w of 1.8 to 2.3 and 1.3 to 1.8 m. HRI
is 15 to 25 % below IRI on measured roads, a ratio of 1.18 to 1.33. The geometric mean of theory and
the middle of these is taken, and RATIO_STD covers them.

The standard deviation of an estimated path is mostly that of the unseen difference of the paths and
tells nothing of the mean path: samples with it make HRI 7 % higher, where that of the profile is
1.5 % low with a standard deviation of 7 % (8 individuals of grade S2, seeds 3 to 10 of
`studies/phone_reports.py`). HRI is therefore that of the profile, with HRI_STD.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np

from road_envs.records.accelerometers import Accelerometer
from road_envs.records.record import Estimate
from road_envs.records.roughness import TRACK, golden_car, root_coherence

MEASURED_RATIO = 1.0 / 0.8
"""Middle of the published ratios: HRI 20 % below IRI."""

HRI_STD = 0.09
"""Relative standard deviation of the HRI of a drive: 0.07 of the 8 individuals, and a margin for so
few.
"""

MISFIT_STD = 0.3
"""Relative standard deviation that is added where the model is far from reproducing the record: of
three such drives of the trial with seeds 301 to 309 one had an IRI 33 to 84 % too high.
"""

RATIO_STD = 0.06
"""Relative standard deviation of the ratio among roads."""

SEGMENT_STD, SEGMENT = 0.06, 100.0
"""Relative standard deviation of the ratio of one road among segments of SEGMENT [m]: of 32 on
isotropic roads, by the golden car. It falls with the root of the length.
"""

LEAST_APART = 0.4
"""Least distance [m] to the left of one another at which sensors of the body tell its roll."""

MEAN_PATH_NOTE = (
    "One sensor, or sensors on one line, do not tell left from right: heights are those of the "
    "mean of both wheel paths, HRI is its index (Sayers 1989), and the IRI has the expected "
    "difference of the paths added, whose uncertainty its interval includes. A bump under "
    "one wheel only appears half as high."
)


def tells_paths_apart(layout: Mapping[str, Accelerometer] | None) -> bool:
    """Whether accelerometers tell the roll of the body or an axle; None is the paper's layout."""
    if layout is None:
        return True
    apart = [
        max(ys) - min(ys)
        for place in ("body", "front axle", "rear axle")
        if (ys := [sensor.y for sensor in layout.values() if sensor.mounted == place])
    ]
    return max(apart) >= LEAST_APART


@cache
def path_ratio(w: float = 2.0, track: float = TRACK) -> float:
    """Return the expected IRI over HRI of a road of waviness `w` with paths `track` [m] apart."""
    ds = 0.05
    step = np.zeros((1, 6000))
    step[0, 2000:] = 1.0  # an impulse of the slope
    response = golden_car(step, ds)[0]
    n = np.fft.rfftfreq(response.size, ds)
    power = np.abs(np.fft.rfft(response)) ** 2
    power[1:] *= n[1:] ** (2.0 - w)
    power[0] = 0.0
    mean = 0.5 * (1.0 + root_coherence(n, w, track))
    return float(np.sqrt(power.sum() / (power * mean).sum()))


def expected_ratio() -> float:
    """Return the expected IRI over HRI of a road that is not known."""
    return float(np.sqrt(path_ratio() * MEASURED_RATIO))


def ratio_std(lengths: np.ndarray) -> np.ndarray:
    """Return the relative standard deviation (K,) of the ratio by `lengths` (K,) [m]."""
    return np.hypot(RATIO_STD, SEGMENT_STD * np.sqrt(SEGMENT / np.maximum(lengths, 1.0)))


def path_level_ratio(n: float) -> float:
    """Return the density of a wheel path over that of the mean path at `n` [cycles/m]."""
    return float(2.0 / (1.0 + root_coherence(np.array([n]), 2.0, TRACK)[0]))


def with_mean_path(estimate: Estimate) -> Estimate:
    """Return an estimate of which both rows are the mean of both wheel paths.

    The error of the mean is the common part of both errors, at most as large as either.
    """
    mean = np.tile(estimate.z.mean(axis=0), (2, 1))
    std = estimate.z_std
    if std is not None:
        std = np.tile(std.min(axis=0), (2, 1))
    return replace(estimate, z=mean, z_std=std, notes=(MEAN_PATH_NOTE, *estimate.notes))
