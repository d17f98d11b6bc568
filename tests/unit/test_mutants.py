"""The list of deliberate faults fits the code; `tests/mutants.py` tries them, which takes long."""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))
from mutants import load_faults  # noqa: E402

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
