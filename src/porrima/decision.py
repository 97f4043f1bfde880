"""What `budget` shows and writes: from the options of the command to shares, verdicts and ranges of magnitude."""

from __future__ import annotations

import itertools
import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from porrima.answers import population_config
from porrima.budget import CUTS, Setting, budget
from porrima.config import GalaxiesConfig, known, load_requirement, parse
from porrima.deconvolution import fit_response
from porrima.errors import InputError
from porrima.galaxies import Galaxies, r2_of_half_light
from porrima.instruments import REQUIREMENTS, SURVEYS, Requirement, Survey
from porrima.io import read_galaxies, write_figure, write_rows
from porrima.prediction import SeriesWarning
from porrima.psf import psf_from_name
from porrima.resolution import seen_by_regauss
from porrima.response import response
from porrima.sample import draw_stars
from porrima.shapes import Adaptive, Plain, estimator_from_name
from porrima.shares import GROUPS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from porrima.budget import Budget
    from porrima.config import PopulationConfig
    from porrima.psf import PSF
    from porrima.shapes import Estimator
    from porrima.shares import Interval, MagnitudeBin, Share
    from porrima.stars import Stars

__all__ = [
    "BUDGET_COLUMNS",
    "budget_answer",
    "budget_lines",
    "galaxies_of",
    "header_of",
    "magnitude_bins",
    "survey_of",
    "write_budget",
]

GALAXY_SIZE = 0.3
"""Half-light radius of the exponential galaxies that are taken where none are given, in arcsec."""

MOST_BINS = 200
"""Bins of magnitude that one budget may have (count)."""

N_DRAWN = 2_000
"""Stars drawn from the analytic Galaxy in each bin of magnitude (count)."""

RUBIN_PSF = Path(__file__).parent / "data" / "rubin.yaml"
"""Where the stanza of the PSF that is called ``rubin`` is."""

FORMATS = (".png", ".pdf", ".svg")
"""Endings that a figure may have."""

_FEWEST_DIGITS = 1e-12  # a bias below it is the rounding of 0


def survey_of(instrument: str | None, requirements: Path | None) -> tuple[Survey, Requirement]:
    """Survey of a name, and the requirements that a budget is held against.

    Parameters
    ----------
    instrument : str or None
        A key of `instruments.SURVEYS`.
    requirements : Path or None
        A YAML file instead of, or beside, the survey's own.

    Returns
    -------
    survey, requirement : Survey, Requirement
        ``kcm16`` gives the PSF where only a file is given.

    Raises
    ------
    InputError
        If neither is given, there is no such survey, or the file is wrong.
    """
    if instrument is None and requirements is None:
        names = ", ".join(REQUIREMENTS)
        raise InputError(f"must be one of {names}, or --requirements FILE.yaml be given", key="--instrument")
    survey = known("--instrument", instrument or "kcm16", SURVEYS)
    if requirements is None:
        return survey, survey.requirement
    return survey, Requirement(**load_requirement(requirements).model_dump())


def galaxies_of(size: float | None, text: str | None) -> Galaxies:
    """Galaxies from the options of a command.

    Parameters
    ----------
    size : float or None
        Half-light radius of exponential galaxies, in arcsec.
    text : str or None
        The keys of `config.GalaxiesConfig` as YAML, or the name of a table.

    Returns
    -------
    galaxies : Galaxies
        `GALAXY_SIZE` where nothing is given.

    Raises
    ------
    InputError
        If both are given, or there are no galaxies, or one is of no good.
    """
    if size is not None and text is not None:
        raise InputError("cannot be given together with --galaxies", key="--galaxy-size", value=size)
    if text is None:
        size = GALAXY_SIZE if size is None else size
        if not 0 < size < math.inf:
            raise InputError("must be positive and finite [arcsec]", key="--galaxy-size", value=size)
        return Galaxies.sersic(size, 1.0)
    data: Any = {"file": text}
    if text.lstrip().startswith("{"):
        try:
            data = yaml.safe_load(text)
        except yaml.YAMLError:
            raise InputError("must be a table or {key: value, ...}", key="--galaxies", value=text) from None
    config = parse(GalaxiesConfig, data, source=Path("--galaxies"))
    if config.file is not None:
        return read_galaxies(config.file, config.index, config.mean_e2, config.smallest)
    ratio = r2_of_half_light(config.index)
    return Galaxies.log_normal(
        ratio * (config.half_light_radius or 0.0) ** 2,
        2 * config.scatter,
        smallest_r2=ratio * config.smallest**2,
        index=config.index,
        mean_e2=config.mean_e2,
    )


def magnitude_bins(
    mag: tuple[float, float], n_bins: int | None, step: float | None
) -> list[tuple[float, float]]:
    """Bins of magnitude, each half-open.

    Parameters
    ----------
    mag : (float, float)
        Whole range, in mag.
    n_bins : int or None
        Number of equal bins (count).
    step : float or None
        Width of each, in mag; the last may be narrower.

    Returns
    -------
    bins : list of (float, float)
        One mag each where neither is given.

    Raises
    ------
    InputError
        If both are given, or one is not positive, or there are more than `MOST_BINS`.
    """
    low, high = mag
    if n_bins is not None and step is not None:
        raise InputError("cannot be given together with --step", key="--bins", value=n_bins)
    if n_bins is not None and n_bins < 1:
        raise InputError("must be at least 1", key="--bins", value=n_bins)
    if step is not None and not 0 < step < math.inf:
        raise InputError("must be positive and finite [mag]", key="--step", value=step)
    if not -50 <= low < high <= 50:
        raise InputError("must be LO HI with LO < HI, within -50 to 50", key="--mag", value=f"{low} {high}")
    count = n_bins if n_bins is not None else math.ceil((high - low) / (step or 1.0) - 1e-9)
    if count > MOST_BINS:
        raise InputError(f"must make at most {MOST_BINS} bins", key="--step", value=count)
    if n_bins is None:
        edges = np.append(low + (step or 1.0) * np.arange(count), high)
    else:
        edges = np.linspace(low, high, count + 1)
    rounded = [round(float(edge), 9) for edge in edges]
    return list(itertools.pairwise(rounded))


def budget_answer(
    survey: Survey,
    requirement: Requirement,
    galaxies: Galaxies,
    bins: Sequence[tuple[float, float]],
    *,
    psf: str | None,
    pixel: float | None,
    pixel_scale: float | None,
    jitter: float | None,
    estimator: str,
    n_stars: int,
    binary_fraction: float | None,
    cut: float | None,
    **options: Any,
) -> tuple[dict[str, Any], Budget]:
    """What `budget` shows: the keys of the contract, and the budget itself.

    Parameters
    ----------
    survey : Survey
        Gives PSF and cut where they are not given.
    requirement : Requirement
        What must be met.
    galaxies : Galaxies
        Whose shear is measured.
    bins : sequence of (float, float)
        Of magnitude, in mag.
    psf, estimator : str
        Names.
    pixel, pixel_scale, jitter, cut : float or None
        In arcsec.
    n_stars : int
        From which the PSF of a patch is made (count).
    binary_fraction : float or None
        In [0, 1]; None for the model's own.
    options : dict
        Of `answers.population_config`.

    Returns
    -------
    answer, budget : dict, Budget
        Dimensionless, mag, arcsec.

    Raises
    ------
    InputError
        If an option is wrong, a bin holds no star, or the cut is too wide for kernel moments.
    """
    if n_stars < 1:
        raise InputError("must be at least 1", key="--n-stars", value=n_stars)
    if binary_fraction is not None and not 0 <= binary_fraction <= 1:
        raise InputError("must be in [0, 1]", key="--binary-fraction", value=binary_fraction)
    config = population_config(
        **options, mag=(bins[0][0], bins[-1][1]), cut=survey.cut if cut is None else cut
    )
    method = estimator_from_name(estimator)
    profile = _profile(survey, psf, pixel, pixel_scale, jitter)
    parts = _stars_of(config, bins)
    setting = Setting(
        requirement=requirement,
        response=response(profile, method),
        n_stars=n_stars,
        multiplicity=config.multiplicity.build(),
        photometry=config.photometry.build(),
        cut=config.cut,
        binary_fraction=binary_fraction,
        fit=fit_response(profile, galaxies),
        seen=_seen(method, galaxies, profile),
    )
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = budget(setting, parts)
    for text in dict.fromkeys(str(one.message) for one in said):
        warnings.warn(text, SeriesWarning, stacklevel=2)
    return _answer(found, profile, estimator, galaxies), found


def _profile(
    survey: Survey, psf: str | None, pixel: float | None, pixel_scale: float | None, jitter: float | None
) -> PSF:
    """PSF that was asked for, or the survey's."""
    if psf is not None:
        return psf_from_name(psf, pixel=pixel, pixel_scale=pixel_scale, jitter=jitter)
    own: dict[str, Any] = {
        "pixel": pixel or survey.pixel,
        "pixel_scale": pixel_scale,
        "jitter": jitter or survey.jitter,
    }
    if survey.psf == "rubin":
        found = psf_from_name(str(RUBIN_PSF), **own)
        return replace(found, name=found.name.replace(str(RUBIN_PSF), survey.psf))
    return psf_from_name(survey.psf, **own)


def _stars_of(
    config: PopulationConfig, bins: Sequence[tuple[float, float]]
) -> list[tuple[tuple[float, float], Stars]]:
    """Stars of each bin: of a catalogue those that are there, of the Galaxy as many in each."""
    where = config.stars
    whole = draw_stars(config) if where.catalog is not None else None
    parts = []
    for mag in bins:
        if whole is not None:
            stars = whole.select(magnitude=mag)
        else:
            one = where.model_copy(update={"mag": mag, "n_drawn": N_DRAWN})
            stars = draw_stars(config.model_copy(update={"stars": one}))
        if not len(stars):
            rule = f"no star with magnitude in [{mag[0]:g}, {mag[1]:g}): choose other bins"
            raise InputError(rule, source=where.catalog, key="mag")
        parts.append((mag, stars))
    return parts


def _seen(estimator: Estimator, galaxies: Galaxies, psf: PSF) -> Galaxies | None:
    """Sizes as a method that subtracts moments sees them; None where there is no such method."""
    if isinstance(estimator, Plain):
        return galaxies
    return seen_by_regauss(galaxies, psf) if isinstance(estimator, Adaptive) else None


def _answer(found: Budget, psf: PSF, estimator: str, galaxies: Galaxies) -> dict[str, Any]:
    setting = found.setting
    requirement, shape = setting.requirement, setting.response.shape0
    return {
        "requirement": requirement.name,
        "source": requirement.source,
        "required_sigma_e": requirement.sigma_e,
        "required_sigma_r2": requirement.sigma_r2,
        "required_m": requirement.m,
        "required_c": requirement.c,
        "psf": psf.name,
        "estimator": estimator,
        "r2_0": float(shape.r2),
        "e1_0": float(shape.e1),
        "e2_0": float(shape.e2),
        "cut": setting.cut,
        "n_stars": setting.n_stars,
        "binary_fraction": setting.binary_fraction,
        "galaxy_index": galaxies.index,
        "galaxy_inverse_r2": galaxies.inverse_r2,
        "kappa_gal": None if setting.fit is None else setting.fit.kappa_m,
        "seen_inverse_r2": None if setting.seen is None else setting.seen.inverse_r2,
        "bins": [_bin_row(one) for one in found.bins],
        "verdicts": [_verdict_row(one, group) for one in found.bins for group in found.groups],
        "shares": [_share_row(one, share) for one in found.bins for share in one.shares],
        "ranges": [
            {"group": group, "mag_lo": low, "mag_hi": high}
            for group in found.groups
            for low, high in found.ranges(group)
        ],
    }


def _place(one: MagnitudeBin) -> dict[str, Any]:
    return {"mag_lo": one.magnitude[0], "mag_hi": one.magnitude[1]}


def _bin_row(one: MagnitudeBin) -> dict[str, Any]:
    low, high = one.uncertainty.interval("eta")
    moments = one.uncertainty.prediction.population
    source, change = one.uncertainty.ranking()[0]
    return _place(one) | {
        "n_catalog_stars": one.n_catalog_stars,
        "population_binary_fraction": float(moments.binary_fraction[0]),
        "mean_x": float(moments.mean_x[0]),
        "eta": float(one.uncertainty.prediction.eta[0]),
        "eta_low": low,
        "eta_high": high,
        "largest_source": source,
        "largest_change": change,
    }


def _verdict_row(one: MagnitudeBin, group: str) -> dict[str, Any]:
    worst = one.worst(group)
    share = worst.share
    return _place(one) | {
        "group": group,
        "quantity": worst.quantity,
        "share": None if share is None else share.value,
        "share_low": None if share is None else share.low,
        "share_high": None if share is None else share.high,
        "verdict": worst.verdict,
        "n_stars_needed": one.n_stars(group),
        "widest_cut": one.widest_cut[group],
    }


def _share_row(one: MagnitudeBin, share: Share) -> dict[str, Any]:
    row = _place(one) | {"group": share.group, "quantity": share.quantity, "required": share.required}
    parts: dict[str, Interval] = {"bias": share.bias, "scatter": share.scatter, "total": share.total}
    for name, interval in parts.items():
        row |= {f"{name}{end}": v for end, v in zip(("", "_low", "_high"), interval, strict=True)}
        row[f"{name}_share"] = None if share.required is None else abs(interval.value) / share.required
    row["verdict"] = share.verdict
    ends = zip(("", "_low", "_high"), share.n_stars, strict=True)
    return row | {f"n_stars_needed{end}": value for end, value in ends}


BUDGET_COLUMNS = [
    "mag", "10⁴ η", "by", "e1", "e2", "r2", "m", "c1", "c2", "verdict", "stars needed", "widest cut [arcsec]",
]  # fmt: skip
"""Heads of the table for the terminal; of each quantity, percent of the requirement, bias then total."""


def budget_lines(found: Budget) -> list[list[Any]]:
    """Lines of a budget for the terminal, one for each range of magnitude and group.

    Parameters
    ----------
    found : Budget
        Dimensionless.

    Returns
    -------
    lines : list of list
        Under `BUDGET_COLUMNS`.
    """
    lines, end = [], found.setting.cut * CUTS[-1] * (1 - 1e-9)
    for one in found.bins:
        low, high = (1e4 * end for end in one.uncertainty.interval("eta"))
        eta = f"{1e4 * one.uncertainty.prediction.eta[0]:.2f} ({low:.2f}-{high:.2f})"
        for number, group in enumerate(found.groups):
            of = {s.quantity: s for s in one.required(group)}
            cells = [_percent(of.get(q)) for q in (*GROUPS["psf"], *GROUPS["fit"])]
            needed, cut = one.n_stars(group), one.widest_cut[group]
            first = [f"{one.magnitude[0]:g}-{one.magnitude[1]:g}", eta] if not number else ["", ""]
            stars = "none" if math.isinf(needed) else f"{needed:.0f}"
            widest = "none" if math.isnan(cut) else f"{'>' if cut > end else ''}{cut:.3f}"
            lines.append([*first, group, *cells, one.worst(group).verdict or "", stars, widest])
    return lines


def _percent(share: Share | None) -> str:
    """Bias and total of a quantity in percent of its requirement."""
    if share is None or share.required is None:
        return ""
    of = 100 / share.required
    bias = 0.0 if abs(share.bias.value) < _FEWEST_DIGITS else abs(share.bias.value) * of
    return f"{bias:.0f} / {share.total.value * of:.0f} %"


def header_of(answer: dict[str, Any], multiplicity: str) -> str:
    """Lines above the table on the terminal.

    Parameters
    ----------
    answer : dict
        From `budget_answer`.
    multiplicity : str
        As given.

    Returns
    -------
    header : str
        What is required, of what, and what the cells are; lengths in arcsec.
    """
    limits = [
        f"{name} {answer[f'required_{name}']:g}"
        for name in ("sigma_e", "sigma_r2", "m", "c")
        if answer[f"required_{name}"] is not None
    ]
    return (
        f"{answer['requirement']}: {', '.join(limits)} ({answer['source']})\n"
        f"{answer['psf']}, {answer['estimator']}, {multiplicity}, cut {answer['cut']:g} arcsec, "
        f"{answer['n_stars']} stars for the PSF of a patch\n"
        "cells: bias / rms error, in percent of the requirement; psf: its shape; fit, moments: shear by that method"
    )


def write_budget(answer: dict[str, Any], table: Path | None, picture: Path | None) -> None:
    """Shares as a table (ECSV) and as a figure.

    Parameters
    ----------
    answer : dict
        From `budget_answer`, dimensionless and mag.
    table, picture : Path or None
        Files to write; none where not given.

    Returns
    -------
    None
        The result is the files.

    Raises
    ------
    InputError
        If one cannot be written.
    """
    if picture is not None and picture.suffix not in FORMATS:
        raise InputError(f"must end in {', '.join(FORMATS)}", key="plot", value=picture)
    if table is not None:
        empty = {"required": math.nan, "verdict": ""}
        rows = [
            {key: empty.get(key, math.nan) if value is None else value for key, value in row.items()}
            for row in answer["shares"]
        ]
        write_rows(rows, table)
    if picture is not None:
        from porrima.diagrams import budget_shares  # noqa: PLC0415  (slow to import, where used)

        write_figure(budget_shares(answer), picture)
