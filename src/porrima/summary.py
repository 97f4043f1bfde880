"""From many stacks to numbers: bias and error with their standard errors, per range of binary fraction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from porrima.prediction import QUANTITIES, integrate, population_moments, predict
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.shapes import estimator_from_name

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.config import RunConfig
    from porrima.prediction import PairIntegrals
    from porrima.systems import Population

    FloatArray = NDArray[np.float64]

__all__ = ["STATISTICS", "predicted_curves", "rows", "summarise"]

STATISTICS = (
    "bias", "bias_se", "sigma", "sigma_se", "sd", "sd_se",
    "prediction_bias", "prediction_sigma", "prediction_sd",
)  # fmt: skip
"""What is given for each PSF, quantity and bin."""

_FRACTIONS = 1001  # nodes of the predicted curves between 0 and 1


def statistics(change: FloatArray) -> dict[str, float]:
    r"""Bias and errors of a measured quantity over stacks, with standard errors.

    Parameters
    ----------
    change : (n,) float array
        Value of each stack minus that of the PSF without companions; for the size over that of the PSF,
        dimensionless; n at least 2.

    Returns
    -------
    statistics : dict
        ``bias``, ``sigma`` (rms about no change), ``sd`` (about the mean) and the standard error of each.

    Notes
    -----
    :math:`\sigma^2 = \sum_s \delta_s^2 / (N_s - 1)` (KCM16, Eq. 10).  The companions' x is heavy-tailed, so the
    standard errors take the fourth moment of the sample:
    :math:`var(s^2) = [m_4 - s^4 (n-3)/(n-1)]/n`, halved over s.

    References
    ----------
    KCM16
    """
    n = change.size
    bias = change.mean()
    centred = change - bias
    variance = centred @ centred / (n - 1)
    variance_of_variance = max(np.mean(centred**4) - variance**2 * (n - 3) / (n - 1), 0.0) / n
    square = change**2
    sigma = np.sqrt(square.sum() / (n - 1))
    return {
        "bias": bias,
        "bias_se": np.sqrt(variance / n),
        "sigma": sigma,
        "sigma_se": square.std(ddof=1) / np.sqrt(n) / (2 * sigma) if sigma > 0 else 0.0,
        "sd": np.sqrt(variance),
        "sd_se": np.sqrt(variance_of_variance) / (2 * np.sqrt(variance)) if variance > 0 else 0.0,
    }


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
    grid = np.linspace(0.0, 1.0, _FRACTIONS) if fractions is None else fractions
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


def summarise(
    run: xr.Dataset,
    config: RunConfig,
    population: Population,
    bins: int = 20,
    integrals: PairIntegrals | None = None,
) -> xr.Dataset:
    """Bias and error in bins of binary fraction, with what is predicted for the same stacks.

    Parameters
    ----------
    run : Dataset
        As `simulation.open_run` gives it.
    config : RunConfig
        Of the run.
    population : Population
        Of the run.
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
    the law of total variance the mean of the variance plus the variance of the bias.
    """
    if bins < 1:
        raise ValueError(f"bins must be at least 1, got {bins}")
    fraction = run["binary_fraction"].to_numpy()
    edges = np.arange(bins + 1) / bins  # so that 0.35 is an edge of 20 bins
    which = np.clip(np.searchsorted(edges, fraction, side="right") - 1, 0, bins - 1)
    curves = _at_stacks(population, config, fraction, integrals)
    out = {name: np.full((len(config.psf), len(QUANTITIES), bins), np.nan) for name in STATISTICS}
    n_stacks, n_failed = np.bincount(which, minlength=bins), np.zeros((len(config.psf), bins), dtype=int)
    members = np.split(np.argsort(which, kind="stable"), np.cumsum(n_stacks)[:-1])
    for p in range(len(config.psf)):
        for q, quantity in enumerate(QUANTITIES):
            change = run[quantity][p].to_numpy() - float(run[f"{quantity}_0"][p])
            if quantity == "r2":
                change /= float(run["r2_0"][p])
            for k, everyone in enumerate(members):
                inside = everyone[np.isfinite(change[everyone])]
                n_failed[p, k] = everyone.size - inside.size
                if inside.size >= 2:
                    predicted = _average(curves["bias"][p, q, inside], curves["sd"][p, q, inside])
                    for name, value in (statistics(change[inside]) | predicted).items():
                        out[name][p, q, k] = value
    return xr.Dataset(
        {name: (("psf", "quantity", "bin"), values) for name, values in out.items()}
        | {"n_stacks": ("bin", n_stacks), "n_failed": (("psf", "bin"), n_failed)},
        coords={
            "psf": list(config.psf),
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
    return [
        {
            "psf": str(psf),
            "quantity": quantity,
            "f_lo": float(summary["f_lo"][k]),
            "f_hi": float(summary["f_hi"][k]),
            "n_stacks": int(summary["n_stacks"][k]),
            "n_failed": int(summary["n_failed"].sel(psf=psf)[k]),
        }
        | {name: float(summary[name].sel(psf=psf, quantity=quantity)[k]) for name in STATISTICS}
        for psf in summary["psf"].to_numpy()
        for quantity in ("r2", "e1", "e2")
        for k in range(summary.sizes["bin"])
        if int(summary["n_stacks"][k]) > 0
    ]


def _at_stacks(
    population: Population, config: RunConfig, fraction: FloatArray, integrals: PairIntegrals | None
) -> dict[str, FloatArray]:
    """Predicted bias and sd, (psf, quantity, stack)."""
    grid = np.unique(fraction) if np.ptp(fraction) == 0 else None
    curves = predicted_curves(population, config, config.n_stars, grid, integrals)
    nodes = curves["binary_fraction"].to_numpy()
    return {
        name: np.stack(
            [[np.interp(fraction, nodes, line) for line in psf] for psf in curves[name].to_numpy()]
        )
        for name in ("bias", "sd")
    }


def _average(bias: FloatArray, sd: FloatArray) -> dict[str, float]:
    variance = np.mean(sd**2)
    return {
        "prediction_bias": bias.mean(),
        "prediction_sigma": np.sqrt(variance + np.mean(bias**2)),
        "prediction_sd": np.sqrt(variance + bias.var()),
    }
