"""Tests that every lane of a fleet equals its vehicle simulated alone."""

import dataclasses

import numpy as np
import pytest
from speeds import speed_ramp
from vehicle_fixtures import varied_plant

from road_envs.core.config import ConfigError
from road_envs.kernels.simd import LANES
from road_envs.roads import load_road
from road_envs.simulation.drive import DriveSimulator
from road_envs.simulation.lanes import aligned_zeros
from road_envs.simulation.manoeuvres import Slalom
from road_envs.vehicle.parameters import NOMINAL, TorsionalFrame, VehicleVariation, load_vehicle
from studies.bench.fleet import Fleet, select_vehicle

CAR = load_vehicle("land_rover_defender_110")
DAMPER = CAR.strut.damper
HEAVY = dataclasses.replace(
    CAR,
    m_b=2100.0,
    front=dataclasses.replace(CAR.front, y_s=0.5, k_t=300e3),
    strut=dataclasses.replace(
        CAR.strut,
        n_p=1.25,
        p_stat=2.6e6,
        damper=dataclasses.replace(DAMPER, ride=DAMPER.handling),
    ),
    valve=dataclasses.replace(CAR.valve, delay=0.033, lag=0.004),
)
ROADS = ("iso_d", "belgian_like", "bump_asymmetric", "iso_f")


VARIED = VehicleVariation(
    gas=(1.03, 0.96, 0.99, 1.02),
    damper=(1.1, 0.85, 1.2, 0.9),
    bushing=(1.2, 0.9, 1.0, 1.0),
    tyre=(1.06, 0.95, 0.9, 1.08),
    tyre_progression=4.0,
    roll_stiffness=(5000.0, 2000.0),
)


def make_simulators(size, frame=None):
    """Return simulators that differ from each other, equal ones at every call.

    With a `frame`, all vehicles have it.
    """
    simulators = []
    for k in range(size):
        car = HEAVY if k % 3 == 1 else CAR
        surface = load_road(ROADS[k % len(ROADS)]).realise(np.random.default_rng(k))
        speed = speed_ramp(3.0, 12.0, 0.7) if k % 5 == 2 else 4.0 + k
        manoeuvre = Slalom(begin=0.1, period=0.5) if k % 4 == 3 else None
        mode = ("ride", "handling", {"front": "ride", "rear": "handling"})[k % 3]
        variation = dataclasses.replace(VARIED if k % 4 == 1 else NOMINAL, frame=frame)
        plant = varied_plant(car, variation, manoeuvre is not None)
        simulators.append(DriveSimulator(plant, car, surface, speed, mode, manoeuvre=manoeuvre))
    return simulators


def random_commands(size, n, seed=5):
    """Return random commands (size, n), each constant for 90 steps."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.integers(0, 256, (size, -(-n // 90)), dtype=np.uint8), 90, axis=1)[:, :n]


@pytest.mark.parametrize(
    "frame", [None, TorsionalFrame(f=11.0, zeta=0.05)], ids=["stiff", "flexible"]
)
def test_every_lane_matches_its_vehicle_simulated_alone(frame):
    size, n = LANES + 3, 1500
    commands = random_commands(size, n)
    fleet = Fleet(make_simulators(size, frame))
    signals = fleet.advance(commands)
    for k, simulator in enumerate(make_simulators(size, frame)):
        alone = simulator.advance(commands[k]).signals
        scale = np.abs(alone).max(axis=0)
        assert select_vehicle(signals, k).shape == (n, 29 if frame is None else 32)
        assert (
            np.abs(select_vehicle(signals, k) - alone).max(axis=0) <= 1e-9 * scale + 1e-12
        ).all(), k
        written_back = fleet.write_back()[k].state
        np.testing.assert_allclose(written_back, simulator.state, rtol=1e-6, atol=1e-9)


def test_a_lane_is_bitwise_independent_of_the_other_lanes_and_of_threads():
    size, n = 2 * LANES + 1, 400
    commands = random_commands(size, n)
    one_thread = Fleet(make_simulators(size)).advance(commands)
    two_threads = Fleet(make_simulators(size), threads=2).advance(commands)
    np.testing.assert_array_equal(one_thread, two_threads)
    for k in (0, 5, LANES + 2, size - 1):
        single = Fleet([make_simulators(size)[k]]).advance(commands[k : k + 1])
        np.testing.assert_array_equal(select_vehicle(single, 0), select_vehicle(one_thread, k))


def test_a_fleet_in_chunks_equals_the_whole_drive_bitwise():
    size, n = 5, 600
    commands = random_commands(size, n)
    whole = Fleet(make_simulators(size)).advance(commands)
    fleet, begin = Fleet(make_simulators(size)), 0
    for part in (1, 50, 249, 300):
        buffer = fleet.allocate_signals(part)
        signals = fleet.advance(commands[:, begin : begin + part], buffer)
        assert signals is buffer
        for k in range(size):
            np.testing.assert_array_equal(
                select_vehicle(signals, k), select_vehicle(whole, k)[begin : begin + part]
            )
        begin += part


def test_a_simulator_continues_alone_after_write_back():
    size, n = 4, 300
    commands = random_commands(size, 2 * n)
    fleet = Fleet(make_simulators(size))
    fleet.advance(commands[:, :n])
    written_back = fleet.write_back()
    for k, simulator in enumerate(make_simulators(size)):
        simulator.advance(commands[k, :n])
        np.testing.assert_allclose(written_back[k].state, simulator.state, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(
            written_back[k].strut_state, simulator.strut_state, rtol=1e-9, atol=1e-15
        )
        alone, on = (
            simulator.advance(commands[k, n:]).signals,
            written_back[k].advance(commands[k, n:]).signals,
        )
        np.testing.assert_allclose(on, alone, rtol=1e-6, atol=1e-6)


def test_a_diverged_vehicle_does_not_affect_the_other_lanes():
    size, n = 3, 200
    commands = random_commands(size, n)
    reference = Fleet(make_simulators(size)).advance(commands)
    diverging = make_simulators(size)
    diverging[1].state[0] = np.nan
    signals = Fleet(diverging).advance(commands)
    assert np.isnan(select_vehicle(signals, 1)[-1]).any()
    for k in (0, 2):
        np.testing.assert_array_equal(select_vehicle(signals, k), select_vehicle(reference, k))


def test_aligned_rows_begin_at_cache_line_boundaries():
    for shape in ((7,), (4, 3), (1,), (50, 29)):
        array = aligned_zeros(*shape)
        assert array.shape == (*shape, LANES) and array.ctypes.data % (8 * LANES) == 0


def test_an_empty_or_mixed_fleet_is_rejected():
    with pytest.raises(ConfigError, match="at least one drive"):
        Fleet([])
    slow = make_simulators(1)[0]
    fast = DriveSimulator(slow.plant, CAR, slow.surface, 5.0, step=0.0005)
    with pytest.raises(ConfigError, match="one integrator step"):
        Fleet([slow, fast])
    flexible = DriveSimulator(
        varied_plant(CAR, VehicleVariation(frame=TorsionalFrame(f=9.0, zeta=0.1))),
        CAR,
        slow.surface,
        5.0,
    )
    with pytest.raises(ConfigError, match="all have a flexible frame, or none"):
        Fleet([slow, flexible])
