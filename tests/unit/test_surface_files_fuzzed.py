"""Fuzz tests of the surface file readers: a result or an error, in bounded time and memory."""

import re
import time
import tracemalloc

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from oracles_roads import crg_file, erd_file

from examples import examples
from road_envs.roads.formats import erd, opencrg
from road_envs.roads.formats import table as tables
from road_envs.roads.formats.opencrg import SurfaceFileError
from road_envs.roads.measured import SURFACE_SUFFIXES, Measured
from road_envs.roads.surface import Surface

Z = 0.01 * np.random.default_rng(1).standard_normal((2, 24)).cumsum(axis=1)
S = 0.25 * np.arange(24)


def parquet(compression):
    sink = pa.BufferOutputStream()
    table = pa.table({"distance": S, "left": Z[0], "right": Z[1]})
    pq.write_table(table, sink, compression=compression, use_dictionary=False)
    return sink.getvalue().to_pybytes()


def text(separator):
    rows = [separator.join(f"{x:.4f}" for x in row) for row in (S, *Z)]
    columns = zip(*(row.split(separator) for row in rows), strict=True)
    return ("distance left right\n" + "\n".join(map(separator.join, columns))).encode()


def read_erd(data):
    return erd._parse(data, lambda: data.partition(b"\nEND")[2])


def read_floats(data):
    return erd._parse(erd_file(Z, "<")[0], lambda: data)


READERS = {
    "crg": (opencrg.parse, [crg_file(Z.T, form) for form in opencrg.WIDTHS]),
    "erd": (read_erd, [b"".join(erd_file(Z)), b"".join(erd_file(Z, samples=-1))]),
    "erd numbers": (read_floats, [erd_file(Z, order)[1] for order in "<>"]),
    "parquet": (tables.parse_parquet, [parquet(c) for c in ("none", "snappy", "zstd", "gzip")]),
    "text": (tables.parse_text, [text(","), text(" "), text(";")]),
}


def answer(read, data):
    """Return the reader's result for `data`, or None; time and memory scale with its size."""
    tracemalloc.start()
    began, before = time.process_time(), pa.default_memory_pool().bytes_allocated()
    try:
        actual = read(data)
    except SurfaceFileError as error:
        assert str(error) and "\n" not in str(error)
        actual = None
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 300_000 + 64 * len(data)
    assert time.process_time() - began < 1.0 + 1e-5 * len(data)
    assert pa.default_memory_pool().bytes_allocated() <= before + len(data)
    return actual


def warmed(reader):
    read, samples = READERS[reader]
    for data in samples:
        read(data)  # imports happen here, outside the measurement
    return read, samples


@pytest.mark.parametrize("reader", READERS)
@examples(20)
@given(st.binary(max_size=600))
def test_arbitrary_bytes_are_rejected(reader, data):
    read, _ = warmed(reader)
    assert reader.endswith("numbers") or answer(read, b"\xfe" + data) is None


@pytest.mark.parametrize("reader", READERS)
@examples(50)
@given(st.data())
def test_a_corrupted_file_is_read_or_rejected(reader, data):
    read, samples = warmed(reader)
    content = bytearray(data.draw(st.sampled_from(samples)))
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(content) - 1))
        if data.draw(st.booleans()):
            content[at] = data.draw(st.integers(0, 255))
        else:
            content[at : at + data.draw(st.integers(0, 5))] = data.draw(st.binary(max_size=6))
    actual = answer(read, bytes(content))
    if actual is not None and reader != "crg":
        z, ds = actual.z, actual.ds
        assert z.ndim == 2 and z.shape[0] == 2 and z.size <= 8 * len(content)
        assert 0.0 < ds < 1e7


@pytest.mark.parametrize("reader", READERS)
@examples(20)
@given(st.data())
def test_corrupted_numbers_are_read_or_rejected(reader, data):
    read, samples = warmed(reader)
    content = data.draw(st.sampled_from(samples))
    actual = [m.span() for m in re.finditer(rb"[0-9][-+0-9.eE]*", content)]
    start, end = data.draw(st.sampled_from(actual or [(0, 1)]))
    huge = [b"9" * 400, b"-1", b"0", b"1e308", b"-1e-320", b"nan", b"inf", b"9" * 18, b"4294967296"]
    answer(read, content[:start] + data.draw(st.sampled_from(huge)) + content[end:])


@pytest.mark.parametrize("reader", READERS)
def test_a_truncated_file_is_read_or_rejected(reader):
    read, samples = warmed(reader)
    for content in samples:
        for end in range(0, len(content), 1 + len(content) // 120):
            answer(read, content[:end])


@pytest.mark.parametrize(
    ("reader", "data"),
    [
        ("text", b"1 2\n" * 50_000),
        ("text", b"1" * 200_000),
        ("text", b"0 1\n1 2\n" + b"2" * 100_000 + b" 3\n" + b"\n" * 50_000),
        ("text", b"," * 200_000),
        ("text", b"#\n" * 100_000),
        ("text", b"0 1\n1e-9 1\n" + b"\n".join(b"%d 1" % k for k in range(1, 20_000))),
        ("text", b"0 " + b"1 " * 100_000),
        ("erd", b"".join(erd_file(Z)) + b"9" * 200_000),
        ("erd", b"".join(erd_file(Z)) + b" 1" * 100_000),
        ("erd", b"ERDFILEV2.00\n" + b"END " * 50_000),
        ("erd", b"ERDFILEV2.00\n" + b"1," * 100_000 + b"\nEND\n"),
        ("erd", b"ERDFILEV2.00\n" + b" " * 200_000 + b"\nEND"),
        ("erd", b"ERDFILEV2.00\n" + b"\n".join(b"KEY%05d" % k for k in range(20_000)) + b"\nEND\n"),
        ("crg", b"$CT\n" + b"$\n" * 100_000),
        ("crg", b"$ROAD_CRG\n" + b"a=1\n" * 50_000),
        ("crg", b"$KD_DEFINITION\n" + b"D:long section 1,m\n" * 10_000 + b"$\n$ROAD_CRG\n$$$\n"),
    ],
    ids=lambda x: x if isinstance(x, str) else x[:12].decode(),
)
@pytest.mark.costly
def test_time_and_memory_scale_with_the_size_of_repetitive_files(reader, data):
    answer(warmed(reader)[0], data)


def test_a_decompression_bomb_is_rejected_before_decompression():
    table = pa.table({name: np.zeros(2_000_000) for name in ("distance", "left", "right")})
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    data = sink.getvalue().to_pybytes()
    assert 8 * table.num_rows > 100 * len(data)
    assert answer(tables.parse_parquet, data) is None


@pytest.mark.parametrize("suffix", SURFACE_SUFFIXES)
@examples(20)
@example(b"")
@given(st.binary(max_size=200))
def test_an_invalid_file_is_rejected_with_its_path(tmp_path_factory, suffix, data):
    path = tmp_path_factory.getbasetemp() / f"fuzzed{suffix}"
    path.write_bytes(data)
    try:
        surface = Measured(path=str(path)).realise(np.random.default_rng(0))
    except SurfaceFileError as error:
        assert str(error).startswith(str(path))
    else:
        assert isinstance(surface, Surface)
