"""Tables of pairs in, tables of numbers out; a file is written whole or not at all."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.errors import InputError
from porrima.systems import Systems
from porrima.tables import column_values, load_table, open_catalog

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure

__all__ = ["make_folder", "read_systems", "write_figure", "write_rows", "write_whole"]

_PAIR_COLUMNS = {"flux_ratio": "", "dx": "arcsec", "dy": "arcsec"}
_WIDEST = 10.0  # arcsec; what is wider is no unresolved pair for any survey


def read_systems(path: Path) -> Systems:
    """Systems of two sources from a table.

    Parameters
    ----------
    path : Path
        Any table that astropy reads, with columns ``flux_ratio`` (0 for a single star), ``dx``, ``dy``
        [arcsec, companion from primary] and, optionally, ``weight``.

    Returns
    -------
    systems : Systems
        One per row.

    Raises
    ------
    InputError
        If a column is missing or a value breaks its rule: names the row.
    """
    table, row = load_table(open_catalog(path, {}, None))
    values = {}
    for name, unit in (_PAIR_COLUMNS | {"weight": ""}).items():
        if name in table.colnames:
            values[name] = column_values(path, table[name], name, unit, row)
        elif name != "weight":
            raise InputError(
                f"is missing; the table has {', '.join(table.colnames)}", source=path, column=name
            )
    values.setdefault("weight", np.ones(len(table)))
    if not len(table):
        raise InputError("must have rows below its header", source=path)
    f, w = values["flux_ratio"], values["weight"]
    good = {
        "flux_ratio": ("must be in [0, 1]", (f >= 0) & (f <= 1)),
        "dx": ("must be within 10 arcsec", np.abs(values["dx"]) <= _WIDEST),
        "dy": ("must be within 10 arcsec", np.abs(values["dy"]) <= _WIDEST),
        "weight": ("must be finite and not negative", np.isfinite(w) & (w >= 0)),
    }
    for name, (rule, fine) in good.items():
        if not np.all(fine):
            k = int(np.argmin(fine))
            raise InputError(rule, source=path, row=int(row[k]), column=name, value=values[name][k])
    if not w.sum() > 0:
        raise InputError("must have a positive sum", source=path, column="weight", value=w.sum())
    return Systems.from_pairs(f, values["dx"], values["dy"], w)


def make_folder(path: Path) -> None:
    """A folder that can be written, made where it is not there.

    Parameters
    ----------
    path : Path
        The folder.

    Returns
    -------
    None
        The result is the folder.

    Raises
    ------
    InputError
        If it cannot be made or written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", key="output", value=path) from None
    if not os.access(path, os.W_OK):
        raise InputError("must be a folder that can be written", key="output", value=path)


def write_whole(path: Path, write: Callable[[Path], Any]) -> None:
    """A file written under a temporary name beside its place, then renamed.

    Parameters
    ----------
    path : Path
        The file, replaced if it exists.
    write : callable
        Writes to the path that it is given; its suffix is that of `path`.

    Returns
    -------
    None
        The result is the file.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    unfinished = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        write(unfinished)
        unfinished.replace(path)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", key="output", value=path) from None
    finally:
        unfinished.unlink(missing_ok=True)


def write_rows(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Rows of equal keys as a table (ECSV).

    Parameters
    ----------
    rows : sequence of dict
        As `summary.rows` gives them.
    path : Path
        The file, replaced if it exists.

    Returns
    -------
    None
        The result is the file.
    """
    from astropy.table import Table  # noqa: PLC0415  (slow to import)

    table = Table(rows=list(rows))
    write_whole(path, lambda unfinished: table.write(unfinished, format="ascii.ecsv"))


_NO_DATE: dict[str, dict[str, Any]] = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}


def write_figure(figure: Figure, path: Path) -> None:
    """A figure as PNG, PDF or SVG, the same bytes for the same numbers.

    Parameters
    ----------
    figure : Figure
        From `figures`.
    path : Path
        The file, replaced if it exists; its suffix is the format.

    Returns
    -------
    None
        The result is the file.

    Raises
    ------
    InputError
        If the suffix is of no such format.
    """
    if path.suffix not in (".png", ".pdf", ".svg"):
        raise InputError("must end in .png, .pdf or .svg", key="plot", value=path)
    write_whole(path, lambda part: figure.savefig(part, dpi=160, metadata=_NO_DATE.get(path.suffix, {})))
