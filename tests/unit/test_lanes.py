"""Variants of one vehicle side by side over the same road."""

import numba
import numpy as np
import pytest
from vehicle_fixtures import (
    DEFENDER,
    VARIED,
    VARIED_FLEXIBLE,
    VARIED_PLANTS,
    smooth_road,
    varied_plant,
)

from road_envs.kernels.simd import LANES
from road_envs.kernels.simd_arrays import stack_array, stack_rows
from road_envs.simulation.drive import DriveSimulator
from road_envs.simulation.lanes import SharedInputs, drive_variants
from road_envs.simulation.rosenbrock import ACCELERATION, TWIST
from road_envs.simulation.tape import linearize_drive
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.suspension import encode_command, settled_strut_state

STRUT_STATE, STEPS, H = settled_strut_state(encode_command("ride")), 300, 1e-3
PLANTS = [build_plant(DEFENDER), varied_plant(DEFENDER, VARIED), VARIED_PLANTS["varied"]]


@numba.njit
def fill_on_the_stack(numbers, rows):
    one, many = stack_array(3), stack_rows(2)
    for i in range(3):
        one[i] = 1.0 + i
    many[:] = 7.0
    many[1, 2], one[1] = 9.0, one[1] + many[0, 7]
    numbers[:], rows[:] = one[1:], many
    return one.ctypes.data % 64 + many.ctypes.data % 64


@pytest.mark.costly
def test_arrays_on_the_stack_are_apart_and_begin_on_cache_lines():
    numbers, rows = np.zeros(2), np.zeros((2, LANES))
    assert fill_on_the_stack(numbers, rows) == 0
    np.testing.assert_array_equal(numbers, [9.0, 3.0])
    expected = np.full((2, LANES), 7.0)
    expected[1, 2] = 9.0
    np.testing.assert_array_equal(rows, expected)


def random_inputs() -> SharedInputs:
    rng = np.random.default_rng(3)
    road = np.cumsum(rng.normal(scale=[[1e-3], [2e-2]], size=(2 * STEPS, 2, 4)), axis=0)
    commands = np.zeros(STEPS, dtype=np.uint8)
    commands[100:200] = encode_command("handling")
    commands[200:] = encode_command({"front": "handling", "rear": "ride"})
    return SharedInputs(road, commands, STRUT_STATE, 0.01, H, np.zeros(len(commands)))


def test_variants_drive_as_each_of_them_alone():
    inputs, plants = random_inputs(), [PLANTS[i % 3] for i in range(11)]
    starts = [equilibrium(p, STRUT_STATE, np.zeros(4)) + 1e-5 * i for i, p in enumerate(plants)]
    found = drive_variants(plants, starts, inputs)
    assert len(found) == 11
    for plant, start, a in zip(plants, starts, found, strict=True):
        alone = linearize_drive(
            plant, STRUT_STATE, start, inputs.road, H, commands=inputs.commands, lag=inputs.lag
        )
        np.testing.assert_allclose(a, alone.acceleration, rtol=1e-9, atol=1e-9)


def test_flexible_variants_drive_as_the_simulator_does():
    surface, speed = smooth_road(height=0.02), 12.0
    plant = varied_plant(DEFENDER, VARIED_FLEXIBLE)
    drive = DriveSimulator(plant, DEFENDER, surface, speed, "ride", H)
    start = drive.state.copy()
    s, v, _ = drive.half_step_inputs(2000)
    stations = s[:-1, None] - np.array([0.0, 0.0, DEFENDER.wheelbase, DEFENDER.wheelbase])
    z = np.stack([surface.height(stations[:, w])[w % 2] for w in range(4)], axis=1)
    ahead = surface.height((stations + 1e-6).T.ravel()).reshape(2, 4, -1)
    behind = surface.height((stations - 1e-6).T.ravel()).reshape(2, 4, -1)
    slope = np.stack([(ahead - behind)[w % 2, w] / 2e-6 for w in range(4)], axis=1)
    road = np.stack([z, slope * v[:-1, None]], axis=1)
    commands = np.zeros(2000, dtype=np.uint8)
    shared = SharedInputs(road, commands, STRUT_STATE, 0.01, H, np.zeros(len(commands)))
    (a,) = drive_variants([plant], [start], shared)
    signals = drive.advance(commands).signals
    expected = signals[:, [*range(ACCELERATION, ACCELERATION + 7), TWIST + 2]]
    assert a.shape == (2000, 8) and np.ptp(expected[:, 7]) > 1.0
    np.testing.assert_allclose(a, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("count", [1, 8, 9])
def test_any_number_of_variants_is_taken(count):
    inputs = random_inputs()
    start = equilibrium(PLANTS[0], STRUT_STATE, np.zeros(4)) + 1e-6
    assert len(drive_variants([PLANTS[0]] * count, [start] * count, inputs)) == count
