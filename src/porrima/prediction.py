"""The closed forms: what companions do to the PSF of a stack, without drawing anything.

Averages over the stars' companions and a response give the bias and the scatter of the measured shape, for any
number of stars in the stack.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from porrima.averages import PopulationMoments, population_moments
from porrima.integrals import EVEN, PairIntegrals, integrate
from porrima.moments import INDICES, ORDER
from porrima.response import SERIES_LIMIT
from porrima.singles import added_shapes, added_to_shape, node_weights

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.averages import TripleMoments
    from porrima.response import Response
    from porrima.singles import AddedShape

    FloatArray = NDArray[np.float64]

__all__ = [
    "QUANTITIES", "PairIntegrals", "PopulationMoments", "Prediction", "SeriesWarning", "integrate",
    "population_moments", "predict", "series_orders",
]  # fmt: skip

QUANTITIES = ("e1", "e2", "r2")
"""What is predicted, in the order of every array of three; r2 relative to that of the PSF."""

MANY_STARS = 10_000
"""Number of stars from which second order about the mean stack is as good as single stars solved exactly."""

_ORDERS = np.sum(INDICES, axis=1)
_NO_BIAS = 1e-12  # what is smaller is the rounding of a bias that symmetry forbids


class SeriesWarning(UserWarning):
    """Pairs are too wide, for this PSF and estimator, for a series in kernel moments."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    r"""Bias and error of the shape of a stack, for k binary fractions.

    Parameters
    ----------
    population : PopulationMoments
        What it rests on.
    n_stars : int or None
        Stars in the stack (count); None for the limit of infinitely many.
    r2_0 : float
        Size of the PSF without companions by the same estimator, in arcsec².
    bias : (3, k) float array
        Mean of e1, e2, r2 of the stack minus those of the PSF; r2 over that of the PSF.  Dimensionless.
        Bias and covariance are NaN where the pairs are too wide for a series in kernel moments, see `predict`.
    covariance : (3, 3, k) float array
        Covariance of the three about their means, dimensionless.
    log_covariance : (3, 3, k) float array
        Covariance of e1, e2 and ln R² about their means, dimensionless.
    crossover_n_stars : (3, k) float array
        Number of stars at which the bias overtakes the scatter: below 1 where it always does, infinite where there
        is no bias (count).
    series : (4, k) float array
        Share of the orders 2, 4, 6 and 8 of the kernel moments in the mean change of size, dimensionless.
    """

    population: PopulationMoments
    n_stars: int | None
    r2_0: float
    bias: FloatArray
    covariance: FloatArray
    log_covariance: FloatArray
    crossover_n_stars: FloatArray
    series: FloatArray

    @property
    def sd(self) -> FloatArray:
        """Standard deviation about the mean, (3, k), dimensionless."""
        variance: FloatArray = np.einsum("qqk->qk", self.covariance)
        return np.sqrt(np.maximum(variance, 0.0))

    @property
    def sigma(self) -> FloatArray:
        """Rms about the PSF without companions (KCM16, Eq. 10), (3, k), dimensionless."""
        return np.hypot(self.bias, self.sd)

    @property
    def eta(self) -> FloatArray:
        """Mean of x over the size of the PSF, (k,), dimensionless."""
        return self.population.mean_x / self.r2_0

    @property
    def last_order(self) -> NDArray[np.int64]:
        """Order at which the expansion stops being good: the first whose successor is no smaller, or 8; (k,)."""
        grows = np.abs(self.series[1:]) >= np.abs(self.series[:-1])
        return np.where(grows.any(axis=0), np.array(EVEN)[np.argmax(grows, axis=0)], ORDER)


class _Derivatives(NamedTuple):
    """First (4, n_moment) and second (4, n_moment, n_moment) derivative of e1, e2, R² over R0² and ln R²."""

    first: FloatArray
    second: FloatArray

    @classmethod
    def of(cls, response: Response) -> _Derivatives:
        """Those of a response."""
        r2_0 = float(response.shape0.r2)
        size, curved = response.first[2:] / r2_0, response.second[2:] / r2_0
        return cls(
            first=np.concatenate([response.first[:2], size, size]),
            second=np.concatenate([response.second[:2], curved, curved - size.T @ size]),
        )


def predict(moments: PopulationMoments, response: Response, n_stars: int | None = None) -> Prediction:
    r"""Bias and scatter of the shape measured on a stack.

    Parameters
    ----------
    moments : PopulationMoments
        Of one star, at k binary fractions.
    response : Response
        Of the PSF and estimator.
    n_stars : int, optional
        Stars in the stack, at least 1 (count); None for infinitely many.

    Returns
    -------
    prediction : Prediction
        Dimensionless; r2 over that of the PSF.

    Raises
    ------
    ValueError
        If `n_stars` is less than 1.

    Warns
    -----
    SeriesWarning
        Where the series in kernel moments does not converge: with the order at which it stops being good.

    Notes
    -----
    The change of shape of a stack is what each star adds alone, :math:`s_1(k/N) = s(k/N) - s_0`, solved exactly, and
    to second order what two stars add together, :math:`k^T B k'/N^2` with the response's second derivative B.
    With the mean m and covariance C of one star's moments and :math:`g = s_1(k/N) + \frac{N-1}{N^2} m^T B k`,

    .. math:: \mathrm{bias} = N \langle s_1 \rangle + \frac12\Big(1 - \frac1N\Big) m^T B m, \qquad
       \mathrm{cov}_{qr} = N\, \mathrm{cov}(g_q, g_r) + \frac{N-1}{2N^3} \mathrm{tr}(B_q C B_r C) .

    This is exact for one star, and what three stars add together, third order in the size change, is left out.
    From `MANY_STARS` on, and for stars of unequal weight, :math:`s_1` too is taken to second order: then with the
    first derivative A, bias = A m + (m B m + tr(B C)/N)/2 and the covariance is that of (A + B m) k with the same
    trace.  For plain moments, to first order,

    .. math:: sd(R^2)/R_0^2 = \sqrt{(\langle x^2\rangle - \langle x\rangle^2)/N}/R_0^2, \qquad
       sd(e_i) = \sqrt{[\langle x^2\rangle/2 + e_i^2(\langle x^2\rangle - \langle x\rangle^2)]/N}/R_0^2,

    the first exact, the second 5 % too large at N = 1 and 1 % at 5, and for N → ∞ KCM16 Eqs. 7-12 with their
    second-order term.  Where the moments of order 8 make up more than `response.SERIES_LIMIT` of the mean size
    change, the series has not converged and the result is NaN: a cut near the width of the PSF.  Plain moments have
    no such limit.

    References
    ----------
    KCM16
    """
    if n_stars is not None and n_stars < 1:
        raise ValueError(f"n_stars must be at least 1, got {n_stars}")
    by_moments = _Derivatives.of(response)
    n_too_wide = 0
    limit, scatter = _endless(moments, by_moments)
    if n_stars is None:
        bias, covariance = limit, np.zeros((4, 4, limit.shape[1]))
    elif n_stars >= MANY_STARS or not moments.equal_weights:
        bias, covariance = _about_the_mean(moments, by_moments, n_stars)
    else:
        added = added_to_shape(response, moments.cut, n_stars)
        n_too_wide = added.n_too_wide
        bias, covariance = _star_by_star(moments, by_moments, n_stars, added, response)
    biased = np.abs(limit) > _NO_BIAS
    crossover = np.divide(scatter, limit**2, out=np.full_like(scatter, np.inf), where=biased)
    orders = series_orders(moments, response)
    diverged = np.abs(orders[-1]) > SERIES_LIMIT
    for result in (bias, covariance, crossover):
        result[..., diverged] = np.nan
    logarithmic = [0, 1, 3]
    prediction = Prediction(
        population=moments,
        n_stars=n_stars,
        r2_0=float(response.shape0.r2),
        bias=bias[:3],
        covariance=covariance[:3, :3],
        log_covariance=covariance[np.ix_(logarithmic, logarithmic)],
        crossover_n_stars=crossover[:3],
        series=orders,
    )
    if np.any(diverged):
        text = _series_text(prediction, response, int(np.argmax(diverged)))
        warnings.warn(text, SeriesWarning, stacklevel=2)
    elif n_too_wide and np.any(moments.unresolved_fraction > 0):
        text = (
            f"cut {moments.cut} arcsec: single pairs near it are too wide for {response.psf} ({response.estimator}) "
            f"at n_stars = {n_stars} and are taken to second order"
        )
        warnings.warn(text, SeriesWarning, stacklevel=2)
    return prediction


def _endless(moments: PopulationMoments, by_moments: _Derivatives) -> tuple[FloatArray, FloatArray]:
    """Change of shape of an endless stack, and N times the variance of a long one, both (4, k)."""
    bending = _bending(by_moments, moments.mean)
    bias = by_moments.first @ moments.mean.T + 0.5 * np.einsum("kqi,ki->qk", bending, moments.mean)
    gradient = by_moments.first + bending
    return bias, np.einsum("kqi,kqi->qk", gradient @ moments.covariance, gradient)


def _about_the_mean(
    moments: PopulationMoments, by_moments: _Derivatives, n_stars: int
) -> tuple[FloatArray, FloatArray]:
    """Change of shape (4, k) and covariance (4, 4, k) to second order about the mean stack."""
    m, c = moments.mean + moments.shift / n_stars, moments.covariance / n_stars
    bending = _bending(by_moments, m)
    curved = np.einsum("kqi,ki->qk", bending, m) + np.einsum("qij,kij->qk", by_moments.second, c)
    gradient = by_moments.first + bending
    covariance = gradient @ c @ gradient.transpose(0, 2, 1) + 0.5 * _traces(by_moments, c)
    return by_moments.first @ m.T + 0.5 * curved, covariance.transpose(1, 2, 0)


def _bending(by_moments: _Derivatives, mean: FloatArray) -> FloatArray:
    """Second derivatives times mean moments, (k, 4, n_moment)."""
    bending: FloatArray = mean @ by_moments.second.reshape(-1, mean.shape[1]).T
    return bending.reshape(mean.shape[0], -1, mean.shape[1])


def _traces(by_moments: _Derivatives, covariance: FloatArray) -> FloatArray:
    """tr(B_q C B_r C), (k, 4, 4)."""
    turned = by_moments.second @ covariance[:, None]
    k, q = turned.shape[:2]
    traces: FloatArray = turned.reshape(k, q, -1) @ turned.transpose(0, 3, 2, 1).reshape(k, -1, q)
    return traces


def _star_by_star(
    moments: PopulationMoments, by_moments: _Derivatives, n_stars: int, added: AddedShape, response: Response
) -> tuple[FloatArray, FloatArray]:
    """Change of shape (4, k) and covariance (4, 4, k), exact in what a single star adds."""
    weight, m, c = node_weights(moments.powers), moments.mean, moments.covariance

    def average(values: FloatArray) -> FloatArray:
        return (weight @ values.reshape(values.shape[0], -1)).reshape(-1, *values.shape[1:])

    bending = _bending(by_moments, m)
    alone, mixed, square = average(added.mean), average(added.with_moments), average(added.product)
    if moments.triples is not None:
        extra = _triples_alone(moments.triples, by_moments, n_stars, response)
        alone, mixed, square = (a + b for a, b in zip((alone, mixed, square), extra, strict=True))
    bias = n_stars * alone + 0.5 * (1 - 1 / n_stars) * np.einsum("kqi,ki->kq", bending, m)
    push = bending * (n_stars - 1) / n_stars**2  # on a star's moments, from the others
    pulled = push.transpose(0, 2, 1)
    mixed = mixed @ pulled
    square = square + mixed + mixed.transpose(0, 2, 1)
    square += push @ (c + m[:, :, None] * m[:, None, :]) @ pulled
    mean = alone + np.einsum("kqi,ki->kq", push, m)
    covariance = n_stars * (square - mean[:, :, None] * mean[:, None, :])
    covariance += 0.5 * (n_stars - 1) / n_stars**3 * _traces(by_moments, c)
    return bias.T, covariance.transpose(1, 2, 0)


def _triples_alone(
    triples: TripleMoments, by_moments: _Derivatives, n_stars: int, response: Response
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What single triples add to the shape, (k, 4), times moments, (k, 4, n_moment), and its square, (k, 4, 4).

    To second order from their mean moments and products; what is beyond, from some of them.
    """
    first, second = by_moments.first / n_stars, by_moments.second / n_stars**2
    kernel, share, product = triples.kernel, triples.share, triples.product
    exact = added_shapes(response, kernel / n_stars)[0]
    linear = kernel @ first.T
    curved = 0.5 * np.einsum("ni,qij,nj->nq", kernel, second, kernel, optimize=True)
    alone = triples.mean @ first.T + 0.5 * np.einsum("qij,kij->kq", second, product)
    alone += share @ (exact - linear - curved)
    mixed = first @ product + np.einsum("kn,nq,ni->kqi", share, exact - linear, kernel, optimize=True)
    beyond = exact[:, :, None] * exact[:, None, :] - linear[:, :, None] * linear[:, None, :]
    square = first @ product @ first.T + np.einsum("kn,nqr->kqr", share, beyond)
    return alone, mixed, square


def series_orders(moments: PopulationMoments, response: Response) -> FloatArray:
    """Share of each even order of the kernel moments in the mean change of size.

    Parameters
    ----------
    moments : PopulationMoments
        Of one star, at k binary fractions.
    response : Response
        Of the PSF and estimator.

    Returns
    -------
    share : (4, k) float array
        Orders 2, 4, 6 and 8, with sum 1, dimensionless; 0 where there is no change.
    """
    size = response.first[2] * moments.mean
    total = size.sum(axis=1)
    parts = np.stack([size[:, n == _ORDERS].sum(axis=1) for n in EVEN])
    share: FloatArray = np.divide(parts, total, out=np.zeros_like(parts), where=total != 0)
    return share


def _series_text(prediction: Prediction, response: Response, k: int) -> str:
    """What is wrong with a series that does not converge."""
    shown = ", ".join(f"{100 * part:+.3g} %" for part in prediction.series[:, k])
    return (
        f"cut {prediction.population.cut} arcsec is too wide for the kernel moments of {response.psf} "
        f"({response.estimator}): orders {', '.join(map(str, EVEN))} make {shown} of the size change, and the "
        f"expansion stops being good at order {prediction.last_order[k]}"
    )
