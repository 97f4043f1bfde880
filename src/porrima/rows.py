"""Rows of a catalogue as a reader finds them, and the checks that every reader makes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]
    BoolArray = NDArray[np.bool_]

__all__ = [
    "SKY_AREA",
    "CatalogRows",
    "NoOptions",
    "numbers",
    "parsed_options",
    "refuse",
    "refuse_unless",
    "table_area",
]

SKY_AREA = 41253.0
"""Solid angle of the whole sky, in deg² (4π sr, rounded up)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CatalogRows:
    """What a reader found in each of the n rows of a file, unchecked.

    Parameters
    ----------
    row : (n,) int array
        Line of a text file, or row of another table, counted from 1.
    names : mapping of str to str
        The file's own column name of each quantity in `values`.
    values : mapping of str to (n,) float array
        ``mass`` [M_sun], ``distance`` [pc], ``magnitude`` [mag], ``metallicity`` [dex], ``log_age``
        [log10 yr] and, where there are such, ``luminosity_class`` and ``mass_ratio`` [in [0, 1]]; NaN where the
        file gives nothing.
    component : (n,) str array
        One of `porrima.stars.COMPONENTS`.
    band : str
        Band of the magnitude.
    area : float, optional
        Solid angle of the catalogue, in deg².
    source : str
        What the catalogue says of itself.
    pointing : (float, float), optional
        Galactic longitude and latitude, in deg.
    assumed : mapping of str to (n,) bool array
        Reason, and the rows for which something was taken that the file does not say.
    rejected : mapping of str to (n,) bool array
        Reason, and the rows that its reader leaves out; their values are not looked at.
    """

    row: IntArray
    names: Mapping[str, str]
    values: Mapping[str, FloatArray]
    component: NDArray[np.str_]
    band: str
    area: float | None = None
    source: str = ""
    pointing: tuple[float, float] | None = None
    assumed: Mapping[str, BoolArray] = field(default_factory=dict)
    rejected: Mapping[str, BoolArray] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class NoOptions:
    """Options of a reader that has none."""


def refuse(path: Path, row: IntArray, column: str, values: FloatArray, bad: BoolArray, rule: str) -> None:
    """Nothing, where no row breaks a rule.

    Parameters
    ----------
    path : Path
        The file, for the message.
    row : (n,) int array
        Number of each row, dimensionless.
    column : str
        The file's own name of the column.
    values : (n,) float array
        The column, in the unit that the message shows.
    bad : (n,) bool array
        Rows that break the rule, dimensionless.
    rule : str
        The rule.

    Returns
    -------
    None
        The check has no result.

    Raises
    ------
    InputError
        Names the first row that breaks the rule.
    """
    if np.any(bad):
        k = int(np.argmax(bad))
        value = "nothing" if np.isnan(values[k]) else f"{values[k]:.10g}"
        raise InputError(rule, source=path, row=int(row[k]), column=column, value=value)


def refuse_unless(
    path: Path,
    row: IntArray,
    values: Mapping[str, FloatArray],
    rules: Iterable[tuple[str, str, BoolArray]],
) -> None:
    """Nothing, where the columns of a user's table keep all rules.

    Parameters
    ----------
    path : Path
        The file, for the message.
    row : (n,) int array
        Number of each row, dimensionless.
    values : mapping of str to (n,) float array
        Columns by name, in the units that the message shows.
    rules : iterable of (str, str, (n,) bool array)
        Name of a column, the rule, and the rows that keep it.

    Returns
    -------
    None
        The check has no result.

    Raises
    ------
    InputError
        Names the first row that breaks the first rule that is broken.
    """
    for name, rule, good in rules:
        if not np.all(good):
            k = int(np.argmin(good))
            value = f"{values[name][k]:.10g}"
            raise InputError(rule, source=path, row=int(row[k]), column=name, value=value)


def numbers(path: Path, column: str, texts: list[str], row: IntArray) -> FloatArray:
    """Numbers of a column from their texts.

    Parameters
    ----------
    path : Path
        The file, for the message.
    column : str
        Name of the column.
    texts : list of str
        One for each row.
    row : (n,) int array
        Number of each row, dimensionless.

    Returns
    -------
    numbers : (n,) float array
        In the file's unit.

    Raises
    ------
    InputError
        If a text is no number; names the first.
    """
    try:
        return np.array(texts, dtype=float)
    except ValueError:
        for k, text in enumerate(texts):
            try:
                float(text)
            except ValueError:
                place: dict[str, Any] = {"source": path, "row": int(row[k]), "column": column}
                raise InputError("must be a number", **place, value=repr(text[:40])) from None
        raise InputError("must hold numbers", source=path, column=column) from None


def parsed_options(options: Mapping[str, Any], kind: type[Any]) -> Any:
    """Options of a reader from the names and values that a user gives.

    Parameters
    ----------
    options : mapping of str to object
        Names and values; a value may be the text of a number.
    kind : type
        Frozen dataclass of the options, each with a default.

    Returns
    -------
    options : kind
        The defaults, replaced where an option is given.

    Raises
    ------
    InputError
        If there is no such option, or a value is not what it must be.
    """
    known = {entry.name: entry.default for entry in fields(kind)}
    values = {}
    for name, value in options.items():
        if name not in known:
            rule = f"must be one of {', '.join(known) or 'none, for this format'}"
            raise InputError(rule, key="options", value=name)
        if isinstance(known[name], str):
            values[name] = value
            continue
        try:
            values[name] = float(value)
        except (TypeError, ValueError):
            raise InputError("must be a number", key=f"options, {name}", value=repr(value)[:40]) from None
        if math.isnan(values[name]):
            raise InputError("must be a number", key=f"options, {name}", value="nan")
    return kind(**values)


def table_area(path: Path, meta: Mapping[Any, Any]) -> float | None:
    """Solid angle that a table states in its metadata.

    Parameters
    ----------
    path : Path
        The file, for the message.
    meta : mapping
        Metadata, where ``area_deg2`` is looked for in any case of letters.

    Returns
    -------
    area : float or None
        In deg²; None where not stated.

    Raises
    ------
    InputError
        If it is no positive number or exceeds the sky.
    """
    area = {str(key).lower(): value for key, value in meta.items()}.get("area_deg2")
    if area is None:
        return None
    if not (isinstance(area, (int, float)) and 0 < area <= SKY_AREA):
        rule = "must be positive and no more than the sky"
        raise InputError(rule, source=path, key="area_deg2", value=repr(area))
    return float(area)
