r"""Statistics of many stacks per narrow range of binary fraction, merged without the stacks themselves.

A part of a run leaves the number, the mean and the central sums of second, third and fourth order of its changes
of shape.  Sums of several parts are exact functions of theirs: with n, mean and :math:`M_k = \sum (x - \bar x)^k`
of each part i and :math:`\delta_i = \bar x_i - \bar x`,

.. math:: M_2 = \sum_i M_{2,i} + n_i \delta_i^2, \qquad
          M_3 = \sum_i M_{3,i} + 3 \delta_i M_{2,i} + n_i \delta_i^3, \qquad
          M_4 = \sum_i M_{4,i} + 4 \delta_i M_{3,i} + 6 \delta_i^2 M_{2,i} + n_i \delta_i^4

(Chan et al. 1979, Pebay 2008).  No large numbers are subtracted, so nothing is lost, whatever the mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["FINE", "QUANTITIES", "STATISTICS", "Tally", "changes", "fine_bins", "merged", "tally"]

FINE = 300
"""Ranges of binary fraction of a stored tally: those of a summary in 1, 2, 3, 4, 5, 6, 10, 12, 15, 20, 25, 30, 50,
60, 75, 100, 150 or 300 ranges are made of them (count)."""

QUANTITIES = ("e1", "e2", "r2")
"""Changes that are counted, in the order of every array of three."""

STATISTICS = ("n_stacks", "count", "mean", "m2", "m3", "m4", "fraction", "fraction_m2")
"""Fields of a `Tally`, in the order of its array."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tally:
    """Statistics of the changes of shape of stacks, per range of binary fraction.

    Parameters
    ----------
    n_stacks : (n_psf, 3, n_bin) float array
        Stacks in the range (count).
    count : (n_psf, 3, n_bin) float array
        Those that could be measured, of which all that follows is (count).
    mean : (n_psf, 3, n_bin) float array
        Of the change, dimensionless; 0 where there is none.
    m2, m3, m4 : (n_psf, 3, n_bin) float array
        Sums of its powers about the mean, dimensionless.
    fraction, fraction_m2 : (n_psf, 3, n_bin) float array
        Mean binary fraction, in [0, 1], and the sum of squares about it.

    References
    ----------
    Chan1979, Pebay2008
    """

    n_stacks: FloatArray
    count: FloatArray
    mean: FloatArray
    m2: FloatArray
    m3: FloatArray
    m4: FloatArray
    fraction: FloatArray
    fraction_m2: FloatArray

    @classmethod
    def from_array(cls, values: FloatArray) -> Tally:
        """Tally that a store keeps.

        Parameters
        ----------
        values : (n_psf, 3, 8, n_bin) float array
            In the order of `STATISTICS`, dimensionless; with an axis before these where there are several tallies.

        Returns
        -------
        tally : Tally
            The same numbers.
        """
        return cls(**{name: values[..., k, :] for k, name in enumerate(STATISTICS)})

    def to_array(self) -> FloatArray:
        """Array that `from_array` reads, (n_psf, 3, 8, n_bin).

        Returns
        -------
        values : (n_psf, 3, 8, n_bin) float array
            Dimensionless.
        """
        return np.stack([getattr(self, name) for name in STATISTICS], axis=-2)

    def rebinned(self, bins: int) -> Tally:
        """The same stacks in fewer ranges.

        Parameters
        ----------
        bins : int
            A divisor of the present number of ranges (count).

        Returns
        -------
        tally : Tally
            With that many ranges.
        """
        fields = {name: getattr(self, name) for name in STATISTICS}
        return _merge({k: v.reshape(*v.shape[:-1], bins, -1) for k, v in fields.items()}, axis=-1)


def fine_bins(bins: int) -> int:
    """The number of ranges to count in for a summary in `bins` ranges.

    Parameters
    ----------
    bins : int
        Ranges of the summary (count).

    Returns
    -------
    fine : int
        A multiple of it (count), `FINE` or the next one above.
    """
    return bins * -(-FINE // bins)


def changes(shapes: FloatArray, alone: FloatArray) -> FloatArray:
    """Changes of shape of stacks against the PSF without companions.

    Parameters
    ----------
    shapes : (3, n_psf, n) float array
        e1, e2 and r2 of the stacks; r2 in arcsec².
    alone : (3, n_psf) float array
        Of the PSF without companions, measured the same way; r2 in arcsec².

    Returns
    -------
    change : (n_psf, 3, n) float array
        Stack minus PSF, r2 over that of the PSF; dimensionless.
    """
    change = (shapes - alone[:, :, None]).swapaxes(0, 1)
    change[:, 2] /= alone[2, :, None]
    return change


def tally(binary_fraction: FloatArray, change: FloatArray, bins: int = FINE) -> Tally:
    """Statistics of the changes of shape of some stacks.

    Parameters
    ----------
    binary_fraction : (n,) float array
        Of each stack, in [0, 1].
    change : (n_psf, 3, n) float array
        From `changes`, dimensionless; NaN where it could not be measured.
    bins : int
        Number of equal ranges between 0 and 1, each but the last half-open (count).

    Returns
    -------
    tally : Tally
        In two passes: first the means, then the powers about them.
    """
    edges = np.arange(bins + 1) / bins  # so that 0.35 is an edge of 20 bins
    which = np.clip(np.searchsorted(edges, binary_fraction, side="right") - 1, 0, bins - 1)
    values = np.zeros((*change.shape[:2], len(STATISTICS), bins))
    values[:, :, 0] = np.bincount(which, minlength=bins)
    _count(which, binary_fraction, np.ascontiguousarray(change), values)
    return Tally.from_array(values)


@njit(cache=True)
def _count(which, fraction, change, values):  # type: ignore[no-untyped-def]
    """Fill the statistics from the second on, (n_psf, 3, 8, n_bin), in two passes over each row of changes.

    The first pass finds the mean but for its rounding, which the second measures and takes out.
    """
    for p in range(change.shape[0]):
        for q in range(change.shape[1]):
            row, out = change[p, q], values[p, q]
            for s in range(row.size):
                if np.isfinite(row[s]):
                    out[1, which[s]] += 1.0
                    out[2, which[s]] += row[s]
                    out[6, which[s]] += fraction[s]
            for k in range(out.shape[1]):
                if out[1, k] > 0.0:
                    out[2, k] /= out[1, k]
                    out[6, k] /= out[1, k]
            rounding = np.zeros(out.shape[1])
            for s in range(row.size):
                if np.isfinite(row[s]):
                    k = which[s]
                    d, f = row[s] - out[2, k], fraction[s] - out[6, k]
                    rounding[k] += d
                    out[3, k] += d * d
                    out[4, k] += d * d * d
                    out[5, k] += d * d * d * d
                    out[7, k] += f * f
            for k in range(out.shape[1]):
                if out[1, k] > 0.0:
                    e = rounding[k] / out[1, k]
                    out[2, k] += e
                    out[5, k] -= 4.0 * e * out[4, k]
                    out[4, k] -= 3.0 * e * out[3, k]


def merged(parts: Tally) -> Tally:
    """Statistics of the stacks of several tallies.

    Parameters
    ----------
    parts : Tally
        Several, along the first axis of its arrays.

    Returns
    -------
    tally : Tally
        As if all had been counted together, to rounding.
    """
    return _merge({name: getattr(parts, name) for name in STATISTICS}, axis=0)


def _merge(parts: dict[str, Any], axis: int) -> Tally:
    """Parts along an axis as one."""
    n = parts["count"]
    count = n.sum(axis=axis)

    def centred(name: str) -> tuple[FloatArray, FloatArray]:
        mean = (n * parts[name]).sum(axis=axis) / np.maximum(count, 1)
        return mean, np.where(n > 0, parts[name] - np.expand_dims(mean, axis), 0.0)

    mean, d = centred("mean")
    fraction, f = centred("fraction")
    m2, m3, m4 = parts["m2"], parts["m3"], parts["m4"]
    return Tally(
        n_stacks=parts["n_stacks"].sum(axis=axis),
        count=count,
        mean=mean,
        m2=(m2 + n * d**2).sum(axis=axis),
        m3=(m3 + 3 * d * m2 + n * d**3).sum(axis=axis),
        m4=(m4 + 4 * d * m3 + 6 * d**2 * m2 + n * d**4).sum(axis=axis),
        fraction=fraction,
        fraction_m2=(parts["fraction_m2"] + n * f**2).sum(axis=axis),
    )
