"""The paper's experiments, each a function that returns its numbers with their axes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from porrima.config import PopulationConfig, RunConfig, parse
from porrima.galaxy import Robin2003
from porrima.multiplicity import DucheneKraus2013
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
    from pathlib import Path

    import xarray as xr
    from numpy.typing import NDArray

    from porrima.galaxy import StarCounts
    from porrima.stars import Stars

    FloatArray = NDArray[np.float64]

__all__ = [
    "EffectOfNStars", "ErrorsAndBiases", "against_magnitude", "effect_of_n_stars", "errors_and_biases",
    "galaxy_against_catalog", "n_stars_configs", "paper_config", "population", "store_name",
]  # fmt: skip

QUICK, FULL = 100_000, 500_000  # stacks; the paper has "hundreds of thousands"
N_STARS = (40, 750, 2100, 10_000)
"""Stars in the stacks of KCM16 Fig. 5 (count)."""

N_STARS_QUICK, N_STARS_FULL = 10_000, 100_000  # stacks of each
N_STARS_PSF = ("psf1", "psf2")
GAP_RULES = {name: DucheneKraus2013(gap_rule=name) for name in ("lower", "solar")}
ELLIPTICITIES = (0.02, 0.05, 0.1, 0.15, 0.2)
"""Of the Gaussian PSFs of the magnitude figure, along x (dimensionless)."""

SURVEY_PSFS = {
    "Euclid VIS": {"name": "optical1", "pixel": 0.1, "jitter": 0.029},
    "Roman H158": {"name": "roman:H158:SCA01", "pixel": 0.11},
}
"""PSFs of surveys in the magnitude figure, with pixel and jitter in arcsec."""

MASS_CLASSES = {
    "below 0.1": (0.0, 0.1),
    "0.1-0.5": (0.1, 0.5),
    "0.5-0.7": (0.5, 0.7),
    "0.7-1.5": (0.7, 1.5),
    "0.5-1.5": (0.5, 1.5),
}
"""Classes of mass of the population figure, in M_sun; the last is the sum of the two before it."""


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
    return parse(
        RunConfig,
        {
            "stars": {"l": 180, "b": 45, "band": "i", "mag": [18, 19]},
            "n_stacks": FULL if full else QUICK,
            "seed": seed,
        },
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
    run = open_run(store)
    config, population = run.config, run.population
    integrals = integrate(population)
    moments = population_moments(population, integrals, np.array([0.35]))
    curves = predicted_curves(population, config, config.n_stars, integrals=integrals)
    curves.attrs["n_stars"] = config.n_stars
    return ErrorsAndBiases(
        config=config,
        summary=summarise(run, integrals=integrals),
        curves=curves,
        limit=predicted_curves(population, config, None, integrals=integrals),
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
        Another for another number of stars or stacks, or seed.
    """
    return f"run-{config.n_stars}-{config.n_stacks}-{config.seed}.zarr"


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


def n_stars_configs(*, full: bool = False, seed: int = 1) -> list[RunConfig]:
    """The settings of KCM16 Fig. 5.

    Parameters
    ----------
    full : bool
        At the paper's own number of stacks: 100 000 of each number of stars, 1.3e9 stars behind two PSFs.
    seed : int
        Of the runs.

    Returns
    -------
    configs : list of RunConfig
        As `paper_config`, one for each of `N_STARS`, behind PSF1 and PSF2.

    References
    ----------
    KCM16
    """
    n_stacks = N_STARS_FULL if full else N_STARS_QUICK
    common = {"psf": N_STARS_PSF, "n_stacks": n_stacks}
    base = paper_config(full=full, seed=seed)
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


def population(
    magnitude: tuple[float, float] = (16.0, 24.0), band: str = "i", galaxy: Robin2003 | None = None
) -> xr.Dataset:
    r"""Share of mass classes and mean binary fraction over the sky (KCM16 Sect. 4.3).

    Parameters
    ----------
    magnitude : (float, float)
        Half-open range, in mag.
    band : str
        One of the bands of `porrima.photometry.MainSequence`.
    galaxy : Robin2003, optional
        The model; the default one where not given.

    Returns
    -------
    dataset : Dataset
        ``share`` (scan, angle, mass_class) and ``binary_fraction`` (scan, angle, gap_rule), dimensionless,
        ``bright_limit`` (scan, angle), an upper limit on the share of stars above 1.5 M_sun, and
        ``n_per_deg2``, along three scans: latitude 15 to 75 deg at l = 0 and 180, longitude at b = 45.

    Notes
    -----
    Main-sequence stars, from the integral of `Robin2003.star_counts`: no random numbers.  Shares are of the
    stars up to 1.5 M_sun, the end of the photometry.  Those above are not counted but limited: at the
    magnitude of 1.5 M_sun, so nearer and more frequent than they are, and all alive, they would number
    :math:`\int_{1.5}^\infty m^{-3} dm` over the same integral across the last cell of mass times its stars.

    References
    ----------
    KCM16, Robin2003, DucheneKraus2013
    """
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for results only)

    model = galaxy or Robin2003()
    latitude, longitude = np.arange(15.0, 76.0, 5.0), np.linspace(0.0, 360.0, 25)
    scans = {
        "l = 0": (np.zeros(latitude.size), latitude),
        "l = 180": (np.full(latitude.size, 180.0), latitude),
        "b = 45": (longitude, np.full(longitude.size, 45.0)),
    }
    parts = []
    for name, (l, b) in scans.items():
        counts = [
            model.star_counts(x % 360.0, y, np.array(magnitude), band) for x, y in zip(l, b, strict=True)
        ]
        part = xr.Dataset(
            {
                "share": (("angle", "mass_class"), [_shares(c) for c in counts]),
                "binary_fraction": (("angle", "gap_rule"), [_binary_fractions(c)[:, 0] for c in counts]),
                "bright_limit": ("angle", [_bright_limit(c) for c in counts]),
                "n_per_deg2": ("angle", [c.per_deg2[0] for c in counts]),
            },
            coords={
                "angle": longitude if name == "b = 45" else latitude,
                "mass_class": list(MASS_CLASSES),
                "gap_rule": list(GAP_RULES),
            },
        )
        parts.append(part.expand_dims(scan=[name]))
    dataset = xr.concat(parts, dim="scan", join="outer")
    dataset.attrs = {"band": band, "magnitude_lo": magnitude[0], "magnitude_hi": magnitude[1]}
    return dataset


def _shares(counts: StarCounts) -> list[float]:
    stars = counts.by_mass[0] / counts.by_mass[0].sum()
    return [float(stars[(counts.mass >= lo) & (counts.mass < hi)].sum()) for lo, hi in MASS_CLASSES.values()]


def _bright_limit(counts: StarCounts) -> float:
    """Upper limit on the share of stars above 1.5 M_sun."""
    last = counts.mass[-1] / np.sqrt(counts.mass[-1] / counts.mass[-2])  # lower edge of the last cell
    above = 1.5**-2 / (last**-2 - 1.5**-2)
    return float(above * counts.by_mass[0, -1] / counts.by_mass[0].sum())


def _binary_fractions(counts: StarCounts) -> FloatArray:
    """Mean multiplicity fraction (gap_rule, bin)."""
    laws = [model.companions(counts.mass) for model in GAP_RULES.values()]
    return np.stack([counts.mean(law.multiplicity_fraction) for law in laws])


def galaxy_against_catalog(
    stars: Stars,
    galaxy: Robin2003,
    direction: tuple[float, float],
    magnitudes: FloatArray,
    rng: np.random.Generator,
) -> xr.Dataset:
    """The analytic Galaxy beside a catalogue of the same direction, per bin of magnitude.

    Parameters
    ----------
    stars : Stars
        Main-sequence stars of the catalogue, up to 1.5 M_sun, with their area.
    galaxy : Robin2003
        The model.
    direction : (float, float)
        Galactic longitude and latitude, in deg.
    magnitudes : (n + 1,) float array
        Edges of the bins, in mag.
    rng : numpy.random.Generator
        For the sampling error of the median distance (200 bootstraps).

    Returns
    -------
    dataset : Dataset
        ``catalog`` and ``galaxy`` (quantity, bin) and ``stderr``, the sampling error of the catalogue:
        stars per deg², median distance in pc, mean mass in M_sun, mean multiplicity fractions of
        Duchene & Kraus (2013) by gap rule.
    """
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for results only)

    counts = galaxy.star_counts(*direction, magnitudes, stars.band)
    expected = np.vstack(
        [counts.per_deg2, counts.median_distance, counts.mean_mass, _binary_fractions(counts)]
    )
    value, stderr = np.empty_like(expected), np.empty_like(expected)
    for k in range(magnitudes.size - 1):
        here = stars.select(magnitude=(magnitudes[k], magnitudes[k + 1]))
        n, area = len(here), stars.area or 1.0
        medians = [np.median(here.distance[rng.integers(0, n, n)]) for _ in range(200)]
        value[:2, k] = n / area, np.median(here.distance)
        stderr[:2, k] = np.sqrt(n) / area, np.std(medians)
        of_star = [here.mass, *(m.companions(here.mass).multiplicity_fraction for m in GAP_RULES.values())]
        for row, values in enumerate(of_star, start=2):
            value[row, k], stderr[row, k] = values.mean(), values.std() / np.sqrt(n)
    names = ["counts", "median_distance", "mean_mass", *(f"fraction_{rule}" for rule in GAP_RULES)]
    dims = ("quantity", "bin")
    return xr.Dataset(
        {"catalog": (dims, value), "stderr": (dims, stderr), "galaxy": (dims, expected)},
        coords={"quantity": names, "mag_lo": ("bin", magnitudes[:-1]), "mag_hi": ("bin", magnitudes[1:])},
        attrs={"band": stars.band, "l": direction[0], "b": direction[1], "source": stars.source},
    )


def against_magnitude(
    edges: FloatArray,
    models: dict[str, DucheneKraus2013],
    *,
    binary_fraction: float | None = 0.35,
    n_stars: int = 10_000,
    n_drawn: int = 4000,
    seed: int = 1,
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
