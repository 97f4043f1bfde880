"""The paper's experiments on the stars themselves: the analytic Galaxy over the sky, and beside a catalogue."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from porrima.galaxy import Robin2003
from porrima.multiplicity import DucheneKraus2013

if TYPE_CHECKING:
    from collections.abc import Callable

    import xarray as xr
    from numpy.typing import NDArray

    from porrima.galaxy import StarCounts
    from porrima.stars import Stars

    FloatArray = NDArray[np.float64]

__all__ = ["galaxy_against_catalog", "population"]

GAP_RULES = {name: DucheneKraus2013(gap_rule=name) for name in ("lower", "solar")}
N_DIRECTIONS = 51
"""Directions of the population figure: thirteen latitudes on two meridians, the others along a parallel (count)."""

MASS_CLASSES = {
    "below 0.1": (0.0, 0.1),
    "0.1-0.5": (0.1, 0.5),
    "0.5-0.7": (0.5, 0.7),
    "0.7-1.5": (0.7, 1.5),
    "0.5-1.5": (0.5, 1.5),
}
"""Classes of mass of the population figure, in M_sun; the last is the sum of the two before it."""


def population(
    magnitude: tuple[float, float] = (16.0, 24.0),
    band: str = "i",
    galaxy: Robin2003 | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> xr.Dataset:
    r"""Share of mass classes and mean binary fraction over the sky (KCM16 Sect. 4.3).

    Parameters
    ----------
    magnitude : (float, float)
        Half-open range, in mag.
    band : str
        One of the bands of `porrima.photometry.MainSequence`.
    galaxy : Robin2003, optional
        The model; the default one where not given.
    progress : callable
        Called with the number of directions done, `N_DIRECTIONS` in all (count).

    Returns
    -------
    dataset : Dataset
        ``share`` (scan, angle, mass_class) and ``binary_fraction`` (scan, angle, gap_rule), dimensionless,
        ``bright_limit`` (scan, angle), an upper limit on the share of stars above 1.5 M_sun, and
        ``n_per_deg2``, along three scans: latitude 15 to 75 deg at l = 0 and 180, longitude at b = 45.

    Notes
    -----
    Main-sequence stars, from the integral of `Robin2003.star_counts`: no random numbers.  Shares are of the
    stars up to 1.5 M_sun, the end of the photometry.  Those above are not counted but limited: at the
    magnitude of 1.5 M_sun, so nearer and more frequent than they are, and all alive, they would number
    :math:`\int_{1.5}^\infty m^{-3} dm` over the same integral across the last cell of mass times its stars.

    References
    ----------
    KCM16, Robin2003, DucheneKraus2013
    """
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for results only)

    model = galaxy or Robin2003()
    latitude, longitude = np.arange(15.0, 76.0, 5.0), np.linspace(0.0, 360.0, N_DIRECTIONS - 26)
    scans = {
        "l = 0": (np.zeros(latitude.size), latitude),
        "l = 180": (np.full(latitude.size, 180.0), latitude),
        "b = 45": (longitude, np.full(longitude.size, 45.0)),
    }
    parts = []
    for name, (l, b) in scans.items():
        counts = [
            model.star_counts(x % 360.0, y, np.array(magnitude), band) for x, y in zip(l, b, strict=True)
        ]
        part = xr.Dataset(
            {
                "share": (("angle", "mass_class"), [_shares(c) for c in counts]),
                "binary_fraction": (("angle", "gap_rule"), [_binary_fractions(c)[:, 0] for c in counts]),
                "bright_limit": ("angle", [_bright_limit(c) for c in counts]),
                "n_per_deg2": ("angle", [c.per_deg2[0] for c in counts]),
            },
            coords={
                "angle": longitude if name == "b = 45" else latitude,
                "mass_class": list(MASS_CLASSES),
                "gap_rule": list(GAP_RULES),
            },
        )
        progress(len(counts))
        parts.append(part.expand_dims(scan=[name]))
    dataset = xr.concat(parts, dim="scan", join="outer")
    dataset.attrs = {"band": band, "magnitude_lo": magnitude[0], "magnitude_hi": magnitude[1]}
    return dataset


def _shares(counts: StarCounts) -> list[float]:
    stars = counts.by_mass[0] / counts.by_mass[0].sum()
    return [float(stars[(counts.mass >= lo) & (counts.mass < hi)].sum()) for lo, hi in MASS_CLASSES.values()]


def _bright_limit(counts: StarCounts) -> float:
    """Upper limit on the share of stars above 1.5 M_sun."""
    last = counts.mass[-1] / np.sqrt(counts.mass[-1] / counts.mass[-2])  # lower edge of the last cell
    above = 1.5**-2 / (last**-2 - 1.5**-2)
    return float(above * counts.by_mass[0, -1] / counts.by_mass[0].sum())


def _binary_fractions(counts: StarCounts) -> FloatArray:
    """Mean multiplicity fraction (gap_rule, bin)."""
    laws = [model.companions(counts.mass) for model in GAP_RULES.values()]
    return np.stack([counts.mean(law.multiplicity_fraction) for law in laws])


def galaxy_against_catalog(
    stars: Stars,
    galaxy: Robin2003,
    direction: tuple[float, float],
    magnitudes: FloatArray,
    rng: np.random.Generator,
) -> xr.Dataset:
    """The analytic Galaxy beside a catalogue of the same direction, per bin of magnitude.

    Parameters
    ----------
    stars : Stars
        Main-sequence stars of the catalogue, up to 1.5 M_sun, with their area.
    galaxy : Robin2003
        The model.
    direction : (float, float)
        Galactic longitude and latitude, in deg.
    magnitudes : (n + 1,) float array
        Edges of the bins, in mag.
    rng : numpy.random.Generator
        For the sampling error of the median distance (200 bootstraps).

    Returns
    -------
    dataset : Dataset
        ``catalog`` and ``galaxy`` (quantity, bin) and ``stderr``, the sampling error of the catalogue:
        stars per deg², median distance in pc, mean mass in M_sun, mean multiplicity fractions of
        Duchene & Kraus (2013) by gap rule.
    """
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for results only)

    counts = galaxy.star_counts(*direction, magnitudes, stars.band)
    expected = np.vstack(
        [counts.per_deg2, counts.median_distance, counts.mean_mass, _binary_fractions(counts)]
    )
    value, stderr = np.empty_like(expected), np.empty_like(expected)
    for k in range(magnitudes.size - 1):
        here = stars.select(magnitude=(magnitudes[k], magnitudes[k + 1]))
        n, area = len(here), stars.area or 1.0
        medians = [np.median(here.distance[rng.integers(0, n, n)]) for _ in range(200)]
        value[:2, k] = n / area, np.median(here.distance)
        stderr[:2, k] = np.sqrt(n) / area, np.std(medians)
        of_star = [here.mass, *(m.companions(here.mass).multiplicity_fraction for m in GAP_RULES.values())]
        for row, values in enumerate(of_star, start=2):
            value[row, k], stderr[row, k] = values.mean(), values.std() / np.sqrt(n)
    names = ["counts", "median_distance", "mean_mass", *(f"fraction_{rule}" for rule in GAP_RULES)]
    dims = ("quantity", "bin")
    return xr.Dataset(
        {"catalog": (dims, value), "stderr": (dims, stderr), "galaxy": (dims, expected)},
        coords={"quantity": names, "mag_lo": ("bin", magnitudes[:-1]), "mag_hi": ("bin", magnitudes[1:])},
        attrs={"band": stars.band, "l": direction[0], "b": direction[1], "source": stars.source},
    )
