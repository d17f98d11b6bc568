"""Headless Chromium for tests of pages: opens files, presses keys, evaluates scripts, screenshots.

Commands are sent through two pipes (Chrome DevTools Protocol, messages end with a zero byte), so
no port is opened and no further package is needed.
"""

import base64
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
READY = """location.pathname.endsWith(%s) && document.readyState === "complete" &&
(document.documentElement.dataset.ready === "yes" || !document.querySelector("script:not([type])"))
"""
ON_THREE_AND_FOUR = """
import fcntl, os, sys
incoming, outgoing = (fcntl.fcntl(int(word), fcntl.F_DUPFD, 10) for word in sys.argv[1:3])
os.dup2(incoming, 3), os.dup2(outgoing, 4)
os.execv(sys.argv[3], sys.argv[3:])
"""
KEYS = {
    "Tab": (9, ""),
    "Enter": (13, "\r"),
    "ArrowRight": (39, ""),
    "ArrowLeft": (37, ""),
    "Home": (36, ""),
    "+": (187, "+"),
    "2": (50, "2"),
}


class Browser:
    """One tab; `errors` are those of scripts and console, `requests` all requested addresses."""

    def __init__(self, patience: float = 60.0):
        self.patience, self.count, self.rest = patience, 0, b""
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.home = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        to_read, self.write = os.pipe()
        self.read, to_write = os.pipe()
        words = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"]
        words += ["--remote-debugging-pipe", f"--user-data-dir={self.home.name}", "about:blank"]
        self.process = subprocess.Popen(
            [sys.executable, "-c", ON_THREE_AND_FOUR, str(to_read), str(to_write), *words],
            pass_fds=(to_read, to_write),
            env={**os.environ, "HOME": self.home.name},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_read)
        os.close(to_write)
        try:
            self._attach()
        except BaseException:
            self.__exit__()
            raise

    def _attach(self):
        self.session = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self.session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        os.close(self.write)
        os.close(self.read)
        self.home.cleanup()

    def open(self, path: Path, width: int = 1280, height: int = 1000, after: str = ""):
        """Open a file, with `after` appended to its URL, and wait until its scripts have run."""
        self.resize(width, height)
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=path.as_uri() + after)
        end = time.monotonic() + self.patience
        while not self.value(READY % json.dumps(path.name)):
            assert time.monotonic() < end, f"{path} is not ready: {self.errors}"
            time.sleep(0.05)

    def resize(self, width: int, height: int = 1000):
        """Change the size of the window."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def value(self, script: str):
        """Return the value of an expression in the page."""
        reply = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in reply, reply["exceptionDetails"]
        return reply["result"].get("value")

    def press(self, *names: str):
        """Press keys, one after the other."""
        for name in names:
            code, text = KEYS[name]
            key = {"key": name, "windowsVirtualKeyCode": code, "nativeVirtualKeyCode": code}
            down = {"type": "keyDown", "text": text} if text else {"type": "rawKeyDown"}
            self.call("Input.dispatchKeyEvent", **key, **down)
            self.call("Input.dispatchKeyEvent", **key, type="keyUp")

    def picture(self, path: Path):
        """Write a screenshot as PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))

    def call(self, method: str, **params) -> dict:
        """Send a command and return its result; record the events received meanwhile."""
        self.count += 1
        message = {"id": self.count, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.write, json.dumps(message).encode() + b"\0")
        while True:
            reply = self._next()
            if reply.get("id") == self.count:
                assert "error" not in reply, reply["error"]
                return reply["result"]
            self._record_event(reply)

    def _record_event(self, reply: dict):
        params = reply.get("params", {})
        match reply.get("method"):
            case "Runtime.exceptionThrown":
                self.errors.append(json.dumps(params["exceptionDetails"]))
            case "Log.entryAdded":
                self.errors.append(params["entry"]["text"])
            case "Network.requestWillBeSent":
                self.requests.append(params["request"]["url"])

    def _next(self) -> dict:
        end = time.monotonic() + self.patience
        while b"\0" not in self.rest:
            ready, _, _ = select.select([self.read], [], [], end - time.monotonic())
            assert ready, "the browser does not answer"
            part = os.read(self.read, 1 << 20)
            assert part, "the browser has gone"
            self.rest += part
        message, _, self.rest = self.rest.partition(b"\0")
        return json.loads(message)
