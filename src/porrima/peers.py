"""What others would write: the same stacks with numpy and GalSim, drawn and measured as images.

Nothing is shared with the engine but the population itself.  Companions are drawn by vectorised numpy; three ways
lead from them to a shape.  They are meant to be as fast as a competent user would make them, and to be right.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import galsim
import numpy as np
from scipy import fft

from porrima.photometry import STEP

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from porrima.psf import PSF
    from porrima.systems import Population

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = [
    "PEERS",
    "STAMP",
    "Companions",
    "Pairs",
    "convolved",
    "hsm",
    "one_convolution",
    "one_draw",
    "star_by_star",
]

STAMP = 128
"""Pixels on a side of every image (count)."""

_BATCH = 8  # stamps transformed at once: they stay in the cache
_LN10 = float(np.log(10.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Pairs:
    """Unresolved pairs among the stars of some stacks of equal size; all other stars are single.

    Parameters
    ----------
    n_stacks, n_stars : int
        Stacks, and stars in each (count).
    stack : (n,) int array
        Number of the stack of each pair, ascending.
    flux_ratio : (n,) float array
        Companion flux over primary flux, in [0, 1].
    dx, dy : (n,) float array
        Companion offset from the primary, in arcsec.
    """

    n_stacks: int
    n_stars: int
    stack: IntArray
    flux_ratio: FloatArray
    dx: FloatArray
    dy: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Companions:
    r"""Companions of a population, drawn with numpy: what does not change from draw to draw, one row per star.

    Parameters
    ----------
    fraction : (n,) float array
        Probability to have a companion, in [0, 1].
    slope, start : (n,) float array
        :math:`1/(\gamma + 1)` and :math:`q_m^{\gamma+1}` of the mass ratio, dimensionless.
    log_angle, scatter : (n,) float array
        Mean and standard deviation of the natural logarithm of the semi-major axis, as seen, in arcsec.
    place : (n,) float array
        Of the primary on the grid of log mass, in steps.
    magnitude : (n, n_grid) float array
        Each star's own track relative to the primary, in mag.
    cut : float
        Separation from which a pair is resolved, in arcsec.
    """

    fraction: FloatArray
    slope: FloatArray
    start: FloatArray
    log_angle: FloatArray
    scatter: FloatArray
    place: FloatArray
    magnitude: FloatArray
    cut: float

    @classmethod
    def of(cls, population: Population, binary_fraction: float) -> Companions:
        """Companions of one class, with isotropic orbits, a full log-normal of axes and equal weights.

        Parameters
        ----------
        population : Population
            Its n stars and their law.
        binary_fraction : float
            Before resolved pairs leave, in [0, 1].

        Returns
        -------
        companions : Companions
            One row per star.

        Raises
        ------
        ValueError
            If the law is another one.
        """
        law, stars, tracks = population.law, population.stars, population.tracks
        known = not np.any(
            np.isfinite(law.log_a_max)
            | np.isfinite(law.mass_ratio)
            | (law.mass_ratio_max != 1)
            | (law.share != 1)
            | (population.weight != 1)
        )
        if not known or population.projection != "isotropic" or np.any(law.mass_ratio_exponent == -1):
            raise ValueError(f"population must have a full log-normal and isotropic orbits, got {law}")
        own = np.zeros((len(stars), len(tracks.magnitude)))
        for k in range(tracks.index.shape[1]):
            own += tracks.weight[:, k, None] * tracks.magnitude.T[tracks.index[:, k]]
        place = (np.log10(stars.mass) - tracks.log_mass_min) / STEP
        below = np.clip(place.astype(np.int64), 0, own.shape[1] - 2)
        row = np.arange(len(stars))
        own -= (own[row, below] + (place - below) * (own[row, below + 1] - own[row, below]))[:, None]
        exponent = law.mass_ratio_exponent + 1
        return cls(
            fraction=np.minimum(
                1.0, population.scale(np.array([binary_fraction])) * law.multiplicity_fraction
            ),
            slope=1 / exponent,
            start=law.mass_ratio_min**exponent,
            log_angle=_LN10 * law.log_a - np.log(stars.distance),  # au / pc = arcsec
            scatter=_LN10 * law.log_a_sigma,
            place=place,
            magnitude=own,
            cut=population.cut,
        )

    def draw(self, n_stacks: int, n_stars: int, rng: np.random.Generator) -> Pairs:
        """Pairs of stacks of exactly `n_stars` stars: a resolved pair makes room for the next star drawn.

        Parameters
        ----------
        n_stacks, n_stars : int
            Stacks, and stars in each (count).

        Returns
        -------
        pairs : Pairs
            In the order of the stacks.
        """
        wanted, found, parts = n_stacks * n_stars, 0, []
        while found < wanted:
            star = rng.integers(self.fraction.size, size=int(1.1 * (wanted - found)) + 16)
            pair = np.flatnonzero(rng.random(star.size) < self.fraction[star])
            primary = star[pair]
            separation = np.exp(
                self.log_angle[primary] + self.scatter[primary] * rng.standard_normal(pair.size)
            )
            separation *= np.sqrt(1 - rng.random(pair.size) ** 2)
            seen = separation < self.cut
            before: IntArray = np.cumsum(~seen) - ~seen  # resolved pairs ahead of each pair
            place = found + pair[seen] - before[seen]
            inside = place < wanted
            parts.append((place[inside], primary[seen][inside], separation[seen][inside]))
            found += star.size - int(pair.size - seen.sum())
        place, primary, separation = (np.concatenate(part) for part in zip(*parts, strict=True))
        angle = 2 * np.pi * rng.random(place.size)
        return Pairs(
            n_stacks=n_stacks,
            n_stars=n_stars,
            stack=place // n_stars,
            flux_ratio=self._flux_ratios(primary, rng),
            dx=separation * np.cos(angle),
            dy=separation * np.sin(angle),
        )

    def _flux_ratios(self, primary: IntArray, rng: np.random.Generator) -> FloatArray:
        """Flux ratio of a drawn companion of each primary, on its own track; 0 below the track's first mass."""
        start, n_grid = self.start[primary], self.magnitude.shape[1]
        q = (start + rng.random(primary.size) * (1 - start)) ** self.slope[primary]
        place = self.place[primary] + np.log10(q) / STEP
        below = np.clip(place.astype(np.int64), 0, n_grid - 2)
        at, track = primary * n_grid + below, self.magnitude.ravel()
        left = track[at]
        magnitude = left + (place - below) * (track[at + 1] - left)
        return np.where(place >= 0, np.minimum(np.exp(-0.4 * _LN10 * magnitude), 1.0), 0.0)


def hsm(image: Any) -> tuple[float, float, float]:
    """Adaptive shape e1, e2, r2 of an image by GalSim's HSM, as it comes.

    Parameters
    ----------
    image : galsim.Image
        With its ``scale`` in arcsec.

    Returns
    -------
    shape : (float, float, float)
        e1, e2 (dimensionless) and r2 in arcsec².
    """
    found = galsim.hsm.FindAdaptiveMom(image)
    e1, e2 = found.observed_shape.e1, found.observed_shape.e2
    return e1, e2, 2 * (found.moments_sigma * image.scale) ** 2 / float(np.sqrt(1 - e1**2 - e2**2))


@lru_cache(maxsize=4)
def _of_galsim(psf: PSF) -> Any:
    """Profile of a PSF in GalSim's own accuracy; of samples, those that a stamp can see: FFTs are 100 times faster."""
    if not isinstance(psf.profile, galsim.InterpolatedImage):
        return psf.profile.withGSParams(galsim.GSParams())
    samples, half = psf.profile.image, STAMP // 2 + 8
    x, y = round(samples.true_center.x), round(samples.true_center.y)
    seen = samples[galsim.BoundsI(x - half, x + half, y - half, y + half)].copy()
    return galsim.InterpolatedImage(seen, x_interpolant="quintic", flux=1.0)


@lru_cache(maxsize=4)
def _transform(psf: PSF) -> NDArray[np.complex128]:
    """Fourier transform of a PSF, its origin in pixel (0, 0)."""
    stamp = psf.profile.drawImage(
        nx=STAMP, ny=STAMP, scale=psf.scale, method="no_pixel", dtype=float, offset=(0.5, 0.5)
    )
    transform: NDArray[np.complex128] = fft.rfft2(np.fft.ifftshift(stamp.array))
    return transform


def _stamp(profile: Any, scale: float) -> Any:
    return profile.drawImage(nx=STAMP, ny=STAMP, scale=scale, method="no_pixel", dtype=float)


def _places(pairs: Pairs) -> tuple[FloatArray, FloatArray]:
    """Flux (2, n) and place x, y (2, 2, n) [arcsec] of primaries and companions about their flux centroids."""
    f = pairs.flux_ratio
    primary = 1 / (1 + f)
    flux = np.stack([primary, f * primary])
    return flux, np.stack([-flux[1], flux[0]])[:, None] * np.stack([pairs.dx, pairs.dy])


def _ends(pairs: Pairs) -> list[int]:
    """Where the pairs of each stack begin, and where the last end."""
    ends: list[int] = np.searchsorted(pairs.stack, np.arange(pairs.n_stacks + 1)).tolist()
    return ends


def _by_stack(pairs: Pairs) -> Iterator[list[list[tuple[float, float, float]]]]:
    """Flux, x and y [arcsec] of both stars of each pair, stack by stack."""
    flux, place = _places(pairs)
    columns = [list(zip(flux[k].tolist(), *place[k].tolist(), strict=True)) for k in range(2)]
    ends = _ends(pairs)
    for first, last in pairwise(ends):
        yield [
            [primary, companion] for primary, companion in zip(*(c[first:last] for c in columns), strict=True)
        ]


def star_by_star(psf: PSF, pairs: Pairs) -> FloatArray:
    """Shapes of stacks by GalSim, each star drawn on its own stamp, the stamps added and measured with HSM.

    Parameters
    ----------
    psf : PSF
        Got ready once, in GalSim's default accuracy.
    pairs : Pairs
        Of n stacks; their other stars are single.

    Returns
    -------
    shapes : (n, 3) float array
        e1, e2 (dimensionless), r2 in arcsec².
    """
    profile, out = _of_galsim(psf), np.empty((pairs.n_stacks, 3))
    for stack, systems in enumerate(_by_stack(pairs)):
        total = galsim.ImageD(STAMP, STAMP, scale=psf.scale)
        for system in systems:
            both = [profile.shift(x, y) * flux for flux, x, y in system if flux > 0]
            total += _stamp(galsim.Sum(both), psf.scale)
        for _ in range(pairs.n_stars - len(systems)):
            total += _stamp(profile, psf.scale)
        out[stack] = hsm(total)
    return out


def one_draw(psf: PSF, pairs: Pairs) -> FloatArray:
    """Shapes of stacks by one GalSim image each: a sum of shifted delta functions convolved with the PSF, and HSM.

    Parameters
    ----------
    psf : PSF
        Got ready once, in GalSim's default accuracy.
    pairs : Pairs
        Of n stacks; their other stars are one delta function.

    Returns
    -------
    shapes : (n, 3) float array
        e1, e2 (dimensionless), r2 in arcsec².
    """
    profile, out = _of_galsim(psf), np.empty((pairs.n_stacks, 3))
    for stack, systems in enumerate(_by_stack(pairs)):
        stars = [
            galsim.DeltaFunction(flux=flux).shift(x, y)
            for system in systems
            for flux, x, y in system
            if flux > 0
        ]
        stars.append(galsim.DeltaFunction(flux=pairs.n_stars - len(systems)))
        out[stack] = hsm(_stamp(galsim.Convolve(galsim.Sum(stars), profile), psf.scale))
    return out


def one_convolution(psf: PSF, pairs: Pairs) -> FloatArray:
    """Shapes of stacks by one FFT each: sources counted in the nearest pixel, convolved with the PSF, and HSM.

    Parameters
    ----------
    psf : PSF
        Transformed once.
    pairs : Pairs
        Of n stacks; their other stars lie in one pixel.

    Returns
    -------
    shapes : (n, 3) float array
        e1, e2 (dimensionless), r2 in arcsec².

    Notes
    -----
    A pixel of 0.1/12 arcsec is not small beside the companions: those within half of one are lost, others move in or
    out.  The mean size change of a stack comes out 5.4 % too large at 18 to 19 mag, behind `psf1` and `optical1`.
    """
    images = (image for batch in convolved(psf, pairs) for image in batch)
    return np.array([hsm(galsim.Image(image, scale=psf.scale)) for image in images])


def convolved(psf: PSF, pairs: Pairs) -> Iterator[FloatArray]:
    """Images of stacks by FFT, a few at a time.

    Parameters
    ----------
    psf : PSF
        Transformed once.
    pairs : Pairs
        Of n stacks; their other stars lie in one pixel.

    Returns
    -------
    images : iterator of (k, 128, 128) float array
        Of flux `n_stars` each, the flux centroids in the middle of pixel (64, 64), dimensionless.
    """
    ends, middle = _ends(pairs), STAMP // 2
    flux, place = _places(pairs)
    column, row = np.rint(place / psf.scale).astype(np.int64).transpose(1, 0, 2)
    pixel = (pairs.stack % _BATCH) * STAMP**2 + (row + middle) * STAMP + column + middle
    for start in range(0, pairs.n_stacks, _BATCH):
        stop = min(start + _BATCH, pairs.n_stacks)
        here = slice(ends[start], ends[stop])
        grid = np.bincount(pixel[:, here].ravel(), flux[:, here].ravel(), (stop - start) * STAMP**2)
        grid = grid.reshape(-1, STAMP, STAMP)
        grid[:, middle, middle] += pairs.n_stars - np.diff(ends[start : stop + 1])
        spectrum = fft.rfft2(grid)
        spectrum *= _transform(psf)
        yield fft.irfft2(spectrum, s=grid.shape[1:], overwrite_x=True)


PEERS: dict[str, Callable[[PSF, Pairs], FloatArray]] = {
    "galsim-stars": star_by_star,
    "galsim-sum": one_draw,
    "fft": one_convolution,
}
"""Ways to the same shapes by name."""
