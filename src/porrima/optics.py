"""Diffraction-limited PSFs of an obscured pupil with struts, in closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import galsim
import numpy as np
from scipy.special import j1

from porrima.instruments import EUCLID_VIS
from porrima.sampling import HALF_WIDTH

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.spectra import Light

    FloatArray = NDArray[np.float64]

__all__ = ["ARCSEC", "EUCLID_LIKE", "WAVELENGTH", "Pupil", "diffraction_pattern", "optical_image"]

WAVELENGTH = 800.0
"""Of the named optical PSFs, in nm: that at which Euclid states the size of its PSF (Laureijs et al. 2011)."""

ARCSEC = math.pi / 648_000
"""One arcsec, in rad."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pupil:
    """Round pupil with a round central obscuration and pairs of opposite radial struts.

    Parameters
    ----------
    diameter : float
        In m.
    obscuration : float
        Diameter of the central obscuration over that of the pupil, in [0, 1).
    strut_pairs : int
        Pairs of opposite struts, evenly spaced (count).
    strut_thickness : float
        Over the diameter, dimensionless.
    strut_angle : float
        Of the first pair, from the y axis towards -x, in deg.
    """

    diameter: float
    obscuration: float
    strut_pairs: int
    strut_thickness: float
    strut_angle: float = 0.0


EUCLID_LIKE = Pupil(diameter=EUCLID_VIS.diameter, obscuration=0.35, strut_pairs=3, strut_thickness=0.01)
"""Six struts, as KCM16 has them.  The obscuration, 0.42 m, is that which leaves Euclid's collecting area of
0.9926 m² of its 1.2 m (as in GalSim-Euclid-Like); the struts are 12 mm thick."""


def diffraction_pattern(pupil: Pupil, wavelength: float, x: FloatArray, y: FloatArray) -> FloatArray:
    r"""Surface brightness of a point source behind a pupil without aberrations.

    Parameters
    ----------
    pupil : Pupil
        Its shape.
    wavelength : float
        In nm.
    x, y : (ny, nx) float array
        Place from the source, in arcsec; any shapes that broadcast.

    Returns
    -------
    brightness : (ny, nx) float array
        Of unit flux, in arcsec^-2.

    Notes
    -----
    With :math:`\rho` the radius of the pupil, :math:`k = 2 \pi \rho\, \theta / \lambda`,
    :math:`\epsilon` the obscuration, t the thickness in units of :math:`\rho` and :math:`k_s, k_n` the
    components of k along and across a pair of struts,

    .. math:: I = \frac{\rho^2}{\lambda^2 a} \Bigl[ 2\pi \frac{J_1(k)}{k}
              - 2\pi \epsilon^2 \frac{J_1(\epsilon k)}{\epsilon k}
              - \sum_s 2 t\, \mathrm{sinc}\frac{t k_n}{2}\,
                \frac{\sin k_s - \sin \epsilon k_s}{k_s} \Bigr]^2 ,

    a being the open area in units of :math:`\rho^2`.  The ends of the struts are taken as straight: that
    changes a by less than 1e-6.

    References
    ----------
    BornWolf1999
    """
    per_arcsec = math.pi * pupil.diameter / (wavelength * 1e-9) * ARCSEC
    kx, ky = np.asarray(x) * per_arcsec, np.asarray(y) * per_arcsec
    k = np.hypot(kx, ky)
    epsilon, t = pupil.obscuration, 2 * pupil.strut_thickness
    amplitude = 2 * math.pi * (_jinc(k) - epsilon**2 * _jinc(epsilon * k))
    for pair in range(pupil.strut_pairs):
        angle = math.radians(pupil.strut_angle) + math.pi * pair / pupil.strut_pairs
        along = -math.sin(angle) * kx + math.cos(angle) * ky
        across = math.cos(angle) * kx + math.sin(angle) * ky
        length = np.sinc(along / math.pi) - epsilon * np.sinc(epsilon * along / math.pi)
        amplitude -= 2 * t * np.sinc(t * across / (2 * math.pi)) * length
    area = math.pi * (1 - epsilon**2) - 2 * pupil.strut_pairs * t * (1 - epsilon)
    return np.asarray(amplitude**2 * (per_arcsec / (2 * math.pi)) ** 2 / area)


def _jinc(k: FloatArray) -> FloatArray:
    """J1(k) / k."""
    safe = np.where(k > 1e-6, k, 1.0)
    return np.where(k > 1e-6, j1(safe) / safe, 0.5)


def optical_image(
    pupil: Pupil,
    light: Light,
    e1: float,
    e2: float,
    scale: float,
    half_width: float = HALF_WIDTH,
) -> Any:
    r"""Samples of a diffraction pattern sheared at constant area.

    Parameters
    ----------
    pupil : Pupil
        What diffracts.
    light : Light
        One wavelength or many; each has its own pattern.
    e1, e2 : float
        Distortion of the shear, dimensionless.
    scale : float
        Side of a pixel, in arcsec.
    half_width : float
        Of the image, in arcsec; 1.4 % of the light lies beyond 5.5 arcsec, most of it along the struts.

    Returns
    -------
    image : galsim.ImageD
        Odd number of pixels a side, the origin in the middle.

    Notes
    -----
    Adaptive moments follow a shear exactly, :math:`M \to S M S^T`, and three or more evenly spaced pairs of
    struts leave the pattern round: its adaptive distortion is therefore (e1, e2), wherever the struts point.

    References
    ----------
    KCM16, Sect. 5.2; Hirata2003
    """
    side = 2 * math.ceil(half_width / scale) + 1
    along = (np.arange(side) - side // 2) * scale
    inverse = np.linalg.inv(galsim.Shear(e1=e1, e2=e2).getMatrix())  # of determinant 1
    x = inverse[0, 0] * along + inverse[0, 1] * along[:, None]
    y = inverse[1, 0] * along + inverse[1, 1] * along[:, None]
    half = side // 2 + 1  # the pattern is the same at -x, -y
    lower = np.zeros((half, side))
    for wavelength, share in zip(light.wavelength, light.share, strict=True):
        lower += share * diffraction_pattern(pupil, wavelength, x[:half], y[:half])
    pixels = np.concatenate([lower, lower[-2::-1, ::-1]])
    return galsim.ImageD(pixels * scale**2, scale=scale)
