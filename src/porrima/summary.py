"""From many stacks to numbers: bias and error with their standard errors, per range of binary fraction.

The stacks are not all in memory at any time: what is needed of them is in the tallies of their chunks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from porrima.prediction import QUANTITIES, integrate, population_moments, predict
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.shapes import estimator_from_name
from porrima.tallies import Tally, changes, fine_bins, merged, tally

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from porrima.config import RunConfig
    from porrima.prediction import PairIntegrals
    from porrima.store import FinishedRun
    from porrima.systems import Population

    FloatArray = NDArray[np.float64]

__all__ = ["STATISTICS", "predicted_curves", "rows", "summarise"]

STATISTICS = (
    "bias", "bias_se", "sigma", "sigma_se", "sd", "sd_se",
    "prediction_bias", "prediction_sigma", "prediction_sd",
)  # fmt: skip
"""What is given for each PSF, quantity and bin."""

_NODES = 1001  # of the predicted curves between 0 and 1
_BLOCK = 16  # tallies read at once
_STACKS = 10_000  # stacks read at once, where there is no tally of them


def statistics(counted: Tally) -> dict[str, FloatArray]:
    r"""Bias and errors of measured quantities over stacks, with standard errors.

    Parameters
    ----------
    counted : Tally
        Of the changes of each range of binary fraction, dimensionless.

    Returns
    -------
    statistics : dict
        ``bias``, ``sigma`` (rms about no change), ``sd`` (about the mean) and the standard error of each, each a
        (n_psf, 3, n_bin) array; NaN where fewer than two stacks are left.

    Notes
    -----
    :math:`\sigma^2 = \sum_s \delta_s^2 / (N_s - 1)` (KCM16, Eq. 10).  The companions' x is heavy-tailed, so the
    standard errors take the fourth moment of the sample: with central sums :math:`M_k` and the mean :math:`\mu`,
    :math:`var(s^2) = [M_4/n - s^4 (n-3)/(n-1)]/n`, and
    :math:`(n - 1)\, var(\delta^2) = M_4 - M_2^2/n + 4\mu M_3 + 4\mu^2 M_2`; the standard error of a root is that of
    its square over twice the root.

    References
    ----------
    KCM16
    """
    enough = counted.count >= 2
    n = np.where(enough, counted.count, np.nan)
    mean, m2, m3, m4 = counted.mean, counted.m2, counted.m3, counted.m4
    variance = m2 / (n - 1)
    variance_of_variance = np.maximum(m4 / n - variance**2 * (n - 3) / (n - 1), 0.0) / n
    square = (m2 + n * mean**2) / (n - 1)
    of_squares = np.maximum(m4 - m2**2 / n + 4 * mean * m3 + 4 * mean**2 * m2, 0.0)
    variance_of_square = of_squares / (n - 1) / n
    return {
        "bias": np.where(enough, mean, np.nan),
        "bias_se": np.sqrt(variance / n),
        "sigma": np.sqrt(square),
        "sigma_se": _of_root(variance_of_square, square),
        "sd": np.sqrt(variance),
        "sd_se": _of_root(variance_of_variance, variance),
    }


def _of_root(variance: FloatArray, square: FloatArray) -> FloatArray:
    """Standard error of the root of a number with this variance; 0 where the number is."""
    root = 2 * np.sqrt(square)
    out: FloatArray = np.where(np.isnan(root), root, 0.0)
    np.divide(np.sqrt(variance), root, out=out, where=root > 0)
    return out


def predicted_curves(
    population: Population,
    config: RunConfig,
    n_stars: int | None,
    fractions: FloatArray | None = None,
    integrals: PairIntegrals | None = None,
) -> xr.Dataset:
    """Predicted bias and scatter of a run against binary fraction.

    Parameters
    ----------
    population : Population
        Of the run.
    config : RunConfig
        Names the PSFs and the estimator.
    n_stars : int or None
        Stars in a stack (count); None for infinitely many.
    fractions : (k,) float array, optional
        Binary fractions, in [0, 1]; a fine grid where not given.
    integrals : PairIntegrals, optional
        Of the population, where they are known already.

    Returns
    -------
    curves : Dataset
        ``bias``, ``sd``, ``sigma`` over (psf, quantity, binary_fraction), dimensionless.
    """
    grid = np.linspace(0.0, 1.0, _NODES) if fractions is None else fractions
    moments = population_moments(population, integrals or integrate(population), grid)
    estimator = estimator_from_name(config.estimator)
    psfs = [psf_from_name(name, **config.psf_options) for name in config.psf]
    predictions = [predict(moments, response(psf, estimator), n_stars) for psf in psfs]
    dimensions = ("psf", "quantity", "binary_fraction")
    return xr.Dataset(
        {
            name: (dimensions, np.stack([getattr(p, name) for p in predictions]))
            for name in ("bias", "sd", "sigma")
        },
        coords={"psf": list(config.psf), "quantity": list(QUANTITIES), "binary_fraction": grid},
    )


def summarise(run: FinishedRun, bins: int = 20, integrals: PairIntegrals | None = None) -> xr.Dataset:
    """Bias and error in bins of binary fraction, with what is predicted for the same stacks.

    Parameters
    ----------
    run : FinishedRun
        From `store.open_run`.
    bins : int
        Number of equal ranges between 0 and 1 (count), at least 1.
    integrals : PairIntegrals, optional
        Of the population, where they are known already.

    Returns
    -------
    summary : Dataset
        `STATISTICS` over (psf, quantity, bin), dimensionless; ``f_lo``, ``f_hi``, ``n_stacks`` and
        ``n_failed`` (stacks that could not be measured) per bin.

    Raises
    ------
    ValueError
        If there are no bins.

    Notes
    -----
    A prediction is averaged over the binary fractions of the bin's own stacks: the mean of the bias, and by
    the law of total variance the mean of the variance plus the variance of the bias.  Where `bins` divides
    `tallies.FINE`, the tallies in the store say all and no stack is read.
    """
    if bins < 1:
        raise ValueError(f"bins must be at least 1, got {bins}")
    fine = _tally_of(run, fine_bins(bins))
    coarse, edges = fine.rebinned(bins), np.arange(bins + 1) / bins
    numbers = statistics(coarse) | _predictions(run, fine, bins, integrals)
    n_failed = coarse.n_stacks[:, -1] - coarse.count[:, -1]
    return xr.Dataset(
        {name: (("psf", "quantity", "bin"), numbers[name]) for name in STATISTICS}
        | {
            "n_stacks": ("bin", coarse.n_stacks[0, 0].astype(int)),
            "n_failed": (("psf", "bin"), n_failed.astype(int)),
        },
        coords={
            "psf": list(run.config.psf),
            "quantity": list(QUANTITIES),
            "f_lo": ("bin", edges[:-1]),
            "f_hi": ("bin", edges[1:]),
        },
    )


def rows(summary: xr.Dataset) -> list[dict[str, Any]]:
    """One plain dict per PSF, quantity and bin that holds stacks, for JSON and tables.

    Parameters
    ----------
    summary : Dataset
        From `summarise`.

    Returns
    -------
    rows : list of dict
        Keys ``psf, quantity, f_lo, f_hi, n_stacks, n_failed`` (stacks that could not be measured, and are left
        out) and `STATISTICS`, dimensionless; NaN where fewer than two stacks are left.
    """
    psfs, quantities = summary["psf"].to_numpy().tolist(), summary["quantity"].to_numpy().tolist()
    low, high, n_stacks = (summary[name].to_numpy().tolist() for name in ("f_lo", "f_hi", "n_stacks"))
    n_failed = summary["n_failed"].to_numpy().tolist()
    numbers = {
        name: summary[name].transpose("psf", "quantity", "bin").to_numpy().tolist() for name in STATISTICS
    }
    return [
        {
            "psf": str(psf),
            "quantity": quantity,
            "f_lo": low[k],
            "f_hi": high[k],
            "n_stacks": n_stacks[k],
            "n_failed": n_failed[p][k],
        }
        | {name: values[p][quantities.index(quantity)][k] for name, values in numbers.items()}
        for p, psf in enumerate(psfs)
        for quantity in ("r2", "e1", "e2")
        for k in range(len(n_stacks))
        if n_stacks[k] > 0
    ]


def _tally_of(run: FinishedRun, bins: int) -> Tally:
    """Tally of all stacks of a run in that many ranges, some chunks at a time and always in the same order."""
    blocks = _stored(run.dataset) if bins == run.dataset.sizes.get("bin") else _counted(run.dataset, bins)
    total = next(blocks)
    for block in blocks:
        total = merged(Tally.from_array(np.stack([total.to_array(), block.to_array()])))
    return total


def _stored(dataset: xr.Dataset) -> Iterator[Tally]:
    """Tallies that the store keeps, some chunks as one."""
    for first in range(0, dataset.sizes["chunk"], _BLOCK):
        yield merged(Tally.from_array(dataset["tally"][first : first + _BLOCK].to_numpy()))


def _counted(dataset: xr.Dataset, bins: int) -> Iterator[Tally]:
    """Tallies counted now, from some stacks after the others."""
    alone = np.stack([dataset[f"{name}_0"].to_numpy() for name in QUANTITIES])
    chunk = dataset["binary_fraction"].encoding.get("chunks", (_STACKS,))[0]
    step = chunk * -(-_STACKS // chunk)
    for first in range(0, dataset.sizes["stack"], step):
        some = slice(first, first + step)
        shapes = np.stack([dataset[name][:, some].to_numpy() for name in QUANTITIES])
        yield tally(dataset["binary_fraction"][some].to_numpy(), changes(shapes, alone), bins)


def _predictions(
    run: FinishedRun, fine: Tally, bins: int, integrals: PairIntegrals | None
) -> dict[str, FloatArray]:
    """Predictions for the stacks of each of fewer ranges, from where the stacks of the fine ones lie in them.

    In a fine range a curve is a parabola through its two ends and its middle, so that the mean of the stacks'
    binary fractions and the mean of their squares give its mean.
    """
    n = fine.count
    n_fine = n.shape[-1]
    uniform = run.config.binary_fraction == "uniform"
    fraction = np.arange(2 * n_fine + 1) / (2 * n_fine) if uniform else fine.fraction[n > 0][:1]
    curves = predicted_curves(run.population, run.config, run.config.n_stars, fraction, integrals)
    place = fine.fraction * n_fine - np.arange(n_fine)  # 0 to 1 in the range
    place2 = place**2 + fine.fraction_m2 / np.maximum(n, 1) * n_fine**2

    def average(curve: FloatArray) -> FloatArray:
        if uniform:
            low, middle, high = curve[..., :-1:2], curve[..., 1::2], curve[..., 2::2]
            slope, bend = 4 * middle - 3 * low - high, 2 * (low - 2 * middle + high)
            curve = low + slope * place + bend * place2
        total = np.where(n > 0, n * curve, 0.0).reshape(*n.shape[:2], bins, -1).sum(axis=-1)
        count = n.reshape(*n.shape[:2], bins, -1).sum(axis=-1)
        out: FloatArray = np.full_like(total, np.nan)
        np.divide(total, count, out=out, where=count >= 2)
        return out

    bias, sd = curves["bias"].to_numpy(), curves["sd"].to_numpy()
    mean, square, variance = average(bias), average(bias**2), average(sd**2)
    return {
        "prediction_bias": mean,
        "prediction_sigma": np.sqrt(variance + square),
        "prediction_sd": np.sqrt(variance + np.maximum(square - mean**2, 0.0)),
    }
