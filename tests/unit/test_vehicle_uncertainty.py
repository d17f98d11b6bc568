"""Intervals of roads under a vehicle and instruments that were identified, and are not known."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from test_map_smoother import MIXED, drive_record, objective_of, perturb, residual_at
from vehicle_fixtures import DEFENDER

from estimators.api import copy_with
from estimators.map_smoother.car_fit import CarFit
from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.gauss_newton import MapSolution
from estimators.map_smoother.identification_result import (
    IdentificationResult,
    posterior_of,
)
from estimators.map_smoother.identified_vehicle import IdentifiedVehicle
from estimators.map_smoother.preconditioner import stationary_hessian
from estimators.map_smoother.vehicle_uncertainty import VehicleUncertainty
from leaderboard.metrics.heights import band_pass, uncertainty
from road_envs.core.config import build
from road_envs.drives.recording import simulate_record
from road_envs.records.record import PROFILE_SPACING, scored_band
from road_envs.vehicle.parameters import BendingMode, Tolerance
from road_envs.vehicle.tolerances import parameter_space

INSTRUMENTS = 11
"""Gain and place of three sensors, odometer and speed."""


def linearized():
    record, _ = drive_record(length=12.0)
    objective = objective_of(record)
    return objective.linearize(perturb(np.zeros(objective.size), 0.3))


def test_a_change_is_that_of_the_predicted_accelerations():
    lin, b = linearized(), np.zeros((1 + INSTRUMENTS, 1 + INSTRUMENTS))
    (one,) = lin.passes
    _, bias = one.source.split(one.own)
    predicted = one.source.measurements.y - one.residual - bias[:, None]
    gain = b.copy()
    gain[1, 1] = 1.0  # of the first sensor
    drawn = np.random.default_rng(1).standard_normal(len(gain))
    (change,) = VehicleUncertainty(DEFENDER, ("m_b",), gain).draw_changes(one, drawn[None])
    np.testing.assert_allclose(np.abs(change[0]), 0.02 * abs(drawn[-1]) * np.abs(predicted[0]),
                               rtol=0.01, atol=1e-9)  # fmt: skip
    assert np.abs(change[1:]).max() < 1e-9
    mass = b.copy()
    mass[0, 0] = 0.05**2
    (change,) = VehicleUncertainty(DEFENDER, ("m_b",), mass).draw_changes(one, drawn[None])
    step = 0.001 * DEFENDER.m_b
    cars = [replace(DEFENDER, m_b=DEFENDER.m_b + d) for d in (step, -step)]
    heavy, light = (
        residual_at(replace(lin.objective, passes=(one.source.with_car(car),)), lin.x)
        for car in cars
    )
    expected = 0.05 * abs(drawn[-1]) * (light - heavy) / 0.002
    error = np.abs(np.abs(change) - np.abs(expected))
    assert error.max() < 0.05 * np.abs(expected).max()


def test_errors_that_no_vehicle_has_are_an_arithmetic_error():
    (one,) = linearized().passes
    mode = BendingMode(f=25.0, zeta=0.999, length=4.4)
    car = replace(DEFENDER, variation=replace(DEFENDER.variation, bending=mode))
    wide = VehicleUncertainty(car, ("variation.bending.zeta",), 4.0 * np.eye(1 + INSTRUMENTS))
    white = np.ones((2, 1 + INSTRUMENTS)) * [[1.0], [-1.0]]
    with pytest.raises(ArithmeticError, match="a fitted vehicle is none: zeta: must be below 1"):
        wide.draw_changes(one, white)


def test_of_a_fit_the_covariance_is_that_of_the_fit_in_units_of_the_tolerances():
    """Of instruments that were not fitted it is that of their prior."""
    car = replace(
        DEFENDER,
        tolerances={
            name: Tolerance(relative=0.1, source="test") for name in ("m_b", "I_xx", "I_yy")
        },
    )
    lin = linearized()
    solution = MapSolution(lin, stationary_hessian(lin.objective), np.ones(1))
    covariance = np.array([[0.01, 0.004, 0.0], [0.004, 0.0025, 0.0], [0.0, 0.0, 0.49]])
    x = np.array([0.5, 0.0, 0.0])
    fit = CarFit(parameter_space(car), x, covariance, (solution,), 0.0)
    found = VehicleUncertainty.of_fit(fit)
    assert found.car.m_b == DEFENDER.m_b * np.exp(0.05) and found.names == ("m_b", "I_xx", "I_yy")
    np.testing.assert_allclose(found.covariance[:3, :3], 0.01 * covariance)
    std = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(std[3:], [0.012 / 0.02] * 3 + [1.0] * 6 + [0.0, 0.0])


def test_what_is_not_known_of_a_vehicle_is_remembered_with_it():
    """As `_identify_once` writes and reads it."""
    tolerances = {name: Tolerance(relative=0.1, source="test") for name in ("m_b", "I_xx")}
    car = replace(DEFENDER, tolerances=tolerances)
    found = IdentifiedVehicle(car=car, covariance=((0.01, 0.002), (0.002, 0.04)))
    again = build(IdentifiedVehicle, json.loads(json.dumps(asdict(found))), "cache")
    assert again == found and found.uncertainty.names == ("m_b", "I_xx")
    np.testing.assert_array_equal(again.uncertainty.covariance, [[0.01, 0.002], [0.002, 0.04]])
    assert IdentifiedVehicle(car=car).uncertainty is None


@pytest.mark.costly
def test_intervals_of_a_wrong_vehicle_cover_the_error_if_they_know_of_it():
    record, truth = drive_record(length=40.0)
    names = ("m_b", "front.m", "rear.m", "I_yy", "variation.damper.FL", "variation.tyre.RR")
    tolerances = {name: Tolerance(relative=0.1, source="test") for name in names}
    space = parameter_space(replace(DEFENDER, tolerances=tolerances))
    wrong = space.from_vector(np.array([0.6, -0.9, 1.2, -0.7, 1.3, -0.8]))
    covariance = np.zeros((len(names) + INSTRUMENTS,) * 2)
    covariance[: len(names), : len(names)] = 0.01 * np.eye(len(names))
    shares = []
    for known in ((), tuple(map(tuple, covariance.tolist()))):
        identified = IdentifiedVehicle(car=wrong, covariance=known)
        smoother = copy_with(MapSmoother(adapt=False), identified=identified)
        found = smoother.estimate(record, DEFENDER)
        y, a = band_pass(np.stack([truth.z, found.z]), PROFILE_SPACING, scored_band(15.0))
        scores = uncertainty(y, a, found.z_std)
        shares.append((scores.coverage_50, scores.coverage_90))
    assert shares[0][0] < 0.4 and shares[0][1] < 0.75
    assert 0.4 < shares[1][0] < 0.75 and 0.8 < shares[1][1] < 0.99


@pytest.mark.parametrize(("grade", "widened"), [("S0", False), ("S1", True)])
@pytest.mark.costly
def test_the_tolerances_of_a_described_vehicle_count_where_its_error_shows(grade, widened):
    record, truth = simulate_record(
        "iso_b", speed_kmh=36.0, mode=MIXED, seed=211, grade=grade, length=60.0
    )
    told, known = (MapSmoother(adapt=adapt).estimate(record, DEFENDER) for adapt in (True, False))
    assert (np.median(told.z_std) > 3.0 * np.median(known.z_std)) == widened
    assert any("times those of a vehicle that is known" in note for note in told.notes) == widened
    y, a = (band_pass(z, PROFILE_SPACING, scored_band(10.0)) for z in (truth.z, told.z))
    assert uncertainty(y, a, told.z_std).coverage_90 > 0.8


def test_what_an_identification_left_open_is_not_narrowed_by_the_next_drive():
    """Drives do not show it: what stays unexplained of one says nothing about it."""
    told = replace(DEFENDER, tolerances={"m_b": Tolerance(relative=0.1, source="weighed")})
    found = replace(DEFENDER, tolerances={"m_b": Tolerance(relative=0.1, source="identified")})
    sensors = ("RF", "LR", "RR")
    assert VehicleUncertainty.of_tolerances(told, sensors).is_prior
    assert not VehicleUncertainty.of_tolerances(found, sensors).is_prior


@pytest.mark.parametrize(("contradiction", "far", "another"), [(3.0, 4.0, True), (1.4, 4.0, False),
                                                               (3.0, 2.0, False)])  # fmt: skip
def test_a_vehicle_of_another_kind_keeps_its_tolerances_and_is_noted(contradiction, far, another):
    tolerances = {name: Tolerance(relative=0.1, source="weighed") for name in ("m_b", "I_yy")}
    car = replace(DEFENDER, tolerances=tolerances)
    lin = linearized()
    solution = MapSolution(lin, stationary_hessian(lin.objective), np.ones(1))
    covariance = np.diag([0.04, 0.01])
    fit = CarFit(parameter_space(car), np.array([far, 0.0]), covariance, (solution,), contradiction)
    found, uncertainty = posterior_of(fit, car)
    std = [0.1, 0.1] if another else [0.02, 0.01]
    assert [one.relative for one in found.tolerances.values()] == pytest.approx(std)
    np.testing.assert_allclose(np.sqrt(np.diag(uncertainty.covariance))[:2], std)
    notes = IdentificationResult(fit, found, uncertainty, ()).notes
    assert any("of another kind" in note for note in notes) is another
