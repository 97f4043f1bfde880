"""A run: stars and companions from a configuration, stacks in chunks, a store that survives interruption."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np

from porrima import __version__
from porrima.cluster import cluster as cluster_of
from porrima.config import RunConfig, canonical
from porrima.errors import InputError
from porrima.moments import N_MOMENTS, KernelMoments
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.sample import draw_stars, population_of
from porrima.shapes import estimator_from_name
from porrima.stack import draw_stacks, draw_systems
from porrima.store import STAR_COLUMNS, Chunk, Store, check_output, header, opened, star_column
from porrima.tallies import QUANTITIES, changes, tally

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from porrima.cluster import Cluster
    from porrima.psf import PSF
    from porrima.shapes import Shape
    from porrima.stack import Device, Stacks
    from porrima.systems import Population

    FloatArray = NDArray[np.float64]

__all__ = ["CHUNK", "Method", "simulate"]

Method = Literal["moments", "images"]

CHUNK: dict[Method, int] = {"moments": 10_000, "images": 100}
"""Stacks in a chunk, what an interruption can lose: a second or a minute of one core (count)."""


def simulate(
    config: RunConfig,
    path: Path,
    *,
    resume: bool = False,
    method: Method = "moments",
    device: Device = "cpu",
    chunk: int | None = None,
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
    device : {"cpu", "cuda"}
        Where stacks are drawn; their bits, and so their stores, are those of one kind of device.
    chunk : int, optional
        Stacks per chunk (count), `CHUNK` where not given; a resumed run keeps that of its store.
    workers : int, optional
        Processes of a local Dask cluster (count); this process alone where neither is given.
    scheduler : str, optional
        Address of a running Dask scheduler.
    progress : callable
        Called with the number of stacks that are there already, then after each chunk with that of its stacks.

    Returns
    -------
    n_stacks : int
        Computed in this call (count).

    Raises
    ------
    InputError
        If the path cannot be written, exists, is written by another process or holds another configuration; or
        the configuration is wrong.
    RunError
        If the run had to stop: the disk is full, or workers die.
    """
    check_output(path, resume)
    run = _Run.of(config, population_of(config, draw_stars(config)), method, device)
    known = header(config, run.population.primaries, run.alone, method=method, identity=run.identity)
    if workers is None and scheduler is None:
        run.draw(0, 0)  # refuses a device that is not there before a store is made
    layout = {"n_stacks": config.n_stacks, "chunk": chunk or CHUNK[method]}
    with cluster_of(workers, scheduler) as cluster, opened(path, known, **layout, resume=resume) as store:
        missing = store.missing()
        n_missing = sum(last - first for first, last in missing)
        progress(config.n_stacks - n_missing)
        for n_stacks in _written(run, store, missing, cluster):
            progress(n_stacks)
    return n_missing


@dataclass(frozen=True, slots=True, kw_only=True)
class _Run:
    """What a chunk needs to be computed, anywhere; `alone` is (3, n_psf), the PSFs without companions."""

    config: RunConfig
    population: Population
    method: Method
    device: Device
    alone: FloatArray

    @classmethod
    def of(cls, config: RunConfig, population: Population, method: Method, device: Device) -> _Run:
        shapes = [_without_companions(config, name, method) for name in config.psf]
        alone = [[float(np.squeeze(getattr(shape, name))) for shape in shapes] for name in QUANTITIES]
        return cls(config=config, population=population, method=method, device=device, alone=np.array(alone))

    def draw(self, first: int, last: int) -> Stacks:
        config = self.config
        try:
            return draw_stacks(
                self.population,
                n_stars=config.n_stars,
                binary_fraction=config.binary_fraction,
                seed=config.seed,
                first=first,
                last=last,
                device=self.device,
            )
        except InputError:
            raise
        except ValueError as error:
            raise InputError(str(error)) from None

    def chunk(self, first: int, last: int) -> Chunk:
        config, stacks = self.config, self.draw(first, last)
        shapes = np.empty((3, len(config.psf), last - first))
        for p, name in enumerate(config.psf):
            shape = (
                _from_moments(config, name, stacks.moments)
                if self.method == "moments"
                else self._from_images(name, first, last)
            )
            shapes[:, p] = shape.e1, shape.e2, shape.r2
        return Chunk(
            first=first,
            binary_fraction=stacks.binary_fraction,
            shapes=shapes,
            moments=stacks.moments.values,
            tally=tally(stacks.binary_fraction, changes(shapes, self.alone)),
        )

    def _from_images(self, psf: str, first: int, last: int) -> Shape:
        from porrima.images import measure_stack  # noqa: PLC0415  (GalSim's drawing, where used)

        config = self.config
        shapes = [
            measure_stack(
                _psf(config, psf),
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

    @property
    def identity(self) -> str:
        """Hash of all that the numbers depend on."""
        rest, tables = self.config.model_copy(update={"stars": None}), []  # wherever the stars came from
        if rest.selection is not None:
            tables = [one.table.read_bytes() for one in rest.selection if one.table is not None]
            bare = tuple(one.model_copy(update={"table": None}) for one in rest.selection)
            rest = rest.model_copy(update={"selection": bare})
        digest = hashlib.sha256(f"{canonical(rest)} {self.method} {self.device} {__version__}".encode())
        for table in tables:
            digest.update(table)
        stars = self.population.primaries
        digest.update(stars.band.encode())
        for shape in self.alone.T:  # a file of a PSF's name may have changed
            digest.update(" ".join(f"{number:.9f}" for number in shape).encode())
        for name in STAR_COLUMNS:
            digest.update(star_column(stars, name).tobytes())
        return digest.hexdigest()


def _psf(config: RunConfig, name: str) -> PSF:
    return psf_from_name(name, **config.psf_options)


def _from_moments(config: RunConfig, psf: str, moments: KernelMoments) -> Shape:
    return response(_psf(config, psf), estimator_from_name(config.estimator)).shapes(moments)


def _without_companions(config: RunConfig, psf: str, method: Method) -> Shape:
    if method == "moments":
        return _from_moments(config, psf, KernelMoments(values=np.zeros((1, N_MOMENTS)), n_stars=1))
    from porrima.images import measure_stack  # noqa: PLC0415  (GalSim's drawing, where used)
    from porrima.systems import Systems  # noqa: PLC0415

    zero = np.zeros(1)
    single = Systems.from_pairs(zero, zero, zero)
    return measure_stack(_psf(config, psf), single, estimator_from_name(config.estimator))


def _written(
    run: _Run, store: Store, ranges: list[tuple[int, int]], cluster: Cluster | None
) -> Iterator[int]:
    """Numbers of stacks written, chunk by chunk: by this process, or by workers that see the store's folder."""
    if cluster is None:
        results: Iterator[Chunk | int] = (run.chunk(*some) for some in ranges)
    else:
        results = cluster.results(partial(_write_there, run, store.path, store.token), ranges)
    for result in results:
        if isinstance(result, Chunk):
            store.write(result)
            result = result.binary_fraction.size
        yield result


def _write_there(run: _Run, path: Path, token: str, first: int, last: int) -> Chunk | int:
    """Number of stacks written by a worker; the chunk itself, for another to write, where the store is not in reach.

    The token is looked for each time: when the process that gave the work out has died, and another run has taken
    the store, nothing is written to it.
    """
    chunk = run.chunk(first, last)
    store = Store.within_reach(path, token)
    if store is None:
        return chunk
    store.write(chunk)
    return last - first
