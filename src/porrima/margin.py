"""How well the merit of a chosen setting is known: errors of the multiplicity table, choices, star counts and noise."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.choice import stacked
from porrima.clipping import count_pairs
from porrima.companions import MassRangeWarning
from porrima.gain import moved_together, read_either_way
from porrima.multiplicity import COMPILATIONS, MULTIPLICITY
from porrima.own_sizes import own_sizes, sorting
from porrima.systems import Population

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from porrima.choice import Choice, Plan, Setting, Stacked, StarBin
    from porrima.companions import MultiplicityModel
    from porrima.own_sizes import Sorting
    from porrima.photometry import MassLuminosity
    from porrima.response import Response
    from porrima.stars import Stars

    FloatArray = NDArray[np.float64]

__all__ = ["COUNTS_ERROR", "MODELS", "Companions", "Margin", "left_after_correction", "margin"]

COUNTS_ERROR = 0.15
"""Relative error of the star counts of the analytic Galaxy (`galaxy.Robin2003`), dimensionless."""

SIGMA_ERROR = 0.05
"""Relative error of the noise of a star (assumed), dimensionless."""

MODELS = tuple(dict.fromkeys([*COMPILATIONS, "dk13-kcm16"]))
"""Models of multiplicity among which a choice is compared."""

MOST_STARS, FEW_STARS = 200, 80
"""Stars on which changes are found, and those of a model with several classes to a star (count)."""

_LEAST = 8  # stars of a bin


@dataclass(frozen=True, slots=True, kw_only=True)
class Companions:
    """What makes pairs of stars.

    Parameters
    ----------
    multiplicity : MultiplicityModel
        The table and how it is read.
    photometry : MassLuminosity
        Mass to light.
    cut : float
        Separation from which pairs are resolved, in arcsec.
    binary_fraction : float, optional
        In [0, 1]; None for the model's own.
    """

    multiplicity: MultiplicityModel
    photometry: MassLuminosity
    cut: float
    binary_fraction: float | None = None

    def population(self, stars: Stars) -> Population:
        """Population of some stars.

        Parameters
        ----------
        stars : Stars
            Of one range of magnitude.

        Returns
        -------
        population : Population
            With the cut alone.
        """
        return Population.of(stars, multiplicity=self.multiplicity, photometry=self.photometry, cut=self.cut)


@dataclass(frozen=True, slots=True, kw_only=True)
class Margin:
    """Merit of a setting with the interval in which it is known.

    Parameters
    ----------
    value, low, high : float
        Dimensionless.
    sources : dict of (float, float)
        Largest changes down and up by each source, dimensionless.
    models : dict of float
        Merit of the setting with other models of multiplicity, by name, dimensionless; no part of the interval.
    """

    value: float
    low: float
    high: float
    sources: dict[str, tuple[float, float]]
    models: dict[str, float]


def margin(
    choice: Choice, setting: Setting, stars: Sequence[Stars], companions: Companions, response: Response
) -> Margin:
    """Merit of a setting with the interval in which it is known.

    Parameters
    ----------
    choice : Choice
        Of which it is one.
    setting : Setting
        Numbers of range, exposures and clip.
    stars : sequence of Stars
        Of each bin of the choice.
    companions : Companions
        As the choice was made with.
    response : Response
        Of the PSF and estimator.

    Returns
    -------
    margin : Margin
        Dimensionless.

    Notes
    -----
    As `uncertainty.uncertainty`: each figure of the multiplicity table is moved by its error in all bins at once, and
    the cut by `uncertainty.CUT_ERROR`; star counts move by `COUNTS_ERROR` and the noise by `SIGMA_ERROR`; these and the
    error of the finite number of stars are added in quadrature.  Photometry and the choices of the model add an
    envelope.  Changes are found on up to `MOST_STARS` stars.

    References
    ----------
    DucheneKraus2013, KCM16
    """
    look = _Look.at(choice, setting, response)
    few = look.thinned(stars, companions)
    start = [companions.population(one) for one in few]
    reference = look.stack(start, companions)

    def change(populations: list[Population], with_what: Companions = companions) -> float:
        return look.merit(look.stack(populations, with_what), reference) - look.value

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MassRangeWarning)  # said when the choice was made
        errors = _errors(look, start, companions, change)
        read = [replace(companions, multiplicity=m, photometry=p)
                for m, p in read_either_way(companions.multiplicity, companions.photometry)]  # fmt: skip
        choices = [change([one.population(s) for s in few], one) for one in read]
        models = {}
        for name in MODELS:
            if MULTIPLICITY[name] != companions.multiplicity:
                other = replace(companions, multiplicity=MULTIPLICITY[name])
                models[name] = look.value + change([other.population(s) for s in few], other)
    sampled = choice.sampled(setting)
    errors["stars"] = (-sampled, sampled)
    finite = [ends for ends in errors.values() if not math.isnan(ends[0])]
    down, up = (math.sqrt(sum(ends[k] ** 2 for ends in finite)) for k in (0, 1))
    return Margin(
        value=look.value,
        low=max(look.value + min(0.0, *choices) - down, 0.0),
        high=look.value + max(0.0, *choices) + up,
        sources=errors | {"choices": (min(0.0, *choices), max(0.0, *choices))},
        models=models,
    )


def _errors(look: _Look, start: list[Population], companions: Companions, change: Any) -> dict[str, Any]:
    """Changes down and up by each kind of error, rows of the table in quadrature."""
    found: dict[str, list[tuple[float, float]]] = {}
    names = [name for row in companions.multiplicity.row_errors for name in row._fields] + ["cut"]
    for name, (down, up) in zip(names, moved_together(start, companions.multiplicity), strict=True):
        if all(_same(a, b) for a, b in zip(down, up, strict=True)):
            continue
        both = [change(down), change(up)]
        found.setdefault(name, []).append((min(0.0, *both), max(0.0, *both)))
    errors = {
        name: (-math.hypot(*(e[0] for e in ends)), math.hypot(*(e[1] for e in ends)))
        for name, ends in found.items()
    }
    for name, kind, factors in (
        ("star counts", ("scatter", "noise"), (1 / (1 + COUNTS_ERROR), 1 / (1 - COUNTS_ERROR))),
        ("noise of a star", ("noise", "clip"), ((1 - SIGMA_ERROR) ** 2, (1 + SIGMA_ERROR) ** 2)),
    ):
        ends = [look.scaled(kind, factor) - look.value for factor in factors]
        errors[name] = (min(0.0, *ends), max(0.0, *ends))
    return errors


def _same(one: Population, other: Population) -> bool:
    """Whether a figure moves nothing here: no star takes its row."""
    if one.cut != other.cut:
        return False
    names = ("multiplicity_fraction", "mass_ratio_exponent", "log_a", "log_a_sigma")
    return all(np.array_equal(getattr(one.law, name), getattr(other.law, name)) for name in names)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Look:
    """A setting by itself, and what populations in place of its own do to it."""

    part: slice
    bins: tuple[StarBin, ...]
    plan: Plan
    own: Stacked
    remaining: FloatArray | None
    response: Response
    sorted_by: dict[float, Sorting]

    @classmethod
    def at(cls, choice: Choice, setting: Setting, response: Response) -> _Look:
        """That of a choice."""
        e, k = setting.exposures, setting.clip
        some = slice(int(choice.stacks.first[setting.stars]), int(choice.stacks.last[setting.stars]) + 1)
        bins = tuple(replace(one, covariance=one.covariance[e : e + 1]) for one in choice.bins[some])
        plan = replace(
            choice.plan,
            threshold=choice.plan.threshold[k : k + 1],
            exposures=choice.plan.exposures[e : e + 1],
        )
        left = None if choice.remaining is None else choice.remaining[tuple(setting)]
        own = _whole(stacked(bins, plan), len(bins))
        return cls(part=some, bins=bins, plan=plan, own=own, remaining=left, response=response, sorted_by={})

    @property
    def value(self) -> float:
        """Merit of the setting."""
        return float(self.own.merit(self.plan.requirement, self.remaining)[0, 0, 0])

    def thinned(self, stars: Sequence[Stars], companions: Companions) -> list[Stars]:
        """Few stars of each bin, more where more of the stack comes from, at one magnitude."""
        chosen = stars[self.part]
        classes = max(companions.population(s.take(np.arange(1))).law.star.size for s in chosen)
        most = FEW_STARS if classes > 1 else MOST_STARS
        share = np.array([one.per_deg2 for one in self.bins]) / sum(one.per_deg2 for one in self.bins)
        few = []
        for one, s, part in zip(self.bins, chosen, share, strict=True):
            n = min(max(round(most * part), _LEAST), len(s))
            few.append(replace(s.evenly(n), magnitude=np.full(n, 0.5 * sum(one.magnitude))))
        return few

    def stack(self, populations: list[Population], companions: Companions) -> Stacked:
        """The setting with other populations."""
        bins = []
        for one, population in zip(self.bins, populations, strict=True):
            if population.cut not in self.sorted_by:
                self.sorted_by[population.cut] = sorting(self.response, population.cut)
            counts = count_pairs(population, companions.binary_fraction)
            sizes = own_sizes(counts, self.sorted_by[population.cut], one.magnitude)
            bins.append(replace(one, parts=(sizes,)))
        return _whole(stacked(bins, self.plan), len(bins))

    def merit(self, moved: Stacked, reference: Stacked) -> float:
        """Merit of the setting when it changes as much as a stack does: biases by as much, variances in proportion."""
        own = self.own

        def grown(name: str) -> FloatArray:
            before = getattr(reference, name)
            ratio = np.divide(getattr(moved, name), before, out=np.ones_like(before), where=before > 0)
            return np.asarray(getattr(own, name) * ratio)

        found = replace(
            own,
            binaries=own.binaries + moved.binaries - reference.binaries,
            clip=own.clip + moved.clip - reference.clip,
            scatter=grown("scatter"),
            noise=grown("noise"),
        )
        return float(found.merit(self.plan.requirement, self.remaining)[0, 0, 0])

    def scaled(self, names: tuple[str, ...], factor: float) -> float:
        """Merit of the setting with some of its parts times a factor."""
        found = replace(self.own, **{name: getattr(self.own, name) * factor for name in names})
        return float(found.merit(self.plan.requirement, self.remaining)[0, 0, 0])


def _whole(stacks: Stacked, n: int) -> Stacked:
    """Of the range from the first to the last bin alone."""
    chosen = {name: getattr(stacks, name)[n - 1 : n] for name in stacks.__dataclass_fields__}
    return type(stacks)(**chosen)


def left_after_correction(
    bins: Sequence[StarBin], plan: Plan, stars: Sequence[Stars], companions: Companions, response: Response
) -> FloatArray:
    """Bias by companions that stays after the predicted one is taken off: how far other models are from the one in use.

    Parameters
    ----------
    bins : sequence of StarBin
        Of the choice.
    plan : Plan
        What is tried.
    stars : sequence of Stars
        Of each bin.
    companions : Companions
        As the choice is made with.
    response : Response
        Of the PSF and estimator.

    Returns
    -------
    remaining : (r, e, k, 3) float array
        Root mean square of the differences over `MODELS` but the one in use, dimensionless, on up to `MOST_STARS` stars
        of each bin.
    """
    sorted_by = sorting(response, companions.cut)
    few = []
    for s in stars:
        n = min(len(s), FEW_STARS)
        few.append(s.take(((np.arange(n) + 0.5) * len(s) / n).astype(np.int64)))

    def biases(with_what: Companions) -> FloatArray:
        found = []
        for one, some in zip(bins, few, strict=True):
            counts = count_pairs(with_what.population(some), with_what.binary_fraction)
            found.append(replace(one, parts=(own_sizes(counts, sorted_by, one.magnitude),)))
        return stacked(found, plan).binaries

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MassRangeWarning)
        own = biases(companions)
        others = [
            biases(replace(companions, multiplicity=MULTIPLICITY[name])) - own
            for name in MODELS
            if MULTIPLICITY[name] != companions.multiplicity
        ]
    return np.asarray(np.sqrt(np.mean(np.square(others), axis=0)))
