"""What a survey takes for one star: the point sources of each system, seen about their flux centroid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from porrima.moments import KernelMoments, moments_of_points

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["Systems"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Systems:
    """Systems of two or more point sources, each seen by the survey as one star.

    Parameters
    ----------
    flux : (n, k) float array
        Share of each of the k sources in the flux of its system, in [0, 1], sum 1.
    x, y : (n, k) float array
        Offset of each source from the flux centroid of its system, in arcsec.
    weight : (n,) float array
        Weight of each system in the stack, dimensionless, not negative.
    """

    flux: FloatArray
    x: FloatArray
    y: FloatArray
    weight: FloatArray

    @classmethod
    def from_pairs(
        cls, flux_ratio: FloatArray, dx: FloatArray, dy: FloatArray, weight: FloatArray | None = None
    ) -> Systems:
        """Systems of two sources.

        Parameters
        ----------
        flux_ratio : (n,) float array
            Companion flux over primary flux, in [0, 1]; 0 for a single star.
        dx, dy : (n,) float array
            Companion offset from the primary along the detector axes, in arcsec.
        weight : (n,) float array, optional
            Weight in the stack, dimensionless; 1 where not given.

        Returns
        -------
        systems : Systems
            Primary first, then companion.

        Raises
        ------
        ValueError
            If a flux ratio lies outside [0, 1], an offset is not finite, or the weights do not sum to
            more than 0.
        """
        f, dx, dy = (np.atleast_1d(np.asarray(v, dtype=float)) for v in (flux_ratio, dx, dy))
        w = np.ones_like(f) if weight is None else np.atleast_1d(np.asarray(weight, dtype=float))
        for name, values, good, rule in (
            ("flux_ratio", f, (f >= 0) & (f <= 1), "in [0, 1]"),
            ("dx", dx, np.isfinite(dx), "finite"),
            ("dy", dy, np.isfinite(dy), "finite"),
            ("weight", w, np.isfinite(w) & (w >= 0), "finite and not negative"),
        ):
            if not np.all(good):
                raise ValueError(f"{name} must be {rule}, got {values[~good][0]}")
        if not w.sum() > 0:
            raise ValueError(f"weight must have a positive sum, got {w.sum()}")
        flux = np.stack([1 / (1 + f), f / (1 + f)], axis=1)
        from_centroid = np.stack([-f / (1 + f), 1 / (1 + f)], axis=1)
        return cls(flux=flux, x=from_centroid * dx[:, None], y=from_centroid * dy[:, None], weight=w)

    def __len__(self) -> int:
        return int(self.weight.size)

    def kernel_moments(self) -> KernelMoments:
        """Mean kernel moments of the stack of all systems.

        Returns
        -------
        moments : KernelMoments
            Of one stack, in arcsec^(a+b), weighted with `weight`.
        """
        each = moments_of_points(self.flux, self.x, self.y)
        mean = self.weight @ each / self.weight.sum()
        return KernelMoments(values=mean[None, :], n_stars=len(self))
