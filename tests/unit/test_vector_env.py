"""The vector environment against scalar environments, to the bit."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from vector_checker import VectorCheckError, check_vector_env
from vehicle_fixtures import varied_plant

import road_envs
from road_envs.core.config import ConfigError
from road_envs.envs.instrumented_fleet import InstrumentedFleet
from road_envs.envs.road_recon import RoadReconEnv
from road_envs.envs.safe4s4 import Safe4S4VectorEnv
from road_envs.envs.vector import RoadReconVectorEnv
from road_envs.kernels.simd import LANES
from road_envs.vehicle.parameters import TorsionalFrame, VehicleVariation

SHORT = {"road": "iso_d", "length": 6.0, "speed_kmh": [40.0, 70.0], "control": "axle"}
VARIANTS = {
    "axle control, drawn speeds": SHORT,
    "no truth, ideal sensors": {
        **SHORT,
        "truth": False,
        "sensors": "ideal",
        "control": "vehicle",
    },
    "slalom, fine step": {
        **SHORT,
        "manoeuvre": {"kind": "slalom", "begin": 0.0, "period": 0.6},
        "step": 0.0005,
    },
    "all states and instruments, a price on information": {
        **SHORT,
        "speed_kmh": 54.0,
        "control": "states",
        "observe": ["accelerations", "planar", "struts"],
        "weights": {"unresolved_variance": 30.0},
        "manoeuvre": {"kind": "slalom", "begin": 0.0, "period": 0.6},
    },
    "roads of several lengths and modes": {
        **SHORT,
        "road": "bump_asymmetric",
        "length": None,
        "speed_kmh": 150.0,
        "mode": {"front": "ride", "rear": "handling"},
    },
}


ONE_OF_MANY = {"axle control, drawn speeds", "slalom, fine step"}
"""Variants of which other tests and variants have each part."""


def vector(options=SHORT, **kwargs):
    return RoadReconVectorEnv(**{"num_envs": 3, **kwargs}, **options)


@pytest.mark.parametrize(
    "options",
    [
        pytest.param(options, id=name, marks=[pytest.mark.slow] * (name in ONE_OF_MANY))
        for name, options in VARIANTS.items()
    ],
)
@pytest.mark.costly
def test_environment_i_equals_the_single_one_with_seed_plus_i_in_every_mode(options):
    number = 10  # more than one block of lanes, the second one partly filled
    ended = check_vector_env(
        lambda **kwargs: vector(options, **kwargs),
        lambda: RoadReconEnv(**options),
        num_envs=number,
        steps=45,
        seed=3,
    )
    assert ended >= 3 * number / 2


def test_results_do_not_depend_on_num_envs_or_threads():
    def run(**kwargs):
        envs = vector(**kwargs)
        actions = np.random.default_rng(1).integers(0, 4, (30, 20))
        outputs = [envs.reset(seed=5)[0][:2]]
        for row in actions:
            observation, reward, *_ = envs.step(row[: envs.num_envs])
            outputs += [observation[:2], reward[:2]]
        return outputs

    alone = run(num_envs=2)
    for other in (run(num_envs=20), run(num_envs=20, threads=3)):
        for one, two in zip(alone, other, strict=True):
            np.testing.assert_array_equal(one, two)


def test_make_vec_creates_it_and_max_episode_steps_truncates():
    envs = gym.make_vec(
        "RoadRecon-v0", num_envs=2, vectorization_mode="vector_entry_point", **SHORT
    )
    assert isinstance(envs.unwrapped, RoadReconVectorEnv)
    assert envs.unwrapped.max_episode_steps == gym.spec(road_envs.ID).max_episode_steps
    short = vector(max_episode_steps=4)
    short.reset(seed=0)
    ends = [short.step(np.zeros(3, dtype=int))[3].tolist() for _ in range(10)]
    assert [all(row) for row in ends] == [False] * 3 + [True] + [False] * 4 + [True] + [False]
    assert not any(any(row) for k, row in enumerate(ends) if k not in (3, 8))


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
def test_a_copy_continues_identically(clone):
    envs = vector()
    envs.reset(seed=2)
    for _ in range(5):
        envs.step(np.array([0, 3, 1]))
    twin = clone(envs)
    for _ in range(25):
        one, two = envs.step(np.array([1, 0, 2])), twin.step(np.array([1, 0, 2]))
        for a, b in zip(one[:4], two[:4], strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_failed_vehicle_reports_a_reason_and_does_not_affect_others():
    healthy, envs = vector(), vector()
    healthy.reset(seed=1)
    envs.reset(seed=1)
    envs.fleet.state.q[0, 0, 1] = np.nan
    envs.fleet.state.q[0, 1, 2] = 0.9
    observation, reward, terminated, truncated, infos = envs.step(np.zeros(3, dtype=int))
    expected = healthy.step(np.zeros(3, dtype=int))
    assert terminated.tolist() == [False, True, True] and not truncated.any()
    assert infos["reason"].tolist() == [0, 2, 1]
    assert "no longer finite" in envs.failures[1]
    assert "phi passed 45 degrees at t = 0.050 s" in envs.failures[2]
    assert np.isfinite(observation).all() and np.isfinite(reward).all()
    np.testing.assert_array_equal(observation[0], expected[0][0])
    observation, *_ = envs.step(np.zeros(3, dtype=int))  # NEXT_STEP: both restart
    assert np.isfinite(observation).all() and envs.observation_space.contains(observation)


def test_reset_options_apply_to_the_masked_environments_only():
    envs = vector(autoreset_mode=AutoresetMode.DISABLED)
    envs.reset(seed=0)
    mask = np.array([False, True, False])
    _, infos = envs.reset(options={"reset_mask": mask, "speed_kmh": 33.0})
    assert infos["speed_kmh"].tolist() == [0.0, 33.0, 0.0]
    assert infos["_speed_kmh"].tolist() == mask.tolist()


def test_invalid_input_is_rejected_in_one_sentence():
    envs = vector(autoreset_mode="Disabled")
    with pytest.raises(gym.error.ResetNeeded, match="call reset before step"):
        envs.step(np.zeros(3, dtype=int))
    envs.reset(seed=0)
    for bad, message in (
        (np.array([0, 4, 0]), "actions must be 0 to 3, got 4 for environment 1"),
        (np.zeros(2, dtype=int), "actions must be 3 whole numbers"),
        (np.zeros(3), "whole numbers, got float64"),
    ):
        with pytest.raises(ConfigError, match=message):
            envs.step(bad)
    with pytest.raises(ConfigError, match="reset_mask must be an array of 3 bools"):
        envs.reset(options={"reset_mask": np.zeros(3, dtype=bool)})
    with pytest.raises(ConfigError, match="reset_mask is for autoreset_mode 'Disabled'"):
        vector().reset(options={"reset_mask": np.ones(3, dtype=bool)})
    with pytest.raises(ConfigError, match="seed must be one number or 3 numbers, got 2"):
        envs.reset(seed=[1, 2])
    with pytest.raises(ConfigError, match="num_envs must be a whole number"):
        vector(num_envs=0)
    with pytest.raises(ConfigError, match="num_envs must be at most 100000, got 1000000000"):
        vector(num_envs=10**9)
    with pytest.raises(ConfigError, match="max_episode_steps must be a whole number"):
        vector(max_episode_steps=0)
    with pytest.raises(ConfigError, match="unknown autoreset mode"):
        vector(autoreset_mode="never")
    with pytest.raises(ConfigError, match="render with"):
        vector(render_mode="rgb_array")
    with pytest.raises(gym.error.ResetNeeded, match="have ended"):
        for _ in range(40):
            envs.step(np.zeros(3, dtype=int))


class Faulty(RoadReconVectorEnv):
    """Vector environment with one of the faults that the checker has to detect."""

    def __init__(self, fault, **options):
        super().__init__(**options)
        self.fault, self.buffer = fault, None
        if fault == "mode":
            self.metadata = {"autoreset_mode": "next"}
        if fault == "space":
            self.observation_space = self.single_observation_space

    def reset(self, *, seed=None, options=None):
        if self.fault == "seed":
            seed = [seed] * self.num_envs
        return super().reset(seed=seed, options=options)

    def step(self, actions):
        observation, reward, terminated, truncated, infos = super().step(actions)
        if self.fault == "buffer":
            if self.buffer is None:
                self.buffer = observation
            self.buffer[:] = observation
            observation = self.buffer
        if self.fault == "reward":
            reward = reward * (1.0 + 1e-12)
        if self.fault == "final" and "final_obs" in infos:
            infos["final_obs"] = observation
        if self.fault == "mask" and "_t" in infos:
            infos["_t"] = ~infos["_t"]
        if self.fault == "type":
            terminated = terminated.astype(int)
        return observation, reward, terminated, truncated, infos


FAULTS = {
    "mode": "must be AutoresetMode",
    "space": "must be a batch of 3",
    "seed": "the observation differs",
    "buffer": "have changed",
    "reward": "reward, terminated, truncated are",
    "final": "final_obs is not the last observation",
    "mask": "is masked",
    "type": "terminations are",
}


@pytest.mark.parametrize("fault, message", FAULTS.items())
@pytest.mark.costly
def test_the_checker_detects(fault, message):
    with pytest.raises(VectorCheckError, match=message):
        check_vector_env(
            lambda **kwargs: Faulty(fault, **kwargs, **SHORT),
            lambda: RoadReconEnv(**SHORT),
            steps=40,
        )


CRUEL = {
    "class H": ({"road": "iso_h", "length": 15.0, "speed_kmh": [20.0, 120.0]}, 1000),
    "bumps in a slalom": (
        {"road": "bump_asymmetric", "speed_kmh": 54.0, "manoeuvre": "slalom"},
        4000,
    ),
    "twist": ({"road": "twist", "speed_kmh": [30.0, 90.0]}, 5000),
}
"""Options and number of episodes, 10 000 in total."""


@pytest.mark.slow
@pytest.mark.parametrize("options, episodes", CRUEL.values(), ids=CRUEL.keys())
def test_extreme_episodes_stay_finite_or_end_with_a_reason(options, episodes):
    number, ended = 500, 0
    envs = RoadReconVectorEnv(
        num_envs=number,
        control="axle",
        control_rate=50.0,
        truth=False,
        autoreset_mode="SameStep",
        **options,
    )
    envs.reset(seed=0)
    rng = np.random.default_rng(0)
    while ended < episodes:
        observation, reward, terminated, truncated, infos = envs.step(rng.integers(0, 4, number))
        assert np.isfinite(observation).all() and np.isfinite(reward).all()
        for i in np.flatnonzero(terminated | truncated):
            assert bool(infos["final_info"]["reason"][i]) == bool(terminated[i])
        ended += int((terminated | truncated).sum())


def test_a_fleet_of_several_blocks_has_no_last_interval_and_a_flexible_frame_is_refused():
    setup = RoadReconVectorEnv(1).setup
    with pytest.raises(ValueError, match=f"at most {LANES} vehicles, got {LANES + 1}"):
        setup.make_fleet(LANES + 1).last_interval(LANES, 0)
    frame = VehicleVariation(frame=TorsionalFrame(f=11.0, zeta=0.05))
    plant = varied_plant(setup.car, frame)
    with pytest.raises(ConfigError, match="does not support a flexible frame"):
        InstrumentedFleet(plant, setup.car, setup.fleet_settings())


@pytest.mark.parametrize("options", [SHORT, None], ids=["RoadRecon-v0", "Safe4S4-v1"])
def test_a_state_is_continued_to_the_bit(options):
    envs = Safe4S4VectorEnv(3) if options is None else vector(options)
    envs.reset(seed=2)
    for _ in range(5):
        envs.step(np.array([0, 3, 1]))
    state = envs.state()
    first = [envs.step(np.array([1, 0, 2])) for _ in range(25)]
    envs.reset(seed=9)
    for _ in range(2):  # the state itself is not changed by going on from it
        envs.set_state(state)
        for one in first:
            for a, b in zip(one[:4], envs.step(np.array([1, 0, 2]))[:4], strict=True):
                np.testing.assert_array_equal(a, b)


def test_a_foreign_state_is_rejected():
    with pytest.raises(ConfigError, match="one that state"):
        vector().set_state({"q": 1})
    with pytest.raises(ConfigError, match="of 2 environments; there are 3"):
        vector().set_state(vector(num_envs=2).state())
