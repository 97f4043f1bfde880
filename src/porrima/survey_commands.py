"""The commands about a survey's decisions: arguments in, one result out; no science here, heavy imports where used."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from porrima.options import (
    Band,
    Catalogue,
    EstimatorName,
    Format,
    Jitter,
    Json,
    Latitude,
    Longitude,
    Mag,
    Mapping,
    MultiplicityName,
    PhotometryName,
    Pixel,
    PixelScale,
    ReaderOptions,
    Seed,
    table_of,
)  # fmt: skip
from porrima.terminal import show

__all__ = ["budget", "correct"]


def budget(
    *,
    instrument: Annotated[
        str | None, typer.Option(help="euclid-vis, roman-h158, rubin, kcm16 or massey13.")
    ] = None,
    requirements: Annotated[Path | None, typer.Option(help="YAML file: sigma_e, sigma_r2, m, c.")] = None,
    stars: Annotated[Path | None, typer.Option("--stars", help="Table as `porrima stars` writes it.")] = None,
    catalog: Catalogue = None,
    format: Format = None,  # noqa: A002
    map: Mapping = None,  # noqa: A002
    options: ReaderOptions = None,
    l: Longitude = None,
    b: Latitude = None,
    mag: Mag = (16.0, 24.0),
    bins: Annotated[int | None, typer.Option(help="Equal bins of magnitude.")] = None,
    step: Annotated[float | None, typer.Option(help="Width of a bin [mag]; 1 if not given.")] = None,
    psf: Annotated[str | None, typer.Option("--psf", help="Name of the PSF; the instrument's.")] = None,
    pixel: Pixel = None,
    pixel_scale: PixelScale = None,
    jitter: Jitter = None,
    estimator: EstimatorName = "adaptive",
    n_stars: Annotated[int, typer.Option(help="From which the PSF of a patch is made.")] = 2000,
    binary_fraction: Annotated[
        float | None, typer.Option(help="0 to 1; as the model gives it if not given.")
    ] = None,
    galaxy_size: Annotated[
        float | None, typer.Option(help="Half-light radius of exponential galaxies [arcsec]; 0.3.")
    ] = None,
    galaxies: Annotated[
        str | None, typer.Option(help="Table, or {half_light_radius: R, scatter: S, index: N, ...}.")
    ] = None,
    multiplicity: MultiplicityName = "dk13",
    photometry: PhotometryName = "main-sequence",
    band: Band = None,
    cut: Annotated[float | None, typer.Option(help="Separation of resolved pairs [arcsec].")] = None,
    seed: Seed = 1,
    plot: Annotated[Path | None, typer.Option(help="Picture to write: PNG, PDF or SVG.")] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="ECSV file to write.")] = None,
    as_json: Json = False,
) -> None:
    """Share of a survey's requirements that unresolved binaries use, by magnitude."""
    from porrima.decision import decided
    from porrima.ledger import BUDGET_COLUMNS, budget_lines, header_of, write_budget

    catalog, format = table_of(stars, catalog, format)  # noqa: A001
    result, found = decided(
        instrument=instrument, requirements=requirements, galaxy_size=galaxy_size, galaxies=galaxies, mag=mag,
        bins=bins, step=step, psf=psf, pixel=pixel, pixel_scale=pixel_scale, jitter=jitter, estimator=estimator,
        n_stars=n_stars, binary_fraction=binary_fraction, cut=cut, l=l, b=b, catalog=catalog, format=format, map=map,
        options=options, band=band, seed=seed, multiplicity=multiplicity, photometry=photometry,
    )  # fmt: skip
    write_budget(result, output, plot)
    show(result, as_json, header_of(result, multiplicity), BUDGET_COLUMNS, budget_lines(found))


def correct(
    table: Annotated[
        Path | None,
        typer.Argument(help="Columns e1, e2, r2 [arcsec²], n_stars and more; or give one PSF by options."),
    ] = None,
    *,
    method: Annotated[
        str,
        typer.Option(help="predict; extrapolate (samples of stars); fields (low and high binary fraction)."),
    ] = "predict",
    e1: Annotated[float | None, typer.Option("--e1", help="Measured, of the PSF of one patch.")] = None,
    e2: Annotated[float | None, typer.Option("--e2", help="Measured, of the PSF of one patch.")] = None,
    r2: Annotated[float | None, typer.Option("--r2", help="Measured [arcsec²].")] = None,
    e1_error: Annotated[float | None, typer.Option("--e1-error", help="Standard error of e1.")] = None,
    e2_error: Annotated[float | None, typer.Option("--e2-error", help="Standard error of e2.")] = None,
    r2_error: Annotated[
        float | None, typer.Option("--r2-error", help="Standard error of r2 [arcsec²].")
    ] = None,
    n_stars: Annotated[int | None, typer.Option(help="From which that PSF is made.")] = None,
    nested: Annotated[
        bool, typer.Option("--nested", help="Each sample of stars is part of all larger ones.")
    ] = False,
    instrument: Annotated[
        str | None, typer.Option(help="euclid-vis, roman-h158, rubin, kcm16 or massey13.")
    ] = None,
    stars: Annotated[Path | None, typer.Option("--stars", help="Table as `porrima stars` writes it.")] = None,
    catalog: Catalogue = None,
    format: Format = None,  # noqa: A002
    map: Mapping = None,  # noqa: A002
    options: ReaderOptions = None,
    l: Longitude = None,
    b: Latitude = None,
    mag: Annotated[
        tuple[float, float] | None,
        typer.Option("--mag", help="Of the stars, where the table does not say.", metavar="LO HI"),
    ] = None,
    psf: Annotated[str | None, typer.Option("--psf", help="Name of the PSF; the instrument's.")] = None,
    pixel: Pixel = None,
    pixel_scale: PixelScale = None,
    jitter: Jitter = None,
    estimator: EstimatorName = "adaptive",
    binary_fraction: Annotated[
        float | None, typer.Option(help="0 to 1; as the model gives it if not given.")
    ] = None,
    galaxy_size: Annotated[
        float | None, typer.Option(help="Half-light radius of exponential galaxies [arcsec]; 0.3.")
    ] = None,
    galaxies: Annotated[
        str | None, typer.Option(help="Table, or {half_light_radius: R, scatter: S, index: N, ...}.")
    ] = None,
    multiplicity: MultiplicityName = "dk13",
    photometry: PhotometryName = "main-sequence",
    band: Band = None,
    cut: Annotated[float | None, typer.Option(help="Separation of resolved pairs [arcsec].")] = None,
    seed: Seed = 1,
    plot: Annotated[Path | None, typer.Option(help="Picture to write: PNG, PDF or SVG.")] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="ECSV file to write.")] = None,
    as_json: Json = False,
) -> None:
    """A measured PSF with the bias of unresolved binaries taken off, and what is left."""
    from porrima.receipt import CORRECT_COLUMNS, correct_header, correct_lines, write_correction
    from porrima.remedy import corrected

    catalog, format = table_of(stars, catalog, format)  # noqa: A001
    measured = {
        "e1": e1,
        "e2": e2,
        "r2": r2,
        "e1_error": e1_error,
        "e2_error": e2_error,
        "r2_error": r2_error,
    }
    result = corrected(
        table=table, measured=measured | {"n_stars": n_stars}, method=method, nested=nested, instrument=instrument,
        galaxy_size=galaxy_size, galaxies=galaxies, mag=mag, psf=psf, pixel=pixel, pixel_scale=pixel_scale,
        jitter=jitter, estimator=estimator, binary_fraction=binary_fraction, cut=cut, l=l, b=b, catalog=catalog,
        format=format, map=map, options=options, band=band, seed=seed, multiplicity=multiplicity,
        photometry=photometry,
    )  # fmt: skip
    write_correction(result, output, plot)
    show(result, as_json, correct_header(result), CORRECT_COLUMNS, correct_lines(result))
