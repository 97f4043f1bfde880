"""Mass to light: absolute magnitudes of main-sequence stars, and the flux ratio of a pair."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = ["PHOTOMETRY", "HabetsHeintze1981", "MainSequence", "MassLuminosity", "Tracks", "flux_ratio"]

STEP = 0.0025
"""Spacing in log10 mass of the tabulated tracks (dimensionless)."""

_BELOW = {"log_teff": -0.03}
"""Step of a column from 0.09 to 0.08 M_sun where it is not that of magnitudes, 1.73 mag: for the temperature, in dex,
about that from 0.10 to 0.09 M_sun."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracks:
    """Absolute magnitude against mass in one band, on a uniform grid of log10 mass, and each star's place in it.

    A star's relation is the weighted mean of four tracks (two metallicities, two ages).

    Parameters
    ----------
    log_mass_min : float
        log10 of the first mass in M_sun.
    magnitude : (n_grid, n_track) float array
        Absolute magnitude, in mag, at log10 masses `log_mass_min` + `STEP` k.
    dark_below : float
        Mass under which a star gives no light, in M_sun.
    index : (n, 4) int array
        Tracks of each star.
    weight : (n, 4) float array
        Their weights, dimensionless, with sum 1.
    """

    log_mass_min: float
    magnitude: FloatArray
    dark_below: float
    index: IntArray
    weight: FloatArray


class MassLuminosity(Protocol):
    """A published relation between mass and magnitude."""

    @property
    def mass_range(self) -> tuple[float, float]:
        """Least and largest mass of a primary, in M_sun."""

    @property
    def bands(self) -> tuple[str, ...]:
        """Names of the bands it has; empty where the relation serves every band."""

    def tracks(self, mass: FloatArray, metallicity: FloatArray, log_age: FloatArray, band: str) -> Tracks:
        """Tracks of one band with the place in them of (n,) float array stars: M_sun, dex, log10 yr."""


@njit(inline="always")
def magnitude_on_track(grid, log_mass_min, log_mass, i, w):  # type: ignore[no-untyped-def]
    """Absolute magnitude of one mass on the tracks i of a star, of weights w (compiled; as in `Tracks`, unchecked)."""
    position = (log_mass - log_mass_min) * (1.0 / STEP)
    k = min(max(int(position), 0), grid.shape[0] - 2)
    t = position - k
    low = w[0] * grid[k, i[0]] + w[1] * grid[k, i[1]] + w[2] * grid[k, i[2]] + w[3] * grid[k, i[3]]
    k += 1
    high = w[0] * grid[k, i[0]] + w[1] * grid[k, i[1]] + w[2] * grid[k, i[2]] + w[3] * grid[k, i[3]]
    return low + t * (high - low)


@njit(cache=True)
def _magnitudes(grid, log_mass_min, dark_below, index, weight, mass, out):  # type: ignore[no-untyped-def]
    for s in range(mass.shape[0]):
        for k in range(mass.shape[1]):
            out[s, k] = np.inf
            if mass[s, k] >= dark_below:
                out[s, k] = magnitude_on_track(grid, log_mass_min, np.log10(mass[s, k]), index[s], weight[s])


def magnitudes(tracks: Tracks, mass: FloatArray) -> FloatArray:
    """Absolute magnitudes of any masses on the tracks of given stars.

    Parameters
    ----------
    tracks : Tracks
        Tracks that hold the place of n stars.
    mass : (n, k) float array
        Masses to look up on the track of each star, in M_sun.

    Returns
    -------
    magnitude : (n, k) float array
        In mag; infinite for dark stars.
    """
    out = np.empty(mass.shape)
    _magnitudes(
        tracks.magnitude, tracks.log_mass_min, tracks.dark_below, tracks.index, tracks.weight, mass, out
    )
    return out


def flux_ratio(tracks: Tracks, mass: FloatArray, mass_ratio: FloatArray) -> FloatArray:
    r"""Flux of the companion over that of the primary, from their masses.

    Parameters
    ----------
    tracks : Tracks
        Tracks that hold the place of the n primaries.
    mass : (n,) float array
        Mass of the primary, in M_sun.
    mass_ratio : (n, k) float array
        Companion mass over primary mass, in (0, 1].

    Returns
    -------
    flux_ratio : (n, k) float array
        :math:`f = 10^{-0.4 [M(q m) - M(m)]}`, in [0, 1]; 0 for a dark companion.
    """
    primary = magnitudes(tracks, mass[:, None])
    companion = magnitudes(tracks, mass[:, None] * mass_ratio)
    ratio: FloatArray = np.minimum(10.0 ** (-0.4 * (companion - primary)), 1.0)
    return ratio


def check_masses(mass: FloatArray, mass_range: tuple[float, float], name: str) -> None:
    """Nothing, where all masses are within the range of a relation or model.

    Parameters
    ----------
    mass : (n,) float array
        In M_sun.
    mass_range : (float, float)
        Least and largest mass allowed, in M_sun, both inclusive.
    name : str
        Name of the relation, for the message.

    Returns
    -------
    None
        The check has no result.

    Raises
    ------
    ValueError
        If a mass lies outside.
    """
    low, high = mass_range
    outside = (mass < low) | (mass > high)
    if np.any(outside):
        raise ValueError(f"mass must be in [{low}, {high}] M_sun for {name}, got {mass[outside][0]}")


@dataclass(frozen=True, slots=True, kw_only=True)
class HabetsHeintze1981:
    r"""Mass-luminosity relation of Habets & Heintze (1981), the one behind KCM16 Sect. 4.3.

    Parameters
    ----------
    branch : {"own", "primary"}
        Whether each star takes the branch of its own mass, or both stars that of the
        primary, as the authors' code of 2017 does.

    Notes
    -----
    With :math:`l = \log_{10} M`, :math:`M_V = 4.00 - 6.41\,l` for :math:`l > 0.13`,
    :math:`4.80 - 12.47\,l` for :math:`-0.62 < l \le 0.13` and :math:`9.02 - 5.61\,l` below,
    extrapolated to any lower mass [coefficients from one secondary source].  The flux ratio
    is the same in every band (flat spectrum), no star is dark, and [M/H] and age do not enter.
    Against `MainSequence` it is too bright by 0.5 to 1 mag at 0.4-0.6 M_sun and too flat below 0.24.

    References
    ----------
    Habets1981, KCM16
    """

    branch: Literal["own", "primary"] = "own"

    @property
    def mass_range(self) -> tuple[float, float]:
        """Least and largest mass of a primary, in M_sun."""
        return (0.03, 10.0)

    @property
    def bands(self) -> tuple[str, ...]:
        """Empty: one relation for every band."""
        return ()

    def tracks(self, mass: FloatArray, metallicity: FloatArray, log_age: FloatArray, band: str) -> Tracks:
        """Tracks of the relation and the place in them of each star.

        Parameters
        ----------
        mass : (n,) float array
            In M_sun.
        metallicity, log_age : (n,) float array
            Not used; dex and log10 yr.
        band : str
            Not used: the flux ratio is the same in all.

        Returns
        -------
        tracks : Tracks
            Track 0 is the relation; 1 to 3 prolong each of its branches to all masses.

        Raises
        ------
        ValueError
            If a mass lies outside `mass_range`.
        """
        check_masses(mass, self.mass_range, "habets-heintze")
        log_mass_min = -3.0
        grid = log_mass_min + STEP * np.arange(1 + round(4.0 / STEP))
        branches = np.stack([4.00 - 6.41 * grid, 4.80 - 12.47 * grid, 9.02 - 5.61 * grid], axis=1)
        own = np.where(grid > 0.13, branches[:, 0], np.where(grid > -0.62, branches[:, 1], branches[:, 2]))
        index = np.zeros((mass.size, 4), dtype=np.int64)
        if self.branch == "primary":
            log_mass = np.log10(mass)
            index[:] = np.where(log_mass > 0.13, 1, np.where(log_mass > -0.62, 2, 3))[:, None]
        return Tracks(
            log_mass_min=log_mass_min,
            magnitude=np.ascontiguousarray(np.column_stack([own, branches])),
            dark_below=0.0,
            index=index,
            weight=np.tile([1.0, 0.0, 0.0, 0.0], (mass.size, 1)),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class MainSequence:
    """Main-sequence magnitudes of the PARSEC isochrones against mass, metallicity and age.

    Notes
    -----
    The table shipped with Porrima holds, for six metallicities [M/H] (-2 to +0.3) and three ages
    (log10 9.0, 9.8, 10.2 yr), absolute magnitudes from 0.09 M_sun to the turn-off.  Between its nodes
    magnitudes are linear in log10 mass, [M/H] and age (the brightening is, nearly); beyond its ends [M/H]
    and age are clipped.

    - A star that its catalogue calls a main-sequence star is not older than the turn-off of its mass
      and metallicity: its age is lowered to that.  Above a track's last mass the track goes on straight.
    - At 0.08 M_sun every track is 1.73 mag fainter than at 0.09 M_sun, the step of the Besançon model's
      own thin disc in i, taken for all bands.  A companion below 0.08 M_sun is dark.
    - [M/H] = +0.3 starts at 0.10 M_sun: its step to 0.09 is that of the solar track.  The track of
      [M/H] = -1, log10 age 9.8 stops at 0.5 M_sun in the table and is continued by the mean of its two
      neighbours in metallicity, joined without a step.

    References
    ----------
    Bressan2012, Robin2003
    """

    @property
    def mass_range(self) -> tuple[float, float]:
        """Least and largest mass of a primary, in M_sun."""
        return (0.08, 1.5)

    @property
    def bands(self) -> tuple[str, ...]:
        """Names of the bands: g, r, i, z, euclid_VIS (AB), gaia_G and roman_F... (Vega-like)."""
        return tuple(name for name in _photometry_table() if name not in _NOT_BANDS)

    def tracks(self, mass: FloatArray, metallicity: FloatArray, log_age: FloatArray, band: str) -> Tracks:
        """Tracks of one band and the place in them of each star.

        Parameters
        ----------
        mass : (n,) float array
            In M_sun.
        metallicity : (n,) float array
            [M/H], in dex.
        log_age : (n,) float array
            log10 of the age in yr.
        band : str
            One of `bands`.

        Returns
        -------
        tracks : Tracks
            Eighteen tracks, metallicity by age.

        Raises
        ------
        ValueError
            If the band is unknown or a mass lies outside `mass_range`.
        """
        if band not in self.bands:
            raise ValueError(f"band must be one of {', '.join(self.bands)}, got {band}")
        return self._tracks(mass, metallicity, log_age, band)

    def temperature_tracks(self, mass: FloatArray, metallicity: FloatArray, log_age: FloatArray) -> Tracks:
        """Tracks of the effective temperature and the place in them of each star.

        Parameters
        ----------
        mass : (n,) float array
            In M_sun.
        metallicity : (n,) float array
            [M/H], in dex.
        log_age : (n,) float array
            log10 of the age in yr.

        Returns
        -------
        tracks : Tracks
            As `tracks`, with log10 of the temperature in K for `magnitude`.

        Raises
        ------
        ValueError
            If a mass lies outside `mass_range`.
        """
        return self._tracks(mass, metallicity, log_age, "log_teff")

    def _tracks(self, mass: FloatArray, metallicity: FloatArray, log_age: FloatArray, column: str) -> Tracks:
        """Tracks of one column of the table."""
        check_masses(mass, self.mass_range, "main-sequence")
        grid, turn_off, mh, age = _main_sequence_grid(column)
        j, wj = _bracket(mh, metallicity)
        turn_off_star = (1 - wj)[:, None] * turn_off[j] + wj[:, None] * turn_off[j + 1]
        k, wk = _bracket(10.0**age, 10.0 ** np.minimum(log_age, _oldest(turn_off_star, age, mass)))
        first = j * age.size + k
        return Tracks(
            log_mass_min=float(np.log10(self.mass_range[0])),
            magnitude=grid,
            dark_below=self.mass_range[0],
            index=np.stack([first, first + 1, first + age.size, first + age.size + 1], axis=1),
            weight=np.stack([(1 - wj) * (1 - wk), (1 - wj) * wk, wj * (1 - wk), wj * wk], axis=1),
        )

    def turn_off_mass(self, metallicity: FloatArray, log_age: FloatArray) -> FloatArray:
        """Largest mass still on the main sequence.

        Parameters
        ----------
        metallicity : (n,) float array
            [M/H], in dex.
        log_age : (n,) float array
            log10 of the age in yr.

        Returns
        -------
        mass : (n,) float array
            In M_sun, at most the upper end of `mass_range`, linear in [M/H] and log10 age.
        """
        _, turn_off, mh, age = _main_sequence_grid(self.bands[0])
        (j, wj), (k, wk) = _bracket(mh, metallicity), _bracket(age, log_age)
        young = (1 - wj) * turn_off[j, k] + wj * turn_off[j + 1, k]
        old = (1 - wj) * turn_off[j, k + 1] + wj * turn_off[j + 1, k + 1]
        mass: FloatArray = (1 - wk) * young + wk * old
        return mass


_NOT_BANDS = ("mh", "log_age", "mass", "log_teff")

PHOTOMETRY: dict[str, MassLuminosity] = {
    "main-sequence": MainSequence(),
    "habets-heintze": HabetsHeintze1981(),
}


def _bracket(nodes: FloatArray, value: FloatArray) -> tuple[IntArray, FloatArray]:
    """Lower node of each value, and the weight of the upper one; values are clipped to the nodes."""
    clipped = np.clip(value, nodes[0], nodes[-1])
    low = np.clip(np.searchsorted(nodes, clipped, side="right") - 1, 0, nodes.size - 2).astype(np.int64)
    return low, (clipped - nodes[low]) / (nodes[low + 1] - nodes[low])


def _oldest(turn_off: FloatArray, age: FloatArray, mass: FloatArray) -> FloatArray:
    """log10 age at which each mass reaches the turn-off; turn_off is (n, n_age), falling with age."""
    oldest = np.full(mass.shape, age[-1])
    for k in range(age.size - 1):
        young, old = turn_off[:, k], turn_off[:, k + 1]
        t = np.clip((young - mass) / (young - old), 0.0, 1.0)
        oldest = np.where(mass > old, np.minimum(oldest, age[k] + t * (age[k + 1] - age[k])), oldest)
    return oldest


@cache
def _photometry_table() -> dict[str, FloatArray]:
    """Columns of the shipped table."""
    from astropy.table import Table  # noqa: PLC0415  (slow to import, read once)

    path = files("porrima") / "data" / "main_sequence_photometry.ecsv"
    table = Table.read(str(path), format="ascii.ecsv")
    return {name: np.asarray(table[name], dtype=float) for name in table.colnames}


@cache
def _main_sequence_grid(band: str) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Magnitudes (n_grid, n_mh n_age), turn-off masses (n_mh, n_age), metallicities and log10 ages."""
    columns = _photometry_table()
    mh, age = np.unique(columns["mh"]), np.unique(columns["log_age"])
    raw = {}
    for z in mh:
        for t in age:
            rows = (columns["mh"] == z) & (columns["log_age"] == t)
            raw[z, t] = (columns["mass"][rows], columns[band][rows])
    raw[-1.0, 9.8] = _continued(raw[-1.0, 9.8], raw[-1.5, 9.8], raw[-0.5, 9.8])
    solar = raw[0.0, age[0]][1]
    n_grid = 1 + round(np.log10(1.5 / 0.08) / STEP + 0.5)
    log_mass = np.log10(0.08) + STEP * np.arange(n_grid)
    grid = np.empty((n_grid, mh.size * age.size))
    turn_off = np.empty((mh.size, age.size))
    for j, z in enumerate(mh):
        for k, t in enumerate(age):
            mass, magnitude = raw[z, t]
            turn_off[j, k] = mass[-1]
            if mass[0] > 0.095:
                mass = np.concatenate([[0.09], mass])
                magnitude = np.concatenate([[magnitude[0] + solar[0] - solar[1]], magnitude])
            mass = np.concatenate([[0.08], mass])
            magnitude = np.concatenate([[magnitude[0] + _BELOW.get(band, 1.73)], magnitude])
            x = np.log10(mass)
            slope = (magnitude[-1] - magnitude[-2]) / (x[-1] - x[-2])
            beyond = magnitude[-1] + slope * (log_mass - x[-1])
            grid[:, j * age.size + k] = np.where(log_mass <= x[-1], np.interp(log_mass, x, magnitude), beyond)
    return grid, turn_off, mh, age


def _continued(
    track: tuple[FloatArray, FloatArray],
    left: tuple[FloatArray, FloatArray],
    right: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """The track, continued above its last mass by the mean of two others, without a step."""
    mass, magnitude = track
    more = np.intersect1d(left[0], right[0])
    more = more[more >= mass[-1]]
    mean = 0.5 * (np.interp(more, *left) + np.interp(more, *right))
    shifted = mean + (magnitude[-1] - mean[0])
    return np.concatenate([mass, more[1:]]), np.concatenate([magnitude, shifted[1:]])
