"""What an entry imports and boards lack is told before it is submitted."""

import re
import struct
import sys
import tracemalloc
import zipfile
import zlib
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from wheels import write_wheel

from leaderboard.commands import check
from leaderboard.commands.options import LimitOptions
from leaderboard.conformance.probes import CheckResult
from leaderboard.entries import entry_files, imports
from leaderboard.entries.entry import EntryError
from leaderboard.entries.entry_files import CLASS_FOLDER
from leaderboard.entries.imports import imported_versions
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
        ("import pytest", ["pytest of the package pytest"]),
        ("if 1:\n    from _pytest.mark import Mark", ["_pytest of the package pytest"]),
        ("def f():\n    import pytest", []),
        ("class A:\n    async def f(self):\n        import pytest", []),
        ("import os\nwith os.scandir():\n    import pytest", ["pytest of the package pytest"]),
        ("from contextlib import suppress\nwith suppress(ImportError):\n    import pytest", []),
        ("import contextlib as c\nwith c.suppress(ImportError, OSError):\n    import pytest", []),
        ("class A:\n    import xdist.plugin", ["xdist of the package pytest-xdist"]),
        ("try:\n    import pytest\nexcept ImportError:\n    pass", []),
        ("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import pytest", []),
        ("import json, scipy.signal, torch, yaml\nfrom . import entry", []),
        ("import not_installed_anywhere", []),  # which cannot be constructed here, either
        ("import pytest (", []),
    ],
)
@pytest.mark.parametrize("as_wheel", [False, True])
def test_modules_that_boards_lack_are_named_with_their_package(tmp_path, helper, missing, as_wheel):
    code = write(tmp_path / "code", helper)
    places = [code]
    if as_wheel:
        files = [(f"mine/{path.name}", path.read_text()) for path in (code / "mine").iterdir()]
        (tmp_path / "wheel").mkdir()
        wheel = write_wheel(tmp_path / "wheel", "my_road", "", "mine = mine.entry:Mine", files)
        places = [wheel, wheel.parent]
    sentences = [f"it imports {x}, which boards lack" for x in missing]
    for place in places:
        assert [x.partition(":")[0] for x in missing_packages(place)] == sentences


@pytest.mark.parametrize(
    "helper",
    [
        "x = " + "+".join(["1"] * 20_000),
        "if " + "+".join(["1"] * 1200) + ":\n    pass",
        "x = " + "-" * 20_000 + "1",
        "import pytest\n" + "#" * (1 << 20),
        "import pytest\nx = f'" + "{a}" * 60_000 + "'",  # for two minutes, if there were 300 000
    ],
)
def test_code_that_is_too_deep_or_too_long_to_be_parsed_is_not_read(tmp_path, helper):
    assert missing_packages(write(tmp_path, helper)) == []
    assert missing_packages(write(tmp_path, "import pytest\n" + "#" * 100_000)) != []


@pytest.mark.parametrize(
    ("text", "is_refused"),
    [
        (b"import " + b".".join([b"a"] * 101), True),
        (b"import " + b".".join([b"a"] * 10_000), True),
        (b"from " + b"\t.\\\n ".join([b"a"] * 5000) + b" import b", True),
        (b"import " + ".".join(["\u00e9"] * 5000).encode(), True),
        (b"import " + b".".join([b"a"] * 100), False),
        (b"from " + b"a" * 50_000 + b" import " + b"b," * 2000 + b"b", False),
        (b"from . import " + b"b," * 2000 + b"b" * 50_000, False),
        (b"import " + b"a" * 50_000, False),
        (b"from " + b"." * 50_000 + b" import a", False),
    ],
)
def test_the_reading_of_imports_takes_no_memory_by_the_square_of_their_length(
    tmp_path, text, is_refused
):
    code = write(tmp_path, "import pytest")
    assert imported_versions(str(code)) and missing_packages(code)  # what is kept is read before
    (code / "mine/helper.py").write_bytes(text)
    tracemalloc.start()
    try:
        for read in (imported_versions, lambda folder: missing_packages(Path(folder))):
            why = pytest.raises(EntryError, match=r"mine\.helper has a name of over 100 parts, ")
            with why if is_refused else nullcontext():
                assert all(len(x) < 300 for x in read(str(code)))
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("coding", ["utf-8", "latin-1", "punycode", "idna", "unicode_escape"])
def test_the_coding_that_a_file_names_does_not_decide_how_long_it_is_read(tmp_path, coding):
    code = write(tmp_path, "")
    text = f"# coding: {coding}\nimport zz_gone\n# \xe9" + "\\x7b" * 10
    (code / "mine/helper.py").write_bytes(text.encode("latin-1"))
    assert "zz_gone none" in imported_versions(str(code))


def test_packages_that_come_along_and_modules_that_are_not_run_are_not_missing(tmp_path):
    along = {"pytest/__init__.py": "", "mine/test_helper.py": "import xdist"}
    assert missing_packages(write(tmp_path, "import pytest", **along)) == []


def test_the_files_of_an_entry_have_one_budget_for_the_reading_of_their_imports(
    tmp_path, monkeypatch
):
    files = [(f"mine/m{k}.py", "import zz_gone\nx = f'{k}{k}'") for k in range(3)]
    wheel = write_wheel(tmp_path, "mine", "", "mine = mine.entry:Mine", files)
    assert "zz_gone none" in imported_versions(str(wheel))
    monkeypatch.setattr(imports, "_MOST_WORK", 2 * 2 * len(files[0][1]))
    with pytest.raises(EntryError, match="its Python files have too many braces to be parsed in s"):
        imported_versions(str(wheel))
    monkeypatch.undo()
    monkeypatch.setattr(imports, "_MAX_MODULES", 2)
    monkeypatch.setattr(imports, "find_spec", pytest.fail)  # none is looked up before
    with pytest.raises(EntryError, match="its code imports more than 2 modules"):
        imported_versions(str(write(tmp_path / "code", "import zz_1, zz_2, zz_3")))
    monkeypatch.undo()
    monkeypatch.setattr(imports, "MAX_FILES", 6)
    with pytest.raises(EntryError, match="its code has more than 6 files, with those in wheels"):
        imported_versions(str(wheel))
    long = [("mine/long.py", "import zz_unseen\n" + "{}" * (1 << 20)), *files]
    monkeypatch.undo()
    long_wheel = write_wheel(tmp_path, "long", "", "mine = mine.entry:Mine", long)
    assert imported_versions(str(long_wheel)) == ("zz_gone none",)


@pytest.mark.parametrize("as_wheel", [False, True])
def test_what_is_installed_beside_an_entry_is_told_by_version_or_by_content(
    tmp_path, monkeypatch, as_wheel
):
    def write_distribution(name, version, record):
        about = site / f"{name}-{version}.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
        )
        (about / "RECORD").write_text(record)
        (about / "top_level.txt").write_text(name)

    site, project = tmp_path / "site", tmp_path / "project"
    for folder in (site, project):
        folder.mkdir()
        monkeypatch.syspath_prepend(folder)
    (site / "zz_loose.py").write_text("import zz_deeper, json\nfrom leaderboard import api")
    (site / "zz_deeper.py").write_text("A = 1")
    (site / "zz_wheel.py").write_text("import zz_not_followed")
    write_distribution("zz_wheel", "1.0", "zz_wheel.py,sha256=a,9\n../bin/zz.py,sha256=b,9\n")
    (project / "zz_editable.py").write_text("")
    write_distribution("zz_editable", "2.0", "zz_editable.pth,,")
    (project / "zz_develop.py").write_text("")  # which an older installer leaves in its folder
    (project / "zz_develop.egg-info").mkdir()
    (project / "zz_develop.egg-info/PKG-INFO").write_text("Name: zz_develop\nVersion: 3.0\n")
    (project / "zz_develop.egg-info/top_level.txt").write_text("zz_develop")
    optional = "try:\n    import zz_gone, zz_editable, zz_develop\nexcept ImportError:\n    pass"
    helper = f"import zz_loose, zz_wheel\n{optional}\nfrom .entry import np"
    code = write(tmp_path / "code", helper)
    if as_wheel:
        files = [(f"mine/{path.name}", path.read_text()) for path in (code / "mine").iterdir()]
        code = write_wheel(tmp_path, "my_road", "", "mine = mine.entry:Mine", files)

    def told():
        versions = imported_versions(str(code))
        assert {*installed.items()} <= {tuple(x.split()[:2]) for x in versions}
        return {x.partition(" ")[0]: x for x in versions if tuple(x.split()[:2]) not in fixed}

    installed = {
        "numpy": np.__version__,
        "zz_wheel": "1.0",
        "zz_editable": "2.0",
        "zz_develop": "3.0",
        "zz_gone": "none",
    }
    fixed = installed.items()
    before = told()
    assert list(before) == ["zz_deeper", "zz_develop", "zz_editable", "zz_loose"]
    (site / "zz_deeper.py").write_text("A = 2")
    (project / "zz_editable.py").write_text("B = 1")
    after = told()
    changed = [name for name in before if before[name] != after[name]]
    assert changed == ["zz_deeper", "zz_editable"] and list(after) == list(before)
    (site / "zz_wheel-1.0.dist-info/METADATA").write_text("Name: zz_wheel\nVersion: 1.1\n")
    assert [x for x in imported_versions(str(code)) if x.startswith("zz_wheel 1.1 ")]


FILES_OF_A_WHEEL = (
    '"zz_gain/a,b.NPZ"', "zz_gain/w.bin", "zz_gain/w.pickle", "zz_gain/w.h5", "zz_gain/w.pth",
    "zz_gain/weights", "zz_gain/editable_.gz", "zz_gain/bin/w.pb", "../../../share/zz_gain/w.dat",
)  # fmt: skip
FILES_OF_A_MACHINE = (
    "../../../bin/zz", '"../../Scripts/z,z.exe"', "/usr/share/zz", "../../../include/zz/zz.h",
    "__editable___zz_finder.py", "_zz_editable_loader.py", "_editable_impl_zz.pth",
    "zz_gain-1.0.dist-info/direct_url.json", "zz_gain-1.0.dist-info/INSTALLER",
    "__pycache__/zz_gain.pyc", "zz_gain/__pycache__/w.pyc", "zz_gain/__config__.py",
    "zz_gain/core.cpython-311-darwin.so", "zz_gain.libs/libm-0a.so.5.0", "zz_gain/core.pyd",
    "zz_gain/core.h",
)  # fmt: skip


def test_a_wheel_that_is_built_again_under_its_version_is_another_one_on_every_machine(
    tmp_path, monkeypatch
):
    about = tmp_path / "site" / "zz_gain-1.0.dist-info"
    about.mkdir(parents=True)
    monkeypatch.syspath_prepend(tmp_path / "site")
    (tmp_path / "site" / "zz_gain.py").write_text("GAIN = 1.0")
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: zz_gain\nVersion: 1.0\n")
    (about / "top_level.txt").write_text("zz_gain")
    code = write(tmp_path / "code", "import zz_gain")

    def told(*lines):
        (about / "RECORD").write_text("".join(f"{line},9\n" for line in lines))
        (found,) = (x for x in imported_versions(str(code)) if x.startswith("zz_gain"))
        return found

    mine = (
        "zz_gain.py,sha256=a",
        "zz_gain.dat,sha512=a",
        *(f"{name},sha256=a" for name in FILES_OF_A_WHEEL),
    )
    known = told(*mine)
    assert known == told(*reversed(mine), *(f"{name},sha256=b" for name in FILES_OF_A_MACHINE))
    assert known == told(*(line.replace("../../../share", "../../share") for line in mine))
    for k in range(len(mine)):
        for rebuilt in (mine[:k] + mine[k + 1 :], [*mine, mine[k].replace("=a", "=b")]):
            assert told(*rebuilt) != known and told(*rebuilt).startswith("zz_gain 1.0 ")


def test_a_module_in_the_working_folder_is_not_taken_for_what_is_imported(tmp_path, monkeypatch):
    site, here = tmp_path / "site", tmp_path / "here"
    for folder in (site, here):
        folder.mkdir()
        (folder / "zz_gain.py").write_text(f"GAIN = '{folder.name}'")
    monkeypatch.syspath_prepend(site)
    code = write(tmp_path / "code", "import zz_gain")
    (known,) = (x for x in imported_versions(str(code)) if x.startswith("zz_gain"))
    monkeypatch.setenv(CLASS_FOLDER, str(here))
    assert known in imported_versions(str(code))
    (site / "zz_gain.py").unlink()
    assert "zz_gain none" in imported_versions(str(code))


def test_each_loose_part_of_a_package_without_init_is_told_by_its_content(tmp_path, monkeypatch):
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (second, first):
        (folder / "zz_acme").mkdir(parents=True)
        monkeypatch.syspath_prepend(folder)
    (first / "zz_acme/core.py").write_text("")
    about = first / "zz_acme_core-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: zz_acme_core\nVersion: 1.0\n")
    (about / "RECORD").write_text("zz_acme/core.py,,")
    loose = second / "zz_acme/zz_far.py"
    loose.write_text("import zz_far\nfrom .near import GAIN")
    code = write(tmp_path / "code", "from zz_acme.zz_far import GAIN")

    def told():
        return [x for x in imported_versions(str(code)) if x.startswith("zz_")]

    digest, owner, far = told()
    assert digest.startswith("zz_acme ") and (owner, far) == ("zz_acme_core 1.0", "zz_far none")
    (first / "zz_acme/core.py").write_text("A = 1")
    assert told() == [digest, owner, far]
    loose.write_text("import zz_far\nGAIN = 2.0")
    assert told()[0] != digest and told()[1:] == [owner, far]


def test_an_entry_is_refused_beside_a_loose_module_of_which_nothing_tells_a_change(
    tmp_path, monkeypatch
):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(entry_files, "_MAX_SIZE", 1000)
    (tmp_path / "zz_large.py").write_text("A = 1" + " " * 1000)
    code = write(tmp_path / "code", "import zz_large")
    with pytest.raises(EntryError, match="of zz_large beside it, which it imports, its code has"):
        imported_versions(str(code))
    about = tmp_path / "zz_large-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: zz_large\nVersion: 1.0\n")
    (about / "top_level.txt").write_text("zz_large")
    monkeypatch.setattr("sys.path", [*sys.path, str(tmp_path / "other")])  # looked up anew
    assert "zz_large 1.0" in imported_versions(str(code))  # installed without a list of its files


def test_a_wheel_whose_imports_cannot_be_read_is_one_sentence(tmp_path):
    (tmp_path / "cut.whl").write_bytes(b"PK")
    with pytest.raises(EntryError, match="its imports cannot be read: File is not a zip file"):
        imported_versions(str(tmp_path / "cut.whl"))


def test_a_member_of_a_wheel_that_holds_more_than_it_states_takes_no_more_memory(tmp_path):
    wheel, stated = tmp_path / "x-1.0-py3-none-any.whl", b"x = 1\n"
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    content = packer.compress(stated + bytes(2**28)) + packer.flush()
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("x.py", content)
    sizes = zlib.crc32(content), len(content), len(content)
    false = zlib.crc32(stated), len(content), len(stated)
    data = re.sub(
        rb"\x00\x00(....)" + re.escape(struct.pack("<III", *sizes)),
        lambda found: b"\x08\x00" + found[1] + struct.pack("<III", *false),
        wheel.read_bytes(), flags=re.DOTALL,
    )  # fmt: skip
    wheel.write_bytes(data)
    tracemalloc.start()
    try:
        assert imported_versions(str(wheel)) == ()
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_member_of_a_wheel_that_is_unpacked_without_a_limit_is_refused(tmp_path, method):
    with zipfile.ZipFile(tmp_path / "x.whl", "w", method) as wheel:
        wheel.writestr("x.py", "x = 1\n" * 100)
    with pytest.raises(EntryError, match=r"x\.py is compressed by another method than deflate"):
        imported_versions(str(tmp_path / "x.whl"))


def test_what_is_no_wheel_and_broken_entry_points_are_left_to_others(tmp_path):
    weights = tmp_path / "tcn.safetensors"
    weights.write_bytes(b"\x08" + bytes(100))
    assert missing_packages(weights) == []
    points = {"mine-1.dist-info/entry_points.txt": "mine = mine.entry:Mine"}
    assert missing_packages(write(tmp_path / "code", "import pytest", **points)) == []


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
    assert "it imports xdist of the package pytest-xdist" in bad.facts["checks"][0]["message"]
