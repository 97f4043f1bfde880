"""The paper's experiments, each a function that returns its numbers with their axes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from porrima.archive import source_key
from porrima.cache import content_key
from porrima.config import PopulationConfig, RunConfig, canonical, parse
from porrima.prediction import integrate, population_moments, predict
from porrima.psf import psf_from_name, sheared_gaussian
from porrima.response import response
from porrima.sample import draw_stars
from porrima.shapes import Adaptive
from porrima.simulation import simulate
from porrima.store import open_run
from porrima.summary import predicted_curves, summarise
from porrima.uncertainty import uncertainty

if TYPE_CHECKING:
    from collections.abc import Callable

    import xarray as xr
    from numpy.typing import NDArray

    from porrima.multiplicity import MultiplicityModel
    from porrima.store import FinishedRun

    FloatArray = NDArray[np.float64]

__all__ = [
    "EffectOfNStars", "ErrorsAndBiases", "against_magnitude", "effect_of_n_stars", "errors_and_biases",
    "n_stars_configs", "numbers_of_run", "paper_config", "store_name",
]  # fmt: skip

QUICK, FULL = 100_000, 500_000  # stacks; the paper has "hundreds of thousands"
N_STARS = (40, 750, 2100, 10_000)
"""Stars in the stacks of KCM16 Fig. 5 (count)."""

PAPER_FRACTION = 0.35
"""Binary fraction at which the paper reads its figures, in [0, 1]."""

N_STARS_QUICK, N_STARS_FULL = 10_000, 100_000  # stacks of each
N_STARS_PSF = ("psf1", "psf2")
ELLIPTICITIES = (0.02, 0.05, 0.1, 0.15, 0.2)
"""Of the Gaussian PSFs of the magnitude figure, along x (dimensionless)."""

SURVEY_PSFS = {
    "Euclid VIS": {"name": "optical1", "pixel": 0.1, "jitter": 0.029},
    "Roman H158": {"name": "roman:H158:SCA01", "pixel": 0.11},
}
"""PSFs of surveys in the magnitude figure, with pixel and jitter in arcsec."""


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
    fraction : float
        A binary fraction: `PAPER_FRACTION`, or that of the stacks where all have one; in [0, 1].
    mean_x : float
        At that fraction, in arcsec².
    removed_fraction : float
        Share of resolved pairs among all pairs at that fraction, in [0, 1].
    """

    config: RunConfig
    summary: xr.Dataset
    curves: xr.Dataset
    limit: xr.Dataset
    fraction: float
    mean_x: float
    removed_fraction: float


def paper_config(
    *, full: bool = False, seed: int = 1, psf: tuple[str, ...] | None = None, n_stars: int | None = None
) -> RunConfig:
    """The setting of KCM16 Sect. 5.1.

    Parameters
    ----------
    full : bool
        At the paper's own number of stacks.
    seed : int
        Of the run.
    psf : tuple of str, optional
        Other PSFs than the paper's.
    n_stars : int, optional
        Another number of stars in a stack than 40 (count).

    Returns
    -------
    config : RunConfig
        Stars of the analytic Galaxy at l = 180°, b = 45°, 18 <= i < 19; N = 40; three Gaussian PSFs; adaptive.

    References
    ----------
    KCM16
    """
    return parse(
        RunConfig,
        {
            "stars": {"l": 180, "b": 45, "band": "i", "mag": [18, 19]},
            "n_stacks": FULL if full else QUICK,
            "seed": seed,
        }
        | ({"psf": psf} if psf else {})
        | ({"n_stars": n_stars} if n_stars is not None else {}),
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
    return numbers_of_run(open_run(store))


def numbers_of_run(run: FinishedRun, bins: int = 20) -> ErrorsAndBiases:
    """Error and bias of the PSF's shape in any run, simulated and predicted.

    Parameters
    ----------
    run : FinishedRun
        From `store.open_run`.
    bins : int
        Ranges of binary fraction (count).

    Returns
    -------
    numbers : ErrorsAndBiases
        Where all stacks have one binary fraction, its curves have that one alone.
    """
    config, population = run.config, run.population
    integrals = integrate(population)
    given = {"uniform": PAPER_FRACTION, "model": None}.get(
        str(config.binary_fraction), config.binary_fraction
    )
    moments = population_moments(population, integrals, None if given is None else np.array([given]))
    fraction = float(moments.binary_fraction[0]) if given is None else float(given)
    grid = None if config.binary_fraction == "uniform" else np.array([fraction])
    curves, limit = (
        predicted_curves(population, config, n_stars, grid, integrals) for n_stars in (config.n_stars, None)
    )
    curves.attrs["n_stars"] = config.n_stars
    return ErrorsAndBiases(
        config=config,
        summary=summarise(run, bins=bins, integrals=integrals),
        curves=curves,
        limit=limit,
        fraction=fraction,
        mean_x=float(moments.mean_x[0]),
        removed_fraction=float(moments.removed_fraction[0]),
    )


def store_name(config: RunConfig) -> str:
    """Name of the folder that keeps the stacks of an experiment.

    Parameters
    ----------
    config : RunConfig
        The run.

    Returns
    -------
    name : str
        Another for another configuration, content of a file of a PSF, or state of the source.
    """
    files = [Path(name.split("[")[0]) for name in config.psf]
    contents = [file.read_bytes() for file in files if file.is_file()]
    key = content_key(canonical(config), contents, source_key("simulation"))
    return f"run-{config.n_stars}-{config.n_stacks}-{config.seed}-{key[:8]}.zarr"


@dataclass(frozen=True, slots=True, kw_only=True)
class EffectOfNStars:
    """Numbers of the figure of the number of stars in a stack.

    Parameters
    ----------
    numbers : Dataset
        As `summary.summarise` gives them, over n_stars besides, dimensionless.
    limit : Dataset
        Predicted against binary fraction for N → ∞, dimensionless.
    """

    numbers: xr.Dataset
    limit: xr.Dataset


def n_stars_configs(
    *, full: bool = False, seed: int = 1, psf: tuple[str, ...] | None = None
) -> list[RunConfig]:
    """The settings of KCM16 Fig. 5.

    Parameters
    ----------
    full : bool
        At the paper's own number of stacks: 100 000 of each number of stars, 1.3e9 stars behind two PSFs.
    seed : int
        Of the runs.
    psf : tuple of str, optional
        Other PSFs than PSF1 and PSF2.

    Returns
    -------
    configs : list of RunConfig
        As `paper_config`, one for each of `N_STARS`, behind PSF1 and PSF2.

    References
    ----------
    KCM16
    """
    n_stacks = N_STARS_FULL if full else N_STARS_QUICK
    base = paper_config(full=full, seed=seed, psf=psf or N_STARS_PSF)
    common = {"n_stacks": n_stacks}
    return [base.model_copy(update=common | {"n_stars": n_stars}) for n_stars in N_STARS]


def effect_of_n_stars(
    configs: list[RunConfig], folder: Path, progress: Callable[[int], None] = lambda _: None
) -> EffectOfNStars:
    """Error of the PSF's ellipticity against binary fraction for stacks of few and many stars (KCM16, Fig. 5).

    Parameters
    ----------
    configs : list of RunConfig
        From `n_stars_configs`.
    folder : Path
        Where the stacks are kept; those of an earlier call are used again.
    progress : callable
        Called with the number of stars done (count).

    Returns
    -------
    numbers : EffectOfNStars
        All that the figure shows.

    Notes
    -----
    One set of stacks stands behind both PSFs, so that their errors are compared on the same stars.
    """
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for results only)

    summaries, integrals = [], None
    for config in configs:
        store = folder / store_name(config)
        simulate(config, store, resume=store.exists(), progress=partial(_in_stars, progress, config.n_stars))
        run = open_run(store)
        integrals = integrals or integrate(run.population)
        summaries.append(summarise(run, integrals=integrals))
    numbers = xr.concat(summaries, dim="n_stars").assign_coords(n_stars=[c.n_stars for c in configs])
    numbers.attrs["n_stacks"] = configs[0].n_stacks
    return EffectOfNStars(
        numbers=numbers, limit=predicted_curves(run.population, configs[0], None, integrals=integrals)
    )


def _in_stars(progress: Callable[[int], None], n_stars: int, n_stacks: int) -> None:
    progress(n_stacks * n_stars)


def against_magnitude(
    edges: FloatArray,
    models: dict[str, MultiplicityModel],
    *,
    binary_fraction: float | None = 0.35,
    n_stars: int = 10_000,
    n_drawn: int = 4000,
    seed: int = 1,
    progress: Callable[[int], None] = lambda _: None,
) -> xr.Dataset:
    r"""Mean x and errors of the PSF against magnitude (KCM16 Sect. 5.4), Gaussian PSFs and those of surveys.

    Parameters
    ----------
    edges : (n + 1,) float array
        Of the bins of magnitude, in mag.
    models : dict
        Multiplicity models by name.
    binary_fraction : float, optional
        In [0, 1]; None for each model's own.
    n_stars : int
        Stars in a stack, for its scatter (count).
    n_drawn : int
        Stars drawn from the analytic Galaxy at l = 180°, b = 45° in each bin (count).
    seed : int
        Of those stars.
    progress : callable
        Called with the number of bins of a model done (count).

    Returns
    -------
    dataset : Dataset
        ``mean_x`` in arcsec² with ``mean_x_low`` and ``mean_x_high`` (model, bin); ``limit_e`` (model, psf, bin), the
        error of the ellipticity as a vector for infinitely many stars, ``sd_e``, its scatter in a component for
        `n_stars`, and ``limit_r2`` and ``sd_r2`` likewise; ``e_0``, ``r2_0`` [arcsec²] (psf).  Dimensionless but for
        sizes.

    References
    ----------
    KCM16
    """
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for results only)

    psfs = {f"e = {e:g}": sheared_gaussian(f"e = {e:g}", e, 0.0) for e in ELLIPTICITIES}
    psfs |= {name: psf_from_name(**options) for name, options in SURVEY_PSFS.items()}  # type: ignore[arg-type]
    replies = [response(psf, Adaptive()) for psf in psfs.values()]
    shape = (len(models), len(psfs), edges.size - 1)
    of_psf = {name: np.empty(shape) for name in ("limit_e", "sd_e", "limit_r2", "sd_r2")}
    of_x = {name: np.empty((shape[0], shape[2])) for name in ("mean_x", "mean_x_low", "mean_x_high")}
    for k in range(edges.size - 1):
        where = {"l": 180, "b": 45, "mag": (edges[k], edges[k + 1]), "n_drawn": n_drawn}
        for i, model in enumerate(models.values()):
            config = parse(PopulationConfig, {"stars": where, "seed": seed})
            stars, light = draw_stars(config), config.photometry.build()
            found = uncertainty(
                stars, replies[0], multiplicity=model, photometry=light, binary_fraction=binary_fraction
            )
            r2_0, moments = found.prediction.r2_0, found.prediction.population
            ends = zip(of_x, (found.value[0], *found.interval("eta")), strict=True)
            for name, eta in ends:
                of_x[name][i, k] = eta * r2_0
            for j, reply in enumerate(replies):
                limit, stack = predict(moments, reply), predict(moments, reply, n_stars)
                of_psf["limit_e"][i, j, k] = np.hypot(*limit.bias[:2, 0])
                of_psf["limit_r2"][i, j, k] = abs(limit.bias[2, 0])
                of_psf["sd_e"][i, j, k], of_psf["sd_r2"][i, j, k] = stack.sd[0, 0], stack.sd[2, 0]
            progress(1)
    zero = [reply.shape0 for reply in replies]
    return xr.Dataset(
        {name: (("model", "psf", "bin"), values) for name, values in of_psf.items()}
        | {name: (("model", "bin"), values) for name, values in of_x.items()}
        | {"e_0": ("psf", [float(np.hypot(s.e1, s.e2)) for s in zero])}
        | {"r2_0": ("psf", [float(s.r2) for s in zero])},
        coords={
            "model": list(models),
            "psf": list(psfs),
            "mag_lo": ("bin", edges[:-1]),
            "mag_hi": ("bin", edges[1:]),
        },
        attrs={"n_stars": n_stars, "binary_fraction": binary_fraction, "band": "i"},
    )
