"""Every shipped vehicle goes the whole way: drive, environment, estimate, bound, report, file."""

import json

import gymnasium
import numpy as np
import pandas as pd
import pytest
from fake_results import runs_of

import road_envs  # noqa: F401, registers the environment
from estimators import create, estimate
from estimators.map_smoother.estimator import MapSmoother
from leaderboard import score
from leaderboard.evaluation.evaluate import run_task
from leaderboard.evaluation.tasks import load_task
from leaderboard.metrics.heights import band_pass, error_over_truth, uncertainty
from road_envs import load_vehicle, simulate_record
from road_envs.core.config import ConfigError
from road_envs.drives.training_corpus import Corpus, _perturb_parameters
from road_envs.records.record import scored_band
from road_envs.roads import realise_road
from road_envs.vehicle.parameters import write_vehicle

VEHICLES = ("bmw_320i", "jeep_cherokee", "land_rover_defender_110", "volkswagen_vanagon", "van")
"""One of each kind of wheels and struts, and a generic one."""
every_vehicle = pytest.mark.parametrize("name", VEHICLES)
other_vehicles = pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name == "land_rover_defender_110"))
        for name in VEHICLES
    ],
)
"""The Defender drives in most other tests too."""


@pytest.fixture(scope="module")
def drive():
    """A drive of each vehicle over one road, by its name."""
    drives = {}

    def of(name):
        if name not in drives:
            drives[name] = simulate_record(
                "iso_c", speed_kmh=36.0, seed=3, vehicle=name, length=60.0
            )
        return drives[name]

    return of


@other_vehicles
@pytest.mark.parametrize(
    ("estimator", "limit"), [("map_smoother", 0.25), ("kalman_rts", 0.3), ("wiener", 0.45)]
)
@pytest.mark.costly
def test_estimators_with_a_vehicle_model_find_the_road(drive, name, estimator, limit):
    record, truth = drive(name)
    found = estimate(estimator, record, name)
    assert score(found, truth)["nrmse"] < limit
    assert found.notes == ()


@every_vehicle
def test_a_learned_estimator_says_on_which_vehicle_it_was_trained(drive, name):
    notes = estimate("tcn", drive(name)[0], name).notes
    trained_on_another = any("were trained on land_rover_defender_110" in note for note in notes)
    assert trained_on_another == (name != "land_rover_defender_110")


@every_vehicle
def test_the_environment_runs_to_the_end_of_the_road(name):
    env = gymnasium.make(
        "RoadRecon-v0",
        vehicle=name,
        length=20.0,
        speed_kmh=54.0,
        observe=["accelerations", "struts"],
    )
    observation, _ = env.reset(seed=1)
    actions = 1 if load_vehicle(name).is_passive else 2
    assert env.action_space == gymnasium.spaces.Discrete(actions)
    total, ended = 0.0, False
    while not ended:
        observation, reward, terminated, ended, _ = env.step(actions - 1)
        assert env.observation_space.contains(observation) and not terminated
        total += reward
    assert -10.0 < total < -0.1
    flags = env.unwrapped.split(observation)["front"]
    assert flags.tolist() == ([0.0, 0.0] if actions == 1 else [1.0, 1.0])


@every_vehicle
def test_a_manufactured_vehicle_drives_and_its_file_reads_back(name, tmp_path):
    car = load_vehicle(name)
    exact, _ = simulate_record("iso_c", speed_kmh=36.0, vehicle=car, length=20.0)
    varied, _ = simulate_record("iso_c", speed_kmh=36.0, vehicle=car, length=20.0, grade="S3")
    a, b = exact.a[0], varied.a[0, : exact.t.size]
    kept = np.isfinite(b)
    assert 0.5 < np.corrcoef(a[kept], b[kept])[0, 1] < 1.0
    write_vehicle(tmp_path / "copy.yaml", car)
    assert load_vehicle(tmp_path / "copy.yaml") == car


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name not in ("bmw_320i", "van")))
        for name in VEHICLES
    ],
)
@pytest.mark.costly
def test_the_commands_take_the_vehicle(road_recon, name):
    words = ("--vehicle", name, "--speed-kmh", "36")
    code, _, err = road_recon(
        "simulate", *words, "--road", "iso_c", "--length", "60", "--out", "d.csv"
    )
    assert code == 0, err
    mode = next(iter(load_vehicle(name).modes))
    table = pd.read_csv("d.csv", comment="#")
    assert set(table["mode_front"]) == {mode}
    code, out, err = road_recon("observability", *words, "--mode", mode, "--json")
    assert code == 0, err
    assert 0.02 < json.loads(out)["bounds"][0]["nrmse"] < 0.3
    report = ("report", "d.csv", "--vehicle", name, "--estimator", "wiener", "--segment", "20")
    code, out, err = road_recon(*report, "--out", "r", "--json")
    assert code == 0, err
    rows = json.loads(out)["drives"][0]["segments"]
    assert {row["state"] for row in rows} == {mode}
    assert all(row["class"] in ("C", "D") for row in rows[1:])


@pytest.mark.costly
def test_the_drive_of_a_passive_car_needs_no_mode_and_takes_no_other(road_recon):
    road = ("--road", "iso_c", "--length", "40", "--speed-kmh", "36")
    road_recon("simulate", *road, "--vehicle", "bmw_320i", "--out", "d.csv")
    table = pd.read_csv("d.csv", comment="#").drop(columns=["mode_front", "mode_rear"])
    table.to_csv("plain.csv", index=False)
    read = ("estimate", "wiener", "plain.csv", "--vehicle")
    assert road_recon(*read, "bmw_320i")[0] == 0
    _, _, err = road_recon(*read, "bmw_320i", "--mode", "ride")
    assert "the car bmw_320i has passive struts: mode passive, not 'ride'" in err
    _, _, err = road_recon(*read, "land_rover_defender_110")
    assert "the state of the struts is missing" in err
    _, _, err = road_recon("simulate", *road, "--vehicle", "bmw_320i", "--mode", "handling")
    assert "the car bmw_320i has passive struts: mode passive, not 'handling'" in err
    road_recon("simulate", *road, "--mode", "handling", "--out", "stiff.parquet")
    _, _, err = road_recon("estimate", "wiener", "stiff.parquet", "--vehicle", "bmw_320i")
    assert "the car bmw_320i has passive struts: it is the drive of another car" in err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"control": "states"}, "control = 'states' switches 4S4 struts, but the car bmw_320i"),
        ({"mode": "ride"}, "the car bmw_320i has passive struts: mode passive, not 'ride'"),
    ],
)
def test_an_environment_of_a_passive_car_refuses_what_would_switch_it(options, message):
    with pytest.raises(ConfigError, match=message):
        gymnasium.make("RoadRecon-v0", vehicle="bmw_320i", **options)


@every_vehicle
def test_drives_of_the_vehicle_can_be_trained_on(name):
    corpus = Corpus(car=name, number=2, shortest=100, longest=100)
    record, truth, _ = corpus.simulate_drive(0)
    assert np.isfinite(record.a).all() and truth.z.shape[1] == truth.s.size
    one = _perturb_parameters(corpus.vehicle, np.random.default_rng(1), 1.0)
    assert one.strut != corpus.vehicle.strut and one.front != corpus.vehicle.front
    if corpus.vehicle.is_passive:
        assert not record.spring_stiff.any() and not record.damper_high.any()


VAN_TASK = {
    "name": "van", "title": "A van", "board": {"title": "A van"}, "version": 1,
    "car": "volkswagen_vanagon", "instruments": "paper",
    "conditions": [{"mode": "passive", "speed_kmh": 36.0}],
    "training": {"roads": ["iso_d"], "seeds": [1], "length": 60.0},
    "test": {"roads": ["iso_c"], "seeds": [1001], "length": 60.0},
}  # fmt: skip


@pytest.mark.costly
def test_a_task_may_name_another_car(tmp_path):
    pytest.importorskip("torch")
    path = tmp_path / "van.yaml"
    path.write_text(json.dumps(VAN_TASK), encoding="utf-8")
    results = run_task(load_task(path), {"wiener": create("wiener"), "tcn": create("tcn")}, (1,))
    assert all(result.failure is None for result in results)
    errors = {r.estimator: next(iter(runs_of(r).values()))["nrmse"] for r in results}
    assert errors["wiener"] < 0.5 < errors["tcn"]
    pretrained = [r for r in results if r.settings.get("shipped")]
    assert [r.estimator for r in pretrained] == ["tcn"]


def test_a_task_takes_the_modes_of_its_car_only(tmp_path):
    path = tmp_path / "van.yaml"
    task = {**VAN_TASK, "conditions": [{"mode": "ride", "speed_kmh": 36.0}]}
    path.write_text(json.dumps(task), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"conditions: .* passive struts: mode passive, not"):
        load_task(path)


@pytest.mark.slow
def test_the_frame_of_an_ordinary_car_is_found_though_its_file_has_none():
    drive = {"vehicle": "bmw_320i", "speed_kmh": 54.0, "mode": "passive", "seed": 77}
    road = realise_road("iso_c", 77, 60.0)
    record, truth = simulate_record(road, individual=78, grade="S2", **drive)
    found = MapSmoother().estimate(record, load_vehicle("bmw_320i"))
    assert any("a frame that can twist at 17" in note for note in found.notes)
    y, a = band_pass(np.stack([truth.z, found.z]), truth.ds, scored_band(15.0))
    assert error_over_truth(y, a).pooled < 0.15  # 0.7 without the frame
    assert uncertainty(y, a, found.z_std).coverage_90 > 0.8
