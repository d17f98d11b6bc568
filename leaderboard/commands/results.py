"""Commands on folders of results: `run-job`, `verify`, `score`, `season`, `cite` and `clean`."""

import dataclasses
import re
import secrets
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from leaderboard import commands
from leaderboard.api import load_task as load_arrays
from leaderboard.commands.options import Json, LimitOptions, ResultsFolder, Share, argument, option
from leaderboard.commands.output import Output
from leaderboard.entries.entries import resolve_entries
from leaderboard.evaluation.tasks import load_task, shipped_tasks
from leaderboard.report.citation import as_bibtex, cite_entry
from leaderboard.running import jobs
from leaderboard.running.verification import (
    SHARE,
    Verified,
    load_verified,
    save_verified,
    verify_folder,
)
from leaderboard.sandbox.client import SandboxClient
from leaderboard.submission import hidden_seeds
from leaderboard.task_tables import score_file
from road_envs.core import artifacts
from road_envs.core.code_digest import cache_home
from road_envs.core.config import ConfigError
from road_envs.kernels import _numba

_RANDOM_ROAD_BOARDS = ("new_road", "field", "class")  # boards with random roads
_DEFAULT_FOLDER = Path("out/leaderboard")
_DIGEST = re.compile("[0-9a-f]{16}")  # of code, the name of a folder of compiled kernels
_SEASON_NAME = re.compile(r"[A-Za-z0-9._-]+")  # of a folder, as git and shells show it


def run_job(
    spec: Annotated[Path, argument("Job file from `leaderboard --plan`.")],
    out: ResultsFolder = _DEFAULT_FOLDER,
    json: Json = False,
) -> None:
    """Run one job and store its results for the next `leaderboard --out`.

    Jobs can be run any number of times and in parallel.
    """
    commands.check_output_folder(out)
    for done in jobs.run_job_file(spec, out):
        if json:
            commands.print_json(dataclasses.asdict(done))
        else:
            state = done.failure or "done"
            commands.console.print(f"{done.task}: {done.entry}, {done.condition}: {state}")


def verify(
    folder: Annotated[Path, argument("Folder of results, the --out of `leaderboard`.")],
    *,
    share: Share = SHARE,
    seed: Annotated[
        int | None, option("Seed of the choice of drives; drawn if missing.", min=0)
    ] = None,
    estimator: Annotated[
        list[str] | None,
        option("Entry of another package: wheel, folder or class; may be given again."),
    ] = None,
    limits: LimitOptions,
) -> Output:
    """Run a random tenth of stored drives again and compare; exit status 1 if one differs.

    Rows of this processor and its kernels are compared in all scores, those of others in the
    ranking score at a wider tolerance.
    What was found is kept in the folder: boards note rows of other processors without it.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder")
    load_verified(folder)  # what cannot be added to is told before the run
    commands.find_from_here(estimator or ())
    with SandboxClient(limits.parse()) as sandbox, commands.progress_bar() as progress:
        entries = resolve_entries(estimator or (), sandbox.describe)
        run = jobs.in_sandbox(sandbox)
        own = sandbox.limits.seconds, sandbox.limits.memory
        found = verify_folder(
            folder, run, entries, share=share, seed=seed, limits=own, report=progress
        )
    return verified_output(save_verified(found, folder))


def verified_output(found: Sequence[Verified]) -> Output:
    """Return what was found of each row; exit status 1 if one differs or is false."""
    run = [row for row in found if row.runs or row.is_false]
    agreeing = sum(row.agrees for row in run)
    cells = []
    for row in found:
        numbers = [""] * 3
        if row.runs:
            numbers = [str(row.runs), f"{row.distance:.1e}", f"{row.tolerance:.0e}"]
        verdict = "agrees" if row.agrees else f"DIFFERS: {row.is_far or 'no run'}"
        if row.reason:
            verdict = f"DIFFERS: {row.reason}" if row.is_false else row.reason
        task = f"{row.task}: {row.drives}" if row.drives else row.task
        cells.append([row.estimator, task, *numbers, str(row.score), verdict])
    heads = ("estimator", "task", "runs", "apart", "tolerance", "score", "result")
    table = commands.make_table(heads, cells, texts=("task", *heads[5:]), box=None)
    summary = (
        f"{agreeing} of {len(run)} rows agree on {found[0].kernels}; "
        f"{len(found) - len(run)} could not be run again"
    )
    facts = [{**dataclasses.asdict(row), "agrees": row.agrees} for row in found]
    return Output(facts=facts, shows=[table, summary], status=int(agreeing < len(run)))


def score(
    heights: Annotated[
        Path, argument("CSV or Parquet file: test_profiles of `dataset --task`, filled in.")
    ],
    *,
    task: Annotated[str, option("Task that the heights are of.")],
    roads: Annotated[
        int | None, option("Test drives per condition, as for `dataset`.", min=1)
    ] = None,
) -> Output:
    """Score heights of the test drives of a task, made by any program."""
    table = score_file(load_arrays(task, roads=roads), heights)
    return Output(facts=table.values, shows=[str(table)])


def season(
    out: Annotated[Path, option("Folder of the hidden test set.")],
    salt: Annotated[
        str | None, option("With --reveal: the secret salt, which was drawn and printed once.")
    ] = None,
    task: Annotated[
        list[str] | None,
        option("Shipped task; may be given again. Default: all with random roads."),
    ] = None,
    reveal: Annotated[
        bool, option("Verify the salt and write the tasks with their seeds.", "--reveal")
    ] = False,
) -> Output:
    """Publish the hash of a hidden test set, and later, with --reveal, its seeds."""
    if not _SEASON_NAME.fullmatch(name := out.resolve().name):
        raise ConfigError(
            "--out: the name of the folder may have the letters A to Z and a to z, digits, ., _ "
            f"and -, got {name!r}"
        )
    if reveal:
        if salt is None:
            raise ConfigError("--reveal needs the --salt of the hidden test set")
        if task:
            raise ConfigError("--reveal uses the tasks of the hidden test set; leave out --task")
        paths = [str(path) for path in hidden_seeds.reveal(salt, out)]
        commitment = hidden_seeds.load(out).commitment
        return Output(facts={"commitment": commitment, "salt": salt, "tasks": paths})
    if salt is not None:
        raise ConfigError("--salt is for --reveal: each season has a salt of its own, drawn")
    chosen = [load_task(name) for name in task or ()] or [
        each for each in shipped_tasks() if each.board_name in _RANDOM_ROAD_BOARDS
    ]
    salt = secrets.token_urlsafe(24)
    hidden = hidden_seeds.commit(salt, chosen)
    facts = {"commitment": hidden.commitment, "publish": str(hidden_seeds.save(hidden, out))}
    return Output(facts={**facts, "salt, to be kept secret": salt})


def cite(
    entry: Annotated[str | None, argument("Entry with a row in the folder.")] = None,
    out: ResultsFolder = _DEFAULT_FOLDER,
) -> None:
    """Print how to cite this project, and an entry with the versions of what ran."""
    cited = "" if entry is None else cite_entry(out, entry)
    typer.echo(as_bibtex() + cited, nl=False)


def clean(
    folder: Annotated[Path | None, argument("Default: the caches of this user.")] = None,
    dry_run: Annotated[bool, option("List them, delete nothing.", "--dry-run")] = False,
) -> Output:
    """Delete stale artifacts: results, cards, caches and compiled code that other code has made."""
    where = folder or cache_home()
    if folder is not None and not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder")
    found = [str(path) for path in artifacts.clean(where, delete=not dry_run)]
    for path in _kernels_of_other_code() if folder is None else []:
        found.append(str(path))
        if not dry_run:
            shutil.rmtree(path)
    what = "would be deleted" if dry_run else "deleted"
    summary = f"{len(found)} stale artifacts below {where} {what}"
    shows = [*found, summary] if dry_run else [summary]
    return Output(facts={"folder": str(where), "stale": found, "deleted": not dry_run}, shows=shows)


def _kernels_of_other_code() -> list[Path]:
    """Return the folders of this user's cache that have kernels of other code, and nothing else."""
    folders = [x for x in cache_home().glob("*") if _DIGEST.fullmatch(x.name) and x.is_dir()]
    return [
        folder
        for folder in sorted(folders)
        if folder != _numba.CACHE and not folder.is_symlink()
        and all(x.suffix in (".nbi", ".nbc", ".lock") for x in folder.rglob("*") if not x.is_dir())
    ]  # fmt: skip
