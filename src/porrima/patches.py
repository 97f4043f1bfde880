"""Measured PSFs of patches of a field, or of samples of stars that see one PSF, from a table or from options."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from porrima.correction import Patch
from porrima.errors import InputError
from porrima.rows import refuse_unless
from porrima.tables import load_table, named_columns, open_catalog

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    BoolArray = NDArray[np.bool_]

__all__ = ["COLUMNS", "MOST_PATCHES", "PatchTable", "one_patch", "read_patches"]

COLUMNS = {
    "e1": "", "e2": "", "r2": "arcsec2", "n_stars": "", "mag_lo": "mag", "mag_hi": "mag", "l": "deg", "b": "deg",
    "x": "", "y": "", "e1_error": "", "e2_error": "", "r2_error": "arcsec2", "binary_fraction": "",
    "binary_fraction_error": "", "eta": "", "sd": "",
}  # fmt: skip
"""Columns of a table of patches, with their units; beside them ``patch``, a name."""

MOST_PATCHES = 20_000
"""Rows that a table may have (count)."""

_TOGETHER = (("mag_lo", "mag_hi"), ("l", "b"), ("eta", "sd"), ("e1", "e2"))
_NEEDS = {
    "e1_error": "e1",
    "e2_error": "e2",
    "r2_error": "r2",
    "binary_fraction_error": "binary_fraction",
}
_ALIKE = 0.85  # of a column's name to one that is known, from which it is taken for a slip


@dataclass(frozen=True, slots=True, kw_only=True)
class PatchTable:
    """Measured PSFs, one in each of n rows.

    Parameters
    ----------
    source : Path or None
        The file; None for options of the command.
    row : (n,) int array
        Line or row of the file, for messages (count).
    name : tuple of str
        Name of each patch; samples of one PSF share it.
    named : bool
        Whether the table has names, or the numbers of its rows are taken.
    values : dict
        (n,) float arrays, those of `COLUMNS` that are given, in their units.
    """

    source: Path | None
    row: NDArray[np.int64]
    name: tuple[str, ...]
    named: bool
    values: dict[str, FloatArray]

    def __len__(self) -> int:
        return len(self.name)

    def patch(self, k: int) -> Patch:
        """Measured PSF of one row.

        Parameters
        ----------
        k : int
            From 0 on.

        Returns
        -------
        patch : Patch
            Ellipticity dimensionless, 0 where only the size is given; size in arcsec².
        """
        shape, error = (
            np.array([self.values[name + end][k] if name + end in self.values else 0.0 for name in _SHAPE])
            for end in ("", "_error")
        )
        return Patch(shape=shape, n_stars=int(self.values["n_stars"][k]), error=error)

    def at(self, name: str, k: int) -> float | None:
        """Value of a column in one row.

        Parameters
        ----------
        name : str
            One of `COLUMNS`.
        k : int
            From 0 on.

        Returns
        -------
        value : float or None
            In the unit of the column; None where the table has no such column.
        """
        return float(self.values[name][k]) if name in self.values else None


_SHAPE = ("e1", "e2", "r2")


def one_patch(
    shape: tuple[float, float, float] | None,
    shape_error: tuple[float, float, float] | None,
    n_stars: int | None,
) -> PatchTable:
    """The PSF of one patch from options of the command.

    Parameters
    ----------
    shape, shape_error : (float, float, float) or None
        e1, e2 (dimensionless) and R² in arcsec², and their standard errors.
    n_stars : int or None
        Stars in the stack (count).

    Returns
    -------
    table : PatchTable
        Of one row.

    Raises
    ------
    InputError
        If one is missing or breaks its rule: names the option.
    """
    for key, required in (("--shape", shape), ("--n-stars", n_stars)):
        if required is None:
            raise InputError("is missing, or a table of patches", key=key)
    given = dict(zip(_SHAPE, shape or (), strict=False)) | {"n_stars": n_stars}
    given |= {f"{name}_error": value for name, value in zip(_SHAPE, shape_error or (), strict=False)}
    values = {name: np.array([value], dtype=float) for name, value in given.items()}
    for name, rule, good in _rules(values):
        if not good.all():
            option = "--n-stars" if name == "n_stars" else "--shape-error" if "_" in name else "--shape"
            key = option if name == "n_stars" else f"{option}, {name.removesuffix('_error')}"
            raise InputError(rule, key=key, value=f"{values[name][0]:g}")
    return PatchTable(source=None, row=np.array([1]), name=("1",), named=False, values=values)


def read_patches(path: Path) -> PatchTable:
    """Measured PSFs from a table.

    Parameters
    ----------
    path : Path
        Any table that astropy reads, with columns of `COLUMNS`: ``r2`` [arcsec²] and ``n_stars`` at least.

    Returns
    -------
    table : PatchTable
        One row for each PSF; rows without a name are patches of their own.

    Raises
    ------
    InputError
        If a column is missing, or its name a slip, or a value breaks its rule: names the row.
    """
    table, row = load_table(open_catalog(path, {}, None))
    names = list(table.colnames)
    for name in names:
        near = difflib.get_close_matches(name, [*COLUMNS, "patch"], n=1, cutoff=_ALIKE)
        if near and near[0] not in names and name not in COLUMNS:
            raise InputError(f"is no column of patches (did you mean {near[0]}?)", source=path, column=name)
    needed = {name: COLUMNS[name] for name in ("r2", "n_stars")}
    values = named_columns(path, table, row, needed, COLUMNS)
    for pair in _TOGETHER:
        for one, other in (pair, pair[::-1]):
            if one in values and other not in values:
                raise InputError(f"is missing beside {one}", source=path, column=other)
    for name, other in _NEEDS.items():
        if name in values and other not in values:
            raise InputError(f"is missing beside {name}", source=path, column=other)
    if len(table) > MOST_PATCHES:
        raise InputError(f"must have no more than {MOST_PATCHES} rows", source=path, value=len(table))
    refuse_unless(path, row, values, _rules(values))
    named = "patch" in names
    name = tuple(str(one) for one in (table["patch"] if named else range(1, len(row) + 1)))
    return PatchTable(source=path, row=row, name=name, named=named, values=values)


def _rules(values: dict[str, FloatArray]) -> Sequence[tuple[str, str, BoolArray]]:
    """Name of each quantity, what must hold, and where it does."""
    rules: list[tuple[str, str, BoolArray]] = []
    for name, v in values.items():
        finite = np.isfinite(v)
        if name in ("e1", "e2"):
            rules.append((name, "must be in (-1, 1)", finite & (np.abs(v) < 1)))
        elif name in ("r2", "sd"):
            unit = " [arcsec²]" if name == "r2" else ""
            rules.append((name, f"must be positive and finite{unit}", finite & (v > 0)))
        elif name == "n_stars":
            whole = finite & (v >= 1) & (v <= 1e9) & (v == np.floor(np.where(finite, v, 0.5)))
            rules.append((name, "must be a whole number from 1 to 1e9", whole))
        elif name == "binary_fraction":
            rules.append((name, "must be in [0, 1]", finite & (v >= 0) & (v <= 1)))
        elif name.endswith("_error"):
            rules.append((name, "must be finite and not negative", finite & (v >= 0)))
        elif name == "b":
            rules.append((name, "must be in [-90, 90] [deg]", finite & (np.abs(v) <= 90)))
        elif name == "mag_hi" and "mag_lo" in values:
            within = finite & (v <= 50) & (values["mag_lo"] < v) & (values["mag_lo"] >= -50)
            rules.append((name, "must be above mag_lo, both within -50 to 50", within))
        elif name not in ("x", "y"):
            rules.append((name, "must be finite", finite))
    if "e1" in values and "e2" in values:
        rules.append(("e2", "must make e1² + e2² less than 1", np.hypot(values["e1"], values["e2"]) < 1))
    return rules
