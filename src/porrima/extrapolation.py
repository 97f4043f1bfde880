r"""The true shape of a PSF from stars that companions change by different amounts, whatever the amplitude.

Stars of several ranges of magnitude, stars left by several thresholds of rejection, or fields of low and high binary
fraction see one PSF.  The change :math:`s_k` that is predicted for sample k may be wrong by one factor A: measured
shapes :math:`y_k = y_0 + A s_k` give both, the shape at no change and the amplitude, by generalised least squares.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from porrima.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["Extrapolation", "Split", "best_split", "extrapolate", "forecast", "sample_covariance"]

_LEAST_LEVER = 1e-6  # spread of the changes over the largest, below which they are one number


@dataclass(frozen=True, slots=True, kw_only=True)
class Extrapolation:
    """True shape and amplitude from k samples of stars, each with q quantities.

    Parameters
    ----------
    shape : (q,) float array
        At no change, in the unit of the measured quantities.
    amplitude : float
        Of the change, over the predicted one (dimensionless).
    covariance : (q + 1, q + 1) float array
        Of the q quantities and the amplitude, in their units.
    chi2 : float
        Of the fit (dimensionless).
    n_dof : int
        Degrees of freedom (count).
    residual : (k, q) float array
        Measured minus fitted, in the unit of the quantities.
    """

    shape: FloatArray
    amplitude: float
    covariance: FloatArray
    chi2: float
    n_dof: int
    residual: FloatArray

    @property
    def error(self) -> FloatArray:
        """Standard error of the shape, (q,), in the unit of the quantities."""
        return np.sqrt(np.diag(self.covariance)[:-1])

    @property
    def amplitude_error(self) -> float:
        """Standard error of the amplitude (dimensionless)."""
        return float(np.sqrt(self.covariance[-1, -1]))


def sample_covariance(
    per_star: FloatArray, n_stars: NDArray[np.int64], nested: bool = False, error: FloatArray | None = None
) -> FloatArray:
    r"""Covariance of the mean shapes of samples of stars.

    Parameters
    ----------
    per_star : (k, q, q) float array
        Covariance of what one star of each sample adds, in the units of the quantities, multiplied; N times the
        covariance of stacks of N stars.
    n_stars : (k,) int array
        Stars in each sample (count).
    nested : bool
        Whether each sample is part of all larger ones, as the stars left by thresholds of rejection are.
    error : (k, q) float array, optional
        Standard errors of other origin, independent between samples, in the units of the quantities.

    Returns
    -------
    covariance : (k q, k q) float array
        In the units of the quantities, multiplied; all quantities of the first sample come first.

    Raises
    ------
    InputError
        If a number of stars is below 1.

    Notes
    -----
    The mean of a large sample L of N stars is that of its part S and that of the rest, weighted with their numbers, and
    the rest is independent: :math:`\mathrm{cov}(\bar y_S, \bar y_L) = C_S/N_L` with the covariance of one star *of the
    smaller sample*.  Exact for means, whether the number in S is fixed or not; shapes follow to first order.
    """
    if np.any(n_stars < 1):
        raise InputError("must be at least 1", key="n_stars", value=int(n_stars.min()))
    k, q = per_star.shape[:2]
    covariance = np.zeros((k, q, k, q))
    for i, j in itertools.product(range(k), repeat=2):
        if i == j or nested:
            small = i if n_stars[i] <= n_stars[j] else j
            covariance[i, :, j, :] = per_star[small] / max(n_stars[i], n_stars[j])
    total = covariance.reshape(k * q, k * q)
    if error is not None:
        total += np.diag(error.ravel() ** 2)
    return total


def extrapolate(
    measured: FloatArray, change: FloatArray, covariance: FloatArray, shape_error: FloatArray | None = None
) -> Extrapolation:
    r"""True shape and amplitude of the change, by generalised least squares.

    Parameters
    ----------
    measured : (k, q) float array
        Shapes of k samples, such as R² in arcsec².
    change : (k, q) float array
        Predicted change of each, in the same units.
    covariance : (k q, k q) float array
        Of the measured shapes, from `sample_covariance`.
    shape_error : (n, k, q) float array, optional
        Changes of the prediction by n independent errors of the model, of one standard deviation each.

    Returns
    -------
    extrapolation : Extrapolation
        In the units of the quantities.

    Raises
    ------
    InputError
        If there are fewer than two samples, or their changes do not differ.

    Notes
    -----
    With the design X (one column for each quantity and one of the changes) and the covariance C,
    :math:`\hat p = (X^T C^{-1} X)^{-1} X^T C^{-1} y` with covariance :math:`(X^T C^{-1} X)^{-1}`.  An error of the
    model adds :math:`d d^T` to C with what it does to the changes, d; the part of it that is a factor on all changes
    then is the amplitude's, and does not touch the shape.
    """
    design, weighted, inverse = _normal_equations(change, covariance, shape_error)
    y = measured.ravel()
    found = inverse @ (weighted @ y)
    left = y - design @ found
    whitened = np.linalg.solve(_with_model(covariance, shape_error), left)
    return Extrapolation(
        shape=found[:-1],
        amplitude=float(found[-1]),
        covariance=inverse,
        chi2=float(left @ whitened),
        n_dof=y.size - found.size,
        residual=left.reshape(measured.shape),
    )


def forecast(change: FloatArray, covariance: FloatArray, shape_error: FloatArray | None = None) -> FloatArray:
    """Covariance that an extrapolation will have, before anything is measured.

    Parameters
    ----------
    change : (k, q) float array
        Predicted change of each sample, in the units of the quantities, such as arcsec².
    covariance : (k q, k q) float array
        Of the shapes to be measured, in the same units.
    shape_error : (n, k, q) float array, optional
        As for `extrapolate`.

    Returns
    -------
    covariance : (q + 1, q + 1) float array
        Of the q quantities and the amplitude.

    Raises
    ------
    InputError
        As `extrapolate`.
    """
    return _normal_equations(change, covariance, shape_error)[2]


def _with_model(covariance: FloatArray, shape_error: FloatArray | None) -> FloatArray:
    """Covariance of the measured shapes about the predicted ones, with what the model does not know."""
    if shape_error is None:
        return covariance
    moved = shape_error.reshape(shape_error.shape[0], -1)
    total: FloatArray = covariance + moved.T @ moved
    return total


def _normal_equations(
    change: FloatArray, covariance: FloatArray, shape_error: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Design (k q, q + 1), it times the inverse covariance, and the covariance of the result."""
    k, q = change.shape
    if k < 2:
        raise InputError(
            "must be at least 2, of stars that companions change by different amounts", key="samples", value=k
        )
    apart = np.ptp(change, axis=0)
    if not np.any(apart > _LEAST_LEVER * np.abs(change).max(axis=0)):
        raise InputError(
            "must differ in the predicted change, or there is nothing to extrapolate", key="samples"
        )
    design = np.column_stack([np.tile(np.eye(q), (k, 1)), change.ravel()])
    weighted = np.asarray(np.linalg.solve(_with_model(covariance, shape_error), design).T, dtype=float)
    inverse = np.asarray(np.linalg.inv(weighted @ design), dtype=float)
    return design, weighted, 0.5 * (inverse + inverse.T)


@dataclass(frozen=True, slots=True, kw_only=True)
class Split:
    """How stars are best shared between samples.

    Parameters
    ----------
    share : (k,) float array
        Of the stars in each sample, in [0, 1], sum 1; two at most are not 0.
    error : float
        Standard error of the true size from one star in all, in the unit of the changes: over the root of N for N.
    """

    share: FloatArray
    error: float


def best_split(change: FloatArray, sd: FloatArray) -> Split:
    r"""The shares of stars that give the true size the smallest error.

    Parameters
    ----------
    change : (k,) float array
        Predicted change of size of each sample, in arcsec² or over the size.
    sd : (k,) float array
        Standard deviation of what one star adds, in the same unit, positive.

    Returns
    -------
    split : Split
        In the same unit.

    Raises
    ------
    InputError
        If no two samples differ in the change.

    Notes
    -----
    Two samples of N stars in all give :math:`y_0 = (s_2 y_1 - s_1 y_2)/(s_2 - s_1)`, best with
    :math:`N_1 : N_2 = |s_2| \sigma_1 : |s_1| \sigma_2`, and then
    :math:`\sigma(y_0) = (|s_2| \sigma_1 + |s_1| \sigma_2)/(|s_2 - s_1| \sqrt N)`.  For two parameters no more than two
    samples are needed (Elfving 1952), so all pairs are tried.

    References
    ----------
    Elfving1952
    """
    best = Split(share=np.zeros(change.size), error=np.inf)
    for i, j in itertools.combinations(range(change.size), 2):
        apart = abs(change[j] - change[i])
        if not apart > _LEAST_LEVER * np.abs(change).max():
            continue
        weight = np.array([abs(change[j]) * sd[i], abs(change[i]) * sd[j]])
        error = float(weight.sum() / apart)
        if error < best.error:
            share = np.zeros(change.size)
            share[[i, j]] = weight / weight.sum()
            best = Split(share=share, error=error)
    if not np.isfinite(best.error):
        raise InputError(
            "must differ in the predicted change, or there is nothing to extrapolate", key="samples"
        )
    return best
