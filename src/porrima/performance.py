"""What `bench` measured, as it is shown: lines for the terminal, tables for a document, files in a folder."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from porrima.figures import performance
from porrima.files import make_folder, write_json, write_whole
from porrima.io import write_figure
from porrima.markdown import markdown_table, with_text_between

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["lines", "tables", "with_tables", "write_performance"]

BEGIN, END = "<!-- from bench.json -->", "<!-- end -->"
"""Where the tables lie in a document."""

NAMES = {
    "moments": "engine, moments",
    "shapes": "engine, moments and shapes",
    "floor": "random numbers alone",
    "galsim-stars": "GalSim, star by star",
    "galsim-sum": "GalSim, one draw per stack",
    "fft": "numpy, histogram and FFT",
    "response": "response",
    "stamps": "Porrima, on pixels",
    "hsm": "HSM",
}
"""Of what is measured, in words."""


def lines(result: dict[str, Any]) -> list[list[str]]:
    """A result for the terminal.

    Parameters
    ----------
    result : dict
        From `bench.bench`.

    Returns
    -------
    lines : list of [what, value, unit]
        Machine, speeds, ratios, shapes, cost and memory.
    """
    told = [
        [key.replace("_", " "), str(result[key]), ""]
        for key in ("processor", "threads", "vector_bits", "gpu")
    ]
    for row in result["speeds"]:
        told.append([f"{_name(row, 'who')}, {_where(row)}", _number(row, "stars_per_s", 1e-3), "10³ stars/s"])
    for row in result["ratios"]:
        told.append(
            [f"ratio to {_name(row, 'against')}, {_where(row)}", _number(row, "ratio"), "with shapes"]
        )
        told.append(["", _number(row, "ratio_moments"), "moments alone"])
    for row in result["shape_speeds"]:
        told.append(
            [f"{NAMES[row['measurer']]}, {row['psf']}", _number(row, "shapes_per_s", 1e-3), "10³ shapes/s"]
        )
    for row in [*result["cost_of_stars"], *result["cost_of_stacks"]]:
        label = f"{_grouped(row['n_stacks'])} stacks of {_grouped(row['n_stars'])} stars, with shapes"
        told.append([label, _number(row, "us_per_stack_with_shape"), "µs per stack"])
    for row in result["memory"]:
        label = f"run of {_grouped(row['n_stacks'])} stacks of {row['n_stars']} stars, peak memory"
        told.append([label, f"{row['peak_mb']:.0f}", "MB"])
    return told


def tables(result: dict[str, Any]) -> str:
    """A result as Markdown.

    Parameters
    ----------
    result : dict
        From `bench.bench`, or read from its file.

    Returns
    -------
    text : str
        The machine in a sentence, then a table for each list of the result.
    """
    speeds, ratios = result["speeds"], result["ratios"]
    shapes, stars, stacks = (result[key] for key in ("shape_speeds", "cost_of_stars", "cost_of_stacks"))
    return "\n\n".join(
        [
            _machine(result),
            "Speed, in 10³ stars per second:",
            _pivot(speeds, "who", "stars_per_s", 1e-3),
            "Engine with shapes, over:",
            _pivot(ratios, "against", "ratio"),
            "Engine with moments alone, over:",
            _pivot(ratios, "against", "ratio_moments"),
            "Shapes of stacks of 40 stars:",
            markdown_table(
                ["measured by", "PSF", "10³ shapes/s", "over HSM"],
                [
                    [NAMES[row["measurer"]], row["psf"], _number(row, "shapes_per_s", 1e-3), _over_hsm(row)]
                    for row in shapes
                ],
            ),
            "Cost against the stars in a stack, in ns per star:",
            markdown_table(
                ["stars in a stack", "stacks", "moments", "with shapes"],
                [
                    [_grouped(row["n_stars"]), _grouped(row["n_stacks"]), *_costs(row, 1e3 / row["n_stars"])]
                    for row in stars
                ],
            ),
            "Cost against the number of stacks of 40 stars, in µs per stack:",
            markdown_table(
                ["stacks", "moments", "with shapes"],
                [[_grouped(row["n_stacks"]), *_costs(row, 1.0)] for row in stacks],
            ),
            "Memory of whole runs (`porrima simulate`, one PSF, stacks of 40 stars):",
            markdown_table(
                ["stacks", "peak memory [MB]", "wall time [s]"],
                [
                    [_grouped(r["n_stacks"]), f"{r['peak_mb']:.0f}", f"{r['run_s']:.1f}"]
                    for r in result["memory"]
                ],
            ),
        ]
    )


def with_tables(document: str, result: dict[str, Any]) -> str:
    """A document with the tables of a result between its two markers.

    Parameters
    ----------
    document : str
        Markdown; without both `BEGIN` and `END` it stays as it is.
    result : dict
        From `bench.bench`.

    Returns
    -------
    document : str
        The rest of it unchanged.
    """
    return with_text_between(document, BEGIN, END, tables(result))


def write_performance(result: dict[str, Any], folder: Path) -> None:
    """Numbers, figure and tables of a result in a folder, made where it is not there.

    Parameters
    ----------
    result : dict
        From `bench.bench`.
    folder : Path
        Gets ``bench.json``, ``performance.png`` and ``performance.svg``; a ``performance.md`` that is there and has
        the two markers gets the tables.

    Returns
    -------
    None
        The result are the files, each whole.
    """
    make_folder(folder)
    write_json(result, folder / "bench.json")
    figure = performance(result)
    for suffix in ("png", "svg"):
        write_figure(figure, folder / f"performance.{suffix}")
    page = folder / "performance.md"
    if page.is_file():
        document = with_tables(page.read_text(encoding="utf-8"), result)
        write_whole(page, lambda path: path.write_text(document, encoding="utf-8"))


def _machine(result: dict[str, Any]) -> str:
    memory = "" if result["memory_gb"] is None else f", {result['memory_gb']:.0f} GB of memory"
    gpu = "" if result["gpu"] is None else f", GPU {result['gpu']}"
    return (
        f"{result['processor']}, {result['threads']} threads on {result['cores']} cores, vectors of "
        f"{result['vector_bits']} bits ({result['vector_features']}){memory}{gpu}; {result['versions']}. "
        f"Median of {result['rounds']} rounds and its standard error; seed {result['seed']}."
    )


def _name(row: dict[str, Any], key: str) -> str:
    return NAMES[row[key]] + ("" if row["device"] == "cpu" else f" ({row['device']})")


def _where(row: dict[str, Any]) -> str:
    return f"{row['psf']}, {_grouped(row['n_stars'])} stars"


def _over_hsm(row: dict[str, Any]) -> str:
    return "1" if row["measurer"] == "hsm" else _number(row, "ratio_to_hsm")


def _costs(row: dict[str, Any], factor: float) -> list[str]:
    return [_number(row, key, factor) for key in ("us_per_stack", "us_per_stack_with_shape")]


def _number(row: dict[str, Any], key: str, factor: float = 1.0) -> str:
    """Number and error, to two figures of the error."""
    value, error = factor * row[key], factor * row[f"{key}_error"]
    digits = max(0, 1 - math.floor(math.log10(error))) if error > 0 else 3
    return f"{_grouped(value, digits)} ± {_grouped(error, digits)}"


def _grouped(value: float, digits: int = 0) -> str:
    return f"{value:,.{digits}f}".replace(",", " ")


def _pivot(rows: list[dict[str, Any]], key: str, value: str, factor: float = 1.0) -> str:
    """Table with a line for each name and a column for each kind of stack."""
    columns = list(dict.fromkeys(_where(row) for row in rows))
    names = list(dict.fromkeys(_name(row, key) for row in rows))
    cells = {(_name(row, key), _where(row)): _number(row, value, factor) for row in rows}
    return markdown_table(
        ["", *columns], [[name, *(cells.get((name, column), "") for column in columns)] for name in names]
    )
