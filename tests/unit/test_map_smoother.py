"""The MAP smoother: road transform, derivatives, minimization, windows, the linear posterior."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from oracles import linear_matrices
from scipy.fft import irfft, rfft
from scipy.linalg import expm
from vehicle_fixtures import DEFENDER

from estimators.common.block_means import block_means
from estimators.common.spline import evaluate_spline
from estimators.map_smoother import gauss_newton, wheel_liftoff
from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.gauss_newton import GaussNewton, MapSolution, minimize
from estimators.map_smoother.objective import Objective
from estimators.map_smoother.preconditioner import StationaryHessian, stationary_hessian
from estimators.map_smoother.road_prior import RoadTransform
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.windows import whole_objective
from leaderboard.metrics.heights import band_pass, nrmse
from road_envs.analysis.information_bound import RoadPrior
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Record, scored_band
from road_envs.roads.iso8608 import Iso8608
from road_envs.roads.obstacles import Bumps, _Trapezoid
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.force_curves import Curve
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.struts import _ModeCurves

PAPER = load_instruments("paper")
MIXED = {"front": "ride", "rear": "handling"}
PRIOR = RoadPrior()


def surface(length=40.0, seed=5, road_class="D"):
    return Iso8608(road_class=road_class, length=length).realise(np.random.default_rng(seed))


@cache
def drive_record(mode="handling", kmh=54.0, length=40.0, density=0.01, road_class="D"):
    """A record and its true profile, simulated in steps of half a millisecond."""
    return simulate_record(
        surface(length, road_class=road_class),
        vehicle=DEFENDER,
        speed_kmh=kmh,
        mode=MIXED if mode == "mixed" else mode,
        instruments=replace(PAPER, noise_density=density),
        seed=1,
        step=5e-4,
    )


def objective_of(record: Record, car: VehicleParameters = DEFENDER, **settings) -> Objective:
    """The objective of a whole record as one window."""
    drive, _ = MapSmoother(**settings).prepare(record, car)
    return whole_objective(drive, PRIOR)


def residual_at(objective: Objective, x: np.ndarray) -> np.ndarray:
    """Residual of an objective of one pass."""
    (one,) = objective.passes
    _, (own,), _ = objective.split(x)
    return one.linearize(objective.coefficients(x), own).residual


def error(estimate, profile, record) -> float:
    """In-band NRMSE of both wheel paths together."""
    band = scored_band(float(record.v.mean()))
    return nrmse(profile.z, estimate.z, profile.ds, band).pooled


def perturb(x, scale=1.0, seed=0):
    return x + scale * np.random.default_rng(seed).standard_normal(x.size)


def test_local_roughness_is_found_where_it_is_and_not_on_a_stationary_road():
    objective = objective_of(drive_record()[0])
    stationary, road = stationary_hessian(objective), objective.road
    rng, noise = np.random.default_rng(4), objective.noise_variance
    inside = road.free > 0
    u = rng.standard_normal((2, road.size))
    np.testing.assert_array_equal(stationary.local_roughness(road, noise, u, inside), 1.0)
    rough = np.full((2, road.size), 0.05)
    middle = road.size // 3
    rough[0, middle : middle + 20] = 5.0
    drawn = road.whiten(rough * np.diff(road.apply(u), axis=1, prepend=0.0))
    local = stationary.local_roughness(road, noise, drawn, inside)
    assert local[0, middle : middle + 20].mean() > 20.0 * np.median(local[:, inside])
    assert local[1, middle : middle + 20].mean() < 5.0 * np.median(local[:, inside])
    half = inside & (np.arange(road.size) < road.size // 2)
    ahead = np.where(np.arange(road.size) < road.size // 2, u, 0.0)  # not passed yet
    np.testing.assert_array_equal(stationary.local_roughness(road, noise, ahead, half), 1.0)
    edges = np.zeros((2, road.size))
    edges[0, [middle, middle + 20]] = 0.05, -0.05  # a bump, level between its edges
    local = stationary.local_roughness(road, noise, road.whiten(edges), inside)
    assert local[0, middle] > 2.0 * local[0, middle + 10] > 2.0 * np.median(local[:, inside])


def test_the_prior_does_not_follow_what_was_not_read():
    """Where no sensor was read the most probable road is level, which says nothing of the road."""
    objective = objective_of(drive_record()[0])
    stationary, road, noise = (
        stationary_hessian(objective),
        objective.road,
        objective.noise_variance,
    )
    gap = slice(road.size // 2, road.size // 2 + road.size // 6)
    read = np.ones(road.size)
    read[gap] = 0.0
    holed = StationaryHessian((stationary.passes[0]._replace(read=read),))
    u = np.random.default_rng(4).standard_normal((2, road.size))
    level = u.copy()
    level[:, gap] = 0.0
    inside = road.free > 0
    np.testing.assert_array_equal(holed.local_roughness(road, noise, level, inside), 1.0)
    whole, found, wrong = (
        each.density_of(road, noise, x)[5:-5].mean()
        for each, x in ((stationary, u), (holed, level), (stationary, level))
    )
    assert found == pytest.approx(whole, rel=0.1) and wrong < 0.87 * whole
    dof = [each.effective_dof(road, noise)[0] for each in (holed, stationary)]
    assert dof[0] / dof[1] == pytest.approx(np.sum(road.free * read) / road.free.sum())
    rough = np.full((2, road.size), 0.05)
    rough[:, road.size // 3 : road.size // 3 + 20] = 5.0
    local = holed.local_roughness(
        road, noise, road.whiten(rough * np.diff(road.apply(level), axis=1, prepend=0.0)), inside
    )
    np.testing.assert_array_equal(local[:, gap], 1.0)
    assert local[:, road.size // 3 : road.size // 3 + 20].mean() > 3.0


@pytest.mark.parametrize("collapsed", [1.0, 1e-3])
def test_the_density_of_a_road_is_found_where_readings_tell_it_and_goes_on_from_there(collapsed):
    """Of a linear vehicle the power of the most probable road is what the readings tell of it."""
    objective = objective_of(drive_record(length=80.0)[0])
    stationary, noise = stationary_hessian(objective), 300.0 * objective.noise_variance

    def told(road):
        posterior = np.linalg.inv(np.eye(2) + stationary.excess(road, noise))
        return 1.0 - np.diagonal(posterior, axis1=1, axis2=2).real.T

    road = objective.road
    true = replace(road, free=np.ones(road.size), density=np.full(road.n.size, 0.25))
    open_ = told(true).mean(axis=0) < 0.2
    assert 0.1 < open_.mean() < 0.9
    road = replace(true, density=np.where(open_, 0.25 * collapsed, 0.25))
    white = np.random.default_rng(3).standard_normal((16, 2, road.size))
    roads = irfft(np.sqrt(told(road)) * rfft(white, axis=2), road.size, axis=2)
    found = [stationary.density_of(road, noise, u) for u in roads]
    np.testing.assert_allclose(np.mean(found, axis=0), 0.25, rtol=0.1)


@pytest.mark.parametrize("uneven", [False, True], ids=["stationary", "with obstacles"])
def test_under_a_lifted_wheel_the_road_becomes_straight_or_as_low_as_where_the_wheel_lands(
    uneven, monkeypatch
):
    lin = SimpleNamespace(objective=objective_of(drive_record()[0]))
    road = lin.objective.road
    node, first = np.arange(road.size), np.flatnonzero(road.free)[100]
    mask = (node >= first) & (node < first + 10)
    c = np.where(node < first, 0.06, 0.0) * np.array([[1.0], [0.0]])
    c[0, mask] = 0.06 - 0.09 * (0.1 * (node[mask] - first)) ** 2  # a wheel that falls
    c[:, node < first - 50] = 0.0
    local = np.where(mask, 3.0, 0.01) if uneven else np.ones(road.size)
    road = replace(road, local=np.tile(local, (2, 1)))
    lin.objective = replace(lin.objective, road=road)
    u = road.whiten(np.diff(c - road.background, axis=1, prepend=0.0)).ravel()
    lin.x = np.pad(u, (0, lin.objective.size - u.size))
    monkeypatch.setattr(
        wheel_liftoff, "unloaded_nodes", lambda lin: np.array([mask, ~mask & False])
    )
    x = wheel_liftoff.relax_unloaded(lin)
    found = road.coefficients(lin.objective.split(x)[0])
    straight = 0.06 * (1.0 - np.arange(1, 11) / 11.0)
    expected = c.copy()
    expected[0, mask] = c[0, mask].min() if uneven else np.minimum(c[0, mask], straight)
    np.testing.assert_allclose(found[:, road.free > 0], expected[:, road.free > 0], atol=1e-9)


def test_a_clipped_sample_is_a_limit_and_not_a_measurement():
    a = np.array([[1.0, 5.0, 5.0, 2.0, -5.0, 0.0]])
    censored = np.array([[0.0, 1.0, 1.0, 0.0, -1.0, 0.0]])
    valid = censored == 0.0
    means = block_means(a, valid, 3, censored)
    predicted = np.array([[1.0, 8.0, 4.0, 2.0, -9.0, 3.0]])
    np.testing.assert_allclose(means.residual(predicted), [[1.0 / 3.0, -1.0]])
    np.testing.assert_array_equal(means.sample_count, [[3.0, 3.0]])
    left_out = block_means(a, valid, 3)
    np.testing.assert_allclose(left_out.residual(predicted), [[0.0, -1.5]])


@pytest.mark.costly
def test_bumps_on_a_level_road_are_found_within_a_twentieth():
    road = {"kind": "scaled", "height_factor": -1.0, "road": {
        "kind": "potholes", "length": 50.0, "rate": 0.06, "depth": [0.03, 0.08],
        "size": [0.4, 2.0], "edge": 0.15}}  # fmt: skip
    record, profile = simulate_record(road, speed_kmh=14.5, mode="handling", seed=3, step=5e-4)
    estimate = MapSmoother().estimate(record, DEFENDER)
    assert error(estimate, profile, record) < 0.05
    level = np.abs(profile.z) < 1e-6
    assert np.abs(estimate.z - estimate.z.mean())[level].max() < 0.02


# --- the cost and its derivatives -----------------------------------------------------------------


@pytest.mark.parametrize("mode", ["handling", "mixed"])
def test_the_gradient_equals_finite_differences_of_the_cost(mode):
    objective = objective_of(drive_record(mode, length=12.0)[0], step=0.0005)
    rng = np.random.default_rng(3)
    x = perturb(np.zeros(objective.size), 0.3)
    lin = objective.linearize(x)
    assert lin.passes[0].tape.signals[:, 25:].min() > 0.0  # no jump where a tyre lifts off
    for _ in range(3):
        dx = rng.standard_normal(objective.size)
        eps = 1e-6
        costs = [objective.linearize(x + sign * eps * dx).cost for sign in (1.0, -1.0)]
        assert lin.gradient() @ dx == pytest.approx((costs[0] - costs[1]) / (2.0 * eps), rel=1e-4)


def test_an_update_of_the_prior_changes_neither_road_nor_motion():
    objective = objective_of(drive_record(length=12.0)[0])
    lin = objective.linearize(perturb(np.zeros(objective.size)))
    new = MapSolution(lin, stationary_hessian(objective), np.ones(1)).with_prior().linearization
    again = new.objective.linearize(new.x)
    assert not np.allclose(new.objective.road.amplitude, objective.road.amplitude, rtol=0.03)
    np.testing.assert_allclose(new.residual, again.residual, atol=1e-6)
    assert new.cost == pytest.approx(again.cost, rel=1e-6)


def test_the_adjoint_transposes_the_tangent_and_the_hessian_is_gauss_newton():
    objective = objective_of(drive_record(length=12.0)[0])
    lin = objective.linearize(perturb(np.zeros(objective.size)))
    rng = np.random.default_rng(4)
    dx, dual = rng.standard_normal(objective.size), rng.standard_normal(lin.residual[0].shape)
    (a,) = lin.tangent(dx)
    assert np.sum(a * dual) == pytest.approx(dx @ lin.adjoint([dual]), rel=1e-9)
    expected = dx @ dx + np.sum(objective.passes[0].information * a**2)
    assert dx @ lin.hessian_product(dx) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("kmh", [2.2, 54.0])
def test_the_block_tangent_equals_the_tangent_of_the_steps(kmh):
    """At varying speed, with missing samples, two steps per sample and an incomplete last chunk."""
    record, _ = drive_record(length=12.0)
    a, v = record.a.copy(), kmh / 3.6 * (1.0 + 0.5 * np.sin(3.0 * record.t))
    a[1, 300:320] = np.nan
    s = np.concatenate([[0.0], np.cumsum(np.diff(record.t) * 0.5 * (v[1:] + v[:-1]))])
    objective = objective_of(replace(record, a=a, v=v, s=s), step=0.0005, data_rate=250.0)
    rng = np.random.default_rng(8)
    lin = objective.linearize(perturb(np.zeros(objective.size)))
    dx = rng.standard_normal(objective.size)
    (one,), (u, (own,), _) = objective.passes, objective.split(dx)
    start, bias = one.split(own)
    taped, _ = lin.passes[0].tape.tangent(
        start, one.road_under_wheels(objective.road.apply(u), DEFENDER.wheelbase)
    )
    samples = taped[:: one.inputs.decimation][: one.measurements.n_samples]
    expected = one.measurements.average(one.model.sensor_rows @ samples.T)
    expected += bias[:, None]
    assert one.inputs.decimation == 2 and expected.shape[1] % 6 != 0
    single = 1e-6 * np.abs(expected).max()  # the matrices are kept in single precision
    np.testing.assert_allclose(lin.tangent(dx)[0], expected, rtol=0.0, atol=single)


def test_under_a_lifted_wheel_the_road_is_not_raised():
    """A bump of 10 cm lifts both axles off; the road behind it is as low as before it."""
    steep = _Trapezoid(height=0.1, ramp=0.2, top=0.4)
    road = Bumps(layout="small", small=steep, run_in=6.0, run_out=6.0)
    bump = road.realise(np.random.default_rng(0))
    record, truth = simulate_record(
        bump,
        vehicle=DEFENDER,
        speed_kmh=14.5,
        mode="handling",
        instruments=PAPER,
        seed=1,
        step=5e-4,
    )
    estimate = MapSmoother(draws=0).estimate(record, DEFENDER)
    ahead, behind = (truth.s > 5.5) & (truth.s < 5.9), (truth.s > 6.9) & (truth.s < 7.1)
    assert any("wheels were in the air for" in note for note in estimate.notes)
    assert (estimate.z[:, behind] - estimate.z[:, ahead].mean(axis=1)[:, None] < 0.08).all()
    assert error(estimate, truth, record) < 0.7


def test_a_tone_outside_the_model_is_down_weighted_at_its_frequency(monkeypatch):
    """The residual is large at 12 Hz alone; as white noise it would mask all other frequencies."""
    record, truth = drive_record()
    tone = 0.5 * np.sin(2.0 * np.pi * 12.0 * record.t + np.array([[0.0], [2.0], [4.0]]))
    estimator, wrong = MapSmoother(adapt=False, draws=0), replace(record, a=record.a + tone)
    reweighted = estimator.estimate(wrong, DEFENDER)
    assert "does not reproduce the accelerations" in reweighted.notes[-1]
    assert f"residual {reweighted.residual:.1f} times" in reweighted.notes[-1]
    monkeypatch.setattr(gauss_newton, "TUNING", replace(TUNING, reweighting_steps=0))
    white = estimator.estimate(wrong, DEFENDER)
    assert error(reweighted, truth, record) < 0.8 * error(white, truth, record)


def test_drawn_noise_has_the_inverse_covariance_of_the_cost():
    objective = objective_of(drive_record(length=12.0)[0])
    J, rng = objective.passes[0].measurements.y.shape[1], np.random.default_rng(10)
    weights, inverse_variance = rng.uniform(0.01, 2.0, J // 2 + 1), rng.uniform(0.5, 2.0, (3, J))
    lin = objective.linearize(np.zeros(objective.size)).with_noise([inverse_variance], [weights])
    drawn = np.array([lin.draw_noise(rng)[0].ravel() for _ in range(4000)])
    direction = rng.standard_normal((3, J))
    expected = np.sum(direction * lin.apply_inverse_covariance([direction])[0])
    assert np.var(drawn @ direction.ravel()) == pytest.approx(expected, rel=0.1)


@pytest.mark.costly
def test_joined_windows_agree_with_one_window_within_its_std():
    record, truth = drive_record(length=90.0)
    whole = MapSmoother(adapt=False).estimate(record, DEFENDER)
    parts = MapSmoother(adapt=False, window=3.0, overlap=1.0).estimate(record, DEFENDER)
    band = scored_band(float(record.v.mean()))
    z = band_pass(np.stack([whole.z, parts.z, truth.z]), truth.ds, band)
    assert whole.z_std is not None and record.t[-1] > 6.0
    apart = np.sqrt(np.mean((z[1] - z[0]) ** 2))
    assert 0.0 < apart < 0.6 * whole.z_std.mean()
    assert np.sqrt(np.mean((z[1] - z[2]) ** 2)) < 1.2 * np.sqrt(np.mean((z[0] - z[2]) ** 2))


# --- the linear vehicle ---------------------------------------------------------------------------

C_S = 3000.0
K_S = (16682.0, 16682.0)


def linear_car() -> VehicleParameters:
    """Linear dampers and no friction; for small motions the gas springs are linear, too."""
    line, none = Curve(x=(-3.0, 3.0), F=(-3.0 * C_S, 3.0 * C_S)), Curve(x=(-3.0, 3.0), F=(0.0, 0.0))
    damper, friction = _ModeCurves(ride=line, handling=line), _ModeCurves(ride=none, handling=none)
    strut = replace(DEFENDER.strut, damper=damper, friction=friction)
    return replace(DEFENDER, strut=strut)


def dense_tangent(objective: Objective) -> np.ndarray:
    """Block means (3 J, 2 K) per unit of each coefficient, by the energy matrices; the road is
    linear between instants a quarter of a millisecond apart.
    """
    M, C, K, K_r, C_r = linear_matrices(DEFENDER, K_S, (C_S, C_S))
    (one,) = objective.passes
    h, size, J = one.inputs.h, objective.road.size, one.measurements.y.shape[1]
    A = np.block([[np.zeros((7, 7)), np.eye(7)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    B = np.vstack([np.zeros((7, 8)), np.linalg.solve(M, np.hstack([K_r, C_r]))])
    big = np.zeros((30, 30))
    big[:14, :14], big[:14, 14:22], big[14:22, 22:] = A * h, B * h, np.eye(8)
    step = expm(big)[:14]
    x = (one.inputs.s[::2] - objective.road.origin) / objective.road.ds
    road = np.zeros((x.size + 1, 8, 2 * size))
    for axle in range(2):
        for n, at in enumerate(np.append(x, x[-1]) - axle * DEFENDER.wheelbase / objective.road.ds):
            i, t = int(at), at - int(at)
            r = 1.0 - t
            z = np.array([r**3, 4 - 6 * t**2 + 3 * t**3, 4 - 6 * r**2 + 3 * r**3, t**3]) / 6.0
            w = np.array([-(r**2), 3 * t**2 - 4 * t, 4 * r - 3 * r**2, t**2]) / 2.0
            for side in range(2):
                nodes_ = side * size + i + np.arange(-1, 3)
                road[n, 2 * axle + side, nodes_] = z
                road[n, 4 + 2 * axle + side, nodes_] = w * one.inputs.v[0] / objective.road.ds
    state, sensed = np.zeros((14, 2 * size)), np.zeros((x.size, 3, 2 * size))
    sensor_rows = np.array([[1.0, y, -ahead] for ahead, y, _ in PAPER.locations(DEFENDER).values()])
    for n in range(x.size):
        sensed[n] = sensor_rows @ (A @ state + B @ road[n])[[7, 8, 9]]
        drift = road[n + 1] - road[n]
        state = step[:, :14] @ state + step[:, 14:22] @ road[n] + step[:, 22:] @ drift
    block = one.inputs.decimation * one.measurements.sample_weight.shape[2]
    samples = sensed[: J * block : one.inputs.decimation]
    return samples.reshape(J, -1, 3, 2 * size).mean(axis=1).transpose(1, 0, 2).reshape(3 * J, -1)


@pytest.mark.costly
def test_on_a_linear_vehicle_the_map_road_is_the_dense_gaussian_posterior():
    """Motions are so small that gas springs and tyres are linear. The oracle shares the prior,
    whose density is tested above, and the noise scale.
    """
    car, scale = linear_car(), 1e-3
    record, _ = drive_record("ride", length=12.0)
    quiet = replace(record, a=np.zeros_like(record.a))
    objective = objective_of(quiet, car, step=0.00025, noise_density=0.01 * scale)
    road = replace(objective.road, prior_amplitude=scale * objective.road.prior_amplitude)
    J, rng = dense_tangent(objective) @ road_matrix(road), np.random.default_rng(7)
    drawn = rng.standard_normal(2 * road.size)
    (one,) = objective.passes
    noise = np.sqrt(one.model.noise_variance / one.measurements.sample_count.ravel())
    y = J @ drawn + noise * rng.standard_normal(noise.size)
    model = replace(one.model, bias_std=1e-9)
    one = replace(one, model=model, initial_std=0.0 * one.initial_std)
    objective = Objective(road, (one,))
    # the vehicle is not quite at rest at first
    (settling,) = objective.linearize(np.zeros(objective.size)).residual
    measurements = replace(one.measurements, y=y.reshape(settling.shape) - settling)
    objective = Objective(road, (replace(one, measurements=measurements),))
    precise = {"cg_iterations": 400, "cg_tolerance": 1e-6, "change_tolerance": 1e-9}
    solution = minimize(objective, GaussNewton(adapt_prior=False, **precise))
    assert 1.0 <= solution.noise_scale < 1.1
    noise *= np.sqrt(solution.noise_scale)
    J, y = J / noise[:, None], y / noise
    expected = np.linalg.solve(np.eye(J.shape[1]) + J.T @ J, J.T @ y)
    at = (np.linspace(1.0, 7.0, 400) - road.origin) / road.ds
    u, dense, true = (
        evaluate_spline(road.coefficients(x[: 2 * road.size].reshape(2, -1)), at)
        for x in (solution.linearization.x, expected, drawn)
    )
    assert np.std(dense - true) < 0.1 * np.std(true)
    assert np.std(u - dense) < 0.01 * np.std(dense - true)


def road_matrix(road: RoadTransform) -> np.ndarray:
    """Coefficients (2 K, 2 K) per unit of each entry of the noise."""
    units = np.eye(2 * road.size).reshape(-1, 2, road.size)
    return np.array([road.apply(u).ravel() for u in units]).T
