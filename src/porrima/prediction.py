"""The closed forms: what companions do to the PSF of a stack, without drawing anything.

Averages over the stars' companions and a response give the bias and the scatter of the measured shape, for any
number of stars in the stack.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from porrima.averages import PopulationMoments, population_moments
from porrima.integrals import EVEN, PairIntegrals, integrate
from porrima.moments import INDICES, ORDER
from porrima.response import SERIES_LIMIT
from porrima.singles import added_to_shape, node_weights

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.response import Response

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
    crossover_n_stars : (3, k) float array
        Number of stars at which the bias overtakes the scatter: below 1 where it always does, infinite where there
        is no bias (count).
    """

    population: PopulationMoments
    n_stars: int | None
    r2_0: float
    bias: FloatArray
    covariance: FloatArray
    crossover_n_stars: FloatArray

    @property
    def sd(self) -> FloatArray:
        """Standard deviation about the mean, (3, k), dimensionless."""
        return np.sqrt(np.maximum(np.einsum("qqk->qk", self.covariance), 0.0))

    @property
    def sigma(self) -> FloatArray:
        """Rms about the PSF without companions (KCM16, Eq. 10), (3, k), dimensionless."""
        return np.hypot(self.bias, self.sd)

    @property
    def eta(self) -> FloatArray:
        """Mean of x over the size of the PSF, (k,), dimensionless."""
        return self.population.mean_x / self.r2_0

    @property
    def log_size_covariance(self) -> FloatArray:
        """Covariance of e1, e2 and ln R² of the stack, (3, 3, k), dimensionless: that of R² over its mean size.

        To second order in the scatter of R²/R0², so 1 % at one star and nothing from 40 on.
        """
        unit = np.ones((3, self.bias.shape[1]))
        unit[2] = 1.0 / (1.0 + self.bias[2])
        return self.covariance * unit[:, None] * unit[None, :]


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

    the first exact, the second 6 % too large at N = 1 and 1 % at 5, and for N → ∞ KCM16 Eqs. 7-12 with their
    second-order term.  Where the moments of order 8 make up more than `response.SERIES_LIMIT` of the mean size
    change, the series has not converged and the result is NaN: a cut near the width of the PSF.  Plain moments have
    no such limit.

    References
    ----------
    KCM16
    """
    if n_stars is not None and n_stars < 1:
        raise ValueError(f"n_stars must be at least 1, got {n_stars}")
    limit, scatter = _endless(moments, response)
    if n_stars is None:
        bias, covariance = limit.copy(), np.zeros((3, 3, limit.shape[1]))
    elif n_stars >= MANY_STARS or not moments.equal_weights:
        bias, covariance = _about_the_mean(moments, response, n_stars)
    else:
        bias, covariance = _star_by_star(moments, response, n_stars)
    r2_0 = float(response.shape0.r2)
    unit = np.array([1.0, 1.0, r2_0])
    biased = np.abs(limit) > _NO_BIAS * unit[:, None]
    crossover = np.divide(scatter, limit**2, out=np.full_like(scatter, np.inf), where=biased)
    orders = series_orders(moments, response)
    diverged = np.abs(orders[-1]) > SERIES_LIMIT
    if np.any(diverged):
        warnings.warn(_series_text(moments, response, orders[:, diverged][:, 0]), SeriesWarning, stacklevel=2)
    for result in (bias, covariance, crossover):
        result[..., diverged] = np.nan
    return Prediction(
        population=moments,
        n_stars=n_stars,
        r2_0=r2_0,
        bias=bias / unit[:, None],
        covariance=covariance / np.multiply.outer(unit, unit)[:, :, None],
        crossover_n_stars=crossover,
    )


def _endless(moments: PopulationMoments, response: Response) -> tuple[FloatArray, FloatArray]:
    """Change of shape of an endless stack, and N times the variance of a long one, both (3, k)."""
    bending = _bending(response, moments.mean)
    bias = response.first @ moments.mean.T + 0.5 * np.einsum("kqi,ki->qk", bending, moments.mean)
    gradient = response.first + bending
    return bias, np.einsum("kqi,kqi->qk", gradient @ moments.covariance, gradient)


def _about_the_mean(
    moments: PopulationMoments, response: Response, n_stars: int
) -> tuple[FloatArray, FloatArray]:
    """Change of shape (3, k) and covariance (3, 3, k) to second order about the mean stack."""
    m, c = moments.mean + moments.shift / n_stars, moments.covariance / n_stars
    bending = _bending(response, m)
    curved = np.einsum("kqi,ki->qk", bending, m) + np.einsum("qij,kij->qk", response.second, c)
    gradient = response.first + bending
    covariance = gradient @ c @ gradient.transpose(0, 2, 1) + 0.5 * _traces(response, c)
    return response.first @ m.T + 0.5 * curved, covariance.transpose(1, 2, 0)


def _bending(response: Response, mean: FloatArray) -> FloatArray:
    """Second derivatives times mean moments, (k, 3, n_moment)."""
    return (mean @ response.second.reshape(-1, mean.shape[1]).T).reshape(mean.shape[0], 3, -1)


def _traces(response: Response, covariance: FloatArray) -> FloatArray:
    """tr(B_q C B_r C), (k, 3, 3)."""
    turned = response.second @ covariance[:, None]
    rows = turned.reshape(turned.shape[0], 3, -1)
    traces: FloatArray = rows @ turned.transpose(0, 3, 2, 1).reshape(turned.shape[0], -1, 3)
    return traces


def _star_by_star(
    moments: PopulationMoments, response: Response, n_stars: int
) -> tuple[FloatArray, FloatArray]:
    """Change of shape (3, k) and covariance (3, 3, k), exact in what a single star adds."""
    added = added_to_shape(response, moments.cut, n_stars)
    if added.n_too_wide and np.any(moments.unresolved_fraction > 0):
        text = (
            f"cut {moments.cut} arcsec: single pairs near it are too wide for {response.psf} ({response.estimator}) "
            f"at n_stars = {n_stars} and are taken to second order"
        )
        warnings.warn(text, SeriesWarning, stacklevel=3)
    weight, n_moments = node_weights(moments.powers), moments.mean.shape[1]
    m, c = moments.mean, moments.covariance
    bending = _bending(response, m)
    alone = weight @ added.mean
    bias = n_stars * alone + 0.5 * (1 - 1 / n_stars) * np.einsum("kqi,ki->kq", bending, m)
    push = bending * (n_stars - 1) / n_stars**2  # on a star's moments, from the others
    pulled = push.transpose(0, 2, 1)
    mixed = (weight @ added.with_moments.reshape(-1, 3 * n_moments)).reshape(-1, 3, n_moments) @ pulled
    square = (weight @ added.product.reshape(-1, 9)).reshape(-1, 3, 3) + mixed + mixed.transpose(0, 2, 1)
    square += push @ (c + m[:, :, None] * m[:, None, :]) @ pulled
    mean = alone + np.einsum("kqi,ki->kq", push, m)
    covariance = n_stars * (square - mean[:, :, None] * mean[:, None, :])
    covariance += 0.5 * (n_stars - 1) / n_stars**3 * _traces(response, c)
    return bias.T, covariance.transpose(1, 2, 0)


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


def _series_text(moments: PopulationMoments, response: Response, share: FloatArray) -> str:
    """What is wrong with a series that does not converge."""
    grown = np.flatnonzero(np.abs(share[1:]) >= np.abs(share[:-1]))
    stops = EVEN[grown[0]] if grown.size else ORDER
    shown = ", ".join(f"{100 * part:+.3g} %" for part in share)
    return (
        f"cut {moments.cut} arcsec is too wide for the kernel moments of {response.psf} ({response.estimator}): orders "
        f"{', '.join(map(str, EVEN))} make {shown} of the size change, and the expansion stops being good at order "
        f"{stops}"
    )
