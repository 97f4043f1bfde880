"""Gaia DR3: its columns to rows of a catalogue (distances, masses), and cones of it from the archive."""

from __future__ import annotations

import contextlib
import math
import re
import sys
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.errors import InputError
from porrima.files import write_table
from porrima.photometry import MainSequence, magnitudes
from porrima.rows import CatalogRows, parsed_options, refuse, table_area
from porrima.tables import column_values, load_columns

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from porrima.tables import CatalogFile, LoadedTable

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]
    BoolArray = NDArray[np.bool_]

__all__ = [
    "QUANTITIES",
    "SIGNATURE",
    "GaiaOptions",
    "distance_from_parallax",
    "fetch_cone",
    "mass_from_magnitude",
    "read_gaia",
    "sequence_magnitude",
]

SIGNATURE = re.compile(rb"(?s)\A(?=.*\bsource_id\b)(?=.*\bphot_g_mean_mag\b)(?=.*\bbp_rp\b)", re.IGNORECASE)
"""What the beginning of a file of the catalogue holds: three of its column names."""

QUANTITIES = {
    "parallax": "mas",
    "parallax_error": "mas",
    "phot_g_mean_mag": "mag",
    "bp_rp": "mag",
    "ruwe": "",
    "ipd_frac_multi_peak": "",
    "distance": "pc",
    "extinction": "mag",
}
"""Quantities that the columns of a file may be named for, and the unit of a bare number."""

BAND = "gaia_G"
"""The band of all its magnitudes (Vega-like)."""

_DISTANCES = ("r_med_photogeo", "distance_gspphot")  # columns of the archive taken for the distance, in pc
_FROM_PARALLAX = "parallax"  # as the column of the distance: none
_FETCHED = (
    "source_id",
    "parallax",
    "parallax_error",
    "phot_g_mean_mag",
    "bp_rp",
    "ruwe",
    "ipd_frac_multi_peak",
)
_MASS_RANGE = (0.08, 1.5)  # M_sun, of MainSequence
_BRIGHTER, _FAINTER = 1.5, 4.0  # mag above and below the dwarf sequence that are still on it
_RADIUS_MAX = 10.0  # deg
_ROWS_MAX = 3_000_000  # where the archive ends its answer without a word

# Dwarf sequence A0 to M8, BP-RP against absolute G, in mag (Pecaut & Mamajek 2013, their table of 2024).
_BP_RP = (
    -0.037, 0.377, 0.587, 0.784, 0.850, 0.983, 1.10, 1.34, 1.53, 1.70, 1.84, 2.09, 2.23, 2.50, 2.94, 3.35, 3.71, 4.16,
    4.65, 4.86,
)  # fmt: skip
_ABSOLUTE_G = (
    1.00, 2.51, 3.26, 4.325, 4.801, 5.553, 5.83, 6.59, 7.15, 7.57, 8.10, 8.82, 9.29, 10.05, 11.21, 12.45, 13.35, 14.26,
    14.72, 15.20,
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class GaiaOptions:
    """Assumptions behind distances and masses, and cuts in quality.

    Parameters
    ----------
    zero_point : float
        Mean error of the parallaxes, taken away from each, in mas (Lindegren et al. 2021).
    length_scale : float
        Of the prior of `distance_from_parallax`, in pc (Astraatmadja & Bailer-Jones 2016).
    metallicity, log_age : float
        Of every star, in dex and log10 yr.
    ruwe_max : float
        Rows with a `ruwe` of this or more, or with none, are left out (dimensionless); 1.4 is customary.
    ipd_frac_multi_peak_max : float
        Rows with more per cent of windows with two peaks than this are left out; 2 is customary.

    Raises
    ------
    InputError
        If a value is out of range.

    Notes
    -----
    Both cuts are off by default: what they remove is binaries, whose effect is what Porrima is after.  A
    sample with them is for a survey that makes the same cuts.
    """

    zero_point: float = -0.017
    length_scale: float = 1350.0
    metallicity: float = 0.0
    log_age: float = 9.7
    ruwe_max: float = math.inf
    ipd_frac_multi_peak_max: float = math.inf

    def __post_init__(self) -> None:
        ranges = {
            "zero_point": (-1.0, 1.0),
            "length_scale": (10.0, 1e5),
            "metallicity": (-3.0, 1.0),
            "log_age": (6.0, 10.3),
            "ruwe_max": (0.0, math.inf),
            "ipd_frac_multi_peak_max": (0.0, math.inf),
        }
        for entry in fields(self):
            (low, high), value = ranges[entry.name], getattr(self, entry.name)
            if not low <= value <= high:
                raise InputError(f"must be in [{low:g}, {high:g}]", key=f"options, {entry.name}", value=value)


def distance_from_parallax(parallax: FloatArray, error: FloatArray, length_scale: float) -> FloatArray:
    r"""Most probable distance of stars whose density falls off exponentially with distance.

    Parameters
    ----------
    parallax : (n,) float array
        In mas, its zero point corrected; may be negative.
    error : (n,) float array
        Standard error of the parallax, in mas, positive.
    length_scale : float
        L of the prior, in pc.

    Returns
    -------
    distance : (n,) float array
        In pc: near 1/parallax for small errors, towards 2 L for large ones.

    Notes
    -----
    The prior :math:`P(r) \propto r^2 e^{-r/L}` and a Gaussian likelihood have their mode at a root of

    .. math:: \frac{r^3}{L} - 2 r^2 + \frac{\varpi}{\sigma^2} r - \frac{1}{\sigma^2} = 0

    (Bailer-Jones 2015, Eq. 19): the smallest positive one, should there be three.  All lie between
    :math:`1/\varpi` and 2 L, or beyond 2 L where :math:`\varpi < 1/2L`.

    References
    ----------
    BailerJones2015
    """
    scale = length_scale / 1000.0  # kpc, the unit of 1/mas
    weight = 1.0 / error**2

    def cubic(r: FloatArray) -> FloatArray:
        """The left side, negative at 0; r in kpc."""
        value: FloatArray = r * r * (r / scale - 2.0) + (parallax * r - 1.0) * weight
        return value

    inverse = np.where(parallax > 0, 1.0 / np.where(parallax > 0, parallax, 1.0), np.inf)
    near = inverse < 2.0 * scale
    low = np.where(near, inverse, 2.0 * scale)
    behind = np.sqrt(4.0 * scale * weight * np.maximum(-parallax, 0.0))
    beyond = np.maximum(np.maximum(4.0 * scale, behind), np.cbrt(4.0 * scale * weight))
    high = np.where(near, 2.0 * scale, beyond)
    discriminant = 4.0 - 3.0 * parallax * weight / scale  # between its extrema the cubic falls
    root = np.sqrt(np.maximum(discriminant, 0.0))
    top, bottom = (2.0 - root) * scale / 3.0, (2.0 + root) * scale / 3.0
    three = near & (discriminant > 0)
    first = three & (top > low) & (cubic(np.maximum(top, low)) >= 0)
    high = np.where(first, top, high)
    low = np.where(three & ~first, np.clip(bottom, low, high), low)
    r = 0.5 * (low + high)
    for _ in range(200):  # Newton's steps, or halving where one leaves the bracket
        value = cubic(r)
        low, high = np.where(value < 0, r, low), np.where(value < 0, high, r)
        slope = r * (3.0 * r / scale - 4.0) + parallax * weight
        step = r - value / np.where(slope == 0, np.nan, slope)
        new = np.where((step > low) & (step < high), step, 0.5 * (low + high))
        done = np.abs(new - r) <= 1e-12 * r
        r = new
        if np.all(done | ~np.isfinite(r)):
            break
    distance: FloatArray = 1000.0 * r
    return distance


def mass_from_magnitude(absolute: FloatArray, metallicity: float, log_age: float) -> FloatArray:
    """Mass of main-sequence stars from their absolute magnitude in Gaia's G.

    Parameters
    ----------
    absolute : (n,) float array
        Absolute magnitude, in mag (Vega-like).
    metallicity, log_age : float
        Of all the stars, in dex and log10 yr.

    Returns
    -------
    mass : (n,) float array
        In M_sun; 0 for stars fainter than one of 0.08 M_sun, infinite for stars brighter than one of 1.5.

    Notes
    -----
    The relation of `porrima.photometry.MainSequence`, inverted; a mass that has left the main sequence at
    that age stands where it left it.  An unresolved companion makes the star brighter by up to 0.75 mag,
    its mass up to a fifth too large.
    """
    mass = np.geomspace(*_MASS_RANGE, 600)
    same = np.ones(mass.size)
    tracks = MainSequence().tracks(mass, metallicity * same, log_age * same, BAND)
    g = np.minimum.accumulate(magnitudes(tracks, mass[:, None])[:, 0])
    found: FloatArray = np.exp(np.interp(-absolute, -g, np.log(mass)))
    found = np.where(absolute > g[0], 0.0, np.where(absolute < g[-1], np.inf, found))
    return found


def sequence_magnitude(bp_rp: FloatArray) -> FloatArray:
    """Absolute G magnitude of the dwarf sequence at a colour.

    Parameters
    ----------
    bp_rp : (n,) float array
        BP - RP, in mag; made for -0.04 (A0) to 4.86 (M8), constant beyond.

    Returns
    -------
    absolute : (n,) float array
        In mag (Vega-like); Gaia DR2's photometry, within 0.02 mag of that of DR3.

    References
    ----------
    Pecaut2013
    """
    absolute: FloatArray = np.interp(bp_rp, _BP_RP, _ABSOLUTE_G)
    return absolute


def read_gaia(file: CatalogFile) -> CatalogRows:
    """Rows of a table with Gaia DR3's columns, each star with a distance and a mass.

    Parameters
    ----------
    file : CatalogFile
        The table; its `columns` may rename any of `QUANTITIES`, its options are those of `GaiaOptions`.

    Returns
    -------
    rows : CatalogRows
        In internal units, magnitudes in gaia_G.

    Raises
    ------
    InputError
        If a column is missing, or a parallax error is not positive: names the row.

    Notes
    -----
    - The distance is the column named for it; or ``r_med_photogeo`` or ``distance_gspphot`` where the table
      has one of them; and else, or in rows where that is empty, `distance_from_parallax`.  Name the column
      ``parallax`` to have all from there.
    - The absolute magnitude takes no extinction into account but that of the column named ``extinction``
      (A_G, such as ``ag_gspphot``; 0 where empty): 0.1 mag neglected cost 1 to 2 % in mass.
    - A star counts as on the main sequence from 1.5 mag above the dwarf sequence of its colour (an equal
      pair, rich in metals) to 4 mag below it (subdwarfs; white dwarfs are some 8 mag below).  Giants,
      white dwarfs and stars with a quite wrong parallax are left out and counted.
    - The mass is that of one star of the Sun's metallicity and 5 Gyr (both are options) with that magnitude.
      Stars that the analytic Galaxy draws at l = 180, b = 45, G = 16 to 20 mag, with parallaxes good to
      10 %, come back with masses 13 % too large (median; 68 % of them 2 to 25 % too large), for they are
      poorer in metals: at [M/H] = -0.4 it is 2 % (-11 to 13 %), which is the better value for faint stars
      off the plane.  The errors of the parallaxes add little to that down to G = 19.

    References
    ----------
    Gaia2023, Lindegren2021, BailerJones2015, Astraatmadja2016
    """
    options: GaiaOptions = parsed_options(file.options, GaiaOptions)
    if file.band not in (None, BAND):
        rule = f"must be {BAND}, the band of Gaia's magnitudes"
        raise InputError(rule, source=file.path, key="band", value=file.band)
    names = _names(file)
    loaded = load_columns(file, [*names.values(), *_DISTANCES])
    columns = _columns(file, names, loaded)
    n = loaded.row.size
    nothing = np.full(n, np.nan)
    g, colour = columns["phot_g_mean_mag"], columns["bp_rp"]
    given = columns.get("distance", nothing)
    measured = _distances(file, names, columns, loaded.row, options)
    distance = np.where(np.isnan(given), measured, given)
    extinction = columns.get("extinction", nothing)
    modulus = 5.0 * np.log10(distance) - 5.0
    absolute = g - modulus - np.where(np.isnan(extinction), 0.0, extinction)
    mass = mass_from_magnitude(absolute, options.metallicity, options.log_age)
    excess = absolute - sequence_magnitude(colour)
    rejected = {
        **_cuts(columns, options),
        "no magnitude": np.isnan(g),
        "no colour": np.isnan(colour),
        "no distance": np.isnan(distance),
        f"more than {_BRIGHTER} mag above the main sequence": excess < -_BRIGHTER,
        f"more than {_FAINTER} mag below the main sequence": excess > _FAINTER,
        f"brighter than {_MASS_RANGE[1]} M_sun": mass == np.inf,
        f"fainter than {_MASS_RANGE[0]} M_sun": mass == 0,
    }
    every = np.ones(n, dtype=bool)
    meta = {str(key).lower(): value for key, value in loaded.table.meta.items()}
    return CatalogRows(
        row=loaded.row,
        names={
            "mass": names["phot_g_mean_mag"],
            "metallicity": "",
            "log_age": "",
            "distance": names["distance"],
        },
        values={
            "mass": mass,
            "distance": distance,
            "magnitude": g,
            "metallicity": np.full(n, options.metallicity),
            "log_age": np.full(n, options.log_age),
        },
        component=np.full(n, "unknown"),
        band=BAND,
        area=table_area(file.path, meta),
        source=str(meta.get("source") or f"{file.path.name} (Gaia)"),
        assumed={
            "distance from the parallax and a prior": np.isnan(given),
            "extinction neglected": np.isnan(extinction),
            f"mass from G at [M/H] {options.metallicity:g} and log_age {options.log_age:g}": every,
        },
        rejected=rejected,
    )


def _names(file: CatalogFile) -> dict[str, str]:
    """Column of each quantity: the one given, or the archive's own name."""
    unknown = next((name for name in file.columns if name not in QUANTITIES), None)
    if unknown is not None:
        raise InputError(f"must be one of {', '.join(QUANTITIES)}", key="columns", value=unknown)
    return {quantity: file.columns.get(quantity, quantity) for quantity in QUANTITIES}


def _columns(file: CatalogFile, names: dict[str, str], loaded: LoadedTable) -> dict[str, FloatArray]:
    """The columns that the table has, by quantity; ``distance`` may be one of the archive's."""
    if "distance" not in file.columns:
        own = next((name for name in _DISTANCES if name in loaded.names), None)
        names["distance"] = own or _FROM_PARALLAX
    needed = {"phot_g_mean_mag", "bp_rp", *file.columns}
    if names["distance"] == _FROM_PARALLAX:
        needed |= {"parallax", "parallax_error"}
        needed.discard("distance")
    columns = {}
    for quantity, unit in QUANTITIES.items():
        name = names[quantity]
        if quantity == "distance" and name == _FROM_PARALLAX:
            continue
        if name in loaded.names:
            columns[quantity] = column_values(file.path, loaded.table[name], name, unit, loaded.row)
        elif quantity in needed:
            rule = f"must be in the table, for {quantity}; it has {', '.join(loaded.names[:30])}"
            raise InputError(rule, source=file.path, column=name)
    if not loaded.row.size:
        raise InputError("must have rows below its header", source=file.path)
    return columns


def _distances(
    file: CatalogFile,
    names: dict[str, str],
    columns: dict[str, FloatArray],
    row: IntArray,
    options: GaiaOptions,
) -> FloatArray:
    """Distances in pc from the parallaxes, NaN where there is none."""
    if "parallax" not in columns or "parallax_error" not in columns:
        return np.full(row.size, np.nan)
    parallax, error = columns["parallax"], columns["parallax_error"]
    bad = ~np.isnan(parallax) & ~(np.isfinite(error) & (error > 0))
    refuse(file.path, row, names["parallax_error"], error, bad, "must be positive and finite")
    rule = "must be from -1000 to 1000 mas (is it in mas?)"
    refuse(file.path, row, names["parallax"], parallax, np.abs(parallax) > 1000.0, rule)
    distance = np.full(row.size, np.nan)
    known = ~np.isnan(parallax)
    corrected = parallax[known] - options.zero_point
    distance[known] = distance_from_parallax(corrected, error[known], options.length_scale)
    return distance


def _cuts(columns: dict[str, FloatArray], options: GaiaOptions) -> dict[str, BoolArray]:
    """Rows that the cuts in quality leave out; none where there is no cut."""
    cuts = {}
    for name, limit, sign in (
        ("ruwe", options.ruwe_max, "of {} or more"),
        ("ipd_frac_multi_peak", options.ipd_frac_multi_peak_max, "above {}"),
    ):
        if math.isinf(limit):
            continue
        if name not in columns:
            raise InputError(
                "needs its column, which the table lacks", key=f"options, {name}_max", value=limit
            )
        fine = columns[name] < limit if name == "ruwe" else columns[name] <= limit
        cuts[f"{name} {sign.format(f'{limit:g}')}"] = ~fine
    return cuts


def fetch_cone(l: float, b: float, radius: float, magnitude: tuple[float, float], path: Path) -> None:
    """A file with the sources of Gaia DR3 in a circle on the sky, as the archive at ESA has them.

    Parameters
    ----------
    l, b : float
        Galactic longitude and latitude of its centre, in deg.
    radius : float
        Its radius, in deg, up to 10.
    magnitude : (float, float)
        Half-open range [lo, hi) of G, in mag.
    path : Path
        ECSV file to write, with the solid angle, in deg², in its metadata.

    Returns
    -------
    None
        The result is the file.

    Raises
    ------
    InputError
        If astroquery is not installed, the archive does not answer, or it has no such source.
    """
    if not (math.isfinite(l) and -90 <= b <= 90):
        raise InputError(
            "must be a direction: l any angle, b in [-90, 90] deg", key="gaia", value=f"{l}, {b}"
        )
    if not 0 < radius <= _RADIUS_MAX:
        raise InputError(f"must be positive and no more than {_RADIUS_MAX:g} deg", key="radius", value=radius)
    from astropy.coordinates import SkyCoord  # noqa: PLC0415  (slow to import, needed here only)

    centre = SkyCoord(l, b, unit="deg", frame="galactic").icrs
    query = (
        f"SELECT {', '.join(_FETCHED)} FROM gaiadr3.gaia_source "
        f"WHERE 1 = CONTAINS(POINT('ICRS', ra, dec), "
        f"CIRCLE('ICRS', {centre.ra.deg:.8f}, {centre.dec.deg:.8f}, {radius:.8f})) "
        f"AND phot_g_mean_mag >= {magnitude[0]:g} AND phot_g_mean_mag < {magnitude[1]:g}"
    )
    table = _answer(query)
    if len(table) == 0:
        raise InputError("has no source in that circle and range of magnitudes", source="the Gaia archive")
    if len(table) >= _ROWS_MAX:
        rule = f"ends its answer at {_ROWS_MAX} sources: take a smaller circle or range of magnitudes"
        raise InputError(rule, source="the Gaia archive")
    table.meta = {
        "source": f"Gaia DR3, {radius:g} deg around l = {l:g}, b = {b:g}",
        "area_deg2": 2.0 * math.pi * (1.0 - math.cos(math.radians(radius))) * math.degrees(1.0) ** 2,
        "query": query,
    }
    write_table(table, path)


def _answer(query: str) -> Any:
    """Table that the archive answers a query with."""
    try:
        with contextlib.redirect_stdout(sys.stderr):  # it greets on standard output
            from astroquery.gaia import Gaia  # noqa: PLC0415  (an extra)
    except ImportError:
        rule = "needs the package astroquery, which is not installed: install porrima[gaia]"
        raise InputError(rule, key="gaia") from None
    try:
        with contextlib.redirect_stdout(sys.stderr):
            return Gaia.launch_job_async(query).get_results()
    except Exception as error:  # whatever its layers raise: no network, a refused query, a broken answer
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        raise InputError("must answer", source="the Gaia archive", value=reason) from error
