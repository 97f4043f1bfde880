r"""How well a prediction is known: the errors of the multiplicity table and the choices it leaves, as an interval.

Each figure of the table is moved by its error, one at a time; each choice (photometry, gap rule, projection) is
made the other way, in all combinations.  Nothing is drawn.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from porrima.averages import population_moments
from porrima.integrals import PairIntegrals, coefficient_moments, integrate, separation_moments
from porrima.photometry import PHOTOMETRY
from porrima.prediction import MANY_STARS, QUANTITIES, predict
from porrima.systems import Population

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from porrima.multiplicity import DucheneKraus2013
    from porrima.photometry import MassLuminosity
    from porrima.prediction import Prediction
    from porrima.response import Response
    from porrima.selection import Selection
    from porrima.stars import Stars

    FloatArray = NDArray[np.float64]

__all__ = ["CUT_ERROR", "NAMES", "ROW_ERRORS", "RowErrors", "Source", "Uncertainty", "uncertainty"]

NAMES = ("eta", *(f"{kind}_{q}" for kind in ("bias", "sd", "sigma") for q in QUANTITIES))
"""What is given an interval, dimensionless: as in `prediction.Prediction`."""

CUT_ERROR = 0.1
"""Relative error of the cut: a survey resolves pairs from somewhere between 0.9 and 1.1 times the nominal
separation on (assumed; no source)."""

MOST_STARS = 1000
"""Stars on which changes are found, evenly through those given in mass and distance (count)."""

_INTERVALS = 32  # of the rule over the mass ratio for changes: its error, 5e-4, is the same before and after


class RowErrors(NamedTuple):
    """Errors of one row of the multiplicity table, one standard deviation down and up."""

    multiplicity_fraction: tuple[float, float]
    mass_ratio_exponent: tuple[float, float]
    log_a: tuple[float, float]  # dex
    sigma_log_period: tuple[float, float]  # dex


ROW_ERRORS = (
    RowErrors((0.04, 0.06), (1.0, 1.0), (0.05, 0.05), (0.25, 0.25)),
    RowErrors((0.03, 0.03), (0.2, 0.2), (0.30, 0.30), (0.25, 0.25)),
    RowErrors((0.02, 0.02), (0.1, 0.1), (0.05, 0.05), (0.10, 0.10)),
)
"""Below 0.1, 0.1-0.5 and about 1 M_sun.  Multiplicity fractions and exponents as published (Duchene & Kraus 2013);
they give no error of mean separations and widths: half the distance to the later compilations is taken (Winters et
al. 2019: 20 au; Susemiehl & Meyer 2022: 27 and 50 au; Offner et al. 2023: 4, 25 and 40 au and their widths)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """One source of uncertainty and what it does.

    Parameters
    ----------
    name : str
        Such as ``multiplicity_fraction`` or ``photometry``.
    kind : {"error", "choice", "sample"}
        An error of one standard deviation, a choice made the other way, or the finite number of stars.
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
        One for each kind of figure, choice and the stars.
    """

    prediction: Prediction
    value: FloatArray
    low: FloatArray
    high: FloatArray
    sources: tuple[Source, ...]

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
    multiplicity: DucheneKraus2013,
    photometry: MassLuminosity,
    cut: float = 0.05,
    binary_fraction: float | None = None,
    n_stars: int | None = None,
    row_errors: tuple[RowErrors, ...] = ROW_ERRORS,
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
    multiplicity : DucheneKraus2013
        The table and its gap rule.
    photometry : MassLuminosity
        The relation in use.
    cut : float
        Separation from which a pair is resolved, in arcsec.
    binary_fraction : float, optional
        Before resolved pairs leave, in [0, 1], taken as exact: errors of multiplicity fractions then only move pairs
        between rows.  None for the model's own, which they move.
    n_stars : int, optional
        Stars in the stack (count); None for infinitely many.
    row_errors : tuple of RowErrors
        Of the three rows of the table.
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
    Each figure is moved down and up by its error, and the changes of a kind of figure in the three rows, of the
    kinds, of the cut and of the sample of stars are added in quadrature, as independent.  The choices (photometry:
    `MainSequence` or `HabetsHeintze1981`; gap rule; projection) are no errors: the interval reaches from the lowest
    to the highest of their eight combinations, and by the sum in quadrature beyond.  Changes are found on up to
    `MOST_STARS` stars, to a few per cent of themselves, with the scatter of a long stack; the prediction itself on
    all stars.

    References
    ----------
    DucheneKraus2013, KCM16, Offner2023, Susemiehl2022, Winters2019
    """
    if not 0 <= cut_error < 1:
        raise ValueError(f"cut_error must be in [0, 1), got {cut_error}")
    models = {"multiplicity": multiplicity, "photometry": photometry, "cut": cut, "selection": selection}
    whole = Population.of(stars, **models)  # type: ignore[arg-type]
    integrals = integrate(whole) if integrals is None else integrals
    fraction = None if binary_fraction is None else np.array([binary_fraction])
    prediction = predict(population_moments(whole, integrals, fraction), response, n_stars)
    some = _thinned(stars)
    judge = _Judge(prediction=prediction, response=response, fraction=fraction)
    base = Population.of(some, **models)  # type: ignore[arg-type]
    start = _rough(base)
    reference = judge.raw(base, start)
    change = {
        name: [judge.change(p, i, reference) for p, i in moved]
        for name, moved in _moved(base, start, multiplicity, row_errors, cut_error).items()
    }
    sources = [_combined(name, np.array(changes)) for name, changes in change.items() if changes]
    choices = {key: judge.change(p, i, reference) for key, (p, i) in _choices(some, models).items()}
    for number, name in enumerate(("photometry", "gap_rule", "projection")):
        alone = choices[tuple(k == number for k in range(3))]
        sources.append(
            Source(name=name, kind="choice", low=np.minimum(alone, 0.0), high=np.maximum(alone, 0.0))
        )
    sampled = judge.sampled(whole, integrals)
    sources.append(Source(name="stars", kind="sample", low=-sampled, high=sampled))
    independent = [s for s in sources if s.kind != "choice"]
    every, value = np.array(list(choices.values())), judge.value
    return Uncertainty(
        prediction=prediction,
        value=value,
        low=value + every.min(axis=0) - np.sqrt(sum(s.low**2 for s in independent)),
        high=value + every.max(axis=0) + np.sqrt(sum(s.high**2 for s in independent)),
        sources=tuple(sources),
    )


def _thinned(stars: Stars) -> Stars:
    """At most so many stars, evenly through mass and, within alike masses, distance."""
    if len(stars) <= MOST_STARS:
        return stars
    alike = np.round(np.log10(stars.mass), 1)
    order = np.lexsort((stars.distance, alike))
    return stars.take(order[((np.arange(MOST_STARS) + 0.5) * len(stars) / MOST_STARS).astype(np.int64)])


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
    model: DucheneKraus2013,
    row_errors: tuple[RowErrors, ...],
    cut_error: float,
) -> dict[str, Iterator[tuple[Population, PairIntegrals]]]:
    """Populations with one figure moved by its error, with their integrals, by the name of the figure."""
    law, row = population.law, model.rows(population.stars.mass)
    free = np.isnan(law.mass_ratio)  # pairs that a catalogue has made have no law
    if population.stars.mass_ratio is not None:
        free = np.isnan(population.stars.mass_ratio)
    width = 2.0 / 3.0 * model.scatter_scale

    def law_with(name: str, change: FloatArray) -> Population:
        moved: Any = {name: getattr(law, name) + change}
        if name == "log_a":
            moved["log_a_max"] = law.log_a_max + change
        if name == "multiplicity_fraction":
            moved[name] = np.clip(moved[name], 0.0, 1.0)
        return replace(population, law=replace(law, **moved))

    def each(figure: str, name: str, scale: float, mine: NDArray[np.bool_]) -> Iterator[Any]:
        for number, errors in enumerate(row_errors):
            here = mine & (row == number)
            if not here.any():
                continue
            for error, sign in zip(getattr(errors, figure), (-1.0, 1.0), strict=True):
                moved = law_with(name, np.where(here, sign * error * scale, 0.0))
                yield moved, _again(moved, integrals, name)

    def cuts() -> Iterator[Any]:
        for factor in (1.0 - cut_error, 1.0 + cut_error):
            moved = replace(population, cut=population.cut * factor)
            yield moved, _again(moved, integrals, "cut")

    everyone = np.ones_like(free)
    return {
        "multiplicity_fraction": each("multiplicity_fraction", "multiplicity_fraction", 1.0, free),
        "mass_ratio_exponent": each("mass_ratio_exponent", "mass_ratio_exponent", 1.0, free),
        "mean_separation": each("log_a", "log_a", 1.0, everyone),
        "sigma_log_period": each("sigma_log_period", "log_a_sigma", width, everyone),
        "cut": cuts(),
    }


def _rough(population: Population) -> PairIntegrals:
    """Integrals good enough for changes."""
    if population.selection is not None:
        return integrate(population, _INTERVALS)
    return PairIntegrals(
        cut=population.cut,
        coefficient=coefficient_moments(population, _INTERVALS),
        separation=separation_moments(population),
    )


def _again(population: Population, integrals: PairIntegrals, moved: str) -> PairIntegrals:
    """Integrals of a population of which one figure has moved: only what depends on it is found anew."""
    if moved == "multiplicity_fraction":
        return integrals
    if population.selection is not None:
        return _rough(population)
    if moved == "mass_ratio_exponent":
        return replace(integrals, coefficient=coefficient_moments(population, _INTERVALS))
    return replace(integrals, cut=population.cut, separation=separation_moments(population))


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
    stars: Stars, models: dict[str, Any]
) -> dict[tuple[bool, ...], tuple[Population, PairIntegrals]]:
    """Populations with photometry, gap rule and projection each as given or the other way, by what is other."""
    model, photometry = models["multiplicity"], models["photometry"]
    names = {True: PHOTOMETRY["main-sequence"], False: PHOTOMETRY["habets-heintze"]}
    other_photometry = names[photometry != names[True]]
    other_gap = {"lower": "solar", "solar": "lower"}[model.gap_rule]
    other_projection = {"isotropic": "inclination-uniform", "inclination-uniform": "isotropic"}[
        model.projection
    ]
    out: dict[tuple[bool, ...], tuple[Population, PairIntegrals]] = {}
    for other in itertools.product((False, True), repeat=3):
        chosen = replace(
            model,
            gap_rule=other_gap if other[1] else model.gap_rule,
            projection=other_projection if other[2] else model.projection,
        )
        light = other_photometry if other[0] else photometry
        population = Population.of(stars, **models | {"multiplicity": chosen, "photometry": light})
        if other[2] and population.selection is None:  # the mass ratio knows nothing of the projection
            coefficient = out[*other[:2], False][1].coefficient
            integrals = PairIntegrals(
                cut=population.cut, coefficient=coefficient, separation=separation_moments(population)
            )
        else:
            integrals = _rough(population)
        out[other] = population, integrals
    return out
