"""The paper's statements, each decided by numbers: what they are, how well they are known, and whether they fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
import yaml

from porrima.archive import fingerprint, keep, kept, source_key
from porrima.cache import content_key
from porrima.evidence import Evidence
from porrima.statement_rules import RULES

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from porrima.evidence import Measure

    Parts = dict[str, xr.Dataset]

__all__ = ["VERDICTS", "Judgement", "claims_kept", "claims_of", "judged", "numbers_of", "verdict_of"]

HOLDS, PARTLY, FAILS, OPEN = (
    "holds", "holds under the paper's assumption only", "does not hold", "not checked with these options",
)  # fmt: skip
VERDICTS = (HOLDS, PARTLY, FAILS, OPEN)
"""Of a statement: all its parts fit, all do if an assumption of the paper is made, one does not, no number is there."""

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_TEXTS = Path(__file__).parent / "data" / "report" / "statements.yaml"


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """What becomes of the measures of a statement.

    Parameters
    ----------
    verdict : str
        One of `VERDICTS`.
    deciding : Measure or None
        The number that stands for it: the first that does not fit where there is one, otherwise the first.
    failed : tuple of Measure
        Those without an assumption that do not fit.
    open_parts : tuple of str
        Parts of which there is no number.
    assumptions : tuple of str
        Those under which the parts fit that do not fit without.
    """

    verdict: str
    deciding: Measure | None
    failed: tuple[Measure, ...]
    open_parts: tuple[str, ...]
    assumptions: tuple[str, ...]


def verdict_of(measures: Sequence[Measure]) -> Judgement:
    """Verdict on a statement from its numbers alone.

    Parameters
    ----------
    measures : sequence of Measure
        Each of a part of the statement, with or without an assumption of the paper.

    Returns
    -------
    judgement : Judgement
        With the number that decides.

    Notes
    -----
    A part fits if all its numbers without an assumption fit.  It fits under an assumption if it has numbers with one
    and all these fit.  Numbers that are not there do not count.
    """
    parts = dict.fromkeys(m.part for m in measures)
    there = [m for m in measures if m.is_there]
    open_parts = tuple(part for part in parts if part not in {m.part for m in there})
    plain = [m for m in there if not m.under]
    failed = tuple(m for m in plain if not m.fits)
    assumed = {part: [m.fits for m in there if m.part == part and m.under] for part in parts}
    unmet = {m.part for m in failed} | ({m.part for m in there} - {m.part for m in plain})
    assumptions = tuple(dict.fromkeys(m.under for m in there if m.under and m.part in unmet))
    if not there:
        verdict = OPEN
    elif not unmet:
        verdict = HOLDS
    else:
        verdict = PARTLY if all(assumed[part] and all(assumed[part]) for part in unmet) else FAILS
    deciding = next(iter((*failed, *there)), None)
    return Judgement(
        verdict=verdict, deciding=deciding, failed=failed, open_parts=open_parts, assumptions=assumptions
    )


def judged(results: Mapping[str, Parts]) -> Parts:
    """All statements of the paper with their verdicts, from saved numbers.

    Parameters
    ----------
    results : dict
        Datasets of each experiment, from `programme.carried_out`.

    Returns
    -------
    parts : dict
        ``claims`` over ``number``: ``statement``, ``paper``, ``quantity``, ``porrima``, ``error``, ``verdict`` and
        ``why``.  ``numbers`` over ``row``: every number that is there, with the ``claim`` that it is for, its ``part``,
        ``quantity``, ``value``, ``error``, the ``least`` and ``largest`` that fit, the standard errors that are
        allowed beyond (``slack``), the assumption ``under`` which it is, and whether it ``fits``.

    References
    ----------
    KCM16
    """
    texts = yaml.safe_load(_TEXTS.read_text(encoding="utf-8"))
    evidence, claims, numbers = Evidence(results), [], []
    for number, rule in RULES.items():
        measures = rule(evidence)
        claims.append({"number": number} | texts[number] | _found(verdict_of(measures), texts[number]["why"]))
        numbers += [{"claim": number} | m.record() for m in measures if m.is_there]
    return {"claims": _columns(claims, "number"), "numbers": _columns(numbers, "row")}


def claims_kept(results: Mapping[str, Parts], folder: Path) -> Parts:
    """All statements with their verdicts: those kept from an earlier call where all numbers are the same.

    Parameters
    ----------
    results : dict
        Datasets of each experiment, from `programme.carried_out`.
    folder : Path
        Where they are kept.

    Returns
    -------
    parts : dict
        As `judged` gives them, as they are on the disk.
    """
    prints = sorted((name, fingerprint(parts)) for name, parts in results.items())
    key = content_key(prints, source_key("claims"), _TEXTS.read_text(encoding="utf-8"))
    path = folder / "claims"
    found = kept(path, key)
    if found is None:
        keep(path, key, judged(results))
        found = kept(path, key) or {}
    return found


def _found(judgement: Judgement, why: str) -> dict[str, Any]:
    """The columns of a claim that the numbers decide."""
    one = judgement.deciding
    others = [
        f"{m.quantity}: {_shown(m.value)} ± {_shown(m.error, 2)}" for m in judgement.failed if m is not one
    ]
    said = [f"Nor do these fit: {'; '.join(others)}."] if others else []
    if judgement.verdict == PARTLY:
        said += [f"The assumption: {'; '.join(judgement.assumptions)}."]
    said += [f"No number here of: {', '.join(judgement.open_parts)}."] if judgement.open_parts else []
    return {
        "quantity": one.quantity if one else "",
        "porrima": one.value if one else math.nan,
        "error": one.error if one else math.nan,
        "verdict": judgement.verdict,
        "why": " ".join([why, *said]),
    }


def _shown(value: float, digits: int = 3) -> str:
    """A number in a sentence."""
    if value != 0 and not 1e-3 <= abs(value) < 1e4:
        mantissa, exponent = f"{value:.1e}".split("e")
        return f"{mantissa} × 10{str(int(exponent)).translate(_RAISED)}".replace("-", "−")
    return f"{value:.{digits}g}".replace("-", "−")


def _columns(records: Sequence[Mapping[str, Any]], dimension: str) -> xr.Dataset:
    """Records as a dataset over one dimension."""
    columns = {key: [record[key] for record in records] for key in records[0]}
    coords = {dimension: columns.pop(dimension, list(range(len(records))))}
    return xr.Dataset({key: (dimension, np.array(values)) for key, values in columns.items()}, coords=coords)


def claims_of(parts: Parts) -> list[dict[str, Any]]:
    """Claims as records.

    Parameters
    ----------
    parts : dict
        From `judged`.

    Returns
    -------
    records : list of dict
        With the keys of `page.Claim`.
    """
    return _records(parts["claims"], "number")


def numbers_of(parts: Parts) -> list[dict[str, Any]]:
    """Numbers behind the verdicts as records.

    Parameters
    ----------
    parts : dict
        From `judged`.

    Returns
    -------
    records : list of dict
        One for each number.
    """
    records = _records(parts["numbers"], "row")
    return [{key: value for key, value in record.items() if key != "row"} for record in records]


def _records(dataset: xr.Dataset, dimension: str) -> list[dict[str, Any]]:
    """A dataset over one dimension as records of plain values."""
    columns = {dimension: dataset[dimension].to_numpy().tolist()}
    columns |= {str(name): values.to_numpy().tolist() for name, values in dataset.data_vars.items()}
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
