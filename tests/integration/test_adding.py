"""One file and one line with its import add an estimator, a policy or a road family.

A road or a task is one YAML file. Each is added to a copy of the tree, and used there by its name.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

ESTIMATOR = '''
"""Half the level road."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from road_envs.data.record import Estimate, profile_stations


@dataclass(frozen=True, kw_only=True)
class Added:
    """Zero heights."""

    causal: ClassVar[bool] = True

    def estimate(self, record, car):
        """Return zero heights."""
        s = profile_stations(record.length)
        return Estimate(s, np.zeros((2, s.size)))
'''

POLICY = '''
"""Groundhook with the opposite sign."""

from dataclasses import dataclass

from road_envs.policies.two_state import TwoStateDamper


@dataclass(kw_only=True)
class Added(TwoStateDamper):
    """Policy with high damping where -a e' > 0."""

    def law(self, v, a, e_dot):
        """Return the product."""
        return -a * e_dot
'''

ROAD = '''
"""A road that rises evenly."""

from dataclasses import dataclass

import numpy as np

from road_envs.config import Settings
from road_envs.roads.surface import Surface


@dataclass(frozen=True, kw_only=True)
class Added(Settings):
    """A ramp."""

    length: float = 20.0

    def realise(self, rng):
        """Return the ramp."""
        return Surface(np.tile(np.linspace(0.0, 0.1, 2001), (2, 1)), 0.01, name="ramp")
'''

ADDITIONS = {
    "estimator": (
        "estimators/baselines/added.py", ESTIMATOR, "estimators/registry.py",
        "from estimators.baselines.flat import", '    "flat": FlatEstimator,\n',
        "from road_envs import simulate_record\nfrom estimators import estimate\n"
        "r, _ = simulate_record('flat', speed_kmh=36, length=20.0)\n"
        "print(abs(estimate('added', r).z).max())",
        "0.0",
    ),
    "policy": (
        "road_envs/policies/added.py", POLICY, "road_envs/policies/__init__.py",
        "from road_envs.policies.dqn import", '    "add": AccelerationDriven,\n',
        "from road_envs import policies\nprint(type(policies.create('added')).__name__)",
        "Added",
    ),
    "road family": (
        "road_envs/roads/added.py", ROAD, "road_envs/roads/__init__.py",
        "from road_envs.roads.belgian import", '        "belgian": Belgian,\n',
        "from road_envs import load_road\nimport numpy as np\n"
        "print(load_road({'kind': 'added'}).realise(np.random.default_rng(0)).z.max())",
        "0.1",
    ),
}  # fmt: skip
"""File and text of the addition; its registry, the lines beside its import and its entry; a use of
it and what that prints.
"""


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """A copy of the packages and configurations."""
    folder = tmp_path_factory.mktemp("tree")
    for name in ("road_envs", "estimators", "leaderboard", "configs"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


def output(tree: Path, code: str) -> str:
    """Return what Python prints of `code`, with the packages of `tree`."""
    environment = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tree, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("kind", ADDITIONS)
def test_one_file_and_one_line_with_its_import_add_it(tree, kind):
    file, text, registry, import_before, entry_before, code, expected = ADDITIONS[kind]
    (tree / file).write_text(text)
    path = tree / registry
    content = path.read_text()
    module = file.removesuffix(".py").replace("/", ".")
    entry = entry_before[: entry_before.index('"')] + '"added": Added,\n'
    for before, line in [
        (import_before, f"from {module} import Added\n"),
        (entry_before, entry),
    ]:
        assert content.count(before) == 1
        content = content.replace(before, line + before)
    path.write_text(content)
    assert output(tree, code) == expected


def test_one_yaml_adds_a_road_and_a_task(tree):
    (tree / "configs/roads/mine.yaml").write_text("kind: iso8608\nroad_class: B\nlength: 30.0\n")
    task = (tree / "configs/tasks/new_road.yaml").read_text().replace("new_road\n", "mine\n", 1)
    (tree / "configs/tasks/mine.yaml").write_text(task)
    code = (
        "from road_envs import load_road\nfrom leaderboard.evaluation.tasks import shipped_tasks\n"
        "print(load_road('mine').length, 'mine' in [t.name for t in shipped_tasks()])"
    )
    assert output(tree, code) == "30.0 True"
