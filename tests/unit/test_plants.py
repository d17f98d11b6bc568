"""Cars of other projects, against their statics, our simulator and published roll responses."""

import subprocess
import sys
import tomllib

import numpy as np
import pytest
from scipy.signal import csd, welch

from leaderboard.drive_report.drive_estimates import with_doubts
from road_envs.core import extras
from road_envs.core.code_digest import ROOT
from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables.description import DriveDescription
from road_envs.drives.measured_record import MeasuredRecord
from road_envs.drives.reading import DriveFile
from road_envs.drives.recording import simulate_record
from road_envs.plants import commonroad_car, driving
from road_envs.plants.commonroad_car import CommonRoadCar, as_driven
from road_envs.plants.driving import PLANTS, simulate_on_plant
from road_envs.plants.mujoco_car import MujocoCar
from road_envs.roads import realise_road
from road_envs.roads.surface import Surface
from road_envs.sensing.instruments import SensorLocation
from road_envs.simulation.drive import simulate
from road_envs.vehicle.parameters import load_vehicle

POINTS = [SensorLocation(0.0, 0.0), SensorLocation(0.0, 1.0), SensorLocation(-1.0, 0.0)]
CARS = {
    name: load_vehicle(name).sliding for name in ("bmw_320i", "jeep_cherokee", "volkswagen_vanagon")
}
CLASS_C = realise_road("iso_c", 1, 60.0)
LEVEL = Surface(np.zeros((2, 200)), 0.1)


@pytest.fixture(autouse=True)
def _extra():
    for module in extras.EXTRAS["plants"]:
        pytest.importorskip(module, reason="needs the extra 'plants'")


def driven(plant, car, surface=CLASS_C, v=10.0, duration=7.0):
    """Return accelerations of heave, roll and pitch (3, N), every millisecond."""
    a = PLANTS[plant](car, POINTS).drive(surface, -5.0, v, duration, 1e-3)
    return np.array([a[0], a[1] - a[0], a[2] - a[0]])


def ours(car, surface=CLASS_C, v=10.0):
    return simulate(car, surface, v).acceleration[:7000, :3].T


def told(plant, car):
    return as_driven(car) if plant == "commonroad" else car


@pytest.mark.parametrize("name", CARS)
@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.costly
def test_heave_and_pitch_agree_with_our_simulator(plant, name):
    found, expected = driven(plant, CARS[name]), ours(told(plant, CARS[name]))
    for k in (0, 2):
        assert np.corrcoef(found[k], expected[k])[0, 1] > 0.99
        assert found[k].std() == pytest.approx(expected[k].std(), rel=0.05)


@pytest.mark.costly
def test_roll_of_commonroad_is_that_of_the_table():
    # ratios to a body that rolls about its centre of mass, as measured by others with this car
    # (BMW, 36 km/h): 1.65, 1.58, 0.37, 0.47, 0.59
    found, expected = (
        driven("commonroad", CARS["bmw_320i"])[1],
        ours(as_driven(CARS["bmw_320i"]))[1],
    )
    f, power = welch(expected, 1e3, nperseg=3000)
    gain = np.abs(csd(expected, found, 1e3, nperseg=3000)[1]) / power
    table = {0.67: 1.65, 1.0: 1.58, 3.0: 0.37, 4.0: 0.47, 5.0: 0.59}
    for at, ratio in table.items():
        assert gain[np.argmin(np.abs(f - at))] == pytest.approx(ratio, rel=0.12)


@pytest.mark.parametrize("name", ["bmw_320i", "volkswagen_vanagon"])
@pytest.mark.costly
def test_the_plants_roll_as_each_other_and_not_as_ours(name):
    car = CARS[name]
    one, other = (driven(plant, car)[1] for plant in PLANTS)
    assert np.corrcoef(one, other)[0, 1] > 0.93
    assert np.corrcoef(one, ours(car)[1])[0, 1] < 0.91


@pytest.mark.parametrize("name", CARS)
@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.costly
def test_a_car_on_a_level_road_stays_at_rest(plant, name):
    # free wheels of CommonRoad brake by a thousandth of g while they settle
    motion = driven(plant, CARS[name], LEVEL, duration=2.0)[:, 100:]
    assert np.abs(motion).max() < 3e-3


def test_a_car_of_mujoco_goes_where_it_heads():
    """Without slip its speed sideways is v psi, here 10 m/s times 0.01."""
    one = MujocoCar(CARS["bmw_320i"], POINTS)
    one.data.qpos[2] = 0.01
    for _ in range(2000):
        one.step(np.zeros(4), np.zeros(4), 10.0)
    assert one.data.qvel[0] == pytest.approx(0.1, abs=0.015)


def test_struts_and_tyres_of_mujoco_carry_the_weight():
    car = CARS["bmw_320i"]
    one = MujocoCar(car, POINTS)
    for _ in range(500):
        one.step(np.zeros(4), np.zeros(4), 10.0)
    np.testing.assert_allclose(one.data.ctrl, np.repeat(car.strut_loads, 2), rtol=1e-6)
    np.testing.assert_allclose(one.data.xfrc_applied[:, 2].sum(), 1093.28 * 9.81, rtol=1e-4)


def test_the_vehicle_that_commonroad_has_is_told_the_tyres_and_joints_of_its_package():
    car = load_vehicle("bmw_320i")
    p, side = CommonRoadCar(car, POINTS).p, as_driven(car).side
    assert side.joint_stiffness == pytest.approx((p.K_ras, p.K_ras), rel=1e-8)
    assert side.joint_damping == pytest.approx((p.K_rad, p.K_rad), rel=1e-7)
    np.testing.assert_allclose(side.C_alpha, -p.tire.p_ky1 * np.array(car.tyre_loads))


def test_a_tyre_of_mujoco_never_pulls_and_slips_within_the_friction():
    one = MujocoCar(CARS["bmw_320i"], POINTS)
    one.step(np.array([0.0, 0.0, -0.2, -0.2]), np.zeros(4), 10.0)
    assert (one.data.xfrc_applied[:, 2] >= 0.0).all()
    assert (one.side_force[2:] == 0.0).all()


def test_side_forces_of_mujoco_turn_against_the_slip_over_the_relaxation_length():
    # the first order lag of a constant slip: F = -C alpha (1 - exp(-x / sigma))
    one, v = MujocoCar(CARS["bmw_320i"], POINTS), 10.0
    one.model.opt.timestep = 2e-4
    for _ in range(200):  # 0.4 m
        one.data.qpos[:], one.data.qvel[:] = 0.0, 0.0
        one.data.qvel[0] = 0.1
        one.step(np.zeros(4), np.zeros(4), v)
    alpha, grown = 0.1 / v, 1.0 - np.exp(-0.4 / one.sigma)
    np.testing.assert_allclose(one.side_force, -one.C * alpha * grown, rtol=0.02)


def test_no_equation_is_shared_with_our_vehicle_and_simulator():
    ours = ["vehicle.equations", "vehicle.suspension", "vehicle.tyres", "vehicle.linear_model"]
    ours += ["simulation.rosenbrock", "simulation.drive", "simulation.sensitivity"]
    code = f"""import sys
import road_envs.plants.commonroad_car, road_envs.plants.mujoco_car
print([m for m in {ours} if "road_envs." + m in sys.modules])"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("plant", "module"), [("mujoco", "mujoco"), ("commonroad", "vehiclemodels")]
)
def test_a_missing_extra_is_named(monkeypatch, plant, module):
    for name in [m for m in sys.modules if m.partition(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(extras.MissingExtraError, match=r"road-envs\[plants\]"):
        simulate_on_plant(plant, LEVEL, speed_kmh=36.0, vehicle="bmw_320i")


def test_one_extra_brings_the_plants_and_the_command_that_drives_them():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert "road-envs[board]" in project["optional-dependencies"]["plants"]


def test_other_equations_of_commonroad_are_refused(monkeypatch):
    patches = (*commonroad_car.PATCHES, (r"no such term", "", 1))
    monkeypatch.setattr(commonroad_car, "PATCHES", patches)
    with pytest.raises(ImportError, match="other equations than"):
        CommonRoadCar(CARS["bmw_320i"], POINTS)


def test_a_record_of_a_plant_is_as_any_other():
    surface = realise_road("iso_b", 3, 30.0)
    record, truth = simulate_on_plant(
        "commonroad", surface, speed_kmh=54.0, vehicle="bmw_320i", instruments="ideal"
    )
    assert record.a.shape == (3, record.t.size)
    np.testing.assert_allclose(record.s[0], -5.0)
    np.testing.assert_allclose(record.s[-1], 30.0 + CARS["bmw_320i"].wheelbase + 5.0, atol=0.05)
    np.testing.assert_allclose(truth.z, surface.height(truth.s))
    assert not record.commands.any()
    own, _ = simulate_record(
        surface, speed_kmh=54.0, vehicle=as_driven(CARS["bmw_320i"]), instruments="ideal"
    )
    # of the sensors at left and right rear the mean does not see roll
    n = min(own.t.size, record.t.size)
    found, expected = record.a[1:, :n].mean(axis=0), own.a[1:, :n].mean(axis=0)
    assert np.corrcoef(found, expected)[0, 1] > 0.999


def test_a_slow_sampling_of_commonroad_is_no_other_motion():
    surface = realise_road("iso_b", 3, 20.0)
    drive = CommonRoadCar(CARS["bmw_320i"], POINTS).drive
    fine, coarse = (drive(surface, -5.0, 15.0, 1.0, sample) for sample in (0.001, 0.01))
    np.testing.assert_allclose(coarse, fine[:, ::10], atol=1e-9)


def test_the_noise_of_a_plant_is_not_drawn_by_the_numbers_of_its_road(monkeypatch):
    """A road that varies is filtered white noise, of one seed."""

    def stop(*given):
        assert given[-1].standard_normal() != np.random.default_rng(3).standard_normal()
        raise InterruptedError

    monkeypatch.setattr(driving, "DataLogger", stop)
    with pytest.raises(InterruptedError):
        simulate_on_plant("mujoco", "iso_b", seed=3, speed_kmh=36.0, vehicle="bmw_320i")


@pytest.mark.parametrize(
    ("plant", "settings", "message"),
    [
        ("mujoco", {"vehicle": "land_rover_defender_110"}, "needs passive struts"),
        ("exudyn", {}, "unknown plant 'exudyn'"),
        ("mujoco", {"speed_kmh": 0.0}, "speed must be above 0"),
        ("commonroad", {"instruments": "axle_ends"}, "no sensors on its axles"),
    ],
)
def test_what_a_plant_does_not_have_is_refused(plant, settings, message):
    with pytest.raises(ConfigError, match=message):
        simulate_on_plant(plant, LEVEL, **{"speed_kmh": 36.0, "vehicle": "bmw_320i", **settings})


@pytest.mark.parametrize(("axle", "name"), [(0, "front"), (1, "rear")])
@pytest.mark.parametrize("plant", PLANTS)
def test_an_accelerometer_on_an_axle_is_refused_by_the_car_itself(plant, axle, name):
    places = [*POINTS, SensorLocation(1.3, 0.7, axle)]
    with pytest.raises(ConfigError, match=f"the plant {plant} .* y = 0.7 m is on the {name} axle"):
        PLANTS[plant](CARS["bmw_320i"], places)


@pytest.mark.costly
def test_tyres_of_another_program_are_noticed_behind_peaks_of_paving_too():
    """The paving makes the Defender seem to twist and bend; its file has rigid joints."""
    name = "defender_110_coils"
    record, _ = simulate_on_plant(
        "commonroad", "belgian_like", speed_kmh=36.0, seed=11, vehicle=name, length=100.0
    )
    drive = DriveFile(
        "d", "d", MeasuredRecord(record), "", load_vehicle(name), "paper", False, DriveDescription()
    )
    (note,) = with_doubts(drive).measured.notes
    assert "tyres that slide sideways better" in note
