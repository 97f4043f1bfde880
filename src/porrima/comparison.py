"""Models of multiplicity side by side: what they say of stars of each mass, and what of it reaches a PSF."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.averages import population_moments
from porrima.companions import MassRangeWarning
from porrima.config import PopulationConfig, parse
from porrima.integrals import integrate
from porrima.io import write_figure
from porrima.multiplicity import MULTIPLICITY
from porrima.sample import draw_stars
from porrima.systems import Population

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

    from porrima.companions import CompanionLaw

    FloatArray = NDArray[np.float64]

__all__ = ["EDGES", "ORBITS", "laws_by_mass", "mean_x_by_model", "mean_x_table", "write_comparison"]

EDGES = np.arange(16.0, 24.0)
"""Edges of the bins, in mag."""

ORBITS = ("circular", "eccentric")
"""All orbits circles; or of the eccentricities of the model, of ``mds17`` where it has none."""

_MASSES = {"0.2": 0.2, "1": 1.0}  # M_sun, of the densities of the axes


def _with_orbits(model: Any, orbits: str) -> Any:
    if orbits == "circular":
        return replace(model, eccentricity="circular")
    return model if model.eccentricity != "circular" else replace(model, eccentricity="mds17")


def mean_x_by_model(edges: FloatArray = EDGES, n_drawn: int = 4000, seed: int = 1) -> xr.Dataset:
    r"""Mean x of stacks by model of multiplicity, with circular orbits and with eccentric ones.

    Parameters
    ----------
    edges : (n + 1,) float array
        Of the bins, in mag.
    n_drawn : int
        Stars drawn in each bin from the analytic Galaxy at l = 180, b = 45 deg (count).
    seed : int
        Of the stars.

    Returns
    -------
    dataset : Dataset
        ``mean_x`` (model, orbits, bin) in arcsec², at the model's own fraction of pairs, and ``binary_fraction``
        (model, bin) before resolved pairs leave.
    """
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for results only)

    mean_x = np.empty((len(MULTIPLICITY), len(ORBITS), edges.size - 1))
    fraction = np.empty((len(MULTIPLICITY), edges.size - 1))
    for k in range(edges.size - 1):
        where = {"l": 180, "b": 45, "mag": (edges[k], edges[k + 1]), "n_drawn": n_drawn}
        config = parse(PopulationConfig, {"stars": where, "seed": seed})
        stars, light = draw_stars(config), config.photometry.build()
        for i, model in enumerate(MULTIPLICITY.values()):
            for j, orbits in enumerate(ORBITS):
                with warnings.catch_warnings():
                    warnings.simplefilter(
                        "ignore", MassRangeWarning
                    )  # shown for what it is: all models, all stars
                    population = Population.of(
                        stars, multiplicity=_with_orbits(model, orbits), photometry=light
                    )
                found = population_moments(population, integrate(population))
                mean_x[i, j, k], fraction[i, k] = found.mean_x[0], found.binary_fraction[0]
    return xr.Dataset(
        {"mean_x": (("model", "orbits", "bin"), mean_x), "binary_fraction": (("model", "bin"), fraction)},
        coords={
            "model": list(MULTIPLICITY),
            "orbits": list(ORBITS),
            "mag_lo": ("bin", edges[:-1]),
            "mag_hi": ("bin", edges[1:]),
        },
    )


def mean_x_table(dataset: xr.Dataset) -> str:
    """Mean x by model as a table for a document.

    Parameters
    ----------
    dataset : Dataset
        From `mean_x_by_model`: arcsec² and mag.

    Returns
    -------
    table : str
        Markdown, in 1e-6 arcsec².
    """
    bins = [f"{a:g}–{b:g}" for a, b in zip(dataset["mag_lo"].values, dataset["mag_hi"].values, strict=True)]
    lines = [f"| model, orbits | {' | '.join(bins)} |", "|---" * (len(bins) + 1) + "|"]
    for model in dataset["model"].values:
        for orbits in dataset["orbits"].values:
            values = 1e6 * dataset["mean_x"].sel(model=model, orbits=orbits).values
            lines.append(f"| `{model}`, {orbits} | {' | '.join(f'{v:.2f}' for v in values)} |")
    return "\n".join(lines)


def laws_by_mass(mass: FloatArray) -> xr.Dataset:
    """What each model says of field stars of each mass, and the rows of tables with their errors.

    Parameters
    ----------
    mass : (n,) float array
        Of primaries, in M_sun.

    Returns
    -------
    dataset : Dataset
        Over (model, mass): ``multiplicity_fraction``, ``mean_mass_ratio``, ``median_axis`` of circles that look the
        same [au], NaN outside the masses of the model; over (model, star, log_a): ``density`` of these axes per dex.
    """
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for results only)

    names = ("multiplicity_fraction", "mean_mass_ratio", "median_axis")
    out = {name: np.full((len(MULTIPLICITY), mass.size), np.nan) for name in names}
    log_a = np.linspace(-2.5, 5.0, 301)
    density = np.full((len(MULTIPLICITY), len(_MASSES), log_a.size), np.nan)
    for i, model in enumerate(MULTIPLICITY.values()):
        low, high = model.mass_range
        inside = np.flatnonzero((mass >= low) & (mass <= high))
        law = model.companions(mass[inside])
        out["multiplicity_fraction"][i, inside] = law.multiplicity_fraction[law.first]
        out["mean_mass_ratio"][i, inside] = np.bincount(law.star, law.share * _mean_mass_ratios(law))
        for k, n in enumerate(inside):
            one = _density(law, k, log_a)
            below = np.cumsum(one) / one.sum()
            out["median_axis"][i, n] = 10 ** np.interp(0.5, below, log_a)
        for j, star in enumerate(_MASSES.values()):
            if low <= star <= high:
                density[i, j] = _density(model.companions(np.array([star])), 0, log_a)
    return xr.Dataset(
        {name: (("model", "mass"), values) for name, values in out.items()}
        | {"density": (("model", "star", "log_a"), density)},
        coords={"model": list(MULTIPLICITY), "mass": mass, "star": list(_MASSES), "log_a": log_a},
    )


def _density(law: CompanionLaw, star: int, log_a: FloatArray) -> FloatArray:
    """Density per dex of the axes of one star's companions."""
    mine = law.star == star
    z = (log_a - law.log_a[mine, None]) / law.log_a_sigma[mine, None]
    each = np.exp(-0.5 * z**2) / (np.sqrt(2 * np.pi) * law.log_a_sigma[mine, None])
    each = np.where(log_a <= law.log_a_max[mine, None], each, 0.0)
    total: FloatArray = law.share[mine] @ each
    return total / float(total.sum() * (log_a[1] - log_a[0]))


def _mean_mass_ratios(law: CompanionLaw) -> FloatArray:
    """Mean mass ratio of each class; no exponent is -1 or -2."""
    g, low, high = law.mass_ratio_exponent, law.mass_ratio_min, law.mass_ratio_max
    mean: FloatArray = (
        (high ** (g + 2) - low ** (g + 2)) / (high ** (g + 1) - low ** (g + 1)) * (g + 1) / (g + 2)
    )
    return mean


def write_comparison(folder: str | Path) -> str:
    """The figure of the models written, and the table of what they give.

    Parameters
    ----------
    folder : str or Path
        Where ``multiplicity.png`` goes.

    Returns
    -------
    table : str
        From `mean_x_table`, in 1e-6 arcsec².
    """
    from porrima.multiplicity_figure import models_of_multiplicity  # noqa: PLC0415  (slow to import, where used)

    found = mean_x_by_model()
    laws = laws_by_mass(np.geomspace(0.08, 1.5, 120))
    write_figure(models_of_multiplicity(laws, found), Path(folder) / "multiplicity.png")
    return mean_x_table(found)
