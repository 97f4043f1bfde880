r"""Whether a survey sees that a star is two: the residual of its best fit by one star, and the chance to notice it."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter1d
from scipy.special import ndtri
from scipy.stats import chi2, ncx2

from porrima import __version__
from porrima.cache import content_key, load, save
from porrima.pointings import HALF_WIDTH, REACH, Pointings, dither_pattern, pointings
from porrima.selection import Layer, probability_layer
from porrima.units import SIGMA_PER_FWHM

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.exposure import Exposures
    from porrima.psf import PSF

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = ["FALSE_ALARM", "Detection", "Statistic", "detection_probability", "misfit", "threshold"]

Statistic = Literal["shape", "residuals"]
"""What is looked at: the fall of chi² when second derivatives of the PSF are fitted with the star, or chi² itself."""

FALSE_ALARM = 1e-3
"""Share of single stars that are taken for pairs, where nothing else is asked for (dimensionless)."""

SHAPE_DEGREES = 3
"""Second derivatives that are fitted: xx, xy, yy (count)."""

CLOSE, FIT_STEPS = 0.04, 4
"""Separation in arcsec up to which the best fit of one star lies so near the flux centroid that the projection finds
it (to 1e-3 of the misfit), and Gauss-Newton steps for wider pairs (count): 1 % is missing at 0.15 arcsec, where the
fit turns from the centroid to the primary and converges slowly, 4 to 20 % at 0.2 arcsec."""

ANGLES, PHASES, GROUPS = 8, 4, 8
"""Position angles, places of the star in its pixels, and classes in which their misfits are averaged (count)."""

SEPARATIONS, WIDEST = 24, 0.3
"""Separations of a table (count) and the largest, in arcsec, from which on nothing changes any more."""

_LOG_SEPARATION = np.linspace(math.log10(0.005), math.log10(WIDEST), SEPARATIONS)
_CONTRAST = np.linspace(0.0, 7.5, 16)
_CORE, _PEAK = 0.15, 0.1  # arcsec and share of the flux: where the trend of the misfit bends


def threshold(false_alarm: float, degrees: int = SHAPE_DEGREES) -> float:
    """Value of the statistic that a single star passes with a given probability.

    Parameters
    ----------
    false_alarm : float
        Share of single stars taken for pairs, in (0, 1).
    degrees : int
        Degrees of freedom of the statistic (count).

    Returns
    -------
    threshold : float
        Of chi², dimensionless.

    Raises
    ------
    ValueError
        If the share is not in (0, 1).
    """
    if not 0 < false_alarm < 1:
        raise ValueError(f"false_alarm must be in (0, 1), got {false_alarm}")
    return float(chi2.isf(false_alarm, degrees))


def detection_probability(
    misfit: FloatArray, false_alarm: float = FALSE_ALARM, degrees: int = SHAPE_DEGREES
) -> FloatArray:
    r"""Probability that noise and misfit together pass the threshold.

    Parameters
    ----------
    misfit : (n,) float array
        Expected :math:`\Delta\chi^2` without noise, not negative, dimensionless.
    false_alarm : float
        Share of single stars taken for pairs, in (0, 1).
    degrees : int
        Degrees of freedom of the statistic (count).

    Returns
    -------
    probability : (n,) float array
        In [0, 1]; the false-alarm rate where there is no misfit.

    Notes
    -----
    The statistic is a non-central :math:`\chi^2` with the misfit as its non-centrality: exact for Gaussian noise of
    known variance, and for a fit that is linear over its noise.
    """
    grid, value = _probabilities(false_alarm, degrees)
    return np.asarray(np.interp(np.sqrt(np.asarray(misfit, dtype=float)), grid, value))


@lru_cache(maxsize=16)
def _probabilities(false_alarm: float, degrees: int) -> tuple[FloatArray, FloatArray]:
    """Probability on a grid of the root of the misfit, to 1e-5: scipy's own takes a microsecond each."""
    limit = threshold(false_alarm, degrees)
    top = math.sqrt(limit) + 8.0
    grid = np.linspace(0.0, top, 2000)
    return grid, np.append(false_alarm, ncx2.sf(limit, degrees, grid[1:] ** 2))


def misfit(
    star: Pointings,
    exposures: Exposures,
    separation: FloatArray,
    flux_ratio: FloatArray,
    angle: FloatArray,
    magnitude: FloatArray,
    statistic: Statistic = "shape",
    r2_error: float = 0.0,
) -> FloatArray:
    r"""Expected :math:`\Delta\chi^2` of the best fit by one star to pairs without noise.

    Parameters
    ----------
    star : Pointings
        Places of the star in its exposures, and the effective PSF.
    exposures : Exposures
        Its flux and noise; the number of exposures is that of `star`.
    separation, flux_ratio, angle : (n,) float array
        Of the pairs: in arcsec; companion over primary, in [0, 1]; position angle in rad.
    magnitude : (m,) float array
        Of the whole system, in mag.
    statistic : {"shape", "residuals"}
        What is looked at.
    r2_error : float
        Rms error of the known PSF in R², and in R² e1 and R² e2, in arcsec²; it counts as noise of the shape, and is
        not in the residuals.

    Returns
    -------
    misfit : (n, m) float array
        Dimensionless.

    Notes
    -----
    A star of F electrons has in a pixel the variance :math:`V = B + F P`, with B that of the background and P the
    PSF.  The pair is moved to where its best fit by free flux and place lies where the derivatives are taken (see
    `CLOSE`); the last step is the projection: with the residual r in units of :math:`\sqrt V`
    freed of P and its first derivatives,

    .. math:: \lambda = F^2 |r|^2 \quad\text{or, for the shape,}\quad \lambda = F^2 |T^\mathsf{T} r|^2 ,

    T being an orthonormal basis of what the three second derivatives add; an error of the PSF adds to the unit
    covariance of :math:`T^\mathsf{T} r`, by which its square is then divided.  The noise of the pair is taken for that
    of the star fitted to it.
    """
    templates, flux = star.derivatives(), exposures.electrons(magnitude)
    noise = exposures.background / flux
    residual = _residuals(
        star, templates, _basis(templates, float(np.median(noise))), separation, flux_ratio, angle
    )
    bases = [_basis(templates, level) for level in noise.tolist()]
    parts = np.stack([residual @ (q * root).T for root, q, _ in bases], axis=1)
    if statistic == "shape":
        for k, f in enumerate(flux.tolist()):
            parts[:, k, 3:] = np.linalg.solve(_spread(bases[k][2], f, r2_error), parts[:, k, 3:].T).T
        return np.asarray(flux * (parts[..., 3:] ** 2).sum(axis=-1))
    weight = np.stack([root**2 for root, _, _ in bases], axis=1)
    return np.asarray(np.maximum(flux * (residual**2 @ weight - (parts[..., :3] ** 2).sum(axis=-1)), 0.0))


def _basis(templates: FloatArray, background: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Root of the weights for a star of unit flux, orthonormal whitened templates, and the triangle between them.

    Signals are in units of F, variances in units of F: lambda is F times a square of whitened signals.
    """
    root = 1.0 / np.sqrt(background + np.maximum(templates[0], 0.0))
    scale = np.linalg.norm(templates, axis=1)
    q, triangle = np.linalg.qr((templates * root / scale[:, None]).T)
    return root, q.T, triangle * scale


def _spread(triangle: FloatArray, flux: float, r2_error: float) -> FloatArray:
    """Cholesky factor (3, 3) of the covariance of the shape's three parts, noise and PSF error together.

    Coefficients of the second derivatives are q_xx/2, q_xy and q_yy/2; equal errors of q_xx + q_yy, q_xx - q_yy and
    2 q_xy give them these variances.
    """
    of_psf = math.sqrt(flux) * r2_error * triangle[3:, 3:] * np.sqrt([0.125, 0.25, 0.125])
    return np.asarray(np.linalg.cholesky(np.eye(3) + of_psf @ of_psf.T), dtype=float)


def _residuals(
    star: Pointings,
    templates: FloatArray,
    basis: tuple[FloatArray, FloatArray, FloatArray],
    separation: FloatArray,
    flux_ratio: FloatArray,
    angle: FloatArray,
) -> FloatArray:
    """Images of pairs of unit flux, about their best fits, minus the star."""
    root, q, triangle = basis
    share = flux_ratio / (1 + flux_ratio)
    offset = separation * np.stack([np.cos(angle), np.sin(angle)])

    def images(place: FloatArray, some: IntArray) -> FloatArray:
        (x, y), (dx, dy), s = -place, offset[:, some], share[some, None]
        pairs: FloatArray = star.images(x, y) * (1 - s) + star.images(x + dx, y + dy) * s - templates[0]
        return pairs

    place = share * offset  # of the fitted star from the primary: first the flux centroid
    wide = np.flatnonzero(np.asarray(separation) > CLOSE)
    for _ in range(FIT_STEPS - 1 if wide.size else 0):
        fit = np.linalg.solve(triangle[:3, :3], (images(place[:, wide], wide) @ (q[:3] * root).T).T)
        place[:, wide] += fit[1:] / (1 + fit[0])
    return images(place, np.arange(separation.size))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Detection:
    r"""Probability that a survey recognises a pair on its own images: a selection.

    Parameters
    ----------
    name : str
        Of the exposures and the PSF.
    exposures : Exposures
        Flux and noise.
    false_alarm : float
        Share of single stars taken for pairs, in (0, 1).
    degrees : int
        Degrees of freedom of the statistic (count).
    magnitudes : (n,) float array
        Of the table, one apart, in mag.
    table : (GROUPS, n_separation, n_contrast, n) float array
        Coefficients of the cubic splines through the logarithms of the misfits over their trend, each the mean of a
        class of position angles and places in the pixel, from the smallest to the largest (dimensionless).

    Notes
    -----
    The trend is :math:`y^2 s^4 F^2 / (B + F/10)` with :math:`y = f/(1+f)^2` and :math:`s = r/\sqrt{1 + (r/0.15'')^2}`:
    what is left is flat where pairs are close, contrasts large or stars faint, and hardly needs extrapolation.
    """

    name: str
    exposures: Exposures
    false_alarm: float
    degrees: int
    magnitudes: FloatArray
    table: FloatArray

    @classmethod
    def of(
        cls,
        psf: PSF,
        exposures: Exposures,
        *,
        false_alarm: float = FALSE_ALARM,
        statistic: Statistic = "shape",
        psf_error: float = 0.0,
        roll: FloatArray | None = None,
        magnitudes: tuple[int, int] = (14, 26),
    ) -> Detection:
        """Table of one survey.

        Parameters
        ----------
        psf : PSF
            Effective: convolved with the pixel.
        exposures : Exposures
            Flux, noise and number of the exposures.
        false_alarm : float
            Share of single stars taken for pairs, in (0, 1).
        statistic : {"shape", "residuals"}
            What is looked at.
        psf_error : float
            Rms error of the known PSF in R² over R², and in e1 and e2, from star to star, dimensionless; R² is that of
            a Gaussian of the same FWHM.
        roll : (n_exposures,) float array, optional
            Turn of the detector in each exposure, in rad; none where not given.
        magnitudes : (int, int)
            First and last of the table, in mag.

        Returns
        -------
        detection : Detection
            From 0.005 arcsec to `WIDEST` and 7.5 mag.

        Notes
        -----
        Its table takes seconds, and is kept on disk (`cache`) for the pixels of the PSF and all that is given.
        """
        grid = np.arange(magnitudes[0], magnitudes[1] + 1, dtype=float)
        r2_error = psf_error * 2 * (psf.fwhm * SIGMA_PER_FWHM) ** 2
        turns = np.zeros(exposures.n_exposures) if roll is None else np.asarray(roll, dtype=float)
        image = psf.draw(reach=HALF_WIDTH + REACH)
        key = content_key(
            image.array, image.scale, exposures, r2_error, statistic, turns, grid, _code_version()
        )
        known = load(key)
        if known is None:
            known = {"table": _table(psf, exposures, turns, grid, statistic, r2_error)}
            save(key, known)
        pixels = exposures.n_exposures * (2 * math.ceil(HALF_WIDTH / exposures.pixel) + 1) ** 2
        return cls(
            name=f"{exposures.name}, {exposures.n_exposures} exposures, {psf.name}",
            exposures=exposures,
            false_alarm=false_alarm,
            degrees=SHAPE_DEGREES if statistic == "shape" else pixels - SHAPE_DEGREES,
            magnitudes=grid,
            table=known["table"],
        )

    def misfits(self, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray) -> FloatArray:
        """Expected misfits of pairs by class of position angle and place in the pixel.

        Parameters
        ----------
        separation, flux_ratio, magnitude : (n,) float array
            In arcsec; companion over primary, in [0, 1]; of the whole system, in mag.  Any shapes that broadcast.

        Returns
        -------
        misfit : (GROUPS, n) float array
            Dimensionless; 0 for a single star.
        """
        r, f, m = np.broadcast_arrays(
            *(np.asarray(v, dtype=float) for v in (separation, flux_ratio, magnitude))
        )
        pair = (f > 0) & (r > 0)
        safe_r, safe_f = np.where(pair, r, WIDEST), np.where(pair, f, 1.0)
        step = _LOG_SEPARATION[1] - _LOG_SEPARATION[0]
        place = np.stack(
            [
                (np.log10(safe_r) - _LOG_SEPARATION[0]) / step,
                -2.5 * np.log10(safe_f) / (_CONTRAST[1] - _CONTRAST[0]),
                m - self.magnitudes[0],
            ]
        )
        last = np.array(self.table.shape[1:], dtype=float).reshape(-1, *[1] * r.ndim) - 1
        place = np.clip(place, 0.0, last).reshape(3, -1)
        left = [map_coordinates(one, place, order=3, mode="mirror", prefilter=False) for one in self.table]
        trend = np.where(pair, _trend(self.exposures, np.minimum(safe_r, WIDEST), safe_f, m), 0.0)
        return np.asarray(np.exp(left).reshape(-1, *r.shape) * trend)

    def rejected(self, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray) -> FloatArray:
        """Probability that a system is recognised as more than a star, and rejected.

        Parameters
        ----------
        separation, flux_ratio, magnitude : (n,) float array
            In arcsec; companion over primary, in [0, 1]; of the whole system, in mag.  Any shapes that broadcast.

        Returns
        -------
        rejected : (n,) float array
            In [0, 1], averaged over position angle and the place in the pixel; the false-alarm rate for a single
            star.
        """
        found = self.misfits(separation, flux_ratio, magnitude)
        return np.asarray(detection_probability(found, self.false_alarm, self.degrees).mean(axis=0))

    def layers(
        self, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray
    ) -> tuple[Layer, ...]:
        r"""The probability on a grid.

        Parameters
        ----------
        separation, flux_ratio, magnitude : (n_r,), (n_f,), (n_m,) float array
            In arcsec, dimensionless and mag.

        Returns
        -------
        layers : tuple of Layer
            One, as normal deviates: nearly linear in :math:`\sqrt{\Delta\chi^2}`, which goes with
            :math:`f/(1+f)^2` and the square of the separation.
        """
        found = probability_layer(self, separation, flux_ratio, magnitude).score
        return (Layer(score=ndtri(np.clip(found, 1e-300, 1 - 1e-16)), normal=True),)


def _trend(
    exposures: Exposures, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray
) -> FloatArray:
    """What most of the misfit follows; see `Detection`."""
    y = flux_ratio / (1 + flux_ratio) ** 2
    square = separation**2 / (1 + (separation / _CORE) ** 2)
    flux = exposures.electrons(magnitude)
    return np.asarray((y * square * flux) ** 2 / (exposures.background + _PEAK * flux))


def _table(
    psf: PSF,
    exposures: Exposures,
    roll: FloatArray,
    magnitudes: FloatArray,
    statistic: Statistic,
    r2_error: float,
) -> FloatArray:
    """Coefficients of the splines of `Detection`."""
    separation, contrast = np.meshgrid(10**_LOG_SEPARATION, _CONTRAST, indexing="ij")
    r, f = (np.tile(v.ravel(), ANGLES) for v in (separation, 10 ** (-0.4 * contrast)))
    angle = np.repeat(2 * math.pi * np.arange(ANGLES) / ANGLES, contrast.size)
    found, star = [], pointings(psf, exposures.pixel, dither_pattern(exposures.n_exposures), roll)
    for phase in range(PHASES):
        star = replace(star, place=dither_pattern(exposures.n_exposures, phase))
        turned = angle + 2 * math.pi * phase / PHASES / ANGLES
        found.append(misfit(star, exposures, r, f, turned, magnitudes, statistic, r2_error))
    sorted_ = np.sort(np.reshape(found, (PHASES * ANGLES, -1)), axis=0)
    classes = sorted_.reshape(GROUPS, -1, *separation.shape, magnitudes.size).mean(axis=1)
    trend = _trend(exposures, separation[..., None], 10 ** (-0.4 * contrast[..., None]), magnitudes)
    table = np.log(np.maximum(classes / trend, 1e-300))
    for axis in (1, 2, 3):
        table = spline_filter1d(table, order=3, axis=axis, mode="mirror")
    return np.asarray(table)


@cache
def _code_version() -> str:
    """Hash of the modules that a table is made with."""
    modules = sys.modules[Pointings.__module__], sys.modules[__name__]
    return content_key(__version__, *(Path(str(m.__file__)).read_bytes() for m in modules))
