"""Tests of the tangent: dual numbers, differences, the linear vehicle."""

import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.linalg import expm
from vehicle_fixtures import (
    CARS,
    MANOEUVRE_PLANTS,
    PLANTS,
    VARIED_MANOEUVRE_PLANTS,
    ZEROS,
    run_integrator,
    smooth_road,
    vectors,
)

from road_envs.simulation.rosenbrock import ACCELERATION, LOAD
from road_envs.simulation.tape import linearize_drive
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.force_curves import interpolate_table, second_derivative
from road_envs.vehicle.linear_model import jacobian
from road_envs.vehicle.suspension import encode_command, settled_strut_state

MODES = ("ride", "handling")
REACH = np.repeat([0.05, 0.5], 7)
"""Magnitudes of coordinates and rates on a rough road; UNEVEN: of road heights and rates."""
UNEVEN = np.array([0.02, 0.5])[:, None]
TEST_PLANTS = {**MANOEUVRE_PLANTS, "varied": VARIED_MANOEUVRE_PLANTS["varied"]}
every_car = pytest.mark.parametrize("name", CARS)
every_plant = pytest.mark.parametrize("name", TEST_PLANTS)
every_mode = pytest.mark.parametrize("mode", MODES)
states = vectors(14, *REACH)
roads = vectors(16, *np.repeat([0.02, 0.5], 4)).map(lambda x: x.reshape(2, 2, 4))
directions = vectors(14, 1.0), vectors(16, 1.0), vectors(7, 1.0), vectors(14, 1.0)


def random_cases(size):
    """Return random steps: every fourth one large, every third one with an airborne wheel."""
    rng, cases = np.random.default_rng(11), []
    for i in range(size):
        strut_state = settled_strut_state(encode_command(MODES[i % 2]))
        if i % 5 == 4:
            strut_state = np.column_stack(
                [rng.uniform(-0.02, 0.02, 4), *rng.uniform(0.0, 1.0, (2, 4))]
            )
        size = 2.0 if i % 4 == 0 else 0.1
        road = size * UNEVEN * rng.standard_normal((2, 2, 4))
        road[:, 0, i // 3 % 4] -= 0.1 * (i % 3 == 0)
        y, dy = size * REACH * rng.standard_normal(14), REACH * rng.standard_normal(14)
        droad, a_xy = UNEVEN * rng.standard_normal((2, 2, 4)), rng.standard_normal((2, 2))
        cases.append((strut_state, y, road, (0.001, 0.005)[i % 2], a_xy, dy, droad))
    return cases


@cache
def tapes():
    """Return the random steps and their tapes."""
    cases = random_cases(120)
    return cases, [linearize_drive(TEST_PLANTS["varied"], *case[:5]) for case in cases]


def test_the_tangent_equals_the_derivative_by_dual_numbers(tmp_path):
    """To rounding: soft, stiff and intermediate struts, and airborne wheels."""
    plant, (cases, case_tapes) = TEST_PLANTS["varied"], tapes()
    given = {"n_cases": len(cases)}
    for i, (strut_state, y, road, h, a_xy, dy, droad) in enumerate(cases):
        values = {
            "constants": np.frombuffer(plant.constants.tobytes(), dtype=np.uint8),
            "velocity": plant.velocity, "displacement": plant.displacement,
            "strut_state": strut_state,
            "y": y, "road": road.ravel(), "a_xy": a_xy.ravel(), "h": h,
            "dy": dy, "droad": droad.ravel(),
        }  # fmt: skip
        given |= {f"{i}/{name}": value for name, value in values.items()}
    np.savez(tmp_path / "cases.npz", **given)
    here = Path(__file__).parents[1] / "support"
    uncompiled = {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(here.parents[1])}
    command = [sys.executable, here / "dual_numbers.py", "cases.npz", "found.npz"]
    subprocess.run(command, env={**os.environ, **uncompiled}, cwd=tmp_path, check=True, timeout=120)
    exact = np.load(tmp_path / "found.npz")
    loads = np.array([tape.signals[0, LOAD:] for tape in case_tapes])
    assert 40 <= (loads == 0.0).any(axis=1).sum() <= 80
    for i, tape in enumerate(case_tapes):
        a, end = tape.tangent(*cases[i][5:])
        expected = exact["signals"][i, ACCELERATION : ACCELERATION + 7]
        np.testing.assert_allclose(a[0], expected, atol=1e-11 * np.abs(expected).max())
        for half in (slice(7), slice(7, None)):
            expected = exact["end"][i, half]
            np.testing.assert_allclose(end[half], expected, atol=1e-11 * np.abs(expected).max())


def test_the_tangent_equals_the_finite_difference_of_the_step():
    for (strut_state, y, road, h, a_xy, dy, droad), tape in zip(*tapes(), strict=True):
        eps, ends, starts = 1e-6, [], []
        for sign in (1.0, -1.0):
            there = y + sign * eps * dy, road + sign * eps * droad
            moved = linearize_drive(TEST_PLANTS["varied"], strut_state, *there, h, a_xy)
            ends.append(moved.end)
            starts.append(moved.acceleration[0])
        a, end = tape.tangent(dy, droad)
        slope = (ends[0] - ends[1]) / (2.0 * eps), (starts[0] - starts[1]) / (2.0 * eps)
        np.testing.assert_allclose(end, slope[0], atol=1e-6 * np.abs(end).max())
        np.testing.assert_allclose(a[0], slope[1], atol=1e-6 * np.abs(a).max())


@given(st.integers(0, 1), st.floats(-0.5, 4.5))
def test_the_second_derivative_of_a_table_is_the_slope_of_its_slope(k, x):
    """Also at the ends of a table, beyond which the curve is continued linearly."""
    assume(abs(2.0 * x - round(2.0 * x)) > 1e-4)
    tables = np.random.default_rng(3).standard_normal((2, 10, 4))
    tables[:, [0, -1], 2:] = 0.0
    slopes = [interpolate_table(tables, float(k), 0.0, 0.5, x + eps)[1] for eps in (1e-5, -1e-5)]
    result = second_derivative(tables, float(k), 0.0, 0.5, x)
    assert result == pytest.approx((slopes[0] - slopes[1]) / 2e-5, rel=1e-6, abs=1e-6)
    assert (result == 0.0) == (not 0.0 < x < 4.0)


# --- whole drives ---------------------------------------------------------------------------------

H, SPEED, S_0, STEPS = 0.001, 12.0, 4.0, 600
ROUGH = smooth_road(height=0.03)


def under_wheels(name, surface):
    """Return heights and rates (2 STEPS, 2, 4) under the wheels at every half step."""
    s = S_0 + SPEED * 0.5 * H * np.arange(2 * STEPS)
    stations = np.stack([s, s - CARS[name].wheelbase])
    z, slope = surface.height(stations), SPEED * surface.slope(stations)
    return np.stack([np.transpose(x, (2, 1, 0)).reshape(-1, 4) for x in (z, slope)], axis=1)


@cache
def linearized_drive(name, mode):
    """Return start, road and tape of a drive with wheel lift-off."""
    strut_state = settled_strut_state(encode_command(mode))
    start, road = equilibrium(PLANTS[name], strut_state, ZEROS), under_wheels(name, ROUGH)
    return start, road, linearize_drive(PLANTS[name], strut_state, start, road, H)


@every_car
@every_mode
def test_a_linearized_drive_has_the_signals_of_the_plain_drive(name, mode):
    start, _, tape = linearized_drive(name, mode)
    y = start.copy()
    out = run_integrator(
        PLANTS[name], y, h=H, steps=STEPS, surface=ROUGH, speed=SPEED, s_0=S_0, mode=mode
    )
    assert (out[:, LOAD:] == 0.0).any()
    np.testing.assert_allclose(tape.signals, out, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(tape.end, y, rtol=1e-9, atol=1e-9)


@every_car
@every_mode
def test_near_rest_the_tangent_converges_to_the_linear_motion_with_order_two(name, mode):
    """Reference: the matrix exponential of the Jacobian of the equations."""
    strut_state, change = settled_strut_state(encode_command(mode)), np.linspace(-1.0, 1.0, 14)
    start, seconds = equilibrium(PLANTS[name], strut_state, ZEROS), 0.1
    truth = expm(seconds * jacobian(PLANTS[name], strut_state, start, ZEROS, ZEROS)) @ change
    error, h = [], 0.001 / 2.0 ** np.arange(4)
    for step in h:
        road = np.zeros((2 * round(seconds / step), 2, 4))
        tape = linearize_drive(PLANTS[name], strut_state, start, road, step)
        error.append(np.linalg.norm(tape.tangent(change, road)[1] - truth))
    assert error[0] < 0.02 * np.linalg.norm(truth)
    assert np.polyfit(np.log(h), np.log(error), 1)[0] == pytest.approx(2.0, abs=0.1)


def test_applying_a_tape_twice_gives_equal_results_and_keeps_the_arguments():
    _, road, tape = linearized_drive("unequal_axles", "ride")
    start = np.ones(14)
    first, second = (tape.tangent(start, road) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (start == 1.0).all()


def test_an_array_of_the_wrong_shape_is_rejected_by_name():
    plant, strut_state, start = PLANTS["unequal_axles"], np.zeros((4, 3)), np.zeros(14)
    _, road, tape = linearized_drive("unequal_axles", "ride")
    wrong = [
        ("road", lambda: linearize_drive(plant, strut_state, start, np.zeros((5, 2, 4)), H)),
        ("start", lambda: linearize_drive(plant, strut_state, start[:7], road, H)),
        ("a_xy", lambda: linearize_drive(plant, strut_state, start, road, H, road[:, 0, :2].T)),
        ("strut_state", lambda: linearize_drive(plant, strut_state[:3], start, road, H)),
        ("road", lambda: tape.tangent(start, road[:-2])),
        ("start", lambda: tape.tangent(start[:7], road)),
    ]
    for name, call in wrong:
        with pytest.raises(ValueError, match=f"{name} must be of shape"):
            call()


def test_a_diverged_motion_raises_instead_of_returning_a_derivative():
    road = np.zeros((4, 2, 4))
    road[2, 0, 1] = np.inf
    with pytest.raises(ArithmeticError, match="no longer finite"):
        linearize_drive(PLANTS["unequal_axles"], np.zeros((4, 3)), np.zeros(14), road, H)
