"""Findings: sentences about the boards, made from their numbers."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np

from leaderboard.evaluation.boards import BoardDefinition
from leaderboard.metrics import heights
from leaderboard.metrics.baselines import MEMORY
from leaderboard.metrics.level import EQ_12_RAW, STATE_LIMITS
from leaderboard.report import board_definitions as boards
from leaderboard.report import tables
from leaderboard.report.notes import has_public_roads
from leaderboard.report.tables import BoardView, Row, Section
from leaderboard.running.board import Board
from road_envs.records.record import PROFILE_SPACING, profile_stations
from road_envs.roads import load_road

PAPER_NETWORK = "static_lm"  # the estimator that implements the paper's network
_N_PAIRS = 200  # number of pairs of unrelated roads, of the class of the training roads
UNRELATED_ROAD = {"kind": "iso8608", "road_class": "D", "length": 100.0}


@dataclass(frozen=True)
class Report:
    """Boards as tables, the main one first, and findings in sentences."""

    views: tuple[BoardView, ...]
    findings: tuple[str, ...]


def build_report(board: Board) -> Report:
    """Tables and findings of a board."""
    views = tuple(tables.board_views(board))
    return Report(views, findings(views))


@cache
def unrelated_level_errors(
    longest_wave: float = 20.0, about_mean: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Return level errors (2 _N_PAIRS,), of single wheel paths, about their mean or first height,
    and correlations (_N_PAIRS,) of pairs of independent class-D roads of 100 m.
    """
    levels: list[float] = []
    r: list[float] = []
    for y, a in _unrelated_roads(longest_wave):
        if about_mean:
            y, a = heights.remove_mean(y), heights.remove_mean(a)
        levels += heights.level_error(y, a)[:2]
        # at 1 m/s the low-pass does not shorten the scored band
        y, a = heights.band_pass(np.stack([y, a]), PROFILE_SPACING, heights.scored_band(1.0))
        r.append(heights.correlation(y, a, PROFILE_SPACING).r)
    return np.abs(levels), np.array(r)


@lru_cache(maxsize=1)
def _unrelated_roads(longest_wave: float) -> list[list[np.ndarray]]:
    """Return pairs of independent roads, each the heights (2, M) [m] of both wheel paths."""
    road = load_road({**UNRELATED_ROAD, "n_min": 1.0 / longest_wave})
    s = profile_stations(100.0)
    rng = np.random.default_rng
    return [[road.realise(rng([0, k, j])).height(s) for j in (0, 1)] for k in range(_N_PAIRS)]


def _unrelated_sentence() -> str:
    """Return the sentence about equation 12 for a road that is unrelated to the truth."""
    levels, r = unrelated_level_errors()
    others = [unrelated_level_errors(100.0, about_mean)[0] for about_mean in (True, False)]
    long_waves, as_printed = (100.0 * np.median(x) for x in others)
    low, median, high = 100.0 * np.quantile(levels, [0.1, 0.5, 0.9])
    low_share = _percent(float(np.mean(levels < STATE_LIMITS[0])), 0)
    return (
        f"An unrelated road of the same class D has a level error (the paper's eq. 12) of "
        f"{median:.0f}\u00a0% in the median where no wave is longer than 20 m ({low:.0f} to "
        f"{high:.0f}\u00a0% from the 10th to the 90th percentile, below 15\u00a0% in "
        f"{low_share} of cases); with waves up to 100 m it has {long_waves:.0f}\u00a0%, and "
        f"{as_printed:.0f}\u00a0% as printed, of heights above the first one instead of the mean "
        f"({r.size} pairs of 100 m, each wheel path; correlation {abs(np.mean(r)):.2f}). The paper "
        "reports 10.2 to 14.8\u00a0% for its network: eq. 12 alone cannot distinguish a "
        "reconstruction from an unrelated road."
    )


def findings(views: Sequence[BoardView]) -> tuple[str, ...]:
    """Sentences about all boards; those for which results are missing are left out."""
    found = [_unrelated_sentence()]
    for view in views:
        claimed = [x for x in view.sections if any(row.state == "claim" for row in x.rows)]
        rows = [row for section in claimed for row in section.rows if row.state != "claim"]
        found += [_paper_protocol(claimed, rows), _memory(rows)]
        for section in view.sections:
            if view.definition.divisions and section not in claimed:
                found += [f"{section.task.name}: {sentence}" for sentence in headline(section)]
    return tuple(sentence for sentence in found if sentence)


def headline(section: Section) -> list[str]:
    """Sentence on the best entry, the next ones and how sure that is, in plain words."""
    if not (scored := scored_rows(section)):
        return []
    best, *others = scored
    definition = section.task.board_definition
    rank = boards.rank_column(definition)
    tied = [row.name for row in others if row.values.get(rank) == best.values.get(rank)]
    first = _best_sentence(best, tied, definition)
    if not others:
        return [first, f"It is the only {boards.ranked_kind(definition)}."]
    certainty = _certainty_sentence(best, tied, others[0], section)
    return [first, _others_sentence(best, others, definition), certainty]


def scored_rows(section: Section) -> list[Row]:
    """Rows of entries that the board orders, with its ranking score, best first."""
    definition = section.task.board_definition
    rows = (row for row in section.rows if tables.is_ranked(row, definition))
    return [row for row in rows if row.values.get(definition.ranks_by) is not None]


def _paper_protocol(sections: Sequence[Section], rows: Sequence[Row]) -> str:
    """Scores of the paper's network under the paper's protocol, over the sections with a claim."""
    found = [row for row in rows if row.name == PAPER_NETWORK and row.values]
    if not found:
        return ""
    states = [int(row.values.get(name) or 0) for name in tables.TRAINING_STATES for row in found]
    near, total = sum(states[: len(found)]), sum(states)
    counted = f" ({near} of {total} trainings below 15\u00a0%)" if total else ""
    labels = [x.label for section in sections for x in section.task.conditions]
    cars = sorted({car for label in labels if (car := label.partition(", car ")[2])})
    tested = f" and tested on another car ({', '.join(cars)})" if cars else ""
    return (
        f"Trained as the paper trains it, on an altered copy of the paving{tested}, the "
        f"{PAPER_NETWORK} network has a level error of {_percent(_mean(found, EQ_12_RAW))} by "
        f"eq. 12 as printed{counted}, which counts the datum, and "
        f"{_percent(_mean(found, 'level_error'))} of heights about their mean, at an in-band error "
        f"of {_mean(found, 'nrmse'):.2f}, where a flat road has 1, and correlation "
        f"{_mean(found, 'r'):.2f}."
    )


def _memory(rows: Sequence[Row]) -> str:
    found = [row for row in rows if row.name == MEMORY and row.values]
    if not found:
        return ""
    return (
        "There the training road, moved back by its known delay, has an in-band error of "
        f"{_mean(found, 'nrmse'):.2f} and a level error of {_percent(_mean(found, EQ_12_RAW))} as "
        f"printed, and uses no measurement ({MEMORY}): the protocol rewards memorising the road."
    )


def _best_sentence(best: Row, tied: Sequence[str], definition: BoardDefinition) -> str:
    key, forms = definition.ranks_by, boards.column_forms(definition)
    low, high = best.values.get("low"), best.values.get("high")
    interval = tables.interval_text(low, high, forms[key])
    sure = "" if low is None else f", with 95\u00a0% confidence {interval}"
    scale = ", where an exact estimate has 0 and a flat road 1" if key == "nrmse" else ""
    worst = best.values.get(boards.WORST)
    tail = "" if worst is None else f" On its worst drive it is {forms[boards.WORST].text(worst)}."
    error = forms[key].text(best.values[key])
    among = " of the causal entries" * (boards.ranked_kind(definition) != "entry")
    is_best = f"has the lowest error{among}:" if tied else f"is best{among}: its error is"
    return f"{best.name} {is_best} {error}{scale}{sure}.{tail}"


def _others_sentence(best: Row, others: Sequence[Row], definition: BoardDefinition) -> str:
    """Sentences on the next entries, the best causal one, and the place of the paper's network."""
    key, second = definition.ranks_by, others[0]

    def score(row: Row) -> str:
        return boards.COLUMNS[key].text(row.values[key])

    text = f"{second.name} follows with {score(second)}"
    if (error := best.values[key]) and (behind := second.values[key]):
        text += f", {behind / error:.1f} times as much"
    causal = next((row for row in others if row.causal), None)
    if causal is not None and not best.causal:
        own = "it is" if causal is second else f"{causal.name} with {score(causal)},"
        text += f"; {own} the best that may run while driving"
    paper = next((row for row in others if row.name == PAPER_NETWORK), None)
    if paper is None or key != "nrmse":
        return f"{text}."
    verdict = "worse" if (paper.values[key] or 0.0) > 1.0 else "better"
    return f"{text}; the paper's network has {score(paper)}, {verdict} than a flat road."


def _certainty_sentence(best: Row, tied: Sequence[str], second: Row, section: Section) -> str:
    """Sentence on the first place: of those further down, the first may leave none behind."""
    if best.values.get(boards.rank_column(section.task.board_definition)) is None:
        return "Too few roads for a rank or an interval: another road may give another order."
    if tied:
        names = ", ".join(tied)
        return f"The first place is not decided: these drives cannot tell {names} from it."
    doubt = " Nothing of this holds of an entry that has drawn these public roads again."
    return (
        f"The first place is decided: resampling the roads leaves {second.name}, which is next, "
        "behind. An entry shares the rank of the one before it unless more others are surely "
        f"better than it.{doubt * has_public_roads(section.task)}"
    )


def _mean(rows: Sequence[Row], score: str) -> float:
    found = [x for row in rows if (x := row.values.get(score)) is not None]
    return float(np.mean(found)) if found else np.nan


def _percent(share: float, digits: int = 1) -> str:
    return f"{100.0 * share:.{digits}f}\u00a0%"
