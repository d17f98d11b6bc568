"""A described vehicle is adapted to its own drive by the likelihood of the spectra."""

from dataclasses import replace

import numpy as np
import pytest
from test_wiener import DEFENDER, PAPER, SPLIT, drive, in_band, synthetic_segment

from estimators.registry import create
from estimators.wiener import adaptation
from estimators.wiener.adaptation import _fisher_scoring, _model_error_psd, _responses
from estimators.wiener.iteration import Iterate
from estimators.wiener.spectral_model import SensedVehicle, _build_model
from estimators.wiener.tuning import TUNING
from leaderboard.scoring import score
from road_envs.analysis.information_bound import equivalent_damping
from road_envs.drives.recording import simulate_record
from road_envs.vehicle.linear_model import frequency_response, linearise
from road_envs.vehicle.tolerances import parameter_space

SPACE = parameter_space(DEFENDER)


def test_parameters_are_found_within_their_covariance():
    x = np.random.default_rng(5).standard_normal(SPACE.size)
    segment, true = synthetic_segment(1024e-6, 0.1, 5, v=15.0, car=SPACE.from_vector(x))
    described = SensedVehicle.of(DEFENDER, PAPER)
    given = segment, true.prior, true.size, true.noise_scale
    model = _build_model(described, *given)
    nothing = np.zeros((2, true.n.size))
    iterate = Iterate(nothing, nothing, model.S, model, segment.a, model.noise_psd())
    found, covariance, gain = _fisher_scoring(
        SPACE, np.zeros(SPACE.size), PAPER, segment, iterate, 3
    )
    std = np.sqrt(np.diag(covariance))
    known = std < 0.5
    assert gain > 100.0 and known.sum() >= 5
    assert (np.abs(found - x)[known] < 3.0 * std[known]).all()
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), found - x)
    assert 0.5 < np.mean(whitened**2) < 2.0


def response(car, segment, model, damping):
    one = SensedVehicle.of(car, PAPER)
    linear = linearise(one.plant, segment.mode, one.points, damping=damping)
    return one.response(frequency_response(linear, segment.v, f=model.f), model.f, model.n)


def test_derivatives_of_the_response_are_differences_of_responses():
    segment, model = synthetic_segment(256e-6, 1.0, 1)
    part = replace(model, n=model.n[20:600:20], f=model.f[20:600:20], S=model.S[20:600:20])
    space = parameter_space(DEFENDER, structure=True)
    _, dH = _responses(space, np.zeros(space.size), PAPER, segment, part)
    damping = equivalent_damping(space.car, segment.mode, segment.v, part.prior)
    for name in ("m_b", "front.m", "variation.tyre.RL", "variation.frame.f", "variation.bending.f",
                 "variation.contact_length", "variation.gas.FR"):  # fmt: skip
        k = space.names.index(name)
        d = 0.02 * np.eye(space.size)[k]
        ends = [response(space.from_vector(x), segment, part, damping) for x in (d, -d)]
        expected = (ends[0] - ends[1]) / 0.04
        assert np.abs(dH[k] - expected).max() < 0.1 * np.abs(expected).max(), name


def test_the_error_of_a_model_is_that_of_random_models():
    rng = np.random.default_rng(1)
    dH = rng.standard_normal((3, 2, 4, 2)) + 1j * rng.standard_normal((3, 2, 4, 2))
    root = rng.standard_normal((3, 3))
    S = np.array([[[2.0, 0.5], [0.5, 1.0]]] * 2)
    errors = np.tensordot((rng.standard_normal((20_000, 3)) @ root.T), dH, axes=1)
    expected = np.mean(errors @ S @ np.conj(np.swapaxes(errors, -1, -2)), axis=0)
    found = _model_error_psd(dH, root @ root.T, S)
    np.testing.assert_allclose(found, expected, atol=0.05 * np.abs(expected).max())


@pytest.mark.costly
def test_a_vehicle_as_described_is_not_adapted(monkeypatch):
    """Even if its noise, which chance makes large, gives rise to a first step."""
    record, _ = drive("defender", "iso_d", "split", 54.0, 1, 60.0)
    found = []
    for scale in (0.0, np.inf):
        monkeypatch.setattr(adaptation, "TUNING", replace(TUNING, adapted_scale=scale))
        found.append(create("wiener").estimate(record, DEFENDER))
    np.testing.assert_array_equal(found[0].z, found[1].z)
    assert not any("adapted" in note for note in found[0].notes)


@pytest.mark.costly
def test_deviations_contain_the_tolerances_of_a_vehicle_that_is_not_adapted():
    """On a road so smooth that the own departures of a vehicle hardly show."""
    inside = []
    for seed in (5100, 5101):
        given = {"vehicle": DEFENDER, "speed_kmh": 100.0, "mode": SPLIT, "length": 200.0}
        record, truth = simulate_record("iso_b", **given, instruments=PAPER, seed=seed, grade="S1")
        for car in (DEFENDER, replace(DEFENDER, tolerances={})):
            found = create("wiener").estimate(record, car)
            inside.append(score(found, truth, speed_kmh=100.0)["coverage_90"])
    told, bare = np.reshape(inside, (2, 2)).mean(axis=0)
    assert 0.85 < told < 0.95
    assert bare < told - 0.03


@pytest.mark.slow
def test_a_vehicle_that_departs_is_adapted_to_its_own_drive():
    given = {"vehicle": DEFENDER, "speed_kmh": 54.0, "mode": SPLIT, "length": 50.0}
    record, truth = simulate_record("iso_d", **given, instruments=PAPER, seed=901, grade="S2")
    found = create("wiener").estimate(record, DEFENDER)
    told = create("wiener", adapt=False).estimate(record, DEFENDER)
    assert in_band(found, truth, 54.0) < 0.4 < 0.6 < in_band(told, truth, 54.0)
    assert any("adapted to the drive" in note for note in found.notes)
    bare = replace(DEFENDER, tolerances={})
    np.testing.assert_array_equal(create("wiener").estimate(record, bare).z, told.z)
