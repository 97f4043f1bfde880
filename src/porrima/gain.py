"""What fainter stars buy: how much smaller the effect of their companions is, and how well that is known."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.averages import population_moments
from porrima.integrals import integrate
from porrima.photometry import PHOTOMETRY
from porrima.systems import Population
from porrima.uncertainty import CUT_ERROR, ROW_ERRORS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import xarray as xr
    from numpy.typing import NDArray

    from porrima.multiplicity import DucheneKraus2013
    from porrima.photometry import MassLuminosity
    from porrima.stars import Stars

    FloatArray = NDArray[np.float64]

__all__ = ["gain", "moved_together", "read_either_way", "with_figure_moved"]

FIGURES = {  # of a row of the table: what it is called in the law of companions
    "multiplicity_fraction": "multiplicity_fraction",
    "mass_ratio_exponent": "mass_ratio_exponent",
    "log_a": "log_a",
    "sigma_log_period": "log_a_sigma",
}


def gain(
    bins: Sequence[tuple[tuple[float, float], Stars]],
    multiplicity: DucheneKraus2013,
    photometry: MassLuminosity = PHOTOMETRY["main-sequence"],
    cut: float = 0.05,
    binary_fraction: float | None = None,
) -> xr.Dataset:
    r"""Mean x of the brightest stars over that of fainter ones, with the interval in which it is known.

    Parameters
    ----------
    bins : sequence of ((float, float), Stars)
        Half-open ranges in mag with their stars, the brightest first.
    multiplicity : DucheneKraus2013
        The table and how it is read.
    photometry : MassLuminosity
        Mass to light.
    cut : float
        Separation from which pairs are resolved, in arcsec.
    binary_fraction : float, optional
        In [0, 1]; None for the model's own.

    Returns
    -------
    dataset : Dataset
        ``gain``, ``low`` and ``high`` (bin), dimensionless, with ``mag_lo`` and ``mag_hi``; ``mean_x`` in arcsec².

    Notes
    -----
    What moves one bin moves the others, so the ratio is known better than either number: each figure of the table is
    moved in all bins at once.  Errors are added in quadrature in the logarithm, and the choices (photometry, gap rule,
    projection) taken as an envelope, as in `uncertainty.uncertainty`; the finite number of stars is left out.  The
    truncation of the orbits is part of the model, not a choice among these.

    References
    ----------
    DucheneKraus2013, KCM16
    """
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for results only)

    fraction = None if binary_fraction is None else np.array([binary_fraction])

    def mean_x(populations: list[Population]) -> FloatArray:
        return np.array([population_moments(p, integrate(p), fraction).mean_x[0] for p in populations])

    def read(model: DucheneKraus2013, light: MassLuminosity) -> list[Population]:
        return [Population.of(s, multiplicity=model, photometry=light, cut=cut) for _, s in bins]

    start = read(multiplicity, photometry)
    found = mean_x(start)
    value = np.log(found[0] / found)
    errors = []
    for down_and_up in moved_together(start, multiplicity):
        x = np.array([mean_x(populations) for populations in down_and_up])
        errors.append(np.log(x[:, :1] / x) - value)
    choices = np.array([mean_x(read(*choice)) for choice in read_either_way(multiplicity, photometry)])
    envelope = np.log(choices[:, :1] / choices)
    change = np.array(errors)  # (source, 2, bin)
    low = envelope.min(axis=0) - np.sqrt(np.sum(np.minimum(change.min(axis=1), 0.0) ** 2, axis=0))
    high = envelope.max(axis=0) + np.sqrt(np.sum(np.maximum(change.max(axis=1), 0.0) ** 2, axis=0))
    edges = np.array([magnitude for magnitude, _ in bins])
    ends = {"gain": value, "low": low, "high": high}
    return xr.Dataset(
        {name: ("bin", np.exp(values)) for name, values in ends.items()} | {"mean_x": ("bin", found)},
        coords={"mag_lo": ("bin", edges[:, 0]), "mag_hi": ("bin", edges[:, 1])},
    )


def moved_together(
    start: list[Population], model: DucheneKraus2013
) -> Iterator[tuple[list[Population], list[Population]]]:
    """All bins with one figure of one row, or the cut, moved by its error.

    Parameters
    ----------
    start : list of Population
        One for each bin.
    model : DucheneKraus2013
        Whose table it is.

    Yields
    ------
    down, up : list of Population
        The bins with the figure lowered and raised by one standard deviation.

    Returns
    -------
    None
        An iterator.
    """
    for number, row in enumerate(ROW_ERRORS):
        for figure in FIGURES:
            low, high = getattr(row, figure)
            down, up = (
                [with_figure_moved(p, model, number, figure, change) for p in start]
                for change in (-low, high)
            )
            yield down, up
    down, up = ([replace(p, cut=p.cut * (1 + sign * CUT_ERROR)) for p in start] for sign in (-1, 1))
    yield down, up


def with_figure_moved(
    population: Population, model: DucheneKraus2013, row: int, figure: str, change: float
) -> Population:
    """Population with one figure of the table changed where its stars take a row.

    Parameters
    ----------
    population : Population
        Of n stars.
    model : DucheneKraus2013
        Whose table it is.
    row : int
        As `DucheneKraus2013.rows` numbers them.
    figure : str
        A field of `uncertainty.RowErrors`.
    change : float
        Added to the figure, in its unit.

    Returns
    -------
    population : Population
        With another law of companions.
    """
    law, name = population.law, FIGURES[figure]
    unit = (
        2.0 / 3.0 * model.scatter_scale if figure == "sigma_log_period" else 1.0
    )  # log a over that of log P
    here = np.where(model.rows(population.stars.mass) == row, change * unit, 0.0)
    moved: Any = {name: getattr(law, name) + here}
    if name == "log_a":
        moved["log_a_max"] = law.log_a_max + here
    if name == "multiplicity_fraction":
        moved[name] = np.clip(moved[name], 0.0, 1.0)
    return replace(population, law=replace(law, **moved))


def read_either_way(
    model: DucheneKraus2013, photometry: MassLuminosity
) -> Iterator[tuple[DucheneKraus2013, MassLuminosity]]:
    """Models and relations in all combinations of what may be read either way, as given first.

    Parameters
    ----------
    model : DucheneKraus2013
        As given.
    photometry : MassLuminosity
        As given.

    Yields
    ------
    model, photometry : DucheneKraus2013, MassLuminosity
        One of the combinations.

    Returns
    -------
    None
        An iterator.
    """
    lights = [photometry, *(light for light in PHOTOMETRY.values() if light != photometry)]
    gaps = sorted(("lower", "solar"), key=lambda rule: rule != model.gap_rule)
    turned = sorted(("isotropic", "inclination-uniform"), key=lambda name: name != model.projection)
    for light, rule, projection in itertools.product(lights, gaps, turned):
        yield replace(model, gap_rule=rule, projection=projection), light  # type: ignore[arg-type]
