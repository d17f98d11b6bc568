"""Submissions: a folder that cannot be altered unseen, and the way from a fork to the page."""

import contextlib
import dataclasses
import json
import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
from board_runs import ESTIMATORS, run, small
from fake_results import runs_of, with_runs
from fakes import SHORT_TASK
from test_verification import chosen_fakes, run_here
from wheels import module, write_wheel

from leaderboard.conformance import results as conformance_results
from leaderboard.conformance.method_card import TEMPLATE, load_method_card
from leaderboard.conformance.probes import CheckResult
from leaderboard.conformance.results import EstimatorCard, card_identity, card_path
from leaderboard.entries.entries import make_entry
from leaderboard.evaluation import store
from leaderboard.metrics.baselines import BASELINES
from leaderboard.report.citation import cite_entry
from leaderboard.running.verification import save_definition, verify_folder
from leaderboard.sandbox import bubblewrap
from leaderboard.sandbox.limits import Limits
from leaderboard.sandbox.retest import REMEMBERS
from leaderboard.submission import repository, signature
from leaderboard.submission import submission as submission_module
from leaderboard.submission.rules import Rules, load_rules
from leaderboard.submission.submission import (
    RECORD,
    SUBMISSION,
    Submission,
    _digests,
    load_submission,
)
from road_envs.core.config import ConfigError

CARD = """
method: Reads the heights from the record.
data: none
licence: MIT
authors: [Ada Author, Bo Author]
citation: A. Author, 100 % of it, 2026
"""


def write_record(folder, code=""):
    record = Submission(
        name="reader", code=code, package_version="1", hardware={"processor": "one"},
        cpu_seconds=1.0, files=_digests(folder),
    )  # fmt: skip
    SUBMISSION.write(folder / RECORD, dataclasses.asdict(record))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A submission of an estimator of the tests, with its rows of a small task."""
    folder = tmp_path_factory.mktemp("made") / "reader"
    run(folder)
    shutil.rmtree(folder / "jobs")
    (folder / "card.yaml").write_text(CARD)
    write_record(folder)
    return folder


@pytest.fixture
def submission(made, tmp_path):
    return shutil.copytree(made, tmp_path / "submissions" / "reader")


def test_a_submission_that_was_not_touched_is_read(submission):
    assert load_submission(submission).name == "reader"


def test_a_changed_a_missing_and_a_further_file_are_refused(submission):
    row = store.row_path(submission, "small", "reader")
    text = row.read_text()
    row.write_text(text + " ")
    with pytest.raises(ConfigError, match=r"reader\.json: changed since the submission was made"):
        load_submission(submission)
    row.unlink()
    with pytest.raises(ConfigError, match=r"reader\.json: missing, of the record"):
        load_submission(submission)
    row.write_text(text)
    (submission / "code").mkdir()
    (submission / "code" / "more.py").write_text("")
    with pytest.raises(ConfigError, match=r"more\.py: not of the record"):
        load_submission(submission)
    (submission / "code" / "more.py").unlink()
    (submission / "code" / "link").symlink_to("/etc/passwd")
    with pytest.raises(ConfigError, match="a submission has no links"):
        load_submission(submission)


def test_a_submission_without_its_card_is_refused(submission):
    (submission / "card.yaml").unlink()
    write_record(submission)
    with pytest.raises(ConfigError, match=r"card\.yaml: there is no card of the method"):
        load_submission(submission)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (TEMPLATE, "method is not filled in"),
        (CARD.replace("data: none", "data: ''"), "data is not filled in"),
        (CARD.replace("licence: MIT", ""), "licence: missing"),
        (CARD + "more: 1", "more: unknown key"),
        (
            CARD.replace("licence: MIT", 'licence: "\\e]0;MIT"'),
            "licence has characters that cannot",
        ),
    ],
)
def test_a_card_that_is_not_filled_in_is_refused(text, sentence, tmp_path):
    (tmp_path / "card.yaml").write_text(text)
    with pytest.raises(ConfigError, match=sentence):
        load_method_card(tmp_path / "card.yaml")


def test_a_signature_is_of_one_record_and_one_key(submission, tmp_path):
    pytest.importorskip("cryptography")
    assert signature.verify(submission) is None
    key = signature.sign(submission, tmp_path / "key.pem")
    assert signature.verify(submission) == key == signature.sign(submission, tmp_path / "key.pem")
    assert (tmp_path / "key.pem").stat().st_mode & 0o777 == 0o600
    other = signature.sign(submission, tmp_path / "other.pem")
    assert other != key and signature.verify(submission) == other
    forged = json.loads((submission / signature.FILE).read_text()) | {"key": key}
    (submission / signature.FILE).write_text(json.dumps(forged))
    with pytest.raises(ConfigError, match=r"not the signature of submission\.json"):
        signature.verify(submission)
    signature.sign(submission, tmp_path / "key.pem")
    with (submission / RECORD).open("a") as file:
        file.write(" ")
    with pytest.raises(ConfigError, match=r"not the signature of submission\.json"):
        signature.verify(submission)
    (submission / signature.FILE).write_text("[1]")
    with pytest.raises(ConfigError, match="damaged, not a signature"):
        signature.verify(submission)


def test_what_replaces_a_signed_submission_is_signed_by_its_key(submission, tmp_path):
    pytest.importorskip("cryptography")
    earlier = shutil.copytree(submission, tmp_path / "earlier" / "reader")
    signature.check_owner(submission, None)
    signature.check_owner(submission, earlier)  # of which nobody is known to be the owner
    owner = signature.sign(earlier, tmp_path / "key.pem")
    with pytest.raises(ConfigError, match=f"reader: is not signed, what .* the key {owner[:12]}"):
        signature.check_owner(submission, earlier)
    other = signature.sign(submission, tmp_path / "other.pem")
    with pytest.raises(ConfigError, match=f"signed by the key {other[:12]}, .* {owner[:12]}; sign"):
        signature.check_owner(submission, earlier)
    signature.sign(submission, tmp_path / "key.pem")
    signature.check_owner(submission, earlier)


class NoSandbox(contextlib.nullcontext):
    """In place of a client of the sandbox: the entry of these tests runs in this process."""

    isolation = "none"


@pytest.fixture
def verified(made, tmp_path, monkeypatch):
    """Return a function that alters a submission with its record and verifies it, undisturbed."""
    entry = make_entry("reader", ESTIMATORS["reader"])
    probed = EstimatorCard(
        identity=card_identity(entry.name, entry.settings, entry.code), estimator=entry.name,
        settings=entry.settings, code=entry.code, drive="a drive",
        probes=(CheckResult("causality", True, "so it is"),),
    )  # fmt: skip

    def write_card(folder, card=probed):
        content = dataclasses.asdict(card)
        conformance_results.CARD.write(
            card_path(folder, card.identity), content, content.pop("identity")
        )

    def altered_and_verified(alter, **options):
        folder = shutil.copytree(made, tmp_path / "reader", dirs_exist_ok=True)
        row_file = store.row_path(folder, "small", "learner")
        row_file.unlink()  # its own entry and the baselines
        write_card(folder)
        alter(folder)
        write_record(folder, entry.code)
        rules = Rules(tasks=("small",), seeds=2), [small()]
        options = {"seed": 1, **options}
        return submission_module.verify_submission(folder, rules, Limits(), **options)

    m = monkeypatch
    m.setattr(submission_module, "SandboxClient", NoSandbox)
    m.setattr(submission_module, "_submitted_entry", lambda folder, sandbox: entry)
    m.setattr(submission_module, "in_sandbox", lambda sandbox: run_here)
    m.setattr(submission_module, "probe_entries", lambda entries, out, limits: write_card(out))
    m.setattr(submission_module, "verify_folder", partial(verify_folder, simulate=chosen_fakes))
    altered_and_verified.card, altered_and_verified.write_card = probed, write_card
    return altered_and_verified


def change_row(folder, **changes):
    row = store.load(store.row_path(folder, "small", "reader"))
    store.save(dataclasses.replace(row, **changes), folder)


def test_an_honest_submission_agrees(verified):
    found = verified(lambda folder: None)
    assert {row.estimator for row in found} == {"reader", *BASELINES}
    assert all(row.agrees for row in found)


def test_a_submission_that_replaces_a_signed_one_needs_its_key(verified, made, tmp_path):
    pytest.importorskip("cryptography")
    earlier = shutil.copytree(made, tmp_path / "earlier" / "reader")
    signature.sign(earlier, tmp_path / "key.pem")
    with pytest.raises(ConfigError, match="is not signed, what it replaces by the key"):
        verified(lambda folder: None, replaces=earlier)


def test_scores_are_verified_although_the_folder_defines_another_task(verified):
    def forge(folder):
        (path,) = (folder / "definitions").iterdir()
        path.unlink()
        save_definition(dataclasses.replace(small(), name="decoy"), folder)
        row = store.load(store.row_path(folder, "small", "reader"))
        better = {run: scores | {"nrmse": 0.01} for run, scores in runs_of(row).items()}
        change_row(folder, scores=with_runs(row, better).scores)

    assert [row.estimator for row in verified(forge) if not row.agrees] == ["reader"]


def test_a_row_of_another_name_is_refused(verified):
    def add_row(folder):
        row = store.load(store.row_path(folder, "small", "reader"))
        store.save(dataclasses.replace(row, estimator="phantom"), folder)

    with pytest.raises(
        ConfigError, match=r"phantom\.json: neither a row of its entry nor a baseline"
    ):
        verified(add_row)


def test_a_row_of_the_easiest_drive_or_with_a_false_claim_is_refused(verified):
    def choose(folder):
        row = store.load(store.row_path(folder, "small", "reader"))
        change_row(folder, scores=with_runs(row, dict(list(runs_of(row).items())[:1])).scores)

    with pytest.raises(ConfigError, match="reader on small: its drives are not those of its task"):
        verified(choose)
    with pytest.raises(ConfigError, match=r"reader on small: its lag is 0\.0, the row says 3\.0"):
        verified(lambda folder: change_row(folder, lag=3.0))


def test_a_note_on_another_entry_is_refused(verified):
    def accuse(name):
        return lambda folder: change_row(folder, notes=(f"{name}: {REMEMBERS}",))

    assert all(row.agrees for row in verified(accuse("reader")))  # found by chance
    with pytest.raises(ConfigError, match="its note is not found here: rival: its estimate"):
        verified(accuse("rival"))


def test_a_card_that_the_probes_do_not_give_is_refused(verified):
    def forge(folder):
        probes = (CheckResult("causality", False, "it is not"),)
        verified.write_card(folder, dataclasses.replace(verified.card, probes=probes))

    with pytest.raises(ConfigError, match="its card is not what the probes of reader find here"):
        verified(forge)


def test_a_folder_of_another_name_is_refused(submission):
    # a name with a space would be two to a shell
    for name in ("other", "rea der"):
        submission = submission.rename(submission.with_name(name))
        with pytest.raises(ConfigError, match="must have the name of its entry, 'reader'"):
            load_submission(submission)
    data, _ = SUBMISSION.read(submission / RECORD)
    data.pop("identity")
    SUBMISSION.write(submission / RECORD, data | {"name": "rea der"})
    with pytest.raises(ConfigError, match="which has up to 40 letters"):
        load_submission(submission)


def test_names_that_differ_in_case_only_are_refused(verified, tmp_path):
    (tmp_path / "READER").mkdir()
    with pytest.raises(ConfigError, match="READER looks the same"):
        verified(lambda folder: None)


def test_the_site_has_a_page_of_each_entry_with_its_card(submission, tmp_path, monkeypatch):
    repo = submission.parents[1]
    (repo / "rules.yaml").write_text("tasks: [new_road]\nseeds: 2\n")
    rules, _ = load_rules(repo / "rules.yaml")
    monkeypatch.setattr(repository, "load_rules", lambda path: (rules, [small()]))
    (submission / "cards").mkdir()
    (submission / "cards" / "of_another.json").write_text("{}")  # the mark of a rival
    write_record(submission)
    index = repository.build_site(repo, tmp_path / "site")
    assert not (tmp_path / "site" / "cards" / "of_another.json").exists()
    assert "reader" in index.read_text()
    page = (tmp_path / "site" / "estimators" / "reader.html").read_text()
    assert "Ada Author, Bo Author" in page and "Reads the heights from the record." in page
    assert "Ada Author" not in (tmp_path / "site" / "estimators" / "flat.html").read_text()


def test_no_text_of_a_submission_becomes_code_of_the_site(submission, tmp_path, monkeypatch):
    repo, attack = (
        submission.parents[1],
        '</script><script>alert("1")</script><img src=x onerror=f()>',
    )
    (repo / "rules.yaml").write_text("tasks: [new_road]\nseeds: 2\n")
    rules, _ = load_rules(repo / "rules.yaml")
    monkeypatch.setattr(repository, "load_rules", lambda path: (rules, [small()]))
    card = {"method": attack, "data": attack, "licence": attack, "authors": [attack]}
    (submission / "card.yaml").write_text(json.dumps(card | {"citation": attack}))
    row = store.load(store.row_path(submission, "small", "reader"))
    traces = [dataclasses.replace(trace, road=attack, condition=attack) for trace in row.traces]
    change_row(
        submission, notes=(attack,), settings={attack: attack}, isolation=attack, traces=traces,
        environment={"processor": attack, attack: attack},
    )  # fmt: skip
    write_record(submission)
    repository.build_site(repo, tmp_path / "site")
    pages = [path.read_text() for path in (tmp_path / "site").rglob("*.html")]
    assert sum("alert(" in page for page in pages) >= 2
    assert not [page for page in pages if "<script>alert" in page or "<img src=x" in page]


def test_a_link_to_a_folder_is_refused(submission):
    elsewhere = submission.parent / "elsewhere"
    (submission / "cards").rename(elsewhere) if (submission / "cards").exists() else None
    elsewhere.mkdir(exist_ok=True)
    (submission / "more").symlink_to(elsewhere)
    with pytest.raises(ConfigError, match="more: a submission has no links"):
        load_submission(submission)


def test_a_record_that_is_a_link_is_not_read(submission):
    (submission / "submission.json").unlink()
    (submission / "submission.json").symlink_to("/dev/null")  # or /dev/zero, which has no end
    with pytest.raises(ConfigError, match=r"submission\.json: a submission has no links"):
        load_submission(submission)


@pytest.mark.parametrize("seed", range(3))
def test_a_single_forged_drive_is_found_in_every_attempt(verified, seed):
    def improve_one(folder):
        row = store.load(store.row_path(folder, "small", "reader"))
        scores = runs_of(row)
        better = {run: scores[run] | {"nrmse": 0.01} for run in list(scores)[-1:]}
        change_row(folder, scores=with_runs(row, scores | better).scores)

    assert [row.estimator for row in verified(improve_one, seed=seed) if not row.agrees] == [
        "reader"
    ]


def test_a_row_of_another_task_and_a_failed_baseline_are_refused(verified):
    def fail_a_baseline(folder):
        row = store.load(store.row_path(folder, "small", "truth_plus_noise"))
        store.save(dataclasses.replace(row, scores=None, failure="it failed"), folder)

    def add_a_task(folder):
        row = store.load(store.row_path(folder, "small", "flat"))
        store.save(dataclasses.replace(row, task="large"), folder)

    with pytest.raises(ConfigError, match="row of truth_plus_noise on small: it failed"):
        verified(fail_a_baseline)
    with pytest.raises(ConfigError, match="neither a row of its entry nor a baseline"):
        verified(add_a_task)


def test_a_citation_says_what_ran(submission):
    shutil.copytree(submission / "results", submission / "site" / "results")
    (submission / "site" / "methods").mkdir()
    shutil.copy(submission / "card.yaml", submission / "site" / "methods" / "reader.yaml")
    text = cite_entry(submission / "site", "reader")
    row = store.load(store.row_path(submission, "small", "reader"))
    assert "author = {Ada Author and Bo Author}" in text and r"100 \% of it" in text
    assert f"small {row.task_digest[:12]}" in text and row.package_version in text
    card = submission / "site" / "methods" / "reader.yaml"
    card.write_text(card.read_text().replace("A. Author, 100 % of it, 2026", "none"))
    assert "none" not in cite_entry(submission / "site", "reader")
    with pytest.raises(ConfigError, match="unknown entry 'leader'"):
        cite_entry(submission / "site", "leader")


def test_a_results_repository_is_not_written_over_files(tmp_path):
    (tmp_path / ".git").mkdir()
    written = repository.write_repository(tmp_path)
    assert tmp_path / "ci" / "verify.sh" in written and os.access(written[2], os.X_OK)
    rules, tasks = load_rules(tmp_path / "rules.yaml")
    assert rules.roads == 4 and [task.name for task in tasks] == ["new_road"]
    with pytest.raises(ConfigError, match="is not empty"):
        repository.write_repository(tmp_path)
    (tmp_path / "more.yaml").write_text("seeds: 100000000000\n")
    with pytest.raises(ConfigError, match="seeds: must be at most 100"):
        load_rules(tmp_path / "more.yaml")
    with pytest.raises(ConfigError, match="has no submission"):
        repository.build_site(tmp_path, tmp_path / "site")


ROOT = Path(__file__).parents[2]
GIT_NAMES = [f"GIT_{x}_{y}" for x in ("AUTHOR", "COMMITTER") for y in ("NAME", "EMAIL")]
ESTIMATE = "a = np.nan_to_num(record.a[0])\nz[:] = 1e-3 * np.interp(stations, record.s, a)"


def call(*words, cwd, status=0):
    """Run a program as a user does; return what it has printed."""
    environment = {
        **os.environ,
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        "PYTHONPATH": str(ROOT),
        **dict.fromkeys(GIT_NAMES, "a@b.c"),
    }
    done = subprocess.run(
        [str(word) for word in words], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture
def verifies(made, tmp_path):
    """A repository with a rival's submission, and what its ci/verify.sh says of a branch of it."""
    repo = tmp_path / "repo"
    repository.write_repository(repo)
    shutil.copytree(made, repo / "submissions" / "rival")
    for words in (("init", "-b", "main"), ("add", "."), ("commit", "-m", "a rival")):
        call("git", *words, cwd=repo)
    call("git", "switch", "-c", "mine", cwd=repo)
    program = tmp_path / "road-recon"
    program.write_text("#!/bin/sh\necho $1 $2\n")
    program.chmod(0o755)
    path = f"PATH={tmp_path}:{os.environ['PATH']}"
    return repo, lambda status=0: call("env", path, "ci/verify.sh", "main", cwd=repo, status=status)


def test_a_submission_is_verified_before_it_is_committed_and_after(verifies):
    repo, said = verifies
    assert said() == "no submission differs from main\nresults-site .\n"
    shutil.copytree(repo / "submissions" / "rival", repo / "submissions" / "mine")
    verified = "verify-submission submissions/mine\nresults-site .\n"
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
    (tmp_path / "road-recon").write_text('#!/bin/sh\n[ $1 = results-site ] || ls "$8"\n')
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


def test_a_link_in_place_of_all_submissions_is_refused(verifies):
    repo, said = verifies
    (repo / "submissions").rename(repo / "others")
    (repo / "submissions").symlink_to("others")
    shutil.copytree(repo / "others" / "rival", repo / "others" / "mine")
    assert said(status=1) == "submissions is a link\n"


def test_code_that_is_newer_than_the_roads_of_a_season_is_refused(verifies):
    repo, said = verifies
    (repo / "submissions" / "rival" / "code").mkdir()
    (repo / "submissions" / "rival" / "code" / "a.whl").write_text("a")
    for name, text in (
        ("rules.yaml", "tasks: [seasons/1/class.yaml]\n"),
        ("seasons/1/class.yaml", ""),
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


def test_what_lies_in_the_folder_of_the_site_is_no_row_of_it(submission, verifies, monkeypatch):
    repo, said = verifies
    (repo / "site").mkdir()
    said()
    assert not (repo / "site").exists()
    repo = submission.parents[1]
    (repo / "rules.yaml").write_text("tasks: [new_road]\nseeds: 2\n")
    rules, _ = load_rules(repo / "rules.yaml")
    monkeypatch.setattr(repository, "load_rules", lambda path: (rules, [small()]))
    row = store.load(store.row_path(submission, "small", "flat"))
    store.save(dataclasses.replace(row, failure="forged", scores=None), repo / "site")
    repository.build_site(repo, repo / "site")
    assert store.load(store.row_path(repo / "site", "small", "flat")).failure is None
    repository.build_site(repo, repo / "site")
    store.save(dataclasses.replace(row, estimator="phantom"), repo / "site")
    with pytest.raises(ConfigError, match=r"phantom\.json: of no submission; remove"):
        repository.build_site(repo, repo / "site")


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
    assert "5 of 5 rows agree" in said and "site/index.html" in said

    call("git", "pull", fork, "trial", cwd=upstream)
    call("road-recon", "results-site", ".", cwd=upstream)
    page = (upstream / "site" / "estimators" / "trial.html").read_text()
    assert "Ada Author" in page
    assert "road_recon_trial" in call("road-recon", "cite", "trial", "--out", "site", cwd=upstream)

    # another key than that of the owner, then a better score, under a record made anew
    folder = fork / "submissions" / "trial"
    signature.sign(upstream / "submissions" / "trial", tmp_path / "owner.pem")
    call("git", "add", "submissions", cwd=upstream)
    call("git", "commit", "-m", "signed", cwd=upstream)
    call("git", "fetch", cwd=fork)
    signature.sign(folder, tmp_path / "other.pem")
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
    signature.sign(folder, tmp_path / "owner.pem")
    assert "DIFFERS" in call("ci/verify.sh", "origin/main", cwd=fork, status=1)
