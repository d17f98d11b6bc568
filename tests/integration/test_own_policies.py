"""Policies of other people: by class, by file, in a process of their own, checked and compared."""

import dataclasses
import json
import socket
import sys
from pathlib import Path

import numpy as np
import pytest
from bad_policies import Lateral

from leaderboard.commands import policies
from leaderboard.entries.entry_files import CLASS_FOLDER
from leaderboard.policies import policy_checks
from leaderboard.policies.policy_checks import OPTIONS, SEEDS, check_policy
from leaderboard.policies.policy_process import POLICY_LIMITS, PolicyProcess
from leaderboard.sandbox import bubblewrap
from road_envs.core.config import ConfigError
from road_envs.policies import make_policy
from road_envs.policies.api import PolicyError
from road_envs.policies.rollout import roll_out

SUPPORT = Path(__file__).parents[1] / "support"
LEARNED = Path(__file__).parents[2] / "configs/policies/learned.npz"
SPY = """
import os, socket
from dataclasses import dataclass

@dataclass
class Spy:
    def reset(self, context):
        found = [path for path in ({secret!r}, {keys!r}) if os.path.exists(path)]
        try:
            open("/entry/new.py", "w").close()
            found.append("writes to its code")
        except OSError:
            pass
        try:
            socket.create_connection(("127.0.0.1", {port}), 1.0)
            found.append("network of the host")
        except OSError:
            pass
        raise ValueError(f"found {{found}}, user {{os.getuid()}}, code {{os.listdir('/entry')}}")

    def act(self, observations):
        return [0] * len(observations)
"""
SHORT = {**OPTIONS, "length": 10.0}
LIMITS = dataclasses.replace(POLICY_LIMITS, seconds=5.0, memory=1.5)


@pytest.fixture(autouse=True)
def _short_roads(monkeypatch):
    monkeypatch.setitem(policy_checks.OPTIONS, "length", 10.0)


def drive(reference, limits=LIMITS, seeds=SEEDS):
    with PolicyProcess(f"bad_policies:{reference}", limits=limits) as policy:
        return roll_out(policy, dict(SHORT), seeds).actions


@pytest.mark.costly
def test_a_policy_in_a_process_acts_as_it_does_here():
    np.testing.assert_array_equal(drive("Lateral"), roll_out(Lateral(), dict(SHORT), SEEDS).actions)
    np.testing.assert_array_equal(drive("Prints"), drive("Lateral"))


@pytest.mark.parametrize(
    ("reference", "sentence"),
    [
        ("Endless", "stopped after 2 s, the time limit"),
        pytest.param("Greedy", "MemoryError", marks=pytest.mark.processes),
        ("Leaves", "its process ended without a response, by exit status 3"),
        ("Floats", "act must return whole numbers, got float64"),
        pytest.param(
            "TooMany", "act must return 4 actions, one per vehicle", marks=pytest.mark.processes
        ),
        ("Beyond", "actions must be 0 to 15, got 99"),
        pytest.param(
            "Nowhere", "the policy bad_policies:Nowhere cannot be used", marks=pytest.mark.processes
        ),
    ],
)
@pytest.mark.costly
def test_a_policy_beyond_its_limits_ends_in_a_sentence(reference, sentence):
    with pytest.raises(PolicyError, match=sentence):
        drive(reference, dataclasses.replace(POLICY_LIMITS, seconds=2.0, memory=1.5))


@pytest.mark.costly
def test_a_process_that_failed_is_replaced_at_the_next_episode():
    with PolicyProcess("bad_policies:Leaves", limits=LIMITS) as policy:
        for _ in range(2):
            with pytest.raises(PolicyError, match="exit status 3"):
                roll_out(policy, dict(SHORT), SEEDS)


def test_a_policy_that_has_raised_is_made_anew_in_its_process():
    processes = set()
    with PolicyProcess("bad_policies:Raises", limits=LIMITS) as policy:
        for _ in range(2):
            with pytest.raises(PolicyError, match="ValueError: episode 1"):
                roll_out(policy, dict(SHORT), SEEDS)
            processes.add(policy._guest.pid)
    assert len(processes) == 1


def verdicts(name):
    return {r.name: r.passed for r in check_policy(f"bad_policies:{name}")}


@pytest.mark.parametrize(
    ("name", "failed"),
    [
        ("Remembers", ["reset"]),
        pytest.param("Chance", ["repeat", "reset"], marks=pytest.mark.processes),
        ("Beyond", ["runs"]),
    ],
)
@pytest.mark.costly
def test_each_fault_fails_its_check(name, failed):
    assert [check for check, passed in verdicts(name).items() if passed is False] == failed


@pytest.mark.costly
def test_a_sound_policy_passes_and_what_it_refuses_is_noted():
    found = verdicts("Lateral")
    assert not [check for check, passed in found.items() if passed is False]
    assert found["observations"] is None and found["actions"] is None and found["vehicles"]
    assert verdicts("Crowd")["vehicles"] is None


@pytest.mark.costly
@pytest.mark.parametrize(
    "name",
    [
        "skyhook",
        pytest.param("learned", marks=pytest.mark.processes),
        pytest.param("greedy_information", marks=pytest.mark.slow),
    ],
)
def test_policies_of_this_package_pass(name):
    failed = [r for r in check_policy(name) if r.passed is False]
    assert not failed


@pytest.mark.costly
def test_check_policy_refuses_foreign_code_until_it_is_trusted(road_recon, monkeypatch):
    monkeypatch.syspath_prepend(str(SUPPORT))
    monkeypatch.setattr(bubblewrap, "obstacle", lambda: "bubblewrap is not installed")
    code, out, err = road_recon("check-policy", "bad_policies:Lateral")
    assert code == 2 and out == "" and "bubblewrap is not installed" in err
    assert "give --isolation process if you trust its code" in err
    code, out, _ = road_recon(
        "check-policy", "bad_policies:Remembers", "--isolation", "process", "--json"
    )
    assert code == 1 and not json.loads(out)["passed"]


@pytest.mark.costly
def test_policies_compares_a_class_and_a_file_beside_shipped_ones(
    road_recon, tmp_path, monkeypatch
):
    monkeypatch.syspath_prepend(str(SUPPORT))
    (tmp_path / "mine.npz").write_bytes(LEARNED.read_bytes())
    words = ("--policy", "fixed_ride", "--policy", "mine.npz", "--policy", "bad_policies:Chance")
    code, out, _ = road_recon(
        "policies", *words, "--quick", "--isolation", "process", "--json", "--out", "out"
    )
    rows = {row["policy"]: row for row in json.loads(out)["rows"]}
    assert code == 0 and set(rows) == {"fixed_ride", "mine", "Chance", "rrms"}
    assert all(row["failure"] is None for row in rows.values())
    page = (tmp_path / "out/policies.html").read_text()
    assert all(name in page for name in rows)
    (note,) = json.loads(out)["notes"]
    assert note.startswith("These drives are public: mine, Chance may have been trained on them, ")
    assert "or play back what was found for them beforehand" in note and note in page
    assert (tmp_path / "out/benchmark.txt").read_text().endswith(f"{note}\n")


def test_a_reader_is_told_what_policies_of_others_may_know_and_what_a_file_lacks():
    notes = policies._notes
    assert notes(["rrms", "ride/handling"], ["rrms"], None) == []
    (note,) = notes(["rrms", "installed"], [], None)
    assert "installed may have been trained on them, or play back" in note
    assert notes(["rrms", "mine"], ["rrms", "a/mine.npz"], "a text of 16 letters") == []
    (note,) = notes(["mine"], ["a/mine.zip"], "a text of 16 letters")
    assert note.startswith("mine: the file holds no statistics of VecNormalize")
    assert "no masks of actions; the network gets the features as they are, may choose each" in note
    assert (
        "action, and is asked for one in each control interval, whatever its action_repeat" in note
    )


def test_a_reference_of_another_file_is_not_taken_for_a_policy_of_its_name(road_recon, tmp_path):
    for folder in "ab":
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.npz").write_bytes(LEARNED.read_bytes())
    said = "two policies have the name 'mine': give each of them once"
    words = ("--policy", "a/mine.npz", "--reference", "b/mine.npz")
    code, _, err = road_recon("policies", *words, "--quick")
    assert code == 2 and said in " ".join(err.split())


def test_of_all_policies_only_constant_pairs_of_this_package_are_left_out(road_recon, monkeypatch):
    def compare(entries, *_, **__):
        raise ConfigError(f"compared: {' '.join(entries)}")

    known = policies.names()
    monkeypatch.setattr(policies, "names", lambda: (*known, "fixed_gain"))
    monkeypatch.setattr(policies, "runs_foreign_code", lambda reference: False)
    monkeypatch.setattr(policies, "make_policy", lambda reference: reference)
    monkeypatch.setattr(policies.comparison, "compare", compare)
    code, _, err = road_recon("policies", "--quick", "--isolation", "process")
    assert code and "fixed_gain" in err and "rrms" in err and "fixed_ride" not in err


@pytest.mark.costly
@pytest.mark.skipif(bubblewrap.obstacle() is not None, reason="bubblewrap cannot be used here")
def test_a_policy_inside_bubblewrap_sees_its_code_and_nothing_else(tmp_path, monkeypatch):
    (tmp_path / "secret.txt").write_text("seeds")
    limits = dataclasses.replace(POLICY_LIMITS, seconds=30.0, isolation="bubblewrap")
    with socket.create_server(("127.0.0.1", 0)) as server:
        secret, port = str(tmp_path / "secret.txt"), server.getsockname()[1]
        keys = str(Path.home() / ".ssh")
        (tmp_path / "spy.py").write_text(SPY.format(secret=secret, keys=keys, port=port))
        monkeypatch.syspath_prepend(str(tmp_path))
        with (
            PolicyProcess("spy:Spy", limits=limits) as policy,
            pytest.raises(PolicyError, match=r"found \[\], user [1-9][0-9]{4,}, code \['spy.py'\]"),
        ):
            roll_out(policy, dict(SHORT), SEEDS)
    monkeypatch.syspath_prepend(str(SUPPORT))
    with PolicyProcess("bad_policies:Lateral", limits=limits) as policy:
        actions = roll_out(policy, dict(SHORT), SEEDS).actions
    np.testing.assert_array_equal(actions, roll_out(Lateral(), dict(SHORT), SEEDS).actions)


@pytest.mark.costly
@pytest.mark.parametrize("isolation", ["process", "bubblewrap"])
def test_a_policy_is_the_same_program_in_both_isolations(tmp_path, monkeypatch, isolation):
    """A copy of its package, or of its module: what lies beside that is missing in both."""
    if isolation == "bubblewrap" and (reason := bubblewrap.obstacle()):
        pytest.skip(reason)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*sys.path])
    monkeypatch.setenv(CLASS_FOLDER, "")
    (tmp_path / "zz_policies").mkdir()
    for place in ("zz_gain.py", "zz_policies/gain.py"):
        (tmp_path / place).write_text("GAIN = 2.0")
    constant = "from road_envs.policies.fixed import FixedPair"
    (tmp_path / "zz_alone.py").write_text(f"import zz_gain\n{constant}")
    (tmp_path / "zz_policies" / "__init__.py").write_text(f"from .gain import GAIN\n{constant}")
    limits = dataclasses.replace(LIMITS, seconds=30.0, isolation=isolation)

    def driven(reference):
        assert policies.policy_isolation(reference, isolation) == isolation
        with PolicyProcess(reference, limits=limits) as policy:
            return roll_out(policy, dict(SHORT), SEEDS[:1]).actions

    assert driven("zz_policies:FixedPair").size
    with pytest.raises(PolicyError, match="zz_alone:FixedPair cannot be used: No module named 'zz"):
        driven("zz_alone:FixedPair")


@pytest.mark.parametrize(
    ("reference", "sentence"),
    [
        ("mine.npz", "mine.npz: there is no such file"),
        ("nowhere:Mine", "No module named 'nowhere'"),
        ("bad_policies:np", "it must be a dataclass of settings"),
        ("skihook", "did you mean 'skyhook'"),
    ],
)
def test_a_reference_to_no_policy_is_one_sentence(reference, sentence):
    with pytest.raises(ConfigError, match=sentence):
        make_policy(reference)
