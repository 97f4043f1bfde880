"""The paper's programme: its experiments in order, each carried out only where nothing is kept that it would repeat."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.archive import keep, kept, source_key
from porrima.cache import content_key
from porrima.config import Multiplicity, canonical
from porrima.experiments import (
    against_magnitude,
    effect_of_n_stars,
    errors_and_biases,
    n_stars_configs,
    paper_config,
    store_name,
)
from porrima.findings import of_errors_and_biases, of_magnitude, of_n_stars, of_population, of_toy
from porrima.instruments import KCM16
from porrima.multiplicity import MULTIPLICITY
from porrima.paper_tables import multiplicity_table, pair_sketch, psf_table
from porrima.psf import psf_from_name
from porrima.star_experiments import N_DIRECTIONS, population
from porrima.statements import N_STEPS, statement_numbers
from porrima.toy import toy_maps

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from contextlib import AbstractContextManager
    from pathlib import Path

    import xarray as xr

    from porrima.config import RunConfig
    from porrima.multiplicity import MultiplicityModel

    Parts = dict[str, xr.Dataset]
    Advance = Callable[[int], None]

__all__ = ["Experiment", "carried_out", "programme"]

OPTICAL = ("optical0", "optical1", "optical2", "optical1-rotated")
"""PSFs of KCM16 Sect. 5.2, with the struts of one turned."""

READINGS = ("dk13", "dk13-kcm16")
"""The two readings of the multiplicity table."""

_EDGES = np.arange(16.0, 24.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """One experiment of the programme.

    Parameters
    ----------
    name : str
        Of its numbers and files.
    settings : str
        All that its numbers depend on besides the source, as one line.
    size : int
        How much there is to do (count).
    unit : str
        Of what.
    make : callable
        Given a function that is called with how much is done, carries it out and gives its datasets by name.
    """

    name: str
    settings: str
    size: int
    unit: str
    make: Callable[[Advance], Parts]


def programme(
    folder: Path,
    *,
    full: bool = False,
    seed: int = 1,
    psf: tuple[str, ...] | None = None,
    n_stars: int | None = None,
) -> list[Experiment]:
    """The experiments of the paper.

    Parameters
    ----------
    folder : Path
        Where stacks are kept.
    full : bool
        At the paper's own size.
    seed : int
        Of all that is drawn.
    psf : tuple of str, optional
        Other PSFs than the paper's; the optical ones are then left out.
    n_stars : int, optional
        Another number of stars in the stacks of the first figures than 40 (count).

    Returns
    -------
    experiments : list of Experiment
        In the order of the report.

    Raises
    ------
    InputError
        If a PSF or a number is wrong.
    """
    for name in psf or ():
        psf_from_name(name)  # refuses what is none before anything is made
    config = paper_config(full=full, seed=seed, psf=psf, n_stars=n_stars)
    runs = {"errors_and_biases": config}
    runs["errors_and_biases_kcm16"] = config.model_copy(
        update={"multiplicity": Multiplicity(model=READINGS[1])}
    )
    if psf is None:
        runs["errors_and_biases_optical"] = config.model_copy(update={"psf": OPTICAL})
    stacks = [_stacks(name, run, folder) for name, run in runs.items()]
    stacks.insert(1, _n_stars(n_stars_configs(full=full, seed=seed, psf=psf), folder))
    n_drawn = 4000 if full else 500
    tables = [
        _small("multiplicity_table", lambda: multiplicity_table(_models())),
        _sky(),
        _small("psf_table", psf_table),
    ]
    last = [_magnitude(n_drawn, seed), _statements(config.psf, psf or OPTICAL, 4 * n_drawn, seed)]
    return [_toy(), _small("sketch", pair_sketch), *tables, *stacks, *last]


def carried_out(
    experiments: list[Experiment],
    folder: Path,
    progress: Callable[[str, int, str, bool], AbstractContextManager[Advance]],
) -> Iterator[tuple[str, Parts]]:
    """Numbers of the experiments: those kept from an earlier call, and the others made now.

    Parameters
    ----------
    experiments : list of Experiment
        From `programme`.
    folder : Path
        Where their numbers are kept, each under the key of settings and source.
    progress : callable
        Given name, size and unit of an experiment and whether its numbers are there already; a context that gives
        what is called with how much is done.

    Yields
    ------
    name, parts : str, dict
        Datasets by name, as they are on the disk.

    Returns
    -------
    None
        A generator.
    """
    for experiment in experiments:
        path = folder / experiment.name
        key = content_key(experiment.settings, source_key("programme"))
        parts = kept(path, key)
        with progress(experiment.name, experiment.size, experiment.unit, parts is not None) as advance:
            if parts is None:
                keep(path, key, experiment.make(advance))
                parts = kept(path, key) or {}
        yield experiment.name, parts


def _stacks(name: str, config: RunConfig, folder: Path) -> Experiment:
    store = store_name(config)

    def make(advance: Advance) -> Parts:
        numbers = errors_and_biases(config, folder / store, lambda n: advance(n * config.n_stars))
        return of_errors_and_biases(numbers, KCM16)

    settings = f"{store} {canonical(config)} {KCM16}"
    return Experiment(
        name=name, settings=settings, size=config.n_stacks * config.n_stars, unit="stars", make=make
    )


def _n_stars(configs: list[RunConfig], folder: Path) -> Experiment:
    return Experiment(
        name="effect_of_n_stars",
        settings=" ".join(f"{store_name(config)} {canonical(config)}" for config in configs),
        size=sum(config.n_stacks * config.n_stars for config in configs),
        unit="stars",
        make=lambda advance: of_n_stars(effect_of_n_stars(configs, folder, advance), KCM16),
    )


def _sky() -> Experiment:
    return Experiment(
        name="population",
        settings="",
        size=N_DIRECTIONS,
        unit="directions",
        make=lambda advance: of_population(population(progress=advance)),
    )


def _magnitude(n_drawn: int, seed: int) -> Experiment:
    options: dict[str, Any] = {"n_drawn": n_drawn, "seed": seed}
    models = _models()
    make = partial(against_magnitude, _EDGES, models, **options)
    return Experiment(
        name="magnitude",
        settings=json.dumps(options, sort_keys=True),
        size=(_EDGES.size - 1) * len(models),
        unit="bins",
        make=lambda advance: of_magnitude(make(progress=advance)),
    )


def _models() -> dict[str, MultiplicityModel]:
    return {name: MULTIPLICITY[name] for name in READINGS}


def _small(name: str, make: Callable[[], Parts]) -> Experiment:
    """An experiment that is done at once."""

    def made(advance: Advance) -> Parts:
        parts = make()
        advance(1)
        return parts

    return Experiment(name=name, settings="", size=1, unit="table", make=made)


def _toy() -> Experiment:
    return Experiment(
        name="toy", settings="", size=4, unit="maps", make=lambda advance: of_toy(toy_maps(progress=advance))
    )


def _statements(psf: tuple[str, ...], optical: tuple[str, ...], n_drawn: int, seed: int) -> Experiment:
    options: dict[str, Any] = {"psf": psf, "optical": optical, "n_drawn": n_drawn, "seed": seed}
    make = partial(statement_numbers, models=_models(), **options)
    return Experiment(
        name="statements",
        settings=json.dumps(options, sort_keys=True),
        size=N_STEPS,
        unit="groups of numbers",
        make=lambda advance: make(progress=advance),
    )
