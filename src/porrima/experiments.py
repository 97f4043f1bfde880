"""The paper's experiments, each a function that returns its numbers with their axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from porrima.config import RunConfig, StarsConfig
from porrima.prediction import integrate, population_moments
from porrima.simulation import open_run, simulate
from porrima.summary import predicted_curves, summarise

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import xarray as xr

__all__ = ["ErrorsAndBiases", "errors_and_biases", "paper_config"]

QUICK, FULL = 100_000, 500_000  # stacks; the paper has "hundreds of thousands"


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorsAndBiases:
    """Numbers of the six-panel figure of KCM16.

    Parameters
    ----------
    config : RunConfig
        What was run.
    summary : Dataset
        Simulated and predicted, per bin of binary fraction, dimensionless.
    curves, limit : Dataset
        Predicted against binary fraction for the N of the stacks and for N → ∞, dimensionless.
    mean_x : float
        At a binary fraction of 0.35, in arcsec².
    removed_fraction : float
        Share of resolved pairs among all pairs at 0.35, in [0, 1].
    """

    config: RunConfig
    summary: xr.Dataset
    curves: xr.Dataset
    limit: xr.Dataset
    mean_x: float
    removed_fraction: float


def paper_config(*, full: bool = False, seed: int = 1) -> RunConfig:
    """The setting of KCM16 Sect. 5.1.

    Parameters
    ----------
    full : bool
        At the paper's own number of stacks.
    seed : int
        Of the run.

    Returns
    -------
    config : RunConfig
        Stars of the analytic Galaxy at l = 180°, b = 45°, 18 <= i < 19; N = 40; three Gaussian PSFs; adaptive.

    References
    ----------
    KCM16
    """
    return RunConfig(
        stars=StarsConfig(l=180.0, b=45.0, band="i", mag=(18.0, 19.0)),
        n_stacks=FULL if full else QUICK,
        seed=seed,
    )


def errors_and_biases(
    config: RunConfig, store: Path, progress: Callable[[int], None] = lambda _: None
) -> ErrorsAndBiases:
    """Error and bias of the PSF's shape against binary fraction (KCM16, Fig. 4), simulated and predicted.

    Parameters
    ----------
    config : RunConfig
        The run.
    store : Path
        Where its stacks are kept; those of an earlier call are used again.
    progress : callable
        Called with the number of stacks done.

    Returns
    -------
    numbers : ErrorsAndBiases
        All that the figure shows.
    """
    simulate(config, store, resume=store.exists(), progress=progress)
    run, config, population = open_run(store)
    moments = population_moments(population, integrate(population), np.array([0.35]))
    curves = predicted_curves(population, config, config.n_stars)
    curves.attrs["n_stars"] = config.n_stars
    return ErrorsAndBiases(
        config=config,
        summary=summarise(run, config, population),
        curves=curves,
        limit=predicted_curves(population, config, None),
        mean_x=float(moments.mean_x[0]),
        removed_fraction=float(moments.removed_fraction[0]),
    )
