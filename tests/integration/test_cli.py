"""Subcommands of `road-recon` and their error messages."""

import io
import json
import os
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
import typer
from rich.console import Console

from leaderboard import cli
from leaderboard.commands.listing import KINDS
from leaderboard.commands.output import facts_table
from leaderboard.entries.entry_files import CLASS_FOLDER
from road_envs.core import config
from road_envs.core.config import ConfigError
from road_envs.drives.recording import read_record
from road_envs.roads import load_road

DRIVE = ("--road", "iso_c", "--length", "30", "--speed-kmh", "36")


GROUPS = {"": cli._RoadRecon, "roads": cli._Roads}
COMMANDS = [
    (*group.split(), name, target)
    for group, commands in GROUPS.items()
    for entries in commands.sections.values()
    for name, target in entries.items()
]


@pytest.mark.parametrize("words", COMMANDS, ids=lambda words: " ".join(words[:-1]))
def test_every_command_has_a_help_text_that_opens_with_its_line_in_the_list(road_recon, words):
    *command, target = words
    code, out, _ = road_recon(*command, "--help")
    assert code == 0 and f"Usage: road-recon {' '.join(command)}" in out
    text = " ".join(out.split("\n\n")[1].split())
    assert text.startswith(cli._help_line(target).removesuffix("."))


def test_the_help_lists_every_command_whole(road_recon):
    for group, commands in GROUPS.items():
        code, out, _ = road_recon(*group.split(), "--help")
        assert code == 0
        shown = " ".join(out.split())
        for section, entries in commands.sections.items():
            assert f"{section}:" in shown
            lines = {name: cli._help_line(target) for name, target in entries.items()}
            assert all(len(x) > 20 and f" {name} {x}" in shown for name, x in lines.items())


def test_options_are_listed_by_what_they_are_for(road_recon):
    _, out, _ = road_recon("simulate", "--help")
    places = [out.index(text) for text in ("Options:", "Drive:", "--road", "Running:", "Output:")]
    assert places == sorted(places) and out.index("--json") > places[-1]
    _, out, _ = road_recon("estimate", "--help")
    assert out.index("Arguments:") < out.index("estimator <") < out.index("Options:")


def test_every_option_of_a_section_is_an_option_of_a_command():
    group = typer.main.get_command(cli.app)
    commands = [group.get_command(None, name) for name in group.list_commands(None)]
    known = {parameter.name for command in commands for parameter in command.params}
    assert {name for names in cli.OPTION_SECTIONS.values() for name in names} <= known


def test_the_help_imports_neither_the_commands_nor_the_libraries_they_need():
    """They take a second to import, and the help a tenth of that."""
    heavy = ("scipy", "numba", "pydantic", "rich", "pandas", "matplotlib", "torch", "jinja2")
    code = f"""
import sys
from leaderboard import cli
sys.argv = ["road-recon", "--help"]
try:
    cli.main()
except SystemExit as ended:
    assert not ended.code
print([name for name in {heavy} if name in sys.modules])
print([name for name in sys.modules if name.startswith("leaderboard.commands")])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-2:] == ["[]", "[]"]


def test_a_drive_of_a_perturbed_vehicle_is_recorded_with_its_lost_samples(road_recon, tmp_path):
    """Lost samples are counted, stored as NaN and do not break the plot."""
    road, files = ("--road", "iso_c", "--length", "60"), ("--out", "d.parquet", "--plot", "d.png")
    code, out, _ = road_recon("simulate", *road, "--grade", "S3", *files, "--json")
    facts = json.loads(out)
    assert code == 0 and facts["grade"] == "S3" and facts["lost_samples"] > 0
    record, provenance = read_record(tmp_path / "d.parquet")
    assert np.isnan(record.a).any(axis=0).sum() == facts["lost_samples"]
    assert provenance["grade"] == "S3" and all(
        np.isfinite(list(facts["rms_acceleration"].values()))
    )
    assert (tmp_path / "d.png").read_bytes().startswith(b"\x89PNG")
    code, out, _ = road_recon("simulate", *road, "--json")
    assert code == 0 and json.loads(out)["grade"] == "S0" and json.loads(out)["lost_samples"] == 0


def test_a_drive_is_recorded_reconstructed_and_scored(road_recon, tmp_path):
    code, out, _ = road_recon(
        "simulate", *DRIVE, "--out", "d.parquet", "--truth", "t.csv", "--plot", "d.png", "--json"
    )
    assert code == 0
    facts = json.loads(out)
    assert facts["length_m"] == pytest.approx(30.0)
    record, provenance = read_record(tmp_path / "d.parquet")
    assert provenance["road"] == "iso_c" and provenance["seed"] == 1
    assert facts["samples"] == record.t.size
    assert (tmp_path / "d.png").read_bytes().startswith(b"\x89PNG")
    truth = load_road(tmp_path / "t.csv").realise(np.random.default_rng(0))
    drawn = load_road({"name": "iso_c", "length": 30.0}).realise(np.random.default_rng(1))
    s = np.linspace(0.5, 29.5, 100)
    np.testing.assert_allclose(truth.height(s), drawn.height(s), atol=1e-6)

    trained = road_recon(
        "train", "fir_ridge", *DRIVE, "--drives", 3, "--seed", 10, "--out", "m.npz", "--json"
    )
    assert trained[0] == 0 and json.loads(trained[1])["drives"] == 3
    code, out, _ = road_recon(
        "estimate", "m.npz", "d.parquet", "--truth", "t.csv", "--out", "e.csv", "--plot", "e.png",
        "--json",
    )  # fmt: skip
    assert code == 0
    assert 0.0 < json.loads(out)["scores"]["nrmse"] < 1.0
    assert {p.name for p in tmp_path.iterdir()} == {
        "d.parquet", "t.csv", "d.png", "m.npz", "e.csv", "e.png",
    }  # fmt: skip


def test_a_measured_drive_is_accepted_in_place_of_a_record(road_recon, tmp_path):
    road_recon("simulate", *DRIVE, "--out", "d.parquet")
    record, _ = read_record(tmp_path / "d.parquet")
    rows = np.column_stack([record.t, *record.a, record.v])
    np.savetxt(tmp_path / "d.csv", rows, "%.9g", ",", header="t,a_rf,a_lr,a_rr,v", comments="")
    code, out, _ = road_recon("estimate", "fir_ridge", "d.csv", "--mode", "ride", "--out", "e.csv")
    assert code == 0 and "length_m" in out and (tmp_path / "e.csv").stat().st_size > 1000
    code, out, _ = road_recon("classify", "d.csv", "--mode", "ride", "--json")
    assert code == 0 and json.loads(out)["class"] in "BCD"
    code, _, err = road_recon("estimate", "fir_ridge", "d.csv")
    assert code == 2 and "the state of the struts is missing" in err
    code, _, err = road_recon("classify", "d.parquet", "--mode", "ride")
    assert code == 2 and "leave out --mode" in err


def test_choices_for_a_table_are_saved_and_read(road_recon, tmp_path):
    road_recon("simulate", *DRIVE, "--out", "d.csv")
    table = pd.read_csv(tmp_path / "d.csv", comment="#")
    table = table.rename(columns={"a_rf [m/s2]": "front", "v [m/s]": "pace"})
    table.drop(columns=["s [m]"]).to_csv(tmp_path / "own.csv", index=False)
    code, _, err = road_recon("classify", "own.csv")
    assert code == 2 and "2 problems" in err and "--columns a_rf=NAME" in err
    names = ("--columns", "a_rf=front,v=pace", "--units", "a_rf=m/s2")
    code, first, _ = road_recon("classify", "own.csv", *names, "--save-description", "d.yaml")
    assert code == 0
    code, again, _ = road_recon("classify", "own.csv", "--description", "d.yaml")
    assert code == 0 and again == first
    code, _, err = road_recon("classify", "own.csv", "--columns", "a_rf:front")
    assert code == 2 and "key=value" in err


@pytest.mark.costly
def test_scores_of_an_estimate_are_printed_with_their_units(road_recon):
    road_recon("simulate", *DRIVE, "--out", "d.parquet", "--truth", "t.csv")
    code, out, _ = road_recon("estimate", "wiener", "d.parquet", "--truth", "t.csv")
    lines = {line.rsplit(maxsplit=2)[0]: line.split()[-2:] for line in out.splitlines()}
    assert code == 0 and lines["IRI error"][1] == "mm/m"
    assert float(lines["DSD distance"][0]) >= 0.0 and lines["DSD distance"][1] == "dB"
    assert "scores" not in out and "nrmse" not in out
    code, _, err = road_recon("estimate", "m.npz", "d.parquet", "--set", "passes=2")
    assert code == 2 and "takes no others" in err


def test_training_a_network_reports_why_it_stopped(road_recon):
    code, out, _ = road_recon(
        "train", "static_lm", *DRIVE, "--set", "max_epochs=3", "--out", "m.npz", "--json"
    )
    facts = json.loads(out)
    assert code == 0 and facts["epochs"] <= 3 and facts["stopped_by"]


def test_roads_are_listed_with_class_and_rms(road_recon):
    code, out, _ = road_recon("roads", "list", "--json")
    rows = {row["road"]: row for row in json.loads(out)}
    assert code == 0
    assert rows["iso_d"]["class"] == "D" and rows["iso_f"]["class"] == "F"
    assert rows["flat"]["rms_mm"] == [0.0, 0.0]


def test_a_road_is_plotted_and_exported(road_recon, tmp_path):
    assert road_recon("roads", "plot", "belgian", "--out", "b.png")[0] == 0
    assert (tmp_path / "b.png").stat().st_size > 10_000
    assert road_recon("roads", "export", "bump_small", "--out", "b.csv")[0] == 0
    again = load_road(tmp_path / "b.csv").realise(np.random.default_rng(0))
    assert again.z.max() == pytest.approx(0.1, abs=1e-6)


@pytest.mark.parametrize(
    "out", [("t.csv",), ("t.parquet",), ("t.erd",), ("t.crg",), ("t.crg", "--form", "LRFI")]
)
def test_an_exported_road_can_be_read_back_from_every_format(road_recon, tmp_path, out):
    assert road_recon("roads", "export", "twist", "--out", *out)[0] == 0
    again = load_road(tmp_path / out[0]).realise(np.random.default_rng(0))
    drawn = load_road("twist").realise(np.random.default_rng(1))
    np.testing.assert_allclose(again.z, drawn.z, atol=1e-6)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("simulate", "--road", "belgiun"), ["belgiun", "did you mean 'belgian'"]),
        (("simulate", "--road", "nowhere.crg"), ["nowhere.crg"]),
        (("simulate", "--mode", "hard"), ["hard", "handling", "ride"]),
        (("simulate", "--mode", "front=ride"), ["front and rear"]),
        (("simulate", "--plant", "mujoco", "--vehicle", "saloon", "--mode", "ride"), ["passive"]),
        (("simulate", "--grade", "S9"), ["unknown grade 'S9'", "S0, S1, S2, S3, S4"]),
        (("simulate", "--speed-kmh", "0"), ["speed", "above 0"]),
        (("simulate", "--speed-kmh", "-3"), ["speed", "above 0"]),
        (("simulate", "--road", "iso_a", "--length", "2"), ["shorter than the wheelbase"]),
        (("simulate", "--vehicle", "beetle"), ["beetle", "land_rover_defender_110"]),
        (("simulate", "--out", "no/where.parquet"), ["no does not exist"]),
        (("simulate", "--out", "record.xlsx"), [".parquet or .csv"]),
        (("roads", "export", "flat", "--out", "f.xlsx"), [".csv or .parquet or .crg or .erd"]),
        (("roads", "export", "flat", "--out", "f.crg", "--form", "ABC"), ["ABC", "KDBI"]),
        (("roads", "export", "flat", "--out", "f.csv", "--form", "KDBI"), ["for .crg files only"]),
        (("estimate", "flat", "missing.parquet"), ["missing.parquet"]),
        (("estimate", "flot", "missing.parquet"), ["flot", "did you mean 'flat'"]),
        (("train", "flat", "--road", "iso_a", "--out", "m.npz"), ["flat is not trainable"]),
        (
            ("train", "static_lm", "--road", "iso_a", "--out", "m.npz", "--set", "hiden=3"),
            ["hiden", "did you mean 'hidden'"],
        ),
        (
            ("train", "static_lm", "--road", "iso_a", "--out", "m.npz", "--set", "hidden"),
            ["key=value"],
        ),
        (("policies", "--policy", "randum"), ["randum", "did you mean 'random'"]),
        (("policies", "--policy", "rrmz"), ["rrmz", "did you mean 'rrms'"]),
        (("train-policy", "--out", "n.txt"), [".npz"]),
        (("leaderboard", "--task", "paper_9"), ["paper_9", "paper_1"]),
        (("leaderboard", "--estimator", "flot"), ["flot", "did you mean 'flat'"]),
        (("leaderboard", "--board", "new-roads"), ["new_roads", "did you mean 'new_road'"]),
        (("leaderboard", "--without", "kalmann"), ["kalmann", "did you mean 'kalman'"]),
        (("leaderboard", "--estimator", "flat", "--without", "tcn"), ["not both"]),
    ],
)  # fmt: skip
@pytest.mark.costly
def test_invalid_input_gives_one_sentence_and_writes_no_file(road_recon, tmp_path, words, message):
    code, out, err = road_recon(*words)
    assert code == 2
    assert err.startswith("error: ") and err.count("\n") == 1 and "Traceback" not in err
    for word in message:
        assert word in err
    assert out == "" and list(tmp_path.iterdir()) == []


def test_no_sentence_holds_commands_of_a_terminal(road_recon):
    code, _, err = road_recon("season", "--out", "\x1b]0;x", "--reveal", "--salt", "a")
    assert code == 2 and "]0;x" in err and "\x1b" not in err


@pytest.mark.parametrize(
    ("written", "words"),
    [
        ("'x' is not a valid integer.", "must be a whole number"),
        ("'x' is not a valid int range.", "must be a whole number"),
        ("'x' is not a valid float.", "must be a number"),
        ("-1 is not in the range x>=0.", "must be at least 0"),
        ("7 is not in the range 0<=x<=1.", "must be from 0 to 1"),
        ("Input should be a valid integer, unable to parse", "must be a whole number"),
        ("Input should be greater than or equal to 0", "must be at least 0"),
    ],
)  # fmt: skip
def test_what_versions_of_typer_write_of_a_value_has_the_same_words(written, words):
    sentence = cli._usage_sentence(typer.BadParameter(written, param_hint="'--seed'"))
    assert sentence == f"--seed {words}; try 'road-recon --help'"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("simulate", "--seed", "x"), "--seed must be a whole number, got 'x'; try 'road-recon "),
        (("simulate", "--seed=-1"), "--seed must be at least 0, got '-1'; try"),
        (("simulate", "--length", "abc"), "--length must be a number, got 'abc'; try"),
        (("simulate", "--colour"), "no such option: --colour"),
        (("simulat",), "no such command 'simulat': did you mean 'simulate'"),
        (("classify",), "missing argument 'record'; try 'road-recon classify --help'"),
        (("list", "vehicels"), "unknown kind of names 'vehicels' (did you mean 'vehicles'?)"),
    ],
)  # fmt: skip
def test_words_that_the_command_line_does_not_know_get_one_sentence_too(road_recon, words, message):
    code, out, err = road_recon(*words)
    assert (code, out) == (2, "") and err.startswith(f"error: {message}")
    assert err.count("\n") == 1 and "Input should" not in err


def test_a_missing_extra_is_a_sentence_and_leaves_nothing(road_recon, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    code, _, err = road_recon("dataset", "--out", "d", "--drives", "10", "--episodes", "skyhook")
    assert code == 2 and err.startswith("error: ") and "road-envs[minari]" in err
    assert err.count("error") == 1 and "Traceback" not in err and list(tmp_path.iterdir()) == []
    code, _, err = road_recon("dataset", "--out", "d", "--episodes", "skihook")
    assert code == 2 and "unknown policy 'skihook' (did you mean 'skyhook'?)" in err


def test_bytes_that_are_no_parquet_file_are_called_damaged(road_recon, tmp_path):
    (tmp_path / "d.parquet").write_bytes(np.random.default_rng(1).bytes(5000))
    for words in (("classify", "d.parquet"), ("simulate", "--road", "d.parquet")):
        code, _, err = road_recon(*words)
        assert code == 2 and err.startswith("error: d.parquet: damaged, or no Parquet file")


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_names_is_listed_with_a_line_on_each(road_recon, kind):
    code, out, _ = road_recon("list", kind, "--json")
    lines = json.loads(out)
    assert code == 0 and lines and all(len(text) > 5 for text in lines.values())
    if kind != "policies":  # whose files have settings of some policies
        assert set(config.names(kind)) <= set(lines)
    code, out, _ = road_recon("list", kind)
    assert code == 0 and all(name in out for name in lines)


def test_the_help_names_the_vehicles_the_sensors_and_the_modes(road_recon):
    _, out, _ = road_recon("simulate", "--help")
    shown = " ".join(out.split())
    for kind in ("vehicles", "sensors"):
        assert ", ".join(config.names(kind)) in shown
    assert "ride, handling, soft_high, stiff_low, passive" in shown


def test_a_path_longer_than_the_terminal_is_printed_whole():
    path, console = "/a/folder" * 20, Console(width=60, file=io.StringIO())
    for part in facts_table({"page": path, "rows": 3}):
        console.print(part)
    assert path in "".join(console.file.getvalue().replace("page", "").split())


def test_debug_shows_the_traceback(monkeypatch):
    from road_envs.core.config import ConfigError

    monkeypatch.setattr(sys, "argv", ["road-recon", "--debug", "simulate", "--road", "belgiun"])
    with pytest.raises(ConfigError):
        cli.main()


@pytest.mark.parametrize(
    "words",
    [
        ("estimate", "in_this_folder:Other", "none.csv"),
        ("report", "none.csv", "--out", "page", "--estimator", "in_this_folder:Other"),
        ("leaderboard", "--task", "new_road", "--estimator", "in_this_folder:Other"),
    ],
    ids=lambda words: words[0],
)
def test_an_estimator_may_be_in_a_module_of_this_folder(road_recon, tmp_path, monkeypatch, words):
    def stop(limits):
        raise ConfigError("not run here")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [x for x in sys.path if x not in ("", str(tmp_path))])
    monkeypatch.setenv(CLASS_FOLDER, "")
    monkeypatch.setattr("leaderboard.commands.board.SandboxClient", stop)
    (tmp_path / "in_this_folder.py").touch()
    code, _, err = road_recon(*words)
    assert code == 2 and os.environ[CLASS_FOLDER] == str(tmp_path)
    # in the judge's process nothing is imported from there
    assert (str(tmp_path) in sys.path) == (words[0] != "leaderboard")
    assert words[0] != "estimate" or "the module in_this_folder has no Other" in err
