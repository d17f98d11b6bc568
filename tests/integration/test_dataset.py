"""The command `dataset`: drives, roads and splits that can be used without the simulator."""

import hashlib
import json
import sys

import numpy as np
import pandas as pd
import pytest

from leaderboard import cli
from road_envs.drives.training_corpus import Corpus


def run(monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["road-recon", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return ended.value.code or 0, *capsys.readouterr()


def test_a_data_set_has_every_drive_in_one_split_and_checksums(monkeypatch, capsys, tmp_path):
    out = tmp_path / "set"
    words = ("dataset", "--out", out, "--drives", 10, "--seed", 7, "--sensors", "phone", "--json")
    code, told, err = run(monkeypatch, capsys, *words)
    assert code == 0, err
    assert json.loads(told)["drives"] == 10
    about = json.loads((out / "dataset.json").read_text())
    for name, digest in about["files"].items():
        assert hashlib.sha256((out / name).read_bytes()).hexdigest() == digest
    drives = pd.read_parquet(out / "drives.parquet")
    assert drives["drive"].tolist() == list(range(10))
    assert drives["split"].value_counts().to_dict() == {"train": 8, "validation": 1, "test": 1}
    for split, part in drives.groupby("split"):
        records = pd.read_parquet(out / f"{split}_records.parquet")
        profiles = pd.read_parquet(out / f"{split}_profiles.parquet")
        assert set(records["drive"]) == set(profiles["drive"]) == set(part["drive"])
    record, truth, _ = Corpus(number=10, seed=7, instruments="phone").simulate_drive(9)
    test = pd.read_parquet(out / "test_records.parquet")
    np.testing.assert_allclose(test["a_lr"], record.a[1], rtol=1e-6)
    np.testing.assert_allclose(test["s"], record.s)
    heights = pd.read_parquet(out / "test_profiles.parquet")
    np.testing.assert_allclose(heights["right"], truth.z[1], rtol=1e-6)
    card = (out / "README.md").read_text(encoding="utf-8")
    assert "license: cc-by-4.0" in card and about["corpus"] in card
    code, _, err = run(monkeypatch, capsys, *words)
    assert code == 2 and "exists; give a folder that does not" in err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--task", "new_road", "--drives", "20"), "are those of the task: leave them out"),
        (("--task", "new_road", "--sensors", "phone"), "are those of the task: leave them out"),
        (("--task", "new_road", "--episodes", "ride"), "either --task or --episodes, not both"),
        (("--csv",), "--csv and --roads are of a task"),
    ],
)
def test_options_of_another_kind_of_data_set_are_refused(
    monkeypatch, capsys, tmp_path, words, sentence
):
    code, out, err = run(monkeypatch, capsys, "dataset", "--out", tmp_path / "set", *words)
    assert code == 2 and sentence in err and out == "" and list(tmp_path.iterdir()) == []
