"""A run that is killed twenty times and resumed leaves the board of an undisturbed run."""

import itertools

import pytest
from test_executors import expected, killed_and_resumed  # noqa: F401


@pytest.fixture(scope="module")
def conditions():
    return 2


@pytest.mark.slow
def test_a_run_killed_20_times_gives_the_same_board(tmp_path, expected):  # noqa: F811
    kills = 0
    for round_ in itertools.count():
        delays = [1.0 + (0.37 * (k + 3 * round_)) % 6.0 for k in range(8)]
        now = killed_and_resumed(tmp_path / str(round_), expected, delays, 2)
        print(f"round {round_}: killed {now} times, resumed, the same board")
        kills += now
        if kills >= 20:
            break
