"""The headline: what more stars, fainter stars and cleaner stars do about the size of a PSF."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from porrima.averages import population_moments
from porrima.clip import Clip, Noise
from porrima.config import PopulationConfig, parse
from porrima.exposure import EUCLID_VIS_WIDE
from porrima.instruments import KCM16
from porrima.integrals import integrate
from porrima.io import write_figure
from porrima.multiplicity import MULTIPLICITY
from porrima.photometry import PHOTOMETRY
from porrima.precision import fitted_noise
from porrima.prediction import predict
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.sample import draw_stars
from porrima.shapes import Adaptive
from porrima.systems import Population

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

    from porrima.averages import PopulationMoments
    from porrima.response import Response
    from porrima.stars import Stars

    FloatArray = NDArray[np.float64]

__all__ = ["CLIP", "CROWDS", "MODELS", "headline", "write_headline"]

CROWDS = (1, 3, 10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000)
"""Numbers of stars in a stack."""

EDGES = (16, 17, 18, 19, 20, 21, 22, 23, 24)
"""Of the bins, in mag."""

MODELS = ("dk13", "dk13-kcm16", "modern")
"""Models of multiplicity that are compared."""

CLIP = 0.01
"""Largest change of a star's own size with which it is kept (dimensionless)."""

BINARY_FRACTION = 0.35
"""That of the paper."""


def headline(
    crowds: tuple[int, ...] = CROWDS, edges: tuple[float, ...] = EDGES, n_drawn: int = 2000
) -> xr.Dataset:
    """Errors of the PSF over what is required, by number of stars and by magnitude.

    Parameters
    ----------
    crowds : tuple of int
        Numbers of stars in a stack (count), of 18 to 19 mag.
    edges : tuple of float
        Of the bins, in mag.
    n_drawn : int
        Stars drawn in each bin from the analytic Galaxy at l = 180, b = 45 deg (count).

    Returns
    -------
    dataset : Dataset
        ``error`` (quantity, n_stars): rms error of r2 and e1 with ``dk13``; ``bias`` (way, bin): of r2, for each model
        and for ``dk13`` with stars clipped by their own size; all over the requirement of KCM16, dimensionless.

    Notes
    -----
    Behind ``psf1``, with adaptive moments and 35 % of pairs.  Clips have the noise of `precision.fitted_noise` in the
    exposures of Euclid's wide survey, the i band taken for that of VIS.

    References
    ----------
    KCM16
    """
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for results only)

    behind = response(psf_from_name("psf1"), Adaptive())
    clip = _clip(behind)
    required = np.array([KCM16.sigma_r2 or np.nan, KCM16.sigma_e or np.nan])
    moments = _moments(_stars(18, 19, n_drawn), "dk13")
    sigma = np.array([predict(moments, behind, n).sigma[[2, 0], 0] for n in crowds]).T
    bias = np.empty((len(MODELS) + 1, len(edges) - 1))
    for k in range(len(edges) - 1):
        stars = _stars(edges[k], edges[k + 1], n_drawn)
        for way, (model, selection) in enumerate([*((name, None) for name in MODELS), ("dk13", clip)]):
            bias[way, k] = predict(_moments(stars, model, selection), behind).bias[2, 0]
    return xr.Dataset(
        {
            "error": (("quantity", "n_stars"), sigma / required[:, None]),
            "bias": (("way", "bin"), bias / required[0]),
        },
        coords={
            "quantity": ["r2", "e1"],
            "n_stars": list(crowds),
            "way": [*MODELS, "clip"],
            "magnitude": ("bin", 0.5 * (np.array(edges[:-1]) + np.array(edges[1:]))),
        },
        attrs={"clip": CLIP},
    )


def write_headline(folder: str | Path) -> Path:
    """The figure written.

    Parameters
    ----------
    folder : str or Path
        Where ``headline.png`` goes.

    Returns
    -------
    path : Path
        Of the figure.
    """
    from porrima.headline_figure import levers  # noqa: PLC0415  (slow to import, where used)

    path = Path(folder) / "headline.png"
    write_figure(levers(headline()), path)
    return path


def _stars(low: float, high: float, n_drawn: int) -> Stars:
    where = {"l": 180, "b": 45, "mag": (low, high), "n_drawn": n_drawn}
    return draw_stars(parse(PopulationConfig, {"stars": where}))


def _moments(stars: Stars, model: str, selection: Clip | None = None) -> PopulationMoments:
    """Averages at the paper's binary fraction."""
    population = Population.of(
        stars,
        multiplicity=MULTIPLICITY[model],
        photometry=PHOTOMETRY["main-sequence"],
        selection=selection,
    )
    return population_moments(population, integrate(population), np.array([BINARY_FRACTION]))


def _clip(behind: Response) -> Clip:
    """Clip by R² with the noise of Euclid's wide survey."""
    noise = fitted_noise(psf_from_name("psf1"), EUCLID_VIS_WIDE, float(behind.shape0.r2))
    magnitude = np.arange(EDGES[0], EDGES[-1] + 0.5, 0.5)
    sigma = behind.kappa_r2 * noise.sigma_r2(magnitude)
    return Clip(
        response=behind,
        threshold=CLIP,
        noise=Noise(magnitude=tuple(magnitude.tolist()), sigma=tuple(sigma.tolist())),
    )
