"""The one error that a user's input can raise, and the one that stops a run."""

from __future__ import annotations

from typing import Any

__all__ = ["InputError", "RunError"]


class InputError(ValueError):
    """Wrong input of a user: one line that names the place, the rule and the value.

    Parameters
    ----------
    rule : str
        What must hold, such as ``"must be positive"``.
    source : str, optional
        The file.
    row : int, optional
        Line of a text file, or row of a table, counted from 1.
    column, key : str, optional
        Column of a table, or key of a configuration (dotted) or option of a command.
    value : object, optional
        What was found instead.
    """

    def __init__(
        self,
        rule: str,
        *,
        source: object = None,
        row: int | None = None,
        column: str | None = None,
        key: str | None = None,
        value: Any = None,
    ) -> None:
        places = (
            str(source) if source is not None else None,
            f"row {row}" if row is not None else None,
            f"column {column}" if column else None,
            key,
        )
        place = ", ".join(part for part in places if part)
        got = f", got {value}" if value is not None else ""
        text = f"{place}: {rule}{got}" if place else f"{rule}{got}"
        super().__init__(" ".join(text.split()))


class RunError(RuntimeError):
    """What stops a run and is no fault of its input, such as a full disk: one line that names the place.

    Parameters
    ----------
    message : str
        What happened; what is written stays whole, and the line says how to go on.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))
