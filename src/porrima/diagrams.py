"""The figures of predictions: what they show was computed elsewhere."""

from __future__ import annotations

from typing import Any

from matplotlib import rc_context
from matplotlib.figure import Figure

from porrima.figures import COLOURS, STYLE

__all__ = ["budget_shares"]

_RED = "#b00020"
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
            axis.axhline(1.0, color=_RED, linestyle=":", linewidth=1.2)
            axis.set(yscale="log", xlabel="magnitude", title=_TITLES[group])
            axis.legend(frameon=False, fontsize=8)
        axes[0].set_ylabel("share of the requirement")
        highest = max(row["total_high"] / row["required"] for row in rows)
        axes[0].set_ylim(min(0.01, 0.3 * highest), max(2.0, 1.5 * highest))
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
