"""Options that several commands share: their names, types and help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from porrima.errors import InputError

__all__ = [
    "Band",
    "Catalogue",
    "EstimatorName",
    "Format",
    "Jitter",
    "Json",
    "Latitude",
    "Longitude",
    "Mag",
    "Mapping",
    "MultiplicityName",
    "PhotometryName",
    "Pixel",
    "PixelScale",
    "Psf",
    "ReaderOptions",
    "Seed",
    "table_of",
]

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
    str, typer.Option("--multiplicity", help="dk13, dk13-kcm16, or {model: dk13, gap_rule: solar, ...}.")
]
PhotometryName = Annotated[
    str,
    typer.Option(
        "--photometry", help="main-sequence, habets-heintze, or {model: habets-heintze, branch: primary}."
    ),
]
Psf = Annotated[str, typer.Option("--psf", help="Name of the PSF.")]
Pixel = Annotated[float | None, typer.Option("--pixel", help="Side of a pixel to convolve with [arcsec].")]
PixelScale = Annotated[float | None, typer.Option("--pixel-scale", help="Of a FITS image [arcsec].")]
Jitter = Annotated[
    float | None, typer.Option("--jitter", help="Sigma of a Gaussian to convolve with [arcsec].")
]
EstimatorName = Annotated[
    str, typer.Option("--estimator", help="adaptive, plain or gaussian:SIGMA [arcsec].")
]


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
