"""The training corpus, the training command, and the shipped weights."""

import dataclasses
import json
import subprocess
import sys
from functools import cache

import numpy as np
import pytest

from estimators import REGISTRY, create, pretrained_weights, weights_io
from estimators.api import check_estimate
from leaderboard import pretraining
from leaderboard.entries.entry import needs_training
from leaderboard.evaluation.tasks import load_task
from leaderboard.evaluation.test_data import simulate_drives
from leaderboard.metrics.heights import band_pass, nrmse, scored_band
from road_envs.core import artifacts
from road_envs.drives import training_corpus
from road_envs.drives.recording import simulate_record, write_record
from road_envs.drives.training_corpus import Corpus, _perturb_parameters
from road_envs.roads import Iso8608
from road_envs.roads.formats.write import write
from road_envs.roads.surface import Surface
from road_envs.sensing.perturbed_vehicle import load_plant_mismatch
from road_envs.simulation.drive import SimulationError

CORPUS = Corpus(number=6, shortest=20, longest=30)
PRETRAINED = [path.stem for path in sorted(pretrained_weights.FOLDER.glob("*.safetensors"))]


@cache
def board_drives(number: int):
    """Return the test drives of each condition of the main board."""
    task = load_task("new_road")
    test = task.with_test_drives(number).test
    return task.vehicle, [(c, list(simulate_drives(task, test, c))) for c in task.conditions]


def errors_and_coverage(name: str, number: int):
    """Errors in the scored band and interval coverage on drives of the main board, by condition."""
    estimator, (car, conditions) = create(name), board_drives(number)
    found = {}
    for condition, drives in conditions:
        rows = []
        for test in drives:
            estimate = estimator.estimate(test.record, car)
            check_estimate(estimate, test.record)
            band = scored_band(condition.speed_kmh / 3.6)
            error = nrmse(test.truth.z, estimate.z, test.truth.ds, band).pooled
            rows.append((error, _covered(test.truth, estimate, band)))
        found[condition.label] = rows
    return found


def _covered(truth, estimate, band):
    if estimate.z_std is None:
        return None
    error = np.abs(band_pass(estimate.z - truth.z, truth.ds, band))
    cut = (truth.s.size - error.shape[1]) // 2
    std = estimate.z_std[:, cut : cut + error.shape[1]]
    return [np.mean(error < far * std) for far in (0.6745, 1.6449)]


def test_corpus_drives_are_reproducible_and_differ_by_number():
    one, same, other = (CORPUS.simulate_drive(k) for k in (3, 3, 4))
    np.testing.assert_array_equal(one[0].a, same[0].a)
    np.testing.assert_array_equal(one[1].z, same[1].z)
    assert one[0].v[0] != other[0].v[0]


def test_the_corpus_covers_speeds_modes_and_levels():
    drives = [CORPUS.simulate_drive(k) for k in range(50)]
    v = 3.6 * np.array([record.v[0] for record, _, _ in drives])
    assert v.min() < 10.0 and v.max() > 50.0 and np.all((v > 4.9) & (v < 72.1))
    states = {(*r.spring_stiff[0, [0, 2]], *r.damper_high[0, [0, 2]]) for r, _, _ in drives}
    assert {(False,) * 4, (True,) * 4, (False, True, False, True)} <= states and len(states) > 6
    level = np.array([truth.z.std() for _, truth, _ in drives])
    assert level.max() > 10.0 * level.min()


def test_a_third_of_the_corpus_are_individuals_and_calibration_drives_are_nominal(monkeypatch):
    asked = []

    def remember(surface, *, grade, instruments, **_):
        asked.append((grade, instruments.noise_density))
        raise SimulationError("not simulated")

    monkeypatch.setattr(training_corpus, "simulate_record", remember)
    monkeypatch.setattr(
        training_corpus, "_draw_road", lambda rng, length: Iso8608(road_class="A", length=5.0)
    )
    for k in range(12):
        with pytest.raises(SimulationError):
            CORPUS.simulate_drive(k)
    grades = [grade for grade, _ in asked]
    for grade, share in {"S0": 0.66, "S1": 0.06, "S2": 0.14, "S3": 0.14}.items():
        assert grades.count(grade) / len(grades) == pytest.approx(share, abs=0.1), grade
    asked.clear()
    with pytest.raises(SimulationError):
        CORPUS.simulate_drive(0, nominal=True)
    assert set(asked) == {("S0", CORPUS.sensors.noise_density)}


def test_vehicles_vary_by_the_stated_amounts():
    car = Corpus().vehicle
    rng = np.random.default_rng(0)
    others = [_perturb_parameters(car, rng, 1.0) for _ in range(200)]
    assert np.std([c.m_b / car.m_b for c in others]) == pytest.approx(0.06, rel=0.2)
    peaks = [c.strut.friction.ride.F[0] / car.strut.friction.ride.F[0] for c in others]
    assert np.std(peaks) == pytest.approx(0.158, rel=0.2)  # 15 % and 5 % together
    assert _perturb_parameters(car, rng, 0.0) == car


def test_different_corpora_have_different_digests():
    assert Corpus().digest == Corpus().digest
    changes = ({"number": 7}, {"seed": 2}, {"instruments": "ideal"}, {"fastest_kmh": 60.0})
    digests = {dataclasses.replace(Corpus(), **change).digest for change in changes}
    assert len(digests | {Corpus().digest}) == 5


def test_the_digest_depends_on_the_deviations_of_individuals(monkeypatch):
    before, known = Corpus().digest, load_plant_mismatch()
    monkeypatch.setattr(
        training_corpus, "load_plant_mismatch", lambda: dataclasses.replace(known, step=0.001)
    )
    assert Corpus().digest != before


@pytest.mark.costly
def test_a_short_training_is_reproducible_to_the_bit_interrupted_or_not(tmp_path, monkeypatch):
    """The command of the shipped weights on fewer drives and steps; drives are simulated once."""
    simulated = cache(CORPUS.simulate_drive)
    monkeypatch.setattr(Corpus, "simulate_drive", lambda self, *which: simulated(*which))

    def train(folder):
        folder.mkdir(exist_ok=True)
        estimator = create("tcn", channels=4, steps=6)
        out = folder / "tcn.safetensors"
        pretraining.train(estimator, "tcn", CORPUS, 1, out, "road-recon train tcn")
        return out

    whole = train(tmp_path / "whole")
    save = pretraining._FileCheckpoint.save

    def failing(self, state):
        save(self, state)
        if state["about"][0] >= 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(pretraining._FileCheckpoint, "save", failing)
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path / "parts")
    assert [p.name for p in (tmp_path / "parts").iterdir()] == [".tcn.safetensors.unfinished"]
    monkeypatch.setattr(pretraining._FileCheckpoint, "save", save)
    begun, load = [], pretraining._FileCheckpoint.load
    monkeypatch.setattr(
        pretraining._FileCheckpoint, "load", lambda self: begun.append(load(self)) or begun[-1]
    )
    parts = train(tmp_path / "parts")
    assert begun[0]["about"][0] == 3.0
    assert whole.read_bytes() == parts.read_bytes()
    assert [p.name for p in (tmp_path / "parts").iterdir()] == ["tcn.safetensors"]
    _, about = pretrained_weights.read_weights(whole)
    assert about["command"] == "road-recon train tcn" and about["seed"] == "1"
    assert about["corpus"] == CORPUS.digest
    assert json.loads(about["header"])["settings"]["channels"] == 4


def test_an_unfinished_state_of_another_purpose_is_ignored(tmp_path):
    path = tmp_path / "state"
    pretraining._FileCheckpoint(path, "this").save({"about": np.zeros(3)})
    assert pretraining._FileCheckpoint(path, "this").load() is not None
    assert pretraining._FileCheckpoint(path, "that").load() is None
    path.write_bytes(b"cut short")
    assert pretraining._FileCheckpoint(path, "this").load() is None


def test_an_unfinished_state_of_other_code_is_ignored(tmp_path, monkeypatch):
    tcn, out = create("tcn"), tmp_path / "tcn.safetensors"
    checkpoint = pretraining._checkpoint(tcn, out, "run")
    checkpoint.save({"about": np.zeros(3)})
    assert pretraining._checkpoint(tcn, out, "run").load() is not None
    code = {"leaderboard.pretraining": "older", type(tcn).__module__: "today"}
    monkeypatch.setattr(artifacts, "code_version", lambda *modules: [code[m] for m in modules])
    assert pretraining._checkpoint(tcn, out, "run").load() is None


def test_the_command_trains_from_the_corpus_and_its_file_estimates(road_recon, tmp_path):
    code, out, _ = road_recon(
        "train", "fir_ridge", "--drives", 4, "--out", "bank.safetensors", "--json"
    )
    assert code == 0 and json.loads(out)["drives"] == 4
    _, about = pretrained_weights.read_weights(tmp_path / "bank.safetensors")
    assert about["command"].startswith("road-recon train fir_ridge --drives 4")
    kept = weights_io.load(tmp_path / "bank.safetensors")
    assert kept.weights().keys() == {"bank"} and not needs_training(kept)


def test_an_estimator_for_one_speed_requires_training_roads(road_recon):
    code, _, err = road_recon("train", "static_lm", "--out", "s.npz")
    assert code == 2 and "static_lm is trained for one speed and mode: give training roads" in err
    code, _, err = road_recon("train", "fir_ridge", "--out", "s.npz")
    assert code == 2 and "the name must end in .safetensors" in err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--sensors", "phone"), "training on the corpus takes no --sensors: leave it out"),
        (("--road", "iso_a", "--invert", "a_rf"), "training on simulated drives takes no --invert"),
        (("d.csv", "--profile", "p.csv", "--length", "9"), "training on own drives takes no --len"),
        (("d.csv",), "give the --profile of the drives' roads"),
    ],
)
def test_options_that_a_training_does_not_use_are_refused(road_recon, tmp_path, words, sentence):
    code, out, err = road_recon("train", "fir_ridge", *words, "--out", "f.safetensors")
    assert code == 2 and err.startswith(f"error: {sentence}") and out == ""
    assert list(tmp_path.iterdir()) == []


def test_own_drives_have_whole_profiles_unless_the_estimator_takes_parts(road_recon, tmp_path):
    record, truth = simulate_record("iso_d", length=80.0, speed_kmh=36.0)
    write_record(tmp_path / "d.parquet", record, {})
    for name, start, stop in (("end", 0, 2000), ("start", 1000, None)):
        part = Surface(truth.z[:, start:stop], truth.ds, truth.s[start], name=name)
        write(part, tmp_path / f"{name}.csv")
        words = ("d.parquet", "--profile", f"{name}.csv", "--out", "f.npz")
        code, _, err = road_recon("train", "static_lm", *words)
        assert code == 2 and "all of 0 to 80.00 m are needed to train" in err
        words = (*words[:-1], "f.safetensors", "--set", "wheelbase=2.794")
        code, _, err = road_recon("train", "calibrated_fir", *words)
        assert "are needed to train" not in err
    assert not (tmp_path / "f.npz").exists()


SHIPPED_CORPUS = "0ad25ee03bd7"
"""Digest of the corpus that the shipped weights were trained on; `test_pretrained_weights` holds
that its drives are today's.
"""


@pytest.mark.parametrize("name", PRETRAINED)
def test_shipped_weights_are_small_and_state_their_corpus_and_settings(name, monkeypatch):
    path = pretrained_weights.FOLDER / f"{name}.safetensors"
    assert path.stat().st_size < 500_000
    _, about = pretrained_weights.read_weights(path)
    header = json.loads(about["header"])
    assert header["name"] == name
    assert about["corpus"] == SHIPPED_CORPUS
    monkeypatch.setattr(Corpus, "digest", SHIPPED_CORPUS)
    estimator = create(name)
    assert header["settings"] == json.loads(json.dumps(pretraining.get_settings(estimator)))
    monkeypatch.setattr(pretraining, "package_version", lambda: header["version"])
    digest = pretraining._run_digest(estimator, name, Corpus(), int(about["seed"]))
    assert about["digest"] == digest
    assert about["command"] == f"road-recon train {name} --out {name}.safetensors"
    assert not needs_training(estimator) and needs_training(create(name, shipped=False))


def test_every_pretrained_estimator_ships_weights_below_two_megabytes_in_all():
    assert set(PRETRAINED) == {name for name, cls in REGISTRY.items() if hasattr(cls, "pretrain")}
    total = sum(path.stat().st_size for path in pretrained_weights.FOLDER.glob("*.safetensors"))
    assert total < 2_000_000


def test_importing_the_estimators_does_not_import_torch():
    code = "import sys, estimators; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "False"
