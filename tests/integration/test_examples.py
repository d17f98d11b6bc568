"""Every example runs and keeps its promises, as does the code in README.md and in the tutorials."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from warm_python import WarmPython

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs/tutorials").glob("*.md"))]

EXAMPLES = {
    "simulate_and_reconstruct": (["--compare", "fir_ridge"], ["drive.png", "estimate.png"]),
    "own_estimator": (["--roads", "1"], ["own_estimator.png"]),
    "board_from_python": (
        ["--roads", "1", "--estimators", "fir_ridge", "inverse_quarter_car"],
        ["board.png"],
    ),
    "phone_drive": ([], ["phone_drive.csv", "phone_drive.yaml", "phone_drive_truth.csv"]),
    "switch_the_suspension": (["--drives", "8"], ["switch_the_suspension.png"]),
    "train_a_policy": (["--steps", "8000"], ["train_a_policy.png", "policy.zip"]),
}
"""Options that make an example short, and the files that it writes."""

SLOW = {"own_estimator", "board_from_python", "train_a_policy"}
"""Examples that run a whole task, as README.md and the tutorial of an own estimator do too, or
train for seconds. The others run in `make test-more`, the pages in `make test`.
"""

PNG_SIGNATURE = b"\x89PNG"

CHECKS = {
    "README.md": """
        values = {"fir_ridge": table[table.estimator == "fir_ridge"].nrmse.max(),
                  "wiener": score(estimated, truth)["nrmse"],
                  "steps": model.num_timesteps, "actions": int(model.action_space.n),
                  "observed": list(model.observation_space.shape)}
    """,
    "first_drive.md": """
        values = {"nrmse": scores["nrmse"]}
    """,
    "own_estimator.md": """
        means = table.groupby("estimator")["nrmse"].mean()
        values = {"one drive": own["nrmse"], "task": means["__main__:WindowRidge"],
                  "probes": count_passed(probes)}
    """,
    "own_policy.md": """
        values = {name: float(value) for name, value in returns.items()}
    """,
    "own_vehicle.md": """
        values = {"mass": car.m_b, "right": right, "wrong": wrong}
    """,
    "measured_drive.md": """
        values = {"length": record.length, "class": type(estimated).__name__}
    """,
}
"""Code that collects the values to test at the end of a page, in its own process."""


LIBRARIES = ("leaderboard.api", "estimators.registry", "matplotlib.pyplot", "pandas")
"""What most of the scripts import."""


def environment():
    """Variables of a script: one thread for each numerical library, this checkout, no window."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    return {**os.environ, **threads, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}


@pytest.fixture(scope="module")
def run():
    """Return what a script prints: a function of the script, its words and a folder."""
    with WarmPython(LIBRARIES, environment()) as python:

        def run(*words, cwd):
            status, printed, errors = python.run(*words, cwd=cwd)
            assert status == 0, printed[-2000:] + errors[-4000:]
            return printed

        yield run


def python_blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.S | re.M)


def code_of(page: Path) -> str:
    """Return the code of a page, then that of its check, which prints the values as JSON."""
    check = re.sub(r"^ {8}", "", CHECKS[page.name], flags=re.M)
    return "\n".join([*python_blocks(page), check, "import json", "print(json.dumps(values))"])


@pytest.fixture(scope="module")
def page_values(tmp_path_factory, run):
    """Folder and values of each page, whose blocks run one after the other in one process."""
    results = {}

    def values_of(name):
        if name not in results:
            (page,) = (page for page in PAGES if page.name == name)
            folder = tmp_path_factory.mktemp("page")
            (folder / "page.py").write_text(code_of(page), encoding="utf-8")
            results[name] = folder, json.loads(run(folder / "page.py", cwd=folder).splitlines()[-1])
        return results[name]

    return values_of


def test_every_example_and_every_page_with_code_is_tested():
    assert {path.stem for path in (ROOT / "examples").glob("*.py")} == set(EXAMPLES)
    assert {page.name for page in PAGES if python_blocks(page)} == set(CHECKS)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in SLOW else pytest.mark.processes)
        for name in EXAMPLES
    ],
)
def test_an_example_runs_from_another_folder_and_writes_its_files(name, run, tmp_path):
    options, files = EXAMPLES[name]
    printed = run(ROOT / f"examples/{name}.py", "--out", tmp_path / "out", *options, cwd=tmp_path)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(files)
    for file in files:
        content = (tmp_path / "out" / file).read_bytes()
        assert len(content) > (100 if file.endswith(".yaml") else 10_000)
        assert not file.endswith(".png") or content.startswith(PNG_SIGNATURE)
    if name == "own_estimator":
        errors = [float(line.split()[-3]) for line in printed.splitlines() if "km/h" in line]
        assert len(errors) == 7 and max(errors) < 0.6
        assert "FAILED" not in printed
    if name == "switch_the_suspension":
        returns = dict(re.findall(r"^(.+?) +return (-[\d.]+) on", printed, re.M))
        assert float(returns["lateral threshold"]) > float(returns["always handling"])


def test_an_own_estimator_needs_at_most_80_lines():
    code = (ROOT / "examples/own_estimator.py").read_text(encoding="utf-8")
    cls = code[code.index("@dataclass") : code.index("# %% [markdown]\n# ## The probes")]
    assert len(cls.splitlines()) <= 80


@pytest.mark.costly
def test_the_readme_runs_and_gives_what_it_states(tmp_path):
    """In a new interpreter, as readers run it."""
    (tmp_path / "page.py").write_text(code_of(ROOT / "README.md"), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "page.py"],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    values = json.loads(done.stdout.splitlines()[-1])
    assert (tmp_path / "estimate.png").read_bytes().startswith(PNG_SIGNATURE)
    assert values["wiener"] < 0.3 and values["fir_ridge"] < 0.6 and values["steps"] >= 4096
    stated = README.split("## Train a policy")[1].split("## Report")[0]
    assert f"`Discrete({values['actions']})`" in stated
    assert f"`Box({values['observed'][0]},)`" in stated


@pytest.mark.parametrize(
    "lines",
    [pytest.param(700, marks=pytest.mark.processes), pytest.param(None, marks=pytest.mark.slow)],
    ids=["beginning", "whole"],
)
def test_the_report_of_the_readme_is_written(lines, road_recon, tmp_path):
    """The command as it stands, on the beginning of its drive or on all of it (minutes)."""
    (command,) = re.findall(r"^road-recon (report .*)$", README, re.M)
    words = command.split()
    for k, word in enumerate(words):
        if word.startswith("docs/"):
            words[k] = str(tmp_path / Path(word).name)
            text = (ROOT / word).read_text(encoding="utf-8").splitlines(keepends=True)
            Path(words[k]).write_text("".join(text[:lines]), encoding="utf-8")
    code, printed, error = road_recon(*words)
    assert code == 0, printed + error
    assert (tmp_path / "report/index.html").is_file()


@pytest.mark.costly
def test_the_first_drive_is_reconstructed_with_the_error_that_it_states(page_values):
    folder, values = page_values("first_drive.md")
    assert values["nrmse"] == pytest.approx(0.19, abs=0.01)
    assert (folder / "estimate.png").read_bytes().startswith(PNG_SIGNATURE)


@pytest.mark.costly
def test_the_estimator_of_the_tutorial_learns_and_passes_the_probes(page_values):
    _, values = page_values("own_estimator.md")
    assert values["one drive"] < 0.7 and values["task"] == pytest.approx(0.48, abs=0.05)
    assert values["probes"] == "5/5"


@pytest.mark.costly
def test_the_policy_of_the_tutorial_beats_constant_states(page_values):
    _, values = page_values("own_policy.md")
    assert values["own"] > max(values["ride"], values["handling"])


@pytest.mark.costly
def test_the_vehicle_of_the_tutorial_is_estimated_best_with_its_own_parameters(page_values):
    _, values = page_values("own_vehicle.md")
    assert values["mass"] == 1250.0
    assert values["right"] < values["wrong"]


@pytest.mark.costly
def test_the_table_of_the_tutorial_is_read_as_a_measured_drive(page_values):
    folder, values = page_values("measured_drive.md")
    assert values["length"] > 100.0 and values["class"] == "Estimate"
    assert (folder / "road.png").read_bytes().startswith(PNG_SIGNATURE)
