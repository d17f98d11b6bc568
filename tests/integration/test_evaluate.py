"""Evaluation: scores, failures, isolation of the test truth, baselines, stale results."""

import dataclasses

import numpy as np
import pytest
from fake_estimators import Broken, Learner, Reader
from fake_results import run_scores, runs_of
from fakes import fake_drives, task
from in_process import InProcessExecutor

import estimators
from leaderboard.entries.entries import make_entry
from leaderboard.entries.entry import EntryError, LocalSession, needs_training, reconstruct_all
from leaderboard.evaluation.evaluate import run_task
from leaderboard.evaluation.results import content_digest
from leaderboard.evaluation.store import row_path
from leaderboard.evaluation.test_data import simulate_drives
from leaderboard.metrics.baselines import BASELINES, NOISE_LEVEL, truth_plus_noise
from leaderboard.metrics.heights import nrmse, scored_band
from leaderboard.running.board import RunRequest, baseline_names, load_board, run_board
from road_envs.core.config import ConfigError
from road_envs.simulation.drive import SimulationError


def run(entries, seeds=(1, 2, 3), t=None, **options):
    results = run_task(t or task(), entries, seeds, simulate=fake_drives, **options)
    return {result.estimator: result for result in results}


def board(tmp_path, by_name, t=None, simulate=fake_drives, progress=lambda *_: None, **options):
    entries = [make_entry(name, estimator) for name, estimator in by_name.items()]
    request = RunRequest([t or task()], entries, **options)
    return run_board(request, tmp_path, InProcessExecutor(simulate, by_name), progress)


def test_a_scaled_truth_has_the_error_of_its_scale_on_every_drive():
    result = run({"reader": Reader(gain=0.9)})["reader"]
    np.testing.assert_allclose(run_scores(result, "nrmse"), np.full((5, 2, 1), 0.1), atol=0.01)
    np.testing.assert_allclose(
        run_scores(result, "level_error"), np.full((5, 2, 1), 0.1), atol=0.01
    )
    assert result.failure is None and result.settings == {"gain": 0.9}
    assert [road_seed for _, _, _, road_seed, _ in runs_of(result)] == [11, 12, 13, 14, 15] * 2


def test_an_entry_that_uses_its_arrays_again_is_scored_by_what_they_were():
    used: dict[tuple[int, ...], np.ndarray] = {}

    class Reusing(Reader):
        def estimate(self, record, car):
            made = super().estimate(record, car)
            z = used.setdefault(made.z.shape, np.empty(made.z.shape))
            z[:] = made.z
            return dataclasses.replace(made, z=z)

    results = run({"reader": Reader(gain=0.9), "reusing": Reusing(gain=0.9)}, seeds=(1,))
    assert len(used) == 1
    mine, reader = (run_scores(results[name], "nrmse") for name in ("reusing", "reader"))
    np.testing.assert_array_equal(mine, reader)


def test_all_training_seeds_are_stored_and_traces_are_of_the_median_one():
    result = run({"learner": Learner()})["learner"]
    error = run_scores(result, "nrmse")
    assert error.shape == (5, 2, 3) and len(result.train_seconds) == 6
    assert result.parameters == 1
    for condition, trace in enumerate(result.traces):
        first_road = error[0, condition]
        assert trace.scores["nrmse"] == np.median(first_road) != first_road.min()


def test_an_entry_with_deterministic_training_is_trained_once():
    result = run({"learner": Learner(spread=0.0)})["learner"]
    assert run_scores(result, "nrmse").shape == (5, 2, 1)
    assert result.seeds == (1, 2, 3)


def test_the_same_seeds_give_the_same_scores():
    entries = {"learner": Learner(), "truth_plus_noise": None}
    once, again = run(entries), run(entries)
    for name, result in once.items():
        assert content_digest(result) == content_digest(again[name])


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("raises", "RuntimeError: no idea"),
        ("exits", "SystemExit: 3"),
        ("nan", "must be finite"),
        ("masked", "some of its numbers are masked"),
        ("short", "shape"),
        ("one path", "shape"),
        ("text", "expected an Estimate, got str"),
        ("scribbles", "read-only"),
    ],
)
def test_a_failure_is_a_row_with_the_reason_and_other_rows_are_unaffected(how, message):
    results = run({"broken": Broken(how=how), "reader": Reader()})
    failed = results["broken"]
    assert message in failed.failure and "\n" not in failed.failure
    assert failed.failure.startswith("ride, 14.5 km/h, estimating test drive 1 of 5, seed 1: ")
    assert failed.scores is None and failed.traces == ()
    assert results["reader"].failure is None
    np.testing.assert_allclose(run_scores(results["reader"], "nrmse"), 0.1, atol=0.01)


def test_an_absurd_estimate_has_finite_large_scores():
    result = run({"absurd": Broken(how="absurd")})["absurd"]
    assert result.failure is None
    assert (run_scores(result, "nrmse") > 1e6).all() and np.isfinite(
        run_scores(result, "iri_error")
    ).all()


def test_a_failed_training_names_the_seed():
    class Stubborn(Learner):
        def fit(self, records, truths, car, seed):
            raise ValueError("singular\nmatrix")

    failed = run({"stubborn": Stubborn()})["stubborn"]
    assert failed.failure == "ride, 14.5 km/h, training with seed 1: ValueError: singular matrix"


@pytest.mark.parametrize("error", [SimulationError, ZeroDivisionError])
def test_a_failed_simulation_fails_every_row_of_the_task(error):
    def breaks_down(t, drives, condition):
        if condition.speed_kmh > 50.0:
            raise error("the car left the road")
        return fake_drives(t, drives, condition)

    for result in run_task(task(), {"reader": Reader()}, simulate=breaks_down):
        failure = "54 km/h: the simulation of a drive failed: the car left the road"
        assert failure in result.failure


def test_an_entry_gets_training_truths_and_test_records_only():
    seen = []

    class Curious(Learner):
        def fit(self, records, truths, car, seed):
            seen.extend([("truth", t.z.shape) for t in truths])
            return super().fit(records, truths, car, seed)

        def estimate(self, record, car):
            seen.append(tuple(sorted(vars(record))))
            return super().estimate(record, car)

    run({"curious": Curious()}, seeds=(1,))
    assert [what for what in seen if what[0] == "truth"] == [("truth", (2, 1585))] * 4
    fields = ("a", "damper_high", "length", "low_pass", "s", "sensors", "spring_stiff", "t", "v")
    assert [what for what in seen if what[0] != "truth"] == [fields] * 10


def test_reconstruct_returns_the_estimates_and_names_the_failing_step():
    t = task()
    drives = list(fake_drives(t, t.test, t.conditions[0]))
    records = [drive.record for drive in drives]
    (training_run,) = reconstruct_all(LocalSession(Reader(gain=1.0), t.vehicle), [], records, [1])
    assert len(training_run.estimates) == 5 and training_run.estimate_seconds > 0.0
    with pytest.raises(EntryError, match="estimating test drive 1 of 5, seed 7: RuntimeError"):
        list(reconstruct_all(LocalSession(Broken(how="raises"), t.vehicle), [], records, [7]))


def test_an_estimator_with_weights_is_evaluated_without_training():
    (first, *_), t = fake_drives(task(), task().training, task().conditions[0]), task()
    fitted = Learner().fit([first.record], [first.truth], t.vehicle, seed=5)
    assert needs_training(Learner()) and not needs_training(fitted) and not needs_training(Reader())
    result = run({"fitted": fitted})["fitted"]
    assert run_scores(result, "nrmse").shape == (5, 2, 1) and result.parameters == 1
    np.testing.assert_allclose(run_scores(result, "nrmse"), abs(1.0 - fitted.gain), atol=0.01)


def test_truth_plus_noise_has_exactly_its_noise_level():
    t = task()
    (drive, *_) = fake_drives(t, t.test, t.conditions[0])
    band = scored_band(14.5 / 3.6)
    noisy = truth_plus_noise(drive.truth, band, seed=1)
    error = nrmse(drive.truth.z, noisy.z, drive.truth.ds, band)
    assert error.pooled == pytest.approx(NOISE_LEVEL, rel=1e-9)


@pytest.mark.parametrize("delay", [0.4, 1.0])
def test_memory_is_the_training_road_without_its_delay(delay):
    """Its error is the noise of the copy inside the band; that of `mean` is the delay."""
    belgian = {"kind": "fixed_seed", "seed": 8, "road": "belgian_like"}
    copy = {"kind": "noisy_copy", "noise": 0.1, "delay": delay, "road": belgian}
    t = task(
        training={"roads": [copy], "seeds": [1], "length": 60.0, "noise": False},
        test={"roads": [belgian], "seeds": [11], "length": 60.0},
        trains_on_test_road=True,
    )
    found = run({"memory": None, "mean": estimators.create("mean")}, t=t, seeds=(1,))
    remembered = run_scores(found["memory"], "nrmse")[0, :, 0]
    out_of_place = run_scores(found["mean"], "nrmse")[0, :, 0]
    (test,) = fake_drives(t, t.test, t.conditions[0])
    noise = np.random.default_rng(3).standard_normal(test.truth.z.shape)
    noise *= 0.1 * test.truth.z.std(axis=1, keepdims=True)
    for k, condition in enumerate(t.conditions):
        band = scored_band(condition.speed_kmh / 3.6)
        expected = nrmse(test.truth.z, test.truth.z + noise, test.truth.ds, band).pooled
        # interpolation between the samples of the noise takes off some of it
        assert 0.6 * expected < remembered[k] < 1.2 * expected
    assert (out_of_place > 0.9).all()
    assert found["memory"].role == "baseline"
    assert "memory" in baseline_names(t) and "memory" not in baseline_names(task())


def test_a_task_without_a_bound_has_none_in_its_scores():
    without, with_bound = (
        set(run({"reader": Reader()}, t=task(bound=given))["reader"].scores["score"])
        for given in (False, True)
    )
    assert with_bound - without == {"bound_nrmse", "bound_efficiency"}


def test_progress_is_reported_step_by_step():
    message = []
    entries = {"reader": Reader(), "broken": Broken(how="raises")}
    run(entries, report=message.append)
    assert len(message) == 6
    assert message[0] == "small: simulating, ride, 14.5 km/h"
    assert message[-1] == "small: broken, ride front, handling rear, 54 km/h"


@pytest.mark.costly
def test_every_board_has_the_baselines(tmp_path):
    result = board(tmp_path, {"reader": Reader()}, seeds=(1,))
    (t,) = result.tasks
    assert {r.estimator for r in result.scored(t)} == {"reader", *BASELINES}
    roles = {r.estimator: r.role for r in result.scored(t)}
    assert roles["reader"] == "entry" and roles["flat"] == "baseline"


@pytest.mark.costly
def test_progress_of_a_board_counts_up_to_its_end(tmp_path):
    steps_seen = []
    board(tmp_path, {"reader": Reader()}, seeds=(1,), progress=lambda *a: steps_seen.append(a))
    assert [share for _, share in steps_seen] == [k / 10 for k in range(11)]
    assert steps_seen[1][0].startswith("small: ") and steps_seen[1][0].endswith("km/h")


@pytest.mark.costly
def test_the_number_of_test_roads_can_be_reduced(tmp_path):
    result = board(tmp_path, {"reader": Reader()}, seeds=(1,), roads=2)
    assert run_scores(result.scored(result.tasks[0])[0], "r").shape[0] == 2
    with pytest.raises(ConfigError, match="small: number of drives must be 1 to 5, got 9"):
        board(tmp_path, {"reader": Reader()}, roads=9)


def test_two_roads_with_one_name_and_seed_are_scored_separately():
    waviness = {"kind": "iso8608", "road_class": "D", "w": 3.0, "length": 40.0}
    t = task(test={"roads": ["iso_d", waviness], "seeds": [11], "length": 40.0})
    assert run_scores(run({"reader": Reader()}, t=t)["reader"], "r").shape == (2, 2, 1)


@pytest.mark.costly
def test_results_of_a_changed_task_are_stale(tmp_path):
    board(tmp_path, {"reader": Reader()}, seeds=(1,))
    changed = dataclasses.replace(task(), version=2)
    stored = load_board([changed], tmp_path)
    assert stored.scored(changed) == [] and len(stored.stale(changed)) == 5
    assert {why for _, why in stored.stale(changed)} == {"the task has changed"}


def test_a_simulated_drive_is_evaluated(tmp_path):
    t = task(
        conditions=[{"mode": "ride", "speed_kmh": 54.0}],
        training={"roads": ["iso_d"], "seeds": [1], "length": 20.0},
        test={"roads": ["iso_d"], "seeds": [11, 12], "length": 20.0, "step": 0.0005},
    )
    result = board(tmp_path, {"learner": Learner()}, t, simulate_drives, seeds=(1,))
    results = {r.estimator: r for r in result.scored(t)}
    assert row_path(tmp_path, "small", "learner").exists()
    np.testing.assert_allclose(run_scores(results["flat"], "nrmse"), 1.0)
    np.testing.assert_allclose(run_scores(results["truth_plus_noise"], "nrmse"), NOISE_LEVEL)
    assert np.isfinite(run_scores(results["learner"], "nrmse")).all()


@pytest.mark.costly
def test_roads_with_and_without_obstacles_are_stored_in_one_part(tmp_path):
    roads = [
        "iso_d",
        "belgian_like",
        {"kind": "iso8608", "road_class": "D", "w": 2.5},
        {
            "kind": "iso8608",
            "road_class": "D",
            "w": 1.8,
            "variation": {"law": "gamma", "spread": 0.7, "patch": 50.0},
        },
        "potholes",
        "random_bumps",
    ]
    families = task(
        test={"roads": roads, "seeds": [11], "length": 150.0},
        conditions=[{"mode": "ride", "speed_kmh": 14.5}],
        bumps=True,
    )
    request = RunRequest([families], [make_entry("reader", Reader())], seeds=(1,))
    found = run_board(request, tmp_path, InProcessExecutor(fake_drives, {"reader": Reader()}))
    (row,) = [r for r in found.results["small"] if r.estimator == "reader"]
    scored = [run for run, scores in runs_of(row).items() if "bump_f1" in scores]
    assert len(runs_of(row)) == 6 and 0 < len(scored) < 6
    assert np.isfinite(row.scores["value"]).all()
