"""The figure of what surveys see of pairs: detection probability by separation and contrast.  It computes nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from matplotlib import rc_context
from matplotlib.figure import Figure

from porrima.figures import RED, STYLE

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["detection_maps"]

LEVELS = (0.1, 0.5, 0.9)
"""Of the contours (probability)."""


def detection_maps(maps: xr.Dataset) -> Figure:
    """Probability that a pair is recognised: a row per survey, a column per magnitude.

    Parameters
    ----------
    maps : Dataset
        ``probability`` over (survey, magnitude, contrast, separation), dimensionless; contrast in mag, separation in
        arcsec; the attribute ``cut`` is a separation to be marked, in arcsec.

    Returns
    -------
    figure : Figure
        Ready to be written.
    """
    with rc_context(STYLE):  # type: ignore[arg-type]
        shape = maps.sizes["survey"], maps.sizes["magnitude"]
        figure = Figure(figsize=(2.6 * shape[1] + 0.9, 2.5 * shape[0] + 0.3), layout="constrained")
        axes = figure.subplots(*shape, sharex=True, sharey=True, squeeze=False)
        for row, survey in zip(axes, maps["survey"].to_numpy(), strict=True):
            for axis, magnitude in zip(row, maps["magnitude"].to_numpy(), strict=True):
                mesh = _map(
                    axis, maps["probability"].sel(survey=survey, magnitude=magnitude), maps.attrs["cut"]
                )
                axis.set_title(f"{survey}, {magnitude:g} mag", fontsize=9)
            row[0].set_ylabel("contrast [mag]")
        for axis in axes[-1]:
            axis.set_xlabel("separation [arcsec]")
        bar = figure.colorbar(mesh, ax=axes, label="probability of detection", pad=0.01)
        for level in LEVELS:
            bar.ax.axhline(level, color=RED, linewidth=1.0)
    return figure


def _map(axis: Any, probability: xr.DataArray, cut: float) -> Any:
    """One panel: shades, three contours, the cut."""
    place = probability["separation"], probability["contrast"]
    mesh = axis.pcolormesh(
        *place, probability, vmin=0, vmax=1, cmap="Blues", shading="gouraud", rasterized=True
    )
    axis.contour(*place, probability, levels=LEVELS, colors=RED, linewidths=(0.7, 1.2, 0.7))
    axis.axvline(cut, color="#e69f00", linestyle="--", linewidth=1.2)
    axis.set_xscale("log")
    axis.set_xticks([0.01, 0.02, 0.05, 0.1], ["0.01", "0.02", "0.05", "0.1"])
    axis.set_xticks([], minor=True)
    return mesh
