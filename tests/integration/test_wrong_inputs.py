"""Inputs that used to be answered wrongly without a word, and the sentence that each gets now.

One row of ERRORS for an input that is refused, of NOTES for one that is answered with a note.
"""

import json
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from leaderboard import cli
from road_envs import config
from road_envs.data.recording import simulate_record, write_record
from road_envs.roads import realise_road, write_csv


@cache
def drive():
    """Columns of a drive of 100 m, and its road."""
    record, _ = simulate_record("iso_c", speed_kmh=36.0, mode="ride", seed=1, length=100.0)
    names = ("t", "a_rf", "a_lr", "a_rr", "v", "s")
    columns = dict(zip(names, (record.t, *record.a, record.v, record.s), strict=True))
    return pd.DataFrame(columns).assign(mode="ride"), realise_road("iso_c", 1, 100.0), record


def table(**changes):
    """Write the drive as d.csv, with columns changed; None leaves one out."""
    frame = drive()[0].copy()
    for name, change in changes.items():
        frame = (
            frame.drop(columns=name) if change is None else frame.assign(**{name: change(frame)})
        )
    frame.to_csv("d.csv", index=False)


def surface(text):
    Path("road.csv").write_text(text, encoding="utf-8")


def rows(factor=1.0, count=None, **gaps):
    road = drive()[1]
    lines = []
    for s, left, right in zip(road.s[:count], *road.z[:, :count], strict=True):
        cell = gaps.get("gap") if 20.0 < s < 21.0 and gaps else f"{factor * left:.6f}"
        lines.append(f"{s:.4f},{cell},{factor * right:.6f}")
    return "\n".join(lines) + "\n"


def vehicle(**changes):
    car = yaml.safe_load((config.folder() / "vehicles/land_rover_defender_110.yaml").read_text())
    for path, value in changes.items():
        *parents, key = path.split("__")
        part = car
        for name in parents:
            part = part[name]
        part[key] = value
    Path("car.yaml").write_text(yaml.safe_dump(car), encoding="utf-8")


def record(**changes):
    write_record(Path("d.parquet"), replace(drive()[2], **changes), {})


def another_road():
    table()
    write_csv(realise_road("iso_c", 7, 100.0), "t.csv")


ESTIMATE, CLASSIFY = ("estimate", "wiener", "d.csv"), ("classify", "d.csv")
PLOT = ("roads", "plot", "road.csv", "--out", "r.png")

ERRORS = {
    "accelerations in g, with gravity": (
        lambda: table(a_rf=lambda d: 1.0 + d.a_rf / 9.80665), CLASSIFY, "say --units a_rf=g"),
    "accelerations of 1 mg": (
        lambda: table(a_rf=lambda d: 1e-3 * d.a_rf), CLASSIFY, "less than any driven car"),
    "a dead channel": (
        lambda: table(a_rr=lambda d: 0.0 * d.a_rr), CLASSIFY, "a_rr is 0 in all rows: the sensor"),
    "an axis that points down": (
        lambda: table(a_lr=lambda d: -9.81 - d.a_lr), CLASSIFY, "--invert a_lr"),
    "speed in km/h without its unit": (
        lambda: table(v=lambda d: 3.6 * d.v), CLASSIFY, "m by the odometer and"),
    "times in milliseconds": (
        lambda: table(t=lambda d: 1e3 * d.t), CLASSIFY, "are the times in ms (--units t=ms)?"),
    "a gap of 10^7 s": (
        lambda: table(t=lambda d: d.t + 1e7 * (d.t > 4.0)), CLASSIFY, "longest gap is 1e+07 s"),
    "a cell 1_0": (
        lambda: table(a_rf=lambda d: ["1_0", *d.a_rf[1:].map("{:.4f}".format)]), CLASSIFY,
        "row 1: '1_0' is not a number"),
    "two problems": (
        lambda: table(a_lr=None, v=None, s=None), CLASSIFY, "2 problems: (1) the column a_lr"),
    "the truth of another road": (
        another_road, (*ESTIMATE, "--truth", "t.csv"), "matches the truth at no lag within 50 m"),
    "a surface in mm": (lambda: surface(rows(1e3)), PLOT, "as of heights in millimetres"),
    "a surface with gaps": (
        lambda: surface(rows(gap="nan")), PLOT, "kind: measured, path: ... and bridge_gaps: true"),
    "a surface too short for a class": (
        lambda: surface(rows(count=60)), PLOT, "shorter than min_length"),
    "a tyre in N/mm": (
        lambda: (table(), vehicle(front__k_t=250.0)), (*CLASSIFY, "--vehicle", "car.yaml"),
        "front.k_t = 250 N/m lets a tyre give way by"),
    "an axle in tonnes": (
        lambda: (table(), vehicle(rear__m=0.229)), (*CLASSIFY, "--vehicle", "car.yaml"),
        "the rear axle of m = 0.229 kg hops at"),
    "a description with an unknown key": (
        lambda: (table(), Path("d.yaml").write_text("colums: {}\n")),
        (*CLASSIFY, "--description", "d.yaml"), "did you mean 'columns'"),
    "options for a record that has them": (
        record, ("classify", "d.parquet", "--units", "a_rf=g"), "leave out --units"),
}  # fmt: skip

NOTES = {
    "stations of another origin": (
        lambda: (table(s=lambda d: d.s + 5.0), write_csv(drive()[1], "t.csv")),
        (*ESTIMATE, "--truth", "t.csv"), "aligned with the truth by -4.99 m"),
    "no odometer": (
        lambda: (table(s=None), write_csv(drive()[1], "t.csv")),
        (*ESTIMATE, "--truth", "t.csv"), "aligned with the truth by -4.99 m"),
    "a quiet drive, perhaps in g": (
        lambda: table(a_rf=lambda d: d.a_rf / 9.80665), CLASSIFY, "if it is in g, say --units"),
    "a vehicle that shipped weights do not know": (
        lambda: (table(), vehicle(m_b=2000.0)),
        ("estimate", "fir_ridge", "d.csv", "--vehicle", "car.yaml"), "makes no difference"),
    "a dead channel of a record": (
        lambda: record(a=drive()[2].a * np.array([[1.0], [0.0], [1.0]])),
        ("estimate", "wiener", "d.parquet"), "LR is 0 in all samples: the sensor is dead"),
}  # fmt: skip


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["road-recon", *words])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capsys.readouterr()
        return ended.value.code or 0, out, err

    return run


@pytest.mark.parametrize("name", ERRORS)
def test_a_wrong_input_is_refused_in_one_sentence(run, tmp_path, name):
    prepare, words, sentence = ERRORS[name]
    prepare()
    before = {path.name for path in tmp_path.iterdir()}
    code, _, err = run(*words)
    assert code == 2 and sentence in err and err.startswith("error: ") and err.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("name", NOTES)
def test_a_doubtful_input_is_answered_with_a_note(run, name):
    prepare, words, sentence = NOTES[name]
    prepare()
    code, out, err = run(*words, "--json")
    assert code == 0, err
    assert any(sentence in note for note in json.loads(out)["notes"]), out


def test_a_surface_with_semicolons_decimal_commas_and_millimetres_is_read(run, tmp_path):
    text = rows(1e3).replace(",", ";").replace(".", ",")
    surface("Station [m];left [mm];right [mm]\n" + text)
    code, _, err = run("roads", "export", "road.csv", "--out", "same.csv")
    assert code == 0, err
    again, road = realise_road(tmp_path / "same.csv", 0), drive()[1]
    expected = road.z[:, : again.z.shape[1]] - road.z[:, :1]
    np.testing.assert_allclose(again.z, expected, atol=2e-6)
