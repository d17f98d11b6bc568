"""Picture of the tutorial's first drive, by the tutorial's own code.

    python -m studies.first_drive_picture FILE.png

The blocks of Python of `docs/tutorials/first_drive.md` are run one after the other, up to the one
that saves `estimate.png`.
"""

import argparse
import re
from pathlib import Path

from road_envs.core.code_digest import ROOT

PAGE = ROOT / "docs" / "tutorials" / "first_drive.md"
SAVED = '"estimate.png"'


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("picture", type=Path)
    picture = parser.parse_args().picture
    names: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S):
        exec(block.replace(SAVED, repr(str(picture))), names)
        if SAVED in block:
            return
    raise SystemExit(f"{PAGE.name} saves no {SAVED}")


if __name__ == "__main__":
    main()
