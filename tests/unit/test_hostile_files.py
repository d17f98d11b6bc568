"""Every reader answers damaged and hostile files with its own sentence, which names the file."""

import numpy as np
import pytest
from hostile_files import (
    BOMB,
    MERGES,
    TEXTS,
    answer,
    archive,
    corrupted,
    hostile_archives,
    npy,
    readers,
    with_other_value,
)

from road_envs._reading import parsing, read_npz
from road_envs.config import ConfigError, read_yaml

YAML = (
    "vehicle", "road", "composite road", "instruments", "task", "field", "scenarios",
    "policy settings",
)  # fmt: skip
TEXT = (*YAML, "hidden seeds")
ARCHIVES = ("weights", "policy")
ALL = (*TEXT, *ARCHIVES, "safetensors", "record")
N_FILES = 12
"""Damaged files of each kind and reader; `tests/long/test_many_hostile_files.py` tries hundreds."""


@pytest.fixture(scope="module")
def all_readers(tmp_path_factory):
    found = readers(tmp_path_factory.mktemp("samples"))
    assert set(found) == set(ALL)
    return found


@pytest.mark.parametrize("name", ALL)
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
