"""Digests of code change with the code and with nothing else; kernels are cached by them."""

import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from road_envs.core import code_digest
from road_envs.core.code_digest import ROOT, _find_source, _parse, closure, digest, importers

CODE = b'''"""A module."""

import math

LIMIT = 0.5
"""The largest value [m]."""


def law(x):
    """Return the law."""
    return math.sin(x) if x < LIMIT else 0.0  # beyond it there is none


class Empty:
    """Nothing but a docstring."""
'''

SAME = [
    (b"A module.", b"Another text."),
    (b"Return the law.", b""),
    (b"The largest value [m].", b"Largest."),
    (b"  # beyond it there is none", b""),
    (b"    return math.sin(x) if", b"    return math.sin(\n        x\n    ) if"),
    (b"\n\n\ndef law", b"\ndef law"),
]  # fmt: skip
OTHER = [(b"0.5", b"0.25"), (b"math.sin", b"math.cos"), (b"x <", b"x <="), (b"law(x)", b"law(y)")]


@pytest.mark.parametrize(("old", "new"), SAME)
def test_docstrings_comments_and_layout_do_not_change_the_digest(old, new):
    assert CODE.count(old) == 1
    assert _parse(CODE.replace(old, new)).digest == _parse(CODE).digest


@pytest.mark.parametrize(("old", "new"), OTHER)
def test_any_change_of_the_code_changes_the_digest(old, new):
    assert old in CODE
    assert _parse(CODE.replace(old, new)).digest != _parse(CODE).digest


@given(st.lists(st.integers(-9, 9), min_size=1, unique=True))
def test_different_constants_have_different_digests(numbers):
    assert len({_parse(f"x = {n}".encode()).digest for n in numbers}) == len(numbers)


TEXTS = rb"""
def law(x, *, width=8, **more):
    text = u"one" f"{x:>{width}}" f"{x!r:{width}.{width}}{{" "two" f"{x=:}" "\u1c8a\ud800"
    return text, (), f"", f"{x:{width}}{x:%H:%M}", {**more, None: None}, x[1:], -1.5e300j, ...
"""
OF_A_VERSION = """
import sys
from pathlib import Path
from types import ModuleType
for name in ("road_envs", "road_envs.core", "road_envs.core.atomic_io"):
    sys.modules[name] = ModuleType(name)
sys.modules["road_envs.core"].__path__ = [{folder!r}]
sys.modules["road_envs.core.atomic_io"].write_text = print  # the digest itself needs no package
from road_envs.core.code_digest import _parse
print([_parse(Path(path).read_bytes()).digest for path in {paths!r}])
"""


@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13", "3.14"])
def test_the_digest_is_the_same_in_every_version_of_python(tmp_path, version):
    beside = Path(sys.base_prefix).parent.glob(f"*{version}.*/bin/python3")  # as pyenv and uv do
    found = [path for path in (shutil.which(f"python{version}"), *beside) if path]
    usable = (x for x in found if not subprocess.run([x, "-c", ""], capture_output=True).returncode)
    if (python := next(usable, None)) is None:
        pytest.skip(f"no Python {version} here")
    texts = tmp_path / "texts.py"
    texts.write_bytes(TEXTS)
    paths = [texts, *map(Path, (__file__, code_digest.__file__))]
    folder = str(Path(code_digest.__file__).parent)
    code = OF_A_VERSION.format(folder=folder, paths=[*map(str, paths)])
    done = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == f"{[_parse(path.read_bytes()).digest for path in paths]}\n"


def test_the_digest_of_files_depends_on_names_and_contents_and_not_on_their_order(tmp_path):
    a, b, c = (tmp_path / name for name in ("a.py", "b.py", "c.txt"))
    a.write_text("x = 1")
    b.write_text("x = 2")
    c.write_text("x = 3")
    known = digest([a, b, c], tmp_path)
    assert digest([c, b, a, a], tmp_path) == known
    c.write_text("x = 3  # a text file counts by every byte")
    assert digest([a, b, c], tmp_path) != known
    assert digest([a, b], tmp_path) != digest([a], tmp_path)


def test_a_module_is_made_of_what_it_imports_wherever_the_statement_stands(tmp_path):
    package = tmp_path / "estimators"
    (package / "inner").mkdir(parents=True)
    files = {
        "__init__.py": "from estimators import a",
        "a.py": "import numpy\nfrom estimators import b\n",
        "b.py": "def f():\n    from estimators.inner.c import g\n    return g\n",
        "inner/__init__.py": "",
        "inner/c.py": "def g(): ...",
        "other.py": "",
    }
    for name, text in files.items():
        (package / name).write_text(text)
    found = closure("estimators.a", root=tmp_path)
    names = {path.relative_to(package).as_posix() for path in found}
    assert names == {"a.py", "b.py", "inner/c.py"}
    assert [p.name for p in importers(package, "estimators.inner.c")] == ["b.py"]
    assert closure("elsewhere.a", root=tmp_path) == ()


def test_what_was_parsed_is_remembered_and_a_damaged_memory_is_made_again(tmp_path):
    """In processes of their own, whose cache folder is `tmp_path`."""
    code = (
        "from road_envs.core import code_digest as d; "
        "print(d.digest(d.closure('road_envs.core.config')))"
    )
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}

    def run():
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return done.stdout

    first = run()
    (memory,) = (tmp_path / "road-recon").glob("sources-*.json")
    assert run() == first
    memory.write_text(memory.read_text()[:100])
    assert run() == first


KERNELS = """
import sys
sys.path.insert(0, {folder!r})
from kernel_package import law
print(law.twice(2.0), sum(law.twice._cache_hits.values()))
"""


@pytest.mark.costly
def test_a_kernel_is_compiled_again_when_code_changes_and_not_for_a_comment(tmp_path):
    package = tmp_path / "kernel_package"
    package.mkdir()
    (package / "__init__.py").touch()
    source = textwrap.dedent("""
        from road_envs.kernels._numba import kernel

        FACTOR = 2.0

        @kernel
        def twice(x):
            return FACTOR * x
    """)
    law = package / "law.py"
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}

    def run(text):
        law.write_text(text)
        command = [sys.executable, "-c", KERNELS.format(folder=str(tmp_path))]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        value, hits = done.stdout.split()
        assert ("compiling" in done.stderr) == (hits == "0")
        return float(value), int(hits)

    assert run(source) == (4.0, 0)
    assert run(source) == (4.0, 1)
    assert run('"""Doubles."""\n\n# a comment' + source) == (4.0, 1)
    assert run(source.replace("FACTOR = 2.0", "FACTOR = 3.0")) == (6.0, 0)


@pytest.mark.costly
def test_processes_that_start_together_compile_a_kernel_once(tmp_path):
    package = tmp_path / "kernel_package"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "law.py").write_text(
        "from road_envs.kernels._numba import kernel\n"
        "@kernel\ndef twice(x):\n    return 2.0 * x\n"
        "@kernel\ndef four_times(x):\n    return twice(twice(x))\n"
    )
    code = KERNELS.format(folder=str(tmp_path)).replace("law.twice", "law.four_times")
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    command = [sys.executable, "-c", code]
    running = [
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    answers = [process.communicate()[0].split() for process in running]
    assert [float(value) for value, _ in answers] == [8.0] * 2
    assert sorted(int(hits) for _, hits in answers) == [0, 1]


def test_every_module_of_this_project_is_found_by_its_name():
    for name in ("road_envs", "estimators.api", "leaderboard.cli"):
        assert _find_source(name) in closure(name)
        assert all(path.is_relative_to(ROOT) for path in closure(name))
