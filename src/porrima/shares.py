"""One quantity, or one range of magnitude, beside what a survey requires of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from porrima.prediction import QUANTITIES

if TYPE_CHECKING:
    from porrima.uncertainty import Uncertainty

__all__ = ["GROUPS", "VERDICTS", "Interval", "MagnitudeBin", "Share", "stars_needed"]

GROUPS = {"psf": QUANTITIES, "fit": ("m", "c1", "c2"), "moments": ("m", "c1", "c2")}
"""What is measured, by who measures it: shape of the PSF; shear by a method that fits, or that subtracts moments."""

VERDICTS = ("within", "uses all", "exceeds")
"""Whole interval of the total below the requirement; the requirement in it, or an end unknown; whole interval above."""


class Interval(NamedTuple):
    """A number with the ends of the interval in which it is known."""

    value: float
    low: float
    high: float

    @property
    def size(self) -> Interval:
        """The same without its sign."""
        ends = sorted((abs(self.low), abs(self.high)))
        return Interval(abs(self.value), 0.0 if self.low < 0 < self.high else ends[0], ends[1])

    def over(self, unit: float) -> Interval:
        """In another unit.

        Parameters
        ----------
        unit : float
            In the unit of the interval, positive.

        Returns
        -------
        interval : Interval
            Dimensionless.
        """
        return Interval(self.value / unit, self.low / unit, self.high / unit)


@dataclass(frozen=True, slots=True, kw_only=True)
class Share:
    """One quantity beside what is required of it; all dimensionless, r2 over the size of the PSF.

    Parameters
    ----------
    group, quantity : str
        A key and a value of `GROUPS`.
    required : float or None
        Largest error allowed; None where the survey states none.
    bias : Interval
        Mean over patches, signed.
    scatter : Interval
        Standard deviation between patches.
    total : Interval
        Both in quadrature.
    n_stars : Interval
        Fewest stars for which the total meets the requirement; infinite where the bias alone exceeds it, NaN where
        nothing is required (count).
    """

    group: str
    quantity: str
    required: float | None
    bias: Interval
    scatter: Interval
    total: Interval
    n_stars: Interval

    @property
    def share(self) -> Interval | None:
        """Total over the requirement, dimensionless; None where nothing is required."""
        return None if self.required is None else self.total.over(self.required)

    @property
    def verdict(self) -> str | None:
        """One of `VERDICTS`; None where nothing is required."""
        share = self.share
        if share is None:
            return None
        return VERDICTS[
            int(not share.high <= 1) + int(share.low > 1)
        ]  # an end that is not known may be anywhere


@dataclass(frozen=True, slots=True, kw_only=True)
class MagnitudeBin:
    """Budget of the stars of one range of magnitude.

    Parameters
    ----------
    magnitude : (float, float)
        Half-open range, in mag.
    n_catalog_stars : int
        Stars over which averages are taken (count).
    uncertainty : Uncertainty
        The prediction with its interval.
    shares : tuple of Share
        One for each quantity of each group.
    widest_cut : dict
        Widest cut with which all quantities of a group meet their requirements, in arcsec, sought up to twice the
        given one or to where the series in kernel moments ends; NaN where there is none, and with a selection.
    """

    magnitude: tuple[float, float]
    n_catalog_stars: int
    uncertainty: Uncertainty
    shares: tuple[Share, ...]
    widest_cut: dict[str, float]

    def required(self, group: str) -> list[Share]:
        """Shares of a group of which something is required.

        Parameters
        ----------
        group : str
            A key of `GROUPS`.

        Returns
        -------
        shares : list of Share
            There may be none.
        """
        return [s for s in self.shares if s.group == group and s.required is not None]

    def worst(self, group: str) -> Share:
        """The share that takes most of its requirement.

        Parameters
        ----------
        group : str
            A key of `GROUPS` of which something is required.

        Returns
        -------
        share : Share
            Dimensionless.
        """
        return max(self.required(group), key=lambda s: s.total.value / (s.required or math.inf))

    def verdict(self, group: str) -> str:
        """The most severe verdict on a group.

        Parameters
        ----------
        group : str
            A key of `GROUPS` of which something is required.

        Returns
        -------
        verdict : str
            One of `VERDICTS`.
        """
        return max((s.verdict or VERDICTS[0] for s in self.required(group)), key=VERDICTS.index)

    def n_stars(self, group: str) -> float:
        """Fewest stars for which a whole group meets its requirements.

        Parameters
        ----------
        group : str
            A key of `GROUPS` of which something is required.

        Returns
        -------
        n_stars : float
            Infinite where a bias alone exceeds its requirement (count).
        """
        return max(s.n_stars.value for s in self.required(group))


def stars_needed(bias: float, spread: float, required: float) -> float:
    """Fewest stars whose rms error meets a requirement.

    Parameters
    ----------
    bias : float
        What more stars do not lower, dimensionless.
    spread : float
        Scatter times the root of the number of stars, dimensionless.
    required : float
        Largest rms error, dimensionless.

    Returns
    -------
    n_stars : float
        At least 1; infinite where the bias alone exceeds the requirement, NaN where a number is (count).
    """
    room = required**2 - bias**2
    if math.isnan(room) or math.isnan(spread):
        return math.nan
    return float(max(1, math.ceil(spread**2 / room))) if room > 0 else math.inf
