r"""Samples of stars that see one PSF: what companions change in each, its scatter, and what the model does not know.

An error of the model moves all samples at once, so it is found with each figure of the multiplicity table moved in all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from porrima.averages import population_moments
from porrima.gain import moved_together, read_either_way
from porrima.integrals import integrate
from porrima.photometry import PHOTOMETRY
from porrima.prediction import predict
from porrima.systems import Population

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from porrima.averages import PopulationMoments
    from porrima.multiplicity import DucheneKraus2013
    from porrima.photometry import MassLuminosity
    from porrima.response import Response
    from porrima.stars import Stars

    FloatArray = NDArray[np.float64]

__all__ = ["Fractions", "Samples", "samples_of"]

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
        Predicted mean change of e1, e2 (dimensionless) and R² [arcsec²].
    per_star : (k, 3, 3) float array
        Covariance of what one star adds to e1, e2 and R² [arcsec²]: N times that of stacks of N stars.
    model_error : (n, k, 3) float array
        Change of the change by n errors of the model, one standard deviation or one choice made the other way each.
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
    multiplicity: DucheneKraus2013,
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
    multiplicity : DucheneKraus2013
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
    An error is half of the change between the figure moved down and up by its error, to first order symmetric.  The
    errors of the binary fractions are independent, one for each sample.

    References
    ----------
    DucheneKraus2013, KCM16
    """
    models = {"multiplicity": multiplicity, "photometry": photometry}
    whole = [Population.of(s, multiplicity=multiplicity, photometry=photometry, cut=cut) for s in stars]
    wanted = None if fractions is None else fractions.value
    moments = tuple(_moments(p, wanted, k) for k, p in enumerate(whole))
    change, per_star = np.empty((len(whole), 3)), np.empty((len(whole), 3, 3))
    unit = np.array([1.0, 1.0, float(response.shape0.r2)])
    for k, (one, n) in enumerate(zip(moments, n_stars.tolist(), strict=True)):
        found = predict(one, response, n)
        change[k] = found.bias[:, 0] * unit
        per_star[k] = found.covariance[:, :, 0] * np.outer(unit, unit) * n
    some = [s.take(np.arange(0, len(s), -(-len(s) // MOST_STARS))) for s in stars]

    def changes(populations: Sequence[Population], at: FloatArray | None = wanted) -> FloatArray:
        limits = [predict(_moments(p, at, k), response).bias[:, 0] for k, p in enumerate(populations)]
        found: FloatArray = np.array(limits) * unit
        return found

    start = [Population.of(s, **models, cut=cut) for s in some]  # type: ignore[arg-type]
    reference = changes(start)
    errors = [0.5 * (changes(up) - changes(down)) for down, up in moved_together(start, multiplicity)]
    if choices:
        for number, (model, light) in enumerate(read_either_way(multiplicity, photometry)):
            if number in _ALONE:
                other = [Population.of(s, multiplicity=model, photometry=light, cut=cut) for s in some]
                errors.append(changes(other) - reference)
    if fractions is not None:
        ends = [np.clip(fractions.value + sign * fractions.error, 0.0, 1.0) for sign in (-1.0, 1.0)]
        apart = 0.5 * (changes(start, ends[1]) - changes(start, ends[0]))
        errors += [np.where(np.arange(len(start))[:, None] == k, apart, 0.0) for k in range(len(start))]
    return Samples(
        n_stars=n_stars, moments=moments, change=change, per_star=per_star, model_error=np.array(errors)
    )


_ALONE = (1, 2, 4)  # of the eight combinations: those with one choice made the other way


def _moments(population: Population, fractions: FloatArray | None, k: int) -> PopulationMoments:
    """Of one star of sample k."""
    fraction = None if fractions is None else fractions[k : k + 1]
    return population_moments(population, integrate(population), fraction)
