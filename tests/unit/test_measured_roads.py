"""Roads from measured surfaces: wheel paths, gaps, tiles and text tables."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles_roads import crg_file

from road_envs.core.config import ConfigError
from road_envs.roads import load_road, with_length, write_csv
from road_envs.roads.formats.opencrg import SurfaceFileError
from road_envs.roads.measured import Measured
from road_envs.roads.surface import Surface

FILES = Path(__file__).parents[3] / "shared" / "roads"
needs_files = pytest.mark.skipif(not FILES.is_dir(), reason="needs ../shared/roads")


def rng():
    return np.random.default_rng(0)


def wavy(nu=201, nv=7, seed=3):
    z = np.random.default_rng(seed).standard_normal((nu, nv)) * 0.01
    return z.cumsum(axis=0)


# shipped measurements


@needs_files
@pytest.mark.parametrize(("size", "rms"), [("1in", 24.3e-3), ("2in", 44.2e-3)])
def test_ride_courses_have_their_nominal_roughness(size, rms):
    road = load_road(FILES / "chrono" / f"detrended_rms_course_{size}.crg")
    surface = road.realise(rng())
    assert road.length == pytest.approx(504.75)
    rough = surface.z[:, (surface.s > 100.0) & (surface.s < 404.8)]
    assert rough.std(axis=1) == pytest.approx(rms, abs=1e-4)
    assert "left and right wheel path are the same" in surface.notes


@needs_files
def test_the_half_round_obstacle_is_four_inches_high():
    surface = load_road(FILES / "chrono" / "halfround_4in.crg").realise(rng())
    assert surface.z.max(axis=1) == pytest.approx(0.1016, abs=5e-5)  # sampled to 1 cm
    assert surface.length == pytest.approx(100.0)


@needs_files
def test_a_measured_table_gives_equal_wheel_paths():
    surface = load_road(FILES / "iri_sorel" / "profile_1.txt").realise(rng())
    assert surface.z.shape == (2, 2177)
    assert surface.ds == pytest.approx(0.25)
    assert surface.z[0, 1] == pytest.approx(583.1337 - 583.1370)
    assert surface.notes == ("left and right wheel path are the same",)


@needs_files
def test_a_tile_of_cobbles_can_be_mirrored():
    road = Measured(
        path=str(FILES / "opencrg" / "belgian_block.crg"), repeat="mirror", length=100.0
    )
    surface = road.realise(rng())
    assert surface.notes[-1] == "10.00 m tile mirrored 10 times to 100 m"
    s = np.linspace(0.0, 10.0, 500)
    for start in (20.0, 60.0):
        np.testing.assert_allclose(surface.height(start + s), surface.height(s), atol=1e-12)
        np.testing.assert_allclose(surface.height(start - s), surface.height(s), atol=1e-12)


# roads from files


def crg_path(folder, z, **how):
    path = folder / "surface.crg"
    path.write_bytes(crg_file(z, "KDBI", **how))
    return str(path)


def test_wheel_paths_are_half_a_track_from_the_centre(tmp_path):
    v = np.arange(-2.0, 2.01, 0.5)
    z = 0.01 * np.arange(101)[:, None] * (1.0 + v)  # a plane at each station
    path = crg_path(tmp_path, z)
    k = 0.01 * np.arange(101)
    for centre, middle in ((None, 0.0), (0.3, 0.3), (-1.25, -1.25)):
        left, right = Measured(path=path, centre=centre).realise(rng()).z
        np.testing.assert_allclose(left, k * (1.0 + middle + 0.75), atol=1e-12)
        np.testing.assert_allclose(right, k * (1.0 + middle - 0.75), atol=1e-12)
    with pytest.raises(SurfaceFileError, match=r"left wheel path at v = 2.05 m is off the grid"):
        Measured(path=path, centre=1.3)


def test_missing_heights_matter_only_on_wheel_paths(tmp_path):
    z = wavy(nv=9)
    z[:, 0] = np.nan  # v = -2.0, outside the right path
    z[50:53, 7] = np.nan  # v = 1.5; no path is between 1.0 and 1.5
    Measured(path=crg_path(tmp_path, z), centre=0.0, track=1.0)
    with pytest.raises(SurfaceFileError, match=r"3 of 201 .* left wheel path .* station 5.00 m"):
        Measured(path=crg_path(tmp_path, z), centre=0.75)


def test_gaps_are_interpolated_linearly_if_allowed(tmp_path):
    z = wavy(nv=5)
    holed = z.copy()
    holed[50:53] = holed[90] = np.nan
    road = Measured(path=crg_path(tmp_path, holed), bridge_gaps=True, track=1.0)
    surface = road.realise(rng())
    expected = z[:, 3] - z[0, 3]
    line = np.interp(np.arange(49, 54), [49, 53], expected[[49, 53]])
    np.testing.assert_allclose(surface.z[0, 49:54], line, atol=1e-12)
    assert (
        "interpolated 4 missing heights of the left wheel path, longest gap 0.30 m" in surface.notes
    )


@pytest.mark.parametrize("repeat", ["mirror", "repeat"])
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32), length=st.floats(3.0, 40.0))
def test_tiles_meet_without_a_step(tmp_path_factory, repeat, seed, length):
    z = 1e-3 * np.random.default_rng(seed).standard_normal((61, 7)).cumsum(axis=0)
    path = crg_path(tmp_path_factory.getbasetemp(), z)
    surface = Measured(path=path, repeat=repeat, length=length).realise(rng())
    steps = np.abs(np.diff(z, axis=0)).max() + np.abs(z[-1] - z[0]).max() / 60.0
    assert np.abs(np.diff(surface.z)).max() <= steps
    assert surface.length == pytest.approx(length, abs=0.06)


def test_a_mirrored_tile_alternates_its_direction(tmp_path):
    z = wavy(nu=61, nv=5)
    once = Measured(path=crg_path(tmp_path, z)).realise(rng()).z
    road = Measured(path=crg_path(tmp_path, z), repeat="mirror", length=27.0).realise(rng())
    back = once[:, ::-1]
    expected = np.hstack([once, back[:, 1:], once[:, 1:], back[:, 1:], once[:, 1:]])[:, :271]
    np.testing.assert_array_equal(road.z, expected)
    assert road.notes[-1] == "6.00 m tile mirrored 5 times to 27 m"


def test_the_rise_of_a_repeated_tile_is_removed_and_noted(tmp_path):
    z = 1e-3 * np.arange(61.0)[:, None] * np.ones(5)
    road = Measured(path=crg_path(tmp_path, z), repeat="repeat", length=18.0)
    np.testing.assert_allclose(road.realise(rng()).z, 0.0, atol=1e-12)
    assert "6.00 m tile repeated 3 times to 18 m, its rise of 60.0 and 60.0 mm removed" in (
        road.realise(rng()).notes
    )


def test_a_short_surface_is_rejected(tmp_path):
    path = crg_path(tmp_path, wavy(nu=21))
    with pytest.raises(SurfaceFileError, match=r"2\.00 m long, shorter than min_length = 2\.794 m"):
        Measured(path=path)
    assert Measured(path=path, min_length=1.5).length == pytest.approx(2.0)
    with pytest.raises(SurfaceFileError, match="set repeat to mirror or repeat"):
        Measured(path=path, min_length=1.5, length=50.0)


def test_a_long_surface_is_truncated(tmp_path):
    road = with_length(Measured(path=crg_path(tmp_path, wavy())), 7.0)
    assert road.realise(rng()).length == pytest.approx(7.0)


def test_a_path_in_a_yaml_file_is_relative_to_it(tmp_path):
    crg_path(tmp_path, wavy())
    settings = (
        "kind: fixed_seed\nseed: 0\nroad: {kind: measured, path: surface.crg, length: 15.0}\n"
    )
    (tmp_path / "road.yaml").write_text(settings)
    assert load_road(tmp_path / "road.yaml").length == 15.0


@pytest.mark.parametrize("inner", ["road.yaml", "{name: road.yaml, length: 9.0}"])
def test_a_road_in_a_yaml_file_is_looked_for_beside_it(tmp_path, monkeypatch, inner):
    for folder, road in (("there", "C"), ("here", "A")):
        (tmp_path / folder).mkdir()
        text = f"kind: iso8608\nroad_class: {road}\nlength: 9.0\n"
        (tmp_path / folder / "road.yaml").write_text(text)
    monkeypatch.chdir(tmp_path / "here")
    (tmp_path / "there" / "outer.yaml").write_text(f"kind: scaled\nroad: {inner}\n")
    (tmp_path / "there" / "named.yaml").write_text("name: road.yaml\n")
    assert load_road("../there/outer.yaml").road == load_road("../there/road.yaml")
    assert load_road("../there/named.yaml") == load_road("../there/road.yaml")


def test_the_name_of_a_surface_is_no_path(tmp_path):
    (tmp_path / "holes.yaml").write_text("kind: defects\nname: street.csv\ndefects: []\n")
    assert load_road(tmp_path / "holes.yaml").name == "street.csv"


# tables


def test_an_exported_surface_can_be_read_again(tmp_path):
    surface = load_road("belgian").realise(rng())
    write_csv(surface, tmp_path / "belgian.csv")
    again = load_road(tmp_path / "belgian.csv").realise(rng())
    np.testing.assert_allclose(again.z, surface.z, atol=2e-9)
    assert again.ds == pytest.approx(surface.ds)
    assert [f.name for f in tmp_path.iterdir()] == ["belgian.csv"]


def test_a_failed_export_leaves_the_old_file(tmp_path, monkeypatch):
    def full(source, target):
        assert Path(source).read_text().endswith("8.000000000,0.000000000,0.000000000\n")
        raise OSError("no space left")

    path = tmp_path / "road.csv"
    path.write_text("precious")
    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match="no space"):
        write_csv(Surface(np.zeros((2, 9)), 1.0), path)
    assert path.read_text() == "precious"
    assert [f.name for f in tmp_path.iterdir()] == ["road.csv"]


@pytest.mark.parametrize("separator", [",", ";", "\t", "   ", ", "])
def test_tables_may_use_various_separators_and_headers(tmp_path, separator):
    rows = [["distance", "left", "right"], *[[str(k), f"{k / 9}", f"{k / 7}"] for k in range(9)]]
    path = tmp_path / "table.csv"
    path.write_text("# remark\n\n" + "\n".join(separator.join(row) for row in rows))
    left, right = load_road(path).realise(rng()).z
    np.testing.assert_allclose(left * 9, right * 7, atol=1e-12)
    path.write_text("\n".join([separator.join(["s", "right", "left"]), *[
        separator.join(row) for row in rows[1:]]]))  # fmt: skip
    np.testing.assert_array_equal(load_road(path).realise(rng()).z, [right, left])


def test_uneven_stations_are_resampled_and_noted(tmp_path):
    s = np.sort(np.r_[np.arange(0.0, 20.0, 0.1), np.arange(0.03, 20.0, 1.7)])
    path = tmp_path / "uneven.txt"
    np.savetxt(path, np.column_stack([s, 0.01 * s]))
    surface = load_road(path).realise(rng())
    np.testing.assert_allclose(surface.z[0], 0.01 * surface.s, atol=1e-12)
    assert "resampled to 0.1 m" in surface.notes


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "empty"),
        ("distance,left,right", "empty"),
        ("0 1\n1 2\n1 3\n2 4", "does not increase at row 3"),
        ("0 1\n1 2\nnan 3\n3 4", "distances must be below 1e+07 m, got nan m"),
        ("0 1\n1 2\n2 3\n1e308 4", "got 1e+308 m"),
        ("0 1 2 3\n" * 5, "4 columns"),
        ("0 1\n1 2 3\n2 3", "not a table of numbers"),
        ("0 1\n1 x\n2 3", "not a table of numbers"),
        ("0 1", "at least 4"),
        ("0 1\n1 2\n2 3", "at least 4"),
        ("0 1\n1 nan\n2 3\n3 4\n4 5", "1 of 5 heights of the left wheel path are missing"),
        ("0 1\n1 1e9\n2 3\n3 4\n4 5", "a height of 1e+09 m"),
        ("0 1\n1 2\n2 3\n3 4\n1e6 5", "too uneven"),
    ],
)
def test_an_invalid_table_is_rejected_with_the_reason(tmp_path, text, reason):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=re.escape(reason)) as error:
        load_road(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("name", ["gone.crg", "folder.csv", "picture.png"])
def test_an_unreadable_file_is_named(tmp_path, name):
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(ConfigError, match=name):
        Measured(path=str(tmp_path / name))
