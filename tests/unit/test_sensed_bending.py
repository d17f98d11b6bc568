"""Bending in the model of the map smoother: predictions, tangent and adjoint, linear response."""

from dataclasses import replace

import numpy as np
import pytest
from test_map_smoother import residual_at
from vehicle_fixtures import DEFENDER, smooth_road

from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.preconditioner import linear_responses
from estimators.map_smoother.windows import whole_objective
from leaderboard.metrics.heights import nrmse
from road_envs.analysis.information_bound import RoadPrior
from road_envs.drives.recording import simulate_record
from road_envs.records.record import scored_band
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle import body_bending
from road_envs.vehicle.parameters import BendingMode, TorsionalFrame, VehicleVariation

PAPER = load_instruments("paper")
MODE = BendingMode(f=22.0, zeta=0.05, length=4.4)
VARIATIONS = (
    VehicleVariation(bending=MODE),
    VehicleVariation(bending=MODE, frame=TorsionalFrame(f=12.0, zeta=0.08)),
)


def objective_of(variation, blocks=120):
    car = replace(DEFENDER, variation=variation)
    road = smooth_road(length=20.0, height=0.01)
    record, _ = simulate_record(road, vehicle=car, speed_kmh=36.0, seed=1)
    drive, _ = MapSmoother().prepare(record, car)
    return whole_objective(drive, RoadPrior(), blocks)


@pytest.mark.parametrize("variation", VARIATIONS, ids=["stiff", "twisting"])
def test_tangent_and_adjoint_are_transposes_and_the_tangent_a_derivative(variation):
    objective, rng = objective_of(variation), np.random.default_rng(2)
    x = 0.1 * rng.standard_normal(objective.size)
    lin = objective.linearize(x)
    dx, means = rng.standard_normal(objective.size), rng.standard_normal(lin.residual[0].shape)
    (forward,), backward = lin.tangent(dx), lin.adjoint([means])
    assert np.vdot(forward, means) == pytest.approx(np.vdot(dx, backward), rel=1e-9)
    h = 1e-4
    more, less = (residual_at(objective, x + k * h * dx) for k in (1.0, -1.0))
    difference = (less - more) / (2.0 * h)
    # the tangent filters means over a block, the model samples
    assert np.linalg.norm(forward - difference) < 0.02 * np.linalg.norm(difference)


def test_the_linear_response_has_the_bending_of_the_sensors():
    stiff, bent = (objective_of(v, 40) for v in (VehicleVariation(), VARIATIONS[0]))
    f = np.array([5.0, 20.0, 22.0, 40.0])
    (_, H), (_, B) = (next(linear_responses(one.passes[0], f)) for one in (stiff, bent))
    x = {name: place.x for name, place in PAPER.locations(DEFENDER).items()}
    # on a symmetric road the rear sensors tell pitch from heave with the front one
    heave_pitch = np.linalg.solve(
        np.array([[1.0, -x["RF"]], [1.0, -x["LR"]]]), np.array([H[:, 0, 0], H[:, 1, 0]])
    )
    force = body_bending.modal_force(MODE, DEFENDER) @ heave_pitch
    for row, name in enumerate(("RF", "LR", "RR")):
        expected = body_bending.shape(MODE, x[name]) * body_bending.response(MODE, f) * force
        np.testing.assert_allclose(B[:, row, 0] - H[:, row, 0], expected, rtol=1e-6, atol=1e-9)


def test_a_bending_vehicle_that_is_known_leaves_no_more_noise_than_a_stiff_one():
    road, speed = smooth_road(length=30.0, height=0.02), 36.0
    car = replace(DEFENDER, variation=VARIATIONS[0])
    record, truth = simulate_record(road, vehicle=car, speed_kmh=speed, seed=1)
    band = scored_band(speed / 3.6)  # longer waves are hardly told, by any model
    error = {
        name: nrmse(
            truth.z, MapSmoother(draws=0, adapt=False).estimate(record, told).z, truth.ds, band
        ).pooled
        for name, told in (("stiff", DEFENDER), ("bending", car))
    }
    assert error["bending"] < 0.4 * error["stiff"]
