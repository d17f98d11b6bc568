"""Inputs that used to be answered wrongly without a word, and the sentence that each gets now.

One row of ERRORS for an input that is refused, of NOTES for one that is answered with a note. (An
estimator whose heights are in millimetres is refused in `test_conformance_checks.py`.)
"""

import io
import json
import sys
import zipfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from measured import read_measured_record

from leaderboard import cli
from road_envs.core import config
from road_envs.drives.recording import simulate_record, write_record
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


def text(change):
    """Write the drive as d.csv, with the bytes that `change` makes of its text."""
    Path("d.csv").write_bytes(change(drive()[0].to_csv(index=False)))


def spreadsheet():
    """Bytes of a zip file that says of itself to be an Office document."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr("[Content_Types].xml", "<Types/>")
    return data.getvalue()


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
    "a truth that ends before the road of the record": (
        lambda: (record(), surface(rows(count=1901))),
        ("estimate", "wiener", "d.parquet", "--truth", "road.csv"),
        "road.csv: the true profile is 19.00 m long; of the road of the record all 100.00 m are"),
    "a known road that ends before that of the drive": (
        lambda: (record(), surface(rows(count=1901))),
        ("train", "static_lm", "d.parquet", "--profile", "road.csv", "--out", "f.npz"),
        "d.parquet: its --profile is known from 0.00 to 19.00 m of the drive; all of 0 to 100.00"),
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
    "milli-g without their unit": (
        lambda: table(a_rf=lambda d: 1e3 + 1e3 * d.a_rf / 9.80665), CLASSIFY,
        "more than any car: give its unit (--units a_rf=mg)"),
    "one channel twice": (
        lambda: table(a_rr=lambda d: d.a_lr), CLASSIFY, "a_lr and a_rr are equal in all rows"),
    "times rounded to whole seconds": (
        lambda: table(t=lambda d: d.t.round()), CLASSIFY, "its times are rounded: write them with"),
    "a clock that wraps": (
        lambda: table(t=lambda d: d.t % 4.0), CLASSIFY, "clock starts anew there, cut the file"),
    "times in microseconds": (
        lambda: table(t=lambda d: 1e6 * d.t), CLASSIFY, "are the times in us (--units t=us)?"),
    "an odometer that starts anew": (
        lambda: table(s=lambda d: d.s % 50.0), CLASSIFY, "the vehicle moves backwards"),
    "a drive in reverse": (
        lambda: table(s=lambda d: -d.s, v=lambda d: -d.v), CLASSIFY, "v must not be negative"),
    "an odometer in km": (
        lambda: table(s=lambda d: 1e-3 * d.s), CLASSIFY, "m by the odometer and"),
    "latitude and longitude exchanged": (
        lambda: table(lat=lambda d: 111.0 + 0.0 * d.s, lon=lambda d: 48.0 + d.s / 111e3), CLASSIFY,
        "no latitudes within ±90°"),
    "accelerations in metres": (
        lambda: table(**{"a_rf": None, "a_rf [m]": lambda d: drive()[0].a_rf}), CLASSIFY,
        "the acceleration unit 'm' is unknown; known: m/s2, g, mg"),
    "accelerations ten times a second": (
        lambda: drive()[0][::100].to_csv("d.csv", index=False), CLASSIFY,
        "sampled at 10 Hz; at least 20 Hz"),
    "three seconds without one sensor": (
        lambda: table(a_rf=lambda d: d.a_rf.where((d.t < 4.0) | (d.t > 7.0))), CLASSIFY,
        "of the samples are lost"),
    "a spreadsheet": (
        lambda: Path("d.csv").write_bytes(spreadsheet()), CLASSIFY,
        "a spreadsheet or an archive: save its sheet as CSV"),
    "a damaged archive": (
        lambda: Path("d.csv").write_bytes(b"PK\x03\x04" + bytes(range(256))), CLASSIFY,
        "a damaged zip file"),
    "UTF-16 without its mark": (
        lambda: text(lambda t: t.encode("utf-16-le")), CLASSIFY, "others of no text in UTF-8"),
    "a line that is cut off": (
        lambda: text(lambda t: t[:-30].encode()), CLASSIFY, "Expected 7 columns, got"),
    "no headers": (
        lambda: text(lambda t: t.partition("\n")[2].encode()), CLASSIFY, "the column t is missing"),
    "an empty file": (lambda: Path("d.csv").write_bytes(b""), CLASSIFY, "it has no rows"),
    "options for a record that has them": (
        record, ("classify", "d.parquet", "--units", "a_rf=g"), "leave out --units"),
}  # fmt: skip

CHECKED = {
    "another mode of the struts": (
        lambda: table(mode=lambda d: "handling"), CLASSIFY, "fits the mode ride better: handling"),
    "a speed in km/h without its unit or an odometer": (
        lambda: drive()[0][:5000].assign(v=lambda d: 3.6 * d.v).drop(columns="s")
        .to_csv("d.csv", index=False), CLASSIFY, "(--units v=km/h)"),
    "a speed in mph without its unit or an odometer": (
        lambda: table(v=lambda d: d.v / 0.44704, s=None), CLASSIFY, "(--units v=mph)"),
    "an axis that points down, without gravity": (
        lambda: table(a_lr=lambda d: -d.a_lr), CLASSIFY, "(--invert a_lr)"),
    "left and right exchanged": (
        lambda: table(a_lr=lambda d: d.a_rr, a_rr=lambda d: drive()[0].a_lr), CLASSIFY,
        "LR and RR exchanged better"),
}  # fmt: skip
"""Notes of `drive_check`, which tries other descriptions for seconds; most are slow."""

NOTES = {
    "single samples that no sensor measures": (
        lambda: table(a_rf=lambda d: d.a_rf.where(d.index != 50, 1e6)), CLASSIFY,
        "1 samples beyond 1000 m/s² of the others are taken as lost"),
    "accelerations of 50 Hz repeated in rows of 1000 Hz": (
        lambda: table(**{k: lambda d, k=k: np.repeat(d[k].to_numpy()[::20], 20)[: len(d)]
                         for k in ("a_rf", "a_lr", "a_rr")}), CLASSIFY,
        "repeated for 20 rows each; the first of equal rows are the samples"),
    "a clock whose samples come in bunches": (
        lambda: drive()[0][::10].assign(t=lambda d: d.t + 0.012 * np.sin(7.0 * np.arange(len(d))))
        .to_csv("d.csv", index=False), CLASSIFY, "resampled to 100 Hz, 0.0% of the samples lost"),
    "positions before the first fix": (
        lambda: table(lat=lambda d: np.where(d.t < 3.0, 0.0, 48.0 + d.s / 111_195.0),
                      lon=lambda d: np.where(d.t < 3.0, 0.0, 11.0)), CLASSIFY,
        "positions at 0° N 0° E are taken as missing"),
    "a speed that is noise at standstill": (
        lambda: table(v=lambda d: np.where(d.t < 1.0, -0.01, d.v)), CLASSIFY,
        "speeds down to -0.01 m/s are taken as standstill"),
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
        ("estimate", "fir_ridge", "d.parquet"), "LR is 0 in all samples: the sensor is dead"),
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


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", ERRORS)
@pytest.mark.costly
def test_a_wrong_input_is_refused_in_one_sentence(run, tmp_path, name):
    prepare, words, sentence = ERRORS[name]
    prepare()
    before = {path.name for path in tmp_path.iterdir()}
    code, _, err = run(*words)
    assert code == 2 and sentence in err and err.startswith("error: ") and err.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == before


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", NOTES)
@pytest.mark.costly
def test_a_doubtful_input_is_answered_with_a_note(run, name):
    assert_note(run, *NOTES[name])


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * ("km/h" not in name)) for name in CHECKED],
)
@pytest.mark.costly
def test_a_description_that_fits_worse_than_another_is_noted(run, name):
    assert_note(run, *CHECKED[name])


def assert_note(run, prepare, words, sentence):
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


DIALECTS = {
    "byte order mark": lambda t: t.encode("utf-8-sig"),
    "UTF-16": lambda t: t.encode("utf-16"),
    "semicolons and decimal commas": lambda t: t.replace(",", ";").replace(".", ",").encode(),
    "bars": lambda t: t.replace(",", "|").encode(),
    "spaces": lambda t: t.replace(",", "   ").encode(),
    "lines before the header": lambda t: b"Logger 3\nserial;123\n\n" + t.encode(),
    "a row of units": lambda t: t.replace("\n", "\ns,m/s2,m/s2,m/s2,m/s,m,\n", 1).encode(),
    "line ends of Windows": lambda t: t.replace("\n", "\r\n").encode(),
}


@pytest.mark.parametrize("name", DIALECTS)
def test_a_table_is_the_same_in_every_dialect(tmp_path, name):
    path = tmp_path / "d.csv"
    path.write_bytes(DIALECTS[name](drive()[0].to_csv(index=False)))
    found = read_measured_record(path, 2.794).record
    np.testing.assert_array_equal(found.a, drive()[0][["a_rf", "a_lr", "a_rr"]].to_numpy().T)
    np.testing.assert_allclose(found.v, drive()[0].v)


def test_a_text_larger_than_half_a_gigabyte_is_refused_unread(tmp_path):
    path = tmp_path / "d.csv"
    with path.open("wb") as file:
        file.truncate(2**30)  # sparse: no block is written
    with pytest.raises(config.ConfigError, match="1024 MiB; at most 512 MiB of text are read"):
        read_measured_record(path, 2.794)


def test_a_folder_without_a_name_is_a_folder_like_any_other(road_recon, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, err = road_recon("estimate", "wiener", ".")
    assert code == 2 and "a folder of no app" in err and err.count("\n") == 1
