"""Artifacts: identity, header, reading and refusing; caches that are made again."""

import json
import os

import pytest

from leaderboard.evaluation.task_files import digest_of
from leaderboard.running.jobs import run_job_file
from leaderboard.submission import hidden_seeds, signature
from road_envs.core import artifacts, code_digest
from road_envs.core.artifacts import Kind, NewerFormatError
from road_envs.core.code_digest import ROOT
from road_envs.core.config import ConfigError, read_yaml
from road_envs.core.reading import read_npz
from road_envs.roads.measured import Measured

KIND = Kind("weighing", 2)


def test_a_content_is_equal_after_writing_and_reading(tmp_path):
    path = tmp_path / "deep" / "a.json"
    KIND.write(path, {"mass": 3.5, "broken": float("nan"), "parts": {"a": [1, 2]}}, "me")
    data, checksum = KIND.read(path)
    assert data == {"identity": "me", "mass": 3.5, "broken": None, "parts": {"a": [1, 2]}}
    assert json.loads(path.read_text())["sha256"] == checksum


def test_the_identity_changes_with_kind_format_inputs_code_and_files(tmp_path):
    file = tmp_path / "input.csv"
    file.write_text("1")
    kinds = [
        KIND,
        Kind("weighing", 3),
        Kind("counting", 2),
        Kind("weighing", 2, ("road_envs.core.config",)),
        Kind("weighing", 2, ("road_envs.core.units",)),
    ]
    found = [kind.identity("bolt") for kind in kinds[:4]]
    found += [KIND.identity("nut"), KIND.identity("bolt", 1), KIND.identity("bolt", files=[file])]
    file.write_text("2")
    found.append(KIND.identity("bolt", files=[file]))
    assert len(set(found)) == len(found) == 8
    assert KIND.identity({"a": 1, "b": 2}) == KIND.identity({"b": 2, "a": 1})


INVALID = [
    (lambda text: text[:40], "damaged, not valid JSON"),
    (lambda text: "[" * 100_000, "damaged, not valid JSON"),
    (lambda text: "{}", "not a weighing (it has no format)"),
    (lambda text: text.replace("weighing", "counting"), "its kind is 'counting'"),
    (lambda text: text.replace('"format": 2', '"format": 1'), "written in format 1"),
    (lambda text: text.replace("3.5", "4.5"), "modified since it was written"),
    (lambda text: json.dumps(json.loads(text)), "does not begin with its checksum"),
]


@pytest.mark.parametrize(("change", "message"), INVALID)
def test_an_invalid_file_is_refused_with_its_name_and_found_by_nobody(tmp_path, change, message):
    path = tmp_path / "a.json"
    KIND.write(path, {"mass": 3.5}, "me")
    assert KIND.find(path, "me", dict) == {"mass": 3.5} and KIND.find(path, "you", dict) is None
    path.write_text(change(path.read_text()))
    with pytest.raises(ConfigError) as error:
        KIND.read(path)
    assert str(path) in str(error.value) and message in str(error.value)
    assert KIND.find(path, "me", dict) is None


def read_signature(path):
    pytest.importorskip("cryptography")
    return signature.verify(path.parent)


def read_key(path):
    pytest.importorskip("cryptography")
    return signature.signer(path)


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("kept.json", KIND.read),
        ("job.json", lambda path: list(run_job_file(path, path.parent))),
        (signature.FILE, read_signature),
        ("key.pem", read_key),
        (hidden_seeds.COMMITMENT, lambda path: hidden_seeds.load(path.parent)),
        ("road.yaml", read_yaml),
        ("road.csv", lambda path: digest_of(str(path))),
        ("road.erd", lambda path: Measured(path=str(path)).realise(None)),
        ("weights.npz", read_npz),
    ],
)
def test_of_what_has_no_end_nothing_is_read(tmp_path, name, read):
    """A pipe in the place of a row would let a page wait for ever; this device has an end."""
    (tmp_path / name).symlink_to(os.devnull)
    with pytest.raises((ConfigError, OSError), match="not a regular file"):
        read(tmp_path / name)
    os.mkfifo(tmp_path / "pipe.json")
    assert artifacts.clean(tmp_path) == []


def test_a_newer_format_is_an_error_of_its_own(tmp_path):
    Kind("weighing", 9).write(tmp_path / "a.json", {})
    with pytest.raises(NewerFormatError, match="format 9 by a newer version, this version reads 2"):
        KIND.read(tmp_path / "a.json")


def test_a_key_of_the_header_is_refused_in_the_content():
    with pytest.raises(ValueError, match="format is a key of the header"):
        KIND.to_text({"format": 3})


def test_a_cache_computes_once_and_again_after_damage_or_another_identity(tmp_path):
    asked = []

    def compute():
        asked.append(1)
        return {"mass": 1.5}

    def weigh(identity):
        return KIND.find_or_make(tmp_path, identity, compute, lambda data: data["mass"])

    assert [weigh("a"), weigh("a"), weigh("b"), weigh("b")] == [1.5] * 4 and len(asked) == 2
    (tmp_path / "weighing" / "a.json").write_text("{}")
    assert weigh("a") == 1.5 and len(asked) == 3


def test_a_cache_that_cannot_be_written_still_computes(tmp_path):
    (tmp_path / "weighing").write_text("a file where the folder should be")
    assert KIND.find_or_make(tmp_path, "a", lambda: {"mass": 1}, lambda data: data["mass"]) == 1


def test_content_of_another_shape_is_not_found(tmp_path):
    KIND.write(tmp_path / "a.json", {"weight": 1}, "me")
    assert KIND.find(tmp_path / "a.json", "me", lambda data: data["mass"]) is None


def test_clean_deletes_what_other_code_has_made_and_nothing_else(tmp_path, monkeypatch):
    today = Kind("weighing", 2, ("road_envs.core.config",))
    today.write(tmp_path / "today.json", {"mass": 1})
    KIND.write(tmp_path / "without_code.json", {"mass": 1})
    (tmp_path / "foreign.json").write_text('{"made_by": ["0", "road_envs.core.config"]}')
    with monkeypatch.context() as patch:
        patch.setattr(artifacts, "code_version", lambda *modules: "before")
        today.write(tmp_path / "deep" / "stale.json", {"mass": 1})
        today.write(tmp_path / "damaged.json", {"mass": 1})
    (tmp_path / "damaged.json").write_text((tmp_path / "damaged.json").read_text()[:-5])
    stale = tmp_path / "deep" / "stale.json"
    assert artifacts.clean(tmp_path, delete=False) == [stale] and stale.exists()
    assert artifacts.clean(tmp_path) == [stale] and not stale.exists()
    left = {path.name for path in tmp_path.rglob("*.json")}
    assert left == {"today.json", "without_code.json", "foreign.json", "damaged.json"}


@pytest.mark.parametrize(
    ("name", "decides"),
    [("atomic_io", False), ("code_digest", False), ("artifacts", True), ("reading", True)],
)
def test_a_change_of_what_writes_and_recognises_files_makes_nothing_stale(
    name, decides, monkeypatch
):
    version, parse = artifacts.code_version.__wrapped__, code_digest._source
    before, changed = version("road_envs.core.artifacts"), ROOT / f"road_envs/core/{name}.py"
    assert changed in code_digest.closure("road_envs.core.artifacts")
    other = code_digest._Source("0" * 16, ())
    monkeypatch.setattr(
        code_digest, "_source", lambda path: other if path == changed else parse(path)
    )
    assert (version("road_envs.core.artifacts") != before) is decides
    assert all(path.is_file() for path in artifacts.KEEPERS)


def test_a_file_of_somebody_else_is_no_artifact(tmp_path):
    made_by = ["0", "road_envs.core.config"]
    (tmp_path / "a.json").write_text(json.dumps({"sha256": "0", "made_by": made_by}))
    (tmp_path / "b.json").write_bytes(b"\xff\xfe")
    assert artifacts.clean(tmp_path) == [] and artifacts.code_version() == ""
