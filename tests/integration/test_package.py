"""The built wheel, installed in an environment without the checkout, runs a task."""

import json
import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest
from fakes import SHORT_TASK

pytestmark = pytest.mark.processes
ROOT = Path(__file__).parents[2]


def run(*command, cwd, **environment):
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """`bin` and package folder of an environment with the wheel; dependencies by a path file."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")
    run(*pip, "wheel", ROOT, "--no-deps", "--no-build-isolation", "-w", folder, cwd=folder)
    (wheel,) = folder.glob("road_envs-*.whl")
    home = folder / "environment"
    venv.create(home, with_pip=False)
    ask = "import sysconfig; print(sysconfig.get_path('purelib'))"
    inside = Path(run(home / "bin/python", "-c", ask, cwd=folder).strip())
    run(*pip, "--python", home / "bin/python", "install", "--no-deps", wheel, cwd=folder)
    # path files in that folder are not read, so the editable checkout is not importable
    (inside / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return home / "bin", inside


def test_the_wheel_contains_the_configurations_and_no_tests(installed):
    _, inside = installed
    assert (inside / "road_envs/configs/vehicles/land_rover_defender_110.yaml").is_file()
    assert not (inside / "tests").exists() and not (inside / "configs").exists()


def test_the_installed_wheel_runs_a_leaderboard_task_in_another_folder(installed, tmp_path):
    bin_folder, inside = installed
    where = run(
        bin_folder / "python", "-c", "import road_envs; print(road_envs.__file__)", cwd=tmp_path
    )
    assert Path(where.strip()).is_relative_to(inside)
    (tmp_path / "short.yaml").write_text(SHORT_TASK)
    run(
        bin_folder / "road-recon", "leaderboard", "--task", "short.yaml", "--estimator",
        "fir_ridge", "--seeds", "1", "--workers", "1", "--out", "board", cwd=tmp_path,
    )  # fmt: skip
    result = json.loads((tmp_path / "board/results/short/fir_ridge.json").read_text())
    assert result["failure"] is None
    assert (tmp_path / "board/index.html").is_file()
