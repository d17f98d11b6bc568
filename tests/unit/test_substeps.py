"""Tests of the shorter steps on steep roads, and of surfaces that no wheel can climb."""

import numpy as np
import pytest

from road_envs.core.config import ConfigError
from road_envs.envs.road_recon import RoadReconEnv
from road_envs.roads import load_road
from road_envs.roads.surface import MAX_RISE, RISE_LENGTH, Surface
from road_envs.simulation.drive import DriveSimulator, simulate
from road_envs.simulation.substeps import SUBSTEPS, interpolate
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.suspension import encode_command
from studies.bench.adaptive_drive import simulate_adaptive
from studies.bench.fleet import Fleet, select_vehicle

CAR = load_vehicle("land_rover_defender_110")


def realise(name):
    return load_road(name).realise(np.random.default_rng(7))


@pytest.mark.parametrize(
    ("road", "mode", "share"),
    [("bump_large_small", "handling", 0.01), ("potholes", "ride", 0.025), ("iso_f", "ride", 0.01)],
)
def test_a_millisecond_suffices_at_54_kmh(road, mode, share):
    surface = realise(road)
    exact = simulate_adaptive(CAR, surface, 15.0, mode, rtol=1e-6, atol=1e-8).trajectory
    drive = simulate(CAR, surface, 15.0, mode)
    heave = np.interp(drive.t, exact.t, exact.acceleration[:, 0])
    error = drive.acceleration[:, 0] - heave
    assert np.sqrt(np.mean(error**2) / np.mean(heave**2)) < share


def test_lanes_on_steep_and_on_even_roads_match_vehicles_simulated_alone():
    plant, commands = build_plant(CAR), np.full((5, 3000), encode_command("ride"), np.uint8)
    surfaces = [realise(name) for name in ("potholes", "iso_d", "bump_small", "iso_f", "flat")]

    def simulators():
        return [DriveSimulator(plant, CAR, s, 9.0 + k) for k, s in enumerate(surfaces)]

    signals = Fleet(simulators()).advance(commands[:, :2500])
    for k, simulator in enumerate(simulators()):
        alone = simulator.advance(commands[k, :2500]).signals
        scale = np.abs(alone).max(axis=0)
        difference = np.abs(select_vehicle(signals, k) - alone).max(axis=0)
        assert (difference <= 1e-8 * scale + 1e-12).all(), surfaces[k].name
    # all lanes hold this one vehicle: none takes the whole step where the road is steep
    together = Fleet(simulators()[:1]).advance(commands[:1, :2500])
    np.testing.assert_array_equal(select_vehicle(together, 0), select_vehicle(signals, 0))


def test_inputs_of_a_substep_lie_on_the_lines_between_the_half_steps():
    x = np.array([1.0, 3.0, 4.0])
    found = [interpolate(x, i, half) for i in range(SUBSTEPS) for half in range(2)]
    np.testing.assert_allclose(found, np.interp(np.arange(8) / 8, [0.0, 0.5, 1.0], x))


def test_a_step_higher_than_half_a_wheel_is_refused_and_a_drop_is_not():
    z = np.zeros((2, 1000))
    z[1, 500:] = MAX_RISE + 0.03
    with pytest.raises(ConfigError, match="right wheel path rises by 230 mm within 50 mm"):
        DriveSimulator(build_plant(CAR), CAR, Surface(z, 0.01, name="kerb"), 5.0)
    DriveSimulator(build_plant(CAR), CAR, Surface(-z, 0.01), 5.0)
    ramp = np.clip(0.01 * np.arange(1000) - 5.0, 0.0, 1.0) * 0.9 * MAX_RISE / RISE_LENGTH
    Surface(np.array([ramp, ramp]), 0.01).check_climbable()


def test_an_episode_draws_a_random_road_again_that_no_wheel_climbs():
    env = RoadReconEnv(road="iso_h", length=15.0)
    env.reset(seed=50)
    stream, road = np.random.default_rng(50).spawn(3)[0], env.setup.road
    with pytest.raises(ConfigError, match="no wheel climbs"):
        road.realise(stream).check_climbable()
    np.testing.assert_array_equal(env.drive.surface.z, road.realise(stream).z)


def test_an_episode_refuses_a_fixed_road_that_no_wheel_climbs(tmp_path):
    kerb = tmp_path / "kerb.csv"
    kerb.write_text(
        "station,left,right\n" + "\n".join(f"{0.05 * i},{0.3 * (i > 80)},0" for i in range(200))
    )
    with pytest.raises(ConfigError, match="left wheel path rises by"):
        RoadReconEnv(road=str(kerb)).reset(seed=0)
