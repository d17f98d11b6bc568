"""Submissions: one folder with the code of an entry, its card and its results, made and verified.

code/             the wheel, or the folder of installed packages, that is run
card.yaml         what its authors say about it
results/, cards/, definitions/   rows, probes and tasks, as `leaderboard` writes them
submission.json   name, version of the code, what it cost, and the SHA-256 of every other file
"""

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from leaderboard.conformance.checks import check_entry
from leaderboard.conformance.probes import PROBES
from leaderboard.conformance.results import card_identity, find_card, probe_entries
from leaderboard.entries import entry_files
from leaderboard.entries.entries import find_reference, fold, resolve_entries
from leaderboard.entries.entry import NAME, Entry
from leaderboard.evaluation import store
from leaderboard.evaluation.provenance import describe_environment, package_version
from leaderboard.evaluation.tasks import Task
from leaderboard.method_card import load_method_card
from leaderboard.running.board import Board, baseline_names, run_board
from leaderboard.running.executors import ProcessExecutor
from leaderboard.running.jobs import in_sandbox
from leaderboard.running.verification import Verified, verify_folder
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from leaderboard.submission import signature
from leaderboard.submission.dependencies import missing_packages
from leaderboard.submission.rules import Rules, make_run_request
from road_envs.core.artifacts import Kind
from road_envs.core.atomic_io import PARTIAL_SUFFIX, TempFolder, new_folder, write_text
from road_envs.core.config import ConfigError, Settings, build

SUBMISSION = Kind("submission", 1)
RECORD, CARD = signature.RECORD, "card.yaml"
_PARTS = "jobs"
# a verification of some drives could be repeated until it misses those that were forged
SUBMISSION_SHARE = 1.0  # of the drives are run again
_Progress = Callable[[str, float], None]


@dataclass(frozen=True, kw_only=True)
class _Submission(Settings):
    """Record of a submission; `cpu_seconds` is the processor time of all its runs together."""

    name: str
    code: str
    package_version: str
    hardware: dict[str, str]
    cpu_seconds: float
    files: dict[str, str]  # SHA-256 of each file, by its path in the folder


def make_submission(
    wheel: Path,
    card: Path,
    rules: tuple[Rules, Sequence[Task]],
    folder: Path,
    limits: Limits,
    workers: int = 1,
    progress: _Progress = lambda text, share: None,
) -> tuple[_Submission, Board]:
    """Check an entry, run it by the `rules` and write the folder of its submission; with its board.
    What was driven before it was stopped or failed is not driven again. Raises ConfigError for a
    card that is not filled in, packages that boards lack, a failed check, a failed row, and a
    folder that exists or that another process makes.
    """
    load_method_card(card)
    with new_folder(folder) as partial, _keeping_parts(folder, partial / _PARTS) as spent:
        (partial / "code").mkdir()
        entry_files.snapshot(find_reference(str(wheel)), partial / "code")
        shutil.copyfile(card, partial / CARD)
        with SandboxClient(limits) as sandbox:
            entry = _working_entry(partial, sandbox)
            if folder.resolve().name != entry.name:  # before all is run
                raise ConfigError(f"{folder}: it must have the name of its entry, {entry.name}")
            progress(f"checking {entry.name}", 0.0)
            for missing in missing_packages(partial / "code"):
                raise ConfigError(f"{entry.name}: {missing}")
            for check in check_entry(entry, sandbox, limits):
                if check.passed is False and check.name not in PROBES:  # shown beside its name
                    raise ConfigError(f"{entry.name} fails the check {check.name}: {check.message}")
        request = make_run_request(*rules, [entry], limits)
        board = run_board(request, partial, ProcessExecutor(workers), progress)
        for failed in (row for task in board.tasks for row in board.failed(task)):
            raise ConfigError(f"{failed.estimator} failed on {failed.task}: {failed.failure}")
        cost = round(spent(), 1)
        (partial / _PARTS).unlink()
        record = _Submission(
            name=entry.name, code=entry.code, package_version=package_version(),
            hardware=describe_environment(), cpu_seconds=cost, files=_digests(partial),
        )  # fmt: skip
        SUBMISSION.write(partial / RECORD, asdict(record))
    return record, board


def load_submission(folder: Path) -> _Submission:
    """Read the record of a submission whose files are those of the record. Raises ConfigError."""
    found = _digests(folder)  # before any file is read: one could be a link to an endless device
    data, _ = SUBMISSION.read(folder / RECORD)
    data.pop("identity")
    record = build(_Submission, data, str(folder / RECORD))
    if folder.resolve().name != record.name or not NAME.fullmatch(record.name):
        raise ConfigError(
            f"{folder}: the folder must have the name of its entry, {record.name!r}, which has up "
            "to 40 letters, digits, _ and -"
        )
    for x in sorted(found.keys() ^ record.files.keys()):
        raise ConfigError(f"{folder / x}: {'not ' if x in found else 'missing, '}of the record")
    for name in sorted(found):
        if found[name] != record.files[name]:
            raise ConfigError(
                f"{folder / name}: changed since the submission was made; restore it, or remove "
                f"{folder} and submit again"
            )
    load_method_card(folder / CARD)
    return record


def verify_submission(
    folder: Path,
    rules: tuple[Rules, Sequence[Task]],
    limits: Limits,
    *,
    share: float = SUBMISSION_SHARE,
    seed: int | None = None,
    replaces: Path | None = None,
    progress: _Progress = lambda text, share: None,
) -> list[Verified]:
    """Verify a submission: files, card, signature, code, rows, and a `share` of its drives again.

    `replaces` is the folder of the submission as it stood before; its signer must have signed this
    one. Returns what was found of every row, also of one that differs. Raises ConfigError for a
    submission that is not complete or not by the `rules`.
    """
    record = load_submission(folder)
    signature.check_owner(folder, replaces)
    for name in {path.parent.name for path in folder.resolve().parent.glob(f"*/{RECORD}")}:
        # a folder that is no entry has no row: it would only lock a rival out
        if NAME.fullmatch(name) and name != record.name and fold(name) == fold(record.name):
            raise ConfigError(f"{folder}: {name} looks the same; rename the entry")
    with SandboxClient(limits) as sandbox:
        entry = _working_entry(folder, sandbox)
        if (entry.name, entry.code) != (record.name, record.code):
            raise ConfigError(f"{folder}: its code is that of {entry.name} {entry.code}")
        request = make_run_request(*rules, [entry], limits)
        tasks = request.sized_tasks()
        stored = {path for path in (folder / "results").rglob("*") if path.is_file()}
        for task in tasks:
            for name in (record.name, *baseline_names(task)):
                path = store.row_path(folder, task.name, name)
                row, reason = store.load(path), f"{folder}: its row of {name} on {task.name}"
                stored.discard(path)
                if row.task_digest != task.digest or row.seeds != request.seeds:
                    raise ConfigError(f"{reason} was not made by these rules")
                if row.failure:
                    raise ConfigError(f"{reason}: {row.failure}")
                if stale := row.stale_reason(task):
                    made = f"{record.package_version}, code {row.environment.get('code', '?')[:8]}"
                    here = f"{package_version()}, code {describe_environment()['code'][:8]}"
                    raise ConfigError(
                        f"{reason}: {stale} (road-envs {made}; here {here}): install what verifies "
                        "it, and submit again"
                    )
        for path in sorted(stored):
            raise ConfigError(f"{path}: neither a row of its entry nor a baseline of the rules")
        _verify_probes(entry, folder, tasks[0], limits)
        found = verify_folder(
            folder, in_sandbox(sandbox), [entry],
            tasks=tasks, share=share, seed=seed, limits=(limits.seconds, limits.memory),
            report=progress,
        )  # fmt: skip
    for x in (x for x in found if x.reason):
        raise ConfigError(f"{folder}: its row of {x.estimator} on {x.task}: {x.reason}")
    return found


def _verify_probes(entry: Entry, folder: Path, task: Task, limits: Limits) -> None:
    """Raise ConfigError if the card of the row of a task is not the one of the probes here."""
    row = store.load(store.row_path(folder, task.name, entry.name))
    with TempFolder() as here:
        probe_entries([entry], here, limits)
        cards = [find_card(x, card_identity(of)) for x, of in ((folder, row), (here, entry))]
    outcomes = [card and [(p.name, p.passed) for p in card.probes] for card in cards]
    if outcomes[0] != outcomes[1]:
        raise ConfigError(f"{folder}: its card is not what the probes of {entry.name} find here")


def submitted_entry(folder: Path, sandbox: SandboxClient) -> Entry:
    """Return the entry of the code in a submission, with a failure if it cannot be constructed.
    Raises ConfigError if the code is not that of one entry.
    """
    code = folder / "code"
    wheels = list(code.glob("*.whl"))
    if any(wheel.is_dir() for wheel in wheels) or (wheels and len(list(code.iterdir())) > 1):
        raise ConfigError(f"{code}: one wheel alone, or a folder of packages without any")
    (entry,) = resolve_entries([str(wheels[0] if wheels else code)], sandbox.describe)
    return entry


def _working_entry(folder: Path, sandbox: SandboxClient) -> Entry:
    """Return the entry of a submission. Raises ConfigError if it cannot be run."""
    entry = submitted_entry(folder, sandbox)
    if entry.failure is not None:
        raise ConfigError(f"{entry.name}: {entry.failure}")
    return entry


@contextmanager
def _keeping_parts(folder: Path, parts: Path) -> Iterator[Callable[[], float]]:
    """Keep the `parts` of rows beside the `folder` of a submission until it is made: in a run after
    one that was stopped they are found by what they were made from. Yields a function that returns
    the processor time [s] of all these runs, without that of killed ones.
    """
    kept = folder.with_name(f".{folder.name}.{_PARTS}{PARTIAL_SUFFIX}")
    cost = kept / "cpu_seconds"
    kept.mkdir(exist_ok=True)
    parts.symlink_to(kept.resolve())
    before = float(cost.read_text(encoding="utf-8")) if cost.is_file() else 0.0
    began = _cpu_seconds()
    try:
        yield lambda: before + _cpu_seconds() - began
    except BaseException:
        if any(kept.iterdir()):
            write_text(cost, f"{before + _cpu_seconds() - began:.1f}\n")
        else:
            kept.rmdir()
        raise
    shutil.rmtree(kept)


def _digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a submission but record and signature, by its path in the folder."""
    digests = {}
    for top, folders, names in os.walk(folder):
        for path in [Path(top), *(Path(top, name) for name in (*folders, *names))]:
            if path.is_symlink() or not (path.is_file() or path.is_dir()):
                raise ConfigError(f"{path}: a submission has no links, pipes and devices")
        for path in (Path(top, name) for name in names):
            if (place := path.relative_to(folder).as_posix()) not in (RECORD, signature.FILE):
                digests[place] = hashlib.sha256(path.read_bytes()).hexdigest()
    return digests


def _cpu_seconds() -> float:
    """Processor time [s] of this process and of all ended processes that it has waited for."""
    return sum(os.times()[:4])
