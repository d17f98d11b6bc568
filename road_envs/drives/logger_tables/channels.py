"""Quantities of a drive from the columns of a table, in SI units.

A column is found by the name that is given for its quantity, or else by the quantity's own name or
an alias, with or without a unit in the header. All problems are collected.
"""

import difflib
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables.description import DriveDescription
from road_envs.drives.logger_tables.table import Table, numeric_values, to_si
from road_envs.records import units
from road_envs.records.record import SENSORS

GRAVITY_THRESHOLD = 9.5
"""Least mean [m/s²] of a vertical channel that includes gravity: an axis 14 degrees from the
vertical has as much, and reads accelerations 3 % too low."""

UPRIGHT_THRESHOLD = 0.5  # largest mean [m/s²] without gravity: of an offset, or of a tilted axis
GRAVITY_MAX = 1.5 * units.STANDARD_GRAVITY  # greatest mean [m/s²]: gravity and an offset
GRAVITY_IN_G = (0.9, 1.1)  # mean of a channel in m/s² that suggests a channel in g
LOUD_RMS = 200.0  # RMS [m/s²] that no body or axle has over a drive
LOUDEST = 1000.0  # largest sample [m/s²] of a body or axle, of 100 g; those beyond are lost
MAX_SPIKES = 0.01  # largest share of a channel's samples that may be such
MAX_LISTED = 1500  # characters of all problems, each of which may have 300

QUIET_RMS, SILENT_RMS = 0.15, 0.02
"""RMS [m/s²] at which a driven car is questioned, and below which there is none: 50 km/h on a good
road of class A give 0.3."""


@dataclass
class TableFindings:
    """Problems, which are reported together, and notes on assumptions and corrections."""

    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def raise_problems(self) -> None:
        """Raise ConfigError that lists all problems, if there are any."""
        width = max(300, MAX_LISTED // max(len(self.problems), 1))
        problems = [textwrap.shorten(text, width, placeholder=" ...") for text in self.problems]
        if len(problems) == 1:
            raise ConfigError(problems[0])
        if problems:
            listed = "; ".join(f"({k}) {text}" for k, text in enumerate(problems, 1))
            raise ConfigError(f"{len(problems)} problems: {listed}")


class Channels:
    """The columns of a `table` by quantity, by a `description` and the headers.

    The table has the accelerations of these `accelerometers`; what is found wrong is in `findings`.
    """

    def __init__(
        self, table: Table, description: DriveDescription, accelerometers: Iterable[str] = SENSORS
    ):
        self.table, self.description, self.findings = table, description, TableFindings()
        self.quantities = description.quantities(accelerometers)
        self.headers = {name: self._find(name) for name in self.quantities}

    def __contains__(self, quantity: str) -> bool:
        return self.headers[quantity] is not None

    def list_columns(self) -> str:
        return f"the table has {', '.join(self.table)}"

    def unit(self, quantity: str) -> str | None:
        """Return the unit that is given, or that of the header, if any."""
        header, kind = self.headers[quantity] or "", self.quantities[quantity].kind
        return self.description.units.get(quantity) or units.split_header(header, kind)[1]

    def numbers(self, quantity: str) -> np.ndarray | None:
        """Return a column in SI units (N,), NaN for empty cells; None if it cannot be read."""
        header, kind = self.headers[quantity], self.quantities[quantity].kind
        if header is None or kind is None:
            return None
        try:
            unit = self.unit(quantity)
            factor = units.factor(kind, unit) if unit else 1.0
            x = to_si(numeric_values(self.table[header]), factor)
        except ValueError as error:
            where = quantity if isinstance(error, ConfigError) else f"the column {header}"
            self.findings.problems.append(f"{where}: {error}")
            return None
        if not np.isfinite(x).any():
            self.findings.problems.append(f"the column {header} holds no number")
            return None
        # an odometer or positions would tell
        if quantity == "v" and not (unit or header.lower() == "v" or "s" in self or "lat" in self):
            self.findings.notes.append(
                f"the column {header} has no unit: it is read as m/s (--units v=km/h if it is not)"
            )
        return x

    def acceleration(self, quantity: str) -> np.ndarray | None:
        """Return one channel [m/s²], upwards and without gravity; None if there is none."""
        if quantity not in self:
            if quantity not in self.description.columns:  # else `_find` has told it
                self.findings.problems.append(
                    f"the column {quantity} is missing: name it {quantity} (m/s²) or {quantity}_g, "
                    f"or say which it is with --columns {quantity}=NAME; {self.list_columns()}"
                )
            return None
        if (a := self.numbers(quantity)) is None:
            return None
        name, a = self.headers[quantity], -a if quantity in self.description.invert else a
        problems, notes = self.findings.problems, self.findings.notes
        beyond = np.abs(a - np.nanmedian(a)) > LOUDEST
        if 0 < (lost := int(beyond.sum())) <= MAX_SPIKES * a.size:
            a = np.where(beyond, np.nan, a)
            notes.append(
                f"{name}: {lost} samples beyond {LOUDEST:g} m/s² of the others are taken as lost"
            )
        finite = a[np.isfinite(a)]
        mean, spread = float(finite.mean()), float(finite.std())
        in_g = self.unit(quantity) is None and GRAVITY_IN_G[0] < abs(mean) < GRAVITY_IN_G[1]
        if spread <= 1e-12:
            problems.append(
                f"{name} is {mean:g} in all rows: the sensor is dead, or the wrong column"
            )
        elif in_g:
            problems.append(
                f"{name} has a mean of {mean:.2f}, as of gravity in g: say --units {quantity}=g, "
                f"or --units {quantity}=m/s2 if the sensor has this offset"
            )
        elif abs(mean) > GRAVITY_MAX or spread > LOUD_RMS:
            problems.append(
                f"{name} has a mean of {mean:.4g} and an RMS of {spread:.3g} m/s², more than any "
                f"car: give its unit (--units {quantity}=mg), and scale raw counts by the data "
                "sheet of the sensor"
            )
        elif UPRIGHT_THRESHOLD < abs(mean) < GRAVITY_THRESHOLD:
            tilt = np.degrees(np.arccos(abs(mean) / units.STANDARD_GRAVITY))
            problems.append(
                f"{name} has a mean of {mean:.2f} m/s², neither 0 nor gravity: an axis "
                f"{tilt:.0f} degrees from the vertical, or an offset. Give all three axes (x, y, "
                "z), from which the vertical is found, or subtract an offset that you know"
            )
        elif mean < -GRAVITY_THRESHOLD:
            problems.append(
                f"{name} has a mean of {mean:.1f} m/s²: its axis points down; invert its sign "
                f"with --invert {quantity}"
            )
        elif spread < SILENT_RMS:
            problems.append(
                f"{name} has an RMS of {spread:.2g} m/s², less than any driven car: check the "
                f"column and its unit (--units {quantity}=g)"
            )
        elif spread < QUIET_RMS and self.unit(quantity) is None:
            notes.append(
                f"{name} has an RMS of only {spread:.2g} m/s²: if it is in g, say "
                f"--units {quantity}=g"
            )
        if mean > GRAVITY_THRESHOLD:
            notes.append(f"{name}: its mean of {mean:.2f} m/s² is taken as gravity and subtracted")
            return a - mean
        return a

    def texts(self, quantity: str) -> list[str]:
        """Return the cells of a column, the last known one for an empty cell."""
        import pandas as pd

        header = self.headers[quantity]
        assert header is not None
        cells = pd.Series(self.table[header].to_pylist(), dtype=object).ffill().bfill()
        return [str(cell).strip() for cell in cells]

    def _find(self, quantity: str) -> str | None:
        """Return the header of the column of a quantity, None if there is none."""
        given, kind = self.description.columns.get(quantity), self.quantities[quantity].kind
        names = {h: units.split_header(h, kind)[0].lower() for h in self.table}
        if given is not None:
            wanted = given.strip().lower()
            for known in ({h: h.lower() for h in self.table}, names):
                if len(matches := [h for h, name in known.items() if name == wanted]) == 1:
                    return matches[0]
            close = difflib.get_close_matches(given, list(self.table), n=1)
            hint = f" (did you mean {close[0]!r}?)" if close else ""
            self.findings.problems.append(
                f"there is no column {given!r} for {quantity}{hint}; {self.list_columns()}"
            )
            return None
        taken = {name.strip().lower() for name in self.description.columns.values()}
        free = {h: name for h, name in names.items() if h.lower() not in taken}
        for alias in (quantity, *self.quantities[quantity].aliases):
            matches = [h for h, name in free.items() if name == alias]
            if len(matches) > 1:
                self.findings.problems.append(
                    f"{quantity} is given twice, by the columns {' and '.join(matches)}: say which "
                    f"with --columns {quantity}=NAME"
                )
            if matches:
                return matches[0]
        return None
