"""Policies that attack the comparison: what they see, send, leave behind and are called."""

import dataclasses
from importlib import metadata

import numpy as np
import pytest
from typer.testing import CliRunner
from wheels import write_policies

from leaderboard.cli import app
from leaderboard.policies import comparison, policy_process
from leaderboard.policies.comparison import compare, public_drives
from leaderboard.policies.policy_checks import OPTIONS
from leaderboard.policies.policy_process import POLICY_LIMITS, PolicyProcess
from leaderboard.sandbox import bubblewrap
from road_envs.core.config import ConfigError
from road_envs.policies import create
from road_envs.policies.api import PolicyError
from road_envs.policies.rollout import roll_out

isolated = pytest.mark.skipif(
    bubblewrap.obstacle() is not None, reason="bubblewrap cannot be used here"
)
SHORT, SEEDS = {**OPTIONS, "length": 10.0}, range(2)
LIMITS = dataclasses.replace(POLICY_LIMITS, seconds=3.0, memory=1.5, isolation="bubblewrap")


def policy(name):
    return PolicyProcess(f"hostile.policies:{name}", limits=LIMITS)


@isolated
@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("LooksForTheDrive", r"RuntimeError: found \[\]$"),
        pytest.param(
            "RepliesNested", "its reply is invalid: not JSON", marks=pytest.mark.processes
        ),
        pytest.param("RepliesHuge", "its reply is invalid: not JSON", marks=pytest.mark.processes),
        ("RepliesTwice", "^no message$"),
        pytest.param("Unsigned", "actions must be 0 to 15, got -1", marks=pytest.mark.processes),
        pytest.param(
            "Interrupts", "ended without a response, by exit status 1", marks=pytest.mark.processes
        ),
        pytest.param("Stops", "stopped after 3 s, the time limit", marks=pytest.mark.processes),
        pytest.param(
            "SignalsAbove", r"RuntimeError: stopped \[(1, 2)?\]$", marks=pytest.mark.processes
        ),
        pytest.param("Floods", "stopped after 3 s, the time limit", marks=pytest.mark.processes),
        ("PaintsItsError", r"^RuntimeError: \[/red\] \[2J<script>alert\(1\)</script> rrms 1\.0$"),
    ],
)
def test_an_attack_ends_in_a_sentence(name, sentence):
    with policy(name) as attacker, pytest.raises(PolicyError, match=sentence):
        roll_out(attacker, dict(SHORT), SEEDS)


@isolated
def test_a_score_is_computed_by_code_that_no_policy_can_change():
    with policy("ChangesTheScore") as attacker:
        found = roll_out(attacker, dict(SHORT), SEEDS)
    ride = roll_out(create("fixed_ride"), dict(SHORT), SEEDS)
    np.testing.assert_array_equal(found.totals["reward"], ride.totals["reward"])


class Watches:
    """A policy that notes whether processes of `other` are alive while it drives."""

    def __init__(self, other):
        self.other, self.alive, self.pids = other, [], []

    def reset(self, context):
        self.n = context.n_vehicles

    def act(self, observations):
        self.alive.append(self.other._guest is not None)
        return np.zeros(self.n, dtype=int)


def test_nothing_of_a_policy_runs_beside_the_next_one():
    limits = dataclasses.replace(LIMITS, seconds=60.0, isolation="process")
    with PolicyProcess("hostile.policies:LivesOn", limits=limits) as attacker:
        watches = Watches(attacker)
        found = compare({"a": attacker, "b": watches}, public_drives(2), "b", sweeps=0)
    assert [row["failure"] for row in found.data["rows"]] == [None, None]
    assert not any(watches.alive)


@pytest.mark.costly
@isolated
def test_what_a_policy_has_read_is_dropped_before_the_next_one(monkeypatch):
    steps, start = [], policy_process.start_guest
    monkeypatch.setattr(PolicyProcess, "last_guest", None)
    monkeypatch.setattr(bubblewrap, "forget_pipes", lambda before: steps.append("pipes"))
    monkeypatch.setattr(bubblewrap, "forget_reads", lambda more: steps.append("reads"))
    monkeypatch.setattr(
        policy_process,
        "start_guest",
        lambda *words, **more: steps.append("guest") or start(*words, **more),
    )
    for name in ("Ride", "Ride", "LivesOn"):
        with policy(name) as attacker:
            roll_out(attacker, dict(SHORT), SEEDS)
    forgotten = ["pipes", "reads"]  # before the first, too: of the commands before, with its seal
    assert steps == [*forgotten, "guest", "guest", *forgotten, "guest"]


ODD = ["ride/ride", "best found", "a\x1b[2J", "r\u202ems", "x" * 50, "foo.npz", "os:path"]


def test_an_installed_policy_of_an_odd_name_or_one_of_ours_ends_no_comparison(
    monkeypatch, tmp_path
):
    alike = ["RRMS", "best_found", "Best-found"]
    write_policies(tmp_path, **dict.fromkeys(["mine", *alike, *ODD], "hostile.policies:Ride"))
    monkeypatch.syspath_prepend(str(tmp_path))
    rows = set()
    monkeypatch.setattr(comparison, "compare", lambda entries, *_, **__: rows.update(entries))
    result = CliRunner().invoke(app, ["policies", "--quick", "--isolation", "process"])
    assert rows >= {"mine", "rrms"} and not rows & {*alike, *ODD[1:], "foo", "path"}
    assert result.output.count("left out: the row of") == len(alike) + len(ODD)
    for name in alike:
        words = ["policies", "--quick", "--policy", name, "--isolation", "process"]
        result = CliRunner().invoke(app, words)
        assert isinstance(result.exception, ConfigError) and name in str(result.exception)


@pytest.mark.parametrize("name", ["best found", "ride/ride", "a\x1b[2J", "r\u202ems", "x" * 50])
def test_an_installed_policy_cannot_be_called_like_a_row_of_the_judge(name, monkeypatch, tmp_path):
    write_policies(tmp_path, **{name: "hostile.policies:Ride"})
    monkeypatch.syspath_prepend(str(tmp_path))
    assert metadata.entry_points(group="road_envs.policies", name=name)
    with pytest.raises(ConfigError, match="the name of a policy must be a letter"):
        PolicyProcess(name, limits=LIMITS)


@pytest.mark.parametrize(
    "reference",
    [
        *("rrms.npz", "best found.npz", "a\x1b[2J.npz", "x/learned.zip"),
        *("RRMS.npz", "best-found.npz", pytest.param("mine:rrms", marks=isolated)),
    ],
)
@pytest.mark.parametrize("option", ["policy", "reference"])
@pytest.mark.costly
def test_a_file_or_a_class_cannot_be_called_like_a_row_of_the_judge(option, reference):
    result = CliRunner().invoke(app, ["policies", "--quick", f"--{option}", reference])
    assert "would have the name" in str(result.exception) and "\x1b" not in str(result.exception)


def test_a_seal_that_a_policy_could_guess_is_refused():
    with pytest.raises(ConfigError, match="at least 16 characters"):
        public_drives(2, "season of 2027")
    assert len(public_drives(1, "a text of sixteen characters")) == 2
