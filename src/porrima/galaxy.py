"""The analytic Galaxy: star counts, and stars, towards any direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from porrima.dust import Place, dust_extinction, extinction_ratio
from porrima.photometry import MainSequence
from porrima.populations import COMPONENTS, LOG_MASS
from porrima.sightlines import Sightline, add_counts, cells_in_range, drawn_stars, sightline
from porrima.stars import Stars

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["Robin2003", "StarCounts"]

CHUNK = 500_000  # stars proposed at a time, to bound the memory
_COLUMNS = ("mass", "distance", "magnitude", "metallicity", "log_age", "component")


@dataclass(frozen=True, slots=True, kw_only=True)
class StarCounts:
    """Expected star counts of a direction in bins of magnitude, with the distances and masses they have.

    Parameters
    ----------
    magnitude_edges : (n_bin + 1,) float array
        Edges of the bins, in mag.
    distance_edges : (n_distance + 1,) float array
        Edges of the cells of distance, in pc.
    mass : (n_mass,) float array
        Centres of the cells of mass, in M_sun.
    by_component : (n_component, n_bin) float array
        Stars per deg² of each component, in the order of `porrima.stars.COMPONENTS`.
    by_distance : (n_bin, n_distance) float array
        Stars per deg² in each cell of distance.
    by_mass : (n_bin, n_mass) float array
        Stars per deg² in each cell of mass.
    """

    magnitude_edges: FloatArray
    distance_edges: FloatArray
    mass: FloatArray
    by_component: FloatArray
    by_distance: FloatArray
    by_mass: FloatArray

    @property
    def per_deg2(self) -> FloatArray:
        """Stars per deg² in each bin, (n_bin,) float array."""
        total: FloatArray = self.by_component.sum(axis=0)
        return total

    @property
    def median_distance(self) -> FloatArray:
        """Median distance in each bin in pc, (n_bin,) float array; NaN in an empty bin."""
        median = np.full(self.by_distance.shape[0], np.nan)
        for k, cells in enumerate(self.by_distance):
            if cells.sum() > 0:
                below = np.concatenate([[0.0], np.cumsum(cells)])
                median[k] = np.interp(0.5 * below[-1], below, self.distance_edges)
        return median

    @property
    def mean_mass(self) -> FloatArray:
        """Mean mass in each bin in M_sun, (n_bin,) float array; NaN in an empty bin."""
        return self.mean(self.mass)

    def mean(self, values: FloatArray) -> FloatArray:
        """Mean over the stars of each bin of a quantity that depends on mass.

        Parameters
        ----------
        values : (n_mass,) float array
            The quantity at the masses `mass`, such as a multiplicity fraction (dimensionless).

        Returns
        -------
        mean : (n_bin,) float array
            In the same unit; NaN in an empty bin.
        """
        total = self.by_mass.sum(axis=1)
        mean: FloatArray = np.where(total > 0, self.by_mass @ values, np.nan) / np.where(
            total > 0, total, 1.0
        )
        return mean


@dataclass(frozen=True, slots=True, kw_only=True)
class Robin2003:
    r"""Main-sequence stars of the Galaxy as in the Besançon model of 2003.

    Parameters
    ----------
    extinction_per_kpc : float
        Extinction in V at the Sun, in mag per kpc; 0 for a Galaxy without dust.
    warp : bool
        Whether discs and dust are warped and flared beyond the Sun.
    distance_max : float
        Distance up to which stars are counted, in pc; 50 kpc in the Besançon model.

    Notes
    -----
    Seven thin discs of different age, a thick disc and a halo, each with its density law, IMF, ages and
    [Fe/H] as published (`porrima.populations`) but for what is said below, seen through
    `porrima.photometry.MainSequence`, which stands for the tracks of the Besançon model.

    - Main-sequence stars of 0.08 to 1.5 M_sun only.  Giants and subgiants are left out, 1 to 8 % of all
      stars in a magnitude of i from 16 to 22 and next to none from 22 to 23 in two catalogues of the
      Besançon model at high latitude; so are white dwarfs, 0 to 4 % and most at the faint end.  With their
      share added, counts follow those of Allen's tables within 15 % from V = 16 to 22.
    - No bulge: within some 10° of the Galactic centre counts hold discs and halo only, and nothing warns.
    - The photometry takes [M/H]: [Fe/H], and 0.21 dex more in thick disc and halo, for [alpha/Fe] = 0.3.
    - The mass function is flatter at low mass than published, and the halo 13 instead of 14 Gyr old
      (`porrima.populations` says why).
    - g, r, i, z and euclid_VIS magnitudes are AB, gaia_G and roman_* Vega-like, as those of the photometry.
    - Against those catalogues, per magnitude of i from 16 to 23: counts within 15 %, median distances and
      mean masses within 10 % and mean multiplicity fractions within 0.01, or three sampling errors of the
      catalogue.  Its stars of 0.5 to 0.8 M_sun are 0.3 to 0.5 mag brighter than on the model's own tracks, as
      nearby dwarfs are; those below 0.5 M_sun are 0.3 to 0.7 mag fainter than nearby dwarfs of that mass.

    References
    ----------
    Robin2003, Bressan2012, Cardelli1989
    """

    extinction_per_kpc: float = 0.70
    warp: bool = True
    distance_max: float = 50_000.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.extinction_per_kpc) and self.extinction_per_kpc >= 0):
            raise ValueError(f"extinction_per_kpc must be 0 or more, got {self.extinction_per_kpc}")
        if not (np.isfinite(self.distance_max) and self.distance_max > 0):
            raise ValueError(f"distance_max must be positive and finite, got {self.distance_max}")

    def density(self, component: str, place: Place) -> FloatArray:
        r"""Mass density of a component anywhere in the Galaxy.

        Parameters
        ----------
        component : str
            One of thin1 to thin7, thick, halo.
        place : Place
            Where, in kpc and rad.

        Returns
        -------
        density : (n,) float array
            In M_sun per pc³; the published local density at the Sun.

        Raises
        ------
        ValueError
            If there is no such component.

        References
        ----------
        Robin2003
        """
        names = [c.name for c in COMPONENTS]
        if component not in names:
            raise ValueError(f"component must be one of {', '.join(names)}, got {component}")
        found = COMPONENTS[names.index(component)]
        return found.rho0 * found.relative_density(place, self.warp)

    def extinction(self, l: float, b: float, distance: FloatArray, band: str = "V") -> FloatArray:
        """Extinction between the Sun and some distances.

        Parameters
        ----------
        l, b : float
            Galactic longitude in [0, 360) and latitude in [-90, 90], in deg.
        distance : (n,) float array
            In pc.
        band : str
            A key of `porrima.dust.WAVELENGTHS`.

        Returns
        -------
        extinction : (n,) float array
            In mag.

        Raises
        ------
        ValueError
            If the direction is out of range or the band is not known.

        References
        ----------
        Robin2003, Cardelli1989
        """
        _check_direction(l, b)
        distance = np.asarray(distance, dtype=float)
        in_v = dust_extinction(l, b, distance, self.extinction_per_kpc, self.warp)
        return in_v * extinction_ratio(band)

    def star_counts(self, l: float, b: float, magnitudes: FloatArray, band: str = "i") -> StarCounts:
        """Expected main-sequence stars per deg² in bins of magnitude, by component, distance and mass.

        Parameters
        ----------
        l, b : float
            Galactic longitude in [0, 360) and latitude in [-90, 90], in deg.
        magnitudes : (n + 1,) float array
            Edges of the bins, increasing, in mag.
        band : str
            One of the bands of `porrima.photometry.MainSequence`.

        Returns
        -------
        counts : StarCounts
            From quadrature over mass, metallicity, age and distance; no random numbers.

        Raises
        ------
        ValueError
            If the direction, an edge or the band is out of range.

        References
        ----------
        Robin2003
        """
        edges = _checked(l, b, magnitudes, band)
        sight = self._sightline(l, b, edges, band)
        n_bin = edges.size - 1
        by_component = np.zeros((len(COMPONENTS), n_bin))
        by_distance = np.zeros((n_bin, sight.volume.shape[1]))
        by_mass = np.zeros((n_bin, LOG_MASS.size - 1))
        add_counts(sight, band, edges, by_component, by_distance, by_mass)
        return StarCounts(
            magnitude_edges=edges,
            distance_edges=sight.distance,
            mass=10 ** (0.5 * (LOG_MASS[1:] + LOG_MASS[:-1])),
            by_component=by_component,
            by_distance=by_distance,
            by_mass=by_mass,
        )

    def counts(self, l: float, b: float, magnitudes: FloatArray, band: str = "i") -> FloatArray:
        """Expected main-sequence stars per deg² in bins of magnitude.

        Parameters
        ----------
        l, b : float
            Galactic longitude in [0, 360) and latitude in [-90, 90], in deg.
        magnitudes : (n + 1,) float array
            Edges of the bins, increasing, in mag.
        band : str
            One of the bands of `porrima.photometry.MainSequence`.

        Returns
        -------
        counts : (n,) float array
            Stars per deg², as `star_counts` gives them.

        References
        ----------
        Robin2003
        """
        return self.star_counts(l, b, magnitudes, band).per_deg2

    def draw(
        self,
        l: float,
        b: float,
        area: float,
        band: str,
        magnitude_range: tuple[float, float],
        rng: np.random.Generator,
        n: int | None = None,
    ) -> Stars:
        """Stars drawn from the model, in random order.

        Parameters
        ----------
        l, b : float
            Galactic longitude in [0, 360) and latitude in [-90, 90], in deg.
        area : float
            Solid angle, in deg².
        band : str
            One of the bands of `porrima.photometry.MainSequence`.
        magnitude_range : (float, float)
            Half-open range [lo, hi), in mag.
        rng : numpy.random.Generator
            Where the random numbers come from.
        n : int, optional
            Number of stars (count), whatever the area; where not given, a Poisson number with the mean that
            `area` has.

        Returns
        -------
        stars : Stars
            With `area` as given, or None where `n` is given.

        Raises
        ------
        ValueError
            If an argument is out of range, or `n` stars are asked for where the model has none.

        Notes
        -----
        Rejection from the laws that `star_counts` integrates: a cell of mass, metallicity and distance that
        may hold stars of the range is chosen by its content, a star's values within it are drawn, and the
        star stays if its magnitude lies in the range and it has not left the main sequence.  The laws are
        followed exactly but for the distance, uniform in volume within a cell of 2.3 %.

        References
        ----------
        Robin2003
        """
        edges = _checked(l, b, np.asarray(magnitude_range, dtype=float), band)
        if not (np.isfinite(area) and area > 0):
            raise ValueError(f"area must be positive and finite, got {area}")
        if n is not None and n < 0:
            raise ValueError(f"n must be 0 or more, got {n}")
        sight = self._sightline(l, b, edges, band)
        cells = cells_in_range(sight, band, edges)
        if n and self.counts(l, b, edges, band).sum() == 0:
            raise ValueError(f"magnitude_range must hold stars of the model, got {tuple(edges.tolist())}")
        parts, have = [_no_stars(band)], 0
        left = int(rng.poisson(cells.total * area)) if n is None else n
        while left > 0:
            size = min(CHUNK, left if n is None else int(1.5 * left) + 1000)
            parts.append(drawn_stars(sight, cells, size, band, edges, rng))
            have += len(parts[-1])
            left = left - size if n is None else n - have
        return Stars(
            **{name: np.concatenate([getattr(part, name) for part in parts])[:n] for name in _COLUMNS},
            band=band,
            area=area if n is None else None,
            source=f"Robin2003, l = {l:g}, b = {b:g} deg, {edges[0]:g} <= {band} < {edges[1]:g}",
        )

    def _sightline(self, l: float, b: float, edges: FloatArray, band: str) -> Sightline:
        brightest = float(edges[0])
        return sightline(l, b, band, brightest, self.distance_max, self.extinction_per_kpc, self.warp)


def _no_stars(band: str) -> Stars:
    return Stars.from_columns(mass=[], distance=[], magnitude=[], band=band)


def _checked(l: float, b: float, edges: FloatArray, band: str) -> FloatArray:
    """Edges of the bins as an array, once all arguments are known to be good."""
    edges = np.asarray(edges, dtype=float)
    _check_direction(l, b)
    if edges.ndim != 1 or edges.size < 2 or not np.all(np.isfinite(edges)) or np.any(np.diff(edges) <= 0):
        raise ValueError(f"magnitudes must be two or more increasing finite numbers, got {edges.tolist()}")
    bands = MainSequence().bands
    if band not in bands:
        raise ValueError(f"band must be one of {', '.join(bands)}, got {band}")
    return edges


def _check_direction(l: float, b: float) -> None:
    if not 0 <= l < 360:
        raise ValueError(f"l must be in [0, 360) deg, got {l}")
    if not -90 <= b <= 90:
        raise ValueError(f"b must be in [-90, 90] deg, got {b}")
