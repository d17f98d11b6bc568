"""Results repositories: a git repository of rules and submissions, whose site its CI builds.

rules.yaml            the tasks, and how entries are run on them
submissions/NAME/     one folder for each entry (`submission`)
seasons/NAME/         a hidden test set: a published hash, later its tasks, at last page/, its site
ci/verify.sh          verifies the submissions that a branch changes and builds the site
"""

import shutil
from collections.abc import Callable
from dataclasses import replace
from importlib import resources
from pathlib import Path

from leaderboard.entries.entries import RESERVED, fold
from leaderboard.entries.entry import Entry
from leaderboard.evaluation.provenance import package_version
from leaderboard.method_card import method_card_path
from leaderboard.report.sentences import build_report
from leaderboard.report.site import write_site
from leaderboard.running.board import run_board
from leaderboard.running.executors import ProcessExecutor
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from leaderboard.submission.dependencies import EXTRAS, PROJECT
from leaderboard.submission.rules import RULES, load_rules, make_run_request
from leaderboard.submission.submission import CARD, load_submission, submitted_entry
from road_envs.core.atomic_io import copy_file, write_text
from road_envs.core.config import ConfigError

PUBLISH = "https://OWNER.github.io/REPOSITORY/ (once: Settings, Pages, Source: GitHub Actions)"
_SUBMISSIONS = "submissions"
_TEMPLATE = {  # files of a new results repository, and what they are made from
    "README.md": "readme.txt",
    RULES: "rules.txt",
    "ci/verify.sh": "verify.txt",
    ".github/workflows/verify.yml": "workflow.txt",
    ".github/ISSUE_TEMPLATE/submission.yml": "issue_form.txt",
    f"{_SUBMISSIONS}/README.md": "submissions.txt",
    "seasons/README.md": "seasons.txt",
    ".gitignore": "gitignore.txt",
    ".gitattributes": "gitattributes.txt",
}


def write_repository(folder: Path, package: str | None = None) -> list[Path]:
    """Write a results repository into a new or empty folder (a .git may be there); its files. Their
    CI gives `package` to pip, by default the release of this version. Raises ConfigError for a
    folder with files, and a `package` that is not one line without quotes.
    """
    package = package or f"{PROJECT}[{','.join(EXTRAS)}]=={package_version()}"
    if not package.isprintable() or set(package) & set("'\"`"):
        raise ConfigError(f"--package: one line without quotes, got {package!r}")
    if folder.exists() and (not folder.is_dir() or any(x.name != ".git" for x in folder.iterdir())):
        raise ConfigError(f"{folder} is not empty; choose a new or empty folder")
    templates = resources.files("leaderboard.submission") / "templates"
    for path, name in _TEMPLATE.items():
        text = (templates / name).read_text(encoding="utf-8").replace("{publish}", PUBLISH)
        write_text(folder / path, text.replace("{package}", package))
    (folder / "ci/verify.sh").chmod(0o755)
    return [folder / path for path in _TEMPLATE]


def build_site(
    repository: Path,
    out: Path,
    limits: Limits,
    workers: int = 1,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> Path:
    """Run the entries of all submissions of a repository and write their site into the new or empty
    folder `out`; return its index.

    What a site shows was found by its builder, on one machine: rows that submissions say count for
    nothing here. It has copies of the sites of past seasons, unless it becomes one itself. An entry
    that cannot be run has a row with the reason. Raises ConfigError for a damaged submission, if
    there is none, and if `out` has files.
    """
    rules, tasks = load_rules(repository / RULES)
    folders = sorted(path.parent for path in (repository / _SUBMISSIONS).glob("*/submission.json"))
    if not folders:
        raise ConfigError(f"{repository / _SUBMISSIONS} has no submission")
    if out.exists() and any(out.iterdir()):
        raise ConfigError(f"{out} is not empty: a site shows what is run for it; remove the folder")
    if len({fold(folder.name) for folder in folders}) < len(folders):  # of two pull requests
        raise ConfigError(f"{repository / _SUBMISSIONS}: two names look the same: keep one of them")
    seasons = (repository / "seasons").resolve()
    pages = [] if seasons in out.resolve().parents else sorted(seasons.glob("*/page"))
    for page in pages:  # each would have copies of all before it
        if page.is_symlink() or not page.is_dir():
            raise ConfigError(f"{page}: a past season's site is a folder")
        shutil.copytree(page, out / "seasons" / page.parent.name, symlinks=True)
    for folder in folders:
        load_submission(folder)
        copy_file(folder / CARD, method_card_path(out, folder.resolve().name))
    with SandboxClient(limits) as sandbox:
        entries = [_entry_of(folder, sandbox) for folder in folders]
    request = make_run_request(rules, tasks, entries, limits)
    board = run_board(request, out, ProcessExecutor(workers), progress)
    return write_site(board, build_report(board), out)


def _entry_of(folder: Path, sandbox: SandboxClient) -> Entry:
    """Return the entry of a submission under the name of its folder, whose card it has.

    Its code can fail, or call itself otherwise, from some day on: a failure of its own row, so that
    others have theirs.
    """
    entry, name = submitted_entry(folder, sandbox), folder.resolve().name
    if fold(name) in RESERVED:
        raise ConfigError(f"{folder}: the name {name} is reserved, or looks like one that is")
    if entry.failure is None and entry.name != name:
        return replace(entry, name=name, failure=f"its code is that of {entry.name}")
    return replace(entry, name=name)
