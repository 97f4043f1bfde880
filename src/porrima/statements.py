"""Numbers that the paper's statements need besides its figures: cheap predictions, each with its error."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from porrima.averages import population_moments
from porrima.config import PopulationConfig, parse
from porrima.detector import on_pixels
from porrima.experiments import PAPER_FRACTION, SURVEY_PSFS
from porrima.gaia_flags import GaiaFlags
from porrima.galaxy import Robin2003
from porrima.images import measure_stack
from porrima.instruments import EUCLID_VIS, KCM16
from porrima.integrals import integrate
from porrima.photometry import PHOTOMETRY
from porrima.prediction import predict
from porrima.psf import TABLE_2_FWHM, psf_from_name, sheared_gaussian
from porrima.response import response
from porrima.sample import draw_stars
from porrima.samples import clipped
from porrima.shapes import Adaptive, GaussianWeight
from porrima.stack import draw_systems
from porrima.systems import Population, Systems
from porrima.toy import NEAR

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from porrima.multiplicity import MultiplicityModel
    from porrima.psf import PSF
    from porrima.stars import Stars

    FloatArray = NDArray[np.float64]
    Parts = dict[str, xr.Dataset]
    Numbers = dict[str, tuple[float, float]]

__all__ = ["CLIP", "MAGNITUDES", "N_STEPS", "SMALL_ELLIPTICITY", "statement_numbers"]

MAGNITUDES = (16, 17, 18, 19, 20)
"""Bright ends of the bins of one magnitude that the paper speaks of, in mag."""

SMALL_ELLIPTICITY = 0.05
"""Of the PSF behind which shares of the requirement are found, about that of KCM16 Table 2 (dimensionless)."""

CLIP = 0.016
"""Largest change of its own size with which a star stays in the sample (dimensionless)."""

WIDE = 0.75
"""Sigma of the fixed weight in which Euclid's requirements are given, in arcsec."""

FIELD = 1000.0
"""Area of a field of one binary fraction, as wide as populations stay alike, in deg²."""

N_STEPS = 8
"""Groups of numbers (count)."""

_ROUNDING = 1e-12  # of a number that does not depend on the stars
_PARTS = 8  # of the stars, for standard errors
_STACK = 200  # stars that are put on survey pixels
_LARGE_FWHM = 0.2  # arcsec, of the larger PSF
_DIRECTIONS = [(l, b) for b in (30.0, 45.0, 60.0, 75.0) for l in (0.0, 90.0, 180.0, 270.0)]
_CENTRES = np.arange(0.025, 1.0, 0.05)  # of the bins of binary fraction


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sky:
    """Stars of the analytic Galaxy, and how companions are given to them."""

    models: Mapping[str, MultiplicityModel]
    n_drawn: int
    seed: int

    def stars(
        self, magnitude: tuple[float, float] = (18.0, 19.0), l: float = 180.0, b: float = 45.0
    ) -> Stars:
        where = {"l": l, "b": b, "mag": magnitude, "n_drawn": self.n_drawn}
        return draw_stars(parse(PopulationConfig, {"stars": where, "seed": self.seed}))

    def population(self, stars: Stars, model: str | MultiplicityModel, **options: Any) -> Population:
        given = self.models[model] if isinstance(model, str) else model
        return Population.of(stars, multiplicity=given, photometry=PHOTOMETRY["main-sequence"], **options)


def statement_numbers(
    *,
    psf: Sequence[str],
    optical: Sequence[str],
    models: Mapping[str, MultiplicityModel],
    n_drawn: int = 2000,
    seed: int = 1,
    progress: Callable[[int], None] = lambda _: None,
) -> Parts:
    r"""Predictions that decide on statements of the paper (KCM16) of which no figure shows the numbers.

    Parameters
    ----------
    psf : sequence of str
        PSFs of the simulated stacks; the first is that behind which stars are clipped and put on pixels.
    optical : sequence of str
        PSFs whose response by two estimators is found.
    models : dict
        Two readings of the multiplicity table by name, the published one first.
    n_drawn : int
        Stars drawn from the analytic Galaxy for each magnitude and direction (count).
    seed : int
        Of those stars.
    progress : callable
        Called with the number of groups done, `N_STEPS` in all (count).

    Returns
    -------
    parts : dict
        ``numbers``: ``value`` and ``error`` (standard error) over ``name``; ``psfs``: ``e1_0``, ``e2_0``, ``r2_0``
        [arcsec²] over ``psf``; ``mean_x`` [arcsec²] over ``model`` and ``fraction``; ``findings``: how many numbers.

    Notes
    -----
    At a binary fraction of `experiments.PAPER_FRACTION` unless it says otherwise, adaptive moments, i band, l = 180°,
    b = 45°, 18 to 19 mag.  Standard errors are those of the stars drawn: the scatter among eight parts of them.

    References
    ----------
    KCM16, Robin2003, DucheneKraus2013
    """
    sky = _Sky(models=models, n_drawn=n_drawn, seed=seed)
    first = psf_from_name(psf[0])
    numbers: Numbers = {}
    groups: list[Callable[[], Numbers]] = [
        lambda: _by_magnitude(sky),
        lambda: _surveys(sky),
        lambda: _sizes(sky),
        lambda: _weights(sky, optical),
        lambda: _pixels(sky, first),
        lambda: _triples(sky),
        lambda: _over_the_sky(sky, first),
        lambda: _cleaned(sky, first) | _near(),
    ]
    for group in groups:
        numbers |= group()
        progress(1)
    shapes = {
        name: response(psf_from_name(name), Adaptive()).shape0 for name in dict.fromkeys((*psf, *optical))
    }
    return {
        "numbers": xr.Dataset(
            {k: ("name", [pair[n] for pair in numbers.values()]) for n, k in enumerate(("value", "error"))},
            coords={"name": list(numbers)},
        ),
        "psfs": xr.Dataset(
            {f"{q}_0": ("psf", [float(getattr(s, q)) for s in shapes.values()]) for q in ("e1", "e2", "r2")},
            coords={"psf": list(shapes)},
        ),
        "mean_x": _against_fraction(sky),
        "findings": xr.Dataset({"n_numbers": float(len(numbers))}),
    }


def _mean_x(population: Population, fraction: float | None = PAPER_FRACTION) -> Any:
    """Moments of one star at a binary fraction."""
    fractions = None if fraction is None else np.array([fraction])
    return population_moments(population, integrate(population), fractions)


def _with_error(stars: Stars, number: Callable[[Stars], FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Numbers of some stars, and their standard errors by the scatter among parts of them."""
    parts = [stars.take(np.arange(k, len(stars), _PARTS)) for k in range(_PARTS)]
    value, scatter = number(stars), np.std([number(part) for part in parts], axis=0, ddof=1)
    return value, np.where(scatter > _ROUNDING * np.abs(value), scatter / math.sqrt(_PARTS), 0.0)


def _ratio(above: tuple[float, float], below: tuple[float, float]) -> tuple[float, float]:
    """Ratio of two independent numbers with its error."""
    value = above[0] / below[0]
    return value, abs(value) * math.hypot(above[1] / above[0], below[1] / below[0])


def _by_magnitude(sky: _Sky) -> Numbers:
    """Shares of the requirement for infinitely many stars, and what two magnitudes buy."""
    reply = response(sheared_gaussian("small", SMALL_ELLIPTICITY, 0.0), Adaptive())
    out: Numbers = {}
    for lo in MAGNITUDES:
        stars = sky.stars((float(lo), lo + 1.0))
        for model in sky.models:

            def shares(some: Stars, model: str = model) -> FloatArray:
                bias = predict(_mean_x(sky.population(some, model)), reply).bias[:, 0]
                e, size = math.hypot(bias[0], bias[1]), abs(bias[2])
                required = KCM16.sigma_e or math.nan
                return np.array(
                    [size / (KCM16.sigma_r2 or math.nan), e / required, required * SMALL_ELLIPTICITY / e]
                )

            value, error = _with_error(stars, shares)
            for k, name in enumerate(("size_share", "e_share", "e_for_all")):
                out[f"{name}_{model}_{lo}"] = float(value[k]), float(error[k])
    for model in sky.models:
        out[f"gain_{model}"] = _ratio(out[f"size_share_{model}_18"], out[f"size_share_{model}_20"])
    return out


def _surveys(sky: _Sky) -> Numbers:
    """Change of size behind a sharper telescope over that behind Euclid's, adaptive and by unweighted moments."""
    euclid, roman = (response(psf_from_name(**o), Adaptive()) for o in SURVEY_PSFS.values())  # type: ignore[arg-type]
    model = next(iter(sky.models))

    def ratio(some: Stars) -> FloatArray:
        moments = _mean_x(sky.population(some, model))
        sharp, wide = predict(moments, roman), predict(moments, euclid)
        return np.array([sharp.bias[2, 0] / wide.bias[2, 0], sharp.eta[0] / wide.eta[0]])

    value, error = _with_error(sky.stars(), ratio)
    return {"sharper_adaptive": (value[0], error[0]), "sharper_unweighted": (value[1], error[1])}


def _sizes(sky: _Sky) -> Numbers:
    """Change of size behind a larger Gaussian PSF over that behind the paper's, with the same cut and one in
    proportion."""
    small, large = (
        response(sheared_gaussian("round", 0.0, 0.0, w), Adaptive()) for w in (TABLE_2_FWHM, _LARGE_FWHM)
    )
    model, cut = next(iter(sky.models)), 0.05
    area = float(large.shape0.r2) / float(small.shape0.r2)

    def ratio(some: Stars) -> FloatArray:
        same = _mean_x(sky.population(some, model, cut=cut))
        scaled = _mean_x(sky.population(some, model, cut=cut * _LARGE_FWHM / TABLE_2_FWHM))
        here = predict(same, small).bias[2, 0]
        larger = predict(same, large).bias[2, 0] / here
        return np.array([larger, larger * area, predict(scaled, large).bias[2, 0] / here])

    value, error = _with_error(sky.stars(), ratio)
    names = ("larger", "larger_law", "larger_scaled")
    return {name: (float(value[k]), float(error[k])) for k, name in enumerate(names)}


def _weights(sky: _Sky, names: Sequence[str]) -> Numbers:
    """Change of size and ellipticity by a wide fixed weight, over that of unweighted moments: of the PSF that is
    farthest from 1."""
    model, name = next(iter(sky.models)), next((n for n in names if n.endswith("1")), names[0])
    reply = response(psf_from_name(name), GaussianWeight(WIDE))
    zero = reply.shape0

    def ratios(some: Stars) -> FloatArray:
        found = predict(_mean_x(sky.population(some, model)), reply)
        e_0 = np.array([float(zero.e1), float(zero.e2)])
        along = -(e_0 @ found.bias[:2, 0]) / (e_0 @ e_0) / found.eta[0]
        return np.array([found.bias[2, 0] / found.eta[0], along])

    value, error = _with_error(sky.stars(), ratios)
    return {"wide_size": (value[0], error[0]), "wide_e": (value[1], error[1])}


def _pixels(sky: _Sky, psf: PSF) -> Numbers:
    """Change of size on survey pixels over that without them, and the share of places in a pixel that could be
    measured, by adaptive moments and by a wide fixed weight."""
    population = sky.population(sky.stars(), next(iter(sky.models)))
    systems = draw_systems(population, n_stars=_STACK, binary_fraction=PAPER_FRACTION, seed=sky.seed, stack=0)
    out: Numbers = {}
    for name, estimator, half_width in (("adaptive", Adaptive(), 2.0), ("wide", GaussianWeight(WIDE), 5.5)):
        reply = response(psf, estimator)
        fine = float(reply.shapes(systems.kernel_moments(), threshold=0.0).r2[0] / reply.shape0.r2 - 1)
        change = on_pixels(psf, systems, estimator, EUCLID_VIS.pixel, half_width=half_width)[
            "dr2_rel"
        ].to_numpy()
        good = change[np.isfinite(change)]
        error = good.std() / math.sqrt(good.size) / abs(fine) if good.size else math.nan
        out[f"sampled_{name}"] = (good.mean() / fine if good.size else math.nan), error
        out[f"measured_{name}"] = good.size / change.size, 0.0
    return out


def _triples(sky: _Sky) -> Numbers:
    """Mean x with triples over that of pairs alone, each with the model's own fractions."""
    stars, out = sky.stars(), {}
    for name, model in sky.models.items():
        both = [
            _mean_x(sky.population(stars, replace(model, triples=flag)), None)  # type: ignore[type-var]
            for flag in (True, False)
        ]
        pairs = [(float(m.mean_x[0]), float(m.mean_x[0] * m.relative_error[0])) for m in both]
        out[f"triples_{name}"] = _ratio(*pairs)
    return out


def _over_the_sky(sky: _Sky, psf: PSF) -> Numbers:
    """How the effect varies with direction, and how many stars two fields need to show it."""
    reply = response(psf, Adaptive())
    fields = [sky.stars(l=l, b=b) for l, b in _DIRECTIONS]
    out: Numbers = {}
    for model in sky.models:

        def numbers(some: Stars, model: str = model) -> FloatArray:
            moments = _mean_x(sky.population(some, model), None)
            of_one = predict(moments, reply, 10_000)
            return np.array([of_one.bias[2, 0], 100.0 * of_one.sd[2, 0], moments.binary_fraction[0]])

        found = [_with_error(stars, numbers) for stars in fields]
        value, error = (np.array([one[k] for one in found]) for k in range(2))
        out |= {f"{name}_{model}": number for name, number in _of_fields(value, error).items()}
    return out


def _of_fields(value: FloatArray, error: FloatArray) -> Numbers:
    """Of bias, scatter of one star and binary fraction of some fields, (n, 3): how they vary from field to field."""
    bias, scatter, fraction = value.T
    low, high = int(np.argmin(fraction)), int(np.argmax(fraction))
    mean, ends = bias.mean(), [int(np.argmin(bias)), int(np.argmax(bias))]
    apart, apart_error = bias[high] - bias[low], math.hypot(error[low, 0], error[high, 0])
    needed = 25.0 * (scatter[low] ** 2 + scatter[high] ** 2) / apart**2  # for five standard errors
    return {
        "sky_variation": ((bias[ends[1]] - bias[ends[0]]) / mean, math.hypot(*error[ends, 0]) / mean),
        "sky_fraction": (fraction[high] - fraction[low], math.hypot(error[high, 2], error[low, 2])),
        "sky_difference": (apart, apart_error),
        "sky_stars": (needed, 2.0 * needed * apart_error / abs(apart)),
    }


def _cleaned(sky: _Sky, psf: PSF) -> Numbers:
    """Mean x of all stars over that of those that a clip, or Gaia's flags, leave."""
    reply, model = response(psf, Adaptive()), next(iter(sky.models))

    def clip(some: Stars) -> FloatArray:
        left = clipped(sky.population(some, model), reply, np.array([CLIP, math.inf]), PAPER_FRACTION)
        return np.array([left.eta[1] / left.eta[0], left.removed[0]])

    def gaia(some: Stars) -> FloatArray:
        every = _mean_x(sky.population(some, model)).mean_x[0]
        return np.array([every / _mean_x(sky.population(some, model, selection=GaiaFlags())).mean_x[0]])

    stars = sky.stars()
    per_deg2 = float(Robin2003().star_counts(180.0, 45.0, np.array([18.0, 19.0]), "i").per_deg2[0])
    (gain, removed), errors = _with_error(stars, clip)
    (flags,), (flags_error,) = _with_error(stars.take(np.arange(0, len(stars), 4)), gaia)
    return {
        "clip_gain": (gain, errors[0]), "clip_removed": (removed, errors[1]), "gaia_gain": (flags, flags_error),
        "field_stars": (FIELD * per_deg2, math.sqrt(FIELD * per_deg2)),
    }  # fmt: skip


def _near() -> Numbers:
    """By how much the series of the toy model is off an image: a pair of equal stars at 0.01 arcsec."""
    psf = sheared_gaussian("toy", SMALL_ELLIPTICITY, 0.0)
    pair, reply = Systems.from_pairs(np.ones(1), np.full(1, NEAR), np.zeros(1)), response(psf, Adaptive())
    drawn = measure_stack(psf, pair, Adaptive())
    series = reply.shapes(pair.kernel_moments(), threshold=0.0)
    e_0 = float(reply.shape0.e1)
    change = float(series.e1[0]) / e_0 - 1
    return {"toy_error": (abs(float(drawn.e1) / e_0 - 1 - change), 0.0)}


def _against_fraction(sky: _Sky) -> xr.Dataset:
    """Mean x at the centres of the bins of binary fraction."""
    stars = sky.stars()
    populations = [sky.population(stars, model) for model in sky.models]
    mean_x = [population_moments(p, integrate(p), _CENTRES).mean_x for p in populations]
    return xr.Dataset(
        {"mean_x": (("model", "fraction"), np.array(mean_x))},
        coords={"model": list(sky.models), "fraction": _CENTRES},
    )
