"""What an entry imports and boards lack is told before it is submitted."""

from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from wheels import write_wheel

from leaderboard.commands import check
from leaderboard.commands.options import LimitOptions
from leaderboard.conformance.probes import CheckResult
from leaderboard.submission.dependencies import missing_packages

POINTS = "[road_envs.estimators]\nmine = mine.entry:Mine\n"
ENTRY = "import numpy as np\nfrom . import helper\nfrom estimators import estimate\n"


def write(folder, helper, **more):
    """Write the code of an entry with a helper; return its folder."""
    files = {"mine/__init__.py": "", "mine/entry.py": ENTRY, "mine/helper.py": helper}
    for name, text in {**files, "mine-1.dist-info/entry_points.txt": POINTS, **more}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize(
    ("helper", "missing"),
    [
        ("import pytest", {"pytest": "pytest"}),
        ("if 1:\n    from _pytest.mark import Mark", {"_pytest": "pytest"}),
        ("def f():\n    import pytest", {}),
        ("class A:\n    async def f(self):\n        import pytest", {}),
        ("import os\nwith os.scandir():\n    import pytest", {"pytest": "pytest"}),
        ("from contextlib import suppress\nwith suppress(ImportError):\n    import pytest", {}),
        ("import contextlib as c\nwith c.suppress(ImportError, OSError):\n    import pytest", {}),
        ("class A:\n    import xdist.plugin", {"xdist": "pytest-xdist"}),
        ("try:\n    import pytest\nexcept ImportError:\n    pass", {}),
        ("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import pytest", {}),
        ("import json, scipy.signal, torch, yaml\nfrom . import entry", {}),
        ("import not_installed_anywhere", {}),  # which cannot be constructed here, either
        ("import pytest (", {}),
    ],
)
@pytest.mark.parametrize("as_wheel", [False, True])
def test_modules_that_boards_lack_are_named_with_their_package(tmp_path, helper, missing, as_wheel):
    code = write(tmp_path / "code", helper)
    if as_wheel:
        files = [(f"mine/{path.name}", path.read_text()) for path in (code / "mine").iterdir()]
        code = tmp_path / "wheel"
        code.mkdir()
        wheel = write_wheel(code, "my_road", "", "mine = mine.entry:Mine", files)
        assert missing_packages(wheel) == missing
    assert missing_packages(code) == missing


@pytest.mark.parametrize(
    "helper",
    [
        "x = " + "+".join(["1"] * 20_000),
        "if " + "+".join(["1"] * 1200) + ":\n    pass",
        "x = " + "-" * 20_000 + "1",
        "import pytest\n" + "#" * (1 << 20),
    ],
)
def test_code_that_is_too_deep_or_too_long_to_be_parsed_is_not_read(tmp_path, helper):
    assert missing_packages(write(tmp_path, helper)) == {}
    assert missing_packages(write(tmp_path, "import pytest\n" + "#" * 100_000)) != {}


def test_packages_that_come_along_and_modules_that_are_not_run_are_not_missing(tmp_path):
    along = {"pytest/__init__.py": "", "mine/test_helper.py": "import xdist"}
    assert missing_packages(write(tmp_path, "import pytest", **along)) == {}


def test_what_is_no_wheel_and_broken_entry_points_are_left_to_others(tmp_path):
    weights = tmp_path / "tcn.safetensors"
    weights.write_bytes(b"\x08" + bytes(100))
    assert missing_packages(weights) == {}
    points = {"mine-1.dist-info/entry_points.txt": "mine = mine.entry:Mine"}
    assert missing_packages(write(tmp_path / "code", "import pytest", **points)) == {}


def test_the_check_of_a_wheel_or_folder_fails_for_them(tmp_path, monkeypatch):
    monkeypatch.setattr(
        check, "SandboxClient", lambda limits: nullcontext(SimpleNamespace(describe=0))
    )
    monkeypatch.setattr(
        check, "resolve_entries", lambda *_: [SimpleNamespace(name="mine", failure=None)]
    )
    monkeypatch.setattr(check, "check_entry", lambda *_: [CheckResult("runs", True, "60 m")])
    good = check.check_estimator(str(write(tmp_path / "good", "import yaml")), LimitOptions())
    assert good.status == 0
    bad = check.check_estimator(str(write(tmp_path / "bad", "import xdist")), LimitOptions())
    assert bad.status == 1 and bad.facts["checks"][0]["name"] == "packages"
    assert "xdist is of the package pytest-xdist" in bad.facts["checks"][0]["message"]
