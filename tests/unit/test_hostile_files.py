"""Every reader answers damaged and hostile files with its own sentence, which names the file."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hostile_files import (
    BOMB,
    DRIVE,
    MERGES,
    TEXTS,
    TIMES,
    answer,
    archive,
    corrupted,
    hostile_archives,
    npy,
    read_drive,
    readers,
    with_other_value,
    write_drive,
)

from road_envs.core.config import ConfigError, read_yaml
from road_envs.core.reading import parsing, read_npz
from road_envs.drives.recording import read_record

YAML = (
    "vehicle", "road", "composite road", "instruments", "task", "field", 
    "policy settings", "drive description",
)  # fmt: skip
TEXT = (*YAML, "hidden seeds", "drive table")
ARCHIVES = ("weights", "policy")
ALL = (*TEXT, *ARCHIVES, "safetensors", "record", "drive Parquet")
N_FILES = 12
"""Damaged files of each kind and reader; `tests/long/test_many_hostile_files.py` tries hundreds."""


@pytest.fixture(scope="module")
def all_readers(tmp_path_factory):
    found = readers(tmp_path_factory.mktemp("samples"))
    assert set(found) == set(ALL)
    return found


@pytest.mark.parametrize("name", ALL)
@pytest.mark.costly
def test_a_valid_file_is_read_and_a_folder_and_hostile_texts_are_refused(
    name, all_readers, tmp_path
):
    reader = all_readers[name]
    assert answer(reader, tmp_path, reader.sample) is None
    assert answer(reader, tmp_path, None) is not None
    for content in TEXTS:
        assert answer(reader, tmp_path, content) is not None, content[:60]


@pytest.mark.parametrize("name", ALL)
def test_a_corrupted_file_is_read_or_refused(name, all_readers, tmp_path):
    reader, rng = all_readers[name], np.random.default_rng(1)
    said = [answer(reader, tmp_path, corrupted(reader.sample, rng)) for _ in range(N_FILES)]
    assert any(said)


@pytest.mark.parametrize("name", TEXT)
def test_a_text_with_another_value_is_read_or_refused(name, all_readers, tmp_path):
    reader, rng = all_readers[name], np.random.default_rng(2)
    texts = [with_other_value(reader.sample.decode(), rng) for _ in range(N_FILES)]
    assert any(answer(reader, tmp_path, text.encode()) for text in texts)


@pytest.mark.parametrize("name", ARCHIVES)
def test_archives_that_lie_about_their_arrays_are_refused(name, all_readers, tmp_path):
    reader = all_readers[name]
    for content in hostile_archives(reader.sample):
        assert answer(reader, tmp_path, content) is not None, content[:60]


def test_a_compressed_archive_is_read_as_numpy_reads_it(tmp_path):
    arrays = {
        "a": np.arange(6.0).reshape(2, 3),
        "b": np.asfortranarray(np.arange(6, dtype=">i4").reshape(2, 3)),
        "c": np.array("text"),
        "d": np.zeros((2, 0), dtype=np.float16),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "x.npz", **arrays)
        found = read_npz(tmp_path / "x.npz")
        assert found.keys() == arrays.keys()
        for name, array in arrays.items():
            assert found[name].dtype == array.dtype and found[name].flags.writeable
            np.testing.assert_array_equal(found[name], array)


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path):
    path = tmp_path / "bomb.npz"
    header = "{'descr': '|u1', 'fortran_order': False, 'shape': (30000000,), }"
    path.write_bytes(archive(("x.npy", npy(header, bytes(30_000_000)))))
    with pytest.raises(ConfigError, match="100 times as large"), parsing(path, ConfigError, "bad"):
        read_npz(path)


HEAD = ",".join(DRIVE)
CSV_FILES = {
    "no rows": (lambda text: HEAD, "it has no rows"),
    "one column": (lambda text: "t\n1\n2\n", "the column a_rf is missing"),
    "many columns": (lambda text: ",".join(map(str, range(9999))), "9999 columns; at most 4096"),
    "long header": (lambda text: text.replace("v", "v" * 999, 1), "a header of 999 characters"),
    "one name twice": (lambda text: text.replace("a_lr", "A_RF"), "the column a_rf is duplicated"),
    "one quantity often": (
        lambda text: "".join(
            line + "".join(f",t [{k}]" if line == HEAD else ",1" for k in range(2000)) + "\n"
            for line in text.splitlines()
        ),
        "t is given twice, by the columns t and t [0] and",
    ),
    "line break": (lambda text: text.replace("ride", '"ri\nde"'), "mode 'ri\\nde'"),
    "open quote": (lambda text: text.replace("ride", '"ride', 1), "unknown suspension mode 'ride"),
    "zero byte": (lambda text: text.replace("0.1,", "0.\0001,", 1), "it has zero bytes"),
    "UTF-16 without mark": (lambda text: text.encode("utf-16-be"), "it has zero bytes"),
    "no text": (lambda text: b"\x81\x9d" + text.encode(), "or others of no text in UTF-8"),
    "Windows-1252": (lambda text: text.replace("a_rf", "a\u00e9").encode("latin-1"), "has t, aé"),
    "comments": (lambda text: "#\n" * 400_000 + text, None),
    "UTF-16": (lambda text: text.encode("utf-16"), None),
    "old line ends": (lambda text: text.replace("\n", "\r"), None),
    "4000 other columns": (
        lambda text: "".join(
            line + "".join(f",x{k}" if line == HEAD else ",1" for k in range(4000)) + "\n"
            for line in text.splitlines()
        ),
        None,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CSV_FILES)
def test_unusual_text_of_a_drive_is_read_or_refused(name, all_readers, tmp_path):
    change, sentence = CSV_FILES[name]
    content = change(all_readers["drive table"].sample.decode())
    content = content if isinstance(content, bytes) else content.encode()
    said = answer(all_readers["drive table"], tmp_path, content)
    assert said is None if sentence is None else sentence in said


CELLS = (
    "1_0", "nan", "inf", "-inf", "1e308", "-1e308", "1e400", "9" * 30, "0x10", "true", "12:30",
    "2001-99-99", "9999-12-31T00:00:00", '"a\nb"', "x" * 10_000, "1e-320", "-0", "-1", "1 day",
)  # fmt: skip


@pytest.mark.parametrize("quantity", DRIVE)
@pytest.mark.costly
def test_any_cell_of_a_drive_is_read_or_refused(quantity, all_readers, tmp_path):
    """One cell, the second half, or all of a column; `read_drive` asserts what is read."""
    said = []
    for cell in CELLS:
        for cells in (slice(40, 41), slice(40, None), slice(None)):
            column = [str(x) for x in DRIVE[quantity]]
            column[cells] = [cell] * len(column[cells])
            write_drive(tmp_path / "x.csv", {**DRIVE, quantity: column})
            said.append(
                answer(all_readers["drive table"], tmp_path, (tmp_path / "x.csv").read_bytes())
            )
    assert sum(x is not None for x in said) > len(CELLS)


def test_a_duration_among_dates_is_refused_as_no_time(tmp_path):
    dates = [f"2026-05-01T12:00:00.{k:03d}Z" for k in range(0, 800, 10)]
    write_drive(tmp_path / "x.csv", {**DRIVE, "t": dates})
    assert read_drive(tmp_path / "x.csv").record.t[-1] == pytest.approx(0.79)
    write_drive(tmp_path / "x.csv", {**DRIVE, "t": [*dates[:40], "5 H", *dates[41:]]})
    with pytest.raises(ConfigError, match="row 41: '5 H' is neither a number nor a time in ISO"):
        read_drive(tmp_path / "x.csv")


@pytest.mark.parametrize("quantity", DRIVE)
def test_any_type_of_column_of_a_drive_is_read_or_refused(quantity, all_readers, tmp_path):
    n = TIMES.size
    columns = [
        pa.array([True, False] * (n // 2)), pa.nulls(n), pa.array([[1.0]] * n),
        pa.array([{"a": 1}] * n), pa.array([b"\xff\0"] * n), pa.array([2**64 - 1] * n, pa.uint64()),
        pa.array(["a", "b"] * (n // 2)).dictionary_encode(), pa.array(range(n), pa.date32()),
        pa.array(range(n), pa.time64("us")), pa.array(range(n), pa.duration("ns")),
        pa.array(np.arange(n, dtype=np.float16)), pa.array([b"\xb3"] * n).view(pa.string()),
        *(pa.array(x * TIMES) for x in (1e308, -1e308, 1e155, 1e-320, np.nan)),
    ]  # fmt: skip
    said = []
    for column in columns:
        write_drive(tmp_path / "x.parquet", {**DRIVE, quantity: column})
        content = (tmp_path / "x.parquet").read_bytes()
        said.append(answer(all_readers["drive Parquet"], tmp_path, content))
    assert sum(x is not None for x in said) > len(columns) // 2


def test_a_table_without_rows_is_refused(tmp_path):
    for name in ("x.parquet", "x.csv"):
        write_drive(tmp_path / name, {key: column[:0] for key, column in DRIVE.items()})
        with pytest.raises(ConfigError, match=f"{name}: no readable table"):
            read_drive(tmp_path / name)


def test_a_gap_of_the_clock_is_refused_however_long(tmp_path):
    for gap in (1e3, 1e7, 1e11, 1e12, 1e200):
        for start in (0.4, 0.785):
            write_drive(tmp_path / "x.csv", {**DRIVE, "t": TIMES + gap * (start < TIMES)})
            with pytest.raises(ConfigError, match=r"samples are lost|too large: check its unit"):
                read_drive(tmp_path / "x.csv")


def test_a_parquet_file_of_a_constant_is_refused_before_it_is_unpacked(tmp_path):
    path = tmp_path / "x.parquet"
    pq.write_table(pa.table({f"c{k}": pa.nulls(2**24) for k in range(17)}), path)
    assert path.stat().st_size < 2**20
    for reader in (read_drive, read_record):
        with pytest.raises(ConfigError, match="285212672 cells; at most 268435456 are read"):
            reader(path)


def test_aliases_count_as_what_they_stand_for(tmp_path):
    path = tmp_path / "a.yaml"
    for text, sentence in (
        (BOMB, "values with all aliases; at most 1000000 are read"),
        (MERGES, "values with all aliases"),
        ("a: &a [*a]", "inf values"),
        ("a: " + "x" * 2**22, "4194307 bytes; at most 4194304 are read"),
        ("a: " + "[" * 900, "nested too deeply"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=sentence):
            read_yaml(path)
    path.write_text("a: &a [1, 2]\nb: [*a, *a]\nc: {<<: {d: 1}}")
    assert read_yaml(path) == {"a": [1, 2], "b": [[1, 2], [1, 2]], "c": {"d": 1}}
