"""What accelerometers on the body can know of the road: the linear minimum mean square error.

Over spatial frequency n, at the speed v, the sensors of the linear car report

    a(n) = H(n) z(n) + e(n)            z: left and right wheel path, H: `linear.frequency_response`

z is Gaussian with the prior spectrum S(n) (2, 2), e is noise of the density R(n) (S, S). Whoever
hears the whole drive, before and after, can do no better by linear means than

    z^ = K a,     K = S H* (H S H* + R)^-1,     P = S - K H S

P(n) is the spectrum of what remains unknown (Wiener 1949; Kailath, Sayed & Hassibi, "Linear
Estimation", 2000, chapter 7). Three accelerometers hear heave, pitch and roll; heave and pitch are
made by the mean of the wheel paths, and only roll by their difference. With equal suspension in
front and behind roll is blind at n = (2 k + 1) / (2 wheelbase); with unequal it is not.

R = N² v, N the sensors' noise density; with a `model_error` m each sensor reports besides that m
times its own road-made signal as noise of its own, R_ii = N² v + m² (H S H*)_ii: a model that is
wrong by that share, in every sensor in another way. Above the low-pass `f_c` nothing is heard.

Dampers and friction enter as the damper that errs least in the mean square for a normal rate of
extension, whose standard deviation follows from the road, the speed and the damper itself
(`equivalent_damping`). What of their force is not linear is left out: it is no noise to an
estimator that knows the law. To one that is linear it is (`residual_force_psd.py`), and then
belongs to R.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from road_envs.analysis.roughness import CLASSES, N_0, root_coherence
from road_envs.analysis.statistical_linearization import (
    nonlinear_residual,
    residual_force_psd,
    sensor_psd,
)
from road_envs.data.record import scored_band
from road_envs.sensing.instruments import Instruments
from road_envs.vehicle.equations import Plant, build_plant
from road_envs.vehicle.linear_model import (
    LinearModel,
    combine_wheel_paths,
    frequency_response,
    gaussian_damping,
    linearise,
    strut_rate_response,
)
from road_envs.vehicle.parameters import VehicleParameters

F_C = 25.0
"""Low-pass of the processed accelerations [Hz]."""

N_FREQUENCIES = 4001
"""Frequencies in a band: enough for the narrowest notch, that of stiff struts."""

Mode = str | Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class RoadPrior:
    """What is known of the road before it is driven on: an ISO 8608 road, equally rough in all
    directions. `G_d0` [m³] at n0, waviness `w`, distance `track` [m] of the wheel paths.
    """

    G_d0: float = CLASSES["D"]
    w: float = 2.0
    track: float = 1.5

    def __post_init__(self):
        for name in ("G_d0", "w", "track"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")

    def density(self, n: np.ndarray) -> np.ndarray:
        """One-sided density [m³] of either wheel path at `n` [cycles/m], any shape but 0."""
        return self.G_d0 * (np.asarray(n, dtype=float) / N_0) ** -self.w

    def spectrum(self, n: np.ndarray) -> np.ndarray:
        """Densities and cross-densities (F, 2, 2) [m³] of both wheel paths at `n` (F,)."""
        g = root_coherence(n, self.w, self.track)
        one = np.ones_like(g)
        rows = np.array([[one, g], [g, one]]) * self.density(n)
        return np.moveaxis(rows, -1, 0)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Spectra (F, 2, 2) [m³] at `n` (F,) [cycles/m] of both wheel paths: `prior` before the drive,
    `error` of the best linear estimate after it; `gain` (F, 2, S) [m per m/s²] of that estimate.
    """

    n: np.ndarray
    prior: np.ndarray
    error: np.ndarray
    gain: np.ndarray

    @property
    def paths(self) -> np.ndarray:
        """Densities (F, 2) [m³] of the error of the left and the right wheel path."""
        return np.real(self.error[:, [0, 1], [0, 1]])

    @property
    def mean(self) -> np.ndarray:
        """Density (F,) [m³] of the error of the mean of the wheel paths."""
        return _project_psd(self.error, 0.5, 0.5)

    @property
    def difference(self) -> np.ndarray:
        """Density (F,) [m³] of the error of left less right."""
        return _project_psd(self.error, 1.0, -1.0)

    def relative_error(self, which: str) -> np.ndarray:
        """Share (F,) [-] of the amplitude that stays unknown of "left", "right", "mean" or
        "difference".
        """
        weights = {"left": (1.0, 0.0), "right": (0.0, 1.0), "mean": (0.5, 0.5)}
        at = weights.get(which, (1.0, -1.0))
        return np.sqrt(_project_psd(self.error, *at) / _project_psd(self.prior, *at))

    def variance(self) -> np.ndarray:
        """Variance (2,) [m²] of the error of each wheel path over the frequencies held."""
        return np.trapezoid(self.paths, self.n, axis=0)

    def nrmse(self) -> np.ndarray:
        """RMS of the error over RMS of the road (2,) [-], each wheel path, over the same."""
        prior = np.real(self.prior[:, [0, 1], [0, 1]])
        return np.sqrt(self.variance() / np.trapezoid(prior, self.n, axis=0))

    @cached_property
    def pooled(self) -> float:
        """`nrmse` of both wheel paths together [-], as the judge pools them."""
        return float(np.sqrt(np.mean(self.nrmse() ** 2)))


def _project_psd(spectrum: np.ndarray, left: float, right: float) -> np.ndarray:
    """Density (F,) of left x the left path + right x the right path."""
    a = np.array([left, right])
    return np.maximum(np.real(a @ spectrum @ a), 0.0)  # rounding may leave -1e-30


def posterior(
    n: np.ndarray, H: np.ndarray, S: np.ndarray, R: np.ndarray, model_error: float = 0.0
) -> Posterior:
    """The best linear estimate of wheel paths with the spectrum `S` (F, 2, 2) from sensors with the
    responses `H` (F, S, 2) and the noise spectrum `R` (F, S, S), over `n` (F,).
    """
    HS = H @ S
    signal = HS @ _adjoint(H)
    noise = R + model_error**2 * np.real(signal) * np.eye(H.shape[1])
    # K (signal + noise) = S H*, solved for the adjoint of K
    gain = _adjoint(np.linalg.solve(signal + noise, HS))
    error = S - gain @ HS
    return Posterior(n, S, 0.5 * (error + _adjoint(error)), gain)


def bound(
    car: Plant | VehicleParameters,
    mode: Mode,
    v: float,
    instruments: Instruments,
    prior: RoadPrior,
    *,
    locations: Mapping[str, tuple[float, float]] | None = None,
    damping: np.ndarray | None = None,
    model_error: float = 0.0,
    residual_as_noise: bool = False,
    n: np.ndarray | None = None,
    f_c: float = F_C,
) -> Posterior:
    """What `instruments` on a car in `mode` at `v` [m/s] leave unknown of a road like `prior`.

    Over `n` [cycles/m], by default the judged band. Sensors sit where the instruments say, or at
    `locations`, name -> (x, y) [m]. `damping` (4,) [N s/m] of the struts is `equivalent_damping` if
    it is not given. With `residual_as_noise`, what the struts' forces are not linear in counts as
    noise: the least error of an estimator that is linear. Raises ValueError on values that make no
    sense.
    """
    if not 0 <= model_error < np.inf:
        raise ValueError(f"model_error must not be negative, got {model_error}")
    n = np.linspace(*scored_band(v), N_FREQUENCIES) if n is None else np.asarray(n, dtype=float)
    if damping is None:
        damping = equivalent_damping(car, mode, v, prior)
    if locations is None:
        if isinstance(car, Plant):
            raise ValueError("a plant does not know the axles of its sensors: give their places")
        locations = instruments.locations(car)
    model = linearise(car, mode, locations, damping=damping)
    H = frequency_response(model, v, n=n)
    H[n * v > f_c] = 0.0
    noise = np.maximum(instruments.noise_density, 1e-9) ** 2 * v  # over n; never singular
    R = np.broadcast_to(noise * np.eye(H.shape[1]), (n.size, H.shape[1], H.shape[1]))
    if residual_as_noise:
        forces = residual_force_psd(
            model, nonlinear_residual(car, mode, damping), v, prior.spectrum, n * v
        )
        R = R + v * sensor_psd(model, n * v, forces)
    return posterior(n, H, prior.spectrum(n), R, model_error)


def _adjoint(matrices: np.ndarray) -> np.ndarray:
    return np.conj(np.swapaxes(matrices, -1, -2))


def equivalent_damping(
    car: Plant | VehicleParameters, mode: Mode, v: float, prior: RoadPrior
) -> np.ndarray:
    """The struts' equivalent dampers (4,) [N s/m] on a road like `prior` at `v` [m/s].

    Fixed point of statistical linearisation: the dampers decide how fast the struts move, and the
    motion decides the dampers. Raises ValueError, and ArithmeticError if it is not found.
    """
    one = car if isinstance(car, Plant) else build_plant(car)
    f = np.geomspace(0.05, 50.0, 300)
    S = prior.spectrum(f / v) / v
    damping = gaussian_damping(one, mode, 0.1)
    for _ in range(60):
        model = linearise(one, mode, {}, damping=damping)
        new = gaussian_damping(one, mode, np.maximum(strut_rate_std(model, v, f, S), 1e-6))
        change = np.abs(np.log(new / damping)).max()
        damping = damping**0.3 * new**0.7  # quickest where a damper falls with the root of its rate
        if change < 1e-3:
            return damping
    raise ArithmeticError(f"no equivalent damping was found at {v:g} m/s, G_d0 {prior.G_d0:g} m³")


def strut_rate_std(model: LinearModel, v: float, f: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Standard deviations (4,) [m/s] of the struts' rates of extension on wheel paths with the
    spectrum `S` (F, 2, 2) [m²/Hz] at `f` (F,) [Hz].
    """
    H = combine_wheel_paths(model, v, f, strut_rate_response(model, f))
    density = np.real(np.einsum("fwa,fab,fwb->fw", H, S, H.conj()))
    return np.sqrt(np.trapezoid(density, f, axis=0))


@dataclass(frozen=True, eq=False)
class BoundTable:
    """The bound as a table that a switching policy can look up at every step.

    `nrmse` (front state, rear state, speed) [-], both wheel paths pooled, for `modes` and `speeds`
    (V,) [m/s]: what is left unknown in the judged band, whatever will have been measured, for in
    the linear model it does not depend on the measurements.
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
        model_error: float = 0.0,
    ) -> "BoundTable":
        """Evaluate the bound for every pair of states and every speed."""
        v = np.unique(np.array(list(speeds), dtype=float))
        one, locations = build_plant(car), instruments.locations(car)

        def relative_error(front: str, rear: str, speed: float) -> float:
            mode = {"front": front, "rear": rear}
            n = np.linspace(*scored_band(speed), N_FREQUENCIES // 4)
            found = bound(
                one,
                mode,
                speed,
                instruments,
                prior,
                locations=locations,
                model_error=model_error,
                n=n,
            )
            return found.pooled

        table = [[[relative_error(f, r, speed) for speed in v] for r in modes] for f in modes]
        return cls(modes, v, np.array(table))

    def interpolate(self, front: str, rear: str, v: float) -> float:
        """The bound [-] in a pair of states at `v` [m/s], between the speeds by interpolation."""
        pair = self.nrmse[self.modes.index(front), self.modes.index(rear)]
        return float(np.interp(v, self.speeds, pair))
