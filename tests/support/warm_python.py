"""A Python process with libraries loaded that runs each script in a child of its own.

A script finds a new `__main__`, its own folder, arguments and output; only the libraries are there
before it begins, since to import them takes longer than most scripts. As a program it reads
requests from standard input, one JSON object a line, and writes the exit status of each.
"""

import importlib
import json
import os
import runpy
import signal
import subprocess
import sys
import traceback
from pathlib import Path
from typing import NoReturn

TIME_LIMIT = 300
"""Time [s] after which a script is ended."""


class WarmPython:
    """The process; a context manager."""

    def __init__(self, libraries, environment):
        self._process = subprocess.Popen(
            [sys.executable, __file__, *libraries],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.communicate()

    def run(self, script, *words, cwd):
        """Run a script in the folder `cwd`; return its exit status, output and error output."""
        files = [Path(cwd) / name for name in ("stdout.txt", "stderr.txt")]
        request = {"words": [str(script), *map(str, words)], "folder": str(cwd)}
        request["files"] = list(map(str, files))
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        status = int(self._process.stdout.readline())
        return status, *(file.read_text() for file in files)


def main() -> None:
    for name in sys.argv[1:]:
        importlib.import_module(name)
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            _run(**json.loads(line))
        _, status = os.waitpid(pid, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


def _run(words, folder, files) -> NoReturn:
    status = 1
    try:
        signal.alarm(TIME_LIMIT)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for number, file in enumerate(files, start=1):
            os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        os.chdir(folder)
        sys.argv, sys.path[0] = words, str(Path(words[0]).parent)
        runpy.run_path(words[0], run_name="__main__")
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


if __name__ == "__main__":
    main()
