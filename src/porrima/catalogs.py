"""Real catalogues to `Stars`: the output of two models of the Galaxy, Gaia, or any table with named columns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.besancon import SIGNATURE as BESANCON
from porrima.besancon import read_besancon
from porrima.errors import InputError
from porrima.files import write_table
from porrima.gaia import SIGNATURE as GAIA
from porrima.gaia import read_gaia
from porrima.rows import CatalogRows, NoOptions, parsed_options, refuse, table_area
from porrima.stars import COMPONENTS, Stars
from porrima.tables import CatalogFile, column_values, load_columns, open_catalog
from porrima.trilegal import SIGNATURE as TRILEGAL
from porrima.trilegal import read_trilegal

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]
    BoolArray = NDArray[np.bool_]

__all__ = ["READERS", "Catalog", "read_catalog", "write_stars"]

REQUIRED = {"mass": "solMass", "distance": "pc", "magnitude": "mag"}
"""Columns that a table must have, with the unit of a bare number."""

OPTIONAL = {
    "metallicity": "dex", "log_age": "dex(yr)", "component": "", "luminosity_class": "", "mass_ratio": "",
}  # fmt: skip
"""Columns that it may have."""

_ASSUMED = {"metallicity": 0.0, "log_age": 9.7}  # the Sun's, as `Stars.from_columns` takes them
_MAIN_SEQUENCE = 5  # luminosity class V
_NO_MAGNITUDE = 50.0  # catalogues write 99, -99 or 99.999 where a star has none
_LEAST_MASS = 0.08  # M_sun: below it no hydrogen burns, and the photometry has nothing
_LARGEST_MASS = 500.0  # M_sun: no star is heavier, so the column is in another unit
_NEAREST, _FARTHEST = 1.0, 2e6  # pc: inside the first is the Sun alone, beyond the second no single star seen


@dataclass(frozen=True, slots=True, kw_only=True)
class Catalog:
    """Main-sequence stars of a catalogue, and an account of every row that is not among them.

    Parameters
    ----------
    stars : Stars
        The stars, in the order of the file.
    format : str
        The key of `READERS` that the file was read with.
    n_rows : int
        Count of the rows of the file: the stars and the rejected ones.
    rejected : mapping of str to int
        Reason and count of the rows left out; each row counts once, under the first reason that holds.
    assumed : mapping of str to int
        Count of the stars for which something was taken that the file does not say.
    pointing : (float, float), optional
        Galactic longitude and latitude in deg, where all the rows have the same.
    """

    stars: Stars
    format: str
    n_rows: int
    rejected: Mapping[str, int]
    assumed: Mapping[str, int]
    pointing: tuple[float, float] | None = None


def read_catalog(
    path: str | os.PathLike[str],
    format: str | None = None,  # noqa: A002  (the word of the command line and of astropy)
    columns: Mapping[str, str] | None = None,
    band: str | None = None,
    options: Mapping[str, Any] | None = None,
) -> Catalog:
    """Main-sequence stars of a catalogue file, with the count of what was left out.

    Parameters
    ----------
    path : path
        Text (UTF-8), FITS or VOTable, also compressed with gzip; Parquet where pyarrow is installed.
    format : str, optional
        A key of `READERS`; where not given, it is recognised from the content.
    columns : mapping of str to str, optional
        For ``table``: the file's column of ``mass``, ``distance``, ``magnitude`` and, where there is one,
        of ``metallicity``, ``log_age``, ``component``, ``luminosity_class``; each by default its own name.
        For ``gaia``: the names in `porrima.gaia.QUANTITIES`.
    band : str, optional
        Band of the magnitudes wanted; by default the one that the file states, or else ``"i"`` (AB).
    options : mapping of str to object, optional
        For ``trilegal``: the fields of `porrima.trilegal.TrilegalOptions`; for ``gaia``: those of
        `porrima.gaia.GaiaOptions`.

    Returns
    -------
    catalog : Catalog
        The stars in internal units (M_sun, pc, mag, dex, log10 yr), and what was rejected or assumed.

    Raises
    ------
    InputError
        If the file cannot be read; in one line, with row (line of a text file, row of any other) and column.

    Notes
    -----
    A mass of 0 and a magnitude beyond ±50 (99 in most catalogues) or NaN mean that the file has none: the
    row is rejected and counted, and so is one below 0.08 M_sun, where no hydrogen burns.  A mass or distance
    that is missing, NaN, infinite or negative, and a distance of 0, is an error in any row, on the main
    sequence or not.  So is one that tells of another unit: a mass above 500 M_sun, a distance below 1 pc or
    beyond 2 Mpc.  Rows that a reader leaves out by its own rules are not checked.

    Of a FITS file only the columns in use are held in memory.
    """
    file = open_catalog(Path(path), columns or {}, band, options)
    name = format or next((name for name, sign in _SIGNATURES.items() if sign.search(file.head)), "table")
    if name not in READERS:
        raise InputError(f"must be one of {', '.join(READERS)}", key="format", value=name)
    with np.errstate(all="ignore"):  # the file's numbers may overflow or be NaN before they are checked
        return _select(file.path, name, READERS[name](file))


def write_stars(stars: Stars, path: str | os.PathLike[str]) -> None:
    """A file of stars (ECSV) that `read_catalog` gives back unchanged.

    Parameters
    ----------
    stars : Stars
        The stars; columns carry their units, and band, area (deg²) and source are in the header.
    path : path
        The file, replaced if it exists; it is never seen half written.

    Returns
    -------
    None
        The result is the file.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    from astropy.table import Table  # noqa: PLC0415  (slow to import, needed for tables only)

    area = None if stars.area is None else float(stars.area)
    table = Table(meta={"band": stars.band, "area_deg2": area, "source": stars.source})
    for name, unit in (REQUIRED | OPTIONAL).items():
        if name == "mass_ratio" and stars.mass_ratio is None:
            continue
        if name != "luminosity_class":  # all are on the main sequence
            table[name] = getattr(stars, name)
            table[name].unit = unit or None
    write_table(table, Path(path))


def _check(path: Path, rows: CatalogRows) -> None:
    """Stop at the first row whose mass or distance is none, or whose metallicity or age is infinite."""
    mass, distance = rows.values["mass"], rows.values["distance"]
    looked_at = np.ones(rows.row.size, dtype=bool)
    for out in rows.rejected.values():
        looked_at &= ~out
    bad = [
        ("mass", ~(np.isfinite(mass) & (mass >= 0)), "must be positive and finite (0 where unknown)"),
        ("mass", mass > _LARGEST_MASS, f"must be no more than {_LARGEST_MASS:g} M_sun (is it in M_sun?)"),
        ("distance", ~(np.isfinite(distance) & (distance > 0)), "must be positive and finite"),
        (
            "distance",
            (distance < _NEAREST) | (distance > _FARTHEST),
            f"must be from {_NEAREST:g} to {_FARTHEST:.0e} pc (is it in pc?)",
        ),
        *((quantity, np.isinf(rows.values[quantity]), "must be finite") for quantity in _ASSUMED),
    ]
    if (ratio := rows.values.get("mass_ratio")) is not None:
        bad.append(("mass_ratio", (ratio < 0) | (ratio > 1), "must be in [0, 1]"))
    for quantity, mask, rule in bad:
        refuse(path, rows.row, rows.names[quantity], rows.values[quantity], mask & looked_at, rule)


def _select(path: Path, name: str, rows: CatalogRows) -> Catalog:
    """Catalogue of the main-sequence stars; the rejected rows are counted by reason."""
    _check(path, rows)
    n = rows.row.size
    reasons = {
        **rows.rejected,
        "not on the main sequence": rows.values.get("luminosity_class", np.full(n, 5.0)) != _MAIN_SEQUENCE,
        "no mass": rows.values["mass"] == 0,
        f"below {_LEAST_MASS} M_sun": rows.values["mass"] < _LEAST_MASS,
        "no magnitude": ~(np.abs(rows.values["magnitude"]) < _NO_MAGNITUDE),
    }
    keep = np.ones(n, dtype=bool)
    rejected = {}
    for reason, bad in reasons.items():
        if np.any(keep & bad):
            rejected[reason] = int(np.count_nonzero(keep & bad))
        keep &= ~bad
    if not np.any(keep):
        rule = "must hold at least one main-sequence star with mass and magnitude"
        account = ", ".join(f"{count} {reason}" for reason, count in rejected.items())
        raise InputError(rule, source=path, value=account)
    return Catalog(
        stars=_stars(rows, keep, path.name),
        format=name,
        n_rows=n,
        rejected=rejected,
        assumed=_account(rows, keep),
        pointing=rows.pointing,
    )


def _stars(rows: CatalogRows, keep: BoolArray, name: str) -> Stars:
    """Stars of the rows kept, the Sun's metallicity and 5 Gyr where the file gives none."""
    values = {quantity: rows.values[quantity][keep] for quantity in (*REQUIRED, *_ASSUMED)}
    for quantity, default in _ASSUMED.items():
        values[quantity] = np.where(np.isnan(values[quantity]), default, values[quantity])
    return Stars(
        **values,
        component=rows.component[keep],
        band=rows.band,
        area=rows.area,
        source=rows.source or name,
        mass_ratio=rows.values["mass_ratio"][keep] if "mass_ratio" in rows.values else None,
    )


def _account(rows: CatalogRows, keep: BoolArray) -> dict[str, int]:
    """Count of what was assumed of the rows kept."""
    masks = {
        **rows.assumed,
        **{
            f"{name} not given, {value} taken": np.isnan(rows.values[name])
            for name, value in _ASSUMED.items()
        },
        "component not given": rows.component == "unknown",
    }
    counts = {reason: int(np.count_nonzero(mask & keep)) for reason, mask in masks.items()}
    return {reason: count for reason, count in counts.items() if count}


def _read_table(file: CatalogFile) -> CatalogRows:
    """Rows of any table with named columns.

    Units are honoured; a bare number is in the internal unit.  ``band``, ``area_deg2`` and ``source`` come
    from the table's metadata.
    """
    wanted = {**REQUIRED, **OPTIONAL}
    unknown = next((name for name in file.columns if name not in wanted), None)
    if unknown is not None:
        raise InputError(f"must be one of {', '.join(wanted)}", key="columns", value=unknown)
    parsed_options(file.options, NoOptions)
    names = {quantity: file.columns.get(quantity, quantity) for quantity in wanted}
    loaded = load_columns(file, names.values())
    table, row = loaded.table, loaded.row
    for quantity, name in names.items():
        if name not in loaded.names and (quantity in REQUIRED or quantity in file.columns):
            rule = f"must be in the table, for {quantity}; it has {', '.join(loaded.names[:30])}"
            raise InputError(rule, source=file.path, column=name)
    if not len(table):
        raise InputError("must have rows below its header", source=file.path)
    values = {"metallicity": np.full(len(table), np.nan), "log_age": np.full(len(table), np.nan)}
    for quantity, unit in wanted.items():
        if quantity != "component" and names[quantity] in table.colnames:
            values[quantity] = column_values(file.path, table[names[quantity]], names[quantity], unit, row)
    component = np.full(len(table), "unknown")
    if names["component"] in table.colnames:
        component = _components(file.path, table[names["component"]], names["component"], row)
    assumed = {}
    if "luminosity_class" not in values:
        assumed["luminosity class not given, main sequence taken"] = np.ones(len(table), dtype=bool)
    return CatalogRows(
        row=row,
        names=names,
        values=values,
        component=component,
        assumed=assumed,
        **_metadata(file, table.meta),
    )


def _metadata(file: CatalogFile, meta: Mapping[Any, Any]) -> dict[str, Any]:
    """Band, area and source, as the table states them (in capitals in FITS)."""
    own = {str(key).lower(): value for key, value in meta.items()}
    band = str(own.get("band") or file.band or "i")
    if file.band and band != file.band:
        raise InputError(f"must be {band}, the file's own", source=file.path, key="band", value=file.band)
    return {"band": band, "area": table_area(file.path, meta), "source": str(own.get("source") or "")}


def _components(path: Path, column: Any, name: str, row: IntArray) -> NDArray[np.str_]:
    """Names of components, ``unknown`` where masked or empty."""
    data = np.ma.asarray(column)
    if data.ndim != 1:
        raise InputError("must hold one name in each row", source=path, column=name, value=data.dtype)
    try:
        texts = np.char.strip(np.ma.getdata(data).astype(str))
    except ValueError as error:  # bytes beyond ASCII
        raise InputError("must hold names", source=path, column=name, value=error) from None
    component: NDArray[np.str_] = np.where(np.ma.getmaskarray(data) | (texts == ""), "unknown", texts)
    bad = ~np.isin(component, COMPONENTS)
    if np.any(bad):
        k = int(np.argmax(bad))
        rule = f"must be one of {', '.join(COMPONENTS)}"
        raise InputError(rule, source=path, row=int(row[k]), column=name, value=component[k])
    return component


READERS: dict[str, Callable[[CatalogFile], CatalogRows]] = {
    "besancon": read_besancon,
    "trilegal": read_trilegal,
    "gaia": read_gaia,
    "table": _read_table,
}
"""Format of a file: its reader."""

_SIGNATURES = {
    "besancon": BESANCON,
    "trilegal": TRILEGAL,
    "gaia": GAIA,
}  # a file that shows none of these is a table
