"""PSFs of one name each: the single door through which any GalSim profile enters."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import galsim

from porrima.errors import InputError
from porrima.optics import ARCSEC, EUCLID_LIKE, WAVELENGTH, optical_image
from porrima.psf_files import fits_profile, is_fits_name, is_piff_name, piff_profile, stanza_profile
from porrima.roman import RomanName, roman_profile
from porrima.sampling import HALF_WIDTH, Blur, fwhm_of, interpolated, sampled
from porrima.spectra import Light

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = [
    "EXTENT_PER_FWHM",
    "GRID_SCALE",
    "GSPARAMS",
    "OPTICAL",
    "PSF",
    "PSFS",
    "psf_from_name",
    "sheared_gaussian",
]

GRID_SCALE = 0.1 / 12
"""Coarsest grid on which a PSF is drawn, in arcsec: a VIS pixel sampled 12 times finer (KCM16)."""

GRID_PER_FWHM = 16
"""Fewest pixels across the full width at half maximum, so that sums over pixels are integrals (count)."""

EXTENT_PER_FWHM = 6.0
"""Half width of a stamp over the FWHM, where no extent is given: 14 sigma of a Gaussian (dimensionless)."""

GSPARAMS = galsim.GSParams(
    folding_threshold=1e-8, maxk_threshold=1e-8, xvalue_accuracy=1e-12, kvalue_accuracy=1e-12
)
"""GalSim's accuracy for the analytic presets."""

TABLE_2 = {"0": (0.0, 0.0), "1": (0.054, -0.003), "2": (-0.021, 0.045)}
"""Distortions e1, e2 of the three PSFs of KCM16, dimensionless."""

TABLE_2_FWHM = 0.137
"""FWHM of the three Gaussian PSFs of KCM16, in arcsec."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PSF:
    """Point spread function: a name and an immutable GalSim profile, exact as given, no pixel added.

    Parameters
    ----------
    name : str
        As the option ``--psf`` takes it.
    profile : galsim.GSObject
        Surface brightness, x with the columns and y with the rows upwards, in arcsec.
    extent : float, optional
        Half width of the stamp on which it is drawn, in arcsec; `EXTENT_PER_FWHM` times the FWHM where
        not given, which leaves out less than 1e-20 of a Gaussian, and nothing that an adaptive weight sees.
    grid: float, optional
        Side of a pixel of the grid on which it is drawn, in arcsec; where not given, `GRID_SCALE` or a
        sixteenth of the FWHM, whichever is finer.
    """

    name: str
    profile: Any
    extent: float | None = None
    grid: float | None = None

    @property
    def fwhm(self) -> float:
        """Full width at half maximum, good to 1e-3, in arcsec."""
        return fwhm_of(self.profile)

    @property
    def scale(self) -> float:
        """Side of a pixel of the grid on which the PSF is drawn, in arcsec."""
        return min(GRID_SCALE, self.fwhm / GRID_PER_FWHM) if self.grid is None else self.grid

    def draw(self, profile: Any = None, margin: float = 0.0, reach: float = 0.0) -> Any:
        """Image of the PSF, or of another profile on the grid of the PSF.

        Parameters
        ----------
        profile : galsim.GSObject, optional
            What to draw; the PSF itself where not given.
        margin : float
            Added to the half width of the stamp, in arcsec.
        reach : float
            Least half width of the stamp: how far the weight of an estimator reaches, in arcsec.

        Returns
        -------
        image : galsim.ImageD
            Odd number of pixels a side, the origin of the profile at ``true_center``, ``scale`` in arcsec.

        Notes
        -----
        Sampled at the centres of pixels (``no_pixel``) in float64; for the Gaussian presets to 1e-12.
        """
        scale = self.scale
        extent = EXTENT_PER_FWHM * self.fwhm if self.extent is None else self.extent
        size = 2 * round((max(extent, reach) + margin) / scale) + 1
        drawn = self.profile if profile is None else profile
        return drawn.drawImage(nx=size, ny=size, scale=scale, method="no_pixel", dtype=float)


def sheared_gaussian(name: str, e1: float, e2: float, fwhm: float = TABLE_2_FWHM) -> PSF:
    r"""Gaussian PSF sheared at constant area.

    Parameters
    ----------
    name : str
        Its name.
    e1, e2 : float
        Distortion, dimensionless.
    fwhm : float
        FWHM before the shear, in arcsec.

    Returns
    -------
    psf : PSF
        With :math:`R_0^2 = 2 \sigma^2 / \sqrt{1 - e_1^2 - e_2^2}`.

    Notes
    -----
    GalSim's ``Shear(e1=, e2=)`` is the distortion :math:`(Q_{11} - Q_{22}) / (Q_{11} + Q_{22})`, its
    ``Shear(g1=, g2=)`` the reduced shear.

    References
    ----------
    KCM16, Table 2
    """
    round_psf = galsim.Gaussian(fwhm=fwhm, gsparams=GSPARAMS)
    return PSF(name=name, profile=round_psf.shear(galsim.Shear(e1=e1, e2=e2)))


PSFS: dict[str, Callable[[], PSF]] = {  # KCM16, Table 2
    "psf0": lambda: sheared_gaussian("psf0", *TABLE_2["0"]),
    "psf1": lambda: sheared_gaussian("psf1", *TABLE_2["1"]),
    "psf2": lambda: sheared_gaussian("psf2", *TABLE_2["2"]),
}
"""Every Gaussian PSF that has a name, and how it is made."""

OPTICAL: dict[str, tuple[str, float]] = {  # shape of Table 2, angle of the first struts [deg]
    "optical0": ("0", 0.0),
    "optical1": ("1", 0.0),
    "optical2": ("2", 0.0),
    "optical1-rotated": ("1", 30.0),
}
"""Every diffraction-limited PSF that has a name: `optics.EUCLID_LIKE` at 800 nm, six struts, no aberrations, with
the three shapes; rotated, the struts of the second lie midway between those of the first.  FWHM 0.133 arcsec;
adaptive R² 5.5316e-3, 5.5397e-3 and 5.5384e-3 arcsec²."""


def _of_samples(name: str, image: Any) -> PSF:
    """PSF through samples on its own grid, its extent found once."""
    profile = interpolated(image.array, image.scale)
    return PSF(name=name, profile=profile, extent=EXTENT_PER_FWHM * fwhm_of(profile), grid=image.scale)


@lru_cache(maxsize=8)
def _optical(name: str, light: Light) -> PSF:
    """PSF of a name in `OPTICAL`."""
    shape, angle = OPTICAL[name]
    pupil = replace(EUCLID_LIKE, strut_angle=angle)
    scale = min(GRID_SCALE, min(light.wavelength) * 1e-9 / pupil.diameter / ARCSEC / GRID_PER_FWHM)
    image = optical_image(pupil, light, *TABLE_2[shape], scale)
    return _of_samples(name, image)


@lru_cache(maxsize=2)
def _roman(name: str, light: Light | None) -> Any:
    """Profile of a Roman name."""
    return roman_profile(RomanName(name), light)


def psf_from_name(
    name: str,
    *,
    pixel: float | None = None,
    pixel_scale: float | None = None,
    jitter: float | None = None,
    diffusion: float | None = None,
    light: Light | None = None,
    subtract_background: bool = False,
) -> PSF:
    """PSF of a given name, taken exactly as it is unless something is asked to be added.

    Parameters
    ----------
    name : str
        A key of `PSFS` or `OPTICAL`; ``roman:BAND:SCAnn`` or ``roman:BAND:SCAnn:x,y`` (also ``roman-exact``);
        ``FILE.fits[EXT]`` or ``FILE.fits[EXT,INDEX]``; ``FILE.piff[X,Y]``; a YAML file with a GalSim stanza ``psf``.
    pixel : float, optional
        Side of a square pixel with which it is convolved, in arcsec.
    pixel_scale : float, optional
        Side of a pixel of a FITS image, in arcsec; from its header where not given.
    jitter, diffusion : float, optional
        Sigma of a round Gaussian with which it is convolved, for the pointing and for the charges in the
        detector, in arcsec.
    light : Light, optional
        Of optical, Roman and chromatic PSFs; 800 nm, or the effective wavelength of the Roman band, where not given.
    subtract_background : bool
        Whether a constant is taken off a FITS image.

    Returns
    -------
    psf : PSF
        Equal names and options give equal PSFs.

    Raises
    ------
    InputError
        If no PSF has that name, its file is of no use, or an option does not fit.

    Warns
    -----
    PSFWarning
        If a FITS image is off centre, has a background or wings that its stamp cuts.
    """
    _check_options(
        name, {"pixel": pixel, "pixel_scale": pixel_scale, "jitter": jitter, "diffusion": diffusion}
    )
    if pixel_scale is not None and not is_fits_name(name):
        raise InputError("is for FITS images only", key="pixel_scale", value=f"{pixel_scale} for {name}")
    if subtract_background and not is_fits_name(name):
        raise InputError("is for FITS images only", key="subtract_background", value=name)
    psf = _named(name, pixel_scale, subtract_background, light)
    blur = Blur(pixel=pixel or 0.0, sigma=math.hypot(jitter or 0.0, diffusion or 0.0))
    added = [f"{k} {v:g}" for k, v in {"pixel": pixel, "jitter": jitter, "diffusion": diffusion}.items() if v]
    if not added and (name in PSFS or name in OPTICAL):
        return psf
    return _on_grid(psf, blur, ", ".join([psf.name, *added]))


def _check_options(name: str, lengths: dict[str, float | None]) -> None:
    """Refuse lengths that are not positive."""
    for key, value in lengths.items():
        if value is not None and not 0 < value < math.inf:
            raise InputError("must be positive and finite [arcsec]", key=key, value=value)
    if not name:
        raise InputError("must not be empty", key="psf")


def _named(name: str, pixel_scale: float | None, subtract_background: bool, light: Light | None) -> PSF:
    """PSF of a name, nothing added."""
    if name in OPTICAL:
        return _optical(name, light or Light.of(WAVELENGTH))
    if name.startswith(("roman:", "roman-exact:")):
        return PSF(name=name, profile=_roman(name, light))
    if name.lower().endswith((".yaml", ".yml")):
        return PSF(name=name, profile=_achromatic(stanza_profile(name), name, light))
    if light is not None:
        raise InputError(
            "is for optical, Roman and chromatic PSFs only", key="light", value=f"light for {name}"
        )
    if is_fits_name(name):
        return PSF(name=name, profile=fits_profile(name, pixel_scale, subtract_background))
    if is_piff_name(name):
        return PSF(name=name, profile=piff_profile(name))
    if name in PSFS:
        return PSFS[name]()
    known = [*PSFS, *OPTICAL]
    near = get_close_matches(name, known, n=1, cutoff=0.0)[0]
    rule = f"must be one of {', '.join(known)}, roman:BAND:SCAnn, FILE.fits[EXT], FILE.piff[X,Y], FILE.yaml"
    raise InputError(f"{rule} (nearest: {near})", key="psf", value=name)


def _achromatic(profile: Any, name: str, light: Light | None) -> Any:
    """Profile in a given light."""
    if isinstance(profile, galsim.ChromaticObject):
        if light is None:
            raise InputError("is chromatic: light must be given", source=name, key="psf")
        lines = zip(light.wavelength, light.share, strict=True)
        return galsim.Sum([profile.evaluateAtWavelength(w).withFlux(share) for w, share in lines])
    if light is not None:
        raise InputError(
            "is for optical, Roman and chromatic PSFs only", key="light", value=f"light for {name}"
        )
    return profile


@lru_cache(maxsize=8)
def _on_grid(psf: PSF, blur: Blur, name: str) -> PSF:
    """PSF drawn once on its grid, blurred there: from then on every place of a star in its pixel is alike."""
    try:
        image = sampled(psf.profile, psf.scale, max(HALF_WIDTH, EXTENT_PER_FWHM * psf.fwhm), blur)
    except galsim.GalSimFFTSizeError as error:
        raise InputError(f"is too narrow for how wide it is: {error}", key="psf", value=name) from None
    return _of_samples(name, image)
