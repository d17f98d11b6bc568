"""Kept results: the figures, tables and pictures of README and docs, and whether they are of today.

    python -m studies.results check [NAME ...]      name those that are stale; some seconds
    python -m studies.results make [NAME ...]       make the stale ones again, --jobs 2 side by side
    python -m studies.results renew [NAME ...]      after a change that should move nothing, or
                                                    only rows with --anew KEY=VALUE

`studies/results.yaml` lists them: commands, outputs, and the modules whose code, with all that they
import, decides the figures. A result that is made leaves an artifact in `docs/made`, which says by
which commit, when, on what machine and in how long. A result is stale when its commands, that code,
the configurations or an output differ from it.

Unfinished work stays in `out/results` under the identity of the result, and studies that keep their
rows go on there. The rows are kept beside the artifact: where only code has changed, a random tenth
of them is made again, some of each estimator, and if they are equal the result is of today's
program, as the artifact says.
"""

import argparse
import dataclasses
import hashlib
import itertools
import json
import math
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from leaderboard.evaluation.provenance import describe_environment
from leaderboard.metrics.bootstrap import REPRODUCIBLE
from road_envs.core.artifacts import Kind
from road_envs.core.atomic_io import write_text
from road_envs.core.code_digest import ROOT
from road_envs.core.config import ConfigError, Positive, Settings, build, read_yaml, validate_choice
from studies.arithmetic import describe_machine, environment
from studies.pages import write_pages

LIST = Path(__file__).with_suffix(".yaml")
MADE = ROOT / "docs" / "made"
WORK = ROOT / "out" / "results"
CONFIGS = ("conditions", "field", "roads", "sensors", "vehicles")
"""Folders of `configs` that every result depends on."""

KEPT = Kind("kept result", 1)
"""Written without modules: `road-recon clean` leaves what is kept in the checkout."""

SAME_KERNELS = 1e-6
"""Relative tolerance of rows that were made with the same arithmetic (`studies.arithmetic`)."""

STDOUT, STDOUT_JSON = "stdout.txt", "stdout.json"
"""Output of all commands, each below a line `$ command`; and what the last one prints, alone."""


@dataclass(frozen=True, kw_only=True)
class KeptResult(Settings):
    """A result, made by `commands` in a folder of its own, which they call {work}.

    `outputs` names the file of the checkout that each file of that folder becomes.
    """

    commands: tuple[str, ...]
    outputs: dict[str, str]
    modules: tuple[str, ...]
    minutes: Annotated[Positive, "min", "on an idle machine of two cores"]
    cores: Literal[1, 2] = 1
    """Number of cores that it keeps busy; 2 too where work beside it would disturb a timing."""

    native: bool = False
    """Whether it is made with all that the processor has, as it tells how fast that is."""

    configs: tuple[str, ...] = ()
    needs: str = ""
    """Path beside the checkout without which it cannot be made."""

    def identity(self) -> str:
        """Identity of what would be made now."""
        folders = [ROOT / "configs" / name for name in (*CONFIGS, *self.configs)]
        files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
        kind = dataclasses.replace(KEPT, modules=self.modules)
        return kind.identity(self.commands, self.outputs, files=files)


@cache
def known_results() -> dict[str, KeptResult]:
    """All kept results by name, in the order of the list. Raises ConfigError."""
    listed = read_yaml(LIST)
    return {name: build(KeptResult, data, f"{LIST.name}: {name}") for name, data in listed.items()}


@cache
def stale_reason(name: str) -> str | None:
    """Reason why a result is not of today's program, in a few words; None if it is."""
    result = known_results()[name]
    if (made := _artifact(name)) is None:
        return "made by an unknown program"
    for path, digest in made["outputs"].items():
        if file_digest(ROOT / path) != digest:
            return f"{path} differs from what {made['commit']} made"
    if made["identity"] != result.identity():
        return f"made by {made['commit']}, code has changed since"
    return None


def _artifact(name: str) -> dict[str, Any] | None:
    """Content of the artifact of a result; None if there is none that can be read."""
    try:
        return KEPT.read(MADE / f"{name}.json")[0]
    except ConfigError:
        return None


def result_of(path: str) -> str | None:
    """Name of the result that has the output `path`; None if none has."""
    for name, result in known_results().items():
        if path in result.outputs.values():
            return name
    return None


def file_digest(path: Path) -> str:
    """Digest of a file by its bytes; that of a missing file is empty."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def make_result(
    name: str, report: Any = print, accept: Callable[[Path], str] | None = None
) -> float:
    """Run the commands of a result, put its outputs in place, and return the time [s] taken.

    Libraries use as many threads as it has cores, so that no figure depends on what runs beside it.
    `accept` takes the folder of the work, puts its rows in order, which the commands then print
    again, and says how much of it was made now. Raises ConfigError if a command fails, an output is
    missing or it is not accepted; then nothing is replaced.
    """
    result = known_results()[name]
    identity = result.identity()
    work = WORK / f"{name}-{identity[:12]}"
    work.mkdir(parents=True, exist_ok=True)
    begin, now = time.monotonic(), "whole"
    _run_commands(result, work, report)
    if accept is not None:
        now = accept(work)
        _run_commands(result, work, lambda line: None)
    if missing := [file for file in result.outputs if not (work / file).is_file()]:
        raise ConfigError(f"{name}: its commands have not written {', '.join(missing)}")
    seconds = time.monotonic() - begin
    for path in work.glob("*.jsonl"):
        MADE.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, MADE / f"{name}.{path.name}")
    for file, target in result.outputs.items():
        (ROOT / target).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(work / file, ROOT / target)
    content = {
        "commands": list(result.commands),
        "commit": describe_environment().get("commit", "no commit")[:7],
        "made": time.strftime("%Y-%m-%d"),
        "seconds": round(seconds),
        "made now": now,
        "machine": describe_machine(result.native),
        "outputs": {path: file_digest(ROOT / path) for path in result.outputs.values()},
    }
    KEPT.write(MADE / f"{name}.json", content, identity)
    return seconds


def renew_result(
    name: str,
    rng: np.random.Generator,
    anew: Collection[str] = (),
    tolerance: float | None = None,
) -> float:
    """Make a random tenth of the rows of a result again, three at least of each estimator in each
    file, and its outputs from all. Rows with one of the pairs `anew`, KEY=VALUE, are made anew and
    not compared. They are compared to a relative `tolerance`: by default to the last digits, and as
    rows of a board are if they are of another kernel of BLAS, or of an unknown one. Raises
    ConfigError as `make_result`, if there are no rows, and if one differs.
    """
    work = WORK / f"{name}-{known_results()[name].identity()[:12]}"
    work.mkdir(parents=True, exist_ok=True)
    left_out: dict[str, dict[str, int]] = {}
    for path in MADE.glob(f"{name}.*.jsonl"):
        lines, file = path.read_text(encoding="utf-8").splitlines(), path.name[len(name) + 1 :]
        rows = [line for line in lines if not _has(json.loads(line), anew)]
        chosen = _some_of_each([json.loads(row).get("name") for row in rows], rng)
        left_out[file] = {rows[k]: lines.index(rows[k]) for k in chosen}
        rest = (row for row in rows if row not in left_out[file])
        write_text(work / file, "".join(f"{row}\n" for row in rest))
    if not left_out:
        raise ConfigError(f"{name}: none of its rows are kept; make it")
    machine = (_artifact(name) or {"machine": {}})["machine"]
    if tolerance is None:
        here = describe_machine(known_results()[name].native)
        is_same = "blas" in machine and machine["blas"] == here.get("blas")
        tolerance = SAME_KERNELS if is_same else REPRODUCIBLE
    compare = partial(_compare_rows, left_out, tolerance, anew)
    return make_result(name, lambda line: None, compare)


def _some_of_each(names: Sequence[str | None], rng: np.random.Generator) -> set[int]:
    """Return a random tenth of the indices of each of the `names`, three at least."""
    chosen = set[int]()
    for name in dict.fromkeys(names):
        own = [k for k, other in enumerate(names) if other == name]
        chosen |= set(rng.choice(own, min(len(own), max(3, len(own) // 10)), replace=False))
    return chosen


def _has(row: Mapping[str, Any], pairs: Collection[str]) -> bool:
    """Whether a row has one of the pairs KEY=VALUE, as its value or as an item of a list."""
    return any(
        f"{key}={item}" in pairs
        for key, value in row.items()
        for item in (value if isinstance(value, list) else [value])
    )


def _compare_rows(
    left_out: Mapping[str, Mapping[str, int]], tolerance: float, anew: Collection[str], work: Path
) -> str:
    """Say how many rows were made again, and put each in its place, the least first. Raises
    ConfigError if one of them is another one now.
    """
    for file, rows in left_out.items():
        lines = (work / file).read_text("utf-8").splitlines()
        for row, place in sorted(rows.items(), key=lambda item: item[1]):
            same = (x for x in lines if _is_same(json.loads(row), json.loads(x), tolerance))
            if (line := next(same, None)) is None:
                (work / file).unlink()  # of two programs
                raise ConfigError(f"{work.name}: a row is another one now: {row}; make it whole")
            lines.remove(line)
            lines.insert(place, line)
        write_text(work / file, "".join(f"{line}\n" for line in lines))
    count = sum(map(len, left_out.values()))
    others = "".join(f"all rows of {pair}, and " for pair in anew)
    return f"{others}{count} rows, equal to those of the program before to {tolerance:g}"


def _is_same(a: Any, b: Any, tolerance: float) -> bool:
    """Whether two rows are equal, numbers to a relative `tolerance`, and but for times."""
    if isinstance(a, dict) and isinstance(b, dict):
        timed = {key for key in a if key.endswith("seconds")}
        return a.keys() == b.keys() and all(
            _is_same(a[k], b[k], tolerance) for k in a.keys() - timed
        )
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_is_same, a, b, itertools.repeat(tolerance)))
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=tolerance, abs_tol=1e-12) or (a != a and b != b)
    return bool(a == b)


def _run_commands(result: KeptResult, work: Path, report: Callable[[str], Any]) -> None:
    """Run the commands of a result, and write what they print. Raises ConfigError if one fails."""
    printed = []
    for command in result.commands:
        report(f"  $ {command}")
        words = shlex.split(command.replace("{work}", str(work)))
        text = _run(words, work / "log.txt", result.cores, environment(result.native))
        shown = re.sub(r" --out \{work\}\S*", "", command).replace("{work}/", "")
        lines = [f"$ {shown}", *text.rstrip().splitlines()]
        printed.append("".join(f"{line.rstrip()}\n" for line in lines))
        write_text(work / STDOUT_JSON, text)
    write_text(work / STDOUT, "\n".join(printed))


def _run(words: Sequence[str], log: Path, threads: int, variables: Mapping[str, str]) -> str:
    """Output of a command of this Python's environment. Raises ConfigError if it fails."""
    programs = Path(sys.executable).parent
    own = {"python": sys.executable, "road-recon": str(programs / "road-recon")}
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads))
    with log.open("ab") as errors:
        done = subprocess.run(
            [own.get(words[0], words[0]), *words[1:]],
            cwd=ROOT,
            env={**variables, **limits},
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            check=False,
        )
    if done.returncode:
        raise ConfigError(f"{shlex.join(words)} ended with status {done.returncode}, see {log}")
    return done.stdout


def _check(names: Iterable[str]) -> int:
    """Print the stale results; return their number."""
    stale = {name: reason for name in names if (reason := stale_reason(name))}
    for name, reason in stale.items():
        result = known_results()[name]
        places = ", ".join(result.outputs.values())
        print(f"stale: {name} ({places}): {reason}; about {result.minutes:g} min")
    minutes = sum(known_results()[n].minutes * known_results()[n].cores for n in stale) / 2
    if stale:
        print(f"{len(stale)} kept results are stale: `make results JOBS=2`, {minutes:.0f} min")
    else:
        print("every kept result is of today's program")
    return len(stale)


def _make(
    names: Iterable[str],
    results: Mapping[str, KeptResult],
    jobs: int = 1,
    make: Callable[[str], float] = lambda name: make_result(name, lambda line: None),
) -> int:
    """Make the stale results on `jobs` cores, the longest first; return how many failed."""
    stale = sorted((n for n in names if stale_reason(n)), key=lambda n: -results[n].minutes)
    absent = [n for n in stale if results[n].needs and not (ROOT / results[n].needs).exists()]
    for name in absent:
        print(f"{name}: not made: it needs {results[name].needs}", flush=True)
    left, running, failed = [n for n in stale if n not in absent], dict[Future, str](), 0
    with ThreadPoolExecutor(jobs) as pool:
        while left or running:
            free = jobs - sum(_cores(results[name], jobs) for name in running.values())
            following = next((n for n in left if _cores(results[n], jobs) <= free), None)
            if following is not None:
                minutes = sum(_cores(results[n], jobs) * results[n].minutes for n in left) / jobs
                print(f"{following}: {results[following].minutes:g} min, {minutes:.0f} min left")
                left.remove(following)
                running[pool.submit(make, following)] = following
                continue
            for done in wait(running, return_when=FIRST_COMPLETED).done:
                name = running.pop(done)
                if isinstance(error := done.exception(), ConfigError):
                    failed += 1
                    print(f"  failed: {error}", flush=True)
                else:
                    print(f"  {name}: made in {done.result() / 60.0:.1f} min", flush=True)
    try:
        for page in write_pages():
            shown = page.relative_to(ROOT)
            print(f"written: {shown}; read the sentences beside its tables again")
    except ConfigError as error:
        failed += 1
        print(f"  failed: {error}")
    return failed


def _cores(result: KeptResult, jobs: int) -> int:
    return min(result.cores, jobs)


def main() -> None:
    """Command line; see the module."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("action", choices=("check", "make", "renew"))
    parser.add_argument("names", nargs="*", metavar="NAME", help="default: all")
    parser.add_argument(
        "--jobs", type=int, default=1, help="results side by side; one that takes two cores is two"
    )
    parser.add_argument(
        "--anew", action="append", default=[], metavar="KEY=VALUE", help="rows that have changed"
    )
    parser.add_argument("--tolerance", type=float, help="of rows that are compared, relative")
    chosen = parser.parse_args()
    try:
        results = known_results()
        names = [validate_choice("result", name, results) for name in chosen.names] or [*results]
    except ConfigError as error:
        parser.error(str(error))
    if chosen.action == "check":
        count = _check(names)
    elif chosen.action == "make":
        count = _make(names, results, chosen.jobs)
    else:
        again = partial(
            renew_result,
            rng=np.random.default_rng(),
            anew=chosen.anew,
            tolerance=chosen.tolerance,
        )
        count = _make(names, results, chosen.jobs, again)
    sys.exit(bool(count))


if __name__ == "__main__":
    main()
