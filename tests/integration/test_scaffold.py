"""Template package of an estimator: written, tested, built, installed, evaluated."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from fake_results import runs_of
from fakes import SHORT_TASK
from typer.testing import CliRunner

from leaderboard.cli import app
from leaderboard.commands.new import _write_package
from leaderboard.evaluation.store import load
from road_envs.core.config import ConfigError

ROOT = Path(__file__).parents[2]


EXAMPLES = {"estimator": "double_twice", "learner": "learn_it", "policy": "firm_in_corners"}
"""A name of the package of each example."""


def run(*command, cwd, path=()):
    done = subprocess.run(
        [sys.executable, "-m", *map(str, command)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    """Folder with a package of each example, by its name."""
    folder = tmp_path_factory.mktemp("packages")
    for example, name in EXAMPLES.items():
        _write_package(name, folder / example, example)
    return folder


@pytest.mark.costly
def test_the_tests_of_all_packages_pass(packages):
    folders = [packages / example for example in EXAMPLES]
    options = ("-q", "-p", "no:cacheprovider", "--import-mode=importlib")
    tested = run("pytest", *options, *folders, cwd=packages, path=[*folders, ROOT])
    assert "9 passed" in tested


@pytest.mark.processes
def test_the_template_package_installs_and_gets_a_row_on_the_board(
    packages, tmp_path, monkeypatch, road_recon
):
    folder, target = packages / "estimator", tmp_path / "target"
    code = (folder / "road_recon_double_twice/estimator.py").read_text()
    assert len(code.splitlines()) < 80
    pip = ("pip", "--disable-pip-version-check", "--quiet")
    options = ("--no-deps", "--no-build-isolation", "--no-compile", "--target", target)
    run(*pip, "install", *options, folder, cwd=tmp_path)  # builds a wheel first
    monkeypatch.syspath_prepend(str(target))
    code, out, err = road_recon("check-estimator", "double_twice")
    assert code == 0 and "double_twice: ready for a board" in out, err
    (tmp_path / "short.yaml").write_text(SHORT_TASK)
    words = ("--task", "short.yaml", "--estimator", "double_twice", "--seeds", 1, "--workers", 1)
    code, _, err = road_recon("leaderboard", *words, "--out", "board")
    assert code == 0, err
    row = load(tmp_path / "board/results/short/double_twice.json")
    assert row.failure is None and row.estimator == "double_twice"
    assert next(iter(runs_of(row).values()))["nrmse"] > 0.0
    assert "double_twice" in (tmp_path / "board/index.html").read_text()


@pytest.mark.parametrize(
    ("example", "check"),
    [
        pytest.param(
            "learner",
            ("check-estimator", "road_recon_learn_it.estimator:LearnIt"),
            marks=pytest.mark.processes,
        ),
        ("policy", ("check-policy", "road_recon_firm_in_corners.policy:FirmInCorners")),
    ],
)
@pytest.mark.costly
def test_the_templates_of_a_learner_and_of_a_policy_pass_the_checks(
    packages, monkeypatch, road_recon, example, check
):
    monkeypatch.syspath_prepend(str(packages / example))
    isolation = ("--isolation", "process") if example == "policy" else ()
    code, printed, err = road_recon(*check, *isolation)
    assert code == 0 and "ready" in printed and "FAILED" not in printed, err
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
        _write_package(name, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_name_is_taken_by_its_own_kind_only(tmp_path):
    with pytest.raises(ConfigError, match="the name 'skyhook' is taken by an installed policy"):
        _write_package("skyhook", tmp_path / "new", "policy")
    assert _write_package("flat", tmp_path / "new", "policy")


def test_a_folder_with_files_is_refused_and_unchanged(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match="is not empty; choose a new or empty folder"):
        _write_package("my_road", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_new_estimator_prints_the_next_commands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    output = CliRunner().invoke(app, ["new-estimator", "my_road"]).stdout
    assert 'pip install --editable "./road-recon-my-road[test]"\n' in output
    assert "python -m pytest ./road-recon-my-road\n" in output
    assert "road-recon check-estimator my_road\n" in output
    readme = (tmp_path / "road-recon-my-road" / "README.md").read_text()
    assert "road-recon check-estimator my_road" in readme and "{" not in readme


def test_a_new_vehicle_is_written_and_drives(road_recon):
    values = ("--class", "saloon", "--mass", "1500", "--wheelbase", "2.7", "--track", "1.55")
    code, out, err = road_recon("new-vehicle", "mine.yaml", *values)
    assert code == 0, err
    assert "mine.yaml" in out
    code, _, err = road_recon("new-vehicle", "mine.yaml", *values)
    assert code == 2
    assert "mine.yaml exists" in err
    code, _, err = road_recon("new-vehicle", "mine", *values)
    assert code == 2 and "mine: the name must end in .yaml or .yml" in err
    drive = ("--vehicle", "mine.yaml", "--road", "iso_c", "--length", "20", "--speed-kmh", "36")
    code, _, err = road_recon("simulate", *drive, "--out", "d.csv")
    assert code == 0, err
