"""The report: one page that needs no network, and the figure and table beside it, from saved numbers only."""

from __future__ import annotations

import io
import math
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from porrima import __version__
from porrima.figures import effect_of_n_stars, errors_and_biases
from porrima.files import write_whole
from porrima.instruments import KCM16
from porrima.io import write_figure, write_rows
from porrima.summary import rows

if TYPE_CHECKING:
    from pathlib import Path

    import xarray as xr
    from matplotlib.figure import Figure

    from porrima.experiments import EffectOfNStars, ErrorsAndBiases

__all__ = ["write_report"]

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Porrima: errors and biases of the PSF from unresolved binary stars</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #1b1b1b;
  background: #fff; }}
figure {{ margin: 1.5rem 0; }} figure svg {{ max-width: 100%; height: auto; background: #fff; }}
.wide {{ overflow-x: auto; }}
table {{ border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums; }}
th, td {{ padding: 0.2rem 0.7rem; text-align: right; border-bottom: 1px solid #ddd; white-space: nowrap; }}
caption {{ text-align: left; padding-bottom: 0.4rem; }}
pre {{ background: #f4f4f4; padding: 0.8rem; white-space: pre-wrap; overflow-wrap: anywhere; }}
</style>
</head>
<body>
<main>
<h1>Errors and biases of the PSF from unresolved binary stars</h1>
<p>{answer}</p>
<figure>
{figure}
<figcaption>Error (left) and bias (right) of the size and the two ellipticity components of a stack of {n_stars} stars,
{mag} mag in {band}, against the binary fraction of the population, after Kuntzer, Courbin &amp; Meylan (2016), Fig. 4.
Symbols: {n_stacks} simulated stacks with standard errors; the PSFs are set apart a little. Solid: closed form for
{n_stars} stars. Dashed: closed form for infinitely many stars. The PSFs share
the stacks, and so their scatter. Dotted: requirement of {requirement}.</figcaption>
</figure>
<h2>Simulation against prediction</h2>
<p>{agreement}</p>
<div class="wide">{table}</div>
<h2>Number of stars in a stack</h2>
<figure>
{second_figure}
<figcaption>Error of the two ellipticity components of stacks of {n_stars_list} stars, after Kuntzer, Courbin &amp;
Meylan (2016), Fig. 5. Symbols: {n_stacks_each} simulated stacks of each, with standard errors; one set of stacks stands
behind both PSFs. Solid: closed form. Dashed: closed form for infinitely many stars, the bias that no number of stars
takes away. Dotted: requirement.</figcaption>
</figure>
<p>{second_agreement}</p>
<p>The whole tables are in <code>errors_and_biases.ecsv</code> and <code>effect_of_n_stars.ecsv</code>, the stacks in
the Zarr stores beside them.</p>
<h2>How it was made</h2>
<p>Stars: {stars}. {pairs}</p>
<pre>{config}</pre>
<p>Porrima {version}. Models: Kuntzer, Courbin &amp; Meylan 2016 (arXiv:1512.01549); Duch&ecirc;ne &amp; Kraus 2013;
Robin et al. 2003; Bressan et al. 2012.</p>
</main>
</body>
</html>
"""


def write_report(numbers: ErrorsAndBiases, of_n_stars: EffectOfNStars, folder: Path) -> Path:
    """Path of the page written, with the figures (SVG, PDF, PNG) and the tables (ECSV) beside it.

    Parameters
    ----------
    numbers : ErrorsAndBiases
        From `experiments.errors_and_biases`.
    of_n_stars : EffectOfNStars
        From `experiments.effect_of_n_stars`.
    folder : Path
        Where to write; it exists.

    Returns
    -------
    page : Path
        ``index.html`` in the folder.
    """
    figures = {
        "errors_and_biases": errors_and_biases(numbers.summary, numbers.curves, numbers.limit, KCM16),
        "effect_of_n_stars": effect_of_n_stars(of_n_stars.numbers, of_n_stars.limit, KCM16),
    }
    for name, figure in figures.items():
        for suffix in ("svg", "pdf", "png"):
            write_figure(figure, folder / f"{name}.{suffix}")
    write_rows(rows(numbers.summary), folder / "errors_and_biases.ecsv")
    by_n_stars = [
        {"n_stars": int(n)} | row
        for n in of_n_stars.numbers["n_stars"].to_numpy()
        for row in rows(of_n_stars.numbers.sel(n_stars=n))
    ]
    write_rows(by_n_stars, folder / "effect_of_n_stars.ecsv")
    page = folder / "index.html"
    text = _page(numbers, of_n_stars.numbers, *figures.values())
    write_whole(page, lambda path: path.write_text(text, encoding="utf-8"))
    return page


def _svg(figure: Figure) -> str:
    """A figure as it stands in a page."""
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :]


def _page(numbers: ErrorsAndBiases, of_n_stars: xr.Dataset, figure: Figure, second_figure: Figure) -> str:
    config = numbers.config
    where = config.stars
    stars = (
        f"l = {where.l:g}°, b = {where.b:g}° of the analytic Galaxy"
        if where.catalog is None
        else str(where.catalog)
    )
    return _PAGE.format(
        answer=_answer(numbers),
        figure=_svg(figure),
        second_figure=_svg(second_figure),
        n_stars_list=", ".join(str(n) for n in of_n_stars["n_stars"].to_numpy()),
        n_stacks_each=f"{of_n_stars.attrs['n_stacks']:,}".replace(",", " "),
        second_agreement=_agreement(of_n_stars),
        n_stars=config.n_stars,
        n_stacks=f"{config.n_stacks:,}".replace(",", " "),
        mag=f"{where.mag[0]:g} to {where.mag[1]:g}",
        band=escape(where.band or "i"),
        requirement=escape(KCM16.source),
        agreement=_agreement(numbers.summary),
        table=_table(numbers.summary),
        stars=escape(stars),
        pairs=f"At a binary fraction of 0.35, {numbers.removed_fraction:.0%} of the pairs are resolved and removed.",
        config=escape(config.model_dump_json(exclude_none=True, indent=1)),
        version=__version__,
    )


def _answer(numbers: ErrorsAndBiases) -> str:
    limit = numbers.limit.isel(psf=0).sel(quantity="r2").interp(binary_fraction=0.35)
    required = KCM16.sigma_r2 or math.inf
    share = float(limit["bias"]) / required
    models = f"{numbers.config.multiplicity.model}, {numbers.config.estimator} moments"
    return (
        f"With 35 % binaries the mean of x = f r²/(1 + f)² over the stars is {_power(numbers.mean_x)} arcsec², and the "
        f"PSF of a stack comes out larger by {_power(float(limit['bias']))} ({models}): "
        f"{share:.0%} of the size requirement of {_power(required)}. More stars in the stack lower the scatter, "
        "not this bias."
    )


def _power(value: float) -> str:
    """Number as a reader of print expects it, with three figures."""
    mantissa, exponent = f"{value:.2e}".split("e")
    return f"{mantissa} × 10<sup>{int(exponent)}</sup>".replace("-", "−")


def _agreement(summary: xr.Dataset) -> str:
    pulls = {
        name: np.abs((summary[name] - summary[f"prediction_{name}"]) / summary[f"{name}_se"]).max().item()
        for name in ("bias", "sigma", "sd")
    }
    checked = int(np.isfinite(summary["bias"]).sum()) * len(pulls)
    worst = ", ".join(f"{name} {pull:.1f}" for name, pull in pulls.items())
    failed = float((summary["n_failed"].sum("bin") / summary["n_stacks"].sum("bin")).max())
    lost = f" {failed:.1%} of the stacks could not be measured and are left out." if failed > 0 else ""
    return f"Largest difference of {checked} numbers, in standard errors of the simulation: {worst}.{lost}"


def _table(summary: xr.Dataset) -> str:
    names = ("bias", "sigma", "sd")
    heads = ("PSF", "quantity", "binary fraction", "stacks", *(h for n in names for h in (n, "predicted")))
    head = "".join(f"<th scope='col'>{name}</th>" for name in heads)
    body = "".join(
        f"<tr><td>{escape(row['psf'])}</td><td>{row['quantity']}</td>"
        f"<td>{row['f_lo']:.2f}–{row['f_hi']:.2f}</td><td>{row['n_stacks']}</td>"
        + "".join(
            f"<td>{_with_error(row[name], row[f'{name}_se'])}</td><td>{row[f'prediction_{name}'] * 1e3:.4f}</td>"
            for name in names
        )
        + "</tr>\n"
        for row in rows(summary)
    )
    caption = "<caption>Per PSF, quantity and bin, in units of 10<sup>−3</sup></caption>"
    return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _with_error(value: float, error: float) -> str:
    return f"{value * 1e3:.4f} ± {error * 1e3:.4f}"
