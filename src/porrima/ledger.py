"""What `budget` shows and writes: shares, verdicts and ranges of magnitude as rows, lines, a table and a figure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from porrima.budget import CUTS
from porrima.io import write_rows_and_figure
from porrima.shares import GROUPS

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.figure import Figure

    from porrima.budget import Budget
    from porrima.galaxies import Galaxies
    from porrima.shares import Interval, MagnitudeBin, Share

__all__ = ["BUDGET_COLUMNS", "budget_answer", "budget_header", "budget_lines", "write_budget"]

_FEWEST_DIGITS = 1e-12  # a bias below it is the rounding of 0


def budget_answer(found: Budget, psf: str, estimator: str, galaxies: Galaxies) -> dict[str, Any]:
    """The keys of the contract.

    Parameters
    ----------
    found : Budget
        Dimensionless.
    psf, estimator : str
        Their names.
    galaxies : Galaxies
        Whose shear is measured.

    Returns
    -------
    answer : dict
        Dimensionless, mag, arcsec.
    """
    premises = found.premises
    requirement, shape = premises.requirement, premises.response.shape0
    return {
        "requirement": requirement.name,
        "source": requirement.source,
        "required_sigma_e": requirement.sigma_e,
        "required_sigma_r2": requirement.sigma_r2,
        "required_m": requirement.m,
        "required_c": requirement.c,
        "psf": psf,
        "estimator": estimator,
        "r2_0": float(shape.r2),
        "e1_0": float(shape.e1),
        "e2_0": float(shape.e2),
        "cut": premises.cut,
        "n_stars": premises.n_stars,
        "binary_fraction": premises.binary_fraction,
        "galaxy_index": galaxies.index,
        "galaxy_inverse_r2": galaxies.inverse_r2,
        "kappa_gal": None if premises.fit is None else premises.fit.kappa_m,
        "seen_inverse_r2": None if premises.seen is None else premises.seen.inverse_r2,
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
    moments, models = one.uncertainty.prediction.population, one.uncertainty.models
    source, change = one.uncertainty.ranking()[0]
    return _place(one) | {
        "n_catalog_stars": one.n_catalog_stars,
        "population_binary_fraction": float(moments.binary_fraction[0]),
        "mean_x": float(moments.mean_x[0]),
        "eta": float(one.uncertainty.prediction.eta[0]),
        "eta_low": low,
        "eta_high": high,
        "eta_models_low": min((float(v[0]) for v in models.values()), default=None),
        "eta_models_high": max((float(v[0]) for v in models.values()), default=None),
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
        "verdict": one.verdict(group),
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
    lines, end = [], found.premises.cut * CUTS[-1] * (1 - 1e-9)
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
            lines.append([*first, group, *cells, one.verdict(group), stars, widest])
    return lines


def _percent(share: Share | None) -> str:
    """Bias and total of a quantity in percent of its requirement."""
    if share is None or share.required is None:
        return ""
    of = 100 / share.required
    bias = 0.0 if abs(share.bias.value) < _FEWEST_DIGITS else abs(share.bias.value) * of
    return f"{bias:.0f} / {share.total.value * of:.0f} %"


def budget_header(answer: dict[str, Any], multiplicity: str) -> str:
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
    coloured = "".join(
        f"\n{row['mag_lo']:g}-{row['mag_hi']:g}, companions' colour in {row['colour_band']}: size "
        f"{row['colour_r2']:+.1e}, {row['colour_r2_known']:+.1e} where the PSF follows the star's colour, "
        f"eta {row['colour_eta']:.1e}"
        for row in answer["bins"]
        if row.get("colour_band")
    )
    return (
        f"{answer['requirement']}: {', '.join(limits)} ({answer['source']})\n"
        f"{answer['psf']}, {answer['estimator']}, {multiplicity}, cut {answer['cut']:g} arcsec, "
        f"{answer['n_stars']} stars for the PSF of a patch\n"
        "cells: bias / rms error, in percent of the requirement; psf: its shape; fit, moments: shear by that method"
        + coloured
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

    def draw() -> Figure:
        from porrima.diagrams import budget_shares  # noqa: PLC0415  (slow to import, where used)

        return budget_shares(answer)

    rows = [row | {"verdict": row["verdict"] or ""} for row in answer["shares"]]
    write_rows_and_figure(rows, table, draw, picture)
