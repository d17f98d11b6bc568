"""Code that is newer than the roads of a season could know them: what the script asks git."""

import os
import shutil

import pytest
import results_repositories
import submissions
import yaml
from results_repositories import call, committed, merge_ref, of_season

from road_envs.core.config import find, read_yaml

made, submission = submissions.made, submissions.submission
verifies = results_repositories.verifies

CODE = "submissions/mine/code/a.whl"
RECORD_OF_MINE = {"submissions/mine/submission.json": "of mine"}
NEWER = "submissions/mine: its code is newer than the roads of seasons/1/class.yaml\n"


@pytest.mark.costly
def test_code_that_came_between_the_roads_and_the_rules_is_refused(verifies):
    repo, said = verifies
    roads, rules = of_season()
    committed(repo, "the roads", **roads)
    call("git", "branch", "-f", "main", cwd=repo)
    committed(repo, "mine", **RECORD_OF_MINE, **{CODE: "knows"})
    assert "verify-submission submissions/mine" in said()
    call("git", "branch", "-f", "main", cwd=repo)
    committed(repo, "the rules", **rules)
    assert said(status=1) == NEWER
    path = f"PATH={repo.parent}:{os.environ['PATH']}"
    assert call("env", path, "ci/verify.sh", cwd=repo, status=1) == NEWER


def moved(repo, roads, rules):
    """The season leaves the rules, so that new code is taken, and comes back from an archive."""
    committed(repo, "the season ends", **roads, **rules)
    committed(repo, "mine, later", **RECORD_OF_MINE, **{CODE: "knows"})
    call("git", "mv", "seasons/1", "seasons/archive", cwd=repo)
    return "seasons/archive/class.yaml"


def salt_first(repo, roads, rules):
    """The roads are drawn from the salt by whoever sees it."""
    committed(repo, "the salt", **{"seasons/1/salt.txt": "of the roads"})
    committed(repo, "mine, later", **RECORD_OF_MINE, **{CODE: "knows"})
    committed(repo, "the season ends", **roads)
    return "seasons/1/class.yaml"


def elsewhere(repo, roads, rules):
    committed(repo, "the season ends", **of_season("autumn/class.yml")[0])
    committed(repo, "mine, later", **RECORD_OF_MINE, **{CODE: "knows"})
    return "autumn/class.yml"


def at_the_root(repo, roads, rules):
    committed(repo, "the season ends", **of_season("class.yaml")[0])
    committed(repo, "mine, later", **RECORD_OF_MINE, **{CODE: "knows"})
    return "class.yaml"


def not_committed(repo, roads, rules):
    committed(repo, "the season ends", **roads)
    (repo / CODE).parent.mkdir(parents=True)
    (repo / CODE).write_text("knows")
    (repo / "submissions/mine/submission.json").write_text("of mine")
    return "seasons/1/class.yaml"


@pytest.mark.parametrize("way", [moved, salt_first, elsewhere, at_the_root, not_committed])
def test_code_that_is_newer_than_the_roads_is_found_wherever_they_stand(verifies, way):
    repo, _ = verifies
    shutil.rmtree(repo / "submissions" / "rival")  # it has no code
    committed(
        repo, "honest", **{"submissions/old/submission.json": "", CODE.replace("mine", "old"): "o"}
    )
    place = way(repo, *of_season())
    (repo / "rules.yaml").write_text(f"tasks: [{place}]\n")
    call("git", "commit", "-a", "-m", "the rules", cwd=repo)
    path = f"PATH={repo.parent}:{os.environ['PATH']}"
    newer = f"submissions/mine: its code is newer than the roads of {place}\n"
    assert call("env", path, "ci/verify.sh", cwd=repo, status=1) == newer
    shutil.rmtree(repo / "submissions" / "mine")
    if way is not not_committed:
        call("git", "commit", "-a", "-m", "mine is removed", cwd=repo)
    assert call("env", path, "ci/verify.sh", cwd=repo) == f"results-site {repo}\n"


def test_no_branch_hides_when_code_or_roads_came(verifies):
    """From before the roads, with code and the same roads in turn; its history is simplified."""
    repo, said = verifies
    roads, rules = of_season()
    call("git", "branch", "forged", cwd=repo)
    committed(repo, "the season ends", **roads, **rules)
    call("git", "branch", "-f", "main", cwd=repo)
    call("git", "switch", "forged", cwd=repo)
    committed(repo, "mine", **{CODE: "knows"})
    committed(repo, "the same roads", **roads, **{CODE: None})
    call("git", "merge", "-m", "main", "main", cwd=repo)
    committed(repo, "a word", **{"README.md": "A word."})
    merge_ref(repo, "forged")
    assert "class.yaml: changed and changed back" in said(status=1)
    call("git", "branch", "-f", "main", "forged", cwd=repo)  # without that: taken over as it is
    call("git", "switch", "-C", "mine", "main", cwd=repo)
    committed(repo, "mine", **RECORD_OF_MINE, **{CODE: "knows"})
    assert said(status=1) == NEWER


def test_rows_of_a_season_by_older_code_are_taken_from_a_branch_that_has_merged(verifies):
    repo, said = verifies
    committed(repo, "mine", **RECORD_OF_MINE, **{CODE: "honest"})
    call("git", "branch", "-f", "main", cwd=repo)
    call("git", "switch", "-C", "season", cwd=repo)
    roads, rules = of_season()
    committed(repo, "the season ends", **roads, **rules)
    merge_ref(repo, "season")
    call("git", "branch", "-f", "main", cwd=repo)
    call("git", "switch", "mine", cwd=repo)
    committed(repo, "a word", **{"submissions/mine/card.yaml": ""})
    call("git", "merge", "-m", "main", "main", cwd=repo)
    committed(repo, "rows", **{"submissions/mine/results/class.json": ""})
    merge_ref(repo, "mine")
    assert said() == "verify-submission submissions/mine\n"
    call("git", "branch", "-f", "main", "mine", cwd=repo)  # taken over as it is
    (repo / "rules.yaml").write_text(f"# a word\n{rules['rules.yaml']}")
    shutil.rmtree(repo / "submissions" / "rival")  # it has no code
    committed(repo, "rules")
    assert "rival is removed" in said(status=1)


@pytest.mark.parametrize(
    ("name", "content"), [("b.whl", "roads"), ("b.whl", "of the roads"), ('a"b', "of the roads")]
)
def test_roads_within_the_code_of_an_entry_make_no_other_one_newer(verifies, name, content):
    """Its branch, from before all others, is merged after the season, which it has seen."""
    repo, said = verifies
    call("git", "branch", "rival", cwd=repo)
    committed(repo, "mine", **RECORD_OF_MINE, **{CODE: "honest"})
    roads, rules = of_season()
    committed(repo, "the season ends", **roads, **rules, **{"seasons/1/salt.txt": "of the roads"})
    call("git", "branch", "-f", "main", cwd=repo)
    call("git", "switch", "rival", cwd=repo)
    committed(repo, "knows", **{f"submissions/rival/code/{name}": content})
    merge_ref(repo, "rival")
    call("git", "branch", "-f", "main", cwd=repo)
    call("git", "switch", "-C", "mine", cwd=repo)
    committed(repo, "a word", **{"submissions/mine/card.yaml": ""})
    assert said() == "verify-submission submissions/mine\n"


@pytest.mark.parametrize("season", ["seasons/Frühjahr/class.yaml", "a-1.yaml"])
def test_code_that_is_newer_than_a_season_of_any_name_is_refused(verifies, season):
    repo, said = verifies
    roads, rules = of_season(season)
    committed(repo, "the season ends", **roads, **rules)
    call("git", "branch", "-f", "main", cwd=repo)
    committed(repo, "mine", **{CODE: "knows"})
    assert said(status=1).endswith(f"newer than the roads of {season}\n")


def test_code_that_is_newer_than_the_roads_of_a_season_is_refused(verifies):
    repo, said = verifies
    (repo / "submissions" / "rival" / "code").mkdir()
    (repo / "submissions" / "rival" / "code" / "a.whl").write_text("a")
    for name, text in (
        ("rules.yaml", "tasks: [seasons/1/class.yaml]\n"),
        *of_season()[0].items(),
    ):
        call("git", "add", ".", cwd=repo)
        call("git", "commit", "-m", "before", cwd=repo)
        (repo / name).parent.mkdir(exist_ok=True)
        (repo / name).write_text(text)
    call("git", "add", ".", cwd=repo)
    call("git", "commit", "-m", "the season ends", cwd=repo)
    call("git", "branch", "-f", "main", cwd=repo)
    (repo / "submissions" / "rival" / "results" / "more.json").write_text("")
    assert "verify-submission submissions/rival" in said()  # with its row of the season
    newer = "its code is newer than the roads of seasons/1/class.yaml\n"
    mine = shutil.copytree(repo / "submissions" / "rival", repo / "submissions" / "mine")
    assert said(status=1).endswith(f"submissions/mine: {newer}")
    shutil.rmtree(mine)
    (repo / "submissions" / "rival" / "code" / "a.whl").write_text("b")
    assert said(status=1) == f"submissions/rival: {newer}"
    (repo / "rules.yaml").write_text("tasks: [class]\n")
    assert "verify-submission submissions/rival" in said()


@pytest.fixture
def older(verifies):
    """The repository, what its script says, and a branch `older` than a second rival's code and
    than the season that ends later.
    """
    repo, said = verifies
    call("git", "switch", "main", cwd=repo)
    committed(repo, "its code", **{"submissions/rival/code/a.whl": "knows nothing"})
    call("git", "branch", "older", cwd=repo)
    files = {"submission.json": "of the second", "code/a.whl": "knows nothing"}
    committed(repo, "a rival", **{f"submissions/second/{x}": y for x, y in files.items()})
    roads, rules = of_season()
    committed(repo, "the season ends", **roads, **rules, **{"seasons/1/salt.txt": "the salt"})
    return repo, said


def test_a_branch_that_takes_the_roads_from_the_main_line_makes_no_older_code_newer(older):
    """As `Update branch` does: the first parent of that merge has neither roads nor rival."""
    repo, said = older
    call("git", "switch", "older", cwd=repo)
    committed(repo, "a note", **{"docs/note.txt": "a note"})
    call("git", "merge", "-m", "updated", "main", cwd=repo)
    assert said() == "no submission differs from main\n"
    merge_ref(repo, "older")
    path = f"PATH={repo.parent}:{os.environ['PATH']}"
    assert "results-site" in call("env", path, "ci/verify.sh", cwd=repo)


@pytest.mark.parametrize("content", ["roads", "the salt"])
def test_a_branch_that_adds_the_roads_once_more_is_refused(older, content):
    """Else code that it lacks would be newer than they are, and its owner locked out."""
    repo, said = older
    call("git", "switch", "older", cwd=repo)
    committed(repo, "added", **{"docs/x": content})
    merge_ref(repo, "older")
    assert said(status=1).endswith("adds a file that main has: rebase the branch onto it\n")


def test_a_name_within_another_word_of_the_rules_is_no_season(verifies):
    repo, said = verifies
    committed(repo, "notes", **of_season("s.yaml")[0], **of_season("seasons/s.yaml")[1])
    call("git", "branch", "-f", "main", cwd=repo)
    committed(repo, "mine", **RECORD_OF_MINE, **{CODE: "new"})
    assert said() == "verify-submission submissions/mine\n"


@pytest.mark.parametrize("text", ["tasks: [short.yaml]", "tasks: [new_road]  # then short.yaml"])
def test_a_task_of_its_own_hides_no_roads(verifies, text):
    repo, said = verifies
    committed(repo, "the rules", **{"short.yaml": "public roads", "rules.yaml": f"{text}\n"})
    call("git", "branch", "-f", "main", cwd=repo)
    committed(repo, "mine", **RECORD_OF_MINE, **{CODE: "new"})
    assert said() == "verify-submission submissions/mine\n"


def test_the_pull_request_of_a_season_is_told_which_entries_it_makes_newer(verifies):
    """An honest entry was merged into the main line after the season's branch began."""
    repo, said = verifies
    committed(repo, "its code", **{"submissions/rival/code/a.whl": "knows nothing"})
    call("git", "branch", "-f", "main", cwd=repo)
    roads, rules = of_season()
    committed(repo, "the season ends", **roads, **rules)
    assert said() == "no submission differs from main\n"
    call("git", "switch", "main", cwd=repo)
    committed(repo, "merged meanwhile", **RECORD_OF_MINE, **{CODE: "knows nothing"})
    call("git", "switch", "mine", cwd=repo)
    call("git", "merge", "-m", "updated", "main", cwd=repo)
    assert said(status=1) == NEWER
    call("git", "reset", "--hard", "main", cwd=repo)
    committed(repo, "the season ends", **roads, **rules)
    assert said() == "no submission differs from main\n"


def test_rules_that_cannot_be_read_are_refused_before_all_that_comes_after_them(verifies):
    repo, said = verifies
    assert said() == "no submission differs from main\n"
    asked = repo.parent / "asked"
    (repo.parent / "road-recon").write_text(f"#!/bin/sh\necho $* >{asked}\nexit 2\n")
    committed(repo, "a typo", **{"seasons/1/new_raod.yaml": "roads"})
    assert said(status=2) == ""
    assert asked.read_text() == f"results-site {repo} --check --isolation bubblewrap\n"


@pytest.mark.costly
def test_the_rules_of_a_repository_can_be_checked(tmp_path):
    call("road-recon", "new-results-repo", "repo", cwd=tmp_path)
    check = ("road-recon", "results-site", "repo", "--check")
    assert "new_road" in call(*check, cwd=tmp_path)
    (tmp_path / "repo/rules.yaml").write_text("tasks: [seasons/1/new_raod.yaml]\n")
    assert "seasons/1/new_raod.yaml" in call(*check, cwd=tmp_path, status=2)
    (tmp_path / "repo/rules.yaml").write_text("tasks: [new_road]\nroads: 1000\n")
    assert "number of drives must be" in call(*check, cwd=tmp_path, status=2)
    own = read_yaml(find("tasks", "class")) | {"name": "own", "instruments": "none.yaml"}
    (tmp_path / "repo/own.yaml").write_text(yaml.safe_dump(own))
    (tmp_path / "repo/rules.yaml").write_text("tasks: [own.yaml]\n")
    assert "none.yaml" in call(*check, cwd=tmp_path, status=2)


def test_a_branch_that_has_merged_another_one_and_undone_it_is_refused(verifies):
    """Its diff shows its own submission alone; after both are merged the other one is undone."""
    repo, said = verifies
    call("git", "switch", "--create", "organiser", "main", cwd=repo)
    committed(repo, "more roads", **{"rules.yaml": "tasks: [new_road]\nroads: 20\n"})
    call("git", "switch", "mine", cwd=repo)
    committed(repo, "mine", **RECORD_OF_MINE, **{CODE: "honest"})
    call("git", "merge", "--strategy=ours", "--message=merged", "organiser", cwd=repo)
    assert said(status=1) == "rules.yaml: changed and changed back: squash the commits\n"


def test_a_repository_without_submissions_has_no_site_yet(verifies):
    repo, _ = verifies
    committed(repo, "none left", **{"submissions/rival/submission.json": None})
    path = f"PATH={repo.parent}:{os.environ['PATH']}"
    assert call("env", path, "ci/verify.sh", cwd=repo) == "no submissions yet\n"


def test_a_clone_without_its_history_is_refused(verifies):
    repo, _ = verifies
    roads, rules = of_season()
    committed(repo, "mine", **RECORD_OF_MINE, **{CODE: "honest"})
    committed(repo, "the season ends", **roads, **rules)
    call("git", "clone", "--depth=1", "--branch=mine", f"file://{repo}", "shallow", cwd=repo.parent)
    path = f"PATH={repo.parent}:{os.environ['PATH']}"
    said = call("env", path, "ci/verify.sh", cwd=repo.parent / "shallow", status=1)
    assert said == "a shallow clone: git fetch --unshallow\n"


def test_a_tag_is_no_branch_that_is_compared_with(verifies):
    """Git takes the tag: nothing would differ from it."""
    repo, said = verifies
    committed(repo, "mine", **RECORD_OF_MINE, **{CODE: "honest"})
    call("git", "tag", "main", "HEAD", cwd=repo)
    assert said(status=1) == "a tag is named main\n"
    path = f"PATH={repo.parent}:{os.environ['PATH']}"
    found = call("env", path, "ci/verify.sh", "refs/heads/main", cwd=repo)
    assert "verify-submission submissions/mine" in found
    workflow = (repo / ".github" / "workflows" / "verify.yml").read_text()
    assert "format('refs/remotes/origin/{0}', github.base_ref)" in workflow
