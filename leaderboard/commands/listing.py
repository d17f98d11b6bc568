"""Command `list`: the names that options take, each with a line on what it is."""

from typing import Annotated

import typer

from leaderboard.commands import make_table
from leaderboard.commands.output import Output
from leaderboard.listing import KINDS, names_of


def list_names(
    kind: Annotated[str, typer.Argument(help=f"{', '.join([*KINDS][:-1])} or {[*KINDS][-1]}.")],
) -> Output:
    """List the names that an option takes, each with what it stands for.

    Estimators and policies of other installed packages are among them.
    """
    lines = names_of(kind)
    heads = (kind, "what it is")
    return Output(facts=lines, shows=[make_table(heads, lines.items(), texts=heads[1:], box=None)])
