"""From the options of `budget` to a budget: survey, galaxies, bins of magnitude, stars and PSF."""

from __future__ import annotations

import itertools
import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from porrima.answers import COLOUR_KEYS, colour_answer, population_config
from porrima.budget import Premises, budget
from porrima.colour import chromatic
from porrima.config import GalaxiesConfig, known, load_requirement, parse
from porrima.deconvolution import fit_response
from porrima.errors import InputError
from porrima.galaxies import Galaxies, r2_of_half_light
from porrima.instruments import REQUIREMENTS, SURVEYS, Requirement, Survey
from porrima.integrals import integrate
from porrima.io import read_galaxies
from porrima.ledger import budget_answer
from porrima.psf import GRID_PER_FWHM, psf_from_name
from porrima.resolution import seen_by_regauss
from porrima.response import response
from porrima.sample import draw_stars, population_of, selection_of
from porrima.shapes import Adaptive, Plain, estimator_from_name

if TYPE_CHECKING:
    from collections.abc import Sequence

    from porrima.budget import Budget
    from porrima.colour import Chromatic
    from porrima.config import PopulationConfig
    from porrima.psf import PSF
    from porrima.shapes import Estimator
    from porrima.stars import Stars

__all__ = ["decided", "galaxies_of", "magnitude_bins", "profile_of", "seen_by", "survey_of"]

GALAXY_SIZE = 0.3
"""Half-light radius of the exponential galaxies that are taken where none are given, in arcsec."""

MOST_BINS = 200
"""Bins of magnitude that one budget may have (count)."""

N_DRAWN = 2_000
"""Stars drawn from the analytic Galaxy in each bin of magnitude (count)."""

RUBIN_PSF = Path(__file__).parent / "data" / "rubin.yaml"
"""Where the stanza of the PSF that is called ``rubin`` is."""


def survey_of(instrument: str | None, requirements: Path | None) -> tuple[Survey, Requirement]:
    """Survey of a name, and the requirements that a budget is held against.

    Parameters
    ----------
    instrument : str or None
        A key of `instruments.SURVEYS`.
    requirements : Path or None
        A YAML file instead of, or beside, the survey's own.

    Returns
    -------
    survey, requirement : Survey, Requirement
        ``kcm16`` gives the PSF where only a file is given.

    Raises
    ------
    InputError
        If neither is given, there is no such survey, or the file is wrong.
    """
    if instrument is None and requirements is None:
        names = ", ".join(REQUIREMENTS)
        raise InputError(f"must be one of {names}, or --requirements FILE.yaml be given", key="--instrument")
    survey = known("--instrument", instrument or "kcm16", SURVEYS)
    if requirements is None:
        return survey, survey.requirement
    return survey, Requirement(**load_requirement(requirements).model_dump())


def galaxies_of(size: float | None, text: str | None) -> Galaxies:
    """Galaxies from the options of a command.

    Parameters
    ----------
    size : float or None
        Half-light radius of exponential galaxies, in arcsec.
    text : str or None
        The keys of `config.GalaxiesConfig` as YAML, or the name of a table.

    Returns
    -------
    galaxies : Galaxies
        `GALAXY_SIZE` where nothing is given.

    Raises
    ------
    InputError
        If both are given, or there are no galaxies, or one is of no good.
    """
    if size is not None and text is not None:
        raise InputError("cannot be given together with --galaxies", key="--galaxy-size", value=size)
    if text is None:
        size = GALAXY_SIZE if size is None else size
        if not 0 < size < math.inf:
            raise InputError("must be positive and finite [arcsec]", key="--galaxy-size", value=size)
        return Galaxies.sersic(size, 1.0)
    data: Any = {"file": text}
    if text.lstrip().startswith("{"):
        try:
            data = yaml.safe_load(text)
        except yaml.YAMLError:
            raise InputError("must be a table or {key: value, ...}", key="--galaxies", value=text) from None
    config = parse(GalaxiesConfig, data, source=Path("--galaxies"))
    if config.file is not None:
        return read_galaxies(config.file, config.index, config.mean_e2, config.smallest)
    ratio = r2_of_half_light(config.index)
    return Galaxies.log_normal(
        ratio * (config.half_light_radius or 0.0) ** 2,
        2 * config.scatter,
        smallest_r2=ratio * config.smallest**2,
        index=config.index,
        mean_e2=config.mean_e2,
    )


def magnitude_bins(
    mag: tuple[float, float], n_bins: int | None, step: float | None
) -> list[tuple[float, float]]:
    """Bins of magnitude, each half-open.

    Parameters
    ----------
    mag : (float, float)
        Whole range, in mag.
    n_bins : int or None
        Number of equal bins (count).
    step : float or None
        Width of each, in mag; the last may be narrower.

    Returns
    -------
    bins : list of (float, float)
        One mag each where neither is given.

    Raises
    ------
    InputError
        If both are given, or one is not positive, or there are more than `MOST_BINS`.
    """
    low, high = mag
    if n_bins is not None and step is not None:
        raise InputError("cannot be given together with --step", key="--bins", value=n_bins)
    if n_bins is not None and n_bins < 1:
        raise InputError("must be at least 1", key="--bins", value=n_bins)
    if step is not None and not 0 < step < math.inf:
        raise InputError("must be positive and finite [mag]", key="--step", value=step)
    if not -50 <= low < high <= 50:
        raise InputError("must be LO HI with LO < HI, within -50 to 50", key="--mag", value=f"{low} {high}")
    count = n_bins if n_bins is not None else math.ceil((high - low) / (step or 1.0) - 1e-9)
    if count > MOST_BINS:
        raise InputError(f"must make at most {MOST_BINS} bins", key="--step", value=count)
    if n_bins is None:
        edges = np.append(low + (step or 1.0) * np.arange(count), high)
    else:
        edges = np.linspace(low, high, count + 1)
    rounded = [round(float(edge), 9) for edge in edges]
    return list(itertools.pairwise(rounded))


def decided(
    *,
    instrument: str | None,
    requirements: Path | None,
    galaxy_size: float | None,
    galaxies: str | None,
    mag: tuple[float, float],
    bins: int | None,
    step: float | None,
    psf: str | None,
    pixel: float | None,
    pixel_scale: float | None,
    jitter: float | None,
    estimator: str,
    n_stars: int,
    binary_fraction: float | None,
    cut: float | None,
    colour: str | None = None,
    **options: Any,
) -> tuple[dict[str, Any], Budget]:
    """Budget from the options of the command.

    Parameters
    ----------
    instrument, requirements, galaxy_size, galaxies, mag, bins, step
        As `survey_of`, `galaxies_of` and `magnitude_bins` take them.
    psf, estimator : str
        Names; None for the survey's PSF.
    pixel, pixel_scale, jitter, cut : float or None
        In arcsec; None for the survey's pixel, jitter and cut.
    n_stars : int
        From which the PSF of a patch is made (count).
    binary_fraction : float or None
        In [0, 1]; None for the model's own.
    colour : str or None
        Band in which the PSF is formed, where the colour of companions is asked for.
    options : dict
        Of `answers.population_config`.

    Returns
    -------
    answer, budget : dict, Budget
        The keys of the contract, and what they are from.

    Raises
    ------
    InputError
        If an option is wrong, a bin holds no star, or the cut is too wide for kernel moments.
    """
    if n_stars < 1:
        raise InputError("must be at least 1", key="--n-stars", value=n_stars)
    survey, requirement = survey_of(instrument, requirements)
    sizes, ranges = galaxies_of(galaxy_size, galaxies), magnitude_bins(mag, bins, step)
    config = population_config(**options, mag=mag, cut=survey.cut if cut is None else cut)
    method = estimator_from_name(estimator)
    profile = profile_of(survey, psf, pixel, pixel_scale, jitter)
    waves = None
    if colour is not None:
        own = (survey.pixel, survey.jitter) if psf is None else (None, None)
        blur: dict[str, Any] = {"pixel": pixel or own[0], "jitter": jitter or own[1]}
        waves = chromatic(psf or survey.psf, method, colour, **blur)
    parts, reply = _stars_of(config, ranges), response(profile, method)
    premises = Premises(
        requirement=requirement,
        response=reply,
        n_stars=n_stars,
        multiplicity=config.multiplicity.build(),
        photometry=config.photometry.build(),
        cut=config.cut,
        binary_fraction=binary_fraction,
        fit=fit_response(profile, sizes),
        seen=seen_by(method, sizes, profile),
        selection=selection_of(config, reply),
    )
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = budget(premises, parts)
    for one in {str(one.message): one for one in said}.values():  # each bin says the same
        warnings.warn(one.message, stacklevel=2)
    answer = budget_answer(found, profile.name, estimator, sizes)
    for row, (_, stars) in zip(answer["bins"], parts, strict=True):
        row |= _colours(config, stars, waves, premises)
    return answer, found


def _colours(
    config: PopulationConfig, stars: Stars, waves: Chromatic | None, premises: Premises
) -> dict[str, Any]:
    """What the colour of the companions of a bin does; None where it is not asked for."""
    if waves is None:
        return dict.fromkeys(COLOUR_KEYS)
    population = population_of(config, stars, premises.response)
    fraction = None if premises.binary_fraction is None else np.array([premises.binary_fraction])
    r2_0 = float(premises.response.shape0.r2)
    return colour_answer(config, population, integrate(population), waves, r2_0, fraction)


def profile_of(
    survey: Survey, psf: str | None, pixel: float | None, pixel_scale: float | None, jitter: float | None
) -> PSF:
    """PSF that was asked for, or the survey's.

    Parameters
    ----------
    survey : Survey
        Gives PSF, pixel and jitter where they are not given.
    psf : str or None
        Its name.
    pixel, pixel_scale, jitter : float or None
        In arcsec.

    Returns
    -------
    psf : PSF
        Convolved with pixel and jitter.

    Raises
    ------
    InputError
        If there is no such PSF.
    """
    if psf is not None:
        return psf_from_name(psf, pixel=pixel, pixel_scale=pixel_scale, jitter=jitter)
    own: dict[str, Any] = {
        "pixel": pixel or survey.pixel,
        "pixel_scale": pixel_scale,
        "jitter": jitter or survey.jitter,
    }
    if survey.psf == "rubin":
        found = psf_from_name(str(RUBIN_PSF), **own)
        grid = found.fwhm / GRID_PER_FWHM if found.grid is None else found.grid
        return replace(found, name=found.name.replace(str(RUBIN_PSF), survey.psf), grid=grid)
    return psf_from_name(survey.psf, **own)


def _stars_of(
    config: PopulationConfig, bins: Sequence[tuple[float, float]]
) -> list[tuple[tuple[float, float], Stars]]:
    """Stars of each bin: of a catalogue those that are there, of the Galaxy as many in each."""
    where = config.stars
    whole = draw_stars(config) if where.catalog is not None else None
    parts = []
    for mag in bins:
        if whole is not None:
            stars = whole.select(magnitude=mag)
        else:
            one = where.model_copy(update={"mag": mag, "n_drawn": N_DRAWN})
            stars = draw_stars(config.model_copy(update={"stars": one}))
        if not len(stars):
            rule = f"no star with magnitude in [{mag[0]:g}, {mag[1]:g}): choose other bins"
            raise InputError(rule, source=where.catalog, key="mag")
        parts.append((mag, stars))
    return parts


def seen_by(estimator: Estimator, galaxies: Galaxies, psf: PSF) -> Galaxies | None:
    """Sizes as a method that subtracts moments of the PSF sees them.

    Parameters
    ----------
    estimator : Estimator
        Of the moments.
    galaxies : Galaxies
        Whose shear is measured.
    psf : PSF
        Behind which they are seen.

    Returns
    -------
    galaxies : Galaxies or None
        None where there is no such method.
    """
    if isinstance(estimator, Plain):
        return galaxies
    return seen_by_regauss(galaxies, psf) if isinstance(estimator, Adaptive) else None
