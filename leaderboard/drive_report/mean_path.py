"""Results of sensors that tell no roll: the mean of both wheel paths, its HRI, and an IRI.

Accelerometers on the centre line of the body, or one of them, feel the mean m of both paths; half
their difference d, which rolls the vehicle, is not seen. The golden car over the mean path gives
the half-car roughness index (HRI; Sayers, Transp. Res. Rec. 1215, 1989), which is below the IRI,
the mean of the indices of both paths. With M and D for the motion of the golden car over m and d,

    HRI = mean |M|,    IRI = mean (|M + D| + |M - D|) / 2 = mean max(|M|, |D|)

D is drawn from what is expected of an isotropic surface whose mean path is as rough as this one: of
a road of waviness w whose paths have the root coherence gamma(n), it has the spectrum of M times
(1 - gamma) / (1 + gamma). Its level follows the median of |M| along the road, not the mean: a
single obstacle is in both paths or in one, and adds as much to the IRI as to the HRI either way. On
a road without obstacles the ratio IRI / HRI is 1.30 for w = 2 and paths 1.5 m apart, 1.24 to 1.34
for w of 1.8 to 2.3 and 1.3 to 1.8 m. HRI is 15 to 25 % below IRI on measured roads, a ratio of 1.18
to 1.33. The level of D is that of the geometric mean of theory and the middle of these.

The HRI is that of the profile. Of a vehicle as described it is 4 % low, as the estimate is smooth.
Bodies bend at 15 to 40 Hz, which no description says and a device feels as short waves, so that an
IRI would be up to 112 % high: `estimators.wiener.structure_search` finds it in the spectrum.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from estimators.wiener.tuning import TUNING
from leaderboard.drive_report.obstacles import running_median
from leaderboard.drive_report.posterior_iri import IriPosterior, segment_means
from road_envs.records.accelerometers import Accelerometer
from road_envs.records.record import Estimate, Record
from road_envs.records.roughness import TRACK, golden_car, root_coherence

_MEASURED_RATIO = 1.0 / 0.8  # middle of the published ratios: HRI 20 % below IRI
HRI_STD = 0.065
"""Relative standard deviation of the HRI of a drive by a vehicle whose structure is not the one
described, and of kinds that were not simulated; that of the tolerances (`roughness_std`) adds to
it. On development seeds (above) the estimate's HRI errs by 0.07.
"""

MISFIT_STD = 0.12
"""Relative standard deviation that is added where the model is far from reproducing the record: the
HRI of such drives of the development seeds errs by 0.09, and 0.06 of the others.
"""

_LEVEL_STD = 0.15  # standard deviation of the logarithm of D's level among roads: 0.06 of the ratio
_LEVEL_WINDOW = 60.0  # window [m] of the median of |M|, by which the level of D follows the road
_NORMAL_MEDIAN = 0.6745  # median magnitude of a standard normal number
_SAMPLES = 64  # samples of D
_FILLINGS = 32  # samples of a road where nothing was read
_LEAST_APART = 0.4  # least distance [m] to the left of one another at which sensors tell the roll
_SAME_PLACE = 0.5  # most distance [m] along the body of two sensors that are a pair
_MEAN_PATH_NOTE = (
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
    return max(apart) >= _LEAST_APART


def tells_vehicle(layout: Mapping[str, Accelerometer] | None) -> bool:
    """Whether accelerometers tell a vehicle from a road, whose paths explain any two of them."""
    return tells_paths_apart(layout) and (layout is None or len(layout) >= TUNING.least_channels)


def means_of_pairs(record: Record, layout: Mapping[str, Accelerometer]) -> Record | None:
    """Return a record of the means of sensors of the `layout` on both sides of the body, as sensors
    on its centre line, which feel neither roll nor twist; None if there are no such pairs.
    """
    means = {}
    for (i, (name, one)), (j, (_, other)) in combinations(enumerate(layout.items()), 2):
        is_pair = one.mounted == other.mounted == "body" and one.axle == other.axle
        if is_pair and abs(one.ahead - other.ahead) <= _SAME_PLACE and one.y * other.y < 0.0:
            share = other.y / (other.y - one.y)
            ahead = share * one.ahead + (1.0 - share) * other.ahead
            centred = replace(one, ahead=ahead, y=0.0)
            means[name] = (centred, share * record.a[i] + (1.0 - share) * record.a[j])
    if not means:
        return None
    sensors = {name: sensor for name, (sensor, _) in means.items()}
    return replace(record, a=np.array([a for _, a in means.values()]), sensors=sensors)


@cache
def _golden_power(ds: float, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return `n` (K,) [cycles/m] and the power (K,) of the golden car over white slopes."""
    step = np.zeros((1, size))
    step[0, size // 3 :] = 1.0  # an impulse of the slope
    response = golden_car(step, ds)[0]
    power = np.abs(rfft(response)) ** 2
    power[0] = 0.0
    return rfftfreq(response.size, ds), power


def _path_ratio(w: float = 2.0, track: float = TRACK) -> float:
    """Return the expected IRI over HRI of a road of waviness `w` with paths `track` [m] apart."""
    n, power = _golden_power(0.05, 6000)
    power = power * np.maximum(n, n[1]) ** (2.0 - w)
    mean = 0.5 * (1.0 + root_coherence(n, w, track))
    return float(np.sqrt(power.sum() / (power * mean).sum()))


def path_level_ratio(n: float) -> float:
    """Return the density of a wheel path over that of the mean path at `n` [cycles/m]."""
    return float(2.0 / (1.0 + root_coherence(np.array([n]), 2.0, TRACK)[0]))


def with_mean_path(estimate: Estimate, unread: np.ndarray) -> Estimate:
    """Return an estimate of which both rows are the mean of both wheel paths.

    The error of the mean is the common part of both errors, at most as large as either. Where it
    is `unread` (M,), its samples have the slopes of other places, in a row: of a single sensor no
    prior is known that is as rough as the road.
    """
    std, draws, mean = estimate.z_std, estimate.draws, estimate.z.mean(axis=0)
    if std is not None:
        std = np.tile(std.min(axis=0), (2, 1))
    if draws is not None:
        draws = np.broadcast_to(draws.mean(axis=1, keepdims=True), draws.shape)
    if unread.any() and not unread.all():
        draws = _filled(mean, unread)
    notes = (_MEAN_PATH_NOTE, *estimate.notes)
    return replace(estimate, z=np.tile(mean, (2, 1)), z_std=std, draws=draws, notes=notes)


def _filled(z: np.ndarray, unread: np.ndarray) -> np.ndarray:
    """Return roads (_FILLINGS, 2, M) with the heights `z` (M,) but where they are `unread` (M,)."""
    rng, slopes = np.random.default_rng(2), np.diff(z, prepend=z[0])
    known, count = slopes[~unread], np.count_nonzero(unread)
    filled = np.tile(slopes, (_FILLINGS, 1))
    for row in filled:
        row[unread] = known[(rng.integers(known.size) + np.arange(count)) % known.size]
    return np.broadcast_to(np.cumsum(filled, axis=1)[:, None], (_FILLINGS, 2, z.size))


def mean_path_indices(
    z: np.ndarray, ds: float, index: np.ndarray, factor: float, std: float
) -> tuple[IriPosterior, IriPosterior]:
    """Return HRI and IRI between the indices (K + 1,) of a mean path, each (1, K).

    `z` (L, M) [m] are samples of the mean path, or one profile, every `ds` [m]. Both indices are
    multiplied by `factor`, whose relative standard deviation is `std`.
    """
    rng, motion = np.random.default_rng(0), 1e3 * np.abs(golden_car(z, ds))
    # of standard deviations on a road without obstacles: IRI² / HRI² = 1 + (D / M)²
    ratio = np.sqrt(_path_ratio() * _MEASURED_RATIO)
    share = float(np.sqrt(ratio**2 - 1.0))
    level = share / _NORMAL_MEDIAN * running_median(motion, ds, _LEVEL_WINDOW, 0.5)
    units = _unit_differences(motion.shape[1], ds, rng)
    half, iri = [], []
    for k in range(_SAMPLES):
        one, scale = motion[k % len(z)], float(np.exp(std * rng.standard_normal()))
        spread = level[k % len(z)] * np.exp(_LEVEL_STD * rng.standard_normal())
        unseen = np.abs(spread * next(units))
        half.append(scale * segment_means(one, index))
        iri.append(scale * segment_means(np.maximum(one, unseen), index))
    both = (np.quantile(factor * np.array(x), (0.025, 0.5, 0.975), axis=0) for x in (half, iri))
    first, second = (IriPosterior(*quantiles[:, None]) for quantiles in both)
    return first, second


def _unit_differences(size: int, ds: float, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield samples (N,) of D of variance 1: the golden car over unlike isotropic paths."""
    whole = next_fast_len(size + round(50.0 / ds), real=True)
    n, power = _golden_power(ds, round(300.0 / ds))
    # that of isotropic paths: half the density of a path, less what both have in common
    power = power * 0.5 * (1.0 - root_coherence(n, 2.0, TRACK))
    lines = np.interp(rfftfreq(whole, ds), n, power)
    amplitude = np.sqrt(lines / (4.0 * lines.sum())) * whole
    while True:
        white = rng.standard_normal((2, amplitude.size))
        yield irfft(amplitude * (white[0] + 1j * white[1]), whole)[:size]


def golden_weight(n: np.ndarray) -> np.ndarray:
    """Return the share of each spatial frequency (F,) [cycles/m] in the square of the IRI of a road
    of waviness 2, times a constant.
    """
    return np.interp(n, *_golden_power(0.05, 6000))
