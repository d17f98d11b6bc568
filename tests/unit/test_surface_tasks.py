"""Tasks on a surface file: what is driven, how fast, and which roads are trained on."""

import dataclasses
import re

import numpy as np
import pytest

from leaderboard.surface_tasks import _surface_class, surface_tasks
from road_envs.core.config import ConfigError
from road_envs.roads import load_road, write_csv
from road_envs.simulation.drive import simulate


def surface_file(folder, name, seed, length=120.0, road_class="E"):
    folder.mkdir(exist_ok=True)
    road = load_road({"kind": "iso8608", "road_class": road_class, "length": length})
    write_csv(road.realise(np.random.default_rng(seed)), folder / name)
    return folder / name


def test_a_surface_file_gives_a_paper_task_and_a_new_road_task(tmp_path):
    paper, new = surface_tasks(surface_file(tmp_path, "course.csv", seed=3))
    assert (paper.name, new.name) == ("course_paper", "course_new_road")
    assert paper.trains_on_test_road and not new.trains_on_test_road
    assert "class E, the class of this file" in new.title
    assert paper.test.roads_and_seeds[0][0].length == pytest.approx(120.0, abs=0.1)


def test_a_short_surface_is_mirrored_with_a_note(tmp_path):
    for t in surface_tasks(surface_file(tmp_path, "tile.csv", seed=4, length=10.0)):
        surface = t.test.roads_and_seeds[0][0].realise(np.random.default_rng(0))
        assert surface.length == pytest.approx(100.0)
        assert any("mirrored" in note for note in surface.notes)


@pytest.mark.parametrize(
    ("road_class", "length", "part"),
    [("C", 400.0, "The first 300 m of 400 m"), ("E", 120.0, "All 120 m")],
)
def test_a_surface_is_driven_at_the_highest_speed_at_which_the_wheels_stay_down(
    tmp_path, road_class, length, part
):
    path = surface_file(tmp_path, "a.csv", seed=1, length=length, road_class=road_class)
    t = surface_tasks(path)[1]
    speed = t.conditions[0].speed_kmh
    assert {c.speed_kmh for c in t.conditions} == {speed} and t.bound
    assert t.note.startswith(f"{part} are driven at {speed:g} km/h")
    surface = t.test.roads_and_seeds[0][0].realise(np.random.default_rng(0))

    def lifted(speed_kmh):
        modes = [c.simulator_mode for c in t.conditions]
        loads = [simulate(t.vehicle, surface, speed_kmh / 3.6, mode).tyre_load for mode in modes]
        return max((load.min(axis=1) <= 0.0).mean() for load in loads)

    assert lifted(speed) <= 0.001
    if road_class == "C":
        assert speed == 14.5
    else:
        assert speed < 14.5 and lifted({10.0: 14.5, 7.0: 10.0, 5.0: 7.0}[speed]) > 0.001


def test_a_surface_on_which_wheels_fly_at_every_speed_has_no_bound_and_says_so(tmp_path):
    path = surface_file(tmp_path, "rough.csv", seed=1, road_class="G")
    for t in surface_tasks(path):
        assert not t.bound and t.conditions[0].speed_kmh == 5.0
        assert re.search(r"a wheel is still in the air for \d\d\.\d% of the time", t.note)


def test_the_noise_of_a_copy_does_not_grow_with_the_grade_of_the_road(tmp_path):
    surface = load_road("iso_c").realise(np.random.default_rng(2))
    found = {}
    for grade in (0.0, 0.02, 0.05):
        hill = dataclasses.replace(surface, z=surface.z + grade * surface.s)
        write_csv(hill, tmp_path / "hill.csv")
        (copy, _), *_ = surface_tasks(tmp_path / "hill.csv")[0].training.roads_and_seeds
        altered = copy.realise(np.random.default_rng(0))
        apart = altered.height(surface.s[200:-200] + copy.delay) - hill.z[:, 200:-200]
        found[grade] = (apart - apart.mean(axis=1, keepdims=True)).std()
        assert found[grade] == pytest.approx(found[0.0], rel=0.05)
    assert 0.0 < found[0.0] < 0.1 * surface.z.std()


def test_a_level_surface_is_refused_by_the_name_of_its_file(tmp_path):
    write_csv(load_road("flat").realise(np.random.default_rng(0)), tmp_path / "level.csv")
    with pytest.raises(ConfigError, match=r"level\.csv: a level surface, on which no estimate"):
        surface_tasks(tmp_path / "level.csv")


def test_the_class_of_a_surface_is_that_of_its_rougher_path():
    road = load_road({"kind": "iso8608", "road_class": "C", "length": 300.0})
    surface = road.realise(np.random.default_rng(5))
    assert _surface_class(surface) == "C"
    assert _surface_class(dataclasses.replace(surface, z=surface.z * [[1.0], [4.0]])) == "E"


@pytest.mark.parametrize("level", [0, 1])
def test_a_surface_with_one_level_path_has_the_class_of_the_other(tmp_path, level):
    road = load_road({"kind": "iso8608", "road_class": "C", "length": 120.0})
    surface = road.realise(np.random.default_rng(1))
    z = surface.z.copy()
    z[level] = 0.0
    write_csv(dataclasses.replace(surface, z=z), tmp_path / "one_sided.csv")
    assert "class C, the class of this file" in surface_tasks(tmp_path / "one_sided.csv")[1].title


def test_a_surface_too_coarse_to_be_driven_is_refused_by_the_name_of_its_file(tmp_path):
    rows = "".join(f"{500.0 * k:.1f},{k % 2:.1f},{k % 3:.1f}\n" for k in range(5))
    (tmp_path / "coarse.csv").write_text(f"distance [m],left [m],right [m]\n{rows}")
    with pytest.raises(ConfigError, match=r"coarse\.csv: of no use as a test road: .* N >= 4"):
        surface_tasks(tmp_path / "coarse.csv")


def test_a_file_that_is_no_surface_is_refused(tmp_path):
    path = tmp_path / "bad.csv"
    path.write_text("0 zero\n")
    with pytest.raises(ConfigError, match=r"bad\.csv"):
        surface_tasks(path)


@pytest.mark.costly
def test_the_digest_depends_on_the_content_of_a_surface_file(tmp_path):
    path = surface_file(tmp_path, "a.csv", seed=1)
    before = surface_tasks(path)[0].digest
    moved = surface_tasks(surface_file(tmp_path / "elsewhere", "a.csv", seed=1))[0].digest
    assert moved == before
    surface_file(tmp_path, "a.csv", seed=2)
    assert surface_tasks(path)[0].digest != before
