"""One file and one line with its import add an estimator, a policy, a road family or a metric.

A road, a task or a board is one YAML file. Each is added to a copy of the tree and used there.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from leaderboard.evaluation.boards import BoardDefinition
from leaderboard.report.board_definitions import board_columns
from road_envs.core.config import ConfigError, build

ROOT = Path(__file__).parents[2]

ESTIMATOR = '''
"""Half the level road."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from road_envs.records.record import Estimate, profile_stations


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

from road_envs.policies.two_state import _TwoStateDamper


@dataclass(kw_only=True)
class Added(_TwoStateDamper):
    """Policy with high damping where -a e' > 0."""

    def law(self, v, a, e_dot):
        """Return the product."""
        return -a * e_dot
'''

ROAD = '''
"""A road that rises evenly."""

from dataclasses import dataclass

import numpy as np

from road_envs.core.config import Settings
from road_envs.roads.surface import Surface


@dataclass(frozen=True, kw_only=True)
class Added(Settings):
    """A ramp."""

    length: float = 20.0

    def realise(self, rng):
        """Return the ramp."""
        return Surface(np.tile(np.linspace(0.0, 0.1, 2001), (2, 1)), 0.01, name="ramp")
'''

METRIC = '''
"""Mean error."""

import numpy as np

from leaderboard.metrics.api import ScoredEstimate, metric


@metric("mean error", unit="mm", factor=1000.0, digits=1, better="zero", boards=("new_road",))
def added(scored: ScoredEstimate) -> float:
    """Mean error of both wheel paths."""
    return float(np.mean(scored.a - scored.y))
'''

BOARD = """
board:
  title: Mine
  ranks_by: crps
  columns: [crps, worst, r]
  on_request: [nrmse]
  divisions: [offline]
"""

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
        "from road_envs.policies.fixed import", '    "add": AccelerationDriven,\n',
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
    "metric": (
        "leaderboard/metrics/added.py", METRIC, "leaderboard/metrics/registry.py",
        "from leaderboard.metrics import ", "level, roughness, agreement, obstacles)",
        "from road_envs.records.record import Estimate, Profile\nimport numpy as np\n"
        "from leaderboard.metrics.api import ScoredEstimate\n"
        "from leaderboard.metrics.registry import SCORES, compute_scores\n"
        "from leaderboard.evaluation.boards import shipped_boards\n"
        "from leaderboard.report.board_definitions import board_columns\n"
        "s, z = np.arange(4000) * 0.025, np.random.default_rng(0).normal(size=(2, 4000))\n"
        "scored = ScoredEstimate(Profile(s, z), Estimate(s, z + 0.02), 4.0, bumps=False)\n"
        "x = compute_scores(scored)['added']\n"
        "(column,) = [c for c in board_columns('new_road', shipped_boards()['new_road'])\n"
        "             if c.key == 'added']\n"
        "print(SCORES['added'].format_value(x), column.unit, column.wide, column.help)",
        "+20.0 mm True Mean error of both wheel paths.",
    ),
}  # fmt: skip
"""File and text of the addition; its registry, the lines beside its import and its entry; a use of
it and what that prints.
"""


YAML_USES = {
    "road and task": (
        "from road_envs import load_road\nfrom leaderboard.evaluation.tasks import shipped_tasks\n"
        "print(load_road('mine').length, 'mine' in [t.name for t in shipped_tasks()])",
        "30.0 True",
    ),
    "board": (
        "from leaderboard.evaluation.tasks import load_task\n"
        "from leaderboard.report.board_definitions import board_columns\n"
        "from leaderboard.report.tables import board_views\n"
        "from leaderboard.running.board import Board\n"
        "tasks = [load_task(name) for name in ('my_board', 'new_road')]\n"
        "views = board_views(Board(tuple(tasks), {t.name: () for t in tasks}))\n"
        "view = views[-1]\n"
        "keys = [c.key for c in board_columns(view.board, view.definition) if not c.wide]\n"
        "print(len(views), view.board, view.definition.title, *keys, view.sections[0].task.name)",
        "2 my_board Mine rank crps worst r my_board",
    ),
}
"""A use of what one YAML file adds, and what that prints."""

PROGRAM = """
import contextlib, io, json, sys, traceback
printed = {}
for name, code in json.load(sys.stdin).items():
    with contextlib.redirect_stdout(io.StringIO()) as out:
        try:
            exec(code, {})
        except Exception:
            traceback.print_exc(file=out)
    printed[name] = out.getvalue().strip()
print(json.dumps(printed))
"""
"""Runs the uses one after the other: to import the packages takes longer than all of them."""


def add_to_registry(tree: Path, kind: str) -> None:
    """Write the file of an addition, and its two lines into the registry."""
    file, text, registry, import_before, entry_before, *_ = ADDITIONS[kind]
    (tree / file).write_text(text)
    path = tree / registry
    content = path.read_text()
    module = file.removesuffix(".py").replace("/", ".")
    package, _, name = module.rpartition(".")
    imported, entry = f"from {module} import Added\n", '"added": Added,\n'
    if kind == "metric":
        imported, entry = f"from {package} import {name}\n", "added,\n"
    indentation = entry_before[: len(entry_before) - len(entry_before.lstrip())]
    for before, line in [(import_before, imported), (entry_before, indentation + entry)]:
        assert content.count(before) == 1
        content = content.replace(before, line + before)
    path.write_text(content)


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """What each use prints in a copy of the packages and configurations with all additions."""
    tree = tmp_path_factory.mktemp("tree")
    for name in ("road_envs", "estimators", "leaderboard", "configs"):
        shutil.copytree(ROOT / name, tree / name)
    for kind in ADDITIONS:
        add_to_registry(tree, kind)
    (tree / "configs/roads/mine.yaml").write_text("kind: iso8608\nroad_class: B\nlength: 30.0\n")
    task = (tree / "configs/tasks/new_road.yaml").read_text()
    (tree / "configs/tasks/mine.yaml").write_text(task.replace("new_road\n", "mine\n", 1))
    lines = task.splitlines(keepends=True)
    kept = "".join(line for line in lines if not line.startswith(("board:", "name:")))
    (tree / "configs/tasks/my_board.yaml").write_text(f"name: my_board\n{kept}{BOARD}")
    uses = {name: code for name, (code, _) in YAML_USES.items()}
    uses |= {kind: code for kind, (*_, code, _) in ADDITIONS.items()}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=tree,
        env={**os.environ, "PYTHONPATH": str(tree)},
        input=json.dumps(uses),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("kind", ADDITIONS)
@pytest.mark.costly
def test_one_file_and_one_line_with_its_import_add_it(printed, kind):
    assert printed[kind] == ADDITIONS[kind][-1]


@pytest.mark.parametrize("name", YAML_USES)
def test_one_yaml_adds_it(printed, name):
    assert printed[name] == YAML_USES[name][1]


def test_a_board_with_an_unknown_column_is_refused():
    board = yaml.safe_load(BOARD.replace("worst", "worse"))["board"]
    with pytest.raises(ConfigError) as error:
        board_columns("mine", build(BoardDefinition, board, "mine"))
    message = "unknown column of the board mine: 'worse' (did you mean 'worst'?)"
    assert message in str(error.value)
