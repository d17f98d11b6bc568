"""Accelerometers anywhere on body and axles: simulation, files, environments."""

from dataclasses import asdict, replace

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import yaml
from measured import read_measured_record
from scipy import signal
from vehicle_fixtures import DEFENDER, smooth_road

from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables.description import (
    DriveDescription,
    read_description,
    write_description,
)
from road_envs.drives.recording import read_record, simulate_record, write_record
from road_envs.envs.road_recon import RoadReconEnv
from road_envs.records.accelerometers import Accelerometer, from_plain, to_plain
from road_envs.sensing.data_logger import load_instruments
from road_envs.sensing.instruments import ANTIALIAS_ORDER, instruments_of
from road_envs.simulation.drive import simulate
from road_envs.vehicle.equations import AXLE, N_DOF, PHI, THETA, Z_B
from road_envs.vehicle.linear_model import _wheel_response, linearise

PAPER, IDEAL = load_instruments("paper"), load_instruments("ideal")
ROAD = smooth_road(length=20.0, height=0.01)
SIX = {
    **PAPER.accelerometers,
    "seat": Accelerometer(ahead=-0.3, y=0.4),
    "front_hub": Accelerometer(mounted="front axle", y=0.6, range=490.0),
    "diff": Accelerometer(mounted="rear axle", y=0.1, range=490.0),
}


def layout(sensors, instruments=PAPER):
    return replace(instruments, accelerometers=sensors)


def drive(instruments, seed=0, **options):
    return simulate_record(
        ROAD, vehicle=DEFENDER, speed_kmh=36.0, instruments=instruments, seed=seed, **options
    )[0]


def test_sensors_measure_the_second_derivative_of_the_height_where_they_are_mounted():
    """Central differences of the heights' rates, through SciPy's filter, sampled."""
    record = drive(layout(SIX, IDEAL))
    motion = simulate(DEFENDER, ROAD, 10.0)
    rate = motion.state[:, N_DOF:].T
    front = DEFENDER.front.x
    rates = {
        "RF": rate[Z_B] - (front - 0.12) * rate[THETA] - 0.55 * rate[PHI],
        "seat": rate[Z_B] + 0.3 * rate[THETA] + 0.4 * rate[PHI],
        "front_hub": rate[AXLE] + 0.6 * rate[AXLE + 1],
        "diff": rate[AXLE + 2] + 0.1 * rate[AXLE + 3],
    }
    sos = signal.butter(ANTIALIAS_ORDER, IDEAL.f_alias, fs=1000.0, output="sos")
    for name, x in rates.items():
        expected = signal.sosfilt(sos, np.gradient(x, motion.t))
        measured = record.a[list(SIX).index(name)]
        assert np.std(measured - expected) < 0.02 * expected.std()
    hub, body = record.a[4].std(), record.a[0].std()
    assert hub > 3.0 * body


def test_the_papers_sensors_measure_the_same_among_others():
    alone, among = drive(layout(PAPER.accelerometers, IDEAL)), drive(layout(SIX, IDEAL))
    np.testing.assert_array_equal(among.a[:3], alone.a)
    assert alone.channels == ("RF", "LR", "RR") and among.channels == tuple(SIX)


def test_each_sensor_has_its_own_range_and_noise():
    still = smooth_road(length=20.0, height=0.0)
    loud = {**SIX, "front_hub": replace(SIX["front_hub"], noise_density=0.05)}
    noisy, _ = simulate_record(still, speed_kmh=36.0, instruments=layout(loud))
    ratio = noisy.a[4].std() / noisy.a[5].std()
    assert ratio == pytest.approx(5.0, rel=0.1)
    narrow = {**SIX, "diff": Accelerometer(mounted="rear axle", y=0.1, range=3.0)}
    clipped, free = drive(layout(narrow, IDEAL)), drive(layout(SIX, IDEAL))
    assert np.abs(free.a[5]).max() > 6.0 and np.abs(clipped.a[5]).max() < 4.5
    np.testing.assert_array_equal(clipped.a[:5], free.a[:5])


def test_every_sensor_of_a_faulty_layout_has_its_own_faults():
    sound, faulty = drive(layout(SIX, IDEAL)), drive(layout(SIX, IDEAL), grade="S3")
    assert faulty.a.shape[0] == len(SIX)
    means = np.nanmean(faulty.a, axis=1)
    assert np.unique(means).size == len(SIX) and np.abs(means).max() > 1e-3
    assert sound.sensors == faulty.sensors == layout(SIX, IDEAL).layout


@pytest.mark.parametrize("name", ["record.parquet", "record.csv"])
def test_a_record_keeps_its_layout_in_a_file(tmp_path, name):
    record = drive(layout(SIX))
    write_record(tmp_path / name, record, {})
    if name.endswith("csv"):
        description = DriveDescription(sensors=shape(SIX, tmp_path))
        measured = read_measured_record(
            tmp_path / name, DEFENDER.wheelbase, description=description
        )
        np.testing.assert_allclose(measured.record.a, record.a, atol=1e-4)
        again = measured.record
    else:
        again, _ = read_record(tmp_path / name)
        np.testing.assert_array_equal(again.a, record.a)
    assert again.sensors == layout(SIX).layout and again.channels == tuple(SIX)
    assert again.sensors["RF"].range == PAPER.range and again.sensors["diff"].range == 490.0
    assert from_plain(to_plain(SIX), "x") == SIX and to_plain(None) is None


def test_a_description_says_where_the_accelerometers_of_a_table_are(tmp_path):
    hubs = {"left_hub": SIX["front_hub"], "dash": Accelerometer(axle="front", ahead=-1.0, y=0.0)}
    record = drive(layout(hubs))
    table = {"t": record.t, "phone 2 [g]": record.a[1] / 9.80665, "hub": record.a[0]}
    pd.DataFrame(table | {"v": record.v}).to_csv(tmp_path / "d.csv", index=False)
    told = DriveDescription(
        columns={"a_left_hub": "hub", "a_dash": "phone 2"}, mode="ride", accelerometers=hubs
    )
    write_description(tmp_path / "d.yaml", told)
    assert "mounted: front axle" in (tmp_path / "d.yaml").read_text()
    again = read_description(tmp_path / "d.yaml")
    assert again == told
    measured = read_measured_record(tmp_path / "d.csv", DEFENDER.wheelbase, description=again)
    assert measured.record.sensors == layout(hubs).layout
    np.testing.assert_allclose(measured.record.a, record.a, atol=1e-6)
    with pytest.raises(ConfigError, match="unknown quantity in columns 'a_rf'"):
        told.updated(columns={"a_rf": "hub"})
    with pytest.raises(ConfigError, match="the column a_hood is missing"):
        more = told.updated(accelerometers={**hubs, "hood": Accelerometer(y=0.0)})
        read_measured_record(tmp_path / "d.csv", DEFENDER.wheelbase, description=more)


def test_a_record_without_a_layout_has_that_of_the_assumed_instruments():
    record = replace(drive(PAPER), sensors=None)
    assert instruments_of(record, "paper").accelerometers == PAPER.accelerometers
    assert instruments_of(replace(record, sensors=SIX), "paper").accelerometers == SIX
    with pytest.raises(ConfigError, match=r"has 3 accelerations, but .* axle_ends have 4"):
        instruments_of(record, "axle_ends")


def shape(sensors, tmp_path) -> str:
    path = tmp_path / "layout.yaml"
    plain = {**asdict(PAPER), "accelerometers": to_plain(sensors)}
    path.write_text(yaml.safe_dump(plain, sort_keys=False))
    return str(path)


def test_an_environment_observes_the_sensors_of_its_instruments(tmp_path):
    options = {"road": "iso_d", "length": 20.0, "speed_kmh": 54.0}
    env = RoadReconEnv("rgb_array", sensors=shape(SIX, tmp_path), **options)
    paper = gym.make("RoadRecon-v0", sensors="paper", **options).unwrapped
    assert env.observation_space.shape == (6 * 50 + 5,)
    observation, _ = env.reset(seed=3)
    assert env.observation_space.contains(observation)
    parts = env.split(observation)
    assert list(parts) == [*SIX, "speed", "front", "rear"]
    high = env.split(env.observation_space.high)
    assert high["diff"][0] == 490.0 and high["RF"][0] == pytest.approx(PAPER.range)
    other, _ = paper.reset(seed=3)
    assert np.abs(parts["RF"] - paper.split(other)["RF"]).max() < 6.0 * 0.01 * np.sqrt(500.0)
    actions = [0, 1] * 8
    seen = [env.split(env.step(action)[0]) for action in actions]
    motion = env.fleet.last_interval(0, env._command_byte)
    hub = motion.vertical_acceleration(0.0, 0.6, 0)
    # the filter delays by 1.25 ms: compare what it leaves as it is, one sample later
    pair = (seen[-1]["front_hub"][1:], hub[:-1])
    low = [np.convolve(x, np.full(10, 0.1), "valid") for x in pair]
    assert np.corrcoef(*low)[0, 1] > 0.99
    assert seen[-1]["front_hub"].std() > 2.0 * seen[-1]["seat"].std()


def test_vector_environments_observe_any_layout(tmp_path):
    options = {"road": "iso_d", "length": 20.0, "sensors": shape(SIX, tmp_path)}
    envs = gym.make_vec(
        "RoadRecon-v0", num_envs=2, vectorization_mode="vector_entry_point", **options
    )
    one = gym.make("RoadRecon-v0", **options)
    seen, _ = envs.reset(seed=5)
    np.testing.assert_array_equal(seen[0], one.reset(seed=5)[0])
    for action in (0, 1, 1):
        seen = envs.step(np.full(2, action))[0]
        np.testing.assert_array_equal(seen[0], one.step(action)[0])


def test_a_sensor_cannot_have_the_name_of_another_part_of_the_observation(tmp_path):
    named = {"speed": Accelerometer(y=0.0)}
    with pytest.raises(ConfigError, match="accelerometer must not be named 'speed'"):
        gym.make("RoadRecon-v0", sensors=shape(named, tmp_path))


def test_the_linear_model_has_rows_of_the_axles():
    places = layout(SIX).locations(DEFENDER)
    model = linearise(DEFENDER, "handling", places)
    rows = dict(zip(places, model.sensor_rows, strict=True))
    np.testing.assert_array_equal(rows["front_hub"], [0, 0, 0, 1, 0.6, 0, 0])
    np.testing.assert_array_equal(rows["diff"], [0, 0, 0, 0, 0, 1, 0.1])
    f = np.array([2.0, 11.0, 40.0])
    H = _wheel_response(model, f)
    # the height of the front left wheel moves the front axle most, and its left end most of all
    assert (np.abs(H[:, 4, 0]) > np.abs(H[:, 5, 0])).all()
    assert (np.abs(H[:, 4, 0]) > np.abs(H[:, 4, 1])).all()
