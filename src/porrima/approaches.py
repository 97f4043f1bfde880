"""The three ways to a true PSF size, side by side: how well each will do, before anything is measured."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.correction import Patch, change_behind, correct
from porrima.extrapolation import best_split, forecast, sample_covariance
from porrima.gain import moved_together
from porrima.photometry import PHOTOMETRY
from porrima.samples import MOST_STARS, Fractions, clipped, one_choice_made, samples_of
from porrima.systems import Population
from porrima.uncertainty import uncertainty

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from porrima.companions import MultiplicityModel
    from porrima.response import Response
    from porrima.samples import Samples
    from porrima.stars import Stars

    FloatArray = NDArray[np.float64]

__all__ = ["approaches", "clip_forecast"]

_LIGHT = PHOTOMETRY["main-sequence"]
_SIZE = slice(2, 3)


def approaches(
    bins: Sequence[tuple[tuple[float, float], Stars]],
    response: Response,
    multiplicity: MultiplicityModel,
    *,
    n_stars: int,
    fields: Fractions,
    thresholds: FloatArray,
    at: int = 0,
) -> list[dict[str, Any]]:
    """Forecast errors of the true size by prediction, by two extrapolations, and from two fields.

    Parameters
    ----------
    bins : sequence of ((float, float), Stars)
        Ranges of magnitude with their stars, in mag.
    response : Response
        Of the PSF and estimator.
    multiplicity : MultiplicityModel
        Companions of stars.
    n_stars : int
        Stars in all (count).
    fields : Fractions
        Binary fractions of the fields, with their errors.
    thresholds : (k,) float array
        Largest size changes of stars by themselves that are kept, dimensionless; infinite for all.
    at : int
        The range of magnitude for all but the extrapolation over magnitudes.

    Returns
    -------
    rows : list of dict
        Errors of R² over R², dimensionless: ``scatter`` alone with the stars shared equally, and ``best_scatter``
        shared best; ``error`` and ``best_error`` with the errors of the model, ``error_with_choices`` with its choices
        as well.  Of samples of unlike stars ``best_share``, of clips the share ``removed`` and ``eta``.

    Notes
    -----
    Clips are seen without noise, and their samples share their stars.
    """
    _, stars = bins[at]
    options: dict[str, Any] = {"multiplicity": multiplicity}
    known = uncertainty(stars, response, photometry=_LIGHT, n_stars=n_stars, **options)
    change = change_behind(known.prediction.population, [response], n_stars)
    one = correct(Patch(shape=change.shape0, n_stars=n_stars, error=np.zeros(3)), known, change)
    r2 = float(response.shape0.r2)
    error, scatter = one.error()[1, 2] / r2, one.scatter[2] / r2
    widest = np.abs(one.choice_shift()[:, 2]).max() / r2
    rows = [_row("prediction", scatter, scatter, error, error, error + widest)]
    each = np.full(len(bins), max(n_stars // len(bins), 1))
    by_magnitude = [
        samples_of([s for _, s in bins], response, each, choices=c, **options) for c in (False, True)
    ]
    rows.append(_of_samples("magnitudes", by_magnitude, n_stars, r2))
    rows.append(clip_forecast(stars, response, multiplicity, thresholds, n_stars))
    each = np.full(fields.value.size, max(n_stars // fields.value.size, 1))
    by_field = [
        samples_of([stars] * fields.value.size, response, each, fractions=fields, choices=c, **options)
        for c in (False, True)
    ]
    rows.append(_of_samples("fields", by_field, n_stars, r2))
    return rows


def _row(approach: str, *errors: float) -> dict[str, Any]:
    names = ("scatter", "best_scatter", "error", "best_error", "error_with_choices")
    return {"approach": approach} | {name: float(e) for name, e in zip(names, errors, strict=True)}


def _of_samples(approach: str, samples: Sequence[Samples], n_stars: int, r2: float) -> dict[str, Any]:
    """Errors from samples of unlike stars, without and with the choices of the models."""
    plain, widened = samples
    sd = np.sqrt(plain.per_star[:, 2, 2])
    split = best_split(plain.change[:, 2], sd)
    used = split.share > 0
    of_best = np.maximum(np.round(split.share[used] * n_stars), 1).astype(np.int64)

    def error(found: Samples, rows: NDArray[np.bool_], n: NDArray[np.int64], with_model: bool) -> float:
        spread = sample_covariance(found.per_star[rows][:, _SIZE, _SIZE], n)
        model = found.model_error[:, rows][..., _SIZE] if with_model else None
        return math.sqrt(forecast(found.change[rows][:, _SIZE], spread, model)[0, 0]) / r2

    every = np.ones(len(sd), dtype=bool)
    errors = (
        error(plain, every, plain.n_stars, False), error(plain, used, of_best, False),
        error(plain, every, plain.n_stars, True), error(plain, used, of_best, True),
        error(widened, every, plain.n_stars, True),
    )  # fmt: skip
    return _row(approach, *errors) | {"best_share": split.share.tolist()}


def clip_forecast(
    stars: Stars,
    response: Response,
    multiplicity: MultiplicityModel,
    thresholds: FloatArray,
    n_stars: int,
) -> dict[str, Any]:
    """Forecast error of the true size by extrapolation over thresholds of rejection, without noise.

    Parameters
    ----------
    stars : Stars
        Before rejection.
    response : Response
        Of the PSF and estimator.
    multiplicity : MultiplicityModel
        Companions of stars.
    thresholds : (k,) float array
        Largest size changes of stars by themselves that are kept, dimensionless; infinite for all.
    n_stars : int
        Stars before rejection (count).

    Returns
    -------
    row : dict
        As `approaches`; nothing is shared between thresholds, which see the same stars.
    """
    some = stars.take(np.arange(0, len(stars), -(-len(stars) // MOST_STARS)))

    def eta(population: Population) -> FloatArray:
        return clipped(population, response, thresholds).eta

    base = Population.of(some, multiplicity=multiplicity, photometry=_LIGHT)
    own = clipped(base, response, thresholds)
    errors = []
    for down, up in moved_together([base], multiplicity):
        low, high = eta(down[0]), eta(up[0])
        errors += [0.5 * (high - low), math.sqrt(2) * (0.5 * (high + low) - own.eta)]
    others = [
        Population.of(some, multiplicity=m, photometry=p) for m, p in one_choice_made(multiplicity, _LIGHT)
    ]
    widened = [*errors, *(eta(other) - own.eta for other in others)]
    n = np.round(n_stars * (1 - own.removed)).astype(np.int64)
    spread = sample_covariance(own.sd[:, None, None] ** 2, n, nested=True)
    scatter, error, widest = (
        math.sqrt(forecast(own.eta[:, None], spread, model)[0, 0])
        for model in (None, np.array(errors)[:, :, None], np.array(widened)[:, :, None])
    )
    return _row("clips", scatter, scatter, error, error, widest) | {
        "removed": own.removed.tolist(),
        "eta": own.eta.tolist(),
    }
