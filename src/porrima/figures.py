"""The figures: each function draws one from saved numbers and computes nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

if TYPE_CHECKING:
    import xarray as xr

    from porrima.instruments import Requirement

__all__ = [
    "COLOURS",
    "MARKERS",
    "RED",
    "STYLE",
    "at_one_fraction",
    "effect_of_n_stars",
    "errors_and_biases",
    "performance",
    "responses",
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
RED = "#b00020"  # what is required, and what one is warned of
MARKERS = ("o", "s", "^", "D", "v", "P")
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
            row[0].axhline(required, color=RED, linestyle=":", linewidth=1.2)
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
            color=colour, marker=MARKERS[p % len(MARKERS)], markersize=3.2, linestyle="none", linewidth=0.9,
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
        ({"color": RED, "linestyle": ":"}, f"requirement ({requirement.name})"),
    ):
        handles += axis.plot([], [], **style)
        labels.append(label)
    figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False, fontsize=8.5)


def at_one_fraction(summary: xr.Dataset, requirement: Requirement) -> Figure:
    """Three panels: bias and scatter of R², e1 and e2 behind each PSF, of stacks with one binary fraction.

    Parameters
    ----------
    summary : Dataset
        From `summary.summarise`, with stacks in one bin: symbols with their standard errors, dimensionless.
    requirement : Requirement
        Drawn as dotted lines.

    Returns
    -------
    figure : Figure
        Open symbols are predictions.
    """
    here = summary.isel(bin=int(np.argmax(summary["n_stacks"].to_numpy())))
    psfs = [str(name) for name in summary["psf"].to_numpy()]
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(7.4, max(2.6, 1.4 + 0.5 * len(psfs))), layout="constrained")
        axes = figure.subplots(1, 3, sharey=True)
        for axis, (quantity, _, label) in zip(axes, _PANELS, strict=True):
            for k, (statistic, words) in enumerate((("bias", "bias"), ("sd", "scatter of a stack"))):
                place = np.arange(len(psfs)) + 0.2 * (k - 0.5)
                one = here.sel(quantity=quantity)
                style = {"color": COLOURS[k], "marker": MARKERS[k], "markersize": 4.0, "linestyle": "none"}
                axis.errorbar(one[statistic], place, xerr=one[f"{statistic}_se"], label=words, **style)
                axis.plot(
                    one[f"prediction_{statistic}"], place, label=f"{words}, predicted", **style | {"markersize": 9.0},
                    markerfacecolor="none",
                )  # fmt: skip
            required = requirement.sigma_r2 if quantity == "r2" else requirement.sigma_e
            if required is not None:
                axis.axvline(required, color=RED, linestyle=":", linewidth=1.2)
            axis.axvline(0.0, color="0.6", linewidth=0.6, zorder=0)
            axis.set_xlabel(label)
            axis.ticklabel_format(axis="x", style="sci", scilimits=(0, 0), useMathText=True)
        axes[0].set_yticks(range(len(psfs)), psfs)
        axes[0].set_ylim(len(psfs) - 0.5, -0.5)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False, fontsize=8.0)
    return figure


def effect_of_n_stars(numbers: xr.Dataset, limit: xr.Dataset, requirement: Requirement) -> Figure:
    """Two panels: error of e1 and e2 against binary fraction, for stacks of few and many stars (KCM16, Fig. 5).

    Parameters
    ----------
    numbers : Dataset
        ``sigma``, ``sigma_se`` and ``prediction_sigma`` over (n_stars, psf, quantity, bin), dimensionless: symbols
        with their standard errors, and solid lines.
    limit : Dataset
        From `summary.predicted_curves` for infinitely many stars: dashed lines.
    requirement : Requirement
        Drawn as dotted lines.

    Returns
    -------
    figure : Figure
        Ready to be written.
    """
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(7.4, 4.6), layout="constrained")
        axes = figure.subplots(1, 2, sharex=True, sharey=True)
        for axis, quantity in zip(axes, ("e1", "e2"), strict=True):
            centre = 0.5 * (numbers["f_lo"] + numbers["f_hi"])
            for p, psf in enumerate(numbers["psf"].to_numpy()):
                filled = {"markerfacecolor": "none"} if p % 2 else {}
                for n, n_stars in enumerate(numbers["n_stars"].to_numpy()):
                    here = numbers.sel(n_stars=n_stars, psf=psf, quantity=quantity)
                    colour = COLOURS[n % len(COLOURS)]
                    label = f"{n_stars} stars" if p == 0 else None
                    axis.errorbar(
                        centre, here["sigma"], yerr=here["sigma_se"], color=colour, marker=MARKERS[p % len(MARKERS)],
                        markersize=3.6, linestyle="none", linewidth=0.9, label=label, **filled,
                    )  # fmt: skip
                    axis.plot(centre, here["prediction_sigma"], color=colour, linewidth=1.0)
                endless = limit["sigma"].sel(psf=psf, quantity=quantity)
                axis.plot(
                    limit["binary_fraction"],
                    endless,
                    color="0.25",
                    linewidth=0.9,
                    linestyle=("--", "-.")[p % 2],
                )
            axis.axhline(requirement.sigma_e, color=RED, linestyle=":", linewidth=1.2)
            axis.set_yscale("log")
            axis.set_ylim(1e-6, 4e-3)
            axis.set_xlim(0.0, 1.0)
            axis.set_xlabel("binary fraction of the population")
            axis.set_title(f"$e_{quantity[1]}$", fontsize=9.5)
        axes[0].set_ylabel(r"$\sigma(e_i)$")
        _legend_of_n_stars(figure, axes[0], numbers, requirement)
    return figure


def _legend_of_n_stars(figure: Figure, axis: Any, numbers: xr.Dataset, requirement: Requirement) -> None:
    handles, labels = axis.get_legend_handles_labels()
    for p, psf in enumerate(numbers["psf"].to_numpy()):
        name = str(psf).upper()
        face = "none" if p % 2 else "0.25"
        style = {
            "color": "0.25",
            "marker": MARKERS[p % len(MARKERS)],
            "markersize": 3.6,
            "markerfacecolor": face,
        }
        handles += axis.plot([], [], linestyle="none", **style)
        labels.append(name)
        handles += axis.plot([], [], color="0.25", linewidth=0.9, linestyle=("--", "-.")[p % 2])
        labels.append(f"{name}, infinitely many")
    handles += axis.plot([], [], color="0.25", linewidth=1.0)
    labels.append("prediction")
    handles += axis.plot([], [], color=RED, linestyle=":", linewidth=1.2)
    labels.append(f"requirement ({requirement.name})")
    figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False, fontsize=8.0)


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
                    linestyle="none", marker=MARKERS[k], color=COLOURS[k], markersize=4.0, alpha=0.8, label=estimator,
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


_SPEEDS = (
    ("moments", "engine, moments", COLOURS[0], "o"),
    ("shapes", "engine, with shapes", COLOURS[5], "D"),
    ("floor", "random numbers alone", "0.45", "|"),
    ("fft", "numpy, histogram and FFT", COLOURS[2], "^"),
    ("galsim-sum", "GalSim, one draw per stack", COLOURS[4], "s"),
    ("galsim-stars", "GalSim, star by star", COLOURS[1], "v"),
)
_COSTS = (("us_per_stack", 0), ("us_per_stack_with_shape", 1))  # against the first two of _SPEEDS


def performance(result: dict[str, Any]) -> Figure:
    """Speed of the engine and its peers, and the engine's cost against stars in a stack and number of stacks.

    Parameters
    ----------
    result : dict
        From `bench.bench`: stars per s, µs per stack (dimensionless where a ratio).

    Returns
    -------
    figure : Figure
        Three panels, all on logarithmic axes.
    """
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(9.6, 3.9), layout="constrained")
        axes = figure.subplots(1, 3, width_ratios=(1.4, 1.0, 1.0))
        _speeds(axes[0], result["speeds"])
        for axis, rows, key, per_star in (
            (axes[1], result["cost_of_stars"], "n_stars", True),
            (axes[2], result["cost_of_stacks"], "n_stacks", False),
        ):
            unit = np.array([1e3 / row["n_stars"] if per_star else 1.0 for row in rows])
            for name, number in _COSTS:
                cost = unit * [row[name] for row in rows]
                error = unit * [row[f"{name}_error"] for row in rows]
                _, _, colour, marker = _SPEEDS[number]
                axis.errorbar(
                    [row[key] for row in rows], cost, yerr=error,
                    color=colour, marker=marker, markersize=4.0, linewidth=1.0,
                )  # fmt: skip
            axis.set(xscale="log", yscale="log")
            axis.grid(color="0.92", linewidth=0.6)
            axis.set_axisbelow(True)
        axes[1].set(xlabel="stars in a stack", ylabel="engine: cost [ns per star]")
        axes[2].set(xlabel="stacks of 40 stars", ylabel="engine: cost [µs per stack]")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=8.5)
        figure.suptitle(f"{result['processor']}, {result['threads']} threads", fontsize=9)
    return figure


def _speeds(axis: Any, rows: list[dict[str, Any]]) -> None:
    """One line for each PSF and size of stack, one symbol for each way to the same shapes."""
    kinds = list(dict.fromkeys((row["psf"], row["n_stars"]) for row in rows))
    for who, label, colour, marker in _SPEEDS:
        for device in dict.fromkeys(row["device"] for row in rows if row["who"] == who):
            here = [row for row in rows if row["who"] == who and row["device"] == device]
            axis.errorbar(
                [row["stars_per_s"] for row in here],
                [kinds.index((row["psf"], row["n_stars"])) for row in here],
                xerr=[row["stars_per_s_error"] for row in here],
                color=colour, marker=marker, markersize=12.0 if marker == "|" else 6.0, linestyle="none",
                fillstyle="full" if device == "cpu" else "none",
                label=label if device == "cpu" else f"{label} ({device})",
            )  # fmt: skip
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(numticks=12))
    axis.set_yticks(
        range(len(kinds)), [f"{psf}\n{n_stars:,} stars".replace(",", " ") for psf, n_stars in kinds]
    )
    axis.set_ylim(len(kinds) - 0.5, -0.5)
    axis.tick_params(axis="y", which="both", length=0)
    axis.grid(axis="x", color="0.92", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.set_xlabel("stars per second")
