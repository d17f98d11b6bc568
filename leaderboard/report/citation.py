"""Citations in BibTeX: of this project, of the paper that it follows, and of a row of a board."""

from collections.abc import Sequence
from pathlib import Path
from string import Template

from leaderboard.evaluation.provenance import package_version
from leaderboard.evaluation.results import Result
from leaderboard.evaluation.store import load
from leaderboard.method_card import find_method_card
from road_envs.core.config import ConfigError, validate_choice

_TEMPLATES = Path(__file__).parents[1] / "templates"
_SPECIAL = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_"}
    | {"{": "(", "}": ")", "\\": ""}  # BibTeX counts \{, too
    | {"^": r"\textasciicircum{}", "~": r"\textasciitilde{}"}  # TeX reads ^^5c as \
)


def as_bibtex(note: str = "") -> str:
    """Entries of this project, with a `note` on what is cited of it, and of the paper."""
    line = f"\n  note = {{{_escape(note)}}}," if note else ""
    return _fill("project.bib", version=package_version(), note=line)


def cite_entry(out: Path, name: str) -> str:
    """BibTeX of an entry whose rows are under `out`: what ran, on what, and what its card says.
    Raises ConfigError if there is no row of this name.
    """
    paths = sorted((out / "results").glob("*/*.json"))
    if not paths:
        raise ConfigError(
            f"{out}: no results; `road-recon leaderboard --out {out}` makes them, and in a results "
            "repository `road-recon results-site .`"
        )
    validate_choice("entry", name, sorted({path.stem for path in paths}))
    rows = [load(path) for path in paths if path.stem == name]
    card = find_method_card(out, name)
    authors, note = "", _what_ran(rows)
    if card is not None:
        authors = f"\n  author = {{{_escape(' and '.join(card.authors))}}},"
        note += f"; {card.citation}" if card.citation != "none" else ""
    return _fill("entry.bib", name=name, authors=authors, note=_escape(note))


def _escape(text: str) -> str:
    """Return a text as TeX prints it, in one line."""
    return " ".join(text.split()).translate(_SPECIAL)


def _fill(template: str, **values: str) -> str:
    return Template((_TEMPLATES / template).read_text(encoding="utf-8")).substitute(values)


def _what_ran(rows: Sequence[Result]) -> str:
    """Version and digests of the rows, by which anybody can tell whether they cite the same."""
    tasks: dict[str, list[str]] = {}
    for row in rows:
        code = f"code {row.code}, " if row.code else ""
        program = f"{code}settings {row.settings or 'by default'}, road-envs {row.package_version}"
        tasks.setdefault(program, []).append(f"{row.task} {row.task_digest[:12]}")
    return "; ".join(f"{program}, {', '.join(names)}" for program, names in tasks.items())
