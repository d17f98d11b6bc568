"""The environment against its docstring and the checkers of Gymnasium and Stable-Baselines3."""

import copy
import json
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scipy.signal import sosfilt

import road_envs
from road_envs.analysis.comfort import wk_sos
from road_envs.core.config import ConfigError
from road_envs.envs.options import ACTIONS
from road_envs.envs.road_recon import RoadReconEnv
from road_envs.roads import load_road
from road_envs.sensing.data_logger import DataLogger
from road_envs.simulation.drive import DriveSimulator
from road_envs.vehicle.equations import Z_B
from road_envs.vehicle.suspension import encode_command

VARIANTS = {
    "default": {},
    "axle control, speeds drawn": {
        "control": "axle",
        "road": "iso_d",
        "speed_kmh": [14.5, 54.0],
        "length": 30.0,
    },
    "without truth": {"truth": False, "road": "iso_c", "length": 20.0},
    "bumps": {"road": "bump_asymmetric", "mode": {"front": "ride", "rear": "handling"}},
    "fine step": {"road": "iso_e", "length": 20.0, "step": 0.0005, "control_rate": 50.0},
}
SHORT = {"road": "iso_d", "length": 20.0, "speed_kmh": 54.0}


def make(**options) -> RoadReconEnv:
    return gym.make("RoadRecon-v0", **options).unwrapped


def rollout(env, actions, seed=None, options=None):
    """Return observations, rewards and infos of an episode under `actions`."""
    observation, info = env.reset(seed=seed, options=options)
    steps = [(observation, 0.0, info)]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        steps.append((observation, reward, info))
        if terminated or truncated:
            break
    return steps


def assert_same(one, other):
    assert len(one) == len(other)
    for (obs_1, reward_1, info_1), (obs_2, reward_2, info_2) in zip(one, other, strict=True):
        np.testing.assert_array_equal(obs_1, obs_2)
        assert reward_1 == reward_2
        assert info_1.keys() == info_2.keys()
        for key in info_1:
            np.testing.assert_array_equal(info_1[key], info_2[key])


@pytest.mark.parametrize("options", VARIANTS.values(), ids=VARIANTS.keys())
def test_the_gymnasium_env_checker_passes(options):
    check_env(make(**options), skip_render_check=True)


@pytest.mark.parametrize("options", VARIANTS.values(), ids=VARIANTS.keys())
def test_the_stable_baselines_env_checker_passes(options):
    from stable_baselines3.common.env_checker import check_env as check_for_sb3

    check_for_sb3(make(**options))


def test_the_env_spec_round_trips_through_json():
    spec = gym.spec("RoadRecon-v0")
    again = gym.envs.registration.EnvSpec.from_json(spec.to_json())
    assert again.id == road_envs.ID
    assert json.loads(spec.to_json())["entry_point"] == "road_envs.envs.road_recon:RoadReconEnv"


def test_equal_seeds_give_equal_episodes_and_different_seeds_different_ones():
    actions = [0, 1, 1, 0] * 5
    first, again, other = (rollout(make(**SHORT), actions, seed) for seed in (3, 3, 4))
    assert_same(first, again)
    assert not np.array_equal(first[-1][0], other[-1][0])


def test_a_second_reset_without_a_seed_draws_another_road():
    env = make(**SHORT)
    first = rollout(env, [0] * 20, seed=3)[-1][2]["profile"]
    second = rollout(env, [0] * 20)[-1][2]["profile"]
    assert not np.array_equal(first, second)


def test_the_road_of_a_seed_does_not_depend_on_the_sensors():
    noisy = rollout(make(**SHORT), [0] * 30, seed=5)
    ideal = rollout(make(**SHORT, sensors="ideal"), [0] * 30, seed=5)
    for (_, _, a), (_, _, b) in zip(noisy, ideal, strict=True):
        np.testing.assert_array_equal(a["profile"], b["profile"])


def test_an_episode_does_not_depend_on_earlier_episodes():
    env = make(**SHORT)
    fresh = rollout(env, [1] * 10, seed=9)
    rollout(env, [0, 1] * 10, seed=1)
    assert_same(fresh, rollout(env, [1] * 10, seed=9))


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
def test_a_copy_made_in_mid_episode_continues_identically(clone):
    env = make(**SHORT)
    rollout(env, [0, 1] * 4, seed=2)
    twin = clone(env)
    for action in (1, 0, 1):
        one, two = env.step(action), twin.step(action)
        np.testing.assert_array_equal(one[0], two[0])
        assert one[1:4] == two[1:4]


def test_the_profile_in_info_is_the_road_under_the_front_axle():
    env = make(road="belgian", speed_kmh=54.0)
    surface = load_road("belgian").realise(np.random.default_rng(0))
    for _, _, info in rollout(env, [0] * 40, seed=0):
        np.testing.assert_array_equal(info["profile"], surface.height(info["s"]))
        assert info["s"][-1] < info["station"]
    assert info["s"][0] > 0.0


def test_the_reward_is_minus_the_weighted_terms_times_the_interval():
    weights = {"comfort": 2.0, "rattle": 3.0, "tyre_load": 5.0}
    env = make(**SHORT, weights=weights, control_rate=10.0)
    for _, reward, info in rollout(env, [0, 1] * 5, seed=1)[1:]:
        expected = -0.1 * sum(weights[name] * info[name] for name in weights)
        assert reward == pytest.approx(expected, rel=1e-12)


def test_a_return_does_not_depend_on_the_control_rate():
    slow, fast = (
        -sum(r for _, r, _ in rollout(make(**SHORT, control_rate=rate), [0] * 400, seed=1))
        for rate in (5.0, 50.0)
    )
    assert fast == pytest.approx(slow, rel=0.15)  # means of short-term RMS values are lower


def test_an_observation_has_the_samples_the_speed_and_the_commanded_states():
    env = make(**SHORT, control="axle", sensors="ideal")
    for action, states in enumerate(ACTIONS["axle"]):
        observation = rollout(env, [0, action], seed=1)[-1][0]
        parts = env.split(observation)
        assert parts["RF"].shape == parts["LR"].shape == parts["RR"].shape == (50,)
        assert parts["speed"] == pytest.approx(15.0)
        for axle in ("front", "rear"):
            np.testing.assert_array_equal(parts[axle], [states[axle] == "handling"] * 2)


def test_a_command_takes_effect_after_the_valve_delay():
    rides = rollout(make(**SHORT, sensors="ideal"), [0] * 6, seed=1)
    switched = rollout(make(**SHORT, sensors="ideal"), [0] * 5 + [1], seed=1)
    loads_1, loads_2 = rides[-1][2]["loads"], switched[-1][2]["loads"]
    np.testing.assert_array_equal(loads_1[:, :20], loads_2[:, :20])
    assert not np.allclose(loads_1[:, 25:], loads_2[:, 25:], rtol=1e-6)


def test_an_episode_is_truncated_only_after_the_road_ends():
    env = make(**SHORT)
    env.reset(seed=0)
    ends = []
    while not (ends and any(ends[-1])):
        *_, terminated, truncated, info = env.step(0)
        ends.append((terminated, truncated))
    assert ends[-1] == (False, True)
    beyond = info["station"] - 20.0 - env.setup.car.wheelbase - 5.0
    assert 0.0 <= beyond <= 15.0 * env.setup.interval


def test_speeds_are_drawn_from_the_range_and_may_be_set_at_reset():
    env = make(road="iso_a", length=10.0, speed_kmh=[20.0, 40.0])
    speeds = {env.reset(seed=seed)[1]["speed_kmh"] for seed in range(20)}
    assert len(speeds) == 20 and all(20.0 <= v <= 40.0 for v in speeds)
    assert env.reset(options={"speed_kmh": 33.0})[1]["speed_kmh"] == 33.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"raod": "flat"}, ["raod", "did you mean 'road'", "speed_kmh"]),
        ({"road": "belgiun"}, ["belgiun", "did you mean 'belgian'"]),
        ({"speed_kmh": 0.0}, ["speed_kmh", "positive"]),
        ({"speed_kmh": [54.0, 14.5]}, ["speed_kmh", "the smallest and the largest"]),
        ({"speed_kmh": "54"}, ["speed_kmh", "'54'"]),
        ({"mode": "hard"}, ["hard", "handling", "ride"]),
        ({"control": "wheel"}, ["control", "vehicle", "axle"]),
        ({"control_rate": 7.0}, ["control_rate", "whole number"]),
        ({"control_rate": 0.0}, ["control_rate: must be positive, got 0.0 Hz"]),
        ({"step": 0.0}, ["step: must be positive, got 0.0 s"]),
        ({"weights": {"comfrt": 1.0}}, ["comfrt", "did you mean 'comfort'"]),
        ({"vehicle": "beetle"}, ["beetle", "land_rover_defender_110"]),
    ],
)
def test_an_invalid_option_is_named_with_the_choices(options, words):
    with pytest.raises(ConfigError) as caught:
        gym.make("RoadRecon-v0", **options)
    for word in words:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_reset_option_and_an_invalid_action_are_rejected():
    env = make(**SHORT)
    with pytest.raises(ConfigError, match=r"unknown reset options \['sped'\]; known: speed_kmh"):
        env.reset(options={"sped": 3.0})
    env.reset(seed=0)
    with pytest.raises(ConfigError, match="one of 0 to 1, got 2"):
        env.step(2)
    with pytest.raises(ConfigError, match="one of 0 to 1, got True"):
        env.step(True)


def test_unknown_keywords_raise_what_wrappers_of_other_libraries_expect():
    # TorchRL passes `frameskip` and tries again without it on a TypeError only
    with pytest.raises(TypeError, match="frameskip"):
        make(**SHORT, frameskip=1)
    env = make(**SHORT)
    with pytest.raises(TypeError, match="unknown reset options"):
        env.reset(options={"sped": 3.0})


def test_a_step_that_makes_intervals_endless_is_rejected():
    with pytest.raises(ConfigError, match=r"at most 1000000 integrator steps.*step = 1e-12 s"):
        make(**SHORT, step=1e-12)


def test_nonfinite_motion_terminates_with_a_reason():
    env = make(**SHORT)
    env.reset(seed=0)
    env.fleet.state.q[0, 0, 0] = np.inf
    observation, _, terminated, truncated, info = env.step(0)
    assert (terminated, truncated, info["reason"]) == (True, False, 2)
    assert "no longer finite" in env.unwrapped.failure
    assert env.observation_space.contains(observation)


def test_a_rollover_terminates_with_a_reason():
    env = make(**SHORT)
    env.reset(seed=0)
    env.fleet.state.q[0, 1, 0] = 0.9
    _, _, terminated, truncated, info = env.step(0)
    assert (terminated, truncated, info["reason"]) == (True, False, 1)
    assert "phi passed 45 degrees at t = 0.050 s" in env.unwrapped.failure


@pytest.mark.processes
def test_a_spawned_worker_finds_the_environment_by_module_and_id(tmp_path):
    script = tmp_path / "workers.py"
    script.write_text(
        "from stable_baselines3.common.env_util import make_vec_env\n"
        "from stable_baselines3.common.vec_env import SubprocVecEnv\n"
        "if __name__ == '__main__':\n"
        "    envs = make_vec_env('road_envs:RoadRecon-v0', 1, seed=7, vec_env_cls=SubprocVecEnv,\n"
        "                        vec_env_kwargs={'start_method': 'spawn'},\n"
        "                        env_kwargs={'road': 'iso_d', 'length': 20.0})\n"
        "    first = envs.reset()\n"
        "    envs.step([1])\n"
        "    print(first.shape)\n"
        "    envs.close()\n"
    )
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "(1, 155)"


def test_making_the_environment_does_not_import_torch():
    code = (
        "import sys, gymnasium, road_envs\n"
        "gymnasium.make('RoadRecon-v0')\n"
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "False", done.stderr


def test_observations_equal_the_data_logger_applied_to_the_drive():
    """The compiled control step against the drive and the data logger."""
    options = {"road": "iso_e", "length": 40.0, "speed_kmh": 36.0, "mode": "handling"}
    env = make(**options)
    observation, _ = env.reset(seed=11)
    road_rng, _, sensor_rng = np.random.default_rng(11).spawn(3)
    setup = env.setup
    surface = setup.road.realise(road_rng)
    drive = DriveSimulator(setup.plant, setup.car, surface, 10.0, "handling")
    logger = DataLogger(setup.instruments, setup.car, 0.001, sensor_rng)
    wk, memory = wk_sos(1000.0), np.zeros((4, 2))
    for _ in range(60):
        trajectory = drive.advance(np.full(50, encode_command("handling"), dtype=np.uint8))
        parts = env.split(observation)
        logged = np.clip(logger.sample(trajectory), -setup.instruments.range, np.inf)
        observed = np.array([parts[name] for name in ("RF", "LR", "RR")])
        np.testing.assert_allclose(observed, np.minimum(logged, setup.instruments.range), atol=1e-5)
        assert parts["speed"][0] == pytest.approx(10.0 * logger.speed_gain, rel=1e-6)
        weighted, memory = sosfilt(wk, trajectory.acceleration[:, Z_B], zi=memory)
        observation, reward, _, _, info = env.step(1)
    trajectory = drive.advance(np.full(50, encode_command("handling"), dtype=np.uint8))
    weighted, memory = sosfilt(wk, trajectory.acceleration[:, Z_B], zi=memory)
    variation = trajectory.tyre_load / np.repeat(setup.car.tyre_loads, 2) - 1.0
    terms = [
        np.sqrt(np.mean(weighted**2)),
        np.sqrt(np.mean(trajectory.extension**2)),
        np.sqrt(np.mean(variation**2)),
    ]
    assert [info[name] for name in ("comfort", "rattle", "tyre_load")] == pytest.approx(terms)
    assert reward == pytest.approx(-0.05 * (terms[0] + 10.0 * terms[1] + terms[2]))
    np.testing.assert_allclose(info["loads"], trajectory.tyre_load.T, rtol=1e-9)
