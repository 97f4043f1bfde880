"""The figure of a choice of stars: what the error is made of around the best setting.  It computes nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from porrima.figures import COLOURS, RED, STYLE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["choice_panels"]

_PARTS = (
    ("binaries", "bias by companions", COLOURS[1], "-"),
    ("clip_bias", "bias by the clip of noise", COLOURS[4], "-"),
    ("scatter", "scatter of companions", COLOURS[2], "--"),
    ("noise", "noise of the stars", COLOURS[0], "--"),
)


def choice_panels(answer: dict[str, Any]) -> Figure:
    """Four panels: merit against clip and faint limit; parts of the errors of R² and e against the clip; and advice.

    Parameters
    ----------
    answer : dict
        As `porrima select --json` prints it: errors over the requirement, dimensionless, against mag and clip.

    Returns
    -------
    figure : Figure
        The red dotted line is the requirement, the star the best setting.
    """
    with rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(11.4, 7.2), layout="constrained")
        axes = figure.subplot_mosaic([["merit", "r2", "e"], ["advice"] * 3], height_ratios=(1.0, 0.8))
        _merits(figure, axes["merit"], answer)
        _parts(axes["r2"], answer, "r2")
        worse = max(("e1", "e2"), key=lambda quantity: answer["best"][f"share_{quantity}"] or 0.0)
        _parts(axes["e"], answer, worse)
        axes["e"].legend(facecolor="white", edgecolor="none", fontsize=7.5, loc="lower left")
        _advice(axes["advice"], answer)
        figure.suptitle(
            f"{answer['survey']}: {answer['requirement']}, {answer['configuration']['multiplicity']['model']}, "
            f"patches of {answer['patch_area']:.2g} deg²",
            fontsize=10,
        )
    return figure


def _percent(clip: float | None, loosest: float) -> float:
    """Place of a clip on the axis: none stands beyond the loosest."""
    return 100 * (loosest * 2.4 if clip is None else clip)


def _loosest(answer: dict[str, Any]) -> float:
    return max((row["clip"] for row in answer["against_clip"] if row["clip"] is not None), default=0.1)


def _clip_axis(axis: Any, answer: dict[str, Any]) -> None:
    """Clips in percent, on a logarithmic axis with a place for none."""
    loosest = _loosest(answer)
    tightest = min((row["clip"] for row in answer["against_clip"] if row["clip"] is not None), default=0.002)
    axis.set_xscale("log")
    ticks = [t for t in (0.2, 0.5, 1.0, 2.0, 5.0, 10.0) if 100 * tightest <= 1.01 * t <= 102 * loosest]
    axis.set_xticks([*ticks, _percent(None, loosest)], [*(f"{t:g}" for t in ticks), "none"])
    axis.set_xticks([], minor=True)
    axis.set_xlabel(r"largest $|\delta R^2|/R_0^2$ of a star that is kept [%]")


def _merits(figure: Figure, axis: Any, answer: dict[str, Any]) -> None:
    """Merit over faint limit and clip, at the bright limit and the exposures of the best."""
    best, loosest = answer["best"], _loosest(answer)
    rows = [
        row
        for row in answer["settings"]
        if row["mag_lo"] == best["mag_lo"] and row["n_exposures"] == best["n_exposures"]
    ]
    faint = sorted({row["mag_hi"] for row in rows})
    clips = sorted({_percent(row["clip"], loosest) for row in rows})
    merit = np.full((len(faint), len(clips)), np.nan)
    for row in rows:
        merit[faint.index(row["mag_hi"]), clips.index(_percent(row["clip"], loosest))] = row["merit"]
    ratio = np.minimum(merit / best["merit"], 5.0)
    edges = np.append(np.array(faint) - 0.5, faint[-1] + 0.5)
    logs = np.log(clips)
    middle = 0.5 * (logs[1:] + logs[:-1])
    ends = np.exp([2 * logs[0] - middle[0], *middle, 2 * logs[-1] - middle[-1]]) if len(clips) > 1 else None
    if ends is not None:
        mesh = axis.pcolormesh(ends, edges, ratio, cmap="viridis_r", vmin=1, vmax=5, rasterized=True)
        bar = figure.colorbar(mesh, ax=axis, pad=0.01)
        bar.set_label("merit over the best (5: or more)")
    for y, row in zip(faint, ratio, strict=True):
        good = [c for c, value in zip(clips, row, strict=True) if value <= _FLAT]
        axis.plot(good, [y] * len(good), linestyle="none", marker="o", markersize=2.6, color="white")
    axis.plot(
        _percent(best["clip"], loosest),
        best["mag_hi"],
        marker="*",
        markersize=12,
        color=RED,
        markeredgecolor="white",
    )
    axis.set_yticks(faint)
    axis.set_ylim(edges[0], edges[-1])
    axis.set_ylabel("faint limit [mag]")
    axis.set_title(
        f"from {best['mag_lo']:g} mag, {best['n_exposures']} exposures; dots: within 10 %", fontsize=9
    )
    _clip_axis(axis, answer)


_FLAT = 1.1  # as `choice.FLAT`


def _parts(axis: Any, answer: dict[str, Any], quantity: str) -> None:
    """What the error of one quantity is made of, against the clip, over its requirement."""
    rows, loosest = answer["against_clip"], _loosest(answer)
    required = answer["required_sigma_r2" if quantity == "r2" else "required_sigma_e"]
    place = [_percent(row["clip"], loosest) for row in rows]
    unit = required or 1.0
    shown = []
    for part, label, colour, line in _PARTS:
        values = np.abs([row[f"{part}_{quantity}"] for row in rows]) / unit
        axis.plot(place, np.where(values > 0, values, np.nan), color=colour, linestyle=line, label=label)
        shown.append(values)
    total = [row[f"share_{quantity}"] for row in rows] if required is not None else shown[-1]
    if required is not None:
        axis.plot(place, total, color="black", linewidth=1.6, label="all")
    axis.axvline(_percent(answer["best"]["clip"], loosest), color="0.6", linewidth=0.8, linestyle=":")
    if required is not None:
        axis.axhline(1.0, color=RED, linestyle=":", linewidth=1.2)
    axis.set_yscale("log")
    axis.set_ylim(3e-3 * max(total), 3 * max(total))
    name = {"r2": "$R^2$", "e1": "$e_1$", "e2": "$e_2$"}[quantity]
    axis.set_ylabel(f"error of {name}" + (" over the requirement" if required is not None else ""))
    best = answer["best"]
    axis.set_title(
        f"{best['mag_lo']:g} to {best['mag_hi']:g} mag, {best['n_exposures']} exposures", fontsize=9
    )
    _clip_axis(axis, answer)


def _advice(axis: Any, answer: dict[str, Any]) -> None:
    """Merit of each kind of advice, the best with its interval."""
    best = answer["best"]
    rows = [("best", best), *((row["advice"], row) for row in answer["runners_up"])]
    for k, (_, row) in enumerate(rows):
        colour = RED if not k else COLOURS[0]
        axis.barh(-k, row["merit"], color=colour, alpha=0.75, height=0.62)
        clip = "no clip" if row["clip"] is None else f"{100 * row['clip']:.2g} %"
        what = f"{row['mag_lo']:g}–{row['mag_hi']:g} mag, {clip}, {row['n_stars']:.0f} stars"
        place = row["merit"] if k else max(row["merit"], best["merit_high"])
        axis.text(place, -k, f"  {what}", va="center", fontsize=7.5)
    low, high = best["merit_low"], best["merit_high"]
    axis.errorbar(
        best["merit"],
        0,
        xerr=[[best["merit"] - low], [high - best["merit"]]],
        color="black",
        linewidth=1.0,
        capsize=2,
    )
    axis.axvline(1.0, color=RED, linestyle=":", linewidth=1.2)
    axis.set_yticks([-k for k in range(len(rows))], [name for name, _ in rows], fontsize=7.5)
    axis.set_xlim(0, 1.3 * max(1.0, *(row["merit"] for _, row in rows)))
    axis.set_xlabel("largest rms error over the requirement")
