"""What `correct` shows and writes: corrected shapes and what is left as lines, a table and a figure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from porrima.io import write_rows_and_figure

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.figure import Figure

__all__ = ["CORRECT_COLUMNS", "correct_header", "correct_lines", "write_correction"]

MOST_LINES = 40
"""Patches that are shown on a terminal (count)."""

CORRECT_COLUMNS = [
    "patch",
    "quantity",
    "measured",
    "corrected",
    "error",
    "model",
    "choices",
    "scatter",
    "measurement",
]
"""Heads of the table for the terminal."""


def correct_lines(answer: dict[str, Any]) -> list[list[Any]]:
    """Lines of corrections for the terminal: shapes of the PSF, then what is left in shear.

    Parameters
    ----------
    answer : dict
        From `remedy.corrected`, dimensionless and arcsec².

    Returns
    -------
    lines : list of list
        Under `CORRECT_COLUMNS`, of the first `MOST_LINES` patches; m and c as they were before, and left to be 0.
    """
    first = list(dict.fromkeys(row["patch"] for row in answer["values"]))[:MOST_LINES]
    lines = []
    for patch in first:
        for row in answer["values"]:
            if row["patch"] == patch:
                size = row["quantity"] == "r2"
                lines.append(_line(row, row["quantity"], "measured", "corrected", 6 if size else 5))
        for row in answer["shear"]:
            if row["patch"] == patch:
                lines.append(_line(row, f"{row['quantity']} ({row['group']})", "before", "after", 3))
    return lines


def _line(row: dict[str, Any], name: str, before: str, after: str, digits: int) -> list[Any]:
    """One quantity; what does not stand in the answer stays empty."""
    choices = [row.get("choice_low"), row.get("choice_high")]
    shift = "" if None in choices else " ".join(f"{value:+.1e}" for value in choices)
    parts = [row["error"], row.get("model_error"), shift, row.get("scatter"), row.get("measurement_error")]
    numbers = [row.get(before), row.get(after, 0.0)]
    return [
        row["patch"],
        name,
        *(("" if v is None else f"{v:.{digits}g}") for v in numbers),
        *(v if isinstance(v, str) else "" if v is None else f"{v:.2g}" for v in parts),
    ]


def correct_header(answer: dict[str, Any]) -> str:
    """Lines above the table on the terminal.

    Parameters
    ----------
    answer : dict
        From `remedy.corrected`.

    Returns
    -------
    header : str
        What was done with what; the fits, where samples of stars were fitted; dimensionless.
    """
    config = answer["configuration"]
    with_model = (
        "" if config is None else f", {config['multiplicity']['model']}, cut {answer['cut']:g} arcsec"
    )
    lines = [f"{answer['method']}: {answer['psf']}, {answer['estimator']}{with_model}"]
    for fit in answer.get("fits", [])[:MOST_LINES]:
        best = fit["best_error_r2"]
        split = "" if best is None else f"; {best:.2g} with the stars shared best, scatter alone"
        lines.append(
            f"patch {fit['patch']}: {fit['n_samples']} samples, amplitude {fit['amplitude']:.3g} ± "
            f"{fit['amplitude_error']:.2g}, chi² {fit['chi2']:.3g} for {fit['n_dof']}, relative error of R² "
            f"{fit['error_r2']:.2g}{split}"
        )
    return "\n".join(lines)


def write_correction(answer: dict[str, Any], table: Path | None, picture: Path | None) -> None:
    """Corrected shapes as a table (ECSV), with what they were made with, and as a figure.

    Parameters
    ----------
    answer : dict
        From `remedy.corrected`, dimensionless and arcsec².
    table, picture : Path or None
        Files to write; none where not given.

    Returns
    -------
    None
        The result is the files.

    Raises
    ------
    InputError
        If one cannot be written.
    """

    def draw() -> Figure:
        from porrima.diagrams import corrections  # noqa: PLC0415  (slow to import, where used)

        return corrections(answer)

    made_with = {key: value for key, value in answer.items() if not isinstance(value, list)}
    write_rows_and_figure(answer["values"], table, draw, picture, made_with)
