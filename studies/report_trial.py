"""Trial of the report: drives as phones log them, of cars that differ from their description.

For each case a table is written (`examples/phone_drive.py`) and reported by one command,
and the obstacles and IRI that the report gives are compared with the road:

    python -m studies.report_trial RESULTS.jsonl

A row is appended to the results for each case; those that stand there are not computed again.
"""

import contextlib
import io
import itertools
import json
import runpy
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

from leaderboard import cli
from leaderboard.drive_report.obstacles import detect
from leaderboard.drive_report.posterior_iri import posterior_iri
from road_envs.records.record import Estimate, profile_stations
from road_envs.records.roughness import displacement_psd
from road_envs.roads import realise_road
from road_envs.roads.surface import Surface
from studies.study import Row, run_study, study_parser

ROOT = Path(__file__).parents[1]

LENGTH = 150.0
"""Length [m] of a road."""

CLASSES, SPEEDS, SEEDS = "BC", (30, 36, 50), (107, 108, 109)
"""Road classes, speeds [km/h], and seeds of road, car, noise and clock. Nothing in the report was
decided by drives of these seeds; it was by some of 1 to 20 and of 101 to 106.
"""

CASES = tuple(itertools.product(CLASSES, SPEEDS, SEEDS))
"""Class, speed [km/h] and seed of each drive."""

LIMITS = {"place_m": 0.5, "height": 0.2, "iri": 0.15}
"""Errors that a report is allowed: places [m], relative heights over the surface's, relative IRI of
segments.
"""

SHORT_WAVES = (0.8, 1.1)
"""Shortest and longest of the waves [m] that make up the crest of the bump."""

NAMES = ("hump 75 mm", "pothole 50 mm", "bump 30 mm")


def road(letter: str, seed: int) -> dict:
    """Return a road of a class with a hump, a pothole and a bump whose places the seed draws."""
    rng = np.random.default_rng((seed, 14))
    hump, hole, bump = np.array([35.0, 75.0, 115.0]) + rng.uniform(-6.0, 6.0, 3)
    side = str(rng.choice(["left", "right"]))
    defects = [
        {"shape": "half_sine", "at": float(hump), "length": 3.7, "height": 0.075},
        {"shape": "pothole", "at": float(hole), "length": 1.2, "edge": 0.2, "height": -0.05,
         "side": side},
        {"shape": "half_sine", "at": float(bump), "length": 0.9, "height": 0.03},
    ]  # fmt: skip
    ground = {"kind": "iso8608", "road_class": letter, "length": LENGTH}
    return {
        "kind": "superposed",
        "roads": [ground, {"kind": "defects", "length": LENGTH, "defects": defects}],
    }


def write_drive(case: tuple[str, int, int], folder: Path) -> dict:
    """Write the drive of a case, phone_drive.csv and .yaml, and its road.yaml into `folder`; return
    the road.
    """
    letter, speed, seed = case
    described = road(letter, seed)
    (folder / "road.yaml").write_text(yaml.safe_dump(described), encoding="utf-8")
    words = ["--out", folder, "--road", folder / "road.yaml", "--speed-kmh", speed, "--seed", seed]
    with _arguments("phone_drive.py", *words), contextlib.redirect_stdout(io.StringIO()):
        runpy.run_path(str(ROOT / "examples/phone_drive.py"))
    return described


def compute(case: tuple[str, int, int]) -> Row:
    """Write the drive of a case, report it, and return the errors of the report."""
    _, speed, seed = case
    printed = io.StringIO()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        described = write_drive(case, folder)
        began = time.process_time()
        words = ["--description", folder / "phone_drive.yaml", "--out", folder / "report", "--json"]
        with (
            _arguments("road-recon", "report", folder / "phone_drive.csv", *words),
            contextlib.redirect_stdout(printed),
            contextlib.suppress(SystemExit),
        ):
            cli.main()
        seconds = time.process_time() - began
        heights = pd.read_parquet(folder / "report/phone_drive_heights.parquet")
        surface = realise_road(folder / "road.yaml", seed)
    (drive,) = json.loads(printed.getvalue())["drives"]
    defects = [d for part in described["roads"] for d in part.get("defects", [])]
    errors = compare(drive, defects, surface)
    errors["speed"] = drive["speed_kmh"] / speed - 1.0
    return {"seconds": seconds, **errors, "short_waves": short_wave_gain(heights, surface)}


def short_wave_gain(heights: pd.DataFrame, surface: Surface) -> float:
    """Return the RMS of the waves SHORT_WAVES in reported `heights`, of both wheel paths or of
    their mean, over that in the surface.
    """
    s, true = heights["station_m"].to_numpy(), surface.height(heights["station_m"].to_numpy())
    columns = ["left_m", "right_m"]
    if "mean_m" in heights:
        columns, true = ["mean_m"], true.mean(axis=0, keepdims=True)
    n, told = displacement_psd(heights[columns].to_numpy().T, float(s[1] - s[0]))
    _, true = displacement_psd(true, float(s[1] - s[0]))
    inside = (n >= 1.0 / SHORT_WAVES[1]) & (n <= 1.0 / SHORT_WAVES[0])
    return float(np.sqrt(told[:, inside].sum() / true[:, inside].sum()))


def compare(drive: dict, defects: list[dict], surface: Surface) -> Row:
    """Return the errors of a report: of obstacles, of the IRI of segments, and false obstacles.

    An obstacle is that of its kind (bump, hole) nearest to its station; its error of height
    is relative, -1 if there is none within 2 m. The waves of the road are part of its surface: a
    `height` is compared with that of the true surface over the line between the feet, as reports
    define it, and `nominal` with that of the defect alone.
    """
    found, inside = list(drive["obstacles"]), [0, 0, 0]
    place: list[float | None] = []
    height, nominal = list[float](), list[float]()
    s = profile_stations(LENGTH)
    on_surface = detect(Estimate(s, surface.height(s)))
    for defect in defects:
        same = [o for o in found if (o["height_mm"] > 0.0) == (defect["height"] > 0.0)]
        near = [o for o in same if abs(o["station_m"] - defect["at"]) < 2.0]
        if not near:
            place.append(None)
            height.append(-1.0)
            nominal.append(-1.0)
            continue
        nearest = min(near, key=lambda o: abs(o["station_m"] - defect["at"]))
        found.remove(nearest)
        true = min(
            (o for o in on_surface if o.height * defect["height"] > 0.0),
            key=lambda o: abs(o.station - defect["at"]),
        ).height
        place.append(off := nearest["station_m"] - defect["at"])
        inside[0] += bool(abs(off) <= 1.96 * nearest["station_std_m"])
        height.append(1e-3 * nearest["height_mm"] / true - 1.0)
        nominal.append(1e-3 * nearest["height_mm"] / defect["height"] - 1.0)
        low, high = (1e-3 * nearest[f"height_{x}_mm"] for x in ("low", "high"))
        inside[1] += bool(low <= true <= high)
        inside[2] += bool(low <= defect["height"] <= high)
    rows = drive["segments"]
    edges = np.array([row["begin_m"] for row in rows] + [rows[-1]["end_m"]])
    s = edges[0] + 0.025 * np.arange(int((edges[-1] - edges[0]) / 0.025))
    truth = Estimate(s - s[0], surface.height(s))
    iri = posterior_iri(truth, edges - edges[0]).median[2]
    told = [(r, x) for r, x in zip(rows, iri, strict=True) if r["iri_mean_high"] is not None]
    covered = [bool(r["iri_mean_low"] <= x <= r["iri_mean_high"]) for r, x in told]
    return {
        "place_m": place,
        "height": height,
        "nominal": nominal,
        "covered": inside,
        "iri": [row["iri_mean"] / x - 1.0 for row, x in zip(rows, iri, strict=True)],
        "iri_covered": sum(covered),
        "iri_intervals": len(told),
        "false": [[o["station_m"], o["height_mm"]] for o in found],
        "notes": drive["notes"],
    }


def passes(result: Row, height: str = "height") -> bool:
    """Return whether all errors of a report are within LIMITS, those of `height` or "nominal"."""
    errors = {**result, "height": result[height]}
    return all(
        x is not None and abs(x) <= limit for key, limit in LIMITS.items() for x in errors[key]
    )


def summary(results: list[Row]) -> str:
    """Return the errors of the trial by class and speed, in words."""
    lines = []
    for letter, speed in sorted({tuple(r["case"][:2]) for r in results}):
        chosen = [r for r in results if tuple(r["case"][:2]) == (letter, speed)]
        good, nominal = sum(map(passes, chosen)), sum(passes(r, "nominal") for r in chosen)
        lines.append(
            f"class {letter}, {speed} km/h: {good} of {len(chosen)} within all limits, "
            f"{nominal} by nominal heights; {_heights(np.ravel([r['height'] for r in chosen]))}"
        )
    for k, name in enumerate(NAMES):
        place, of_surface, of_defect = (
            np.array([r[key][k] for r in results], dtype=float)
            for key in ("place_m", "height", "nominal")
        )
        lines.append(
            f"{name}: place {np.nanmean(place):+.2f} ± {np.nanstd(place):.2f} m, "
            f"{np.mean(np.abs(place) <= 0.5):.0%} within 0.5 m; {_heights(of_surface)}; "
            f"over the nominal {_heights(of_defect)}"
        )
        worst = int(np.argmax(np.abs(of_surface)))
        letter, speed, seed = results[worst]["case"]
        lines.append(
            f"{name}, worst: {100.0 * of_surface[worst]:+.0f} % on class {letter} at {speed} km/h, "
            f"seed {seed}"
        )
    for letter in sorted({r["case"][0] for r in results}):
        heights = np.array([r["height"] for r in results if r["case"][0] == letter])
        lines.append(
            f"class {letter}: {np.mean(np.abs(heights) <= LIMITS['height']):.0%} of "
            f"{heights.size} obstacles within 20 %"
        )
    speed = 100.0 * np.array([r["speed"] for r in results])
    lines.append(
        f"speed, of which distances are the integral: {speed.mean():+.2f} ± {speed.std():.2f} %, "
        f"at most {np.abs(speed).max():.2f} %"
    )
    iri = 100.0 * np.concatenate([r["iri"] for r in results])
    intervals = sum(r["iri_intervals"] for r in results)
    covered = sum(r["iri_covered"] for r in results) / max(intervals, 1)
    lines.append(
        f"IRI of segments: {iri.mean():+.1f} ± {iri.std():.1f} %, "
        f"{np.mean(np.abs(iri) <= 15.0):.0%} within 15 %, {covered:.0%} of {intervals} intervals "
        "hold it"
    )
    gain = np.array([r["short_waves"] for r in results])
    lines.append(
        f"waves of {SHORT_WAVES[0]} to {SHORT_WAVES[1]} m: {gain.mean():.2f} ± {gain.std():.2f} of "
        f"their true amplitude, {gain.min():.2f} to {gain.max():.2f}"
    )
    places, heights, nominals = np.mean([r["covered"] for r in results], axis=0) / 3.0
    false = sum(len(r["false"]) for r in results)
    good, nominal = sum(map(passes, results)), sum(passes(r, "nominal") for r in results)
    lines.append(
        f"within their intervals: {places:.0%} of places, {heights:.0%} of heights, "
        f"{nominals:.0%} of nominal heights; false obstacles: {false}"
    )
    doubts = sum(any("better:" in note for note in r["notes"]) for r in results)
    lines.append(f"drives whose right description was doubted: {doubts}")
    lines.append(
        f"{good} of {len(results)} reports within all limits, {nominal} by nominal heights"
    )
    lines.append(f"processor time of a report: at most {max(r['seconds'] for r in results):.0f} s")
    return "\n".join(lines)


def _heights(errors: np.ndarray) -> str:
    """Return the relative errors of heights in words."""
    within = np.mean(np.abs(errors) <= LIMITS["height"])
    return (
        f"height {100.0 * errors.mean():+.0f} ± {100.0 * errors.std():.0f} %, {within:.0%} "
        "within 20 %"
    )


@contextlib.contextmanager
def _arguments(*words):
    before, sys.argv = sys.argv, [str(word) for word in words]
    try:
        yield
    finally:
        sys.argv = before


def main() -> None:
    """Run the cases that the results do not have yet, and print the summary."""
    chosen = study_parser("Trial of the report.").parse_args()
    cases = [{"case": list(case)} for case in CASES]
    run_study(chosen, cases, compute, summary, lambda rows, path: None)


if __name__ == "__main__":
    main()
