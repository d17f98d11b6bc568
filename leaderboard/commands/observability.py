"""Command `observability`: bounds on the error of the road estimate by mode and speed."""

from pathlib import Path
from typing import Annotated, Any

from rich.table import Table

from leaderboard import commands
from leaderboard.commands.options import Sensors, Vehicle, option
from leaderboard.commands.output import Output
from leaderboard.observability import BANDWIDTHS, bounds_by_state
from leaderboard.report import plots
from road_envs.analysis.information_bound import RoadPrior
from road_envs.core.config import ConfigError, validate_choice
from road_envs.drives.reading import DEFAULT_VEHICLE
from road_envs.records.roughness import CLASSES
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle

_DEFAULT_MODES = ("ride", "handling", "front=ride,rear=handling", "front=handling,rear=ride")


def observability(
    *,
    speed_kmh: Annotated[list[float] | None, option("Speed in km/h; may be given again.")] = None,
    mode: Annotated[
        list[str] | None,
        option("Mode, as in `simulate`; may be given again. Default: those of the vehicle."),
    ] = None,
    road_class: Annotated[str, option("ISO 8608 class of the road, A to H.")] = "D",
    noise: Annotated[
        float | None, option("Noise density of each sensor in (m/s²)/sqrt(Hz); default: its own.")
    ] = None,
    mismatch: Annotated[
        float, option("Model error relative to the signal of each sensor.", min=0.0)
    ] = 0.0,
    damping: Annotated[
        str | None, option("Dampers in N s/m by mode, such as ride=2000,handling=5000.")
    ] = None,
    vehicle: Vehicle = DEFAULT_VEHICLE,
    sensors: Sensors = "paper",
    attainable: Annotated[
        bool,
        option(
            "Also compute the attainable error of the nonlinear vehicle by the bandwidth of "
            "the data, its van Trees bound, and the bound of linear estimators, to which friction "
            "is noise.",
            "--attainable",
        ),
    ] = False,
    out: Annotated[Path | None, option("Plot over spatial frequency to write.")] = None,
) -> Output:
    """Compute bounds on the error of an estimate by mode and speed, and plot them over frequency.

    The first table is the bound of the linear vehicle without friction: it shows where roll does
    not separate the wheel paths.
    """
    commands.check_output_path(out, *commands.PICTURES)
    car = load_vehicle(vehicle)
    validate_choice("road class", road_class, CLASSES)
    prior = RoadPrior(G_d0=CLASSES[road_class], track=2.0 * car.front.y_t)
    default = list(car.modes) if car.is_passive else _DEFAULT_MODES
    speeds = speed_kmh or [14.5, 54.0]
    modes = [commands.parse_mode(text) for text in mode or default]
    with commands.progress_bar() as progress:
        rows, curves = bounds_by_state(
            car, sensors, prior, modes, speeds, noise_density=noise, dampers=_dampers(damping),
            model_error=mismatch, attainable=attainable, with_curves=out is not None,
            progress=progress,
        )  # fmt: skip
    densities = load_instruments(sensors).noise_densities.tolist() if noise is None else [noise]
    ends = sorted({min(densities), max(densities)})  # one number, unless sensors have their own
    facts: dict[str, Any] = {"vehicle": vehicle, "sensors": sensors, "road_class": road_class}
    facts |= {"noise_density": ends if len(ends) > 1 else ends[0], "mismatch": mismatch}
    title = f"class {road_class}, noise {' to '.join(f'{x:g}' for x in ends)} (m/s²)/√Hz"
    title += f", {100 * mismatch:g} % mismatch" if mismatch else ""
    if out is not None:
        plots.draw_observability(curves, title, out)
    shows = [_table(rows, speeds, title), *([_attainable_table(rows)] if attainable else [])]
    return Output(facts={**facts, "bounds": rows}, shows=shows)


def _dampers(text: str | None) -> dict[str, float] | None:
    if text is None:
        return None
    pairs = commands.parse_pairs("damping", text)
    try:
        return {mode: float(value) for mode, value in pairs.items()}
    except ValueError:
        raise ConfigError(f"--damping must be mode=number in N s/m, got {text!r}") from None


def _attainable_table(rows: list[dict[str, Any]]) -> Table:
    heads = ("front / rear", "km/h", *(f"{f:g} Hz" for f in BANDWIDTHS), "van Trees", "linear")
    cells = []
    for row in rows:
        errors = *row["attainable"].values(), row["van_trees"], row["linear_estimators"]
        cells.append((row["mode"], f"{row['speed_kmh']:g}", *(f"{x:.3f}" for x in errors)))
    title = "Attainable in-band NRMSE: nonlinear vehicle, data up to ..."
    caption = (
        "one road; van Trees: no estimator errs less over all such roads; linear: friction is "
        "noise to linear estimators"
    )
    return commands.make_table(heads, cells, title=title, caption=caption)


def _table(rows: list[dict[str, Any]], speeds: list[float], title: str) -> Table:
    text = "{nrmse_left:.3f}, {nrmse_right:.3f}; {nrmse:.3f}"
    cells: dict[str, list[str]] = {}
    for row in rows:
        cells.setdefault(row["mode"], [row["mode"]]).append(text.format(**row))
    heads = ("front / rear", *(f"{speed:g} km/h" for speed in speeds))
    title = f"Bound of a linear vehicle without friction: {title}"
    caption = "in-band NRMSE: left, right wheel path; pooled"
    return commands.make_table(heads, cells.values(), title=title, caption=caption)
