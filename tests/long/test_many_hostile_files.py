"""Hundreds of damaged files for every reader, as `tests/unit/test_hostile_files.py` tries a few."""

import numpy as np
import pytest
from hostile_files import answer, corrupted, readers, with_other_value

N_FILES = 400


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_damaged_files_are_read_or_refused(seed, tmp_path):
    rng = np.random.default_rng([7, seed])
    (tmp_path / "samples").mkdir()
    for name, reader in readers(tmp_path / "samples").items():
        files = [corrupted(reader.sample, rng) for _ in range(N_FILES)]
        if reader.name.endswith(("yaml", "json", "csv")):
            text = reader.sample.decode()
            files += [with_other_value(text, rng).encode() for _ in range(N_FILES)]
        refused = sum(answer(reader, tmp_path, content) is not None for content in files)
        print(f"{name}: {len(files)} files, {refused} refused, the others read")
        assert refused > N_FILES // 2
