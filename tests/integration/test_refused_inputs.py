"""Inputs that ended in a traceback or in minutes of work, and the sentence that each gets now."""

import errno
import io
import os
import re
import subprocess
import sys
import time

import pytest
import yaml
from fakes import SHORT_TASK

from leaderboard import cli
from road_envs.core.config import ConfigError, find, read_yaml
from road_envs.drives.logger_tables.description import read_description
from road_envs.drives.recording import simulate_record
from road_envs.roads import realise_road
from road_envs.simulation.drive import SimulationError
from road_envs.vehicle.parameters import load_vehicle


def test_a_unit_of_an_unknown_quantity_is_refused_also_beside_instruments(tmp_path):
    path = tmp_path / "d.yaml"
    path.write_text("units: {acc: g}\nsensors: phone\n")
    with pytest.raises(ConfigError, match="unknown quantity in units 'acc'"):
        read_description(path)


@pytest.mark.parametrize(
    ("road", "sentence"),
    [
        ({"kind": "random_level", "level": [-9, 9.2e18], "road": "iso_d"}, "within 200 dB"),
        (
            {"kind": "random_level", "level": [100.0, 140.0], "road": "iso_d"},
            "the limit is 10000 m",
        ),
        ({"kind": "concatenated", "roads": ["iso_d"] * 2000}, "at most 200 elements"),
        ({"kind": "superposed", "roads": ["iso_d"] * 2000}, "at most 200 elements"),
    ],
)
def test_roads_that_are_too_high_or_of_too_many_parts_are_refused_early(road, sentence):
    began = time.process_time()
    with pytest.raises(ValueError, match=sentence):
        realise_road(road, 0)
    assert time.process_time() - began < 2.0


def test_two_tasks_of_one_name_are_refused_before_anything_runs(road_recon, tmp_path):
    paths = [tmp_path / folder / "street.csv" for folder in ("a", "b")]
    for path in paths:
        path.parent.mkdir()
        rows = [f"{0.1 * k:.1f},{k % 7},{k % 5}\n" for k in range(400)]
        path.write_text("distance [m],left [mm],right [mm]\n" + "".join(rows))
    words = [word for path in paths for word in ("--road", str(path))]
    code, _, err = road_recon("leaderboard", *words, "--estimator", "flat", "--out", "out")
    assert code == 2 and re.match("error: two tasks are named .*street.*: name one diff", err), err
    assert not (tmp_path / "out").exists()


def test_a_plan_runs_nothing_again(road_recon, tmp_path):
    words = (
        "--task",
        "paper_1",
        "--estimator",
        "flat",
        "--again",
        "--plan",
        str(tmp_path / "jobs"),
    )
    code, _, err = road_recon("leaderboard", *words, "--out", str(tmp_path / "out"))
    assert code == 2 and err.startswith("error: --plan writes jobs of missing results only"), err
    assert not list(tmp_path.iterdir())


def test_an_estimator_given_twice_is_refused_before_anything_runs(road_recon, tmp_path):
    """Its second row would stay in the folder, failed, on every later board."""
    (tmp_path / "short.yaml").write_text(SHORT_TASK)
    words = ("leaderboard", "--task", "short.yaml", *("--estimator", "flat") * 2)
    code, _, err = road_recon(*words, "--out", "out")
    assert code == 2 and err == "error: the estimator flat is given twice: give it once\n", err
    assert not (tmp_path / "out").exists()


def test_a_vehicle_that_cannot_stand_still_is_one_sentence(tmp_path):
    data = read_yaml(find("vehicles", "land_rover_defender_110"))
    data["strut"]["bushing"]["F"][5] = 2147483648
    (tmp_path / "car.yaml").write_text(yaml.safe_dump(data))
    car = load_vehicle(tmp_path / "car.yaml")
    with pytest.raises(SimulationError, match=r"no static equilibrium .*; check its masses"):
        simulate_record("iso_d", vehicle=car, speed_kmh=36.0, length=4.0)
    data["strut"]["bushing"]["F"][5] = 0.0
    data["valve"]["delay"] = 2147483648
    (tmp_path / "car.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError, match=r"valve\.delay: must be at most 10"):
        load_vehicle(tmp_path / "car.yaml")


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (MemoryError("2 TiB"), "error: not enough memory (2 TiB): give less data"),
        (MemoryError(), "error: not enough memory (no size given)"),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), "error: the operating system refused a "
         "request: No space left on device"),
    ],
)  # fmt: skip
def test_lack_of_memory_and_errors_without_a_file_are_sentences(
    error, sentence, monkeypatch, capsys
):
    def fail(**_):
        raise error

    monkeypatch.setattr(cli, "app", fail)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2 and capsys.readouterr().err.startswith(sentence)


@pytest.mark.processes
def test_a_board_is_printed_in_the_locale_c_without_utf_8(tmp_path):
    text = SHORT_TASK.replace("A short task", "Kurz, für alle").replace(
        "{title: Short}", "{title: Kürze}"
    )
    (tmp_path / "short.yaml").write_text(text, encoding="utf-8")
    words = ["leaderboard", "--task", "short.yaml", "--estimator", "flat", "--isolation", "process"]
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run(
        [sys.executable, "-m", "leaderboard.cli", *words, "--out", "out"],
        cwd=tmp_path, env=os.environ | plain, capture_output=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-500:]
    assert "Kürze: Kurz, für alle" in done.stdout.decode()


@pytest.mark.costly
def test_an_address_where_no_scheduler_answers_is_one_sentence_in_ten_seconds(tmp_path):
    pytest.importorskip("distributed")
    (tmp_path / "short.yaml").write_text(SHORT_TASK, encoding="utf-8")
    code = """
import sys, time
from leaderboard.running.dask_executor import DaskExecutor
from road_envs.core.config import ConfigError
for address in ("tcp://127.0.0.1:5", "nowhere"):
    began = time.monotonic()
    try:
        DaskExecutor(address)
    except ConfigError as error:
        assert "no Dask scheduler answers at" in str(error) and time.monotonic() - began < 10.0
        print("refused")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.stdout.split(), done.stderr) == (["refused"] * 2, "")


@pytest.mark.processes
def test_local_is_a_cluster_of_this_machine(tmp_path):
    pytest.importorskip("distributed")
    (tmp_path / "short.yaml").write_text(SHORT_TASK, encoding="utf-8")
    words = ["leaderboard", "--task", "short.yaml", "--estimator", "flat", "--isolation", "process"]
    done = subprocess.run(
        [sys.executable, "-m", "leaderboard.cli", *words, "--out", "out", "--dask", "local",
         "--workers", "1"],
        cwd=tmp_path, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr[-500:]
    assert (tmp_path / "out/results/short/flat.json").exists()


def test_a_question_without_an_answer_and_a_folder_without_results_end_in_a_sentence(
    road_recon, monkeypatch
):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    code, _, err = road_recon("new-vehicle", "car.yaml")
    assert code == 2 and err.endswith(
        "error: a question was left open: give its answer as an option\n"
    )
    code, _, err = road_recon("cite", "mine", "--out", "nowhere")
    assert code == 2 and err == (
        "error: nowhere: no results; `road-recon leaderboard --out nowhere` makes them, and in a "
        "results repository `road-recon results-site .`\n"
    )


def test_a_file_that_only_ends_as_parquet_is_called_damaged_by_every_reader(road_recon, tmp_path):
    (tmp_path / "heights.parquet").write_bytes(bytes(range(200)))
    for words in (
        ("estimate", "wiener", "heights.parquet"),
        ("iri", "heights.parquet"),
        ("score", "heights.parquet", "--task", "class", "--roads", "2"),
    ):
        code, _, err = road_recon(*words)
        assert code == 2 and err.startswith("error: heights.parquet: damaged, or "), err
