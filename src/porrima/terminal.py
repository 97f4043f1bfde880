"""How a command speaks: one JSON object or one table on standard output, progress on standard error."""

from __future__ import annotations

import json
import math
import sys
from typing import Any

from rich import box, progress
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

__all__ = ["Progress", "show"]


class Progress:
    """A bar on standard error, with the rate and the time left."""

    def __init__(self, total: int, unit: str) -> None:
        self._bar = progress.Progress(
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TextColumn(unit),
            progress.TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._task = self._bar.add_task(unit, total=total)

    def advance(self, n: int) -> None:
        """Count n more as done; the bar is there from the first call on, so that an error comes before it."""
        self._bar.start()
        self._bar.update(self._task, advance=n)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar.live.is_started:
            self._bar.stop()


def show(
    result: dict[str, Any], as_json: bool, header: str, columns: list[str], table: list[list[Any]]
) -> None:
    """Print a result: one JSON object, or a header and a table.

    Parameters
    ----------
    result : dict
        Keys and values of the contract.
    as_json : bool
        Whether it is for a program.
    header : str
        What the table is of.
    columns : list of str
        Its heads.
    table : list of list
        Its lines.

    Returns
    -------
    None
        It goes to standard output.
    """
    if as_json:
        print(json.dumps(_plain(result), allow_nan=False))
        return
    grid = Table(
        *(Column(Text(column)) for column in columns), box=box.SIMPLE_HEAD
    )  # a unit in brackets is no markup
    for row in table:
        grid.add_row(*(Text(f"{value:.6g}" if isinstance(value, float) else str(value)) for value in row))
    console = Console(width=None if sys.stdout.isatty() else 200)
    console.print(header, markup=False, highlight=False)
    console.print(grid)


def _plain(value: Any) -> Any:
    """A result as JSON has it: no numpy types, null for what is not a finite number."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value
