"""Companions of stars as numbers: classes of mass ratios and orbits, and what a model of them must give."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, get_args

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.orbits import Projection

    BoolArray = NDArray[np.bool_]
    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = [
    "CompanionLaw", "MassRangeWarning", "MultiplicityModel", "RowErrors", "check_option", "multiplicity_scale",
    "scale_from", "scales_reached", "warn_of_masses",
]  # fmt: skip


class MassRangeWarning(UserWarning):
    """Some stars have masses for which a model has no figures of its own."""


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
    is_triple : (m,) bool array
        Whether the class is one of which a triple takes two, see `hierarchy`; of pairs where not given.
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
    is_triple: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))

    def __post_init__(self) -> None:
        if self.is_triple.size != self.star.size:
            object.__setattr__(self, "is_triple", np.zeros(self.star.size, np.bool_))

    @property
    def first(self) -> IntArray:
        """First class of each star, (n,)."""
        starts: IntArray = np.flatnonzero(np.diff(self.star, prepend=-1))
        return starts

    @property
    def abundance(self) -> FloatArray:
        """Share of each class among the stars over the mean one, (m,): its weight in averages over stars."""
        return self.share * (self.star.size / self.first.size)

    def take(self, of: IntArray) -> CompanionLaw:
        """Chosen classes; where some are chosen more than once their shares no longer sum to 1.

        Parameters
        ----------
        of : (k,) int array
            Numbers of classes, ascending (dimensionless).

        Returns
        -------
        law : CompanionLaw
            Of k classes.
        """
        return CompanionLaw(**{field.name: getattr(self, field.name)[of] for field in fields(self)})

    def with_given(self, mass_ratio: FloatArray) -> CompanionLaw:
        """The law with the pairs that a catalogue has made: their mass ratios fixed, its single stars single.

        Classes keep their shares, whatever the mass ratio.  A pair is no triple.

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
            is_triple=self.is_triple & np.isnan(mass_ratio),
        )

    def moved(self, figure: str, change: FloatArray) -> CompanionLaw:
        r"""The law with one of its figures moved.

        Parameters
        ----------
        figure : str
            A field of `RowErrors`.
        change : (m,) float array
            Added to the figure of each class: dimensionless, or dex of log10 au or of log10 of the period.

        Returns
        -------
        law : CompanionLaw
            Multiplicity fractions stay in [0, 1].

        Notes
        -----
        A change of the scatter of log P by :math:`\delta` changes that of all orbits of a star by
        :math:`\frac23\delta`: its classes, their means and their widths, are stretched about their common mean.
        """
        if figure == "multiplicity_fraction":
            return replace(self, multiplicity_fraction=np.clip(self.multiplicity_fraction + change, 0.0, 1.0))
        if figure == "mass_ratio_exponent":
            return replace(self, mass_ratio_exponent=self.mass_ratio_exponent + change)
        if figure == "log_a":
            return replace(self, log_a=self.log_a + change, log_a_max=self.log_a_max + change)
        mean = self._mean(self.log_a)
        sigma = np.sqrt(self._mean(self.log_a_sigma**2 + (self.log_a - mean) ** 2))
        stretch = 1.0 + 2.0 / 3.0 * change / sigma
        width = self.log_a_sigma * stretch
        alone = np.bincount(self.star)[self.star] == 1
        return replace(
            self,
            log_a=mean + (self.log_a - mean) * stretch,
            log_a_sigma=np.where(alone | (change == 0), width, np.round(width, 2)),  # few widths, few tables
        )

    def _mean(self, values: FloatArray) -> FloatArray:
        """Mean over the classes of each star, for each class, (m,)."""
        return np.asarray(np.bincount(self.star, self.share * values)[self.star], dtype=float)


class RowErrors(NamedTuple):
    """Errors of one row of a table of multiplicity, one standard deviation down and up."""

    multiplicity_fraction: tuple[float, float]
    mass_ratio_exponent: tuple[float, float]
    log_a: tuple[float, float]  # dex
    sigma_log_period: tuple[float, float]  # dex

    @classmethod
    def of(
        cls, multiplicity_fraction: float, mass_ratio_exponent: float, log_a: float, log_a_sigma: float
    ) -> RowErrors:
        """Errors that are as large down as up.

        Parameters
        ----------
        multiplicity_fraction, mass_ratio_exponent : float
            Dimensionless.
        log_a, log_a_sigma : float
            Of the mean and the scatter of log10 of the semi-major axis, in dex; 3/2 of the latter is that of log P.

        Returns
        -------
        errors : RowErrors
            Down and up.
        """
        sizes = multiplicity_fraction, mass_ratio_exponent, log_a, 1.5 * log_a_sigma
        return cls(*((size, size) for size in sizes))


class MultiplicityModel(Protocol):
    """A published account of stellar multiplicity."""

    @property
    def mass_range(self) -> tuple[float, float]:
        """Least and largest mass of a primary, in M_sun."""

    @property
    def projection(self) -> Projection:
        """How orbits are turned to the line of sight."""

    @property
    def row_errors(self) -> tuple[RowErrors, ...]:
        """Errors of each row of its table."""

    @property
    def choices(self) -> dict[str, Any]:
        """Options that the sources leave open, each with the other value that it may have."""

    def rows(self, mass: FloatArray) -> IntArray:
        """Row of its table that primaries take, mass in M_sun, (n,) float array."""

    def companions(self, mass: FloatArray, metallicity: FloatArray | None = None) -> CompanionLaw:
        """Companions of primaries, (n,) float array: mass in M_sun, [M/H] in dex, the Sun's where not given."""


def check_option(key: str, value: str, names: Any) -> None:
    """Nothing, where an option of a model is one of those there are.

    Parameters
    ----------
    key, value : str
        Name of the option, and what a user gives.
    names : type
        A ``Literal`` of those there are.

    Returns
    -------
    None
        The check has no result.

    Raises
    ------
    ValueError
        If it is another one.
    """
    if value not in get_args(names):
        raise ValueError(f"{key} must be one of {', '.join(get_args(names))}, got {value}")


def warn_of_masses(mass: FloatArray, mass_range: tuple[float, float], name: str) -> None:
    """Nothing, but a warning where stars lie outside the masses that a model has figures for.

    Parameters
    ----------
    mass : (n,) float array
        In M_sun.
    mass_range : (float, float)
        Least and largest mass, in M_sun.
    name : str
        Of the model.

    Returns
    -------
    None
        The result is the warning.

    Warns
    -----
    MassRangeWarning
        With the share of the stars outside.
    """
    low, high = mass_range
    share = float(np.mean((mass < low) | (mass > high))) if mass.size else 0.0
    if share > 0:
        rule = f"outside {low:g} to {high:g} M_sun, the range of {name}, and take its nearest row"
        warnings.warn(f"{share:.1%} of the stars lie {rule}", MassRangeWarning, stacklevel=3)


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
    return scale_from(scales_reached(multiplicity_fraction, abundance), binary_fraction)


def scales_reached(
    multiplicity_fraction: FloatArray, abundance: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Binary fractions between which the factor of `multiplicity_scale` is linear in them.

    Parameters
    ----------
    multiplicity_fraction, abundance : (n,) float array
        As for `multiplicity_scale`.

    Returns
    -------
    binary_fraction, scale : (m,) float array
        Ascending; dimensionless.
    """
    order = np.argsort(multiplicity_fraction, kind="stable")
    ascending = multiplicity_fraction[order]
    number = np.ones_like(ascending) if abundance is None else abundance[order]
    values, first = np.unique(ascending, return_index=True)
    values, first = values[values > 0], first[values > 0]
    sum_below = np.concatenate([[0.0], np.cumsum(number * ascending)])[first]
    number_below = np.concatenate([[0.0], np.cumsum(number)])
    above = number_below[-1] - number_below[first]
    reached = np.concatenate([[0.0], ((sum_below / values + above) / number_below[-1])[::-1]])
    return reached, np.concatenate([[0.0], 1.0 / values[::-1]])


def scale_from(reached: tuple[FloatArray, FloatArray], binary_fraction: FloatArray) -> FloatArray:
    """The factor of `multiplicity_scale` from `scales_reached`.

    Parameters
    ----------
    reached : pair of (m,) float array
        From `scales_reached`.
    binary_fraction : (k,) float array
        Wanted, in [0, 1].

    Returns
    -------
    scale : (k,) float array
        Dimensionless.

    Raises
    ------
    ValueError
        As `multiplicity_scale`.
    """
    wanted = np.asarray(binary_fraction, dtype=float)
    if np.any((wanted < 0) | (wanted > 1) | ~np.isfinite(wanted)):
        raise ValueError(
            f"binary_fraction must be in [0, 1], got {wanted[~((wanted >= 0) & (wanted <= 1))][0]}"
        )
    most = reached[0][-1]
    if np.any(wanted > most * (1 + 1e-12)):
        raise ValueError(f"binary_fraction must be at most {most:.6g} for these stars, got {wanted.max()}")
    scale: FloatArray = np.interp(wanted, *reached)
    return scale
