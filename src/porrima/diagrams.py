"""The figures of predictions: what they show was computed elsewhere."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

from matplotlib import colormaps, rc_context
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from porrima.figures import COLOURS, RED, STYLE

if TYPE_CHECKING:
    import xarray as xr

    from porrima.instruments import Requirement

__all__ = [
    "against_magnitude",
    "budget_shares",
    "colour_against_eta",
    "correction_residuals",
    "corrections",
    "pair_sketch",
]

_TITLES = {"psf": "shape of the PSF", "fit": "shear, fit", "moments": "shear, moments"}
_LABELS = {"e1": "$e_1$", "e2": "$e_2$", "r2": "$R^2$", "m": "$m$", "c1": "$c_1$", "c2": "$c_2$"}


def budget_shares(answer: dict[str, Any]) -> Figure:
    """Share of each requirement against magnitude, a panel for each group.

    Parameters
    ----------
    answer : dict
        As `porrima budget --json` prints it: lines are the rms error over the requirement, dotted ones the bias alone,
        bands the interval of the rms error; dimensionless against mag.

    Returns
    -------
    figure : Figure
        Ready to be written.
    """
    rows = [row for row in answer["shares"] if row["required"] is not None]
    groups = list(dict.fromkeys(row["group"] for row in rows))
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(0.6 + 2.8 * len(groups), 3.4), layout="constrained")
        axes = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
        for axis, group in zip(axes, groups, strict=True):
            here = [row for row in rows if row["group"] == group]
            for colour, quantity in zip(
                COLOURS, dict.fromkeys(row["quantity"] for row in here), strict=False
            ):
                _share_line(axis, [row for row in here if row["quantity"] == quantity], colour)
            axis.axhline(1.0, color=RED, linestyle=":", linewidth=1.2)
            axis.set(yscale="log", xlabel="magnitude", title=_TITLES[group])
            axis.legend(frameon=False, fontsize=8)
        axes[0].set_ylabel("share of the requirement")
        highest = max(row["total"] / row["required"] for row in rows)
        lowest = min(row["total"] / row["required"] for row in rows)
        axes[0].set_ylim(max(1e-3, 0.4 * lowest), max(3.0, 3.0 * highest))
        figure.suptitle(f"{answer['requirement']}, {answer['n_stars']} stars", fontsize=9.5)
    return figure


def _share_line(axis: Any, rows: list[dict[str, Any]], colour: str) -> None:
    """One quantity: rms error with its interval, and the bias where there is one."""
    edges = [*(row["mag_lo"] for row in rows), rows[-1]["mag_hi"]]
    total, low, high = (
        [row[name] / row["required"] for row in rows] for name in ("total", "total_low", "total_high")
    )
    axis.stairs(total, edges, color=colour, linewidth=1.4, baseline=None, label=_LABELS[rows[0]["quantity"]])
    axis.stairs(high, edges, baseline=low, fill=True, color=colour, alpha=0.12, linewidth=0)
    axis.stairs(
        [row["bias_share"] for row in rows], edges, color=colour, linewidth=1.0, linestyle=":", baseline=None
    )


def colour_against_eta(answers: dict[str, dict[str, Any]]) -> Figure:
    """What the colour of companions does to the size of the PSF, beside what their separation does.

    Parameters
    ----------
    answers : dict
        Title of a panel: as `porrima budget --colour BAND --json` prints it; dimensionless against mag.

    Returns
    -------
    figure : Figure
        Open symbols are negative changes; the dashed line is the requirement.
    """
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(7.4, 3.6), layout="constrained")
        axes = figure.subplots(1, len(answers), sharey=True, squeeze=False)[0]
        for axis, (title, answer) in zip(axes, answers.items(), strict=True):
            bins = answer["bins"]
            middle = [0.5 * (row["mag_lo"] + row["mag_hi"]) for row in bins]
            for key, label, colour, marker in _COLOUR_LINES:
                values = [row[key] for row in bins]
                axis.plot(middle, [abs(v) for v in values], color=colour, linewidth=1.0, linestyle=":")
                for sign, fill in ((1, colour), (-1, "white")):
                    here = [(m, sign * v) for m, v in zip(middle, values, strict=True) if sign * v > 0]
                    if here:
                        look = {"markeredgecolor": colour, "markerfacecolor": fill, "markersize": 4.5}
                        axis.plot(*zip(*here, strict=True), linestyle="", marker=marker, **look)
                axis.plot([], [], color=colour, linestyle=":", marker=marker, markersize=4.5, label=label)
            if answer["required_sigma_r2"] is not None:
                axis.axhline(answer["required_sigma_r2"], color=RED, linestyle="--", linewidth=1.0)
            axis.set(yscale="log", xlabel="$i$ [mag]", title=title)
        axes[0].set_ylabel(r"$|\delta R^2| / R_0^2$")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=8.5)
    return figure


_COLOUR_LINES = (
    ("eta", r"$\eta$, flux ratios in $i$", "0.55", "s"),
    ("colour_eta", r"$\eta$, flux ratios in the band of the PSF", COLOURS[0], "o"),
    ("colour_r2", "colour of companions, PSF model blind to colour", COLOURS[1], "D"),
    ("colour_r2_known", "colour of companions, PSF model of the star's colour", COLOURS[2], "^"),
)

_ROWS = (
    ("mean_x", r"$\langle x \rangle$ [arcsec$^2$]", (1e-7, 3e-5)),
    ("e", r"$\sigma(e)$", (1e-6, 1e-3)),
    ("r2", r"$\sigma(R^2)/R_0^2$", (3e-5, 5e-3)),
)
_SURVEYS = (("--", "D"), ("-.", "^"))  # line and symbol of each survey's PSF


def against_magnitude(data: xr.Dataset, requirement: Requirement) -> Figure:
    """Mean x, error of the ellipticity and of the size against magnitude (KCM16 Sect. 5.4), a column for each model.

    Parameters
    ----------
    data : Dataset
        From `experiments.against_magnitude`: arcsec² and dimensionless against mag.
    requirement : Requirement
        Drawn as dotted lines.

    Returns
    -------
    figure : Figure
        Colours are the ellipticities of Gaussian PSFs, grey lines with symbols PSFs of surveys; the band is the
        interval in which the mean of x is known, the thin grey lines the scatter of a stack.
    """
    models = [str(name) for name in data["model"].to_numpy()]
    middle = 0.5 * (data["mag_lo"] + data["mag_hi"])
    norm = Normalize(0.0, float(data["e_0"].sel(psf=_gaussians(data)).max()))
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(7.4, 8.2), layout="constrained")
        axes = figure.subplots(len(_ROWS), len(models), sharex=True, sharey="row", squeeze=False)
        for column, model in zip(axes.T, models, strict=True):
            here = data.sel(model=model)
            column[0].fill_between(
                middle, here["mean_x_low"], here["mean_x_high"], color=COLOURS[0], alpha=0.15
            )
            column[0].plot(middle, here["mean_x"], color=COLOURS[0], linewidth=1.4)
            for axis, quantity, required in (
                (column[1], "e", requirement.sigma_e), (column[2], "r2", requirement.sigma_r2),
            ):  # fmt: skip
                _errors(axis, here, quantity, middle, norm)
                axis.axhline(required, color=RED, linestyle=":", linewidth=1.2)
            column[0].set_title(model, fontsize=9.5)
            column[-1].set_xlabel(f"${data.attrs['band']}$ [mag]")
        for row, (_, label, limits) in zip(axes, _ROWS, strict=True):
            row[0].set(yscale="log", ylabel=label, ylim=limits)
        bar = ScalarMappable(norm, colormaps["viridis"])
        figure.colorbar(bar, ax=axes[1], label="$e$ of Gaussian PSFs", pad=0.01)
        _magnitude_legend(figure, axes, data, requirement)
    return figure


def _gaussians(data: xr.Dataset) -> list[str]:
    return [str(name) for name in data["psf"].to_numpy() if str(name).startswith("e = ")]


def _errors(axis: Any, data: xr.Dataset, quantity: str, middle: Any, norm: Normalize) -> None:
    """Errors for infinitely many stars behind each PSF, and the scatter behind the first."""
    names = [str(name) for name in data["psf"].to_numpy()]
    gaussians = _gaussians(data)
    for name in gaussians if quantity == "e" else gaussians[:1]:
        here = data.sel(psf=name)
        colour = colormaps["viridis"](norm(float(here["e_0"]))) if quantity == "e" else COLOURS[0]
        axis.plot(middle, here[f"limit_{quantity}"], color=colour, linewidth=1.4)
    surveys = [name for name in names if name not in gaussians]
    for name, (style, marker) in zip(surveys, _SURVEYS, strict=True):
        one = data.sel(psf=name)[f"limit_{quantity}"]
        axis.plot(middle, one, color="0.35", linestyle=style, marker=marker, markersize=3.2, linewidth=1.0)
    axis.plot(middle, data[f"sd_{quantity}"].isel(psf=0), color="0.6", linewidth=0.8)


def _magnitude_legend(figure: Figure, axes: Any, data: xr.Dataset, requirement: Requirement) -> None:
    surveys = [str(name) for name in data["psf"].to_numpy() if str(name) not in _gaussians(data)]
    entries: list[tuple[dict[str, Any], str]] = [
        ({"color": COLOURS[0]}, "Gaussian PSF, infinitely many stars")
    ]
    for name, (style, marker) in zip(surveys, _SURVEYS, strict=True):
        e = float(data["e_0"].sel(psf=name))
        look = {"color": "0.35", "linestyle": style, "marker": marker, "markersize": 3.2}
        entries.append((look, f"PSF of {name}, $e$ = {e:.3f}"))
    entries.append(
        ({"color": "0.6", "linewidth": 0.8}, f"scatter of {data.attrs['n_stars']} stars, Gaussian PSF")
    )
    entries.append(({"color": RED, "linestyle": ":"}, f"requirement ({requirement.name})"))
    handles = [axes[0, 0].plot([], [], **look)[0] for look, _ in entries]
    labels = [label for _, label in entries]
    figure.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False, fontsize=8.5)


def corrections(answer: dict[str, Any]) -> Figure:
    """Corrected shapes, patch by patch, or sizes of samples against what companions are to add to them.

    Parameters
    ----------
    answer : dict
        As `porrima correct --json` prints it, dimensionless and arcsec².

    Returns
    -------
    figure : Figure
        Ready to be written.
    """
    with rc_context(STYLE):  # type: ignore[arg-type]
        if "samples" in answer:
            return _extrapolations(answer)
        quantities = list(dict.fromkeys(row["quantity"] for row in answer["values"]))
        figure = Figure(figsize=(7.4, 2.2 * len(quantities)), layout="constrained")
        for axis, quantity in zip(
            figure.subplots(len(quantities), 1, sharex=True, squeeze=False)[:, 0], quantities, strict=True
        ):
            rows = [row for row in answer["values"] if row["quantity"] == quantity]
            number = range(1, len(rows) + 1)
            corrected = [row["corrected"] for row in rows]
            sides = [
                [row["corrected"] - row["low"] for row in rows],
                [row["high"] - row["corrected"] for row in rows],
            ]
            axis.plot(
                number, [row["measured"] for row in rows], "o", color=COLOURS[1], mfc="none", label="measured"
            )
            axis.errorbar(
                number, corrected, yerr=sides, fmt="s", color=COLOURS[0], markersize=4, label="corrected"
            )
            axis.set_ylabel(_LABELS[quantity] + (" [arcsec$^2$]" if quantity == "r2" else ""))
        axis.set_xlabel("patch")
        axis.xaxis.get_major_locator().set_params(integer=True)
        axis.legend(frameon=False, fontsize=8)
    return figure


def _extrapolations(answer: dict[str, Any]) -> Figure:
    """Size of each sample over the fitted one against the change that is predicted, with the fits."""
    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axis = figure.subplots()
    for colour, fit in zip(itertools.cycle(COLOURS), answer["fits"], strict=False):
        rows = [row for row in answer["samples"] if row["patch"] == fit["patch"]]
        change = [row["predicted_change"] for row in rows]
        line = [0.0, max(change)]
        fitted = [fit["amplitude"] * x for x in line]
        size = [fit["amplitude"] * x + row["residual"] for x, row in zip(change, rows, strict=True)]
        axis.plot(line, fitted, color=colour, linewidth=1.2)
        axis.plot(change, size, "o", color=colour, markersize=4, label=f"patch {fit['patch']}")
        axis.errorbar([0.0], [0.0], yerr=[fit["error_r2"]], color=colour, capsize=3)
    axis.set(xlabel=r"predicted $\delta R^2/R_0^2$", ylabel=r"$R^2/R_0^2 - 1$, $R_0^2$ as fitted")
    if len(answer["fits"]) <= len(COLOURS):
        axis.legend(frameon=False, fontsize=8)
    return figure


def correction_residuals(data: xr.Dataset) -> Figure:
    """Size and ellipticity of simulated stacks before and after a correction, against magnitude.

    Parameters
    ----------
    data : Dataset
        From `trials.trials`: dimensionless against mag.

    Returns
    -------
    figure : Figure
        Symbols are means over the trials with the range of two thirds of them; the band is the forecast of one standard
        deviation about 0, the hatched one that of the extrapolation over all magnitudes.
    """
    middle = 0.5 * (data["mag_lo"] + data["mag_hi"])
    edges = [*data["mag_lo"].to_numpy(), float(data["mag_hi"][-1])]
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(7.4, 3.4), layout="constrained")
        labels = {"r2": r"$R^2/R_0^2 - 1$", "e1": r"$e_1 - e_{1,0}$"}
        for axis, (quantity, label) in zip(figure.subplots(1, 2), labels.items(), strict=True):
            here = data.sel(quantity=quantity)
            down, up = here["down"].mean("trial"), here["up"].mean("trial")
            axis.stairs(
                up, edges, baseline=-down, fill=True, color=COLOURS[0], alpha=0.18, label="forecast, after"
            )
            wide = float(here["extrapolated_error"].mean())
            axis.axhspan(
                -wide,
                wide,
                facecolor="none",
                edgecolor="0.5",
                hatch="////",
                linewidth=0,
                label="forecast, extrapolated",
            )
            for k, (name, marker) in enumerate((("before", "o"), ("after", "s"))):
                values = here[name]
                mean, ends = values.mean("trial"), values.quantile([1 / 6, 5 / 6], "trial")
                sides = [mean - ends[0], ends[1] - mean]
                axis.errorbar(
                    middle + 0.12 * (2 * k - 1), mean, yerr=sides, color=COLOURS[1 - k], marker=marker,
                    markersize=4, linestyle="none", linewidth=1.1, label=name,
                )  # fmt: skip
            axis.axhline(0.0, color="0.3", linewidth=0.6)
            axis.set(xlim=(edges[0], edges[-1]), xlabel="$i$ [mag]", ylabel=label)
            axis.ticklabel_format(axis="y", style="sci", scilimits=(0, 0), useMathText=True)
        handles, names = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
        figure.suptitle(f"{data.attrs['psf']}, stacks of {data.attrs['n_stars']} stars", fontsize=9.5)
    return figure


def pair_sketch(points: xr.Dataset) -> Figure:
    """A pair with the symbols of the paper (KCM16, Fig. 2): primary, companion, photocentre.

    Parameters
    ----------
    points : Dataset
        ``points`` of `paper_tables.pair_sketch`: places in arcsec from the primary, fluxes over that of the primary.

    Returns
    -------
    figure : Figure
        Areas of the stars go with their fluxes.
    """
    x, y, flux = (points[name].to_numpy() for name in ("x", "y", "flux"))
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(5.2, 3.6), layout="constrained")
        axis = figure.subplots()
        axis.plot([x[0], x[1]], [y[0], y[1]], color="0.5", linewidth=0.9, linestyle="--")
        for k, colour in ((0, COLOURS[0]), (1, COLOURS[1])):
            axis.scatter(x[k], y[k], s=900 * flux[k], facecolor=colour, edgecolor="none", zorder=3)
        axis.plot(x[2], y[2], marker="x", markersize=9, markeredgewidth=2, color="0.1", linestyle="")
        for start, end, place, text in (
            ((x[0], y[0]), (x[1], y[0]), (0.62 * x[1], y[0] - 0.0032), r"$\delta x$"),
            ((x[1], y[0]), (x[1], y[1]), (x[1] + 0.0015, 0.45 * y[1]), r"$\delta y$"),
        ):
            axis.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": "0.3", "linewidth": 1.0})
            axis.text(*place, text, fontsize=11)
        for k, shift, text in (
            (0, (-0.0005, -0.0068), r"$(\bar x_m, \bar y_m)$, $I_m$"),
            (1, (-0.008, 0.0048), r"$(\bar x_c, \bar y_c)$, $I_c = f I_m$"),
            (2, (-0.0105, 0.0022), r"$(\bar x, \bar y)$"),
        ):
            axis.text(x[k] + shift[0], y[k] + shift[1], text, fontsize=10, ha="left")
        axis.text(0.62 * x[1] - 0.0015, 0.62 * y[1] + 0.001, "$r$", fontsize=11, ha="right")
        axis.set(xlim=(-0.009, 0.052), ylim=(-0.009, 0.034), aspect="equal")
        axis.set_xlabel("$x$ from the primary [arcsec]")
        axis.set_ylabel("$y$ from the primary [arcsec]")
    return figure
