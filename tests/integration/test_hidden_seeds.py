"""Hidden test sets: the commitment fixes them, and the salt reveals and verifies them."""

import json

import pytest
from typer.testing import CliRunner

from leaderboard.cli import app
from leaderboard.evaluation import hidden_seeds
from leaderboard.evaluation.tasks import load_task
from road_envs.core.config import ConfigError

SALT = "correct horse battery"


@pytest.fixture
def published(tmp_path):
    hidden_seeds.save(hidden_seeds.commit(SALT, [load_task("class")]), tmp_path)
    return tmp_path


def test_the_published_file_contains_neither_salt_nor_seeds(published):
    text = (published / hidden_seeds.COMMITMENT).read_text()
    assert [path.name for path in published.iterdir()] == [hidden_seeds.COMMITMENT]
    assert SALT not in text and load_task("class").digest in text
    for seed in hidden_seeds.seeds(SALT, load_task("class"), 10):
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


def test_another_salt_gives_other_seeds_and_another_commitment():
    t = load_task("class")
    one, other = (hidden_seeds.commit(salt, [t]).commitment for salt in (SALT, SALT + "!"))
    assert one != other and one == hidden_seeds.commit(SALT, [t]).commitment
    assert not set(hidden_seeds.seeds(SALT, t, 50)) & set(hidden_seeds.seeds(SALT + "!", t, 50))


def test_one_salt_gives_different_seeds_for_each_task():
    found = [set(hidden_seeds.seeds(SALT, load_task(name), 20)) for name in ("class", "new_road")]
    assert not found[0] & found[1]


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
    with pytest.raises(ConfigError, match="at least 12 characters, got 6"):
        hidden_seeds.commit("winter", [load_task("class")])
    with pytest.raises(ConfigError, match="No such file"):
        hidden_seeds.reveal(SALT, tmp_path / "nothing")


def test_a_task_changed_after_the_commitment_is_refused(published, monkeypatch):
    older = load_task("class").with_test_drives(20)
    monkeypatch.setattr(hidden_seeds, "load_task", lambda name: older)
    with pytest.raises(ConfigError, match="class: the public task has changed"):
        hidden_seeds.reveal(SALT, published)


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
