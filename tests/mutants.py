"""Deliberate faults: a test counts once it has been seen to fail.

    python tests/mutants.py [filter]

The faults are those of `tests/faults`. Each changes one line in a temporary copy of the tree and
runs the test that must then turn red. `filter` is part of a file name or of a changed text. As many
faults are tried at a time as MUTANT_JOBS says, by default one for each core. The exit status is 1
if a fault survives, no longer fits its file or breaks more than its test.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

import yaml

ROOT = Path(__file__).resolve().parent.parent
COPIED = ("road_envs", "estimators", "leaderboard", "configs", "tests", "pyproject.toml")
FAULTS_FOLDER = ROOT / "tests" / "faults"


class Fault(NamedTuple):
    """`old` stands once in `file`; with `new` in its place each of `tests` must fail."""

    file: str
    old: str
    new: str
    tests: str


def load_faults() -> list[Fault]:
    """Return the faults of all files of FAULTS_FOLDER."""
    tables = [yaml.safe_load(p.read_text("utf-8")) for p in sorted(FAULTS_FOLDER.glob("*.yaml"))]
    return [
        Fault(file, row["old"], row["new"], row["test"])
        for table in tables
        for file, rows in table.items()
        for row in rows
    ]


def test_id(tree: Path, tests: str) -> str:
    """The identifier by which pytest knows `tests`, "file::name"."""
    file, name = tests.split("::")
    (path,) = (tree / "tests").glob(f"*/test_{file}.py")
    return f"{path}::{name}"


def run_tests(tree: Path, *tests: str) -> tuple[int, str]:
    """Exit status and output of pytest in a tree."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    command += ["--hypothesis-profile", "faults"]  # a red test need not look for its least example
    settings = {"XDG_CACHE_HOME": str(tree / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [*command, f"--basetemp={tree / 'tmp'}", *(test_id(tree, name) for name in tests)],
        cwd=tree,
        env=os.environ | settings,
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout + done.stderr


def verdict(tree: Path, fault: Fault) -> str:
    """The word "caught", or what went wrong."""
    path = tree / fault.file
    text = path.read_text(encoding="utf-8")
    if text.count(fault.old) != 1:
        return f"DOES NOT FIT: found {text.count(fault.old)} times"
    path.write_text(text.replace(fault.old, fault.new), encoding="utf-8")
    try:
        status, output = run_tests(tree, fault.tests)
    finally:
        path.write_text(text, encoding="utf-8")
    if status == 0:
        return "SURVIVED"
    return "caught" if status == 1 else f"BROKE THE RUN (status {status})\n{output[-800:]}"


def copy_tree(tree: Path) -> Path:
    """Copy what the tests need to a new folder."""
    tree.mkdir()
    for name in COPIED:
        if (ROOT / name).is_dir():
            ignore = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / name, tree / name, ignore=ignore)
        else:
            shutil.copy(ROOT / name, tree / name)
    return tree


def main(wanted: str) -> int:
    chosen = [f for f in load_faults() if wanted in f.file or wanted in f.old or wanted in f.new]
    jobs = int(os.environ.get("MUTANT_JOBS", os.cpu_count() or 1))
    caught = 0
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as pool:
        trees = [copy_tree(Path(folder) / str(job)) for job in range(jobs)]
        status, output = run_tests(trees[0], *sorted({f.tests for f in chosen}))
        if status != 0:
            print(f"without any fault the tests are not green:\n{output[-4000:]}")
            return 1
        for tree in trees[1:] if (trees[0] / "cache").exists() else []:
            shutil.copytree(trees[0] / "cache", tree / "cache")  # kernels compiled without a fault
        idle: SimpleQueue[Path] = SimpleQueue()
        for tree in trees:
            idle.put(tree)

        def attempt(fault: Fault) -> tuple[Fault, str, float]:
            tree, start = idle.get(), time.perf_counter()
            try:
                return fault, verdict(tree, fault), time.perf_counter() - start
            finally:
                idle.put(tree)

        for fault, found, spent in pool.map(attempt, chosen):
            caught += found == "caught"
            print(f"{found:8} {spent:4.0f} s  {fault.file}: {fault.old} -> {fault.new}", flush=True)
    print(f"{caught} of {len(chosen)} faults caught")
    return 0 if caught == len(chosen) > 0 else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else ""))
