"""Reconstruction without a vehicle model: responses identified on a known road, then inverted.

A calibration drive over a measured profile gives the impulse responses from the road to the sensors
(`impulse_responses.py`), for any vehicle and any number of accelerometers at any places. On another
road they are the measurement model of a random walk over distance, and the most probable road, with
its standard deviation, follows from normal equations (`road_posterior.py`). The distance between
the axles is the only number that must be known of the vehicle.

Responses belong to the states of the struts in which they were identified. Those of several states
are kept side by side, and a drive is estimated with those of the state that prevails in it. They
hold for other speeds, since the delay between the axles is not part of them; friction does not, as
its share depends on speed and roughness.

Standard deviations are those of the posterior, times a factor that makes half and nine tenths of
the errors on the calibration drives lie within the Gaussian bounds; each fifth of a drive is
estimated there with responses identified on the other four.

Limitations: a linear model of the vehicle, as in `wiener`; roads on which wheels leave the ground.
A calibration drive of 100 m leaves errors of its own; two or three reduce them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Annotated, Any, ClassVar, NamedTuple, Self, cast

import numpy as np
from pydantic import Field
from scipy.ndimage import gaussian_filter1d

from estimators.api import (
    CalibrationDrive,
    CalibrationError,
    Profiles,
    Records,
    copy_with,
    require_fitted,
    validate_weights,
)
from estimators.common.blas import single_blas_thread
from estimators.common.coverage import coverage_factors
from estimators.common.odometer import calibrate_odometer
from estimators.common.spatial_signals import axle_states
from estimators.linear import impulse_responses, road_posterior
from estimators.linear.calibration_checks import check_drives, check_responses
from estimators.linear.impulse_responses import IdentifiedResponses, Responses, RoadDrive
from estimators.preprocessing import RecordError, clean_record, sample_profile
from road_envs.core.config import Settings
from road_envs.records.record import (
    PROFILE_SPACING,
    Estimate,
    Profile,
    Record,
    profile_stations,
    scored_band,
)
from road_envs.records.roughness import band_pass
from road_envs.vehicle.parameters import VehicleParameters

_WINDOW = 200.0  # length [m] of the road that is estimated at a time, with a road prior of its own
_NODE_TIME = 0.01  # time [s] between nodes, four in a period of 25 Hz
_NODE_SPACING = (0.1, 0.25)  # least and greatest spacing [m] of nodes
_DRAWS = 40  # samples of the posterior for the standard deviation
_SMOOTHING = 5.0  # distance [m] over which the power of the samples is averaged
_VALIDATED = 3  # calibration drives at most on which standard deviations are calibrated
# Greatest error on held-out parts of the road, over the road, of responses that are used; 1 is no
# information
_MAX_HELD_OUT = 0.7
_FAR_SPEED = 1.3  # factor between the speeds of calibration and drive from which on a note is given


class _VehicleResponse(NamedTuple):
    """Result of calibration drives in one strut state: `responses`, `state` (4,) (stiff and high
    damping in front, then at the rear), mean `speed` [m/s], the factor `std_factor` on standard
    deviations, and the in-band `error` of segments estimated without themselves over their road.
    """

    responses: Responses
    state: np.ndarray
    speed: float
    std_factor: float
    error: float


class _VehicleResponses(NamedTuple):
    """Responses by strut state, and the `axles` (X,) [m] behind the first."""

    by_state: tuple[_VehicleResponse, ...]
    axles: np.ndarray


@dataclass(frozen=True, kw_only=True)
class CalibratedFir(Settings):
    """Linear window over distance for a vehicle that is known by calibration drives alone."""

    causal: ClassVar[bool] = False
    uses_seed: ClassVar[bool] = False

    wheelbase: Annotated[
        float | None,
        Field(gt=0, le=20),
        "m",
        "between first and last axle; default: that of the vehicle given",
    ] = None
    seed: Annotated[int, Field(ge=0), "", "of the samples of the posterior"] = 0
    fitted_state: _VehicleResponses | None = field(
        default=None, init=False, repr=False, compare=False
    )

    def fit(self, records: Records, truths: Profiles, car: VehicleParameters, seed: int) -> Self:
        """Identify the responses from drives over known roads; `seed` is unused. Of `car` only the
        wheelbase is used, unless it is a setting. Raises RecordError, CalibrationError.
        """
        drives = [CalibrationDrive(*pair) for pair in zip(records, truths, strict=True)]
        if len(drives) > 1:
            drives = [replace(drive, name=f"drive {i}") for i, drive in enumerate(drives, 1)]
        return self._identify(drives, car)

    def calibrate(self, drives: Sequence[CalibrationDrive], car: VehicleParameters) -> Self:
        """Identify the responses from the drives over measured roads, starting from those of `fit`
        if there are any; drives over unmeasured roads are not used. Raises RecordError,
        CalibrationError.
        """
        known = [drive for drive in drives if drive.profile is not None]
        if not known and self.fitted_state is None:
            raise CalibrationError(
                "calibrated_fir has no model of the vehicle: calibrate it by at least one drive "
                "over a measured road"
            )
        return self._identify(known, car) if known else self

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Return the most probable road and its standard deviation in the scored band. Raises
        RecordError, NotFittedError.
        """
        model = require_fitted(self.fitted_state, self)
        record, notes = clean_record(record, None)
        odometer = calibrate_odometer(record)
        record = odometer.record
        state = _state(record)
        chosen = min(model.by_state, key=lambda x: float(np.abs(x.state - state).sum()))
        n_sensors = len(chosen.responses.taps)
        if len(record.a) != n_sensors:
            raise RecordError(
                f"calibrated with {n_sensors} accelerometers, the record has {len(record.a)}: "
                "calibrate with the accelerometers of the record"
            )
        z, z_std = _reconstruct(chosen.responses, model.axles, record, self.seed)
        if (chosen.state != state).any():
            notes += (
                "no calibration drive was in this state of the struts; the responses are those of "
                "the nearest state",
            )
        v = float(record.v.mean())
        if not chosen.speed / _FAR_SPEED < v < chosen.speed * _FAR_SPEED:
            notes += (
                f"calibrated at {3.6 * chosen.speed:.0f} km/h, driven at {3.6 * v:.0f} km/h: "
                "friction acts otherwise there, and errors exceed the standard deviations",
            )
        stations = profile_stations(record.length)
        return odometer.describe(Estimate(stations, z, chosen.std_factor * z_std, notes))

    def summary(self) -> dict[str, Any]:
        """Return what the calibration gave: in each strut state the in-band error of segments that
        it did not use, and the gain of all wheels together on long waves, sensor by sensor. Raises
        NotFittedError.
        """
        model = require_fitted(self.fitted_state, self)
        return {
            "axles_m": model.axles.tolist(),
            "speeds_m_s": [x.speed for x in model.by_state],
            "held_out_nrmse": [x.error for x in model.by_state],
            "gains": [x.responses.long_wave_gain.tolist() for x in model.by_state],
        }

    def weights(self) -> dict[str, np.ndarray]:
        """Return `taps` (S, k, X, 2, N_TAPS), `ar` (S, AR_ORDER) and `innovation` (S, k, k) of S
        strut states, `axles` (X,), and `about` (S, 7): state, speed, factor on the standard
        deviations, held-out error. Raises NotFittedError.
        """
        model = require_fitted(self.fitted_state, self)
        about = [[*x.state, x.speed, x.std_factor, x.error] for x in model.by_state]
        parts = zip(*(x.responses for x in model.by_state), strict=True)
        arrays = dict(zip(Responses._fields, map(np.array, parts), strict=True))
        return {**arrays, "axles": model.axles, "about": np.array(about)}

    def with_weights(self, weights: Mapping[str, np.ndarray]) -> Self:
        """Return a copy with these weights. Raises ValueError."""
        shapes = {
            "taps": (None, None, None, 2, impulse_responses.N_TAPS),
            "ar": (None, impulse_responses.AR_ORDER),
            "innovation": (None, None, None),
            "axles": (None,),
            "about": (None, 7),
        }
        taps, ar, innovation, axles, about = validate_weights(weights, shapes)
        n_states, k = taps.shape[:2]
        if not (len(ar) == len(innovation) == len(about) == n_states > 0):
            raise ValueError("taps, ar, innovation and about must be of the same strut states")
        if innovation.shape[1:] != (k, k) or taps.shape[2] != axles.size:
            raise ValueError("innovation and axles must be of the sensors and axles of the taps")
        by_state = tuple(
            _VehicleResponse(Responses(*x[:3]), x[3][:4], *x[3][4:].tolist())
            for x in zip(taps, ar, innovation, about, strict=True)
        )
        return copy_with(self, fitted_state=_VehicleResponses(by_state, axles))

    @single_blas_thread()
    def _identify(self, drives: Sequence[CalibrationDrive], car: VehicleParameters) -> Self:
        axles = np.array([0.0, self.wheelbase or car.wheelbase])
        kept, before = dict[bytes, _VehicleResponse](), self.fitted_state
        if before is not None and np.array_equal(before.axles, axles):
            kept = {x.state.tobytes(): x for x in before.by_state}
        groups: dict[bytes, list[CalibrationDrive]] = {}
        for drive in drives:
            record = calibrate_odometer(clean_record(drive.record, None)[0]).record
            groups.setdefault(_state(record).tobytes(), []).append(replace(drive, record=record))
        for key, group in groups.items():
            prior = kept[key].responses.taps if key in kept else None
            if prior is not None and len(prior) != len(group[0].record.a):
                prior = None
            kept[key] = _identify_state(group, axles, prior)
        return copy_with(self, fitted_state=_VehicleResponses(tuple(kept.values()), axles))


def _identify_state(
    drives: Sequence[CalibrationDrive], axles: np.ndarray, prior: np.ndarray | None
) -> _VehicleResponse:
    """Identify the responses from drives in one strut state. Raises CalibrationError."""
    data = [RoadDrive.of(drive.record, cast(Profile, drive.profile), axles) for drive in drives]
    check_drives(drives, data)
    found = IdentifiedResponses.identify(data, prior)
    check_responses(found, drives, axles)
    factor, error = _validate(found, drives, axles)
    if not error <= _MAX_HELD_OUT:
        names = ", ".join(drive.name for drive in drives)
        raise CalibrationError(
            f"{names}: on parts of the road that were held out the error is {error:.2f} of the "
            f"road, and at most {_MAX_HELD_OUT} is allowed (1 is no information): give drives over "
            "a rougher or longer profile, and check that distances and profile belong together"
        )
    speed = float(np.mean([drive.record.v.mean() for drive in drives]))
    return _VehicleResponse(found.responses, _state(drives[0].record), speed, factor, error)


def _validate(
    found: IdentifiedResponses, drives: Sequence[CalibrationDrive], axles: np.ndarray
) -> tuple[float, float]:
    """Return the factor on standard deviations that gives COVERAGE on segments that responses were
    identified without, and the in-band RMS error over the RMS of the road there.
    """
    ratios, square, power = [], 0.0, 0.0
    for drive in drives[:_VALIDATED]:
        record, profile = drive.record, cast(Profile, drive.profile)
        s, band = profile_stations(record.length), scored_band(float(record.v.mean()))
        truth = sample_profile(profile, s)
        inside = band_pass(truth, PROFILE_SPACING, band)
        cut = slice((s.size - inside.shape[1]) // 2, (s.size + inside.shape[1]) // 2)
        part = RoadDrive.segment_of(s[cut], profile, axles)
        for segment, responses in enumerate(found.held_out):
            here = part == segment
            z, z_std = _reconstruct(responses, axles, record, 0)
            error = band_pass(z - truth, PROFILE_SPACING, band)[:, here]
            ratios.append((np.abs(error) / z_std[:, cut][:, here]).ravel())
            square += float(np.sum(error**2))
            power += float(np.sum(inside[:, here] ** 2))
    factors = coverage_factors(np.concatenate(ratios))
    return float(np.exp(np.mean(np.log(factors)))), float(np.sqrt(square / power))


def _reconstruct(
    responses: Responses, axles: np.ndarray, record: Record, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return heights and standard deviations (2, M) [m] of a clean record, window by window."""
    stations, rng = profile_stations(record.length), np.random.default_rng(seed)
    v = float(np.median(record.v))
    ds = float(np.clip(_NODE_TIME * v, *_NODE_SPACING))
    margin = axles[-1] + impulse_responses.MEMORY * v
    t = impulse_responses.sample_times(record)
    a, s = impulse_responses.sensed(record, t), np.interp(t, record.t, record.s)
    count = max(1, round(record.length / _WINDOW))
    edges = np.linspace(0.0, record.length, count + 1)
    z, power = np.zeros((2, stations.size)), np.zeros((2, stations.size))
    settings = road_posterior.START
    for begin, end in pairwise(edges):
        own = np.flatnonzero((s > begin - margin) & (s < end + margin))
        if own.size < 2:
            continue
        part = slice(own[0], own[-1] + 1)
        first = max(begin - margin, float(s[own[0]])) - margin
        nodes = road_posterior.Nodes(first, ds, int((end + margin - first) / ds) + 1)
        fine = impulse_responses.fine_stations(record, t[part])
        roads = [nodes.accelerations(fine - axle) for axle in axles]
        data = road_posterior.NormalEquations.of(responses, a[:, part], roads)
        prior = nodes.prior_bands()
        settings = data.fit_settings(prior, settings)
        posterior = data.solve(prior, settings)
        here = (stations >= begin) & (stations < end)
        heights = nodes.heights(stations)
        z[:, here] = (heights @ posterior.mean.reshape(-1, 2)).T[:, here]
        drawn = posterior.draw(_DRAWS, rng).reshape(nodes.size, 2, _DRAWS)
        for path in range(2):
            x = band_pass((heights @ drawn[:, path]).T, PROFILE_SPACING, scored_band(v))
            cut = (stations.size - x.shape[1]) // 2
            ends = (cut, stations.size - x.shape[1] - cut)
            power[path, here] = np.pad(np.mean(x**2, axis=0), ends, mode="edge")[here]
    width = _SMOOTHING / PROFILE_SPACING
    return z, np.sqrt(gaussian_filter1d(power, width, axis=1, mode="nearest"))


def _state(record: Record) -> np.ndarray:
    """Return the prevailing state (4,): stiff and high damping in front, then at the rear."""
    return axle_states(record).mean(axis=1).round()
