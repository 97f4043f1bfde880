"""Tables of the page: records with all their digits, and the cells that are shown of them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from porrima.page import Table, plain, quoted, words
from porrima.summary import rows

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    import xarray as xr

    Parts = dict[str, xr.Dataset]

__all__ = ["claim_numbers", "table_of"]

_HEADS = (
    "PSF", "quantity", "binary fraction", "stacks", "bias", "predicted", "σ", "predicted", "sd", "predicted",
)  # fmt: skip
_QUANTITIES = {"r2": Markup("R²"), "e1": Markup("e<sub>1</sub>"), "e2": Markup("e<sub>2</sub>")}
_WIDEST = 10  # columns shown; all are in the files
_WIDER = 12  # of the table that has many
_SCANS = {"l = 0": "latitude at l = 0°", "l = 180": "latitude at l = 180°", "b = 45": "longitude at b = 45°"}


def table_of(kind: str, name: str, title: str, parts: Parts) -> Table:
    """Table of an experiment.

    Parameters
    ----------
    kind : str
        What the experiment is like.
    name, title : str
        Of the experiment.
    parts : dict
        Its datasets.

    Returns
    -------
    table : Table
        For the page, with all digits to take away.
    """
    if kind in _RECORDS:
        return _plain(name, title, list(_RECORDS[kind](parts)))
    return _statistics(name, title, list(_of_stacks(parts)))


def claim_numbers(records: Sequence[Mapping[str, Any]]) -> Table:
    """Table of the numbers behind the verdicts.

    Parameters
    ----------
    records : sequence of dict
        From `claims.numbers_of`.

    Returns
    -------
    table : Table
        One row for each number.
    """
    shown = [
        [
            one["claim"], one["part"], one["quantity"], quoted(one["value"]),
            quoted(one["error"], 2) if one["error"] else "exact", quoted(one["least"]), quoted(one["largest"]),
            plain(one["slack"]), "yes" if one["fits"] else "no", one["under"] or "–",
        ]
        for one in records
    ]  # fmt: skip
    return Table(
        name="claim_numbers",
        label="Numbers behind the verdicts",
        caption="Every number, its standard error and the limits for it; slack: standard errors by which it "
        "may lie outside (negative: must lie inside); under: the assumption of the paper that was made",
        heads=("claim", "part", "number", "value", "error", "least", "largest", "slack", "fits", "under"),
        rows=shown,
        n_labels=3,
        records=[
            {key: value if not isinstance(value, float) or math.isfinite(value) else math.nan
             for key, value in one.items()}
            for one in records
        ],
    )  # fmt: skip


def _by_direction(parts: Parts) -> Iterator[dict[str, Any]]:
    """One record for each direction of each scan."""
    sky = parts["sky"]
    for scan in sky["scan"].to_numpy().tolist():
        here = sky.sel(scan=scan).dropna("angle", subset=["n_per_deg2"])
        for k in range(here.sizes["angle"]):
            one = here.isel(angle=k)
            yield (
                {"along": _SCANS[scan], "angle": float(one["angle"])}
                | {
                    f"stars {kind}": float(one["share"].sel(mass_class=kind))
                    for kind in one["mass_class"].to_numpy()
                }
                | {
                    f"binary fraction, {rule} row": float(one["binary_fraction"].sel(gap_rule=rule))
                    for rule in one["gap_rule"].to_numpy()
                }
                | {"stars per deg²": float(one["n_per_deg2"])}
            )


def _by_magnitude(parts: Parts) -> Iterator[dict[str, Any]]:
    """One record for each model and bin."""
    data = parts["magnitude"]
    for model in data["model"].to_numpy().tolist():
        for k in range(data.sizes["bin"]):
            one = data.sel(model=model).isel(bin=k)
            names = ("mag_lo", "mag_hi", "mean_x", "mean_x_low", "mean_x_high")
            yield (
                {"model": model}
                | {name: float(one[name]) for name in names}
                | {
                    f"{name}, {psf}": float(one[name].sel(psf=psf))
                    for name in ("limit_e", "limit_r2")
                    for psf in one["psf"].to_numpy()
                }
            )


def _by_contrast(parts: Parts) -> Iterator[dict[str, Any]]:
    """One record for each contrast of the toy model."""
    found = parts["findings"]
    for dm in found["delta_m"].to_numpy().tolist():
        here = found.sel(delta_m=dm)
        yield {
            "companion": "as bright" if dm == 0 else "fainter",
            "Δm [mag]": dm,
            "Δe/e at most": float(here["de_rel_at_0_01"]),
            "ΔR²/R² at most": float(here["dr2_rel_at_0_01"]),
            "one per cent at [arcsec]": float(here["radius_of_1_percent"]),
        }


def _by_symbol(parts: Parts) -> Iterator[dict[str, Any]]:
    """One record for each symbol of the sketch."""
    found = parts["findings"]
    for symbol, meaning, name, unit in (
        ("f", "intensity of the companion over that of the primary", "flux_ratio", ""),
        ("δx", "companion from the primary", "dx", "arcsec"),
        ("δy", "companion from the primary", "dy", "arcsec"),
        ("r", "separation", "separation", "arcsec"),
        ("(x̄, ȳ)", "distance of the photocentre from the primary", "shift", "arcsec"),
        ("x", "what the pair adds to R²", "x_second", "arcsec²"),
    ):
        yield {"symbol": symbol, "meaning": meaning, "value": float(found[name]), "unit": unit}


def _by_row(parts: Parts) -> Iterator[dict[str, Any]]:
    """One record for each row of the multiplicity table, as printed and as each model reads it."""
    table = parts["table"]
    heads = ("from [M☉]", "to [M☉]", "MF", "down", "up", "γ", "± γ", "a [au]", "σ of log P", "σ of log a",
             "largest a [au]", "CF", "± CF")  # fmt: skip
    printed = ("mass_lo", "mass_hi", "multiplicity_fraction", "multiplicity_fraction_down", "multiplicity_fraction_up",
               "mass_ratio_exponent", "mass_ratio_exponent_error", "mean_separation", "scatter_log_period", "", "",
               "companion_frequency", "companion_frequency_error")  # fmt: skip
    read = ("mass_lo", "mass_hi", "read_multiplicity_fraction", "", "", "read_mass_ratio_exponent", "",
            "read_separation", "", "read_scatter_log_a", "read_largest_separation", "", "")  # fmt: skip
    rows_of = [("printed", table, printed, "multiplicity_fraction")]
    rows_of += [
        (model, table.sel(model=model), read, "read_multiplicity_fraction")
        for model in table["model"].to_numpy().tolist()
    ]
    for reading, data, names, needed in rows_of:
        there = data.dropna("row", subset=[needed])
        for k in range(there.sizes["row"]):
            values = [float(there[name][k]) if name else math.nan for name in names]
            yield {"reading": reading} | dict(zip(heads, values, strict=True))


def _by_psf(parts: Parts) -> Iterator[dict[str, Any]]:
    """One record for each PSF of the paper."""
    table = parts["table"]
    heads = {
        "e1": "e1", "e2": "e2", "e": "e", "angle_printed": "printed [deg]", "angle": "angle [deg]",
        "fwhm_printed": "FWHM, printed [″]", "fwhm": "FWHM [″]", "r2_0": "R² [arcsec²]",
        "r2_0_optical": "R², optical", "e1_measured": "e1, measured", "e2_measured": "e2, measured",
    }  # fmt: skip
    for psf in table["psf"].to_numpy().tolist():
        here = table.sel(psf=psf)
        yield {"PSF": psf} | {head: float(here[name]) for name, head in heads.items()}


def _of_stacks(parts: Parts) -> Iterator[dict[str, Any]]:
    """One record for each PSF, quantity and bin of binary fraction, and number of stars where there are several."""
    if "numbers" not in parts:
        yield from rows(parts["summary"])
        return
    numbers = parts["numbers"]
    for n in numbers["n_stars"].to_numpy().tolist():
        for row in rows(numbers.sel(n_stars=n)):
            yield {"n_stars": n} | row


_RECORDS: dict[str, Callable[[Parts], Iterator[dict[str, Any]]]] = {
    "toy": _by_contrast, "sketch": _by_symbol, "multiplicity_table": _by_row, "population": _by_direction,
    "psf_table": _by_psf, "magnitude": _by_magnitude,
}  # fmt: skip


def _statistics(name: str, label: str, records: list[dict[str, Any]]) -> Table:
    """Bias, error and scatter with their standard errors beside the predictions."""
    many = "n_stars" in records[0]
    shown = [
        [
            *([plain(row["n_stars"])] if many else []),
            row["psf"],
            _QUANTITIES[row["quantity"]],
            Markup("{}–{}").format(plain(row["f_lo"]), plain(row["f_hi"])),
            plain(row["n_stacks"]),
            *(cell for one in ("bias", "sigma", "sd") for cell in _compared(row, one)),
        ]
        for row in records
    ]
    return Table(
        name=name,
        label=label,
        caption=Markup("Bias, rms error σ and scatter sd, with standard errors, in units of 10<sup>−3</sup>"),
        heads=(*(("stars",) if many else ()), *_HEADS),
        rows=shown,
        n_labels=3 if many else 2,
        records=records,
    )


def _compared(row: dict[str, Any], name: str) -> tuple[Markup, Markup]:
    """A simulated number with its standard error, and the predicted one."""
    value, error, predicted = (
        quoted(row[key], 4, scale=1e-3, fixed=True) for key in (name, f"{name}_se", f"prediction_{name}")
    )
    return Markup("{} ± {}").format(value, error), predicted


def _plain(name: str, label: str, records: list[dict[str, Any]]) -> Table:
    """Records as they are, with some figures; the first columns of them."""
    digits = 4 if name == "psf_table" else 3
    heads = tuple(records[0])[: _WIDER if name == "multiplicity_table" else _WIDEST]
    return Table(
        name=name,
        label=label,
        caption=words(f"{name}_table", {}),
        heads=heads,
        rows=[
            [row[head] if isinstance(row[head], str) else quoted(row[head], digits) for head in heads]
            for row in records
        ],
        n_labels=next(
            (k for k, head in enumerate(heads) if not isinstance(records[0][head], str)), len(heads)
        ),
        records=records,
    )
