# ruff: noqa: E402
import gc
import os
import re
import sys

# Workers share the cores: threads of BLAS that wait for each other cost up to half as much again.
for library in ("OMP", "OPENBLAS", "MKL"):  # before NumPy is imported
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

gc.disable()  # until all modules are imported: nothing of them is garbage

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


LONG = """
    cars examples own_policies site_in_browser executors hostile_entries conformance_checks
    sandbox scaffold wiener wrong_inputs kalman estimator_contract calibrated_fir board
    kalman_posterior record_contract accelerometer_layouts_estimated rosenbrock car_fit
    vector_env conformance_results work_precision paper package adding map_smoother
    passes_command report kills
""".split()
"""Files of the most processor time, the longest first, so that the workers end together."""


def pytest_collection_modifyitems(items):
    order = {f"test_{name}": k for k, name in enumerate(LONG)}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


def pytest_collection_finish():
    gc.freeze()
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config):
    """One worker more than there are cores, since some tests wait for time limits and for disks."""
    return (os.cpu_count() or 1) + 1


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Each file in one worker, and those of the site together, which takes seconds to make."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduler(LoadFileScheduling):
        def _split_scope(self, nodeid):
            return re.sub(r"(tests/browser)/.*", r"\1", super()._split_scope(nodeid))

    return Scheduler(config, log)


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
