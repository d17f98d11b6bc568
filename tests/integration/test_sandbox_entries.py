"""Sandbox: entries that are described and not yet run, limits, and words for an exit."""

import errno
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy
import pytest
from guests import LIMITS, drives
from test_sandbox import MODES

from leaderboard.commands import find_from_here, import_from_here
from leaderboard.entries import entries
from leaderboard.entries.entry import EntryError
from leaderboard.entries.entry_files import CLASS_FOLDER, list_files, snapshot
from leaderboard.entries.imports import imported_versions
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.guest import MachineError, describe_exit
from leaderboard.sandbox.limits import Limits
from road_envs.core.config import ConfigError


@pytest.mark.costly
def test_a_plug_in_is_described_without_being_loaded_in_this_process(tmp_path, monkeypatch):
    limits = replace(LIMITS, isolation=MODES[0])
    (tmp_path / "external_slope.py").write_text(
        "import numpy, sys\n"
        "from dataclasses import dataclass\n"
        "from typing import ClassVar\n"
        "@dataclass(frozen=True, kw_only=True)\n"
        "class Slope:\n"
        "    causal: ClassVar[bool] = True\n"
        "    steep: float = 0.5\n"
        "    def estimate(self, record, car): ...\n"
    )
    about = tmp_path / "external_slope-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: external-slope\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        "[road_envs.estimators]\nslope = external_slope:Slope\nsunken = no_such_module:Hole\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with SandboxClient(limits) as fresh:
        slope, sunken, flat = entries.resolve_entries(["slope", "sunken", "flat"], fresh.describe)
    assert (slope.settings, slope.causal, slope.failure) == ({"steep": 0.5}, True, None)
    assert (slope.name, slope.reference) == ("slope", "external_slope:Slope")
    assert [x.rpartition(" ")[0] for x in slope.imports] == [f"numpy {numpy.__version__}"]
    assert len(slope.code) == 16 and "external_slope" not in sys.modules
    assert sunken.failure == "cannot be constructed: there is no module 'no_such_module'"
    assert flat.reference == "flat" and flat.failure is None
    before = slope.code
    (tmp_path / "external_slope.py").write_text(
        (tmp_path / "external_slope.py").read_text().replace("0.5", "0.6")
    )
    with SandboxClient(limits) as fresh:
        with pytest.raises(EntryError, match="its files have changed since the run was planned"):
            fresh.reconstruct(slope, *drives(), (1,))
        (slope,) = entries.resolve_entries(["slope"], fresh.describe)
    assert slope.code != before and slope.settings == {"steep": 0.6}


def test_an_entry_is_not_run_with_other_imports_than_it_was_planned_with(tmp_path, monkeypatch):
    (tmp_path / "zz_gain.py").write_text("GAIN = 1.0")
    (tmp_path / "code").mkdir()
    (tmp_path / "code/zz_mine.py").write_text("import zz_gain\n")
    monkeypatch.syspath_prepend(tmp_path)
    reference = str(tmp_path / "code")
    known = {"code": snapshot(reference, None), "imports": imported_versions(reference)}
    entry = entries.Entry(name="mine", reference=reference, **known)
    (tmp_path / "zz_gain.py").write_text("GAIN = -3.0")
    with SandboxClient(replace(LIMITS, isolation=MODES[0])) as fresh:
        with pytest.raises(EntryError, match=r"imports \(zz_gain\) have changed since the run was"):
            fresh.reconstruct(entry, *drives(), (1,))


def test_two_classes_of_one_name_in_one_module_are_two_entries(tmp_path, monkeypatch):
    text = (
        "class {}:\n"
        "    @dataclass(frozen=True)\n"
        "    class Est:\n"
        "        causal: ClassVar[bool] = False\n"
        "        def estimate(self, record, car): ...\n"
    )
    head = "from dataclasses import dataclass\nfrom typing import ClassVar\n"
    (tmp_path / "twins.py").write_text(head + text.format("A") + text.format("B"))
    monkeypatch.syspath_prepend(tmp_path)
    references = "twins:A.Est", "twins:B.Est"
    with SandboxClient(replace(LIMITS, isolation=MODES[0])) as fresh:
        (a,), (b,) = (entries.resolve_entries([one], fresh.describe) for one in references)
    assert a.name == b.name == "Est" and a.code != b.code
    for entry in (a, b):
        copy = tmp_path / entry.code
        assert snapshot(entry.reference, copy) == entry.code
        assert snapshot(entry.reference, None, copy) == entry.code  # also on a worker


def test_what_cannot_be_described_takes_no_name_of_an_entry_that_works(tmp_path):
    def describe(reference):
        if "first" in reference or "named" in reference:
            name = "flat" if "named" in reference else None
            if name is None:
                raise EntryError("cannot be constructed")
            return {"name": name, "causal": False, "code": "1" * 16}
        return {"name": "rival", "causal": False, "code": "0" * 16}

    wheels = [tmp_path / place / "rival-1.0.whl" for place in ("first", "named", "second")]
    for wheel in wheels:
        wheel.parent.mkdir()
        wheel.touch()
    found = entries.resolve_entries([str(wheel) for wheel in wheels], describe)
    assert [(entry.name, entry.failure is None) for entry in found] == [
        ("rival_2", False), ("rival_3", False), ("rival", True),
    ]  # fmt: skip


NO_SPACE = "this machine has no space left for its code: set TMPDIR elsewhere"
NO_GUEST = "this machine did not start its guest: "


@pytest.mark.parametrize(
    ("writes", "code", "sentence"),
    [
        ((Path, "write_bytes"), errno.ENOSPC, NO_SPACE),
        ((shutil, "copyfile"), errno.ENOSPC, NO_SPACE),
        ((shutil, "copyfile"), errno.EDQUOT, NO_SPACE),
        ((shutil, "copyfile"), errno.EIO, NO_GUEST),
    ],
)
def test_an_entry_that_a_machine_has_no_space_for_is_not_blamed_and_ends_no_others(
    tmp_path, monkeypatch, writes, code, sentence
):
    """Nor is what was copied of it left for others, which would see it and lack the space."""

    def refuse(*args, **options):
        raise OSError(code, os.strerror(code), "a file")

    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "code.py").touch()
    monkeypatch.setattr(*writes, refuse)
    with SandboxClient(replace(LIMITS, isolation=MODES[0])) as fresh:
        given = str(tmp_path / "mine")
        mine, flat = entries.resolve_entries([given, "flat"], fresh.describe)
        with pytest.raises(MachineError):
            fresh.describe(given)
        assert not [*fresh._folder.glob("*.code")]
        assert len([*fresh._folder.glob("entry-*")]) == (writes[0] is shutil)
    assert mine.failure.startswith(sentence) and flat.failure is None
    assert len(mine.failure) <= 300


def test_a_module_beside_an_entry_takes_the_place_of_none_of_the_leaderboard(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setenv(CLASS_FOLDER, "")
    for name in ("beside_it.py", "colorsys.py"):
        (tmp_path / name).write_text("raise RuntimeError('it was imported')\n")
    (tmp_path / "wave").mkdir()
    find_from_here(["beside_it:Mine"])
    assert str(tmp_path) not in sys.path
    for name in ("beside_it", "colorsys"):
        assert list(list_files(f"{name}:Mine")) == [(tmp_path / f"{name}.py", f"{name}.py")]
    (installed,) = list_files("wave:Wave_read")  # a folder without __init__.py is no package
    assert tmp_path not in installed[0].parents
    import_from_here("beside_it:Mine")
    assert sys.path.index(str(tmp_path)) == len(sys.path) - 1


def test_of_a_file_in_two_portions_of_a_package_the_one_is_listed_that_is_imported(
    tmp_path, monkeypatch
):
    for folder in ("second", "first"):
        (tmp_path / folder / "zz_parts").mkdir(parents=True)
        (tmp_path / folder / "zz_parts/mine.py").touch()
        monkeypatch.syspath_prepend(tmp_path / folder)
    (tmp_path / "second/zz_parts/other.py").touch()
    listed = {name: path.parents[1].name for path, name in list_files("zz_parts.mine:Mine")}
    assert listed == {"zz_parts/mine.py": "first", "zz_parts/other.py": "second"}


@pytest.mark.parametrize("link", ["weights.npz", "data"])
def test_a_link_in_the_code_of_an_entry_is_refused_and_named(tmp_path, link):
    """As DVC and Hugging Face keep weights: left out, they would be missing in the guest."""
    code = tmp_path / "code" / "mine"
    code.mkdir(parents=True)
    (code / "__init__.py").touch()
    (tmp_path / "data").mkdir()
    assert [name for _, name in list_files(str(tmp_path / "code"))] == ["mine/__init__.py"]
    (code / link).symlink_to(tmp_path / link)
    with pytest.raises(EntryError, match=f"its code has a link, .* leads to: 'mine/{link}'"):
        list(list_files(str(tmp_path / "code")))


def test_limits_must_be_positive():
    for name in ("seconds", "memory", "file"):
        with pytest.raises(ValueError, match=f"{name}: must be positive, got 0"):
            Limits(**{name: 0})
    with pytest.raises(ValueError, match="processes: must be at least 1, got 0"):
        Limits(processes=0)


def test_an_exit_is_described_by_its_signal_or_status():
    assert [describe_exit(x) for x in (0, 3, -9, 128 + 11)] == [
        "exit status 0", "exit status 3", "SIGKILL", "SIGSEGV",
    ]  # fmt: skip


def test_a_class_of_this_package_is_named_as_the_registry_does():
    """By its path it would have no code of its own, and so a row that is never made again."""
    with pytest.raises(
        ConfigError, match=r"estimators\.baselines\.flat:Flat is a class of this pa"
    ):
        entries.resolve_entries(["estimators.baselines.flat:Flat"], None)
