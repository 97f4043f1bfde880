"""Arrays kept on disk by what they were made from, so that the same question is not worked out twice."""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["cache_folder", "content_key", "load", "save"]


def cache_folder() -> Path | None:
    """Folder in which arrays are kept.

    Returns
    -------
    folder : Path or None
        ``PORRIMA_CACHE``, or ``porrima`` in ``XDG_CACHE_HOME`` or in ``~/.cache``; None, for nowhere, where
        ``PORRIMA_CACHE`` is set and empty.  It need not exist.
    """
    chosen = os.environ.get("PORRIMA_CACHE")
    if chosen is not None:
        return Path(chosen).expanduser() if chosen.strip() else None
    base = os.environ.get("XDG_CACHE_HOME", "")
    try:
        return Path(base) / "porrima" if os.path.isabs(base) else Path.home() / ".cache" / "porrima"
    except RuntimeError:  # no home
        return None


def content_key(*parts: Any) -> str:
    """Name of a result, from all that it was made from.

    Parameters
    ----------
    *parts : array, bytes or anything with a faithful repr
        In a fixed order.

    Returns
    -------
    key : str
        SHA-256 in hexadecimal: equal for equal parts only.
    """
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"array {part.dtype.str} {part.shape} ".encode())
            digest.update(np.ascontiguousarray(part).data)
        else:
            content = part if isinstance(part, bytes) else repr(part).encode()
            digest.update(f"{type(part).__name__} {len(content)} ".encode() + content)
    return digest.hexdigest()


def load(key: str) -> dict[str, Any] | None:
    """Arrays that were saved under a key.

    Parameters
    ----------
    key : str
        From `content_key`.

    Returns
    -------
    arrays : dict or None
        None where there are none, or where the file is damaged: it is then made anew.
    """
    folder = cache_folder()
    if folder is None:
        return None
    try:
        with open(folder / f"{key}.npz", "rb") as stream, np.load(stream, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}  # each member's checksum is compared here
    except (OSError, ValueError, EOFError, KeyError, BadZipFile):
        return None


def save(key: str, arrays: Mapping[str, Any]) -> None:
    """Keep arrays under a key; a folder that cannot be written to is passed over.

    Parameters
    ----------
    key : str
        From `content_key`.
    arrays : mapping
        Names and arrays.

    Returns
    -------
    None
        The file appears whole or not at all, also with several processes at work.
    """
    folder = cache_folder()
    if folder is None:
        return
    unfinished = folder / f".{os.getpid()}-{threading.get_ident()}-{key}.npz"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(unfinished, allow_pickle=False, **arrays)
        os.replace(unfinished, folder / f"{key}.npz")
    except OSError:
        pass
    finally:
        with contextlib.suppress(OSError):
            unfinished.unlink()
