"""The simplest selection, whose effect is that of a smaller cut."""

from dataclasses import dataclass

import numpy as np

from porrima.selection import SHARP, Layer


@dataclass(frozen=True, slots=True, kw_only=True)
class HardCut:
    """Pairs at or beyond a separation in arcsec are rejected, all others and single stars kept."""

    separation: float

    def rejected(self, separation, flux_ratio, magnitude):
        beyond, _, _ = np.broadcast_arrays(separation >= self.separation, flux_ratio, magnitude)
        return beyond.astype(float)

    def layers(self, separation, flux_ratio, magnitude):
        score = ((separation / self.separation) ** 2 - 1) / SHARP
        return (Layer(score=np.tile(score, (1, flux_ratio.size, 1)), normal=True),)
