"""The benchmark itself: it must decide something, and its line must hold."""

import json

import numpy as np
import pytest

from leaderboard.commands import policies as policies_command
from leaderboard.policies import best_found, grid_search
from leaderboard.policies.safe_comparison import BEST_FOUND, compare_safely, public_drives
from road_envs.envs.safe4s4 import Safe4S4Env, Safe4S4Setup
from road_envs.policies import create
from road_envs.policies.safe_rollout import SafeDrives, drive_safely

LAWS = ("fixed_ride", "fixed_handling", "lateral", "rrms")


@pytest.fixture(scope="module")
def drives():
    return public_drives(8)


@pytest.fixture(scope="module")
def rollouts(drives):
    return {name: drive_safely(create(name), drives) for name in LAWS}


def test_ride_violates_and_handling_is_uncomfortable(rollouts):
    ride, handling = rollouts["fixed_ride"], rollouts["fixed_handling"]
    assert ride.violated.mean() > 0.9
    assert handling.violated.mean() < 0.1
    assert handling.comfort.mean() > 1.6 * ride.comfort.mean()


def test_the_rank_order_is_the_same_at_all_control_rates():
    orders = set()
    for rate in (10.0, 20.0, 50.0, 100.0):
        setup = Safe4S4Setup({"split": "train", "control_rate": rate})
        few = SafeDrives(setup, range(4))
        scores = [drive_safely(create(name), few).score.mean() for name in LAWS[:3]]
        orders.add(tuple(np.argsort(scores).tolist()))
    assert len(orders) == 1


def test_no_row_is_above_the_best_found_on_any_drive():
    few = public_drives(2)
    data = compare_safely({name: create(name) for name in LAWS}, few, "rrms", generations=2)
    rows = {row["policy"]: np.array(row["scores"]) for row in data["rows"]}
    assert set(rows) == {*LAWS, BEST_FOUND}
    for name, scores in rows.items():
        assert (scores <= rows[BEST_FOUND] + 1e-9).all(), name
    laws = max(rows[name].mean() for name in LAWS)
    assert rows[BEST_FOUND].mean() > 0.85 * laws, "no headroom above the laws"


def test_the_beam_returns_the_actions_of_its_score():
    one = public_drives(2)
    one.starts = one.starts[2:3]
    actions, score = best_found.beam(one, 0)
    again = best_found.replay(one, actions[:, None])
    assert again.score * again.duration == pytest.approx(score)


def test_replayed_actions_give_the_same_drives(drives, rollouts):
    again = best_found.replay(drives, rollouts["rrms"].actions)
    np.testing.assert_array_equal(again.score, rollouts["rrms"].score)


def test_a_drive_of_the_comparison_is_the_one_of_the_environment(drives):
    env = Safe4S4Env(split="test")
    env.reset(seed=1, options={"group": "unseen"})
    total, done = 0.0, False
    while not done:
        _, reward, terminated, truncated, _ = env.step(0)
        total, done = total + reward, terminated or truncated
    k = 2 * 1  # the second public drive, before its mirror image
    ride = drive_safely(create("fixed_ride"), drives)
    assert ride.comfort[k] * ride.duration[k] == pytest.approx(-total, rel=1e-12)


def test_a_policy_that_fails_is_a_row_with_its_failure(drives):
    few = public_drives(2)
    policies = {"fixed_ride": create("fixed_ride"), "broken": object()}
    rows = compare_safely(policies, few, "fixed_ride", generations=0)["rows"]
    assert [row["policy"] for row in rows if row["failure"]] == ["broken"]
    assert rows[0]["wins"] == rows[0]["losses"] == 0 and rows[0]["ties"] == 4


def test_tuning_takes_the_best_of_its_grid_on_training_drives(monkeypatch):
    monkeypatch.setitem(grid_search.GRIDS, "lateral", {"threshold": (0.8, 9.0)})
    drives = grid_search.training_drives(1)
    assert drives.setup.safe.split == "train"
    found = grid_search.tune("lateral", drives)
    assert [trial.settings["threshold"] for trial in found.trials] == [0.8, 9.0]
    assert found.cost == min(trial.cost for trial in found.trials)
    assert found.settings == {"threshold": 0.8}


def test_the_command_prints_and_writes_the_table(tmp_path, capsys):
    policies_command.policies(policy=["lateral"], drives=2, generations=0, out=tmp_path)
    printed = capsys.readouterr().out
    data = json.loads((tmp_path / "benchmark.json").read_text())
    assert [row["policy"] for row in data["rows"]] == ["lateral", "rrms"]
    text = (tmp_path / "benchmark.txt").read_text()
    assert printed == text and "4 drives" in text
    for row in data["rows"]:
        (line,) = (line for line in text.splitlines() if line.startswith(row["policy"] + " "))
        assert f"{row['score']['mean']:.3f}" in line and f"{row['violations']:.0%}" in line
