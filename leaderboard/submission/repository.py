"""Results repositories: a git repository of rules and submissions, whose site its CI builds.

rules.yaml            the tasks, and how entries are run on them
submissions/NAME/     one folder for each entry (`submission`)
seasons/              hidden test sets: published hashes, later the tasks
ci/verify.sh          verifies the submissions that a branch changes and builds the site
"""

import dataclasses
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from importlib import resources
from pathlib import Path

from leaderboard.conformance.method_card import method_card_path
from leaderboard.conformance.results import card_identity, card_path, probe_entries
from leaderboard.entries.entries import registered_entry
from leaderboard.evaluation import store
from leaderboard.metrics.baselines import ALL_BASELINES
from leaderboard.report.sentences import build_report
from leaderboard.report.site import write_site
from leaderboard.running.board import load_board
from leaderboard.running.verification import save_definition
from leaderboard.sandbox.limits import Limits
from leaderboard.submission.rules import RULES, load_rules, make_run_request
from leaderboard.submission.submission import CARD, RECORD, load_submission
from road_envs.core.atomic_io import copy_file, write_text
from road_envs.core.config import ConfigError

_SUBMISSIONS = "submissions"
_TEMPLATE = {
    "README.md": "readme.txt",
    RULES: "rules.txt",
    "ci/verify.sh": "verify.txt",
    ".github/workflows/verify.yml": "workflow.txt",
    ".github/ISSUE_TEMPLATE/submission.yml": "issue_form.txt",
    f"{_SUBMISSIONS}/README.md": "submissions.txt",
    "seasons/README.md": "seasons.txt",
    ".gitignore": "gitignore.txt",
}
"""Files of a new results repository, and the templates that they are made from."""


def write_repository(folder: Path) -> list[Path]:
    """Write a results repository into a new or empty folder (a .git may be there); its files.

    Raises ConfigError for a folder with files.
    """
    if folder.exists() and (not folder.is_dir() or any(x.name != ".git" for x in folder.iterdir())):
        raise ConfigError(f"{folder} is not empty; choose a new or empty folder")
    templates = resources.files("leaderboard.submission") / "templates"
    for path, name in _TEMPLATE.items():
        write_text(folder / path, (templates / name).read_text(encoding="utf-8"))
    (folder / "ci/verify.sh").chmod(0o755)
    return [folder / path for path in _TEMPLATE]


def build_site(repository: Path, out: Path) -> Path:
    """Write the site of all submissions of a repository into the folder `out`; its index.

    Rows of baselines are taken from the first submission that has them, their cards are made here.
    Raises ConfigError for a damaged submission, if there is none, and for a row in `out` that is of
    none.
    """
    rules, tasks = load_rules(repository / RULES)
    folders = sorted(path.parent for path in (repository / _SUBMISSIONS).glob("*/submission.json"))
    if not folders:
        raise ConfigError(f"{repository / _SUBMISSIONS} has no submission")
    written: set[Path] = set()
    records = {folder: load_submission(folder) for folder in folders}
    for folder, record in records.items():
        for path in sorted((folder / "results").rglob("*.json")):
            target = out / path.relative_to(folder)
            if path.stem == record.name or (path.stem in ALL_BASELINES and target not in written):
                written.add(target)
                row = store.load(path)
                card = card_path(out, card_identity(row.estimator, row.settings, row.code))
                copy_file(path, target)
                probed = folder / card.relative_to(out)
                if path.stem == record.name and probed.exists():
                    copy_file(probed, card)
        copy_file(folder / CARD, method_card_path(out, record.name))
    for path in {*(out / "results").rglob("*.json"), *out.glob("verified.json")} - written:
        raise ConfigError(f"{path}: of no submission; remove {out}")
    sized = make_run_request(rules, tasks, (), limits=Limits()).sized_tasks()
    for task in sized:
        save_definition(task, out)
    own = [entry for name in ALL_BASELINES if (entry := registered_entry(name, False))]
    probe_entries(own, out, Limits())
    since = _submitted_since(repository, {x.name: x.code for x in records.values()})
    board = dataclasses.replace(load_board(sized, out), since=since)
    return write_site(board, build_report(board), out)


def _submitted_since(repository: Path, codes: Mapping[str, str]) -> dict[str, int]:
    """Return the order in which the `codes` of names, which may be older, came to the main line, by
    merges, as authors choose the dates of commits: numbers below 1; 1 without git.
    """
    since, main = dict.fromkeys(codes, 1), ["git", "log", "--first-parent", "--format=%H"]
    run = partial(subprocess.run, cwd=repository, capture_output=True, text=True)
    with suppress(OSError):
        place = {x: -k for k, x in enumerate(run(main).stdout.split())}  # latest first
        for name, code in codes.items():
            record = f"{_SUBMISSIONS}/{name}/{RECORD}"
            found = run([*main, "-m", "--no-renames", f"-S{code}", "--", record]).stdout.split()
            since[name] = place.get(found[-1] if found else "", 1)
    return since
