"""Agreement trial of reports from one phone on the dashboard of a car.

Each drive is an individual of grade S2 (masses, dampers, friction, tyres and structure off the
description) of one of three cars, over a road of class A to C with obstacles on every second one,
as a zip file of phyphox with a random mount. The report of the zip file with the described car is
compared with the road that was driven: IRI by segment, its interval, obstacles that are found, and
those that are not there.

    python -m studies.phone_reports --out out/phone_reports

The folder keeps what is done, so that a trial that was ended goes on; the summary is printed.
"""

import argparse
import io
import itertools
import json
import time
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from leaderboard.drive_report.conditions import load_conditions
from leaderboard.drive_report.report import ReportSettings, make_report
from road_envs.drives.logger_tables.description import PLACES
from road_envs.drives.reading import read_drive
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Record
from road_envs.records.roughness import golden_car
from road_envs.records.units import STANDARD_GRAVITY
from road_envs.roads import realise_road
from road_envs.roads.surface import Surface
from road_envs.sensing.instruments import load_instruments

VEHICLES, LENGTH = ("bmw_320i", "volkswagen_vanagon", "jeep_cherokee"), 250.0
"""Described vehicles, and length [m] of each road."""

CLASSES, SPEEDS, FIRST_SEED = "ABC", (50, 70, 100), 601
"""Road classes, speeds [km/h], and the seed of road, car, noise and mount of the first drive; each
further drive has the next. Nothing in the report was decided by drives of these seeds; it was by
those of 401 to 445.
"""

PLACES_OF_OBSTACLES = ((80.0, 3.7), (170.0, 0.9))
"""Middle and length [m] of the half sines on roads of even seeds; the first is a hump."""

HEIGHTS, HIGH = (0.03, 0.05, 0.06, 0.075), 0.05
"""Heights [m] that are drawn, and the least of those that should be found."""

NEAR = 1.0
"""Distance [m] within which an obstacle of a report is that of the road."""


def obstacles(seed: int) -> list[tuple[float, float, float]]:
    """Return middle, length and height [m] of the obstacles of a road."""
    if seed % 2:
        return []
    drawn = np.random.default_rng((seed, 10)).choice(HEIGHTS, len(PLACES_OF_OBSTACLES))
    return [(*place, float(h)) for place, h in zip(PLACES_OF_OBSTACLES, drawn, strict=True)]


def road(letter: str, seed: int) -> dict[str, Any]:
    """Return the description of a road of a class, with obstacles for an even seed."""
    ground = {"kind": "iso8608", "road_class": letter, "length": LENGTH}
    if not obstacles(seed):
        return ground
    defects = [
        {"shape": "half_sine", "at": at, "length": length, "height": height}
        for at, length, height in obstacles(seed)
    ]
    return {
        "kind": "superposed",
        "roads": [ground, {"kind": "defects", "length": LENGTH, "defects": defects}],
    }


def write_zip(path: Path, t: np.ndarray, vertical: np.ndarray, speed: float, seed: int) -> None:
    """Write a drive at constant `speed` [m/s] as phyphox exports it, in a random mount."""
    rng = np.random.default_rng((seed, 28))
    across = 0.3 * np.std(vertical) * rng.standard_normal((2, t.size))
    axes = np.column_stack([*across, vertical + STANDARD_GRAVITY])
    axes = Rotation.random(random_state=seed).apply(axes)
    fixes = np.arange(0.0, t[-1], 1.0)
    lat = 48.0 + (speed * fixes + 0.3 * rng.standard_normal(fixes.size)) / 111_195.0
    v = speed + 0.1 * rng.standard_normal(fixes.size)
    tables = {
        "Accelerometer.csv": (
            ("Time (s)", "X (m/s^2)", "Y (m/s^2)", "Z (m/s^2)"), np.column_stack([t, axes])
        ),
        "Location.csv": (
            ("Time (s)", "Latitude (°)", "Longitude (°)", "Velocity (m/s)"),
            np.column_stack([fixes, lat, np.full(fixes.size, 11.0), v]),
        ),
    }  # fmt: skip
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, (heads, values) in tables.items():
            text = io.StringIO()
            np.savetxt(text, values, "%.9g", ",", header=",".join(heads), comments="")
            file.writestr(name, text.getvalue())


def drive_with_phone(
    surface: Surface, speed_kmh: float, vehicle: str, seed: int
) -> tuple[Record, np.ndarray]:
    """Return the record of an individual of grade S2 with a phone on its dashboard, and the
    vertical acceleration (N,) [m/s²] with lost samples interpolated.
    """
    phone = replace(load_instruments("phone"), accelerometers={"PHONE": PLACES["dashboard"]})
    record, _ = simulate_record(
        surface, speed_kmh=speed_kmh, vehicle=vehicle, instruments=phone, grade="S2", seed=seed
    )
    good = np.isfinite(record.a[0])
    return record, np.interp(record.t, record.t[good], record.a[0, good])


def run_case(case: tuple[str, str, int, int], folder: Path, estimator: str) -> dict[str, Any]:
    """Simulate one drive, report it, and return the errors of the report."""
    vehicle, letter, speed_kmh, seed = case
    surface = realise_road(road(letter, seed), seed)
    record, a = drive_with_phone(surface, speed_kmh, vehicle, seed)
    path = folder / "drive.zip"
    write_zip(path, record.t, a, speed_kmh / 3.6, seed)
    began = time.process_time()
    drive = read_drive(path, vehicle=vehicle, offset=float(record.s[0]))
    chosen = ReportSettings(conditions=load_conditions("hpms"), settings={}, estimator=estimator)
    (result,) = make_report([drive], chosen, lambda *_: None).drives
    seconds = time.process_time() - began
    return {"case": list(case), "seconds": seconds, **compare(result, surface, seed)}


def compare(result: Any, surface: Surface, seed: int) -> dict[str, Any]:
    """Return the errors of a result: of the IRI of its segments, and false obstacles."""
    edges = np.array([r["begin_m"] for r in result.segments] + [result.segments[-1]["end_m"]])
    iri, half = true_iri(surface, edges)
    rows = result.segments
    there = obstacles(seed)
    found = [
        [min((abs(o["station_m"] - at) for at, *_ in there), default=1e9), o["kind"]]
        for o in result.obstacles
    ]
    high = [at for at, _, height in there if height >= HIGH]
    return {
        "iri": [r["iri_mean"] / x - 1.0 for r, x in zip(rows, iri, strict=True)],
        "hri": [r.get("hri", np.nan) / x - 1.0 for r, x in zip(rows, half, strict=True)],
        "ratio": (iri / half).tolist(),
        "inside": [
            bool(r["iri_mean_low"] <= x <= r["iri_mean_high"])
            for r, x in zip(rows, iri, strict=True)
        ],
        "width": [np.log(r["iri_mean_high"] / r["iri_mean_low"]) for r in rows],
        "obstacles": len(high),
        "found": sum(any(abs(o["station_m"] - at) < NEAR for o in result.obstacles)
                     for at in high),
        "false": sum(d >= NEAR and not kind.startswith("possible") for d, kind in found),
        "possible": sum(d >= NEAR and kind.startswith("possible") for d, kind in found),
        "length": float(edges[-1] - edges[0]),
        "notes": list(result.notes),
    }  # fmt: skip


def true_iri(surface: Surface, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the IRI and HRI [mm/m], each (K,), between the stations `edges` (K + 1,) [m]."""
    ds = 0.025
    s = edges[0] + ds * np.arange(round((edges[-1] - edges[0]) / ds) + 1)
    left, right = surface.height(s)
    index = np.round((edges - edges[0]) / ds).astype(int)
    found = []
    for z in (left, right, 0.5 * (left + right)):
        motion = 1e3 * np.abs(golden_car(z[None], ds)[0])
        found.append([motion[i:j].mean() for i, j in itertools.pairwise(index)])
    iri = np.array(found)
    return iri[:2].mean(axis=0), iri[2]


def summary(results: list[dict[str, Any]]) -> str:
    """Return the errors of the trial by vehicle, by class, and of all drives, as a table."""
    lines = [
        f"{'IRI by segment':20s} segments   bias   RMSE  within 15 %  inside 95 %  "
        "obstacles of 50 mm  false, possible per km"
    ]
    for name in (*VEHICLES, *CLASSES, "all"):
        chosen = [r for r in results if name in ("all", *r["case"][:2])]
        if not chosen:
            continue
        error = np.concatenate([r["iri"] for r in chosen])
        inside = np.concatenate([r["inside"] for r in chosen])
        km = sum(r["length"] for r in chosen) / 1000.0
        found, there, false, possible = (
            sum(r[key] for r in chosen) for key in ("found", "obstacles", "false", "possible")
        )
        lines.append(
            f"{name:20s} {error.size:8d} {error.mean():+6.1%} {np.sqrt(np.mean(error**2)):6.1%} "
            f"{np.mean(np.abs(error) < 0.15):12.0%} {inside.mean():12.0%} "
            f"{f'{found} of {there} found':>19s} {false / km:15.1f}, {possible / km:.1f}"
        )
    told = [1.0 + np.array(r["iri"]) for r in results]  # over the true IRI
    before, after = (
        np.sqrt(np.mean((np.concatenate(x) - 1.0) ** 2))
        for x in ([x[1:] for x in told], [x[1:] / x[0] for x in told])
    )
    lines.append(
        f"RMSE of all but the first segments {before:.1%}, "
        f"with the IRI of the first known {after:.1%}"
    )
    seconds, km = sum(r["seconds"] for r in results), sum(r["length"] for r in results) / 1000.0
    return "\n".join([*lines, f"processor time {seconds / km:.0f} s per km"])


def drive_lines(results: list[dict[str, Any]]) -> str:
    """Return a line for each drive with the errors of its segments."""
    lines = []
    for r in results:
        vehicle, letter, speed, seed = r["case"]
        errors = " ".join(f"{100 * x:+.0f}" for x in r["iri"])
        lines.append(
            f"{vehicle}, {letter}, {speed} km/h, seed {seed}: IRI {errors} % by segment, "
            f"{sum(r['inside'])} of {len(r['inside'])} inside"
        )
    return "\n".join(lines)


def main() -> None:
    """Run the cases that the folder does not have yet, and print the summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/phone_reports"))
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--speeds", type=int, nargs="+", default=SPEEDS)
    parser.add_argument("--estimator", default="map_smoother")
    parser.add_argument("--each", action="store_true", help="a line for each drive instead")
    options = parser.parse_args()
    results = []
    cases = itertools.product(VEHICLES, CLASSES, options.speeds)
    for seed, (vehicle, letter, speed) in enumerate(cases, options.first_seed):
        folder = options.out / f"{vehicle}_{letter}_{speed}_{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        kept = folder / "errors.json"
        if not kept.exists():
            result = run_case((vehicle, letter, speed, seed), folder, options.estimator)
            kept.write_text(json.dumps(result), encoding="utf-8")
        results.append(json.loads(kept.read_text(encoding="utf-8")))
    print(drive_lines(results) if options.each else summary(results))


if __name__ == "__main__":
    main()
