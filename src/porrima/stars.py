"""Stars as a survey's catalogue or a model of the Galaxy gives them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.units import to_internal

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["COMPONENTS", "Stars"]

COMPONENTS = (
    "thin1",
    "thin2",
    "thin3",
    "thin4",
    "thin5",
    "thin6",
    "thin7",
    "thick",
    "halo",
    "bulge",
    "unknown",
)
"""Names of the Galaxy's components, as in Robin et al. (2003); ``unknown`` where a catalogue does not say."""

_DEFAULTS: dict[str, float] = {"metallicity": 0.0, "log_age": 9.7}  # the Sun's, where a catalogue gives none


@dataclass(frozen=True, slots=True, kw_only=True)
class Stars:
    """Stars, each with what the companions and the photometry need.

    Parameters
    ----------
    mass : (n,) float array
        Mass of the star, in M_sun, positive.
    distance : (n,) float array
        Distance from the Sun, in pc, positive.
    magnitude : (n,) float array
        Apparent magnitude in `band`, in mag; of a pair, that of both stars together.
    metallicity : (n,) float array
        [M/H], in dex.
    log_age : (n,) float array
        log10 of the age in yr.
    component : (n,) str array
        One of `COMPONENTS`.
    band : str
        Name of the band of `magnitude`, such as ``"i"`` (AB).
    area : float, optional
        Solid angle that the stars fill, in deg²; None where unknown.
    source : str
        Where the stars come from.
    mass_ratio : (n,) float array, optional
        Companion mass over primary mass where the catalogue itself has made the pair, in [0, 1]: 0 for a star
        that it says is single, NaN where it says nothing and the multiplicity model is to decide.

    Raises
    ------
    ValueError
        If the arrays differ in length, or a value is not finite or not positive where it must be.
    """

    mass: FloatArray
    distance: FloatArray
    magnitude: FloatArray
    metallicity: FloatArray
    log_age: FloatArray
    component: NDArray[np.str_]
    band: str
    area: float | None = None
    source: str = ""
    mass_ratio: FloatArray | None = None

    def __post_init__(self) -> None:
        n = np.shape(self.mass)
        if self.mass_ratio is not None:
            wrong = (self.mass_ratio < 0) | (self.mass_ratio > 1)
            if self.mass_ratio.shape != n or np.any(wrong):
                raise ValueError(f"mass_ratio must be {n} numbers in [0, 1] or NaN, got {self.mass_ratio}")
        for name in ("mass", "distance", "magnitude", "metallicity", "log_age", "component"):
            values = np.asarray(getattr(self, name))
            if values.ndim != 1 or values.shape != n:
                raise ValueError(f"{name} must be an array of shape {n}, got {values.shape}")
            if name != "component" and not np.all(np.isfinite(values)):
                raise ValueError(f"{name} must be finite, got {values[~np.isfinite(values)][0]}")
            if name in ("mass", "distance") and np.any(values <= 0):
                raise ValueError(f"{name} must be positive, got {values[values <= 0][0]}")

    @classmethod
    def from_columns(
        cls,
        *,
        mass: Any,
        distance: Any,
        magnitude: Any,
        metallicity: Any = None,
        log_age: Any = None,
        component: Any = None,
        band: str = "i",
        area: float | None = None,
        source: str = "",
        mass_ratio: Any = None,
    ) -> Stars:
        """Stars from columns that may be incomplete.

        Parameters
        ----------
        mass, distance, magnitude : (n,) array-like
            Bare numbers in M_sun, pc, mag, or astropy Quantities.
        metallicity, log_age : (n,) array-like or float, optional
            In dex and log10 yr; where not given, the Sun's metallicity and 5 Gyr.
        component : (n,) array-like, optional
            ``unknown`` where not given.
        band : str
            Band of the magnitudes.
        area : float, optional
            Solid angle, in deg².
        source : str
            Where the stars come from.
        mass_ratio : (n,) array-like, optional
            In [0, 1]; NaN, or not given at all, where the multiplicity model decides.

        Returns
        -------
        stars : Stars
            The same stars, complete.
        """
        mass = np.atleast_1d(np.asarray(to_internal(mass, "mass"), dtype=float))

        def full(name: str, values: Any) -> FloatArray:
            filled = _DEFAULTS[name] if values is None else values
            return np.array(np.broadcast_to(np.asarray(filled, dtype=float), mass.shape))

        names = np.full(mass.shape, "unknown") if component is None else np.asarray(component, dtype=str)
        return cls(
            mass=mass,
            distance=np.atleast_1d(np.asarray(to_internal(distance, "distance"), dtype=float)),
            magnitude=np.atleast_1d(np.asarray(to_internal(magnitude, "magnitude"), dtype=float)),
            metallicity=full("metallicity", metallicity),
            log_age=full("log_age", log_age),
            component=names,
            band=band,
            area=area,
            source=source,
            mass_ratio=None if mass_ratio is None else full("mass_ratio", mass_ratio),
        )

    def __len__(self) -> int:
        return int(self.mass.size)

    def evenly(self, n: int) -> Stars:
        """So many of the stars, evenly through mass and, within alike masses, distance.

        Parameters
        ----------
        n : int
            How many, up to all of them (count).

        Returns
        -------
        stars : Stars
            Sorted by mass in steps of 0.1 dex, then by distance.
        """
        order = np.lexsort((self.distance, np.round(np.log10(self.mass), 1)))
        return self.take(order[((np.arange(n) + 0.5) * len(self) / n).astype(np.int64)])

    def take(self, index: NDArray[Any]) -> Stars:
        """Stars at an index or under a mask.

        Parameters
        ----------
        index : (k,) int array or (n,) bool array
            Numbers of the stars, or a mask, dimensionless.

        Returns
        -------
        stars : Stars
            Those stars, with the same band, area and source.
        """
        return replace(
            self,
            mass=self.mass[index],
            distance=self.distance[index],
            magnitude=self.magnitude[index],
            metallicity=self.metallicity[index],
            log_age=self.log_age[index],
            component=self.component[index],
            mass_ratio=None if self.mass_ratio is None else self.mass_ratio[index],
        )

    def select(
        self,
        *,
        magnitude: tuple[float, float] | None = None,
        mass_max: float | None = None,
        component: str | None = None,
    ) -> Stars:
        """Stars within a range of magnitude, up to a mass, of one component.

        Parameters
        ----------
        magnitude : (float, float), optional
            Half-open range [lo, hi), in mag.
        mass_max : float, optional
            Largest mass kept, inclusive, in M_sun.
        component : str, optional
            One of `COMPONENTS`.

        Returns
        -------
        stars : Stars
            The selected stars; there may be none.
        """
        keep = np.ones(len(self), dtype=bool)
        if magnitude is not None:
            keep &= (self.magnitude >= magnitude[0]) & (self.magnitude < magnitude[1])
        if mass_max is not None:
            keep &= self.mass <= mass_max
        if component is not None:
            keep &= self.component == component
        return self.take(keep)

    def counts(
        self, magnitude: tuple[float, float], multiplicity_fraction: FloatArray
    ) -> list[dict[str, Any]]:
        """Number and mean properties of the stars per magnitude.

        Parameters
        ----------
        magnitude : (float, float)
            Range to divide into bins of one mag from its bright end; the last may be narrower.
        multiplicity_fraction : (n,) float array
            Of each star, in [0, 1].

        Returns
        -------
        counts : list of dict
            ``mag_lo``, ``mag_hi``, ``n``, ``n_per_deg2``, ``median_distance_pc``, ``mean_mass`` [M_sun] and
            ``mean_multiplicity_fraction``; None where not known or there is no star.
        """
        low, high = magnitude
        edges = np.append(low + np.arange(np.ceil(high - low - 1e-9)), high)
        rows = []
        for lo, hi in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            inside = (self.magnitude >= lo) & (self.magnitude < hi)
            n = int(inside.sum())
            rows.append(
                {
                    "mag_lo": lo,
                    "mag_hi": hi,
                    "n": n,
                    "n_per_deg2": n / self.area if self.area else None,
                    "median_distance_pc": float(np.median(self.distance[inside])) if n else None,
                    "mean_mass": float(self.mass[inside].mean()) if n else None,
                    "mean_multiplicity_fraction": float(multiplicity_fraction[inside].mean()) if n else None,
                }
            )
        return rows
