"""OpenCRG files: intact ones are read, damaged ones rejected with the reason."""

import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracles_roads import crg_file

from examples import examples
from road_envs.roads.formats.opencrg import SurfaceFileError, parse
from road_envs.roads.formats.table import parse_text

MEASURED = Path(__file__).parents[3] / "shared" / "roads"
needs_files = pytest.mark.skipif(not MEASURED.is_dir(), reason="needs ../shared/roads")
FORMS = ("LRFI", "LDFI", "KRBI", "KDBI")
PRECISION = {"LRFI": 1e-6, "LDFI": 1e-11, "KRBI": 1e-6, "KDBI": 0.0}

grids = arrays(
    float,
    st.tuples(st.integers(2, 12), st.integers(2, 23)),
    elements=st.one_of(st.floats(-9.0, 9.0), st.just(np.nan)),
).filter(lambda z: not np.isnan(z[-1]).all())


def wavy(nu=201, nv=7, seed=3):
    z = np.random.default_rng(seed).standard_normal((nu, nv)) * 0.01
    return z.cumsum(axis=0)


# the format


@examples(30)
@given(grids, st.sampled_from(FORMS), st.sampled_from(["\n", "\r\n"]))
def test_every_data_format_returns_the_written_grid(z, form, eol):
    grid = parse(crg_file(z, form, du=0.1, dv=0.5, eol=eol))
    np.testing.assert_allclose(grid.z, z, atol=PRECISION[form])
    np.testing.assert_allclose(grid.v, 0.5 * (np.arange(z.shape[1]) - 0.5 * (z.shape[1] - 1)))
    assert (grid.du, grid.u_start) == (0.1, 0.0)


@pytest.mark.parametrize("form", FORMS)
def test_sections_with_explicit_v_are_sorted_from_right_to_left(form):
    z, places = wavy(nv=4), [1.0, -1.5, 0.25, -0.75]
    grid = parse(crg_file(z, form, places=places))
    np.testing.assert_array_equal(grid.v, [-1.5, -0.75, 0.25, 1.0])
    np.testing.assert_allclose(grid.z, z[:, [1, 3, 2, 0]], atol=PRECISION[form])


def test_case_spacing_and_comments_of_keys_are_ignored():
    data = crg_file(wavy(), "KDBI", start=730.0)
    text, _, payload = data.partition(b"$" * 72 + b"\n")
    for change in (bytes.upper, bytes.lower, bytes.swapcase):
        header = change(text).replace(b" = ", b"=").replace(b"#:kdbi", b"#:KDBI")
        grid = parse(header + b"$" * 72 + b"\n" + payload)
        np.testing.assert_array_equal(grid.z, wavy())
        assert grid.u_start == 730.0


def test_header_text_beyond_column_72_is_ignored():
    data = crg_file(wavy(), "KDBI")
    for line in (
        b"reference_line_increment = 0.1  ! step",
        b"D:long section 3,m  ! from right to left",
    ):
        assert line in data
        data = data.replace(line, line.split(b"!")[0].ljust(72) + b"rubbish, $ and = 3")
    np.testing.assert_array_equal(parse(data).z, wavy())


@pytest.mark.parametrize("form", FORMS)
def test_rows_are_counted_if_the_header_states_no_number(form):
    data = crg_file(wavy(nu=23), form)
    data = re.sub(rb"reference_line_end_u.*\n", b"", data)
    np.testing.assert_allclose(parse(data).z, wavy(nu=23), atol=PRECISION[form])


def test_modifiers_scale_the_grid():
    mods = ["$ROAD_CRG_MODS", "SCALE_Z_GRID = 0.5", "scale_length=2.0", "scale_width = 3.0", "$"]
    grid = parse(crg_file(wavy(), "KDBI", extra=mods))
    np.testing.assert_array_equal(grid.z, 0.5 * wavy())
    assert grid.du == 0.2
    assert grid.v[-1] == pytest.approx(3.0 * 1.5)


def test_the_reference_line_is_ignored_with_a_note():
    z = wavy(nv=5)
    data = crg_file(z, "KDBI").replace(b"D:long section 1,m", b"D:reference line slope,m/m", 1)
    for k in range(2, 6):
        data = data.replace(b"long section %d" % k, b"long section %d" % (k - 1))
    data = data.replace(b"_v_left = 1.0", b"_v_left = 0.5")
    grid = parse(data)
    np.testing.assert_array_equal(grid.z, z[:, 1:])
    assert grid.notes == ("slope of the reference line ignored",)


# damage


@pytest.mark.parametrize("form", ["KRBI", "KDBI"])
def test_a_binary_file_transferred_as_text_is_rejected(form):
    data = crg_file(np.tile(wavy(), (4, 1)), form)
    text, mark, payload = data.partition(b"$" * 72 + b"\n")
    assert b"\r\n" not in payload
    damaged = payload[:400] + b"\r\n" + payload[402:]
    assert parse(text + mark + damaged).z.shape == (804, 7)
    with pytest.raises(SurfaceFileError, match="transferred as text"):
        parse(text + mark + damaged.replace(b"\r\n", b"\n"))


@examples(30)
@given(st.sampled_from(FORMS), st.floats(0.0, 0.999))
def test_a_truncated_file_is_rejected(form, share):
    data = crg_file(wavy(nu=40, nv=9), form)
    cut = data[: int(share * (len(data) - 80))]
    with pytest.raises(SurfaceFileError):
        parse(cut)


@pytest.mark.parametrize("form", FORMS)
def test_a_file_with_extra_rows_is_rejected(form):
    more = crg_file(wavy(nu=60), form).partition(b"$" * 72 + b"\n")[2]
    header = b"".join(crg_file(wavy(nu=40), form).partition(b"$" * 72 + b"\n")[:2])
    with pytest.raises(SurfaceFileError, match="damaged"):
        parse(header + more)


@pytest.mark.parametrize("form", FORMS)
def test_a_header_that_states_gigabytes_allocates_no_memory(form):
    data = re.sub(rb"(reference_line_end_u) = .*\n", rb"\1 = 1e9\n", crg_file(wavy(), form))
    tracemalloc.start()
    with pytest.raises(SurfaceFileError, match="damaged"):
        parse(data)
    assert tracemalloc.get_traced_memory()[1] < 20 * len(data)
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"$KD_Definition", b"$KD_Nothing", "no $KD_DEFINITION"),
        (b"#:KDBI", b"#:KXBI", "unknown data format 'KXBI'"),
        (b"section 2", b"section 9", "not numbered 1 to 7"),
        (b"section 2,m", b"section 2,mm", "in 'mm'"),
        (b"section 2", b"section at v = 0.1", "neither all numbered"),
        (b"increment = 0.1 ", b"increment = 0 ", "reference_line_increment must be positive"),
        (b"increment = 0.1 ", b"increment = 0.3 ", "whole number of steps"),
        (b"increment = 0.1 ", b"increment = ten", "'ten' is not a number"),
        (b"increment = 0.1 ", b"increment = inf", "is not a number"),
        (b"_v_increment = 0.5", b"_v_increment = 0.4", "do not end at 1.5 m"),
        (b"_v_increment = 0.5", b"_v_increment = -0.5", "must be positive"),
        (b"* a comment", b"long_section_v_left = 1.5", "appears twice"),
        (b"$CT", b"$ROAD_CRG", "appears twice"),
        (b"$CT", b"$ROAD_CRG_FILE", "refers to another file"),
        (b"$KD_Def", b"$ROAD_CRG_MODS\nscale_width = 1e308\n$\n$KD_Def", "scale_width must be"),
        (b"$" * 72, b"", "header is missing"),
        (b"D:long", b"E:long", "defines no channel"),
        (b"D:long", b"D:short", "at least 2 long sections"),
    ],
)
def test_an_inconsistent_header_is_rejected_with_the_reason(old, new, reason):
    data = crg_file(wavy(), "KDBI")
    assert old in data
    with pytest.raises(SurfaceFileError, match=re.escape(reason)):
        parse(data.replace(old, new))


def test_implausible_heights_are_rejected():
    z = wavy()
    z[5, 2] = 1e38
    with pytest.raises(SurfaceFileError, match=r"a height of 1e\+38 m"):
        parse(crg_file(z, "KRBI"))


@pytest.mark.parametrize(
    "field", [b"          ", b"  0.1 0.2 ", b"   abc    ", b"  \xff\xfe  0.1 "]
)
def test_a_non_numeric_text_field_is_rejected(field):
    data = crg_file(np.full((9, 7), 0.123456), "LRFI")
    with pytest.raises(SurfaceFileError, match="damaged"):
        parse(data[:-200] + data[-200:].replace(b"  0.123456", field, 1))


@examples(50)
@given(st.binary(max_size=400))
def test_arbitrary_bytes_are_rejected(data):
    with pytest.raises(SurfaceFileError):
        parse(data)
    with pytest.raises(SurfaceFileError):
        parse_text(b"1 2 3 4\n" + data)


@examples(60)
@given(st.sampled_from(FORMS), st.data())
def test_a_corrupted_file_is_read_or_rejected(form, data):
    content = bytearray(crg_file(wavy(nu=6, nv=3), form))
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(0, 5))] = data.draw(st.binary(max_size=6))
    try:
        grid = parse(bytes(content))
    except SurfaceFileError as error:
        assert str(error)
    else:
        assert grid.z.shape[1] == grid.v.size
        assert grid.z.size <= len(content)
        assert (np.diff(grid.v) > 0).all()


# sample files


@needs_files
def test_the_measured_cobbles_match_their_description():
    grid = parse((MEASURED / "opencrg" / "belgian_block.crg").read_bytes())
    assert grid.z.shape == (1001, 341)
    assert (grid.u_start, grid.du) == (730.0, 0.01)
    assert grid.v[[0, -1]] == pytest.approx([-1.7, 1.7])
    whole = grid.v[~np.isnan(grid.z).any(axis=0)]
    assert whole.size == 308
    assert whole[[0, -1]] == pytest.approx([-1.37, 1.70])
    assert np.isnan(grid.z).mean() == pytest.approx(0.065, abs=5e-4)


@needs_files
def test_the_handmade_sample_files_are_read_exactly():
    straight = parse((MEASURED / "opencrg" / "handmade_straight.crg").read_bytes())
    assert straight.z.shape == (23, 7)
    np.testing.assert_array_equal(np.argwhere(np.isnan(straight.z)), [[7, 0], [7, 6], [8, 0]])
    assert straight.z[13, 6] == -0.0111111
    platform = parse((MEASURED / "opencrg" / "handmade_platform.crg").read_bytes())
    np.testing.assert_array_equal(platform.v, [-1.5, -1.25, -1.0, 0.0, 1.0, 1.25, 1.5])
    assert platform.z[1] == pytest.approx(1.5)
