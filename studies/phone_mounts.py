"""Trial of twenty mounts of one phone: is the report right, or does it say that it is not?

    python -m studies.phone_mounts rows.jsonl

One drive of a saloon, off its description, over a road of class B, as the phone on its dashboard
writes it in each mount: turned at random with all three axes, turned once more in the middle of the
drive, and with one axis alone, which is off the vertical by an angle. No mount was chosen by what
the report makes of it.
"""

import io
import tempfile
import zipfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from leaderboard.drive_report.conditions import load_conditions
from leaderboard.drive_report.report import ReportSettings, make_report
from road_envs.core.config import ConfigError
from road_envs.drives.reading import read_drive
from road_envs.records.record import Record
from road_envs.records.units import STANDARD_GRAVITY
from road_envs.roads import realise_road
from road_envs.roads.surface import Surface
from studies.phone_reports import compare, drive_with_phone, write_zip
from studies.study import Row, run_study, study_parser

VEHICLE, CLASS, SPEED, SEED = "bmw_320i", "B", 70.0, 903
"""Described vehicle, road class, speed [km/h], and seed of road, individual and noise."""

LENGTH = 400.0  # of the road [m]

MOUNTS: tuple[Row, ...] = (
    *({"mount": "three axes", "angle": None, "seed": seed} for seed in range(14)),
    *({"mount": "turns at half", "angle": angle, "seed": 14} for angle in (20, 60)),
    *({"mount": "one axis", "angle": angle, "seed": 15} for angle in (5, 15, 35, 80)),
)
"""Kind, angle [deg] of the turn or of the one axis to the vertical, and seed of the mount."""

NEAR = 0.15
"""Relative error of the IRI of a segment that is still right."""


@cache
def driven() -> tuple[Surface, Record, np.ndarray]:
    """Return the road, the record of the drive, and its vertical acceleration (N,) [m/s²]."""
    road = {"kind": "iso8608", "road_class": CLASS, "length": LENGTH}
    surface = realise_road(road, SEED)
    return surface, *drive_with_phone(surface, SPEED, VEHICLE, SEED)


def write_drive(path: Path, mount: str, angle: float | None, seed: int) -> Path:
    """Write the drive of a mount below the folder `path`; returns the file."""
    _, record, vertical = driven()
    drive = path / "drive.zip"
    if mount == "one axis":
        assert angle is not None
        across = 0.3 * np.std(vertical) * np.random.default_rng(seed).standard_normal(vertical.size)
        up = np.cos(np.radians(angle)) * (vertical + STANDARD_GRAVITY)
        axis = up + np.sin(np.radians(angle)) * across
        columns = np.column_stack([record.t, axis, np.full(record.t.size, SPEED / 3.6)])
        drive = path / "drive.csv"
        np.savetxt(drive, columns, "%.9g", ",", header="t,a_phone,v", comments="")
        return drive
    write_zip(drive, record.t, vertical, SPEED / 3.6, seed)
    if mount == "turns at half":
        with zipfile.ZipFile(drive) as file:
            tables = {name: file.read(name).decode() for name in file.namelist()}
        heads, _, body = tables["Accelerometer.csv"].partition("\n")
        values = np.loadtxt(io.StringIO(body), delimiter=",")
        late = values.shape[0] // 2
        turn = Rotation.from_euler("x", angle, degrees=True)
        values[late:, 1:] = turn.apply(values[late:, 1:])
        text = io.StringIO()
        np.savetxt(text, values, "%.9g", ",", header=heads, comments="")
        with zipfile.ZipFile(drive, "w", zipfile.ZIP_DEFLATED) as file:
            for name, table in (tables | {"Accelerometer.csv": text.getvalue()}).items():
                file.writestr(name, table)
    return drive


def compute(mount: str, angle: float | None, seed: int) -> Row:
    """Report the drive of a mount: errors of IRI and what is said first, or why it is refused."""
    surface, *_ = driven()
    chosen = ReportSettings(
        conditions=load_conditions("hpms"), settings={}, estimator="map_smoother"
    )
    with tempfile.TemporaryDirectory() as folder:
        path = write_drive(Path(folder), mount, angle, seed)
        try:
            drive = read_drive(path, vehicle=VEHICLE, at="dashboard")
            (result,) = make_report([drive], chosen, lambda *_: None).drives
        except ConfigError as error:
            return {"refused": str(error).replace(folder, "").lstrip("/")}
    kept: dict[str, Any] = compare(result, surface, seed=1)  # an odd seed has no obstacles
    return {key: kept[key] for key in ("iri", "inside", "notes")}


def verdict(row: Row) -> str:
    """Say whether a report is within 15 %, refused, farther off but inside its intervals, rough by
    its own word, or wrong in silence.
    """
    if "refused" in row:
        return "refused"
    if all(abs(error) < NEAR for error in row["iri"]):
        return "within 15 %"
    if all(row["inside"]):
        return "inside 95 %"
    return "says rough" if "rough" in row["notes"][0] else "SILENT"


def summary(rows: list[Row]) -> str:
    """Return a line for each mount, and the number of each verdict."""
    lines = []
    rows = [row for mount in MOUNTS for row in rows if mount.items() <= row.items()]
    for row in rows:
        angle = "any way up" if row["angle"] is None else f"{row['angle']} deg"
        errors = " ".join(f"{100 * x:+.0f}" for x in row.get("iri", ()))
        inside = f"{sum(row['inside'])} of {len(row['inside'])} inside" if errors else ""
        told = f"IRI {errors} % by segment, {inside}" if errors else row["refused"]
        lines.append(f"{row['mount']:14s} {angle:10s} {verdict(row):12s} {told}")
    verdicts = [verdict(row) for row in rows]
    lines.append(", ".join(f"{verdicts.count(v)} {v}" for v in dict.fromkeys(verdicts)))
    return "\n".join(lines)


def main() -> None:
    """Report the mounts that the file does not have yet, and print all."""
    run_study(study_parser(__doc__ or "").parse_args(), MOUNTS, compute, summary, lambda *_: None)


if __name__ == "__main__":
    main()
