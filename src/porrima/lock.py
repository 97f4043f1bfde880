"""One writer at a time: a locked file in a folder, with a word by which others know its holder."""

from __future__ import annotations

import fcntl
import os
import socket
import uuid
import warnings
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from porrima.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["locked", "token_of"]

_LOCK = ".lock"


@contextmanager
def locked(path: Path) -> Iterator[str]:
    """Token of this process in the locked file of a folder; the lock ends with the process, however that ends.

    Parameters
    ----------
    path : Path
        The folder.

    Yields
    ------
    token : str
        Known to those to whom this process tells it, and to those who see the file.

    Returns
    -------
    None
        A context manager; the file is gone after it.

    Raises
    ------
    InputError
        If another process holds the lock.

    Notes
    -----
    A file that a killed process left is no lock: the kernel holds it (``flock``), also over NFS.
    """
    file = path / _LOCK
    handle = _lock(file, path)
    try:
        token = uuid.uuid4().hex
        os.truncate(handle, 0)
        os.pwrite(handle, f"process {os.getpid()} on {socket.gethostname()}\n{token}\n".encode(), 0)
        os.fsync(handle)  # so that other machines see it
        yield token
    finally:
        with suppress(OSError):
            file.unlink()
        os.close(handle)


def token_of(path: Path) -> str | None:
    """Token of the process that has locked a folder.

    Parameters
    ----------
    path : Path
        The folder.

    Returns
    -------
    token : str or None
        None where this process sees no such lock.
    """
    try:
        return (path / _LOCK).read_text(encoding="utf-8").split("\n")[1]
    except (OSError, IndexError, ValueError):
        return None


def _lock(file: Path, path: Path) -> int:
    """Handle of the locked file."""
    while True:
        handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(handle, 500, 0).decode(errors="replace").split("\n")[0] or "another process"
            os.close(handle)
            raise InputError(f"is being written by {holder}", key="output", value=path) from None
        except OSError as error:
            note = "let no other process write to it"
            warnings.warn(f"{path}: cannot be locked ({error.strerror}): {note}", stacklevel=2)
        with suppress(OSError):
            if os.fstat(handle).st_ino == file.stat().st_ino:
                return handle
        os.close(handle)  # its holder has just removed it
