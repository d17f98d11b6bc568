"""Statistical linearisation against closed forms of cube and sign, drawn signals and the oracle."""

import numpy as np
import oracles
import pytest
from scipy import signal
from test_linear_model import energy_matrices
from vehicle_fixtures import CARS, DEFENDER, PLANTS, varied_plant

from road_envs.analysis.information_bound import (
    RoadPrior,
    bound,
    equivalent_damping,
    strut_rate_std,
)
from road_envs.analysis.statistical_linearization import (
    NonlinearResidual,
    _hermite,
    nonlinear_residual,
    residual_force_psd,
)
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.equations import N_DOF
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.linear_model import (
    _wheel_response,
    force_response,
    linearise,
    strut_forces,
    strut_rate_response,
)
from road_envs.vehicle.parameters import TorsionalFrame, VehicleVariation
from road_envs.vehicle.suspension import encode_command, settled_strut_state

PLACES = {"RF": (1.2, -0.5), "LR": (-2.0, 0.6), "RR": (-2.0, -0.6)}
DF = 0.05
F = DF * np.arange(1, 401)


def force_of(residual, e, e_dot):
    """Return the residual force (4, N) at extensions (4, N) from rest and rates (4, N)."""
    tables = zip(residual.over_extension, residual.over_rate, e, e_dot, strict=True)
    return np.array(
        [np.interp(x, residual.e, r) + np.interp(w, residual.e_dot, q) for r, q, x, w in tables]
    )


def spectrum(correlation=0.6):
    """Return the one-sided spectrum (400, 4, 4) of four signals; the second lags the first."""
    shape = np.exp(-(((F - 3.0) / 1.5) ** 2))
    S = np.zeros((F.size, 4, 4), dtype=complex)
    for i in range(4):
        S[:, i, i] = (i + 1.0) * shape
    cross = correlation * np.sqrt(2.0) * shape * np.exp(-2j * np.pi * F * 0.11)
    S[:, 1, 0], S[:, 0, 1] = cross, cross.conj()
    return S


def test_the_residual_of_a_cube_is_the_triple_convolution():
    """x³ = 3 sigma² x + residual, and the residual has the autocorrelation 6 R(tau)³."""
    x = np.linspace(-60.0, 60.0, 20001)
    actual = _hermite(x, np.tile(x**3, (4, 1)), spectrum(), DF)
    tau = np.linspace(-12.0, 12.0, 4801)
    waves = np.exp(2j * np.pi * np.outer(tau, F))
    R = np.real(waves @ spectrum().reshape(F.size, -1)).reshape(tau.size, 4, 4) * DF
    for f in (1.0, 3.0, 9.0):
        kernel = np.exp(-2j * np.pi * f * tau)[:, None, None]
        expected = 2.0 * np.sum(6.0 * R**3 * kernel, axis=0) * (tau[1] - tau[0])
        at = actual[round(f / DF)]
        level = np.sqrt(np.outer(np.diag(expected), np.diag(expected)).real)
        assert (np.abs(at - expected) < 0.01 * level)[:2, :2].all()
        assert np.diag(at).real == pytest.approx(np.diag(expected).real, rel=0.01)


def test_the_residual_of_a_sign_follows_the_arcsine_law():
    """R = (2 / pi) (arcsin(rho) - rho), of power 1 - 2 / pi (Van Vleck & Middleton 1966)."""
    x = np.linspace(-60.0, 60.0, 40001)
    S = spectrum(0.0)
    actual = np.real(_hermite(x, np.tile(np.sign(x), (4, 1)), S, DF)[:, 0, 0])
    tau = np.linspace(-15.0, 15.0, 12001)
    rho = np.real(np.exp(2j * np.pi * np.outer(tau, F)) @ S[:, 0, 0]) / S[:, 0, 0].real.sum()
    R = 2.0 / np.pi * (np.arcsin(np.clip(rho, -1.0, 1.0)) - rho)
    expected = np.array(
        [2.0 * np.sum(R * np.cos(2.0 * np.pi * f * tau)) * (tau[1] - tau[0]) for f in F]
    )
    for low, high in ((0.5, 2.0), (2.0, 4.0), (7.0, 11.0), (14.0, 19.0)):
        inside = (F > low) & (F < high)
        assert actual[1:][inside].mean() == pytest.approx(expected[inside].mean(), rel=0.1)


def test_drawn_signals_have_the_residual_spectra_and_cross_spectra():
    rng, size = np.random.default_rng(5), 2**19
    fs = 2.0 * F[-1]
    lines = rng.standard_normal((2, 4, size // 2 + 1)) * np.array([1.0, 1j])[:, None, None]
    grid = np.fft.rfftfreq(size, 1.0 / fs)
    S = np.array([np.interp(grid, F, s) for s in spectrum().reshape(F.size, -1).T], dtype=complex)
    root = np.zeros((grid.size, 4, 4), dtype=complex)
    S = S.T.reshape(grid.size, 4, 4)
    inside = (grid > 0.1) & (grid < 8.0)
    root[inside] = np.linalg.cholesky(S[inside] + 1e-12 * np.eye(4))
    x = np.fft.irfft(np.einsum("fab,bf->af", root, lines.sum(axis=0)) * np.sqrt(fs * size / 4))
    law = np.tanh(2.0 * np.linspace(-9.0, 9.0, 6001)) + 0.05 * np.linspace(-9.0, 9.0, 6001) ** 2
    table = np.linspace(-9.0, 9.0, 6001)
    y = np.interp(x, table, law)
    rest = y - np.mean(y, axis=1, keepdims=True)
    rest -= np.mean(rest * x, axis=1, keepdims=True) / np.mean(x**2, axis=1, keepdims=True) * x
    # uses the spectrum that was drawn, interpolated to the grid of F
    actual = _hermite(table, np.tile(law, (4, 1)), S_on(S, grid), DF)
    for i, j in ((0, 0), (1, 1), (2, 2), (1, 0)):
        f, P = signal.csd(rest[j], rest[i], fs, nperseg=2048)
        for band in ((0.5, 2.0), (2.0, 5.0), (7.0, 10.0)):
            inside = (f > band[0]) & (f < band[1])
            k = np.arange(round(band[0] / DF), round(band[1] / DF))
            level = np.sqrt(actual[k, i, i].real.mean() * actual[k, j, j].real.mean())
            gap = abs(P[inside].mean() - actual[k, i, j].mean())
            assert gap < 0.05 * level, (i, j, band)


def S_on(S, grid):
    """Return a spectrum on `grid` interpolated to F."""
    flat = S.reshape(grid.size, -1)
    return np.array([np.interp(F, grid, s) for s in flat.T], dtype=complex).T.reshape(F.size, 4, 4)


@pytest.mark.parametrize("name", CARS)
@pytest.mark.parametrize("mode", ["ride", "handling"])
def test_linear_force_plus_residual_equals_the_strut_force(name, mode):
    """Force curves of the oracle, with the slopes of the linear model."""
    car, one = CARS[name], PLANTS[name]
    c = np.array([1500.0, 1500.0, 2500.0, 2500.0])
    rest = nonlinear_residual(one, mode, c)
    y = equilibrium(one, settled_strut_state(encode_command(mode)), np.zeros(4))
    model = linearise(one, mode, PLACES, damping=c)
    e_0 = model.strut_rows @ y[:N_DOF]
    _, _, K, _, _ = energy_matrices(name, mode)
    e = np.array([[-0.02, -0.01, 0.0, 0.02]] * 4)
    w = np.array([[0.3, -0.02, 0.01, -0.5]] * 4)
    k = [K_of_strut(K, car, i) for i in range(4)]
    losses = [
        oracles.CubicCurve(getattr(curve, mode)) for curve in (car.strut.damper, car.strut.friction)
    ]
    column = car.strut.x_1 + (car.strut.x_2 if mode == "ride" else 0.0)
    actual = force_of(rest, e, w)
    for i in range(4):
        stop = car.strut.bump_stop.front if i < 2 else car.strut.bump_stop.rear

        def static(x, stop=stop):
            gas = car.strut.p_stat * car.strut.A * (column / (column + x)) ** car.strut.n_p
            return gas - sum(float(oracles.CubicCurve(s)(x)) for s in (car.strut.bushing, stop))

        for x, rate, value in zip(e[i], w[i], actual[i], strict=True):
            force = static(e_0[i] + x) - sum(float(law(rate)) for law in losses)
            linear = static(e_0[i]) - k[i] * x - c[i] * rate
            # tolerance of linear interpolation, table steps 0.25 mm and 1 mm/s
            assert value == pytest.approx(force - linear, abs=3.0)


def K_of_strut(K, car, i):
    """Return the rate of strut `i` from the heave and pitch terms of the stiffness matrix."""
    sums = K[0, 0] / 2.0, K[0, 2] / 2.0  # k_f + k_r, and -(k_f x_f + k_r x_r)
    x_f, x_r = car.front.x, car.rear.x
    rear = (-sums[1] - x_f * sums[0]) / (x_r - x_f)
    return sums[0] - rear if i < 2 else rear


def test_the_residual_is_uncorrelated_with_the_motion():
    v, prior = 8.0, RoadPrior(G_d0=256e-6)
    c = equivalent_damping(DEFENDER, "ride", v, prior)
    rest, model = (
        nonlinear_residual(DEFENDER, "ride", c),
        linearise(DEFENDER, "ride", {}, damping=c),
    )
    f = np.linspace(0.02, 60.0, 3000)
    sigma = strut_rate_std(model, v, f, prior.spectrum(f / v) / v)[:, None]
    w = sigma * np.random.default_rng(0).standard_normal((4, 200_000))
    q = force_of(rest, np.zeros_like(w), w)
    correlation = np.mean(q * w, axis=1) / np.sqrt(np.mean(q**2, axis=1) * np.mean(w**2, axis=1))
    assert (np.abs(correlation) < 0.02).all()
    D = residual_force_psd(model, rest, v, prior.spectrum, f)
    power = np.trapezoid(np.real(np.einsum("fww->wf", D)), f)
    assert ((power > 0.8 * np.var(q, axis=1)) & (power < 1.05 * np.var(q, axis=1))).all()


@pytest.mark.parametrize("name", CARS)
def test_the_force_response_agrees_with_the_energy_matrices(name):
    c, f = np.array([900.0, 900.0, 1500.0, 1500.0]), 4.0
    model = linearise(PLANTS[name], "ride", PLACES, damping=c)
    K, C = (-np.diag(model.M) @ model.A[7:, part] for part in (slice(7), slice(7, None)))
    sensed, rates = (x[0] for x in force_response(model, np.array([f])))
    car, jw = CARS[name], 2j * np.pi * f
    for w, axle in enumerate((car.front, car.front, car.rear, car.rear)):
        y = axle.y_s * (1.0, -1.0)[w % 2]
        push = np.zeros(7)
        push[:3] = 1.0, y, -axle.x
        push[3 + 2 * (w // 2) : 5 + 2 * (w // 2)] = -1.0, -y
        q = np.linalg.solve(jw**2 * np.diag(model.M) + jw * C + K, push)
        a = jw**2 * q
        expected = [oracles.point_acceleration(*a[:3], *at) for at in PLACES.values()]
        np.testing.assert_allclose(sensed[:, w], expected, rtol=1e-8)
        assert rates[w, w] == pytest.approx(jw * (push @ q), rel=1e-8)


@pytest.mark.parametrize("frame", [None, TorsionalFrame(f=12.0, zeta=0.08)])
def test_more_damping_acts_as_a_strut_force_against_the_rate_of_extension(frame):
    plant = varied_plant(DEFENDER, VehicleVariation(frame=frame))
    c, more, f = np.full(4, 1200.0), np.array([0.0, 0.0, 700.0, 0.0]), np.array([1.5, 9.0, 13.0])
    before, after = (linearise(plant, "ride", PLACES, damping=x) for x in (c, c + more))
    sensed, rates = force_response(before, f)
    rate = strut_rate_response(after, f)
    force = -more[:, None] * rate
    np.testing.assert_allclose(rate, strut_rate_response(before, f) + rates @ force, rtol=1e-8)
    expected = _wheel_response(before, f) + sensed @ force
    np.testing.assert_allclose(_wheel_response(after, f), expected, rtol=1e-8)


def test_strut_forces_are_computed_independently():
    e, w = np.array([[0.01], [-0.02], [0.0], [0.03]]), np.array([[0.1], [0.0], [-0.3], [0.2]])
    together = strut_forces(DEFENDER, "ride", e, w)
    for i in range(4):
        alone = strut_forces(DEFENDER, "ride", np.full((4, 1), e[i, 0]), np.full((4, 1), w[i, 0]))
        assert alone[i, 0] == together[i, 0]


def test_the_residual_as_noise_raises_the_bound():
    for mode in ("ride", "handling", {"front": "ride", "rear": "handling"}):
        arguments = (DEFENDER, mode, 15.0, load_instruments("paper"), RoadPrior())
        assert bound(*arguments, residual_as_noise=True).pooled > 1.5 * bound(*arguments).pooled


def test_a_linear_strut_has_no_residual():
    x = np.linspace(-1.0, 1.0, 11)
    rest = NonlinearResidual(x, np.zeros((4, 11)), x, np.zeros((4, 11)))
    model = linearise(DEFENDER, "ride", PLACES, damping=np.full(4, 2000.0))
    D = residual_force_psd(model, rest, 10.0, RoadPrior().spectrum, np.array([1.0, 5.0]))
    np.testing.assert_array_equal(D, 0.0)
