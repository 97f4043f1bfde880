"""Numbers of experiments on the disk, each under the key of all that they were made from."""

from __future__ import annotations

import ast
import os
import shutil
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from porrima.cache import content_key
from porrima.files import make_folder

if TYPE_CHECKING:
    import xarray as xr

    Parts = dict[str, xr.Dataset]

__all__ = ["fingerprint", "keep", "kept", "source_key", "versions"]

_PACKAGES = ("numpy", "scipy", "numba", "galsim", "astropy", "xarray")
_HERE = Path(__file__).parent


def versions() -> dict[str, str]:
    """Versions of the packages on which the numbers rest.

    Returns
    -------
    versions : dict
        By name of the package.
    """
    return {name: version(name) for name in _PACKAGES}


@cache
def source_key(*modules: str) -> str:
    """Name of the state of the source that modules rest on.

    Parameters
    ----------
    *modules : str
        Of this package.

    Returns
    -------
    key : str
        Another where one of these modules, one that they import through any others, a shipped table, or the version
        of a package beneath is another.

    Notes
    -----
    A change of a figure or of the report's page leaves it as it is.
    """
    seen: set[str] = set()
    todo = set(modules)
    texts = {}
    while todo:
        name = todo.pop()
        seen.add(name)
        texts[name] = (_HERE / f"{name}.py").read_bytes()
        todo |= _imported(ast.parse(texts[name])) - seen
    data = sorted(path for path in (_HERE / "data").iterdir() if path.suffix in (".ecsv", ".yaml"))
    tables = [(path.name, path.read_bytes()) for path in data]
    return content_key(sorted(texts.items()), tables, versions())


def _imported(tree: ast.Module) -> set[str]:
    """Modules of this package that a module imports, anywhere in it."""
    froms = [(node.module or "", node.names) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    names = {module.split(".")[1] for module, _ in froms if module.startswith("porrima.")}
    names |= {alias.name for module, aliases in froms if module == "porrima" for alias in aliases}
    return {name for name in names if (_HERE / f"{name}.py").is_file()}


def fingerprint(parts: Parts) -> str:
    """Name of the numbers in datasets.

    Parameters
    ----------
    parts : dict
        Datasets by name.

    Returns
    -------
    key : str
        Equal for equal numbers, labels and attributes only.
    """
    content = []
    for name, part in sorted(parts.items()):  # a store has its arrays in any order
        arrays = sorted((str(key), one.dims, one.to_numpy().tolist()) for key, one in part.variables.items())
        content.append((name, sorted(part.attrs.items()), arrays))
    return content_key(content)


def kept(path: Path, key: str) -> Parts | None:
    """Datasets that were kept under a key.

    Parameters
    ----------
    path : Path
        The folder that `keep` made.
    key : str
        What they must have been made from.

    Returns
    -------
    parts : dict or None
        By name; None where there are none, they have another key, or they are damaged: they are then made anew.
    """
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for results only)

    try:
        if (path / "key").read_text(encoding="ascii") != key:
            return None
        names = sorted(group.name for group in path.iterdir() if group.is_dir())
        return {name: xr.open_zarr(path / name, chunks=None, consolidated=False).load() for name in names}
    except (OSError, KeyError, ValueError):
        return None


def keep(path: Path, key: str, parts: Parts) -> None:
    """Keep datasets under a key, in the place of those that were there.

    Parameters
    ----------
    path : Path
        Folder to make.
    key : str
        All that they were made from.
    parts : dict
        Datasets by name.

    Returns
    -------
    None
        The folder appears whole.
    """
    make_folder(path.parent)
    unfinished = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        for name, part in parts.items():
            part.to_zarr(unfinished / name, zarr_format=2, consolidated=False)
        (unfinished / "key").write_text(key, encoding="ascii")
        shutil.rmtree(path, ignore_errors=True)
        unfinished.replace(path)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
