"""`policies`: the league of suspension-switching policies."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from leaderboard import league
from leaderboard.commands import console, json_text, mode_of, print_json, progress_bar
from leaderboard.commands.drives import Json, Length
from leaderboard.statistics import Interval
from road_envs.config import ConfigError
from road_envs.files import write_text
from road_envs.manoeuvres import KINDS as MANOEUVRES
from road_envs.policies import REGISTRY


def policies(
    policy: Annotated[
        list[str] | None,
        typer.Option(help=f"Policy, may be given again: {', '.join(REGISTRY)}; default all."),
    ] = None,
    road: Annotated[str, typer.Option(help="Road family to drive on.")] = "iso_d",
    speed_kmh: Annotated[float, typer.Option(help="Speed in km/h.")] = 54.0,
    length: Length = 100.0,
    control: Annotated[str, typer.Option(help="What an action switches: vehicle, axle.")] = (
        "vehicle"
    ),
    mode: Annotated[str, typer.Option(help="4S4 mode at the start.")] = "ride",
    manoeuvre: Annotated[
        str | None, typer.Option(help=f"Manoeuvre on the way: {', '.join(MANOEUVRES)}.")
    ] = None,
    roads: Annotated[int, typer.Option(help="Number of test roads.", min=2)] = 10,
    steps: Annotated[int, typer.Option(help="Control intervals a learner gets.", min=1)] = (
        league.LEARNING_STEPS
    ),
    out: Annotated[Path | None, typer.Option(help="Folder for policies.json.")] = None,
    json: Json = False,
) -> None:
    """Compare policies on comfort, rattle space and tyre load over the same held-out roads."""
    scenario: dict[str, Any] = {
        "road": road,
        "speed_kmh": speed_kmh,
        "length": length,
        "control": control,
        "mode": mode_of(mode),
        "manoeuvre": manoeuvre,
    }
    seeds = range(league.TEST_SEEDS.start, league.TEST_SEEDS.start + roads)
    with progress_bar() as progress:
        standings = league.compare(
            policy or list(REGISTRY),
            scenario=scenario,
            learning_steps=steps,
            seeds=seeds,
            progress=progress,
        )
    rows = [_row(s) for s in standings]
    data = {"scenario": scenario, "seeds": list(seeds), "learning_steps": steps, "rows": rows}
    if out:
        write_text(out / "policies.json", json_text(data))
    print_json(data) if json else _print(standings, scenario, roads)
    if failed := [s.policy for s in standings if s.failure]:
        raise ConfigError(f"{', '.join(failed)} failed; the others stand")


def _row(standing: league.Standing) -> dict[str, Any]:
    return {
        "policy": standing.policy,
        "failure": standing.failure,
        **{name: x._asdict() for name, x in standing.intervals.items()},
        "drives": {name: x.tolist() for name, x in standing.drives.items()},
    }


def _print(standings: list[league.Standing], scenario: dict[str, Any], roads: int) -> None:
    manoeuvre = scenario["manoeuvre"]
    where = "{road}, {length:g} m, {speed_kmh:g} km/h".format(**scenario)
    table = Table(
        title=f"Switching policies on {roads} held-out roads: {where}",
        title_justify="left",
        box=None,
        padding=(0, 1),
        pad_edge=False,
    )
    table.add_column("policy", no_wrap=True)
    for heading in ("comfort\nm/s²", "rattle\nmm", "tyre load\n-", "switches\n1/km", "return\n-"):
        table.add_column(heading, justify="right", no_wrap=True)
    for standing in standings:
        if standing.failure:
            table.add_row(standing.policy, f"failed: {standing.failure}", style="red")
            continue
        x = standing.intervals
        table.add_row(
            standing.policy,
            _span(x["comfort"], 1.0, 2),
            _span(x["rattle"], 1000.0, 1),
            _span(x["tyre_load"], 1.0, 3),
            f"{x['switches_per_km'].mean:.0f}",
            _span(x["episode_return"], 1.0, 2),
        )
    console.print(table)
    console.print(
        "Interquartile means over roads, ± half the 95 % bootstrap interval; lower is better, for "
        "the return higher."
    )
    if manoeuvre is None:
        console.print("Without manoeuvres nothing rewards handling: see --manoeuvre.")


def _span(x: Interval, factor: float, digits: int) -> str:
    half = 0.5 * factor * (x.high - x.low)
    return f"{factor * x.mean:.{digits}f} ±{half:.{digits}f}"
