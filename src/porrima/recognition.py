"""What Euclid and Roman recognise of pairs, by separation, contrast and magnitude: the numbers of the figure."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from porrima.detection import Detection
from porrima.exposure import EXPOSURES
from porrima.instruments import SURVEYS
from porrima.io import write_figure
from porrima.psf import psf_from_name

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["recognition_maps", "write_recognition"]

MAGNITUDES = (18.0, 20.0, 22.0)
"""Of the systems shown, in the survey's own band, in mag."""

NAMES = {"euclid-vis": "Euclid VIS", "roman-h158": "Roman H158"}
"""Surveys shown, and how they are called there."""


def recognition_maps(
    magnitudes: tuple[float, ...] = MAGNITUDES, n_separations: int = 120, n_contrasts: int = 91
) -> xr.Dataset:
    """Probability that a pair is recognised on all exposures of a survey.

    Parameters
    ----------
    magnitudes : tuple of float
        Of the whole systems, in mag.
    n_separations, n_contrasts : int
        Points from 0.006 to 0.15 arcsec, and from 0 to 5 mag (count).

    Returns
    -------
    maps : Dataset
        ``probability`` over (survey, magnitude, contrast, separation), in [0, 1]; mag and arcsec; with the cut of the
        paper, in arcsec, as the attribute ``cut``.
    """
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for results only)

    separation, contrast = np.geomspace(0.006, 0.15, n_separations), np.linspace(0.0, 5.0, n_contrasts)
    m, c, r = np.meshgrid(magnitudes, contrast, separation, indexing="ij")
    found = []
    for name in NAMES:
        survey = SURVEYS[name]
        psf = psf_from_name(survey.psf, pixel=survey.pixel, jitter=survey.jitter)
        found.append(Detection.of(psf, EXPOSURES[name]()).rejected(r, 10 ** (-0.4 * c), m))
    return xr.Dataset(
        {"probability": (("survey", "magnitude", "contrast", "separation"), np.array(found))},
        coords={
            "survey": list(NAMES.values()), "magnitude": list(magnitudes), "contrast": contrast,
            "separation": separation,
        },
        attrs={"cut": 0.05},
    )  # fmt: skip


def write_recognition(folder: str | Path) -> Path:
    """The figure of what surveys recognise, written.

    Parameters
    ----------
    folder : str or Path
        Where ``detection.png`` goes.

    Returns
    -------
    path : Path
        Of the figure.
    """
    from porrima.detection_figure import detection_maps  # noqa: PLC0415  (slow to import, where used)

    path = Path(folder) / "detection.png"
    write_figure(detection_maps(recognition_maps()), path)
    return path
