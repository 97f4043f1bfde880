"""Files and folders that a command writes: whole or not at all."""

from __future__ import annotations

import json
import math
import os
from typing import TYPE_CHECKING, Any

from porrima.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

__all__ = ["json_ready", "make_folder", "write_json", "write_table", "write_whole"]


def make_folder(path: Path) -> None:
    """A folder that can be written, made where it is not there.

    Parameters
    ----------
    path : Path
        The folder.

    Returns
    -------
    None
        The result is the folder.

    Raises
    ------
    InputError
        If it cannot be made or written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", key="output", value=path) from None
    if not os.access(path, os.W_OK):
        raise InputError("must be a folder that can be written", key="output", value=path)


def write_whole(path: Path, write: Callable[[Path], Any]) -> None:
    """A file written under a temporary name beside its place, then renamed.

    Parameters
    ----------
    path : Path
        The file, replaced if it exists.
    write : callable
        Writes to the path that it is given; its suffix is that of `path`.

    Returns
    -------
    None
        The result is the file.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    try:
        unfinished = path.with_name(f".{os.getpid()}-{path.name}")
        try:
            write(unfinished)
            unfinished.replace(path)
        finally:
            unfinished.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", key="output", value=path) from None
    except ValueError:  # no name at all, or a NUL in it
        raise InputError("must be the name of a file", key="output", value=repr(str(path))) from None


def write_table(table: Any, path: Path) -> None:
    """A table of astropy as ECSV.

    Parameters
    ----------
    table : astropy.table.Table
        The table.
    path : Path
        The file, replaced if it exists.

    Returns
    -------
    None
        The result is the file.
    """
    write_whole(path, lambda unfinished: table.write(unfinished, format="ascii.ecsv"))


def write_json(value: Any, path: Path) -> None:
    """A result as JSON, a line for each value.

    Parameters
    ----------
    value : dict
        Keys and values, lists and objects in them.
    path : Path
        The file, replaced if it exists.

    Returns
    -------
    None
        The result is the file.
    """
    text = json.dumps(json_ready(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    write_whole(path, lambda unfinished: unfinished.write_text(text, encoding="utf-8"))


def json_ready(value: Any) -> Any:
    """A result as JSON has it.

    Parameters
    ----------
    value : object
        A dict, list, number or text.

    Returns
    -------
    value : object
        The same without numpy's floats, and with null for what is not a finite number.
    """
    if isinstance(value, dict):
        return {key: json_ready(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(inner) for inner in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value
