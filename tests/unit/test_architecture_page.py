"""The architecture page names existing paths, every package, and the layers of the contracts."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
PACKAGES = ("road_envs", "estimators", "leaderboard", "studies")


def named_paths() -> set[str]:
    """Words in backticks that have a slash or the suffix of a file."""
    words = re.findall(r"`([\w./-]+)`", PAGE)
    return {word for word in words if "/" in word or re.search(r"\.(py|toml|yaml)$", word)}


def test_every_path_on_the_page_exists():
    paths = named_paths()
    assert len(paths) > 50
    assert [path for path in sorted(paths) if not (ROOT / path).exists()] == []


def test_every_package_is_on_the_page():
    folders = {
        path.parent.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("__init__.py")
    }
    words = set(re.findall(r"`([\w./-]+)`", PAGE))
    assert sorted(folders - words) == []


def test_the_rooms_in_the_picture_are_those_of_the_contracts():
    """A line of rooms for each layer, in order, below the name of the package."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    picture = PAGE.split("```")[1]
    for package in ("road_envs", "estimators", "leaderboard"):
        (layers,) = (
            contract["layers"]
            for contract in contracts["contracts"]
            if contract["name"].startswith(f"rooms of {package}")
        )
        drawn = picture.partition(f" {package} ")[2].partition("──")[0]
        lines = [line.strip() for line in drawn.splitlines() if line.strip()]
        assert lines == [layer.replace(f"{package}.", "") for layer in layers]
        assert len(layers) <= 12
