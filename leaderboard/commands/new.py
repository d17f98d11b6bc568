"""Commands that write something to begin with: `new-estimator`, `new-policy`, `new-vehicle`.

The examples in `leaderboard/templates` work and are meant to be replaced.
"""

import keyword
import re
from importlib import resources
from pathlib import Path
from string import Template
from typing import Annotated, Literal

import estimators
from leaderboard.commands import YAML, check_output_path
from leaderboard.commands.options import argument, option
from leaderboard.commands.output import Output
from road_envs import policies
from road_envs.core.atomic_io import write_text
from road_envs.core.config import ConfigError
from road_envs.vehicle.generic_cars import CLASSES, fitted_vehicle
from road_envs.vehicle.parameters import write_vehicle

_Example = Literal["estimator", "learner", "policy"]
_Name = Annotated[str, argument("Name to register it under: lower-case letters, digits and _.")]
_Folder = Annotated[Path | None, option("New or empty folder; by default road-recon-NAME here.")]


def new_estimator(
    name: _Name,
    out: _Folder = None,
    learns: Annotated[
        bool, option("An estimator that is fitted to training drives.", "--learns")
    ] = False,
) -> Output:
    """Write a small working package with a new estimator."""
    return _write(name, out, "learner" if learns else "estimator", f"check-estimator {name}")


def new_policy(name: _Name, out: _Folder = None) -> Output:
    """Write a small working package with a new switching policy."""
    return _write(name, out, "policy", f"check-policy {name}")


def _write(name: str, out: Path | None, example: _Example, check: str) -> Output:
    folder = out or Path(f"road-recon-{name.replace('_', '-')}")
    written = [str(path) for path in _write_package(name, folder, example)]
    target = folder if folder.is_absolute() else f"./{folder}"
    install, test = f'pip install --editable "{target}[test]"', f"python -m pytest {target}"
    following = [install, test, f"road-recon {check}"]
    shows = [*written, "next: " + "\n      ".join(following)]
    return Output(facts={"written": written, "next": following}, shows=shows)


def new_vehicle(
    out: Annotated[Path, argument("File to write, such as my_car.yaml.")],
    car_class: Annotated[str, option(f"One of {', '.join(CLASSES)}.", "--class", prompt="class")],
    mass: Annotated[float, option("Mass ready to drive [kg].", prompt="mass [kg]")],
    wheelbase: Annotated[float, option("Between the axles [m].", prompt="wheelbase [m]")],
    track: Annotated[float, option("Between a left and right tyre [m].", prompt="track [m]")],
) -> Output:
    """Write a vehicle file of a class with its mass, wheelbase, track and tolerances.

    What is not given is asked for. The registration papers have mass and wheelbase; the track is
    in any data sheet.
    """
    check_output_path(out, *YAML)
    if out.exists():
        raise ConfigError(f"{out} exists: choose another file, or remove it")
    car = fitted_vehicle(out.stem, car_class, mass, wheelbase, track)
    head = f"A {car_class} of {mass:g} kg, {wheelbase:g} m wheelbase, {track:g} m track. SI units."
    write_vehicle(out, car, head)
    following = f"road-recon identify DRIVE DRIVE --vehicle {out} narrows its tolerances"
    facts = {"written": str(out), "next": following}
    return Output(facts=facts, shows=[str(out), f"next: {following}"])


def _write_package(name: str, folder: Path, example: _Example = "estimator") -> list[Path]:
    """Write a package with the estimator or policy `name` into a new or empty `folder`; return its
    files. Raises ConfigError, before anything is written, for an invalid name or a folder with
    files.
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
        f"{module}/__init__.py": '"""${article} ${kind} for RoadRecon: `${name}`."""\n',
        f"{module}/{kind}.py": _template(example),
        f"tests/test_{kind}.py": _template(f"{example}_test"),
    }
    for path, text in files.items():
        write_text(folder / path, Template(text).substitute(fields))
    return [folder / path for path in files]


def _template(name: str) -> str:
    file = resources.files("leaderboard") / "templates" / f"{name}.txt"
    return file.read_text(encoding="utf-8")
