"""How a command speaks: one JSON object or one table on standard output, progress on standard error."""

from __future__ import annotations

import json
import sys
import time
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Any

from rich import box, progress
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from porrima.files import json_ready

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

__all__ = ["Progress", "show", "step"]

_QUIET = 10.0  # s between two lines where there is no terminal, at least
_STEP = 0.01  # share of the whole between them, at least


class Progress:
    """A bar on standard error with the rate and the time left; where that is no terminal, a line now and then.

    Parameters
    ----------
    total : int
        How many there are in all (count).
    unit : str
        Of what.
    rate : (str, int), optional
        Unit of the rate and how many there are in one of `unit`, such as 40 stars in a stack.
    """

    def __init__(self, total: int, unit: str, rate: tuple[str, int] | None = None) -> None:
        self._total, self._unit, self._rate = total, unit, rate or (unit, 1)
        self._done = self._before = self._told = 0
        self._start = self._told_at = 0.0
        self._bar = progress.Progress(
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TextColumn("{task.description}"),
            console=Console(stderr=True),
        )
        self._task = self._bar.add_task(unit, total=total)

    def advance(self, n: int) -> None:
        """Count n more as done; the first are those that were there before, and the clock starts with them."""
        now = time.monotonic()
        self._done += n
        if not self._start:
            self._before, self._start, self._told_at = n, now, now
        if sys.stderr.isatty():
            self._bar.start()
            self._bar.update(self._task, completed=self._done, description=self._words(now))
        elif self._due(now):
            self._told, self._told_at = self._done, now
            print(f"{self._done} of {self._total} {self._words(now)}", file=sys.stderr, flush=True)

    def _due(self, now: float) -> bool:
        """Whether it is time for a line; what began to tell also tells its end."""
        if self._done >= self._total:
            return self._told > 0
        return now - self._told_at >= _QUIET and self._done - self._told >= _STEP * self._total

    def _words(self, now: float) -> str:
        new, elapsed = self._done - self._before, now - self._start
        if new <= 0 or elapsed <= 0:
            return self._unit
        left = (self._total - self._done) * elapsed / new
        unit, each = self._rate
        return f"{self._unit}, {_short(new * each / elapsed)} {unit}/s, {timedelta(seconds=round(left))} left"

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar.live.is_started:
            self._bar.stop()


@contextmanager
def step(name: str, size: int, unit: str, there: bool) -> Iterator[Callable[[int], None]]:
    """Tell of one of several steps: its name, how far it is, and that it is done.

    Parameters
    ----------
    name : str
        Of the step.
    size : int
        How much there is to do (count).
    unit : str
        Of what.
    there : bool
        Whether it was done before.

    Yields
    ------
    advance : callable
        Given how much more is done (count).

    Returns
    -------
    None
        A context manager.
    """
    print(f"{name}: {'as it was' if there else f'{size} {unit}'}", file=sys.stderr, flush=True)
    start = time.monotonic()
    with Progress(size, unit) as progress:
        yield progress.advance
    if not there:
        print(f"{name}: done in {time.monotonic() - start:.1f} s", file=sys.stderr, flush=True)


def _short(value: float) -> str:
    """A rate with three figures: 81.2 million, 3.4."""
    for size, name in ((1e9, " thousand million"), (1e6, " million"), (1e3, " thousand")):
        if value >= size:
            return f"{value / size:.3g}{name}"
    return f"{value:.3g}"


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
        print(json.dumps(json_ready(result), allow_nan=False))
        return
    grid = Table(
        *(Column(Text(column)) for column in columns), box=box.SIMPLE_HEAD
    )  # a unit in brackets is no markup
    for row in table:
        grid.add_row(*(Text(f"{value:.6g}" if isinstance(value, float) else str(value)) for value in row))
    console = Console(width=None if sys.stdout.isatty() else 200)
    console.print(header, markup=False, highlight=False)
    console.print(grid)
