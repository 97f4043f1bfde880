r"""Which stars make the best PSF: the range of magnitude, clip and number of exposures with the smallest error.

The error of the PSF of one patch has a bias, by companions and by the clip's cutting into noise, and a scatter, of the
companions and of the noise of N stars.  Faint stars are many and noisy; bright ones let pairs be recognised.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from porrima.own_sizes import together
from porrima.prediction import QUANTITIES
from porrima.truncation import kept_shapes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from porrima.instruments import Requirement
    from porrima.own_sizes import OwnSizes
    from porrima.truncation import Sides

    FloatArray = NDArray[np.float64]

__all__ = [
    "CENTRES", "FLAT", "NOISE_ERROR", "THRESHOLDS", "WEIGHTS", "Choice", "Plan", "Setting", "Stacked", "StarBin",
    "choose", "row_of", "stacked",
]  # fmt: skip

CENTRES = ("stack", "known")
"""What a clip is centred on: the mean of the stars that it keeps, or a PSF that is known from elsewhere."""

WEIGHTS = ("equal", "inverse-variance")
"""How stars of several magnitudes are weighted in one stack."""

THRESHOLDS = np.append(np.inf, np.geomspace(0.1, 0.002, 19))
"""Clips that are tried where none are given, dimensionless: none, then ever tighter ones."""

FLAT = 1.1
"""Settings whose merit is within this factor of the best count as good as it (dimensionless)."""

NOISE_ERROR = 0.1
"""Share of the clip's own bias that stays after it is taken off: the noise of a star known to 5 % (assumed)."""

_LEAST = 0.1  # of 1 - M': a clip that follows its own centre more closely than that finds nothing
_NOTHING = 1e6  # factor on its errors


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What is tried, and what it is held against.

    Parameters
    ----------
    requirement : Requirement
        On e1, e2 and R² of the PSF.
    area : float
        Of the patch whose stars make one PSF, in deg².
    exposures : tuple of int
        Numbers of exposures of each star that are tried, ascending (count).
    threshold : (k,) float array
        Clips that are tried, the loosest first, dimensionless; infinite for none.
    sides : {"both", "upper"}
        Whether stars that look too small are clipped as well.
    centre : {"stack", "known"}
        What the clip is centred on.
    independent : bool
        Whether other exposures are stacked than those that are clipped.
    weights : {"equal", "inverse-variance"}
        Of stars of several magnitudes.
    """

    requirement: Requirement
    area: float
    exposures: tuple[int, ...]
    threshold: FloatArray
    sides: Sides = "both"
    centre: Literal["stack", "known"] = "stack"
    independent: bool = False
    weights: Literal["equal", "inverse-variance"] = "equal"


@dataclass(frozen=True, slots=True, kw_only=True)
class StarBin:
    """Stars of one range of magnitude.

    Parameters
    ----------
    magnitude : (float, float)
        Half-open range, in mag.
    per_deg2 : float
        Stars per deg², resolved pairs counted as one.
    parts : tuple of OwnSizes
        Of samples of these stars, alike in number: how much they differ is the error of their finite number.
    covariance : (n_exposure, n_m, 3, 3) float array
        Of the noise of one star's e1, e2 and R² over R0², for each number of exposures and group of magnitude,
        dimensionless.
    """

    magnitude: tuple[float, float]
    per_deg2: float
    parts: tuple[OwnSizes, ...]
    covariance: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Stacked:
    """Stacks of all contiguous ranges of magnitude (r), numbers of exposures (e) and clips (k).

    Parameters
    ----------
    first, last : (r,) int array
        First and last bin of each range (count).
    n_stars : (r, e, k) float array
        Stars in the stack (count).
    share, false_rejections : (r, e, k) float array
        Share of the stars kept, and of those without a companion rejected, in [0, 1].
    mean_x : (r, e, k) float array
        In arcsec².
    binaries, clip : (r, e, k, 3) float array
        Bias of e1, e2 and R² over R0² by companions and by what the clip does to noise, dimensionless.
    scatter, noise : (r, e, k, 3) float array
        Variance of the stack's by companions and by noise, dimensionless.
    """

    first: NDArray[np.int64]
    last: NDArray[np.int64]
    n_stars: FloatArray
    share: FloatArray
    false_rejections: FloatArray
    mean_x: FloatArray
    binaries: FloatArray
    clip: FloatArray
    scatter: FloatArray
    noise: FloatArray

    @property
    def sd(self) -> FloatArray:
        """Standard deviation of e1, e2 and R² over R0² between patches, (r, e, k, 3), dimensionless."""
        return np.sqrt(np.maximum(self.scatter + self.noise, 0.0))

    def bias(self, remaining: FloatArray | None = None) -> FloatArray:
        """Size of the bias, the two kinds of which are not let cancel each other.

        Parameters
        ----------
        remaining : (r, e, k, 3) float array, optional
            What is left of that by companions after the predicted one is taken off, dimensionless; none is where not
            given.

        Returns
        -------
        bias : (r, e, k, 3) float array
            Dimensionless, not negative.
        """
        if remaining is None:
            return np.abs(self.binaries) + np.abs(self.clip)
        return np.hypot(remaining, NOISE_ERROR * self.clip)

    def merit(self, requirement: Requirement, remaining: FloatArray | None = None) -> FloatArray:
        """Largest rms error over what is required of it.

        Parameters
        ----------
        requirement : Requirement
            On e1, e2 and R².
        remaining : (r, e, k, 3) float array, optional
            As for `bias`, dimensionless.

        Returns
        -------
        merit : (r, e, k) float array
            Dimensionless; at most 1 where the requirements are met.
        """
        required = [requirement.of(quantity) or math.inf for quantity in QUANTITIES]
        return np.asarray((np.hypot(self.bias(remaining), self.sd) / required).max(axis=-1))


def stacked(bins: Sequence[StarBin], plan: Plan, left_out: int | None = None) -> Stacked:
    r"""Bias and scatter of every stack that a plan allows.

    Parameters
    ----------
    bins : sequence of StarBin
        Neighbouring ranges of magnitude, the brightest first.
    plan : Plan
        What is tried.
    left_out : int, optional
        Sample of stars of each bin that is left out (count).

    Returns
    -------
    stacked : Stacked
        Dimensionless.

    Notes
    -----
    Weights by inverse variance are (1 - M')/V of the size, the best for a clip that is centred on the stack.

    With :math:`N_b` stars kept of bin b, of weight w, mean M and variance V of one star's, the stack is off by
    :math:`\sum N w M / \sum N w` and scatters with :math:`\sum N w^2 V/(\sum N w)^2`.  The size is divided by
    1 - M', the variance by its square, where the clip is centred on the stack (`truncation.kept_shapes`).
    """
    found = []
    for one in bins:
        parts = [part for k, part in enumerate(one.parts) if k != left_out or len(one.parts) == 1]
        sizes = together(parts)
        rows = [kept_shapes(sizes, c, plan.threshold, plan.sides, plan.independent) for c in one.covariance]
        found.append(
            {name: np.array([getattr(row, name) for row in rows]) for name in rows[0].__dataclass_fields__}
        )
    each = {name: np.array([one[name] for one in found]) for name in found[0]}  # (b, e, k[, 3])
    number = plan.area * np.array([one.per_deg2 for one in bins])[:, None, None] * each["share"]
    variance = (each["scatter"] + each["noise"])[..., 2]
    own = 1 - each["follows"] if plan.centre == "stack" else np.ones_like(number)
    weight = np.ones_like(number)
    if plan.weights == "inverse-variance":
        weight = np.maximum(own, 1e-6) / np.maximum(variance, 1e-300)
    first, last = np.triu_indices(len(bins))

    def over(values: FloatArray) -> FloatArray:
        sums = np.cumsum(np.concatenate([np.zeros((1, *values.shape[1:])), values]), axis=0)
        return np.asarray(sums[last + 1] - sums[first])

    share = number * weight
    norm = over(share)
    free = over(share * own) / norm
    lever = np.ones((*norm.shape, 3))
    lever[..., 2] = np.where(free > _LEAST, 1 / np.maximum(free, _LEAST), _NOTHING)

    def mean(name: str) -> FloatArray:
        return np.asarray(over(share[..., None] * each[name]) / norm[..., None] * lever)

    def spread(name: str) -> FloatArray:
        wide = share * weight
        return np.asarray(over(wide[..., None] * each[name]) * (lever / norm[..., None]) ** 2)

    every = over(number / each["share"])
    return Stacked(
        first=first,
        last=last,
        n_stars=over(number),
        share=over(number) / every,
        false_rejections=over(number / each["share"] * each["false_rejections"]) / every,
        mean_x=over(share * each["mean_x"]) / norm,
        binaries=mean("binaries"),
        clip=mean("clip"),
        scatter=spread("scatter"),
        noise=spread("noise"),
    )


class Setting(NamedTuple):
    """One of the settings that are tried: numbers of the range, of the exposures and of the clip."""

    stars: int
    exposures: int
    clip: int


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The best setting, and all that it was chosen from.

    Parameters
    ----------
    plan : Plan
        What was tried.
    bins : tuple of StarBin
        Of which stars.
    stacks : Stacked
        What every setting gives.
    remaining : (r, e, k, 3) float array, optional
        Bias by companions that stays after a correction, dimensionless; where given the merit is that after it.
    """

    plan: Plan
    bins: tuple[StarBin, ...]
    stacks: Stacked
    remaining: FloatArray | None = None

    @cached_property
    def merit(self) -> FloatArray:
        """Largest rms error over what is required of it, (r, e, k), dimensionless."""
        return self.stacks.merit(self.plan.requirement, self.remaining)

    @property
    def best(self) -> Setting:
        """The setting of the smallest merit, of equal ones that of the loosest clip."""
        return self.best_of(np.ones(self.merit.shape, dtype=bool))

    def best_of(self, allowed: NDArray[np.bool_]) -> Setting:
        """The best of some settings.

        Parameters
        ----------
        allowed : (r, e, k) bool array
            Whether a setting may be chosen, dimensionless.

        Returns
        -------
        setting : Setting
            The first of equal ones to 1e-9.
        """
        merit = np.where(allowed & np.isfinite(self.merit), self.merit, np.inf)
        good = np.argwhere(merit <= merit.min() * (1 + 1e-9))
        return Setting(*(int(k) for k in good[np.argmin(good[:, 2])]))

    def magnitude(self, stars: int) -> tuple[float, float]:
        """Magnitudes of a range.

        Parameters
        ----------
        stars : int
            Number of the range (count).

        Returns
        -------
        magnitude : (float, float)
            In mag.
        """
        return self.bins[self.stacks.first[stars]].magnitude[0], self.bins[self.stacks.last[stars]].magnitude[
            1
        ]

    def along(self, axis: int) -> list[Setting]:
        """Settings that differ from the best in one thing.

        Parameters
        ----------
        axis : int
            0 for the faint limit, 1 for the exposures, 2 for the clip (count).

        Returns
        -------
        settings : list of Setting
            In order.
        """
        best = self.best
        if axis == 0:
            same = np.flatnonzero(self.stacks.first == self.stacks.first[best.stars])
            return [best._replace(stars=int(k)) for k in same]
        if axis == 1:
            return [best._replace(exposures=k) for k in range(len(self.plan.exposures))]
        return [best._replace(clip=k) for k in range(self.plan.threshold.size)]

    def as_good(self) -> NDArray[np.int64]:
        """Settings whose merit is within `FLAT` of the best, (n, 3): range, exposures and clip (count)."""
        return np.argwhere(self.merit <= FLAT * self.merit[self.best])

    def runners_up(self) -> dict[str, Setting]:
        """The best setting of each kind of advice, by its name; what the plan has no setting for is left out."""
        lo, hi = (np.array([self.magnitude(k)[end] for k in range(self.stacks.first.size)]) for end in (0, 1))
        everything = np.arange(lo.size) == int(np.argmax(hi - lo))
        none, most = np.isinf(self.plan.threshold), np.arange(len(self.plan.exposures))
        allowed = {
            "all stars, no clip": (everything, most >= 0, none),
            "best range, no clip": (lo > 0, most >= 0, none),
            "19 mag and fainter, no clip": (lo >= 19, most >= 0, none),
            "20 mag and fainter, no clip": (lo >= 20, most >= 0, none),
            "all stars, clip": (everything, most >= 0, ~none),
            "brighter than 20 mag, clip": (hi <= 20, most >= 0, ~none),
            "one exposure": (lo > -np.inf, np.array(self.plan.exposures) == 1, none | ~none),
        }
        out = {}
        for name, (stars, exposures, clip) in allowed.items():
            these = stars[:, None, None] & exposures[:, None] & clip
            if these.any():
                out[name] = self.best_of(these)
        return out

    def sampled(self, setting: Setting) -> float:
        """Standard error of the merit of a setting from the finite number of stars, by leaving out each sample.

        Parameters
        ----------
        setting : Setting
            One of those that were tried.

        Returns
        -------
        error : float
            Dimensionless; NaN where there is one sample only.
        """
        n = min(len(one.parts) for one in self.bins)
        if n < 2:
            return math.nan
        plan = replace(
            self.plan,
            threshold=self.plan.threshold[setting.clip : setting.clip + 1],
            exposures=self.plan.exposures[setting.exposures : setting.exposures + 1],
        )
        chosen = slice(self.stacks.first[setting.stars], self.stacks.last[setting.stars] + 1)
        some = [
            replace(one, covariance=one.covariance[setting.exposures : setting.exposures + 1])
            for one in self.bins[chosen]
        ]
        whole = len(some) - 1  # the range from the first to the last bin
        left = None if self.remaining is None else self.remaining[tuple(setting)]
        merits = [float(stacked(some, plan, k).merit(plan.requirement, left)[whole, 0, 0]) for k in range(n)]
        return float(np.sqrt((n - 1) * np.var(merits)))


def choose(bins: Sequence[StarBin], plan: Plan, remaining: FloatArray | None = None) -> Choice:
    r"""The range of magnitude, clip and number of exposures whose PSF has the smallest error.

    Parameters
    ----------
    bins : sequence of StarBin
        Neighbouring ranges of magnitude, the brightest first.
    plan : Plan
        What is tried.
    remaining : (r, e, k, 3) float array, optional
        Bias by companions that stays after a correction, dimensionless.

    Returns
    -------
    choice : Choice
        Dimensionless.

    Notes
    -----
    The merit is the largest of :math:`\sqrt{(|b| + |c|)^2 + s^2 + n^2}/\mathrm{requirement}` over e1, e2 and R², with
    the bias b by companions, c by the clip's cutting into the noise, the scatter s of companions and the noise n of the
    stack.  b and c have unlike signs where a clip is from above only; they are not let cancel, for that would
    choose the one threshold at which a model of the companions happens to make them equal.
    """
    return Choice(plan=plan, bins=tuple(bins), stacks=stacked(bins, plan), remaining=remaining)


def row_of(choice: Choice, setting: Setting) -> dict[str, Any]:
    """All numbers of one setting.

    Parameters
    ----------
    choice : Choice
        Of which it is one.
    setting : Setting
        Numbers of range, exposures and clip.

    Returns
    -------
    row : dict
        mag, count, arcsec² and dimensionless; `clip` is None where there is none.
    """
    stacks, at = choice.stacks, tuple(setting)
    lo, hi = choice.magnitude(setting.stars)
    clip = float(choice.plan.threshold[setting.clip])
    row: dict[str, Any] = {
        "mag_lo": lo, "mag_hi": hi, "clip": clip if math.isfinite(clip) else None,
        "n_exposures": choice.plan.exposures[setting.exposures], "n_stars": float(stacks.n_stars[at]),
        "kept_share": float(stacks.share[at]), "false_rejections": float(stacks.false_rejections[at]),
        "mean_x": float(stacks.mean_x[at]), "merit": float(choice.merit[at]),
    }  # fmt: skip
    for k, quantity in enumerate(QUANTITIES):
        required = choice.plan.requirement.of(quantity)
        parts = {
            "binaries": stacks.binaries[at][k], "clip_bias": stacks.clip[at][k],
            "scatter": math.sqrt(max(stacks.scatter[at][k], 0.0)), "noise": math.sqrt(max(stacks.noise[at][k], 0.0)),
            "remaining": math.nan if choice.remaining is None else choice.remaining[at][k],
        }  # fmt: skip
        total = math.hypot(parts["binaries"] + parts["clip_bias"], parts["scatter"], parts["noise"])
        left = choice.remaining
        rms = math.hypot(float(stacks.bias(left)[at][k]), float(stacks.sd[at][k]))
        row |= {f"{name}_{quantity}": float(value) for name, value in parts.items()}
        row[f"total_{quantity}"] = float(total)
        row[f"share_{quantity}"] = None if required is None else float(rms / required)
    return row
