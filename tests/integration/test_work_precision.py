"""Work-precision comparison: all integrators reproduce one reference solution."""

import json
import math
import shutil
import sys

import numpy as np
import pytest
import typer

from road_envs.roads import load_road
from studies import missed_bumps
from studies import work_precision as precision
from studies.bench import integrators
from studies.bench.integrators import (
    EXPLICIT_METHODS,
    IntegrationProblem,
    PeerError,
    relative_error,
)

METHODS = (*EXPLICIT_METHODS, "LSODA", "BDF", "Radau")


@pytest.fixture(scope="module")
def problem():
    return IntegrationProblem(0.6)


@pytest.fixture(scope="module")
def truth(problem):
    return problem.scipy("Radau", 1e-6)


@pytest.mark.costly
def test_the_body_moves_in_the_compared_drive(truth):
    assert truth.shape == (600, 3)
    assert abs(truth[-100:, 0]).max() > 0.1


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.costly
def test_every_scipy_method_reproduces_the_reference(problem, truth, method):
    assert relative_error(problem.scipy(method, 1e-5), truth) < 0.003


def test_both_of_our_integrators_reproduce_the_reference(problem, truth):
    assert relative_error(problem.fixed_step(0.000125), truth) < 0.003
    assert relative_error(problem.adaptive(1e-6), truth) < 0.003


def test_a_step_limit_prevents_adaptive_solvers_from_skipping_a_bump():
    bump = load_road("bump_small").realise(np.random.default_rng(0))
    unlimited, limited = IntegrationProblem(2.0, bump), IntegrationProblem(2.0, bump, max_step=0.01)
    assert np.abs(unlimited.scipy("BDF", 1e-3)).max() < 1e-9
    truth = limited.scipy("DOP853", 1e-6)
    assert np.abs(truth[:, 0]).max() > 5.0
    assert relative_error(limited.scipy("BDF", 1e-4), truth) < 0.02
    assert relative_error(limited.adaptive(1e-5), truth) < 0.02


def test_speed_at_equal_error_follows_power_laws_and_is_unknown_beyond_them():
    steps = 1e-3 * 0.5 ** np.arange(3)
    rows = [
        {"method": precision.OURS[0], "error": 40.0 * h, "times_real_time": 2e6 * h} for h in steps
    ]
    rows += [
        {"method": "order 4", "error": e, "times_real_time": 100.0 * e**0.25} for e in (1e-4, 0.3)
    ]
    rows += [{"method": "exact", "error": e, "times_real_time": 1.0} for e in (1e-6, 1e-5)]
    speeds = precision.speeds_at_equal_error(rows)
    assert speeds[precision.OURS[0]] == pytest.approx(2000.0)
    assert speeds["order 4"] == pytest.approx(100.0 * 0.04**0.25)
    assert math.isnan(speeds["exact"])


def test_the_missed_bump_is_found_with_limited_steps():
    heights = [missed_bumps.largest_heave("Radau", rtol, step) for rtol, step in missed_bumps.CASES]
    assert max(heights[:2]) < 1e-9
    assert heights[2] == pytest.approx(missed_bumps.largest_heave("DOP853", 1e-6, 1e-3), rel=0.01)


def test_sundials_reproduces_the_reference(problem, truth):
    pytest.importorskip("sksundae", reason="scikit-sundae is not installed")
    assert relative_error(problem.cvode(1e-6), truth) < 0.003


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("octave-cli") is None, reason="Octave is not installed")
def test_octaves_ode23s_reproduces_the_reference(problem, truth):
    a, seconds = problem.octave(1e-3)
    assert relative_error(a, truth) < 0.01
    assert seconds > 0.0


def test_a_missing_or_failing_peer_raises_an_error_that_names_it(problem, monkeypatch, tmp_path):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(PeerError, match="Octave is not installed"):
        problem.octave(1e-3)
    monkeypatch.setitem(sys.modules, "sksundae.cvode", None)
    with pytest.raises(PeerError, match="scikit-sundae is not installed"):
        problem.cvode(1e-3)
    monkeypatch.setattr(shutil, "which", lambda name: sys.executable)
    with pytest.raises(PeerError, match=r"Octave failed: .*norc"):
        problem.octave(1e-3)


@pytest.mark.costly
def test_the_command_measures_plots_and_names_skipped_peers(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(precision, "_timed", lambda run, setting: (run(setting), 0.05))
    monkeypatch.setattr(precision, "SCIPY", {"RK45": (1e-3, 1e-5)})
    monkeypatch.setitem(sys.modules, "sksundae.cvode", None)
    monkeypatch.setattr(integrators.shutil, "which", lambda name: None)
    picture = tmp_path / "p.png"
    words = ["--out", str(picture), "--duration", "0.6"]
    with pytest.raises(SystemExit) as ended:
        monkeypatch.setattr(sys, "argv", ["work_precision", *words, "--json"])
        typer.run(precision.precision)
    assert not ended.value.code
    rows = json.loads(capsys.readouterr().out)
    done = [row for row in rows if "error" in row]
    assert {row["method"] for row in done} == {*precision.OURS, "SciPy RK45"}
    assert all(row["times_real_time"] == pytest.approx(12.0) for row in done)
    steps = [row["error"] for row in done if "step" in row]
    assert steps == sorted(steps, reverse=True) and steps[-1] < 0.02
    assert [row["method"] for row in rows if "skipped" in row] == [
        "SUNDIALS CVODE",
        "Octave ode23s",
    ]
    assert picture.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(SystemExit):
        monkeypatch.setattr(sys, "argv", ["work_precision", *words])
        typer.run(precision.precision)
    out, err = capsys.readouterr()
    assert "rtol 0.001" in out and "h = 0.125 ms" in out
    assert "Octave ode23s is skipped: Octave is not installed" in " ".join(err.split())
