r"""The companion's colour: its PSF is wider than the primary's, however close it is.

A diffraction pattern grows with wavelength and companions are redder.  Next to what a pair's separation does,
:math:`\eta`, the light f/(1+f) of the companion brings a change of size of its own, first order in the difference
of the two stars' PSFs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline

from porrima.errors import InputError
from porrima.integrals import coefficient_moments, integrate, starts_of_mass_ratios
from porrima.passbands import black_body, passband, photon_averages
from porrima.photometry import MainSequence, flux_ratio, magnitudes
from porrima.psf import PSFS, psf_from_name
from porrima.psf_files import is_fits_name, is_piff_name
from porrima.reach import settled, stamp_reach
from porrima.roman import RomanName
from porrima.spectra import Light

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray

    from porrima.companions import CompanionLaw
    from porrima.integrals import PairIntegrals
    from porrima.passbands import Passband, Spectrum
    from porrima.photometry import MassLuminosity, Tracks
    from porrima.psf import PSF
    from porrima.shapes import Estimator, Shape
    from porrima.stars import Stars
    from porrima.systems import Population

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = ["Chromatic", "ColourBias", "chromatic", "colour_bias", "in_band", "integrals_in_band"]

N_NODES = 7
"""Wavelengths at which a PSF is drawn, evenly through the band (count)."""

REFERENCE = 4500.0
"""Temperature of the black body in whose light the PSF is that others are held against, in K: about that of the mean
star from 16 to 23 mag."""

STEP = 0.02
"""Share of the light that is moved to one wavelength, and back, to find what it does (dimensionless)."""

N_MASS_RATIOS = 65
"""Nodes of Simpson's rule over the logarithm of the mass ratio (count)."""

N_MASSES = 151
"""Masses on which colours are turned into sizes (count)."""

OBSERVED = {"euclid_VIS": ("r", "z"), "r": ("r", "z"), "i": ("r", "z"), "z": ("r", "z")}
"""Colour by which a survey knows a star, for each band; F106 - F158 for those of Roman."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Chromatic:
    r"""What each wavelength does to the shape of a PSF, to first order in its share of the light.

    Parameters
    ----------
    psf, estimator : str
        Their names.
    band : Passband
        What the light comes through.
    shape0 : Shape
        In the light of the reference; r2 in arcsec².
    influence : (3, n_wavelength) float array
        Change of e1, e2 and R² over that of the reference, per share of the photons that is taken from all and given
        to one wavelength of the band (dimensionless).
    slope : (3,) float array
        Change of e1, e2 and ln R² per change of ln wavelength of all the light (dimensionless).
    """

    psf: str
    estimator: str
    band: Passband
    shape0: Shape
    influence: FloatArray
    slope: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ColourBias:
    r"""Mean change of the stacked PSF by the colour of companions, for k binary fractions.

    Parameters
    ----------
    blind : (3, k) float array
        Of e1, e2 and R² over R0², where the PSF of a star is taken to be that of the primary: a PSF model
        that does not look at colours (dimensionless).
    known : (3, k) float array
        The same where it is taken to be that of a single star with the colour of the pair (dimensionless).
    """

    blind: FloatArray
    known: FloatArray


def chromatic(
    name: str, estimator: Estimator, band: str, reference: float = REFERENCE, **options: Any
) -> Chromatic:
    r"""Influence of each wavelength on the shape of a PSF, measured on drawn images.

    Parameters
    ----------
    name : str
        An optical or Roman PSF, or a file with a chromatic GalSim stanza.
    estimator : Estimator
        What is measured.
    band : str
        One of `passbands.PASSBANDS`; for a Roman PSF its own.
    reference : float
        Temperature of the black body that stands for the stars of a stack, in K.
    options : dict
        Of `psf.psf_from_name`: pixel and jitter, in arcsec, which do not grow with wavelength.

    Returns
    -------
    chromatic : Chromatic
        Kept, so that the same question is answered at once.

    Raises
    ------
    InputError
        If the PSF has no wavelength, or another band.

    Notes
    -----
    The PSF is drawn at `N_NODES` wavelengths :math:`\lambda_k`.  With p the photons of the reference and cubic
    splines :math:`\ell_k(\lambda)` through the nodes, its image is
    :math:`I = \sum_k I_k \int p\, \ell_k d\lambda`; what moving a share :math:`\pm\epsilon` of the light to one node
    does to the measured shape is its influence there, :math:`[s((1-\epsilon) I + \epsilon I_k) - s((1+\epsilon) I -
    \epsilon I_k)]/2\epsilon`, and the spline through them that of every wavelength.  A star of other photons p' has
    the shape :math:`s_0 + \int (p' - p)\, g\, d\lambda`, exact to first order in their difference for any estimator;
    in a stack the reference is what all stars together look like.  1000 K away from it the error is 7 % behind optics
    alone and 2 % with pixel and jitter.
    For plain moments g is the R² of the wavelength alone.  A telescope at the limit of diffraction has a slope of 2.
    """
    return _chromatic(name, estimator, band, reference, tuple(sorted(options.items())))


@lru_cache(maxsize=16)
def _chromatic(
    name: str,
    estimator: Estimator,
    band: str,
    reference: float,
    options: tuple[tuple[str, float | None], ...],
) -> Chromatic:
    """What `chromatic` keeps."""
    found = passband(band)
    if name.startswith(("roman:", "roman-exact:")) and passband_of(RomanName(name).band) != band:
        raise InputError(f"must be {passband_of(RomanName(name).band)} for {name}", key="colour", value=band)
    wavelength = np.array(found.wavelength)
    nodes = np.linspace(wavelength[0], wavelength[-1], N_NODES)
    images, scale, psf = _images(name, tuple(nodes.tolist()), estimator, options)
    cardinal = CubicSpline(nodes, np.eye(N_NODES))
    photons = black_body(wavelength, reference) * np.array(found.throughput)
    photons /= photons.sum()
    mean = np.tensordot(photons @ cardinal(wavelength), images, axes=1)
    measure = _measured(settled(estimator, psf), scale)
    shape0 = measure(mean)
    at_nodes = np.empty((3, N_NODES))
    for k, image in enumerate(images):
        up, down = (measure(mean + sign * STEP * (image - mean)) for sign in (1, -1))
        change = [float(getattr(up, q) - getattr(down, q)) / (2 * STEP) for q in ("e1", "e2", "r2")]
        at_nodes[:, k] = *change[:2], change[2] / float(shape0.r2)
    influence = CubicSpline(nodes, at_nodes, axis=1)
    return Chromatic(
        psf=psf.name,
        estimator=estimator.name,
        band=found,
        shape0=shape0,
        influence=influence(wavelength),
        slope=(influence(wavelength, 1) * wavelength) @ photons,
    )


def passband_of(roman: str) -> str:
    """Band of the photometry that one of ``galsim.roman`` is.

    Parameters
    ----------
    roman : str
        Such as H158.

    Returns
    -------
    band : str
        Such as roman_F158.
    """
    return f"roman_F{roman[1:]}"


@lru_cache(maxsize=4)
def _images(
    name: str,
    nodes: tuple[float, ...],
    estimator: Estimator,
    options: tuple[tuple[str, float | None], ...],
) -> tuple[FloatArray, float, PSF]:
    """PSF at each wavelength (k, ny, nx), of unit flux, on one grid; side of its pixels; the PSF in the middle."""
    if name in PSFS or is_fits_name(name) or is_piff_name(name):
        raise InputError("needs an optical, Roman or chromatic PSF", key="colour", value=name)
    blur: dict[str, Any] = dict(options)
    psfs = [psf_from_name(name, light=Light.of(w), **blur) for w in nodes]
    scale, middle = min(psf.scale for psf in psfs), psfs[len(psfs) // 2]
    reach = max(6.0 * max(psf.fwhm for psf in psfs), stamp_reach(settled(estimator, middle), middle))
    return np.stack([replace(p, grid=scale, extent=reach).draw().array for p in psfs]), scale, middle


def _measured(estimator: Estimator, scale: float) -> Any:
    """Function from pixels to a shape."""
    import galsim  # noqa: PLC0415  (its image, where used)

    def shape(pixels: FloatArray) -> Shape:
        found = estimator.measure(galsim.ImageD(np.ascontiguousarray(pixels), scale=scale))
        if int(found.flag):
            raise InputError(
                "cannot be measured at the wavelengths of the band", key="psf", value=int(found.flag)
            )
        return found

    return shape


def in_band(population: Population, photometry: MassLuminosity, band: str) -> Population:
    """The same stars and companions with the flux ratios of another band.

    Parameters
    ----------
    population : Population
        Stars selected by their magnitude in any band, in mag.
    photometry : MassLuminosity
        Mass to light.
    band : str
        In which the PSF is formed.

    Returns
    -------
    population : Population
        Selection, magnitudes and weights as before.

    Raises
    ------
    InputError
        If the photometry has no such band.
    """
    stars = population.stars
    try:
        tracks = photometry.tracks(stars.mass, stars.metallicity, stars.log_age, band)
    except ValueError as error:
        raise InputError(str(error), key="band") from None
    return replace(population, tracks=tracks)


def integrals_in_band(population: Population, integrals: PairIntegrals) -> PairIntegrals:
    """Expectations over companions with other flux ratios, of the same orbits; a selection sees these flux ratios.

    Parameters
    ----------
    population : Population
        From `in_band`.
    integrals : PairIntegrals
        Of the population it was made from, dimensionless.

    Returns
    -------
    integrals : PairIntegrals
        Separations as before.
    """
    if integrals.joint is not None:
        return integrate(population)
    return replace(integrals, coefficient=coefficient_moments(population))


def colour_bias(
    population: Population,
    chromatic: Chromatic,
    integrals: PairIntegrals,
    binary_fraction: FloatArray | None = None,
    spectrum: Spectrum = "broad-band",
    observed: tuple[str, str] | None = None,
) -> ColourBias:
    r"""Mean change of shape that the colour of unresolved companions brings to a stack.

    Parameters
    ----------
    population : Population
        Of n rows, stars or classes of their companions, with the flux ratios of the band (`in_band`).
    chromatic : Chromatic
        Of PSF and estimator.
    integrals : PairIntegrals
        Of the same rows (`integrals_in_band`): the chance that a pair stays in the sample.
    binary_fraction : (k,) float array, optional
        Before resolved pairs leave, in [0, 1]; None for the model's own.
    spectrum : {"broad-band", "black-body"}
        Of the stars.
    observed : (str, str), optional
        Bands of the colour by which the survey knows a star, bluer first; those of `OBSERVED` where not given.

    Returns
    -------
    bias : ColourBias
        For k binary fractions, dimensionless.

    Raises
    ------
    InputError
        If there are triples.

    Notes
    -----
    With s the shape of a single star behind the PSF, from its own photons, a pair of primary A and companion B has,
    for r → 0, :math:`s_A + \frac{f}{1+f}(s_B - s_A)`.  ``blind`` is the mean of the second term, ``known`` that of the
    difference from a single star on the same track that has the colour of the pair: what is left when the PSF model
    interpolates in observed colour.  The mean is over mass ratios by Simpson's rule and over stars with
    :math:`p_i P_{unres,i}` of :math:`\sum_i (1 - p_i P_{res,i})`, as that of x; classes count by their abundance, and a
    selection by what it keeps of pairs and of single stars.  First order in the difference of the
    two spectra; the term with both colour and separation, of order :math:`\eta` times 0.1, is left out.
    """
    if np.any(population.law.is_triple):
        raise InputError("must be off for the colour of companions", key="multiplicity.triples", value=True)
    law, w, number = population.law, population.weight, population.abundance
    first = starts_of_mass_ratios(law)
    run = np.repeat(np.arange(first.size), np.diff(first, append=law.star.size))
    pairs = _Pairs.of(population, first)
    blind, known = _changes(pairs, chromatic, spectrum, observed or _observed(chromatic.band.name))
    p = np.minimum(1.0, population.scale(binary_fraction)[:, None] * law.multiplicity_fraction)
    alone = 1.0 if integrals.single_kept is None else integrals.single_kept
    kept = (number * w * (alone - p * integrals.lost)).sum(axis=1)
    means = [_kept_means(pairs, change, integrals, run) for change in (blind, known)]
    of_blind, of_known = (mean @ (number * w * p).T / kept for mean in means)
    return ColourBias(blind=of_blind, known=of_known)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pairs:
    """Pairs of each run of classes of one star that share their mass ratios, (n,) and (n, k)."""

    stars: Stars
    mass: FloatArray  # of the primary, in M_sun, within the photometry
    ratio: FloatArray
    weight: FloatArray  # of the rule over mass ratios
    flux_ratio: FloatArray

    @classmethod
    def of(cls, population: Population, first: IntArray) -> _Pairs:
        """Those of the runs that start at some rows."""
        stars, tracks = population.stars.take(first), population.tracks
        own = replace(tracks, index=tracks.index[first], weight=tracks.weight[first])
        ratio, weight = _mass_ratios(population.law.take(first), stars.mass, tracks.dark_below)
        return cls(
            stars=stars,
            mass=np.clip(stars.mass, *MainSequence().mass_range),
            ratio=ratio,
            weight=weight,
            flux_ratio=flux_ratio(own, stars.mass, ratio),
        )


def _changes(
    pairs: _Pairs, chromatic: Chromatic, spectrum: Spectrum, observed: tuple[str, str]
) -> tuple[FloatArray, FloatArray]:
    """Change of shape (3, n, k) against the primary, and against a single star of the colour of the pair."""
    mass, ratio, stars = pairs.mass, pairs.ratio, pairs.stars
    place = MainSequence().tracks(mass, stars.metallicity, stars.log_age, "i")
    shapes = [
        replace(place, magnitude=np.ascontiguousarray(grid))
        for grid in photon_averages(chromatic.band, chromatic.influence, spectrum)
    ]
    masses = np.concatenate([mass[:, None], mass[:, None] * ratio], axis=1)
    share = pairs.flux_ratio / (1 + pairs.flux_ratio)
    own = np.stack([_of_masses(one, masses) for one in shapes])
    blind = share * (own[..., 1:] - own[..., :1])
    single = np.stack(_single_of_colour(place, mass, ratio, shapes, observed, stars))
    known = own[..., :1] + blind - single
    return np.where(share > 0, blind, 0.0), np.where(share > 0, known, 0.0)


def _kept_means(pairs: _Pairs, change: FloatArray, integrals: PairIntegrals, run: IntArray) -> FloatArray:
    """Expectation (3, m) of a change (3, n, k) over the companions of each class that stay, n being runs of classes.

    A selection knows powers of 4 y.  The change is fitted by those from 1 to 8, which vanish for dark companions as it
    does; what the fit leaves is taken to be kept as pairs are in the mean.
    """
    if integrals.joint is None:
        of_run: FloatArray = (change * pairs.weight).sum(axis=2)
        return of_run[:, run] * integrals.kept
    four_y = 4 * pairs.flux_ratio / (1 + pairs.flux_ratio) ** 2
    powers = four_y[..., None] ** np.arange(1, integrals.joint.shape[2])
    root = np.sqrt(np.maximum(pairs.weight, 0.0))
    inverse = np.linalg.pinv(root[..., None] * powers, rcond=1e-10)  # (n, power, k)
    fitted = np.einsum("njk,qnk->qnj", inverse, root * change)
    left = ((change - np.einsum("nkj,qnj->qnk", powers, fitted)) * pairs.weight).sum(axis=2)
    means: FloatArray = np.einsum("qmj,mj->qm", fitted[:, run], integrals.joint[0, :, 1:, 0])
    means += left[:, run] * integrals.kept
    return means


def _observed(band: str) -> tuple[str, str]:
    return OBSERVED.get(band, ("roman_F106", "roman_F158"))


def _of_masses(tracks: Tracks, mass: FloatArray) -> FloatArray:
    """Value on each star's track at masses (n, k); 0 for dark ones, which never count."""
    values = magnitudes(tracks, mass)
    return np.where(np.isfinite(values), values, 0.0)


def _mass_ratios(law: CompanionLaw, mass: FloatArray, dark_below: float) -> tuple[FloatArray, FloatArray]:
    """Mass ratios (n, k) that shine and their weights, by Simpson's rule in ln q; those given are their own rule."""
    low, high = law.mass_ratio_min, law.mass_ratio_max
    first = np.minimum(np.maximum(dark_below / mass, low), high)
    simpson = np.ones(N_MASS_RATIOS)
    simpson[1:-1:2], simpson[2:-1:2] = 4.0, 2.0
    span = np.log(high / first)[:, None]
    log_q = np.log(high)[:, None] - span * np.linspace(1.0, 0.0, N_MASS_RATIOS)
    g = law.mass_ratio_exponent + 1.0
    steep = np.abs(g) > 1e-9
    norm = np.where(steep, (high**g - low**g) / np.where(steep, g, 1.0), np.log(high / low))
    weight = np.exp(g[:, None] * log_q) / norm[:, None] * span / (N_MASS_RATIOS - 1) / 3.0 * simpson
    given = ~np.isnan(law.mass_ratio)
    ratio = np.where(given[:, None], law.mass_ratio[:, None], np.exp(log_q))
    ratio[:, 0] = np.where(given, ratio[:, 0], first * (1 + 1e-12))  # not dark by rounding
    weight = np.where(given[:, None], np.eye(1, N_MASS_RATIOS), weight)
    return np.minimum(ratio, 1.0), weight


def _single_of_colour(
    place: Tracks,
    mass: FloatArray,
    ratio: FloatArray,
    shapes: list[Tracks],
    observed: tuple[str, str],
    stars: Stars,
) -> list[FloatArray]:
    """Shapes (n, k) of single stars on each star's track that have the colour of each pair."""
    bands = [
        replace(
            place, magnitude=MainSequence().tracks(mass, stars.metallicity, stars.log_age, name).magnitude
        )
        for name in observed
    ]
    grid = np.geomspace(*MainSequence().mass_range, N_MASSES)
    grid[0] *= 1 + 1e-12
    every = np.broadcast_to(grid, (mass.size, N_MASSES))
    blue, red = (magnitudes(one, every) for one in bands)
    redder = np.maximum.accumulate((blue - red)[:, ::-1], axis=1)  # towards small masses
    curves = [_of_masses(one, every)[:, ::-1] for one in shapes]
    primary = [magnitudes(one, mass[:, None]) for one in bands]
    bright = [1 + flux_ratio(one, mass, ratio) for one in bands]
    colour = primary[0] - primary[1] - 2.5 * np.log10(bright[0] / bright[1])
    out = [np.empty(ratio.shape) for _ in shapes]
    for s in range(mass.size):
        for values, curve in zip(out, curves, strict=True):
            values[s] = np.interp(colour[s], redder[s], curve[s])
    return out
