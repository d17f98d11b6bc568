"""Vehicle parameters from drives: derivatives, recovery, refusals."""

from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import bilinear, lfilter
from test_map_smoother import residual_at
from vehicle_fixtures import DEFENDER

from estimators.api import CalibrationDrive, CalibrationError
from estimators.map_smoother import car_fit, identification, solver
from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.gauss_newton import GaussNewton, minimize
from estimators.map_smoother.identification import identify
from estimators.map_smoother.instrument_errors import InstrumentErrors
from estimators.map_smoother.marginal_likelihood import (
    LikelihoodTerms,
    perturbed_cars,
    perturbed_passes,
    sensitivities,
)
from estimators.map_smoother.objective import Objective
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.windows import whole_objective
from leaderboard.metrics.heights import nrmse
from road_envs.analysis.information_bound import RoadPrior
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Profile, scored_band
from road_envs.roads.iso8608 import Iso8608
from road_envs.sensing.instruments import load_instruments
from road_envs.sensing.perturbed_vehicle import perturb_vehicle
from road_envs.vehicle.equations import THETA
from road_envs.vehicle.tolerances import ParameterSpace, parameter_space

PAPER, MIXED = load_instruments("paper"), {"front": "ride", "rear": "handling"}
SPACE = parameter_space(DEFENDER)


@cache
def calibration_drive(grade="S1", seed=2, length=100.0, kmh=54.0):
    surface = Iso8608(road_class="D", length=length).realise(np.random.default_rng(900 + seed))
    record, profile = simulate_record(
        surface, vehicle=DEFENDER, speed_kmh=kmh, mode=MIXED, seed=seed, grade=grade
    )
    error = 0.0005 * np.random.default_rng(seed).standard_normal(profile.z.shape)
    return CalibrationDrive(record, Profile(profile.s, profile.z + error)), profile


def short_objective() -> Objective:
    record = calibration_drive()[0].record
    drive, _ = MapSmoother().prepare(record, DEFENDER)
    return whole_objective(drive, RoadPrior(), 600)


def test_sensitivities_are_differences_of_single_drives():
    objective = short_objective()
    x = 0.5 * np.random.default_rng(0).standard_normal(objective.size)
    lin = objective.linearize(x)
    few = ParameterSpace(DEFENDER, SPACE.names[::5], SPACE.std[::5])
    cars = perturbed_cars(few, np.zeros(few.size))
    derivatives = sensitivities(lin.passes[0], perturbed_passes(objective.passes[0], cars))
    for car, found in zip(cars[1:], derivatives, strict=True):
        (one,) = objective.passes
        residual = residual_at(replace(objective, passes=(one.with_car(car),)), x)
        expected = (lin.residual[0] - residual) / TUNING.difference
        np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def compared(result, true):
    """Deviations (P,) from the true vehicle in posterior standard deviations."""
    space = result.fit.space
    x = result.fit.x[: space.size] - space.to_vector(true)
    # the common friction and that of each strut are told apart by their tolerances alone
    friction = np.array(["friction" in name for name in space.names])
    return (x / result.std[: space.size])[~friction]


@pytest.mark.costly
def test_a_flexible_vehicle_is_recovered_from_a_drive_over_a_known_road():
    drive, _ = calibration_drive("S3")
    result = identify([drive], DEFENDER, structure=True)
    true = perturb_vehicle(DEFENDER, "S3", 2).car
    z = compared(result, true)
    assert np.mean(np.abs(z) < 3.0) >= 0.95
    told, identified = result.unexplained[0]
    assert identified.power < 0.05 * told.power
    mass = result.car.m_b / true.m_b
    assert abs(mass - 1.0) < 0.25 * abs(DEFENDER.m_b / true.m_b - 1.0) + 0.01
    contact = result.car.variation.contact_length
    assert contact == pytest.approx(true.variation.contact_length, abs=0.01)
    assert parameter_space(result.car).names == result.fit.space.names


def test_the_state_in_which_a_part_of_a_drive_begins_is_found_over_a_known_road():
    drive, _ = calibration_drive()
    car, smoother = perturb_vehicle(DEFENDER, "S1", 2).car, MapSmoother()
    _, later = identification._parts(drive, smoother)
    objective = identification._objective(later, car, smoother)
    at_rest = identification._settle(objective, GaussNewton(), 1)
    found = identification._solve(later, car, smoother)
    # what remains are the errors of the profile
    assert found.noise_scale < 5.0 < 0.05 * at_rest.noise_scale


@pytest.mark.costly
def test_the_smoother_adapts_to_another_vehicle_and_not_to_its_own():
    drive, truth = calibration_drive("S1", 1, 90.0)
    told, adapted = (
        MapSmoother(adapt=adapt, draws=0).estimate(drive.record, DEFENDER)
        for adapt in (False, True)
    )
    scores = [nrmse(truth.z, one.z, truth.ds, scored_band(15.0)).pooled for one in (told, adapted)]
    assert scores[1] < 0.7 * scores[0]
    assert any("the vehicle was adapted to the drive: " in note for note in adapted.notes)
    own = MapSmoother(draws=0).estimate(calibration_drive("S0", 1, 40.0)[0].record, DEFENDER)
    assert not any("adapted" in note for note in own.notes)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda d: replace(d, profile=Profile(d.profile.s, d.profile.z[:, ::-1])), "do not belong"),
        (
            lambda d: replace(d, profile=Profile(d.profile.s, d.profile.z[::-1])),
            "left and right exchanged fits",
        ),
        (
            lambda d: replace(d, profile=Profile(d.profile.s, d.profile.z[::-1, ::-1])),
            "reversed fits",
        ),
        (
            lambda d: replace(d, profile=Profile(d.profile.s, -d.profile.z)),
            "opposite sign fits",
        ),
        (lambda d: replace(d, record=replace(d.record, a=9.81 * d.record.a)), "check the units"),
        (
            lambda d: replace(d, profile=Profile(d.profile.s[:1000], d.profile.z[:, :1000])),
            "too short to identify",
        ),
        (lambda d: replace(d, record=replace(d.record, a=0.01 * d.record.a)), "hardly exceed"),
    ],
    ids=["reversed", "sides", "backwards", "sign", "units", "short", "smooth"],
)
def test_a_calibration_drive_that_does_not_fit_is_refused_in_one_sentence(change, reason):
    drive, _ = calibration_drive()
    with pytest.raises(CalibrationError, match=reason):
        identify([change(drive)], DEFENDER)


def test_errors_of_the_instruments_are_applied_to_the_model():
    objective = short_objective()
    (one,), c, own = objective.passes, objective.road.background, np.zeros(17)
    means = one.measurements.y - one.linearize(c, own).residual
    errors = np.zeros(11)
    errors[:3] = 2.0, 0.0, -1.0
    readings = InstrumentErrors.of(one)
    assert readings.names[:5] == ("gain.RF", "gain.LR", "gain.RR", "x.RF", "x.LR")
    assert readings.names[8:] == ("y.RR", "odometer", "speed")
    changed = readings.apply(one, errors)
    scaled = one.measurements.y - changed.linearize(c, own).residual
    expected = np.exp(readings.std * errors)[:3, None] * means
    np.testing.assert_allclose(scaled, expected, atol=1e-12)
    moved = readings.apply(one, np.eye(11)[9])
    np.testing.assert_allclose(moved.inputs.s - one.inputs.s, readings.std[9])
    rows = readings.apply(one, np.eye(11)[4]).model.sensor_rows  # ahead: pitch, nose down
    expected = np.zeros((3, 7))
    expected[1, THETA] = -0.012
    np.testing.assert_allclose(rows - one.model.sensor_rows, expected, atol=1e-12)
    assert readings.apply(one, np.zeros(0)) is one


@pytest.mark.parametrize(("described", "left", "refused"), [(90.0, 60.0, True), (90.0, 30.0, False),
                                                            (2.0, 1.9, False)])  # fmt: skip
def test_an_identification_that_does_not_explain_held_out_readings_is_refused(
    described, left, refused
):
    parts = tuple(SimpleNamespace(power=power) for power in (described, left))
    result, drives = SimpleNamespace(unexplained=(parts,), left=left), [SimpleNamespace(name="one")]
    outcome = (
        pytest.raises(CalibrationError, match=r"one: .* 60 times") if refused else nullcontext()
    )
    with outcome:
        identification._refuse_unexplained(result, drives)


def test_each_step_over_an_unmeasured_road_has_derivatives_of_its_own(monkeypatch):
    objective, at = short_objective(), []
    steps = GaussNewton(4.0)
    few = ParameterSpace(DEFENDER, SPACE.names[:3], SPACE.std[:3])

    def logged(space, x):
        at.append(x.copy())
        return perturbed_cars(space, x)

    monkeypatch.setattr(car_fit, "perturbed_cars", logged)
    fit = car_fit.fit_car([minimize(objective, steps)], few, steps, max_steps=4)
    assert len(at) >= 3
    assert all((one != other).any() for one, other in pairwise([*at, fit.x]))


def test_drives_of_two_vehicles_contradict_each_other_about_one():
    """One wants a tenth more of a parameter, the other a tenth less, each sure to a hundredth."""

    def wish(change):
        information = 1e4 * np.eye(2)
        gradient = information @ np.array([change, 0.0])
        unmoved = np.zeros(2), np.zeros(1), np.zeros((2, 1))
        return LikelihoodTerms(gradient, information, information, *unmoved)

    def contradiction(*changes):
        return car_fit._contradiction([wish(change) for change in changes], np.zeros(2))

    assert contradiction(0.1, -0.1) == pytest.approx(0.5 * 10.0**2)
    assert contradiction(0.01, -0.01) == pytest.approx(0.5)
    assert contradiction(0.1) == 0.0


@pytest.mark.costly
def test_a_fit_that_was_not_believed_is_not_made_again_for_the_same_drive(monkeypatch):
    drive, _ = calibration_drive("S1", 1, 40.0)
    made = []

    def counted(*args, **settings):
        made.append(car_fit.adapt_car(*args, **settings))
        return made[-1]

    monkeypatch.setattr(solver, "fit_if_due", counted)
    monkeypatch.setattr(solver, "adapt_car", counted)
    monkeypatch.setattr(solver, "is_believed", lambda fit, own: False)
    found = MapSmoother().estimate(drive.record, DEFENDER)
    assert any("the vehicle was adapted" in note for note in found.notes)
    assert len(made) == 1


@pytest.mark.costly
def test_a_long_drive_of_a_described_vehicle_is_not_taken_for_one_of_another(monkeypatch):
    # of 400 m, the errors of its tolerances explain 130 of the residual, and of each 100 m 32
    monkeypatch.setattr(solver, "adapt_car", lambda *_: pytest.fail("a vehicle was fitted"))
    record, truth = simulate_record(
        "iso_b", vehicle=DEFENDER, speed_kmh=54.0, mode=MIXED, seed=11, length=400.0
    )
    found = MapSmoother(draws=2).estimate(record, DEFENDER)
    band = scored_band(15.0)
    assert nrmse(truth.z, found.z, truth.ds, band).pooled < 0.15


@pytest.mark.parametrize(
    ("before", "after", "is_kept"), [(0.37, 1.9, False), (0.37, 0.9, True), (2.0, 1.9, True)]
)
def test_a_fit_that_explains_less_than_the_described_vehicle_is_refused(
    before, after, is_kept, monkeypatch
):
    monkeypatch.setattr(solver, "misfit_power", lambda power: np.array([power]))
    described, fitted = (SimpleNamespace(linearization=power) for power in (before, after))
    assert solver._explains_more(fitted, described) is is_kept


@pytest.mark.costly
def test_a_fit_that_leaves_much_does_no_harm_where_sensors_are_on_brackets():
    drive, truth = calibration_drive("S0", 3, 40.0)
    w, damping = 2.0 * np.pi * 60.0, 0.03
    resonance = [2.0 * damping * w, w**2], [1.0, 2.0 * damping * w, w**2]
    shaken = lfilter(*bilinear(*resonance, drive.record.fs), drive.record.a)
    unfitted, fitted = (
        MapSmoother(adapt=adapt).estimate(replace(drive.record, a=shaken), DEFENDER)
        for adapt in (False, True)
    )
    band = scored_band(15.0)
    errors = [nrmse(truth.z, one.z, truth.ds, band).pooled for one in (unfitted, fitted)]
    assert errors[1] < 1.1 * errors[0]
    assert "does not reproduce" in fitted.notes[0]
