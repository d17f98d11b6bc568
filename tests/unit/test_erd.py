"""ERD files: read in any unit and byte order, or rejected with the reason."""

import re
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracles_roads import erd_file

from road_envs.core.config import ConfigError
from road_envs.roads import load_road
from road_envs.roads.formats.erd import _parse
from road_envs.roads.formats.opencrg import SurfaceFileError
from road_envs.roads.measured import Measured

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048, "in": 0.0254, "mils": 2.54e-5}


def rng():
    return np.random.default_rng(0)


def wavy(channels=2, size=40):
    return np.random.default_rng(5).standard_normal((channels, size)).cumsum(axis=1)


def read(header, body):
    return _parse(header + body, lambda: body)


def read_floats(header, body):
    return _parse(header, lambda: body)


# the format


@given(
    arrays(float, st.tuples(st.just(2), st.integers(1, 30)), elements=st.floats(-9.0, 9.0)),
    st.sampled_from(sorted(METRES)), st.sampled_from(sorted(METRES)), st.floats(0.01, 10.0),
    st.sampled_from(["\n", "\r\n", "\r"]),
)  # fmt: skip
def test_heights_and_step_are_converted_to_metres(z, unit, x_unit, step, eol):
    actual, ds, notes, start = read(*erd_file(z, unit=unit, x_unit=x_unit, step=step, eol=eol))
    np.testing.assert_allclose(actual, z * METRES[unit], rtol=1e-7, atol=1e-7 * METRES[unit])
    assert ds == pytest.approx(step * METRES[x_unit]) and (notes, start) == ((), 0.0)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("offset", [0.0, 583.0, 1e-6])
def test_the_byte_order_of_binary_numbers_is_detected(order, offset):
    z = wavy() + offset
    actual, *_ = read_floats(*erd_file(z, order))
    np.testing.assert_allclose(actual, z * 1e-3, rtol=1e-6)
    level, *_ = read_floats(*erd_file(0.0 * z, order))
    assert not level.any()


def test_wheel_paths_are_found_by_channel_name():
    z = wavy(5)
    names = ("Speed", "RElev.", "CElev.", "LElev.", "Temp.")
    units = ("km/h", "in", "mm", "ft", "deg C")
    actual, *_ = read(*erd_file(z, names=names, unit=units))
    np.testing.assert_allclose(actual, [z[3] * 0.3048, z[1] * 0.0254], rtol=1e-6)


@pytest.mark.parametrize(
    "extra",
    ["LONGNAME" + "Left elevation".ljust(32) + "Right elevation",
     "LONGNAME" + "Elevation, left wheel path".ljust(32) + "Elevation, right wheel path"],
)  # fmt: skip
def test_wheel_paths_may_have_long_names_only(extra):
    actual, *_ = read(*erd_file(wavy(), names=(), extra=(extra,)))
    np.testing.assert_allclose(actual, 1e-3 * wavy(), rtol=1e-6)


def test_a_single_channel_is_used_for_both_paths():
    actual, *_ = read(*erd_file(wavy(1), names=("Elev.",)))
    np.testing.assert_array_equal(actual[0], actual[1])


@pytest.mark.parametrize("samples", [-1, 0])
def test_samples_are_counted_if_the_header_states_no_number(samples):
    actual, *_ = read(*erd_file(wavy(), samples=samples))
    assert actual.shape == (2, 40)


def test_lines_may_have_any_number_of_values():
    header, body = erd_file(wavy())
    words = body.decode().split()
    rows = [", ".join(words[k : k + 7]) for k in range(0, len(words), 7)]
    actual, *_ = read(header, "\n".join(rows).encode())
    np.testing.assert_allclose(actual, 1e-3 * wavy(), rtol=1e-6)


def test_a_file_of_the_ltpp_programme_can_be_read():
    text = (
        "ERDFILEV2.00\n"
        "      3,      5,     -1,      1,      5,       0.0250,     -1,\n"
        "TITLE   LTPP SPS Section: Run 1\n"
        "SHORTNAMLElev.  RElev.  CElev.\n"
        "UNITSNAMmm      mm      mm\n"
        "XLABEL  Distance\nXUNITS  m\nDATE    11/Apr/1997\n\nEND\n"
        " 0.0 0.0 0.0\n 1.0 2.0 3.0\n 2.0 4.0 6.0\n 3.0 6.0 9.0\n 4.0 8.0 12.0\n"
    )
    z, ds, *_ = read(text.encode(), b"")
    np.testing.assert_allclose(z, [1e-3 * np.arange(5.0), 2e-3 * np.arange(5.0)])
    assert ds == 0.025


# as roads


@pytest.mark.parametrize("form", ["text", "<", ">"])
def test_an_erd_file_can_be_loaded_as_a_road(tmp_path, form):
    z = wavy(size=300)
    header, body = erd_file(z, form)
    if form == "text":
        (tmp_path / "section.erd").write_bytes(header + body)
    else:
        (tmp_path / "section.erd").write_bytes(header)
        (tmp_path / "section.bin").write_bytes(body)
    surface = load_road(tmp_path / "section.erd").realise(rng())
    np.testing.assert_allclose(surface.z, 1e-3 * (z - z[:, :1]), atol=1e-8)
    assert (surface.ds, surface.length) == (0.025, pytest.approx(299 * 0.025))


def test_a_missing_binary_file_is_named(tmp_path):
    (tmp_path / "section.erd").write_bytes(erd_file(wavy(), "<")[0])
    with pytest.raises(ConfigError, match=r"section\.bin, which is missing"):
        load_road(tmp_path / "section.erd")


def test_missing_heights_are_rejected_or_interpolated(tmp_path):
    z = wavy(size=300)
    z[0, 7:9] = np.nan
    path = tmp_path / "section.erd"
    path.write_bytes(b"".join(erd_file(z)))
    with pytest.raises(SurfaceFileError, match="2 of 300 heights of the left wheel path"):
        load_road(path)
    assert (
        "interpolated 2 missing"
        in Measured(path=str(path), bridge_gaps=True).realise(rng()).notes[0]
    )


# damage


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"ERDFILE", b"PROFILE", "not an ERD file"),
        (b"\nEND\n", b"\nDONE\n", "the line END of the header is missing"),
        (
            b"SHORTNAM",
            b"GENNAME ",
            "0 channels match the left wheel path, expected 1 among:  [mm],  [mm]",
        ),
        (
            b"RElev.",
            b"LElev.",
            "2 channels match the left wheel path, expected 1 among: LElev. [mm]",
        ),
        (b"RElev.", b"CElev.", "0 channels match the right wheel path"),
        (
            b"UNITSNAMmm ",
            b"UNITSNAMV  ",
            "0 channels match the left wheel path, expected 1 among: LElev. [V]",
        ),
        (
            b"UNITSNAM",
            b"NOTHING ",
            "0 channels match the left wheel path, expected 1 among: LElev. []",
        ),
        (b"XUNITS  m", b"XUNITS  s", "the step: the distance unit 's' is unknown"),
        (b"XUNITS", b"YUNITS", "the step: the distance unit '' is unknown; known: m, km"),
        (b"0.025", b"-0.02", "the step must be positive and below 1e+07 m, got -0.02 m"),
        (b"0.025", b" nan ", "is not a number"),
        (b"0.025", b"1e999", "is not a number"),
        (b"      5,", b"      0,", "unknown number type 0; known: 1 (4-byte float) and 5 (text)"),
        (b"      2,", b"      3,", "80 numbers, but the header states 40 samples of 3 channels"),
        (b"      2,", b"      0,", "damaged: 0 channels"),
        (b"      2,", b"9999999,", "damaged: 9999999 channels"),
        (b"      2,", b"    2.5,", "'2.5' in its second line is not an integer"),
        (b"     40,", b"     41,", "80 numbers, but the header states 41 samples"),
        (b",       0.025,  -1,", b"", "its second line has 5 numbers instead of 6"),
        (b"     40,", b"100e100,", "'100e100' in its second line is not an integer"),
    ],
)
def test_an_inconsistent_header_is_rejected_with_the_reason(old, new, reason):
    header, body = erd_file(wavy())
    assert header.count(old) >= 1
    with pytest.raises(SurfaceFileError, match=re.escape(reason)):
        read(header.replace(old, new, 1), body)


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (b"", "damaged: 0 numbers"),
        (b"1.0 2.0 3.0", "damaged: 3 numbers"),
        (b"1.0 two", "not a table of numbers"),
        (b"1.0 1.0D-3", "not a table of numbers"),
        (b"1.0 1_0", "not a table of numbers"),
        (b"1.0 # 2.0", "not a table of numbers"),
        (b"1.0 1e99", r"a height of 1e+96 m"),
        (b"1.0 \xff\x00", "not a table of numbers"),
    ],
)
def test_invalid_numbers_are_rejected(body, reason):
    header, _ = erd_file(wavy(), samples=-1)
    with pytest.raises(SurfaceFileError, match=re.escape(reason)):
        read(header, body)


@pytest.mark.parametrize("cut", [1, 2, 3, 4, 8, 160, 319])
@pytest.mark.parametrize("order", ["<", ">"])
def test_a_truncated_binary_file_is_rejected(cut, order):
    header, body = erd_file(wavy(), order)
    with pytest.raises(SurfaceFileError, match="damaged"):
        read_floats(header, body[:-cut])


def test_implausible_binary_numbers_are_rejected():
    header, _ = erd_file(wavy(), "<", samples=-1)
    integers = (1e3 * abs(wavy())).astype("<i4").tobytes()
    for body in (bytes(range(1, 9)) * 100, integers, b"\xfe" * 8):
        with pytest.raises(SurfaceFileError, match="implausible in either byte order"):
            read_floats(header, body)


def test_a_header_that_states_gigabytes_allocates_no_memory():
    header, body = erd_file(wavy(), samples=10**9)
    tracemalloc.start()
    with pytest.raises(SurfaceFileError, match="states 1000000000 samples"):
        read(header, body)
    assert tracemalloc.get_traced_memory()[1] < 40 * len(header + body)
    tracemalloc.stop()
