"""Options that several commands share: their names, types and help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from porrima.errors import InputError

__all__ = [
    "Band", "BinaryFraction", "Catalogue", "Colour", "EstimatorName", "Folder", "Format", "GalaxySize",
    "GalaxySizes", "Instrument", "Jitter", "Json", "Latitude", "Longitude", "Mag", "Mapping",
    "MultiplicityName", "Output", "PhotometryName", "Pixel", "PixelScale", "Plot", "Psf", "ReaderOptions",
    "Rejected", "Seed", "StarsTable", "Survey", "SurveyCut", "SurveyPsf", "table_of",
]  # fmt: skip

Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]
Seed = Annotated[int, typer.Option("--seed", help="Of everything that is drawn.")]
Longitude = Annotated[float | None, typer.Option("--l", help="Galactic longitude [deg].")]
Latitude = Annotated[float | None, typer.Option("--b", help="Galactic latitude [deg].")]
Catalogue = Annotated[
    Path | None, typer.Option("--catalog", help="A real catalogue instead of the analytic Galaxy.")
]
Format = Annotated[str | None, typer.Option("--format", help="Of the catalogue; recognised when not given.")]
Mapping = Annotated[str | None, typer.Option("--map", help="Its columns: mass=M,distance=D,magnitude=I.")]
ReaderOptions = Annotated[
    str | None, typer.Option("--options", help="Of its format: binaries=drop, ruwe_max=1.4, ...")
]
Band = Annotated[str | None, typer.Option("--band", help="Of the magnitudes; i, or the catalogue's own.")]
Mag = Annotated[tuple[float, float], typer.Option("--mag", help="Magnitude range [lo, hi).", metavar="LO HI")]
MultiplicityName = Annotated[
    str, typer.Option("--multiplicity", help="dk13, modern, ... or {model: dk13, gap_rule: solar, ...}.")
]
PhotometryName = Annotated[
    str,
    typer.Option(
        "--photometry", help="main-sequence, habets-heintze, or {model: habets-heintze, branch: primary}."
    ),
]
Psf = Annotated[str, typer.Option("--psf", help="Name of the PSF.")]
Rejected = Annotated[
    str | None,
    typer.Option(
        "--selection",
        help="Also rejected: a table, {clip: T, noise: SIGMA}, {detection: euclid-vis}, {gaia: dr3}, a list.",
    ),
]
Pixel = Annotated[float | None, typer.Option("--pixel", help="Side of a pixel to convolve with [arcsec].")]
PixelScale = Annotated[float | None, typer.Option("--pixel-scale", help="Of a FITS image [arcsec].")]
Jitter = Annotated[
    float | None, typer.Option("--jitter", help="Sigma of a Gaussian to convolve with [arcsec].")
]
Colour = Annotated[
    str | None, typer.Option("--colour", help="Band of the PSF: adds what the companions' colour does.")
]
EstimatorName = Annotated[
    str, typer.Option("--estimator", help="adaptive, plain or gaussian:SIGMA [arcsec].")
]
Instrument = Annotated[str | None, typer.Option(help="euclid-vis, roman-h158, rubin, kcm16 or massey13.")]
Survey = Annotated[str | None, typer.Option("--survey", "--instrument", help="euclid-vis or roman-h158.")]
Folder = Annotated[Path | None, typer.Option("--output", "-o", help="Folder: table, numbers and figure.")]
StarsTable = Annotated[Path | None, typer.Option("--stars", help="Table as `porrima stars` writes it.")]
SurveyPsf = Annotated[str | None, typer.Option("--psf", help="Name of the PSF; the instrument's.")]


def _fraction(value: float | None) -> float | None:
    """A binary fraction, where one is given."""
    if value is not None and not 0 <= value <= 1:
        raise InputError("must be in [0, 1]", key="--binary-fraction", value=value)
    return value


BinaryFraction = Annotated[
    float | None, typer.Option(help="0 to 1; as the model gives it if not given.", callback=_fraction)
]
GalaxySize = Annotated[
    float | None, typer.Option(help="Half-light radius of exponential galaxies [arcsec]; 0.3.")
]
GalaxySizes = Annotated[
    str | None,
    typer.Option("--galaxies", help="Table, or {half_light_radius: R, scatter: S, index: N, ...}."),
]
SurveyCut = Annotated[float | None, typer.Option("--cut", help="Separation of resolved pairs [arcsec].")]
Plot = Annotated[Path | None, typer.Option(help="Picture to write: PNG, PDF or SVG.")]
Output = Annotated[Path | None, typer.Option("--output", "-o", help="ECSV file to write.")]


def table_of(stars: Path | None, catalog: Path | None, format: str | None) -> tuple[Path | None, str | None]:  # noqa: A002
    """Catalogue and format, where --stars may stand for both.

    Parameters
    ----------
    stars, catalog : Path or None
        Files; one of them at most.
    format : str or None
        Of the catalogue.

    Returns
    -------
    catalog, format : Path or None, str or None
        A table where ``--stars`` is given.

    Raises
    ------
    InputError
        If they exclude each other.
    """
    for key, value in (("--catalog", catalog), ("--format", format)):
        if stars is not None and value is not None:
            raise InputError(f"cannot be given together with {key}", key="--stars", value=stars)
    return (catalog, format) if stars is None else (stars, "table")
