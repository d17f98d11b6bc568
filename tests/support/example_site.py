"""A board of short drives with results of every kind, and its site."""

import re
from functools import cache
from pathlib import Path

import numpy as np
from fake_estimators import Broken, Learner, Reader
from fakes import baselines, fake_drives, task

from leaderboard.evaluation.evaluate import run_task
from leaderboard.report.sentences import build_report
from leaderboard.report.site import _render_pages, write_site
from leaderboard.report.tables import board_views
from leaderboard.running.board import Board
from road_envs.records.record import Estimate

POLICIES = Path(__file__).parents[2] / "docs" / "policies"
ENTRIES = ("static_lm", "reader", "online", "broken")


class Online(Reader):
    causal = True

    def estimate(self, record, car):
        found = super().estimate(record, car)
        return Estimate(found.s, found.z, np.full_like(found.z, 0.003))


def tasks():
    return [
        task(
            "held_out",
            test={
                "roads": ["iso_d", "iso_c"],
                "seeds": [11, 12, 13, 14, 15],  # intervals and ranks need five roads of a family
                "length": 40.0,
                "families": ["rough", "smooth"],
            },
        ),
        task(
            "paving",
            title="Paving & <cobbles>",
            board="paper",
            conditions=[{"mode": "ride", "speed_kmh": 14.5}],
            training={"roads": ["belgian_training"], "seeds": [1]},
            test={"roads": ["belgian"], "seeds": [11]},
            trains_on_test_road=True,
            claimed_level_error=0.102,
        ),
        task(
            "blocks",
            board="paper",
            conditions=[{"mode": "ride", "speed_kmh": 14.5}],
            training={"roads": ["bump_asymmetric_training_pp"], "seeds": [1]},
            test={"roads": ["bump_asymmetric"], "seeds": [11]},
            trains_on_test_road=True,
            bumps=True,
        ),
    ]


@cache
def results():
    """Return results of every kind on each task; the learner replaces the network."""
    entries = dict(
        zip(ENTRIES, (Learner(), Reader(), Online(gain=0.7), Broken(how="raises")), strict=True)
    )
    return {
        t.name: tuple(run_task(t, {**entries, **baselines()}, (1, 2, 3), simulate=fake_drives))
        for t in tasks()
    }


def board():
    return Board(tuple(tasks()), results())


@cache
def report():
    return build_report(board())


@cache
def site():
    return dict(_render_pages(board(), report()))


def built(made, folder):
    """Build the site of a board in a folder and return its index."""
    return write_site(made, build_report(made), folder)


def text_of(html):
    html = re.sub(r"<(style|script).*?</\1>|<[^>]*>", " ", html, flags=re.S)
    return " ".join(html.split())


@cache
def lines_of(name="held_out"):
    sections = [s for view in board_views(board()) for s in view.sections]
    return {line.name: line for s in sections if s.task.name == name for line in s.rows}
