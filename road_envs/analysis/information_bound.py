"""Lower bound on the error of linear road reconstruction from accelerometers on the body.

At spatial frequency n and speed v the sensors of the linear vehicle measure

    a(n) = H(n) z(n) + e(n)     z: left and right wheel path, H: `linear_model.frequency_response`

z is Gaussian with the prior spectrum S(n) (2, 2), and e is noise of density R(n) (S, S). The linear
minimum mean square error estimate from the whole drive (non-causal) is

    z^ = K a,     K = S H* (H S H* + R)^-1,     P = S - K H S

and P(n) is the spectrum of its error (Wiener 1949; Kailath, Sayed & Hassibi, "Linear Estimation",
2000, chapter 7). The mean of the wheel paths excites heave and pitch, their difference only roll.
With equal suspension in front and at the rear, roll does not respond at
n = (2 k + 1) / (2 wheelbase).

R = N² v with the noise density N of the sensors. A `model_error` m adds noise, independent in each
sensor, of that share of the road-induced signal: R_ii = N² v + m² (H S H*)_ii. Above the low-pass
F_C the response is zero.

Dampers and friction are replaced by the linear damping of least mean square error for a Gaussian
rate of extension (`equivalent_damping`). The nonlinear residual of their force is noise for a
linear estimator, and adds to R (`statistical_linearization.py`). An estimator that knows the force
laws has no such noise, the default.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import numpy as np

from road_envs.analysis.statistical_linearization import (
    hermitian,
    nonlinear_residual,
    residual_force_psd,
)
from road_envs.core.config import Positive, Settings
from road_envs.records.record import F_C, scored_band
from road_envs.records.roughness import CLASSES, N_0, TRACK, TrackWidth, root_coherence
from road_envs.sensing.instruments import Instruments
from road_envs.vehicle.equations import Plant, build_plant
from road_envs.vehicle.linear_model import (
    LinearModel,
    combine_wheel_paths,
    force_response,
    frequency_response,
    gaussian_damping,
    linearise,
    strut_rate_response,
)
from road_envs.vehicle.parameters import VehicleParameters

N_FREQUENCIES = 4001  # in a band, enough for the narrowest notch, that of stiff struts
Mode = str | Mapping[str, str]  # state of all struts, or states by axle or wheel


@dataclass(frozen=True, kw_only=True)
class RoadPrior(Settings):
    """Prior of an isotropic ISO 8608 road."""

    G_d0: Annotated[Positive, "m³", "density at n0"] = CLASSES["D"]
    w: Annotated[Positive, "", "waviness"] = 2.0
    track: TrackWidth = TRACK

    def density(self, n: np.ndarray) -> np.ndarray:
        """Return the one-sided density [m³] of a wheel path at `n` [cycles/m], any shape, n > 0."""
        return self.G_d0 * (np.asarray(n, dtype=float) / N_0) ** -self.w

    def spectrum(self, n: np.ndarray) -> np.ndarray:
        """Return densities and cross-densities (F, 2, 2) [m³] of both wheel paths at `n` (F,)."""
        g = root_coherence(n, self.w, self.track)
        one = np.ones_like(g)
        return np.moveaxis(np.array([[one, g], [g, one]]) * self.density(n), -1, 0)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior of both wheel paths at the frequencies `n` (F,) [cycles/m].

    `prior` (F, 2, 2) [m³] is the spectrum of the road, `error` (F, 2, 2) [m³] that of the error of
    the best linear estimate, `gain` (F, 2, S) [m per m/s²] the gain of that estimate.
    """

    n: np.ndarray
    prior: np.ndarray
    error: np.ndarray
    gain: np.ndarray

    @property
    def path_psd(self) -> np.ndarray:
        """Error densities (F, 2) [m³] of the left and the right wheel path."""
        return np.real(self.error[:, [0, 1], [0, 1]])

    def relative_error(self, which: str) -> np.ndarray:
        """Return the amplitude of the error of the "left", "right", "mean" or "difference" of the
        wheel paths, relative to the prior (F,) [-].
        """
        known = {"left": (1.0, 0.0), "right": (0.0, 1.0), "mean": (0.5, 0.5)}
        a = np.array(known.get(which, (1.0, -1.0)))
        # rounding may leave -1e-30
        error, prior = (np.maximum(np.real(a @ x @ a), 0.0) for x in (self.error, self.prior))
        return np.sqrt(error / prior)

    def nrmse(self) -> np.ndarray:
        """Return the RMS error relative to the RMS of the road (2,) [-], for each wheel path."""
        prior = np.real(self.prior[:, [0, 1], [0, 1]])
        error, road = (np.trapezoid(x, self.n, axis=0) for x in (self.path_psd, prior))
        return np.sqrt(error / road)

    @cached_property
    def pooled(self) -> float:
        """`nrmse` of both wheel paths together [-], pooled as in the scores."""
        return float(np.sqrt(np.mean(self.nrmse() ** 2)))


def posterior(
    n: np.ndarray, H: np.ndarray, S: np.ndarray, R: np.ndarray, model_error: float = 0.0
) -> Posterior:
    """Return the best linear estimate of wheel paths with the prior spectrum `S` (F, 2, 2).

    The sensors have the responses `H` (F, S, 2) and the noise spectrum `R` (F, S, S) over `n` (F,).
    """
    HS = H @ S
    signal = HS @ hermitian(H)
    noise = R + model_error**2 * np.real(signal) * np.eye(H.shape[1])
    # K (signal + noise) = S H*, solved for the adjoint of K
    gain = hermitian(np.linalg.solve(signal + noise, HS))
    error = S - gain @ HS
    return Posterior(n, S, 0.5 * (error + hermitian(error)), gain)


def bound(
    car: Plant | VehicleParameters,
    mode: Mode,
    v: float,
    instruments: Instruments,
    prior: RoadPrior,
    *,
    model_error: float = 0.0,
    n: np.ndarray | None = None,
    **options: Any,
) -> Posterior:
    """Return the least error of linear reconstruction, driving in `mode` at `v` [m/s].

    `n` [cycles/m] is the scored band by default. `options` are those of `measurement`. Raises
    ValueError on invalid arguments.
    """
    if not 0 <= model_error < np.inf:
        raise ValueError(f"model_error must not be negative, got {model_error}")
    n = np.linspace(*scored_band(v), N_FREQUENCIES) if n is None else np.asarray(n, dtype=float)
    H, R = measurement(car, mode, v, instruments, prior, n, **options)
    return posterior(n, H, prior.spectrum(n), R, model_error)


def measurement(
    car: Plant | VehicleParameters,
    mode: Mode,
    v: float,
    instruments: Instruments,
    prior: RoadPrior,
    n: np.ndarray,
    *,
    locations: Mapping[str, tuple[Any, ...]] | None = None,
    damping: np.ndarray | None = None,
    residual_as_noise: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Return response H (F, S, 2) and noise spectrum R (F, S, S) of the sensors at `n` (F,).

    `locations`, as in `linearise`, replace those of the `instruments`. `damping` (4,) [N s/m] of
    the struts is `equivalent_damping` by default. With `residual_as_noise` the nonlinear residual
    of the strut forces adds to the noise, as it does for purely linear estimators.
    """
    if damping is None:
        damping = equivalent_damping(car, mode, v, prior)
    if locations is None:
        if isinstance(car, Plant):
            raise ValueError("a plant has no sensor locations: give locations")
        locations = instruments.locations(car)
    model = linearise(car, mode, locations, damping=damping, speed=v)
    H = frequency_response(model, v, n=n)
    H[n * v > F_C] = 0.0
    # density over n; the lower limit keeps R regular for noise-free instruments
    own = dict(zip(instruments.accelerometers, instruments.noise_densities, strict=True))
    densities = np.array([own.get(name, instruments.noise_density) for name in locations])
    noise = np.maximum(densities, 1e-9) ** 2 * v
    R = np.broadcast_to(np.diag(noise), (n.size, noise.size, noise.size))
    if residual_as_noise:
        residual = nonlinear_residual(car, mode, damping)
        forces = residual_force_psd(model, residual, v, prior.spectrum, n * v)
        by_force, _ = force_response(model, n * v)
        R = R + v * (by_force @ forces @ hermitian(by_force))
    return H, R


def equivalent_damping(
    car: Plant | VehicleParameters, mode: Mode, v: float, prior: RoadPrior
) -> np.ndarray:
    """Return the equivalent damping (4,) [N s/m] of the struts on a road with `prior` at `v` [m/s].

    It is the fixed point of statistical linearisation: the damping determines the strut rates, and
    their standard deviation determines the damping. Raises ValueError, and ArithmeticError if the
    iteration does not converge.
    """
    model_plant = car if isinstance(car, Plant) else build_plant(car)
    f = np.geomspace(0.05, 50.0, 300)
    S = prior.spectrum(f / v) / v
    damping = gaussian_damping(model_plant, mode, 0.1)
    for _ in range(60):
        model = linearise(model_plant, mode, {}, damping=damping, speed=v)
        std = np.maximum(strut_rate_std(model, v, f, S), 1e-6)
        new = gaussian_damping(model_plant, mode, std)
        change = np.abs(np.log(new / damping)).max()
        # this relaxation converges fastest where the damping falls with the root of the rate
        damping = damping**0.3 * new**0.7
        if change < 1e-3:
            return damping
    where = f"at {v:g} m/s, G_d0 {prior.G_d0:g} m³"
    raise ArithmeticError(f"the equivalent damping did not converge {where}")


def strut_rate_std(model: LinearModel, v: float, f: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return the standard deviations (4,) [m/s] of the strut rates on wheel paths with the spectrum
    `S` (F, 2, 2) [m²/Hz] at `f` (F,) [Hz].
    """
    H = combine_wheel_paths(model, v, f, strut_rate_response(model, f))
    density = np.real(np.einsum("fwa,fab,fwb->fw", H, S, H.conj()))
    return np.sqrt(np.trapezoid(density, f, axis=0))


@dataclass(frozen=True, eq=False)
class BoundTable:
    """Table of the bound for each pair of strut states: `nrmse` (front state, rear state, speed)
    [-] in the scored band, pooled over both wheel paths, for `modes` and `speeds` (V,) [m/s].
    """

    modes: tuple[str, ...]
    speeds: np.ndarray
    nrmse: np.ndarray

    @classmethod
    def tabulate(
        cls,
        car: VehicleParameters,
        instruments: Instruments,
        prior: RoadPrior,
        speeds: Iterable[float],
        modes: tuple[str, ...] = ("ride", "handling"),
    ) -> "BoundTable":
        """Evaluate the bound for every pair of states and every speed."""
        v = np.unique(np.array(list(speeds), dtype=float))
        plant, locations = build_plant(car), instruments.locations(car)
        nrmse = np.empty((len(modes), len(modes), v.size))
        for i, j, k in np.ndindex(nrmse.shape):
            mode, speed = {"front": modes[i], "rear": modes[j]}, float(v[k])
            n = np.linspace(*scored_band(speed), N_FREQUENCIES // 4)
            found = bound(plant, mode, speed, instruments, prior, n=n, locations=locations)
            nrmse[i, j, k] = found.pooled
        return cls(modes, v, nrmse)

    def interpolate(self, front: str, rear: str, v: float) -> float:
        """Return the bound [-] for a pair of states at `v` [m/s], interpolated over speed."""
        pair = self.nrmse[self.modes.index(front), self.modes.index(rear)]
        return float(np.interp(v, self.speeds, pair))
