"""The stars of a configuration, and the population that they make."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from porrima.errors import InputError
from porrima.systems import BRIGHT_MASS, Population

if TYPE_CHECKING:
    from porrima.catalogs import Catalog
    from porrima.config import PopulationConfig
    from porrima.stars import Stars

__all__ = ["catalog_of", "draw_stars", "population_of"]

_GALAXY_STREAM = 1  # spawn key of the stars' generator; the engine's streams are keyed by the seed alone


def catalog_of(config: PopulationConfig) -> Catalog | None:
    """Catalogue of a configuration, with the account of its rows.

    Parameters
    ----------
    config : PopulationConfig
        With a direction or a catalogue.

    Returns
    -------
    catalog : Catalog or None
        None for a direction.

    Raises
    ------
    InputError
        If the catalogue is wrong.
    """
    where = config.stars
    if where.catalog is None:
        return None
    from porrima.catalogs import read_catalog  # noqa: PLC0415  (astropy's readers, where used)

    return read_catalog(
        where.catalog, format=where.format, columns=where.map, band=where.band, options=where.options
    )


def draw_stars(config: PopulationConfig, catalog: Catalog | None = None) -> Stars:
    """Stars of a configuration: read or drawn, selected by magnitude and mass.

    Parameters
    ----------
    config : PopulationConfig
        With a direction or a catalogue.
    catalog : Catalog, optional
        What `catalog_of` gave for it, where it has been read already.

    Returns
    -------
    stars : Stars
        Main-sequence stars up to 1.5 M_sun in the magnitude range.

    Raises
    ------
    InputError
        If the catalogue is wrong or no star is left.
    """
    where = config.stars
    if where.l is not None and where.b is not None:
        from porrima.galaxy import Robin2003  # noqa: PLC0415  (the Galaxy's tables, where used)

        sequence = np.random.SeedSequence(config.seed, spawn_key=(_GALAXY_STREAM,))
        rng = np.random.Generator(np.random.Philox(sequence))
        n = None if where.area else where.n_drawn
        try:
            stars = Robin2003().draw(
                where.l, where.b, where.area or 1.0, where.band or "i", where.mag, rng, n=n
            )
        except ValueError as error:
            raise InputError(str(error), key="stars") from None
    elif (found := catalog or catalog_of(config)) is not None:
        stars = found.stars
    else:
        raise InputError("must have either a direction (l and b) or a catalogue", key="stars")
    selected = stars.select(magnitude=config.stars.mag, mass_max=BRIGHT_MASS)
    if len(selected) == 0:
        low, high = config.stars.mag
        raise InputError(
            f"no main-sequence star up to {BRIGHT_MASS} M_sun with magnitude in [{low}, {high})",
            source=config.stars.catalog,
            key="mag",
        )
    return selected


def population_of(config: PopulationConfig, stars: Stars) -> Population:
    """Population of a configuration.

    Parameters
    ----------
    config : PopulationConfig
        Models and cut.
    stars : Stars
        Already selected.

    Returns
    -------
    population : Population
        What simulation and prediction start from.
    """
    return Population.of(
        stars,
        multiplicity=config.multiplicity.build(),
        photometry=config.photometry.build(),
        cut=config.cut,
        stack_weight=config.stack_weight,
    )
