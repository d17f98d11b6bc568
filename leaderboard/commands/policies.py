"""Commands `policies`, `tune-policy`, `train-policy`: suspension-switching policies."""

import contextlib
import dataclasses
import functools
import json as json_module
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

import estimators
from estimators.api import Estimator, refits_per_case
from leaderboard.commands import (
    check_output_folder,
    check_output_path,
    console,
    import_from_here,
    notices,
    on_interrupt,
    print_json,
    progress_bar,
    to_json,
)
from leaderboard.commands.options import Isolation, Json, MemoryLimit, TimeLimit, parse_limits
from leaderboard.policies import best_found, comparison, grid_search, safe_comparison
from leaderboard.policies import page as policy_page
from leaderboard.policies.comparison import PolicyResult
from leaderboard.policies.policy_process import POLICY_LIMITS, PolicyProcess
from leaderboard.policies.ride_metrics import METRICS
from leaderboard.policies.scenarios import load_scenarios
from leaderboard.policies.store import RowStore
from leaderboard.policies.summary import REFERENCE, format_metric, summarize_results
from leaderboard.policies.training_study import evaluate_study, study_lines, train_seeds
from leaderboard.report.rendering import POLICY_PAGE, write_pending
from leaderboard.sandbox import bubblewrap
from leaderboard.sandbox.limits import Limits
from road_envs.core.atomic_io import write_text
from road_envs.core.config import ConfigError, validate_choice
from road_envs.policies import FILE_SUFFIX, REGISTRY, make_policy, names, runs_foreign_code
from road_envs.policies.fixed import FixedPair
from road_envs.policies.greedy_information import GreedyInformation
from road_envs.policies.safe_rollout import SafeDrives
from road_envs.vehicle.suspension import MODES

COLUMNS = ("comfort", "tyre_load", "switches_per_km", "return")
WIDE_COLUMNS = (*COLUMNS, "vdv", "rattle", "stops_per_km", "roll_peak", "dwell", "bound")
"""Columns of the table by default and with --wide; the page has all."""
SAFE_REFERENCE = "rrms"
"""Policy of the benchmark that differences refer to by default."""

SWEPT_WEIGHTS = (15.0, 30.0, 300.0, 2000.0)
"""Information weights of the sensing policies in the Pareto plot. Each gives a different policy at
some speed of the league scenarios; weight 0 is the policy `ride`.
"""


def policies(
    *,
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="Policy: a name of `road-recon list policies`, module:Class, or a file from "
            "`train-policy`; may be given again. Default: all of this package, and installed "
            "ones where they can be isolated."
        ),
    ] = None,
    scenarios: Annotated[
        str | None,
        typer.Option(
            help="Sensing comparison: a name of `road-recon list scenarios`, or a YAML path; "
            "without it, the public drives of RoadRecon/Safe4S4-v1."
        ),
    ] = None,
    estimator: Annotated[
        list[str] | None,
        typer.Option(help="Estimator applied to the records; may be given again."),
    ] = None,
    roads: Annotated[int | None, typer.Option(help="Test roads of each case.", min=2)] = None,
    drives: Annotated[
        int, typer.Option(help="Public drives of the benchmark, each to both sides.", min=2)
    ] = safe_comparison.PUBLIC_DRIVES,
    generations: Annotated[
        int, typer.Option(help="Generations of the search for the best switching; 0: none.", min=0)
    ] = best_found.GENERATIONS,
    seal: Annotated[
        str | None, typer.Option(help="Secret text of the sealed drives, instead of public ones.")
    ] = None,
    reference: Annotated[str | None, typer.Option(help="Policy that differences refer to.")] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="The quick scenarios, without sweep: half a minute.")
    ] = False,
    sweep: Annotated[
        bool, typer.Option("--sweep", help="Add sensing policies with other information weights.")
    ] = False,
    wide: Annotated[
        bool, typer.Option("--wide", help="More columns, wider than 80 characters.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for results, plot and page; or a .png for the plot.")
    ] = None,
    kept: Annotated[
        Path | None,
        typer.Option(
            "--from", help="Draw the page or plot of a stored policies.json; simulate nothing."
        ),
    ] = None,
    time_limit: TimeLimit = POLICY_LIMITS.seconds,
    memory_limit: MemoryLimit = POLICY_LIMITS.memory,
    isolation: Isolation = "auto",
    json: Json = False,
) -> None:
    """Compare policies by comfort, handling and estimation error on held-out roads."""
    if kept:
        _redraw(kept, out)
        return
    if quick and (scenarios is not None or sweep):
        raise ConfigError(
            "--quick means the quick scenarios without sweep: leave out --scenarios and --sweep"
        )
    limits = parse_limits(time_limit, memory_limit, isolation)
    if scenarios is None and not (quick or sweep or estimator or roads):
        draw = functools.partial(safe_comparison.public_drives, drives, seal)
        _benchmark(policy, draw, reference or SAFE_REFERENCE, generations, limits, out, json)
        return
    reference = reference or REFERENCE
    chosen = load_scenarios(scenarios or "quick")
    seeds = chosen.test_seeds(roads)
    entries = _entries(policy, limits)
    validate_choice("reference", reference, list(entries) if policy else [*entries, REFERENCE])
    if sweep:
        entries |= {
            f"{policy_page.SWEEP_PREFIX}{w:g}": GreedyInformation(weight=w) for w in SWEPT_WEIGHTS
        }
    applied = {name: _make_estimator(name) for name in estimator or ["fir_ridge"]}
    check_output_folder(out)
    store = RowStore(out / "policies", chosen, seeds, applied) if out else None
    keepable = {n: p for n, p in entries.items() if store and not isinstance(p, PolicyProcess)}
    rows = {n: store.load(n, p) for n, p in keepable.items()} if store else {}
    finished = {n: row for n, row in rows.items() if row is not None}
    if out:
        write_pending(out / POLICY_PAGE, "Switching policies", f"policies --out {out}")
    kept_rows = f"finished policies are kept in {out}; the same command continues" if out else ""

    def keep(result: PolicyResult) -> None:
        if store and result.policy in keepable:
            store.save(result, entries[result.policy])

    with contextlib.ExitStack() as processes, on_interrupt(kept_rows), progress_bar() as progress:
        for entry in entries.values():
            if isinstance(entry, PolicyProcess):
                processes.enter_context(entry)
        results = comparison.compare(
            chosen,
            entries,
            applied,
            roads=roads,
            seconds=limits.seconds,
            finished=finished,
            on_result=keep,
            progress=progress,
        )
        data = summarize_results(chosen, results, seeds, reference)
        if out:
            write_text(out / "policies.json", to_json(data))
            timelines = {r.policy: r.timeline for r in results if r.timeline is not None}
            page = policy_page.write_policy_page(data, timelines, out)
            notices.print(f"page: {page}")
    print_json(data) if json else _print(data, WIDE_COLUMNS if wide else COLUMNS)
    if failed := [r.policy for r in results if r.failure]:
        raise ConfigError(f"failed policies: {', '.join(failed)}; the other results are valid")


def _benchmark(
    policy: list[str] | None,
    draw: Callable[[], SafeDrives],
    reference: str,
    generations: int,
    limits: Limits,
    out: Path | None,
    json: bool,
) -> None:
    """Compare policies on the drives of the benchmark that `draw` returns."""
    check_output_folder(out)
    entries = _entries(policy, limits)
    if policy is None:
        pairs = {f"{f}/{r}": FixedPair(front=f, rear=r) for r in MODES for f in MODES}  # type: ignore[arg-type]
        entries = {n: p for n, p in entries.items() if not n.startswith("fixed")} | pairs
    elif reference not in entries:
        entries[reference] = make_policy(reference)
    with contextlib.ExitStack() as processes, on_interrupt(""), progress_bar() as progress:
        for entry in entries.values():
            if isinstance(entry, PolicyProcess):
                processes.enter_context(entry)
        drives = draw()
        drives.threads = min(2, os.cpu_count() or 1)
        data = safe_comparison.compare_safely(
            entries, drives, reference, generations=generations, seconds=limits.seconds,
            progress=progress,
        )  # fmt: skip
    lines = _benchmark_lines(data)
    if out:
        write_text(out / "benchmark.json", to_json(data))
        write_text(out / "benchmark.txt", "\n".join(lines) + "\n")
    if json:
        print_json(data)
    for line in [] if json else lines:
        console.print(line, soft_wrap=True, highlight=False)
    if failed := [row["policy"] for row in data["rows"] if row["failure"]]:
        raise ConfigError(f"failed policies: {', '.join(failed)}; the other results are valid")


def _benchmark_lines(data: dict[str, Any]) -> list[str]:
    """Return the lines of the table, best score first."""
    lines = [
        f"{data['benchmark']}, {data['split']}: {data['drives']} drives, half of them mirrored",
        f"{'policy':20s} score   95 %             comfort viol.  left right unseen    S3  "
        f"load tr. roll  +/=/- {data['reference']}",
    ]
    rows = [row for row in data["rows"] if not row["failure"]]
    for row in sorted(rows, key=lambda row: -row["score"]["mean"]):
        g, s = row["groups"], row["score"]
        left, right, unseen, s3 = (
            f"{g[name]['score']:6.2f}" if name in g else "   n/a"
            for name in ("left", "right", "unseen", "S3")
        )
        lines.append(
            f"{row['policy']:20s} {s['mean']:6.3f} {s['low']:7.3f} to {s['high']:6.3f} "
            f"{row['comfort']['mean']:6.3f} {row['violations']:5.0%} {left} {right} {unseen} {s3} "
            f"{row['load_transfer']:5.2f} {row['roll']:6.1f}  "
            f"{row['wins']}/{row['ties']}/{row['losses']}"
        )
    lines += [f"{r['policy']} failed: {r['failure']}" for r in data["rows"] if r["failure"]]
    return [
        *lines,
        "score [m²/s⁴]: minus mean-square comfort and the price of violations; higher is better.",
        f"{safe_comparison.BEST_FOUND}: search on the known road, not attainable.",
    ]


def chosen_isolation(isolation: str) -> Any:
    """Return "bubblewrap" or "process" by the option; None if neither may be used.

    Raises ConfigError.
    """
    if isolation == "process":
        return isolation
    obstacle = bubblewrap.obstacle()
    if obstacle is not None and isolation == "bubblewrap":
        raise ConfigError(f"{obstacle}; install it, or choose the isolation process")
    return "bubblewrap" if obstacle is None else None


def policy_reference(reference: str, isolation: str) -> str:
    """Return a reference to a policy that may be run. Raises ConfigError."""
    import_from_here([reference])
    if ":" not in reference and not reference.endswith(FILE_SUFFIX):
        validate_choice("policy", reference, names())
    foreign = runs_foreign_code(reference)
    if foreign and chosen_isolation(isolation) is None:
        raise ConfigError(
            f"the policy {reference} is not part of this package, and {bubblewrap.obstacle()}: "
            "install it, or give --isolation process if you trust its code with your rights"
        )
    return reference


def _entries(references: list[str] | None, limits: Limits) -> dict[str, Any]:
    """Return the policies by name, those of other packages in processes. Raises ConfigError."""
    if references is None:
        isolated = chosen_isolation(limits.isolation)
        references = list(names() if isolated else REGISTRY)
    entries: dict[str, Any] = {}
    for reference in references:
        policy_reference(reference, limits.isolation)
        name = reference.rpartition(":")[2]
        name = Path(name).stem if name.endswith(FILE_SUFFIX) else name
        if name in entries:
            raise ConfigError(f"two policies have the name {name!r}: give each of them once")
        if runs_foreign_code(reference):
            own = dataclasses.replace(limits, isolation=chosen_isolation(limits.isolation))
            entries[name] = PolicyProcess(reference, limits=own)
        else:
            entries[name] = make_policy(reference)
    return entries


def _redraw(kept: Path, out: Path | None) -> None:
    """Draw the page (without drives) or the plot of a kept comparison."""
    if out is None:
        raise ConfigError("--from needs --out: a folder for the page, or a .png for the plot")
    try:
        data = json_module.loads(kept.read_bytes())
        if out.suffix == ".png":
            policy_page.draw_pareto(data, out)
        else:
            policy_page.write_policy_page(data, {}, out)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{kept} is not the policies.json of a comparison: {error!r}") from None
    notices.print(f"written: {out}")


def tune_policy(
    name: Annotated[str, typer.Argument(help="Policy to tune.")],
    drives: Annotated[
        int, typer.Option(help="Training drives, each to both sides.", min=1)
    ] = grid_search.TRAINING_DRIVES,
    out: Annotated[Path | None, typer.Option(help="YAML file for the settings.")] = None,
) -> None:
    """Search the settings of a policy on training drives only."""
    validate_choice("policy", name, grid_search.GRIDS)
    check_output_path(out, ".yaml", ".yml")
    with progress_bar() as progress:
        best = grid_search.tune(name, grid_search.training_drives(drives), progress)
    command = f"road-recon tune-policy {name} --drives {drives}"
    if out:
        write_text(out, grid_search.as_yaml(best, command))
    for row in best.trials:
        console.print(f"{row.cost:.4f}  {row.settings}")
    console.print(f"best: {best.settings}, cost {best.cost:.4f} m²/s⁴")


def train_policy(
    *,
    name: Annotated[
        str, typer.Argument(help="ppo, dqn, ppo_sensing, ppo_preview, or a YAML file.")
    ],
    out: Annotated[Path, typer.Option(help="File for the best network (.npz).")],
    scenarios: Annotated[str, typer.Option(help="Scenarios for training.")] = "training",
    seed: Annotated[int, typer.Option(help="First training seed.", min=0)] = 1,
    seeds: Annotated[int, typer.Option(help="Number of training seeds.", min=1)] = 1,
    steps: Annotated[int | None, typer.Option(help="Total number of actions.", min=1)] = None,
    checkpoint: Annotated[
        Path | None, typer.Option(help="Checkpoint file, loaded if it exists.")
    ] = None,
    log: Annotated[Path | None, typer.Option(help="Folder for TensorBoard logs.")] = None,
) -> None:
    """Train a policy with Stable-Baselines3 on training roads, evaluate it on held-out ones."""
    training_config = grid_search.load_training_config(name, steps)
    check_output_path(out, ".npz")
    chosen = load_scenarios(scenarios)
    kept = f"the state is kept in {checkpoint}; the same command continues" if checkpoint else ""
    with on_interrupt(kept), progress_bar() as progress:
        learning = train_seeds(
            training_config,
            chosen,
            range(seed, seed + seeds),
            checkpoint=checkpoint,
            log=log,
            progress=progress,
        )
        evaluation = evaluate_study(learning, chosen, training_config.unresolved_variance)
    grid_search.write_bytes(out, learning.best.to_bytes())
    write_text(out.with_suffix(".json"), to_json(evaluation))
    for network, curve in zip(learning.networks, learning.curves, strict=True):
        for done, value in curve:
            console.print(
                f"seed {network.metadata['seed']}: {done:8d} steps  return {value:.4f} per second"
            )
    for line in study_lines(Path(name).stem, evaluation):
        console.print(line)


def _make_estimator(name: str) -> Estimator:
    """Create an estimator, without pretrained weights if it can be fitted to a case in seconds.

    The weights were trained without manoeuvres and not in every pair of modes, so the estimator is
    fitted to the drives of each policy instead.
    """
    estimator = estimators.create(name)
    return estimators.create(name, shipped=False) if refits_per_case(estimator) else estimator


def _print(data: dict[str, Any], columns: Sequence[str]) -> None:
    console.print(
        f"Switching policies on {len(data['seeds'])} held-out roads: {data['title']}",
        soft_wrap=True,
    )
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
    names = next((list(row["errors"]) for row in data["rows"] if not row["failure"]), [])
    table.add_column("policy", no_wrap=True)
    heads = [f"{METRICS[name].head}\n{METRICS[name].unit}" for name in columns]
    for heading in (*heads, *(name.replace("_", "\n", 1) for name in names)):
        table.add_column(heading, justify="right", no_wrap=True)
    failed = [row for row in data["rows"] if row["failure"]]
    for row in data["rows"]:
        if row["failure"]:
            continue
        cells = [format_metric(name, row["metrics"][name]["mean"]) for name in columns]
        cells += [_span(row["errors"][name]) for name in names]
        table.add_row(row["policy"] + ("" if row["attainable"] else " *"), *cells)
    needed = console.measure(table, options=console.options.update(width=500)).maximum
    Console(file=console.file, width=max(needed, console.width), markup=False).print(
        table
    )  # not truncated
    for row in failed:
        console.print(f"{row['policy']} failed: {row['failure']}", style="red")
    console.print(
        "Means over cases of interquartile means over roads; an estimator's column is its\n"
        "in-band NRMSE with half the 95 % bootstrap interval over roads. Lower is better,\n"
        "for the return higher. * uses the true road: not attainable."
    )
    for note in dict.fromkeys(note for row in data["rows"] for note in row["notes"]):
        console.print(note)


def _span(x: dict[str, float]) -> str:
    half = 0.5 * (x["high"] - x["low"])
    return f"{x['mean']:.3f} ±{half:.3f}" if half == half else "–"
