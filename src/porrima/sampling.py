"""PSFs sampled on a fine grid: convolution with pixel, jitter and charge diffusion, and what FFTs would redo."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import galsim
import numpy as np
from scipy import fft, signal

from porrima.units import SIGMA_PER_FWHM

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["HALF_WIDTH", "Blur", "convolved", "fwhm_of", "interpolated", "sampled", "upsampled"]

HALF_WIDTH = 5.5
"""Least half width of a grid of samples, in arcsec: seven sigmas of a weight of 0.78 arcsec."""

MAX_SIDE = 4096
"""Most pixels along a side of a grid of samples (count)."""

FWHM_PIXELS = 64
"""Pixels across the FWHM where it is measured (count)."""

CORE = 1.25
"""Half width of what is drawn twice as fine, in arcsec."""

N_TAPS = 41
"""Taps of the filter by which every other pixel is left out: flat to 3e-7 over the lower half of the frequencies
that remain (count)."""

TIGHT = {"maxk_threshold": 1e-6, "kvalue_accuracy": 1e-10, "maximum_fft_size": 8192}
"""GalSim's accuracy for a profile that only an FFT can draw.  Its folding threshold stays: the grid is wide, and
with it the pupil of an ``OpticalPSF`` would change."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Blur:
    """What the detector and the pointing add to a PSF.

    Parameters
    ----------
    pixel : float
        Side of a square pixel, in arcsec; 0 for none.
    sigma : float
        Standard deviation of the round Gaussian of jitter and charge diffusion together, in arcsec; 0 for none.
    """

    pixel: float = 0.0
    sigma: float = 0.0

    def transfer(self, frequency: FloatArray) -> FloatArray:
        """Transfer function along one axis.

        Parameters
        ----------
        frequency : (n,) float array
            In cycles per arcsec.

        Returns
        -------
        transfer : (n,) float array
            Dimensionless, 1 at frequency 0.

        Notes
        -----
        sinc(p f) exp(-2 pi² sigma² f²); the one of two dimensions is the product over both axes.
        """
        gaussian = np.exp(-2 * (math.pi * self.sigma * frequency) ** 2)
        return np.asarray(np.sinc(self.pixel * frequency) * gaussian)


def interpolated(pixels: FloatArray, scale: float) -> Any:
    """Profile through samples of a surface brightness.

    Parameters
    ----------
    pixels : (n, n) float array
        Odd n, the origin in the middle; in any unit of flux.
    scale : float
        Side of a pixel, in arcsec.

    Returns
    -------
    profile : galsim.InterpolatedImage
        Of flux 1, with GalSim's quintic between the samples.

    References
    ----------
    Rowe2015
    """
    image = galsim.ImageD(np.ascontiguousarray(pixels), scale=scale)
    return galsim.InterpolatedImage(
        image,
        x_interpolant="quintic",
        flux=1.0,
        pad_factor=1.0,  # pads for FFTs only, with a third of a gigabyte
        calculate_stepk=False,
        calculate_maxk=False,
    )


def fwhm_of(profile: Any) -> float:
    """Full width at half maximum: diameter of the disc with the area above half the maximum.

    Parameters
    ----------
    profile : galsim.GSObject
        Its maximum near its origin.

    Returns
    -------
    fwhm : float
        Good to 1e-3, in arcsec.

    Notes
    -----
    GalSim's ``calculateFWHM`` draws with as few pixels as do for an FFT: for ``galsim.roman`` it is 30 % too small.
    """
    if hasattr(profile, "fwhm") or not profile.is_analytic_x:
        return float(profile.calculateFWHM())
    side = 4 * FWHM_PIXELS + 1
    fwhm = math.sqrt(profile.flux / (2 * math.pi * profile.max_sb)) / SIGMA_PER_FWHM
    for _ in range(8):
        scale, before = fwhm / FWHM_PIXELS, fwhm
        drawn = profile.drawImage(nx=side, ny=side, scale=scale, method="no_pixel", dtype=float).array
        fwhm = 2 * math.sqrt(np.count_nonzero(drawn > drawn.max() / 2) / math.pi) * scale
        if abs(fwhm - before) < 0.25 * before:
            break
    return fwhm


def sampled(profile: Any, scale: float, half_width: float = HALF_WIDTH, blur: Blur | None = None) -> Any:
    """Profile drawn once on a fine grid, behind a pixel and a Gaussian if wanted.

    Parameters
    ----------
    profile : galsim.GSObject
        Any; one that only an FFT can draw, such as a convolution, is drawn by one.
    scale : float
        Side of a pixel of the grid, at most a twelfth of the FWHM, in arcsec.
    half_width : float
        Of the grid, in arcsec; light beyond is left out.
    blur : Blur, optional
        With what it is convolved.

    Returns
    -------
    image : galsim.ImageD
        Odd number of pixels a side, the origin in the middle.

    Raises
    ------
    galsim.GalSimFFTSizeError
        If not even GalSim's default accuracy fits into its largest FFT.

    Notes
    -----
    An interpolated image has kinks, and sums over pixels of 0.1/12 arcsec see them: by 1e-3 of a size change,
    differently for each place of a star in its pixel (`galsim.roman`, FITS images of 0.1 arcsec).  Its core is
    therefore drawn twice as fine, and frequencies that would fold onto those of the PSF are filtered out.
    """
    side = min(2 * math.ceil(half_width / scale) + 1, MAX_SIDE - 1)

    def draw(of: Any, size: int, step: float) -> Any:
        return of.drawImage(nx=size, ny=size, scale=step, method="no_pixel", dtype=float)

    if profile.is_analytic_x:
        image = draw(profile, side, scale)
        middle, core = side // 2, min(side // 2, math.ceil(CORE / scale))
        inside = slice(middle - core, middle + core + 1)
        fine = draw(profile, 4 * core + N_TAPS, scale / 2)
        image.array[inside, inside] = _every_other(fine.array)
    else:
        try:
            image = draw(profile.withGSParams(**TIGHT), side, scale)
        except galsim.GalSimFFTSizeError:
            image = draw(profile, side, scale)
    return image if blur is None else convolved(image, blur)


def _every_other(pixels: FloatArray) -> FloatArray:
    """Flux of every other pixel, counted from half the filter inside the edge, of the filtered image."""
    taps = signal.firwin(N_TAPS, 0.5, window=("kaiser", 14))
    kept = (pixels.shape[0] - N_TAPS) // 2 + 1
    matrix = np.zeros((kept, pixels.shape[0]))
    for row in range(kept):
        matrix[row, 2 * row : 2 * row + N_TAPS] = 2 * taps
    return np.asarray(matrix @ pixels @ matrix.T)


def convolved(image: Any, blur: Blur) -> Any:
    """Samples of a PSF behind a pixel and a Gaussian.

    Parameters
    ----------
    image : galsim.Image
        Odd number of pixels a side, the origin in the middle.
    blur : Blur
        With what it is convolved.

    Returns
    -------
    image : galsim.ImageD
        On the same grid.

    Notes
    -----
    By one FFT with the transfer functions themselves, exact for samples that resolve the PSF; zeros around
    the grid keep what leaves one edge from coming back at the other.
    """
    n, scale = image.array.shape[0], image.scale
    size = fft.next_fast_len(n + math.ceil((blur.pixel / 2 + 6 * blur.sigma) / scale), real=True)
    spectrum = fft.rfft2(image.array, (size, size), workers=-1)
    spectrum *= blur.transfer(fft.fftfreq(size, scale))[:, None] * blur.transfer(fft.rfftfreq(size, scale))
    pixels = fft.irfft2(spectrum, (size, size), workers=-1)[:n, :n]
    return galsim.ImageD(np.ascontiguousarray(pixels), scale=scale)


def upsampled(pixels: FloatArray, factor: int) -> FloatArray:
    """Band-limited image on a finer grid.

    Parameters
    ----------
    pixels : (n, n) float array
        Even n, the origin at [n/2, n/2]; in any unit of flux.
    factor : int
        How many times finer (count).

    Returns
    -------
    fine : (m, m) float array
        Surface brightness at the new points, the origin in the middle, m = (n - 2) factor + 1; in the same unit.

    Notes
    -----
    Zeros beyond the highest frequency: exact where the image resolves all there is, as an image of a
    diffraction pattern does, and dies at its edges.
    """
    n = pixels.shape[0]
    size = n * factor
    spectrum = np.zeros((size, size), dtype=complex)
    low = (size - n) // 2
    spectrum[low : low + n, low : low + n] = fft.fftshift(fft.fft2(pixels))
    fine = fft.ifft2(fft.ifftshift(spectrum)).real * factor**2
    reach = (n // 2 - 1) * factor
    middle = size // 2
    return np.ascontiguousarray(
        fine[middle - reach : middle + reach + 1, middle - reach : middle + reach + 1]
    )
