"""PSFs from files: FITS images and cubes, Piff models, GalSim configuration stanzas."""

from __future__ import annotations

import copy
import math
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import galsim
import numpy as np
import yaml

from porrima.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["PSFWarning", "fits_profile", "is_fits_name", "is_piff_name", "piff_profile", "stanza_profile"]

FITS_NAME = re.compile(
    r"(?P<path>.+\.(?:fits|fit|fts)(?:\.gz|\.fz)?)(?:\[(?P<part>[^\]]*)\])?", re.IGNORECASE
)
PIFF_NAME = re.compile(r"(?P<path>.+\.piff)(?:\[(?P<part>[^\]]*)\])?", re.IGNORECASE)

SHIFT_WARNING = 1.0
"""Distance between the middle of a stamp and the PSF above which a warning is given, in pixels."""

EDGE_WARNING = 0.005
"""Share of a background, or of wings outside the stamp, in the flux above which a warning is given (dimensionless)."""

EDGE_ERROR = 0.05
"""Brightness of the edge over that of the peak at which too little is left to measure (dimensionless)."""

MIN_SIDE = 8
"""Fewest pixels along a side of a stamp (count)."""


class PSFWarning(UserWarning):
    """A PSF can be used, but not everything about it is as it should be: with the size of what is not."""


def is_fits_name(name: str) -> bool:
    """Whether a name is that of a FITS file, with or without ``[EXT]`` or ``[EXT,INDEX]``."""
    return FITS_NAME.fullmatch(name) is not None


def is_piff_name(name: str) -> bool:
    """Whether a name is that of a Piff file, with or without ``[X,Y]`` or ``[CHIP,X,Y]``."""
    return PIFF_NAME.fullmatch(name) is not None


def fits_profile(name: str, pixel_scale: float | None = None, subtract_background: bool = False) -> Any:
    """Effective PSF from an image in a FITS file.

    Parameters
    ----------
    name : str
        ``FILE.fits``, ``FILE.fits[EXT]`` or, for a plane of a cube, ``FILE.fits[EXT,INDEX]``: extension by number
        or name, plane from 0.  Without EXT the first image of the file.
    pixel_scale : float, optional
        In arcsec; from ``PIXELSCL``, ``CDi_j`` or ``CDELTi`` where not given.
    subtract_background : bool
        Whether the median of the outermost pixels is subtracted.

    Returns
    -------
    profile : galsim.InterpolatedImage
        Of flux 1, centred on its weighted centroid, with GalSim's quintic between pixels.

    Raises
    ------
    InputError
        If there is no such image, or it has no scale, pixels that are not finite, no positive flux, no peak
        inside, or an edge so bright that most of the PSF is missing.

    Warns
    -----
    PSFWarning
        With the size of the shift, and of the background or of the wings beyond the stamp that its edge shows.
    """
    match = FITS_NAME.fullmatch(name)
    path, part = (match["path"], match["part"]) if match else (name, None)
    pixels, headers = _fits_plane(path, part)
    if not np.all(np.isfinite(pixels)):
        bad = int((~np.isfinite(pixels)).sum())
        raise InputError(
            "must have finite pixels only", source=name, value=f"{bad} of {pixels.size} that are not"
        )
    if min(pixels.shape) < MIN_SIDE:
        size = f"{pixels.shape[1]} x {pixels.shape[0]}"
        raise InputError(f"must have at least {MIN_SIDE} pixels a side", source=name, value=size)
    scale = _scale(headers, name, pixel_scale)
    if not pixels.sum() > 0:
        raise InputError("must have a positive total flux", source=name, value=f"{pixels.sum():g}")
    if subtract_background:
        pixels = pixels - np.median(_border(pixels))
    centre = _centroid(pixels, name)
    _check_edge(pixels, name, scale)
    image = galsim.ImageD(np.ascontiguousarray(pixels), scale=scale)
    return galsim.InterpolatedImage(
        image, x_interpolant="quintic", offset=galsim.PositionD(*centre), flux=1.0
    )


def _fits_plane(path: str, part: str | None) -> tuple[FloatArray, list[Any]]:
    """One image, as float64, and the headers that may hold its scale."""
    from astropy.io import fits  # noqa: PLC0415  (a fifth of a second, for FITS files only)

    if not Path(path).is_file():
        raise InputError("no such file", source=path)
    extension, comma, plane = (part or "").partition(",")
    try:
        with fits.open(path) as hdus:
            hdu = _extension(hdus, extension.strip(), path)
            data = None if hdu.data is None else np.array(hdu.data)
            headers = [hdu.header.copy(), hdus[0].header.copy()]
    except OSError as error:
        raise InputError(f"cannot be read as FITS: {error}", source=path) from None
    if data is None or data.dtype.names is not None or data.dtype.kind not in "fiu":
        raise InputError("must be an image", source=f"{path}[{extension}]")
    if comma:
        if data.ndim != 3:
            raise InputError(
                "must be a cube to take a plane of it", source=path, value=f"{data.ndim} dimensions"
            )
        if not (plane.strip().isdigit() and int(plane) < len(data)):
            raise InputError(f"plane must be one of 0 to {len(data) - 1}", source=path, value=plane)
        data = data[int(plane)]
    if data.ndim == 3 and len(data) == 1:
        data = data[0]
    if data.ndim == 3:
        last = f"FILE.fits[{extension or 0},{len(data) - 1}]"
        raise InputError(f"is a cube of {len(data)} planes: name one, up to {last}", source=path)
    if data.ndim != 2:
        raise InputError("must be an image of two dimensions", source=path, value=f"{data.ndim}")
    return data.astype(float), headers


def _extension(hdus: Any, extension: str, path: str) -> Any:
    """The HDU that is meant: by number, by name, or the first that holds an image."""
    if not extension:
        for hdu in hdus:
            if hdu.is_image and hdu.data is not None:
                return hdu
        raise InputError("holds no image", source=path)
    key = int(extension) if extension.isdigit() else extension
    try:
        return hdus[key]
    except (KeyError, IndexError):
        names = ", ".join(f"{n} {hdu.name}".strip() for n, hdu in enumerate(hdus))
        raise InputError(f"extension must be one of {names}", source=path, value=extension) from None


def _scale(headers: list[Any], name: str, given: float | None) -> float:
    """Side of a pixel in arcsec: as given, or from a header."""
    found = next((s for s in (_header_scale(header, name) for header in headers) if s is not None), None)
    if given is None:
        if found is None:
            rule = "has no pixel scale (PIXELSCL, CDi_j or CDELTi): give --pixel-scale in arcsec"
            raise InputError(rule, source=name)
        return found
    if found is not None and abs(given / found - 1) > 1e-3:
        text = f"{name}: --pixel-scale {given:g} arcsec is taken, the header has {found:.6g}"
        warnings.warn(PSFWarning(text), stacklevel=4)
    return given


def _header_scale(header: Any, name: str) -> float | None:
    """Scale of one header in arcsec, None where it has none."""
    try:
        if "PIXELSCL" in header:
            sides = [float(header["PIXELSCL"])]
        elif "CD1_1" in header:
            unit = _unit(header)
            cd = [[float(header.get(f"CD{i}_{j}", 0.0)) * unit for j in (1, 2)] for i in (1, 2)]
            sides = [math.hypot(cd[0][j], cd[1][j]) for j in (0, 1)]
        elif "CDELT1" in header and ("CTYPE1" in header or "CUNIT1" in header or header["CDELT1"] != 1):
            sides = [abs(float(header[f"CDELT{i}"])) * _unit(header) for i in (1, 2)]
        else:
            return None
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"has a pixel scale that cannot be read: {error}", source=name) from None
    if not all(0 < side < math.inf for side in sides):
        raise InputError("must have a positive pixel scale [arcsec]", source=name, value=sides[0])
    if abs(sides[0] / sides[-1] - 1) > 1e-3:
        raise InputError(
            "must have square pixels", source=name, value=f"{sides[0]:.6g} x {sides[1]:.6g} arcsec"
        )
    return math.sqrt(sides[0] * sides[-1])


def _unit(header: Any) -> float:
    """Arcsec per unit of the header's world coordinates, deg unless it says otherwise."""
    from astropy import units  # noqa: PLC0415  (as above)

    return float(units.Unit(header.get("CUNIT1") or "deg").to("arcsec"))


def _border(pixels: FloatArray) -> FloatArray:
    """The outermost pixels."""
    return np.concatenate([pixels[0], pixels[-1], pixels[1:-1, 0], pixels[1:-1, -1]])


def _centroid(pixels: FloatArray, name: str) -> tuple[float, float]:
    """Weighted centroid from the middle of the stamp, in pixels."""
    image = galsim.ImageD(np.ascontiguousarray(pixels), scale=1.0)
    row, column = np.unravel_index(np.argmax(pixels), pixels.shape)
    if row in (0, pixels.shape[0] - 1) or column in (0, pixels.shape[1] - 1):
        raise InputError("must have its peak inside the stamp", source=name, value=f"pixel [{column}, {row}]")
    start = galsim.PositionD(float(column + 1), float(row + 1))
    found = galsim.hsm.FindAdaptiveMom(image, guess_centroid=start, guess_sig=2.0, strict=False)
    at = start if found.error_message else found.moments_centroid
    shift = at - image.true_center
    if math.hypot(shift.x, shift.y) > SHIFT_WARNING:
        text = f"{name}: the PSF lies {shift.x:+.2f}, {shift.y:+.2f} pixels from the middle; it is recentred"
        warnings.warn(PSFWarning(text), stacklevel=4)
    return shift.x, shift.y


def _check_edge(pixels: FloatArray, name: str, scale: float) -> None:
    """Refuse a stamp whose edge is bright; say what its brightness means as background, or as wings."""
    edge, peak, total = np.median(_border(pixels)), pixels.max(), pixels.sum()
    if not total > 0 or abs(edge) > EDGE_ERROR * peak:
        rule = (
            f"must have an edge fainter than {EDGE_ERROR} of its peak: it is too small, or has a background"
        )
        raise InputError(rule, source=name, value=f"{edge / peak:.2g}")
    radius = min(pixels.shape) / 2
    background = edge * pixels.size / total
    beyond = 2 * math.pi * radius**2 * edge / total  # of wings that fall as r^-3, as those of diffraction do
    if max(abs(background), beyond) > EDGE_WARNING:
        text = (
            f"{name}: its edge is not dark: {background:.1g} of the flux if that is a background, "
            f"about {beyond:.1g} more beyond {radius * scale:.2f} arcsec if those are wings"
        )
        warnings.warn(PSFWarning(text), stacklevel=4)


def stanza_profile(path: str) -> Any:
    """PSF from a YAML file with a GalSim configuration.

    Parameters
    ----------
    path : str
        Of a file whose key ``psf`` is a stanza as GalSim's configuration takes it.

    Returns
    -------
    profile : galsim.GSObject or galsim.ChromaticObject
        As GalSim builds it.

    Raises
    ------
    InputError
        If the file cannot be read, has no ``psf``, or GalSim refuses the stanza.

    Notes
    -----
    ``modules`` and ``eval_variables`` next to ``psf`` are heeded.  A stanza is code: it runs with the
    rights of who reads it.

    References
    ----------
    Rowe2015
    """
    try:
        config = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", source=path) from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"must be YAML: {error}", source=path) from None
    if not (isinstance(config, dict) and isinstance(config.get("psf"), dict)):
        raise InputError(
            "must have a GalSim stanza such as {type: Moffat, beta: 3, fwhm: 0.7}", source=path, key="psf"
        )
    try:
        galsim.config.ImportModules(config)
        profile, _ = galsim.config.BuildGSObject(copy.deepcopy(config), "psf")
    except Exception as error:  # the constructors that a stanza names raise whatever they like
        text = str(error).strip() or type(error).__name__
        raise InputError(text, source=path, key="psf") from None
    if not isinstance(profile, galsim.GSObject | galsim.ChromaticObject):
        raise InputError("must be a profile", source=path, key="psf", value=type(profile).__name__)
    return profile


def piff_profile(name: str) -> Any:
    """PSF of a Piff model at one place.

    Parameters
    ----------
    name : str
        ``FILE.piff[X,Y]`` or ``FILE.piff[CHIP,X,Y]``: place in pixels, chip by number where there are many.

    Returns
    -------
    profile : galsim.GSObject
        Along the axes of the image, in arcsec; with or without pixel as the model has it.

    Raises
    ------
    InputError
        If Piff is not installed, the file cannot be read, or it has no such place.

    References
    ----------
    Jarvis2021
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the packages that Piff imports
            import piff  # noqa: PLC0415  (optional)
    except ImportError:
        raise InputError("needs Piff: pip install 'porrima[piff]'", source=name) from None
    match = PIFF_NAME.fullmatch(name)
    path, part = (match["path"], match["part"]) if match else (name, None)
    try:
        *chip, x, y = (float(v) for v in (part or "").split(","))
        if len(chip) > 1:
            raise ValueError
    except ValueError:
        raise InputError("must name a place: FILE.piff[X,Y] or FILE.piff[CHIP,X,Y]", source=name) from None
    if not Path(path).is_file():
        raise InputError("no such file", source=path)
    try:
        model = piff.read(path)
        chipnum = int(chip[0]) if chip else next(iter(model.wcs))
        profile, _ = model.get_profile(x, y, chipnum=chipnum)
        local = model.wcs[chipnum].local(galsim.PositionD(x, y))
    except Exception as error:  # a file of another version fails wherever it happens to
        raise InputError(f"cannot be used by Piff: {error or type(error).__name__}", source=name) from None
    scale = galsim.PixelScale(math.sqrt(abs(local.pixelArea())))
    return scale.toWorld(local.toImage(profile))
