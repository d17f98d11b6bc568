# ruff: noqa: E402
import gc
import importlib.util
import os
import re
import sys
from pathlib import Path

# Workers share the cores: threads of BLAS that wait for each other cost up to half as much again.
for library in ("OMP", "OPENBLAS", "MKL"):  # before NumPy is imported
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

gc.disable()  # until all modules are imported: nothing of them is garbage

import pytest
from hypothesis import Phase, settings

from examples import FACTOR
from leaderboard import cli

ROOT = Path(__file__).resolve().parents[1]
TESTED = Path(cli.__file__).resolve().parents[1]
if TESTED != ROOT:  # a copied environment still names the checkout that it was made for
    pytest.exit(f"these tests are of {ROOT}, the package that they import is {TESTED}: install it "
                f"here, with {sys.executable} -m pip install --editable {ROOT}", 2)  # fmt: skip

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
    cars own_policies examples kalman estimator_contract hostile_entries board hidden_seeds
    calibrated_fir record_contract car_fit site_in_browser wiener conformance_checks
    accelerometer_layouts_estimated vector_env kalman_posterior rosenbrock executors wrong_inputs
    sandbox evaluate seals work_precision conformance_results adaptive_drive policies map_smoother
    paper varied_drives report cli adding
""".split()
"""Files of the most processor time, the longest first, so that the workers end together."""


def pytest_collection_modifyitems(items):
    order = {f"test_{name}": k for k, name in enumerate(LONG)}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


def pytest_collection_finish():
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _kept_caches():
    """Between guests, files stay in the memory of the machine, which other tests share, and no
    pipes are opened, which takes seconds. Tests of these functions import them before this.
    """
    import jobs_with_kept_caches  # which spares this process, too

    from leaderboard.running import executors

    started = executors.start_host_process

    def start(handler, *folders):
        with pytest.MonkeyPatch.context() as of_process:
            support = str(Path(jobs_with_kept_caches.__file__).parent)
            of_process.setenv("PYTHONPATH", support, prepend=os.pathsep)
            return started(jobs_with_kept_caches.__name__, *folders)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(executors, "start_host_process", start)
        yield


LEARNS = importlib.util.find_spec("torch") is not None
NEEDED = ("torch", "stable_baselines3")
collect_ignore = (
    []
    if LEARNS
    else ["integration/test_policy_training.py", "integration/test_sb3.py", "unit/test_agents.py"]
)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Skip what needs the extra `learn` where that is not installed (`make test-versions`)."""
    try:
        return (yield)
    except Exception as error:
        if LEARNS or not any(f"module named '{name}" in str(error) for name in NEEDED):
            raise
        pytest.skip("needs the extra learn")


pytest_runtest_setup = pytest_runtest_call


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
    """Let commands read drives without trying other descriptions, which takes seconds each."""
    monkeypatch.setattr("leaderboard.commands.drive_files.with_doubts", lambda drive: drive)


@pytest.fixture
def road_recon(unchecked, monkeypatch, capsys, tmp_path):
    """Run the command in an empty folder, without doubts of descriptions; returns exit code,
    standard output and error.
    """
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["road-recon", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capsys.readouterr()
        return ended.value.code or 0, out, err

    return run
