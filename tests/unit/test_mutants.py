"""The list of deliberate faults fits the code; `tests/mutants.py` tries them, which takes long."""

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))
from mutants import VERDICTS, load_faults, load_verdicts, touches_kernels  # noqa: E402

FAULTS = load_faults()


def test_each_fault_changes_one_place_of_its_file():
    texts = {file: (ROOT / file).read_text(encoding="utf-8") for file, *_ in FAULTS}
    assert [f for f in FAULTS if texts[f.file].count(f.old) != 1 or f.old == f.new] == []


def test_each_fault_names_a_test():
    texts = {p.stem: p.read_text(encoding="utf-8") for p in ROOT.glob("tests/*/test_*.py")}
    named = {(f"test_{file}", name) for file, name in (f.tests.split("::") for f in FAULTS)}
    missing = [
        (file, name)
        for file, name in named
        if not re.search(rf"^ *def {name.partition('[')[0]}\(", texts.get(file, ""), re.MULTILINE)
    ]
    assert missing == []


def test_every_kept_verdict_is_caught():
    lines = VERDICTS.read_text(encoding="utf-8").splitlines()
    kept = load_verdicts()
    assert len(kept) == sum(not line.startswith("#") for line in lines) > 0
    assert {verdict.found for verdict in kept.values()} == {"caught"}


KERNELS = """
LIMIT = 3.0

@kernel(inline=False)
def step(x):
    return x + LIMIT

class Vehicle:
    @property
    def mass(self):
        return 2000.0
"""


@pytest.mark.parametrize(
    ("place", "touched"), [("LIMIT = 3.0", True), ("x + LIMIT", True), ("2000.0", False)]
)
def test_kernels_are_compiled_anew_for_faults_in_them_and_their_constants(place, touched):
    assert touches_kernels(KERNELS, place) is touched
