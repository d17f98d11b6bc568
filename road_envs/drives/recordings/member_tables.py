"""Columns of the tables of an app as arrays of numbers, found by the beginning of their names."""

from collections.abc import Mapping

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables.table import Table, numeric_values, parse_text
from road_envs.records import units


def parse_member(name: str, data: bytes) -> Table:
    """Return the table in the bytes of a member. Raises ConfigError naming the member."""
    try:
        return parse_text(data)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None
    except ValueError as error:
        raise ConfigError(f"{name}: no readable table: {error}") from None


def number_column(table: Table, wanted: str, kind: str, member: str) -> np.ndarray | None:
    """Return the column whose header without its unit is `wanted`, in SI units (N,).

    Headers are compared without case; None if there is no such column. Raises ConfigError.
    """
    matches = [h for h in table if units.split_header(h)[0].lower() == wanted.lower()]
    if not matches:
        return None
    try:
        x = numeric_values(table[matches[0]])
        unit = units.split_header(matches[0])[1]
        return x * (units.factor(kind, unit) if unit else 1.0)
    except (ValueError, ConfigError) as error:
        raise ConfigError(f"{member}, column {matches[0]}: {error}") from None


def find_member(members: Mapping[str, bytes], *names: str) -> str | None:
    """Return the first member of one of these names, without case and folder; None if none is."""
    by_name = {path.rsplit("/", 1)[-1].lower(): path for path in sorted(members, reverse=True)}
    return next((by_name[name.lower()] for name in names if name.lower() in by_name), None)
