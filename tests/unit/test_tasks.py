"""Tasks: validation, separation of training and test, digests, and simulated drives."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from fakes import task
from scipy import signal

from leaderboard.evaluation import test_data
from leaderboard.evaluation.tasks import load_task, shipped_tasks
from leaderboard.evaluation.test_data import simulate_drives
from leaderboard.shared_surfaces import _fixed_surfaces, share_a_surface
from leaderboard.surface_tasks import _surface_class
from road_envs.core import config
from road_envs.core.config import ConfigError, names
from road_envs.drives.recording import simulate_record
from road_envs.records.record import profile_stations
from road_envs.roads import load_road, realise_road
from road_envs.sensing.data_logger import load_instruments
from road_envs.vehicle.parameters import load_vehicle

DRIVES = {"roads": ["iso_d"], "seeds": [1, 2]}


def test_every_shipped_task_loads_and_can_be_simulated():
    shipped = shipped_tasks()
    assert [t.name for t in shipped] == names("tasks")
    for t in shipped:
        first = t.test.roads_and_seeds[0][0]
        assert first.length > t.vehicle.wheelbase
        assert t.sensors.fs * t.test.step <= 1.0


def test_the_papers_eight_scenarios_are_those_of_its_tables():
    """Table 4; ride comfort in scenario 2 and the claims after section 7."""
    paper = {t.name: t for t in shipped_tasks("paper")}
    driven = [paper[f"paper_{k}"].conditions[0] for k in range(1, 9)]
    modes = ["handling", "ride", "ride", "handling", "ride", "handling", "ride", "handling"]
    assert [c.mode for c in driven] == modes
    assert [c.speed_kmh for c in driven] == [14.5] * 6 + [54.0] * 2
    assert {c.grade for c in driven} == {"S3"}  # the perturbed vehicle replaces the measurements
    claims = [paper[f"paper_{k}"].claimed_level_error for k in range(1, 9)]
    assert claims == [None] * 4 + [0.102, 0.128, 0.148, 0.142]
    assert all(t.trains_on_test_road and len(t.test.roads_and_seeds) == 1 for t in paper.values())
    assert [paper[f"paper_{k}"].bumps for k in range(1, 9)] == [True] * 4 + [False] * 4


def test_the_new_road_board_separates_training_and_test_seeds():
    t = load_task("new_road")
    assert not t.training.all_seeds & t.test.all_seeds and not t.trains_on_test_road
    assert (
        len(t.test.roads_and_seeds) == 12
        and len(t.with_test_drives(None).test.roads_and_seeds) == 60
    )
    assert all(road.length == pytest.approx(300.0) for road, _ in t.test.roads_and_seeds)
    states = {c.label for c in t.conditions}
    assert {f"ride front, handling rear, {v} km/h" for v in ("14.5", "54")} <= states
    assert {c.speed_kmh for c in t.conditions} == {14.5, 30.0, 54.0}
    assert t.test.step < t.training.step


def test_the_default_design_drives_every_family_road_and_condition_in_fourteen_drives():
    t = load_task("new_road")
    driven = [t.drives_of(t.test, condition) for condition in t.conditions]
    assert sum(map(len, driven)) == 14 and all(driven)
    assert {k for part in driven for k, _, _ in part} == set(range(12))
    families = [t.test.families[k % 6] for part in driven for k, _, _ in part]
    assert all(families.count(name) >= 2 for name in t.test.families)
    assert t.test.strata == [[0, 6], [1, 7], [2, 3, 8, 9], [4, 5, 10, 11]]
    dense = t.with_test_drives(12)
    assert all(len(dense.drives_of(dense.test, c)) == 12 for c in dense.conditions)
    assert [k for k, _, _ in t.drives_of(t.training, t.conditions[0])] == list(range(10))


@pytest.mark.parametrize(
    ("design", "reason"),
    [
        ([[0, 1], [1]], "each of the drives 0 to 2"),
        ([[0, 1, 2], [3]], "each of the drives 0 to 2"),
        ([[0, 0, 1, 2], [1]], "none twice under one, got"),
        ([[0, 1, 2]], "2 lists, none for training"),
    ],
)
def test_a_design_that_does_not_fit_is_rejected(design, reason):
    with pytest.raises(ConfigError, match=reason):
        task(test={"roads": ["iso_d"], "seeds": [11, 12, 13], "design": design})


def test_no_two_test_roads_share_a_seed():
    """Roads of one seed are correlated, so a board would count one road twice."""
    for t in shipped_tasks():
        pairs = (
            t.with_test_drives(None).test.roads_and_seeds
            if t.has_several_test_drives
            else t.test.roads_and_seeds
        )
        assert len({seed for _, seed in pairs}) == len(pairs)


def test_families_partition_the_test_drives():
    drives = load_task("new_road").with_test_drives(None).test
    families = {name: drives.indices_of_family(name) for name in drives.families}
    assert sorted(k for part in families.values() for k in part) == list(range(60))
    assert [len(part) for part in families.values()] == [10, 10, 20, 20]
    roads = [drives.roads_and_seeds[k][0] for k in families["ISO w = 2"]]
    assert {(type(road.road).__name__, road.road.w) for road in roads} == {("Iso8608", 2.0)}
    with pytest.raises(ConfigError, match="one family for each of the 2 roads, got 1"):
        task(test={"roads": ["iso_d", "iso_e"], "seeds": [7], "families": ["one"]})


CARS = [{"mode": "ride", "speed_kmh": 30.0, "grade": grade} for grade in ("S0", "S1", "S3")]


def test_the_field_board_has_all_grades_on_the_same_roads():
    t = load_task("field")
    grades = [c.grade for c in t.conditions]
    assert grades == ["S0", "S1", "S2", "S3"] * 2
    assert [t.seed_stream(c) for c in t.conditions] == [0] * 4 + [4] * 4
    assert t.conditions[3].label == "ride, 14.5 km/h, car S3"


def test_training_uses_the_nominal_vehicle_and_test_one_perturbed_vehicle(monkeypatch):
    seen = []

    def recorded(surface, *, grade, seed, individual, **options):
        seen.append((grade, seed.entropy, *seed.spawn_key, individual.entropy))
        return simulate_record(surface, grade=grade, seed=seed, individual=individual, **options)

    monkeypatch.setattr(test_data, "simulate_record", recorded)
    t = task(conditions=CARS, test={"roads": ["iso_b"], "seeds": [11], "length": 12.0},
             training={"roads": ["iso_b"], "seeds": [1], "length": 12.0})  # fmt: skip
    for condition in t.conditions:
        list(simulate_drives(t, t.training, condition)), list(simulate_drives(t, t.test, condition))
    trained, tested = seen[::2], seen[1::2]
    assert trained == [("S0", 1, 0, 1)] * 3
    assert tested == [(grade, 11, 0, 11) for grade in ("S0", "S1", "S3")]


CALIBRATION = [
    {"road": "iso_c", "mode": "ride", "speed_kmh": 36.0, "seed_offset": 100, "length": 12.0},
    {"road": "iso_d", "mode": "ride", "speed_kmh": 30.0, "seed_offset": 200, "length": 12.0,
     "survey_std": 0.001},
]  # fmt: skip


def test_calibration_drives_are_of_the_very_vehicle_on_other_roads(monkeypatch):
    driven = []

    def recorded(surface, *, seed, individual, grade, speed_kmh, **options):
        driven.append((individual.entropy, grade, speed_kmh, seed.spawn_key))
        return simulate_record(
            surface, seed=seed, individual=individual, grade=grade, speed_kmh=speed_kmh, **options
        )

    monkeypatch.setattr(test_data, "simulate_record", recorded)
    t = task(conditions=CARS[1:], calibration=CALIBRATION,
             test={"roads": ["iso_b"], "seeds": [11], "length": 12.0})  # fmt: skip
    (drive,) = simulate_drives(t, t.test, t.conditions[0])
    assert driven == [
        (11, "S1", 30.0, (0,)), (11, "S1", 36.0, (1, 100)), (11, "S1", 30.0, (1, 200))
    ]  # fmt: skip
    unknown, known = drive.calibration
    assert unknown.profile is None and known.survey_std == 0.001
    truth = load_road("iso_d")
    road = dataclasses.replace(truth, length=12.0).realise(np.random.default_rng(211))
    error = known.profile.z - road.height(known.profile.s)
    assert 0.0008 < error.std() < 0.0012
    list(simulate_drives(t, t.training, t.conditions[0]))
    assert all(one[1:3] == ("S0", 30.0) for one in driven[3:])  # no calibration of training drives


@pytest.mark.parametrize("t", [t for t in shipped_tasks() if t.calibration], ids=lambda t: t.name)
def test_no_calibration_drive_shares_a_seed_with_a_test_or_training_drive(t):
    t = t.with_test_drives(None)
    seeds = [seed for _, seed in t.test.roads_and_seeds]
    others = set(seeds) | {seed for _, seed in t.training.roads_and_seeds}
    own = [seed + run.seed_offset for run in t.calibration for seed in seeds]
    assert len(set(own)) == len(own) and not others & set(own)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed_offset": 1}, r"a calibration drive shares the seeds \[12, 13, 14, 15\] with other"),
        ({"seed_offset": 100}, r"a calibration drive shares the seeds \[111, 112"),
        ({"survey_std": 0.0}, "survey_std: must be positive, got 0.0 m"),
        ({"seed_offset": 0}, "seed_offset: must be at least 1, got 0"),
    ],
)
def test_an_invalid_calibration_drive_is_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        task(calibration=[CALIBRATION[0], {**CALIBRATION[1], **change}])


def test_a_calibration_drive_over_the_test_road_is_refused():
    with pytest.raises(ConfigError, match="a calibration drive and a test drive share a surface"):
        task(test={"roads": ["belgian"], "seeds": [11]},
             calibration=[{**CALIBRATION[0], "road": "belgian", "length": None}])  # fmt: skip


@pytest.mark.parametrize(
    ("own_seed", "offset", "test", "shared"),
    [
        (None, 76, {"roads": [77], "seeds": [1]}, 77),
        (None, 77, {"roads": ["iso_d", 10_078], "seeds": [1]}, 10_078),
        (11, 500, {"roads": ["iso_c"], "seeds": [11]}, 11),
    ],
)
def test_no_calibration_drive_is_over_the_test_road_that_a_seed_of_its_own_draws(
    own_seed, offset, test, shared
):
    """Of the numbers, each is the seed of a road that is drawn by that one alone."""

    def road(x):
        return {"kind": "fixed_seed", "seed": x, "road": "iso_c"} if isinstance(x, int) else x

    run = {**CALIBRATION[0], "road": road(own_seed or "iso_c"), "seed_offset": offset}
    drives = {
        "training": DRIVES | {"seeds": [5]},
        "test": {**test, "roads": [*map(road, test["roads"])]},
    }
    with pytest.raises(ConfigError, match=rf"a calibration drive shares the seeds \[{shared}\]"):
        task(**drives, calibration=[run])
    task(**drives, calibration=[{**run, "seed_offset": offset + 1, "road": "iso_c"}])


def test_a_low_pass_leaves_the_accelerations_below_it_and_keeps_samples_lost():
    options = {"conditions": CARS[2:], "test": {"roads": ["iso_b"], "seeds": [11], "length": 60.0}}
    plain, low = task(**options), task(**options, low_pass=25.0)
    a, b = (next(simulate_drives(t, t.test, t.conditions[0])).record.a for t in (plain, low))
    np.testing.assert_array_equal(np.isnan(a), np.isnan(b))
    f, before = signal.welch(np.nan_to_num(a), fs=1000.0, nperseg=512)
    after = signal.welch(np.nan_to_num(b), fs=1000.0, nperseg=512)[1]
    ratio = after.mean(axis=0) / before.mean(axis=0)
    assert 0.8 < ratio[(f > 2.0) & (f < 15.0)].mean() < 1.2
    assert ratio[(f > 60.0) & (f < 200.0)].max() < 0.1
    with pytest.raises(ConfigError, match="low_pass: must be positive, got 0"):
        task(low_pass=0.0)


def test_more_test_drives_than_a_task_has_are_refused():
    with pytest.raises(ConfigError, match="new_road: number of drives must be 1 to 60, got 61"):
        load_task("new_road").with_test_drives(61)


def test_a_shared_seed_is_refused():
    with pytest.raises(ConfigError, match=r"training and test share the seeds \[2\]"):
        task(training=DRIVES, test={"roads": ["iso_d"], "seeds": [2, 3]})


def test_a_road_drawn_by_a_seed_of_its_own_is_that_of_the_seed():
    fixed = {"kind": "fixed_seed", "seed": 5, "road": "iso_d"}
    drawn, alone = {"roads": ["iso_d"], "seeds": [5, 6]}, {"roads": [fixed], "seeds": [1]}
    for training, test in ((drawn, alone), (alone, drawn)):
        with pytest.raises(ConfigError, match=r"training and test share the seeds \[5\]"):
            task(training=training, test=test)
    with pytest.raises(ConfigError, match=r"no seed varies the road FixedSeed, so the test needs"):
        task(training=DRIVES, test={**alone, "seeds": [11, 12]})
    assert task(training=DRIVES, test={"roads": [fixed, {**fixed, "seed": 6}], "seeds": [11]})
    assert task(training=DRIVES, test={"roads": ["iso_d", "flat"], "seeds": [11, 12]})


FIXED = {"kind": "fixed_seed", "seed": 77, "road": "iso_d"}


@pytest.mark.parametrize(
    ("roads", "seeds", "message"),
    [
        (["iso_d"] * 5, [1001, 11001, 21001], "by multiples of 10000; got [1001, 11001, 21001]"),
        (["iso_d", "iso_e"], [10011, 11], "seeds must differ, also from those of another road"),
        (["belgian", "iso_d", "belgian"], [1001], "no seed varies the road FixedSeed"),
        ([FIXED, "flat", FIXED], [1001], "no seed varies the road FixedSeed"),
        ([FIXED, {"kind": "scaled", "road": FIXED}], [1001], "may list each surface once"),
    ],
)
def test_a_road_counts_once_at_whatever_place_of_the_list(roads, seeds, message):
    with pytest.raises(ConfigError) as error:
        task(test={"roads": roads, "seeds": seeds})
    assert message in str(error.value)
    assert task(test={"roads": ["iso_d"] * 5, "seeds": [1001, 1002]})  # by seeds of their own


@pytest.mark.parametrize("training", ["belgian", "belgian_training"])
def test_training_on_the_test_road_must_be_declared(training):
    roads = {"training": {"roads": [training], "seeds": [1]}}
    test = {"roads": ["belgian"], "seeds": [2]}
    with pytest.raises(ConfigError, match="trains_on_test_road"):
        task(**roads, test=test)
    assert task(**roads, test=test, trains_on_test_road=True).trains_on_test_road


WAVES = {"kind": "sine_sweep", "length": 40.0, "n_start": 1.0, "n_end": 1.0, "amplitude": 0.01,
         "amplitude_end": 0.01}  # fmt: skip


@pytest.mark.parametrize(
    ("training", "shares"),
    [
        ({**WAVES, "length": 50.0}, True),
        ({"kind": "with_aprons", "road": WAVES}, True),
        ({"kind": "scaled", "road": WAVES, "height_factor": 2.0}, True),
        ({"kind": "concatenated", "roads": ["iso_c", {"kind": "noisy_copy", "road": WAVES}]}, True),
        ({"kind": "fixed_seed", "seed": 3, "road": {"kind": "noisy_copy", "road": WAVES}}, True),
        ({"kind": "fixed_seed", "road": "iso_c", "seed": 3}, False),
        ({"kind": "concatenated", "roads": ["iso_c", {"kind": "flat"}]}, False),
    ],
)
def test_a_surface_is_the_same_at_another_length_between_aprons_scaled_or_altered(training, shares):
    test = {"kind": "concatenated", "roads": [WAVES, {"kind": "flat"}, "iso_c"]}
    assert len(_fixed_surfaces([load_road(test)])) == 1
    roads = {
        "training": {"roads": [training], "seeds": [1]},
        "test": {"roads": [test], "seeds": [2]},
    }
    if shares:
        with pytest.raises(ConfigError, match="trains_on_test_road"):
            task(**roads)
    else:
        task(**roads)


def test_a_file_is_the_same_surface_under_another_name_and_a_seed_draws_another(tmp_path):
    heights = 0.01 * np.random.default_rng(0).standard_normal((200, 2))
    table = "".join(f"{0.1 * k:.1f},{a:.5f},{b:.5f}\n" for k, (a, b) in enumerate(heights))
    for name in "ab":
        (tmp_path / f"{name}.csv").write_text(f"station,left,right\n{table}")
    a, b = ([load_road(tmp_path / f"{name}.csv")] for name in "ab")
    assert _fixed_surfaces(a) == _fixed_surfaces(b)
    drawn = [load_road({"kind": "fixed_seed", "road": "iso_c", "seed": k}) for k in (1, 1, 2)]
    assert len(_fixed_surfaces(drawn)) == 2


def defects(*made, **settings):
    rows = [{"shape": "half_sine", "at": 20.0, "length": 2.0, "height": 0.05} | one for one in made]
    return {"kind": "defects", "length": 60.0, "defects": rows, **settings}


@pytest.mark.parametrize(
    ("one", "other", "is_same"),
    [
        (FIXED, {**FIXED, "road": "iso_c"}, True),
        (FIXED, {**FIXED, "road": {"name": "iso_d", "length": 60.0}}, True),
        (FIXED, {**FIXED, "road": {"kind": "iso8608", "road_class": "D", "w": 2.5}}, True),
        (FIXED, {**FIXED, "seed": 78}, False),
        ({**FIXED, "road": WAVES}, {**FIXED, "road": WAVES, "seed": 78}, True),
        (defects({}, name="mine"), defects({}, name="other"), True),
        (defects({}), defects({"height": 0.03, "at": 30.0}), True),
        (defects({}, {"at": 40.0, "length": 4.0}), defects({"at": 40.0, "length": 4.0}, {}), True),
        (defects({}), defects({"length": 2.2}), False),
        (defects({}), defects({"side": "left"}), False),
        (defects({}), {"kind": "bumps", "layout": "small"}, False),
        ({"kind": "bumps", "layout": "small"}, "bump_large_small", False),
        ({"kind": "bumps", "layout": "small"}, {"kind": "bumps", "layout": "small",
                                                "height_factor": 1.001}, True),
        (WAVES, {**WAVES, "amplitude": 0.02, "amplitude_end": 0.02}, True),
        (WAVES, {**WAVES, "paths": "left"}, False),
        (WAVES, {**WAVES, "n_start": 2.0, "n_end": 2.0}, False),
    ],
)  # fmt: skip
def test_a_surface_is_told_from_another_by_its_heights_whatever_its_settings(one, other, is_same):
    first, second = (_fixed_surfaces([load_road(road)]) for road in (one, other))
    assert (first == second) is is_same
    test = {"roads": [one], "seeds": [1001]}
    calibration = [{**CALIBRATION[0], "road": other, "length": None}]
    tasks = [
        {"training": {"roads": [other], "seeds": [1]}, "test": test},
        {"training": {"roads": ["flat"], "seeds": [1]}, "test": test, "calibration": calibration},
        {"test": {**test, "roads": [one, "flat", other]}},
    ]
    for settings in tasks:
        if is_same:
            with pytest.raises(ConfigError, match=r"share a surface|list each surface once"):
                task(**settings)
        else:
            task(**settings)


def test_measured_roads_are_one_in_another_unit_or_cut_and_two_on_one_hill(tmp_path):
    rng = np.random.default_rng(0)

    def measured(name, z, factor=1.0):
        rows = "".join(f"{0.1 * k:.1f},{a:.7f},{b:.7f}\n" for k, (a, b) in enumerate(factor * z))
        unit = {1.0: "m", 1e3: "mm"}[factor]
        (tmp_path / name).write_text(f"distance [m],left [{unit}],right [{unit}]\n{rows}")
        return _fixed_surfaces([load_road(tmp_path / name)])

    hill = 0.1 * 0.1 * np.arange(400)[:, None]
    z, other = (hill + 0.001 * rng.standard_normal((400, 2)) for _ in range(2))
    road = measured("a.csv", z)
    assert len(road) == 1 and road == measured("mm.csv", z, 1e3) == measured("cut.csv", z[50:300])
    assert road != measured("other.csv", other)
    assert measured("plane.csv", np.zeros((400, 2))) == []


@pytest.mark.parametrize("road_class", ["A", "C"])
def test_two_surveys_of_one_road_are_one_surface(tmp_path, road_class):
    """Each has noise of its own, of 0.3 mm in each height, and both may be on crests alike."""
    rng = np.random.default_rng(0)
    s = np.arange(0.0, 80.0, 0.025)

    def survey(name, seed):
        z = realise_road({"kind": "iso8608", "road_class": road_class, "length": 80.0}, seed)
        heights = z.height(s).T + 0.3e-3 * rng.standard_normal((s.size, 2))
        heights -= 1e-4 * (s[:, None] - 40.0) ** 2
        rows = "".join(f"{x:.3f},{a:.7f},{b:.7f}\n" for x, (a, b) in zip(s, heights, strict=True))
        (tmp_path / name).write_text(f"distance [m],left [m],right [m]\n{rows}")
        return [load_road(tmp_path / name)]

    first = survey("first.csv", 1)
    assert share_a_surface(first, survey("again.csv", 1))
    assert not share_a_surface(first, survey("other.csv", 2))


@pytest.mark.parametrize("noise", [0.0, 0.2e-3])
def test_a_survey_is_the_same_road_driven_back_and_with_one_of_its_wheel_paths(tmp_path, noise):
    """Noise [m] in each height of either survey hides the rises, not the waves."""
    rng = np.random.default_rng(0)
    s = np.arange(0.0, 60.0, 0.025)
    left, right, third = (
        realise_road({"kind": "iso8608", "road_class": "B", "length": 60.0}, seed).height(s)[0]
        for seed in (1, 2, 3)
    )

    def survey(name, *paths):
        heights = np.array(paths).T + noise * rng.standard_normal((s.size, 2))
        rows = "".join(f"{x:.3f},{a:.7f},{b:.7f}\n" for x, (a, b) in zip(s, heights, strict=True))
        (tmp_path / f"{name}.csv").write_text(f"distance [m],left [m],right [m]\n{rows}")
        return [load_road(tmp_path / f"{name}.csv")]

    first = survey("first", left, right)
    assert share_a_surface(first, survey("back", right[::-1], left[::-1]))
    assert share_a_surface(first, survey("exchanged", right, left))
    assert share_a_surface(first, survey("next_line", right, third))
    assert not share_a_surface(first, survey("other", third, third[::-1]))


def test_bumps_of_slightly_other_lengths_are_no_surface_in_common():
    one, other = ([load_road(defects({"length": length}))] for length in (2.0, 2.1))
    assert not share_a_surface(one, other)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"boards": "paper"}, "unknown key, did you mean 'board'"),
        (
            {"board": "papers"},
            "unknown board 'papers' (did you mean 'paper'?); known: class, field",
        ),
        (
            {"board": {"title": "Mine", "ranks_by": "r"}},  # of which more is better
            "unknown score to rank by, of which less is better: 'r'",
        ),
        (
            {
                "conditions": [
                    {"mode": "ride", "speed_kmh": 9.0, "car": f"{folder}/van.yaml"}
                    for folder in "ab"
                ]
            },
            "conditions must have labels that differ",
        ),
        ({"test": {"roads": ["iso_x"], "seeds": [9]}}, "unknown road 'iso_x'"),
        ({"test": {"roads": [], "seeds": [9]}}, "roads: must have at least 1 element, got"),
        ({"test": {"roads": ["iso_d"], "seeds": [9, 9]}}, "seeds must differ"),
        # tables of scores hold whole numbers of 63 bits
        ({"test": {"roads": ["iso_d"], "seeds": [2**62]}}, "must be below 4.61169e+18, got"),
        (
            {"test": {"roads": ["iso_d"], "seeds": [9], "step": 0.0}},
            "step: must be positive",
        ),
        (
            {"conditions": [{"mode": "ride", "speed_kmh": 0.0}]},
            "speed_kmh: must be positive",
        ),
        ({"conditions": [{"mode": "sport", "speed_kmh": 9.0}]}, "mode"),
        ({"conditions": []}, "conditions: must have at least 1 element"),
        (
            {"name": "class", "board": {"title": "Mine", "ranks_by": "nrmse"}},
            "a task with a board of its own cannot be named as the board class",
        ),
        (
            {
                "conditions": [{"mode": "passive", "speed_kmh": 9.0, "plant": "mujoco"}],
                "low_pass": 4.0,
            },
            "conditions on a plant cannot have a low_pass",
        ),
        (
            {
                "conditions": [
                    {"mode": "passive", "speed_kmh": 9.0, "plant": "mujoco", "grade": "S1"}
                ]
            },
            "conditions on a plant cannot have a grade",
        ),
        (
            {
                "conditions": [{"mode": "passive", "speed_kmh": 9.0, "plant": "mujoco"}],
                "test": {"roads": ["iso_d"], "seeds": [9], "noise": False},
            },
            "conditions on a plant cannot have test drives without noise",
        ),
        *[
            (
                {"test": {"roads": ["iso_d"], "seeds": [9], "families": [family]}},
                "families need names that are no condition, car or frame, nor 'all drives', "
                f"got {family!r}",
            )
            for family in ("", "all drives", "ride, 14.5 km/h", "car S1", "frame 7 to 9 Hz")
        ],
        *[
            (
                {"instruments": "phone", "low_pass": f_c},
                f"low_pass must be below 50 Hz, half the sampling rate of phone, got {f_c:g} Hz",
            )
            for f_c in (50.0, 60.0)
        ],
        ({"name": "../up"}, "letters, digits"),
        ({"name": ".."}, "letters, digits"),
    ],
)
def test_invalid_task_settings_give_one_sentence_that_names_them(change, message):
    with pytest.raises(ConfigError) as error:
        task(**{"name": "small", **change})
    assert message in str(error.value) and "\n" not in str(error.value)


def test_the_name_of_a_task_must_be_that_of_its_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({**as_settings(), "name": "other"}))
    with pytest.raises(ConfigError, match="named 'other' but its file 'mine'"):
        load_task(path)


def test_no_other_task_has_the_name_of_a_shipped_one(tmp_path):
    data = config.read_yaml(config.find("tasks", "class"))
    path = tmp_path / "class.yaml"
    path.write_text(yaml.safe_dump(data))
    assert load_task(path).digest == load_task("class").digest
    path.write_text(yaml.safe_dump({**data, "bumps": True}))
    with pytest.raises(
        ConfigError, match=r"class\.yaml: class is the name of another, shipped task"
    ):
        load_task(path)


def test_files_are_named_relative_to_the_file_of_their_task(tmp_path, monkeypatch):
    there = tmp_path / "tasks"
    (there / "files").mkdir(parents=True)
    for kind, name in (("vehicles", "land_rover_defender_110"), ("sensors", "paper")):
        shutil.copyfile(config.find(kind, name), there / "files" / f"{name}.yaml")
    heights = "distance [m],left [mm],right [mm]\n"
    heights += "".join(f"{0.1 * k:.1f},{k % 7},{k % 5}\n" for k in range(400))
    (there / "files" / "street.csv").write_text(heights)
    (there / "patched.yaml").write_text("kind: measured\npath: files/street.csv\n")
    (tmp_path / "patched.yaml").write_text("kind: flat\nlength: 40.0\n")  # of the same name
    bent = {"kind": "noisy_copy", "road": "patched.yaml", "noise": 0.1}
    changed = {
        "car": "files/land_rover_defender_110.yaml",
        "instruments": str(there / "files" / "paper.yaml"),
        "conditions": [
            {"mode": "ride", "speed_kmh": 14.5, "car": "files/land_rover_defender_110.yaml"}
        ],
        "training": {"roads": ["files/street.csv", {"name": "patched.yaml"}], "seeds": [1]},
        "test": {"roads": [{"kind": "measured", "path": "files/street.csv"}, bent], "seeds": [3]},
        "trains_on_test_road": True,
        "note": "as in files/paper.yaml",
    }
    (there / "mine.yaml").write_text(yaml.safe_dump({**as_settings(), **changed}))
    found = []
    for here, name in ((tmp_path, "tasks/mine.yaml"), (there, "mine.yaml")):
        monkeypatch.chdir(here)
        mine = load_task(name)
        assert mine.vehicle_of(mine.conditions[0]) == load_vehicle("land_rover_defender_110")
        assert mine.sensors == load_instruments("paper") and mine.note == "as in files/paper.yaml"
        first, second, third, fourth = mine.training.roads + mine.test.roads
        assert first == second == third == fourth.road and Path(first.path).samefile(
            there / "files" / "street.csv"
        )
        found.append((mine.digest, mine.conditions[0].label))
    assert found[0] == found[1] and found[0][1] == "ride, 14.5 km/h, land_rover_defender_110"
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="mine"):
        (tmp_path / "mine.yaml").write_text((there / "mine.yaml").read_text())
        load_task("mine.yaml")


def as_settings():
    return {
        "name": "mine",
        "title": "Mine",
        "board": "new_road",
        "version": 1,
        "car": "land_rover_defender_110",
        "instruments": "paper",
        "conditions": [{"mode": "ride", "speed_kmh": 14.5}],
        "training": DRIVES,
        "test": {"roads": ["iso_d"], "seeds": [3]},
    }


def test_a_title_names_the_car_of_the_test_drives_where_it_is_another_one():
    assert load_task("paper_5").heading == (
        "Belgian paving; ride, 14.5 km/h; evaluated on the field car S3, trained on S0"
    )
    assert load_task("new_road").heading == load_task("new_road").title
    assert load_task("field").heading == load_task("field").title


def test_levels_on_the_main_board_lie_in_several_classes():
    t = load_task("new_road").with_test_drives(None)
    surfaces = [road.realise(np.random.default_rng(seed)) for road, seed in t.test.roads_and_seeds]
    levelled = [surface for k, surface in enumerate(surfaces) if k % 6 < 4]
    classes = [_surface_class(surface) for surface in levelled]
    assert max(classes.count(letter) for letter in "BCDE") < 0.65 * len(classes)
    assert {"C", "D"} <= set(classes)


def test_drives_are_repeatable_and_one_road_is_the_same_in_every_condition():
    t = task(test={"roads": ["iso_d"], "seeds": [11], "length": 20.0, "step": 0.0005})
    first, again, fast = (next(simulate_drives(t, t.test, t.conditions[k])) for k in (0, 0, 1))
    np.testing.assert_array_equal(first.record.a, again.record.a)
    np.testing.assert_array_equal(first.truth.z, fast.truth.z)
    np.testing.assert_array_equal(first.truth.s, profile_stations(first.record.length))
    assert first.record.a.shape[1] > fast.record.a.shape[1]


def test_drives_are_simulated_with_the_step_of_the_task():
    t = task(test={"roads": ["iso_d"], "seeds": [11], "length": 20.0, "noise": False})
    finer = dataclasses.replace(t.test, step=0.0005)
    a, b = (next(simulate_drives(t, d, t.conditions[0])).record.a for d in (t.test, finer))
    assert a.shape == b.shape and 0.0 < np.abs(a - b).max() < 0.1 * np.abs(a).max()


def test_the_noise_of_a_drive_is_drawn_by_no_other_seed_of_its_task(monkeypatch):
    """`SeedSequence([n, 0])` draws what n does, and a road that varies is filtered white noise."""
    run = {"road": "iso_c", "mode": "ride", "speed_kmh": 54.0, "seed_offset": 1, "length": 20.0}
    t = task(test={"roads": ["flat"], "seeds": [11], "length": 20.0}, calibration=[run])
    drawn = [np.random.SeedSequence(seed) for seed in (11, 12)]  # of both roads, and the vehicle

    def driven(surface, **given):
        drawn.append(given["seed"])
        return simulate_record(surface, **given)

    monkeypatch.setattr(test_data, "simulate_record", driven)
    for condition in t.conditions:
        next(simulate_drives(t, t.test, condition))
    assert len(drawn) == 6  # the calibration drive of both conditions is one
    assert len({tuple(sequence.generate_state(4)) for sequence in drawn}) == 5


@pytest.mark.parametrize("own_densities", [False, True])
def test_noise_is_simulated_only_if_the_task_has_it(own_densities, tmp_path):
    instruments = yaml.safe_load(config.find("sensors", "paper").read_text())
    if own_densities:
        density, instruments["noise_density"] = instruments["noise_density"], 0.0
        for sensor in instruments["accelerometers"].values():
            sensor["noise_density"] = density
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(instruments, sort_keys=False))
    t = task(instruments=str(tmp_path / "mine.yaml"),
             test={"roads": ["flat"], "seeds": [11], "length": 20.0, "noise": False})  # fmt: skip
    quiet = next(simulate_drives(t, t.test, t.conditions[0])).record
    assert np.abs(quiet.a).max() < 1e-6
    noisy = dataclasses.replace(t.test, noise=True)
    assert next(simulate_drives(t, noisy, t.conditions[0])).record.a.std() > 0.05


def test_the_receiver_task_drives_the_field_cars_with_positions_that_wander():
    short, field = (load_task(name).with_test_length(12.0) for name in ("field_receiver", "field"))
    of_field = next(c for c in field.conditions if c.label == short.conditions[0].label)
    assert short.digest != dataclasses.replace(short, position_noise=False).digest
    (one,) = simulate_drives(short, short.test, short.conditions[0], chosen=[0])
    (other,) = simulate_drives(field, field.test, of_field, chosen=[0])
    np.testing.assert_array_equal(one.record.a, other.record.a)
    np.testing.assert_array_equal(one.record.v, other.record.v)
    assert np.abs(one.record.s - other.record.s).max() > 0.2
    with pytest.raises(ValueError, match="position_noise needs the position fixes of S3 or S4"):
        dataclasses.replace(field, position_noise=True)
