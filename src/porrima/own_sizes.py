r"""Stars of a population by the change of size that each shows by itself, with what each adds to a stack.

A clip looks at a star's own change of size and at nothing else, so that pairs of any separation and flux ratio may be
sorted by it once: what any clip with any noise leaves is then a sum over one axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

from porrima.clip import shape_grid
from porrima.prediction import QUANTITIES
from porrima.screen import FOUR_Y, SQUARE, flux_ratio_of
from porrima.singles import ANGLES, pair_moments

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from porrima.clipping import PairCounts
    from porrima.response import Response

    FloatArray = NDArray[np.float64]

__all__ = ["OwnSizes", "Sorting", "own_sizes", "sorting", "together"]

MAGNITUDE_STEP = 0.25
"""Width of a group of magnitudes whose noise is one, in mag: it differs by 6 % at most from that in the middle."""

SMALLEST = 1e-5
"""Change of size next to 0 (dimensionless): a tenth of the noise of the brightest star of a survey, or less."""

PER_DECADE = 60
"""Nodes of the change of size in a decade (count)."""

_PARTS = 4  # of a cell of separation that are sorted apart


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnSizes:
    r"""Stars by their own change of size, in groups of magnitude.

    Parameters
    ----------
    magnitude : (n_m,) float array
        Mean of each group, in mag.
    change : (n_u,) float array
        Nodes of a star's own :math:`\delta R^2/R_0^2`, ascending from 0, dimensionless.
    number : (n_m, n_u) float array
        Stars at each node, single ones at 0, dimensionless.
    added : (n_m, n_u, 3) float array
        Their number times the mean of what each adds to e1, e2 and R² over R0² of a stack, dimensionless.
    squared : (n_m, n_u, 3) float array
        Their number times the mean square of it.
    spread : (n_m, n_u) float array
        Standard deviation of the own change of size with the position angle, dimensionless.
    x : (n_m, n_u) float array
        Their number times the mean of x, in arcsec².
    total : float
        All stars, resolved pairs included, in the unit of their number, dimensionless.
    """

    magnitude: FloatArray
    change: FloatArray
    number: FloatArray
    added: FloatArray
    squared: FloatArray
    spread: FloatArray
    x: FloatArray
    total: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sorting:
    """What pairs show and add, on the screen's nodes: one serves all stars behind a PSF that have the same cut.

    Parameters
    ----------
    cut : float
        In arcsec.
    change, spread : (n_f, n_r) float array
        Own change of size on nodes of 4 y and (r/cut)², mean and standard deviation over position angle, dimensionless.
    per_x : (n_f, n_r - 1, 6) float array
        What a pair adds to e1, e2 and R² over R0² over its x, and the mean square over x², between two nodes of
        separation, in arcsec^-2 and arcsec^-4.
    """

    cut: float
    change: FloatArray
    spread: FloatArray
    per_x: FloatArray


def sorting(response: Response, cut: float) -> Sorting:
    """What pairs show and add behind a PSF.

    Parameters
    ----------
    response : Response
        Of the PSF and estimator.
    cut : float
        Separation from which pairs are resolved, in arcsec.

    Returns
    -------
    sorting : Sorting
        For `own_sizes`.

    Raises
    ------
    InputError
        If the cut is too wide for kernel moments.
    """
    own = shape_grid(response, "r2", cut * np.sqrt(SQUARE), flux_ratio_of(FOUR_Y))
    derivative = response.first / np.array([[1.0], [1.0], [float(response.shape0.r2)]])
    square = 0.5 * (SQUARE[1:] + SQUARE[:-1])
    r, angle = np.meshgrid(
        cut * np.sqrt(square), 2 * math.pi * (np.arange(ANGLES) + 0.5) / ANGLES, indexing="ij"
    )
    rows = []
    for y in np.append(FOUR_Y[1], FOUR_Y[1:]):  # a dark companion adds nothing, whatever stands there
        kernel = pair_moments(np.full(r.size, y), r.ravel(), angle.ravel())
        x = 0.25 * y * cut**2 * square[:, None, None]
        added = (kernel @ derivative.T).reshape(square.size, ANGLES, -1) / x
        rows.append(np.concatenate([added.mean(axis=1), (added**2).mean(axis=1)], axis=1))
    return Sorting(cut=cut, change=own.mean, spread=own.spread, per_x=np.array(rows))


def own_sizes(counts: PairCounts, sorted_by: Sorting, magnitude: tuple[float, float]) -> OwnSizes:
    r"""Stars sorted by the change of size that they show by themselves.

    Parameters
    ----------
    counts : PairCounts
        Of a population with the same cut.
    sorted_by : Sorting
        Behind the PSF.
    magnitude : (float, float)
        Range that is cut into groups, those of all samples of a range alike, in mag.

    Returns
    -------
    sizes : OwnSizes
        Dimensionless.

    Notes
    -----
    A star's own change is solved exactly (`clip.own_shape`); to a long stack it adds :math:`A k/N` with the response's
    first derivative A and its kernel moments k to order 8.
    """
    own, spread, per_x = (
        _between(counts.four_y, part) for part in (sorted_by.change, sorted_by.spread, sorted_by.per_x)
    )
    top = math.ceil(PER_DECADE * math.log10(1.001 * own.max() / SMALLEST)) + 1
    change = np.append(0.0, SMALLEST * 10 ** (np.arange(top + 1) / PER_DECADE))
    n_groups = math.ceil((magnitude[1] - magnitude[0]) / MAGNITUDE_STEP - 1e-6)
    edge = np.linspace(*magnitude, n_groups + 1)
    group = np.clip(np.searchsorted(edge, counts.magnitude, side="right") - 1, 0, n_groups - 1)
    into = (np.arange(n_groups)[:, None] == group).astype(float)  # (group, node of magnitude)
    powers = np.tensordot(into, counts.powers, 1)
    stars = counts.single + counts.powers[:, :, 0, :, 0].sum(axis=(1, 2))
    in_group, middle = into @ stars, 0.5 * (edge[1:] + edge[:-1])
    sums = np.zeros((n_groups, change.size, 3 + 2 * len(QUANTITIES)))
    _sorted(powers, own, spread, per_x, change, sums)
    sums[:, 0, 0] += into @ counts.single
    number, scale = sums[..., 0], counts.cut**2 / 4
    return OwnSizes(
        magnitude=np.divide(into @ (stars * counts.magnitude), in_group, out=middle, where=in_group > 0),
        change=change,
        number=number,
        added=sums[..., 3:6] * scale,
        squared=sums[..., 6:9] * scale**2,
        spread=_spread(sums[..., 1], number, change),
        x=sums[..., 2] * scale,
        total=float(counts.single.sum() + counts.pairs),
    )


def together(parts: Sequence[OwnSizes]) -> OwnSizes:
    """Samples of stars of one range of magnitude as one.

    Parameters
    ----------
    parts : sequence of OwnSizes
        Behind the same response, with the same groups.

    Returns
    -------
    sizes : OwnSizes
        Their sums, dimensionless.
    """
    number = np.array([part.number for part in parts])
    summed = {
        name: np.sum([getattr(part, name) for part in parts], axis=0) for name in ("added", "squared", "x")
    }
    weight = number.sum(axis=2)
    middle = np.array([part.magnitude for part in parts])
    spread = np.sum(number * np.array([part.spread for part in parts]) ** 2, axis=0)
    total = number.sum(axis=0)
    return OwnSizes(
        magnitude=(weight * middle).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-300),
        change=parts[0].change,
        number=total,
        spread=_spread(spread, total, parts[0].change),
        total=sum(part.total for part in parts),
        **summed,
    )


def _spread(squares: FloatArray, number: FloatArray, change: FloatArray) -> FloatArray:
    """Root mean square over pairs, no more than the change itself: what leans in a cell may leave next to none."""
    mean = np.divide(squares, number, out=np.zeros_like(number), where=number > 0)
    return np.minimum(np.sqrt(np.maximum(mean, 0.0)), change)


def _between(four_y: FloatArray, values: FloatArray) -> FloatArray:
    """Values (n_f, ...) on the screen's nodes of 4 y at others, between which they are linear."""
    columns = values.reshape(FOUR_Y.size, -1).T
    found = np.stack([np.interp(four_y, FOUR_Y, column) for column in columns], axis=1)
    return found.reshape(four_y.size, *values.shape[1:])


@njit(cache=True, parallel=True)
def _sorted(powers, mean, spread, per_x, change, out):  # type: ignore[no-untyped-def]
    """Add the cells of each group to the nodes of the change of size on either side."""
    low, per = math.log(change[1]), 1.0 / math.log(change[2] / change[1])
    for g in prange(powers.shape[0]):
        content = np.empty(3)
        for f in range(powers.shape[1]):
            for c in range(powers.shape[3]):
                if powers[g, f, 0, c, 0] <= 0.0:
                    continue
                for part in range(_PARTS):
                    a, b = part / _PARTS - 0.5, (part + 1) / _PARTS - 0.5
                    s = 0.5 * (a + b) + 0.5
                    for k in range(3):
                        content[k] = powers[g, f, 0, c, k] * (b - a)
                        content[k] += powers[g, f, 1, c, k] * 0.5 * (b * b - a * a)
                    u = (1.0 - s) * mean[f, c] + s * mean[f, c + 1]
                    wide = (1.0 - s) * spread[f, c] + s * spread[f, c + 1]
                    node = 0 if u < change[1] else 1 + int((math.log(u) - low) * per)
                    node = min(max(node, 0), change.size - 2)
                    upper = (u - change[node]) / (change[node + 1] - change[node])
                    upper = min(max(upper, 0.0), 1.0)
                    for side in range(2):
                        share = upper if side else 1.0 - upper
                        row = out[g, node + side]
                        row[0] += share * content[0]
                        row[1] += share * content[0] * wide * wide
                        row[2] += share * content[1]
                        for q in range(3):
                            row[3 + q] += share * content[1] * per_x[f, c, q]
                            row[6 + q] += share * content[2] * per_x[f, c, 3 + q]
