"""Inverse quarter car: against the forward one in state space, and on a vehicle of which it is the
exact inverse, as far as three accelerometers allow.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_wiener import CARS, SPLIT, linear_car

from estimators import create
from estimators.linear.inverse_quarter_car import (
    PATHS,
    _accelerations_at_struts,
    _quarter_cars,
    _QuarterCars,
    _weigh_by_road,
)
from leaderboard.metrics.heights import band_pass, nrmse
from road_envs.core.config import ConfigError
from road_envs.drives.recording import simulate_record
from road_envs.records.record import PROFILE_SPACING, scored_band
from road_envs.roads import load_road, with_length
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.equations import build_plant

IDEAL = load_instruments("ideal")
CORNERS = _QuarterCars(
    *(np.array(x) for x in (
        [430.0, 430.0, 500.0, 300.0], [115.0, 90.0, 115.0, 60.0], [16e3, 84e3, 20e3, 30e3],
        [2e3, 5e3, 0.0, 1e3], [250e3, 200e3, 300e3, 150e3], [1200.0, 0.0, 400.0, 800.0],
    ))
)  # fmt: skip


@cache
def uncoupled_car():
    """A linear vehicle with uncoupled corners: point masses over the struts and at the wheels."""
    car = linear_car()
    y, x = car.front.y_t, 0.5 * car.wheelbase
    axle = replace(car.front, y_s=y, I_xx=car.front.m * y**2, x=x)
    return replace(
        car, front=axle, rear=replace(axle, x=-x), I_xx=car.m_b * y**2, I_yy=car.m_b * x**2
    )


@cache
def drive(mode="ride", speed_kmh=54.0, mirrored=False):
    """The uncoupled vehicle on a very smooth road, optionally with equal wheel paths."""
    surface = with_length(load_road("iso_b"), 150.0).realise(np.random.default_rng(3))
    surface = replace(surface, z=0.1 * surface.z)  # the gas spring is linear for small motions
    if mirrored:
        surface = replace(surface, z=surface.z[[0, 0]])
    return simulate_record(
        surface,
        vehicle=uncoupled_car(),
        speed_kmh=speed_kmh,
        mode=mode,
        instruments=IDEAL,
        seed=3,
        step=0.00025,
    )


def estimate(record, **settings):
    """The plain inverse, without weights."""
    return create("inverse_quarter_car", instruments="ideal", weigh=False, **settings).estimate(
        record, uncoupled_car()
    )


@pytest.mark.parametrize("k", range(4))
def test_it_is_the_inverse_of_the_quarter_car_in_state_space(k):
    """State: heights of body and wheel, their rates; inputs: road height and rate."""
    m_s, m_u, k_s, c_s, k_t, c_t = (x[k] for x in CORNERS)
    body = np.array([-k_s, k_s, -c_s, c_s]) / m_s
    wheel = np.array([k_s, -k_s - k_t, c_s, -c_s - c_t]) / m_u
    A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], body, wheel])
    B = np.array([[0, 0], [0, 0], [0, 0], np.array([k_t, c_t]) / m_u])
    f = np.geomspace(0.1, 25.0, 60)
    p = 2j * np.pi * f
    road = B[:, 0] + p[:, None] * B[:, 1]
    H = np.linalg.solve(p[:, None, None] * np.eye(4) - A, road[:, :, None])[:, :, 0] @ body
    np.testing.assert_allclose(CORNERS.inverse(f)[k] * H, 1.0, rtol=1e-9)


def test_accelerations_at_the_struts_are_those_of_the_rigid_body():
    car, rng = CARS["defender"], np.random.default_rng(0)
    heave, roll, pitch = rng.standard_normal((3, 5))
    locations = IDEAL.locations(car)
    a = np.array([heave - x * pitch + y * roll for x, y, _ in locations.values()])
    corners = [(a.x, side * a.y_s) for a in car.axles for side in (1.0, -1.0)]
    expected = [heave - x * pitch + y * roll for x, y in corners]
    np.testing.assert_allclose(_accelerations_at_struts(a, locations, car), expected, atol=1e-12)


@pytest.mark.parametrize(("mode", "k_s"), [("ride", 16682.0), ("handling", 83574.0)])
def test_the_corners_of_the_defender_match_its_parameters(mode, k_s):
    car = CARS["defender"]
    found = _quarter_cars(
        build_plant(car), car, dict.fromkeys(("front", "rear"), mode), np.full(4, 0.1)
    )
    assert found.m_s.sum() == pytest.approx(car.m_b)
    assert found.m_s @ np.repeat([car.front.x, car.rear.x], 2) == pytest.approx(0.0, abs=1e-9)
    assert found.k_s == pytest.approx(np.full(4, k_s), rel=0.01)  # p_stat A / x_stat, and bushing


@pytest.mark.parametrize("speed_kmh", [14.5, 54.0])
@pytest.mark.parametrize("mode", ["ride", "handling", SPLIT], ids=str)
def test_for_equal_wheel_paths_uncoupled_corners_are_inverted_exactly(mode, speed_kmh):
    record, truth = drive.__wrapped__(mode, speed_kmh, mirrored=True)
    error = nrmse(truth.z, estimate(record).z, PROFILE_SPACING, scored_band(speed_kmh / 3.6)).pooled
    assert error < (0.01 if speed_kmh < 20.0 else 0.03)


def test_of_the_difference_a_comb_over_three_wheelbases_is_recovered():
    """cos²(pi n L) is the comb (q(s - L) + 2 q(s) + q(s + L)) / 4."""
    record, truth = drive()
    found, L = estimate(record), uncoupled_car().wheelbase
    mean, half = 0.5 * (truth.z[0] + truth.z[1]), 0.5 * (truth.z[0] - truth.z[1])
    comb = sum(
        share * np.interp(truth.s + shift, truth.s, half)
        for shift, share in ((-L, 0.25), (0.0, 0.5), (L, 0.25))
    )
    inside = (truth.s > 10.0) & (truth.s < truth.s[-1] - 10.0)
    expected = np.array([mean + comb, mean - comb])[:, inside]
    assert nrmse(expected, found.z[:, inside], PROFILE_SPACING, scored_band(15.0)).pooled < 0.04
    assert 0.35 < nrmse(truth.z, found.z, PROFILE_SPACING, scored_band(15.0)).pooled < 0.5


def test_weights_are_those_of_wieners_filter_for_a_road_and_what_exceeds_it():
    """A resonance of ten times the road's amplitude is left at a tenth of the road's."""
    f = np.linspace(0.05, 40.0, 4000)
    paths = np.array([1.0, 0.3, 2.0, 0.5])[:, None] / f * (1.0 + 0.0j)
    loud = (f > 7.0) & (f < 14.0)
    paths[1, loud] *= 10.0
    left = PATHS @ _weigh_by_road(np.linalg.solve(PATHS, paths), f, 0.6) * f
    np.testing.assert_allclose(left[[0, 2, 3]], np.array([1.0, 2.0, 0.5])[:, None] * np.ones(4000))
    middle = (f > 9.0) & (f < 11.0)
    np.testing.assert_allclose(left[1, middle], 0.3 / 10.0, rtol=1e-6)
    np.testing.assert_allclose(left[1, (f < 5.0) | (f > 18.0)], 0.3)
    nothing = np.zeros((4, f.size))
    assert not _weigh_by_road(nothing, f, 0.6).any()
    np.testing.assert_allclose(_weigh_by_road(paths, f, 24.9), paths)  # no band to judge by


def test_a_frame_that_twists_does_not_make_it_worse_than_a_flat_road():
    record, truth = simulate_record(
        "iso_d", speed_kmh=54.0, mode=SPLIT, seed=31, length=60.0, individual=31, grade="S2"
    )
    errors = [
        nrmse(truth.z, found.estimate(record, CARS["defender"]).z, truth.ds, scored_band(15.0))
        for found in (create("inverse_quarter_car", weigh=weigh) for weigh in (False, True))
    ]
    assert errors[0].pooled > 2.0 and errors[1].pooled < 0.95


def test_below_its_band_the_estimate_tends_to_zero():
    """Below f_low / v the estimate is under half, and smaller for a higher f_low."""
    record, truth = drive(mirrored=True)
    slow = (0.05, 0.1)
    levels = [
        band_pass(estimate(record, f_low=f).z, PROFILE_SPACING, slow).std() for f in (0.3, 2.5, 5.0)
    ]
    true = band_pass(truth.z, PROFILE_SPACING, slow).std()
    assert levels[0] == pytest.approx(true, rel=0.15)
    assert levels[1] < 0.5 * true and levels[2] < 0.2 * true
    assert any("waves from 0.02 to 1.7 cycles/m" in note for note in estimate(record).notes)


def test_a_mode_change_is_noted_and_invalid_settings_are_rejected():
    record, _ = drive()
    stiff = record.spring_stiff.copy()
    stiff[: record.t.size // 3] = True
    notes = estimate(replace(record, spring_stiff=stiff)).notes
    assert "treated as driven in the dominant strut states" in notes
    with pytest.raises(ConfigError, match="f_low: must be positive, got 0"):
        create("inverse_quarter_car", f_low=0.0)
