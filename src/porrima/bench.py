"""How fast Porrima is: beside what others would write, beside its random numbers alone, and against its own load.

Everything is measured in one run on one machine.  Tasks that are compared take turns; a ratio is formed within each
round, so that a machine which slows down does not move it.  Peers run in as many processes as the engine has threads.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import galsim
import numpy as np

from porrima.config import RunConfig, parse
from porrima.floor import draw_floor
from porrima.machine import peak_memory, this_machine
from porrima.peers import PEERS, Companions, convolved, hsm
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.sample import draw_stars, population_of
from porrima.shapes import Adaptive
from porrima.simulation import CHUNK, simulate
from porrima.stack import Device, draw_stacks
from porrima.stamps import measure_stamps
from porrima.timings import estimate, seconds_of, taken_in_turn

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from porrima.systems import Population

    FloatArray = NDArray[np.float64]

__all__ = ["BINARY_FRACTION", "FULL", "QUICK", "Sizes", "bench", "n_steps"]

BINARY_FRACTION = 0.35
"""Of the population that is drawn: Galaxy at l = 180, b = 45 deg, 18 <= i < 19 (dimensionless)."""

PSF_NAMES = ("psf1", "optical1")
"""A Gaussian, and a diffraction pattern of the same shape."""

_CHUNK = CHUNK["moments"]
_STARS_AT_ONCE = 1 << 15  # that a peer draws before it makes images: its arrays stay in the cache
_COST = {  # rough seconds per stack and per star, on one core or on all threads: they only size what is timed
    "moments": (4e-7, 3e-9),
    "shapes": (1e-6, 3e-9),
    "floor": (2e-7, 1.5e-9),
    "galsim-stars": (3e-4, 1.3e-4),
    "galsim-sum": (1e-3, 3e-5),
    "fft": (4e-4, 5e-8),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Sizes:
    """How much is measured.

    Parameters
    ----------
    rounds : int
        Times that count, of each task (count).
    seconds : float
        That one of them is to take at least, roughly.
    n_stars : (int, int)
        In the stacks that are compared with peers (count).
    scan_stars, scan_stacks : tuple of int
        Stars in a stack, and stacks, against which the cost is measured (count).
    memory_stacks : tuple of int
        Stacks of the runs whose memory is measured (count).
    """

    rounds: int
    seconds: float
    n_stars: tuple[int, int]
    scan_stars: tuple[int, ...]
    scan_stacks: tuple[int, ...]
    memory_stacks: tuple[int, ...]


FULL = Sizes(
    rounds=5,
    seconds=0.25,
    n_stars=(40, 10_000),
    scan_stars=(1, 3, 10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000),
    scan_stacks=(100, 300, 1000, 3000, 10_000, 30_000, 100_000, 300_000, 1_000_000),
    memory_stacks=(10_000, 100_000, 1_000_000),
)
"""The default."""

QUICK = Sizes(
    rounds=3,
    seconds=0.03,
    n_stars=(40, 1000),
    scan_stars=(1, 100, 10_000),
    scan_stacks=(100, 1000, 10_000),
    memory_stacks=(1000, 20_000),
)
"""For a first look."""


def n_steps(sizes: Sizes) -> int:
    """Steps that `bench` tells of.

    Parameters
    ----------
    sizes : Sizes
        How much is measured.

    Returns
    -------
    n_steps : int
        Groups of tasks, points of a scan and runs (count).
    """
    groups = len(PSF_NAMES) * (len(sizes.n_stars) + 1)
    return groups + len(sizes.scan_stars) + len(sizes.scan_stacks) + len(sizes.memory_stacks)


def bench(
    sizes: Sizes = FULL, *, seed: int = 1, progress: Callable[[int], None] = lambda _: None
) -> dict[str, Any]:
    """What was measured.

    Parameters
    ----------
    sizes : Sizes
        How much is measured.
    seed : int
        Of everything drawn.
    progress : callable
        Called with 1 after each of `n_steps` steps.

    Returns
    -------
    result : dict
        The machine, and the lists ``speeds``, ``ratios``, ``shape_speeds``, ``cost_of_stars``, ``cost_of_stacks`` and
        ``memory``; each key is described in docs/commands.md.
    """
    start, machine, population = time.perf_counter(), this_machine(), _population(seed)
    result: dict[str, Any] = asdict(machine) | {
        "seed": seed,
        "binary_fraction": BINARY_FRACTION,
        "rounds": sizes.rounds,
        "speeds": [],
        "ratios": [],
        "shape_speeds": [],
    }
    with _processes(machine.threads) as pool:
        team = _Team(pool=pool, size=machine.threads, seed=seed)
        for psf in PSF_NAMES:
            for n_stars in sizes.n_stars:
                speeds, ratios = _compared(population, team, psf, n_stars, sizes)
                result["speeds"] += speeds
                result["ratios"] += ratios
                progress(1)
            result["shape_speeds"] += _shape_speeds(population, team, psf, sizes)
            progress(1)
    result["cost_of_stars"] = _scan([(n, None) for n in sizes.scan_stars], population, seed, sizes, progress)
    result["cost_of_stacks"] = _scan([(40, n) for n in sizes.scan_stacks], population, seed, sizes, progress)
    result["memory"] = list(_memory(sizes, seed, progress))
    return result | {"wall_s": time.perf_counter() - start}


# --- the engine


@lru_cache(maxsize=1)
def _population(seed: int) -> Population:
    """The stars of every measurement; a process of a peer makes the same ones."""
    config = _config(seed)
    return population_of(config, draw_stars(config))


def _config(seed: int, **other: Any) -> RunConfig:
    stars = {"l": 180, "b": 45, "mag": [18, 19]}
    return parse(RunConfig, {"stars": stars, "binary_fraction": BINARY_FRACTION, "seed": seed, **other})


def _devices() -> tuple[Device, ...]:
    """Where the engine can draw: the one place that knows of others than the CPU."""
    from numba import cuda  # noqa: PLC0415  (starts the driver)

    return ("cpu", "cuda") if cuda.is_available() else ("cpu",)


def _chunks(
    draw: Callable[..., Any], population: Population, n_stars: int, n_stacks: int, seed: int
) -> Iterator[Any]:
    """Stacks as a run draws them, a chunk at a time."""
    for first in range(0, n_stacks, _CHUNK):
        last = min(first + _CHUNK, n_stacks)
        yield draw(
            population, n_stars=n_stars, binary_fraction=BINARY_FRACTION, seed=seed, first=first, last=last
        )


def _moments(
    draw: Callable[..., Any], population: Population, n_stars: int, n_stacks: int, seed: int
) -> float:
    """Seconds to draw stacks, with their moments or as random numbers alone."""
    return seconds_of(lambda: [None for _ in _chunks(draw, population, n_stars, n_stacks, seed)])


def _shapes(
    draw: Callable[..., Any], population: Population, n_stars: int, n_stacks: int, seed: int, psf: str
) -> float:
    """Seconds for moments and shapes."""
    reply = response(psf_from_name(psf), Adaptive())
    return seconds_of(
        lambda: [reply.shapes(s.moments).r2 for s in _chunks(draw, population, n_stars, n_stacks, seed)]
    )


def _n_stacks(task: str, n_stars: int, seconds: float) -> int:
    per_stack, per_star = _COST[task]
    return max(1, round(seconds / (per_stack + per_star * n_stars)))


# --- peers, each in as many processes as the engine has threads


@dataclass(frozen=True, slots=True, kw_only=True)
class _Team:
    """Processes of peers."""

    pool: ProcessPoolExecutor
    size: int
    seed: int

    def slowest(self, work: Callable[[int, int], float]) -> float:
        """Seconds of the slowest process, all at the same work with streams of their own."""
        return max(self.pool.map(work, [self.seed] * self.size, range(self.size)))


def _processes(n: int) -> ProcessPoolExecutor:
    """Fresh processes (a fork would inherit the threads of compiled loops), one thread each."""
    return ProcessPoolExecutor(
        n, multiprocessing.get_context("spawn"), initializer=galsim.utilities.set_omp_threads, initargs=(1,)
    )


@lru_cache(maxsize=1)
def _companions(seed: int) -> Companions:
    return Companions.of(_population(seed), BINARY_FRACTION)


def _peer_seconds(name: str, psf: str, n_stars: int, n_stacks: int, seed: int, process: int) -> float:
    """Seconds in which one process draws and measures stacks, everything built before."""
    behind, companions = psf_from_name(psf), _companions(seed)
    rng = np.random.default_rng([seed, process])
    at_once = max(1, _STARS_AT_ONCE // n_stars)

    def work() -> None:
        for first in range(0, n_stacks, at_once):
            PEERS[name](behind, companions.draw(min(at_once, n_stacks - first), n_stars, rng))

    return seconds_of(work)


def _stamps(psf: str, n_stacks: int, seed: int, process: int = 0) -> FloatArray:
    """Images of stacks of 40 stars to measure."""
    pairs = _companions(seed).draw(n_stacks, 40, np.random.default_rng([seed, process]))
    return np.concatenate(list(convolved(psf_from_name(psf), pairs)))


def _hsm_seconds(psf: str, n_stacks: int, seed: int, process: int) -> float:
    """Seconds in which one process measures images that are there with HSM."""
    scale = psf_from_name(psf).scale
    images = [galsim.Image(image, scale=scale) for image in _stamps(psf, n_stacks, seed, process)]
    return seconds_of(lambda: [hsm(image) for image in images])


# --- what is measured


@dataclass(frozen=True, slots=True, kw_only=True)
class _Task:
    """One thing that is timed: what, where, and how many stacks at once."""

    who: str
    device: str
    n_stacks: int
    work: Callable[[], float]


def _tasks(population: Population, team: _Team, psf: str, n_stars: int, seconds: float) -> Iterator[_Task]:
    """The engine, its floor and its peers on one kind of stack."""
    drawn = {("moments", device): partial(draw_stacks, device=device) for device in _devices()}
    for (who, device), draw in (drawn | {("floor", "cpu"): draw_floor}).items():
        n = _n_stacks(who, n_stars, seconds)
        work = partial(_moments, draw, population, n_stars, n, team.seed)
        yield _Task(who=who, device=device, n_stacks=n, work=work)
    for (_, device), draw in drawn.items():
        n = _n_stacks("shapes", n_stars, seconds)
        work = partial(_shapes, draw, population, n_stars, n, team.seed, psf)
        yield _Task(who="shapes", device=device, n_stacks=n, work=work)
    for name in PEERS:
        n = _n_stacks(name, n_stars, seconds)
        work = partial(team.slowest, partial(_peer_seconds, name, psf, n_stars, n))
        yield _Task(who=name, device="cpu", n_stacks=n * team.size, work=work)


def _compared(
    population: Population, team: _Team, psf: str, n_stars: int, sizes: Sizes
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Speeds of all tasks on one kind of stack, and the engine's ratio to the others."""
    tasks = {(t.who, t.device): t for t in _tasks(population, team, psf, n_stars, sizes.seconds)}
    seconds = taken_in_turn({who: task.work for who, task in tasks.items()}, sizes.rounds)
    rates = {who: n_stars * task.n_stacks / seconds[who] for who, task in tasks.items()}
    about: dict[str, Any] = {"psf": psf, "n_stars": n_stars}
    speeds = [
        about
        | {"who": task.who, "device": task.device, "n_stacks": task.n_stacks}
        | _told("stars_per_s", rates[who])
        for who, task in tasks.items()
    ]
    ratios = [
        about
        | {"against": other, "device": device}
        | _told("ratio", rates["shapes", device] / rates[other, "cpu"])
        | _told("ratio_moments", rates["moments", device] / rates[other, "cpu"])
        for other, _ in tasks
        if other not in ("moments", "shapes")
        for device in _devices()
    ]
    return speeds, ratios


def _told(name: str, values: FloatArray) -> dict[str, float]:
    """A number and its error under two keys."""
    value, error = estimate(values)
    return {name: value, f"{name}_error": error}


def _shape_speeds(population: Population, team: _Team, psf: str, sizes: Sizes) -> list[dict[str, Any]]:
    """Shapes per second: the response, Porrima's own measurement of stamps, and HSM, for stacks of 40 stars."""
    reply, scale = response(psf_from_name(psf), Adaptive()), psf_from_name(psf).scale
    n_stacks, n_stamps = round(sizes.seconds / 1e-6), max(8, round(sizes.seconds / 4e-4))
    moments = next(_chunks(draw_stacks, population, 40, min(n_stacks, _CHUNK), team.seed)).moments
    calls = max(1, n_stacks // _CHUNK)
    images = _stamps(psf, n_stamps, team.seed)
    tasks: dict[str, Callable[[], float]] = {
        "response": lambda: seconds_of(lambda: [reply.shapes(moments) for _ in range(calls)]),
        "stamps": lambda: seconds_of(lambda: measure_stamps(images, scale, Adaptive())),
        "hsm": lambda: team.slowest(partial(_hsm_seconds, psf, n_stamps)),
    }
    n = {"response": calls * len(moments), "stamps": n_stamps, "hsm": n_stamps * team.size}
    rates = {name: n[name] / seconds for name, seconds in taken_in_turn(tasks, sizes.rounds).items()}
    return [
        {"psf": psf, "measurer": name}
        | _told("shapes_per_s", rate)
        | _told("ratio_to_hsm", rate / rates["hsm"])
        for name, rate in rates.items()
    ]


def _scan(
    points: list[tuple[int, int | None]],
    population: Population,
    seed: int,
    sizes: Sizes,
    progress: Callable[[int], None],
) -> list[dict[str, Any]]:
    """Cost of the engine, alone and with shapes, for given stars in a stack and stacks (None: as many as fit)."""
    rows = []
    for n_stars, given in points:
        n_stacks = _n_stacks("shapes", n_stars, 0.5 * sizes.seconds) if given is None else given
        calls = max(1, _n_stacks("shapes", n_stars, 0.1 * sizes.seconds) // n_stacks)
        stacks = (draw_stacks, population, n_stars, n_stacks, seed)
        works = {
            "us_per_stack": partial(_moments, *stacks),
            "us_per_stack_with_shape": partial(_shapes, *stacks, PSF_NAMES[0]),
        }
        tasks = {name: partial(_repeated, calls, work) for name, work in works.items()}
        row: dict[str, Any] = {"n_stars": n_stars, "n_stacks": n_stacks}
        for name, seconds in taken_in_turn(tasks, sizes.rounds).items():
            row |= _told(name, 1e6 / (calls * n_stacks) * seconds)
        rows.append(row)
        progress(1)
    return rows


def _repeated(calls: int, task: Callable[[], float]) -> float:
    """Seconds of several calls."""
    return sum(task() for _ in range(calls))


def _memory(sizes: Sizes, seed: int, progress: Callable[[int], None]) -> Iterator[dict[str, Any]]:
    """Peak memory of runs of growing size, each in a process of its own."""
    for n_stacks in sizes.memory_stacks:
        with _processes(1) as pool:
            yield pool.submit(_run_memory, n_stacks, seed).result()
        progress(1)


def _run_memory(n_stacks: int, seed: int) -> dict[str, Any]:
    """Memory and time of this process after one run."""
    config = _config(seed, n_stars=40, n_stacks=n_stacks, psf="psf1")
    with tempfile.TemporaryDirectory() as folder:
        seconds = seconds_of(lambda: simulate(config, Path(folder) / "run.zarr"))
    return {"n_stacks": n_stacks, "n_stars": 40, "run_s": seconds, "peak_mb": peak_memory()}
