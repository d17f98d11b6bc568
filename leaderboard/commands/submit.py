"""Commands of submissions: `submit`, `verify-submission`, `new-results-repo`, `results-site`."""

import dataclasses
import shlex
from pathlib import Path
from typing import Annotated

from leaderboard.commands import check_output_folder, progress_bar
from leaderboard.commands.options import CORES, LimitOptions, Share, Workers, argument, option
from leaderboard.commands.output import Output, facts_table
from leaderboard.commands.results import verified_output
from leaderboard.evaluation.test_data import check_plants
from leaderboard.method_card import TEMPLATE
from leaderboard.report.board_definitions import WORST, column_forms
from leaderboard.report.tables import board_views
from leaderboard.running.board import Board
from leaderboard.submission import repository, signature
from leaderboard.submission.rules import RULES, load_rules, make_run_request
from leaderboard.submission.submission import SUBMISSION_SHARE, make_submission, verify_submission
from road_envs.core.atomic_io import write_text
from road_envs.core.config import ConfigError

_ISOLATED = LimitOptions(isolation="bubblewrap")
_RulesFile = Annotated[
    Path | None, option("Rules of the results repository; by default new_road whole.")
]


def submit(
    wheel: Annotated[Path, argument("Wheel, or folder of installed packages.")],
    *,
    out: Annotated[Path, option("New folder of the submission, named as its entry.")],
    card: Annotated[
        Path, option("Card of the method (YAML); written to be filled in if missing.")
    ] = Path("card.yaml"),
    rules: _RulesFile = None,
    sign: Annotated[
        Path | None, option("Sign with this private key; made if it does not exist.")
    ] = None,
    workers: Workers = CORES,
    limits: LimitOptions,
) -> Output:
    """Make the folder that a pull request adds to a results repository.

    The estimator is checked, probed and run by the rules; the folder has its code, its card, its
    rows and a record of all files.
    """
    if not wheel.exists():
        raise ConfigError(f"{wheel}: no such file; give a wheel or a folder of installed packages")
    if wheel.is_dir() and (found := next(wheel.rglob(".git"), None)):
        raise ConfigError(
            f"{found}: give packages, such as `pip install --target` makes, not a clone"
        )
    if not card.exists():
        write_text(card, TEMPLATE)
        raise ConfigError(f"{card} has been written: fill it in, then give the same command again")
    own, code = load_rules(rules), wheel.absolute()
    signer = None if sign is None else signature.signer(sign)
    with progress_bar() as progress:
        record, board = make_submission(code, card, own, out, limits.parse(), workers, progress)
    facts = dataclasses.asdict(record) | {"scores": _scores(record.name, board)}
    if signer is not None:
        facts["signed by"] = signer(out)
    shown = {key: x for key, x in facts.items() if key != "cpu_seconds"}
    shown["files"] = f"{len(record.files)} below {out}"
    shown["hardware"] = f"{record.hardware['processor']}, {record.cpu_seconds:g} s of its time"
    return Output(facts=facts, shows=facts_table(shown))


def _scores(name: str, board: Board) -> dict[str, str]:
    """Return ranking score and worst drive of an entry by task, as its board shows them."""
    found = {}
    for view in board_views(board):
        shown = [column_forms(view.definition)[key] for key in (view.definition.ranks_by, WORST)]
        for task, rows in ((section.task, section.rows) for section in view.sections):
            values = next(row.values for row in rows if row.name == name)
            found[task.name] = ", ".join(f"{x.label} {x.text(values.get(x.key))}" for x in shown)
    return found


def verify_one(
    folder: Annotated[Path, argument("Folder of a submission.")],
    *,
    rules: _RulesFile = None,
    share: Share = SUBMISSION_SHARE,
    replaces: Annotated[
        Path | None, option("The submission as it was before: its key, if any, must have signed.")
    ] = None,
    limits: LimitOptions = _ISOLATED,
) -> Output:
    """Verify a submission; exit status 1 if a row differs from what is found here.

    Files, card, signature and code are compared with its record, its rows with the rules, and its
    drives are run again.
    """
    with progress_bar() as progress:
        found = verify_submission(
            folder, load_rules(rules), limits.parse(),
            share=share, replaces=replaces, progress=progress,
        )  # fmt: skip
    return verified_output([dataclasses.replace(row, drives="") for row in found])  # by the rules


def new_results_repo(
    folder: Annotated[Path, argument("New or empty folder; a .git may be there.")],
    *,
    package: Annotated[
        str | None,
        option(
            "What its CI gives to pip: by default the release of this version; "
            "'road-envs[all,sign] @ git+https://HOST/PATH@COMMIT' for another program."
        ),
    ] = None,
) -> Output:
    """Write a repository of results: rules, CI that verifies submissions, site, issue form."""
    written = [str(path) for path in repository.write_repository(folder, package)]
    steps = [f"cd {shlex.quote(str(folder))}", "git init --initial-branch main", "git add ."]
    steps += ["git commit --message rules", "git remote add origin ADDRESS"]
    following = " && ".join([*steps, "git push --set-upstream origin main"])
    facts = {"written": written, "next": following, "site": repository.PUBLISH}
    shows = [*written, *(f"\n{key}: {facts[key]}" for key in ("next", "site"))]
    return Output(facts=facts, shows=shows)


def results_site(
    folder: Annotated[Path, argument("Results repository.")],
    *,
    out: Annotated[Path, option("Folder of the site, new or empty.")] = Path("site"),
    check: Annotated[bool, option("Read the rules and their seasons, and run nothing.")] = False,
    workers: Workers = CORES,
    limits: LimitOptions = _ISOLATED,
) -> Output:
    """Run the entries of all submissions of a results repository, and build their site."""
    if check:
        rules, tasks = load_rules(folder / RULES)
        sized = make_run_request(rules, tasks, [], limits.parse()).sized_tasks()
        for task in sized:
            check_plants(task)
        return Output(facts={"tasks": {task.name: task.digest for task in sized}})
    check_output_folder(out)
    with progress_bar() as progress:
        page = repository.build_site(folder, out, limits.parse(), workers, progress)
    return Output(facts={"page": str(page), "site of the main branch": repository.PUBLISH})
