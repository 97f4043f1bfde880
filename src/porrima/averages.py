r"""Averages over the stars of a stack: mean kernel moments, their products, and all that they are made of.

What a pair's even moments, and products of moments, depend on is the measure of :math:`y = f/(1+f)^2` and r² over
the stars: its powers :math:`\langle y^j r^{2k} \rangle` for j, k up to 8 are kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from porrima.errors import InputError
from porrima.integrals import EVEN, PRODUCTS, coefficient_polynomial
from porrima.moments import INDICES, N_MOMENTS, ORDER, angular_mean
from porrima.triple_averages import triple_averages

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.integrals import PairIntegrals
    from porrima.systems import Population
    from porrima.triple_averages import TripleSums

    FloatArray = NDArray[np.float64]

__all__ = ["PopulationMoments", "TripleMoments", "population_moments"]

_LEAST_KEPT = 1e-6  # share of the stars that must be left once resolved pairs are gone
_POWERS = (ORDER + 1) ** 2
_ORDERS = np.sum(INDICES, axis=1)
_XX, _YY = INDICES.index((2, 0)), INDICES.index((0, 2))
_SIZES = [INDICES.index((n, 0)) for n in EVEN]


@dataclass(frozen=True, slots=True, kw_only=True)
class TripleMoments:
    """What triples add to the moments of one star of a stack, for k binary fractions.

    Parameters
    ----------
    mean : (k, n_moment) float array
        Their part of the mean moments, in arcsec^(a+b).
    product : (k, n_moment, n_moment) float array
        Their part of the mean products of two moments, with the weights of the stack squared.
    kernel : (n, n_moment) float array
        Moments of some triples, for what is not linear in them, in arcsec^(a+b).
    share : (k, n) float array
        Of the stars of the stack that each stands for, in [0, 1].
    """

    mean: FloatArray
    product: FloatArray
    kernel: FloatArray
    share: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PopulationMoments:
    r"""First and second moments of the kernel of one star of a stack, for k binary fractions.

    Parameters
    ----------
    cut : float
        Separation from which a pair is resolved, in arcsec.
    binary_fraction : (k,) float array
        Before resolved pairs leave, in [0, 1].
    unresolved_fraction : (k,) float array
        Share of pairs among the stars of the stack, in [0, 1].
    removed_fraction : (k,) float array
        Share of pairs that are resolved or rejected among all pairs, in [0, 1]; the others are missed.
    rejected_fraction : (k,) float array
        Share of the stars that are no resolved pairs which a selection rejects, in [0, 1]; 0 without one.
    false_rejection_fraction : (k,) float array
        Share of single stars that a selection rejects, in [0, 1].
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
    powers : (k, 9, 9) float array
        :math:`\langle (4y)^j (r/r_{cut})^{2k} \rangle` over the stars, j and k from 0 to 8, with the weights of the
        stack; j = 0 counts pairs.  Dimensionless.  Of pairs alone, where there are triples.
    relative_error : (k,) float array
        Of the quadrature: the largest estimate among all powers with j and k above 0 and the mean
        moments, with a selection among x and x² alone; with triples at least the standard error of x or x² by them;
        dimensionless.
    triples : TripleMoments or None
        The part of triples in the moments; None where there are none.

    Notes
    -----
    The estimate of a power is its change between the rule in use and one of half the nodes, which is several times
    the error of the former: 1e-4 or less, the true error 1e-5.
    """

    cut: float
    binary_fraction: FloatArray
    unresolved_fraction: FloatArray
    removed_fraction: FloatArray
    rejected_fraction: FloatArray
    false_rejection_fraction: FloatArray
    mean_x: FloatArray
    mean_x2: FloatArray
    effective_share: FloatArray
    mean: FloatArray
    shift: FloatArray
    covariance: FloatArray
    powers: FloatArray
    relative_error: FloatArray
    triples: TripleMoments | None = None

    @property
    def missed_fraction(self) -> FloatArray:
        """Share of pairs that stay among all pairs, (k,), in [0, 1]."""
        return 1.0 - self.removed_fraction

    @property
    def equal_weights(self) -> bool:
        """Whether all stars count alike in the stack."""
        return bool(np.all(self.effective_share == 1.0))


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
    :math:`\langle x^k \rangle = \sum_i p_i E[x^k; r < r_{cut}]_i / \sum_i (1 - p_i P_{res,i})`; with a selection the
    expectation is over the pairs kept, and the denominator :math:`\sum_i [(1 - p_i) a_i + p_i K_i]` with the
    probabilities :math:`a_i, K_i` that single stars and pairs are kept.  With weights w a
    stack's moments are the ratio :math:`\sum w k / \sum w`: to first order in 1/N their mean is
    :math:`m - [\langle w^2 k\rangle - m \langle w^2\rangle] / (N \langle w\rangle^2)`, their covariance
    :math:`\langle w^2 (k - m)(k' - m')\rangle / (N \langle w\rangle^2)`, and the effective number is
    :math:`N \langle w\rangle^2/\langle w^2\rangle`.  Exact for equal weights.
    """
    fraction, number, w = population.law.multiplicity_fraction, population.abundance, population.weight
    scale = population.scale(binary_fraction)
    equal, of_pairs = bool(np.all(w == 1.0)), np.where(population.law.is_triple, 0.0, number)
    rows = [_star_sums(fraction, integrals, of_pairs * w, 0)]
    rows.append(rows[0] if equal else _star_sums(fraction, integrals, of_pairs * w**2, 0))
    rows.append(_star_sums(fraction, integrals, of_pairs * w, 1))
    rows.append(_star_counts(fraction, integrals, of_pairs))
    sums = _weighted_sums(np.unique(fraction), np.concatenate(rows, axis=1), scale)
    first, second, coarse, counts = np.split(sums, np.cumsum([r.shape[1] for r in rows[:-1]]), axis=1)
    averages = triple_averages(population)
    triples = None if averages is None else averages.sums(scale)
    if triples is not None:
        _count_triples(triples, first, second, counts)
    alone = number if integrals.single_kept is None else number * integrals.single_kept
    pairs, lost = counts[:, 0], counts[:, 1]
    kept = alone.sum() - lost
    if np.any(kept < _LEAST_KEPT * fraction.size):
        raise InputError(
            "must leave some pairs unresolved at this binary fraction", key="cut", value=population.cut
        )
    mean_w = ((alone * w).sum() - first[:, -1]) / kept
    mean_w2 = ((alone * w**2).sum() - second[:, -1]) / kept
    powers = _square(first, kept * mean_w)
    squares = _square(second, kept * mean_w**2)
    mean, weighted = _isotropic_means(powers, population.cut), _isotropic_means(squares, population.cut)
    products = _isotropic_products(squares, population.cut)
    part = None if triples is None else _triple_moments(triples, kept * mean_w, kept * mean_w**2)
    if part is not None and triples is not None:
        mean, products = mean + part.mean, products + part.product
        weighted = weighted + triples.mean[1] / (kept * mean_w**2)[:, None]
    spread = np.ones((kept.size, 1)) if equal else (mean_w2 / mean_w**2)[:, None]
    covariance = products - mean[:, :, None] * weighted[:, None, :] - weighted[:, :, None] * mean[:, None, :]
    covariance += spread[:, :, None] * mean[:, :, None] * mean[:, None, :]
    mean_x = powers[:, 1, 1] * population.cut**2 / 4 + (0.0 if part is None else _mean_x(part))
    mean_x2 = powers[:, 2, 2] * population.cut**4 / 16 + (0.0 if part is None else _mean_x2(part))
    error = _relative_error(powers, _square(coarse, kept * mean_w), integrals.joint is None)
    if triples is not None:
        total = np.stack([kept * mean_w * mean_x, kept * mean_w**2 * mean_x2])
        own = np.divide(triples.error, total, out=np.zeros_like(total), where=total > 0)
        error = np.maximum(error, own.max(axis=0))
    return PopulationMoments(
        cut=population.cut,
        binary_fraction=pairs / fraction.size,
        **_shares(counts, kept, fraction.size, alone.sum()),
        mean_x=mean_x,
        mean_x2=mean_x2,
        effective_share=1 / spread[:, 0],
        mean=mean,
        shift=spread * mean - weighted,
        covariance=covariance,
        powers=powers,
        relative_error=error,
        triples=part,
    )


def _count_triples(triples: TripleSums, first: FloatArray, second: FloatArray, counts: FloatArray) -> None:
    """Add triples, and the weight lost to them, to the sums over pairs of `_star_sums` and `_star_counts`."""
    lost = triples.number - triples.kept
    first[:, -1] += triples.lost[0]
    second[:, -1] += triples.lost[1]
    counts += np.stack([triples.number, lost, lost, lost, triples.number], axis=1)


def _triple_moments(triples: TripleSums, total: FloatArray, total2: FloatArray) -> TripleMoments:
    """The part of triples in the mean star, from sums and what these are divided by."""
    return TripleMoments(
        mean=triples.mean[0] / total[:, None],
        product=triples.product / total2[:, None, None],
        kernel=triples.kernel,
        share=triples.share / total[:, None],
    )


def _mean_x(part: TripleMoments) -> FloatArray:
    """Mean of x that triples make, (k,)."""
    return np.asarray(part.mean[:, _XX] + part.mean[:, _YY])


def _mean_x2(part: TripleMoments) -> FloatArray:
    """Mean of x² that triples make, (k,)."""
    p = part.product
    return np.asarray(p[:, _XX, _XX] + 2 * p[:, _XX, _YY] + p[:, _YY, _YY])


def _star_sums(fraction: FloatArray, integrals: PairIntegrals, weight: FloatArray, rule: int) -> FloatArray:
    """Sums over the stars of each multiplicity fraction, ascending: powers by a rule, and the weight lost to pairs."""
    values, which = np.unique(fraction, return_inverse=True)
    lost = np.bincount(which, weights=weight * integrals.lost, minlength=values.size)
    powers = integrals.sums_of_powers(weight, which, values.size, rule).reshape(-1, _POWERS)
    return np.concatenate([powers, lost[:, None]], axis=1)


def _star_counts(fraction: FloatArray, integrals: PairIntegrals, number: FloatArray) -> FloatArray:
    """Stars of each multiplicity fraction: all, what pairs lose against singles, resolved, removed, singles kept."""
    values, which = np.unique(fraction, return_inverse=True)
    alone = np.ones_like(fraction) if integrals.single_kept is None else integrals.single_kept
    columns = [np.ones_like(fraction), integrals.lost, 1 - integrals.unresolved, 1 - integrals.kept, alone]
    sums = [np.bincount(which, weights=number * c, minlength=values.size) for c in columns]
    return np.stack(sums, axis=1)


def _shares(counts: FloatArray, kept: FloatArray, n: int, alone: float) -> dict[str, FloatArray]:
    """Shares of pairs and single stars that stay and go, from the sums over pairs of `_star_counts`."""
    pairs, _, resolved, removed, alone_of_pairs = counts.T
    singles = n - pairs
    wrong = np.maximum(singles - (alone - alone_of_pairs), 0.0)

    def share(part: FloatArray, whole: FloatArray) -> FloatArray:
        out: FloatArray = np.divide(part, whole, out=np.zeros_like(pairs), where=whole > 1e-9 * n)
        return out

    return {
        "unresolved_fraction": (pairs - removed) / kept,
        "removed_fraction": share(removed, pairs),
        "rejected_fraction": share(np.maximum(n - resolved - kept, 0.0), n - resolved),
        "false_rejection_fraction": share(wrong, singles),
    }


def _weighted_sums(fraction: FloatArray, columns: FloatArray, scale: FloatArray) -> FloatArray:
    """Sums over groups of stars of min(1, s fraction) times each column, (k, column); fractions ascend."""
    zero = np.zeros((1, columns.shape[1]))
    scaled = np.concatenate([zero, np.cumsum(fraction[:, None] * columns, axis=0)])
    plain = np.concatenate([zero, np.cumsum(columns, axis=0)])
    with np.errstate(divide="ignore"):
        below = np.searchsorted(fraction, 1.0 / scale)
    sums: FloatArray = scale[:, None] * scaled[below] + plain[-1] - plain[below]
    return sums


def _square(sums: FloatArray, total: FloatArray) -> FloatArray:
    """Powers (k, 9, 9) of the mean star from the sums over stars."""
    return (sums[:, :_POWERS] / total[:, None]).reshape(-1, ORDER + 1, ORDER + 1)


def _relative_error(fine: FloatArray, coarse: FloatArray, smooth: bool) -> FloatArray:
    """Largest relative difference between two rules among powers of y r² and mean moments, (k,).

    Where a selection has an edge below the cut, high powers of r over the cut are small, badly known and of no
    consequence: of x and x² alone.
    """
    values = [
        np.concatenate([p[:, 1:, 1:].reshape(-1, ORDER**2), _isotropic_means(p, 1.0)[:, _SIZES]], axis=1)
        if smooth
        else p[:, [1, 2], [1, 2]]
        for p in (fine, coarse)
    ]
    difference = np.divide(
        np.abs(values[1] - values[0]), values[0], out=np.zeros_like(values[0]), where=values[0] > 0
    )
    error: FloatArray = difference.max(axis=1)
    return error


@cache
def _mean_of_powers() -> FloatArray:
    """What makes mean moments of powers, (n_moment, 81): odd orders vanish as kernels are turned at random."""
    out = np.zeros((N_MOMENTS, ORDER + 1, ORDER + 1))
    of_order = {n: coefficient_polynomial(n) for n in EVEN}
    for i, (a, b) in enumerate(INDICES):
        n = a + b
        if n % 2 == 0:
            out[i, :, n // 2] = of_order[n] * angular_mean(a, b)
    return out.reshape(-1, _POWERS)


@cache
def _product_of_powers() -> FloatArray:
    """What makes mean products of two moments of powers, (n_moment n_moment, 81)."""
    out = np.zeros((N_MOMENTS, N_MOMENTS, ORDER + 1, ORDER + 1))
    of_orders = {pair: coefficient_polynomial(*pair) for pair in PRODUCTS}
    for i, (a, b) in enumerate(INDICES):
        for j, (c, d) in enumerate(INDICES):
            n, m = sorted((a + b, c + d))
            if (n + m) % 2 == 0:
                out[i, j, :, (n + m) // 2] = of_orders[n, m] * angular_mean(a + c, b + d)
    return out.reshape(-1, _POWERS)


def _isotropic_means(powers: FloatArray, cut: float) -> FloatArray:
    """Mean moments (k, n_moment) of kernels turned at random."""
    mean: FloatArray = powers.reshape(-1, _POWERS) @ _mean_of_powers().T * cut**_ORDERS
    return mean


def _isotropic_products(powers: FloatArray, cut: float) -> FloatArray:
    """Mean products of moments (k, n_moment, n_moment) of kernels turned at random."""
    products = (powers.reshape(-1, _POWERS) @ _product_of_powers().T).reshape(-1, N_MOMENTS, N_MOMENTS)
    scaled: FloatArray = products * np.multiply.outer(cut**_ORDERS, cut**_ORDERS)
    return scaled
