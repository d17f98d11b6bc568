"""A submission of an estimator of the tests, and its fixtures."""

import dataclasses
import shutil

import pytest
from board_runs import run

from leaderboard.submission.submission import RECORD, SUBMISSION, _digests, _Submission

CARD = """
method: Reads the heights from the record.
data: none
licence: MIT
authors: [Ada Author, Bo Author]
citation: A. Author, 100 % of it, 2026
"""


def write_record(folder, code=""):
    record = _Submission(
        name="reader", code=code, package_version="1", hardware={"processor": "one"},
        cpu_seconds=1.0, files=_digests(folder),
    )  # fmt: skip
    SUBMISSION.write(folder / RECORD, dataclasses.asdict(record))
    return record


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
