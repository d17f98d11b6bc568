"""`policies`: the league of suspension-switching policies; `tune-policy`, `train-policy`."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

import estimators
from estimators.api import Estimator
from leaderboard.commands import (
    check_output_path,
    console,
    notices,
    print_json,
    progress_bar,
    to_json,
)
from leaderboard.commands.simulate import Json
from leaderboard.policies import comparison, grid_search
from leaderboard.policies import page as policy_page
from leaderboard.policies.scenarios import load_scenarios
from leaderboard.policies.summary import REFERENCE, format_metric, summarize_results
from leaderboard.policies.training_study import evaluate_study, study_lines, train_seeds
from road_envs._atomic_io import write_text
from road_envs.config import ConfigError, validate_choice
from road_envs.policies import available, create
from road_envs.policies.greedy_information import GreedyInformation

COLUMNS = {
    "comfort": "comfort\nm/s²",
    "tyre_load": "tyre\nload",
    "switches_per_km": "switch\n1/km",
    "reward": "return\n1/s",
}
WIDE_COLUMNS = {
    **COLUMNS,
    "vdv": "VDV\nm/s^1.75",
    "rattle": "rattle\nmm",
    "stops_per_km": "stops\n1/km",
    "roll_peak": "roll\ndeg",
    "dwell": "dwell\ns",
    "bound": "bound\n",
}
"""Columns of the table, by default and with --wide; the page has all."""
SWEPT_WEIGHTS = (15.0, 30.0, 300.0, 2000.0)
"""Weights of information of the sensing policies in the Pareto plot, beside `greedy_information` at
its own and none, which is ride: each makes another choice at some speed of the league.
"""


def policies(
    policy: Annotated[
        list[str] | None, typer.Option(help="Policy, may be given again. Default: all.")
    ] = None,
    scenarios: Annotated[
        str, typer.Option(help="Scenarios: shipped name (quick, league) or YAML path.")
    ] = "quick",
    estimator: Annotated[
        list[str] | None,
        typer.Option(help="Estimator fed with the drives' records; may be given again."),
    ] = None,
    roads: Annotated[int | None, typer.Option(help="Test roads of each case.", min=2)] = None,
    reference: Annotated[
        str, typer.Option(help="Policy from which differences are taken.")
    ] = REFERENCE,
    quick: Annotated[
        bool, typer.Option("--quick", help="The quick scenarios, without sweep: half a minute.")
    ] = False,
    sweep: Annotated[
        bool, typer.Option("--sweep", help="Sensing policies with other weights of information.")
    ] = False,
    wide: Annotated[
        bool, typer.Option("--wide", help="More columns than 80 characters hold.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for results, picture and page.")] = None,
    json: Json = False,
) -> None:
    """Compare policies on comfort, handling and what their drives tell of held-out roads."""
    if quick and (scenarios != "quick" or sweep):
        raise ConfigError("--quick stands for the quick scenarios and no sweep: leave the others")
    chosen = load_scenarios(scenarios)
    seeds = chosen.test_seeds(roads)
    known = [*available(), comparison.ORACLE]
    names = [validate_choice("policy", name, known) for name in policy or known]
    validate_choice("reference", reference, names if policy else known)
    entries: dict[str, Any] = {n: None if n == comparison.ORACLE else create(n) for n in names}
    if sweep:
        entries |= {
            f"{policy_page.SWEEP_PREFIX}{w:g}": GreedyInformation(weight=w) for w in SWEPT_WEIGHTS
        }
    readers = {name: _make_estimator(name) for name in estimator or ["fir_ridge"]}
    if out is not None and out.exists() and not out.is_dir():
        raise ConfigError(f"{out} is a file; a folder is wanted")
    with progress_bar() as progress:
        found = comparison.compare(chosen, entries, readers, roads=roads, progress=progress)
        data = summarize_results(chosen, found, seeds, reference)
        if out:
            write_text(out / "policies.json", to_json(data))
            shown = {s.policy: s.timeline for s in found if s.timeline is not None}
            page = policy_page.write_policy_page(data, shown, out)
            notices.print(f"page: {page}")
    print_json(data) if json else _print(data, WIDE_COLUMNS if wide else COLUMNS)
    if failed := [s.policy for s in found if s.failure]:
        raise ConfigError(f"{', '.join(failed)} failed; the others stand")


def tune_policy(
    name: Annotated[str, typer.Argument(help="Policy to tune.")],
    scenarios: Annotated[
        str, typer.Option(help="Scenarios whose training roads are driven.")
    ] = "training",
    out: Annotated[Path | None, typer.Option(help="YAML file for the settings.")] = None,
) -> None:
    """Search a policy's settings on training roads alone."""
    validate_choice("policy", name, grid_search.GRIDS)
    check_output_path(out, ".yaml", ".yml")
    with progress_bar() as progress:
        best = grid_search.tune(name, load_scenarios(scenarios), progress)
    command = f"road-recon tune-policy {name} --scenarios {scenarios}"
    if out:
        write_text(out, grid_search.as_yaml(best, command))
    for row in best.trials:
        console.print(f"{row.cost:.4f}  {row.settings}")
    console.print(f"best: {best.settings}, cost {best.cost:.4f} per second")


def train_policy(
    name: Annotated[
        str, typer.Argument(help="ppo, dqn, ppo_sensing, ppo_preview, or a YAML file.")
    ],
    out: Annotated[Path, typer.Option(help="File for the best network, .npz.")],
    scenarios: Annotated[str, typer.Option(help="Scenarios to learn on.")] = "training",
    seed: Annotated[int, typer.Option(help="First seed of the trainings.", min=0)] = 1,
    seeds: Annotated[int, typer.Option(help="How many trainings.", min=1)] = 1,
    steps: Annotated[int | None, typer.Option(help="Choices of an action in all.", min=1)] = None,
    checkpoint: Annotated[
        Path | None, typer.Option(help="Taken up if it is there, kept while learning.")
    ] = None,
    log: Annotated[Path | None, typer.Option(help="Folder for TensorBoard.")] = None,
) -> None:
    """Train a network with Stable-Baselines3 on training roads alone; judge it on held-out ones."""
    training_config = grid_search.load_training_config(name, steps)
    check_output_path(out, ".npz")
    chosen = load_scenarios(scenarios)
    with progress_bar() as progress:
        learning = train_seeds(
            training_config,
            chosen,
            range(seed, seed + seeds),
            checkpoint=checkpoint,
            log=log,
            progress=progress,
        )
        told = evaluate_study(learning, chosen, training_config.unresolved_variance)
    grid_search.write_bytes(out, learning.best.to_bytes())
    write_text(out.with_suffix(".json"), to_json(told))
    for network, curve in zip(learning.networks, learning.curves, strict=True):
        for done, value in curve:
            console.print(
                f"seed {network.metadata['seed']}: {done:8d} steps  return {value:.4f} per second"
            )
    for line in study_lines(Path(name).stem, told):
        console.print(line)


def _make_estimator(name: str) -> Estimator:
    """An estimator. One that can be fitted to a case in seconds leaves its weights at home: they
    know no manoeuvre and not every pair of states, and here it is fitted to each policy's drives.
    """
    one = estimators.create(name)
    fits = getattr(type(one), "refit_per_case", False)
    return estimators.create(name, shipped=False) if fits else one


def _print(data: dict[str, Any], shown: dict[str, str]) -> None:
    console.print(
        f"Switching policies on {len(data['seeds'])} held-out roads: {data['title']}",
        soft_wrap=True,
    )
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
    names = next((list(row["errors"]) for row in data["rows"] if not row["failure"]), [])
    table.add_column("policy", no_wrap=True)
    for heading in (*shown.values(), *(name.replace("_", "\n", 1) for name in names)):
        table.add_column(heading, justify="right", no_wrap=True)
    failed = [row for row in data["rows"] if row["failure"]]
    for row in data["rows"]:
        if row["failure"]:
            continue
        cells = [format_metric(name, row["metrics"][name]["mean"]) for name in shown]
        cells += [_span(row["errors"][name]) for name in names]
        table.add_row(row["policy"] + ("" if row["attainable"] else " *"), *cells)
    needed = console.measure(table, options=console.options.update(width=500)).maximum
    Console(file=console.file, width=max(needed, console.width)).print(table)  # never cut
    for row in failed:
        console.print(f"{row['policy']} failed: {row['failure']}", style="red")
    console.print(
        "Means over cases of interquartile means over roads; an estimator's column is its\n"
        "in-band NRMSE with half the 95 % bootstrap interval over roads. Lower is better,\n"
        "for the return higher. * knows the road: not attainable."
    )
    for note in dict.fromkeys(note for row in data["rows"] for note in row["notes"]):
        console.print(note)


def _span(x: dict[str, float]) -> str:
    half = 0.5 * (x["high"] - x["low"])
    return f"{x['mean']:.3f} ±{half:.3f}" if half == half else "–"
