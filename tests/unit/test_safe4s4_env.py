"""The benchmark `RoadRecon/Safe4S4-v1`: drives from a seed, additive reward, violations."""

import warnings
from dataclasses import fields, replace

import gymnasium
import numpy as np
import pytest
import scipy
from gymnasium.utils import seeding
from gymnasium.utils.env_checker import check_env

import road_envs
from road_envs.analysis.comfort import wk_sos
from road_envs.core.config import ConfigError
from road_envs.envs.safe4s4 import Safe4S4Env, Safe4S4Setup, Safe4S4VectorEnv
from road_envs.envs.safe_drives import draw_drive, load_benchmark
from road_envs.envs.safety_step import (
    COST,
    LIFT_OFF,
    LOAD_TRANSFER,
    N_SAFETY,
    SEAT,
    _add_violations,
)
from road_envs.kernels.simd import LANES
from road_envs.simulation.rosenbrock import EXTENSION, LOAD, N_SIGNALS
from road_envs.vehicle.equations import PHI, THETA, Z_B

SHORT = {"duration": 20.0, "road": "D", "grade": "S0", "payload": 0.0, "begin": 3.0}
"""Fields of a drive of 20 s of the described car."""

SEEDS = range(20)


def returns(rate: float, switching: bool = True, **fixed) -> tuple[float, float]:
    """Return the sums of reward and cost of a drive, with states that change every second."""
    env = Safe4S4Env(control_rate=rate)
    env.reset(seed=3, options=SHORT | fixed)
    reward = cost = 0.0
    done, k = False, 0
    while not done:
        k += 1  # reset has driven the first interval
        action = 5 if switching and int(k / rate + 1e-9) % 2 else 0
        _, r, terminated, truncated, info = env.step(action)
        reward, cost, done = reward + r, cost + info["cost"], terminated or truncated
    return reward, cost


def test_the_environment_passes_the_checker():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(road_envs.SAFE_ID).unwrapped, skip_render_check=True)


def test_return_and_cost_are_equal_at_all_control_rates():
    found = np.array([returns(rate) for rate in (10.0, 20.0, 50.0, 100.0)])
    assert found[0, 1] > 0.5
    assert found == pytest.approx(np.tile(found[0], (4, 1)), rel=0.01)


def test_vector_environments_equal_single_ones_to_the_bit():
    envs, single = Safe4S4VectorEnv(3), Safe4S4Env()
    envs.reset(seed=5)
    single.reset(seed=6)
    for action in (0, 5, 10, 15) * 10:
        rows, rewards, _, _, infos = envs.step(np.array([3, action, 1]))
        row, reward, _, _, info = single.step(action)
        np.testing.assert_array_equal(rows[1], row)
        assert rewards[1] == reward
        assert {name: infos[name][1] for name in info} == info


def test_a_restart_leaves_the_other_vehicles_as_they_are():
    alone, envs = Safe4S4Env(), Safe4S4VectorEnv(2, autoreset_mode="Disabled")
    alone.reset(seed=7)
    envs.reset(seed=7)
    for k in range(30):
        envs.step(np.array([k % 16, 0]))
        expected = alone.step(k % 16)[0]
        if k == 20:
            envs.reset(seed=[None, 99], options={"reset_mask": np.array([False, True])})
    found = envs.step(np.array([1, 1]))[0][0]
    np.testing.assert_array_equal(found, alone.step(1)[0])
    assert (found != expected).any()


@pytest.mark.parametrize("kind", ["lane_change", "j_turn", "fishhook"])
def test_terms_follow_from_the_motion_of_the_single_simulator(kind):
    setup = Safe4S4Setup({})
    fixed = SHORT | {"severe": kind, "gentle": "slalom", "grade": "S2"}
    start = setup.prepare(seeding.np_random(1)[0], fixed)
    motion = setup.prepare(seeding.np_random(1)[0], fixed).drive.advance(
        np.zeros(20_000, dtype=np.uint8)
    )
    fleet = setup.make_fleet()
    fleet.start(0, start.drive, start.logger, 50.0)
    rows = np.array([fleet.advance(0).values[0] for _ in range(400)])
    total = dict(zip(setup.output_columns, rows.sum(axis=0), strict=True))
    largest = dict(zip(setup.output_columns, rows.max(axis=0), strict=True))

    a, h = motion.acceleration, 0.001
    seats = [a[:, Z_B] - SEAT[0] * a[:, THETA] + y * a[:, PHI] for y in (SEAT[1], -SEAT[1])]
    squares = scipy.signal.sosfilt(wk_sos(1000.0), np.array(seats), axis=1) ** 2
    load = motion.tyre_load
    off = np.stack([(load[:, [i, i + 2]] <= 0).all(axis=1) for i in (0, 1)])
    ends = [np.flatnonzero(np.diff(np.r_[False, side, False])).reshape(-1, 2) for side in off]
    late = np.zeros(20_000, dtype=bool)
    for first, last in np.concatenate(ends):
        late[first + 20 : last] = True
    e = motion.extension
    stopped = (
        (e[:, :2] < -0.085) | (e[:, :2] > 0.095) | (e[:, 2:] < -0.105) | (e[:, 2:] > 0.115)
    ).any(axis=1)
    sides = load[:, [0, 2]].sum(axis=1), load[:, [1, 3]].sum(axis=1)
    transfer = np.abs(sides[0] - sides[1]) / np.maximum(sides[0] + sides[1], 1.0)
    assert total["comfort"] == pytest.approx(h * squares.mean(axis=0).sum(), rel=1e-6)
    assert total["lift_off"] == pytest.approx(h * off.any(axis=0).sum(), abs=1e-9)
    assert total["stop"] == pytest.approx(h * stopped.sum(), abs=1e-9)
    assert total["cost"] == pytest.approx(h * (stopped | late).sum(), abs=1e-9)
    assert largest["load_transfer"] == pytest.approx(transfer.max(), rel=1e-6)
    assert largest["roll"] == pytest.approx(np.abs(motion.state[:, PHI]).max(), rel=1e-6)


def test_seeds_vary_every_field():
    benchmark = load_benchmark()
    drawn = [draw_drive(benchmark, "test", np.random.default_rng(k), {}) for k in range(60)]
    for field in fields(drawn[0]):
        assert len({getattr(drive, field.name) for drive in drawn}) > 1, field.name


def test_unseen_ranges_share_no_value_with_those_of_training():
    benchmark = load_benchmark()
    for name in ("speed_kmh", "severity", "bump_height", "payload"):
        known, unseen = getattr(benchmark.known, name), getattr(benchmark.unseen, name)
        assert unseen[0] > known[1] or unseen[1] < known[0], name
    assert not set(benchmark.known.road) & set(benchmark.unseen.road)
    assert benchmark.groups["train"] == {"known": 1.0}


def test_splits_share_no_drive():
    drawn = []
    for options in ({}, {"split": "test"}, {"split": "sealed", "seal": "a"}):
        setup = Safe4S4Setup(options)
        fixed = {"group": "known"}
        for k in range(5):
            drawn.append(setup.prepare(seeding.np_random(k)[0], fixed).description.speed_kmh)
    assert len(set(drawn)) == 15


def test_fixing_a_field_leaves_the_others_as_they_are():
    env = Safe4S4Env()
    env.reset(seed=1)
    drawn = env.description
    env.reset(seed=1, options={"speed_kmh": 45.5})
    assert env.description == replace(drawn, speed_kmh=45.5) != drawn
    assert drawn.mirrored.mirrored == drawn


def test_braking_lowers_the_speed():
    env = Safe4S4Env()
    env.reset(seed=1, options=SHORT | {"gentle": "braking", "gentle_severity": 1.0})
    infos = [env.step(0)[4] for _ in range(300)]
    assert infos[0]["speed_kmh"] - infos[-1]["speed_kmh"] == pytest.approx(3.6 * 3.0 * 1.8)


@pytest.mark.parametrize(
    ("options", "reset", "match"),
    [
        ({"split": "sealed"}, {}, "secret text"),
        ({"split": "test", "seal": "x"}, {}, "no other"),
        ({"road": "iso_d"}, {}, "road"),
        ({}, {"spped": 1.0}, "unknown reset options"),
        ({}, {"grade": "S9"}, "grade"),
        ({}, {"duration": 5.0}, "duration"),
    ],
)
def test_bad_options_are_named(options, reset, match):
    with pytest.raises(ConfigError, match=match):
        Safe4S4Env(**options).reset(seed=0, options=reset)


def test_the_vector_reward_holds_the_terms():
    env = Safe4S4Env(vector_reward=True)
    env.reset(seed=3, options=SHORT)
    _, reward, _, _, info = env.step(0)
    assert reward == pytest.approx([-info["comfort"], -info["tyre_load"], -info["cost"]])
    assert env.reward_space.contains(reward)
    envs = Safe4S4VectorEnv(2, vector_reward=True)
    envs.reset(seed=3)
    assert envs.step(np.zeros(2, dtype=int))[1].shape == (2, 3)


def test_a_side_off_the_ground_counts_beyond_20_ms():
    h, stops = 0.001, Safe4S4Setup({}).make_fleet().safety.stops
    off, sums = np.zeros((2, LANES)), np.zeros((N_SAFETY, LANES))
    row = np.zeros((N_SIGNALS, LANES))
    # lane 0: left wheels off for 50 ms; lane 1: for 15 ms; lane 2: one wheel; lane 3: on the left
    for i in range(50):
        row[LOAD : LOAD + 4] = 4000.0
        row[[LOAD, LOAD + 2], 0] = 0.0
        row[[LOAD, LOAD + 2], 1] = 0.0 if i < 15 else 4000.0
        row[LOAD, 2] = 0.0
        row[[LOAD + 1, LOAD + 3], 3] = 0.0
        row[EXTENSION + 1, 4] = -0.09 if i < 3 else 0.0
        _add_violations.py_func(h, stops, off, row, sums)
    assert sums[COST, :5] == pytest.approx([30 * h, 0.0, 0.0, 30 * h, 3 * h])
    assert sums[LIFT_OFF, :5] == pytest.approx([50 * h, 15 * h, 0.0, 50 * h, 0.0])
    assert sums[LOAD_TRANSFER, :3] == pytest.approx([1.0, 1.0, 1.0 / 3.0])


def test_vehicles_that_share_a_drive_move_as_one_alone_does():
    setup = Safe4S4Setup({})
    start = setup.prepare(seeding.np_random(2)[0], SHORT | {"grade": "S2"})
    many, alone = setup.make_fleet(11, distinct=1), setup.make_fleet()
    for fleet in (many, alone):
        fleet.start(0, start.drive, start.logger, start.speed_kmh)
    many.share(0, range(1, 11))
    begin = many.copy_state()
    for _ in range(2):  # started again to the bit
        many.restore_state(begin)
        for byte in (0, 255, 0, 0b11001100):
            rows = many.advance(byte)
        np.testing.assert_array_equal(rows.observation, np.repeat(rows.observation[:1], 11, axis=0))
    for byte in (0, 255, 0, 0b11001100):
        expected = alone.advance(byte)
    np.testing.assert_array_equal(rows.values[10], expected.values[0])
    np.testing.assert_array_equal(rows.observation[10], expected.observation[0])


def test_an_environment_that_another_thread_steps_is_refused():
    env = Safe4S4Env()
    env.reset(seed=1, options=SHORT)
    env.fleet._idle.pop()  # as while a step is under way
    with pytest.raises(ConfigError, match="stepped by two threads at once"):
        env.step(0)
