"""Cost against work: slopes, and that of a board's tables and pages by counts of function calls."""

import sys

import numpy as np
import pytest
from fake_estimators import Reader
from fakes import fake_drives, task

from leaderboard.evaluation.evaluate import run_task
from studies import scaling

SMALL = task(conditions=[{"mode": "ride", "speed_kmh": 54.0}], bound=False)


def calls_and_bytes(out, result, n):
    """Return the number of function calls that tables and site of `n` rows take, and its size."""
    scaling.store_rows(SMALL, result, n, out)
    calls = [0]

    def count(frame, event, argument):
        calls[0] += event in ("call", "c_call")

    sys.setprofile(count)
    try:
        scaling.write_board(SMALL, out)
    finally:
        sys.setprofile(None)
    return calls[0], sum(path.stat().st_size for path in out.rglob("*.html"))


@pytest.mark.costly
def test_tables_and_pages_grow_in_proportion_to_the_rows(tmp_path):
    (result,) = run_task(SMALL, {"reader": Reader()}, (1,), simulate=fake_drives)
    calls_and_bytes(tmp_path / "first", result, 1)  # templates are compiled once
    few, more, most = (np.array(calls_and_bytes(tmp_path / str(n), result, n)) for n in (2, 4, 8))
    assert ((most - more) < 2.1 * (more - few)).all()


def test_slopes_are_those_of_powers():
    work = (1.0, 2.0, 4.0, 8.0)
    curve = scaling.CostCurve("square", "rows", work, tuple(x**2 for x in work))
    assert curve.slope == pytest.approx(2.0) and curve.last_slope == pytest.approx(2.0)
    bent = scaling.CostCurve("late", "rows", work, (1.0, 1.0, 1.0, 8.0))
    assert bent.last_slope == pytest.approx(3.0) and 0.0 < bent.slope < 3.0
