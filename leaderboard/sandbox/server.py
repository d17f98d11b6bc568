"""Fork server of entries: imports the libraries once, before any truth exists.

    python -P -m leaderboard.sandbox.server

reads launch requests from standard input, one JSON line each, and writes the status of each run to
standard output. It ends at the end of its input, or with its parent.
"""

import dataclasses
import gc
import json
import os
import sys

from leaderboard.sandbox import namespaces, processes, supervisor
from leaderboard.sandbox.supervisor import LaunchRequest, RunStatus
from road_envs.config import build


def main() -> None:
    """Serve launch requests until the end of input."""
    processes.die_with_parent()
    processes.become_subreaper()
    _preload()
    print(json.dumps({"namespaces": namespaces.available()}), flush=True)
    for line in sys.stdin:
        run_status = _supervise(build(LaunchRequest, json.loads(line), "launch request"))
        if run_status is not None:
            _send(run_status)


def _preload() -> None:
    """Import what every entry of this package needs; only its worker imports a plug-in."""
    import pyarrow.parquet  # noqa: F401

    import estimators
    import leaderboard.evaluation.entries  # noqa: F401
    import road_envs.data.recording  # noqa: F401

    assert estimators.REGISTRY
    gc.collect()
    gc.freeze()


def _supervise(launch: LaunchRequest) -> RunStatus | None:
    """Fork a supervisor for a run; return a status if the supervisor failed to send its own."""
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            _send(supervisor.run(launch))
            status = 0
        finally:
            os._exit(status)
    _, status = os.waitpid(pid, 0)
    processes.kill_descendants()
    if status == 0:
        return None
    return RunStatus(outcome="supervisor", status=os.waitstatus_to_exitcode(status))


def _send(run_status: RunStatus) -> None:
    sys.stdout.write(json.dumps(dataclasses.asdict(run_status)) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
