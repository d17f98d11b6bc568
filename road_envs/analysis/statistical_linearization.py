"""Nonlinear residual of the strut forces, as noise for an estimator with a linear model.

About rest the force of a strut is, in its extension e and rate of extension e',

    F(e, e') = F_0 - k e - c e' + r(e) + q(e')

with k the slope at rest and c the damping of least mean square error for this motion. For a
Gaussian motion with the autocorrelation R(tau) = sigma² rho(tau), the residual q is uncorrelated
with the motion at any lag (Bussgang 1952), and has the autocorrelation

    R_q(tau) = sum over k >= 2 of a_k² rho(tau)^k,     a_k = E[q(sigma x) He_k(x)] / sqrt(k!)

(Mehler's formula; Price, IRE Trans. Inf. Theory 4, 1958). It excites the vehicle like an additional
force in parallel with each strut. Wheels off the ground are not considered.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from road_envs.vehicle.equations import Plant, build_plant
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.linear_model import (
    LinearModel,
    combine_wheel_paths,
    linearise,
    strut_forces,
    strut_rate_response,
)
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import encode_command, settled_strut_state

ORDERS = 24  # highest order of the Hermite polynomials whose spectra are computed
BANDWIDTH = 60.0  # highest frequency [Hz] of the spectrum of the motion
N_FREQUENCIES = 4096  # number of frequencies of that spectrum


@dataclass(frozen=True, eq=False)
class NonlinearResidual:
    """Residual forces (4, K) [N] of the struts, upwards on the body, over the extension from rest
    `e` (K,) [m] and over the rate of extension `e_dot` (K,) [m/s].
    """

    e: np.ndarray
    over_extension: np.ndarray
    e_dot: np.ndarray
    over_rate: np.ndarray


def nonlinear_residual(
    car: Plant | VehicleParameters, mode: str | Mapping[str, str], damping: np.ndarray
) -> NonlinearResidual:
    """Return the residual of a mode beyond `damping` (4,) [N s/m] and the spring rates at rest."""
    plant = car if isinstance(car, Plant) else build_plant(car)
    rest = equilibrium(plant, settled_strut_state(encode_command(mode)), np.zeros(4))
    e_0 = (linearise(plant, mode, {}, damping=damping).strut_rows @ rest[: rest.size // 2])[:, None]
    e, e_dot = np.linspace(-0.2, 0.25, 1801), np.linspace(-3.0, 3.0, 6001)
    no_rate = np.zeros((4, 1))
    F_0 = strut_forces(plant, mode, e_0, no_rate)
    de = 1e-5
    ends = [strut_forces(plant, mode, e_0 + x, no_rate) for x in (de, -de)]
    k = (ends[1] - ends[0]) / (2.0 * de)
    F_e = strut_forces(plant, mode, e_0 + e, np.zeros((4, e.size)))
    F_rate = strut_forces(plant, mode, np.broadcast_to(e_0, (4, e_dot.size)), no_rate + e_dot)
    return NonlinearResidual(e, F_e - F_0 + k * e, e_dot, F_rate - F_0 + damping[:, None] * e_dot)


def residual_force_psd(
    model: LinearModel,
    residual: NonlinearResidual,
    v: float,
    spectrum: Callable[[np.ndarray], np.ndarray],
    f: np.ndarray,
) -> np.ndarray:
    """Return the spectrum (F, 4, 4) [N²/Hz] at `f` (F,) [Hz] of the residual strut forces, driving
    at `v` [m/s] on wheel paths with the `spectrum` (N, 2, 2) [m³], a function of `n` (N,).
    """
    df = BANDWIDTH / N_FREQUENCIES
    f_motion = df * np.arange(1, N_FREQUENCIES + 1)
    H = combine_wheel_paths(model, v, f_motion, strut_rate_response(model, f_motion))
    rates = H @ (spectrum(f_motion / v) / v) @ hermitian(H)
    extensions = rates / (2.0 * np.pi * f_motion[:, None, None]) ** 2
    total = _hermite(residual.e_dot, residual.over_rate, rates, df)
    total = total + _hermite(residual.e, residual.over_extension, extensions, df)
    grid = df * np.arange(len(total))
    flat = total.reshape(grid.size, -1)
    parts = [np.interp(f, grid, x.real) + 1j * np.interp(f, grid, x.imag) for x in flat.T]
    return np.array(parts).T.reshape(f.size, 4, 4)


def _hermite(x: np.ndarray, laws: np.ndarray, spectrum: np.ndarray, df: float) -> np.ndarray:
    """Spectrum (K + 1, 4, 4) at 0 ... K df of the nonlinear part of `laws` (4, J) over `x` (J,),
    applied to Gaussian signals with the one-sided `spectrum` (K, 4, 4) at df ... K df.
    """
    K = len(spectrum)
    sigma = np.sqrt(np.real(np.einsum("fii->i", spectrum)) * df)
    a, power = _coefficients(x, laws, sigma)
    lines = np.concatenate([np.zeros((1, 4, 4)), spectrum, np.zeros((K, 4, 4))])
    rho = scipy.fft.irfft(lines, axis=0) * (2 * K * df) / np.outer(sigma, sigma)
    R = np.outer(a[ORDERS], a[ORDERS]) * rho
    for k in range(ORDERS - 1, 1, -1):  # Horner's rule, in place: the arrays are large
        R += np.outer(a[k], a[k])
        R *= rho
    R *= rho
    density = scipy.fft.rfft(R, axis=0)[: K + 1] / (2 * K * df)
    # the spectra broaden with the order: the power of the orders above is added as white noise
    return density + np.diag(np.maximum(power - np.sum(a[2:] ** 2, axis=0), 0.0)) / (2 * K * df)


def _coefficients(
    x: np.ndarray, laws: np.ndarray, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (ORDERS + 1, 4) of normalised Hermite polynomials of Gaussian signals, and the
    power (4,) of the part that is neither constant nor linear.
    """
    u = np.linspace(-7.0, 7.0, 2801)
    weight = np.exp(-0.5 * u**2)
    weight /= weight.sum()
    F = np.array([np.interp(s * u, x, law) for s, law in zip(sigma, laws, strict=True)])
    he = [np.ones_like(u), u]
    for k in range(2, ORDERS + 1):
        he.append((u * he[-1] - np.sqrt(k - 1.0) * he[-2]) / np.sqrt(k))
    a = (np.array(he) * weight) @ F.T
    return a, F**2 @ weight - a[0] ** 2 - a[1] ** 2


def hermitian(matrices: np.ndarray) -> np.ndarray:
    """Return the conjugate transposes of the last two axes."""
    return np.conj(np.swapaxes(matrices, -1, -2))
