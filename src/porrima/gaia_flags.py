r"""What Gaia's own flags say of pairs: a model of double peaks and of RUWE in DR3, as a selection."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.special import erf, ndtr

from porrima.selection import probability_layer

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.selection import Layer

    FloatArray = NDArray[np.float64]

__all__ = ["GaiaFlags", "along_scan_error", "orbital_excess"]

APERTURE, SAMPLE = 1.45, 0.0589
"""Length of Gaia's mirrors along scan, in m, and of a sample, in arcsec (Gaia Collaboration, Prusti et al. 2016)."""

WAVELENGTHS = (500e-9, 650e-9, 800e-9)
"""That stand for the G band of late-type stars, in m."""

WINDOW = 0.354
"""Half width along scan of the window of 12 samples in which a star fainter than G = 16 is seen, in arcsec."""

SCANS, YEARS = 17, 2.83
"""Independent scan directions of a typical source in DR3 (visibility periods, count), and the time that DR3 spans."""

PEAK_SIGNIFICANCE = 5.0
"""Of the companion in one window, in units of its noise, at which half of its peaks are recognised [?]."""

_G = np.array([12.0, 13.0, 14.0, 15.0, 16.0, 17.0, 18.0, 19.0, 20.0, 21.0])
_SIGMA_AL = np.array([0.14, 0.14, 0.17, 0.25, 0.39, 0.66, 1.18, 2.28, 4.7, 10.0])  # mas

SMEAR = 0.025
"""Sigma of the Gaussian that brings the line spread function to its FWHM of 0.103 arcsec, in arcsec: aberrations,
charge diffusion, motion during the exposure."""

_BACKGROUND = 0.01  # of the line spread function's peak, in its fit
_STEP = 2e-3  # of its grid, arcsec
_SEPARATION = np.linspace(0.0, 0.6, 61)  # along scan, arcsec
_CONTRAST = np.linspace(0.0, 7.0, 15)  # mag


def along_scan_error(magnitude: FloatArray) -> FloatArray:
    """Error of Gaia's place of a star along scan on one CCD.

    Parameters
    ----------
    magnitude : (n,) float array
        G, in mag.

    Returns
    -------
    error : (n,) float array
        In arcsec: the scatter of the residuals in EDR3, attitude and calibration included.

    References
    ----------
    Lindegren2021b, Fig. A.1, as digitised in astromet.py
    """
    return np.asarray(1e-3 * np.exp(np.interp(magnitude, _G, np.log(_SIGMA_AL))))


@lru_cache(maxsize=1)
def _line_spread() -> tuple[FloatArray, FloatArray]:
    """Grid in arcsec and line spread function of a long aperture behind samples, of sum 1."""
    x = np.arange(-1000, 1001) * _STEP
    arcsec = math.pi / 648_000
    line: FloatArray = np.mean([np.sinc(x * arcsec * APERTURE / w) ** 2 / w for w in WAVELENGTHS], axis=0)
    edge = np.sqrt(2.0) * SMEAR
    box = erf((x + SAMPLE / 2) / edge) - erf((x - SAMPLE / 2) / edge)
    line = np.convolve(line, box, mode="same")
    return np.asarray(x, dtype=np.float64), np.asarray(line / line.sum(), dtype=np.float64)


@lru_cache(maxsize=1)
def _blends() -> tuple[FloatArray, FloatArray]:
    """Whether two stars along scan have two peaks, and the fitted place minus the photocentre [arcsec].

    Over `_SEPARATION` and `_CONTRAST`.  The fit is of maximum likelihood by the line of one star, within the window.
    """
    x, line = _line_spread()
    peak = line.max()
    double, shift = (np.zeros((_SEPARATION.size, _CONTRAST.size)) for _ in range(2))
    trial = np.arange(-200, 201)
    near = np.abs(x) <= WINDOW
    model = np.array([np.log(np.roll(line, k)[near] + _BACKGROUND * peak) for k in trial])
    total = np.array([np.roll(line, k)[near].sum() for k in trial])
    for j, f in enumerate(10 ** (-0.4 * _CONTRAST)):
        s = f / (1 + f)
        for i, d in enumerate(_SEPARATION):
            blend = (1 - s) * np.interp(x + s * d, x, line) + s * np.interp(x - (1 - s) * d, x, line)
            here = blend[np.abs(x) <= d + 0.1]
            tops = (here[1:-1] > here[:-2]) & (here[1:-1] >= here[2:]) & (here[1:-1] > 0.3 * s * peak)
            double[i, j] = tops.sum() > 1
            blend = blend[near] + _BACKGROUND * peak
            likelihood = model @ blend - total * blend.sum() / total.max()
            k = int(np.argmax(likelihood))
            if 0 < k < trial.size - 1:
                left, middle, right = likelihood[k - 1 : k + 2]
                shift[i, j] = _STEP * (trial[k] + 0.5 * (left - right) / (left - 2 * middle + right))
            else:
                shift[i, j] = _STEP * trial[k]
        shift[:, j] -= shift[0, j]
    return double, shift


@lru_cache(maxsize=1)
def _scan_table() -> tuple[RegularGridInterpolator, RegularGridInterpolator]:
    """Share of scans with two peaks, and rms of what a fixed place leaves, over separation and contrast."""
    double, shift = _blends()
    angle = (np.arange(90) + 0.5) * math.pi / 180
    axes = (_SEPARATION, _CONTRAST)
    share, rms = np.zeros_like(double), np.zeros_like(shift)
    for j in range(_CONTRAST.size):
        for i, r in enumerate(_SEPARATION):
            along = r * np.cos(angle)
            share[i, j] = np.interp(along, _SEPARATION, double[:, j]).mean()
            place = np.interp(along, _SEPARATION, shift[:, j])
            linear = (place @ np.cos(angle)) / (np.cos(angle) @ np.cos(angle)) * np.cos(angle)
            rms[i, j] = np.sqrt(np.mean((place - linear) ** 2))
    return RegularGridInterpolator(axes, share), RegularGridInterpolator(axes, rms)


@dataclass(frozen=True, slots=True, kw_only=True)
class GaiaFlags:
    r"""Stars that Gaia DR3's ``ipd_frac_multi_peak`` and ``ruwe`` take for pairs: a selection.

    Parameters
    ----------
    multi_peak : bool
        Whether a star is rejected for windows with two peaks (``ipd_frac_multi_peak`` > 2).
    ruwe_max : float
        Largest ``ruwe`` that is kept; infinite for no such cut.
    false_alarm : float
        Share of single stars that is rejected all the same, in [0, 1).
    colour : float
        Magnitude of the selection's band minus G, in mag.

    Notes
    -----
    A model, not Gaia's pipeline.  A pair of fixed position angle lies along scan at :math:`r |\cos\psi|`.  Two lines
    (diffraction by 1.45 m, samples of 59 mas) have two peaks from 0.09 arcsec on for equal stars, 0.14 arcsec at
    2 mag and 0.19 arcsec at 4 mag, where the companion stands out of the noise of a window; a pair is flagged when
    one of `SCANS` independent scans shows it, for 2 per cent of the windows are fewer than one scan.  A blended pair
    is placed by the fit of one line: what one place on the sky leaves of that over the scan angles is the rms
    :math:`\delta`, and RUWE² = :math:`1 + (\delta / \sigma_{AL})^2`.  Windows of two dimensions, neighbours, a
    variable background and what DR3 drops are left out.  Pairs wider than 0.6 arcsec are treated as at 0.6 arcsec.
    Orbital motion is not in it, for it depends on distance and period: see `orbital_excess`.  Astrometric
    ``non_single_star`` solutions were tried for stars with ruwe > 1.4 only (Halbwachs et al. 2023), spectroscopic
    ones for stars brighter than 13 mag: the flag adds nothing to ``ruwe`` here.

    References
    ----------
    GaiaMission2016, Lindegren2021b, Fabricius2021, Holl2023, Halbwachs2023
    """

    multi_peak: bool = True
    ruwe_max: float = 1.4
    false_alarm: float = 0.0
    colour: float = 0.0

    def rejected(self, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray) -> FloatArray:
        """Probability that a system is flagged.

        Parameters
        ----------
        separation, flux_ratio, magnitude : (n,) float array
            In arcsec; companion over primary, in [0, 1]; of the whole system, in mag.  Any shapes that broadcast.

        Returns
        -------
        rejected : (n,) float array
            In [0, 1], averaged over position angle.
        """
        r, f, g = np.broadcast_arrays(
            separation, flux_ratio, np.asarray(magnitude, dtype=float) - self.colour
        )
        share, rms = _scan_table()
        contrast = np.clip(-2.5 * np.log10(np.maximum(f, 1e-12)), 0.0, _CONTRAST[-1])
        place = np.stack([np.clip(r, 0.0, _SEPARATION[-1]), contrast], axis=-1)
        error, pair = along_scan_error(g), f > 10 ** (-0.4 * _CONTRAST[-1])
        kept = np.full(r.shape, 1.0 - self.false_alarm)
        if self.multi_peak:
            seen = ndtr(f / (1 + f) * SAMPLE / error - PEAK_SIGNIFICANCE)
            kept = kept * np.where(
                pair, (1 - np.clip(share(place).reshape(r.shape), 0, 1)) ** SCANS * seen + 1 - seen, 1.0
            )
        ruwe2 = 1 + np.where(pair, (rms(place).reshape(r.shape) / error) ** 2, 0.0)
        return np.asarray(1 - kept * (ruwe2 <= self.ruwe_max**2))

    def layers(
        self, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray
    ) -> tuple[Layer, ...]:
        """The flags on a grid.

        Parameters
        ----------
        separation, flux_ratio, magnitude : (n_r,), (n_f,), (n_m,) float array
            In arcsec, dimensionless and mag.

        Returns
        -------
        layers : tuple of Layer
            One, in [0, 1].
        """
        return (probability_layer(self, separation, flux_ratio, magnitude),)


def orbital_excess(period: FloatArray) -> FloatArray:
    r"""Share of the variance of a sinusoid that a fit of place and proper motion over DR3 leaves.

    Parameters
    ----------
    period : (n,) float array
        Of a circular orbit, in yr.

    Returns
    -------
    share : (n,) float array
        Mean over phase, in [0, 1].

    Notes
    -----
    With :math:`z = \pi T / P`, :math:`1 - j_0(z)^2 - 3 j_1(z)^2` (spherical Bessel functions), which falls as
    :math:`z^4 / 45` for long periods.  The variance of the photocentre along one direction is
    :math:`\frac13 [\frac{a}{d} (\frac{q}{1+q} - \frac{f}{1+f})]^2` for isotropic orbits.  The parallax, which takes
    what is left at one year, is not in it.
    """
    z = math.pi * YEARS / np.asarray(period, dtype=float)
    small = np.minimum(z, 0.05)
    z_safe = np.maximum(z, 0.05)
    j0 = np.sin(z_safe) / z_safe
    j1 = j0 / z_safe - np.cos(z_safe) / z_safe
    return np.where(z < 0.05, small**4 / 45, 1 - j0**2 - 3 * j1**2)
