"""Which numbers decide on the paper's statements about the stars: the sky, the multiplicity table."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.evidence import Number, measure

if TYPE_CHECKING:
    from collections.abc import Callable

    from porrima.evidence import Evidence, Measure

__all__ = ["demography", "mean_fraction", "trends"]

_SOLAR_GAPS = "the gaps of the table take the values of solar-type stars"
_SEPARATION_ERROR = 0.25  # dex: the table gives none, see `multiplicity.ROW_ERRORS`


def mean_fraction(data: Evidence) -> list[Measure]:
    """Numbers for the mean binary fraction of main-sequence stars."""
    if not data.has("population"):
        return []
    sky, out = data.results["population"]["sky"], []
    for rule, under in (("lower", ""), ("solar", _SOLAR_GAPS)):
        fraction = sky["binary_fraction"].sel(gap_rule=rule)
        error = float(np.sqrt(sum(part**2 for part in _errors_of_rows(data, rule)[1])))
        out.append(
            measure(
                "mean",
                f"mean binary fraction, 16 to 24 mag, all directions (gaps: {rule} row)",
                Number(float(fraction.mean()), error),
                0.35,
                0.4,
                slack=1.0,
                under=under,
            )
        )
    return out


def _errors_of_rows(data: Evidence, rule: str) -> tuple[Any, list[float]]:
    """Share of the stars that take each row of the table, and what its error does to the mean fraction."""
    sky, table = data.results["population"]["sky"], data.results["multiplicity_table"]["table"]
    groups = {
        "lower": (("below 0.1",), ("0.1-0.5", "0.5-0.7"), ("0.7-1.5",)),
        "solar": (("below 0.1",), ("0.1-0.5",), ("0.5-0.7", "0.7-1.5")),
    }[rule]
    printed = table.dropna("row", subset=["multiplicity_fraction"])
    down, up = (printed[f"multiplicity_fraction_{way}"].to_numpy()[:3] for way in ("down", "up"))
    shares: list[Any] = [sum(sky["share"].sel(mass_class=name) for name in names) for names in groups]
    return shares, [float(share.mean()) * e for share, e in zip(shares, 0.5 * (down + up), strict=True)]


def _rise(data: Evidence, rule: str, scan: str, ends: Callable[[Any], tuple[Any, Any]]) -> Number:
    """Difference of the mean binary fraction between two directions of a scan, with that of the table's errors."""
    here = data.results["population"]["sky"].sel(scan=scan).dropna("angle", subset=["n_per_deg2"])
    fraction = here["binary_fraction"].sel(gap_rule=rule)
    low, high = ends(fraction)
    shares, errors = _errors_of_rows(data, rule)
    change, means = ([], [float(share.mean()) for share in shares])
    for share, error, mean in zip(shares, errors, means, strict=True):
        of_scan = share.sel(scan=scan)
        change.append(float(of_scan.sel(angle=high) - of_scan.sel(angle=low)) * error / mean if mean else 0.0)
    value = float(fraction.sel(angle=high) - fraction.sel(angle=low))
    return Number(value, float(np.sqrt(np.sum(np.square(change)))))


def _extremes(fraction: Any) -> tuple[Any, Any]:
    values = fraction.to_numpy()
    return fraction["angle"][int(np.argmin(values))], fraction["angle"][int(np.argmax(values))]


def _ends(fraction: Any) -> tuple[Any, Any]:
    return fraction["angle"][0], fraction["angle"][-1]


def demography(data: Evidence) -> list[Measure]:
    """Numbers for the stars and their binary fraction over the sky."""
    if not data.has("population"):
        return []
    sky, out = data.results["population"]["sky"], []
    for rule, under in (("lower", ""), ("solar", _SOLAR_GAPS)):
        for part, words, scan, ends, limits in (
            (
                "constant",
                "range of the binary fraction, b = 15° to 75°, l = 0°",
                "l = 0",
                _extremes,
                {"largest": 0.02},
            ),
            (
                "rising",
                "rise of the binary fraction, b = 15° to 75°, l = 180°",
                "l = 180",
                _ends,
                {"least": 0.02},
            ),
            (
                "longitude",
                "range of the binary fraction along b = 45°",
                "b = 45",
                _extremes,
                {"least": 0.005},
            ),
        ):
            number = _rise(data, rule, scan, ends)
            out.append(measure(part, f"{words} (gaps: {rule} row)", number, slack=1.0, under=under, **limits))
    away = sky.sel(scan="l = 180").dropna("angle", subset=["n_per_deg2"])
    share = away["share"].sel(mass_class="0.5-1.5")
    for k, least, largest in ((0, 0.0, 0.3), (-1, 0.4, 0.5)):
        p, angle = float(share[k]), float(share["angle"][k])
        error = math.sqrt(p * (1 - p) / float(away["n_per_deg2"][k]))
        out.append(
            measure(
                "0.5–1.5 M☉",
                f"share of 0.5–1.5 M☉ at l = 180°, b = {angle:g}°; error of 1 deg²",
                Number(p, error),
                least,
                largest,
            )
        )
    limit = float(sky["bright_limit"].max())
    return [
        *out,
        measure("above 1.5 M☉", "upper limit on the share above 1.5 M☉", Number(limit, 0.0), largest=0.002),
    ]


def trends(data: Evidence) -> list[Measure]:
    """Numbers for the trends of the multiplicity table."""
    if not data.has("multiplicity_table"):
        return []
    table = data.results["multiplicity_table"]["table"]
    rows = table.dropna("row", subset=["multiplicity_fraction"])
    mf, gamma = rows["multiplicity_fraction"].to_numpy(), rows["mass_ratio_exponent"].to_numpy()
    of_mf = [
        max(pair) if all(map(math.isfinite, pair)) else 0.0
        for pair in zip(
            rows["multiplicity_fraction_down"].to_numpy(),
            rows["multiplicity_fraction_up"].to_numpy(),
            strict=True,
        )
    ]
    of_gamma = rows["mass_ratio_exponent_error"].to_numpy()
    wide = rows.dropna("row", subset=["mean_separation"])["mean_separation"].to_numpy()

    def smallest(values: Any, errors: Any) -> Number:
        steps = np.diff(values)
        k = int(np.argmin(steps))
        return Number(float(steps[k]), math.hypot(errors[k], errors[k + 1]))

    return [
        measure(
            "more companions",
            "smallest step of the multiplicity fraction from row to row",
            smallest(mf, of_mf),
            least=0.0,
            slack=0.0,
        ),
        measure(
            "lighter companions",
            "smallest fall of the exponent of the mass ratio from row to row",
            smallest(-gamma, of_gamma),
            least=0.0,
            slack=0.0,
        ),
        measure(
            "wider orbits",
            "smallest step of the mean separation from row to row [dex]",
            smallest(np.log10(wide), [_SEPARATION_ERROR] * wide.size),
            least=0.0,
            slack=0.0,
        ),
    ]
