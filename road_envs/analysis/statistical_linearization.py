"""What of the struts' forces is not linear: noise to whoever listens to the car linearly.

About rest the force of a strut is, in its extension e and rate of extension e',

    F(e, e') = F_0 - k e - c e' + r(e) + q(e')

with k the slope at rest and c the damper that errs least for this motion. For a normal motion with
the autocorrelation R(tau) = sigma² rho(tau), what remains has no correlation with the motion at any
lag (Bussgang 1952), and the autocorrelation

    R_q(tau) = sum over k >= 2 of a_k² rho(tau)^k,     a_k = E[q(sigma x) He_k(x)] / sqrt(k!)

(Mehler's formula; Price, IRE Trans. Inf. Theory 4, 1958). It excites the car like a force beside
each strut's own. What the dampers make of it is small against friction at low speeds, on smooth
roads, and against the gas spring in stiff states, on rough ones. Tyres that leave the ground are
not in it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, rfft

from road_envs.vehicle.equations import N_DOF, Plant, build_plant, equilibrium
from road_envs.vehicle.linear_model import (
    LinearModel,
    combine_wheel_paths,
    force_response,
    linearise,
    strut_forces,
    strut_rate_response,
)
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import encode_command, settled_strut_state

ORDERS = 24
"""Highest Hermite polynomial whose spectrum is computed."""

Spectrum = Callable[[np.ndarray], np.ndarray]

BANDWIDTH, N_FREQUENCIES = 60.0, 4096
"""Band [Hz] and number of frequencies in which the motion is described."""


@dataclass(frozen=True, eq=False)
class NonlinearResidual:
    """Forces (4, K) [N] upwards on the body, beside the linear ones of each strut: `over_extension`
    over the extension from rest `e` (K,) [m], `over_rate` over the rate of extension `e_dot` (K,)
    [m/s].
    """

    e: np.ndarray
    over_extension: np.ndarray
    e_dot: np.ndarray
    over_rate: np.ndarray

    def force(self, e: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        """Force (4, N) [N] at extensions (4, N) [m] from rest and their rates (4, N) [m/s]."""
        tables = zip(self.over_extension, self.over_rate, e, e_dot, strict=True)
        return np.array(
            [np.interp(x, self.e, r) + np.interp(w, self.e_dot, q) for r, q, x, w in tables]
        )


def nonlinear_residual(
    car: Plant | VehicleParameters, mode: str | Mapping[str, str], damping: np.ndarray
) -> NonlinearResidual:
    """What `damping` (4,) [N s/m] and the struts' rates at rest leave out in a mode."""
    one = car if isinstance(car, Plant) else build_plant(car)
    rest = equilibrium(one, settled_strut_state(encode_command(mode)), np.zeros(4))
    at_rest = (linearise(one, mode, {}, damping=damping).strut_rows @ rest[:N_DOF])[:, None]
    e, e_dot, still = np.linspace(-0.2, 0.25, 1801), np.linspace(-3.0, 3.0, 6001), np.zeros((4, 1))
    F_0 = strut_forces(one, mode, at_rest, still)
    near = 1e-5
    ends = [strut_forces(one, mode, at_rest + x, still) for x in (near, -near)]
    k = (ends[1] - ends[0]) / (2.0 * near)
    F_e = strut_forces(one, mode, at_rest + e, np.zeros((4, e.size)))
    F_rate = strut_forces(one, mode, np.broadcast_to(at_rest, (4, e_dot.size)), still + e_dot)
    return NonlinearResidual(e, F_e - F_0 + k * e, e_dot, F_rate - F_0 + damping[:, None] * e_dot)


def residual_force_psd(
    model: LinearModel, rest: NonlinearResidual, v: float, spectrum: Spectrum, f: np.ndarray
) -> np.ndarray:
    """Densities and cross-densities (F, 4, 4) [N²/Hz] at `f` (F,) [Hz] of the struts' remainders.

    At `v` [m/s] on wheel paths whose `spectrum(n)` is (F, 2, 2) [m³] at `n` (F,) [cycles/m].
    """
    df = BANDWIDTH / N_FREQUENCIES
    at = df * np.arange(1, N_FREQUENCIES + 1)
    H = combine_wheel_paths(model, v, at, strut_rate_response(model, at))
    rates = H @ (spectrum(at / v) / v) @ np.conj(np.swapaxes(H, 1, 2))
    extensions = rates / (2.0 * np.pi * at[:, None, None]) ** 2
    found = _hermite(rest.e_dot, rest.over_rate, rates, df) + _hermite(
        rest.e, rest.over_extension, extensions, df
    )
    grid = df * np.arange(len(found))
    flat = found.reshape(grid.size, -1)
    parts = [np.interp(f, grid, x.real) + 1j * np.interp(f, grid, x.imag) for x in flat.T]
    return np.array(parts).T.reshape(f.size, 4, 4)


def _hermite(x: np.ndarray, laws: np.ndarray, spectrum: np.ndarray, df: float) -> np.ndarray:
    """Spectrum (K + 1, 4, 4) of what is not linear in `laws` (4, J), tabled over `x` (J,), of
    normal signals with a one-sided `spectrum` (K, 4, 4), at 0 ... K df.
    """
    K = len(spectrum)
    sigma = np.sqrt(np.real(np.einsum("fii->i", spectrum)) * df)
    a, power = _coefficients(x, laws, sigma)
    lines = np.concatenate([np.zeros((1, 4, 4)), spectrum, np.zeros((K, 4, 4))])
    rho = irfft(lines, axis=0) * (2 * K * df) / np.outer(sigma, sigma)
    R, each = np.zeros_like(rho), rho
    for k in range(2, ORDERS + 1):
        each = each * rho
        R += np.outer(a[k], a[k]) * each
    found = rfft(R, axis=0)[: K + 1] / (2 * K * df)
    # the spectra of higher orders are the broader the higher: all they hold counts as white
    return found + np.diag(np.maximum(power - np.sum(a[2:] ** 2, axis=0), 0.0)) / (2 * K * df)


def _coefficients(
    x: np.ndarray, laws: np.ndarray, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (ORDERS + 1, 4) of normal signals' normed Hermite polynomials, and the power
    (4,) of what is neither constant nor linear.
    """
    at = np.linspace(-7.0, 7.0, 2801)
    weight = np.exp(-0.5 * at**2)
    weight /= weight.sum()
    F = np.array([np.interp(s * at, x, law) for s, law in zip(sigma, laws, strict=True)])
    he = [np.ones_like(at), at]
    for k in range(2, ORDERS + 1):
        he.append((at * he[-1] - np.sqrt(k - 1.0) * he[-2]) / np.sqrt(k))
    a = (np.array(he) * weight) @ F.T
    return a, F**2 @ weight - a[0] ** 2 - a[1] ** 2


def sensor_psd(model: LinearModel, f: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """Spectrum (F, S, S) [(m/s²)²/Hz] at the sensors of forces (F, 4, 4) [N²/Hz] beside the struts,
    at `f` (F,) [Hz].
    """
    H, _ = force_response(model, f)
    return H @ forces @ np.conj(np.swapaxes(H, 1, 2))
