"""Template package of an estimator: written, tested, built, installed, evaluated."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from leaderboard.cli import app
from leaderboard.conformance.scaffold import write_package
from leaderboard.evaluation.store import load
from road_envs.config import ConfigError

ROOT = Path(__file__).parents[2]


def run(*command, cwd, path):
    done = subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_template_package_installs_and_gets_a_row_on_the_board(tmp_path):
    folder = tmp_path / "mine"
    write_package("double_twice", folder)
    code = (folder / "road_recon_double_twice/estimator.py").read_text()
    assert len(code.splitlines()) < 80
    tested = run("-m", "pytest", "-q", "-p", "no:cacheprovider", cwd=folder, path=[folder, ROOT])
    assert "3 passed" in tested
    pip = ("-m", "pip", "--disable-pip-version-check", "--quiet")
    run(*pip, "wheel", folder, "--no-deps", "--no-build-isolation", "-w", tmp_path,
        cwd=tmp_path, path=[])  # fmt: skip
    (wheel,) = tmp_path.glob("road_recon_double_twice-*.whl")
    target = tmp_path / "target"
    run(*pip, "install", "--no-deps", "--target", target, wheel, cwd=tmp_path, path=[])
    path = [target, ROOT]
    output = run(
        "-m", "leaderboard.cli", "check-estimator", "double_twice", cwd=tmp_path, path=path
    )
    assert "double_twice: ready for a board" in output
    run(
        "-m", "leaderboard.cli", "leaderboard", "--task", "paper_5", "--estimator", "double_twice",
        "--seeds", "1", "--out", "board", cwd=tmp_path, path=path,
    )  # fmt: skip
    row = load(tmp_path / "board/results/paper_5/double_twice.json")
    assert row.failure is None and row.estimator == "double_twice"
    assert (row.drives[0].scores["nrmse"] or 0.0) > 0.0
    assert "double_twice" in (tmp_path / "board/index.html").read_text()


@pytest.mark.parametrize(
    ("example", "check"),
    [
        ("learner", ("check-estimator", "road_recon_mine.estimator:Mine")),
        ("policy", ("check-policy", "road_recon_mine.policy:Mine", "--isolation", "process")),
    ],
)
def test_the_templates_of_a_learner_and_of_a_policy_pass_their_tests_and_checks(
    tmp_path, example, check
):
    write_package("mine", tmp_path / "package", example)
    path = [tmp_path / "package", ROOT]
    tested = run("-m", "pytest", "-q", "-p", "no:cacheprovider", cwd=path[0], path=path)
    assert "3 passed" in tested
    printed = run("-m", "leaderboard.cli", *check, cwd=tmp_path, path=path)
    assert "ready" in printed and "FAILED" not in printed
    if example == "learner":
        (error,) = re.findall(r"in-band\s+error\s+([\d.]+)", " ".join(printed.split()))
        assert float(error) < 0.9  # a flat estimate has 1


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("My-Road", "'My-Road' cannot be the name of an estimator: use lower-case letters"),
        ("class", "'class' cannot be the name of an estimator"),
        ("flat", "the name 'flat' is taken by an installed estimator"),
    ],
)
def test_an_invalid_name_is_refused_and_nothing_is_written(tmp_path, name, sentence):
    with pytest.raises(ConfigError, match=sentence):
        write_package(name, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_name_is_taken_by_its_own_kind_only(tmp_path):
    with pytest.raises(ConfigError, match="the name 'skyhook' is taken by an installed policy"):
        write_package("skyhook", tmp_path / "new", "policy")
    assert write_package("flat", tmp_path / "new", "policy")


def test_a_folder_with_files_is_refused_and_unchanged(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match="is not empty; choose a new or empty folder"):
        write_package("my_road", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_new_estimator_prints_the_next_commands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    output = CliRunner().invoke(app, ["new-estimator", "my_road"]).stdout
    assert 'pip install --editable "./road-recon-my-road[test]"\n' in output
    assert "python -m pytest ./road-recon-my-road\n" in output
    assert "road-recon check-estimator my_road\n" in output
    readme = (tmp_path / "road-recon-my-road" / "README.md").read_text()
    assert "road-recon check-estimator my_road" in readme and "{" not in readme
