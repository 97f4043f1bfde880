"""The Besançon model of the Galaxy (Robin et al. 2003): its output files to rows of a catalogue."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from porrima.errors import InputError
from porrima.rows import SKY_AREA, CatalogRows, NoOptions, numbers, parsed_options, refuse
from porrima.stars import COMPONENTS

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from porrima.tables import CatalogFile

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]
    BoolArray = NDArray[np.bool_]

__all__ = ["COMPONENT_AGES", "SIGNATURE", "i_from_johnson", "read_besancon", "sdss_i"]

COMPONENT_AGES = (0.075, 0.575, 1.5, 2.5, 4.0, 6.0, 8.5, 11.0, 14.0, 10.0)
"""Mean age in Gyr (10⁹ yr) of the components thin 1-7, thick disc, halo, bulge of Robin et al. (2003)."""

SIGNATURE = re.compile(rb"BESANCON MODEL OF STELLAR|\bCL\"?[ ,\t]+\"?Typ\"?[ ,\t]+\"?LTef\b")
"""What the beginning of a file of the model holds."""

_HEADER = {"CL", "Typ", "LTef"}  # how the line that names the Besançon model's columns is known
_TRAILER = re.compile(r"\s*(#|$|Dist\b|Star density|Stars ejected|TOTAL NUMBER)")
_MAGNITUDE = re.compile(r"[UBVRIJHKLugriz](-[UBVRIJHKLugriz])?")  # V, or V-I

# Dwarf sequence A0 to M7, V-Ic against Rc-Ic, in mag (Pecaut & Mamajek 2013, their table of 2019).
_V_MINUS_I = (0.041, 0.506, 0.713, 0.853, 1.272, 1.529, 1.766, 2.420, 2.831, 3.277, 3.664, 4.13, 4.45)
_R_MINUS_I = (0.040, 0.254, 0.350, 0.410, 0.587, 0.723, 0.877, 1.341, 1.590, 1.831, 2.008, 2.18, 2.27)


def sdss_i(v: FloatArray, v_minus_i: FloatArray) -> FloatArray:
    r"""SDSS i magnitude (AB) of dwarfs from Johnson V and Cousins I.

    Parameters
    ----------
    v : (n,) float array
        Johnson V, in mag (Vega).
    v_minus_i : (n,) float array
        V minus Cousins I, in mag; made for dwarfs from 0.04 (A0) to 4.45 (M7), R − I clipped beyond.

    Returns
    -------
    i : (n,) float array
        In mag (AB).

    Notes
    -----
    .. math:: i = I + 0.247\,(R - I) + 0.329

    (Jordi et al. 2006; coefficients ±0.003 and ±0.002, no scatter known), with R − I from V − I along the
    dwarf sequence of Pecaut & Mamajek (2013).  Checked along that sequence: the relation I(i, i−z) of
    Lupton (2005), of stated scatter 0.006 mag, agrees to 0.05 mag from M0 to M5 (V − I = 3.3) and is
    0.08 mag fainter at M6; Jordi's own r and r − i agree to 0.03 mag from G2 to M3.  An error of 0.1 mag in
    R − I costs 0.025 mag.  The metallicity does not enter.

    References
    ----------
    Jordi2006, Pecaut2013, Lupton2005
    """
    r_minus_i = np.interp(v_minus_i, _V_MINUS_I, _R_MINUS_I)
    i: FloatArray = v - v_minus_i + 0.247 * r_minus_i + 0.329
    return i


def i_from_johnson(v: FloatArray, v_minus_i: FloatArray) -> tuple[FloatArray, dict[str, BoolArray]]:
    """SDSS i magnitude (AB) as `sdss_i` has it, and what was assumed for it.

    Parameters
    ----------
    v, v_minus_i : (n,) float array
        As for `sdss_i`, in mag.

    Returns
    -------
    i : (n,) float array
        In mag (AB).
    assumed : dict of str to (n,) bool array
        What was assumed, and of which stars (dimensionless).
    """
    outside = (v_minus_i < _V_MINUS_I[0]) | (v_minus_i > _V_MINUS_I[-1])
    return sdss_i(v, v_minus_i), {
        "i from V and V-I": np.ones(v.size, dtype=bool),
        "V-I beyond the range of its colour term": outside,
    }


def _fields(line: str) -> list[str]:
    """Fields of a line, separated by commas, or else by white space."""
    return [part.strip().strip('"') for part in line.split(",")] if "," in line else line.split()


def read_besancon(file: CatalogFile) -> CatalogRows:
    """Rows of the ASCII output of the model of 2003, with or without kinematics, or of its columns as CSV.

    Parameters
    ----------
    file : CatalogFile
        The file, with its header or at least the line that names the columns, which are found by name.

    Returns
    -------
    rows : CatalogRows
        In internal units.  The column Age holds the number of the component, of which the mean age is taken.

    Raises
    ------
    InputError
        If the file is cut short, lacks a column, or a value is none: names the line.

    Notes
    -----
    A row lacks its Age, an integer, if it has one field less than the header and a decimal point where the
    Age would be; any other short row is an error, and so is a count of rows other than the file's own
    TOTAL NUMBER OF STARS.

    References
    ----------
    Robin2003
    """
    if file.columns:
        rule = "must not be given for a Besançon file, whose header names the columns (or give format table)"
        raise InputError(rule, key="columns")
    parsed_options(file.options, NoOptions)
    lines = file.lines()
    start = next((k for k, line in enumerate(lines) if set(_fields(line.lstrip("#"))) >= _HEADER), None)
    if start is None:
        rule = "must have the header line of the Besançon model (Dist Mv CL Typ LTef ...)"
        raise InputError(rule, source=file.path)
    names = _fields(lines[start].lstrip("#"))
    for name in ("Dist", "Mass"):
        if name not in names:
            rule = f"must be there; the file has {' '.join(names)}"
            raise InputError(rule, source=file.path, row=start + 1, column=name)
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError("must be there once only", source=file.path, row=start + 1, column=twice)
    below = range(start + 1, len(lines))
    frame = [k for k in below if _TRAILER.match(lines[k])]
    row = sorted(set(below).difference(frame))
    if not row:
        raise InputError("must have rows below its header line", source=file.path, row=start + 1)
    columns = _columns(file.path, names, lines, row)
    _check_distances(file.path, lines[:start], columns["Dist"], np.array(row) + 1)
    area = _solid_angle(file.path, [*lines[:start], *(lines[k] for k in frame)], len(row))
    return _rows(file, columns, np.array(row) + 1, area)


def _check_distances(path: Path, header: list[str], distance: FloatArray, row: IntArray) -> None:
    """Stop at a distance that no star of the model has: beyond the header's limit, or in another unit."""
    limit = re.search(r"Distance\s+\d{1,9}\.?\d*\s+a\s+(\d{1,9}\.?\d*)\s+kpc", "\n".join(header))
    if limit and float(limit[1]) > 0:
        rule = f"must be in kpc and no more than the {limit[1]} of the header"
        refuse(path, row, "Dist", distance, distance > 1.001 * float(limit[1]), rule)
    else:
        bad = (distance > 0) & ((distance < 0.001) | (distance > 2000))
        refuse(path, row, "Dist", distance, bad, "must be from 0.001 to 2000 kpc (is it in kpc?)")


def _solid_angle(path: Path, frame: list[str], n_rows: int) -> float | None:
    """Solid angle in deg², from the lines around the rows, which may also say how many rows there are."""
    text = "\n".join(frame)
    total = re.search(r"TOTAL NUMBER OF STARS\s*:\s*(\d{1,15})\b", text)
    if total and int(total[1]) != n_rows:
        rule = f"must have as many rows as its TOTAL NUMBER OF STARS says, {total[1]} (or no such line)"
        raise InputError(rule, source=path, value=n_rows)
    area = re.search(r"Solid angle\s+(\d{1,15}\.?\d*)\s+square degree", text)
    if area and not 0 < float(area[1]) <= SKY_AREA:
        raise InputError("Solid angle must be positive and no more than the sky", source=path, value=area[1])
    return float(area[1]) if area else None


def _columns(path: Path, names: list[str], lines: list[str], row: list[int]) -> dict[str, FloatArray]:
    """The columns as numbers: all, or those in use where not all are numbers; NaN where an age is missing."""
    body = [lines[k] for k in row]
    try:
        table = np.loadtxt(body, delimiter="," if "," in body[0] else None, comments=None, ndmin=2)
        if table.shape[1] == len(names):
            return {name: table[:, j] for j, name in enumerate(names)}
    except ValueError:
        pass  # some row is not as the others: the slow way finds out which
    parts = [_fields(line) for line in body]
    age = names.index("Age") if "Age" in names else None
    for k, part in enumerate(parts):
        # A component is an integer and a mass is not: a row cut at its end is not taken for one without age.
        if age is not None and len(part) == len(names) - 1 and "," not in body[k] and "." in part[age]:
            part.insert(age, "nan")
        if len(part) != len(names):
            rule = f"must have {len(names)} fields, as the header"
            raise InputError(rule, source=path, row=row[k] + 1, value=str(len(part)))
        if age is not None and not part[age]:
            part[age] = "nan"
    used = {"CL", "Age", "[Fe/H]", "l", "b", "Dist", "Mass", *filter(_MAGNITUDE.fullmatch, names)}
    return {
        name: numbers(path, name, [part[j] for part in parts], np.array(row) + 1)
        for j, name in enumerate(names)
        if name in used
    }


def _rows(
    file: CatalogFile, columns: dict[str, FloatArray], row: IntArray, area: float | None
) -> CatalogRows:
    """The model's columns in internal units."""
    nothing = np.full(row.size, np.nan)
    age = columns.get("Age", nothing)
    number = np.where(np.isnan(age), 0, age)
    bad = (age == 0) | ~np.isin(number, range(len(COMPONENT_AGES) + 1))
    refuse(file.path, row, "Age", age, bad, f"must be the number of a component, 1 to {len(COMPONENT_AGES)}")
    refuse(file.path, row, "Dist", columns["Dist"], ~(columns["Dist"] > 0), "must be positive and finite")
    band = file.band or "i"
    magnitude, assumed = _magnitude(file.path, band, columns)
    values = {
        "mass": columns["Mass"],
        "distance": 1000.0 * columns["Dist"],  # from kpc
        "magnitude": magnitude,
        "metallicity": columns.get("[Fe/H]", nothing),
        "log_age": np.array([np.nan, *(9.0 + np.log10(COMPONENT_AGES))])[number.astype(int)],
        "luminosity_class": columns["CL"],
    }
    sky = [columns[name] for name in ("l", "b") if name in columns]
    fixed = len(sky) == 2 and all(np.all(values == values[0]) for values in sky)
    return CatalogRows(
        row=row,
        names={"mass": "Mass", "distance": "Dist", "metallicity": "[Fe/H]", "log_age": "Age"},
        values=values,
        component=np.array(["unknown", *COMPONENTS[: len(COMPONENT_AGES)]])[number.astype(int)],
        band=band,
        area=area,
        source=f"{file.path.name} (Besançon model)",
        pointing=(float(sky[0][0]), float(sky[1][0])) if fixed else None,
        assumed=assumed,
    )


def _magnitude(
    path: Path, band: str, columns: dict[str, FloatArray]
) -> tuple[FloatArray, dict[str, BoolArray]]:
    """Magnitude in a band, from the one that the file has and its colours; and what was assumed for it.

    The i of the model's MegaCam files is taken for that of SDSS, though about 0.085 (r − i) brighter.
    """
    found = {name: values for name, values in columns.items() if _MAGNITUDE.fullmatch(name)}
    known = {name: values for name, values in found.items() if "-" not in name}
    colours = {name: values for name, values in found.items() if "-" in name}
    for _ in colours:  # each colour may join one more band to the chain
        for name, colour in colours.items():
            blue, red = name.split("-")
            if blue in known and red not in known:
                known[red] = known[blue] - colour
            elif red in known and blue not in known:
                known[blue] = known[red] + colour
    if band in known:
        return known[band], {}
    if band == "i" and {"V", "I"} <= set(known):
        return i_from_johnson(known["V"], known["V"] - known["I"])
    rule = f"must be one of {', '.join(sorted(known)) or 'none'}, which the file has"
    raise InputError(rule, source=path, key="band", value=band)
