"""From the options of `select` to the stars that a PSF is best made of: survey, stars, noise, choice."""

from __future__ import annotations

import itertools
import math
import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima import __version__
from porrima.answers import population_config
from porrima.choice import CENTRES, THRESHOLDS, WEIGHTS, Plan, StarBin, choose, row_of
from porrima.clipping import count_pairs
from porrima.companions import MassRangeWarning
from porrima.config import known
from porrima.decision import galaxies_of, magnitude_bins, profile_of, survey_of
from porrima.deconvolution import fit_response
from porrima.errors import InputError
from porrima.exposure import EXPOSURES
from porrima.margin import Companions, left_after_correction, margin
from porrima.moments import INDICES
from porrima.own_sizes import own_sizes, sorting
from porrima.precision import covariance_at, fitted_covariance, measured_covariance
from porrima.response import response
from porrima.sample import catalog_of, draw_stars
from porrima.shapes import estimator_from_name
from porrima.truncation import SIDES

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from porrima.choice import Choice, Setting
    from porrima.config import PopulationConfig
    from porrima.exposure import Exposures
    from porrima.instruments import Requirement, Survey
    from porrima.psf import PSF
    from porrima.response import Response
    from porrima.shapes import Estimator
    from porrima.shear import ShearResponse
    from porrima.stars import Stars

    FloatArray = NDArray[np.float64]

__all__ = ["NOISES", "advised"]

NOISES = ("fitted", "measured")
"""Whose noise a star's shape has: of the best fit to all exposures, or of the estimator on every one of them."""

N_DRAWN = 1_000
"""Stars drawn from the analytic Galaxy in each bin of magnitude (count)."""

SAMPLES = 4
"""Parts of the stars of a bin from whose differences the error of their finite number is found (count)."""

_SECOND = [INDICES.index(powers) for powers in ((2, 0), (1, 1), (0, 2))]


def advised(
    *,
    survey: str | None,
    requirements: Path | None,
    mag: tuple[float, float],
    bins: int | None,
    step: float | None,
    area: float | None,
    patch_area: float | None,
    exposures: Sequence[int] | None,
    clip: Sequence[float] | None,
    sides: str,
    centre: str,
    independent: bool,
    weights: str,
    corrected: bool,
    noise: str,
    psf: str | None,
    pixel: float | None,
    pixel_scale: float | None,
    jitter: float | None,
    estimator: str,
    binary_fraction: float | None,
    galaxy_size: float | None,
    galaxies: str | None,
    cut: float | None,
    **options: Any,
) -> dict[str, Any]:
    """Stars that a PSF is best made of, from the options of the command.

    Parameters
    ----------
    survey, requirements, mag, bins, step, psf, pixel, pixel_scale, jitter, estimator, galaxy_size, galaxies, cut
        As `decision.decided` takes them; the survey must be one of `exposure.EXPOSURES`.
    area : float or None
        Of the sky that a catalogue covers, in deg².
    patch_area : float or None
        Whose stars make one PSF, in deg²; the survey's field of view where not given.
    exposures, clip : sequence or None
        Numbers of exposures and clips that are tried (count, dimensionless).
    sides, centre, weights : str
        As `choice.Plan` has them.
    independent, corrected : bool
        Whether other exposures are stacked than are clipped; whether the predicted bias is taken off.
    noise : str
        One of `NOISES`.
    binary_fraction : float or None
        In [0, 1]; None for the model's own.
    options : dict
        Of `answers.population_config`.

    Returns
    -------
    answer : dict
        The keys of the contract.

    Raises
    ------
    InputError
        If an option is wrong, all stars are saturated, or the cut is too wide for kernel moments.
    """
    own, taken, requirement = _of_survey(survey, requirements)
    names = _named(
        sides=(sides, SIDES), centre=(centre, CENTRES), weights=(weights, WEIGHTS), noise=(noise, NOISES)
    )
    del names["noise"]
    plan = Plan(
        requirement=requirement, area=_positive("--patch-area", patch_area, taken.area, "deg²"),
        exposures=_exposures(exposures, taken), threshold=_thresholds(clip), independent=independent, **names,
    )  # fmt: skip
    sizes, ranges = galaxies_of(galaxy_size, galaxies), _unsaturated(magnitude_bins(mag, bins, step), taken)
    options |= {"band": options.get("band") or (taken.band if options.get("catalog") is None else None)}
    config = population_config(**options, mag=mag, cut=own.cut if cut is None else cut)
    method = estimator_from_name(estimator)
    profile = profile_of(own, psf, pixel, pixel_scale, jitter)
    stars, per_deg2 = _stars_of(config, ranges, taken, area)
    reply = response(profile, method)
    companions = Companions(
        multiplicity=config.multiplicity.build(), photometry=config.photometry.build(), cut=config.cut,
        binary_fraction=binary_fraction,
    )  # fmt: skip
    of_noise = [_noise(profile, replace(taken, n_exposures=n), method, reply, noise) for n in plan.exposures]
    found = _bins(ranges, stars, per_deg2, companions, reply, of_noise)
    left = left_after_correction(found, plan, stars, companions, reply) if corrected else None
    choice = choose(found, plan, left)
    fit = fit_response(profile, sizes)
    head = _head(plan, taken, config) | {
        "psf": profile.name, "estimator": estimator, "r2_0": float(reply.shape0.r2), "e1_0": float(reply.shape0.e1),
        "e2_0": float(reply.shape0.e2), "noise_of": noise, "binary_fraction": binary_fraction, "corrected": corrected,
    }  # fmt: skip
    return head | _answer(choice, stars, companions, reply, fit)


def _of_survey(survey: str | None, requirements: Path | None) -> tuple[Survey, Exposures, Requirement]:
    """Survey, its exposures and what is required of its PSF."""
    if survey is None:
        raise InputError(f"must be one of {', '.join(EXPOSURES)}", key="--survey")
    taken = known("--survey", survey, EXPOSURES)()
    own, requirement = survey_of(survey, requirements)
    if requirement.sigma_e is None and requirement.sigma_r2 is None:
        raise InputError("must have sigma_e or sigma_r2", source=requirements, key="requirements")
    return own, taken, requirement


def _head(plan: Plan, taken: Exposures, config: PopulationConfig) -> dict[str, Any]:
    """What a choice was made for."""
    requirement = plan.requirement
    return {
        "survey": taken.name, "survey_source": taken.source, "saturation": taken.saturation,
        "requirement": requirement.name, "source": requirement.source, "required_sigma_e": requirement.sigma_e,
        "required_sigma_r2": requirement.sigma_r2, "band": config.stars.band, "cut": config.cut,
        "patch_area": plan.area, "sides": plan.sides, "centre": plan.centre, "independent": plan.independent,
        "weights": plan.weights, "configuration": config.model_dump(mode="json", exclude_none=True),
        "version": __version__,
    }  # fmt: skip


def _positive(key: str, value: float | None, otherwise: float, unit: str) -> float:
    """An option that must be positive."""
    value = otherwise if value is None else value
    if not 0 < value < math.inf:
        raise InputError(f"must be positive and finite [{unit}]", key=key, value=value)
    return value


def _named(**options: tuple[str, Sequence[str]]) -> dict[str, Any]:
    """Options that must each be one of some names."""
    return {
        key: known(f"--{key}", value, {name: name for name in names})
        for key, (value, names) in options.items()
    }


def _exposures(wanted: Sequence[int] | None, taken: Exposures) -> tuple[int, ...]:
    """Numbers of exposures: all up to the survey's where none are given."""
    if not wanted:
        return tuple(range(1, taken.n_exposures + 1))
    for n in wanted:
        if not 1 <= n <= MOST_EXPOSURES:
            raise InputError(f"must be 1 to {MOST_EXPOSURES}", key="--exposures", value=n)
    return tuple(sorted(set(wanted)))


MOST_EXPOSURES = 32
"""Exposures of one star that may be asked for (count)."""


def _thresholds(wanted: Sequence[float] | None) -> FloatArray:
    """No clip, then ever tighter ones."""
    if not wanted:
        return THRESHOLDS
    for t in wanted:
        if not 0 < t <= 0.2:
            raise InputError("must be in (0, 0.2]", key="--clip", value=t)
    return np.append(np.inf, np.sort(np.unique(wanted))[::-1])


def _unsaturated(ranges: list[tuple[float, float]], taken: Exposures) -> list[tuple[float, float]]:
    """Ranges without stars that saturate."""
    left = [(max(lo, taken.saturation), hi) for lo, hi in ranges if hi > taken.saturation]
    if not left:
        rule = (
            f"must reach fainter than {taken.saturation:g} mag, from where on stars of {taken.name} saturate"
        )
        raise InputError(rule, key="--mag", value=f"{ranges[0][0]:g} {ranges[-1][1]:g}")
    return left


def _stars_of(
    config: PopulationConfig, ranges: list[tuple[float, float]], taken: Exposures, area: float | None
) -> tuple[list[Stars], list[float]]:
    """Stars of each bin, in AB magnitudes of the survey, and how many there are in a deg²."""
    where = config.stars
    if where.catalog is None:
        if area is not None:
            raise InputError("is that of a catalogue", key="--area", value=area)
        shift = taken.vega_ab if where.band == taken.band else 0.0
        return _of_galaxy(config, ranges, shift)
    whole = draw_stars(config, catalog_of(config))
    size = whole.area if area is None else _positive("--area", area, area, "deg²")
    if size is None:
        raise InputError("is missing: of the sky that the catalogue covers [deg²]", key="--area")
    stars = [whole.select(magnitude=mag) for mag in ranges]
    for mag, some in zip(ranges, stars, strict=True):
        if not len(some):
            rule = f"no star with magnitude in [{mag[0]:g}, {mag[1]:g}): choose other bins"
            raise InputError(rule, source=where.catalog, key="mag")
    return stars, [len(some) / size for some in stars]


def _of_galaxy(
    config: PopulationConfig, ranges: list[tuple[float, float]], shift: float
) -> tuple[list[Stars], list[float]]:
    """Stars of the analytic Galaxy, whose magnitudes are fainter by a shift in AB."""
    from porrima.galaxy import Robin2003  # noqa: PLC0415  (the Galaxy's tables, where used)

    where, stars = config.stars, []
    for lo, hi in ranges:
        one = where.model_copy(update={"mag": (lo - shift, hi - shift), "n_drawn": N_DRAWN})
        drawn = draw_stars(config.model_copy(update={"stars": one}))
        stars.append(replace(drawn, magnitude=np.clip(drawn.magnitude + shift, lo, np.nextafter(hi, lo))))
    edges = np.array([ranges[0][0], *(hi for _, hi in ranges)]) - shift
    counts = Robin2003().counts(where.l or 0.0, where.b or 0.0, edges, where.band or "i")
    return stars, counts.tolist()


def _noise(psf: PSF, taken: Exposures, method: Estimator, reply: Response, whose: str) -> FloatArray:
    """Covariance of one star's e1, e2 and R² over R0², as the estimator has them, at `precision.MAGNITUDES`."""
    if whose == "measured":
        try:
            return measured_covariance(psf, taken, method)
        except ValueError as error:
            raise InputError(f"{error}: take --noise fitted, or another estimator", key="--noise") from None
    derivative = reply.first[:, _SECOND] / np.array([[1.0], [1.0], [float(reply.shape0.r2)]])
    return np.asarray(derivative @ fitted_covariance(psf, taken) @ derivative.T)


def _bins(
    ranges: list[tuple[float, float]], stars: list[Stars], per_deg2: list[float], companions: Companions,
    reply: Response, of_noise: list[FloatArray],
) -> list[StarBin]:  # fmt: skip
    """What a choice is made from."""
    sorted_by, found = sorting(reply, companions.cut), []
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", MassRangeWarning)
        for mag, some, number in zip(ranges, stars, per_deg2, strict=True):
            n = min(SAMPLES, len(some))
            samples = (companions.population(some.take(np.arange(k, len(some), n))) for k in range(n))
            parts = tuple(
                own_sizes(count_pairs(sample, companions.binary_fraction), sorted_by, mag)
                for sample in samples
            )
            middle = np.average([part.magnitude for part in parts], axis=0)
            covariance = np.array([covariance_at(one, middle) for one in of_noise])
            found.append(StarBin(magnitude=mag, per_deg2=number, parts=parts, covariance=covariance))
    for one in {str(one.message): one for one in said}.values():  # each sample says the same
        warnings.warn(one.message, stacklevel=2)
    return found


def _answer(
    choice: Choice, stars: list[Stars], companions: Companions, reply: Response, fit: ShearResponse
) -> dict[str, Any]:
    """The best setting, what comes near it, and what is around it."""
    plan, best = choice.plan, choice.best
    others = choice.runners_up()
    rows = [{"advice": name, **_row(choice, setting, reply, fit)} for name, setting in others.items()]
    for name, change in _VARIANTS.items():
        if all(getattr(plan, key) == value for key, value in change.items()):
            continue
        other = choose(choice.bins, replace(plan, **change), None)
        if choice.remaining is None:
            rows.append({"advice": name, **_row(other, other.best, reply, fit)})
    known_to = margin(choice, best, stars, companions, reply)
    good = choice.as_good()
    spans = np.array([choice.magnitude(int(k)) for k in good[:, 0]])
    clips = plan.threshold[good[:, 2]]
    return {
        "best": _row(choice, best, reply, fit) | {"merit_low": known_to.low, "merit_high": known_to.high,
                                                  "merit_error": choice.sampled(best)},
        "as_good": {
            "bright_limit": [float(spans[:, 0].min()), float(spans[:, 0].max())],
            "faint_limit": [float(spans[:, 1].min()), float(spans[:, 1].max())],
            "clip": [float(clips.min()), None if np.isinf(clips.max()) else float(clips.max())],
            "n_exposures": [int(plan.exposures[k]) for k in sorted(set(good[:, 1].tolist()))],
        },
        "runners_up": sorted(rows, key=lambda row: row["merit"]),
        "against_clip": [_row(choice, s, reply, fit) for s in choice.along(2)],
        "against_faint_limit": [_row(choice, s, reply, fit) for s in choice.along(0)],
        "against_exposures": [_row(choice, s, reply, fit) for s in choice.along(1)],
        "sources": [{"source": name, "low": low, "high": high} for name, (low, high) in known_to.sources.items()],
        "models": [{"model": name, "merit": value} for name, value in known_to.models.items()],
        "bins": [_bin_row(choice, k) for k in range(len(choice.bins))],
        "settings": [
            row_of(choice, type(best)(*at)) for at in itertools.product(*(range(n) for n in choice.merit.shape))
        ],
    }  # fmt: skip


_VARIANTS: dict[str, dict[str, Any]] = {
    "clipped from above only": {"sides": "upper"},
    "weighted by inverse variance": {"weights": "inverse-variance"},
    "weighted alike": {"weights": "equal"},
}


def _row(choice: Choice, setting: Setting, reply: Response, fit: ShearResponse) -> dict[str, Any]:
    r"""A setting, with what it leaves in shear that is measured by a fit.

    Sizes and ellipticities are turned into second moments by the response, and these into m and c.
    """
    row, r2 = row_of(choice, setting), float(reply.shape0.r2)
    per_size = fit.kappa_m * fit.inverse_r2 * r2 / reply.kappa_r2
    along = 0.5 * (reply.first[0, _SECOND[0]] - reply.first[0, _SECOND[2]]) * r2
    per_e = 0.5 * fit.kappa_c * fit.inverse_r2 * r2 / along
    sd_r2 = math.hypot(row["scatter_r2"], row["noise_r2"])
    sd_e = max(math.hypot(row[f"scatter_{q}"], row[f"noise_{q}"]) for q in ("e1", "e2"))
    return row | {
        "m": per_size * (row["binaries_r2"] + row["clip_bias_r2"]),
        "sd_m": per_size * sd_r2,
        "sd_c": per_e * sd_e,
    }


def _bin_row(choice: Choice, k: int) -> dict[str, Any]:
    """Ingredients of one range of magnitude: stars and noise."""
    one = choice.bins[k]
    number = np.array([part.number.sum(axis=1) for part in one.parts]).sum(axis=0)
    sigma = np.sqrt(np.einsum("emqq,m->eq", one.covariance, number / number.sum()))
    total = sum(part.total for part in one.parts)
    return {
        "mag_lo": one.magnitude[0], "mag_hi": one.magnitude[1], "n_per_deg2": one.per_deg2,
        "n_stars": one.per_deg2 * choice.plan.area, "n_drawn": total, "unresolved_share": float(number.sum() / total),
        "sigma_e": float(np.hypot(*sigma[-1, :2]) / math.sqrt(2)), "sigma_r2": float(sigma[-1, 2]),
        "sigma_e_one": float(np.hypot(*sigma[0, :2]) / math.sqrt(2)), "sigma_r2_one": float(sigma[0, 2]),
        "mean_x": float(sum(part.x.sum() for part in one.parts) / number.sum()),
    }  # fmt: skip
