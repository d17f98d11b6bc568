"""Numbers behind the tables of the pages with their text, for the scripts that filter and sort."""

from collections.abc import Sequence
from typing import Any

from leaderboard.report.board_definitions import COLUMNS, TEXT_COLUMNS, Column
from leaderboard.report.figures import rounded
from leaderboard.report.tables import ALL_RUNS, LIMIT_ROWS, BoardView, Row, Section

DIGITS = 5
"""Significant digits of a number, which sorts and draws; its text is what is read."""


def table_data(view: BoardView, section: Section, columns: Sequence[Column]) -> dict[str, Any]:
    """Rows of a task, with their numbers over all runs and over each group, each [number, text]."""
    ranks_by = view.definition.ranks_by
    keys = dict.fromkeys([*(column.key for column in columns), ranks_by, "rank_causal"])
    forms = {key: COLUMNS[key] for key in keys if key not in TEXT_COLUMNS}
    numeric = {**forms, "low": COLUMNS[ranks_by], "high": COLUMNS[ranks_by]}
    return {
        "ranks_by": ranks_by,
        "scale": view.definition.scale,
        "flat": 1.0 if ranks_by == "nrmse" else None,
        "groups": {kind: list(names) for kind, names in section.groups.items()},
        "columns": {
            key: {"better": form.better, "blank": form.blank} for key, form in forms.items()
        },
        "rows": [_row_data(row, numeric) for row in section.rows],
    }


def _row_data(row: Row, forms: dict[str, Any]) -> dict[str, Any]:
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
            name: {
                key: [rounded(x, DIGITS), form.format_value(x)]
                for key, form in forms.items()
                if (x := values.get(key)) is not None
            }
            for name, values in groups.items()
        },
    }
