"""A run: stars and companions from a configuration, stacks in chunks, a store that survives interruption."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from itertools import islice
from typing import TYPE_CHECKING, Any, Literal

import numba
import numpy as np
import xarray as xr
import zarr

from porrima import __version__
from porrima.config import RunConfig, canonical, parse
from porrima.errors import InputError
from porrima.moments import INDICES, N_MOMENTS, KernelMoments
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.sample import draw_stars, population_of
from porrima.shapes import estimator_from_name
from porrima.stack import draw_stacks, draw_systems
from porrima.stars import Stars

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from porrima.psf import PSF
    from porrima.shapes import Shape
    from porrima.systems import Population

    FloatArray = NDArray[np.float64]

__all__ = ["Method", "open_run", "simulate"]

Method = Literal["moments", "images"]

CHUNK = 10_000
"""Stacks in a chunk: what an interruption can lose."""

_STAR_COLUMNS = ("mass", "distance", "magnitude", "metallicity", "log_age", "mass_ratio")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Chunk:
    """Results of the stacks first to last - 1."""

    first: int
    last: int
    binary_fraction: FloatArray
    shapes: FloatArray  # (3, n_psf, n): e1, e2, r2
    moments: FloatArray


def simulate(
    config: RunConfig,
    path: Path,
    *,
    resume: bool = False,
    method: Method = "moments",
    chunk: int = CHUNK,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> int:
    """Number of stacks computed and written to a store; those already there are left as they are.

    Parameters
    ----------
    config : RunConfig
        The run.
    path : Path
        Store to make (a folder), or to complete with `resume`.
    resume : bool
        Go on with a store of the same configuration; without it an existing path is refused.
    method : {"moments", "images"}
        Shapes from kernel moments through the response, or from images drawn and measured with GalSim.
    chunk : int
        Stacks per chunk (count); a resumed run keeps that of its store.
    workers : int, optional
        Processes of a local Dask cluster (count); this process alone where neither is given.
    scheduler : str, optional
        Address of a running Dask scheduler.
    progress : callable
        Called with the number of stacks done after each chunk.

    Returns
    -------
    n_stacks : int
        Computed in this call (count).

    Raises
    ------
    InputError
        If the path cannot be written, exists, or holds another configuration; or the configuration is wrong.
    """
    _check_output(path, resume)
    run = _Run(config=config, population=population_of(config, draw_stars(config)), method=method)
    with _cluster(workers, scheduler) as cluster:
        store = _open_or_create(run, path, resume, chunk)
        chunk = store["binary_fraction"].chunks[0]
        ranges = [(first, min(first + chunk, config.n_stacks)) for first in range(0, config.n_stacks, chunk)]
        missing = [r for number, r in enumerate(ranges) if not _is_written(path, number)]
        progress(config.n_stacks - sum(last - first for first, last in missing))
        for result in _computed(run, missing, cluster):
            _write_chunk(store, path, result)
            progress(result.last - result.first)
    return sum(last - first for first, last in missing)


def open_run(path: Path) -> tuple[xr.Dataset, RunConfig, Population]:
    """A finished run: its dataset, configuration and population.

    Parameters
    ----------
    path : Path
        Store that `simulate` made.

    Returns
    -------
    dataset, config, population : Dataset, RunConfig, Population
        Shapes dimensionless and in arcsec², moments in arcsec^(a+b).

    Raises
    ------
    InputError
        If the path is not a run, or the run is not complete.
    """
    try:
        dataset = xr.open_zarr(path, chunks=None)
        config = parse(RunConfig, json.loads(dataset.attrs["config"]), source=path)
        columns = {name: dataset[f"star_{name}"].to_numpy() for name in _STAR_COLUMNS}
        if np.all(np.isnan(columns["mass_ratio"])):
            columns["mass_ratio"] = None
        stars = Stars.from_columns(**columns, band=dataset.attrs["band"], source=dataset.attrs["stars"])
    except (OSError, KeyError, ValueError):
        raise InputError("is not a run of porrima simulate", source=path) from None
    chunk = dataset["binary_fraction"].encoding["chunks"][0]
    missing = [n for n in range(-(-dataset.sizes["stack"] // chunk)) if not _is_written(path, n)]
    if missing:
        raise InputError(
            f"is not complete ({len(missing)} chunks missing): run again with --resume", source=path
        )
    return dataset, config, population_of(config, stars)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Run:
    """What a chunk needs to be computed, anywhere."""

    config: RunConfig
    population: Population
    method: Method

    def chunk(self, first: int, last: int) -> _Chunk:
        config = self.config
        try:
            stacks = draw_stacks(
                self.population,
                n_stars=config.n_stars,
                binary_fraction=config.binary_fraction,
                seed=config.seed,
                first=first,
                last=last,
            )
        except ValueError as error:
            raise InputError(str(error)) from None
        shapes = np.empty((3, len(config.psf), last - first))
        for p, name in enumerate(config.psf):
            shape = (
                self._from_moments(name, stacks.moments)
                if self.method == "moments"
                else self._from_images(name, first, last)
            )
            shapes[:, p] = shape.e1, shape.e2, shape.r2
        return _Chunk(
            first=first,
            last=last,
            binary_fraction=stacks.binary_fraction,
            shapes=shapes,
            moments=stacks.moments.values,
        )

    def _psf(self, name: str) -> PSF:
        return psf_from_name(name, **self.config.psf_options)

    def _from_moments(self, psf: str, moments: KernelMoments) -> Shape:
        return response(self._psf(psf), estimator_from_name(self.config.estimator)).shapes(moments)

    def _from_images(self, psf: str, first: int, last: int) -> Shape:
        from porrima.images import measure_stack  # noqa: PLC0415  (GalSim's drawing, where used)

        config = self.config
        shapes = [
            measure_stack(
                self._psf(psf),
                draw_systems(
                    self.population,
                    n_stars=config.n_stars,
                    binary_fraction=config.binary_fraction,
                    seed=config.seed,
                    stack=stack,
                ),
                estimator_from_name(config.estimator),
            )
            for stack in range(first, last)
        ]
        return type(shapes[0])(
            **{
                name: np.array([getattr(shape, name) for shape in shapes]).reshape(-1)
                for name in ("e1", "e2", "r2", "flag")
            }
        )

    def shape_without_companions(self, psf: str) -> Shape:
        single = KernelMoments(values=np.zeros((1, N_MOMENTS)), n_stars=1)
        if self.method == "moments":
            return self._from_moments(psf, single)
        from porrima.images import measure_stack  # noqa: PLC0415  (GalSim's drawing, where used)
        from porrima.systems import Systems  # noqa: PLC0415

        zero = np.zeros(1)
        return measure_stack(
            self._psf(psf),
            Systems.from_pairs(zero, zero, zero),
            estimator_from_name(self.config.estimator),
        )

    @property
    def identity(self) -> str:
        """Hash of all that the numbers depend on."""
        rest = self.config.model_copy(update={"stars": None})  # wherever the stars came from, here they are
        digest = hashlib.sha256(f"{canonical(rest)} {self.method} {__version__}".encode())
        digest.update(self.population.stars.band.encode())
        for psf in self.config.psf:  # a file of that name may have changed
            shape = self.shape_without_companions(psf)
            numbers = [float(np.squeeze(value)) for value in (shape.e1, shape.e2, shape.r2)]
            digest.update(" ".join(f"{number:.9f}" for number in numbers).encode())
        for name in _STAR_COLUMNS:
            digest.update(_star_column(self.population.stars, name).tobytes())
        return digest.hexdigest()


@contextmanager
def _cluster(workers: int | None, scheduler: str | None) -> Iterator[_Cluster | None]:
    """Workers of a Dask cluster, made here or reached by address; None where neither is asked for."""
    if workers is None and scheduler is None:
        yield None
        return
    try:
        from dask.distributed import Client, LocalCluster  # noqa: PLC0415  (an extra)
    except ImportError:
        raise InputError("needs Dask: install porrima[cluster]", key="workers") from None
    threads = max(1, (os.cpu_count() or 1) // workers) if workers else None
    local = {"n_workers": workers, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with ExitStack() as stack:
        try:
            where = scheduler or stack.enter_context(LocalCluster(**local))
            client = stack.enter_context(Client(where, timeout="10s"))
        except (OSError, ValueError) as error:
            raise InputError(f"cannot be reached ({error})", key="scheduler", value=scheduler) from None
        yield _Cluster(client=client, threads=threads)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Cluster:
    """A Dask client, and the threads that each worker may take (None: as many as it likes)."""

    client: Any
    threads: int | None


def _computed(run: _Run, ranges: list[tuple[int, int]], cluster: _Cluster | None) -> Iterator[_Chunk]:
    """Results of ranges of stacks, in any order, from this process or the workers of a cluster."""
    if cluster is None:
        yield from (run.chunk(*one) for one in ranges)
        return
    from dask.distributed import as_completed  # noqa: PLC0415  (an extra)

    client = cluster.client
    shared = client.scatter(run, broadcast=True)
    waiting = iter(ranges)
    ahead = 2 * max(1, len(client.scheduler_info()["workers"]))  # bounds what is held in memory

    def submit(n: int) -> list[Any]:
        return [client.submit(_chunk_of, shared, *r, cluster.threads, pure=False) for r in islice(waiting, n)]

    queue = as_completed(submit(ahead))
    for done in queue:
        queue.update(submit(1))
        yield done.result()


def _chunk_of(run: _Run, first: int, last: int, threads: int | None) -> _Chunk:
    """Chunk computed on a worker with its share of the cores."""
    if threads is not None:
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    return run.chunk(first, last)


def _check_output(path: Path, resume: bool) -> None:
    """Refuse a path that cannot be used, before any work is done."""
    try:
        if path.exists() and not resume:
            rule = "exists already; go on with it by --resume, or choose another"
            raise InputError(rule, key="output", value=path)
        if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
            raise InputError("must lie in a folder that can be written", key="output", value=path)
    except OSError as error:  # a name too long, say
        raise InputError(f"cannot be written ({error.strerror})", key="output", value=path) from None
    for leftover in path.rglob("*.partial"):  # of a process that was killed while it wrote
        leftover.unlink(missing_ok=True)


def _open_or_create(run: _Run, path: Path, resume: bool, chunk: int) -> Any:
    if path.exists():
        try:
            store = zarr.open_group(path, mode="r+")
            identity = store.attrs["identity"]
        except (OSError, KeyError, ValueError):
            raise InputError("is not a run of porrima simulate", key="output", value=path) from None
        if identity != run.identity:
            raise InputError(
                "holds a run of another configuration, stars or version", key="output", value=path
            )
        return store
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        _create(run, unfinished, min(chunk, run.config.n_stacks))
        unfinished.rename(path)
    except OSError as error:  # among others, another process was faster
        raise InputError(f"cannot be written ({error.strerror})", key="output", value=path) from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return zarr.open_group(path, mode="r+")


def _create(run: _Run, path: Path, chunk: int) -> None:
    """Make an empty store with everything that is known before the first stack."""
    config = run.config
    alone = [run.shape_without_companions(name) for name in config.psf]
    scalars = {
        f"{name}_0": (("psf",), np.array([float(np.squeeze(getattr(shape, name))) for shape in alone]), attrs)
        for name, attrs in (("e1", {}), ("e2", {}), ("r2", {"units": "arcsec2"}))
    }
    stars = {f"star_{name}": (("star",), _star_column(run.population.stars, name)) for name in _STAR_COLUMNS}
    known = xr.Dataset(
        {**scalars, **stars},
        coords={"psf": list(config.psf), "moment": [f"m{a}{b}" for a, b in INDICES]},
        attrs={
            "config": canonical(config),
            "method": run.method,
            "identity": run.identity,
            "stars": run.population.stars.source,
            "band": run.population.stars.band,
            "versions": json.dumps(
                {"porrima": __version__} | {name: version(name) for name in ("numpy", "numba", "galsim")}
            ),
            "references": "; ".join(_references(config)),
        },
    )
    known.to_zarr(path, zarr_format=2, consolidated=False)
    group = zarr.open_group(path, mode="r+")
    n, n_psf = config.n_stacks, len(config.psf)
    layout: list[tuple[str, tuple[str, ...], tuple[int, ...], tuple[int, ...]]] = [
        ("binary_fraction", ("stack",), (n,), (chunk,)),
        *((name, ("psf", "stack"), (n_psf, n), (n_psf, chunk)) for name in ("e1", "e2", "r2")),
        ("moments", ("stack", "moment"), (n, N_MOMENTS), (chunk, N_MOMENTS)),
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


def _star_column(stars: Stars, name: str) -> FloatArray:
    """Column of the stars as the store keeps it: mass ratios are NaN where none is given."""
    values = getattr(stars, name)
    return np.full(len(stars), np.nan) if values is None else np.ascontiguousarray(values)


def _references(config: RunConfig) -> list[str]:
    """Papers that the models of a run ask to be cited."""
    light = {"main-sequence": "Bressan et al. 2012", "habets-heintze": "Habets & Heintze 1981"}
    stars = str(config.stars.catalog) if config.stars.catalog else "Robin et al. 2003"
    return ["KCM16 (arXiv:1512.01549)", "Duchene & Kraus 2013", light[config.photometry.model], stars]


def _is_written(path: Path, number: int) -> bool:
    """Whether a chunk is complete: its moments are written last, and a file appears whole or not at all."""
    return (path / "moments" / f"{number}.0").exists()


def _write_chunk(store: Any, path: Path, chunk: _Chunk) -> None:
    some = slice(chunk.first, chunk.last)
    try:
        store["binary_fraction"][some] = chunk.binary_fraction
        for q, name in enumerate(("e1", "e2", "r2")):
            store[name][:, some] = chunk.shapes[q]
        store["moments"][some] = chunk.moments
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", key="output", value=path) from None
