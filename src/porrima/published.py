"""Published tables of multiplicity: a power law of mass ratios and a log-normal of axes in each range of masses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np

from porrima.companions import CompanionLaw, RowErrors, check_option, warn_of_masses
from porrima.eccentricity import Eccentricity, eccentric, orbit_nodes
from porrima.hierarchy import triple_fraction, with_triples
from porrima.moe import MetallicityTrend, apply_metallicity

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.orbits import Projection

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = ["Offner2023", "Raghavan2010", "Row", "SusemiehlMeyer2022", "Winters2019"]

_MEAN_LOG_PROJECTION = (np.log(2.0) - 1.0) / np.log(10.0)  # of log10 of sqrt(1 - mu²), mu uniform
_VARIANCE_LOG_PROJECTION = (1.0 - np.pi**2 / 12.0) / np.log(10.0) ** 2


class Row(NamedTuple):
    """One row of a table of multiplicity."""

    mass_lo: float  # M_sun
    mass_hi: float  # M_sun
    multiplicity_fraction: float
    companion_frequency: float  # companions per primary
    mass_ratio_exponent: float
    a_median: float  # au
    log_a_sigma: float  # dex
    errors: RowErrors


@dataclass(frozen=True, slots=True, kw_only=True)
class _LogNormals:
    """What the tables have in common."""

    name: ClassVar[str]
    table: ClassVar[tuple[Row, ...]]
    triple_fractions: ClassVar[tuple[float, ...] | None] = None  # of all stars, where the paper counts them
    is_projected: ClassVar[bool] = False  # whether the table has separations on the sky for semi-major axes

    gap_rule: Literal["nearest", "interpolated"] = "nearest"
    eccentricity: Eccentricity = "circular"
    metallicity: MetallicityTrend = "none"
    mass_ratio_min: float = 0.1
    triples: bool = False

    def __post_init__(self) -> None:
        if self.gap_rule not in ("nearest", "interpolated"):
            raise ValueError(f"gap_rule must be nearest or interpolated, got {self.gap_rule}")
        if not 0 < self.mass_ratio_min < 1:
            raise ValueError(f"mass_ratio_min must be in (0, 1), got {self.mass_ratio_min}")
        check_option("eccentricity", self.eccentricity, Eccentricity)
        check_option("metallicity", self.metallicity, MetallicityTrend)

    @property
    def mass_range(self) -> tuple[float, float]:
        """Least and largest mass of a primary, in M_sun."""
        return (self.table[0].mass_lo, self.table[-1].mass_hi)

    @property
    def projection(self) -> Projection:
        """Isotropic orbits."""
        return "isotropic"

    @property
    def row_errors(self) -> tuple[RowErrors, ...]:
        """Errors of each row of the table."""
        return tuple(row.errors for row in self.table)

    @property
    def choices(self) -> dict[str, Any]:
        """Orbits as circles or not, and for several rows what masses between them take."""
        out: dict[str, Any] = {"eccentricity": "mds17" if self.eccentricity == "circular" else "circular"}
        if len(self.table) > 1:
            out["gap_rule"] = "nearest" if self.gap_rule == "interpolated" else "interpolated"
        if self.metallicity != "none":
            out["metallicity"] = "none"
        return out

    def rows(self, mass: FloatArray) -> IntArray:
        """Row of the table that is nearest to each primary in log mass.

        Parameters
        ----------
        mass : (n,) float array
            In M_sun.

        Returns
        -------
        row : (n,) int array
            From 0, the row of the least masses.
        """
        ends = [np.sqrt(a.mass_hi * b.mass_lo) for a, b in zip(self.table, self.table[1:], strict=False)]
        return np.searchsorted(np.array(ends), mass, side="right")

    def companions(self, mass: FloatArray, metallicity: FloatArray | None = None) -> CompanionLaw:
        """Companion statistics of each primary.

        Parameters
        ----------
        mass : (n,) float array
            Mass of the primary, in M_sun.
        metallicity : (n,) float array, optional
            [M/H], in dex; that of field stars where not given.

        Returns
        -------
        law : CompanionLaw
            Axes in log10 au, scatter in dex.

        Warns
        -----
        MassRangeWarning
            If stars lie outside `mass_range`: they take its nearest row.
        """
        warn_of_masses(mass, self.mass_range, self.name)
        fraction, exponent, log_a, sigma = self._figures(mass)
        if self.is_projected:
            log_a, sigma = self._unprojected(log_a, sigma)
        law = CompanionLaw(
            star=np.arange(mass.size),
            share=np.ones(mass.shape),
            multiplicity_fraction=fraction,
            mass_ratio_exponent=exponent,
            mass_ratio_min=np.full(mass.shape, self.mass_ratio_min),
            mass_ratio_max=np.ones(mass.shape),
            log_a=log_a,
            log_a_sigma=sigma,
            log_a_max=np.full(mass.shape, np.inf),
            mass_ratio=np.full(mass.shape, np.nan),
        )
        law = eccentric(apply_metallicity(law, mass, metallicity, self.metallicity), mass, self.eccentricity)
        return with_triples(law, self._triples(mass)) if self.triples else law

    def _triples(self, mass: FloatArray) -> FloatArray:
        """Share of triples among the multiple stars of each primary's kind, (n,)."""
        fraction, frequency = np.array([row[2:4] for row in self.table]).T
        if self.triple_fractions is not None:
            frequency = fraction + np.array(self.triple_fractions)
        share = triple_fraction(fraction, frequency)
        if self.gap_rule == "nearest":
            return np.asarray(share[self.rows(mass)])
        return np.asarray(0.01 * np.round(np.interp(np.log10(mass), self._centres, share) / 0.01))

    @property
    def _centres(self) -> FloatArray:
        """log10 of the middle mass of each row, in M_sun."""
        return np.log10([row.mass_lo * row.mass_hi for row in self.table]) / 2.0

    def _figures(self, mass: FloatArray) -> tuple[FloatArray, ...]:
        """Multiplicity fraction, exponent, log10 of the axis [au] and its scatter [dex] of each primary, (n,)."""
        rows = np.array([row[2:7] for row in self.table])[:, [0, 2, 3, 4]]
        rows[:, 2] = np.log10(rows[:, 2])
        if self.gap_rule == "nearest":
            return tuple(rows[self.rows(mass)].T)
        between = [np.interp(np.log10(mass), self._centres, column) for column in rows.T]
        steps = (0.001, 0.01, 0.001, 0.1)  # so that stars share what is computed once for all of a kind
        return tuple(step * np.round(column / step) for step, column in zip(steps, between, strict=True))

    def _unprojected(self, log_s: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and scatter of log10 of the semi-major axis behind those of separations on the sky."""
        shift, weight = orbit_nodes("uniform" if self.eccentricity == "mds17" else self.eccentricity, 0.0)
        mean = weight @ shift
        variance = weight @ (shift - mean) ** 2 + _VARIANCE_LOG_PROJECTION
        return log_s - mean - _MEAN_LOG_PROJECTION, np.sqrt(sigma**2 - variance)


@dataclass(frozen=True, slots=True, kw_only=True)
class Offner2023(_LogNormals):
    r"""Main-sequence multiplicity as compiled by Offner et al. (2023), for Protostars and Planets VII.

    Parameters
    ----------
    gap_rule : {"nearest", "interpolated"}
        What masses between rows take: the nearest row in log mass, or all masses values that are linear in log mass
        between the middles of rows.
    eccentricity : {"circular", "uniform", "thermal", "mds17"}
        Of the orbits; the compilation gives none.
    metallicity : {"none", "moe19"}
        Whether close pairs depend on metallicity.
    mass_ratio_min : float
        Least mass ratio, in (0, 1).
    triples : bool
        Whether multiple stars may be triples, see `hierarchy`.

    Notes
    -----
    Five rows from 0.075 to 2.4 M_sun: multiplicity fractions and companion frequencies of main-sequence companions
    above 0.075 M_sun; mass ratios :math:`q^\gamma`, which hold for 1 to 100 au [?]; log-normal axes.  0.15 to 0.30
    M_sun has no log-normal of its own: 10 au and 1.0 dex lie midway between its neighbours.  Nor has 1.6 to 2.4
    M_sun here, where that of the row below is taken; it matters above 1.26 M_sun alone.  Errors of the fractions are
    of the size that the surveys allow and those of axes half the difference to other compilations: neither is the
    paper's own [?].

    References
    ----------
    Offner2023
    """

    name: ClassVar[str] = "offner23"
    triple_fractions: ClassVar[tuple[float, ...] | None] = (0.022, 0.036, 0.063, 0.12, 0.25)
    table: ClassVar[tuple[Row, ...]] = (
        Row(0.075, 0.15, 0.19, 0.21, 1.7, 4.0, 0.7, RowErrors.of(0.03, 0.5, 0.15, 0.15)),
        Row(0.15, 0.30, 0.23, 0.27, 0.7, 10.0, 1.0, RowErrors.of(0.02, 0.3, 0.25, 0.15)),
        Row(0.30, 0.60, 0.30, 0.38, 0.1, 25.0, 1.3, RowErrors.of(0.02, 0.2, 0.15, 0.15)),
        Row(0.75, 1.25, 0.46, 0.60, 0.2, 40.0, 1.5, RowErrors.of(0.03, 0.2, 0.05, 0.10)),
        Row(1.60, 2.40, 0.68, 0.99, -1.3, 40.0, 1.5, RowErrors.of(0.07, 0.3, 0.20, 0.20)),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Raghavan2010(_LogNormals):
    r"""Multiplicity of solar-type stars within 25 pc by Raghavan et al. (2010).

    Parameters
    ----------
    gap_rule : {"nearest", "interpolated"}
        Without effect: there is one row.
    eccentricity : {"uniform", "circular", "thermal", "mds17"}
        Of the orbits; flat in the paper beyond periods of 12 days.
    metallicity : {"none", "moe19"}
        Whether close pairs depend on metallicity.
    mass_ratio_min : float
        Least mass ratio, in (0, 1).
    triples : bool
        Whether multiple stars may be triples, see `hierarchy`.

    Notes
    -----
    56 +- 2 % of 454 stars of F6 to K3 are single, 33 % double, 8 % triple, 3 % higher: a multiplicity fraction of 0.44
    and 0.58 companions to a star.  log10 of the period in days is normal with 5.03 and 2.28 [?]; with a total mass of
    1.5 M_sun, as in the paper, 50.5 au and 1.52 dex.  Mass ratios are flat but for twins; the exponent 0.3 +- 0.1 is
    the fit of Duchene & Kraus (2013) to this sample.  0.7 to 1.3 M_sun stands for the spectral types [?].  Errors of
    the axes are those of 2.28/sqrt(259 companions), rounded up.

    References
    ----------
    Raghavan2010, DucheneKraus2013
    """

    name: ClassVar[str] = "raghavan10"
    table: ClassVar[tuple[Row, ...]] = (
        Row(0.7, 1.3, 0.44, 0.58, 0.3, 50.5, 1.52, RowErrors.of(0.02, 0.1, 0.1, 0.07)),
    )
    eccentricity: Eccentricity = "uniform"


@dataclass(frozen=True, slots=True, kw_only=True)
class Winters2019(_LogNormals):
    r"""Multiplicity of M dwarfs within 25 pc by Winters et al. (2019).

    Parameters
    ----------
    gap_rule : {"nearest", "interpolated"}
        Without effect: there is one row.
    eccentricity : {"circular", "uniform", "thermal", "mds17"}
        Of the orbits; the paper gives none.
    metallicity : {"none", "moe19"}
        Whether close pairs depend on metallicity, which was not measured for M dwarfs.
    mass_ratio_min : float
        Least mass ratio, in (0, 1).
    triples : bool
        Whether multiple stars may be triples, see `hierarchy`.

    Notes
    -----
    Of 1120 M dwarfs 26.8 +- 1.4 % have companions, 32.4 +- 1.4 for 100.  Their projected separations are log-normal,
    20 au and 1.16 dex [?]: the semi-major axes behind them, for isotropic orbits, are 1.36 times larger where orbits
    are circles and have 0.18 dex taken off their scatter in quadrature.  For ``mds17`` the axes are those behind
    orbits of uniform eccentricity.  The paper gives no power law of mass ratios: that of Duchene & Kraus (2013) for
    these masses is taken.  Errors of the axes are half the distance to Susemiehl & Meyer (2022).

    References
    ----------
    Winters2019, DucheneKraus2013
    """

    name: ClassVar[str] = "winters19"
    table: ClassVar[tuple[Row, ...]] = (
        Row(0.075, 0.64, 0.268, 0.324, 0.4, 20.0, 1.16, RowErrors.of(0.014, 0.2, 0.1, 0.05)),
    )
    is_projected: ClassVar[bool] = True


@dataclass(frozen=True, slots=True, kw_only=True)
class SusemiehlMeyer2022(_LogNormals):
    r"""Log-normal orbits of M dwarfs by Susemiehl & Meyer (2022), and of FGK stars in the same way.

    Parameters
    ----------
    gap_rule : {"nearest", "interpolated"}
        As in `Offner2023`.
    eccentricity : {"circular", "uniform", "thermal", "mds17"}
        Of the orbits; the paper gives none.
    metallicity : {"none", "moe19"}
        Whether close pairs depend on metallicity.
    mass_ratio_min : float
        Least mass ratio, in (0, 1).
    triples : bool
        Whether multiple stars may be triples, see `hierarchy`.

    Notes
    -----
    M dwarfs: 0.229 +- 0.028 companions with q > 0.6 to a star, 0.462 (+0.057, -0.052) with q > 0.1, taken for the
    multiplicity fraction: mass ratios follow :math:`q^{0.25 \pm 0.29}` (Reggiani & Meyer 2013); log10 of the axis in
    au is normal with 1.43 and 1.21.  FGK stars: 1.70, 1.68 and 0.61 companions to a star [?]; the multiplicity
    fraction is that of Raghavan et al. (2010).  Masses stand for spectral types.  Errors of the axes: half the
    distance to Winters et al. (2019) and to Raghavan et al. (2010).

    References
    ----------
    Susemiehl2022, Reggiani2013, Raghavan2010
    """

    name: ClassVar[str] = "sm22"
    table: ClassVar[tuple[Row, ...]] = (
        Row(
            0.08, 0.60, 0.462, 0.462, 0.25, 10**1.43, 1.21,
            RowErrors((0.052, 0.057), (0.29, 0.29), (0.07, 0.07), (0.08, 0.08)),
        ),
        Row(0.60, 1.60, 0.44, 0.61, 0.25, 10**1.70, 1.68, RowErrors.of(0.02, 0.29, 0.05, 0.08)),
    )  # fmt: skip
