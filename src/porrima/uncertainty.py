r"""How well a prediction is known: the errors of the multiplicity table and the choices it leaves, as an interval.

Each figure of the table is moved by its error, one at a time; each choice (photometry, gap rule, projection) is
made the other way, in all combinations.  Nothing is drawn.
"""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.averages import population_moments
from porrima.companions import MassRangeWarning, RowErrors
from porrima.integrals import PairIntegrals, coefficient_moments, integrate, separation_moments
from porrima.multiplicity import COMPILATIONS, MULTIPLICITY
from porrima.photometry import PHOTOMETRY
from porrima.prediction import MANY_STARS, QUANTITIES, predict
from porrima.systems import Population

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from porrima.companions import MultiplicityModel
    from porrima.photometry import MassLuminosity
    from porrima.prediction import Prediction
    from porrima.response import Response
    from porrima.selection import Selection
    from porrima.stars import Stars

    FloatArray = NDArray[np.float64]

__all__ = ["CUT_ERROR", "NAMES", "Source", "Uncertainty", "uncertainty"]

NAMES = ("eta", *(f"{kind}_{q}" for kind in ("bias", "sd", "sigma") for q in QUANTITIES))
"""What is given an interval, dimensionless: as in `prediction.Prediction`."""

CUT_ERROR = 0.1
"""Relative error of the cut: a survey resolves pairs from somewhere between 0.9 and 1.1 times the nominal
separation on (assumed; no source)."""

MOST_STARS = 1000
"""Stars on which changes are found, evenly through those given in mass and distance (count)."""

FEW_STARS = 300
"""Stars on which other models are tried, and changes of a model with several classes to a star (count)."""

_INTERVALS = 32  # of the rule over the mass ratio for changes: its error, 5e-4, is the same before and after


_FIGURES = {"log_a": "mean_separation"}  # of a row of the table: the source's name, where it is another one


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """One source of uncertainty and what it does.

    Parameters
    ----------
    name : str
        Such as ``multiplicity_fraction`` or ``photometry``.
    kind : {"error", "choice", "sample", "model"}
        An error of one standard deviation, a choice made the other way, the finite number of stars, or another model
        of multiplicity, which is no part of the interval.
    low, high : (n_name,) float array
        Largest changes of `NAMES` down (not positive) and up (not negative), dimensionless.
    """

    name: str
    kind: str
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Uncertainty:
    """A prediction with the interval in which it is known.

    Parameters
    ----------
    prediction : Prediction
        With the models as given.
    value, low, high : (n_name,) float array
        Of `NAMES`, dimensionless: as predicted, and the ends of the interval.
    sources : tuple of Source
        One for each kind of figure, choice, the stars and the models.
    models : dict of (n_name,) float array
        What other compilations of multiplicity give for the same stars, dimensionless, by name.
    """

    prediction: Prediction
    value: FloatArray
    low: FloatArray
    high: FloatArray
    sources: tuple[Source, ...]
    models: dict[str, FloatArray]

    def interval(self, name: str) -> tuple[float, float]:
        """Ends of the interval of one quantity.

        Parameters
        ----------
        name : str
            One of `NAMES`.

        Returns
        -------
        low, high : float
            Dimensionless.
        """
        k = NAMES.index(name)
        return float(self.low[k]), float(self.high[k])

    def ranking(self, name: str = "eta") -> list[tuple[str, float]]:
        """Sources by how far they move a quantity, the largest first.

        Parameters
        ----------
        name : str
            One of `NAMES`.

        Returns
        -------
        ranking : list of (str, float)
            Name of the source, and the larger of its two changes over the predicted value, dimensionless.
        """
        k = NAMES.index(name)
        scale = abs(self.value[k]) or 1.0
        reach = [(s.name, float(max(-s.low[k], s.high[k]) / scale)) for s in self.sources]
        return sorted(reach, key=lambda pair: -pair[1])


def uncertainty(
    stars: Stars,
    response: Response,
    *,
    multiplicity: MultiplicityModel,
    photometry: MassLuminosity,
    cut: float = 0.05,
    binary_fraction: float | None = None,
    n_stars: int | None = None,
    row_errors: tuple[RowErrors, ...] | None = None,
    cut_error: float = CUT_ERROR,
    integrals: PairIntegrals | None = None,
    selection: Selection | None = None,
) -> Uncertainty:
    r"""Interval of a prediction from the errors of the multiplicity table and the choices of the models.

    Parameters
    ----------
    stars : Stars
        Those of a stack, of equal weight.
    response : Response
        Of the PSF and estimator.
    multiplicity : MultiplicityModel
        The table and how it is read.
    photometry : MassLuminosity
        The relation in use.
    cut : float
        Separation from which a pair is resolved, in arcsec.
    binary_fraction : float, optional
        Before resolved pairs leave, in [0, 1], taken as exact: errors of multiplicity fractions then only move pairs
        between rows.  None for the model's own, which they move.
    n_stars : int, optional
        Stars in the stack (count); None for infinitely many.
    row_errors : tuple of RowErrors, optional
        Of the rows of the table; the model's own where not given.
    cut_error : float
        Relative error of the cut, in [0, 1).
    integrals : PairIntegrals, optional
        Of the population with the models as given, where they are known already.
    selection : Selection, optional
        What else the survey rejects, taken as exact.

    Returns
    -------
    uncertainty : Uncertainty
        Dimensionless.

    Raises
    ------
    InputError
        As `systems.Population.of`.
    ValueError
        If `cut_error` is out of range, or as `predict`.

    Notes
    -----
    Each figure is moved down and up by its error, and the changes of a kind of figure in the rows, of the kinds, of
    the cut and of the sample of stars are added in quadrature, as independent.  The choices (photometry:
    `MainSequence` or `HabetsHeintze1981`; those of the model, such as gap rule and projection) are no errors: the
    interval reaches from the lowest to the highest of their combinations, and by the sum in quadrature beyond.
    Changes are found on up to `MOST_STARS` stars, or `FEW_STARS` where stars have several classes of companions, to a
    few per cent of themselves, with the scatter of a long stack; the prediction itself on all stars.

    The interval is that of the given model.  How far others are from it, those of `multiplicity.COMPILATIONS`, is the
    source ``model``, on up to `FEW_STARS` stars: a systematic error that no table knows of itself, and that is not
    put into the interval, for models are few and not independent.

    References
    ----------
    DucheneKraus2013, KCM16, Offner2023, Susemiehl2022, Winters2019
    """
    if not 0 <= cut_error < 1:
        raise ValueError(f"cut_error must be in [0, 1), got {cut_error}")
    models = {"multiplicity": multiplicity, "photometry": photometry, "cut": cut, "selection": selection}
    with warnings.catch_warnings():
        if integrals is not None:  # whoever made them has heard it
            warnings.simplefilter("ignore", MassRangeWarning)
        whole = Population.of(stars, **models)  # type: ignore[arg-type]
    integrals = integrate(whole) if integrals is None else integrals
    fraction = None if binary_fraction is None else np.array([binary_fraction])
    prediction = predict(population_moments(whole, integrals, fraction), response, n_stars)
    judge = _Judge(prediction=prediction, response=response, fraction=fraction)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MassRangeWarning)  # said of the whole already
        sources, every = _changes(judge, stars, models, row_errors or multiplicity.row_errors, cut_error)
        others = _other_models(judge, stars, models)
    if others:
        changes = np.array(list(others.values())) - judge.value
        low, high = np.minimum(changes.min(axis=0), 0.0), np.maximum(changes.max(axis=0), 0.0)
        sources.append(Source(name="model", kind="model", low=low, high=high))
    sampled = judge.sampled(whole, integrals)
    sources.append(Source(name="stars", kind="sample", low=-sampled, high=sampled))
    independent, value = [s for s in sources if s.kind in ("error", "sample")], judge.value
    return Uncertainty(
        prediction=prediction,
        value=value,
        low=value + every.min(axis=0) - np.sqrt(sum(s.low**2 for s in independent)),
        high=value + every.max(axis=0) + np.sqrt(sum(s.high**2 for s in independent)),
        sources=tuple(sources),
        models=others,
    )


def _changes(
    judge: _Judge, stars: Stars, models: dict[str, Any], row_errors: tuple[RowErrors, ...], cut_error: float
) -> tuple[list[Source], FloatArray]:
    """Sources of errors and choices, and the changes by all combinations of the choices, (n, n_name)."""
    some = _at_most(stars, MOST_STARS)
    base = Population.of(some, **models)
    if len(base.stars) > MOST_STARS:
        some = _at_most(stars, FEW_STARS)
        base = Population.of(some, **models)
    start = _rough(base)
    reference = judge.raw(base, start)
    change = {
        name: [judge.change(p, i, reference) for p, i in moved]
        for name, moved in _moved(base, start, models["multiplicity"], row_errors, cut_error).items()
    }
    sources = [_combined(name, np.array(changes)) for name, changes in change.items() if changes]
    names = ("photometry", *models["multiplicity"].choices)
    choices = {key: judge.change(p, i, reference) for key, (p, i) in _choices(some, models, names).items()}
    for number, name in enumerate(names):
        alone = choices[tuple(k == number for k in range(len(names)))]
        sources.append(
            Source(name=name, kind="choice", low=np.minimum(alone, 0.0), high=np.maximum(alone, 0.0))
        )
    return sources, np.array(list(choices.values()))


def _other_models(judge: _Judge, stars: Stars, models: dict[str, Any]) -> dict[str, FloatArray]:
    """Quantities by each compilation but the one in use, by name."""
    few, out = _at_most(stars, FEW_STARS), {}
    base = Population.of(few, **models)
    reference = judge.raw(base, _rough(base))
    for name in COMPILATIONS:
        if MULTIPLICITY[name] == models["multiplicity"]:
            continue
        population = Population.of(few, **(models | {"multiplicity": MULTIPLICITY[name]}))
        out[name] = judge.value + judge.change(population, _rough(population), reference)
    return out


def _at_most(stars: Stars, most: int) -> Stars:
    """The stars, or so many of them where there are more."""
    return stars if len(stars) <= most else stars.evenly(most)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Judge:
    """What changes of a population do to the quantities of a prediction."""

    prediction: Prediction
    response: Response
    fraction: FloatArray | None

    @property
    def value(self) -> FloatArray:
        """Quantities as predicted, in the order of `NAMES`, (n_name,)."""
        p = self.prediction
        return np.concatenate([p.eta, p.bias[:, 0], p.sd[:, 0], p.sigma[:, 0]])

    def raw(self, population: Population, integrals: PairIntegrals) -> FloatArray:
        """Eta, bias and scatter of a long stack, (7,)."""
        found = predict(population_moments(population, integrals, self.fraction), self.response, MANY_STARS)
        return np.concatenate([found.eta, found.bias[:, 0], found.sd[:, 0]])

    def change(self, population: Population, integrals: PairIntegrals, reference: FloatArray) -> FloatArray:
        """Change of the quantities, in proportion to those of the reference, (n_name,)."""
        raw = self.raw(population, integrals)
        ratio = np.divide(raw, reference, out=np.ones_like(raw), where=np.abs(reference) > 1e-15)
        return self._scaled(ratio)

    def _scaled(self, ratio: FloatArray) -> FloatArray:
        """Change of the quantities when eta, bias and scatter grow by factors."""
        moved = self.value[:7] * ratio
        sigma = np.hypot(moved[1:4], moved[4:7])
        change: FloatArray = np.concatenate([moved, sigma]) - self.value
        return change

    def sampled(self, population: Population, integrals: PairIntegrals) -> FloatArray:
        """Standard error of the quantities from the finite number of stars, (n_name,): that of a ratio of sums."""
        own = population.law.multiplicity_fraction
        pair = np.minimum(1.0, population.scale(self.fraction)[0] * own)
        star, number = population.law.star, population.abundance
        alone = 1.0 if integrals.single_kept is None else integrals.single_kept
        kept = np.bincount(star, number * (alone - pair * integrals.lost))
        relative = []
        for power in (1, 2):
            x = np.bincount(star, number * pair * integrals.power(power, power))
            rest = x - kept * (x.sum() / kept.sum())
            relative.append(np.sqrt(rest @ rest) / x.sum() if x.sum() > 0 else 0.0)
        ratio = 1.0 + np.repeat([relative[0], 0.5 * relative[1]], [4, 3])
        return np.abs(self._scaled(ratio))


def _moved(
    population: Population,
    integrals: PairIntegrals,
    model: MultiplicityModel,
    row_errors: tuple[RowErrors, ...],
    cut_error: float,
) -> dict[str, Iterator[tuple[Population, PairIntegrals]]]:
    """Populations with one figure moved by its error, with their integrals, by the name of the figure."""
    law, row = population.law, model.rows(population.stars.mass)
    free = np.isnan(law.mass_ratio)  # pairs that a catalogue has made have no law
    if population.stars.mass_ratio is not None:
        free = np.isnan(population.stars.mass_ratio)

    def each(figure: str, mine: NDArray[np.bool_]) -> Iterator[Any]:
        for number, errors in enumerate(row_errors):
            here = mine & (row == number)
            if not here.any():
                continue
            for error, sign in zip(getattr(errors, figure), (-1.0, 1.0), strict=True):
                changed = law.moved(figure, np.where(here, sign * error, 0.0))
                moved = replace(population, law=changed)
                yield moved, _again(moved, integrals, figure)

    def cuts() -> Iterator[Any]:
        for factor in (1.0 - cut_error, 1.0 + cut_error):
            moved = replace(population, cut=population.cut * factor)
            yield moved, _again(moved, integrals, "cut")

    everyone = np.ones_like(free)
    of_pairs = ("log_a", "sigma_log_period")
    sources = {
        _FIGURES.get(figure, figure): each(figure, everyone if figure in of_pairs else free)
        for figure in RowErrors._fields
    }
    return sources | {"cut": cuts()}


def _rough(population: Population) -> PairIntegrals:
    """Integrals good enough for changes."""
    if population.selection is not None:
        return integrate(population, _INTERVALS, is_rough=True)
    return PairIntegrals(
        cut=population.cut,
        coefficient=coefficient_moments(population, _INTERVALS),
        separation=separation_moments(population, is_rough=True),
    )


def _again(population: Population, integrals: PairIntegrals, moved: str) -> PairIntegrals:
    """Integrals of a population of which one figure has moved: only what depends on it is found anew."""
    if moved == "multiplicity_fraction":
        return integrals
    if population.selection is not None:
        return _rough(population)
    if moved == "mass_ratio_exponent":
        return replace(integrals, coefficient=coefficient_moments(population, _INTERVALS))
    return replace(integrals, cut=population.cut, separation=separation_moments(population, is_rough=True))


def _combined(name: str, changes: FloatArray) -> Source:
    """One source from the changes down and up of several rows, (2 n_row, n_name): rows in quadrature."""
    pairs = changes.reshape(-1, 2, changes.shape[1])
    low, high = np.minimum(pairs.min(axis=1), 0.0), np.maximum(pairs.max(axis=1), 0.0)
    return Source(
        name=name,
        kind="error",
        low=-np.sqrt(np.sum(low**2, axis=0)),
        high=np.sqrt(np.sum(high**2, axis=0)),
    )


def _choices(
    stars: Stars, models: dict[str, Any], names: tuple[str, ...]
) -> dict[tuple[bool, ...], tuple[Population, PairIntegrals]]:
    """Populations with photometry and each option of the model as given or the other way, by what is other."""
    model, photometry = models["multiplicity"], models["photometry"]
    lights = PHOTOMETRY["main-sequence"], PHOTOMETRY["habets-heintze"]
    other_photometry = lights[photometry == lights[0]]
    out: dict[tuple[bool, ...], tuple[Population, PairIntegrals]] = {}
    for other in itertools.product((False, True), repeat=len(names)):
        is_other = dict(zip(names, other, strict=True))
        chosen = replace(model, **{name: value for name, value in model.choices.items() if is_other[name]})
        light = other_photometry if other[0] else photometry
        population = Population.of(stars, **models | {"multiplicity": chosen, "photometry": light})
        if is_other.get("projection") and population.selection is None:  # the mass ratio knows nothing of it
            same = tuple(flag and name != "projection" for name, flag in is_other.items())
            coefficient = out[same][1].coefficient
            integrals = PairIntegrals(
                cut=population.cut,
                coefficient=coefficient,
                separation=separation_moments(population, is_rough=True),
            )
        else:
            integrals = _rough(population)
        out[other] = population, integrals
    return out
