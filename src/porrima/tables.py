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
from porrima.rows import numbers

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]
    BoolArray = NDArray[np.bool_]

__all__ = [
    "CatalogFile",
    "LoadedTable",
    "column_values",
    "load_columns",
    "load_table",
    "named_columns",
    "open_catalog",
]


_TEXT = "must be UTF-8 text or a FITS table"

_HEAD = 65536  # bytes in which a file shows its format
_PIECE = 64_000_000  # bytes of a FITS table in memory at a time

_ASTROPY_TEXT = {"|": "ascii.ipac", "\\": "ascii.ipac", "Title:": "ascii.mrt"}  # how such a file begins


@dataclass(frozen=True, slots=True, kw_only=True)
class CatalogFile:
    """A catalogue's file, and what is wanted from it.

    Parameters
    ----------
    path : Path
        Its name.
    head : bytes
        Its beginning, decompressed (of a Parquet file the end, where the names are), to know its format by.
    columns : mapping of str to str
        The file's column of each quantity that it names otherwise.
    band : str, optional
        Band of the magnitudes wanted; None for the file's own.
    options : mapping of str to object
        What its reader is to do otherwise than by default; see `porrima.rows.parsed_options`.
    """

    path: Path
    head: bytes
    columns: Mapping[str, str] = field(default_factory=dict)
    band: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_parquet(self) -> bool:
        """Whether it is an Apache Parquet file."""
        return self.head.startswith(b"PAR1")

    def read(self) -> bytes:
        """All its content, decompressed.

        Returns
        -------
        data : bytes
            The content.

        Raises
        ------
        InputError
            If it cannot be read or is no whole gzip file.
        """
        return _bytes(self.path, -1)

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
        data = self.read()
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            row = data.count(b"\n", 0, error.start) + 1
            value = f"byte 0x{data[error.start]:02x}"
            raise InputError(_TEXT, source=self.path, row=row, value=value) from None
        if "\0" in text:
            row = text.count("\n", 0, text.index("\0")) + 1
            raise InputError(_TEXT, source=self.path, row=row, value="byte 0x00")
        return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadedTable:
    """A table as read, unchecked.

    Parameters
    ----------
    table : astropy.table.Table
        With units and metadata, as far as the file has them.
    row : (n,) int array
        Line of a text file, or row of another table, counted from 1.
    names : list of str
        All columns of the file, also those that were not read.
    """

    table: Any
    row: IntArray
    names: list[str]


def open_catalog(
    path: Path, columns: Mapping[str, str], band: str | None, options: Mapping[str, Any] | None = None
) -> CatalogFile:
    """A file that can be read, with its beginning, decompressed if it is gzip'd.

    Parameters
    ----------
    path : Path
        The file.
    columns, band, options : mapping, str, mapping
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
    except (OSError, ValueError) as error:  # no permission; a NUL in the name; InputError is a ValueError too
        if isinstance(error, InputError):
            raise
        raise InputError("must be the name of a file", source=repr(str(path))) from None
    head = _bytes(path, _HEAD)
    if head.startswith(b"PAR1"):
        head = head[:4] + _bytes(path, -1, skip=max(0, path.stat().st_size - _HEAD))
    if not head.strip() and (len(head) < _HEAD or not _bytes(path, -1).strip()):
        raise InputError("must not be empty", source=path)
    return CatalogFile(path=path, head=head, columns=columns, band=band, options=options or {})


def _bytes(path: Path, count: int, skip: int = 0) -> bytes:
    """The first bytes of a file, decompressed, or all for -1."""
    try:
        with path.open("rb") as file:
            if file.read(2) == b"\x1f\x8b":
                file.seek(0)
                with gzip.open(file) as content:
                    return content.read(count)
            file.seek(skip)
            return file.read(count)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise InputError("must be a whole gzip file", source=path, value=error) from None
    except OSError as error:
        raise InputError("must be a readable file", source=path, value=error.strerror or error) from None
    except ValueError:
        raise InputError("must be the name of a file", source=repr(str(path))) from None


def _astropy(path: Path, read: Callable[[], Any]) -> Any:
    """Result of a reader of astropy; its warnings stay inside and all its errors become one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return read()
        except InputError:
            raise
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
    loaded = load_columns(file, None)
    return loaded.table, loaded.row


def load_columns(file: CatalogFile, wanted: Collection[str] | None) -> LoadedTable:
    """Columns of a table, of which a large FITS file or a Parquet file is not read as a whole.

    Parameters
    ----------
    file : CatalogFile
        Any table that astropy reads; Parquet where pyarrow is installed.
    wanted : collection of str, optional
        Names of the columns that may be left out of the result if they are not among these; None for all.

    Returns
    -------
    loaded : LoadedTable
        The columns, the number of each row and all names.

    Raises
    ------
    InputError
        If it is no table; a text row of another length than the header is named.
    """
    from astropy.table import Table  # noqa: PLC0415  (slow to import, needed for tables only)

    if file.is_parquet:
        return _astropy(file.path, partial(_load_parquet, file.path, wanted))  # type: ignore[no-any-return]
    if file.head.startswith(b"SIMPLE"):
        return _astropy(file.path, partial(_load_fits, file, wanted))  # type: ignore[no-any-return]
    kind = "votable" if re.search(rb"<VOTABLE\b", file.head[:4096]) else None
    if kind is None:
        lines = file.lines()
        begin = next((line.lstrip() for line in lines if line.strip()), "")
        kind = next((kind for sign, kind in _ASTROPY_TEXT.items() if begin.startswith(sign)), None)
        if kind is None:
            table, row = _load_text(file.path, lines)
            return LoadedTable(table=table, row=row, names=list(table.colnames))
    table = _astropy(file.path, partial(Table.read, io.BytesIO(file.read()), format=kind))
    return _loaded(table, list(table.colnames))


def _loaded(table: Any, names: list[str]) -> LoadedTable:
    """A table whose rows are counted from 1."""
    return LoadedTable(table=table, row=np.arange(1, len(table) + 1), names=names)


def _load_fits(file: CatalogFile, wanted: Collection[str] | None) -> LoadedTable:
    """Table of a FITS file; a large one piece by piece, of which the columns wanted are kept."""
    from astropy.io import fits  # noqa: PLC0415
    from astropy.table import Table, vstack  # noqa: PLC0415

    path = file.path
    with path.open("rb") as stream:
        plain = stream.read(6) == b"SIMPLE"
    if wanted is None or not plain or path.stat().st_size <= _PIECE:
        table = Table.read(io.BytesIO(file.read()), format="fits")
        return _loaded(table, list(table.colnames))
    with fits.open(path) as units:
        k = next(k for k, unit in enumerate(units) if isinstance(unit, fits.BinTableHDU))
        n, width, names = units[k].header["NAXIS2"], units[k].header["NAXIS1"], list(units[k].columns.names)
    rows = max(1, _PIECE // max(1, width))
    pieces = []
    for first in range(0, max(n, 1), rows):
        with fits.open(path) as units:  # opened anew: what was mapped into memory is given back
            piece = fits.BinTableHDU(data=units[k].data[first : first + rows], header=units[k].header)
            table = Table.read(piece)
            table.keep_columns([name for name in table.colnames if name in wanted])
            pieces.append(table.copy())
    return _loaded(vstack(pieces, metadata_conflicts="silent"), names)


def _load_parquet(path: Path, wanted: Collection[str] | None) -> LoadedTable:
    """Columns of a Parquet file."""
    from astropy.table import Table  # noqa: PLC0415

    try:
        from pyarrow import parquet  # noqa: PLC0415  (not one of Porrima's own dependencies)
    except ImportError:
        rule = "is a Parquet file, which needs the package pyarrow: install it, or convert the file to FITS"
        raise InputError(rule, source=path) from None
    names = list(parquet.read_schema(path).names)
    chosen = names if wanted is None else [name for name in names if name in wanted]
    if not chosen:
        return _loaded(Table(), names)
    return _loaded(Table.read(path, format="parquet", include_names=chosen), names)


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


def named_columns(
    path: Path, table: Any, row: IntArray, needed: Mapping[str, str], optional: Mapping[str, str]
) -> dict[str, FloatArray]:
    """Columns of a user's table, by name.

    Parameters
    ----------
    path : Path
        The file, for the message.
    table : astropy.table.Table
        The table, from `load_table`.
    row : (n,) int array
        Number of each row, dimensionless.
    needed, optional : mapping of str to str
        Names, and the internal unit of each as `column_values` takes it.

    Returns
    -------
    values : dict of (n,) float array
        Those that are there, in their units.

    Raises
    ------
    InputError
        If one that is needed is missing, there are no rows, or a value is no number.
    """
    for name in needed:
        if name not in table.colnames:
            names = ", ".join(table.colnames)
            raise InputError(f"is missing; the table has {names}", source=path, column=name)
    if not len(table):
        raise InputError("must have rows below its header", source=path)
    units = {**needed, **optional}
    return {
        name: column_values(path, table[name], name, unit, row)
        for name, unit in units.items()
        if name in table.colnames
    }
