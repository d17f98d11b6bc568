"""Hidden test sets: the commitment fixes them, and the salt reveals and verifies them."""

import dataclasses
import hashlib
import html
import json
import re
import shutil
import sys
from pathlib import Path

import pytest
import yaml
from board_runs import Counting, make_request
from fake_estimators import Reader
from typer.testing import CliRunner

from leaderboard.cli import app
from leaderboard.commands.options import LimitOptions
from leaderboard.commands.submit import results_site
from leaderboard.evaluation.tasks import load_task
from leaderboard.evaluation.test_data import simulate_drives
from leaderboard.report.notes import PUBLIC_ROADS, SEALED_ROADS
from leaderboard.report.sentences import build_report
from leaderboard.report.site import write_site
from leaderboard.running.board import run_board
from leaderboard.sandbox.limits import Limits
from leaderboard.submission import hidden_seeds
from leaderboard.submission.rules import load_rules, make_run_request
from road_envs.core import config
from road_envs.core.atomic_io import write_text
from road_envs.core.config import ConfigError, find, read_yaml
from road_envs.core.extras import EXTRAS

SALT = "correct horse battery"


@pytest.fixture
def published(tmp_path):
    hidden_seeds.save(hidden_seeds.commit(SALT, [load_task("class")]), tmp_path)
    return tmp_path


def test_the_published_file_contains_neither_salt_nor_seeds(published):
    text = (published / hidden_seeds.COMMITMENT).read_text()
    assert [path.name for path in published.iterdir()] == [hidden_seeds.COMMITMENT]
    assert SALT not in text and load_task("class").digest in text
    (path,) = hidden_seeds.reveal(SALT, published)
    for seed in load_task(path).test.all_seeds:
        assert str(seed) not in text


def test_revealed_tasks_differ_from_the_public_ones_only_in_their_seeds(published):
    (path,) = hidden_seeds.reveal(SALT, published)
    public, hidden = load_task("class").with_test_drives(None), load_task(path)
    assert hidden.name == f"class_{hidden_seeds.load(published).commitment[:8]}"
    assert hidden.conditions == public.conditions and hidden.training == public.training
    assert len(hidden.test.roads_and_seeds) == len(public.test.roads_and_seeds) == 50
    assert [road for road, _ in hidden.test.roads_and_seeds] == [
        road for road, _ in public.test.roads_and_seeds
    ]
    used = public.training.all_seeds | public.test.all_seeds
    assert not hidden.test.all_seeds & used and len(hidden.test.all_seeds) == 50


def revealed(name, folder):
    """Return a shipped task and the one that is committed and revealed for it in a folder."""
    public = load_task(name)
    for module in EXTRAS["plants"] if any(x.plant for x in public.conditions) else ():
        pytest.importorskip(module, reason="the extra `plants` is not installed")
    hidden_seeds.save(hidden_seeds.commit(SALT, [public]), folder)
    (path,) = hidden_seeds.reveal(SALT, folder)
    return public, load_task(path)


@pytest.mark.parametrize("name", config.names("tasks"))
@pytest.mark.costly
def test_every_shipped_task_is_committed_and_revealed(name, tmp_path):
    """And verified by anyone with the salt."""
    public, hidden = revealed(name, tmp_path)
    assert hidden.conditions == public.conditions and hidden.board_name == public.board_name
    assert not hidden.test.all_seeds & (public.training.all_seeds | public.test.all_seeds)
    commitment = hidden_seeds.load(tmp_path)
    drawn = hidden_seeds._seeds(SALT, commitment, public, public.digest, len(public.test.seeds))
    assert list(hidden.test.seeds) == drawn  # what anyone finds who has the salt
    driven = [
        len(t.drives_of(t.test, condition)) for t in (public, hidden) for condition in t.conditions
    ]
    half = len(driven) // 2
    assert driven[half:] >= driven[:half] and min(driven) > 0


UNLIKE = (
    "class", "field", "field_known", "field_bumps", "field_receiver", "new_road", "paper_1",
    "paper_5", "plants_told",
)  # fmt: skip
"""Tasks of every board, with and without calibration, obstacles and a road for training."""


def test_these_tasks_are_of_every_board():
    boards = [{load_task(name).board_name for name in x} for x in (UNLIKE, config.names("tasks"))]
    assert boards[0] == boards[1]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.processes if name in UNLIKE else pytest.mark.slow)
        for name in config.names("tasks")
    ],
)
def test_a_revealed_task_is_run_and_shown_on_its_page(name, tmp_path):
    _, hidden = revealed(name, tmp_path)
    length = None if hidden.bumps else 32.0  # an obstacle stands where it stands
    drives = [dataclasses.replace(x, length=length) for x in (hidden.test, hidden.training)]
    short = dataclasses.replace(hidden, test=drives[0], training=drives[1], bound=False)
    request = make_request({"reader": Reader()}, short, seeds=(1,), roads=1)
    board = run_board(request, tmp_path / "out", Counting({"reader": Reader()}))
    (ran,) = request.sized_tasks()
    assert "reader" in {row.estimator for row in board.scored(ran)} and not board.failed(ran)
    write_site(board, build_report(board), tmp_path / "out")
    season = hidden_seeds.load(tmp_path).commitment[:8]
    index = (tmp_path / "out" / "index.html").read_text()
    assert hidden.name.endswith(season) and hidden.title in html.unescape(index)
    page = (tmp_path / "out" / "estimators" / "reader.html").read_text()
    assert season in page and SALT not in index + page


@pytest.mark.costly
def test_a_season_of_the_plants_is_driven_by_them(tmp_path):
    for extra in ("mujoco", "vehiclemodels"):
        pytest.importorskip(extra, reason="the extra `plants` is not installed")
    hidden_seeds.save(hidden_seeds.commit(SALT, [load_task("plants_blind")]), tmp_path)
    hidden = load_task(hidden_seeds.reveal(SALT, tmp_path)[0])
    short = [dataclasses.replace(x, length=20.0) for x in (hidden.test, *hidden.calibration)]
    hidden = dataclasses.replace(hidden, test=short[0], calibration=tuple(short[1:]))
    of_plant = {condition.plant: condition for condition in hidden.conditions}
    assert "mujoco" in of_plant
    for condition in of_plant.values():
        (drive,) = simulate_drives(hidden, hidden.test, condition)
        assert drive.seed in hidden.test.seeds and drive.record.length == 20.0
        assert len(drive.calibration) == len(hidden.calibration) > 0


@pytest.fixture
def without_plants(monkeypatch):
    for module in EXTRAS["plants"]:
        monkeypatch.setitem(sys.modules, module, None)


NO_PLANT = r"the drive mujoco_.* is not kept: .*pip install 'road-envs\[plants\]'"


def test_a_season_of_the_plants_is_not_published_without_their_programs(tmp_path, without_plants):
    error = run("--out", tmp_path / "autumn", "--task", "plants_blind").exception
    assert isinstance(error, ConfigError) and re.match(
        f"plants_blind_.{{8}}: {NO_PLANT}", str(error)
    )
    assert not (tmp_path / "autumn").exists()


def test_rules_with_drives_of_plants_that_cannot_be_made_are_refused(tmp_path, without_plants):
    rules = tmp_path / "rules.yaml"
    rules.write_text("tasks: [plants_blind]\n")  # whose drives are kept
    assert list(results_site(tmp_path, check=True, limits=LimitOptions()).facts["tasks"])
    text = find("tasks", "plants_blind").read_text().replace("seeds: [7101]", "seeds: [7102]")
    (tmp_path / "mine.yaml").write_text(text.replace("name: plants_blind", "name: mine"))
    rules.write_text("tasks: [mine.yaml]\n")
    with pytest.raises(ConfigError, match=f"^mine: {NO_PLANT}"):
        results_site(tmp_path, check=True, limits=LimitOptions())


def test_the_design_of_the_public_drives_is_repeated_over_the_hidden_ones(tmp_path):
    hidden_seeds.save(hidden_seeds.commit(SALT, [load_task("new_road")]), tmp_path)
    hidden = load_task(hidden_seeds.reveal(SALT, tmp_path)[0])
    assert len(hidden.test.roads_and_seeds) == 60
    assert hidden.test.design[0] == (0, 5, 12, 17, 24, 29, 36, 41, 48, 53)
    families = [{hidden.test.families[k % 6] for k in indices} for indices in hidden.test.design]
    assert set().union(*families) == set(hidden.test.families)


def test_a_task_that_could_not_be_revealed_cannot_be_committed(monkeypatch):
    broken = {**config.read_yaml(config.find("tasks", "class")), "conditions": []}
    monkeypatch.setattr(hidden_seeds, "read_yaml", lambda path: broken)
    with pytest.raises(ConfigError, match="class: it cannot have a season: conditions"):
        hidden_seeds.commit(SALT, [load_task("class")])


def test_another_salt_gives_other_seeds_and_another_commitment():
    t = load_task("class")
    one, other = (hidden_seeds.commit(salt, [t]).commitment for salt in (SALT, SALT + "!"))
    assert one != other and one == hidden_seeds.commit(SALT, [t]).commitment
    assert not {*drawn(SALT, "class")[0]} & {*drawn(SALT + "!", "class")[0]}


def drawn(salt, *names):
    """Return the seeds of tasks that are committed together."""
    tasks = [load_task(name) for name in names]
    hidden = hidden_seeds.commit(salt, tasks)
    return [hidden_seeds._seeds(salt, hidden, task, task.digest, 20) for task in tasks]


def test_one_salt_gives_different_seeds_for_each_task_and_each_commitment():
    both, alone = drawn(SALT, "class", "new_road"), drawn(SALT, "class")
    assert len({*both[0], *both[1], *alone[0]}) == 60


def test_neither_a_seed_nor_a_guessed_salt_can_be_tried_millions_of_times(monkeypatch):
    """The first sample of a record is noise alone, of which the seed is known to who finds it."""
    seeds = [seed for found in drawn(SALT, "class", "new_road") for seed in found]
    assert max(seeds) < 2**62 and max(seeds) > 2**60  # of 40 seeds
    slow = []
    monkeypatch.setattr(
        hidden_seeds.hashlib, "scrypt", lambda word, **cost: slow.append(cost) or b"1"
    )
    drawn(SALT, "class")
    assert len(slow) >= 2 and all(cost["n"] >= 2**14 for cost in slow)


def test_a_season_of_other_roads_than_were_committed_to_is_refused(published):
    (path,) = hidden_seeds.reveal(SALT, published)
    rules = published / "rules.yaml"
    rules.write_text(f"tasks: [{path.name}]\n")
    assert (published / hidden_seeds.SALT).read_text() == SALT
    assert [task.name for task in load_rules(rules)[1]] == [load_task(path).name]
    (published / "current").symlink_to(".")
    for way in ("current", ".", "../" + published.name):
        rules.write_text(f"tasks: [{way}/{path.name}]\n")
        with pytest.raises(ConfigError, match="a path here has neither links nor"):
            load_rules(rules)
    rules.write_text(f"tasks: [{path.name}]\n")
    text = path.read_text()
    path.write_text(text.replace(f"- {load_task(path).test.seeds[0]}\n", "- 7\n", 1))
    with pytest.raises(ConfigError, match=f"{path.name}: it is no task of the commitment in"):
        load_rules(rules)
    path.write_text(text)
    (published / hidden_seeds.SALT).write_text(SALT + "?")
    with pytest.raises(ConfigError, match="the salt does not match the commitment"):
        load_rules(rules)
    (published / hidden_seeds.SALT).unlink()
    with pytest.raises(ConfigError, match=r"salt.txt.*No such file"):
        load_rules(rules)


def test_a_commitment_beside_the_rules_says_nothing_of_public_tasks(published):
    for _ in range(2):
        (published / "rules.yaml").write_text("tasks: [new_road]\n")
        assert [task.name for task in load_rules(published / "rules.yaml")[1]] == ["new_road"]
        hidden_seeds.reveal(SALT, published)


@pytest.mark.parametrize("below", ["", "more/"])
@pytest.mark.costly
def test_a_task_that_is_not_drawn_from_the_commitment_is_refused(tmp_path, below):
    """Neither beside a task of no version nor in a folder below: by hand, roads are chosen."""
    hidden = hidden_seeds.commit(SALT, [load_task("class"), load_task("new_road")])
    odd = dataclasses.replace(hidden, tasks={**hidden.tasks, "class": "0" * 64})
    odd = dataclasses.replace(odd, commitment=hidden_seeds._commitment(SALT, odd))
    for one in (hidden, odd):
        folder = tmp_path / one.commitment[:8]
        hidden_seeds.save(one, folder)
        (folder / hidden_seeds.SALT).write_text(SALT)
        for task in ("class", "new_road"):
            name = f"{below}{task}_{one.commitment[:8]}.yaml"
            data = read_yaml(find("tasks", task)) | {"name": Path(name).stem}
            write_text(folder / name, yaml.safe_dump(data))
            (folder / "rules.yaml").write_text(f"tasks: [{name}]\n")
            why = "it is no task of the commitment|the public task has changed since"
            why = "a season stands beside its commitment" if below else why
            with pytest.raises(ConfigError, match=why):
                load_rules(folder / "rules.yaml")


@pytest.fixture
def refused(published):
    """Whether rules refuse the file of a season with other keys of its task, or of its test."""
    (path,) = hidden_seeds.reveal(SALT, published)
    rules = published / "rules.yaml"
    rules.write_text(f"tasks: [{path.name}]\n")
    task = read_yaml(path)

    def is_refused(test=None, **keys):
        path.write_text(yaml.safe_dump({**task, **keys, "test": task["test"] | (test or {})}))
        try:
            load_rules(rules)
        except ConfigError as error:
            assert "it is no task of the commitment" in str(error)
            return True
        return False

    return is_refused


@pytest.mark.costly
def test_a_later_package_may_describe_a_task_in_other_words(refused, monkeypatch):
    assert not refused() and refused(title="Roads")
    monkeypatch.setattr(hidden_seeds, "package_version", lambda: "99.0")
    assert not refused() and not refused(title="Roads")
    assert refused(board="paper")  # which would rank by another score
    families = {"families": ["easy", "hard", "hard", "hard", "hard"]}
    assert refused(families) and refused(claimed_level_error=0.1)


@pytest.mark.costly
def test_the_seeds_of_a_season_are_those_of_its_salt_in_any_later_package(
    refused, published, monkeypatch
):
    later = dataclasses.replace(load_task("class"), version=99)
    (seeds,) = drawn(SALT, "class")
    monkeypatch.setattr(hidden_seeds, "package_version", lambda: "99.0")
    monkeypatch.setattr(
        hidden_seeds, "load_task", lambda name: later if name == "class" else load_task(name)
    )
    assert not refused() and not refused({"seeds": seeds[:10]})
    (season,) = load_rules(published / "rules.yaml")[1]  # whose conditions are taken on trust
    assert season.note.endswith(hidden_seeds.SEEDS_ALONE)
    assert refused({"seeds": [7, *seeds[1:10]]}) and refused({"seeds": seeds[:9], "number": 45})


def test_a_site_begins_with_the_season_and_says_which_roads_of_its_own_are_public(published):
    (path,) = hidden_seeds.reveal(SALT, published)
    (published / "mine").mkdir()
    text = find("tasks", "class").read_text().replace("name: class", "name: own")
    (published / "mine" / "own.yaml").write_text(text)
    rules = published / "rules.yaml"
    rules.write_text(f"tasks: [new_road, mine/own.yaml, {path.name}]\n")
    season, shipped, own = load_rules(rules)[1]
    assert [season.name, shipped.name, own.name] == [path.stem, "new_road", "own"]
    assert PUBLIC_ROADS in own.note and not own.is_public and shipped.is_public
    assert season.note == f"{load_task('class').note} {SEALED_ROADS}"


def test_a_season_whose_roads_no_seed_varies_says_that_they_are_known(tmp_path):
    tasks = [load_task(name) for name in ("class", "paper_1")]
    hidden_seeds.save(hidden_seeds.commit(SALT, tasks), tmp_path)
    paths = hidden_seeds.reveal(SALT, tmp_path)
    (tmp_path / "rules.yaml").write_text(f"tasks: [{', '.join(path.name for path in paths)}]\n")
    drawn, fixed = load_rules(tmp_path / "rules.yaml")[1]
    assert drawn.note == f"{tasks[0].note} {SEALED_ROADS}"
    assert fixed.note.endswith(hidden_seeds.KNOWN_ROADS) and tasks[1].note in fixed.note


def test_rules_name_some_tasks_and_each_once(tmp_path):
    rules = tmp_path / "rules.yaml"
    wrong = {"[]": "must have at least 1", "[class, class]": "two tasks are named"}
    wrong[f"[{'a' * 300}]"] = "unknown task"  # the system takes no path of that length
    for text, why in wrong.items():
        rules.write_text(f"tasks: {text}\n")
        with pytest.raises(ConfigError, match=why):
            make_run_request(*load_rules(rules), [], Limits()).sized_tasks()


@pytest.mark.parametrize("blank", ["\r", "\u0085", "\u2028", "\u00a0"])
def test_blanks_of_other_alphabets_part_no_words_of_the_rules(tmp_path, blank):
    """The script parts them at those of ASCII alone; YAML breaks lines at the first three, and a
    carriage return ends no comment for the script.
    """
    shutil.copy(find("tasks", "class"), tmp_path / "mine.yaml")
    text = f"tasks: ['mine.yam\\x6c'] # {blank}mine.yaml{blank}".replace("'", '"')
    if blank != "\u00a0":
        text = f"tasks:\n- new_road{blank}- mine.yaml{blank}seeds: 3\n"
    if blank == "\r":
        text = "tasks: # of autumn\r  [mine.yaml]\n"
    (tmp_path / "rules.yaml").write_bytes(text.encode())
    with pytest.raises(ConfigError, match="a path is one word of letters, digits and"):
        load_rules(tmp_path / "rules.yaml")


@pytest.mark.parametrize("text", [r'["cl\x61ss.yaml"]', "['a b.yaml']", '\n  - "cl\\\n  ass.yaml"'])
def test_a_path_that_the_rules_do_not_spell_out_is_refused(tmp_path, text):
    for name in ("class", "a b"):
        shutil.copy(find("tasks", "class"), tmp_path / f"{name}.yaml")
    (tmp_path / "rules.yaml").write_text(f"tasks: {text}\n")
    with pytest.raises(ConfigError, match="a path is one word of letters, digits and"):
        load_rules(tmp_path / "rules.yaml")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"commitment": "0" * 64}, "the salt does not match the commitment"),
        ({"roads": {"class": 3}}, "the salt does not match the commitment"),
        ({"tasks": {"class": "0" * 64}}, "the salt does not match the commitment"),
        ({"seeds": [1]}, "seeds: unknown key"),
    ],
)
def test_an_edited_commitment_file_is_refused(published, change, message):
    path = published / hidden_seeds.COMMITMENT
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(ConfigError, match=message):
        hidden_seeds.reveal(SALT, published)
    assert list(published.glob("*.yaml")) == []


def test_a_wrong_salt_a_short_salt_and_a_missing_file_are_refused(published, tmp_path):
    with pytest.raises(ConfigError, match="the salt does not match the commitment"):
        hidden_seeds.reveal(SALT + "?", published)
    with pytest.raises(ConfigError, match=r"at least 12 characters .* got 6"):
        hidden_seeds.commit("winter", [load_task("class")])
    with pytest.raises(ConfigError, match="No such file"):
        hidden_seeds.reveal(SALT, tmp_path / "nothing")


def test_a_task_changed_after_the_commitment_is_refused(published, monkeypatch):
    older = load_task("class").with_test_drives(20)
    monkeypatch.setattr(hidden_seeds, "load_task", lambda name: older)
    with pytest.raises(ConfigError, match="class: the public task has changed"):
        hidden_seeds.reveal(SALT, published)


def test_what_somebody_publishes_writes_no_other_folder_and_has_an_end(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    name = str(shutil.copy(config.find("tasks", "class"), tmp_path / "elsewhere"))
    hidden = hidden_seeds.commit(SALT, [load_task("class")])
    hidden = dataclasses.replace(
        hidden, tasks={name: load_task(name).digest}, roads={name: 10**30}, commitment=""
    )
    hidden = dataclasses.replace(hidden, commitment=hidden_seeds._commitment(SALT, hidden))
    hidden_seeds.save(hidden, tmp_path / "season")
    (path,) = hidden_seeds.reveal(SALT, tmp_path / "season")
    assert path.parent == tmp_path / "season"
    assert [x.name for x in (tmp_path / "elsewhere").iterdir()] == ["class.yaml"]
    assert len(load_task(path).test.seeds) == len(load_task("class").test.seeds)


LONG = "one of two salts, of which the owner shows the one with the better roads"


@pytest.mark.parametrize(
    ("committed", "shown"),
    [
        ("autumn in the hills", "autumn in the hills\0"),
        (LONG, hashlib.sha256(LONG.encode()).digest().decode("utf-8", "surrogateescape")),
    ],
)
def test_an_owner_cannot_choose_between_two_salts_of_one_commitment(committed, shown, tmp_path):
    """scrypt ignores zeros at the end, and takes a long salt for its digest."""
    with pytest.raises(ConfigError, match=r"at most 64 bytes, none of them 0"):
        hidden_seeds.save(hidden_seeds.commit(committed, [load_task("class")]), tmp_path)
        hidden_seeds.reveal(shown, tmp_path)


def test_a_salt_of_any_bytes_and_a_commitment_without_roads_end_in_no_traceback(tmp_path):
    salt = "\udcff" * 12  # as Python reads an argument that is no UTF-8
    hidden = hidden_seeds.commit(salt, [load_task("class")])
    hidden = dataclasses.replace(hidden, roads={}, commitment="")
    hidden = dataclasses.replace(hidden, commitment=hidden_seeds._commitment(salt, hidden))
    hidden_seeds.save(hidden, tmp_path)
    with pytest.raises(ConfigError, match=r"test\.seeds: must have at least 1 element"):
        hidden_seeds.reveal(salt, tmp_path)


def test_a_folder_can_hold_only_one_hidden_test_set(published):
    with pytest.raises(ConfigError, match="is of another hidden test set"):
        hidden_seeds.save(hidden_seeds.commit(SALT + "!", [load_task("class")]), published)


def run(*words):
    return CliRunner().invoke(app, ["season", *map(str, words)])


def test_the_command_draws_a_salt_and_reveals_the_tasks_with_it(tmp_path):
    result = run("--out", tmp_path, "--task", "class", "--json")
    facts = json.loads(result.stdout)
    salt = facts["salt, to be kept secret"]
    assert len(salt) >= 24 and facts["commitment"] == hidden_seeds.load(tmp_path).commitment
    shown = run("--out", tmp_path, "--salt", salt, "--reveal", "--json")
    (path,) = json.loads(shown.stdout)["tasks"]
    assert load_task(path).board == "class"
    assert isinstance(run("--out", tmp_path, "--reveal").exception, ConfigError)
    again = run("--out", tmp_path / "next", "--task", "class", "--salt", salt).exception
    assert "each season has a salt of its own" in str(again)
    assert not (tmp_path / "next").exists()


@pytest.mark.parametrize("name", ["Fr\u00fchjahr", 'x"y', "a b"])
def test_the_folder_of_a_season_has_a_name_that_every_program_shows_as_it_is(name, tmp_path):
    error = run("--out", tmp_path / name, "--task", "class").exception
    assert isinstance(error, ConfigError) and "letters A to Z and a to z, digits" in str(error)
