"""The TRILEGAL model of the Galaxy (Girardi et al. 2005): its output files to rows of a catalogue."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from porrima.besancon import i_from_johnson
from porrima.errors import InputError
from porrima.rows import CatalogRows, parsed_options, refuse
from porrima.stars import COMPONENTS
from porrima.tables import column_values, load_columns

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.tables import CatalogFile, LoadedTable

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]
    BoolArray = NDArray[np.bool_]

__all__ = ["DWARF_LOG_G", "SIGNATURE", "TrilegalOptions", "read_trilegal"]

SIGNATURE = re.compile(rb"\bGc\"?[ ,\t]+\"?logAge\"?[ ,\t]+\"?\[M/H\]")
"""What the beginning of a file of the model holds."""

DWARF_LOG_G = (4.15, 6.0)
"""Range of log10 surface gravity [cm/s²] of main-sequence stars, half-open: below are giants, above white dwarfs."""

_THIN_AGES = (0.15, 1.0, 2.0, 3.0, 5.0, 7.0)  # Gyr, between the thin discs 1 to 7 of Robin et al. (2003)
_OTHERS = {2: "thick", 3: "halo", 4: "bulge", 5: "unknown"}  # by the number Gc; 5: the Magellanic Clouds
_NEEDED = ("Gc", "logAge", "[M/H]", "m_ini", "logg", "m-M0")
_NO_BAND = {"Gc", "logAge", "[M/H]", "m_ini", "logL", "logTe", "logg", "m-M0", "Av", "m2/m1", "mbol", "Mact"}
_SUN = 4.77  # absolute bolometric magnitude of the Sun in the model
_OWN_NAMES = {
    "gaia_G": ("G", "Gmag"),
    "euclid_VIS": ("VIS", "VISmag"),
}  # of bands that Porrima calls otherwise


@dataclass(frozen=True, slots=True, kw_only=True)
class TrilegalOptions:
    """What to do with the binaries that the model itself has made.

    Parameters
    ----------
    binaries : {"replace", "keep", "drop"}
        For ``replace``, a row with a companion is one catalogued star like any other: it has the mass of the
        star that the row is about and the magnitude of the pair, and Porrima's own statistics decide about
        its companion.  For ``keep`` the model's own pairs are used as they are: their mass ratios, and its
        single stars single; only the orbits, which it does not give, are Porrima's.  For ``drop`` a row with a
        companion is left out and counted.

    Raises
    ------
    InputError
        If it is none of these.

    Notes
    -----
    ``replace`` keeps the counts of a survey that takes each pair for one star, which is what `Stars` means
    by a magnitude; as the model draws mass ratios above 0.7 (by default), its pairs are up to 0.75 mag, 0.5
    in the mean, brighter than their primary alone.  ``drop`` keeps single stars only and lowers the counts by
    the model's binary fraction: in a file of 2963 rows with 31 % pairs, the stars of i = 16 to 23 mag are
    32 % fewer (2131 and 1450), with mean masses and median distances alike to 2 %.
    """

    binaries: str = "replace"

    def __post_init__(self) -> None:
        if self.binaries not in ("replace", "keep", "drop"):
            raise InputError("must be replace, keep or drop", key="options, binaries", value=self.binaries)


_NAMES = {"distance": "m-M0", "metallicity": "[M/H]", "log_age": "logAge", "mass_ratio": "m2/m1"}


def read_trilegal(file: CatalogFile) -> CatalogRows:
    """Rows of an output file of the model, whose columns are found by name.

    Parameters
    ----------
    file : CatalogFile
        The file with the line that names the columns; its options are those of `TrilegalOptions`.

    Returns
    -------
    rows : CatalogRows
        In internal units; distances from m-M0, thin discs 1 to 7 by age.

    Raises
    ------
    InputError
        If the file is cut short, lacks a column, or a value is none: names the line.

    Notes
    -----
    - A star is on the main sequence if log g is in `DWARF_LOG_G`.  In two catalogues of the Besançon model
      this is exactly its luminosity class V (log g at least 4.18; class IV at most 4.12).  Left out with the
      giants are very young stars that still contract.
    - The mass is that of now (``Mact``), or the initial one where the file has none; they differ where the
      star that the row is about was the lighter one of a pair whose heavier star has died.
    - A band has the name of its column, with or without ``mag``, on the file's own zero point (Vega for
      U to K).  Where the file has no i, it comes from V and V-I by `porrima.besancon.sdss_i`.
    - The file says neither its direction nor its area.

    References
    ----------
    Girardi2005, Robin2003
    """
    if file.columns:
        rule = "must not be given for a TRILEGAL file, whose header names the columns (or give format table)"
        raise InputError(rule, key="columns")
    options: TrilegalOptions = parsed_options(file.options, TrilegalOptions)
    loaded = load_columns(file, None)
    missing = next((name for name in _NEEDED if name not in loaded.names), None)
    if missing is not None:
        raise InputError(
            f"must be there; the file has {' '.join(loaded.names)}", source=file.path, column=missing
        )
    if not loaded.row.size:
        raise InputError("must have rows below its header", source=file.path)
    columns = {name: _column(file, loaded, name) for name in _NEEDED}
    mass_name = "Mact" if "Mact" in loaded.names else "m_ini"
    band = file.band or "i"
    magnitude, assumed = _magnitude(file, band, loaded)
    _check(file, columns, loaded)
    low, high = DWARF_LOG_G
    values = {
        "mass": _column(file, loaded, mass_name),
        "distance": 10.0 ** (1.0 + 0.2 * columns["m-M0"]),
        "magnitude": magnitude,
        "metallicity": columns["[M/H]"],
        "log_age": columns["logAge"],
        "luminosity_class": np.where((columns["logg"] >= low) & (columns["logg"] < high), 5.0, 0.0),
    }
    rejected = {}
    if options.binaries != "replace":
        if "m2/m1" not in loaded.names:
            rule = f"must be there, for binaries = {options.binaries}"
            raise InputError(rule, source=file.path, column="m2/m1")
        ratio = _column(file, loaded, "m2/m1")
        if options.binaries == "drop":
            rejected["with a companion of its own"] = ratio > 0
        else:
            values["mass_ratio"] = ratio
    return CatalogRows(
        row=loaded.row,
        names=_NAMES | {"mass": mass_name},
        values=values,
        component=_components(file, columns["Gc"], columns["logAge"], loaded.row),
        band=band,
        source=f"{file.path.name} (TRILEGAL model)",
        assumed=assumed,
        rejected=rejected,
    )


def _check(file: CatalogFile, columns: dict[str, FloatArray], loaded: LoadedTable) -> None:
    """Stop at the first row with a distance modulus, age or gravity that is none, or in another unit."""
    row, modulus, age, gravity = loaded.row, columns["m-M0"], columns["logAge"], columns["logg"]
    for name, values, bad, rule in (
        ("m-M0", modulus, ~np.isfinite(modulus), "must be finite"),
        ("m-M0", modulus, (modulus < -5) | (modulus > 27), "must be from -5 to 27 (is it m-M0?)"),
        ("logAge", age, (age < 5) | (age > 10.5), "must be from 5 to 10.5 (is it log10 of yr?)"),
        ("logg", gravity, ~np.isfinite(gravity), "must be finite"),
    ):
        refuse(file.path, row, name, values, bad, rule)
    if {"logL", "mbol", "m2/m1"} <= set(loaded.names):
        alone = _column(file, loaded, "m2/m1") == 0
        bolometric = _SUN - 2.5 * _column(file, loaded, "logL") + modulus
        bad = alone & (np.abs(bolometric - _column(file, loaded, "mbol")) > 0.3)
        refuse(
            file.path,
            row,
            "m-M0",
            modulus,
            bad,
            "must be mbol of a single star less its absolute one by logL",
        )


def _column(file: CatalogFile, loaded: LoadedTable, name: str) -> FloatArray:
    """Numbers of a column, which has no unit."""
    return column_values(file.path, loaded.table[name], name, "", loaded.row)


def _components(
    file: CatalogFile, number: FloatArray, log_age: FloatArray, row: IntArray
) -> NDArray[np.str_]:
    """Names of the components from their numbers, the thin disc divided by age."""
    bad = ~np.isin(number, [1, *_OTHERS])
    refuse(file.path, row, "Gc", number, bad, "must be the number of a component, 1 to 5")
    thin = np.searchsorted(np.log10(_THIN_AGES) + 9.0, log_age, side="right")
    component = np.array(COMPONENTS)[np.minimum(thin, len(_THIN_AGES))]
    component[np.isnan(log_age)] = "unknown"
    for k, name in _OTHERS.items():
        component[number == k] = name
    return component


def _magnitude(file: CatalogFile, band: str, loaded: LoadedTable) -> tuple[FloatArray, dict[str, BoolArray]]:
    """Magnitude in a band, as the file has it or from V and I; and what was assumed for it."""
    own = (*_OWN_NAMES.get(band, ()), band, f"{band}mag", band.removeprefix("roman_"))
    found = next((name for name in own if name in loaded.names and name not in _NO_BAND), None)
    if found is not None:
        return _column(file, loaded, found), {}
    if band == "i" and {"V", "I"} <= set(loaded.names):
        v = _column(file, loaded, "V")
        return i_from_johnson(v, v - _column(file, loaded, "I"))
    known = ", ".join(name for name in loaded.names if name not in _NO_BAND)
    raise InputError(
        f"must be one of {known or 'none'}, which the file has", source=file.path, key="band", value=band
    )
