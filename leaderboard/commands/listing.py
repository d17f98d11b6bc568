"""Command `list`: the names that options take, each with a line on what it is."""

from typing import Annotated

from leaderboard.commands import make_table
from leaderboard.commands.options import argument
from leaderboard.commands.output import Output
from leaderboard.listing import KINDS, names_of


def list_names(
    kind: Annotated[str, argument(f"{', '.join([*KINDS][:-1])} or {[*KINDS][-1]}.")],
) -> Output:
    """List the names that an option takes, each with what it stands for.

    Estimators and policies of other installed packages are among them.
    """
    lines = names_of(kind)
    heads = (kind, "what it is")
    return Output(facts=lines, shows=[make_table(heads, lines.items(), texts=heads[1:], box=None)])
