"""The figure of stacks of few and many stars: scatter and quantiles, predicted and simulated.  It computes nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from matplotlib import rc_context
from matplotlib.figure import Figure

from porrima.figures import COLOURS, MARKERS, STYLE

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["scatter_of_stacks"]


def scatter_of_stacks(stacks: xr.Dataset) -> Figure:
    """Three panels against the number of stars: scatter of R² and of e1 over its first-order form, and quantiles.

    Parameters
    ----------
    stacks : Dataset
        Simulated: ``ratio`` of the scatter to its first-order form and ``ratio_se`` over (case, quantity, n_stars),
        ``quantile`` and the ends of what its error allows, ``quantile_lo`` and ``quantile_hi``, over (case,
        probability, n_stars).  Predicted: ``ratio_predicted`` over (case, quantity, n_line) and
        ``quantile_predicted`` over (probability, n_line), for the last case.  Dimensionless.

    Returns
    -------
    figure : Figure
        Ready to be written.
    """
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(10.2, 3.6), layout="constrained")
        axes = figure.subplots(1, 3)
        for axis, quantity, label in zip(
            axes, ("r2", "e1"), (r"$\mathrm{sd}(R^2)$", r"$\mathrm{sd}(e_1)$"), strict=False
        ):
            _scatter(axis, stacks, quantity)
            axis.set_ylabel(f"{label} over its first-order form")
        _quantiles(axes[2], stacks.isel(case=-1))
        for axis in axes:
            axis.set_xscale("log")
            axis.set_xlabel(r"stars in a stack, $N_\star$")
        handles, labels = axes[0].get_legend_handles_labels()
        axes[0].legend(
            handles,
            labels,
            frameon=False,
            fontsize=8,
            loc="upper right",
            title="simulated, and predicted (lines)",
        )
    return figure


def _scatter(axis: Any, stacks: xr.Dataset, quantity: str) -> None:
    """Scatter of one quantity over its first-order form: symbols simulated, lines predicted."""
    axis.axhline(1.0, color="0.5", linewidth=0.8, linestyle=":")
    n = stacks["n_stars"].to_numpy()
    for k, case in enumerate(stacks["case"].to_numpy()):
        here = stacks.sel(case=case, quantity=quantity)
        colour = COLOURS[k]
        axis.errorbar(
            n * 1.06 ** (k - 1.5), here["ratio"], yerr=here["ratio_se"],
            color=colour, marker=MARKERS[k], markersize=3.6, linestyle="none", linewidth=0.9, label=str(case),
        )  # fmt: skip
        axis.plot(here["n_line"], here["ratio_predicted"], color=colour, linewidth=1.1)


def _quantiles(axis: Any, stacks: xr.Dataset) -> None:
    """Quantiles of the size error of one case: symbols simulated, lines predicted."""
    n = stacks["n_stars"].to_numpy()
    for k, probability in enumerate(stacks["probability"].to_numpy()):
        here = stacks.sel(probability=probability)
        value = here["quantile"].where(here["quantile"] > 0)
        error = [value - here["quantile_lo"].clip(min=1e-12), here["quantile_hi"] - value]
        colour, marker = (*COLOURS, "0.25")[k % 7], (*MARKERS, "x")[k % 7]
        axis.errorbar(
            n, value, yerr=error, color=colour, marker=marker, markersize=3.6,
            linestyle="none", linewidth=0.9, label=f"{100 * float(probability):g} %",
        )  # fmt: skip
        predicted = here["quantile_predicted"]
        axis.plot(here["n_line"], predicted.where(predicted > 1e-9), color=colour, linewidth=1.1)
    axis.set_yscale("log")
    axis.set_ylim(3e-5, 0.2)
    axis.set_ylabel(r"quantiles of $\delta R^2/R_0^2$")
    axis.legend(frameon=False, fontsize=8, ncols=2, title=str(stacks["case"].to_numpy()))
