"""Progress without a terminal, and what an interrupted command says."""

import io

import pytest
from rich.console import Console

from leaderboard import commands
from leaderboard.commands import (
    LINE_INTERVAL,
    _describe_duration,
    _progress_lines,
    _time_left,
    progress_bar,
)


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


def test_a_line_is_written_at_most_every_interval_with_the_time_left():
    clock, lines = Clock(), []
    progress = _progress_lines(lines.append, clock)
    for k in range(31):
        clock.now = 100.0 + 2.0 * k  # a fiftieth of the work in 2 s
        progress(f"drive {k}", k / 50.0)
    assert len(lines) == int(60.0 / LINE_INTERVAL)
    assert lines[0] == " 10 %  drive 5, about 90 s left".replace("90 s", _describe_duration(90.0))
    assert lines[-1] == " 60 %  drive 30, about 40 s left"


def test_stored_results_do_not_count_as_fast_work():
    clock, lines = Clock(), []
    progress = _progress_lines(lines.append, clock)
    progress("found 90 of 100", 0.9)
    clock.now += 20.0
    progress("one more", 0.91)
    assert lines == [" 91 %  one more, about 3 min left"]


def test_without_progress_no_time_is_shown():
    clock, lines = Clock(), []
    progress = _progress_lines(lines.append, clock)
    clock.now += 20.0
    progress("starting", 0.0)
    assert lines == ["  0 %  starting"]


def test_what_is_prepared_before_the_work_does_not_count():
    clock, lines = Clock(), []
    progress = _progress_lines(lines.append, clock)
    progress("checking", 0.0)
    clock.now += 300.0
    progress("starting", 0.0)
    clock.now += 20.0
    progress("a quarter", 0.25)
    assert lines == ["  0 %  starting", " 25 %  a quarter, about 60 s left"]


def test_a_terminal_shows_the_time_left_too(monkeypatch):
    clock, said = Clock(), io.StringIO()
    shown = Console(file=said, force_terminal=True, width=100)
    monkeypatch.setattr(commands, "notices", shown)
    monkeypatch.setattr(commands, "_time_left", lambda: _time_left(clock))
    with commands.progress_bar() as progress:
        progress("starting", 0.0)
        clock.now += 20.0
        progress("a quarter", 0.25)
    assert "a quarter, about 60 s left" in said.getvalue()


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(4.4, "4 s"), (89.0, "89 s"), (150.0, "2 min"), (7500.0, "2 h 05 min")],
)
def test_durations_are_written_in_whole_units(seconds, text):
    assert _describe_duration(seconds) == text


def test_an_interruption_says_what_is_kept():
    with pytest.raises(KeyboardInterrupt, match="all is kept"), progress_bar("all is kept"):
        raise KeyboardInterrupt
