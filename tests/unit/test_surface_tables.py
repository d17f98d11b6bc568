"""Writers of surface files, and Parquet tables as roads."""

import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from road_envs.core.config import ConfigError
from road_envs.roads import load_road
from road_envs.roads.formats.opencrg import SurfaceFileError, parse
from road_envs.roads.formats.table import parse_parquet, parse_text
from road_envs.roads.formats.write import WRITERS, write, write_crg
from road_envs.roads.measured import Measured
from road_envs.roads.surface import Surface

FORMS = {"LRFI": 0.6e-6, "LDFI": 1e-14, "KRBI": 1e-6, "KDBI": 0.0}
EXACT = np.finfo(float).tiny  # a sum may round the smallest of all numbers
PRECISION = {".csv": 1.1e-9, ".parquet": 0.0, ".crg": EXACT, ".erd": 1.1e-9}


def rng():
    return np.random.default_rng(0)


def wavy(size=60, name="wavy", notes=()):
    z = 0.01 * np.random.default_rng(3).standard_normal((2, size)).cumsum(axis=1)
    return Surface(z - z[:, :1], 0.1, name=name, notes=notes)


HEIGHTS = st.floats(-9.0, 9.0, allow_subnormal=False)
surfaces = st.builds(
    lambda z, ds: Surface(z - z[:, :1], ds),
    arrays(float, st.tuples(st.just(2), st.integers(40, 60)), elements=HEIGHTS),
    st.floats(0.1, 3.0),
)


# all formats


@pytest.mark.parametrize("suffix", WRITERS)
@settings(max_examples=25)
@given(surface=surfaces)
def test_a_written_surface_can_be_read_as_a_road(tmp_path_factory, suffix, surface):
    path = tmp_path_factory.getbasetemp() / f"surface{suffix}"
    write(surface, path)
    again = load_road(path).realise(rng())
    np.testing.assert_allclose(again.z, surface.z, rtol=0.0, atol=PRECISION[suffix])
    assert again.ds == pytest.approx(surface.ds, rel=1e-9)


@pytest.mark.parametrize("suffix", WRITERS)
def test_arbitrary_names_and_notes_do_not_corrupt_a_file(tmp_path, suffix):
    notes = (
        "$ROAD_CRG",
        "* x",
        "END",
        "# a note, with ü and " + "words " * 40,
        "two\nlines\rhere",
        "",
    )
    surface = wavy(name="ERDFILE\n$$ Straße", notes=notes)
    write(surface, tmp_path / f"named{suffix}")
    again = load_road(tmp_path / f"named{suffix}").realise(rng())
    np.testing.assert_allclose(again.z, surface.z, atol=1.1e-9)


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_surface_is_written_with_its_first_station(tmp_path, suffix):
    surface = Surface(wavy().z, 0.1, start=730.0)
    write(surface, tmp_path / f"late{suffix}")
    again = load_road(tmp_path / f"late{suffix}").realise(rng())
    np.testing.assert_allclose(again.z, surface.z, atol=1.1e-9)
    assert again.start == 0.0 and again.ds == pytest.approx(0.1)
    if suffix == ".crg":
        assert again.notes == ("station 0 is u = 730 m",)


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch, suffix):
    def full(source, target):
        raise OSError("no space left")

    path = tmp_path / f"road{suffix}"
    path.write_text("precious")
    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match="no space"):
        write(wavy(), path)
    assert path.read_text() == "precious"
    assert [f.name for f in tmp_path.iterdir()] == [path.name]


def test_an_unknown_file_format_raises_config_error(tmp_path):
    with pytest.raises(ConfigError, match=r"must end in \.csv or \.parquet or \.crg or \.erd"):
        write(wavy(), tmp_path / "road.xlsx")
    with pytest.raises(ConfigError, match="unknown data format 'TEXT'"):
        write_crg(wavy(), tmp_path / "road.crg", "TEXT")
    assert not list(tmp_path.iterdir())


# OpenCRG


@pytest.mark.parametrize(("form", "precision"), FORMS.items())
def test_wheel_paths_of_an_opencrg_file_are_laterally_level(tmp_path, form, precision):
    surface = wavy()
    write_crg(surface, tmp_path / "road.crg", form)
    for shift in (-0.3, 0.0, 0.3):
        road = Measured(path=str(tmp_path / "road.crg"), centre=shift)
        np.testing.assert_allclose(road.realise(rng()).z, surface.z, atol=precision)
    grid = parse((tmp_path / "road.crg").read_bytes())
    np.testing.assert_array_equal(grid.v, [-1.125, -0.375, 0.375, 1.125])
    assert grid.du == pytest.approx(0.1) and grid.z.shape == (60, 4)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("height", [0.0, 9.9999999, 99.5, 1234.5678])
def test_heights_of_any_magnitude_fit_their_fields(tmp_path, form, height):
    z = np.zeros((2, 40))
    z[0, 5], z[1, 9] = height, -height
    write_crg(Surface(z, 0.1), tmp_path / "high.crg", form)
    again = load_road(tmp_path / "high.crg").realise(rng()).z
    digits = {"LRFI": 6, "KRBI": 6.9}.get(form, 14)
    np.testing.assert_allclose(again, z, atol=10.0**-digits * max(1.0, height))


@pytest.mark.parametrize("form", FORMS)
def test_an_opencrg_header_is_ascii_up_to_column_72(tmp_path, form):
    write_crg(wavy(size=61, notes=("a long note " * 20,)), tmp_path / "road.crg", form)
    header, mark, payload = (tmp_path / "road.crg").read_bytes().partition(b"$" * 72 + b"\n")
    assert mark and header.isascii()
    assert max(map(len, header.split(b"\n"))) <= 72
    if form.startswith("K"):
        assert len(payload) % 80 == 0


# Parquet


def parquet(path, **columns):
    pq.write_table(pa.table(columns), path)
    return path


S = 0.1 * np.arange(60)
Z = wavy().z


@pytest.mark.parametrize(
    "columns",
    [
        {"distance": S, "left": Z[0], "right": Z[1]},
        {"right": Z[1], "Left ": Z[0], "note": ["x"] * 60, "DISTANCE": S + 7.0},
        {"distance": S.astype("f4"), "left": Z[0].astype("f4"), "right": Z[1].astype("f4")},
    ],
)
def test_parquet_columns_are_found_by_name(tmp_path, columns):
    surface = load_road(parquet(tmp_path / "t.parquet", **columns)).realise(rng())
    np.testing.assert_allclose(surface.z, Z, atol=1e-7)


def test_one_height_column_is_used_for_both_paths(tmp_path):
    path = parquet(tmp_path / "t.parquet", distance=np.arange(9), height=np.arange(9) % 3)
    surface = load_road(path).realise(rng())
    np.testing.assert_array_equal(surface.z, [np.arange(9) % 3] * 2)
    assert "left and right wheel path are the same" in surface.notes


@pytest.mark.parametrize(
    ("header", "lengths"),
    [
        ("distance_ft,left_in,right_in", (0.3048, 0.0254)),
        ("distance miles,left [mm],right_mm", (1609.344, 1e-3)),
        ("distance_m,height_mil", (1.0, 25.4e-6)),
        ("distance,left,right", (1.0, 1.0)),
    ],
)
def test_a_column_of_a_road_may_end_in_its_unit(header, lengths):
    columns = [S / lengths[0], *(Z[: header.count(",")] / lengths[1])]
    rows = [",".join(f"{x:.9g}" for x in row) for row in np.transpose(columns)]
    found = parse_text("\n".join([header, *rows]).encode())
    np.testing.assert_allclose([found.ds, *found.z[0]], [S[1], *Z[0]], rtol=1e-6, atol=1e-9)


def test_an_inner_and_an_outer_wheel_path_are_not_in_inches():
    with pytest.raises(SurfaceFileError, match="path_in and path_out have different units"):
        parse_text(b"distance,path_in,path_out\n0,1,1\n1,1,1\n2,1,1\n3,1,1\n")


def test_nulls_are_missing_heights(tmp_path):
    left = [None if k in (3, 4) else float(z) for k, z in enumerate(Z[0])]
    path = parquet(tmp_path / "t.parquet", distance=S, left=left, right=Z[1])
    with pytest.raises(SurfaceFileError, match="2 of 60 heights of the left wheel path"):
        load_road(path)
    bridged = Measured(path=str(path), bridge_gaps=True).realise(rng()).z[0, 2:6]
    np.testing.assert_allclose(bridged, np.linspace(Z[0, 2], Z[0, 5], 4))


@pytest.mark.parametrize(
    ("columns", "reason"),
    [
        ({"s": S, "left": Z[0], "right": Z[1]}, "got s, left, right"),
        ({"distance": S, "left": Z[0]}, "got distance, left"),
        ({"distance": S, "left": Z[0], "LEFT": Z[0], "right": Z[1]}, "got distance, left, LEFT"),
        ({"distance": S, "height": ["x"] * 60}, "damaged, or no Parquet file"),
        ({"distance": S, "height": [[1.0]] * 60}, "damaged, or no Parquet file"),
        ({"distance": S[::-1], "height": Z[0]}, "does not increase at row 2"),
        ({"distance": S, "height": 1e9 * Z[0]}, "a height of"),
        ({"distance": [None, *S[1:]], "height": Z[0]}, "got nan m"),
        ({"distance": [0.0] * 0, "height": [0.0] * 0}, "damaged: 0 rows"),
        ({"distance": [0.0], "height": [0.0]}, "at least 4 stations"),
        ({"distance": [0.0] * 500_000, "height": [0.0] * 500_000}, "damaged: 500000 rows in"),
    ],
)
def test_a_parquet_table_without_a_profile_is_rejected(tmp_path, columns, reason):
    with pytest.raises(SurfaceFileError, match=re.escape(reason)) as error:
        load_road(parquet(tmp_path / "t.parquet", **columns))
    assert "\n" not in str(error.value)


def test_a_drive_record_is_rejected_as_a_road(tmp_path):
    path = parquet(tmp_path / "t.parquet", t=S, a_rf=S, v=S, s=S)
    with pytest.raises(SurfaceFileError, match="got t, a_rf, v, s"):
        load_road(path)


def test_a_well_compressed_level_road_can_be_read(tmp_path):
    surface = Surface(np.zeros((2, 200_001)), 0.005)
    write(surface, tmp_path / "level.parquet")
    assert load_road(tmp_path / "level.parquet").length == pytest.approx(1000.0)


def test_changed_bytes_of_the_numbers_are_detected(tmp_path):
    write(wavy(), tmp_path / "t.parquet")
    data = (tmp_path / "t.parquet").read_bytes()
    for at in range(4, len(data) - 8, 7):
        changed = data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :]
        try:
            z = parse_parquet(changed).z
        except SurfaceFileError:
            continue
        np.testing.assert_array_equal(z, wavy().z)
