"""What fainter stars buy: how much smaller the effect of their companions is, and how well that is known."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.averages import population_moments
from porrima.companions import RowErrors
from porrima.integrals import integrate
from porrima.photometry import PHOTOMETRY
from porrima.systems import Population
from porrima.uncertainty import CUT_ERROR

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import xarray as xr
    from numpy.typing import NDArray

    from porrima.companions import MultiplicityModel
    from porrima.photometry import MassLuminosity
    from porrima.stars import Stars

    FloatArray = NDArray[np.float64]

__all__ = ["gain", "moved_together", "read_either_way", "with_figure_moved"]


def gain(
    bins: Sequence[tuple[tuple[float, float], Stars]],
    multiplicity: MultiplicityModel,
    photometry: MassLuminosity = PHOTOMETRY["main-sequence"],
    cut: float = 0.05,
    binary_fraction: float | None = None,
) -> xr.Dataset:
    r"""Mean x of the brightest stars over that of fainter ones, with the interval in which it is known.

    Parameters
    ----------
    bins : sequence of ((float, float), Stars)
        Half-open ranges in mag with their stars, the brightest first.
    multiplicity : MultiplicityModel
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
    moved in all bins at once.  Errors are added in quadrature in the logarithm, and the choices (photometry and those
    of the model) taken as an envelope, as in `uncertainty.uncertainty`; the finite number of stars is left out.  The
    truncation of the orbits is part of the model, not a choice among these.

    References
    ----------
    DucheneKraus2013, KCM16
    """
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for results only)

    fraction = None if binary_fraction is None else np.array([binary_fraction])

    def mean_x(populations: list[Population]) -> FloatArray:
        return np.array([population_moments(p, integrate(p), fraction).mean_x[0] for p in populations])

    def read(model: MultiplicityModel, light: MassLuminosity) -> list[Population]:
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
    start: list[Population], model: MultiplicityModel
) -> Iterator[tuple[list[Population], list[Population]]]:
    """All bins with one figure of one row, or the cut, moved by its error.

    Parameters
    ----------
    start : list of Population
        One for each bin.
    model : MultiplicityModel
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
    for number, row in enumerate(model.row_errors):
        for figure in RowErrors._fields:
            low, high = getattr(row, figure)
            down, up = (
                [with_figure_moved(p, model, number, figure, change) for p in start]
                for change in (-low, high)
            )
            yield down, up
    down, up = ([replace(p, cut=p.cut * (1 + sign * CUT_ERROR)) for p in start] for sign in (-1, 1))
    yield down, up


def with_figure_moved(
    population: Population, model: MultiplicityModel, row: int, figure: str, change: float
) -> Population:
    """Population with one figure of the table changed where its stars take a row.

    Parameters
    ----------
    population : Population
        Of n stars.
    model : MultiplicityModel
        Whose table it is.
    row : int
        As the rows of the model number them.
    figure : str
        A field of `companions.RowErrors`.
    change : float
        Added to the figure, in its unit.

    Returns
    -------
    population : Population
        With another law of companions.
    """
    here = np.where(model.rows(population.stars.mass) == row, change, 0.0)
    return replace(population, law=population.law.moved(figure, here))


def read_either_way(
    model: Any, photometry: MassLuminosity
) -> Iterator[tuple[MultiplicityModel, MassLuminosity]]:
    """Models and relations in all combinations of what may be read either way, as given first.

    Parameters
    ----------
    model : MultiplicityModel
        As given.
    photometry : MassLuminosity
        As given.

    Yields
    ------
    model, photometry : MultiplicityModel, MassLuminosity
        One of the combinations.

    Returns
    -------
    None
        An iterator.
    """
    lights = [photometry, *(light for light in PHOTOMETRY.values() if light != photometry)]
    options = [[(name, getattr(model, name)), (name, other)] for name, other in model.choices.items()]
    for light, *chosen in itertools.product(lights, *options):
        yield replace(model, **dict(chosen)), light
