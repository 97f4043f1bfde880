"""How many stars have a companion, how massive it is, how wide its orbit: one object per published model."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol

import numpy as np

from porrima.photometry import check_masses

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.orbits import Projection

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = ["MULTIPLICITY", "CompanionLaw", "DucheneKraus2013", "MultiplicityModel", "multiplicity_scale"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CompanionLaw:
    r"""Statistics of the companions of n stars: m classes of them, at least one for each star.

    A class is a power law of the mass ratio with a log-normal of the semi-major axis.  A star that has a companion
    has one of a class of its own with the probability `share`, so that classes make a mixture.

    Parameters
    ----------
    star : (m,) int array
        Number of the star of each class, from 0 to n - 1, ascending.
    share : (m,) float array
        Of the class among the companions of its star, in [0, 1]; the shares of a star sum to 1.
    multiplicity_fraction : (m,) float array
        Probability that the star has a companion, in [0, 1]; the same in all its classes.
    mass_ratio_exponent : (m,) float array
        :math:`\gamma` of :math:`dN/dq \propto q^\gamma`, dimensionless.
    mass_ratio_min, mass_ratio_max : (m,) float array
        Range of the mass ratio, in (0, 1].
    log_a : (m,) float array
        Mean of log10 of the semi-major axis in au, before any truncation.
    log_a_sigma : (m,) float array
        Its standard deviation, in dex.
    log_a_max : (m,) float array
        log10 of the largest semi-major axis in au; infinite where there is none.
    mass_ratio : (m,) float array
        The mass ratio itself where a catalogue gives it, in (0, 1]; NaN where it is drawn.
    """

    star: IntArray
    share: FloatArray
    multiplicity_fraction: FloatArray
    mass_ratio_exponent: FloatArray
    mass_ratio_min: FloatArray
    mass_ratio_max: FloatArray
    log_a: FloatArray
    log_a_sigma: FloatArray
    log_a_max: FloatArray
    mass_ratio: FloatArray

    @property
    def first(self) -> IntArray:
        """First class of each star, (n,)."""
        starts: IntArray = np.flatnonzero(np.diff(self.star, prepend=-1))
        return starts

    @property
    def abundance(self) -> FloatArray:
        """Share of each class among the stars over the mean one, (m,): its weight in averages over stars."""
        return self.share * (self.star.size / self.first.size)

    def with_given(self, mass_ratio: FloatArray) -> CompanionLaw:
        """The law with the pairs that a catalogue has made: their mass ratios fixed, its single stars single.

        Classes keep their shares, whatever the mass ratio.

        Parameters
        ----------
        mass_ratio : (n,) float array
            In [0, 1], 0 for a single star, NaN where the law decides.

        Returns
        -------
        law : CompanionLaw
            Orbits as before, in log10 au.
        """
        mass_ratio = mass_ratio[self.star]
        return replace(
            self,
            multiplicity_fraction=np.where(
                np.isnan(mass_ratio), self.multiplicity_fraction, (mass_ratio > 0).astype(float)
            ),
            mass_ratio=np.where(mass_ratio > 0, mass_ratio, np.nan),
        )


class MultiplicityModel(Protocol):
    """A published account of stellar multiplicity."""

    @property
    def mass_range(self) -> tuple[float, float]:
        """Least and largest mass of a primary, in M_sun."""

    @property
    def projection(self) -> Projection:
        """How orbits are turned to the line of sight."""

    def companions(self, mass: FloatArray) -> CompanionLaw:
        """Companion statistics of primaries, mass in M_sun, (n,) float array."""


class _Row(NamedTuple):
    """One row of KCM16 Table 1."""

    mass_lo: float  # M_sun, inclusive
    mass_hi: float  # M_sun, exclusive
    multiplicity_fraction: float
    mass_ratio_exponent: float
    a_mean: float  # au
    sigma_log_period: float  # dex in days


_VERY_LOW = _Row(0.0, 0.1, 0.22, 4.2, 4.5, 0.5)
_LOW = _Row(0.1, 0.5, 0.26, 0.4, 5.3, 1.3)
_SOLAR = _Row(0.7, 1.3, 0.44, 0.3, 45.0, 2.3)


@dataclass(frozen=True, slots=True, kw_only=True)
class DucheneKraus2013:
    r"""Multiplicity of main-sequence stars as compiled by Duchene & Kraus (2013), KCM16 Table 1.

    Parameters
    ----------
    gap_rule : {"lower", "solar"}
        What the masses between the rows take (0.5-0.7 and 1.3-1.5 M_sun): the next lower row, as KCM16
        Sect. 4.3 says, or the row of solar-type stars, as the authors' code of 2017 does.
    a_max_factor : float, optional
        Largest semi-major axis over the mean :math:`\bar a`; None for the full log-normal.
    scatter_scale : float
        Factor on the scatter of log period, dimensionless.  The code of 2017 amounts to 1/(ln 10)^2.
    projection : {"isotropic", "inclination-uniform"}
        Isotropic orbits, or KCM16's literal text (inclination uniform in angle), which raises eta by 2-5 %,
        and by up to 12 % where orbits are truncated.
    mass_ratio_min : float
        Least mass ratio, in (0, 1).

    Raises
    ------
    ValueError
        If an option is outside its range.

    Notes
    -----
    Rows are half-open, [lo, hi); a star of exactly 1.5 M_sun, the largest that KCM16 keep, takes the
    values of the row below.  The mass ratio follows :math:`dN/dq \propto q^\gamma` on
    [mass_ratio_min, 1].  log10 of the period is normal with :math:`\sigma_{\log P}`, so by Kepler's third
    law log10 of the semi-major axis is normal about :math:`\log_{10}\bar a` with
    :math:`\frac{2}{3}\sigma_{\log P}`, independent of the mass ratio.  A truncation redraws the
    semi-major axis alone.  Pairs only: higher orders are left out, which is optimistic.

    References
    ----------
    DucheneKraus2013, KCM16
    """

    gap_rule: Literal["lower", "solar"] = "lower"
    a_max_factor: float | None = None
    scatter_scale: float = 1.0
    projection: Projection = "isotropic"
    mass_ratio_min: float = 0.1

    def __post_init__(self) -> None:
        if self.gap_rule not in ("lower", "solar"):
            raise ValueError(f"gap_rule must be lower or solar, got {self.gap_rule}")
        if self.projection not in ("isotropic", "inclination-uniform"):
            raise ValueError(f"projection must be isotropic or inclination-uniform, got {self.projection}")
        if self.a_max_factor is not None and not (0 < self.a_max_factor < math.inf):
            raise ValueError(f"a_max_factor must be positive and finite, got {self.a_max_factor}")
        if not 0 < self.scatter_scale < math.inf:
            raise ValueError(f"scatter_scale must be positive and finite, got {self.scatter_scale}")
        if not 0 < self.mass_ratio_min < 1:
            raise ValueError(f"mass_ratio_min must be in (0, 1), got {self.mass_ratio_min}")

    @property
    def mass_range(self) -> tuple[float, float]:
        """Least and largest mass of a primary, in M_sun; KCM16 give no widths above 1.5."""
        return (0.0, 1.5)

    def rows(self, mass: FloatArray) -> NDArray[np.int64]:
        """Row of the table that each primary takes, the masses between rows by the gap rule.

        Parameters
        ----------
        mass : (n,) float array
            Mass of the primary, in M_sun.

        Returns
        -------
        row : (n,) int array
            0 below 0.1 M_sun, 1 for 0.1-0.5, 2 for solar-type stars.
        """
        solar_from = _SOLAR.mass_lo if self.gap_rule == "lower" else _LOW.mass_hi
        return np.where(mass < _VERY_LOW.mass_hi, 0, np.where(mass < solar_from, 1, 2))

    def companions(self, mass: FloatArray) -> CompanionLaw:
        r"""Companion statistics of each primary.

        Parameters
        ----------
        mass : (n,) float array
            Mass of the primary, in M_sun.

        Returns
        -------
        law : CompanionLaw
            Arrays of n stars: axes in log10 au, scatter in dex.

        Raises
        ------
        ValueError
            If a mass lies outside `mass_range`.
        """
        check_masses(mass, self.mass_range, "Duchene & Kraus (2013)")
        table = np.array([_VERY_LOW, _LOW, _SOLAR])[self.rows(mass)]
        log_a = np.log10(table[:, 4])
        beyond = math.inf if self.a_max_factor is None else math.log10(self.a_max_factor)
        return CompanionLaw(
            star=np.arange(mass.size),
            share=np.ones(mass.shape),
            multiplicity_fraction=table[:, 2],
            mass_ratio_exponent=table[:, 3],
            mass_ratio_min=np.full(mass.shape, self.mass_ratio_min),
            mass_ratio_max=np.ones(mass.shape),
            log_a=log_a,
            log_a_sigma=2.0 / 3.0 * self.scatter_scale * table[:, 5],
            log_a_max=log_a + beyond,
            mass_ratio=np.full(mass.shape, np.nan),
        )


MULTIPLICITY: dict[str, DucheneKraus2013] = {
    "dk13": DucheneKraus2013(),
    "dk13-kcm16": DucheneKraus2013(gap_rule="solar", a_max_factor=2.5),
}
"""Models by name; ``dk13-kcm16`` is the variant that reproduces the magnitude dependence of KCM16."""


def multiplicity_scale(
    multiplicity_fraction: FloatArray, binary_fraction: FloatArray, abundance: FloatArray | None = None
) -> FloatArray:
    r"""Factor s that scales every star's multiplicity fraction so that a population has a binary fraction F.

    Parameters
    ----------
    multiplicity_fraction : (n,) float array
        Of each star as the model gives it, in [0, 1].
    binary_fraction : (k,) float array
        Wanted mean over the stars, in [0, 1].
    abundance : (n,) float array, optional
        Weight of each star in that mean, of mean 1 (dimensionless); all alike where not given.

    Returns
    -------
    scale : (k,) float array
        Dimensionless.

    Raises
    ------
    ValueError
        If a binary fraction lies outside [0, 1] or beyond what stars with any companions can give.

    Notes
    -----
    Solves :math:`\frac{1}{n} \sum_i \min(1, s\, MF_i) = F` exactly: the left side is linear in s between
    the values :math:`1/MF_i`.  The capping at 1 changes the population at large F (KCM16 Sect. 5.1).

    References
    ----------
    KCM16
    """
    wanted = np.asarray(binary_fraction, dtype=float)
    if np.any((wanted < 0) | (wanted > 1) | ~np.isfinite(wanted)):
        raise ValueError(
            f"binary_fraction must be in [0, 1], got {wanted[~((wanted >= 0) & (wanted <= 1))][0]}"
        )
    order = np.argsort(multiplicity_fraction, kind="stable")
    ascending = multiplicity_fraction[order]
    number = np.ones_like(ascending) if abundance is None else abundance[order]
    values, first = np.unique(ascending, return_index=True)
    values, first = values[values > 0], first[values > 0]
    sum_below = np.concatenate([[0.0], np.cumsum(number * ascending)])[first]
    number_below = np.concatenate([[0.0], np.cumsum(number)])
    above = number_below[-1] - number_below[first]
    reached = np.concatenate([[0.0], ((sum_below / values + above) / number_below[-1])[::-1]])
    if np.any(wanted > reached[-1] * (1 + 1e-12)):
        raise ValueError(
            f"binary_fraction must be at most {reached[-1]:.6g} for these stars, got {wanted.max()}"
        )
    scale: FloatArray = np.interp(wanted, reached, np.concatenate([[0.0], 1.0 / values[::-1]]))
    return scale
