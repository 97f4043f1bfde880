r"""What unresolved binaries take of a survey's requirements: shares, verdicts, stars needed, and what would help.

Each requirement is set against the rms error of what a PSF of N stars gives, :math:`\sqrt{bias^2 + sd^2}` (KCM16,
Eq. 10): the PSF's own shape, and m and c of the shear that is measured with it by a fit or by moments.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from porrima.averages import population_moments
from porrima.companions import MassRangeWarning
from porrima.errors import InputError
from porrima.integrals import PairIntegrals, integrate, separation_moments
from porrima.prediction import MANY_STARS, SeriesWarning, predict
from porrima.shares import GROUPS, Interval, MagnitudeBin, Share, stars_needed
from porrima.shear import deconvolution_bias, moments_bias
from porrima.systems import Population
from porrima.uncertainty import NAMES, uncertainty

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from porrima.companions import MultiplicityModel
    from porrima.galaxies import Galaxies
    from porrima.instruments import Requirement
    from porrima.photometry import MassLuminosity
    from porrima.prediction import Prediction
    from porrima.response import Response
    from porrima.selection import Selection
    from porrima.shear import ShearResponse
    from porrima.stars import Stars
    from porrima.uncertainty import Uncertainty

    FloatArray = NDArray[np.float64]

__all__ = ["CUTS", "Budget", "Premises", "budget"]

FEW_STARS = 40
"""Number of stars below which the scatter does not quite fall with the root of their number (count)."""

CUTS = (0.04, 0.06, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.15, 1.3, 1.5, 1.75, 2.0)
"""Where a cut that would do is sought, over the one given (dimensionless)."""

MOST_STARS = 400
"""Stars of a bin on which other cuts are tried, evenly through those given (count)."""

_ROUNDS = 8  # at most, until the number of stars no longer moves


@dataclass(frozen=True, slots=True, kw_only=True)
class Premises:
    """What a budget is made for.

    Parameters
    ----------
    requirement : Requirement
        What must be met.
    response : Response
        Of PSF and estimator.
    n_stars : int
        Stars from which the PSF of a patch is made (count).
    multiplicity : MultiplicityModel
        Companions of stars.
    photometry : MassLuminosity
        Mass to light.
    cut : float
        Separation from which pairs are resolved, in arcsec.
    binary_fraction : float, optional
        Before resolved pairs leave, in [0, 1]; None for the model's own.
    fit : ShearResponse, optional
        Of a method that fits galaxies with the stacked PSF.
    seen : Galaxies, optional
        Sizes as a method sees them that subtracts moments of the PSF by the same estimator.
    selection : Selection, optional
        What else the survey rejects; other cuts are then not tried.
    """

    requirement: Requirement
    response: Response
    n_stars: int
    multiplicity: MultiplicityModel
    photometry: MassLuminosity
    cut: float
    binary_fraction: float | None = None
    fit: ShearResponse | None = None
    seen: Galaxies | None = None
    selection: Selection | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """Budgets of several ranges of magnitude.

    Parameters
    ----------
    premises : Premises
        What they are made for.
    bins : tuple of MagnitudeBin
        In order.
    """

    premises: Premises
    bins: tuple[MagnitudeBin, ...]

    @property
    def groups(self) -> list[str]:
        """Groups of which something is required and known."""
        return [group for group in GROUPS if self.bins[0].required(group)]

    def ranges(self, group: str) -> list[tuple[float, float]]:
        """Ranges of magnitude that meet all requirements on a group.

        Parameters
        ----------
        group : str
            A key of `GROUPS` of which something is required.

        Returns
        -------
        ranges : list of (float, float)
            Half-open, neighbouring bins joined, in mag.
        """
        out: list[tuple[float, float]] = []
        for one in self.bins:
            if any(s.total.value > (s.required or math.inf) for s in one.required(group)):
                continue
            low, high = one.magnitude
            if out and out[-1][1] == low:
                low = out.pop()[0]
            out.append((low, high))
        return out


def budget(premises: Premises, bins: Sequence[tuple[tuple[float, float], Stars]]) -> Budget:
    r"""Share of each requirement that unresolved binaries use, by magnitude.

    Parameters
    ----------
    premises : Premises
        Requirement, PSF, stars in a patch, companions, galaxies.
    bins : sequence of ((float, float), Stars)
        Half-open ranges in mag, with the stars in them.

    Returns
    -------
    budget : Budget
        Dimensionless.

    Raises
    ------
    InputError
        As `uncertainty.uncertainty`, or if the cut is too wide for kernel moments of the PSF: with the order at which
        the expansion stops being good.
    ValueError
        If the number of stars is less than 1.

    Warns
    -----
    SeriesWarning
        As `prediction.predict`.

    Notes
    -----
    The total is the rms error :math:`\sqrt{bias^2 + sd^2}` of one patch: between patches the scatter averages out,
    the bias does not.  Intervals of e1, e2 and r2 are those of `uncertainty`; of m and c they follow in proportion,
    the bias from that of eta (``fit``) or of r2 (``moments``), the scatter of m from that of r2 and of c from that of
    e1.  The number of stars is :math:`N\,sd^2/(req^2 - bias^2)`, found again star by star below `FEW_STARS`.  For
    other cuts the scatter is that of a long stack, 6 % too large for one star and right from 40 on.

    References
    ----------
    KCM16
    """
    return Budget(premises=premises, bins=tuple(_of_bin(premises, mag, stars) for mag, stars in bins))


def _of_bin(premises: Premises, magnitude: tuple[float, float], stars: Stars) -> MagnitudeBin:
    population = Population.of(
        stars, multiplicity=premises.multiplicity, photometry=premises.photometry, cut=premises.cut,
        selection=premises.selection,
    )  # fmt: skip
    integrals = integrate(population)
    known = uncertainty(
        stars,
        premises.response,
        multiplicity=premises.multiplicity,
        photometry=premises.photometry,
        cut=premises.cut,
        binary_fraction=premises.binary_fraction,
        n_stars=premises.n_stars,
        integrals=integrals,
        selection=premises.selection,
    )
    if np.any(np.isnan(known.prediction.bias)):
        rule = (
            "is too wide for the kernel moments of this PSF, whose expansion stops being good at order "
            f"{known.prediction.last_order[0]}"
        )
        raise InputError(rule, key="cut", value=premises.cut)
    long = predict(known.prediction.population, premises.response, MANY_STARS)
    now, later = _changes(premises, known.prediction), _changes(premises, long)
    shares = tuple(
        _share(premises, known, group, k, now[group][:, k, 0], later[group][:, k, 0])
        for group in now
        for k in range(3)
    )
    return MagnitudeBin(
        magnitude=magnitude,
        n_catalog_stars=len(stars),
        uncertainty=known,
        shares=shares,
        widest_cut=_widest_cuts(premises, stars, population, integrals, shares),
    )


def _changes(premises: Premises, prediction: Prediction) -> dict[str, FloatArray]:
    """Bias and scatter of the quantities of each group, (2, 3, k)."""
    out = {"psf": np.stack([prediction.bias, prediction.sd])}
    found = {}
    if premises.fit is not None:
        found["fit"] = deconvolution_bias(prediction.population, premises.fit, prediction.n_stars)
    if premises.seen is not None:
        covariance = prediction.log_covariance.transpose(2, 0, 1)
        found["moments"] = moments_bias(prediction.bias, covariance, premises.response.shape0, premises.seen)
    for group, shear in found.items():
        out[group] = np.array([[shear.m, shear.c1, shear.c2], [shear.sd_m, shear.sd_c1, shear.sd_c2]])
    return out


def _share(
    premises: Premises, known: Uncertainty, group: str, k: int, now: FloatArray, later: FloatArray
) -> Share:
    """One quantity: bias and scatter (2,) for the stars of a patch, and for many."""
    quantity = GROUPS[group][k]
    if group == "psf":
        bias_from, scatter_from = f"bias_{quantity}", f"sd_{quantity}"
    else:
        bias_from = "eta" if group == "fit" else "bias_r2"
        scatter_from = "sd_r2" if quantity == "m" else "sd_e1"
    bias = _in_proportion(float(now[0]), known, bias_from)
    scatter = _in_proportion(float(now[1]), known, scatter_from).size
    total = Interval(*(math.hypot(b, s) for b, s in zip(bias.size, scatter, strict=True)))
    if group == "psf":
        total = _in_proportion(total.value, known, f"sigma_{quantity}").size
    required = premises.requirement.of(quantity)
    n_stars = Interval(math.nan, math.nan, math.nan)
    if required is not None:
        spread = _in_proportion(float(later[1]) * math.sqrt(MANY_STARS), known, scatter_from).size
        size = _in_proportion(float(later[0]), known, bias_from).size
        n = Interval(*(stars_needed(b, s, required) for b, s in zip(size, spread, strict=True)))
        n_stars = n._replace(value=_refined(premises, known, group, k, n.value, required))
    return Share(
        group=group,
        quantity=quantity,
        required=required,
        bias=bias,
        scatter=scatter,
        total=total,
        n_stars=n_stars,
    )


def _in_proportion(value: float, known: Uncertainty, name: str) -> Interval:
    """Interval of a number that follows a quantity of the prediction."""
    own = float(known.value[NAMES.index(name)])
    if own == 0:
        return Interval(value, value, value)
    ends = sorted(value * end / own for end in known.interval(name))
    return Interval(value, ends[0], ends[1])


def _refined(
    premises: Premises, known: Uncertainty, group: str, k: int, n_stars: float, required: float
) -> float:
    """Number of stars found again with their own prediction, where they are few."""
    if group != "psf" or n_stars >= FEW_STARS:  # m and c fall with the root, of fits exactly
        return n_stars
    for _ in range(_ROUNDS):
        prediction = predict(known.prediction.population, premises.response, int(n_stars))
        bias, scatter = _changes(premises, prediction)[group][:, k, 0].tolist()
        better = stars_needed(bias, scatter * math.sqrt(n_stars), required)
        if better == n_stars or math.isinf(better):
            return better
        n_stars = better
    return n_stars


def _widest_cuts(
    premises: Premises,
    stars: Stars,
    population: Population,
    integrals: PairIntegrals,
    shares: tuple[Share, ...],
) -> dict[str, float]:
    """Widest cut that meets the requirements of each group, between cuts that are tried, linear in logarithms."""
    required = [s for s in shares if s.required is not None]
    if premises.selection is not None:
        return dict.fromkeys((s.group for s in required), math.nan)
    step = math.ceil(len(stars) / MOST_STARS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MassRangeWarning)
        some = Population.of(
            stars.take(np.arange(0, len(stars), step)),
            multiplicity=premises.multiplicity,
            photometry=premises.photometry,
            cut=premises.cut,
        )
    coefficient = integrals.coefficient[:, population.law.star % step == 0]
    totals = np.array(
        [_totals(premises, replace(some, cut=premises.cut * f), coefficient, required) for f in CUTS]
    )
    now = totals[CUTS.index(1.0)]
    scale = [s.total.value / (s.required or math.inf) for s in required]
    used = totals * np.divide(scale, now, out=np.zeros_like(now), where=now > 0)
    out = {}
    for group in dict.fromkeys(s.group for s in required):
        share = used[:, [s.group == group for s in required]].max(axis=1)
        out[group] = premises.cut * _crossing(np.array(CUTS), share)
    return out


def _totals(
    premises: Premises, population: Population, coefficient: FloatArray, required: list[Share]
) -> list[float]:
    """Rms errors of the quantities of which something is required, with another cut; NaN where there are none."""
    integrals = PairIntegrals(
        cut=population.cut, coefficient=coefficient, separation=separation_moments(population, is_rough=True)
    )
    fraction = None if premises.binary_fraction is None else np.array([premises.binary_fraction])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SeriesWarning)
        long = predict(population_moments(population, integrals, fraction), premises.response, MANY_STARS)
    bias_and_sd = _changes(premises, long)
    fewer = math.sqrt(MANY_STARS / premises.n_stars)
    found = [bias_and_sd[s.group][:, GROUPS[s.group].index(s.quantity), 0].tolist() for s in required]
    return [math.hypot(bias, fewer * scatter) for bias, scatter in found]


def _crossing(cut: FloatArray, share: FloatArray) -> float:
    """Largest cut of at most 1 in a share that grows with it; NaN where there is none."""
    good = np.isfinite(share) & (share > 0)
    cut, share = cut[good], share[good]
    if not share.size:
        return float(CUTS[-1])
    if share[0] > 1:
        return math.nan
    return float(np.exp(np.interp(0.0, np.log(np.maximum.accumulate(share)), np.log(cut))))
