"""The 4S4 law that is handed over to MuJoCo, and a drive there beside that of the own simulator."""

import numpy as np
import pytest
from gymnasium.utils import seeding

from road_envs.envs.safe4s4 import Safe4S4Setup
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.suspension import encode_command
from studies.policy_robustness import PlantDrive, SidewaysSetup, SwitchedStruts

CAR = load_vehicle("land_rover_defender_110")
REST = np.zeros(4)


def test_switched_struts_change_by_the_gas_law_of_the_paper():
    """Equation 1: bushing, stops and friction cancel in the difference of stiff and soft."""
    e = np.array([0.03, -0.03, 0.05, -0.02])
    ride, stiff = (SwitchedStruts(CAR, encode_command(mode)) for mode in ("ride", "stiff_low"))
    s = CAR.strut
    gas = [s.p_stat * s.A * (x / (x + e)) ** s.n_p for x in (s.x_1 + s.x_2, s.x_1)]
    found = stiff(e, REST).copy() - ride(e, REST)
    np.testing.assert_allclose(found, gas[1] - gas[0], rtol=1e-9)


def test_a_command_acts_after_the_delay_and_holds_the_oil_of_that_moment():
    struts, e = SwitchedStruts(CAR, encode_command("ride")), np.full(4, 0.04)
    before, force = struts(e, REST).copy(), []
    for _ in range(200):
        struts.advance(encode_command("stiff_low"), e)
        force.append(struts(e, REST)[0])
    # closing a valve at a constant extension changes no force
    np.testing.assert_allclose(force, before[0], rtol=1e-6)
    moved = struts(e + 0.01, REST)[0]
    assert moved < SwitchedStruts(CAR, encode_command("ride"))(e + 0.01, REST)[0] - 200.0


@pytest.mark.costly
def test_a_turn_in_mujoco_leans_the_car_as_the_own_side_motion_does():
    pytest.importorskip("mujoco")
    fixed = {
        "severe": "j_turn", "side": "left", "begin": 0.5, "severity": 0.5, "gentle": "slalom",
        "road": "A", "road_after": "A", "bumps": 0, "grade": "S0", "payload": 0.0,
        "speed_kmh": 45.0, "duration": 20.0,
    }  # fmt: skip
    leans = []
    for setup in (SidewaysSetup({}), Safe4S4Setup({})):
        start = setup.prepare(seeding.np_random(1)[0], fixed)
        part = setup.observation_slices["extension"]
        if isinstance(setup, SidewaysSetup):
            fleet = setup.make_fleet()
            fleet.start(0, start.drive, start.logger, start.speed_kmh)
            rows = [fleet.advance(start.command_byte).observation[0] for _ in range(50)]
        else:
            car = PlantDrive(start, setup)
            rows = [car.advance(start.command_byte) for _ in range(50)]
        e = np.array(rows)[40:, part].mean(axis=0)  # from 2.0 to 2.5 s
        leans.append([e[0] - e[1], e[2] - e[3]])
    assert min(leans[0]) > 0.04  # a left turn extends the left struts
    np.testing.assert_allclose(*leans, rtol=0.15)
