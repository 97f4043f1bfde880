"""The figures: each function draws one from saved numbers and computes nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, LogLocator, NullFormatter, NullLocator, StrMethodFormatter

if TYPE_CHECKING:
    import xarray as xr

    from porrima.instruments import Requirement
    from porrima.stars import Stars

__all__ = [
    "COLOURS",
    "STYLE",
    "errors_and_biases",
    "galaxy_against_catalog",
    "population",
    "responses",
    "selection",
    "toy_maps",
]

COLOURS = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
)  # Okabe & Ito, safe for all eyes
_MARKERS = ("o", "s", "^", "D", "v", "P")
_PANELS = (
    ("r2", r"$\sigma(R^2)/R_0^2$", r"$\langle\delta R^2\rangle/R_0^2$"),
    ("e1", r"$\sigma(e_1)$", r"$\langle\delta e_1\rangle$"),
    ("e2", r"$\sigma(e_2)$", r"$\langle\delta e_2\rangle$"),
)
STYLE = {
    "font.size": 9.0,
    "axes.linewidth": 0.8,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "xtick.top": True,
    "ytick.right": True,
    "svg.fonttype": "path",
}


def errors_and_biases(
    summary: xr.Dataset, curves: xr.Dataset, limit: xr.Dataset, requirement: Requirement
) -> Figure:
    """Six panels: error and bias of R², e1 and e2 against binary fraction (KCM16, Fig. 4).

    Parameters
    ----------
    summary : Dataset
        From `summary.summarise`: symbols with their standard errors, dimensionless.
    curves : Dataset
        From `summary.predicted_curves` at the N of the stacks: solid lines.
    limit : Dataset
        The same for infinitely many stars: dashed lines.
    requirement : Requirement
        Drawn as dotted lines in the panels of the errors.

    Returns
    -------
    figure : Figure
        Ready to be written.
    """
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(7.4, 8.4), layout="constrained")
        axes = figure.subplots(3, 2, sharex=True)
        for row, (quantity, error_label, bias_label) in zip(axes, _PANELS, strict=True):
            for axis, statistic, label in zip(row, ("sigma", "bias"), (error_label, bias_label), strict=True):
                _panel(axis, summary, curves, limit, quantity, statistic)
                axis.set_ylabel(label)
                axis.ticklabel_format(axis="y", style="sci", scilimits=(0, 0), useMathText=True)
            required = requirement.sigma_r2 if quantity == "r2" else requirement.sigma_e
            row[0].axhline(required, color="#b00020", linestyle=":", linewidth=1.2)
            row[0].set_ylim(bottom=0.0)
        for axis in axes[-1]:
            axis.set_xlabel("binary fraction of the population")
            axis.set_xlim(0.0, 1.0)
        _legend(figure, axes[0, 0], curves, requirement)
    return figure


def _panel(
    axis: Any, summary: xr.Dataset, curves: xr.Dataset, limit: xr.Dataset, quantity: str, statistic: str
) -> None:
    centre = 0.5 * (summary["f_lo"] + summary["f_hi"])
    half = 0.5 * float(summary["f_hi"][0] - summary["f_lo"][0])
    n_psf = summary.sizes["psf"]
    for p, psf in enumerate(summary["psf"].to_numpy()):
        here = {"psf": psf, "quantity": quantity}
        colour = COLOURS[p % len(COLOURS)]
        shift = 0.5 * half * (p - 0.5 * (n_psf - 1)) / max(n_psf, 1)  # apart, to be told from each other
        axis.errorbar(
            centre + shift,
            summary[statistic].sel(here),
            yerr=summary[f"{statistic}_se"].sel(here),
            color=colour, marker=_MARKERS[p % len(_MARKERS)], markersize=3.2, linestyle="none", linewidth=0.9,
            label=str(psf).upper(),
        )  # fmt: skip
        fraction = curves["binary_fraction"]
        axis.plot(fraction, curves[statistic].sel(here), color=colour, linewidth=1.1)
        if statistic == "sigma":  # the bias hardly depends on the number of stars
            axis.plot(fraction, limit[statistic].sel(here), color=colour, linewidth=0.9, linestyle="--")
    if statistic == "bias":
        axis.axhline(0.0, color="0.6", linewidth=0.6, zorder=0)


def _legend(figure: Figure, axis: Any, curves: xr.Dataset, requirement: Requirement) -> None:
    handles, labels = axis.get_legend_handles_labels()
    n_stars = curves.attrs["n_stars"]
    for style, label in (
        ({"color": "0.2"}, f"prediction, {n_stars} stars"),
        ({"color": "0.2", "linestyle": "--"}, "prediction, infinitely many stars"),
        ({"color": "#b00020", "linestyle": ":"}, f"requirement ({requirement.name})"),
    ):
        handles += axis.plot([], [], **style)
        labels.append(label)
    figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False, fontsize=8.5)


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
        From `experiments.population`, dimensionless against angles in deg.

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
        One column of panels each, from `experiments.galaxy_against_catalog`: per deg² and mag, pc, M_sun.

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
        color=COLOURS[number], marker=_MARKERS[number], markersize=3.6, linestyle="none", linewidth=0.9,
        label=label,
    )  # fmt: skip


_TOY_ROWS = (
    ("e", "$e$", "viridis", [0.02, 0.05, 0.1, 0.15, 0.2]),
    ("de_rel", r"$\Delta e/e_0$", "RdBu_r", [-0.5, -0.1, 0.1, 0.5, 2.0]),
    ("dr2_rel", r"$\Delta R^2/R_0^2$", "viridis", [0.01, 0.05, 0.1, 0.2]),
)


def toy_maps(maps: xr.Dataset) -> Figure:
    """Ellipticity and relative errors for a companion anywhere in the central pixel (KCM16, Fig. 1).

    Parameters
    ----------
    maps : Dataset
        From `toy.toy_maps`, dimensionless against places in arcsec.

    Returns
    -------
    figure : Figure
        A row for each quantity, a column for each PSF and contrast; the red line lies along the PSF.
    """
    from matplotlib.colors import Normalize, SymLogNorm  # noqa: PLC0415

    columns = [(p, m) for p in range(maps.sizes["psf"]) for m in range(maps.sizes["delta_m"])]
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(1.95 * len(columns) + 1.2, 6.3), layout="constrained")
        axes = figure.subplots(3, len(columns), sharex=True, sharey=True, squeeze=False)
        for row, (name, label, colours, levels) in zip(axes, _TOY_ROWS, strict=True):
            high = float(abs(maps[name]).max())
            norm = SymLogNorm(0.05, vmin=-high, vmax=high) if min(levels) < 0 else Normalize(0.0, high)
            for axis, (p, m) in zip(row, columns, strict=True):
                here = maps[name].isel(psf=p, delta_m=m)
                place = maps["x"], maps["y"], here
                image = axis.pcolormesh(*place, cmap=colours, norm=norm, shading="gouraud", rasterized=True)
                style = "0.9" if colours == "viridis" else "0.2"
                lines = axis.contour(*place, levels=levels, colors=style, linewidths=0.6)
                axis.clabel(lines, fontsize=6, fmt="%g", inline_spacing=1)
                _orientation(axis, maps.isel(psf=p))
                axis.set(aspect="equal", xticks=[-0.04, 0.0, 0.04], yticks=[-0.04, 0.0, 0.04])
            bar = figure.colorbar(image, ax=row[-1], label=label, shrink=0.85, pad=0.03)
            if min(levels) < 0:
                bar.set_ticks([-1.0, -0.1, 0.0, 0.1, 1.0], labels=["−1", "−0.1", "0", "0.1", "1"])
                bar.ax.minorticks_off()
        for axis, (p, m) in zip(axes[0], columns, strict=True):
            psf, contrast = str(maps["psf"].to_numpy()[p]), float(maps["delta_m"][m])
            along = psf.replace("e1", "$e_1$").replace("e2", "$e_2$")
            axis.set_title(f"{along}, $\\Delta m = {contrast:g}$", fontsize=9)
        figure.supxlabel("companion from primary, $x$ [arcsec]", fontsize=9)
        figure.supylabel("companion from primary, $y$ [arcsec]", fontsize=9)
    return figure


def _orientation(axis: Any, psf: xr.Dataset) -> None:
    """A red line through the origin along the major axis."""
    from numpy import arctan2, array, cos, sin  # noqa: PLC0415

    angle = 0.5 * float(arctan2(psf["e2_0"], psf["e1_0"]))
    ends = array([-0.012, 0.012])
    axis.plot(ends * cos(angle), ends * sin(angle), color="red", linewidth=1.6)


def responses(rows: list[dict[str, Any]]) -> Figure:
    """Response of size and ellipticity to an isotropic population across PSFs and estimators.

    Parameters
    ----------
    rows : list of dict
        From `kappa.row`, dimensionless, each with a ``group``: the PSFs of a group share a place on the axis.

    Returns
    -------
    figure : Figure
        Lines at 1: the formulae of KCM16.
    """
    groups = list(dict.fromkeys(row["group"] for row in rows))
    estimators = list(dict.fromkeys(row["kind"] for row in rows))
    mixed = {g for g in groups if len({row["kind"] for row in rows if row["group"] == g}) > 1}
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(max(4.5, 0.42 * len(groups) + 1.4), 6.2), layout="constrained")
        axes = figure.subplots(2, 1, sharex=True)
        for name, axis, label in (
            ("kappa_r2", axes[0], r"size: $\kappa = \delta R^2 / (R_0^2 \eta)$"),
            ("kappa_e", axes[1], r"ellipticity: $-\delta\mathbf{e}\cdot\mathbf{e}_0 / (e_0^2\, \eta)$"),
        ):
            for k, estimator in enumerate(estimators):
                here = [r for r in rows if r["kind"] == estimator and r[name] is not None]
                shift = 0.22 * (k - 0.5 * (len(estimators) - 1))
                axis.plot(
                    [groups.index(r["group"]) + (shift if r["group"] in mixed else 0.0) for r in here],
                    [r[name] for r in here],
                    linestyle="none", marker=_MARKERS[k], color=COLOURS[k], markersize=4.0, alpha=0.8, label=estimator,
                )  # fmt: skip
            axis.axhline(1.0, color="0.35", linewidth=0.9, zorder=0)
            axis.set_ylabel(label)
            axis.grid(axis="y", color="0.92", linewidth=0.6)
            axis.set_axisbelow(True)
        axes[1].axhline(0.0, color="0.7", linewidth=0.6, zorder=0)
        axes[1].set_xticks(range(len(groups)), groups, rotation=48, ha="right", rotation_mode="anchor")
        axes[1].tick_params(axis="x", which="both", top=False, length=0)
        axes[1].set_xlim(-0.6, len(groups) - 0.4)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside upper center", frameon=False, fontsize=8.5, ncols=len(estimators)
        )
    return figure
