"""The commands: arguments in, one result out; no science here, and heavy imports only where used."""

from __future__ import annotations

import signal
import sys
import threading
import time
import warnings
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.exceptions import TyperException

from porrima.errors import InputError, RunError
from porrima.options import (
    Band,
    BinaryFraction,
    Catalogue,
    Colour,
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
    Psf,
    ReaderOptions,
    Rejected,
    Seed,
    table_of,
)  # fmt: skip
from porrima.survey_commands import budget, correct, select
from porrima.terminal import Progress, show

__all__ = ["app", "main"]

app = typer.Typer(
    help="What unresolved binary stars do to the PSF of a weak-lensing survey.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # a unit in brackets is no markup
    context_settings={"help_option_names": ["-h", "--help"]},
)

_INTERRUPTED = 130  # what typer makes of Ctrl-C


@app.command()
def stars(
    *,
    l: Longitude = None,
    b: Latitude = None,
    area: Annotated[float, typer.Option(help="Solid angle to fill [deg²].")] = 1.0,
    catalog: Catalogue = None,
    format: Format = None,  # noqa: A002
    map: Mapping = None,  # noqa: A002
    options: ReaderOptions = None,
    gaia: Annotated[
        bool, typer.Option("--gaia", help="Gaia DR3 around --l and --b, from its archive.")
    ] = False,
    radius: Annotated[float | None, typer.Option(help="Of the circle of --gaia [deg].")] = None,
    save: Annotated[Path | None, typer.Option(help="ECSV file for the archive's own table.")] = None,
    band: Band = None,
    mag: Mag = (16.0, 24.0),
    multiplicity: MultiplicityName = "dk13",
    seed: Seed = 1,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="ECSV file to write.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Picture to write: PNG, PDF or SVG.")] = None,
    as_json: Json = False,
) -> None:
    """Stars of the analytic Galaxy, of a real catalogue or of Gaia's archive, selected and counted."""
    from porrima.answers import COUNT_COLUMNS, count_lines, gaia_cone, population_config, stars_answer
    from porrima.catalogs import write_stars
    from porrima.io import write_figure
    from porrima.sample import catalog_of, draw_stars
    from porrima.star_figures import selection

    with gaia_cone(gaia, l, b, radius, mag, save, catalog) as cone:
        if cone is not None:
            l, b, catalog, format = None, None, cone, "gaia"  # noqa: A001
        config = population_config(
            l=l, b=b, catalog=catalog, format=format, map=map, options=options, band=band, mag=mag, seed=seed,
            multiplicity=multiplicity, area=area if catalog is None else None,
        )  # fmt: skip
        read = catalog_of(config)
    selected = draw_stars(config, read)
    law = config.multiplicity.build().companions(selected.mass, selected.metallicity)
    counts = selected.counts(mag, law.multiplicity_fraction[law.first])
    if output is not None:
        write_stars(selected, output)
    if plot is not None:
        write_figure(selection(selected), plot)
    result, header = stars_answer(selected, counts, read)
    show(result, as_json, header, [selected.band, *COUNT_COLUMNS], count_lines(counts))


@app.command()
def measure(
    table: Annotated[
        Path, typer.Argument(help="Columns flux_ratio, dx, dy [arcsec] and, optionally, weight.")
    ],
    psf: Psf,
    estimator: EstimatorName = "adaptive",
    method: Annotated[
        Literal["response", "images"], typer.Option(help="Moments, or GalSim images.")
    ] = "response",
    pixel: Pixel = None,
    pixel_scale: PixelScale = None,
    jitter: Jitter = None,
    as_json: Json = False,
) -> None:
    """Shape of one stack of the pairs in a table, and its change against the PSF without companions."""
    from porrima.io import read_systems
    from porrima.measurement import measured
    from porrima.psf import psf_from_name
    from porrima.shapes import estimator_from_name

    systems = read_systems(table)
    profile = psf_from_name(psf, pixel=pixel, pixel_scale=pixel_scale, jitter=jitter)
    result = measured(table, systems, profile, estimator_from_name(estimator), method)
    header = f"{len(systems)} systems, {psf}, {estimator}, {method}"
    show(result, as_json, header, ["quantity", "value"], [[k, v] for k, v in result.items()])


@app.command()
def predict(
    *,
    stars: Annotated[Path | None, typer.Option("--stars", help="Table as `porrima stars` writes it.")] = None,
    catalog: Catalogue = None,
    format: Format = None,  # noqa: A002
    map: Mapping = None,  # noqa: A002
    options: ReaderOptions = None,
    l: Longitude = None,
    b: Latitude = None,
    mag: Mag,
    psf: Psf,
    pixel: Pixel = None,
    pixel_scale: PixelScale = None,
    jitter: Jitter = None,
    estimator: EstimatorName = "adaptive",
    binary_fraction: BinaryFraction = None,
    n_stars: Annotated[int | None, typer.Option(help="In the stack; infinitely many if not given.")] = None,
    multiplicity: MultiplicityName = "dk13",
    photometry: PhotometryName = "main-sequence",
    band: Band = None,
    cut: Annotated[float, typer.Option(help="Separation from which a pair is resolved [arcsec].")] = 0.05,
    selection: Rejected = None,
    stack_weight: Annotated[str, typer.Option(help="equal, or flux.")] = "equal",
    colour: Colour = None,
    seed: Seed = 1,
    as_json: Json = False,
) -> None:
    """Bias and error of the PSF's shape in closed form."""
    from porrima.answers import PREDICTED_COLUMNS, population_config, predicted, predicted_lines
    from porrima.colour import chromatic
    from porrima.psf import psf_from_name
    from porrima.response import response
    from porrima.shapes import estimator_from_name

    catalog, format = table_of(stars, catalog, format)  # noqa: A001
    if n_stars is not None and n_stars < 1:
        raise InputError("must be at least 1", key="--n-stars", value=n_stars)
    config = population_config(
        l=l, b=b, catalog=catalog, format=format, map=map, options=options, band=band, mag=mag, seed=seed,
        multiplicity=multiplicity, photometry=photometry, cut=cut, selection=selection, stack_weight=stack_weight,
    )  # fmt: skip
    profile = psf_from_name(psf, pixel=pixel, pixel_scale=pixel_scale, jitter=jitter)
    method = estimator_from_name(estimator)
    waves = chromatic(psf, method, colour, pixel=pixel, jitter=jitter) if colour else None
    result = predicted(config, response(profile, method), binary_fraction, n_stars, waves)
    header = f"{result['n_catalog_stars']} stars, {psf}, {estimator}, {multiplicity}"
    show(result, as_json, header, PREDICTED_COLUMNS, predicted_lines(result))


app.command()(budget)
app.command()(correct)
app.command()(select)


@app.command()
def simulate(
    config: Annotated[Path | None, typer.Argument(help="YAML file; see --example.")] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Zarr store to make.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted run.")] = False,
    method: Annotated[
        Literal["moments", "images"], typer.Option(help="Moments, or GalSim images.")
    ] = "moments",
    device: Annotated[
        Literal["cpu", "cuda"], typer.Option(help="Where to draw: the processor or a GPU.")
    ] = "cpu",
    workers: Annotated[int | None, typer.Option(help="Processes of a local Dask cluster.", min=1)] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler.")] = None,
    chunk: Annotated[
        int | None, typer.Option(help="Stacks per chunk; 10000, or 100 of images.", min=1)
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Instead of that of the configuration.")] = None,
    example: Annotated[bool, typer.Option("--example", help="Print a configuration.")] = False,
    as_json: Json = False,
) -> None:
    """Many stacks of stars, some with companions: their kernel moments and shapes."""
    from porrima.config import EXAMPLE, RunConfig, load, parse

    if example:
        typer.echo(EXAMPLE, nl=False)
        return
    if config is None:
        raise InputError("is missing", key="CONFIG.yaml")
    if output is None:
        raise InputError("is missing", key="--output")
    if workers is not None and scheduler is not None:
        raise InputError("cannot be given together with --scheduler", key="--workers", value=workers)
    run = load(config)
    if seed is not None:
        run = parse(RunConfig, run.model_dump(exclude_unset=True) | {"seed": seed})
    from porrima.simulation import simulate as simulated

    start = time.perf_counter()
    with Progress(run.n_stacks, "stacks", ("stars", run.n_stars)) as progress:
        done = simulated(
            run, output, resume=resume, method=method, device=device, chunk=chunk, workers=workers,
            scheduler=scheduler, progress=progress.advance,
        )  # fmt: skip
    wall = time.perf_counter() - start
    result = {
        "n_stacks": run.n_stacks,
        "n_stars": run.n_stars,
        "wall_s": wall,
        "stars_per_s": done * run.n_stars / wall,
        "n_stacks_computed": done,
    }
    header = f"{output}: {run.n_stacks} stacks of {run.n_stars} stars"
    show(result, as_json, header, ["quantity", "value"], [[k, v] for k, v in result.items()])


@app.command()
def summary(
    run: Annotated[Path, typer.Argument(help="Zarr store of a run.", metavar="RUN.zarr")],
    bins: Annotated[int, typer.Option(help="Ranges of binary fraction.")] = 20,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="ECSV file to write.")] = None,
    as_json: Json = False,
) -> None:
    """Bias and error per range of binary fraction, with standard errors and predictions."""
    from porrima.answers import NUMBER_COLUMNS, number_lines
    from porrima.io import write_rows
    from porrima.store import open_run
    from porrima.summary import rows, summarise

    if bins < 1:
        raise InputError("must be at least 1", key="--bins", value=bins)
    result = rows(summarise(open_run(run), bins=bins))
    if output is not None:
        write_rows(result, output)
    failed = max((row["n_failed"] / row["n_stacks"] for row in result), default=0.0)
    if failed > 0:
        note = f"warning: up to {failed:.1%} of the stacks of a bin could not be measured and are left out, the widest"
        print(f"{note} pairs first: the numbers are low; use --method images", file=sys.stderr)
    show({"bins": result}, as_json, str(run), NUMBER_COLUMNS, number_lines(result))


@app.command()
def report(
    run: Annotated[Path, typer.Argument(help="Zarr store of a run.", metavar="RUN.zarr")],
    output: Annotated[Path, typer.Option("--output", "-o", help="HTML file to write.")],
    bins: Annotated[int, typer.Option(help="Ranges of binary fraction.")] = 20,
    as_json: Json = False,
) -> None:
    """One page about a run that needs no network: figure, numbers, methods, configuration, references."""
    from porrima.answers import NUMBER_COLUMNS, number_lines
    from porrima.experiments import numbers_of_run
    from porrima.findings import of_errors_and_biases
    from porrima.instruments import KCM16
    from porrima.report import write_run
    from porrima.store import open_run
    from porrima.summary import rows

    if bins < 1:
        raise InputError("must be at least 1", key="--bins", value=bins)
    parts = of_errors_and_biases(numbers_of_run(open_run(run), bins), KCM16)
    page = write_run(parts, run.resolve().name, output)
    numbers = rows(parts["summary"])
    result = {"report": str(page), "bins": numbers}
    show(result, as_json, f"report: {page}", NUMBER_COLUMNS, number_lines(numbers))


@app.command()
def paper(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for figures, tables and the report.")
    ],
    full: Annotated[bool, typer.Option("--full", help="At the paper's own number of stacks.")] = False,
    psf: Annotated[list[str] | None, typer.Option(help="Another PSF; again for more.")] = None,
    n_stars: Annotated[int | None, typer.Option(help="In a stack, instead of 40.")] = None,
    seed: Seed = 1,
    as_json: Json = False,
) -> None:
    """The paper's figures with their numbers, and one page about them; what is there already is used again."""
    from porrima.answers import NUMBER_COLUMNS, number_lines
    from porrima.claims import VERDICTS, claims_kept, claims_of, numbers_of
    from porrima.files import make_folder
    from porrima.machine import peak_memory
    from porrima.programme import carried_out, programme
    from porrima.report import write_paper
    from porrima.summary import rows
    from porrima.terminal import step

    experiments = programme(output, full=full, seed=seed, psf=tuple(psf) if psf else None, n_stars=n_stars)
    make_folder(output)
    start = time.perf_counter()
    results = dict(carried_out(experiments, output / "numbers", step))
    decided = claims_kept(results, output / "numbers")
    claims = claims_of(decided)
    page = write_paper(results, output, claims, numbers_of(decided))
    first = results["errors_and_biases"]
    result = {
        "report": str(page),
        "n_stacks": int(first["findings"]["n_stacks"]),
        "n_stars": first["curves"].attrs["n_stars"],
        "n_stars_drawn": sum(one.size for one in experiments if one.unit == "stars"),
        "verdicts": {verdict: [one["verdict"] for one in claims].count(verdict) for verdict in VERDICTS},
        "wall_s": time.perf_counter() - start,
        "peak_memory_mb": peak_memory(),
    }
    near = [row for row in rows(first["summary"]) if row["f_lo"] <= 0.35 < row["f_hi"]]
    counts = ", ".join(f"{verdict}: {count}" for verdict, count in result["verdicts"].items() if count)
    show(result, as_json, f"report: {page}; statements: {counts}", NUMBER_COLUMNS, number_lines(near))


@app.command()
def bench(
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder: numbers, figure, tables.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Half a minute instead of three.")] = False,
    seed: Seed = 1,
    as_json: Json = False,
) -> None:
    """How fast the engine is, beside GalSim, numpy and its own random numbers, all in one run."""
    from porrima.bench import FULL, QUICK, n_steps
    from porrima.bench import bench as measured
    from porrima.files import make_folder
    from porrima.performance import lines, write_performance

    if output is not None:
        make_folder(output)
    sizes = QUICK if quick else FULL
    with Progress(n_steps(sizes), "steps") as progress:
        result = measured(sizes, seed=seed, progress=progress.advance)
    if output is not None:
        write_performance(result, output)
    show(result, as_json, f"speed, {result['versions']}", ["quantity", "value", "unit"], lines(result))


@app.command()
def response(
    psf: Annotated[list[str], typer.Option(help="Name of a PSF; again for more. roman: 18 SCAs, 4 bands.")],
    estimator: Annotated[
        list[str] | None, typer.Option(help="adaptive, plain, plain:R, gaussian:S; again for more.")
    ] = None,
    pixel: Annotated[float | None, typer.Option(help="Side of a pixel to add [arcsec].")] = None,
    pixel_scale: Annotated[float | None, typer.Option(help="Of a FITS image [arcsec].")] = None,
    jitter: Annotated[float | None, typer.Option(help="Sigma of a Gaussian to add [arcsec].")] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Folder: table and figure.")] = None,
    as_json: Json = False,
) -> None:
    """What an estimator makes of companions behind a PSF: kappa, ellipticity, every derivative."""
    from porrima.kappa import COLUMNS, expanded, responses, row, shown, write_responses

    names, estimators = expanded(psf), estimator or ["adaptive"]
    with Progress(len(names) * len(estimators), "responses") as progress:
        found = responses(
            names, estimators, progress.advance, pixel=pixel, pixel_scale=pixel_scale, jitter=jitter
        )
    if output is not None:
        write_responses(found, output)
    rows = [row(one) for one in found]
    show(shown(found), as_json, "responses", COLUMNS, [[r[name] for name in COLUMNS] for r in rows])


@app.command()
def toy(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the figure and its numbers.")],
    psf_fwhm: Annotated[float, typer.Option(help="Of the Gaussian PSF [arcsec].")] = 0.137,
    ellipticity: Annotated[float, typer.Option(help="Of the PSF, along e1 and along e2.")] = 0.05,
    points: Annotated[int, typer.Option(help="Along a side of the pixel, odd.", min=3, max=401)] = 61,
    as_json: Json = False,
) -> None:
    """Maps of the paper's toy model: one companion anywhere in the central pixel."""
    from porrima.toy import write_toy

    result = write_toy(output, fwhm=psf_fwhm, ellipticity=ellipticity, points=points)
    table = [[key, value] for key, value in result.items() if key != "contrasts"]
    table += [[f"{k}, delta_m {c['delta_m']:g}", v] for c in result["contrasts"] for k, v in c.items()]
    show(result, as_json, f"figure: {result['figure']}", ["quantity", "value"], table)


def main() -> None:
    """Run a command; wrong input ends in one line and exit code 2.

    Returns
    -------
    None
        The process exits.
    """
    arguments = sys.argv[1:] or ["--help"]
    warnings.showwarning = lambda message, *_: print(f"warning: {message}", file=sys.stderr)
    unraisable, sys.unraisablehook = sys.unraisablehook, _interrupt_again
    try:
        code = typer.main.get_command(app).main(arguments, prog_name="porrima", standalone_mode=False)
    except InputError as error:
        code = _fail(str(error), 2)
    except RunError as error:
        code = _fail(str(error), 1)
    except TyperException as error:
        code = _fail(error.format_message(), 2)
    except (KeyboardInterrupt, typer.Abort):
        code = _INTERRUPTED
    finally:
        sys.unraisablehook = unraisable
    if code == _INTERRUPTED:
        code = _fail("interrupted; --resume goes on with a run", 1)
    sys.exit(code if isinstance(code, int) else 0)


def _interrupt_again(lost: Any) -> None:
    """A Ctrl-C that came where no exception can be raised, as while compiled code is being loaded, comes again."""
    if lost.exc_type is KeyboardInterrupt:
        main_thread = threading.main_thread().ident or 0
        threading.Timer(0.1, signal.pthread_kill, (main_thread, signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(lost)


def _fail(message: str, code: int) -> int:
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    return code
