r"""Samples of stars that see one PSF: what companions change in each, its scatter, and what the model does not know.

An error of the model moves all samples at once, so it is found with each figure of the multiplicity table moved in all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from porrima.averages import population_moments
from porrima.distribution import pair_density
from porrima.gain import moved_together, read_either_way
from porrima.integrals import integrate
from porrima.photometry import PHOTOMETRY
from porrima.prediction import MANY_STARS, predict
from porrima.systems import Population

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from porrima.averages import PopulationMoments
    from porrima.companions import MultiplicityModel
    from porrima.photometry import MassLuminosity
    from porrima.response import Response
    from porrima.stars import Stars

    FloatArray = NDArray[np.float64]

__all__ = ["Clipped", "Fractions", "Samples", "clipped", "one_choice_made", "samples_of"]

MOST_STARS = 500
"""Stars of a sample on which errors of the model are found, evenly through those given (count)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fractions:
    """Binary fractions of k samples, known from elsewhere.

    Parameters
    ----------
    value : (k,) float array
        Before resolved pairs leave, in [0, 1].
    error : (k,) float array
        Standard error of each, dimensionless; 0 where it is exact.
    """

    value: FloatArray
    error: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Samples:
    """What k samples of stars make of one PSF.

    Parameters
    ----------
    n_stars : (k,) int array
        Stars in each (count).
    moments : tuple of PopulationMoments
        Of one star of each.
    change : (k, 3) float array
        Predicted mean change of e1, e2 (dimensionless) and R² [arcsec²], averaged over the errors of the model.
    per_star : (k, 3, 3) float array
        Covariance of what one star adds to e1, e2 and R² [arcsec²], N times that of stacks of N stars, likewise.
    model_error : (n, k, 3) float array
        Change of the change by n errors of the model: one standard deviation each, or one choice the other way.
    """

    n_stars: NDArray[np.int64]
    moments: tuple[PopulationMoments, ...]
    change: FloatArray
    per_star: FloatArray
    model_error: FloatArray


def samples_of(
    stars: Sequence[Stars],
    response: Response,
    n_stars: NDArray[np.int64],
    *,
    multiplicity: MultiplicityModel,
    photometry: MassLuminosity = PHOTOMETRY["main-sequence"],
    cut: float = 0.05,
    fractions: Fractions | None = None,
    choices: bool = True,
) -> Samples:
    r"""What samples of stars make of one PSF, with the errors of the model that they share.

    Parameters
    ----------
    stars : sequence of Stars
        Of each sample, such as those of a range of magnitude.
    response : Response
        Of the PSF and estimator.
    n_stars : (k,) int array
        Stars in the stack of each (count).
    multiplicity : MultiplicityModel
        The table and how it is read.
    photometry : MassLuminosity
        Mass to light.
    cut : float
        Separation from which pairs are resolved, in arcsec.
    fractions : Fractions, optional
        Binary fractions of the samples; the model's own where not given.
    choices : bool
        Whether photometry, gap rule and projection, each made the other way, count as errors.

    Returns
    -------
    samples : Samples
        In arcsec² and dimensionless.

    Notes
    -----
    A figure that is wrong by z standard deviations changes the change by a z + c z² (a: half of the difference between
    the figure moved up and down; c: what is left of their mean): errors of a and of :math:`\sqrt2\,c`, and a mean of c,
    which is added.  The scatter is averaged likewise.  The errors of the binary fractions are independent, one for each
    sample.

    References
    ----------
    DucheneKraus2013, KCM16
    """
    models = {"multiplicity": multiplicity, "photometry": photometry}
    whole = [Population.of(s, multiplicity=multiplicity, photometry=photometry, cut=cut) for s in stars]
    wanted = None if fractions is None else fractions.value
    moments = tuple(_moments(p, wanted, k) for k, p in enumerate(whole))
    some = [s.take(np.arange(0, len(s), -(-len(s) // MOST_STARS))) for s in stars]
    look = _Look(response=response, fractions=wanted)
    start = [Population.of(s, **models, cut=cut) for s in some]  # type: ignore[arg-type]
    reference = look.at(start)
    errors, shift, more = [], np.zeros_like(reference.bias), np.zeros_like(reference.covariance)
    for down, up in moved_together(start, multiplicity):
        low, high = look.at(down), look.at(up)
        curved = 0.5 * (high.bias + low.bias) - reference.bias
        errors += [0.5 * (high.bias - low.bias), math.sqrt(2) * curved]
        shift += curved
        more += 0.5 * (high.covariance + low.covariance) - reference.covariance
    if choices:
        for model, light in one_choice_made(multiplicity, photometry):
            other = [Population.of(s, multiplicity=model, photometry=light, cut=cut) for s in some]
            errors.append(look.at(other).bias - reference.bias)
    if fractions is not None:
        errors += _errors_of_fractions(start, response, fractions)
    unit = look.unit
    found = [predict(one, response, n) for one, n in zip(moments, n_stars.tolist(), strict=True)]
    scatter = np.array([f.covariance[:, :, 0] * (f.n_stars or 1) for f in found]) * np.outer(unit, unit)
    return Samples(
        n_stars=n_stars,
        moments=moments,
        change=np.array([f.bias[:, 0] for f in found]) * unit + shift,
        per_star=scatter + more,
        model_error=np.array(errors),
    )


class _Seen(NamedTuple):
    """Mean change (k, 3) of long stacks of k samples, and covariance of what one star adds (k, 3, 3)."""

    bias: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class _Look:
    """What long stacks of populations show, in arcsec² and dimensionless."""

    response: Response
    fractions: FloatArray | None

    @property
    def unit(self) -> FloatArray:
        """Of e1, e2 and R², (3,)."""
        return np.array([1.0, 1.0, float(self.response.shape0.r2)])

    def at(self, populations: Sequence[Population]) -> _Seen:
        """What each sample shows."""
        found = [
            predict(_moments(p, self.fractions, k), self.response, MANY_STARS)
            for k, p in enumerate(populations)
        ]
        covariance = np.array([f.covariance[:, :, 0] for f in found]) * MANY_STARS
        return _Seen(
            bias=np.array([f.bias[:, 0] for f in found]) * self.unit,
            covariance=covariance * np.outer(self.unit, self.unit),
        )


def _errors_of_fractions(
    populations: Sequence[Population], response: Response, fractions: Fractions
) -> list[FloatArray]:
    """Change of the mean change by the error of each sample's own binary fraction, (k, 3) each."""
    low, high = (
        _Look(
            response=response,
            fractions=np.clip(fractions.value + sign * fractions.error, 0.0, 1.0),
        ).at(populations)
        for sign in (-1.0, 1.0)
    )
    change, number = 0.5 * (high.bias - low.bias), np.arange(len(populations))[:, None]
    return [np.where(number == k, change, 0.0) for k in range(len(populations))]


def one_choice_made(
    model: MultiplicityModel, photometry: MassLuminosity
) -> list[tuple[MultiplicityModel, MassLuminosity]]:
    """Models and relations with one of their options, or photometry, made the other way.

    Parameters
    ----------
    model : MultiplicityModel
        As given.
    photometry : MassLuminosity
        As given.

    Returns
    -------
    models : list of (MultiplicityModel, MassLuminosity)
        The options from the last to the first, then photometry.
    """
    every = list(read_either_way(model, photometry))
    return [every[1 << k] for k in range(len(every).bit_length() - 1)]


def _moments(population: Population, fractions: FloatArray | None, k: int) -> PopulationMoments:
    """Of one star of sample k."""
    fraction = None if fractions is None else fractions[k : k + 1]
    return population_moments(population, integrate(population), fraction)


@dataclass(frozen=True, slots=True, kw_only=True)
class Clipped:
    r"""Stars that are left by thresholds on their own change of size, seen without noise.

    Parameters
    ----------
    threshold : (k,) float array
        Largest :math:`\delta R^2/R_0^2` of a star by itself, dimensionless.
    removed : (k,) float array
        Share of the stars that are rejected, in [0, 1].
    eta : (k,) float array
        Mean change of size of those that are left, over the size, dimensionless.
    sd : (k,) float array
        Standard deviation of what one of them adds, likewise.
    """

    threshold: FloatArray
    removed: FloatArray
    eta: FloatArray
    sd: FloatArray


def clipped(
    population: Population,
    response: Response,
    threshold: FloatArray,
    binary_fraction: float | None = None,
) -> Clipped:
    r"""Mean and scatter of the size change of stars below thresholds of their own, without noise.

    Parameters
    ----------
    population : Population
        Of stars of equal weight.
    response : Response
        Of the PSF and estimator.
    threshold : (k,) float array
        Largest :math:`\delta R^2/R_0^2` of a star by itself, dimensionless, positive; infinite for all.
    binary_fraction : float, optional
        Before pairs leave, in [0, 1]; None for the model's own.

    Returns
    -------
    clipped : Clipped
        Dimensionless.

    Notes
    -----
    To first order, a pair changes the size by :math:`\kappa x/R_0^2`.  The pairs are counted on cells of flux ratio and
    separation (`distribution.pair_density`), 6 % and 2 % wide, so that a threshold cuts x to some per cent.
    """
    density = pair_density(population, integrate(population), binary_fraction)
    scale = response.kappa_r2 * population.cut**2 / (4 * float(response.shape0.r2))
    added, share = scale * np.outer(density.four_y, density.square).ravel(), density.share.ravel()
    order = np.argsort(added)
    sums = np.cumsum(np.stack([share, share * added, share * added**2])[:, order], axis=1)
    within = np.searchsorted(added[order], threshold, side="right") - 1
    count, first, second = np.where(within >= 0, sums[:, np.maximum(within, 0)], 0.0)
    kept = 1.0 - sums[0, -1] + count
    mean = first / kept
    return Clipped(
        threshold=threshold,
        removed=1.0 - kept,
        eta=mean,
        sd=np.sqrt(np.maximum(second / kept - mean**2, 0.0)),
    )
