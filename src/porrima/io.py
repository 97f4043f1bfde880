"""Tables of pairs in, tables of numbers and figures out."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.errors import InputError
from porrima.files import write_table, write_whole
from porrima.galaxies import Galaxies, r2_of_half_light
from porrima.rows import refuse_unless
from porrima.systems import Systems
from porrima.tables import load_table, named_columns, open_catalog

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure

__all__ = ["read_galaxies", "read_systems", "write_figure", "write_rows", "write_rows_and_figure"]

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
    values = named_columns(path, table, row, _PAIR_COLUMNS, {"weight": ""})
    f, w = values["flux_ratio"], values.setdefault("weight", np.ones(len(table)))
    rules = [
        ("flux_ratio", "must be in [0, 1]", (f >= 0) & (f <= 1)),
        ("dx", "must be within 10 arcsec", np.abs(values["dx"]) <= _WIDEST),
        ("dy", "must be within 10 arcsec", np.abs(values["dy"]) <= _WIDEST),
        ("weight", "must be finite and not negative", np.isfinite(w) & (w >= 0)),
    ]
    refuse_unless(path, row, values, rules)
    if not w.sum() > 0:
        raise InputError("must have a positive sum", source=path, column="weight", value=w.sum())
    return Systems.from_pairs(f, values["dx"], values["dy"], w)


def read_galaxies(path: Path, index: float, mean_e2: float, smallest: float = 0.0) -> Galaxies:
    """Galaxies of given half-light radii from a table.

    Parameters
    ----------
    path : Path
        Any table that astropy reads, with a column ``half_light_radius`` [arcsec] and, optionally, ``weight``.
    index : float
        Sersic index of all, dimensionless.
    mean_e2 : float
        Mean square of their ellipticity before lensing, in [0, 1).
    smallest : float
        Half-light radius below which they are left out, in arcsec.

    Returns
    -------
    galaxies : Galaxies
        With weights that sum to 1.

    Raises
    ------
    InputError
        If the column is missing, there are no galaxies, or a value breaks its rule: names the row.
    """
    table, row = load_table(open_catalog(path, {}, None))
    values = named_columns(path, table, row, {"half_light_radius": "arcsec"}, {"weight": ""})
    radius, weight = values["half_light_radius"], values.setdefault("weight", np.ones(len(table)))
    rules = [
        ("half_light_radius", "must be positive and finite [arcsec]", np.isfinite(radius) & (radius > 0)),
        ("weight", "must be finite and not negative", np.isfinite(weight) & (weight >= 0)),
    ]
    refuse_unless(path, row, values, rules)
    galaxies = Galaxies.sersic(radius, index, weight, mean_e2=mean_e2)
    return galaxies.larger_than(smallest**2 * r2_of_half_light(index)) if smallest > 0 else galaxies


def write_rows(rows: Sequence[dict[str, Any]], path: Path, made_with: dict[str, Any] | None = None) -> None:
    """Rows of equal keys as a table (ECSV).

    Parameters
    ----------
    rows : sequence of dict
        As `summary.rows` gives them.
    path : Path
        The file, replaced if it exists.
    made_with : dict, optional
        Models, options and versions, for the head of the file.

    Returns
    -------
    None
        The result is the file.
    """
    from astropy.table import Table  # noqa: PLC0415  (slow to import)

    table = Table(rows=list(rows), meta=made_with)
    write_table(table, path)


FORMATS = (".png", ".pdf", ".svg")
"""Suffixes of figures."""

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
    if path.suffix not in FORMATS:
        raise InputError("must end in .png, .pdf or .svg", key="plot", value=path)
    write_whole(path, lambda part: figure.savefig(part, dpi=160, metadata=_NO_DATE.get(path.suffix, {})))


def write_rows_and_figure(
    rows: Sequence[dict[str, Any]],
    table: Path | None,
    draw: Callable[[], Figure],
    picture: Path | None,
    made_with: dict[str, Any] | None = None,
) -> None:
    """Rows as a table (ECSV) and what is drawn of them as a figure; neither where one of the files cannot be.

    Parameters
    ----------
    rows : sequence of dict
        As `write_rows` takes them; where one has None there is NaN in the file.
    table, picture : Path or None
        Files to write; none where not given.
    draw : callable
        Gives the figure, where there is one to write.
    made_with : dict, optional
        Models, options and versions, for the head of the table.

    Returns
    -------
    None
        The result is the files.

    Raises
    ------
    InputError
        If one cannot be written.
    """
    if picture is not None and picture.suffix not in FORMATS:
        raise InputError(f"must end in {', '.join(FORMATS)}", key="plot", value=picture)
    for path in (table, picture):
        if path is not None and not path.parent.is_dir():
            raise InputError("cannot be written (No such folder)", key="output", value=path)
    if table is not None:
        known = [{key: math.nan if value is None else value for key, value in row.items()} for row in rows]
        write_rows(known, table, made_with)
    if picture is not None:
        write_figure(draw(), picture)
