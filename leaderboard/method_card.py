"""Card of a method, written by its authors: what it is, what it was made from, who may use it."""

from dataclasses import dataclass
from pathlib import Path
from unicodedata import category

from road_envs.core.config import ConfigError, Settings, build, read_yaml

_UNWRITTEN = "..."  # text of the template where the authors have to write
TEMPLATE = f"""\
# Every text must be replaced; authors is a list of names.
method: {_UNWRITTEN}      # what the estimator does, in a sentence or more
data: {_UNWRITTEN}        # what it was trained and tuned on; none, if on nothing
licence: {_UNWRITTEN}     # of code and weights, such as MIT
authors: [{_UNWRITTEN}]
citation: {_UNWRITTEN}    # how to cite it, as plain text; none, if nothing yet
"""


@dataclass(frozen=True, kw_only=True)
class MethodCard(Settings):
    """Statements of the authors of an entry; shown beside its results, never tested."""

    method: str
    data: str
    licence: str
    authors: tuple[str, ...]
    citation: str

    def __post_init__(self):
        super().__post_init__()
        texts = [*vars(self).items(), *(("authors", author) for author in (self.authors or [""]))]
        for name, text in (x for x in texts if isinstance(x[1], str)):
            if text.strip() in ("", _UNWRITTEN):
                raise ValueError(f"{name} is not filled in")
            # a terminal or a page would obey others; two join letters in Persian and Hindi
            blanks = "\n\t\u200c\u200d"
            if not all(x.isprintable() or x in blanks or category(x) == "Zs" for x in text):
                raise ValueError(f"{name} has characters that cannot be printed")


def load_method_card(path: Path) -> MethodCard:
    """Read a card. Raises ConfigError for a missing file and for a text that is not filled in."""
    if not path.is_file():
        raise ConfigError(f"{path}: there is no card of the method")
    return build(MethodCard, read_yaml(path), str(path))


def method_card_path(out: Path, name: str) -> Path:
    """File of the card of the entry `name` in a folder of results."""
    return out / "methods" / f"{name}.yaml"


def find_method_card(out: Path, name: str) -> MethodCard | None:
    """Card of an entry in a folder of results; None if it has none."""
    path = method_card_path(out, name)
    return load_method_card(path) if path.is_file() else None
