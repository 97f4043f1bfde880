"""The store of a run: a Zarr group that grows chunk by chunk and is whole after every one of them.

A chunk is there when its tally is: that file is written last, once all others of the chunk are on the disk.  Each
file appears under its name whole or not at all.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
import zarr

from porrima import __version__
from porrima.config import RunConfig, canonical, parse
from porrima.errors import InputError, RunError
from porrima.lock import locked, token_of
from porrima.moments import INDICES, N_MOMENTS
from porrima.multiplicity import PAPERS
from porrima.sample import population_of
from porrima.stars import Stars
from porrima.tallies import FINE, QUANTITIES, STATISTICS

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from porrima.systems import Population
    from porrima.tallies import Tally

    FloatArray = NDArray[np.float64]

__all__ = [
    "STAR_COLUMNS", "Chunk", "FinishedRun", "Store", "check_output", "header", "open_run", "opened", "star_column",
]  # fmt: skip

STAR_COLUMNS = ("mass", "distance", "magnitude", "metallicity", "log_age", "mass_ratio")
"""Columns of the stars that the numbers depend on."""

_MARKER = "tally"
_FILES = {
    "binary_fraction": "{}",
    **dict.fromkeys(QUANTITIES, "0.{}"),
    "moments": "{}.0",
    _MARKER: "{}.0.0.0.0",
}
_NO_RUN = "is not a run of porrima simulate"


@dataclass(frozen=True, slots=True, kw_only=True)
class Chunk:
    """Results of consecutive stacks.

    Parameters
    ----------
    first : int
        Number of the first of the n stacks.
    binary_fraction : (n,) float array
        Of the population of each, in [0, 1].
    shapes : (3, n_psf, n) float array
        e1, e2 and r2 of each behind each PSF; r2 in arcsec².
    moments : (n, n_moment) float array
        Mean kernel moments in arcsec^(a+b).
    tally : Tally
        Their statistics.
    """

    first: int
    binary_fraction: FloatArray
    shapes: FloatArray
    moments: FloatArray
    tally: Tally


@dataclass(frozen=True, slots=True, kw_only=True)
class Store:
    """A store that can be written to.

    Parameters
    ----------
    path : Path
        Its folder, absolute.
    token : str
        Of the process that holds its lock.
    group : zarr.Group
        What is in it.
    """

    path: Path
    token: str
    group: Any

    @classmethod
    def within_reach(cls, path: Path, token: str) -> Store | None:
        """The store that another process has locked, if this one sees the same file system.

        Parameters
        ----------
        path : Path
            Its folder, absolute.
        token : str
            What must stand in its lock.

        Returns
        -------
        store : Store or None
            None where there is no such store here, or it has another token.
        """
        if token_of(path) != token:
            return None
        return cls(path=path, token=token, group=zarr.open_group(path, mode="r+"))

    @property
    def ranges(self) -> list[tuple[int, int]]:
        """First stack of each chunk, and the one after its last."""
        fraction = self.group["binary_fraction"]
        n, chunk = fraction.shape[0], fraction.chunks[0]
        return [(first, min(first + chunk, n)) for first in range(0, n, chunk)]

    def missing(self) -> list[tuple[int, int]]:
        """Ranges of stacks that are not there yet.

        Returns
        -------
        ranges : list of (int, int)
            First stack of each chunk, and the one after its last (count).
        """
        written = _written(self.path)
        return [some for number, some in enumerate(self.ranges) if number not in written]

    def write(self, chunk: Chunk) -> None:
        """Keep a chunk: its numbers first, then, when they are on the disk, the tally that says so.

        Parameters
        ----------
        chunk : Chunk
            The stacks of one of the ranges.

        Returns
        -------
        None
            The result is on the disk.

        Raises
        ------
        RunError
            If there is no room, or the folder cannot be written any more.
        """
        some = slice(chunk.first, chunk.first + chunk.binary_fraction.size)
        number = chunk.first // self.group["binary_fraction"].chunks[0]
        try:
            with _uninterrupted():
                self.group["binary_fraction"][some] = chunk.binary_fraction
                for q, name in enumerate(QUANTITIES):
                    self.group[name][:, some] = chunk.shapes[q]
                self.group["moments"][some] = chunk.moments
                self._to_disk(number, [name for name in _FILES if name != _MARKER])
                self.group[_MARKER][number] = chunk.tally.to_array()
                self._to_disk(number, [_MARKER])
        except OSError as error:
            raise _stopped(self.path, error) from None

    def _to_disk(self, number: int, names: list[str]) -> None:
        """Wait until files of a chunk and their names in their folders would outlive a loss of power."""
        files = [self.path / name / _FILES[name].format(number) for name in names]
        with ThreadPoolExecutor(len(files)) as threads:
            list(
                threads.map(_sync, [file for file in files if file.exists()])
            )  # one of NaN alone is not written
            list(threads.map(_sync, [file.parent for file in files]))

    def tidy(self) -> None:
        """Remove what processes that were killed in the middle of a file have left.

        Returns
        -------
        None
            Only whole files stay.
        """
        for leftover in self.path.rglob("*.partial"):
            leftover.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class FinishedRun:
    """A run with all its stacks; none is in memory before it is asked for.

    Parameters
    ----------
    dataset : Dataset
        Shapes dimensionless and in arcsec², moments in arcsec^(a+b), over stack, psf and moment.
    config : RunConfig
        What was run.
    population : Population
        Its stars and their companions' law.
    """

    dataset: xr.Dataset
    config: RunConfig
    population: Population


def open_run(path: Path) -> FinishedRun:
    """A finished run: its dataset, configuration and population.

    Parameters
    ----------
    path : Path
        Store that `simulation.simulate` made.

    Returns
    -------
    run : FinishedRun
        Read from the disk where it is used.

    Raises
    ------
    InputError
        If the path is not a run, or the run is not complete.
    """
    try:
        dataset = xr.open_zarr(path, chunks=None)
        config = parse(RunConfig, json.loads(dataset.attrs["config"]), source=path)
        columns = {name: dataset[f"star_{name}"].to_numpy() for name in STAR_COLUMNS}
        if np.all(np.isnan(columns["mass_ratio"])):
            columns["mass_ratio"] = None
        stars = Stars.from_columns(**columns, band=dataset.attrs["band"], source=dataset.attrs["stars"])
        missing = dataset.sizes["chunk"] - len(_written(path))
    except (OSError, KeyError, ValueError):
        raise InputError(_NO_RUN, source=path) from None
    if missing:
        raise InputError(f"is not complete ({missing} chunks missing): run again with --resume", source=path)
    return FinishedRun(dataset=dataset, config=config, population=population_of(config, stars))


def header(config: RunConfig, stars: Stars, alone: FloatArray, **attributes: str) -> xr.Dataset:
    """Everything in a store that is known before the first stack.

    Parameters
    ----------
    config : RunConfig
        What is run.
    stars : Stars
        Of the population.
    alone : (3, n_psf) float array
        e1, e2 and r2 of each PSF without companions; r2 in arcsec².
    **attributes : str
        More of them, such as ``identity``.

    Returns
    -------
    known : Dataset
        Over psf, moment and star.
    """
    units = {"r2": {"units": "arcsec2"}}
    scalars = {f"{name}_0": (("psf",), alone[q], units.get(name, {})) for q, name in enumerate(QUANTITIES)}
    columns = {f"star_{name}": (("star",), star_column(stars, name)) for name in STAR_COLUMNS}
    versions = {"porrima": __version__} | {name: version(name) for name in ("numpy", "numba", "galsim")}
    return xr.Dataset(
        {**scalars, **columns},
        coords={
            "psf": list(config.psf),
            "moment": [f"m{a}{b}" for a, b in INDICES],
            "quantity": list(QUANTITIES),
            "statistic": list(STATISTICS),
        },
        attrs={
            "config": canonical(config),
            **attributes,
            "stars": stars.source,
            "band": stars.band,
            "versions": json.dumps(versions),
            "references": "; ".join(_references(config)),
        },
    )


def star_column(stars: Stars, name: str) -> FloatArray:
    """Column of the stars as the store keeps it.

    Parameters
    ----------
    stars : Stars
        The n stars.
    name : str
        One of `STAR_COLUMNS`.

    Returns
    -------
    column : (n,) float array
        In the unit of the column; mass ratios are NaN where none is given.
    """
    values = getattr(stars, name)
    return np.full(len(stars), np.nan) if values is None else np.ascontiguousarray(values)


def _references(config: RunConfig) -> list[str]:
    """Papers that the models of a run ask to be cited."""
    light = {"main-sequence": "Bressan et al. 2012", "habets-heintze": "Habets & Heintze 1981"}
    stars = str(config.stars.catalog) if config.stars.catalog else "Robin et al. 2003"
    companions = PAPERS[config.multiplicity.model]
    return ["KCM16 (arXiv:1512.01549)", companions, light[config.photometry.model], stars]


@contextmanager
def opened(path: Path, known: xr.Dataset, *, n_stacks: int, chunk: int, resume: bool) -> Iterator[Store]:
    """A store to write to, which no other process writes to meanwhile.

    Parameters
    ----------
    path : Path
        Its folder: made, or gone on with.
    known : Dataset
        From `header`, with the attribute ``identity``.
    n_stacks : int
        Stacks of the run (count).
    chunk : int
        Stacks in each chunk of a new store (count).
    resume : bool
        Whether it may exist.

    Yields
    ------
    store : Store
        Its lock is held.

    Returns
    -------
    None
        A context manager.

    Raises
    ------
    InputError
        If the path cannot be used, is locked, or holds something else.
    RunError
        If there is no room.
    """
    check_output(path, resume)
    _remove_unfinished(path)
    if not path.exists():
        _create(path, known, n_stacks, chunk)
    _check_identity(path, known.attrs["identity"])
    with ExitStack() as stack:
        try:
            token = stack.enter_context(locked(path))
        except OSError as error:
            raise _stopped(path, error) from None
        store = Store(path=path.resolve(), token=token, group=zarr.open_group(path, mode="r+"))
        store.tidy()
        yield store
        store.tidy()


def check_output(path: Path, resume: bool) -> None:
    """Refuse a path that cannot be used, before any work is done.

    Parameters
    ----------
    path : Path
        Folder of a store.
    resume : bool
        Whether it may exist.

    Returns
    -------
    None
        It can be used.

    Raises
    ------
    InputError
        If not.
    """
    try:
        if path.exists() and not resume:
            rule = "exists already; go on with it by --resume, or choose another"
            raise InputError(rule, key="output", value=path)
        if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
            raise InputError("must lie in a folder that can be written", key="output", value=path)
        if path.is_dir() and not os.access(path, os.W_OK):
            raise InputError("must be a store that can be written", key="output", value=path)
    except OSError as error:  # a name too long, say
        raise InputError(f"cannot be written ({error.strerror})", key="output", value=path) from None


def _check_identity(path: Path, identity: str) -> None:
    try:
        found = zarr.open_group(path, mode="r").attrs["identity"]
    except (OSError, KeyError, ValueError):
        raise InputError(_NO_RUN, key="output", value=path) from None
    if found != identity:
        raise InputError("holds a run of another configuration, stars or version", key="output", value=path)


def _create(path: Path, known: xr.Dataset, n_stacks: int, chunk: int) -> None:
    """Make an empty store beside its place, and move it there."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}@{socket.gethostname()}")
    try:
        with _uninterrupted():
            _lay_out(unfinished, known, n_stacks, min(chunk, n_stacks))
            unfinished.rename(path)
    except OSError as error:
        if path.exists():
            raise InputError("was made by another process just now", key="output", value=path) from None
        raise _stopped(path, error, resumable=False) from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _lay_out(path: Path, known: xr.Dataset, n_stacks: int, chunk: int) -> None:
    known.to_zarr(path, zarr_format=2, consolidated=False)
    group = zarr.open_group(path, mode="r+")
    n_psf, n_chunks = known.sizes["psf"], -(-n_stacks // chunk)
    per_chunk = (n_psf, len(QUANTITIES), len(STATISTICS), FINE)
    layout: list[tuple[str, tuple[str, ...], tuple[int, ...], tuple[int, ...]]] = [
        ("binary_fraction", ("stack",), (n_stacks,), (chunk,)),
        *((name, ("psf", "stack"), (n_psf, n_stacks), (n_psf, chunk)) for name in QUANTITIES),
        ("moments", ("stack", "moment"), (n_stacks, N_MOMENTS), (chunk, N_MOMENTS)),
        (_MARKER, ("chunk", "psf", "quantity", "statistic", "bin"), (n_chunks, *per_chunk), (1, *per_chunk)),
    ]
    for name, dimensions, shape, chunks in layout:
        group.create_array(
            name,
            shape=shape,
            chunks=chunks,
            dtype="f8",
            fill_value=float("nan"),
            attributes={"_ARRAY_DIMENSIONS": list(dimensions)},
        )
    zarr.consolidate_metadata(path)


def _remove_unfinished(path: Path) -> None:
    """Remove the beginnings of a store that processes of this machine left when they were killed."""
    for folder in path.parent.glob(f".{path.name}.*@{socket.gethostname()}"):
        try:
            os.kill(int(folder.name.removeprefix(f".{path.name}.").split("@")[0]), 0)
        except ProcessLookupError:
            shutil.rmtree(folder, ignore_errors=True)
        except (OSError, ValueError):  # of another user, or no such folder
            continue


def _written(path: Path) -> set[int]:
    """Numbers of the chunks that are complete."""
    names = os.listdir(path / _MARKER)
    return {int(name.split(".")[0]) for name in names if name[0].isdigit() and name.endswith(".0")}


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Let Ctrl-C wait until Zarr's threads have written what they are at; a second one does not."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked: list[int] = []

    def wait(number: int, _: Any) -> None:
        asked.append(number)
        if len(asked) > 1:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, wait)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before or signal.SIG_DFL)
    if asked:
        raise KeyboardInterrupt


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _stopped(path: Path, error: OSError, *, resumable: bool = True) -> RunError:
    rest = "; what is written is whole: go on with --resume" if resumable else ""
    return RunError(f"{path}: cannot be written ({error.strerror}){rest}")
