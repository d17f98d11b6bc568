"""A results repository in git, and what its script says of a branch of it."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from leaderboard.submission import repository

ROOT = Path(__file__).parents[2]
GIT_NAMES = [f"GIT_{x}_{y}" for x in ("AUTHOR", "COMMITTER") for y in ("NAME", "EMAIL")]


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
    (repo / "submissions" / "rival" / "submission.json").write_text("of rival")
    for words in (("init", "-b", "main"), ("add", "."), ("commit", "-m", "a rival")):
        call("git", *words, cwd=repo)
    call("git", "switch", "-c", "mine", cwd=repo)
    program = tmp_path / "road-recon"
    program.write_text("#!/bin/sh\nls -A\necho $1 ${2#*/repo/}\n")
    program.chmod(0o755)
    path = f"PATH={tmp_path}:{os.environ['PATH']}"
    return repo, lambda status=0: call("env", path, "ci/verify.sh", "main", cwd=repo, status=status)


def committed(repo, text, **files):
    """Write or, with None, remove files of a repository, and commit all."""
    for name, content in files.items():
        path = repo / name
        if content is None:
            path.unlink()
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content)
    call("git", "add", "--all", cwd=repo)
    call("git", "commit", "-m", text, cwd=repo)


def of_season(name="seasons/1/class.yaml"):
    """Files of a repository whose rules have a season: its roads, and the rules."""
    commitment = Path(name).with_name("commitment.json").as_posix()
    return {name: "roads", commitment: "{}"}, {"rules.yaml": f"tasks: [{name}]\n"}


def merge_ref(repo, branch):
    """Check out what the CI does of a pull request: the main line, into which it is merged."""
    call("git", "checkout", "--detach", "main", cwd=repo)
    call("git", "merge", "--no-ff", "-m", "the pull request", branch, cwd=repo)
