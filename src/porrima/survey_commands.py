"""The commands about a survey's decisions: arguments in, one result out; no science here, heavy imports where used."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from porrima.options import (
    Band,
    BinaryFraction,
    Catalogue,
    Colour,
    EstimatorName,
    Folder,
    Format,
    GalaxySize,
    GalaxySizes,
    Instrument,
    Jitter,
    Json,
    Latitude,
    Longitude,
    Mag,
    Mapping,
    MultiplicityName,
    Output,
    PhotometryName,
    Pixel,
    PixelScale,
    Plot,
    ReaderOptions,
    Rejected,
    Seed,
    StarsTable,
    Survey,
    SurveyCut,
    SurveyPsf,
    table_of,
)  # fmt: skip
from porrima.terminal import show

__all__ = ["budget", "correct", "select"]


def budget(
    *,
    instrument: Instrument = None,
    requirements: Annotated[Path | None, typer.Option(help="YAML file: sigma_e, sigma_r2, m, c.")] = None,
    stars: StarsTable = None,
    catalog: Catalogue = None,
    format: Format = None,  # noqa: A002
    map: Mapping = None,  # noqa: A002
    options: ReaderOptions = None,
    l: Longitude = None,
    b: Latitude = None,
    mag: Mag = (16.0, 24.0),
    bins: Annotated[int | None, typer.Option(help="Equal bins of magnitude.")] = None,
    step: Annotated[float | None, typer.Option(help="Width of a bin [mag]; 1 if not given.")] = None,
    psf: SurveyPsf = None,
    pixel: Pixel = None,
    pixel_scale: PixelScale = None,
    jitter: Jitter = None,
    estimator: EstimatorName = "adaptive",
    n_stars: Annotated[int, typer.Option(help="From which the PSF of a patch is made.")] = 2000,
    binary_fraction: BinaryFraction = None,
    galaxy_size: GalaxySize = None,
    galaxies: GalaxySizes = None,
    multiplicity: MultiplicityName = "dk13",
    photometry: PhotometryName = "main-sequence",
    band: Band = None,
    cut: SurveyCut = None,
    selection: Rejected = None,
    colour: Colour = None,
    seed: Seed = 1,
    plot: Plot = None,
    output: Output = None,
    as_json: Json = False,
) -> None:
    """Share of a survey's requirements that unresolved binaries use, by magnitude."""
    from porrima.decision import decided
    from porrima.ledger import BUDGET_COLUMNS, budget_header, budget_lines, write_budget

    catalog, format = table_of(stars, catalog, format)  # noqa: A001
    result, found = decided(
        instrument=instrument, requirements=requirements, galaxy_size=galaxy_size, galaxies=galaxies, mag=mag,
        bins=bins, step=step, psf=psf, pixel=pixel, pixel_scale=pixel_scale, jitter=jitter, estimator=estimator,
        n_stars=n_stars, binary_fraction=binary_fraction, cut=cut, l=l, b=b, catalog=catalog, format=format, map=map,
        options=options, band=band, colour=colour, seed=seed, multiplicity=multiplicity, photometry=photometry,
        selection=selection,
    )  # fmt: skip
    write_budget(result, output, plot)
    show(result, as_json, budget_header(result, multiplicity), BUDGET_COLUMNS, budget_lines(found))


Patches = Annotated[
    Path | None,
    typer.Argument(help="Columns e1, e2, r2 [arcsec²], n_stars and more; or give one PSF by options."),
]
Method = Annotated[
    str, typer.Option(help="predict; extrapolate (samples of stars); fields (low and high binary fraction).")
]
Measured = Annotated[
    tuple[float, float, float] | None,
    typer.Option(help="Measured, of one patch; R2 in arcsec².", metavar="E1 E2 R2"),
]
MeasuredError = Annotated[
    tuple[float, float, float] | None, typer.Option(help="Standard errors.", metavar="E1 E2 R2")
]
MagOfAll = Annotated[
    tuple[float, float] | None,
    typer.Option("--mag", help="Of the stars, where the table does not say.", metavar="LO HI"),
]
Nested = Annotated[bool, typer.Option("--nested", help="Each sample of stars is part of all larger ones.")]


def correct(
    table: Patches = None,
    *,
    method: Method = "predict",
    shape: Measured = None,
    shape_error: MeasuredError = None,
    n_stars: Annotated[int | None, typer.Option(help="From which that PSF is made.")] = None,
    nested: Nested = False,
    instrument: Instrument = None,
    stars: StarsTable = None,
    catalog: Catalogue = None,
    format: Format = None,  # noqa: A002
    map: Mapping = None,  # noqa: A002
    options: ReaderOptions = None,
    l: Longitude = None,
    b: Latitude = None,
    mag: MagOfAll = None,
    psf: SurveyPsf = None,
    pixel: Pixel = None,
    pixel_scale: PixelScale = None,
    jitter: Jitter = None,
    estimator: EstimatorName = "adaptive",
    binary_fraction: BinaryFraction = None,
    galaxy_size: GalaxySize = None,
    galaxies: GalaxySizes = None,
    multiplicity: MultiplicityName = "dk13",
    photometry: PhotometryName = "main-sequence",
    band: Band = None,
    cut: SurveyCut = None,
    selection: Rejected = None,
    seed: Seed = 1,
    plot: Plot = None,
    output: Output = None,
    as_json: Json = False,
) -> None:
    """A measured PSF with the bias of unresolved binaries taken off, and what is left."""
    from porrima.receipt import CORRECT_COLUMNS, correct_header, correct_lines, write_correction
    from porrima.remedy import corrected

    catalog, format = table_of(stars, catalog, format)  # noqa: A001
    result = corrected(
        table=table, shape=shape, shape_error=shape_error, n_stars=n_stars, method=method, nested=nested,
        instrument=instrument, galaxy_size=galaxy_size, galaxies=galaxies, mag=mag, psf=psf, pixel=pixel,
        pixel_scale=pixel_scale, jitter=jitter, estimator=estimator, binary_fraction=binary_fraction, cut=cut, l=l, b=b,
        catalog=catalog, format=format, map=map, options=options, band=band, seed=seed, multiplicity=multiplicity,
        photometry=photometry, selection=selection,
    )  # fmt: skip
    write_correction(result, output, plot)
    show(result, as_json, correct_header(result), CORRECT_COLUMNS, correct_lines(result))


Clips = Annotated[
    list[float] | None,
    typer.Option("--clip", help="Largest own change of R2 over R2 to be tried; again for more. 19 of them."),
]
Exposed = Annotated[
    list[int] | None,
    typer.Option("--exposures", help="Of each star, to be tried; again for more. All the survey's."),
]
Sides = Annotated[str, typer.Option(help="Clip both sides, or upper: stars that look too large alone.")]
Centre = Annotated[str, typer.Option(help="Of the clip: stack (its own mean), or a known PSF.")]
Independent = Annotated[
    bool, typer.Option("--independent", help="Other exposures are stacked than are clipped.")
]
Weights = Annotated[str, typer.Option(help="Of stars: equal, or inverse-variance.")]
Corrected = Annotated[
    bool, typer.Option("--corrected", help="The predicted bias is taken off; models tell what is left.")
]
NoiseOf = Annotated[str, typer.Option("--noise", help="fitted, or measured by the estimator.")]
CatalogueArea = Annotated[float | None, typer.Option("--area", help="That a catalogue covers [deg²].")]
PatchArea = Annotated[
    float | None, typer.Option(help="Whose stars make one PSF [deg²]; the survey's field of view.")
]


def select(
    *,
    survey: Survey = None,
    requirements: Annotated[Path | None, typer.Option(help="YAML file: sigma_e, sigma_r2.")] = None,
    stars: StarsTable = None,
    catalog: Catalogue = None,
    format: Format = None,  # noqa: A002
    map: Mapping = None,  # noqa: A002
    options: ReaderOptions = None,
    area: CatalogueArea = None,
    l: Longitude = None,
    b: Latitude = None,
    mag: Mag = (16.0, 24.0),
    bins: Annotated[int | None, typer.Option(help="Equal bins of magnitude.")] = None,
    step: Annotated[float | None, typer.Option(help="Width of a bin [mag]; 1 if not given.")] = None,
    patch_area: PatchArea = None,
    exposures: Exposed = None,
    clip: Clips = None,
    sides: Sides = "both",
    centre: Centre = "stack",
    independent: Independent = False,
    weights: Weights = "equal",
    corrected: Corrected = False,
    noise: NoiseOf = "fitted",
    psf: SurveyPsf = None,
    pixel: Pixel = None,
    pixel_scale: PixelScale = None,
    jitter: Jitter = None,
    estimator: EstimatorName = "adaptive",
    binary_fraction: BinaryFraction = None,
    galaxy_size: GalaxySize = None,
    galaxies: GalaxySizes = None,
    multiplicity: MultiplicityName = "dk13",
    photometry: PhotometryName = "main-sequence",
    band: Band = None,
    cut: SurveyCut = None,
    seed: Seed = 1,
    output: Folder = None,
    as_json: Json = False,
) -> None:
    """Which stars make the best PSF: magnitudes, clip and exposures with the smallest error."""
    from porrima.advice import advised
    from porrima.notice import SELECT_COLUMNS, prepared, select_header, select_lines, write_advice

    catalog, format = table_of(stars, catalog, format)  # noqa: A001
    prepared(output)
    result = advised(
        survey=survey, requirements=requirements, mag=mag, bins=bins, step=step, area=area, patch_area=patch_area,
        exposures=exposures, clip=clip, sides=sides, centre=centre, independent=independent, weights=weights,
        corrected=corrected, noise=noise, psf=psf, pixel=pixel, pixel_scale=pixel_scale, jitter=jitter,
        estimator=estimator, binary_fraction=binary_fraction, galaxy_size=galaxy_size, galaxies=galaxies, cut=cut, l=l,
        b=b, catalog=catalog, format=format, map=map, options=options, band=band, seed=seed,
        multiplicity=multiplicity, photometry=photometry,
    )  # fmt: skip
    write_advice(result, output)
    show(result, as_json, select_header(result), SELECT_COLUMNS, select_lines(result))
