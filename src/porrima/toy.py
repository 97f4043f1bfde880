"""The toy model of KCM16: one star with one companion anywhere in the central pixel."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from scipy.optimize import brentq

from porrima import figures
from porrima.errors import InputError
from porrima.files import make_folder, write_whole
from porrima.images import measure_stack
from porrima.instruments import EUCLID_VIS
from porrima.moments import KernelMoments, moments_of_points
from porrima.psf import sheared_gaussian
from porrima.response import response
from porrima.shapes import Adaptive
from porrima.systems import Systems

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from porrima.psf import PSF

    FloatArray = NDArray[np.float64]

__all__ = ["headline", "toy_maps", "write_toy"]

PIXEL = EUCLID_VIS.pixel
"""Side of the central pixel, that of Euclid's VIS, in arcsec."""

NEAR = 0.01
"""Separation at which the paper reads its maps, in arcsec (KCM16 Sect. 2)."""

ONE_PERCENT = 0.01
"""Relative error of the ellipticity that the paper finds there (dimensionless)."""


def toy_maps(
    *,
    fwhm: float = 0.137,
    ellipticity: float = 0.05,
    magnitude_differences: tuple[float, ...] = (0.0, 1.0),
    points: int = 61,
    progress: Callable[[int], None] = lambda _: None,
) -> xr.Dataset:
    r"""Shape of a star with one companion, for every place of the companion in the central pixel (KCM16, Fig. 1).

    Parameters
    ----------
    fwhm : float
        Of the Gaussian PSF before its shear, in arcsec.
    ellipticity : float
        Distortion of the PSF, once along e1 and once along e2, in (0, 1).
    magnitude_differences : tuple of float
        Companion fainter than the primary by so much, in mag, 0 or more.
    points : int
        Places along each side of the pixel, odd (count).
    progress : callable
        Called with the number of maps done, one for each PSF and magnitude difference (count).

    Returns
    -------
    maps : Dataset
        ``e``, ``de_rel`` = :math:`(e - e_0) / e_0` and ``dr2_rel`` = :math:`(R^2 - R_0^2) / R_0^2` over ``psf``,
        ``delta_m``, ``y`` and ``x`` [arcsec], the companion's place from the primary; ``by_images`` is true
        where kernel moments up to order 8 do not reach and the pair was drawn and measured instead; ``e1_0``,
        ``e2_0``, ``r2_0`` [arcsec²] over ``psf``.

    Raises
    ------
    InputError
        If an argument is out of its range.

    Notes
    -----
    Adaptive moments, solved exactly behind each place (`Response.shapes` with threshold 0).

    References
    ----------
    KCM16, Hirata2003
    """
    if not 0 < fwhm < math.inf:
        raise InputError("must be positive and finite [arcsec]", key="--psf-fwhm", value=fwhm)
    if not 0 < ellipticity < 1:
        raise InputError("must be between 0 and 1", key="--ellipticity", value=ellipticity)
    if points < 3 or points % 2 == 0:
        raise InputError("must be odd and at least 3", key="--points", value=points)
    side = np.linspace(-PIXEL / 2, PIXEL / 2, points)
    psfs = [
        sheared_gaussian("PSF along e1", ellipticity, 0.0, fwhm),
        sheared_gaussian("PSF along e2", 0.0, ellipticity, fwhm),
    ]
    x, y = np.meshgrid(side, side)
    found = []
    for psf in psfs:
        found.append(
            [_all_around(psf, 10 ** (-0.4 * dm), x.ravel(), y.ravel()) for dm in magnitude_differences]
        )
        progress(len(magnitude_differences))
    dimensions = ("psf", "delta_m", "y", "x")
    shape0 = [response(psf, Adaptive()).shape0 for psf in psfs]
    size0 = np.array([s.r2 for s in shape0])[:, None, None, None]
    values = np.array([[list(one.values()) for one in row] for row in found])
    values = values.reshape(len(psfs), len(magnitude_differences), 4, points, points)
    e = np.hypot(values[:, :, 0], values[:, :, 1])
    return xr.Dataset(
        {
            "e": (dimensions, e),
            "de_rel": (dimensions, e / ellipticity - 1),
            "dr2_rel": (dimensions, values[:, :, 2] / size0 - 1),
            "by_images": (dimensions, values[:, :, 3] > 0),
            **{f"{q}_0": ("psf", np.array([getattr(s, q) for s in shape0])) for q in ("e1", "e2", "r2")},
        },
        coords={
            "psf": [p.name for p in psfs],
            "delta_m": list(magnitude_differences),
            "y": side,
            "x": side,
        },
        attrs={"fwhm": fwhm, "ellipticity": ellipticity, "estimator": Adaptive().name},
    )


def _all_around(psf: PSF, flux_ratio: float, x: FloatArray, y: FloatArray) -> dict[str, FloatArray]:
    """As `_pairs` for places that are the same turned by 180 degrees, which changes no shape: half of them."""
    half = len(x) // 2 + 1
    found = _pairs(psf, flux_ratio, x[:half], y[:half])
    return {name: np.concatenate([values, values[-2::-1]]) for name, values in found.items()}


def _pairs(psf: PSF, flux_ratio: float, x: FloatArray, y: FloatArray) -> dict[str, FloatArray]:
    """e1, e2, R² of pairs, each alone, and where they had to be drawn."""
    zero = np.zeros_like(x)
    pairs = Systems.from_pairs(zero + flux_ratio, x, y)
    each = KernelMoments(values=moments_of_points(pairs.flux, pairs.x, pairs.y), n_stars=1)
    shape = response(psf, Adaptive()).shapes(each, threshold=0.0)
    result = {"e1": shape.e1, "e2": shape.e2, "r2": shape.r2, "by_images": shape.flag != 0}
    for i in np.flatnonzero(shape.flag).tolist():
        drawn = measure_stack(
            psf, Systems.from_pairs(zero[:1] + flux_ratio, x[i : i + 1], y[i : i + 1]), Adaptive()
        )
        for name in ("e1", "e2", "r2"):
            result[name][i] = getattr(drawn, name)
    return result


def headline(maps: xr.Dataset) -> dict[str, Any]:
    """What the paper says of its maps, in numbers.

    Parameters
    ----------
    maps : Dataset
        From `toy_maps`.

    Returns
    -------
    numbers : dict
        ``at_0_01``: the largest absolute ``de_rel`` and the largest ``dr2_rel`` for a companion at 0.01 arcsec,
        per magnitude difference; ``radius_of_1_percent`` [arcsec], the least separation at which ``de_rel``
        reaches 0.01, NaN where it does not in the pixel; ``e_depends_on_psf`` and ``r2_depends_on_psf``: largest
        difference between the maps of the two PSFs, over the largest value (dimensionless).
    """
    psfs = [
        sheared_gaussian(str(n), float(a), float(b), maps.attrs["fwhm"])
        for n, a, b in zip(maps["psf"].to_numpy(), maps["e1_0"], maps["e2_0"], strict=True)
    ]
    angle = np.linspace(0, math.pi, 24, endpoint=False)
    rows = []
    for dm in maps["delta_m"].to_numpy().tolist():
        ratio = 10 ** (-0.4 * dm)

        def largest(radius: float, ratio: float = ratio) -> FloatArray:
            found = [_pairs(p, ratio, radius * np.cos(angle), radius * np.sin(angle)) for p in psfs]
            e0, r0 = maps.attrs["ellipticity"], maps["r2_0"].to_numpy()
            de = [np.abs(np.hypot(f["e1"], f["e2"]) / e0 - 1).max() for f in found]
            dr2 = [(f["r2"] / r - 1).max() for f, r in zip(found, r0, strict=True)]
            return np.array([max(de), max(dr2)])

        at_near = largest(NEAR)

        def beyond(log_radius: float, largest: Callable[[float], FloatArray] = largest) -> float:
            return float(largest(math.exp(log_radius))[0] - ONE_PERCENT)

        low, high = math.log(1e-4), math.log(PIXEL / 2)
        radius = (
            math.exp(brentq(beyond, low, high, xtol=1e-5)) if beyond(high) > 0 > beyond(low) else math.nan
        )
        rows.append(
            {
                "delta_m": dm,
                "de_rel_at_0_01": float(at_near[0]),
                "dr2_rel_at_0_01": float(at_near[1]),
                "radius_of_1_percent": radius,
            }
        )

    def differs(name: str) -> float:
        values = maps[name].to_numpy()
        return float(np.abs(values[0] - values[1]).max() / np.abs(values).max())

    return {
        "contrasts": rows,
        "e_depends_on_psf": differs("de_rel"),
        "r2_depends_on_psf": differs("dr2_rel"),
        "share_by_images": float(maps["by_images"].mean()),
    }


def write_toy(folder: Path, **options: Any) -> dict[str, Any]:
    """Maps of the toy model, their figure and their numbers, written to a folder.

    Parameters
    ----------
    folder : Path
        Made where it is not there.
    **options : float or int
        Of `toy_maps`.

    Returns
    -------
    result : dict
        ``figure`` and ``maps``, the files ``toy.png`` and ``toy.npz``, and the numbers of `headline`.
    """
    maps = toy_maps(**options)
    make_folder(folder)
    figure = figures.toy_maps(maps)
    files = {"figure": folder / "toy.png", "maps": folder / "toy.npz"}
    write_whole(files["figure"], lambda path: figure.savefig(path, dpi=160))
    arrays: dict[str, Any] = {str(name): values.to_numpy() for name, values in maps.variables.items()}
    write_whole(files["maps"], lambda path: np.savez(path, allow_pickle=False, **arrays))
    return {name: str(path) for name, path in files.items()} | headline(maps)
