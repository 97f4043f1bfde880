"""The figure of the headline.  It computes nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

from porrima.figures import COLOURS, RED, STYLE

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["levers"]

_SHARES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
_WAYS = {
    "dk13": ("table as published", COLOURS[0], "o-"),
    "dk13-kcm16": ("as the paper has it", COLOURS[3], "v--"),
    "modern": ("compilations of today", COLOURS[2], "s-."),
    "clip": ("as published, stars {clip:.0%} too large dropped", COLOURS[1], "D-"),
}


def levers(data: xr.Dataset) -> Figure:
    """Errors over what is required: by number of stars, and by magnitude.

    Parameters
    ----------
    data : Dataset
        From `headline.headline`, dimensionless and mag.

    Returns
    -------
    figure : Figure
        Ready to be written.
    """
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(8.6, 3.7), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        for quantity, label, colour in (
            ("r2", "size $R^2$", COLOURS[0]),
            ("e1", "ellipticity $e_1$", "0.45"),
        ):
            error = data["error"].sel(quantity=quantity)
            left.loglog(data["n_stars"], error, "o-", color=colour, markersize=3.5, label=label)
        for way, (label, colour, line) in _WAYS.items():
            right.semilogy(
                data["magnitude"],
                data["bias"].sel(way=way),
                line,
                color=colour,
                markersize=3.5,
                label=label.format(**data.attrs),
            )
        for axis in (left, right):
            axis.axhline(1.0, color=RED, linestyle=":", linewidth=1.2)
            axis.yaxis.set_major_locator(FixedLocator(_SHARES))
            axis.yaxis.set_minor_formatter(NullFormatter())
            axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.legend(frameon=False, fontsize=8, loc="best")
        left.text(1.0, 0.92, "requirement (KCM16)", color=RED, fontsize=8, va="top")
        left.set(
            xlabel=r"stars in the PSF, $N_\star$",
            ylabel="error / requirement",
            title="More stars do not help the size",
        )
        right.set(
            xlabel="$i$ [mag]",
            ylabel=r"bias of $R^2$ / requirement",
            title="Fainter stars may, cleaner ones do",
        )
    return figure
