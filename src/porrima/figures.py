"""The figures: each function draws one from saved numbers and computes nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure

if TYPE_CHECKING:
    import xarray as xr

    from porrima.instruments import Requirement

__all__ = ["errors_and_biases"]

_COLOURS = (
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
_STYLE = {
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
    from matplotlib import rc_context  # noqa: PLC0415  (its state is set for this figure only)

    with rc_context(_STYLE):  # type: ignore[arg-type]
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
        colour = _COLOURS[p % len(_COLOURS)]
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
