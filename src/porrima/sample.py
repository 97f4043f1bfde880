"""The stars of a configuration, and the population that they make."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.config import RunConfig
from porrima.errors import InputError
from porrima.instruments import SURVEYS
from porrima.selection import Combined, read_selection
from porrima.systems import BRIGHT_MASS, Population

if TYPE_CHECKING:
    from porrima.catalogs import Catalog
    from porrima.config import PopulationConfig
    from porrima.criteria import SelectionConfig
    from porrima.detection import Detection
    from porrima.response import Response
    from porrima.selection import Selection
    from porrima.stars import Stars

__all__ = ["catalog_of", "draw_stars", "population_of", "selection_of"]

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


def population_of(config: PopulationConfig, stars: Stars, response: Response | None = None) -> Population:
    """Population of a configuration.

    Parameters
    ----------
    config : PopulationConfig
        Models, cut and selection.
    stars : Stars
        Already selected.
    response : Response, optional
        Of the PSF that stars are clipped behind; that of the configuration where not given.

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
        selection=selection_of(config, response),
    )


def selection_of(config: PopulationConfig, response: Response | None = None) -> Selection | None:
    """Selection of a configuration.

    Parameters
    ----------
    config : PopulationConfig
        With the key ``selection``, or without.
    response : Response, optional
        Of the PSF that stars are clipped behind; that of the configuration where not given.

    Returns
    -------
    selection : Selection or None
        None where there is none.

    Raises
    ------
    InputError
        If the table is wrong, or it is not clear which PSF is meant.
    """
    if config.selection is None:
        return None
    parts = tuple(_built(one, config, response) for one in config.selection)
    return parts[0] if len(parts) == 1 else Combined(parts=parts)


def _built(one: SelectionConfig, config: PopulationConfig, response: Response | None) -> Selection:
    """One selection of a configuration."""
    if one.table is not None:
        return read_selection(one.table)
    if one.gaia is not None:
        from porrima.gaia_flags import GaiaFlags  # noqa: PLC0415  (where used)

        return GaiaFlags(**one.given("ruwe_max", "multi_peak", "false_alarm", "colour"))
    if one.detection is not None:
        return _detection(
            one.detection,
            one.psf,
            one.pixel,
            one.exposures,
            **one.given("false_alarm", "statistic", "psf_error"),
        )
    from porrima.clip import Clip, Noise  # noqa: PLC0415  (the response, where used)

    noise = one.noise or 0.0
    by_magnitude = sorted(noise.items()) if isinstance(noise, dict) else [(0.0, noise)]
    magnitude, sigma = zip(*by_magnitude, strict=True)
    return Clip(
        response=_clipped_behind(one.psf, config, response),
        threshold=one.clip or 0.0,
        quantity=one.quantity or "r2",
        noise=Noise(magnitude=magnitude, sigma=sigma),
    )


@lru_cache(maxsize=16)
def _detection(
    survey: str, psf: str | None, pixel: float | None, n_exposures: int | None, **options: Any
) -> Detection:
    """What a survey recognises on its exposures, behind its own PSF or another."""
    from porrima.detection import Detection  # noqa: PLC0415  (compiled code, where used)
    from porrima.exposure import EXPOSURES  # noqa: PLC0415
    from porrima.psf import psf_from_name  # noqa: PLC0415  (GalSim, where used)

    own, exposures = SURVEYS[survey], EXPOSURES[survey]()
    if n_exposures is not None:
        exposures = replace(exposures, n_exposures=n_exposures)
    name, side, jitter = (psf, pixel, None) if psf is not None else (own.psf, own.pixel, own.jitter)
    return Detection.of(psf_from_name(name, pixel=side, jitter=jitter), exposures, **options)


def _clipped_behind(name: str | None, config: PopulationConfig, given: Response | None) -> Response:
    """Response of the PSF that stars are clipped behind."""
    from porrima.psf import psf_from_name  # noqa: PLC0415  (GalSim, where used)
    from porrima.response import response  # noqa: PLC0415
    from porrima.shapes import estimator_from_name  # noqa: PLC0415

    if given is not None:
        if name is not None:
            raise InputError("is that of the command", key="selection.psf", value=name)
        return given
    if not isinstance(config, RunConfig):
        raise InputError("needs a PSF", key="selection.clip")
    if name is None and len(config.psf) == 1:
        (name,) = config.psf
    if name not in config.psf:
        rule = f"must name the PSF that stars are clipped behind, one of {', '.join(config.psf)}"
        raise InputError(rule, key="selection.psf", value=name)
    return response(psf_from_name(name, **config.psf_options), estimator_from_name(config.estimator))
