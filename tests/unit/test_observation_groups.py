"""Optional observation groups, the sixteen actions, and the cost of unresolved variance."""

import numpy as np
import pytest
from gymnasium.utils import seeding

from road_envs.analysis.information_bound import RoadPrior, bound
from road_envs.core.config import ConfigError
from road_envs.envs.road_recon import RoadReconEnv
from road_envs.vehicle.equations import PHI, THETA, build_plant
from road_envs.vehicle.parameters import GRAVITY
from road_envs.vehicle.suspension import encode_command

EVERYTHING = {
    "road": "iso_d",
    "length": 12.0,
    "speed_kmh": 54.0,
    "control": "states",
    "manoeuvre": {"kind": "slalom", "begin": 0.0, "period": 0.8},
    "observe": ["accelerations", "planar", "struts"],
}
MODES = ("ride", "handling", "soft_high", "stiff_low")


def test_planar_and_strut_observations_follow_from_the_motion():
    env = RoadReconEnv(**EVERYTHING)
    observation, _ = env.reset(seed=4)
    setup = env.setup
    drive = setup.prepare(seeding.np_random(4)[0], setup.options).drive
    drive.manoeuvre = setup.manoeuvre
    byte, car = encode_command("ride"), setup.car
    for action in (6, 6, 9, 15, 0):
        motion = drive.advance(np.full(50, byte, dtype=np.uint8))
        a = setup.manoeuvre.at(motion.t)
        parts = env.split(observation)
        specific_force = [
            np.mean(a[:, 0] - GRAVITY * motion.state[:, THETA]),
            np.mean(a[:, 1] + GRAVITY * motion.state[:, PHI]),
        ]
        np.testing.assert_allclose(parts["planar"], specific_force, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(parts["extension"], motion.extension[-1], atol=1e-6)
        q_dot = motion.state[-1, 7:]
        rates = [
            q_dot[0] - axle.x * q_dot[2] - q_dot[3 + 2 * i] + y * (q_dot[1] - q_dot[4 + 2 * i])
            for i, axle in enumerate(car.axles)
            for y in (axle.y_s, -axle.y_s)
        ]
        np.testing.assert_allclose(parts["extension_rate"], rates, rtol=1e-4, atol=1e-5)
        byte = int(setup.command_bytes[action])
        observation, *_ = env.step(action)


def test_extra_observation_groups_do_not_change_the_others():
    plain = RoadReconEnv(**{**EVERYTHING, "observe": ["accelerations"]})
    full = RoadReconEnv(**EVERYTHING)
    for one, other in ((plain.reset(seed=1), full.reset(seed=1)), (plain.step(3), full.step(3))):
        assert one[0].shape == (155,) and other[0].shape == (165,)
        np.testing.assert_array_equal(one[0], other[0][:155])
    assert full.observation_space.contains(other[0])


def test_sixteen_actions_command_every_pair_of_strut_states():
    env = RoadReconEnv(**EVERYTHING)
    assert env.action_space.n == 16
    for action in range(16):
        pair = {"front": MODES[action % 4], "rear": MODES[action // 4]}
        assert env.setup.command_bytes[action] == encode_command(pair)


@pytest.mark.parametrize(("action", "pair"), [(0, ("ride", "ride")), (4, ("ride", "handling"))])
def test_the_reward_is_reduced_by_the_unresolved_variance_of_the_bound(action, pair):
    weight = 30.0
    free = RoadReconEnv(**EVERYTHING)
    charged = RoadReconEnv(**EVERYTHING, weights={"unresolved_variance": weight})
    free.reset(seed=2), charged.reset(seed=2)
    (_, r_0, _, _, info_0), (_, r_1, _, _, info_1) = free.step(action), charged.step(action)
    setup = charged.setup
    plant, mode = build_plant(setup.car), {"front": pair[0], "rear": pair[1]}
    locations = setup.instruments.locations(setup.car)
    posterior = bound(plant, mode, 15.0, setup.instruments, RoadPrior(), locations=locations)
    unresolved = info_1["unresolved_variance"]
    assert unresolved == pytest.approx(posterior.pooled**2, rel=1e-2)
    assert r_0 - r_1 == pytest.approx(0.05 * weight * unresolved, rel=1e-9)
    assert "unresolved_variance" not in info_0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observe": ["struts"]}, "observe needs 'accelerations'"),
        ({"observe": ["accelerations", "planar", "planar"]}, "no duplicates"),
        ({"observe": ["accelerations", "lidar"]}, "'accelerations', 'planar' or 'struts'"),
        ({"weights": {"unresolved_variance": -1.0}}, "unresolved_variance: must not be negative"),
        ({"control": "wheel"}, "'vehicle', 'axle' or 'states'"),
    ],
)
def test_an_invalid_observation_option_is_named(options, message):
    with pytest.raises(ConfigError, match=message):
        RoadReconEnv(**{**EVERYTHING, **options})
