"""What `select` shows and writes: the best stars, what comes near them, a table, a figure and all numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from porrima.errors import InputError
from porrima.files import make_folder, write_json
from porrima.io import write_rows_and_figure

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.figure import Figure

__all__ = ["SELECT_COLUMNS", "prepared", "select_header", "select_lines", "write_advice"]

FAINT = "20 mag and fainter, no clip"
"""The advice that the paper ends with, by its name among the runners-up."""

SELECT_COLUMNS = [
    "stars", "mag", "clip", "exposures", "N", "kept", "merit", "e", "R2", "R2 by pairs", "by clip", "scatter", "noise",
    "m",
]  # fmt: skip
"""Heads of the table for the terminal; merit, e and R2 over the requirement, the rest of R2 in units of 1e-4."""


def select_lines(answer: dict[str, Any]) -> list[list[Any]]:
    """Lines of a choice for the terminal: the best setting, then the best of each kind of advice.

    Parameters
    ----------
    answer : dict
        From `advice.advised`, dimensionless and mag.

    Returns
    -------
    lines : list of list
        Under `SELECT_COLUMNS`.
    """
    return [_line("best", answer["best"])] + [_line(row["advice"], row) for row in answer["runners_up"]]


def _line(name: str, row: dict[str, Any]) -> list[Any]:
    """One setting."""
    size = [f"{1e4 * row[f'{part}_r2']:.2f}" for part in ("binaries", "clip_bias", "scatter", "noise")]
    shares = [row["share_e1"], row["share_e2"]]
    e = max((share for share in shares if share is not None), default=None)
    return [
        name,
        f"{row['mag_lo']:g}-{row['mag_hi']:g}",
        _clip(row["clip"]),
        str(row["n_exposures"]),
        f"{row['n_stars']:.0f}",
        f"{100 * row['kept_share']:.0f} %",
        f"{row['merit']:.3g}",
        "" if e is None else f"{e:.3g}",
        "" if row["share_r2"] is None else f"{row['share_r2']:.3g}",
        *size,
        f"{row['m']:+.1e}",
    ]


def _clip(value: float | None) -> str:
    return "none" if value is None else f"{100 * value:.2g} %"


def select_header(answer: dict[str, Any]) -> str:
    """Lines above the table on the terminal.

    Parameters
    ----------
    answer : dict
        From `advice.advised`.

    Returns
    -------
    header : str
        What was chosen, how well it is known, how flat it is, and what fainter stars do; deg², mag and dimensionless.
    """
    best, good = answer["best"], answer["as_good"]
    limits = [
        f"{name} {answer[f'required_{name}']:g}"
        for name in ("sigma_e", "sigma_r2")
        if answer[f"required_{name}"] is not None
    ]
    model = answer["configuration"]["multiplicity"]["model"]
    others = ", ".join(f"{row['model']} {row['merit']:.3g}" for row in answer["models"])
    lines = [
        f"{answer['survey']}: {answer['requirement']}, {', '.join(limits)}; {answer['psf']}, {answer['estimator']}, "
        f"{model}, patches of {answer['patch_area']:.3g} deg², weights {answer['weights']}, clip about "
        f"{'its own mean' if answer['centre'] == 'stack' else 'a known PSF'}, "
        f"{'from both sides' if answer['sides'] == 'both' else 'from above'}"
        + (", predicted bias taken off" if answer["corrected"] else ""),
        f"best: {best['mag_lo']:g}-{best['mag_hi']:g} mag, clip {_clip(best['clip'])}, {best['n_exposures']} "
        f"exposures: {best['merit']:.3g} of the requirement ({best['merit_low']:.3g} to {best['merit_high']:.3g}; "
        f"finite number of stars ± {best['merit_error']:.1g}); the same by {others}",
        f"as good to 10 %: bright limit {_span(good['bright_limit'])}, faint limit {_span(good['faint_limit'])} mag, "
        f"clip {_clip(good['clip'][0])} to {_clip(good['clip'][1])}, exposures "
        + ", ".join(map(str, good["n_exposures"])),
    ]
    faint = next((row for row in answer["runners_up"] if row["advice"] == FAINT), None)
    if faint is not None:
        lines.append(
            f'"use faint stars": {faint["mag_lo"]:g}-{faint["mag_hi"]:g} mag without a clip is '
            f"{faint['merit'] / best['merit']:.2g} times as far off as the best"
        )
    return "\n".join(lines)


def _span(ends: list[float]) -> str:
    return f"{ends[0]:g}" if ends[0] == ends[1] else f"{ends[0]:g} to {ends[1]:g}"


def prepared(folder: Path | None) -> None:
    """See that a folder can be written before anything is computed.

    Parameters
    ----------
    folder : Path or None
        To be made where it is not there; its parent must be.

    Returns
    -------
    None
        Nothing is made yet.

    Raises
    ------
    InputError
        If it cannot be.
    """
    if folder is None:
        return
    if folder.exists() and not folder.is_dir():
        raise InputError("must be a folder", key="output", value=folder)
    if not folder.exists() and not folder.absolute().parent.is_dir():
        raise InputError("cannot be made (No such folder)", key="output", value=folder)


def write_advice(answer: dict[str, Any], folder: Path | None) -> None:
    """Every setting as a table, ``select.ecsv``, the figure, ``select.png``, and all numbers, ``select.json``.

    Parameters
    ----------
    answer : dict
        From `advice.advised`, dimensionless and mag.
    folder : Path or None
        Made where it is not there; nothing is written where not given.

    Returns
    -------
    None
        The result is the files.
    """

    def draw() -> Figure:
        from porrima.choice_figure import choice_panels  # noqa: PLC0415  (slow to import, where used)

        return choice_panels(answer)

    if folder is None:
        return
    make_folder(folder)
    made_with = {key: value for key, value in answer.items() if not isinstance(value, list)}
    write_rows_and_figure(answer["settings"], folder / "select.ecsv", draw, folder / "select.png", made_with)
    write_json(answer, folder / "select.json")
