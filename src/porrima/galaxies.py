"""Galaxies whose shear is measured: how large they are behind the PSF, and how many of each size."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import gammaincinv, gammaln

from porrima.errors import InputError
from porrima.units import to_internal

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["MEAN_E2", "SERSIC", "Galaxies", "r2_of_half_light", "regauss_r2"]

MEAN_E2 = 0.16
"""Mean square of the distortion of galaxies before lensing: responsivity 2 - 0.16 = 1.84 (dimensionless)."""

SERSIC = {"gaussian": 0.5, "exponential": 1.0, "de-vaucouleurs": 4.0}
"""Sersic index of each profile that has a name, dimensionless."""

INDEX_RANGE = (0.3, 6.2)
"""Smallest and largest Sersic index, dimensionless: those that GalSim draws."""

_NODES = 64  # of the quadrature over a law of sizes
_TAIL = 8.0  # standard deviations of a law of sizes that are integrated


@dataclass(frozen=True, slots=True, kw_only=True)
class Galaxies:
    r"""A distribution of galaxy sizes, one profile and the scatter of intrinsic shapes.

    Parameters
    ----------
    r2 : (n,) float array
        Size :math:`R_{gal}^2 = 2\sqrt{\det Q}` of the galaxy before the PSF, in arcsec²: Qxx + Qyy of the galaxy
        made round at constant area.  An elliptical one has :math:`Q_{xx} + Q_{yy} = R_{gal}^2/\sqrt{1 - e^2}`.
    weight : (n,) float array
        Share of each size in the shear estimate, dimensionless, sum 1.
    index : float
        Sersic index of all, dimensionless; 0.5 is a Gaussian.
    mean_e2 : float
        Mean of :math:`e^2 = e_1^2 + e_2^2` before lensing, in [0, 1).
    """

    r2: FloatArray
    weight: FloatArray
    index: float = SERSIC["gaussian"]
    mean_e2: float = MEAN_E2

    def __post_init__(self) -> None:
        _check_sizes(self.r2, "r2", "arcsec²")
        _check_weights(self.weight, self.r2)
        if not INDEX_RANGE[0] <= self.index <= INDEX_RANGE[1]:
            rule = f"must be in [{INDEX_RANGE[0]}, {INDEX_RANGE[1]}]"
            raise InputError(rule, key="galaxies.index", value=self.index)
        if not 0 <= self.mean_e2 < 1:
            raise InputError("must be in [0, 1)", key="galaxies.mean_e2", value=self.mean_e2)

    @classmethod
    def of(
        cls,
        r2: float | FloatArray,
        weight: FloatArray | None = None,
        *,
        index: float = SERSIC["gaussian"],
        mean_e2: float = MEAN_E2,
    ) -> Galaxies:
        """Galaxies of one size, or of a table of sizes.

        Parameters
        ----------
        r2 : float or (n,) float array
            Sizes, positive, in arcsec², or an astropy Quantity.
        weight : (n,) float array, optional
            Not negative, dimensionless; equal where not given.
        index, mean_e2 : float
            As for the class.

        Returns
        -------
        galaxies : Galaxies
            With weights that sum to 1.

        Raises
        ------
        InputError
            If there are no galaxies, a size is not positive, or a weight is negative.
        """
        size = np.atleast_1d(np.asarray(to_internal(r2, "angular_area"), dtype=float)).ravel()
        _check_sizes(size, "r2", "arcsec²")
        share = np.ones(size.size) if weight is None else np.asarray(weight, dtype=float).ravel()
        _check_weights(share, size)
        return cls(r2=size, weight=share / share.sum(), index=index, mean_e2=mean_e2)

    @classmethod
    def sersic(
        cls,
        half_light_radius: float | FloatArray,
        index: float,
        weight: FloatArray | None = None,
        *,
        mean_e2: float = MEAN_E2,
    ) -> Galaxies:
        r"""Galaxies of given half-light radii, made round at constant area.

        Parameters
        ----------
        half_light_radius : float or (n,) float array
            Positive, in arcsec, or an astropy Quantity; :math:`\sqrt{ab}` of an elliptical galaxy.
        index : float
            Sersic index, dimensionless; a value of `SERSIC` for the profiles with a name.
        weight : (n,) float array, optional
            As for `of`.
        mean_e2 : float
            As for the class.

        Returns
        -------
        galaxies : Galaxies
            With R² as `r2_of_half_light` gives it.

        Raises
        ------
        InputError
            As `of`.
        """
        radius = np.atleast_1d(np.asarray(to_internal(half_light_radius, "angle"), dtype=float))
        _check_sizes(radius, "half_light_radius", "arcsec")
        return cls.of(radius**2 * r2_of_half_light(index), weight, index=index, mean_e2=mean_e2)

    @classmethod
    def log_normal(
        cls,
        median_r2: float,
        scatter: float,
        *,
        smallest_r2: float = 0.0,
        index: float = SERSIC["gaussian"],
        mean_e2: float = MEAN_E2,
    ) -> Galaxies:
        r"""Galaxies with a log-normal law of sizes, cut at a smallest one.

        Parameters
        ----------
        median_r2 : float
            Median of the law before the cut, positive, in arcsec².
        scatter : float
            Standard deviation of log10 of R², in dex, not negative.
        smallest_r2 : float
            Galaxies below it are left out, in arcsec².
        index, mean_e2 : float
            As for the class.

        Returns
        -------
        galaxies : Galaxies
            Nodes and weights of a quadrature.

        Raises
        ------
        InputError
            If the median is not positive, the scatter negative, or nothing is left above the cut.

        Notes
        -----
        Without a cut :math:`\langle 1/R^2 \rangle = e^{s^2/2}/R_{med}^2`, s the scatter times ln 10.
        """
        _check_sizes(np.array([median_r2]), "median_r2", "arcsec²")
        if not 0 <= scatter < np.inf:
            raise InputError("must be finite and not negative [dex]", key="galaxies.scatter", value=scatter)
        if scatter == 0:
            one = cls.of(median_r2, index=index, mean_e2=mean_e2)
            return one.larger_than(smallest_r2)
        from_z = -_TAIL if smallest_r2 <= 0 else np.log10(smallest_r2 / median_r2) / scatter
        if from_z >= _TAIL:
            raise InputError("leaves no galaxies [arcsec²]", key="galaxies.smallest_r2", value=smallest_r2)
        x, w = np.polynomial.legendre.leggauss(_NODES)
        low = max(from_z, -_TAIL)
        z = low + 0.5 * (x + 1) * (_TAIL - low)
        return cls.of(median_r2 * 10 ** (scatter * z), w * np.exp(-0.5 * z**2), index=index, mean_e2=mean_e2)

    def larger_than(self, r2: float) -> Galaxies:
        """Those of at least a given size.

        Parameters
        ----------
        r2 : float
            In arcsec².

        Returns
        -------
        galaxies : Galaxies
            Weights sum to 1 again.

        Raises
        ------
        InputError
            If none is left.
        """
        kept = (self.r2 >= r2) & (self.weight > 0)
        if not np.any(kept):
            raise InputError("leaves no galaxies [arcsec²]", key="galaxies.smallest_r2", value=r2)
        share = self.weight[kept]
        return replace(self, r2=self.r2[kept], weight=share / share.sum())

    def resolved(self, psf_r2: float, resolution: float) -> Galaxies:
        r"""Those that a survey takes for resolved behind its PSF.

        Parameters
        ----------
        psf_r2 : float
            Size of the PSF, in arcsec².
        resolution : float
            Least :math:`R_{gal}^2/(R_{gal}^2 + R_P^2)`, in [0, 1).

        Returns
        -------
        galaxies : Galaxies
            Without the smaller ones, for which every formula in :math:`1/R_{gal}^2` diverges.

        Raises
        ------
        InputError
            If none is left, or the resolution is out of range.
        """
        if not 0 <= resolution < 1:
            raise InputError("must be in [0, 1)", key="galaxies.resolution", value=resolution)
        return self.larger_than(psf_r2 * resolution / (1 - resolution))

    @property
    def inverse_r2(self) -> float:
        r""":math:`\langle 1/R_{gal}^2 \rangle`, in arcsec^-2."""
        return float(np.sum(self.weight / self.r2))

    @property
    def half_light_radius(self) -> FloatArray:
        """Half-light radius of each size made round, (n,), in arcsec."""
        return np.sqrt(self.r2 / r2_of_half_light(self.index))


def _check_sizes(size: FloatArray, key: str, unit: str) -> None:
    if size.size == 0:
        raise InputError("must hold at least one galaxy", key=f"galaxies.{key}")
    good = np.isfinite(size) & (size > 0)
    if not np.all(good):
        raise InputError(f"must be positive and finite [{unit}]", key=f"galaxies.{key}", value=size[~good][0])


def _check_weights(weight: FloatArray, r2: FloatArray) -> None:
    if weight.shape != r2.shape:
        raise InputError(f"must be {r2.size}, one for each size", key="galaxies.weight", value=weight.size)
    good = np.isfinite(weight) & (weight >= 0)
    if not np.all(good):
        raise InputError("must be finite and not negative", key="galaxies.weight", value=weight[~good][0])
    if not weight.sum() > 0:
        raise InputError("must have a positive sum", key="galaxies.weight", value=weight.sum())


def r2_of_half_light(index: float) -> float:
    r"""Size R² of a round Sersic profile over its half-light radius squared.

    Parameters
    ----------
    index : float
        Sersic index n, dimensionless.

    Returns
    -------
    ratio : float
        :math:`R^2/R_e^2 = b^{-2n}\, \Gamma(4n)/\Gamma(2n)` with :math:`P(2n, b) = 1/2`, dimensionless: 1/ln 2 for a
        Gaussian, 2.13 for an exponential, 21.7 for a de Vaucouleurs profile, whose wings make most of it.

    Raises
    ------
    InputError
        If the index is not in `INDEX_RANGE`.

    References
    ----------
    Graham2005
    """
    if not INDEX_RANGE[0] <= index <= INDEX_RANGE[1]:
        raise InputError(
            f"must be in [{INDEX_RANGE[0]}, {INDEX_RANGE[1]}]", key="galaxies.index", value=index
        )
    b = gammaincinv(2 * index, 0.5)
    return float(np.exp(gammaln(4 * index) - gammaln(2 * index)) * b ** (-2 * index))


def regauss_r2(observed_r2: FloatArray, psf_r2: float, a4: FloatArray) -> FloatArray:
    r"""Size of galaxies as re-Gaussianization sees it.

    Parameters
    ----------
    observed_r2 : (n,) float array
        Adaptive R² of the re-Gaussianized image, in arcsec².
    psf_r2 : float
        Adaptive R² of the PSF, in arcsec².
    a4 : (n,) float array
        Radial fourth moment of that image, :math:`\rho_4/2 - 1` of HSM, 0 for a Gaussian, dimensionless.

    Returns
    -------
    r2 : (n,) float array
        :math:`R_{gal}^2 = R_I^2 (1 - a_4)/(1 + a_4) - R_P^2`, in arcsec²: what the method divides by.  For an
        exponential galaxy it is far below Qxx + Qyy.

    References
    ----------
    Hirata2003
    """
    a4 = np.asarray(a4, dtype=float)
    r2: FloatArray = np.asarray(observed_r2, dtype=float) * (1 - a4) / (1 + a4) - psf_r2
    return r2
