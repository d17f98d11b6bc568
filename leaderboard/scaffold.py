"""Template packages with an own estimator or switching policy, installable and tested.

The examples in `templates` work and are meant to be replaced: double integration of the body's
accelerations, a regression that learns, and a policy that switches in corners.
"""

import keyword
import re
from importlib import resources
from pathlib import Path
from string import Template
from typing import Literal

import estimators
from road_envs import policies
from road_envs.core.atomic_io import write_text
from road_envs.core.config import ConfigError

Example = Literal["estimator", "learner", "policy"]

_INIT = '"""${article} ${kind} for RoadRecon: `${name}`."""\n'


def write_package(name: str, folder: Path, example: Example = "estimator") -> list[Path]:
    """Write a package with the estimator or policy `name` into a new or empty `folder`.

    Returns its files. Raises ConfigError, before anything is written, for an invalid name or a
    folder with files.
    """
    kind, article = ("policy", "A") if example == "policy" else ("estimator", "An")
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        raise ConfigError(
            f"{name!r} cannot be the name of {article.lower()} {kind}: use lower-case letters, "
            "digits and '_', and begin with a letter"
        )
    if name in (policies.available() if kind == "policy" else estimators.available()):
        raise ConfigError(f"the name {name!r} is taken by an installed {kind}; choose another")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder} is not empty; choose a new or empty folder")
    module = f"road_recon_{name}"
    fields = {
        "name": name,
        "kind": kind,
        "article": article,
        "group": "policies" if kind == "policy" else "estimators",
        "module": module,
        "distribution": module.replace("_", "-"),
        "cls": "".join(part.capitalize() for part in name.split("_")),
    }
    files = {
        "pyproject.toml": _template("pyproject"),
        "README.md": _template(f"{kind}_readme"),
        f"{module}/__init__.py": _INIT,
        f"{module}/{kind}.py": _template(example),
        f"tests/test_{kind}.py": _template(f"{example}_test"),
    }
    for path, text in files.items():
        write_text(folder / path, Template(text).substitute(fields))
    return [folder / path for path in files]


def _template(name: str) -> str:
    file = resources.files("leaderboard") / "templates" / f"{name}.txt"
    return file.read_text(encoding="utf-8")
