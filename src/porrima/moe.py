"""Two papers of Moe: periods, mass ratios and eccentricities together, and close pairs against metallicity."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.special import ndtr

from porrima.companions import CompanionLaw, RowErrors, check_option, warn_of_masses
from porrima.eccentricity import Eccentricity, eccentric

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.orbits import Projection

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = ["METALLICITY", "Metallicity", "MetallicityTrend", "MoeDiStefano2017", "apply_metallicity"]

_NARROW = 0.5  # dex: width and distance of the classes that a wide one is made of
_REACH = 3.3  # standard deviations that they span
_CELLS = 16  # classes of period
_PERIODS = (0.15, 8.0)  # range of log10 of the period in days
_PARTS = 8  # points of each cell over which the frequency is averaged
_BROKEN, _TWIN = 0.3, 0.95  # mass ratios at which the power law changes, and from which twins are
_MEAN_MASS_RATIO = (0.2, 0.6, 0.975)  # of the three classes of mass ratio, for Kepler's law


@dataclass(frozen=True, slots=True, kw_only=True)
class Metallicity:
    r"""The fraction of close pairs against metallicity, after Moe, Kratter & Badenes (2019).

    Parameters
    ----------
    iron : tuple of float
        [Fe/H], in dex.
    close_fraction : tuple of float
        Fraction of solar-type stars with a companion within 10 au, in [0, 1], with the errors 0.12, 0.06, 0.04, 0.03.
    mass_range : (float, float)
        Masses for which it was measured, in M_sun.
    field : float
        [Fe/H] of the field stars that tables of multiplicity hold for, in dex.
    widest : float
        Semi-major axis of the pairs that it counts, in au.

    Notes
    -----
    Linear between the four values.  The published table is for field stars; close pairs are more frequent by
    :math:`F(Z)/F(field)`.  Wide pairs do not depend on metallicity (beyond some 200 au, by El-Badry & Rix 2019).
    [M/H] is taken for [Fe/H], which is 0.2 dex too high for the old, alpha-enhanced stars: their close pairs come out
    too few by 10 %.

    References
    ----------
    Moe2019
    """

    iron: tuple[float, ...] = (-3.0, -1.0, -0.2, 0.5)
    close_fraction: tuple[float, ...] = (0.53, 0.40, 0.24, 0.10)
    mass_range: tuple[float, float] = (0.6, 1.5)
    field: float = -0.2
    widest: float = 10.0

    def factor(self, metallicity: FloatArray) -> FloatArray:
        """How many times more frequent close pairs are than among field stars.

        Parameters
        ----------
        metallicity : (n,) float array
            [Fe/H], in dex; beyond the values of the paper, that of the last.

        Returns
        -------
        factor : (n,) float array
            Dimensionless.
        """
        fraction = np.interp(metallicity, self.iron, self.close_fraction)
        return np.asarray(fraction / np.interp(self.field, self.iron, self.close_fraction))

    def applied(self, law: CompanionLaw, mass: FloatArray, metallicity: FloatArray) -> CompanionLaw:
        r"""The law of companions with as many close pairs as stars of a metallicity have.

        Parameters
        ----------
        law : CompanionLaw
            Of field stars; its classes have semi-major axes.
        mass, metallicity : (n,) float array
            Of the stars, in M_sun and dex.

        Returns
        -------
        law : CompanionLaw
            Of these stars: other multiplicity fractions, other shares of the classes.

        Notes
        -----
        Classes of the stars to which the relation applies are made of narrow ones, see `narrowed`; each of these
        is multiplied by :math:`1 + (F/F_{field} - 1)\,\Phi` with its own part :math:`\Phi` within 10 au.
        """
        measured = (mass >= self.mass_range[0]) & (mass <= self.mass_range[1])
        law = narrowed(law, measured[law.star])
        star = law.star
        within = ndtr((np.log10(self.widest) - law.log_a) / law.log_a_sigma)
        more = np.where(measured, self.factor(metallicity) - 1.0, 0.0)[star]
        share = law.share * (1.0 + more * within)
        total = np.bincount(star, share)[star]
        fraction = np.asarray(np.round(np.minimum(law.multiplicity_fraction * total, 1.0), 3), dtype=float)
        return replace(law, share=share / total, multiplicity_fraction=fraction)


def narrowed(law: CompanionLaw, chosen: NDArray[np.bool_]) -> CompanionLaw:
    r"""The same law with chosen classes made of narrow ones, 0.5 dex wide and 0.5 dex apart.

    Parameters
    ----------
    law : CompanionLaw
        With full log-normals.
    chosen : (m,) bool array
        Whether a class is to be divided, which it is if it is wider than 0.6 dex (dimensionless).

    Returns
    -------
    law : CompanionLaw
        The chosen classes become several, in log10 au.

    Notes
    -----
    A normal density of variance :math:`s^2` is that of :math:`s^2 - h^2` in steps of h, each smoothed by h, but for
    ripples of :math:`2 \exp(-2\pi^2 (1 - h^2/s^2))`.
    """
    wide = chosen & (law.log_a_sigma > 1.2 * _NARROW)
    spread = np.sqrt(np.maximum(law.log_a_sigma**2 - _NARROW**2, 0.0))
    half = np.where(wide, np.ceil(_REACH * spread / _NARROW), 0).astype(np.int64)
    of = np.repeat(np.arange(law.star.size), 2 * half + 1)
    first = np.repeat(np.cumsum(2 * half + 1) - (2 * half + 1), 2 * half + 1)
    step = _NARROW * (np.arange(of.size) - first - half[of])
    weight = np.where(
        wide[of],
        np.exp(-0.5 * np.divide(step, spread[of], out=np.zeros_like(step), where=wide[of]) ** 2),
        1.0,
    )
    weight /= np.bincount(of, weight)[of]
    out = law.take(of)
    return replace(
        out,
        share=out.share * weight,
        log_a=out.log_a + step,
        log_a_sigma=np.where(wide[of], _NARROW, out.log_a_sigma),
    )


METALLICITY = {"none": None, "moe19": Metallicity()}
"""Relations of close pairs with metallicity by name."""

MetallicityTrend = Literal["none", "moe19"]
"""Their names."""


def apply_metallicity(
    law: CompanionLaw, mass: FloatArray, metallicity: FloatArray | None, name: MetallicityTrend
) -> CompanionLaw:
    """The law with as many close pairs as stars of a metallicity have by a named relation.

    Parameters
    ----------
    law : CompanionLaw
        Of field stars.
    mass : (n,) float array
        In M_sun.
    metallicity : (n,) float array or None
        [M/H], in dex; None for field stars, whose law does not change.
    name : {"none", "moe19"}
        The relation.

    Returns
    -------
    law : CompanionLaw
        Axes in log10 au.
    """
    relation = METALLICITY[name]
    if relation is None:
        return law
    return relation.applied(
        law, mass, np.full(mass.shape, relation.field) if metallicity is None else metallicity
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class MoeDiStefano2017:
    r"""Periods, mass ratios with twins and eccentricities of main-sequence pairs by Moe & Di Stefano (2017).

    Parameters
    ----------
    eccentricity : {"mds17", "circular", "uniform", "thermal"}
        Of the orbits; the paper's own by default.
    metallicity : {"none", "moe19"}
        Whether close pairs depend on metallicity.

    Raises
    ------
    ValueError
        If an option is outside its range.

    Notes
    -----
    For primaries of 0.8 to 40 M_sun; lighter ones take the values at 0.8.  Companions with q > 0.3 per dex of period:
    see `frequency`; their mass ratios follow :math:`q^{-1/2}`, steeper by 0.3 per dex beyond log P = 5, with an
    excess of twins above 0.95, see `twin_fraction`; those of 0.1 to 0.3 follow :math:`q^{0.3}` and join them.  These
    exponents are those for 0.8 to 1.2 M_sun and are taken up to 1.5 M_sun.

    Sixteen classes of period, log-normals as wide as they are apart, stand for the piecewise linear density: kinks
    are smoothed by 0.5 dex of the period; times three classes of mass ratio.  Pairs only: the frequencies count all
    companions, of which a star with more than one has one here.  The multiplicity fraction is 0.40 +- 0.04 at 1 and
    0.59 +- 0.08 at 3.5 M_sun (Table 13 by one secondary source [?]), linear in log mass between.  Errors of exponents
    are the paper's for solar-type stars; it gives none for a shift and a stretch of all periods, 0.1 and 0.1 dex are
    assumed.

    References
    ----------
    MoeDiStefano2017, Moe2019
    """

    eccentricity: Eccentricity = "mds17"
    metallicity: MetallicityTrend = "none"

    def __post_init__(self) -> None:
        check_option("eccentricity", self.eccentricity, Eccentricity)
        check_option("metallicity", self.metallicity, MetallicityTrend)

    @property
    def mass_range(self) -> tuple[float, float]:
        """Least and largest mass of a primary, in M_sun."""
        return (0.8, 40.0)

    @property
    def projection(self) -> Projection:
        """Isotropic orbits."""
        return "isotropic"

    @property
    def row_errors(self) -> tuple[RowErrors, ...]:
        """Errors, the same at all masses."""
        return (RowErrors.of(0.04, 0.3, 0.1, 0.1),)

    @property
    def choices(self) -> dict[str, Any]:
        """Orbits as circles, or as the paper has them."""
        return {"eccentricity": "circular" if self.eccentricity != "circular" else "mds17"}

    def rows(self, mass: FloatArray) -> IntArray:
        """Row of the table that each primary takes: there is one.

        Parameters
        ----------
        mass : (n,) float array
            In M_sun.

        Returns
        -------
        row : (n,) int array
            0.
        """
        return np.zeros(mass.shape, np.int64)

    def frequency(self, mass: FloatArray, period: FloatArray) -> FloatArray:
        """Companions with q > 0.3 per primary and dex of period.

        Parameters
        ----------
        mass : (n,) float array
            In M_sun.
        period : (k,) float array
            log10 of the period in days.

        Returns
        -------
        frequency : (n, k) float array
            Per dex; 0 outside 0.15 to 8.

        Notes
        -----
        Equations 20 to 23: constant to log P = 1, linear to 2, slope 0.018 to 3.4, linear to 5.5, exponential beyond.
        """
        log_mass = np.log10(mass)[:, None]
        shortest = 0.020 + 0.04 * log_mass + 0.07 * log_mass**2
        middle = 0.039 + 0.07 * log_mass + 0.01 * log_mass**2
        widest = 0.078 - 0.05 * log_mass + 0.04 * log_mass**2
        low, high = middle - 0.018 * 0.7, middle + 0.018 * 0.7
        rising = shortest + (period - 1.0) * (low - shortest)
        plateau = middle + 0.018 * (period - 2.7)
        falling = high + (period - 3.4) / 2.1 * (widest - high)
        tail = widest * np.exp(-0.3 * (period - 5.5))
        inside = (period >= _PERIODS[0]) & (period <= _PERIODS[1])
        parts = [shortest + 0.0 * period, rising, plateau, falling, tail]
        cases = [period <= 1.0, period <= 2.0, period <= 3.4, period <= 5.5, period > 5.5]
        return np.where(inside, np.select([np.broadcast_to(c, parts[0].shape) for c in cases], parts), 0.0)

    def twin_fraction(self, mass: FloatArray, period: FloatArray) -> FloatArray:
        """Share of twins beyond the power law among companions with q > 0.3.

        Parameters
        ----------
        mass : (n,) float array
            In M_sun.
        period : (k,) float array
            log10 of the period in days.

        Returns
        -------
        fraction : (n, k) float array
            In [0, 1]: 0.3 - 0.15 log10 mass to log P = 1, then falling to 0 at 8 - mass (Eqs. 5 to 7).
        """
        most, last = (0.3 - 0.15 * np.log10(mass))[:, None], (8.0 - mass)[:, None]
        fallen = (np.maximum(period, 1.0) - 1.0) / (last - 1.0)
        return most * np.clip(1.0 - fallen, 0.0, 1.0)

    def counts(self, mass: FloatArray) -> FloatArray:
        """Companions per primary in each class of mass ratio and period.

        Parameters
        ----------
        mass : (n,) float array
            In M_sun, within `mass_range`.

        Returns
        -------
        counts : (n, 3, n_period) float array
            q of 0.1 to 0.3, 0.3 to 1, and twins (count per star).
        """
        edges, (middle, exponent) = np.linspace(*_PERIODS, _CELLS + 1), _classes()
        fine = edges[:-1, None] + np.diff(edges)[:, None] * (np.arange(_PARTS) + 0.5) / _PARTS
        large = self.frequency(mass, fine.ravel()).reshape(mass.size, _CELLS, _PARTS).mean(axis=2)
        large = large * np.diff(edges)
        twins = self.twin_fraction(mass, middle)
        g = exponent + 1.0
        at_break = (
            g * _BROKEN**exponent / (1.0 - _BROKEN**g)
        )  # density of the power law, of integral 1, at q = 0.3
        below = _BROKEN / 1.3 * (1.0 - (0.1 / _BROKEN) ** 1.3)  # integral of (q/0.3)^0.3 from 0.1 to 0.3
        return np.stack(
            [large * (1.0 - twins) * at_break * below, large * (1.0 - twins), large * twins], axis=1
        )

    def companions(self, mass: FloatArray, metallicity: FloatArray | None = None) -> CompanionLaw:
        """Companion statistics of each primary.

        Parameters
        ----------
        mass : (n,) float array
            Mass of the primary, in M_sun.
        metallicity : (n,) float array, optional
            [M/H], in dex; that of field stars where not given.

        Returns
        -------
        law : CompanionLaw
            Three classes of mass ratio times sixteen of period: axes in log10 au, scatter in dex.

        Warns
        -----
        MassRangeWarning
            If stars lie outside `mass_range`: they take its end.
        """
        warn_of_masses(mass, self.mass_range, "mds17")
        counts = self.counts(np.clip(mass, *self.mass_range))
        share = counts / counts.sum(axis=(1, 2), keepdims=True)
        middle, exponent = _classes()
        flat = np.zeros(_CELLS)
        total = 1.0 + np.array(_MEAN_MASS_RATIO)
        log_a = (2.0 * (middle - np.log10(365.25)) + np.log10(total)[:, None]) / 3.0
        one = {
            "mass_ratio_exponent": [flat + 0.3, exponent, flat],
            "mass_ratio_min": [flat + 0.1, flat + _BROKEN, flat + _TWIN],
            "mass_ratio_max": [flat + _BROKEN, flat + 1.0, flat + 1.0],
        }
        classes = {name: np.tile(np.concatenate(values), mass.size) for name, values in one.items()}
        fraction = np.interp(np.log10(np.clip(mass, 1.0, 3.5)), np.log10([1.0, 3.5]), [0.40, 0.59])
        star = np.repeat(np.arange(mass.size), 3 * _CELLS)
        law = CompanionLaw(
            star=star,
            share=share.ravel(),
            multiplicity_fraction=np.round(fraction, 3)[star],
            log_a=(log_a.ravel() + np.log10(mass)[:, None] / 3.0).ravel(),
            log_a_sigma=np.full(star.size, 2.0 / 3.0 * (_PERIODS[1] - _PERIODS[0]) / _CELLS),
            log_a_max=np.full(star.size, np.inf),
            mass_ratio=np.full(star.size, np.nan),
            **classes,
        )
        law = law.take(np.flatnonzero(law.share > 0))
        return eccentric(apply_metallicity(law, mass, metallicity, self.metallicity), mass, self.eccentricity)


def _classes() -> tuple[FloatArray, FloatArray]:
    """log10 of the period [days] in the middle of each class, and exponent of mass ratios above 0.3 there."""
    edges = np.linspace(*_PERIODS, _CELLS + 1)
    middle = 0.5 * (edges[:-1] + edges[1:])
    return middle, -0.5 - 0.3 * np.maximum(middle - 5.0, 0.0)
