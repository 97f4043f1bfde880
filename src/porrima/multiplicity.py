"""How many stars have a companion, how massive it is, how wide its orbit: models by name.

`DucheneKraus2013`, what KCM16 use, is here; those of other papers are in `published` and `moe`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from porrima.companions import CompanionLaw, MultiplicityModel, RowErrors, check_option, multiplicity_scale
from porrima.eccentricity import Eccentricity, eccentric
from porrima.hierarchy import triple_fraction, with_triples
from porrima.moe import MoeDiStefano2017
from porrima.photometry import check_masses
from porrima.published import Offner2023, Raghavan2010, SusemiehlMeyer2022, Winters2019

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.orbits import Projection

    FloatArray = NDArray[np.float64]

__all__ = [
    "COMPILATIONS",
    "MULTIPLICITY",
    "PAPERS",
    "CompanionLaw",
    "DucheneKraus2013",
    "MultiplicityModel",
    "multiplicity_scale",
]  # fmt: skip


class _Row(NamedTuple):
    """One row of KCM16 Table 1."""

    mass_lo: float  # M_sun, inclusive
    mass_hi: float  # M_sun, exclusive
    multiplicity_fraction: float
    mass_ratio_exponent: float
    a_mean: float  # au
    sigma_log_period: float  # dex in days
    companion_frequency: float  # companions to a star


_VERY_LOW = _Row(0.0, 0.1, 0.22, 4.2, 4.5, 0.5, 0.22)
_LOW = _Row(0.1, 0.5, 0.26, 0.4, 5.3, 1.3, 0.33)
_SOLAR = _Row(0.7, 1.3, 0.44, 0.3, 45.0, 2.3, 0.62)


ROW_ERRORS = (
    RowErrors((0.04, 0.06), (1.0, 1.0), (0.05, 0.05), (0.25, 0.25)),
    RowErrors((0.03, 0.03), (0.2, 0.2), (0.30, 0.30), (0.25, 0.25)),
    RowErrors((0.02, 0.02), (0.1, 0.1), (0.05, 0.05), (0.10, 0.10)),
)
"""Below 0.1, 0.1-0.5 and about 1 M_sun.  Multiplicity fractions and exponents as published (Duchene & Kraus 2013);
they give no error of mean separations and widths: half the distance to the later compilations is taken (Winters et
al. 2019: 20 au; Susemiehl & Meyer 2022: 27 and 50 au; Offner et al. 2023: 4, 25 and 40 au and their widths)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DucheneKraus2013:
    r"""Multiplicity of main-sequence stars as compiled by Duchene & Kraus (2013), KCM16 Table 1.

    Parameters
    ----------
    gap_rule : {"lower", "solar"}
        What the masses between the rows take (0.5-0.7 and 1.3-1.5 M_sun): the next lower row, as KCM16
        Sect. 4.3 says, or the row of solar-type stars, as the authors' code of 2017 does.
    a_max_factor : float, optional
        Largest semi-major axis over the mean :math:`\bar a`; None for the full log-normal.
    scatter_scale : float
        Factor on the scatter of log period, dimensionless.  The code of 2017 amounts to 1/(ln 10)^2.
    projection : {"isotropic", "inclination-uniform"}
        Isotropic orbits, or KCM16's literal text (inclination uniform in angle), which raises eta by 2-5 %,
        and by up to 12 % where orbits are truncated.
    mass_ratio_min : float
        Least mass ratio, in (0, 1).
    eccentricity : {"circular", "uniform", "thermal", "mds17"}
        Of the orbits; KCM16 take circles.
    triples : bool
        Whether multiple stars may be triples, as many as there are companions beyond the first; KCM16 have pairs only.

    Raises
    ------
    ValueError
        If an option is outside its range.

    Notes
    -----
    Rows are half-open, [lo, hi); a star of exactly 1.5 M_sun, the largest that KCM16 keep, takes the
    values of the row below.  The mass ratio follows :math:`dN/dq \propto q^\gamma` on
    [mass_ratio_min, 1].  log10 of the period is normal with :math:`\sigma_{\log P}`, so by Kepler's third
    law log10 of the semi-major axis is normal about :math:`\log_{10}\bar a` with
    :math:`\frac{2}{3}\sigma_{\log P}`, independent of the mass ratio.  A truncation redraws the
    semi-major axis alone.  Without `triples` higher orders are left out, which is
    optimistic; with it see `hierarchy`.

    References
    ----------
    DucheneKraus2013, KCM16
    """

    gap_rule: Literal["lower", "solar"] = "lower"
    a_max_factor: float | None = None
    scatter_scale: float = 1.0
    projection: Projection = "isotropic"
    mass_ratio_min: float = 0.1
    eccentricity: Eccentricity = "circular"
    triples: bool = False

    def __post_init__(self) -> None:
        if self.gap_rule not in ("lower", "solar"):
            raise ValueError(f"gap_rule must be lower or solar, got {self.gap_rule}")
        if self.projection not in ("isotropic", "inclination-uniform"):
            raise ValueError(f"projection must be isotropic or inclination-uniform, got {self.projection}")
        if self.a_max_factor is not None and not (0 < self.a_max_factor < math.inf):
            raise ValueError(f"a_max_factor must be positive and finite, got {self.a_max_factor}")
        if not 0 < self.scatter_scale < math.inf:
            raise ValueError(f"scatter_scale must be positive and finite, got {self.scatter_scale}")
        if not 0 < self.mass_ratio_min < 1:
            raise ValueError(f"mass_ratio_min must be in (0, 1), got {self.mass_ratio_min}")
        check_option("eccentricity", self.eccentricity, Eccentricity)

    @property
    def mass_range(self) -> tuple[float, float]:
        """Least and largest mass of a primary, in M_sun; KCM16 give no widths above 1.5."""
        return (0.0, 1.5)

    @property
    def row_errors(self) -> tuple[RowErrors, ...]:
        """Errors of each row: `ROW_ERRORS`, those of the scatter on its scale."""
        scale = self.scatter_scale
        return tuple(
            row._replace(sigma_log_period=(scale * row.sigma_log_period[0], scale * row.sigma_log_period[1]))
            for row in ROW_ERRORS
        )

    @property
    def choices(self) -> dict[str, Any]:
        """The gap rule and the projection, each the other way."""
        projections = {"isotropic": "inclination-uniform", "inclination-uniform": "isotropic"}
        return {
            "gap_rule": {"lower": "solar", "solar": "lower"}[self.gap_rule],
            "projection": projections[self.projection],
        }

    def rows(self, mass: FloatArray) -> NDArray[np.int64]:
        """Row of the table that each primary takes, the masses between rows by the gap rule.

        Parameters
        ----------
        mass : (n,) float array
            Mass of the primary, in M_sun.

        Returns
        -------
        row : (n,) int array
            0 below 0.1 M_sun, 1 for 0.1-0.5, 2 for solar-type stars.
        """
        solar_from = _SOLAR.mass_lo if self.gap_rule == "lower" else _LOW.mass_hi
        return np.where(mass < _VERY_LOW.mass_hi, 0, np.where(mass < solar_from, 1, 2))

    def companions(self, mass: FloatArray, metallicity: FloatArray | None = None) -> CompanionLaw:
        r"""Companion statistics of each primary.

        Parameters
        ----------
        mass : (n,) float array
            Mass of the primary, in M_sun.
        metallicity : (n,) float array, optional
            [M/H], in dex; without effect.

        Returns
        -------
        law : CompanionLaw
            One class for each star, or one for each node of the eccentricity: axes in log10 au, scatter in dex.

        Raises
        ------
        ValueError
            If a mass lies outside `mass_range`.
        """
        check_masses(mass, self.mass_range, "Duchene & Kraus (2013)")
        table = np.array([_VERY_LOW, _LOW, _SOLAR])[self.rows(mass)]
        log_a = np.log10(table[:, 4])
        beyond = math.inf if self.a_max_factor is None else math.log10(self.a_max_factor)
        law = CompanionLaw(
            star=np.arange(mass.size),
            share=np.ones(mass.shape),
            multiplicity_fraction=table[:, 2],
            mass_ratio_exponent=table[:, 3],
            mass_ratio_min=np.full(mass.shape, self.mass_ratio_min),
            mass_ratio_max=np.ones(mass.shape),
            log_a=log_a,
            log_a_sigma=2.0 / 3.0 * self.scatter_scale * table[:, 5],
            log_a_max=log_a + beyond,
            mass_ratio=np.full(mass.shape, np.nan),
        )
        law = eccentric(law, mass, self.eccentricity)
        return with_triples(law, triple_fraction(table[:, 2], table[:, 6])) if self.triples else law


MULTIPLICITY: dict[str, MultiplicityModel] = {
    "dk13": DucheneKraus2013(),
    "dk13-kcm16": DucheneKraus2013(gap_rule="solar", a_max_factor=2.5),
    "offner23": Offner2023(),
    "raghavan10": Raghavan2010(),
    "winters19": Winters2019(),
    "sm22": SusemiehlMeyer2022(),
    "mds17": MoeDiStefano2017(),
    "modern": Offner2023(gap_rule="interpolated", eccentricity="mds17", metallicity="moe19"),
}
"""Models by name; ``dk13-kcm16`` is the variant that reproduces the magnitude dependence of KCM16, ``modern`` what is
known today: the figures of Offner et al. (2023) without steps, eccentric orbits, close pairs by metallicity."""

PAPERS = {
    "dk13": "Duchene & Kraus 2013",
    "dk13-kcm16": "Duchene & Kraus 2013",
    "offner23": "Offner et al. 2023",
    "raghavan10": "Raghavan et al. 2010",
    "winters19": "Winters et al. 2019",
    "sm22": "Susemiehl & Meyer 2022",
    "mds17": "Moe & Di Stefano 2017",
    "modern": "Offner et al. 2023, Moe & Di Stefano 2017, Moe et al. 2019",
}
"""What a model asks to be cited, by its name."""

COMPILATIONS = ("dk13", "offner23", "sm22", "modern")
"""Those that hold for the masses of nearly all stars: what they differ by is the spread between models."""
