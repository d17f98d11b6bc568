"""The Wiener smoother of a whole record: stretch by stretch, with gaps, and again with what of the
struts' forces is not linear taken out.

On a stretch the signals are a Gaussian process of known spectrum, measured where they can be
trusted. With C the covariance that this spectrum makes on a circle and M the selection of what is
measured, the estimate is

    z^ = C_za M' (M C_aa M')^-1 a

so ends and gaps are nothing in particular (`hearing.solve`).

A `pass` beyond the first is statistical linearisation about the estimate itself: from z^ follow the
struts' motion and its uncertainty, from these the expected remainder q of their forces and what is
left unknown of it; q is taken out of the signals, what is left stays as noise, and the level of all
noise is fitted again. Where wheels leave the ground the passes may not converge: one that makes the
signals less likely than the first did, after a remainder that was still another one than before, is
refused, and the one before it stands.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, rfft

from estimators.wiener.segments import Stretch, stretches
from estimators.wiener.spectral_model import (
    Hearing,
    adjoint,
    alive,
    apply,
    likely,
    lines_of,
    listen,
    solve,
    spectrum_of,
)
from road_envs.analysis.information_bound import F_C
from road_envs.analysis.statistical_linearization import Remainder
from road_envs.data.record import GRID, Estimate, Record, grid, scored_band
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.equations import plant
from road_envs.vehicle.parameters import VehicleParameters

LENGTH, MARGIN = 150.0, 40.0
"""Stretches [m], and the record around them that they also see."""

F_DATUM = 0.1
"""Slower than this [Hz] nothing is claimed."""

RELAXATION = 0.7
"""Share of the way to a new remainder that a pass goes."""

LEFT = 0.5
"""Of the power that a pass cannot know of the remainder, the share that counts as noise in the
next. Less than all, since errors of neighbouring moments cancel; tuned on training drives."""

DIVERGING = 0.8
"""Change of the remainder from pass to pass, relative to itself."""


class Pass(NamedTuple):
    """Lines of wheel paths `z` (2, F) and of struts' rates `w` (4, F) on a circle, and the
    densities `error` (F, 2, 2) [m³] of the paths' errors.
    """

    z: np.ndarray
    w: np.ndarray
    error: np.ndarray


def reconstruct(
    record: Record, car: VehicleParameters, instruments: str, passes: int, std_factor: float
) -> Estimate:
    """Both wheel paths, with standard deviations in the judged band times `std_factor`.

    Raises ConfigError on unknown instruments, ValueError on a record that says nothing.
    """
    tools, one = load_instruments(instruments), plant(car)
    places, track = tools.places(car), car.front.y_t + car.rear.y_t
    stations = grid(record.length)
    total, square, weights = (np.zeros((2, stations.size)) for _ in range(3))
    notes: list[str] = []
    parts = list(stretches(record, tools, LENGTH, MARGIN))
    for stretch in parts:
        heard = listen(one, places, tools, stretch, track)
        last = list(smooth(heard, stretch, passes))[-1]
        z, std = on_grid(heard, stretch, last)
        at = np.round(stations / GRID).astype(int) - stretch.first * stretch.stride
        weight = _weight(stations, stretch.core, record.length)
        inside = (at >= 0) & (at < z.shape[1]) & (weight > 0.0)
        total[:, inside] += weight[inside] * z[:, at[inside]]
        square[:, inside] += weight[inside] * std[:, at[inside]]
        weights[:, inside] += weight[inside]
        notes += stretch.notes
    weights = np.maximum(weights, 1e-12)
    return Estimate(stations, total / weights, std_factor * square / weights, tuple(notes))


def smooth(heard: Hearing, stretch: Stretch, passes: int) -> Iterator[Pass]:
    """The estimate after each pass that counts."""
    M, size, measured = stretch.a.shape[1], heard.size, max(int(stretch.seen.sum()), 1)
    q, share = np.zeros((4, size)), np.ones(4)
    start: np.ndarray | None = None
    first: float | None = None
    change = 1.0
    for _ in range(passes):
        push = apply(heard.H_force, rfft(q))
        y = np.where(stretch.seen, stretch.a - irfft(push, size)[:, :M], 0.0)
        if start is not None:
            lines = lines_of(heard, replace(stretch, a=y))
            _, kappa = likely(heard, lines, alive(stretch), share)
            heard = replace(heard, kappa=kappa)
        spectrum = spectrum_of(heard, heard.noise(share))
        start = solve(spectrum / (2.0 * stretch.d), y, stretch.seen, size, start)
        unlikely = float(np.vdot(y, start)) / measured + np.mean(np.linalg.slogdet(spectrum)[1]) / 3
        first = unlikely if first is None else first
        if change > DIVERGING and not unlikely <= first:
            return
        SH = heard.S @ adjoint(heard.H)
        z = apply(SH, rfft(start, size)) / (2.0 * stretch.d) * (heard.f > F_DATUM)
        w = apply(heard.X, z) + apply(heard.X_force, rfft(q))
        now = Pass(z, w, heard.posterior(share).error)
        yield now
        expected, unknown = _remainders(heard, now)
        change = float(np.linalg.norm(expected - q)) / max(float(np.linalg.norm(expected)), 1e-9)
        q += RELAXATION * (expected - q)
        share = np.clip(LEFT * unknown / np.maximum(heard.power, 1e-9), 0.01, 1.0)


def on_grid(heard: Hearing, stretch: Stretch, found: Pass) -> tuple[np.ndarray, np.ndarray]:
    """Heights and their standard deviations (2, N) [m], in steps of GRID from the first station."""
    size = heard.size * stretch.stride
    lines = np.zeros((2, size // 2 + 1), dtype=complex)
    lines[:, : heard.n.size] = found.z * (heard.f < F_C)
    z = irfft(lines, size) * stretch.stride
    low, high = scored_band(stretch.v)
    band = (heard.n >= low) & (heard.n <= high)

    def std(spectrum: np.ndarray) -> np.ndarray:
        return np.sqrt(np.trapezoid(np.real(np.einsum("fii->if", spectrum[band])), heard.n[band]))

    share = _coverage(stretch, size)
    known, prior = std(found.error)[:, None] ** 2, std(heard.S)[:, None] ** 2
    return z, np.sqrt(share * known + (1.0 - share) * prior)


def _coverage(stretch: Stretch, size: int) -> np.ndarray:
    """Share (size,) of the samples about each station that were measured, 1.5 m to either side."""
    measured = np.repeat(stretch.seen.mean(axis=0), stretch.stride)
    window = np.ones(2 * round(1.5 / GRID) + 1)
    share = np.zeros(size)
    share[: measured.size] = np.convolve(measured, window / window.size, "same")
    return np.clip(share, 0.0, 1.0)


def _weight(stations: np.ndarray, core: tuple[float, float], length: float) -> np.ndarray:
    """How much a stretch says at each station: all in its core, fading over half the margin into
    its neighbours.
    """
    fade = 0.5 * MARGIN
    up = np.clip((stations - core[0]) / fade + 0.5, 0.0, 1.0) if core[0] > 0.0 else 1.0
    down = np.clip((core[1] - stations) / fade + 0.5, 0.0, 1.0) if core[1] < length else 1.0
    return np.minimum(up, down) * np.ones(stations.size)


def _remainders(heard: Hearing, found: Pass) -> tuple[np.ndarray, np.ndarray]:
    """Expected remainders (4, size) [N] of the struts' forces, and the power (4,) [N²] unknown."""
    slow = heard.f > F_DATUM
    per_rate = np.where(slow, 1.0 / (2j * np.pi * heard.f), 0.0)
    w, e = irfft(found.w, heard.size), irfft(found.w * per_rate, heard.size)
    P = np.real(np.einsum("fwa,fab,fwb->wf", heard.X, found.error, heard.X.conj()))
    use = slow & (heard.f < F_C)
    std_w = np.sqrt(np.trapezoid(P[:, use], heard.n[use]))
    std_e = np.sqrt(np.trapezoid((P * np.abs(per_rate) ** 2)[:, use], heard.n[use]))
    return expect(heard.rest, e, w, std_e, std_w)


def expect(
    rest: Remainder, e: np.ndarray, w: np.ndarray, std_e: np.ndarray, std_w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean force (4, N) [N] at extensions `e` and rates `w` (4, N) that are known but for normal
    errors of `std_e` [m], `std_w` [m/s] (4,), and its mean variance (4,) [N²].
    """
    mean, variance = np.zeros(e.shape), np.zeros(4)
    for i in range(4):
        tables = (
            (rest.e, rest.of_e[i], e[i], std_e[i]),
            (rest.e_dot, rest.of_rate[i], w[i], std_w[i]),
        )
        for grid_, law, at, std in tables:
            first, second = _blurred(grid_, law, std), _blurred(grid_, law**2, std)
            mean[i] += np.interp(at, grid_, first)
            variance[i] += float(np.mean(np.interp(at, grid_, second - first**2)))
    return mean, variance


def _blurred(at: np.ndarray, law: np.ndarray, std: float) -> np.ndarray:
    """E[law(at + std x)] for a normal x, by 13 points."""
    x = np.linspace(-3.0, 3.0, 13)
    weight = np.exp(-0.5 * x**2)
    weight /= weight.sum()
    return weight @ np.array([np.interp(at + std * each, at, law) for each in x])
