"""Kept results: which are stale and why, how they are made, and that pages quote nothing else."""

import dataclasses
import json
import re
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from road_envs.core.code_digest import _find_source, closure
from road_envs.core.config import ConfigError
from studies import results
from studies.arithmetic import portable
from studies.results import KEPT, KeptResult

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md"))]
SCRIPT = "import sys, pathlib; pathlib.Path(sys.argv[1]).write_text('7'); print('seven')"


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """One result, `seven`, in an empty checkout."""
    (tmp_path / "write.py").write_text(SCRIPT)
    made = KeptResult(
        commands=("python write.py {work}/a.csv --out {work}/b",),
        outputs={"stdout.txt": "docs/seven.txt", "a.csv": "docs/seven.csv"},
        modules=("road_envs.core.units",),
        minutes=0.1,
    )
    for name, value in {
        "ROOT": tmp_path,
        "MADE": tmp_path / "docs" / "made",
        "WORK": tmp_path / "out",
        "write_pages": lambda: [],
        "known_results": lambda: {"seven": made},
        "stale_reason": results.stale_reason.__wrapped__,
    }.items():
        monkeypatch.setattr(results, name, value)
    return made


def test_a_result_is_stale_until_it_is_made_and_then_of_today(kept, tmp_path, capsys):
    assert results.stale_reason("seven") == "made by an unknown program"
    results.make_result("seven", report=lambda line: None)
    assert results.stale_reason("seven") is None
    assert (tmp_path / "docs/seven.csv").read_text() == "7"
    assert (tmp_path / "docs/seven.txt").read_text() == "$ python write.py a.csv\nseven\n"
    data, _ = KEPT.read(tmp_path / "docs/made/seven.json")
    assert data["identity"] == kept.identity() and data["commit"]
    assert results._check(["seven"]) == 0 and "today's program" in capsys.readouterr().out


@pytest.mark.skipif(not portable(), reason="no x86 processor with AVX2")
@pytest.mark.parametrize(("native", "kernel"), [(False, "Haswell"), (True, "None")])
def test_all_but_times_are_made_with_one_arithmetic(kept, tmp_path, monkeypatch, native, kernel):
    monkeypatch.delenv("OPENBLAS_CORETYPE", raising=False)
    told = "import os, sys; print(os.environ.get('OPENBLAS_CORETYPE'), file=open(sys.argv[1], 'w'))"
    (tmp_path / "write.py").write_text(f"{told}; print()")
    made = dataclasses.replace(kept, native=native)
    monkeypatch.setattr(results, "known_results", lambda: {"seven": made})
    results.make_result("seven", report=lambda line: None)
    assert (tmp_path / "docs/seven.csv").read_text() == f"{kernel}\n"
    data, _ = KEPT.read(tmp_path / "docs/made/seven.json")
    assert native or data["machine"]["blas"] == "openblas Haswell"


@pytest.mark.skipif(not portable(), reason="no x86 processor with AVX2")
def test_the_variables_are_words_for_a_shell():
    command = [sys.executable, "-m", "studies.arithmetic"]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert dict(word.split("=", 1) for word in told.split()) == portable()


def test_an_edited_output_and_changed_code_make_it_stale(kept, tmp_path, monkeypatch, capsys):
    results.make_result("seven", report=lambda line: None)
    (tmp_path / "docs/seven.csv").write_text("8")
    assert "docs/seven.csv differs from what" in results.stale_reason("seven")
    (tmp_path / "docs/seven.csv").write_text("7")
    monkeypatch.setattr(KeptResult, "identity", lambda self: "another")
    assert results.stale_reason("seven").endswith("code has changed since")
    assert results._check(["seven"]) == 1
    assert "stale: seven (docs/seven.txt, docs/seven.csv): made by" in capsys.readouterr().out


ROWS = """
import json, pathlib, sys
path = pathlib.Path(sys.argv[1])
text = path.read_text() if path.exists() else ""
known = [json.loads(line)["case"] for line in text.splitlines()]
new = [{"case": k, "error": 0.1 * k, "seconds": len(known) + k} for k in range(40)]
path.write_text(text + "".join(json.dumps(x) + "\\n" for x in new if x["case"] not in known))
pathlib.Path(sys.argv[2]).write_text(f"{len(known)} {known == sorted(known)}")
"""


def make_of_rows(kept, tmp_path, monkeypatch, rows=ROWS):
    """Make a result that keeps its rows, and change the code that decides it."""
    (tmp_path / "write.py").write_text(rows)
    of_rows = dataclasses.replace(
        kept, commands=("python write.py {work}/rows.jsonl {work}/a.csv",)
    )
    monkeypatch.setattr(results, "known_results", lambda: {"seven": of_rows})
    results.make_result("seven", report=lambda line: None)
    monkeypatch.setattr(KeptResult, "identity", lambda self: "another")


def test_a_tenth_of_the_rows_is_made_again_and_a_row_that_differs_refuses_the_rest(
    kept, tmp_path, monkeypatch
):
    with pytest.raises(ConfigError, match="seven: none of its rows are kept; make it"):
        results.renew_result("seven", np.random.default_rng(1))
    make_of_rows(kept, tmp_path, monkeypatch)
    assert results.stale_reason("seven").endswith("code has changed since")
    results.renew_result("seven", np.random.default_rng(1))
    assert results.stale_reason("seven") is None
    assert (tmp_path / "docs/seven.csv").read_text() == "40 True"
    data, _ = KEPT.read(tmp_path / "docs/made/seven.json")
    assert data["made now"] == "4 rows, equal to those of the program before to 1e-06"
    rows = (tmp_path / "docs/made/seven.rows.jsonl").read_text().splitlines()
    assert [json.loads(row)["case"] for row in rows] == [*range(40)]

    monkeypatch.setattr(KeptResult, "identity", lambda self: "third")
    (tmp_path / "write.py").write_text(ROWS.replace("0.1 * k", "0.10001 * k"))
    with pytest.raises(ConfigError, match=r"a row is another one now: .*; make it whole"):
        results.renew_result("seven", np.random.default_rng(1))
    assert (tmp_path / "docs/seven.csv").read_text() == "40 True"
    elsewhere = {"blas": "another kernel"}
    monkeypatch.setattr(results, "describe_machine", lambda native: elsewhere)
    results.renew_result("seven", np.random.default_rng(1))  # as near as on another processor
    data, _ = KEPT.read(tmp_path / "docs/made/seven.json")
    assert data["made now"].endswith("to 0.005")
    (tmp_path / "write.py").write_text(ROWS.replace("0.1 * k", "0.101 * k"))
    monkeypatch.setattr(KeptResult, "identity", lambda self: "fourth")
    monkeypatch.setattr(results, "describe_machine", lambda native: {"blas": "a third one"})
    with pytest.raises(ConfigError, match="a row is another one now"):
        results.renew_result("seven", np.random.default_rng(1))
    results.make_result("seven", report=lambda line: None)
    assert (tmp_path / "docs/seven.csv").read_text() == "0 True"  # nothing of the second program


@pytest.mark.parametrize("seed", range(5))
def test_some_rows_of_each_estimator_are_made_again(kept, tmp_path, monkeypatch, seed):
    named = ROWS.replace('"case": k,', '"case": k, "name": "other" if k % 10 == 7 else "one",')
    make_of_rows(kept, tmp_path, monkeypatch, named)
    (tmp_path / "write.py").write_text(named.replace("0.1 * k", "0.1 * k + (k % 10 == 7)"))
    with pytest.raises(ConfigError, match=r'a row is another one now: .*"other"'):
        results.renew_result("seven", np.random.default_rng(seed))


@pytest.mark.parametrize("case", ["k", '[k, "three", 808]'])
def test_rows_that_are_known_to_have_changed_are_made_anew(kept, tmp_path, monkeypatch, case):
    listed = ROWS.replace('"case": k,', f'"case": {case},')
    make_of_rows(kept, tmp_path, monkeypatch, listed)
    changed = listed.replace("0.1 * k", "0.1 * k + 9.0 * (k == 7)")
    (tmp_path / "write.py").write_text(changed)
    results.renew_result("seven", np.random.default_rng(1), ["case=7"])
    rows = (tmp_path / "docs/made/seven.rows.jsonl").read_text().splitlines()
    assert sorted(json.loads(row)["error"] for row in rows)[-1] == pytest.approx(9.7)
    data, _ = KEPT.read(tmp_path / "docs/made/seven.json")
    assert data["made now"].startswith("all rows of case=7, and 3 rows, equal to those")


def test_a_configuration_that_changes_changes_the_identity(kept, tmp_path):
    before = kept.identity()
    road = tmp_path / "configs" / "roads" / "new.yaml"
    road.parent.mkdir(parents=True)
    road.write_text("kind: iso8608")
    assert kept.identity() != before


@pytest.mark.parametrize(
    ("script", "message"),
    [("raise SystemExit(3)", "ended with status 3"), ("print(1)", "have not written a.csv")],
)
def test_a_result_that_fails_replaces_nothing(kept, tmp_path, script, message):
    results.make_result("seven", report=lambda line: None)
    (tmp_path / "write.py").write_text(script)
    (tmp_path / "out").rename(tmp_path / "gone")
    with pytest.raises(ConfigError, match=message):
        results.make_result("seven", report=lambda line: None)
    assert results.stale_reason("seven") is None


def test_a_result_whose_need_is_absent_is_skipped_and_named(kept, capsys):
    needy = KeptResult(commands=(), outputs={}, modules=(), minutes=1.0, needs="../nowhere")
    assert results._make(["seven"], {"seven": needy}) == 0
    assert "not made: it needs ../nowhere" in capsys.readouterr().out


def test_results_of_one_core_are_made_side_by_side_and_those_of_two_alone(kept, monkeypatch):
    cores = {"one": 1, "two": 2, "another": 1}
    known = {n: results.dataclasses.replace(kept, cores=k) for n, k in cores.items()}
    meeting, running, beside = threading.Barrier(2, timeout=20.0), set(), {}

    def make(name, report):
        running.add(name)
        if cores[name] == 1:
            meeting.wait()
        beside[name] = set(running)
        if cores[name] == 1:
            meeting.wait()
        running.remove(name)
        return 60.0

    monkeypatch.setattr(results, "make_result", make)
    monkeypatch.setattr(results, "stale_reason", lambda name: "it was never made")
    assert results._make(cores, known, jobs=2) == 0
    assert beside == {"one": {"one", "another"}, "another": {"one", "another"}, "two": {"two"}}


def test_the_list_is_valid_and_its_modules_exist():
    known = results.known_results()
    assert len(known) > 15
    for name, result in known.items():
        assert result.modules, name
        for module in result.modules:
            assert results.Kind("x", 1, (module,)).identity() != results.Kind("x", 1).identity()
            assert _find_source(module), module
    outputs = [path for result in known.values() for path in result.outputs.values()]
    assert len(outputs) == len(set(outputs))


@pytest.mark.parametrize("name", ["agents", "benchmark_of_switching", "policies_on_other_cars"])
def test_an_hour_of_switching_is_not_stale_with_an_estimator(name):
    files = closure(*results.known_results()[name].modules)
    reached = [f.relative_to(ROOT).as_posix() for f in files if f.is_relative_to(ROOT)]
    assert [f for f in reached if f.startswith("estimators/")] == ["estimators/api.py"]


def test_every_output_that_a_page_quotes_or_shows_is_of_a_kept_result():
    quoted = set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for found in re.findall(r"<!-- from\s+([^>]+?) -->", text):
            quoted |= set(found.split(", "))
        for found in re.findall(r"\]\((?:\.\./)*(?:docs/)?(images/[^)]+)\)", text):
            quoted.add(f"docs/{found}")
    assert len(quoted) > 15
    assert sorted(path for path in quoted if results.result_of(path) is None) == []


def test_an_unknown_name_is_refused_with_the_choices(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["results", "check", "feild"])
    with pytest.raises(SystemExit):
        results.main()
    assert "feild" in capsys.readouterr().err
