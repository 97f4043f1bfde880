"""How fast the engine is, as a ratio to drawing the same stars with GalSim in the same run."""

from __future__ import annotations

import os
import platform
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import galsim
import numba

from porrima.config import RunConfig, parse
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.sample import draw_stars, population_of
from porrima.shapes import estimator_from_name
from porrima.stack import draw_stacks, draw_systems

if TYPE_CHECKING:
    from porrima.stack import Stacks
    from porrima.systems import Population

__all__ = ["Speed", "measure_speed"]

_STAMP = 128  # pixels a side
_GALSIM_STACKS = 3  # of `n_stars` each: GalSim's rate does not change with their number


@dataclass(frozen=True, slots=True, kw_only=True)
class Speed:
    """Stars simulated per second of wall time, by the engine and by GalSim, in one process and run.

    Parameters
    ----------
    machine : str
        Processor and number of threads.
    n_stars : int
        In each stack (count).
    engine_stars_per_s : float
        Engine alone, on all threads: kernel moments.
    engine_with_shapes_stars_per_s : float
        Engine and the adaptive shape of each stack behind one PSF.
    galsim_stars_per_s : float
        Each star drawn on a 128 x 128 stamp in float64 and each stack measured with HSM, on one thread.
    ratio : float
        Engine over GalSim times the number of threads, as if GalSim ran on all of them (dimensionless).
    """

    machine: str
    n_stars: int
    engine_stars_per_s: float
    engine_with_shapes_stars_per_s: float
    galsim_stars_per_s: float
    ratio: float


def measure_speed(*, n_stars: int = 40, n_stacks: int = 100_000, seed: int = 1) -> Speed:
    """Speed of the engine and of GalSim on the same stars: embedded Galaxy, 18 <= i < 19, 35 % pairs, PSF1.

    Parameters
    ----------
    n_stars : int
        In each stack (count).
    n_stacks : int
        Stacks of the engine (count).
    seed : int
        Of the run.

    Returns
    -------
    speed : Speed
        Stars per second and their ratio.
    """
    config = parse(
        RunConfig, {"stars": {"l": 180, "b": 45, "mag": [18, 19]}, "binary_fraction": 0.35, "seed": seed}
    )
    population = population_of(config, draw_stars(config))

    def draw(last: int) -> Stacks:
        return draw_stacks(population, n_stars=n_stars, binary_fraction=0.35, seed=seed, first=0, last=last)

    reply = response(psf_from_name("psf1"), estimator_from_name("adaptive"))
    reply.shapes(draw(2).moments)  # compiled here
    start = time.perf_counter()
    stacks = draw(n_stacks)
    drawn = time.perf_counter()
    reply.shapes(stacks.moments)
    measured = time.perf_counter()
    galsim_rate = _galsim_rate(population, n_stars, seed)
    engine = n_stars * n_stacks / (drawn - start)
    threads = numba.get_num_threads()
    return Speed(
        machine=f"{_processor()}, {threads} threads",
        n_stars=n_stars,
        engine_stars_per_s=engine,
        engine_with_shapes_stars_per_s=n_stars * n_stacks / (measured - start),
        galsim_stars_per_s=galsim_rate,
        ratio=engine / (galsim_rate * threads),
    )


def _galsim_rate(population: Population, n_stars: int, seed: int) -> float:
    """Stars per second that GalSim draws one by one and stacks, each stack measured with HSM."""
    psf = psf_from_name("psf1")
    spent = 0.0
    for stack in range(_GALSIM_STACKS):
        systems = draw_systems(population, n_stars=n_stars, binary_fraction=0.35, seed=seed, stack=stack)
        start = time.perf_counter()
        total = galsim.ImageD(_STAMP, _STAMP, scale=psf.scale)
        for flux, x, y in zip(systems.flux.tolist(), systems.x.tolist(), systems.y.tolist(), strict=True):
            stars = [psf.profile.shift(x[k], y[k]) * flux[k] for k in range(2) if flux[k] > 0]
            total += galsim.Sum(stars).drawImage(
                nx=_STAMP, ny=_STAMP, scale=psf.scale, method="no_pixel", dtype=float
            )
        galsim.hsm.FindAdaptiveMom(total)
        spent += time.perf_counter() - start
    return n_stars * _GALSIM_STACKS / spent


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [line.split(":")[1].strip() for line in file if line.startswith("model name")]
        return names[0]
    except (OSError, IndexError):
        return f"{platform.processor() or platform.machine()} ({os.cpu_count()} cores)"
