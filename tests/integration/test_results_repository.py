"""Repositories of results: what their script verifies, and the way from a fork to the page."""

import os
import shutil
import string
from functools import partial

import pytest
import results_repositories
import submissions
from fake_results import runs_of, with_runs
from fakes import SHORT_TASK
from results_repositories import ROOT, call, committed, merge_ref
from submissions import CARD
from wheels import module, write_wheel

from leaderboard.commands import submit
from leaderboard.commands.options import LimitOptions
from leaderboard.entries.entries import fold
from leaderboard.entries.entry import NAME
from leaderboard.evaluation import store
from leaderboard.evaluation.provenance import package_version
from leaderboard.sandbox import bubblewrap
from leaderboard.sandbox.limits import Limits
from leaderboard.submission import repository, signature
from leaderboard.submission.rules import load_rules
from leaderboard.submission.submission import RECORD, SUBMISSION, _digests
from road_envs.core.config import ConfigError, read_yaml

made, submission = submissions.made, submissions.submission
verifies = results_repositories.verifies


def test_a_results_repository_is_not_written_over_files(tmp_path):
    (tmp_path / ".git").mkdir()
    written = repository.write_repository(tmp_path)
    assert tmp_path / "ci" / "verify.sh" in written and os.access(written[2], os.X_OK)
    rules, tasks = load_rules(tmp_path / "rules.yaml")
    assert rules.roads == 6 and [task.name for task in tasks] == ["new_road"]
    with pytest.raises(ConfigError, match="is not empty"):
        repository.write_repository(tmp_path)
    assert f"sign]=={package_version()}'" in (tmp_path / ".github/workflows/verify.yml").read_text()
    (tmp_path / "more.yaml").write_text("roads: 4\n")
    with pytest.raises(ConfigError, match="roads: must be at least 5"):
        load_rules(tmp_path / "more.yaml")
    (tmp_path / "more.yaml").write_text("seeds: 100000000000\n")
    with pytest.raises(ConfigError, match="seeds: must be at most 100"):
        load_rules(tmp_path / "more.yaml")
    with pytest.raises(ConfigError, match="has no submission"):
        repository.build_site(tmp_path, tmp_path / "site", Limits())


def test_the_output_and_the_readme_say_where_the_site_is_published(tmp_path, monkeypatch):
    made = submit.new_results_repo(tmp_path / "repo")
    address, step = "https://OWNER.github.io/REPOSITORY/", "Settings, Pages, Source: GitHub Actions"
    monkeypatch.setattr(repository, "build_site", lambda *_: tmp_path / "site" / "index.html")
    site = submit.results_site(tmp_path / "repo", out=tmp_path / "site", limits=LimitOptions())
    said = site.facts["site of the main branch"]
    assert site.facts["page"] == str(tmp_path / "site" / "index.html")
    for text in (
        made.shows[-1],
        made.facts["site"],
        (tmp_path / "repo/README.md").read_text(),
        said,
    ):
        assert address in text and step in text
    jobs = read_yaml(tmp_path / "repo/.github/workflows/verify.yml")["jobs"]
    kept, *_ = (x for x in jobs["verify"]["steps"] if "upload-pages" in x.get("uses", ""))
    assert jobs["verify"]["outputs"] == {"site": "${{ steps.site.outputs.artifact_id }}"}
    assert (kept["id"], kept["with"]) == ("site", {"path": "site"})
    publish = jobs["publish"]
    assert publish["needs"] == "verify" and publish["if"] == "needs.verify.outputs.site != ''"
    assert [x["uses"] for x in publish["steps"]] == ["actions/deploy-pages@v4"]


ESTIMATE = "a = np.nan_to_num(record.a[0])\nz[:] = 1e-3 * np.interp(stations, record.s, a)"


@pytest.mark.costly
def test_a_submission_is_verified_before_it_is_committed_and_after(verifies):
    repo, said = verifies
    assert said() == "no submission differs from main\n"
    with (repo.parent / "road-recon").open("a") as program:  # a new one replaces none
        program.write('case "$*" in *--replaces*) echo replaces; esac\n')
    shutil.copytree(repo / "submissions" / "rival", repo / "submissions" / "mine")
    verified = "verify-submission submissions/mine\n"
    assert said() == verified
    call("git", "add", ".", cwd=repo)
    assert said() == verified
    call("git", "commit", "-m", "mine", cwd=repo)
    assert said() == verified


def test_a_rival_cannot_be_moved_into_another_submission(verifies):
    """By git's detection of renames, the files of the rival would not be named as removed."""
    repo, said = verifies
    rival = repo / "submissions" / "rival"
    shutil.copytree(rival, repo / "submissions" / "mine" / "code" / "data")
    shutil.rmtree(rival)
    call("git", "add", ".", cwd=repo)
    call("git", "commit", "-m", "mine", cwd=repo)
    assert "submissions/rival is removed: for a maintainer" in said(status=1)


def test_no_attribute_hides_the_signature_of_what_is_replaced(verifies, tmp_path):
    repo, said = verifies
    (repo / "submissions" / "rival" / "signature.json").write_text("{}")
    (repo / ".gitattributes").write_text("signature.json export-ignore\n")
    call("git", "add", ".", cwd=repo)
    call("git", "commit", "-m", "signed", cwd=repo)
    call("git", "branch", "-f", "main", cwd=repo)
    (repo / "submissions" / "rival" / "signature.json").unlink()
    (tmp_path / "road-recon").write_text('#!/bin/sh\nls "$6"\n')
    assert said().split() == ["signature.json", "submission.json"]


def test_what_its_owner_has_replaced_or_withdrawn_does_not_come_back(verifies):
    """Whoever has an old submission with its signature could lower a rival's rank by it."""
    repo, said = verifies
    record = repo / "submissions" / "rival" / "submission.json"
    old = record.read_text()
    for change in (partial(record.write_text, "{}"), record.unlink):
        change()
        call("git", "add", ".", cwd=repo)
        call("git", "commit", "-m", "by the owner", cwd=repo)
        call("git", "branch", "-f", "main", cwd=repo)
        record.write_text(old)
        assert said(status=1) == "submissions/rival stood here before: submit it again\n"
        record.write_text("{ }")
        assert "verify-submission submissions/rival" in said()


def withdraw_signed(repo):
    """Sign the rival's submission and withdraw it, on the main line; return where it stood."""
    rival = repo / "submissions" / "rival"
    (rival / "signature.json").write_text("{}")
    for text in ("signed", "withdrawn"):
        call("git", "add", ".", cwd=repo)
        call("git", "commit", "-m", text, cwd=repo)
        shutil.rmtree(rival, ignore_errors=True)
    call("git", "branch", "-f", "main", cwd=repo)
    return rival


def test_the_name_of_what_was_withdrawn_stays_that_of_its_owner(verifies, tmp_path):
    """Whoever cites a rival that has left would cite the entry of somebody else."""
    repo, said = verifies
    rival = withdraw_signed(repo)
    rival.mkdir()
    (rival / "submission.json").write_text("{ }")
    (tmp_path / "road-recon").write_text('#!/bin/sh\nls "$6"\n')
    assert said().split() == ["signature.json", "submission.json"]


def test_no_branch_from_before_it_frees_the_name_of_what_was_withdrawn(verifies, tmp_path):
    repo, said = verifies
    rival = repo / "submissions" / "rival"
    committed(repo, "signed", **{"submissions/rival/signature.json": "{}"})
    call("git", "branch", "-f", "main", cwd=repo)
    call("git", "switch", "-c", "notes", cwd=repo)
    committed(repo, "a note", **{"docs/note.txt": "a note"})
    call("git", "switch", "main", cwd=repo)
    shutil.rmtree(rival)
    call("git", "commit", "-a", "-m", "withdrawn", cwd=repo)
    call("git", "merge", "--no-ff", "-m", "the notes", "notes", cwd=repo)
    call("git", "switch", "-C", "mine", cwd=repo)
    rival.mkdir()
    (rival / "submission.json").write_text("of another")
    (tmp_path / "road-recon").write_text('#!/bin/sh\nls "$6"\n')
    assert said().split() == ["signature.json", "submission.json"]


@pytest.mark.parametrize("name", ["RIVAL", "r1vaI", "rivaI", "r1va1"])
def test_a_name_that_looks_like_a_withdrawn_one_is_refused(verifies, name):
    repo, said = verifies
    withdraw_signed(repo)
    shutil.copytree(repo / "ci", repo / "submissions" / "another")
    assert fold(name) == fold("rival") and "verify-submission submissions/another" in said()
    shutil.copytree(repo / "ci", repo / "submissions" / name)
    assert f"{name} looks the same as rival, which was signed: rename" in said(status=1)


def test_a_file_within_a_folder_signs_no_name(verifies):
    """Added and removed by one branch, it would lock the owners of such names out."""
    repo, said = verifies
    path = "submissions/Riva1/x/signature.json"
    committed(repo, "added", **{path: "{}"})
    committed(repo, "removed", **{path: None})
    call("git", "branch", "-f", "main", cwd=repo)
    committed(repo, "the owner", **{"submissions/rival/card.yaml": "new"})
    assert said() == "verify-submission submissions/rival\n"


def test_the_script_folds_names_as_the_program_does():
    script = (ROOT / "leaderboard/submission/templates/verify.txt").read_text()
    (line,) = [x for x in script.splitlines() if x.startswith("fold()")]
    names = [string.ascii_letters, string.digits + "_-", "r1vaI-O0"]
    found = call("sh", "-c", f'{line}\nfor x in {" ".join(names)}; do fold "$x"; done', cwd=ROOT)
    assert found.split() == [fold(x) for x in names]


@pytest.mark.parametrize(
    "name", ["seasons/1/class_0a1b2c3d.yaml", "submissions/left/submission.json"]
)
def test_what_a_branch_adds_and_removes_is_refused(verifies, name):
    """No reviewer sees it; it made older code newer than a season, and took a signed name."""
    repo, said = verifies
    path = repo / name
    path.parent.mkdir()
    path.write_text("")
    (repo / "README.md").write_text("A word.")
    for text in ("added", "removed"):
        call("git", "add", ".", cwd=repo)
        call("git", "commit", "-m", text, cwd=repo)
        path.unlink(missing_ok=True)
    refused = f"{name}: changed and changed back: squash the commits\n"
    assert said(status=1) == refused
    merge_ref(repo, "mine")
    assert said(status=1) == refused


def test_a_name_is_not_freed_by_a_branch_from_before_it(verifies, tmp_path):
    repo, said = verifies
    first = call("git", "rev-parse", "main", cwd=repo).strip()
    call("git", "switch", "-C", "before", f"{first}", cwd=repo)
    committed(repo, "removed", **{"submissions/rival/submission.json": None})
    call("git", "switch", "mine", cwd=repo)
    withdraw_signed(repo)
    call("git", "switch", "before", cwd=repo)
    call("git", "merge", "-s", "ours", "-m", "main", "main", cwd=repo)
    call("git", "branch", "-f", "main", "before", cwd=repo)
    call("git", "switch", "-C", "mine", "main", cwd=repo)
    shutil.copytree(repo / "ci", repo / "submissions" / "RIVAL")
    assert "RIVAL looks the same as rival, which was signed" in said(status=1)


@pytest.mark.parametrize("name", ["\u212aalman", "my entry", 'x"y', "-n", ".numba_config.yaml"])
def test_a_folder_that_is_no_name_of_an_entry_is_refused(verifies, name):
    """A rival whose name looks the same would have to be renamed."""
    repo, said = verifies
    committed(repo, "notes", **{f"submissions/{name}/notes.txt": ""})
    assert "a name has up to 40 letters, digits, _ and -" in said(status=1)
    assert NAME.pattern in (repo / "ci" / "verify.sh").read_text()


def test_no_file_of_a_branch_is_read_where_the_judge_starts(verifies):
    """Numba reads .numba_config.yaml there, and other libraries read other files."""
    repo, said = verifies
    (repo / ".numba_config.yaml").write_text("x: [")
    shutil.copytree(repo / "submissions" / "rival", repo / "submissions" / "mine")
    assert said() == "verify-submission submissions/mine\n"


def test_a_link_in_place_of_all_submissions_is_refused(verifies):
    repo, said = verifies
    (repo / "submissions").rename(repo / "others")
    (repo / "submissions").symlink_to("others")
    shutil.copytree(repo / "others" / "rival", repo / "others" / "mine")
    assert said(status=1) == "submissions is a link\n"


@pytest.mark.parametrize("name", [".gitattributes", "submissions/rival/.gitattributes"])
def test_attributes_change_no_file_of_a_submission(verifies, name):
    """Git compares what is stored: the ends of lines could write the roads of a season into code
    that is older than they are, and spoil the signature of a rival.
    """
    repo, said = verifies
    bit = repo / "submissions" / "rival" / "code" / "bit.txt"
    bit.parent.mkdir()
    bit.write_text("a\n")
    for text in ("a season", "its roads"):
        call("git", "add", ".", cwd=repo)
        call("git", "commit", "-m", text, cwd=repo)
        (repo / "seasons" / "class.yaml").write_text("roads")
        (repo / "rules.yaml").write_text("tasks: [seasons/class.yaml]\n")
    call("git", "branch", "-f", "main", cwd=repo)
    (repo / "submissions" / "rival" / "results" / "more.json").write_text("")
    assert "verify-submission submissions/rival" in said()
    (repo / name).write_text("bit.txt text eol=crlf\n")
    assert said(status=1) == "attributes of files: for a maintainer\n"
    call("git", "add", ".", cwd=repo)
    call("git", "commit", "-m", "roads as attributes", cwd=repo)
    bit.unlink()
    call("git", "checkout", "--", ".", cwd=repo)
    assert bit.read_bytes() == b"a\r\n" and "clean" in call("git", "status", cwd=repo)
    assert said(status=1) == "attributes of files: for a maintainer\n"


def test_git_leaves_out_no_file_of_a_submission_and_changes_none(verifies):
    repo, said = verifies
    call("git", "config", "core.autocrlf", "input", cwd=repo)
    committed(repo, "mine", **{"submissions/mine/submission.json": "", "submissions/mine/a": ""})
    (repo / "submissions/mine/a").write_bytes(b"a\r\n")
    call("git", "commit", "-a", "-m", "its lines", cwd=repo)
    call("git", "clone", repo, repo.parent / "clone", cwd=repo)
    assert (repo.parent / "clone/submissions/mine/a").read_bytes() == b"a\r\n"
    (repo / ".git/info/exclude").write_text("*.npz\n")
    (repo / "submissions/mine/b.npz").write_text("weights")
    left = "submissions/mine/b.npz"
    assert said(status=1) == f"git ignores {left}: git add --force submissions/mine\n"
    call("git", "add", "--force", "submissions/mine", cwd=repo)
    assert said() == "verify-submission submissions/mine\n"


def test_a_pull_request_builds_no_site_and_the_main_line_all_of_it(verifies):
    repo, said = verifies
    (repo / "site").mkdir()
    assert "results-site" not in said() and (repo / "site").exists()
    (repo / "site" / "index.html").write_text("")
    committed(repo, "code with a page", **{"submissions/mine/code/site/index.html": ""})
    assert call("git", "ls-files", "*.html", cwd=repo).split() == [
        "submissions/mine/code/site/index.html"
    ]
    path = f"PATH={repo.parent}:{os.environ['PATH']}"
    assert call("env", path, "ci/verify.sh", cwd=repo) == f"results-site {repo}\n"
    assert not (repo / "site").exists()


def test_no_site_has_two_names_that_look_the_same(submission, tmp_path):
    """Of two pull requests, each of which was verified beside an older main line."""
    repository.write_repository(tmp_path / "repo")
    for name in ("reader", "Reader"):
        shutil.copytree(submission, tmp_path / "repo" / "submissions" / name)
    with pytest.raises(ConfigError, match="two names look the same"):
        repository.build_site(tmp_path / "repo", tmp_path / "site", Limits())
    assert not (tmp_path / "site").exists()


def test_a_site_is_not_built_over_rows_that_lie_there(submission, tmp_path):
    repository.write_repository(tmp_path / "repo")
    shutil.copytree(submission, tmp_path / "repo" / "submissions" / "reader")
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "row.json").write_text("{}")
    with pytest.raises(ConfigError, match="site is not empty: a site shows what is run for it"):
        repository.build_site(tmp_path / "repo", tmp_path / "site", Limits())


@pytest.mark.slow
@pytest.mark.skipif(bubblewrap.obstacle() is not None, reason=str(bubblewrap.obstacle()))
def test_from_a_fork_to_the_page(tmp_path):
    """A newcomer's way through docs/submitting.md, with two git repositories and the CI by hand."""
    pytest.importorskip("cryptography")
    upstream, fork = tmp_path / "upstream", tmp_path / "fork"
    upstream.mkdir()
    call("git", "init", "-b", "main", cwd=upstream)
    call("road-recon", "new-results-repo", ".", cwd=upstream)
    (upstream / "short.yaml").write_text(SHORT_TASK)
    (upstream / "rules.yaml").write_text("tasks: [short.yaml]\nseeds: 1\n")
    call("git", "add", ".", cwd=upstream)
    call("git", "commit", "-m", "rules", cwd=upstream)
    call("git", "clone", upstream, fork, cwd=tmp_path)
    call("git", "switch", "-c", "trial", cwd=fork)

    wheel = write_wheel(tmp_path, "trial", module(body=ESTIMATE))
    submit = ("road-recon", "submit", wheel, "--rules", fork / "rules.yaml",
              "--out", fork / "submissions" / "trial")  # fmt: skip
    assert "fill it in" in call(*submit, cwd=tmp_path, status=2)
    assert "is not filled in" in call(*submit, cwd=tmp_path, status=2)
    (tmp_path / "card.yaml").write_text(CARD)
    assert "of its time" in call(*submit, cwd=tmp_path)
    call("git", "add", "submissions", cwd=fork)
    call("git", "commit", "-m", "trial", cwd=fork)
    said = call("ci/verify.sh", "origin/main", cwd=fork)
    assert "5 of 5 rows agree" in said and "site" not in said

    call("git", "pull", fork, "trial", cwd=upstream)
    call("ci/verify.sh", cwd=upstream)
    assert (upstream / "site" / "index.html").is_file()
    page = (upstream / "site" / "estimators" / "trial.html").read_text()
    assert "Ada Author" in page
    assert "road_recon_trial" in call("road-recon", "cite", "trial", "--out", "site", cwd=upstream)

    # another key than that of the owner, then a better score, under a record made anew
    folder = fork / "submissions" / "trial"
    signature.signer(tmp_path / "owner.pem")(upstream / "submissions" / "trial")
    call("git", "add", "submissions", cwd=upstream)
    call("git", "commit", "-m", "signed", cwd=upstream)
    call("git", "fetch", cwd=fork)
    signature.signer(tmp_path / "other.pem")(folder)
    call("git", "add", "submissions", cwd=fork)
    call("git", "commit", "-m", "signed by another", cwd=fork)
    said = " ".join(call("ci/verify.sh", "origin/main", cwd=fork, status=2).split())
    assert "what it replaces by the key" in said
    row = store.load(store.row_path(folder, "short", "trial"))
    better = {run: scores | {"nrmse": 0.01} for run, scores in runs_of(row).items()}
    store.save(with_runs(row, better), folder)
    data, _ = SUBMISSION.read(folder / RECORD)
    data.pop("identity")
    SUBMISSION.write(folder / RECORD, data | {"files": _digests(folder)})
    signature.signer(tmp_path / "owner.pem")(folder)
    assert "DIFFERS" in call("ci/verify.sh", "origin/main", cwd=fork, status=1)
