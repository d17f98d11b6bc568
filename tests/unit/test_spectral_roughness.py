"""Roughness class and level from accelerations, against the simulated roads."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from test_wiener import DEFENDER, drive

from estimators.roughness.spectral import class_probabilities, classify_record
from road_envs.drives.recording import simulate_record
from road_envs.records.record import PROFILE_SPACING
from road_envs.records.roughness import (
    CLASSES,
    band_means,
    displacement_psd,
    octave_levels,
    roughness_class,
)
from road_envs.roads import Iso8608, Potholes, Superposed, realise_road


@pytest.mark.parametrize(("road", "mode"), [("iso_b", "ride"), ("iso_d", "split")])
def test_octaves_have_the_levels_and_classes_of_the_road(road, mode):
    record, truth = drive("defender", road, mode, 54.0, length=150.0)
    found = classify_record(record, DEFENDER)
    n, G = displacement_psd(truth.z, PROFILE_SPACING)
    low, high = found.octaves * 2.0**-0.5, found.octaves * 2.0**0.5
    true = band_means(n, G, low, high).mean(axis=0) * (found.octaves / 0.1) ** 2
    np.testing.assert_array_equal(found.octaves, [0.25, 0.5, 1.0])
    assert (np.abs(10.0 * np.log10(found.levels / true)) < 1.5).all()
    assert found.octave_classes == tuple(roughness_class(level) for level in true)
    assert found.letter == road[-1].upper()


def test_class_probabilities_are_those_of_a_normal_log_level():
    found = class_probabilities(np.log(600e-6), 0.3)
    assert sum(found.values()) == pytest.approx(1.0)
    upper, lower = (np.log(limit / 600e-6) / 0.3 for limit in (512e-6, 128e-6))
    assert found["C"] == pytest.approx(stats.norm.cdf(upper) - stats.norm.cdf(lower))
    assert max(found, key=found.get) == "D"
    for name, mean in CLASSES.items():
        assert class_probabilities(np.log(mean), 0.01)[name] == pytest.approx(1.0)


def test_the_command_reports_the_class(road_recon):
    simulate = ("simulate", "--road", "iso_c", "--length", "60", "--speed-kmh", "36")
    assert road_recon(*simulate, "--out", "d.parquet")[0] == 0
    code, out, _ = road_recon("classify", "d.parquet", "--json")
    facts = json.loads(out)
    assert code == 0 and facts["class"] == "C"
    assert facts["probability"]["C"] > 0.5 and len(facts["levels"]) == len(facts["octaves"])
    code, out, _ = road_recon("classify", "d.parquet")
    assert code == 0 and "class C" in out
    assert road_recon("classify", "none.parquet")[0] == 2


def true_level(truth):
    """Geometric mean of the levels of the octaves from 0.25 to 1 cycles/m."""
    _, levels = octave_levels(*displacement_psd(truth.z, truth.ds), (0.25, 1.0))
    return float(np.exp(np.log(levels.mean(axis=0)).mean()))


@pytest.mark.costly
@pytest.mark.parametrize("seed", [0, 2, 4])
def test_an_individual_is_adapted_to_its_drive_and_its_level_lies_in_the_interval(seed):
    surface = realise_road("iso_b", seed, 200.0)
    record, truth = simulate_record(surface, speed_kmh=30.0, grade="S2", seed=seed)
    found = classify_record(record, DEFENDER)
    error = np.log(found.G_d0 / true_level(truth))
    assert any("adapted to the drive" in note for note in found.notes)
    assert abs(error) < 2.0 * found.log_std < 1.5


@pytest.mark.costly
def test_a_road_with_many_potholes_has_a_note_and_an_interval_with_its_level():
    plain, holes = Iso8608(G_d0=32e-6, length=200.0), Potholes(length=200.0, rate=0.1)
    surface = realise_road(Superposed(roads=(plain, holes)), 7)
    record, truth = simulate_record(surface, speed_kmh=30.0, seed=7)
    found, level = classify_record(record, DEFENDER), true_level(truth)
    assert any("shaken by obstacles" in note for note in found.notes)
    assert np.log(level / found.G_d0) > 0.5  # spectra tell too little
    assert np.log(level / found.G_d0) < 2.0 * found.log_std


@pytest.mark.costly
def test_what_tolerances_leave_open_of_a_level_is_in_its_interval():
    record, _ = drive("defender", "iso_b", "ride", 54.0, length=150.0)
    described = classify_record(record, DEFENDER)
    known = classify_record(record, replace(DEFENDER, tolerances={}))
    assert described.G_d0 == pytest.approx(known.G_d0, rel=0.01)
    assert described.log_std > 1.15 * known.log_std
