"""Deliberate faults: a test counts once it has been seen to fail.

    python tests/mutants.py [filter] [--list] [--all]

The faults are those of `tests/faults`. Each changes one place in a temporary copy of the tree and
runs the test that must then turn red. `filter` is part of a file name, of a changed text or of a
test's name. Verdicts are kept in `docs/runs/faults.txt`: a fault that was caught is tried again
only when the function that it changes or its test is no longer the same, or with `--all`; first
come those that were never tried. `--list` tries none and shows which are to be tried. As many are
tried at a time as MUTANT_JOBS says, by default one for each core. The exit status is 1 unless all
were caught.
"""

import argparse
import ast
import hashlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import groupby
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

import yaml

from road_envs.core.atomic_io import write_text
from road_envs.core.code_digest import _find_source, _parse, cache_home, closure, digest

ROOT = Path(__file__).resolve().parent.parent
COPIED = (
    "road_envs", "estimators", "leaderboard", "studies", "configs", "tests", "docs",
    "pyproject.toml",
)  # fmt: skip
FAULTS_FOLDER = ROOT / "tests" / "faults"
VERDICTS = ROOT / "docs" / "runs" / "faults.txt"
TITLE = (
    "# Deliberate faults of tests/faults and whether their tests detect them: `make mutants`.\n"
    "# verdict, time, digests of the fault and of the code that it and its test stand in\n"
)
LONGEST = 1800
"""Time [s] after which a run of tests is given up."""

PLAIN_DECORATORS = {"property", "cached_property", "cache", "staticmethod", "classmethod"}
"""Decorators of functions that no kernel is made of."""


class Fault(NamedTuple):
    """`old` stands once in `file`; with `new` in its place each of `tests` must fail."""

    file: str
    old: str
    new: str
    tests: str

    @property
    def identity(self) -> str:
        """Digest of the fault itself."""
        return short_digest(*self)

    @property
    def context(self) -> str:
        """Digest of the code around the fault and of its test, without comments and layout."""
        path = ROOT / self.file
        text = path.read_text("utf-8")
        if path.suffix == ".py" and text.count(self.old) == 1:
            text = _parse(ast.unparse(statements_at(text, self.old)[0]).encode()).digest
        tree = ast.parse(test_file(ROOT, self.tests).read_text("utf-8"))
        name = self.tests.split("::")[1].partition("[")[0]
        functions = (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef))
        function = next(n for n in functions if n.name == name)
        return short_digest(text, _parse(ast.unparse(function).encode()).digest)


class Verdict(NamedTuple):
    """One line of VERDICTS: "caught", or what went wrong; and the code for which it holds."""

    found: str
    seconds: float
    identity: str
    context: str

    def line(self, fault: Fault) -> str:
        """Return the line of the file."""
        change = f"{fault.file}: {fault.old} -> {fault.new} [{fault.tests}]".replace("\n", "\\n")
        return f"{self.found:12} {self.seconds:4.0f} s  {self.identity} {self.context}  {change}"


def short_digest(*texts: str) -> str:
    """Digest of texts: eight hexadecimal digits."""
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:8]


def load_faults() -> list[Fault]:
    """Return the faults of all files of FAULTS_FOLDER."""
    tables = [yaml.safe_load(p.read_text("utf-8")) for p in sorted(FAULTS_FOLDER.glob("*.yaml"))]
    return [
        Fault(file, row["old"], row["new"], row["test"])
        for table in tables
        for file, rows in table.items()
        for row in rows
    ]


def load_verdicts() -> dict[str, Verdict]:
    """Return the kept verdicts by the identity of their faults."""
    text = VERDICTS.read_text("utf-8") if VERDICTS.exists() else ""
    lines = re.findall(r"^(\w[\w ]*?) +(\d+) s  (\w{8}) (\w{8})  ", text, re.MULTILINE)
    return {line[2]: Verdict(line[0], float(line[1]), line[2], line[3]) for line in lines}


def save_verdicts(faults: list[Fault], verdicts: dict[str, Verdict]) -> None:
    """Write the verdicts of `faults` in their order; those of other faults are dropped."""
    kept = [verdicts[f.identity].line(f) + "\n" for f in faults if f.identity in verdicts]
    write_text(VERDICTS, TITLE + "".join(kept))


def statements_at(text: str, old: str) -> list[ast.stmt]:
    """Return the statements that hold the place of `old` in a file, the outermost first."""
    start = text.index(old)
    first = text.count("\n", 0, start) + 1
    last = first + old.rstrip("\n").count("\n")

    def begin(node: ast.stmt) -> int:
        return min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", ()))])

    return [
        node
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.stmt) and begin(node) <= last and first <= (node.end_lineno or 0)
    ]


@cache
def test_file(tree: Path, tests: str) -> Path:
    """Return the file of `tests`, "file::name"."""
    (path,) = (tree / "tests").glob(f"*/test_{tests.split('::')[0]}.py")
    return path


def run_tests(tree: Path, caches: Path, *tests: str) -> tuple[int, str]:
    """Exit status and output of pytest in a tree."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-m",
        "not slow",
        "-x",
        "-q",
        "-p",
        "no:cacheprovider",
    ]
    command += ["--hypothesis-profile", "faults"]  # a red test need not look for its least example
    names = [f"{test_file(tree, name)}::{name.split('::')[1]}" for name in tests]
    try:
        done = subprocess.run(
            [*command, f"--basetemp={tree / 'tmp'}", *names],
            cwd=tree,
            env=os.environ | {"XDG_CACHE_HOME": str(caches), "PYTHONPATH": str(tree)},
            capture_output=True,
            text=True,
            timeout=LONGEST,
        )
    except subprocess.TimeoutExpired:
        return -1, f"took more than {LONGEST} s"
    return done.returncode, done.stdout + done.stderr


def kernel_folders(tree: Path) -> list[str]:
    """Return the folders in which the kernels of a tree are cached, one for each package."""
    from road_envs.kernels._numba import (
        _kernel_files,  # not before: the import of numba takes a second
    )

    closure.cache_clear()
    _find_source.cache_clear()
    own, *others = (
        digest(_kernel_files(tree / package), tree)
        for package in ("road_envs", "estimators", "leaderboard")
    )
    return [own, *(f"{own}/{other}" for other in others)]


def touches_kernels(text: str, old: str) -> bool:
    """Return True unless `old` stands in a function that no kernel is made of."""
    functions = [n for n in statements_at(text, old) if isinstance(n, ast.FunctionDef)]
    names = {re.split(r"\W", ast.unparse(d))[0] for f in functions for d in f.decorator_list}
    return not functions or not names <= PLAIN_DECORATORS


def reuse_kernels(tree: Path, clean: list[str], fault: Fault, text: str, caches: Path) -> None:
    """Copy compiled kernels that the fault in `tree` does not change to a new folder of caches.

    Their folders are named after the code of all kernels; `clean` are those without the fault and
    `text` is the file without it.
    """
    changed = fault.file.endswith(".py") and touches_kernels(text, fault.old)
    for before, after in zip(clean, kernel_folders(tree), strict=True):
        for path in (tree / "cache" / "road-recon" / before).glob("*.nb[ci]"):
            (module,) = re.findall(r"-([\w.]+)\.py3", path.name)
            if not (changed and tree / fault.file in closure(module, root=tree)):
                target = caches / "road-recon" / after / path.name
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, target)


def try_fault(tree: Path, fault: Fault) -> tuple[str, str]:
    """The word "caught" or what went wrong, and what pytest printed."""
    path = tree / fault.file
    text = path.read_text(encoding="utf-8")
    if text.count(fault.old) != 1:
        return "DOES NOT FIT", f"found {text.count(fault.old)} times"
    clean, caches = kernel_folders(tree), tree / "faulty-cache"
    bytecode = Path(importlib.util.cache_from_source(str(path)))
    status, output = 0, ""
    try:
        path.write_text(text.replace(fault.old, fault.new), encoding="utf-8")
        for reused in (True, False):  # survivors once more with all kernels compiled anew
            if status == 0:
                shutil.rmtree(caches, ignore_errors=True)
                bytecode.unlink(missing_ok=True)
                if reused:
                    reuse_kernels(tree, clean, fault, text, caches)
                status, output = run_tests(tree, caches, fault.tests)
    finally:
        path.write_text(text, encoding="utf-8")
        bytecode.unlink(missing_ok=True)
    found = {0: "SURVIVED", 1: "caught", -1: "HANGS"}
    return found.get(status, "BREAKS ALL"), output[-800:]


def copy_tree(tree: Path) -> Path:
    """Copy what the tests need, and the kernels that this machine has compiled, to a new folder."""
    tree.mkdir()
    for name in COPIED:
        if (ROOT / name).is_dir():
            ignore = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / name, tree / name, ignore=ignore)
        else:
            shutil.copy(ROOT / name, tree / name)
    kernels = cache_home() / kernel_folders(tree)[0]
    if kernels.exists():
        shutil.copytree(kernels, tree / "cache" / "road-recon" / kernels.name)
    return tree


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("filter", nargs="?", default="")
    parser.add_argument("--list", action="store_true", help="show which faults are to be tried")
    parser.add_argument("--all", action="store_true", help="try those again that were caught")
    options = parser.parse_args()
    faults, verdicts = load_faults(), load_verdicts()
    wanted = [f for f in faults if any(options.filter in part for part in f)]

    def rank(fault: Fault) -> int:
        """0: never tried; 1: not caught or changed since; 2: caught."""
        kept = verdicts.get(fault.identity)
        return 0 if kept is None else 1 + (kept[::3] == ("caught", fault.context))

    chosen = sorted(
        (f for f in wanted if options.all or rank(f) < 2), key=lambda f: (rank(f), f.tests)
    )
    if options.list:
        for fault in chosen:
            reason = "changed" if rank(fault) else "untried"
            print(f"{reason} {fault.file}: {fault.old} -> {fault.new}")
        print(f"{len(chosen)} of {len(wanted)} faults are to be tried")
        return 0
    groups = [list(g) for _, g in groupby(chosen, lambda f: (rank(f), f.tests.split("::")[0]))]
    jobs, writing = int(os.environ.get("MUTANT_JOBS", os.cpu_count() or 1)), threading.Lock()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as pool:
        idle: SimpleQueue[Path] = SimpleQueue()
        for job in range(min(jobs, len(groups))):
            idle.put(copy_tree(Path(folder) / str(job)))

        def attempt(group: list[Fault]) -> None:
            tree = idle.get()
            status, output = run_tests(tree, tree / "cache", *sorted({f.tests for f in group}))
            if status != 0:
                print(f"without any fault these tests are not green:\n{output[-4000:]}", flush=True)
            for fault in group if status == 0 else []:
                start = time.perf_counter()
                found, output = try_fault(tree, fault)
                spent = time.perf_counter() - start
                with writing:
                    kept = Verdict(found, spent, fault.identity, fault.context)
                    verdicts[fault.identity] = kept
                    save_verdicts(faults, verdicts)
                    print(kept.line(fault), "" if found == "caught" else output, flush=True)
            idle.put(tree)

        list(pool.map(attempt, groups))
    caught = sum(rank(f) == 2 for f in wanted)
    print(f"{caught} of {len(wanted)} faults caught")
    return 0 if caught == len(wanted) > 0 else 1


if __name__ == "__main__":
    sys.exit(main())
