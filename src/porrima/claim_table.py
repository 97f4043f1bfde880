"""The verdicts on the paper's statements as Markdown, for a document that quotes them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from porrima.claims import VERDICTS
from porrima.markdown import markdown_table, with_text_between

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["BEGIN", "END", "claim_table", "with_claims"]

BEGIN, END = "<!-- from claims.json -->", "<!-- end of claims.json -->"
"""What a document has around the table."""

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def claim_table(result: Mapping[str, Any]) -> str:
    """Statements, numbers and verdicts as Markdown.

    Parameters
    ----------
    result : dict
        ``claims.json`` of `porrima paper`.

    Returns
    -------
    text : str
        How many statements have each verdict, a table of the statements, one of the numbers behind them.
    """
    claims, numbers = result["claims"], result["numbers"]
    verdicts = [claim["verdict"] for claim in claims]
    counts = "; ".join(f"{one}: {verdicts.count(one)}" for one in VERDICTS if one in verdicts)
    of_claims = [
        [claim["number"], claim["statement"], claim["paper"], _measured(claim["porrima"], claim["error"]),
         claim["quantity"], f"**{claim['verdict']}**", claim["why"]]
        for claim in claims
    ]  # fmt: skip
    of_numbers = [
        [one["claim"], one["quantity"], _measured(one["value"], one["error"]), _limits(one), _slack(one["slack"]),
         "yes" if one["fits"] else "no", one["under"]]
        for one in numbers
    ]  # fmt: skip
    return "\n\n".join(
        [
            f"{len(claims)} statements; {counts}.",
            markdown_table(
                ["no.", "statement", "the paper says", "Porrima finds", "which is", "verdict", "why"],
                of_claims,
            ),
            "The numbers behind them:",
            markdown_table(
                ["no.", "number", "value", "has to be", "slack [σ]", "fits", "assumption"], of_numbers
            ),
        ]
    )


def with_claims(document: str, result: Mapping[str, Any]) -> str:
    """A document with the verdicts between its two markers.

    Parameters
    ----------
    document : str
        Markdown; without both `BEGIN` and `END` it stays as it is.
    result : dict
        ``claims.json`` of `porrima paper`.

    Returns
    -------
    document : str
        The rest of it unchanged.
    """
    return with_text_between(document, BEGIN, END, claim_table(result))


def _measured(value: float | None, error: float | None) -> str:
    """A number with its error, to two figures of that."""
    if value is None or error is None:
        return "–"
    if error == 0:
        return f"{value:.6g}".replace("-", "−") + " (exact)"
    if value != 0 and error > 1e-6 * abs(value) and 1e-3 <= abs(value) < 1e5:
        digits = max(0, 1 - math.floor(math.log10(error)))
        return f"{value:.{digits}f} ± {error:.{digits}f}".replace("-", "−")
    return f"{_short(value)} ± {_short(error, 2)}"


def _short(value: float, digits: int = 3) -> str:
    """A number to some figures."""
    if value != 0 and not 1e-3 <= abs(value) < 1e5:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa} × 10{str(int(exponent)).translate(_RAISED)}".replace("-", "−")
    return f"{value:.{digits}g}".replace("-", "−")


def _limits(one: Mapping[str, Any]) -> str:
    """The limits of a number in words."""
    least, largest = one["least"], one["largest"]
    if least is None or largest is None:
        return f"at least {_short(least)}" if least is not None else f"at most {_short(largest)}"
    return f"{_short(least)} to {_short(largest)}"


def _slack(value: float) -> str:
    return f"{value:g}".replace("-", "−")
