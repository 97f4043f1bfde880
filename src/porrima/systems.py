"""What a survey takes for one star: the point sources of each system, seen about their flux centroid."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from porrima.companions import scale_from, scales_reached
from porrima.errors import InputError
from porrima.moments import KernelMoments, moments_of_points
from porrima.units import to_internal

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.companions import CompanionLaw, MultiplicityModel
    from porrima.orbits import Projection
    from porrima.photometry import MassLuminosity, Tracks
    from porrima.selection import Selection
    from porrima.stars import Stars

    FloatArray = NDArray[np.float64]

__all__ = ["BRIGHT_MASS", "Population", "StackWeight", "Systems"]

StackWeight = Literal["equal", "flux"]
"""How stars are weighted in a stack: all alike, or each by its flux."""

BRIGHT_MASS = 1.5
"""Largest mass of a star kept, in M_sun: multiplicity is badly known above (KCM16 Sect. 4.3)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Population:
    """Stars with the law of their companions, and when a survey resolves a pair: what systems are drawn from.

    Simulation and prediction both start here; one draws from it, the other integrates over it.

    Parameters
    ----------
    stars : Stars
        The primaries, with the magnitude of the whole system: n rows, each star once for every class of companions.
    law : CompanionLaw
        Statistics of their companions, a class to a row.
    tracks : Tracks
        Mass-luminosity relation with each star's place in it.
    projection : {"isotropic", "inclination-uniform"}
        Orientation of the orbits.
    cut : float
        Projected separation at or above which a pair is resolved and leaves the sample, in arcsec.
    weight : (n,) float array
        Weight of each star's unit-flux image in a stack, dimensionless, with mean 1.
    selection : Selection or None
        What else the survey rejects, single stars among it.
    """

    stars: Stars
    law: CompanionLaw
    tracks: Tracks
    projection: Projection
    cut: float
    weight: FloatArray
    selection: Selection | None = None

    def __post_init__(self) -> None:
        if self.selection is not None and np.any(self.law.is_triple):
            raise InputError("must be off where there is a selection", key="multiplicity.triples", value=True)

    @classmethod
    def of(
        cls,
        stars: Stars,
        *,
        multiplicity: MultiplicityModel,
        photometry: MassLuminosity,
        cut: float = 0.05,
        stack_weight: StackWeight = "equal",
        selection: Selection | None = None,
    ) -> Population:
        """Population of given stars.

        Parameters
        ----------
        stars : Stars
            Those of one stack: already selected by magnitude, at least one.
        multiplicity : MultiplicityModel
            Gives the law of the companions.
        photometry : MassLuminosity
            Gives flux ratios, in the band of the stars.
        cut : float
            Separation from which a pair is resolved, in arcsec, positive.
        stack_weight : {"equal", "flux"}
            Whether every star counts alike in a stack, or in proportion to its flux.
        selection : Selection, optional
            What else the survey rejects.

        Returns
        -------
        population : Population
            Of these stars.

        Raises
        ------
        InputError
            If there are no stars, one lies outside the range of a model, the cut is not positive, or there are
            triples and a selection, which knows pairs only.
        """
        if len(stars) == 0:
            raise InputError("no star is left after selection", source=stars.source or None)
        if not 0 < cut < np.inf:
            raise InputError("must be positive and finite [arcsec]", key="cut", value=cut)
        try:
            law = multiplicity.companions(stars.mass, stars.metallicity)
            if stars.mass_ratio is not None:
                law = law.with_given(stars.mass_ratio)
            tracks = photometry.tracks(stars.mass, stars.metallicity, stars.log_age, stars.band)
        except ValueError as error:
            raise InputError(str(error), source=stars.source or None) from None
        flux = 10.0 ** (-0.4 * (stars.magnitude - stars.magnitude.min()))
        weight = flux / flux.mean() if stack_weight == "flux" else np.ones(len(stars))
        if law.star.size > len(stars):
            stars, weight = stars.take(law.star), weight[law.star]
            tracks = replace(tracks, index=tracks.index[law.star], weight=tracks.weight[law.star])
        return cls(
            stars=stars, law=law, tracks=tracks, projection=multiplicity.projection, cut=cut, weight=weight,
            selection=selection,
        )  # fmt: skip

    @property
    def abundance(self) -> FloatArray:
        """How much each row counts among the stars, (n,), with mean 1; 1 where stars have one class of companions."""
        return self.law.abundance

    @property
    def primaries(self) -> Stars:
        """The stars, each once."""
        first = self.law.first
        return self.stars if first.size == len(self.stars) else self.stars.take(first)

    def scale(self, binary_fraction: FloatArray | None) -> FloatArray:
        """Factor on all multiplicity fractions for each wanted binary fraction; see `companions.multiplicity_scale`.

        Parameters
        ----------
        binary_fraction : (k,) float array or None
            Before resolved pairs leave, in [0, 1]; None for the model's own.

        Returns
        -------
        scale : (k,) float array
            Dimensionless; (1,) of 1 for None.
        """
        if binary_fraction is None:
            return np.ones(1)
        return scale_from(_scales_reached(self), binary_fraction)


@lru_cache(maxsize=4)
def _scales_reached(population: Population) -> tuple[FloatArray, FloatArray]:
    """Of a population that is drawn from again and again."""
    return scales_reached(population.law.multiplicity_fraction, population.abundance)


@dataclass(frozen=True, slots=True, kw_only=True)
class Systems:
    """Systems of two or more point sources, each seen by the survey as one star.

    Parameters
    ----------
    flux : (n, k) float array
        Share of each of the k sources in the flux of its system, in [0, 1], sum 1.
    x, y : (n, k) float array
        Offset of each source from the flux centroid of its system, in arcsec.
    weight : (n,) float array
        Weight of each system in the stack, dimensionless, not negative.
    """

    flux: FloatArray
    x: FloatArray
    y: FloatArray
    weight: FloatArray

    @classmethod
    def from_pairs(
        cls, flux_ratio: FloatArray, dx: FloatArray, dy: FloatArray, weight: FloatArray | None = None
    ) -> Systems:
        """Systems of two sources.

        Parameters
        ----------
        flux_ratio : (n,) float array
            Companion flux over primary flux, in [0, 1]; 0 for a single star.
        dx, dy : (n,) float array
            Companion offset from the primary along the detector axes, in arcsec, or an astropy Quantity.
        weight : (n,) float array, optional
            Weight in the stack, dimensionless; 1 where not given.

        Returns
        -------
        systems : Systems
            Primary first, then companion.

        Raises
        ------
        ValueError
            If a flux ratio lies outside [0, 1], an offset is not finite, or the weights do not sum to
            more than 0.
        """
        dx, dy = to_internal(dx, "angle"), to_internal(dy, "angle")
        f, dx, dy = (np.atleast_1d(np.asarray(v, dtype=float)) for v in (flux_ratio, dx, dy))
        w = np.ones_like(f) if weight is None else np.atleast_1d(np.asarray(weight, dtype=float))
        for name, values, good, rule in (
            ("flux_ratio", f, (f >= 0) & (f <= 1), "in [0, 1]"),
            ("dx", dx, np.isfinite(dx), "finite"),
            ("dy", dy, np.isfinite(dy), "finite"),
            ("weight", w, np.isfinite(w) & (w >= 0), "finite and not negative"),
        ):
            if not np.all(good):
                raise ValueError(f"{name} must be {rule}, got {values[~good][0]}")
        if not w.sum() > 0:
            raise ValueError(f"weight must have a positive sum, got {w.sum()}")
        flux = np.stack([1 / (1 + f), f / (1 + f)], axis=1)
        from_centroid = np.stack([-f / (1 + f), 1 / (1 + f)], axis=1)
        return cls(flux=flux, x=from_centroid * dx[:, None], y=from_centroid * dy[:, None], weight=w)

    @classmethod
    def from_companions(
        cls, flux_ratio: FloatArray, dx: FloatArray, dy: FloatArray, weight: FloatArray | None = None
    ) -> Systems:
        """Systems of a primary and k companions.

        Parameters
        ----------
        flux_ratio : (n, k) float array
            Flux of each companion over that of the primary, in [0, 1]; 0 where there is none.
        dx, dy : (n, k) float array
            Offsets from the primary along the detector axes, in arcsec.
        weight : (n,) float array, optional
            Weight in the stack, dimensionless; 1 where not given.

        Returns
        -------
        systems : Systems
            Primary first, then its companions.

        Raises
        ------
        ValueError
            If a flux ratio lies outside [0, 1], an offset is not finite, or the weights do not sum to more than 0.
        """
        w = np.ones(len(flux_ratio)) if weight is None else np.asarray(weight, dtype=float)
        for of in range(flux_ratio.shape[1]):
            cls.from_pairs(flux_ratio[:, of], dx[:, of], dy[:, of], w)
        alone = np.zeros((len(w), 1))
        flux = np.concatenate([alone + 1, flux_ratio], axis=1)
        flux /= flux.sum(axis=1, keepdims=True)
        x, y = (np.concatenate([alone, d], axis=1) for d in (dx, dy))
        x, y = (d - np.sum(flux * d, axis=1, keepdims=True) for d in (x, y))
        return cls(flux=flux, x=x, y=y, weight=w)

    def __len__(self) -> int:
        return int(self.weight.size)

    def kernel_moments(self) -> KernelMoments:
        """Mean kernel moments of the stack of all systems.

        Returns
        -------
        moments : KernelMoments
            Of one stack, in arcsec^(a+b), weighted with `weight`.
        """
        each = moments_of_points(self.flux, self.x, self.y)
        mean = self.weight @ each / self.weight.sum()
        return KernelMoments(values=mean[None, :], n_stars=len(self))
