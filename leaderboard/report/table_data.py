"""Numbers behind the tables of the pages, for the scripts that filter and sort them."""

from collections.abc import Sequence
from typing import Any

from leaderboard.report.board_definitions import COLUMNS, TEXT_COLUMNS, Column
from leaderboard.report.figures import rounded
from leaderboard.report.tables import ALL_RUNS, LIMIT_ROWS, BoardView, Row, Section


def table_data(view: BoardView, section: Section, columns: Sequence[Column]) -> dict[str, Any]:
    """Return the rows of a task, with their numbers over all runs and over each group."""
    keys = [
        *(column.key for column in columns),
        view.definition.ranks_by,
        "rank_causal",
        "low",
        "high",
    ]
    numeric = dict.fromkeys(key for key in keys if key not in TEXT_COLUMNS)
    return {
        "ranks_by": view.definition.ranks_by,
        "scale": view.definition.scale,
        "flat": 1.0 if view.definition.ranks_by == "nrmse" else None,
        "groups": {kind: list(names) for kind, names in section.groups.items()},
        "columns": {key: _column_format(key) for key in dict.fromkeys(keys)},
        "rows": [_row_data(row, list(numeric)) for row in section.rows],
    }


def _row_data(row: Row, keys: Sequence[str]) -> dict[str, Any]:
    groups = {ALL_RUNS: row.values, **row.groups}
    return {
        "name": row.name,
        "state": row.state,
        "causal": bool(row.causal),
        "message": row.message,
        # rows with few scores have empty cells instead of dashes
        "sparse": row.state == "claim" or row.name in LIMIT_ROWS,
        "cells": {key: row.cells[key] for key in TEXT_COLUMNS if row.cells.get(key)},
        "groups": {
            name: {key: rounded(x) for key in keys if (x := values.get(key)) is not None}
            for name, values in groups.items()
        },
    }


def _column_format(key: str) -> dict[str, Any]:
    """Return how a script formats a column, equal to `Metric.format_value`."""
    if key in TEXT_COLUMNS or key not in COLUMNS:
        return {"better": "low", "format": None}
    column = COLUMNS[key]
    form = {"factor": column.factor, "digits": column.digits, "blank": column.blank}
    return {"better": column.better, "format": {**form, "sign": column.better == "zero"}}
