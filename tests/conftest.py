import sys

import pytest
from hypothesis import Phase, settings

from examples import FACTOR
from leaderboard import cli

# The first example of a test may compile kernels; the same examples are tried on every machine.
settings.register_profile("steady", deadline=None, derandomize=True, max_examples=30 * FACTOR)
settings.register_profile(
    "faults",
    settings.get_profile("steady"),
    max_examples=100,
    phases=[Phase.explicit, Phase.generate],
)
settings.load_profile("steady")


LONG = (
    *("test_hostile_entries", "test_executors", "test_scaffold", "test_own_policies"),
    *("test_conformance_checks", "test_conformance_results", "test_examples", "test_sandbox"),
    *("test_package", "test_site_in_browser", "test_code_digest", "test_kills"),
)
"""Files whose tests take seconds each. They begin, so that the workers end together."""


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.path.stem not in LONG)


@pytest.fixture
def unchecked(monkeypatch):
    """Let commands read tables without trying other descriptions, which takes a second each."""
    from leaderboard.commands import drive_files

    monkeypatch.setattr(drive_files, "check_notes", lambda *_, **__: ())


@pytest.fixture
def road_recon(monkeypatch, capsys, tmp_path):
    """Run the command in an empty folder; returns exit code, standard output and error."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["road-recon", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capsys.readouterr()
        return ended.value.code or 0, out, err

    return run
