"""Known road of a calibration drive: the measured profile in place of the prior's road."""

from dataclasses import replace

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq

from estimators.api import CalibrationDrive, CalibrationError
from estimators.map_smoother.objective import Objective
from estimators.map_smoother.tuning import TUNING
from road_envs.analysis.information_bound import RoadPrior
from road_envs.records.record import Profile
from road_envs.records.roughness import N_0, displacement_psd


def on_profile(objective: Objective, drive: CalibrationDrive) -> Objective:
    """Return the objective with the known road, if there is one, in place of the prior's.

    The road is the Wiener filter's estimate from the profile: left as measured, errors of short
    waves would count as road and make the vehicle look softer than it is.
    """
    road, profile = objective.road, drive.profile
    if profile is None:
        return objective
    # a prior of the profile's own level, from waves that are long against its error
    n, G = displacement_psd(profile.z, profile.ds)
    inside = (n > TUNING.level_band[0]) & (n < TUNING.level_band[1])
    prior = RoadPrior(G_d0=float(np.mean(G[:, inside] * (n[inside] / N_0) ** 2)))
    noise = 2.0 * drive.survey_std**2 * profile.ds

    def share(n: np.ndarray) -> np.ndarray:
        """Return the road's share of the profile's density at `n` [cycles/m]."""
        density = prior.density(np.maximum(n, 1e-6))
        return density / (density + noise)

    both = np.concatenate([profile.z, profile.z[:, ::-1]], axis=1)  # mirrored at both ends
    spectrum = rfft(both, axis=1) * share(rfftfreq(both.shape[1], profile.ds))
    smooth = irfft(spectrum, both.shape[1], axis=1)[:, : profile.s.size]
    background = road.spline_of(Profile(profile.s, smooth))
    rise = np.maximum(2.0 * np.sin(np.pi * road.n * road.ds), 1e-3)
    # mean and half difference have half the variance each of what is left of the error
    amplitude = rise * np.sqrt(0.25 * noise * share(road.n) / road.ds) * np.ones((2, 1))
    # the road is not moved: its error counts as noise of the readings
    known = replace(
        road, background=background, prior_amplitude=amplitude, density=np.ones(road.n.size),
        free=np.zeros(road.size),
    )  # fmt: skip
    return replace(objective, road=known)


def check_profile(objective: Objective, drive: CalibrationDrive) -> None:
    """Raise CalibrationError if the readings do not belong to the profile, and say what would."""
    (one,), profile = objective.passes, drive.profile
    assert profile is not None
    y = one.measurements.y - one.measurements.y.mean(axis=1, keepdims=True)

    def compare(z: np.ndarray) -> tuple[float, float]:
        """Return the correlation with the readings expected on heights `z`, and over them."""
        known = on_profile(objective, replace(drive, profile=Profile(profile.s, z))).road
        lin = one.linearize(known.background, np.zeros(one.size))
        expected = one.measurements.y - lin.residual
        expected -= expected.mean(axis=1, keepdims=True)
        fit = np.sum(y * expected) / np.sqrt(np.sum(y**2) * np.sum(expected**2))
        return float(fit), float(y.std() / expected.std())

    fit, ratio = compare(profile.z)
    others = {
        "reversed": profile.z[::-1, ::-1],
        "with left and right exchanged": profile.z[::-1],
        "with the opposite sign": -profile.z,
    }
    tried = {what: compare(z)[0] for what, z in others.items()}
    best = max(tried, key=lambda what: tried[what])
    if tried[best] > max(TUNING.min_correlation, fit + TUNING.clearly_better):
        hint = f"the profile {best} fits ({tried[best]:.2f})"
    elif fit < TUNING.min_correlation:
        hint = "it may be another part of the road, or the odometer may be displaced"
    elif not 1.0 / TUNING.unit_ratio < ratio < TUNING.unit_ratio:
        raise CalibrationError(
            f"{drive.name}: the accelerations are {ratio:.2g} times those expected on its profile; "
            "check the units of both (m/s² and m)"
        )
    else:
        return
    raise CalibrationError(
        f"{drive.name}: the readings do not belong to its profile (correlation {fit:.2f} with "
        f"those expected); {hint}"
    )
