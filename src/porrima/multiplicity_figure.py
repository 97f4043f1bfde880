"""The figure of the models of multiplicity side by side.  It computes nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter, FixedLocator, NullFormatter

from porrima.figures import COLOURS, STYLE

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["models_of_multiplicity"]

_LINES = ((0, "-"), (0, "--"), (1, "-"), (2, "-"), (3, "-"), (4, "-"), (5, "-"), (None, "-"))


def models_of_multiplicity(laws: xr.Dataset, effect: xr.Dataset) -> Figure:
    """Six panels: multiplicity fraction, mean mass ratio and median axis by mass; axes of two stars; mean x.

    Parameters
    ----------
    laws : Dataset
        From `comparison.laws_by_mass`: M_sun, au, dex.
    effect : Dataset
        From `comparison.mean_x_by_model`: arcsec², mag.

    Returns
    -------
    figure : Figure
        Ready to be written.
    """
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(10.2, 6.2), layout="constrained")
        axes = figure.subplots(2, 3)
        by_mass = (
            ("multiplicity_fraction", "multiplicity fraction"),
            ("mean_mass_ratio", "mean mass ratio"),
            ("median_axis", "median semi-major axis [au]"),
        )
        for axis, (name, label) in zip(axes[0], by_mass, strict=True):
            _lines(axis, laws, "mass", name)
            axis.set_xscale("log")
            _ticks(axis.xaxis, (0.1, 0.2, 0.5, 1.0))
            axis.set_xlabel(r"mass of the primary [M$_\odot$]")
            axis.set_ylabel(label)
        axes[0, 2].set_yscale("log")
        _ticks(axes[0, 2].yaxis, (2, 5, 10, 20, 50))
        axes[0, 0].set_ylim(0, 0.7)
        for axis, star in zip(axes[1], laws["star"].to_numpy(), strict=False):
            _lines(axis, laws.sel(star=star), "log_a", "density")
            axis.set_xlabel("log semi-major axis [au]")
            axis.set_ylabel("companions per dex")
            axis.set_title(rf"{star} M$_\odot$", fontsize=9)
            axis.set_ylim(0, 0.62)
        _effect(axes[1, 2], effect)
        handles, labels = axes[1, 2].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=8, frameon=False, fontsize=8)
    return figure


def _ticks(axis: Any, at: tuple[float, ...]) -> None:
    """Labels of a logarithmic axis in plain numbers."""
    axis.set_major_locator(FixedLocator(at))
    axis.set_major_formatter(FixedFormatter([f"{value:g}" for value in at]))
    axis.set_minor_formatter(NullFormatter())


def _style(number: int) -> dict[str, Any]:
    colour, line = _LINES[number % len(_LINES)]
    if colour is None:
        return {"color": "k", "linestyle": line, "linewidth": 2.0}
    return {"color": COLOURS[colour], "linestyle": line, "linewidth": 1.2}


def _lines(axis: Any, laws: xr.Dataset, along: str, name: str) -> None:
    """One line for each model."""
    for number, model in enumerate(laws["model"].to_numpy()):
        axis.plot(laws[along], laws[name].sel(model=model), **_style(number))


def _effect(axis: Any, effect: xr.Dataset) -> None:
    """Mean x against magnitude, lines with eccentric orbits, symbols with circles."""
    middle = 0.5 * (effect["mag_lo"] + effect["mag_hi"])
    for number, model in enumerate(effect["model"].to_numpy()):
        style, here = _style(number), effect["mean_x"].sel(model=model)
        axis.plot(middle, 1e6 * here.sel(orbits="eccentric"), label=str(model), **style)
        axis.plot(middle, 1e6 * here.sel(orbits="circular"), "o", color=style["color"], markersize=2.5)
    axis.set_yscale("log")
    _ticks(axis.yaxis, (0.5, 1, 2, 5, 10))
    axis.set_xticks(np.arange(16, 24))
    axis.set_xlabel("i [mag]")
    axis.set_ylabel(r"$\langle x\rangle$ [$10^{-6}$ arcsec$^2$]")
