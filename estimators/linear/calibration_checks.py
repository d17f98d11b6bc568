"""Checks that drives over known profiles determine the responses of a vehicle."""

from collections.abc import Sequence
from typing import cast

import numpy as np

from estimators.api import CalibrationDrive, CalibrationError
from estimators.linear.impulse_responses import F_BODY, RATE, IdentifiedResponses, RoadDrive
from road_envs.records.record import F_C, Profile

# Shortest distance [m] that is of use, of all drives in one state together: five of the longest
# waves of the scored band
_LENGTH_MIN = 25.0
# Least number of independent frequencies in the road's acceleration, of each wheel path and of
# their difference. A tenth of what 100 m of an ISO 8608 road have; a sine has one or two.
_FREQUENCIES_MIN = 30.0
# Least share of the sensors' power that must be predicted where the responses were not
# identified. 100 m of class C or rougher give 0.6 to 0.95, a profile of elsewhere less than 0.1.
_EXPLAINED_MIN = 0.3
# Gain of all wheels together on long waves: a vehicle moves as its road does, whatever it is.
# Drives over 100 m to 1 km give 0.8 to 1.7; accelerations in g divide it by 10.
_GAIN_RANGE = (0.3, 4.0)
_SEARCHED = np.arange(-10.0, 10.5, 0.5)  # shifts [m] of a profile tried to say what is wrong


def check_drives(drives: Sequence[CalibrationDrive], data: Sequence[RoadDrive]) -> None:
    """Raise CalibrationError if drives are too short or their roads have too few frequencies."""
    pairs = [(each, each.segment >= 0) for each in data]
    names = drives[0].name if len(drives) == 1 else f"the {len(drives)} drives in this state"
    length = sum(float(np.ptp(each.s[here])) for each, here in pairs if here.any())
    if length < _LENGTH_MIN:
        raise CalibrationError(
            f"{names}: all axles are on the profile over {length:.0f} m; at least "
            f"{_LENGTH_MIN:.0f} m are needed: check where the profile begins, or drive over a "
            "longer one"
        )
    parts = [each.u[0][:, here] for each, here in pairs if here.sum() > 1]
    motions = {
        "the left wheel path": [u[0] for u in parts],
        "the right wheel path": [u[1] for u in parts],
        "the difference of the wheel paths": [u[0] - u[1] for u in parts],
    }
    counts = {name: sum(map(_independent_frequencies, u)) for name, u in motions.items()}
    name = min(counts, key=counts.__getitem__)
    if counts[name] < _FREQUENCIES_MIN:
        raise CalibrationError(
            f"{names}: {name} moves the wheels at {counts[name]:.0f} independent frequencies; at "
            f"least {_FREQUENCIES_MIN:.0f} are needed to identify the vehicle's responses: choose "
            "a rougher or longer road"
        )


def _independent_frequencies(u: np.ndarray) -> float:
    """Return the number of independent frequencies of a road acceleration (N,) between F_BODY and
    F_C: (sum of powers)² over the sum of their squares, of its spectral lines. The rate of the
    height is taken, which is white on a road with a waviness of 2.
    """
    f = np.fft.rfftfreq(u.size, 1.0 / RATE)
    inside = (f > F_BODY) & (f < F_C)
    power = np.abs(np.fft.rfft(u * np.hanning(u.size))[inside] / f[inside]) ** 2
    # a periodogram's lines are exponentially distributed, which halves the ratio
    return float(2.0 * power.sum() ** 2 / max(np.sum(power**2), 1e-300)) if power.any() else 0.0


def check_responses(
    found: IdentifiedResponses, drives: Sequence[CalibrationDrive], axles: np.ndarray
) -> None:
    """Raise CalibrationError if the profiles do not explain the drives, or not in their units."""
    if (least := float(found.explained.min())) < _EXPLAINED_MIN:
        sensor = f"sensor {1 + int(found.explained.argmin())} of {found.explained.size}"
        raise CalibrationError(
            f"the profile explains {max(least, 0.0):.0%} of what {sensor} measured on parts of the "
            f"road that were left out; at least {_EXPLAINED_MIN:.0%} are needed"
            f"{_reason(drives[0], axles)}"
        )
    gain = float(np.median(found.responses.long_wave_gain))
    low, high = _GAIN_RANGE
    if not low < gain < high:
        turned = "; an axis that points down, or heights counted downwards" if gain < 0.0 else ""
        raise CalibrationError(
            f"on long waves the sensors move {gain:.3g} times as much as the road, which must be "
            f"about 1: check the units of heights (m) and accelerations (m/s²){turned}"
        )


def _reason(drive: CalibrationDrive, axles: np.ndarray) -> str:
    """Return what would make the profile fit, as the end of a sentence."""
    profile = cast(Profile, drive.profile)
    tried = {"the profile is reversed": Profile(profile.s, profile.z[::-1, ::-1])}
    for shift in _SEARCHED:
        name = f"the profile lies {shift:+.1f} m from where the drive says"
        tried[name] = Profile(profile.s - shift, profile.z)
    best, text = _EXPLAINED_MIN, ": it is of another road or lane, or too smooth"
    for name, other in tried.items():
        data = RoadDrive.of(drive.record, other, axles)
        share = data.quick_explained().min() if (data.segment >= 0).sum() > RATE else 0.0
        if share > best:
            best, text = float(share), f": {name}"
    return text
