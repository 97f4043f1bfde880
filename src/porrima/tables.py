"""Files of tables: their bytes, lines and columns in internal units, whatever the format."""

from __future__ import annotations

import csv
import gzip
import io
import re
import warnings
import zlib
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]
    BoolArray = NDArray[np.bool_]

__all__ = [
    "SKY_AREA",
    "CatalogFile",
    "CatalogRows",
    "column_values",
    "load_table",
    "numbers",
    "open_catalog",
    "refuse",
]


SKY_AREA = 41253.0
"""Solid angle of the whole sky, in deg² (4π sr, rounded up)."""

_TEXT = "must be UTF-8 text or a FITS table"

_ASTROPY_TEXT = {"|": "ascii.ipac", "\\": "ascii.ipac", "Title:": "ascii.mrt"}  # how such a file begins


@dataclass(frozen=True, slots=True, kw_only=True)
class CatalogFile:
    """A catalogue's file, and what is wanted from it.

    Parameters
    ----------
    path : Path
        Its name.
    data : bytes
        Its content, decompressed.
    columns : mapping of str to str
        The file's column of each quantity that it names otherwise.
    band : str, optional
        Band of the magnitudes wanted; None for the file's own.
    """

    path: Path
    data: bytes
    columns: Mapping[str, str] = field(default_factory=dict)
    band: str | None = None

    def lines(self) -> list[str]:
        r"""Lines of a text file, without their ends (``\n``, ``\r\n`` or ``\r``).

        Returns
        -------
        lines : list of str
            The first is row 1 of error messages.

        Raises
        ------
        InputError
            If the file is not text in UTF-8.
        """
        try:
            text = self.data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            row = self.data.count(b"\n", 0, error.start) + 1
            value = f"byte 0x{self.data[error.start]:02x}"
            raise InputError(_TEXT, source=self.path, row=row, value=value) from None
        if "\0" in text:
            row = text.count("\n", 0, text.index("\0")) + 1
            raise InputError(_TEXT, source=self.path, row=row, value="byte 0x00")
        return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


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
        [log10 yr] and, where there is one, ``luminosity_class``; NaN where the file gives nothing.
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


def open_catalog(path: Path, columns: Mapping[str, str], band: str | None) -> CatalogFile:
    """A file with its content, decompressed if it is gzip'd.

    Parameters
    ----------
    path : Path
        The file.
    columns, band : mapping of str to str, str
        As in `CatalogFile`.

    Returns
    -------
    file : CatalogFile
        Not empty.

    Raises
    ------
    InputError
        If it is missing, unreadable, empty or no file.
    """
    try:
        if path.is_dir():
            raise InputError("must be a file, not a directory", source=path)
        if path.exists() and not path.is_file():
            raise InputError("must be a file, not a device", source=path)
        data = path.read_bytes()
    except OSError as error:
        raise InputError("must be a readable file", source=path, value=error.strerror) from None
    except ValueError as error:  # a NUL in the name; InputError is a ValueError too
        if isinstance(error, InputError):
            raise
        raise InputError("must be the name of a file", source=repr(str(path))) from None
    if data.startswith(b"\x1f\x8b"):
        try:
            data = gzip.decompress(data)
        except (OSError, EOFError, zlib.error) as error:
            raise InputError("must be a whole gzip file", source=path, value=error) from None
    if not data.strip():
        raise InputError("must not be empty", source=path)
    return CatalogFile(path=path, data=data, columns=columns, band=band)


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


def _astropy(path: Path, read: Callable[[], Any]) -> Any:
    """Result of a reader of astropy; its warnings stay inside and all its errors become one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return read()
        except Exception as error:  # it lets through whatever its parsers raise, far beyond ValueError
            reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
            raise InputError("must be a table that astropy reads", source=path, value=reason) from error


def load_table(file: CatalogFile) -> tuple[Any, IntArray]:
    """Table of astropy, and the number of each of its rows.

    Parameters
    ----------
    file : CatalogFile
        Any table that astropy reads.

    Returns
    -------
    table : astropy.table.Table
        With units and metadata, as far as the file has them.
    row : (n,) int array
        Line of a text file, or row of another table, counted from 1.

    Raises
    ------
    InputError
        If it is no table; a text row of another length than the header is named.
    """
    from astropy.table import Table  # noqa: PLC0415  (slow to import, needed for tables only)

    kind = None
    if file.data.startswith(b"SIMPLE"):
        kind = "fits"
    elif re.search(rb"<VOTABLE\b", file.data[:4096]):
        kind = "votable"
    else:
        lines = file.lines()
        begin = next((line.lstrip() for line in lines if line.strip()), "")
        kind = next((kind for sign, kind in _ASTROPY_TEXT.items() if begin.startswith(sign)), None)
        if kind is None:
            return _load_text(file.path, lines)
    table = _astropy(file.path, partial(Table.read, io.BytesIO(file.data), format=kind))
    return table, np.arange(1, len(table) + 1)


def _load_text(path: Path, lines: list[str]) -> tuple[Any, IntArray]:
    """Table of delimited text, and the line of each of its rows."""
    from astropy.io import ascii as text  # noqa: PLC0415

    row = [k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")]
    start = _header_line(path, lines, row)
    header = lines[start].strip().lstrip("#").strip()
    delimiter = next((mark for mark in ",\t" if mark in header), " ")
    row = [k for k in row if k > start]
    if not row:
        raise InputError("must have rows below its header line", source=path, row=start + 1)
    options = {"format": "tab"} if delimiter == "\t" else {"format": "basic", "delimiter": delimiter}
    try:
        table = _astropy(path, partial(text.read, [header, *(lines[k] for k in row)], guess=False, **options))
    except InputError:
        _refuse_ragged(path, header, lines, row, delimiter)
        raise
    if len(table) != len(row):
        _refuse_ragged(path, header, lines, row, delimiter)
        raise InputError("must have one line for each row", source=path, value=f"{len(table)} rows")
    if lines[0].startswith("# %ECSV"):
        _ecsv_header(path, table, [line[2:] for line in lines[:start] if line.startswith("# ")])
    return table, np.array(row) + 1


def _ecsv_header(path: Path, table: Any, header: list[str]) -> None:
    """Give a table the units and the metadata of its header; to read it as ECSV takes 3 times as long."""
    from astropy import units as u  # noqa: PLC0415
    from astropy.table.meta import get_header_from_yaml  # noqa: PLC0415

    def read() -> None:
        """Units and metadata, from the YAML."""
        known = get_header_from_yaml(header)
        table.meta.update(known.get("meta") or {})
        for column in known["datatype"]:
            if column["name"] in table.colnames and column.get("unit") is not None:
                table[column["name"]].unit = u.Unit(column["unit"], parse_strict="silent")

    _astropy(path, read)


def _header_line(path: Path, lines: list[str], row: list[int]) -> int:
    """Line that names the columns: the first one, or the last comment above it where that holds numbers."""
    if not row:
        raise InputError("must have a header line and rows", source=path)
    if not all(_is_number(part) for part in re.split(r"[,\s]+", lines[row[0]].strip())):
        return row[0]
    if row[0] > 0 and lines[row[0] - 1].lstrip().startswith("#"):
        return row[0] - 1
    rule = "must be a header line that names the columns"
    raise InputError(rule, source=path, row=row[0] + 1, value=lines[row[0]].strip()[:60])


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _refuse_ragged(path: Path, header: str, lines: list[str], row: list[int], delimiter: str) -> None:
    """Stop at the first row that has not as many fields as the header."""

    def count(line: str) -> int:
        """Count of the fields of a line."""
        line = line if delimiter == "\t" else line.strip()
        return len(next(csv.reader([line], delimiter=delimiter, skipinitialspace=True)))

    try:
        n = count(header)
        bad = next((k for k in row if count(lines[k]) != n), None)
    except csv.Error:
        return
    if bad is not None:
        rule = f"must have {n} fields, as the header"
        raise InputError(rule, source=path, row=bad + 1, value=str(count(lines[bad])))


def column_values(path: Path, column: Any, name: str, unit: str, row: IntArray) -> FloatArray:
    """Numbers of a column in an internal unit, NaN where there is none.

    Parameters
    ----------
    path : Path
        The file, for the message.
    column : astropy.table.Column
        The column; bare numbers are in the internal unit already.
    name : str
        Its name.
    unit : str
        The internal unit, such as ``pc``; empty for a dimensionless quantity, whose unit is not looked at.
    row : (n,) int array
        Number of each row, dimensionless.

    Returns
    -------
    values : (n,) float array
        In `unit`.

    Raises
    ------
    InputError
        If a value is no number, or the unit does not fit.
    """
    data = np.ma.asarray(_astropy(path, lambda: getattr(column, "value", column)))
    if data.ndim != 1 or data.dtype.kind not in "iufUSO":
        raise InputError("must hold one number in each row", source=path, column=name, value=data.dtype)
    if data.dtype.kind in "USO":
        filled = [("nan" if value is np.ma.masked else str(value)) for value in data.astype(str)]
        values = numbers(path, name, filled, row)
    else:
        values = np.ma.filled(data.astype(float), np.nan)
    own = getattr(column, "unit", None)
    if not unit or own is None or str(own) in ("", unit):  # FITS knows no dex, but keeps the word
        return values
    try:
        return _converted(values, own, unit)
    except (ValueError, TypeError):  # UnitConversionError is both
        raise InputError(f"must be in a unit like {unit}", source=path, column=name, value=own) from None


def _converted(values: FloatArray, own: Any, unit: str) -> FloatArray:
    """Numbers in an internal unit; magnitudes and decades keep their zero point."""
    from astropy import units as u  # noqa: PLC0415

    if unit == "mag" and isinstance(own, u.MagUnit):
        return values  # mag(AB): the zero point belongs to the band
    if unit == "dex(yr)":
        if own == u.dex:
            return values
        converted: FloatArray = u.Dex(values, own).to_value(u.Unit(unit))
        return converted
    result: FloatArray = u.Quantity(values, own).to_value(unit)
    return result
