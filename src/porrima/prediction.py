"""The closed forms: what companions do to the PSF of a stack, without drawing anything.

Moments of the companions are integrated over stars, mass ratio, separation and orientation; a response turns
them into the bias and the scatter of the measured shape, for any number of stars in the stack.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import log_ndtr, logsumexp

from porrima.errors import InputError
from porrima.moments import INDICES, N_MOMENTS, ORDER, angular_mean, pair_coefficient
from porrima.orbits import projection_nodes
from porrima.photometry import flux_ratio
from porrima.response import SERIES_LIMIT

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.response import Response
    from porrima.systems import Population

    FloatArray = NDArray[np.float64]

__all__ = ["PairIntegrals", "PopulationMoments", "Prediction", "integrate", "population_moments", "predict"]

QUANTITIES = ("e1", "e2", "r2")
"""What is predicted, in the order of every array of three; r2 relative to that of the PSF."""

_EVEN = tuple(range(2, ORDER + 1, 2))
_PRODUCTS = tuple((n, m) for n in range(2, ORDER + 1) for m in range(n, ORDER + 1) if (n + m) % 2 == 0)
_TAIL = np.array([a + b == ORDER for a, b in INDICES])
_CHUNK = 4096  # stars integrated at a time
_MASS_RATIO_PANELS = 48
_DISTANCE_STEP = 0.004  # dex
_LEAST_KEPT = 1e-6  # share of the stars that must be left once resolved pairs are gone


@dataclass(frozen=True, slots=True, kw_only=True)
class PairIntegrals:
    r"""Expectations over the companion of each of n stars, given that it has one.

    Parameters
    ----------
    unresolved : (n,) float array
        Probability that the pair is closer than the cut, in [0, 1].
    mean : (n, 4) float array
        :math:`E[c_n(f)\, r^n;\ r < r_{cut}]` for the even orders 2 to 8, in arcsec^n.
    product : (n, n_product) float array
        :math:`E[c_n c_m\, r^{n+m};\ r < r_{cut}]` for n + m even, in arcsec^(n+m).
    """

    unresolved: FloatArray
    mean: FloatArray
    product: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PopulationMoments:
    r"""First and second moments of the kernel of one star of a stack, for k binary fractions.

    Parameters
    ----------
    binary_fraction : (k,) float array
        Before resolved pairs leave, in [0, 1].
    unresolved_fraction : (k,) float array
        Share of pairs among the stars of the stack, in [0, 1].
    removed_fraction : (k,) float array
        Share of resolved pairs among all pairs, in [0, 1].
    mean_x : (k,) float array
        :math:`\langle x \rangle = \langle f r^2/(1+f)^2 \rangle` with the weights of the stack, in arcsec².
    mean_x2 : (k,) float array
        :math:`\langle x^2 \rangle`, likewise, in arcsec⁴.
    effective_share : (k,) float array
        Effective number of stars over the number in the stack, (0, 1]; 1 for equal weights.
    mean : (k, n_moment) float array
        Mean kernel moments of an endless stack in the order of `moments.INDICES`, in arcsec^(a+b).
    shift : (k, n_moment) float array
        N times the difference from it of the mean over stacks of N stars; 0 for equal weights.
    covariance : (k, n_moment, n_moment) float array
        N times the covariance of the moments of stacks of N stars.
    """

    binary_fraction: FloatArray
    unresolved_fraction: FloatArray
    removed_fraction: FloatArray
    mean_x: FloatArray
    mean_x2: FloatArray
    effective_share: FloatArray
    mean: FloatArray
    shift: FloatArray
    covariance: FloatArray


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
        Bias and sd are NaN where the pairs are too wide for a series in kernel moments, see `predict`.
    sd : (3, k) float array
        Standard deviation about the mean, dimensionless.
    """

    population: PopulationMoments
    n_stars: int | None
    r2_0: float
    bias: FloatArray
    sd: FloatArray

    @property
    def sigma(self) -> FloatArray:
        """Rms about the PSF without companions (KCM16, Eq. 10), (3, k), dimensionless."""
        return np.hypot(self.bias, self.sd)

    @property
    def eta(self) -> FloatArray:
        """Mean of x over the size of the PSF, (k,), dimensionless."""
        return self.population.mean_x / self.r2_0


def integrate(population: Population) -> PairIntegrals:
    r"""Expectations over companions by quadrature: mass ratio and orientation by Gauss's rule, separation exactly.

    Parameters
    ----------
    population : Population
        Stars, their companions' law and the cut.

    Returns
    -------
    integrals : PairIntegrals
        One row per star, in arcsec^n.

    Notes
    -----
    For one orientation the projected separation is :math:`\rho a / d`, and the partial moments of a
    log-normal a with :math:`\mu, s` in natural logarithms are
    :math:`E[a^k; a < A] = \exp(k\mu + k^2 s^2/2)\, \Phi((\ln A - \mu)/s - k s)`.
    Mass ratio and separation are independent in the models at hand.
    """
    separations = _separation_moments(population)
    c_mean, c_product = (
        np.concatenate(parts)
        for parts in zip(
            *(
                _coefficient_moments(population, slice(first, first + _CHUNK))
                for first in range(0, len(population.stars), _CHUNK)
            ),
            strict=True,
        )
    )
    return PairIntegrals(
        unresolved=separations[0],
        mean=c_mean * np.stack([separations[n] for n in _EVEN], axis=1),
        product=c_product * np.stack([separations[n + m] for n, m in _PRODUCTS], axis=1),
    )


def _coefficient_moments(population: Population, some: slice) -> tuple[FloatArray, FloatArray]:
    """E[c_n] for even n, and E[c_n c_m], of some stars."""
    f, weight = _flux_ratio_nodes(population, some)
    c = {n: pair_coefficient(f, n) for n in range(2, ORDER + 1)}
    mean = [np.sum(weight * c[n], axis=1) for n in _EVEN]
    product = [np.sum(weight * c[n] * c[m], axis=1) for n, m in _PRODUCTS]
    return np.stack(mean, axis=1), np.stack(product, axis=1)


def _separation_moments(population: Population) -> dict[int, FloatArray]:
    """E[r^k; r < cut] of each star for even k from 0 to twice the order, in arcsec^k.

    They depend on the star through its law and distance alone, so they are found on a fine grid of distances
    and interpolated (cubic, in logarithms).
    """
    law = np.stack([population.law.log_a, population.law.log_a_sigma, population.law.log_a_max], axis=1)
    log_distance = np.log10(population.stars.distance)
    n = max(5, 2 + int(np.ptp(log_distance) / _DISTANCE_STEP))
    grid = np.linspace(log_distance.min() - _DISTANCE_STEP, log_distance.max() + _DISTANCE_STEP, n)
    moments = {k: np.empty(log_distance.size) for k in range(0, 2 * ORDER + 1, 2)}
    laws, which = np.unique(law, axis=0, return_inverse=True)
    for number, one in enumerate(laws):
        mine = which.ravel() == number
        for k, log_moment in _log_separation_moments(population, one, grid).items():
            moments[k][mine] = np.exp(CubicSpline(grid, log_moment)(log_distance[mine]))
    return moments


def _log_separation_moments(
    population: Population, law: FloatArray, log_distance: FloatArray
) -> dict[int, FloatArray]:
    """Log of E[r^k; r < cut] for one law of the semi-major axis at each log10 distance."""
    rho, weight = projection_nodes(population.projection)
    mu, s, largest = law * math.log(10)
    log_d = log_distance[:, None] * math.log(10)
    upper = np.minimum(math.log(population.cut) + log_d - np.log(rho), largest)
    z = (upper - mu) / s
    log_norm = log_ndtr((largest - mu) / s)
    moments = {}
    for k in range(0, 2 * ORDER + 1, 2):
        log_partial = k * (mu - log_d + np.log(rho)) + 0.5 * (k * s) ** 2 + log_ndtr(z - k * s) - log_norm
        moments[k] = logsumexp(log_partial, axis=1, b=weight)
    return moments


def _flux_ratio_nodes(population: Population, some: slice) -> tuple[FloatArray, FloatArray]:
    """Flux ratios at the nodes of the mass ratio, and their weights, both (n, node)."""
    law, mass = population.law, population.stars.mass[some]
    q_min, gamma = law.mass_ratio_min[some, None], law.mass_ratio_exponent[some, None]
    bright = np.clip(population.tracks.dark_below / mass[:, None], q_min, 1.0)  # below it f = 0
    x, w = np.polynomial.legendre.leggauss(2)
    panel = (np.arange(_MASS_RATIO_PANELS)[:, None] + 0.5 * (x + 1)) / _MASS_RATIO_PANELS
    panel_weight = np.tile(0.5 * w / _MASS_RATIO_PANELS, _MASS_RATIO_PANELS)
    span = -np.log(bright)  # uniform panels in log q, as the tracks are piecewise linear in log mass
    q = np.minimum(bright * np.exp(span * panel.ravel()), 1.0)
    g = gamma + 1
    power = np.where(np.abs(g) > 1e-9, g, 1.0)
    norm = np.where(np.abs(g) > 1e-9, (1 - q_min**power) / power, -np.log(q_min))
    tracks = population.tracks
    some_tracks = replace(tracks, index=tracks.index[some], weight=tracks.weight[some])
    weight = panel_weight * span * q**g / norm
    given = ~np.isnan(law.mass_ratio[some])
    q[given], weight[given] = law.mass_ratio[some][given, None], 1.0 / q.shape[1]
    f = flux_ratio(some_tracks, mass, q)
    return np.where((span > 0) | given[:, None], f, 0.0), weight


def population_moments(
    population: Population, integrals: PairIntegrals, binary_fraction: FloatArray | None = None
) -> PopulationMoments:
    r"""Kernel moments of one star of a stack at given binary fractions, resolved pairs removed.

    Parameters
    ----------
    population : Population
        The n stars.
    integrals : PairIntegrals
        Of the same stars, from `integrate`.
    binary_fraction : (k,) float array, optional
        Before resolved pairs leave, in [0, 1]; None for the model's own.

    Returns
    -------
    moments : PopulationMoments
        For each fraction, in arcsec^(a+b).

    Raises
    ------
    InputError
        If nearly all stars are resolved pairs.

    Notes
    -----
    With :math:`p_i = \min(1, s\, MF_i)`,
    :math:`\langle x^k \rangle = \sum_i p_i E[x^k; r < r_{cut}]_i / \sum_i (1 - p_i P_{res,i})`.  With weights w a
    stack's moments are the ratio :math:`\sum w k / \sum w`: to first order in 1/N their mean is
    :math:`m - [\langle w^2 k\rangle - m \langle w^2\rangle] / (N \langle w\rangle^2)`, their covariance
    :math:`\langle w^2 (k - m)(k' - m')\rangle / (N \langle w\rangle^2)`, and the effective number is
    :math:`N \langle w\rangle^2/\langle w^2\rangle`.  Exact for equal weights.
    """
    fraction, w = population.law.multiplicity_fraction, population.weight
    scale = population.scale(binary_fraction)
    order = np.argsort(fraction, kind="stable")
    resolved = 1 - integrals.unresolved
    columns = np.column_stack(
        [
            np.ones(fraction.size), resolved, w * resolved, w**2 * resolved,
            w[:, None] * integrals.mean, w * integrals.product[:, 0],
            w[:, None] ** 2 * integrals.mean, w[:, None] ** 2 * integrals.product,
        ]
    )[order]  # fmt: skip
    sums = _weighted_sums(fraction[order], columns, scale)
    pairs, resolved_pairs = sums[:, 0], sums[:, 1]
    kept = fraction.size - resolved_pairs
    if np.any(kept < _LEAST_KEPT * fraction.size):
        raise InputError(
            "must leave some pairs unresolved at this binary fraction", key="cut", value=population.cut
        )
    mean_w, mean_w2 = (w.sum() - sums[:, 2]) / kept, ((w**2).sum() - sums[:, 3]) / kept
    first, x2, second, product = np.split(sums[:, 4:], np.cumsum([4, 1, 4]), axis=1)
    mean = _isotropic_means(first / (kept * mean_w)[:, None])
    weighted = _isotropic_means(second / (kept * mean_w**2)[:, None])
    spread = (mean_w2 / mean_w**2)[:, None]
    covariance = _isotropic_products(product / (kept * mean_w**2)[:, None])
    covariance -= mean[:, :, None] * weighted[:, None, :] + weighted[:, :, None] * mean[:, None, :]
    covariance += spread[:, :, None] * mean[:, :, None] * mean[:, None, :]
    return PopulationMoments(
        binary_fraction=pairs / fraction.size,
        unresolved_fraction=(pairs - resolved_pairs) / kept,
        removed_fraction=np.divide(resolved_pairs, pairs, out=np.zeros_like(pairs), where=pairs > 0),
        mean_x=first[:, 0] / (kept * mean_w),
        mean_x2=x2[:, 0] / (kept * mean_w),
        effective_share=1 / spread[:, 0],
        mean=mean,
        shift=spread * mean - weighted,
        covariance=covariance,
    )


def _weighted_sums(fraction: FloatArray, columns: FloatArray, scale: FloatArray) -> FloatArray:
    """Sums over stars of min(1, s fraction) times each column, (k, column); fractions ascend."""
    zero = np.zeros((1, columns.shape[1]))
    scaled = np.concatenate([zero, np.cumsum(fraction[:, None] * columns, axis=0)])
    plain = np.concatenate([zero, np.cumsum(columns, axis=0)])
    with np.errstate(divide="ignore"):
        below = np.searchsorted(fraction, 1.0 / scale)
    sums: FloatArray = scale[:, None] * scaled[below] + plain[-1] - plain[below]
    return sums


def _isotropic_means(of_order: FloatArray) -> FloatArray:
    """Mean moments (k, n_moment) of kernels turned at random, from those of even order (k, 4)."""
    mean = np.zeros((of_order.shape[0], N_MOMENTS))
    for i, (a, b) in enumerate(INDICES):
        if (a + b) % 2 == 0:
            mean[:, i] = of_order[:, _EVEN.index(a + b)] * angular_mean(a, b)
    return mean


def _isotropic_products(of_orders: FloatArray) -> FloatArray:
    """Mean products of moments (k, n_moment, n_moment) of kernels turned at random, from (k, n_product)."""
    second = np.zeros((of_orders.shape[0], N_MOMENTS, N_MOMENTS))
    for i, (a, b) in enumerate(INDICES):
        for j, (c, d) in enumerate(INDICES):
            n, m = sorted((a + b, c + d))
            if (n + m) % 2 == 0:
                second[:, i, j] = of_orders[:, _PRODUCTS.index((n, m))] * angular_mean(a + c, b + d)
    return second


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

    Notes
    -----
    With the mean m and covariance C/N of a stack's moments and the response's derivatives A and B,
    bias = A m + (m B m + tr(B C)/N)/2 and sd² = (A + B m) C (A + B m)/N.  For plain moments this is

    .. math:: sd(R^2)/R_0^2 = \sqrt{(\langle x^2\rangle - \langle x\rangle^2)/N}/R_0^2, \qquad
       sd(e_i) = \sqrt{[\langle x^2\rangle/2 + e_i^2(\langle x^2\rangle - \langle x\rangle^2)]/N}/R_0^2,

    the first exact, the second to first order in x/R0² (6 % too large at N = 1, 0.9 % at 5), and for
    N → ∞ KCM16 Eqs. 7-12 with their second-order term.  For other estimators sd is first order about the
    mean, with the same reservation at very small N.  Where the moments of order 8 make up more than
    `response.SERIES_LIMIT` of the mean size change, the series has not converged and the result is NaN:
    a cut near the width of the PSF.  Plain moments have no such limit.

    References
    ----------
    KCM16
    """
    if n_stars is not None and n_stars < 1:
        raise ValueError(f"n_stars must be at least 1, got {n_stars}")
    per_stack = 0.0 if n_stars is None else 1.0 / n_stars
    first, second = response.first, response.second
    m, c = moments.mean + moments.shift * per_stack, moments.covariance * per_stack
    bending = np.einsum("ki,qij->qkj", m, second)
    bias = first @ m.T + 0.5 * (np.einsum("qkj,kj->qk", bending, m) + np.einsum("qij,kij->qk", second, c))
    gradient = first[:, None, :] + bending
    variance = np.einsum("qki,kij,qkj->qk", gradient, c, gradient, optimize=True)
    r2_0 = float(response.shape0.r2)
    size, tail = m @ first[2], m[:, _TAIL] @ first[2, _TAIL]
    diverged = np.abs(tail) > SERIES_LIMIT * np.abs(size)
    bias[:, diverged], variance[:, diverged] = np.nan, np.nan
    unit = np.array([1.0, 1.0, r2_0])[:, None]
    sd = np.sqrt(np.maximum(variance, 0.0))
    return Prediction(population=moments, n_stars=n_stars, r2_0=r2_0, bias=bias / unit, sd=sd / unit)
