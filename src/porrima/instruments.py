"""Instruments and what is required of their PSF, each figure with its source."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = [
    "EUCLID_VIS", "KCM16", "REQUIREMENTS", "ROMAN_WFI", "RUBIN", "SURVEYS", "Instrument", "Requirement", "Survey",
]  # fmt: skip


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
    """Largest errors of the PSF's shape, and of shear, that a survey allows; None where it states none.

    Parameters
    ----------
    name : str
        Of the set.
    sigma_e : float, optional
        Of one component of the ellipticity (distortion), dimensionless.
    sigma_r2 : float, optional
        Of the size, over the size, dimensionless.
    m : float, optional
        Of the multiplicative bias of shear, dimensionless.
    c : float, optional
        Of one component of the additive bias of shear (not distortion), dimensionless.
    source : str
        Where the figures come from, with the date; ``[?]`` marks one that rests on a single weak source.
    """

    name: str
    sigma_e: float | None = None
    sigma_r2: float | None = None
    m: float | None = None
    c: float | None = None
    source: str

    def of(self, quantity: str) -> float | None:
        """Largest error of one quantity.

        Parameters
        ----------
        quantity : str
            e1, e2, r2, m, c1 or c2.

        Returns
        -------
        largest : float or None
            Dimensionless; r2 over the size of the PSF.
        """
        return {
            "e1": self.sigma_e, "e2": self.sigma_e, "r2": self.sigma_r2, "m": self.m, "c1": self.c, "c2": self.c,
        }[quantity]  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Survey:
    """What a budget takes when nothing else is given.

    Parameters
    ----------
    instrument : Instrument
        The camera.
    requirement : Requirement
        On its PSF and shear.
    psf : str
        Name of a PSF that stands for that of the survey.
    pixel, jitter : float, optional
        Side of a pixel, and sigma of a Gaussian, with which the PSF is convolved, in arcsec.
    cut : float
        Separation from which pairs are resolved, in arcsec.
    """

    instrument: Instrument
    requirement: Requirement
    psf: str
    pixel: float | None = None
    jitter: float | None = None
    cut: float = 0.05


EUCLID_VIS = Instrument(
    name="Euclid VIS",
    diameter=1.2,
    pixel=0.1,
    fwhm=0.16,
    source="Euclid Quick Release Q1: FWHM as measured; Cropper et al. 2016 for the rest",
)

ROMAN_WFI = Instrument(
    name="Roman WFI",
    diameter=2.36,
    pixel=0.11,
    fwhm=0.155,
    source="galsim.roman (GalSim 2.8): diameter, pixel, and the FWHM of H158 with its pixel",
)

RUBIN = Instrument(
    name="Rubin LSSTCam",
    diameter=8.36,
    pixel=0.2,
    fwhm=0.7,
    source="Ivezic et al. 2019: pixel and median seeing",
)

KCM16 = Requirement(
    name="KCM16",
    sigma_e=2e-4,
    sigma_r2=1e-3,
    source="KCM16 Sect. 5.4, after Paulin-Henriksson et al. 2008 and Cropper et al. 2013",
)

EUCLID = Requirement(
    name="Euclid VIS",
    sigma_e=5e-5,
    sigma_r2=5e-4,
    m=2e-3,
    c=5e-4,
    source="Euclid, draft values without a date [?]: transfer of the PSF from stars to galaxies, error of m, "
    "knowledge of c",
)

ROMAN = Requirement(
    name="Roman WFI",
    sigma_e=5.7e-4,
    sigma_r2=7.2e-4,
    m=3.2e-4,
    source="m: Berlfein et al. 2025, where 1e-3 is the relaxed requirement; PSF: one secondary source without a "
    "date [?]",
)

LSST = Requirement(
    name="Rubin",
    m=1e-3,
    c=1e-4,
    source="Rubin's requirement on shape measurement of isolated galaxies as changed in 2018: Bosch, "
    "community.lsst.org/t/3417",
)

MASSEY13 = Requirement(
    name="Massey et al. 2013",
    m=2e-3,
    source="Massey et al. 2013: M < 4e-3 on the power of shear, which is 2 m; A < 1.8e-12 is the power of c over the "
    "sky, no limit on one patch [?]",
)

REQUIREMENTS = {
    "euclid-vis": EUCLID,
    "roman-h158": ROMAN,
    "rubin": LSST,
    "kcm16": KCM16,
    "massey13": MASSEY13,
}
"""Every set of requirements that has a name."""

SURVEYS = {
    "euclid-vis": Survey(instrument=EUCLID_VIS, requirement=EUCLID, psf="optical1", pixel=0.1, jitter=0.029),
    "roman-h158": Survey(instrument=ROMAN_WFI, requirement=ROMAN, psf="roman:H158:SCA01", pixel=0.11),
    "rubin": Survey(instrument=RUBIN, requirement=LSST, psf="rubin", cut=0.26),
    "kcm16": Survey(instrument=EUCLID_VIS, requirement=KCM16, psf="psf1"),
    "massey13": Survey(instrument=EUCLID_VIS, requirement=MASSEY13, psf="psf1"),
}
"""Each with the PSF that stands for it.  Euclid's is brought to its measured FWHM by jitter; ``rubin`` is a
Kolmogorov profile of 0.7 arcsec, and resolves pairs from the same fraction of the FWHM, 0.37, as KCM16 assume."""
