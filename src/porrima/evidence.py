"""What was found, asked for by what it means, and numbers that bear on a statement with the limits that fit it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    import xarray as xr

    Parts = dict[str, xr.Dataset]

__all__ = ["NONE", "N_SIGMA", "Evidence", "Measure", "Number", "bend_of", "measure", "ratio_of", "slope_of"]

N_SIGMA = 3.0
"""Standard errors by which a number may lie outside its limits and still fit (dimensionless)."""

FIRST, OTHER, OPTICAL, MANY = (
    "errors_and_biases", "errors_and_biases_kcm16", "errors_and_biases_optical", "effect_of_n_stars",
)  # fmt: skip
"""Experiments of simulated stacks."""

READINGS = ("dk13", "dk13-kcm16")
"""The two readings of the multiplicity table, the published one first."""


class Number(NamedTuple):
    """A number and its standard error; NaN where there is none."""

    value: float
    error: float


NONE = Number(math.nan, math.nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class Measure:
    """A number that bears on a statement, with the limits within which it fits.

    Parameters
    ----------
    part : str
        Of the statement.
    quantity : str
        What it is, with its unit.
    value, error : float
        With its standard error; 0 where it is exact.
    least, largest : float
        Limits.
    slack : float
        Standard errors by which it may lie outside; negative: by which it must lie inside (dimensionless).
    under : str
        Assumption of the paper that was made; empty for none.
    """

    part: str
    quantity: str
    value: float
    error: float
    least: float = -math.inf
    largest: float = math.inf
    slack: float = N_SIGMA
    under: str = ""

    @property
    def is_there(self) -> bool:
        """Whether there is a number."""
        return math.isfinite(self.value) and math.isfinite(self.error)

    @property
    def fits(self) -> bool:
        """Whether it lies within its limits."""
        room = self.slack * self.error
        return self.least - room <= self.value <= self.largest + room

    def record(self) -> dict[str, Any]:
        """All of it as a row of a table.

        Returns
        -------
        record : dict
            With the names of the parameters, and ``fits``.
        """
        names = ("part", "quantity", "value", "error", "least", "largest", "slack", "under", "fits")
        return {name: getattr(self, name) for name in names}


def measure(
    part: str,
    quantity: str,
    number: Number,
    least: float = -math.inf,
    largest: float = math.inf,
    slack: float = N_SIGMA,
    under: str = "",
) -> Measure:
    """Measure of a part of a statement.

    Parameters
    ----------
    part, quantity : str
        As `Measure` has them.
    number : Number
        What is found.
    least, largest, slack : float
        As `Measure` has them.
    under : str
        Assumption of the paper; empty for none.

    Returns
    -------
    measure : Measure
        Of plain numbers.
    """
    value, error = float(number.value), float(number.error)
    return Measure(
        part=part,
        quantity=quantity,
        value=value,
        error=error,
        least=least,
        largest=largest,
        slack=slack,
        under=under,
    )


class Evidence:
    """Numbers of the experiments, asked for by what they mean; what is not there is NaN.

    Parameters
    ----------
    results : dict
        Datasets of each experiment by its name.
    """

    def __init__(self, results: Mapping[str, Parts]) -> None:
        self.results = results

    def has(self, experiment: str) -> bool:
        """Whether an experiment was carried out."""
        return experiment in self.results

    def named(self, name: str) -> Number:
        """A number of the experiment of statements."""
        if not self.has("statements"):
            return NONE
        numbers = self.results["statements"]["numbers"]
        if name not in numbers["name"].to_numpy():
            return NONE
        return Number(*(float(numbers[k].sel(name=name)) for k in ("value", "error")))

    def psfs(self, experiment: str) -> list[str]:
        """PSFs of simulated stacks, the least elliptical first."""
        if not (self.has(experiment) and self.has("statements")):
            return []
        key = "numbers" if experiment == MANY else "summary"
        names = self.results[experiment][key]["psf"].to_numpy().tolist()
        return sorted(names, key=lambda name: self.size_of(name))

    def ellipticity(self, psf: str) -> tuple[float, float]:
        """Components of the ellipticity of a PSF."""
        shapes = self.results["statements"]["psfs"].sel(psf=psf)
        return float(shapes["e1_0"]), float(shapes["e2_0"])

    def size_of(self, psf: str) -> float:
        """Length of the ellipticity of a PSF."""
        return math.hypot(*self.ellipticity(psf))

    def eta(self, experiment: str, psf: str) -> Any:
        """Mean x over the size of a PSF at the middle of each bin of binary fraction."""
        statements = self.results["statements"]
        model = READINGS[experiment == OTHER]
        mean_x = statements["mean_x"]["mean_x"].sel(model=model).to_numpy()
        return mean_x / float(statements["psfs"]["r2_0"].sel(psf=psf))

    def bins(
        self, experiment: str, psf: str, quantity: str, name: str, n_stars: int | None = None
    ) -> tuple[Any, Any]:
        """Simulated numbers in bins of binary fraction."""
        parts = self.results[experiment]
        data = parts["summary"] if n_stars is None else parts["numbers"].sel(n_stars=n_stars)
        here = data.sel(psf=psf, quantity=quantity)
        return here[name].to_numpy(), here[f"{name}_se"].to_numpy()

    def fractions(self, experiment: str) -> Any:
        """Middles of the bins of binary fraction."""
        parts = self.results[experiment]
        data = parts["numbers" if experiment == MANY else "summary"]
        return 0.5 * (data["f_lo"] + data["f_hi"]).to_numpy().reshape(-1)[: data.sizes["bin"]]

    def at(self, experiment: str, fraction: float) -> int:
        """Number of the bin that a binary fraction lies in."""
        return int(np.argmin(np.abs(self.fractions(experiment) - fraction - 1e-9)))

    def words(self, experiment: str, number: int) -> str:
        """A bin of binary fraction in words."""
        parts = self.results[experiment]
        data = parts["numbers" if experiment == MANY else "summary"]
        lo, hi = (
            float(data[name].to_numpy().reshape(-1)[: data.sizes["bin"]][number]) for name in ("f_lo", "f_hi")
        )
        return f"F = {lo:.3g} to {hi:.3g}"

    def n_stars(self, experiment: str = FIRST) -> list[int]:
        """Numbers of stars in the stacks of an experiment, ascending."""
        parts = self.results[experiment]
        if experiment == MANY:
            return sorted(parts["numbers"]["n_stars"].to_numpy().tolist())
        return [int(json.loads(parts["findings"].attrs["config"])["n_stars"])]


def slope_of(along: Any, value: Any, error: Any) -> Number:
    """Slope of the line through the origin, every bin alike, with its error."""
    norm = along @ along
    return Number(float(along @ value / norm), float(np.sqrt(along**2 @ error**2) / norm))


def ratio_of(above: Number, below: Number) -> Number:
    """Ratio of independent numbers."""
    value = above.value / below.value
    return Number(value, abs(value) * math.hypot(above.error / above.value, below.error / below.value))


def bend_of(fraction: Any, value: Any, error: Any) -> Number:
    """By how much the slope at fractions above 0.8 exceeds that below 0.3, over that."""
    low, high = fraction < 0.3, fraction > 0.8
    ratio = ratio_of(*(slope_of(fraction[k], value[k], error[k]) for k in (high, low)))
    return Number(ratio.value - 1, ratio.error)
