"""How the linearised car hears a road: responses, prior and noise on a stretch's frequencies, and
the roughness and the noise that the stretch itself speaks for.

    a = H z + H_F q + e     z: wheel paths, q: what of the struts' forces is not linear, e: noise

The level G_d(n0) of the prior, its shape (how far each octave is from a waviness of 2) and a factor
kappa(f) on the noise, octave by octave, are those that make the stretch likely: empirical Bayes by
expectation and maximisation (Dempster, Laird & Rubin, J. R. Stat. Soc. B 39, 1977), in turns with
the equivalent dampers that go with the road. Noise can be told from road since three sensors hear
two wheel paths: one combination of them hears noise alone. A car that is not quite the one supposed
shows there, too, and raises kappa.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from estimators.wiener.segments import Stretch
from road_envs.analysis.information_bound import F_C, Posterior, RoadPrior, posterior, road_damping
from road_envs.analysis.statistical_linearization import Remainder, distortion, remainder
from road_envs.sensing.instruments import Instruments
from road_envs.vehicle.equations import Plant
from road_envs.vehicle.linear_model import (
    by_path,
    force_response,
    linearise,
    strut_rate_response,
    wheel_response,
)

APRON = 40.0
"""Road [m] that nobody measured, behind a stretch, before it begins again in the circle of a
discrete Fourier transform."""

F_LOW = 0.4
"""Below it [Hz] the sensors' offsets and drifts are at home."""

OCTAVES = np.array([0.7, 1.4, 2.8, 5.6, 11.0, 20.0])
"""Centres [Hz] of the bands of kappa, between which it is interpolated over log f."""

N_OCTAVES = 0.125 * 2.0 ** np.arange(6)
"""Centres [cycles/m] of the bands of the road's shape, likewise."""

DOUBT = 12.0
"""Weight of kappa = 1, and of a shape of 1, in each band, in lines of the spectrum."""

TOLERANCE, STEPS = 1e-3, 80
"""Of the conjugate gradients: relative size of the rest, and most steps."""

ROUNDS, TURNS = 4, 6
"""Times that the dampers follow the level, and steps of expectation and maximisation in each."""


@dataclass(frozen=True, kw_only=True)
class Felt(RoadPrior):
    """A road as it was felt: `shape` at N_OCTAVES times what its level and waviness say."""

    shape: tuple[float, ...] = (1.0,) * N_OCTAVES.size

    def density(self, n: np.ndarray) -> np.ndarray:
        """One-sided density [m³] of either wheel path at `n` [cycles/m], any shape but 0."""
        more = np.interp(np.log(n), np.log(N_OCTAVES), np.log(self.shape))
        return super().density(n) * np.exp(more)


@dataclass(frozen=True, eq=False)
class Hearing:
    """On the frequencies `n` (F,) [cycles/m], `f` [Hz], of a circle of `size` stations.

    `H` (F, 3, 2) [m/s² per m] and `X` (F, 4, 2) [m/s per m]: responses of the sensors and of the
    struts' rates of extension to the wheel paths; `H_force` (F, 3, 4), `X_force` (F, 4, 4): to
    forces beside the struts'. `rest`: the law of those forces, `power` (4,) [N²] and spectrum over
    n `D` (F, 4, 4) [N² m] of them; `white` [(m/s²)² m] that of a sensor's own noise; `prior` of the
    road and its spectrum `S` (F, 2, 2) [m³].
    """

    size: int
    n: np.ndarray
    f: np.ndarray
    H: np.ndarray
    X: np.ndarray
    H_force: np.ndarray
    X_force: np.ndarray
    rest: Remainder
    power: np.ndarray
    D: np.ndarray
    white: float
    prior: Felt
    S: np.ndarray
    kappa: np.ndarray

    def noise(self, share: np.ndarray | None = None) -> np.ndarray:
        """Spectrum (F, 3, 3) over n of all noise, with a `share` (4,) of the forces' power left."""
        left = self.D if share is None else self.D * np.sqrt(np.outer(share, share))
        forces = self.H_force @ left @ adjoint(self.H_force)
        return self.kappa[:, None, None] * (forces + self.white * np.eye(3))

    def posterior(self, share: np.ndarray | None = None) -> Posterior:
        """What can be known of the road at each frequency, with a `share` of the forces unknown."""
        return posterior(self.n, self.H, self.S, self.noise(share))


def listen(
    one: Plant,
    places: dict[str, tuple[float, float]],
    instruments: Instruments,
    stretch: Stretch,
    track: float,
) -> Hearing:
    """How a car hears a `stretch`; level and noise are fitted to it. `track` [m] of the wheels."""
    size = next_fast_len(stretch.a.shape[1] + round(APRON / stretch.d), real=True)
    prior = Felt(track=track)
    kappa = np.ones(size // 2 + 1)
    for _ in range(ROUNDS):
        found = hearing(one, places, instruments, stretch, prior, size, kappa)
        prior, kappa = likely(found, lines_of(found, stretch), alive(stretch))
    return replace(found, kappa=kappa, prior=prior, S=prior.spectrum(found.n))


def hearing(
    one: Plant,
    places: dict[str, tuple[float, float]],
    instruments: Instruments,
    stretch: Stretch,
    prior: Felt,
    size: int,
    kappa: np.ndarray,
) -> Hearing:
    """How a car hears a road like `prior` on a circle of `size` stations."""
    v = stretch.v
    n = rfftfreq(size, stretch.d)
    n[0] = 0.5 * n[1]  # at 0 nothing is heard, and the prior has no end
    f = n * v
    damping = road_damping(one, stretch.mode, v, prior)
    model = linearise(one, stretch.mode, places, damping=damping)
    alias = instruments.response(f)[:, None, None]
    H_force, X_force = force_response(model, f)
    rest = remainder(one, stretch.mode, damping)
    D = distortion(model, rest, v, prior.spectrum, f)
    return Hearing(
        size=size,
        n=n,
        f=f,
        H=by_path(model, v, f, wheel_response(model, f)) * alias,
        X=by_path(model, v, f, strut_rate_response(model, f)),
        H_force=H_force * alias,
        X_force=X_force,
        rest=rest,
        power=np.trapezoid(np.real(np.einsum("fww->wf", D)), f),
        D=D * v,
        white=max(instruments.noise_density, 1e-6) ** 2 * v,
        prior=prior,
        S=prior.spectrum(n),
        kappa=kappa,
    )


def lines_of(found: Hearing, stretch: Stretch) -> np.ndarray:
    """Lines (F, 3, 1) [m/s² sqrt(m)] of the spectrum of a stretch, its gaps filled with what the
    rest of it makes likely there.
    """
    measured = np.flatnonzero(stretch.seen[alive(stretch)].any(axis=0))
    whole = np.zeros(stretch.a.shape[1], dtype=bool)
    if measured.size:
        whole[measured[0] : measured[-1] + 1] = True
    a = stretch.a
    if (whole & ~stretch.seen[alive(stretch)]).any():
        C = spectrum_of(found, found.noise()) / (2.0 * stretch.d)
        likely_ones = on_circle(C, solve(C, a, stretch.seen, found.size), found.size)
        a = np.where(stretch.seen, a, likely_ones)
    # a Hann window: an abrupt end would spread the body's resonances over frequencies at which
    # there is little else
    window = np.zeros(whole.size)
    window[whole] = np.sin(np.pi * (np.arange(whole.sum()) + 0.5) / max(whole.sum(), 1)) ** 2
    power = max(float(window @ window), 1e-9)
    return rfft(a * window * np.sqrt(2.0 * stretch.d / power), found.size).T[:, :, None]


def alive(stretch: Stretch) -> np.ndarray:
    """Indices of the sensors that report in most of the stretch."""
    share = stretch.seen.mean(axis=1)
    return np.flatnonzero(share > 0.5 * share.max())


def likely(
    found: Hearing,
    lines: np.ndarray,
    sensors: np.ndarray,
    share: np.ndarray | None = None,
) -> tuple[Felt, np.ndarray]:
    """A likelier road and kappa (F,), given the spectrum's `lines` (F, 3, 1) of `sensors`.

    With fewer than three sensors noise cannot be told from road, and kappa stays.
    """
    heard = (found.f > F_LOW) & (found.f < F_C)
    n, y, H = found.n[heard], lines[heard][:, sensors], found.H[heard][:, sensors]
    base = (found.noise(share) / found.kappa[:, None, None])[heard][:, sensors][:, :, sensors]
    band = np.argmin(np.abs(np.log(found.f[heard, None] / OCTAVES)), axis=1)
    factor = np.interp(np.log(OCTAVES), np.log(found.f), found.kappa)
    octave = np.argmin(np.abs(np.log(n[:, None] / N_OCTAVES)), axis=1)
    level, unit = found.prior.G_d0, replace(found.prior, G_d0=1.0, shape=Felt.shape).spectrum(n)
    shape = np.array(found.prior.shape)
    for _ in range(TURNS):
        now = posterior(
            n, H, unit * (level * shape[octave, None, None]), base * factor[band, None, None]
        )
        z = now.gain @ y
        e = y - H @ z
        road = z @ adjoint(z) + now.error
        noise = e @ adjoint(e) + H @ now.error @ adjoint(H)
        rough = _trace(np.linalg.solve(unit, road)) / 2.0
        level = float(np.mean(rough / shape[octave]))
        shape = _shrunk(rough / level, octave, N_OCTAVES.size)
        if sensors.size == 3:
            each = _trace(np.linalg.solve(base, noise)) / 3.0
            factor = _shrunk(each, band, OCTAVES.size)
    prior = replace(found.prior, G_d0=level, shape=tuple(shape.tolist()))
    return prior, np.exp(np.interp(np.log(found.f), np.log(OCTAVES), np.log(factor)))


def _shrunk(each: np.ndarray, band: np.ndarray, bands: int) -> np.ndarray:
    """Means (bands,) of what each line says in its `band`, drawn to 1 where lines are few."""
    return (np.bincount(band, each, bands) + DOUBT) / (np.bincount(band, minlength=bands) + DOUBT)


def _trace(matrices: np.ndarray) -> np.ndarray:
    return np.real(np.einsum("fii->f", matrices))


def adjoint(matrices: np.ndarray) -> np.ndarray:
    """Conjugate transposes of the last two axes."""
    return np.conj(np.swapaxes(matrices, -1, -2))


def spectrum_of(heard: Hearing, noise: np.ndarray) -> np.ndarray:
    """Spectrum (F, 3, 3) over n of the signals, given that of the noise."""
    return heard.H @ heard.S @ adjoint(heard.H) + noise


def apply(responses: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Responses (F, a, b) to lines (b, F), as lines (a, F)."""
    return np.einsum("fab,bf->af", responses, lines)


def on_circle(spectrum: np.ndarray, x: np.ndarray, size: int) -> np.ndarray:
    """Signals `x` (a, M) times the circulant matrix of a spectrum (F, a, a)."""
    return irfft(apply(spectrum, rfft(x, size)), size)[:, : x.shape[1]]


def solve(
    C: np.ndarray, y: np.ndarray, seen: np.ndarray, size: int, start: np.ndarray | None = None
) -> np.ndarray:
    """The x (3, M), 0 where nothing is `seen`, with C x = y (3, M) where it is.

    By conjugate gradients in Fourier transforms; C^-1 of the whole circle is the preconditioner.
    """
    inverse = np.linalg.inv(C)
    y = seen * y
    x = np.zeros_like(y) if start is None else start
    r = y - seen * on_circle(C, x, size)
    aim = TOLERANCE**2 * np.vdot(y, on_circle(inverse, y, size))
    p, before = np.zeros_like(y), np.inf
    for _ in range(STEPS):
        z = seen * on_circle(inverse, r, size)
        square = np.vdot(r, z)
        if not square > aim:
            break
        p = z + square / before * p
        before = square
        Cp = seen * on_circle(C, p, size)
        step = square / np.vdot(p, Cp)
        x = x + step * p
        r = r - step * Cp
    return x
