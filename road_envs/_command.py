"""Entry point of the command `road-recon`.

It stands in `road_envs`, the one of our package names that a user's own folder is unlikely to have,
so that a clash of the other two can be reported instead of failing inside an import.
"""

import importlib
import importlib.util
import sys
from pathlib import Path

from road_envs.core.extras import missing_extra

SIBLINGS = ("estimators", "leaderboard")


def _foreign_package() -> str | None:
    """Return one sentence on a folder that hides one of our packages; None if none does."""
    root = Path(__file__).parents[1]
    for name in SIBLINGS:
        spec = importlib.util.find_spec(name)
        found = (spec.submodule_search_locations or [spec.origin or ""]) if spec else []
        places = [Path(place) for place in found]
        if places and root / name not in places:
            return (
                f"{places[0]} hides the package {name!r} of road-envs: "
                "rename it, or take its folder off PYTHONPATH"
            )
    return None


def main() -> None:
    """Run the command line; exit with status 2 and one sentence if it cannot start."""
    problem = _foreign_package()
    if problem is None:
        try:
            run = importlib.import_module("leaderboard.cli").main
        except ModuleNotFoundError as error:
            problem = missing_extra(error, "the command line")
        else:
            run()
            return
    sys.stderr.write(f"error: {problem}\n")
    raise SystemExit(2)


if __name__ == "__main__":
    main()
