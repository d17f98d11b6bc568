"""Submissions: a folder that cannot be altered unseen."""

import contextlib
import dataclasses
import json
import shutil
import socket
from functools import partial
from types import SimpleNamespace

import pytest
import submissions
from board_runs import ESTIMATORS, SHORT, Counting, run, small
from fake_results import runs_of, with_runs
from fakes import task
from results_repositories import call
from submissions import CARD, write_record
from test_verification import chosen_fakes, run_here
from wheels import write_wheel

from leaderboard.commands import submit as submit_command
from leaderboard.commands.options import LimitOptions
from leaderboard.conformance import results as conformance_results
from leaderboard.conformance.probes import CheckResult
from leaderboard.conformance.results import EstimatorCard, _card_path, card_identity
from leaderboard.entries.entries import make_entry
from leaderboard.entries.entry import Entry
from leaderboard.evaluation import store
from leaderboard.evaluation.provenance import describe_environment
from leaderboard.evaluation.results import RESULT
from leaderboard.method_card import TEMPLATE, load_method_card
from leaderboard.metrics import UNDEFINED
from leaderboard.metrics.baselines import BASELINES
from leaderboard.metrics.bootstrap import MIN_ROADS
from leaderboard.report.citation import cite_entry
from leaderboard.report.sentences import build_report
from leaderboard.running.board import load_board, run_board
from leaderboard.running.verification import save_definition, verify_folder
from leaderboard.sandbox.limits import Limits
from leaderboard.sandbox.retest import REMEMBERS
from leaderboard.submission import repository, signature
from leaderboard.submission import submission as submission_module
from leaderboard.submission.rules import Rules, load_rules
from leaderboard.submission.submission import (
    RECORD,
    SUBMISSION,
    load_submission,
)
from road_envs.core.artifacts import CHECKSUM_PREFIX, _text_checksum
from road_envs.core.config import ConfigError

made, submission = submissions.made, submissions.submission


@pytest.mark.costly
def test_a_submission_that_was_not_touched_is_read(submission):
    assert load_submission(submission).name == "reader"


def test_a_changed_a_missing_and_a_further_file_are_refused(submission, monkeypatch):
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
    (submission / "code" / "link").unlink()
    monkeypatch.chdir(submission / "code")
    with socket.socket(socket.AF_UNIX) as endless:
        endless.bind("socket")
    with pytest.raises(ConfigError, match="socket: a submission has no links, pipes and devices"):
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
        (CARD.replace("[Ada Author", "[..."), "authors is not filled in"),
        (CARD.replace("[Ada Author", "[''"), "authors is not filled in"),
        (CARD.replace("licence: MIT", ""), "licence: missing"),
        (CARD + "more: 1", "more: unknown key"),
        (
            CARD.replace("licence: MIT", 'licence: "\\e]0;MIT"'),
            "licence has characters that cannot",
        ),
        *(
            (CARD.replace("licence: MIT", f'licence: "a\\{x} b"'), "licence has characters that")
            for x in ("r", "v", "x1c", "N", "L")
        ),
    ],
)
def test_a_card_that_is_not_filled_in_is_refused(text, sentence, tmp_path):
    (tmp_path / "card.yaml").write_text(text)
    with pytest.raises(ConfigError, match=sentence):
        load_method_card(tmp_path / "card.yaml")


@pytest.mark.costly
def test_a_key_is_read_before_anything_is_run(tmp_path):
    pytest.importorskip("cryptography")
    (tmp_path / "card.yaml").write_text("")
    (tmp_path / "key.pem").write_text("ssh-ed25519 AAAA")
    (tmp_path / "a.whl").touch()
    said = call(
        "road-recon", "submit", "a.whl", "--sign", "key.pem", "--out", "out", cwd=tmp_path, status=2
    )
    assert "key.pem: not a private key in PEM format" in " ".join(said.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.costly
def test_a_clone_is_no_code_of_a_submission(tmp_path):
    """Git would take it for a repository of its own, and its configuration may hold a token."""
    (tmp_path / "mine" / "src" / ".git").mkdir(parents=True)
    said = call("road-recon", "submit", "mine", "--out", "out", cwd=tmp_path, status=2)
    assert "mine/src/.git: give packages" in " ".join(said.split())


@pytest.mark.costly
@pytest.mark.parametrize("roads", [3, 5])
def test_what_submit_prints_is_what_a_board_shows_of_the_same_rows(tmp_path, monkeypatch, roads):
    seeds = [*range(11, 11 + roads)]
    t = task(**SHORT | {"test": SHORT["test"] | {"seeds": seeds}})
    board, _ = run(tmp_path / "reader", t=t)
    (view,) = build_report(board).views
    (row,) = (row for row in view.sections[0].rows if row.name == "reader")
    made = submissions.write_record(tmp_path / "reader"), board
    monkeypatch.setattr(submit_command, "make_submission", lambda *_: made)
    rules = Rules(tasks=("small",), seeds=2), [t]
    monkeypatch.setattr(submit_command, "load_rules", lambda path: rules)
    for name in ("a.whl", "card.yaml"):
        (tmp_path / name).touch()
    options = {"out": tmp_path / "reader", "card": tmp_path / "card.yaml"}
    output = submit_command.submit(tmp_path / "a.whl", **options, limits=LimitOptions())
    expected = f"in-band NRMSE {row.cells['nrmse']}, worst drive {row.cells['worst']}"
    assert output.facts["scores"] == {"small": expected}
    assert (row.cells["worst"] == UNDEFINED) == (roads < MIN_ROADS)


def test_names_may_have_joined_letters_and_texts_three_dots(tmp_path):
    text = CARD.replace("Ada Author", "\u0646\u06cc\u200c\u0644").replace(
        "data: none", "data: 1 ... 9"
    )
    (tmp_path / "card.yaml").write_text(text)
    assert load_method_card(tmp_path / "card.yaml").data == "1 ... 9"


def test_a_signature_is_of_one_record_and_one_key(submission, tmp_path):
    pytest.importorskip("cryptography")
    assert signature.verify(submission) is None
    key = signature.signer(tmp_path / "key.pem")(submission)
    assert signature.verify(submission) == key == signature.signer(tmp_path / "key.pem")(submission)
    assert (tmp_path / "key.pem").stat().st_mode & 0o777 == 0o600
    other = signature.signer(tmp_path / "other.pem")(submission)
    assert other != key and signature.verify(submission) == other
    forged = json.loads((submission / signature.FILE).read_text()) | {"key": key}
    (submission / signature.FILE).write_text(json.dumps(forged))
    with pytest.raises(ConfigError, match=r"not the signature of submission\.json"):
        signature.verify(submission)
    signature.signer(tmp_path / "key.pem")(submission)
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
    owner = signature.signer(tmp_path / "key.pem")(earlier)
    with pytest.raises(ConfigError, match=f"reader: is not signed, what .* the key {owner[:12]}"):
        signature.check_owner(submission, earlier)
    other = signature.signer(tmp_path / "other.pem")(submission)
    with pytest.raises(ConfigError, match=f"signed by the key {other[:12]}, .* {owner[:12]}; sign"):
        signature.check_owner(submission, earlier)
    signature.signer(tmp_path / "key.pem")(submission)
    signature.check_owner(submission, earlier)


class NoSandbox(contextlib.nullcontext):
    """In place of a client of the sandbox: the entry of these tests runs in this process."""

    isolation = "none"


@pytest.fixture
def verified(made, tmp_path, monkeypatch):
    """Return a function that alters a submission with its record and verifies it, undisturbed."""
    entry = make_entry("reader", ESTIMATORS["reader"])
    probed = EstimatorCard(
        identity=card_identity(entry), estimator=entry.name,
        settings=entry.settings, code=entry.code, drive="a drive",
        probes=(CheckResult("causality", True, "so it is"),),
    )  # fmt: skip

    def write_card(folder, card=probed):
        content = dataclasses.asdict(card)
        conformance_results.CARD.write(
            _card_path(folder, card.identity), content, content.pop("identity")
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
    m.setattr(submission_module, "submitted_entry", lambda folder, sandbox: entry)
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
    signature.signer(tmp_path / "key.pem")(earlier)
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


@pytest.mark.costly
def test_a_row_of_the_easiest_drive_or_with_a_false_claim_is_refused(verified):
    def choose(folder):
        row = store.load(store.row_path(folder, "small", "reader"))
        change_row(folder, scores=with_runs(row, dict(list(runs_of(row).items())[:1])).scores)

    with pytest.raises(ConfigError, match="reader on small: its drives are not those of its task"):
        verified(choose)
    with pytest.raises(ConfigError, match=r"reader on small: its lag is 0\.0, the row says 3\.0"):
        verified(lambda folder: change_row(folder, lag=3.0))


@pytest.mark.costly
def test_a_note_on_another_entry_is_refused(verified):
    def accuse(name):
        return lambda folder: change_row(folder, notes=(f"{name}: {REMEMBERS}",))

    assert all(row.agrees for row in verified(accuse("reader")))  # found by chance
    with pytest.raises(ConfigError, match="its note is not found here: rival: its estimate"):
        verified(accuse("rival"))


@pytest.mark.parametrize("score", ["more", "coverage_90"])
@pytest.mark.costly
def test_a_score_on_a_road_that_nobody_drove_is_refused(verified, score):
    """It was compared with nothing, and as a run that was not run again made a note be believed."""

    def accuse(folder):
        row = store.load(store.row_path(folder, "small", "reader"))
        runs = runs_of(row)
        condition, drive, _, *seeds = next(iter(runs))
        row = with_runs(row, runs | {(condition, drive, "elsewhere", *seeds): {score: 0.9}})
        store.save(dataclasses.replace(row, notes=(f"rival: {REMEMBERS}",)), folder)

    with pytest.raises(ConfigError, match="reader on small: its drives are not those of its task"):
        verified(accuse)


def test_the_conditions_of_a_row_are_in_the_order_of_its_task(verified):
    """Boards took them by their places: the easy one for the hard one."""

    def swap(folder):
        row = store.load(store.row_path(folder, "small", "reader"))
        change_row(folder, scores=with_runs(row, dict(reversed(runs_of(row).items()))).scores)

    with pytest.raises(ConfigError, match="its conditions are not in the order of its task"):
        verified(swap)


def test_an_entry_that_was_probed_with_other_versions_of_its_imports_agrees(verified):
    def move(folder):
        shutil.rmtree(folder / "cards")
        change_row(folder, environment=describe_environment() | {"imports": "numpy 1.0"})
        row = store.load(store.row_path(folder, "small", "reader"))
        elsewhere = dataclasses.replace(verified.card, identity=card_identity(row))
        verified.write_card(folder, elsewhere)

    assert all(row.agrees for row in verified(move))


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


@pytest.mark.costly
def test_names_that_differ_in_case_only_are_refused(verified, tmp_path):
    (tmp_path / "Reader").write_text("a file is no entry")  # the script verifies folders alone
    assert all(row.agrees for row in verified(lambda folder: None))
    (tmp_path / "READER").mkdir()
    assert all(row.agrees for row in verified(lambda folder: None))  # a folder is none either
    (tmp_path / "READER" / RECORD).write_text("")
    with pytest.raises(ConfigError, match="READER looks the same"):
        verified(lambda folder: None)


@pytest.fixture
def build(submission, tmp_path, monkeypatch):
    """Return a function that builds the site of the submission, from what a run would have stored:
    by default its own rows.
    """
    repo, entry = submission.parents[1], make_entry("reader", ESTIMATORS["reader"])
    (repo / "rules.yaml").write_text("tasks: [new_road]\nseeds: 2\n")
    rules, _ = load_rules(repo / "rules.yaml")
    ran = shutil.copytree(submission, tmp_path / "ran")

    def run_board(request, out, executor, progress):
        assert [x.name for x in request.entries] == ["reader"]
        shutil.copytree(ran / "results", out / "results")
        return load_board(request.sized_tasks(), out)

    monkeypatch.setattr(repository, "load_rules", lambda path: (rules, [small()]))
    monkeypatch.setattr(repository, "SandboxClient", lambda limits: NoSandbox())
    monkeypatch.setattr(repository, "submitted_entry", lambda folder, sandbox: entry)
    monkeypatch.setattr(repository, "run_board", run_board)
    return ran, lambda: repository.build_site(repo, tmp_path / "site", Limits())


def test_the_site_shows_what_its_builder_finds_with_the_card_of_each_entry(build, submission):
    _, build_site = build
    row = store.load(store.row_path(submission, "small", "reader"))
    change_row(submission, notes=("by its author",), parameters=777)
    (submission / "cards").mkdir()
    (submission / "cards" / "of_another.json").write_text("{}")  # the mark of a rival
    write_record(submission)
    index = build_site()
    assert store.load(store.row_path(index.parent, "small", "reader")).parameters == row.parameters
    assert not (index.parent / "cards").exists()
    assert "reader" in index.read_text()
    page = (index.parent / "estimators" / "reader.html").read_text()
    assert "Ada Author, Bo Author" in page and "Reads the heights from the record." in page
    assert "by its author" not in page
    assert "Ada Author" not in (index.parent / "estimators" / "flat.html").read_text()


@pytest.mark.parametrize(
    ("entry", "reason"),
    [
        (Entry(name="reader_2", reference="a.whl", failure="not today"), "not today"),
        (Entry(name="rival", reference="a.whl"), "its code is that of rival"),
    ],
)
@pytest.mark.costly
def test_an_entry_that_fails_from_some_day_on_ends_no_site(entry, reason, build, monkeypatch):
    """The code of a wheel can look at the date: nothing that reviewers see changes."""
    monkeypatch.setattr(repository, "submitted_entry", lambda folder, sandbox: entry)
    monkeypatch.setattr(repository, "run_board", lambda *x: run_board(*x[:2], Counting()))
    index = build[1]()
    row = store.load(store.row_path(index.parent, "small", "reader"))
    assert row.failure == reason and row.estimator in index.read_text()
    assert store.load(store.row_path(index.parent, "small", "flat")).failure is None


def test_a_site_links_to_the_pages_of_past_seasons(build, submission):
    repo = submission.parents[1]
    page = repository.build_site(repo, repo / "seasons" / "1 & 2" / "page", Limits())
    assert "Past seasons" not in page.read_text()
    index = build[1]()
    assert 'href="seasons/1%20%26%202/index.html"' in index.read_text()
    assert (index.parent / "seasons/1 & 2/index.html").read_text() == page.read_text()
    later = repository.build_site(repo, repo / "seasons" / "3" / "page", Limits())
    assert not (later.parent / "seasons").exists()
    (repo / "seasons" / "4").mkdir()
    (repo / "seasons" / "4" / "page").symlink_to("/")
    with pytest.raises(ConfigError, match="4/page: a past season's site is a folder"):
        repository.build_site(repo, repo.parent / "other", Limits())


def test_no_text_of_a_submission_becomes_code_of_the_site(build, submission):
    (ran, build_site), attack = build, '</script><script>alert("1")</script><img src=x onerror=f()>'
    card = {"method": attack, "data": attack, "licence": attack, "authors": [attack]}
    (submission / "card.yaml").write_text(json.dumps(card | {"citation": attack}))
    row = store.load(store.row_path(submission, "small", "reader"))
    traces = [dataclasses.replace(trace, road=attack) for trace in row.traces]
    change_row(
        ran, notes=(attack,), settings={attack: attack}, isolation=attack, traces=traces,
        environment={"processor": attack, attack: attack},
    )  # fmt: skip
    write_record(submission)
    pages = [path.read_text() for path in build_site().parent.rglob("*.html")]
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
@pytest.mark.costly
def test_a_single_forged_drive_is_found_in_every_attempt(verified, seed):
    def improve_one(folder):
        row = store.load(store.row_path(folder, "small", "reader"))
        scores = runs_of(row)
        better = {run: scores[run] | {"nrmse": 0.01} for run in list(scores)[-1:]}
        change_row(folder, scores=with_runs(row, scores | better).scores)

    assert [row.estimator for row in verified(improve_one, seed=seed) if not row.agrees] == [
        "reader"
    ]


@pytest.mark.costly
def test_runs_of_a_training_seed_that_is_not_run_again_do_not_agree(verified):
    """An estimator that is not trained has runs of the first seed only: others are invented."""

    def invent(name):
        def add_runs(folder):
            row = store.load(store.row_path(folder, "small", name))
            own = runs_of(row)
            more = {(*run[:-1], 2): scores | {"nrmse": 0.01} for run, scores in own.items()}
            store.save(with_runs(row, own | more), folder)

        return add_runs

    for name in ("reader", "flat"):
        assert [row.estimator for row in verified(invent(name)) if not row.agrees] == [name]


def test_the_bound_of_the_drives_is_verified_whatever_machine_a_row_names(verified):
    """The first row of a board says the bound, below which the rows of others are doubted."""

    def raise_bound(folder):
        row = store.load(store.row_path(folder, "small", "reader"))
        elsewhere = row.environment | {"blas": "openblas Z80"}
        runs = {run: own | {"bound_nrmse": 0.9} for run, own in runs_of(row).items()}
        change_row(folder, scores=with_runs(row, runs).scores, environment=elsewhere)

    found = {row.estimator: row for row in verified(raise_bound)}
    assert found["reader"].score == "bound_nrmse" and not found["reader"].agrees


def test_a_number_of_parameters_without_end_is_refused(verified):
    with pytest.raises(ConfigError, match="parameters: must be below 9"):
        verified(lambda folder: change_row(folder, parameters=10**400))


def test_code_is_one_wheel_alone(submission):
    """Of two, the first in the order of the disk would be run: any of them, after many trials."""
    (submission / "code").mkdir()
    for name in ("a.whl", "b.whl"):
        (submission / "code" / name).write_text("")
    sandbox = SimpleNamespace(describe=lambda reference: {"name": "reader"})
    with pytest.raises(ConfigError, match="code: one wheel alone, or a folder of packages without"):
        submission_module.submitted_entry(submission, sandbox)
    for name in ("a.whl", "b.whl"):
        (submission / "code" / name).unlink()
    (submission / "code" / "c.whl").mkdir()  # which may hold several
    with pytest.raises(ConfigError, match="code: one wheel alone, or a folder of packages without"):
        submission_module.submitted_entry(submission, sandbox)


@pytest.fixture
def submit(tmp_path, monkeypatch):
    """Submits an entry `reader` that no guest has read, to a folder."""

    class NoGuests(contextlib.nullcontext):
        describe = staticmethod(lambda reference: {"name": "reader", "code": "1" * 16})

    (tmp_path / "card.yaml").write_text(CARD)
    wheel = write_wheel(tmp_path, "reader", "import pytest")
    monkeypatch.setattr(submission_module, "SandboxClient", lambda limits: NoGuests(NoGuests))
    monkeypatch.setattr(submission_module, "check_entry", lambda *_: [])
    rules = Rules(tasks=("small",), seeds=2), []
    return lambda name: submission_module.make_submission(
        wheel, tmp_path / "card.yaml", rules, tmp_path / name, Limits()
    )


def test_a_folder_by_another_name_than_its_entry_is_refused_before_anything_is_run(
    submit, tmp_path, monkeypatch
):
    monkeypatch.setattr(submission_module, "check_entry", lambda *_: pytest.fail("it was checked"))
    with pytest.raises(ConfigError, match="another: it must have the name of its entry, reader"):
        submit("another")
    assert not (tmp_path / "another").exists()


def test_a_package_that_boards_lack_is_refused_before_anything_is_run(submit, monkeypatch):
    monkeypatch.setattr(submission_module, "check_entry", lambda *_: pytest.fail("it was checked"))
    with pytest.raises(ConfigError, match="reader: it imports pytest of the package pytest, which"):
        submit("reader")


def test_what_was_driven_before_a_submission_was_stopped_is_not_lost(submit, tmp_path, monkeypatch):
    monkeypatch.setattr(submission_module, "missing_packages", lambda code: [])
    times = iter([0.0, 5.0, 100.0, 103.0])  # of two processes
    monkeypatch.setattr(submission_module, "_cpu_seconds", lambda: next(times))
    found = []

    def run(request, out, executor, progress):
        parts = out / "jobs"
        found.append(sorted(path.name for path in parts.glob("*.json")))
        parts.mkdir(exist_ok=True)
        (parts / f"{len(found)}.json").write_text("{}")
        if len(found) == 1:
            raise KeyboardInterrupt
        return SimpleNamespace(tasks=[])

    monkeypatch.setattr(submission_module, "run_board", run)
    with pytest.raises(KeyboardInterrupt):
        submit("reader")
    assert [path.name for path in tmp_path.glob(".*")] == [".reader.jobs.partial"]
    record, _ = submit("reader")
    assert found == [[], ["1.json"]] and record.cpu_seconds == 8.0
    assert not list(tmp_path.glob(".*")) and load_submission(tmp_path / "reader") == record


def test_what_was_driven_before_a_submission_was_killed_is_not_lost(submit, tmp_path, monkeypatch):
    monkeypatch.setattr(submission_module, "missing_packages", lambda code: [])
    for left in (".reader.partial", ".reader.jobs.partial"):
        (tmp_path / left).mkdir()
        (tmp_path / left / "1.json").write_text("{}")
    found = []

    def run(request, out, executor, progress):
        found.extend(path.name for path in (out / "jobs").glob("*"))
        return SimpleNamespace(tasks=[])

    monkeypatch.setattr(submission_module, "run_board", run)
    submit("reader")
    assert found == ["1.json"] and not list(tmp_path.glob(".*"))
    assert not (tmp_path / "reader" / "1.json").exists()


def test_of_two_submissions_into_one_folder_at_once_the_second_is_refused(
    submit, tmp_path, monkeypatch
):
    monkeypatch.setattr(submission_module, "missing_packages", lambda code: [])

    def run(request, out, executor, progress):
        (out / "jobs" / "1.json").write_text("{}")
        with pytest.raises(ConfigError, match="reader: another process makes it; wait, or give"):
            submit("reader")
        assert (out / "jobs" / "1.json").exists() and (out / "code").exists()
        return SimpleNamespace(tasks=[])

    monkeypatch.setattr(submission_module, "run_board", run)
    record, _ = submit("reader")
    assert not list(tmp_path.glob(".*")) and load_submission(tmp_path / "reader") == record


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("ds", 0.0),
        ("speed_kmh", 5e-324),
        ("truth", [[1, 1], [1, 1]]),
        ("truth", [[1] * 100_000] * 2),
    ],
)
def test_a_trace_that_cannot_be_drawn_is_refused(verified, field, value):
    """What is plotted of a drive is not run again; it ended the building of the site."""

    def forge(folder):
        path = store.row_path(folder, "small", "reader")
        data, _ = RESULT.read(path)
        data["traces"][0][field] = value
        RESULT.write(path, data, data.pop("identity"))

    with pytest.raises(ConfigError, match=f"{field}: "):
        verified(forge)


@pytest.mark.costly
def test_a_thousand_copies_of_a_trace_are_refused(verified):
    def repeat(folder):
        row = store.load(store.row_path(folder, "small", "reader"))
        change_row(folder, traces=500 * row.traces)

    with pytest.raises(ConfigError, match="on small: it has not one trace of each condition"):
        verified(repeat)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("train_seconds", [1.7e308, 1.7e308]),
        ("estimate_ms_per_100m", "1e999"),
        ("calibrate_seconds", "NaN"),
        ("peak_memory", "-Infinity"),
        ("parameters", -(10**30)),
    ],
)
def test_costs_without_a_mean_are_refused(verified, field, value):
    """They are what authors say; those without a finite mean ended the building of the site."""

    def forge(folder):
        path = store.row_path(folder, "small", "reader")
        data, _ = RESULT.read(path)
        identity = data.pop("identity")
        RESULT.write(path, data | {field: value}, identity)
        text = path.read_text().replace(f'"{value}"', str(value))  # a number that is not finite
        start = len(CHECKSUM_PREFIX)
        path.write_text(text.replace(text[start : start + 64], _text_checksum(text), 1))

    with pytest.raises(ConfigError, match=f"{field}"):
        verified(forge)


def test_deviations_of_0_and_trainings_without_times_do_not_end_the_site(build):
    ran, build_site = build
    row = store.load(store.row_path(ran, "small", "reader"))
    traces = tuple(dataclasses.replace(x, deviation=0 * x.truth) for x in row.traces)
    change_row(ran, traces=traces, parameters=3, train_seconds=())
    assert (build_site().parent / "estimators" / "reader.html").exists()


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
    other = dataclasses.replace(row, task="other", settings={"gain": 7.0}, code="abc")
    store.save(other, submission / "site")
    text = cite_entry(submission / "site", "reader")
    assert (
        f"code abc, settings (gain: 7.0), road-envs {row.package_version}, other"
        in text.replace("'", "")
    )
    card = submission / "site" / "methods" / "reader.yaml"
    card.write_text(card.read_text().replace("A. Author, 100 % of it, 2026", "none"))
    assert "none" not in cite_entry(submission / "site", "reader")
    attack = r"^^5cinput^^7b/etc/passwd^^7d \\input{~/a}"
    card.write_text(card.read_text().replace("citation: none", f"citation: {attack}\n  2026"))
    text = cite_entry(submission / "site", "reader")
    assert "^" not in text and r"\input" not in text and r"(\textasciitilde{}/a) 2026}," in text
    with pytest.raises(ConfigError, match="unknown entry 'leader'"):
        cite_entry(submission / "site", "leader")
