"""Tables of a result as Markdown, and documents that quote them."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["markdown_table", "with_text_between"]


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as Markdown.

    Parameters
    ----------
    heads : sequence of str
        One for each column.
    rows : sequence of sequence of str
        Cells under them.

    Returns
    -------
    table : str
        Lines without an end of the last.
    """
    return "\n".join(f"| {' | '.join(row)} |" for row in [heads, ["---"] * len(heads), *rows])


def with_text_between(document: str, begin: str, end: str, text: str) -> str:
    """A document with another text between two markers.

    Parameters
    ----------
    document : str
        Markdown; without both markers, in this order, it stays as it is.
    begin, end : str
        The markers, each on a line of its own.
    text : str
        What stands between them.

    Returns
    -------
    document : str
        The rest of it unchanged.
    """
    between = f"{begin}\n\n{text}\n\n{end}"
    return re.sub(
        f"{re.escape(begin)}.*?{re.escape(end)}", lambda _: between, document, count=1, flags=re.DOTALL
    )
