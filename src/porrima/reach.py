"""How far an estimator looks behind a PSF: its aperture, and the stamp that holds its weight."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from porrima.shapes import Plain

if TYPE_CHECKING:
    from porrima.psf import PSF
    from porrima.shapes import Estimator

__all__ = ["settled", "stamp_reach"]

APERTURE = 0.75
"""Radius that `settled` chooses for PSFs whose moments diverge, in arcsec."""

NOTHING = 1e-16
"""Brightness at the edge of a stamp over that of its peak, below which nothing is beyond (dimensionless)."""

DIVERGES = 1e-3
"""Share of R² in the outer fifth of the stamp above which plain moments have not converged (dimensionless)."""


@lru_cache(maxsize=16)
def settled(estimator: Estimator, psf: PSF) -> Estimator:
    """Estimator that measures stars behind a PSF: plain moments that diverge get an aperture.

    Parameters
    ----------
    estimator : Estimator
        As asked for.
    psf : PSF
        Drawn once.

    Returns
    -------
    estimator : Estimator
        `Plain` within `APERTURE` where `Plain` without an aperture was asked for and the outer fifth of a
        stamp that holds it has more than `DIVERGES` of R²; otherwise the one that was given.
    """
    if not (isinstance(estimator, Plain) and estimator.aperture is None):
        return estimator
    image = psf.draw(reach=1.25 * APERTURE)
    ny, nx = image.array.shape
    x, y = ((np.arange(n) - (n - 1) / 2) for n in (nx, ny))
    second = image.array * (x**2 + y[:, None] ** 2)
    inner = second[np.ix_(np.abs(y) <= 0.4 * ny, np.abs(x) <= 0.4 * nx)].sum()
    return estimator if abs(second.sum() - inner) <= DIVERGES * abs(inner) else Plain(APERTURE)


@lru_cache(maxsize=16)
def stamp_reach(estimator: Estimator, psf: PSF) -> float:
    """Least half width of a stamp of a PSF that holds all that an estimator weighs.

    Parameters
    ----------
    estimator : Estimator
        From `settled`.
    psf : PSF
        Drawn once.

    Returns
    -------
    reach : float
        In arcsec; 0 where the PSF's own stamp is enough, for nothing of it is left at the edge.
    """
    if estimator.reach == 0:
        return 0.0
    pixels = np.abs(psf.draw().array)
    edge = max(pixels[[0, -1]].max(), pixels[:, [0, -1]].max())
    return 0.0 if edge <= NOTHING * pixels.max() else estimator.reach
