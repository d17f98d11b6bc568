"""Command `observability`: bounds on the error of the road estimate by mode and speed."""

import contextlib
import dataclasses
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

from estimators.map_smoother.attainable import attainable_error, van_trees_error
from leaderboard.commands import (
    check_output_path,
    make_table,
    parse_mode,
    parse_pairs,
    progress_bar,
)
from leaderboard.commands.options import Sensors, Vehicle
from leaderboard.commands.output import Output
from leaderboard.report import plots
from road_envs.analysis.information_bound import (
    Posterior,
    RoadPrior,
    bound,
    equivalent_damping,
)
from road_envs.core.config import ConfigError, validate_choice
from road_envs.drives.recording import simulate_record
from road_envs.records.record import F_C, scored_band
from road_envs.records.roughness import CLASSES
from road_envs.roads.iso8608 import Iso8608
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from road_envs.vehicle.suspension import decode_commands, encode_command

DEFAULT_MODES = (
    "ride",
    "handling",
    "front=ride,rear=handling",
    "front=handling,rear=ride",
)
PLOTTED_BAND = (0.05, 2.5)
"""Band [cycles/m] of the plot, cut at the low-pass of the sensors."""

BANDWIDTHS, ATTAINABLE_LENGTH = (25.0, 100.0, 333.0), 100.0
"""Bandwidths [Hz] of the data and length [m] of the road for the attainable error."""


def observability(
    *,
    speed_kmh: Annotated[
        list[float] | None, typer.Option(help="Speed in km/h; may be given again.")
    ] = None,
    mode: Annotated[
        list[str] | None,
        typer.Option(
            help="Mode, as in `simulate`; may be given again. Default: those of the vehicle."
        ),
    ] = None,
    road_class: Annotated[str, typer.Option(help="ISO 8608 class of the road, A to H.")] = "D",
    noise: Annotated[
        float | None,
        typer.Option(help="Noise density in (m/s²)/sqrt(Hz); default: that of the instruments."),
    ] = None,
    mismatch: Annotated[
        float, typer.Option(help="Model error relative to the signal of each sensor.", min=0.0)
    ] = 0.0,
    damping: Annotated[
        str | None,
        typer.Option(help="Dampers in N s/m by mode, such as ride=2000,handling=5000."),
    ] = None,
    vehicle: Vehicle = "land_rover_defender_110",
    sensors: Sensors = "paper",
    attainable: Annotated[
        bool,
        typer.Option(
            "--attainable",
            help="Also compute the attainable error of the nonlinear vehicle by the bandwidth of "
            "the data, its van Trees bound, and the bound of linear estimators, to which friction "
            "is noise.",
        ),
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Plot over spatial frequency to write.")] = None,
) -> Output:
    """Compute bounds on the error of an estimate by mode and speed, and plot them over frequency.

    The first table is the bound of the linear vehicle without friction: it shows where roll does
    not separate the wheel paths.
    """
    check_output_path(out, ".png", ".svg", ".pdf")
    car, instruments = load_vehicle(vehicle), load_instruments(sensors)
    if noise is not None:
        try:
            instruments = dataclasses.replace(instruments, noise_density=noise)
        except ValueError as error:
            raise ConfigError(str(error)) from None
    prior = RoadPrior(
        G_d0=CLASSES[validate_choice("road class", road_class, CLASSES)], track=2.0 * car.front.y_t
    )
    default = list(car.modes) if car.is_passive else DEFAULT_MODES
    speeds, modes = speed_kmh or [14.5, 54.0], [_parsed(text) for text in mode or default]
    for speed in speeds:
        if not (np.isfinite(speed) and speed > 0):
            raise ConfigError(f"the speed must be positive, got {speed} km/h")
    dampers = None if damping is None else _dampers(damping, car)
    # fails before anything is computed
    chosen = [_damping_by_strut(dampers, m, car) for m in modes]
    rows: list[dict[str, Any]] = []
    curves: list[tuple[str, float, Posterior, float]] = []
    jobs = [(*pair, speed) for pair in zip(modes, chosen, strict=True) for speed in speeds]
    with progress_bar() as progress:
        for k, (state, c, speed) in enumerate(jobs):
            name, v = front_rear(state), speed / 3.6
            progress(f"{name}, {speed:g} km/h", k / len(jobs))
            c = equivalent_damping(car, state, v, prior) if c is None else c
            settings: dict[str, Any] = {"damping": c, "model_error": mismatch}
            posterior = bound(car, state, v, instruments, prior, **settings)
            rows.append(_row(name, speed, c, posterior))
            if attainable:
                floor = bound(car, state, v, instruments, prior, residual_as_noise=True, **settings)
                rows[-1]["linear_estimators"] = floor.pooled
                rows[-1] |= _nonlinear(car, state, speed, sensors, noise, prior)
            if out is not None:
                n = np.geomspace(PLOTTED_BAND[0], min(PLOTTED_BAND[1], F_C / v), 3000)
                drawn = bound(car, state, v, instruments, prior, n=n, **settings)
                curves.append((name, speed, drawn, posterior.pooled))
    facts = {
        "vehicle": vehicle,
        "sensors": sensors,
        "road_class": road_class,
        "noise_density": instruments.noise_density,
        "mismatch": mismatch,
    }
    if out is not None:
        plots.draw_observability(curves, _title(facts), out)
    shows = [
        _table(rows, speeds, _title(facts)),
        *([_attainable_table(rows)] if attainable else []),
    ]
    return Output(facts={**facts, "bounds": rows}, shows=shows)


def front_rear(mode: str | dict[str, str]) -> str:
    """Return a short name of a mode, "ride / handling" for front and rear."""
    if isinstance(mode, str):
        return f"{mode} / {mode}"
    if set(mode) == {"front", "rear"}:
        return f"{mode['front']} / {mode['rear']}"
    return ", ".join(f"{wheel} {state}" for wheel, state in mode.items())


def _parsed(text: str) -> str | dict[str, str]:
    mode = parse_mode(text)
    assert mode is not None
    return mode


def _dampers(text: str, car: VehicleParameters) -> dict[str, float]:
    """Parse damping [N s/m] by mode from "ride=2000,handling=5000". Raises ConfigError."""
    dampers = {}
    for mode, value in parse_pairs("damping", text).items():
        validate_choice("suspension mode", mode, car.modes)
        with contextlib.suppress(ValueError):
            dampers[mode] = float(value)
        if not dampers.get(mode, math.nan) >= 0.0:
            raise ConfigError(
                f"a damper must have the form mode=number in N s/m, got '{mode}={value}'"
            )
    return dampers


def _damping_by_strut(
    dampers: dict[str, float] | None, mode: str | dict[str, str], car: VehicleParameters
) -> np.ndarray | None:
    """Return the damping (4,) [N s/m] of each strut in its mode; None without `dampers`."""
    stiff, high = (flags[0] for flags in decode_commands(np.array([encode_command(mode, car)])))
    if dampers is None:
        return None
    names = {state: name for name, state in car.modes.items()}
    modes = [names[bool(s), bool(h)] for s, h in zip(stiff, high, strict=True)]
    if missing := sorted(set(modes) - set(dampers)):
        raise ConfigError(f"--damping has {sorted(dampers)}, but no value for {missing}")
    return np.array([dampers[name] for name in modes])


def _row(mode: str, speed: float, damping: np.ndarray, posterior: Posterior) -> dict[str, Any]:
    left, right = posterior.nrmse()
    return {
        "mode": mode,
        "speed_kmh": speed,
        "band": scored_band(speed / 3.6),
        "nrmse": posterior.pooled,
        "nrmse_left": float(left),
        "nrmse_right": float(right),
        "damping": damping.tolist(),
    }


def _nonlinear(
    car: VehicleParameters,
    mode: str | dict[str, str],
    speed_kmh: float,
    sensors: str,
    noise: float | None,
    prior: RoadPrior,
) -> dict[str, Any]:
    """Return the attainable NRMSE for each of BANDWIDTHS on a road of ATTAINABLE_LENGTH, and the
    bound of van Trees for the widest.
    """
    road = Iso8608(G_d0=prior.G_d0, w=prior.w, track=prior.track, length=ATTAINABLE_LENGTH)
    record, truth = simulate_record(
        road, vehicle=car, speed_kmh=speed_kmh, mode=mode, instruments=sensors
    )
    options: dict[str, Any] = {"instruments": sensors, "noise_density": noise}
    attainable = {
        f"{f:g}": attainable_error(record, truth, car, prior, bandwidth=f, **options)
        for f in BANDWIDTHS
    }
    van_trees = van_trees_error(record, car, prior, bandwidth=BANDWIDTHS[-1], **options)
    return {"attainable": attainable, "van_trees": van_trees}


def _attainable_table(rows: list[dict[str, Any]]) -> Table:
    heads = ("front / rear", "km/h", *(f"{f:g} Hz" for f in BANDWIDTHS), "van Trees", "linear")
    errors = [
        (*row["attainable"].values(), row["van_trees"], row["linear_estimators"]) for row in rows
    ]
    return make_table(
        heads,
        [
            (row["mode"], f"{row['speed_kmh']:g}", *(f"{x:.3f}" for x in cells))
            for row, cells in zip(rows, errors, strict=True)
        ],
        title="Attainable in-band NRMSE: nonlinear vehicle, data up to ...",
        caption="one road; van Trees: no estimator errs less over all such roads; linear: friction "
        "is noise to linear estimators",
    )


def _title(facts: dict[str, Any]) -> str:
    text = f"class {facts['road_class']}, noise {facts['noise_density']:g} (m/s²)/√Hz"
    return text + (f", {100 * facts['mismatch']:g} % mismatch" if facts["mismatch"] else "")


def _table(rows: list[dict[str, Any]], speeds: list[float], title: str) -> Table:
    text = "{nrmse_left:.3f}, {nrmse_right:.3f}; {nrmse:.3f}"
    cells: dict[str, list[str]] = {}
    for row in rows:
        cells.setdefault(row["mode"], [row["mode"]]).append(text.format(**row))
    return make_table(
        ("front / rear", *(f"{speed:g} km/h" for speed in speeds)),
        cells.values(),
        title=f"Bound of a linear vehicle without friction: {title}",
        caption="in-band NRMSE: left, right wheel path; pooled",
    )
