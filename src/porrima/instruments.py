"""Instruments and what is required of their PSF, each figure with its source."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["EUCLID_VIS", "KCM16", "Instrument", "Requirement"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Instrument:
    """A survey camera.

    Parameters
    ----------
    name : str
        As its consortium writes it.
    diameter : float
        Of the primary mirror, in m.
    pixel : float
        Side of a detector pixel, in arcsec.
    fwhm : float
        Full width at half maximum of the PSF, in arcsec.
    source : str
        Where the figures come from.
    """

    name: str
    diameter: float
    pixel: float
    fwhm: float
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Requirement:
    """Largest errors of the PSF's shape that a survey allows.

    Parameters
    ----------
    name : str
        Of the set.
    sigma_e : float
        Of one component of the ellipticity (distortion), dimensionless.
    sigma_r2 : float
        Of the size, over the size, dimensionless.
    source : str
        Where the figures come from.
    """

    name: str
    sigma_e: float
    sigma_r2: float
    source: str


EUCLID_VIS = Instrument(
    name="Euclid VIS",
    diameter=1.2,
    pixel=0.1,
    fwhm=0.16,
    source="Euclid Quick Release Q1: FWHM as measured; Cropper et al. 2016 for the rest",
)

KCM16 = Requirement(
    name="KCM16",
    sigma_e=2e-4,
    sigma_r2=1e-3,
    source="KCM16 Sect. 5.4, after Paulin-Henriksson et al. 2008 and Cropper et al. 2013",
)
