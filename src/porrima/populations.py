"""The components of the Galaxy: density laws, ages, initial mass function, metallicity, magnitudes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from porrima.dust import R_SUN, Z_SUN, Place, young_disc
from porrima.photometry import MainSequence, magnitudes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["COMPONENTS", "LOG_MASS", "METALLICITY", "Component", "MagnitudeTable", "magnitude_table"]

DISC_END = 14.0  # kpc
_HIGH_SLOPE = 3.0  # of the initial mass functions above 1 M_sun
N_AGE = 4  # equal parts of a component's range of age
_MASSES = ((0.08, 0.1, 9), (0.1, 0.3, 43), (0.3, 0.5, 20), (0.5, 0.7, 13), (0.7, 1.0, 14), (1.0, 1.5, 16))
LOG_MASS = np.log10(np.append(np.concatenate([np.geomspace(a, b, n + 1)[:-1] for a, b, n in _MASSES]), 1.5))
"""Edges of the cells of mass: log10 of M_sun; every IMF, and the rows of multiplicity tables, end at one."""

METALLICITY = np.linspace(-2.0, 0.3, 47)
"""Nodes of the magnitude tables in [M/H], dex; those of the photometry are among them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Component:
    r"""One component of the Galaxy.

    Parameters
    ----------
    name : str
        One of `porrima.stars.COMPONENTS`.
    age : (float, float)
        Range of ages in Gyr, all as frequent (constant star formation); one age where both are equal.
    rho0 : float
        Mass density of its living stars at the Sun, in M_sun per pc³.
    iron, scatter : float
        Mean [Fe/H] at the Sun's radius and its standard deviation, in dex.
    alpha : float
        Enhancement [alpha/Fe], in dex.
    gradient : float
        Of the mean [Fe/H] with radius, in dex per kpc.
    flattening : float
        Axis ratio :math:`\epsilon` of its surfaces of equal density, dimensionless; 0 in the thick disc.
    slope : float
        Of the initial mass function below 1 M_sun, :math:`dN/dm \propto m^{-s}`; 3 above (dimensionless).
    low_mass : float
        Mass below which the slope is `low_slope`, in M_sun.
    low_slope : float
        Dimensionless.

    Notes
    -----
    Robin et al. (2003) give one slope below 1 M_sun.  Two catalogues of their model hold fewer stars of low
    mass than it makes: counted in volumes that are complete, where no colour or magnitude enters, half as
    many at 0.09-0.12 M_sun in the thin disc and 0.55 times as many at 0.12-0.2 M_sun in the thick disc.  The
    slopes below `low_mass` are what fits those counts: 1.3 below 0.5 M_sun in the thin disc (also that of the
    stars nearby), -0.2 below 0.3 M_sun in thick disc and halo; each with some 0.1 of error.

    References
    ----------
    Robin2003, Salaris1993
    """

    name: str
    age: tuple[float, float]
    rho0: float
    iron: float
    scatter: float
    alpha: float = 0.0
    gradient: float = 0.0
    flattening: float = 0.0
    slope: float = 0.5
    low_mass: float = 0.3
    low_slope: float = -0.2

    @property
    def metallicity(self) -> float:
        r"""Mean [M/H] at the Sun's radius in dex: [Fe/H] + log10(0.638 :math:`10^{[\alpha/Fe]}` + 0.362)."""
        return self.iron + float(np.log10(0.638 * 10.0**self.alpha + 0.362))

    def relative_density(self, place: Place, warp: bool) -> FloatArray:
        r"""Density over that at the Sun.

        Parameters
        ----------
        place : Place
            Where, in kpc and rad.
        warp : bool
            Whether the disc is warped and flared.

        Returns
        -------
        density : (n,) float array
            Dimensionless.

        Notes
        -----
        With :math:`a^2 = R^2 + z^2/\epsilon^2`: the youngest disc :math:`e^{-(a/5)^2} - e^{-(a/3)^2}`; the
        others :math:`e^{-\sqrt{1/4 + (a/2.53)^2}} - e^{-\sqrt{1/4 + (a/1.32)^2}}`, all to R = 14 kpc; the
        thick disc :math:`e^{-R/2.5}` times a parabola in z up to 0.4 kpc and an exponential of 0.8 kpc
        beyond; the halo :math:`\max(a, 0.5)^{-2.44}` (kpc).

        References
        ----------
        Robin2003
        """
        height = place.without_warp() if warp and self.name != "halo" else place.height
        density: FloatArray = self._law(place.radius, height) / self._law(np.array(R_SUN), np.array(Z_SUN))
        return density

    def _law(self, radius: FloatArray, height: FloatArray) -> FloatArray:
        if self.name == "thick":
            h, x = 0.8, 0.4
            z = np.abs(height)
            vertical = np.where(z <= x, 1 - z**2 / (x * (2 * h + x)), np.exp((x - z) / h) / (1 + x / (2 * h)))
            thick: FloatArray = np.exp(-radius / 2.5) * vertical
            return thick
        if self.name == "thin1":
            disc = young_disc(radius, height, self.flattening, 5.0, 3.0)
            return np.where(radius < DISC_END, disc, 0.0)
        a = np.hypot(radius, height / self.flattening)
        if self.name == "halo":
            halo: FloatArray = np.maximum(a, 0.5) ** -2.44
            return halo
        disc = np.exp(-np.sqrt(0.25 + (a / 2.530) ** 2)) - np.exp(-np.sqrt(0.25 + (a / 1.320) ** 2))
        return np.where(radius < DISC_END, disc, 0.0)

    def slopes(self, mass: FloatArray) -> FloatArray:
        """Slope of the initial mass function at some masses.

        Parameters
        ----------
        mass : (n,) float array
            In M_sun; at a break, the slope above it.

        Returns
        -------
        slope : (n,) float array
            Dimensionless.
        """
        slope: FloatArray = np.where(mass < self.low_mass, self.low_slope, self.slope)
        return np.where(mass < 1.0, slope, _HIGH_SLOPE)

    def number_density(self) -> FloatArray:
        r"""Stars born with the masses of each cell of `LOG_MASS`, in the density of the Sun's place.

        Returns
        -------
        number : (n_mass,) float array
            Stars per pc³, whether or not they still live.

        Notes
        -----
        :math:`\rho_0 = \int m\, \xi(m)\, dm` from 0.08 M_sun up to the largest mass alive: the end of the
        main sequence at the mean age and metallicity or, where that lies beyond the photometry, the mass
        with a life of 10 Gyr :math:`m^{-2.5}`.
        """
        age = float(np.mean(self.age))
        alive = float(main_sequence_end(np.array([self.metallicity]), np.array([np.log10(age) + 9.0]))[0])
        if alive >= MainSequence().mass_range[1]:
            alive = (10.0 / age) ** 0.4
        mass = 10**LOG_MASS
        total = float(np.sum(self._born(np.append(mass[mass < alive], alive), 1.0)))
        number: FloatArray = self._born(mass, 0.0) * (self.rho0 / total)
        return number

    def _born(self, mass: FloatArray, power: float) -> FloatArray:
        """Integral of m^power times the mass function, which is 1 at 1 M_sun, between successive masses."""
        below = _power_law(np.minimum(mass, self.low_mass), self.low_slope - power)
        between = _power_law(np.clip(mass, self.low_mass, 1.0), self.slope - power)
        above = _power_law(np.maximum(mass, 1.0), _HIGH_SLOPE - power)
        born: FloatArray = below * self.low_mass ** (self.low_slope - self.slope) + between + above
        return born


def main_sequence_end(metallicity: FloatArray, log_age: FloatArray) -> FloatArray:
    """Largest mass on the main sequence.

    Parameters
    ----------
    metallicity : (n,) float array
        [M/H], in dex.
    log_age : (n,) float array
        log10 of the age in yr.

    Returns
    -------
    mass : (n,) float array
        In M_sun, at most that of the photometry.

    Notes
    -----
    The photometry's table ends at the last of its masses before the largest temperature; its masses are
    0.05 M_sun apart, so the turn-off lies half a step, 0.025 M_sun, beyond on average.
    """
    end = MainSequence().turn_off_mass(metallicity, log_age) + 0.025
    mass: FloatArray = np.minimum(end, MainSequence().mass_range[1])
    return mass


def _power_law(edges: FloatArray, slope: float) -> FloatArray:
    """Integral of m^-slope between successive edges; the slope is not 1."""
    integral: FloatArray = np.diff(edges ** (1.0 - slope)) / (1.0 - slope)
    return integral


def _thin(
    k: int, age: tuple[float, float], rho0: float, flattening: float, iron: float, scatter: float
) -> Component:
    return Component(
        name=f"thin{k}",
        age=age,
        rho0=rho0,
        flattening=flattening,
        iron=iron,
        scatter=scatter,
        gradient=-0.07,
        slope=1.6,
        low_mass=0.5,
        low_slope=1.3,
    )


COMPONENTS = (
    _thin(1, (0.0, 0.15), 0.003999, 0.0140, 0.01, 0.12),
    _thin(2, (0.15, 1.0), 0.007902, 0.0268, 0.03, 0.12),
    _thin(3, (1.0, 2.0), 0.006224, 0.0375, 0.03, 0.10),
    _thin(4, (2.0, 3.0), 0.004020, 0.0551, 0.01, 0.11),
    _thin(5, (3.0, 5.0), 0.005814, 0.0696, -0.07, 0.18),
    _thin(6, (5.0, 7.0), 0.004928, 0.0785, -0.14, 0.17),
    _thin(7, (7.0, 10.0), 0.006590, 0.0791, -0.37, 0.20),
    Component(name="thick", age=(11.0, 11.0), rho0=0.00134, iron=-0.78, scatter=0.30, alpha=0.3),
    Component(
        name="halo", age=(13.0, 13.0), rho0=9.32e-6, iron=-1.78, scatter=0.50, alpha=0.3, flattening=0.76
    ),
)
"""The Besançon model of 2003 without its bulge.

The densities of thick disc and halo have one weak source; the number densities for M_V < 8 that follow agree
with the model's own, though its two catalogues hold 7, 15 and 5 % fewer stars of thin disc, thick disc and
halo (tests/validation/test_galaxy_catalogues.py).  The enhancement of the two old components is not in the
published table, which gives [Fe/H]: 0.3 dex is the common value, and the tracks of the model are enhanced too.
The published age of the halo, 14 Gyr, belongs to the model's own tracks, which leave the main sequence at
0.80 M_sun; those of the photometry do so at 0.75 M_sun at that age.  13 Gyr, 0.77 M_sun, is taken for it.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class MagnitudeTable:
    """Absolute magnitudes of a component on a grid, for quadrature and for bounds.

    Parameters
    ----------
    centre : (n_age, n_metallicity, n_mass) float array
        Magnitude at the centres of the cells of age and mass, in mag.
    turn_off : (n_age, n_metallicity) float array
        log10 of the largest mass on the main sequence at those ages, in M_sun.
    faint, bright : (n_metallicity, n_mass + 1) float array
        Magnitude at the edges of the cells of mass at the least and the largest age, in mag.
    last : (n_metallicity,) float array
        log10 of the largest mass on the main sequence at the least age, in M_sun.
    """

    centre: FloatArray
    turn_off: FloatArray
    faint: FloatArray
    bright: FloatArray
    last: FloatArray


@cache
def magnitude_table(component: Component, band: str) -> MagnitudeTable:
    """Absolute magnitudes of a component in one band.

    Parameters
    ----------
    component : Component
        Its ages enter, in Gyr.
    band : str
        One of the bands of `porrima.photometry.MainSequence`.

    Returns
    -------
    table : MagnitudeTable
        In mag, read-only by custom: it is kept for the next call.
    """
    low, high = component.age
    ages = low + (high - low) * (np.arange(N_AGE) + 0.5) / N_AGE
    ends = np.maximum(np.array([low, high]), 1e-3)  # the photometry starts at 1 Gyr and clips below
    log_ages, log_ends = np.log10(ages) + 9.0, np.log10(ends) + 9.0
    edges = np.clip(10**LOG_MASS, 0.08, 1.5)
    centres = 10 ** (0.5 * (LOG_MASS[1:] + LOG_MASS[:-1]))
    at_ends = _grid_magnitudes(log_ends, edges, band)
    return MagnitudeTable(
        centre=_grid_magnitudes(log_ages, centres, band),
        turn_off=np.stack([_log_turn_off(age) for age in log_ages]),
        faint=at_ends[0],
        bright=at_ends[1],
        last=_log_turn_off(log_ends[0]),
    )


def _log_turn_off(log_age: float) -> FloatArray:
    mass = main_sequence_end(METALLICITY, np.full(METALLICITY.size, log_age))
    log_mass: FloatArray = np.log10(mass)
    return log_mass


def _grid_magnitudes(log_age: FloatArray, mass: FloatArray, band: str) -> FloatArray:
    """Magnitudes (n_age, n_metallicity, n_mass)."""
    grid = np.meshgrid(log_age, METALLICITY, mass, indexing="ij")
    age, mh, m = (axis.ravel() for axis in grid)
    values = magnitudes(MainSequence().tracks(m, mh, age, band), m[:, None])
    return values.reshape(grid[0].shape)
