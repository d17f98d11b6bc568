"""Several passes over one road in one cost: derivatives, information, alignment, windows."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.fft import irfft, rfft
from vehicle_fixtures import DEFENDER

from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.objective import Objective, shift_inputs
from estimators.map_smoother.preconditioner import StationaryHessian, stationary_hessian
from estimators.map_smoother.windows import common_windows, on_common_nodes, reconstruct
from estimators.passes import estimate_passes
from leaderboard.metrics.heights import band_pass, nrmse
from road_envs.core.config import ConfigError
from road_envs.drives.recording import simulate_record
from road_envs.records.record import scored_band
from road_envs.roads import realise_road

MIXED = {"front": "ride", "rear": "handling"}
CONDITIONS = ((30.0, "handling"), (54.0, MIXED))
LENGTH = 40.0


@cache
def drives(length=LENGTH, road_class="iso_c"):
    """Records over one road at two speeds, and the true profile."""
    road = realise_road(road_class, 3, length)
    made = [
        simulate_record(road, speed_kmh=v, mode=mode, seed=k, vehicle=DEFENDER)
        for k, (v, mode) in enumerate(CONDITIONS)
    ]
    return [record for record, _ in made], made[0][1]


def joint_objective(length=12.0):
    """The joint objective of both drives as one window."""
    found = []

    def keep(objective, members):
        found.append(objective)
        raise StopIteration

    records, _ = drives(length)
    prepared = prepared_drives(records)
    with pytest.raises(StopIteration):
        reconstruct(prepared, MapSmoother().road_prior, common_windows(prepared, 40.0, 5.0), keep)
    return found[0]


def prepared_drives(records):
    return on_common_nodes([MapSmoother().prepare(record, DEFENDER)[0] for record in records])


def error(estimate, truth, v=15.0):
    return nrmse(truth.z, estimate.z, truth.ds, scored_band(v)).pooled


def test_the_joint_cost_is_the_sum_and_its_gradient_that_of_finite_differences():
    objective, rng = joint_objective(), np.random.default_rng(1)
    x = 0.3 * rng.standard_normal(objective.size)
    lin = objective.linearize(x)
    u = x[: 2 * objective.road.size]
    parts = sum(lin.of_pass(k).cost for k in range(2))
    own = sum(one.own @ one.own for one in lin.passes)
    shifts = x @ x - u @ u - own
    assert lin.cost == pytest.approx(parts - 0.5 * (u @ u) + 0.5 * shifts, rel=1e-12)
    eps = 1e-6
    for _ in range(3):
        dx = rng.standard_normal(objective.size)
        dx[-objective.n_shifts :] = 0.0
        costs = [objective.linearize(x + sign * eps * dx).cost for sign in (1.0, -1.0)]
        assert lin.gradient() @ dx == pytest.approx((costs[0] - costs[1]) / (2.0 * eps), rel=1e-4)


def test_a_shift_of_a_pass_changes_its_readings_as_the_tangent_predicts():
    """On waves that the nodes resolve; the shift grows by 2 % of itself over a wheelbase."""
    objective, rng = joint_objective(), np.random.default_rng(2)
    x = rng.standard_normal(objective.size)
    road = objective.road
    u = rfft(x[: 2 * road.size].reshape(2, -1), axis=1) * (road.n < 3.0)
    x[: 2 * road.size] = irfft(u, road.size, axis=1).ravel()
    x[-objective.n_shifts :] = 0.0
    lin = objective.linearize(x)
    dx = np.zeros(objective.size)
    dx[-objective.n_shifts :] = np.linspace(0.9, 1.1, objective.n_shifts)
    first, second = lin.tangent(dx)
    assert (first == 0.0).all()
    eps = 1e-3
    moved = objective.linearize(x + eps * dx)
    change = (lin.passes[1].residual - moved.passes[1].residual) / eps
    assert np.std(second - change) < 0.05 * np.std(change)


def test_the_adjoint_transposes_the_tangent_of_all_passes():
    objective, rng = joint_objective(), np.random.default_rng(3)
    lin = objective.linearize(rng.standard_normal(objective.size))
    dx = rng.standard_normal(objective.size)
    dual = [rng.standard_normal(one.residual.shape) for one in lin.passes]
    left = sum(np.sum(a * b) for a, b in zip(lin.tangent(dx), dual, strict=True))
    assert left == pytest.approx(dx @ lin.adjoint(dual), rel=1e-9)


def test_information_and_degrees_of_freedom_of_the_passes_add():
    objective = joint_objective()
    joint = stationary_hessian(objective)
    noise = objective.noise_variance * np.array([1.0, 3.0])
    road = objective.road
    alone = [stationary_hessian(Objective(road, (each,))) for each in objective.passes]
    parts = [each.excess(road, x[None]) for each, x in zip(alone, noise, strict=True)]
    excess = sum(parts)
    np.testing.assert_allclose(joint.excess(road, noise), excess, rtol=1e-9)
    covered = StationaryHessian(tuple(each._replace(covered=1.0) for each in joint.passes))
    whole = covered.effective_dof(road, noise)
    posterior = np.linalg.inv(np.eye(2) + excess)
    total = road.free.sum() * np.mean(2.0 - np.trace(posterior, axis1=1, axis2=2).real)
    assert whole.sum() == pytest.approx(total, rel=1e-9)
    shares = [np.trace(posterior @ part, axis1=1, axis2=2).real.mean() for part in parts]
    np.testing.assert_allclose(whole / total, shares / np.sum(shares), rtol=1e-9)


def test_inputs_are_shifted_with_their_speed():
    inputs = joint_objective().passes[0].inputs
    knots = np.array([0.0, 10.0, 20.0])
    moved = shift_inputs(inputs, knots, np.array([0.0, 0.1, 0.1]))
    at = np.searchsorted(inputs.s, [5.0, 15.0])
    np.testing.assert_allclose((moved.s - inputs.s)[at], [0.05, 0.1], atol=1e-3)
    np.testing.assert_allclose((moved.v / inputs.v)[at], [1.01, 1.0])


@pytest.mark.costly
def test_two_passes_are_better_than_either_and_their_odometers_are_aligned():
    """The second odometer is 1.2 m and 0.8 % off, and position fixes pull it back."""
    records, truth = drives()
    s = records[1].s
    bent = replace(records[1], s=1.008 * s + 1.2 + 0.03 * np.sin(s / 6.0), v=1.008 * records[1].v)
    smoother = MapSmoother(adapt=False)
    singles = [error(smoother.estimate(r, DEFENDER), truth) for r in records]
    joint = estimate_passes(smoother, [records[0], bent], DEFENDER)
    assert error(joint, truth) < 0.85 * min(singles)
    aligned = estimate_passes(smoother, records, DEFENDER)
    assert error(joint, truth) < 1.2 * error(aligned, truth)
    assert any("stations moved by -1." in note for note in joint.notes)
    assert not any("does not reproduce" in note for note in joint.notes)
    z = band_pass(joint.z - truth.z, truth.ds, scored_band(8.0))
    assert joint.z_std is not None
    assert 0.5 < np.std(z) / joint.z_std.mean() < 1.6


@pytest.mark.costly
def test_windows_of_all_passes_end_at_the_same_stations_and_join():
    records, truth = drives(50.0)
    smoother = MapSmoother(adapt=False, draws=0)
    passes = prepared_drives(records)
    windows = common_windows(passes, 2.2, 0.8)
    assert len(windows) > 2
    for window in windows[1:]:
        begins = [
            one.block_stations[begin] for one, (begin, _, _) in zip(passes, window, strict=True)
        ]
        assert np.ptp(begins) < 0.1
    assert [last for _, _, last in windows[-1]] == [one.blocks for one in passes]
    whole = estimate_passes(smoother, records, DEFENDER)
    parts = estimate_passes(replace(smoother, window=2.2, overlap=0.8), records, DEFENDER)
    assert error(parts, truth) < 1.25 * error(whole, truth)


def test_a_pass_of_another_road_is_refused_before_it_spoils_the_estimate():
    records, _ = drives()
    other, _ = simulate_record("iso_c", speed_kmh=30.0, mode="handling", seed=77, length=LENGTH)
    with pytest.raises(ConfigError, match="pass 2 matches pass 1 nowhere"):
        estimate_passes(MapSmoother(), [records[0], other], DEFENDER)
