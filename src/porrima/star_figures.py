"""The figures of stars: selections, populations over the sky, models beside catalogues.  They compute nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, LogLocator, NullFormatter, NullLocator, StrMethodFormatter

from porrima.figures import COLOURS, MARKERS, STYLE

if TYPE_CHECKING:
    import xarray as xr

    from porrima.stars import Stars

__all__ = ["galaxy_against_catalog", "population", "selection"]

_SHARES = (
    ("0.1-0.5", COLOURS[1], "0.1–0.5"),
    ("0.5-1.5", COLOURS[0], "0.5–1.5"),
    ("0.5-0.7", COLOURS[5], "0.5–0.7"),
    ("0.7-1.5", COLOURS[2], "0.7–1.5"),
    ("below 0.1", COLOURS[3], "below 0.1"),
)
_SCANS = (
    ("l = 0", "$l = 0°$", "Galactic latitude $b$ [deg]"),
    ("l = 180", "$l = 180°$", "Galactic latitude $b$ [deg]"),
    ("b = 45", "$b = 45°$", "Galactic longitude $l$ [deg]"),
)


def selection(stars: Stars) -> Figure:
    """Three panels: how the stars of a selection are distributed in magnitude, mass and distance, by component.

    Parameters
    ----------
    stars : Stars
        The selection: mag, M_sun, pc.

    Returns
    -------
    figure : Figure
        Ready to be written.
    """
    groups = {
        "thin disc": "thin",
        "thick disc": "thick",
        "halo": "halo",
        "bulge": "bulge",
        "component unknown": "unknown",
    }
    names = [n for n, start in groups.items() if np.any(np.char.startswith(stars.component, start))]
    masks = [np.char.startswith(stars.component, groups[name]) for name in names]
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(8.6, 3.1), layout="constrained")
        axes = figure.subplots(1, 3)
        per = f" per deg² ({stars.area:g} deg²)" if stars.area else ""
        for axis, values, label, scale in (
            (axes[0], stars.magnitude, f"{stars.band} [mag]", "linear"),
            (axes[1], stars.mass, r"mass [M$_\odot$]", "log"),
            (axes[2], stars.distance, "distance [pc]", "log"),
        ):
            space = np.geomspace if scale == "log" else np.linspace
            edges = space(values.min(), values.max() * (1 + 1e-9), 31)
            weights = [np.full(int(m.sum()), 1 / stars.area if stars.area else 1.0) for m in masks]
            axis.hist([values[m] for m in masks], edges, weights=weights, stacked=True, label=names,
                      color=COLOURS[: len(names)])  # fmt: skip
            axis.set_xscale(scale)
            axis.set_xlabel(label)
        axes[0].set_ylabel("stars in each bin" + per)
        axes[1].xaxis.set_major_locator(FixedLocator([0.1, 0.2, 0.5, 1.0]))
        axes[1].xaxis.set_major_formatter("{x:g}")
        axes[1].xaxis.set_minor_locator(NullLocator())
        axes[2].legend(frameon=False, fontsize=8)
        figure.suptitle(f"{len(stars)} main-sequence stars, {stars.source}", fontsize=9)
    return figure


def population(dataset: xr.Dataset) -> Figure:
    """Share of mass classes, and mean binary fraction, against latitude and longitude (KCM16 Sect. 4.3).

    Parameters
    ----------
    dataset : Dataset
        From `star_experiments.population`, dimensionless against angles in deg.

    Returns
    -------
    figure : Figure
        Ready to be written.
    """
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(7.4, 5.4), layout="constrained")
        axes = figure.subplots(2, 3, sharex="col", sharey="row")
        for column, (scan, title, label) in zip(axes.T, _SCANS, strict=True):
            here = dataset.sel(scan=scan).dropna("angle", subset=["n_per_deg2"])
            angle = here["angle"]
            for name, colour, words in _SHARES:
                share = here["share"].sel(mass_class=name)
                style = "-" if name in ("0.1-0.5", "0.5-1.5", "below 0.1") else "--"
                column[0].plot(angle, share, style, color=colour, linewidth=1.3, label=words)
            column[1].axhspan(0.35, 0.40, color="0.9", linewidth=0.0, label="KCM16, mean")
            for rule, style in (("solar", "-"), ("lower", "--")):
                fraction = here["binary_fraction"].sel(gap_rule=rule)
                column[1].plot(angle, fraction, style, color="0.2", linewidth=1.3, label=f"gaps: {rule} row")
            column[0].set_title(title, fontsize=9.5)
            column[1].set_xlabel(label)
            column[1].set_xlim(float(angle[0]), float(angle[-1]))
            column[1].set_xticks(range(15, 76, 15) if scan != "b = 45" else range(0, 361, 90))
        axes[0, 0].set_ylim(0.0, 0.8)
        axes[0, 0].set_ylabel("share of the stars")
        axes[1, 0].set_ylim(0.2, 0.42)
        axes[1, 0].set_ylabel("mean binary fraction")
        lo, hi = dataset.attrs["magnitude_lo"], dataset.attrs["magnitude_hi"]
        handles, labels = axes[0, 0].get_legend_handles_labels()
        title = rf"mass [M$_\odot$], main sequence, ${lo:g} \leq {dataset.attrs['band']} < {hi:g}$"
        figure.legend(
            handles, labels, title=title, loc="outside upper center", ncols=5, frameon=False, fontsize=8.5
        )
        axes[1, 1].legend(loc="lower right", frameon=False, fontsize=8.0)
    return figure


_BESIDE = (
    ("counts", "stars per deg² and mag"),
    ("median_distance", "median distance [pc]"),
    ("mean_mass", r"mean mass [M$_\odot$]"),
    ("fraction", "mean multiplicity fraction"),
)


def galaxy_against_catalog(datasets: list[xr.Dataset]) -> Figure:
    """Counts, distances, masses and multiplicity of the analytic Galaxy beside catalogues.

    Parameters
    ----------
    datasets : list of Dataset
        One column of panels each, from `star_experiments.galaxy_against_catalog`: per deg² and mag, pc, M_sun.

    Returns
    -------
    figure : Figure
        Ready to be written.
    """
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(7.4, 9.0), layout="constrained")
        axes = figure.subplots(len(_BESIDE), len(datasets), sharex=True, sharey="row", squeeze=False)
        for column, data in zip(axes.T, datasets, strict=True):
            for axis, (quantity, _) in zip(column, _BESIDE, strict=True):
                if quantity == "fraction":
                    _beside(axis, data, "fraction_solar", 0, "gaps: solar row")
                    _beside(axis, data, "fraction_lower", 1, "gaps: lower row")
                    axis.legend(frameon=False, fontsize=7.5)
                else:
                    _beside(axis, data, quantity, 0, "Besançon catalogue")
            column[0].set_title(f"$l = {data.attrs['l']:g}°$, $b = {data.attrs['b']:g}°$", fontsize=9.5)
            column[-1].set_xlabel(f"${data.attrs['band']}$ [mag]")
        for axis, (quantity, label) in zip(axes[:, 0], _BESIDE, strict=True):
            axis.set_ylabel(label)
            if quantity in ("counts", "median_distance"):
                axis.set_yscale("log")
                axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
                axis.yaxis.set_major_formatter(StrMethodFormatter("{x:.0f}"))
                axis.yaxis.set_minor_formatter(NullFormatter())
        axes[0, 0].plot([], [], color=COLOURS[0], linewidth=1.3, label="analytic Galaxy")
        axes[0, 0].legend(frameon=False, fontsize=7.5)
    return figure


def _beside(axis: Any, data: xr.Dataset, quantity: str, number: int, label: str) -> None:
    """The model as a staircase, the catalogue as points with their sampling errors."""
    here = data.sel(quantity=quantity)
    edges = [*data["mag_lo"].to_numpy(), float(data["mag_hi"][-1])]
    axis.stairs(here["galaxy"], edges, color=COLOURS[number], linewidth=1.3, baseline=None)
    axis.errorbar(
        0.5 * (data["mag_lo"] + data["mag_hi"]), here["catalog"], yerr=here["stderr"],
        color=COLOURS[number], marker=MARKERS[number], markersize=3.6, linestyle="none", linewidth=0.9,
        label=label,
    )  # fmt: skip
