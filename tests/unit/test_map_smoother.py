"""The most probable road: derivatives, the dense linear answer, what is lost, windows, switches."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from oracles import linear_matrices
from scipy.linalg import expm
from vehicle_fixtures import DEFENDER

from estimators.common.block_means import block_means, valid_samples
from estimators.common.model_inputs import antialias_delay, build_model_inputs
from estimators.common.spline import evaluate_spline, sample_under_wheels
from estimators.map_smoother import gauss_newton
from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.gauss_newton import (
    conjugate_gradients,
    huber_weights,
    minimize,
    smooth_friction,
)
from estimators.map_smoother.objective import Objective, linearize
from estimators.map_smoother.posterior_sampling import draw_weighted_noise
from estimators.map_smoother.preconditioner import stationary_hessian
from estimators.map_smoother.road_prior import N_FLAT, RoadTransform, padded_size, prior_amplitude
from estimators.map_smoother.wheel_liftoff import noise_from_coefficients
from estimators.map_smoother.windows import initial_window_state, window_objective
from leaderboard.metrics.heights import band_pass, nrmse
from road_envs.analysis.information_bound import RoadPrior
from road_envs.analysis.roughness import displacement_psd
from road_envs.data.record import Record, scored_band
from road_envs.data.recording import simulate_record
from road_envs.roads.iso8608 import Iso8608
from road_envs.roads.trapezoids import Bumps
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.force_curves import Curve, interpolate_table
from road_envs.vehicle.parameters import ModeCurves, VehicleParameters
from road_envs.vehicle.suspension import V_0, V_STEP, encode_command

PAPER = load_instruments("paper")
MIXED = {"front": "ride", "rear": "handling"}
PRIOR = RoadPrior()


def surface(length=40.0, seed=5, road_class="D"):
    return Iso8608(road_class=road_class, length=length).realise(np.random.default_rng(seed))


@cache
def driven(mode="handling", kmh=54.0, length=40.0, density=0.01, road_class="D"):
    """A record and its truth, from a car that is driven in steps of half a millisecond."""
    return simulate_record(
        DEFENDER,
        surface(length, road_class=road_class),
        speed_kmh=kmh,
        mode=MIXED if mode == "mixed" else mode,
        instruments=replace(PAPER, noise_density=density),
        seed=1,
        step=5e-4,
    )


def objective(record: Record, car: VehicleParameters = DEFENDER, **settings) -> Objective:
    """The whole of a record as one window."""
    estimator = MapSmoother(**settings)
    model, drive = (
        estimator._measurement_model(record, car, PAPER),
        estimator._prepare_drive(record, car, PAPER),
    )
    blocks = drive.a.shape[1] // drive.block_size
    return window_objective(model, drive, PRIOR, initial_window_state(drive), 0, blocks)


def error(estimate, profile, record) -> float:
    """In-band NRMSE of both wheel paths together."""
    band = scored_band(float(record.v.mean()))
    return nrmse(profile.z, estimate.z, profile.ds, band).pooled


def near(x, scale=1.0, seed=0):
    return x + scale * np.random.default_rng(seed).standard_normal(x.size)


# --- the map from the road to the readings --------------------------------------------------------


def test_the_spline_repeats_cubics_and_their_slopes():
    """Coefficients of a cubic are its values with the second derivative's share taken off."""
    k = np.arange(30.0)
    cubic = np.polynomial.Polynomial([0.3, -0.2, 0.05, -0.001])
    c = np.stack([cubic(k) - cubic.deriv(2)(k) / 6.0, np.zeros(30)])
    x = np.linspace(6.0, 26.0, 77)
    np.testing.assert_allclose(evaluate_spline(c, x)[0], cubic(x), atol=1e-12)
    road = np.empty((x.size, 2, 4))
    sample_under_wheels(c, x, np.full(x.size, 3.0), 4.5, road)
    np.testing.assert_allclose(road[:, 1, 0], 3.0 * cubic.deriv()(x), atol=1e-12)
    np.testing.assert_allclose(road[:, 0, 2], cubic(x - 4.5), atol=1e-12)
    assert not road[:, :, [1, 3]].any()


NODES = padded_size(4000)


def free_road(size: int = NODES, ds: float = 0.05) -> RoadTransform:
    return RoadTransform(
        0.0, ds, np.zeros((2, size)), np.ones(size), prior_amplitude(PRIOR, size, ds)
    )


def test_roads_of_white_noise_have_the_prior_s_density_and_coherence():
    road, rng = free_road(), np.random.default_rng(1)
    s = 0.02 * np.arange(500, 9500)
    z = np.array([road.heights_at(rng.standard_normal((2, road.size)), s) for _ in range(40)])
    n, G = displacement_psd(z, 0.02)
    for low, high in ((0.3, 1.0), (1.0, 3.0), (3.0, 8.0)):  # below, drift leaks into the windows
        inside = (n > low) & (n < high)
        level = np.mean(G[..., inside] / PRIOR.density(n[inside]))
        assert level == pytest.approx(1.0, abs=0.05)
    n, mean = displacement_psd(z.mean(axis=1), 0.02)
    for low, high in ((0.1, 0.2), (0.3, 0.5), (1.0, 2.0)):
        inside = (n > low) & (n < high)
        S = PRIOR.spectrum(n[inside])
        wanted = 0.25 * np.real(S.sum(axis=(1, 2)))
        assert np.mean(mean[:, inside] / wanted) == pytest.approx(1.0, abs=0.15)


def test_long_waves_are_no_higher_than_the_longest_of_the_prior():
    road = free_road()
    G = 2.0 * road.ds * np.sum(np.abs(road.transfer_function()) ** 2, axis=0)
    low = (road.n > 0.0) & (road.n < 1.0)
    np.testing.assert_allclose(
        G[low], PRIOR.density(np.maximum(road.n, N_FLAT))[low], rtol=1e-12, atol=0.0
    )


def test_the_road_s_map_is_transposed_and_level_where_it_is_not_free():
    road = free_road(padded_size(300))
    free = np.zeros(road.size)
    free[50:200] = 1.0
    road, rng = replace(road, free=free), np.random.default_rng(2)
    u, dual = rng.standard_normal((2, 2, road.size))
    c = road.apply(u)
    assert np.sum(c * dual) == pytest.approx(np.sum(u * road.apply_transpose(dual)), rel=1e-10)
    assert (c[:, :50] == 0.0).all() and (c[:, 200:] == c[:, 199:200]).all()
    twice = road.scale_density(np.full(road.n.size, 4.0))
    np.testing.assert_allclose(twice.apply(u), 2.0 * c, atol=1e-15)
    np.testing.assert_allclose(twice.apply(twice.convert_noise(u, road)), c, atol=1e-12)


def test_the_noise_of_a_road_gives_its_coefficients():
    road = free_road(padded_size(300))
    free = np.zeros(road.size)
    free[50:200] = 1.0
    road = replace(road, free=free)
    c = road.coefficients(np.random.default_rng(9).standard_normal((2, road.size)))
    np.testing.assert_allclose(road.coefficients(noise_from_coefficients(road, c)), c, atol=1e-12)


def test_the_transfer_of_the_road_is_that_of_its_waves():
    road, k = free_road(padded_size(2000)), 120
    wave = np.sqrt(2.0) * np.cos(2.0 * np.pi * k * np.arange(road.size) / road.size)
    z = road.heights_at(np.stack([wave, np.zeros(road.size)]), 0.05 * np.arange(20, 1900))
    assert (z[0] == z[1]).all()
    assert z[0].std() == pytest.approx(abs(road.transfer_function()[0, k]), rel=1e-3)


def test_lost_samples_take_no_part_in_a_block_s_mean():
    a = np.array([[1.0, 2.0, 99.0, 4.0, 5.0, 6.0, 7.0]])
    used = np.array([[True, True, False, False, False, False, True]])
    read = block_means(a, used, 3)
    np.testing.assert_allclose(read.y, [[1.5, 0.0]])
    np.testing.assert_array_equal(read.sample_count, [[2.0, 0.0]])
    np.testing.assert_allclose(read.average(2.0 * a[:, :6]), [[3.0, 0.0]])


def test_samples_near_a_clipped_or_missing_one_are_not_used():
    record, _ = driven()
    a = record.a.copy()
    a[0, 100], a[1, 200] = np.nan, -PAPER.range
    used = valid_samples(replace(record, a=a), PAPER)
    assert (~used[0]).nonzero()[0].tolist() == list(range(97, 104))
    assert (~used[1]).nonzero()[0].tolist() == list(range(197, 204))
    assert used[2].all()


def test_the_model_is_driven_as_late_as_the_anti_alias_filter():
    assert antialias_delay(PAPER) == pytest.approx(2.613 / (2.0 * np.pi * 333.0), rel=1e-3)
    record, _ = driven()
    way = build_model_inputs(record, PAPER, DEFENDER, max_step=0.0004)
    assert way.decimation == 3 and way.h == pytest.approx(1e-3 / 3)
    at = np.interp(record.t[50] - antialias_delay(PAPER), record.t, record.s)
    assert way.s[2 * 50 * 3] == pytest.approx(at, abs=1e-9)


def test_a_command_reaches_the_valves_after_their_delay():
    record, _ = driven()
    stiff = np.zeros_like(record.spring_stiff)
    stiff[500:, 2] = True
    way = build_model_inputs(
        replace(record, spring_stiff=stiff, damper_high=stiff), PAPER, DEFENDER, max_step=0.001
    )
    first = int(np.argmax(way.commands))
    assert way.commands[first] == encode_command(
        {"FL": "ride", "FR": "ride", "RL": "handling", "RR": "ride"}
    )
    assert record.t[first] - record.t[500] == pytest.approx(
        DEFENDER.valve.delay + antialias_delay(PAPER), abs=0.001
    )


# --- the cost and its derivatives -----------------------------------------------------------------


@pytest.mark.parametrize("mode", ["handling", "mixed"])
def test_the_gradient_is_the_slope_of_the_cost(mode):
    one = objective(driven(mode, length=12.0)[0], step=0.0005)
    rng = np.random.default_rng(3)
    x = near(np.zeros(one.size), 0.3)
    at = linearize(one, x, one.information)
    assert at.tape.signals[:, 25:].min() > 0.0  # no jump where a tyre lifts off
    for _ in range(3):
        dx = rng.standard_normal(one.size)
        eps = 1e-6
        costs = [linearize(one, x + sign * eps * dx, one.information).cost for sign in (1.0, -1.0)]
        assert at.gradient() @ dx == pytest.approx((costs[0] - costs[1]) / (2.0 * eps), rel=1e-4)


def test_the_tangent_is_transposed_and_the_hessian_is_gauss_and_newton_s():
    one = objective(driven(length=12.0)[0])
    at = linearize(one, near(np.zeros(one.size)), one.information)
    rng = np.random.default_rng(4)
    dx, dual = rng.standard_normal(one.size), rng.standard_normal(at.residual.shape)
    a = at.tangent(dx)
    assert np.sum(a * dual) == pytest.approx(dx @ at.adjoint(dual), rel=1e-9)
    wanted = dx @ dx + np.sum(one.information * a**2)
    assert dx @ at.hessian_product(dx) == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize("kmh", [2.0, 54.0])
def test_matrices_of_the_parts_are_the_tangent_of_the_steps(kmh):
    """At a speed that changes, with lost samples, two steps a sample and an odd end."""
    record, _ = driven(length=12.0)
    a, v = record.a.copy(), kmh / 3.6 * (1.0 + 0.5 * np.sin(3.0 * record.t))
    a[1, 300:320] = np.nan
    s = np.concatenate([[0.0], np.cumsum(np.diff(record.t) * 0.5 * (v[1:] + v[:-1]))])
    one = objective(replace(record, a=a, v=v, s=s), step=0.0005, data_rate=250.0)
    rng = np.random.default_rng(8)
    at = linearize(one, near(np.zeros(one.size)), one.information)
    dx = rng.standard_normal(one.size)
    u, start, bias = one.split(dx)
    taped, _ = at.tape.tangent(start, one.road_under_wheels(one.road.apply(u)))
    wanted = one.observe(taped, bias)
    assert one.inputs.decimation == 2 and wanted.shape[1] % 6 != 0
    np.testing.assert_allclose(at.tangent(dx), wanted, atol=1e-11 * np.abs(wanted).max())


def test_conjugate_gradients_solve_what_a_dense_solver_does():
    rng = np.random.default_rng(5)
    A = rng.standard_normal((30, 30))
    A, b = A @ A.T + np.eye(30), rng.standard_normal(30)
    M = np.diag(1.0 / np.diag(A))
    x, k = conjugate_gradients(lambda v: A @ v, b, lambda v: M @ v, 200, 1e-12)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-8)
    assert 10 < k < 100
    assert conjugate_gradients(lambda v: A @ v, b, lambda v: v, 4, 0.0)[1] == 4


def test_blurred_tables_are_means_over_a_trembling_rate():
    one = build_plant(DEFENDER)
    soft = smooth_friction(one, 0.05)
    tremble = np.random.default_rng(6).normal(0.0, 0.05, 200_000)
    for k, v in ((0.0, 0.03), (1.0, -0.2)):
        drawn = np.mean(
            [interpolate_table(one.velocity, k, V_0, V_STEP, v + e)[0] for e in tremble[::20]]
        )
        found, slope = interpolate_table(soft.velocity, k, V_0, V_STEP, v)
        assert found == pytest.approx(drawn, abs=6.0)
        ahead = interpolate_table(soft.velocity, k, V_0, V_STEP, v + 1e-5)[0]
        assert (ahead - found) / 1e-5 == pytest.approx(slope, rel=1e-2)


def test_far_readings_count_less_in_proportion():
    residual, inverse_variance = np.array([0.5, -4.0, 10.0]), np.array([1.0, 1.0, 4.0])
    np.testing.assert_allclose(huber_weights(residual, inverse_variance, 2.0), [1.0, 0.5, 0.4])


def test_below_a_wheel_that_flies_no_road_is_made_up():
    """A bump of 10 cm throws both axles into the air; the road behind it is as low as before it."""
    bump = Bumps(layout="small", run_in=6.0, run_out=6.0).realise(np.random.default_rng(0))
    record, truth = simulate_record(
        DEFENDER, bump, speed_kmh=14.5, mode="handling", instruments=PAPER, seed=1, step=5e-4
    )
    estimate = MapSmoother(draws=0).estimate(record, DEFENDER)
    ahead, behind = (truth.s > 5.5) & (truth.s < 5.9), (truth.s > 6.9) & (truth.s < 7.1)
    assert (estimate.z[:, behind] - estimate.z[:, ahead].mean(axis=1)[:, None] < 0.08).all()
    assert error(estimate, truth, record) < 0.7


def test_a_tone_that_no_car_can_explain_is_hardly_listened_to(monkeypatch):
    """What is left over is loud at 12 Hz alone: heard as white noise it would hide the rest."""
    record, truth = driven()
    tone = 0.5 * np.sin(2.0 * np.pi * 12.0 * record.t + np.array([[0.0], [2.0], [4.0]]))
    estimator, wrong = MapSmoother(draws=0), replace(record, a=record.a + tone)
    found = estimator.estimate(wrong, DEFENDER)
    assert "left unexplained" in found.notes[-1]
    monkeypatch.setattr(gauss_newton, "REWEIGHTING_STEPS", 0)
    white = estimator.estimate(wrong, DEFENDER)
    assert error(found, truth, record) < 0.8 * error(white, truth, record)


def test_coloured_noise_is_drawn_as_it_is_weighed():
    """The covariance of what is drawn is the inverse that readings are weighed by."""
    one = objective(driven(length=12.0)[0])
    J, rng = one.measurements.y.shape[1], np.random.default_rng(10)
    frequency_weights, inverse_variance = (
        rng.uniform(0.01, 2.0, J // 2 + 1),
        rng.uniform(0.5, 2.0, (3, J)),
    )
    at = linearize(one, np.zeros(one.size), inverse_variance, frequency_weights=frequency_weights)
    drawn = np.array([draw_weighted_noise(at, rng).ravel() for _ in range(4000)])
    probe_estimator = rng.standard_normal((3, J))
    assert np.var(drawn @ probe_estimator.ravel()) == pytest.approx(
        np.sum(probe_estimator * at.apply_inverse_covariance(probe_estimator)), rel=0.1
    )


def test_windows_joined_are_one_window_within_its_spread():
    record, truth = driven(length=90.0)
    whole = MapSmoother().estimate(record, DEFENDER)
    parts = MapSmoother(window=3.0, overlap=1.0).estimate(record, DEFENDER)
    band = scored_band(float(record.v.mean()))
    z = band_pass(np.stack([whole.z, parts.z, truth.z]), truth.ds, band)
    assert whole.z_std is not None and record.t[-1] > 6.0
    apart = np.sqrt(np.mean((z[1] - z[0]) ** 2))
    assert 0.0 < apart < 0.5 * whole.z_std.mean()
    assert np.sqrt(np.mean((z[1] - z[2]) ** 2)) < 1.2 * np.sqrt(np.mean((z[0] - z[2]) ** 2))


# --- the linear car -------------------------------------------------------------------------------

C_S = 3000.0
K_S = (16682.0, 16682.0)


def linear_car() -> VehicleParameters:
    """Dampers are straight lines, there is no friction, and the gas hardly bends."""
    line, none = Curve(x=(-3.0, 3.0), F=(-3.0 * C_S, 3.0 * C_S)), Curve(x=(-3.0, 3.0), F=(0.0, 0.0))
    damper, friction = ModeCurves(ride=line, handling=line), ModeCurves(ride=none, handling=none)
    strut = replace(DEFENDER.strut, damper=damper, friction=friction)
    return replace(DEFENDER, strut=strut)


def dense_tangent(one: Objective) -> np.ndarray:
    """Sensed block means (3 J, 2 K) of a unit rise of each coefficient, on the matrices that energy
    gives; the road is a straight line between instants a quarter of a millisecond apart.
    """
    M, C, K, K_r, C_r = linear_matrices(DEFENDER, K_S, (C_S, C_S))
    h, size, J = one.inputs.h, one.road.size, one.measurements.y.shape[1]
    A = np.block([[np.zeros((7, 7)), np.eye(7)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    B = np.vstack([np.zeros((7, 8)), np.linalg.solve(M, np.hstack([K_r, C_r]))])
    big = np.zeros((30, 30))
    big[:14, :14], big[:14, 14:22], big[14:22, 22:] = A * h, B * h, np.eye(8)
    step = expm(big)[:14]
    x = (one.inputs.s[::2] - one.road.origin) / one.road.ds
    road = np.zeros((x.size + 1, 8, 2 * size))
    for axle in range(2):
        for n, at in enumerate(np.append(x, x[-1]) - axle * DEFENDER.wheelbase / one.road.ds):
            i, t = int(at), at - int(at)
            r = 1.0 - t
            z = np.array([r**3, 4 - 6 * t**2 + 3 * t**3, 4 - 6 * r**2 + 3 * r**3, t**3]) / 6.0
            w = np.array([-(r**2), 3 * t**2 - 4 * t, 4 * r - 3 * r**2, t**2]) / 2.0
            for side in range(2):
                nodes_ = side * size + i + np.arange(-1, 3)
                road[n, 2 * axle + side, nodes_] = z
                road[n, 4 + 2 * axle + side, nodes_] = w * one.inputs.v[0] / one.road.ds
    state, sensed = np.zeros((14, 2 * size)), np.zeros((x.size, 3, 2 * size))
    sensor_rows = np.array([[1.0, y, -ahead] for ahead, y in PAPER.locations(DEFENDER).values()])
    for n in range(x.size):
        sensed[n] = sensor_rows @ (A @ state + B @ road[n])[[7, 8, 9]]
        drift = road[n + 1] - road[n]
        state = step[:, :14] @ state + step[:, 14:22] @ road[n] + step[:, 22:] @ drift
    block = one.inputs.decimation * one.measurements.sample_weight.shape[2]
    samples = sensed[: J * block : one.inputs.decimation]
    return samples.reshape(J, -1, 3, 2 * size).mean(axis=1).transpose(1, 0, 2).reshape(3 * J, -1)


def test_on_a_linear_car_it_is_the_dense_gaussian_posterior():
    """Road, readings and noise so small that gas and tyres are straight; nothing in common with
    the oracle but the prior, whose density is tested above, and the noise that the search hears.
    """
    car, scale = linear_car(), 1e-3
    record, _ = driven("ride", length=12.0)
    quiet = replace(record, a=np.zeros_like(record.a))
    one = objective(quiet, car, step=0.00025, noise_density=0.01 * scale)
    road = replace(one.road, amplitude=scale * one.road.amplitude)
    J, rng = dense_tangent(one) @ road_matrix(road), np.random.default_rng(7)
    drawn = rng.standard_normal(2 * road.size)
    noise = np.sqrt(one.model.noise_variance / one.measurements.sample_count.ravel())
    y = J @ drawn + noise * rng.standard_normal(noise.size)
    model = replace(one.model, bias_std=1e-9)
    one = replace(one, road=road, model=model, initial_std=0.0 * one.initial_std)
    settling = linearize(
        one, np.zeros(one.size), one.information
    ).residual  # of a car not quite at rest
    read = replace(one.measurements, y=y.reshape(settling.shape) - settling)
    one = replace(one, measurements=read)
    exact = {
        "cg_iterations": 400,
        "cg_tolerance": 1e-6,
        "cost_tolerance": 1e-9,
        "adapt_prior": False,
    }
    found = minimize(one, stationary_hessian(one), **exact)
    assert 1.0 <= found.noise_scale < 1.1
    noise *= np.sqrt(found.noise_scale)
    J, y = J / noise[:, None], y / noise
    wanted = np.linalg.solve(np.eye(J.shape[1]) + J.T @ J, J.T @ y)
    s = np.linspace(1.0, 7.0, 400)
    u, dense, true = (
        road.heights_at(x[: 2 * road.size].reshape(2, -1), s)
        for x in (found.linearization.x, wanted, drawn)
    )
    assert np.std(dense - true) < 0.1 * np.std(true)
    assert np.std(u - dense) < 0.01 * np.std(dense - true)


def road_matrix(road: RoadTransform) -> np.ndarray:
    """Coefficients (2 K, 2 K) of a unit of each number of the noise."""
    units = np.eye(2 * road.size).reshape(-1, 2, road.size)
    return np.array([road.apply(u).ravel() for u in units]).T
