r"""Triple stars: how many multiple stars are one, and which star goes round which.

A triple is two independent draws of its star's law of pairs, each a mass ratio and a semi-major axis, made again
together until the hierarchy is stable.  The wider orbit is the outer one.  Orbits of one lognormal law, subject to
stability, reproduce the periods of hierarchies (Tokovinin 2014).
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np

from porrima.companions import CompanionLaw

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = [
    "INNER_AROUND_PRIMARY", "STABLE_EXPONENT", "STABLE_RATIO", "members", "triple_fraction", "with_triples",
]  # fmt: skip

INNER_AROUND_PRIMARY = 0.55
"""Probability that the inner pair holds the primary, (A,B)-C, and not the two companions, A-(B,C).

Subsystems of the secondary are almost as frequent as those of the primary, and half of the former come with one of the
latter (Tokovinin 2014): 5 of 9 systems with one subsystem have it around the primary, if both kinds are about as
frequent [?].
"""

STABLE_RATIO, STABLE_EXPONENT = 2.8, 0.4
"""A triple of circular orbits is stable where the outer semi-major axis over the inner one is above 2.8 (1 +
m_3/(m_1 + m_2))^0.4 (Mardling & Aarseth 2001, coplanar, which is the strictest case)."""

_LEAST_SCATTER = 0.2
"""Least scatter of log10 of a star's semi-major axes in dex: with it one of fifteen pairs of draws is stable."""


def triple_fraction(multiplicity_fraction: FloatArray, companion_frequency: FloatArray) -> FloatArray:
    """Share of triples among multiple stars, from how many stars have companions and how many these are.

    Parameters
    ----------
    multiplicity_fraction : (n,) float array
        Stars with a companion among all, in [0, 1].
    companion_frequency : (n,) float array
        Companions to a star, dimensionless.

    Returns
    -------
    share : (n,) float array
        In [0, 1].

    Raises
    ------
    ValueError
        If there are fewer companions than stars that have one.

    Notes
    -----
    min(CF - MF, MF)/MF: quadruple and higher systems count as triples, with as many companions in all.
    """
    few = companion_frequency < multiplicity_fraction
    if np.any(few):
        raise ValueError(
            f"companion_frequency must be at least multiplicity_fraction = {multiplicity_fraction[few][0]:g}, "
            f"got {companion_frequency[few][0]:g}"
        )
    more = np.minimum(companion_frequency - multiplicity_fraction, multiplicity_fraction)
    share: FloatArray = np.divide(more, multiplicity_fraction, out=np.zeros_like(more), where=more > 0)
    return share


def with_triples(law: CompanionLaw, share: FloatArray) -> CompanionLaw:
    """The law with some of the pairs made triples.

    Parameters
    ----------
    law : CompanionLaw
        Of pairs, m classes of n stars.
    share : (n,) float array
        Of triples among the multiple stars of each kind, in [0, 1].

    Returns
    -------
    law : CompanionLaw
        After the classes of a star come the same again, of which a triple takes two.  The fraction of stars that are
        multiple stays.  Axes in log10 au.

    Raises
    ------
    ValueError
        If a share lies outside [0, 1], or the orbits of a star are too alike for a stable hierarchy.

    References
    ----------
    Tokovinin2014, Mardling2001
    """
    wrong = ~((share >= 0) & (share <= 1))
    if np.any(wrong):
        raise ValueError(f"share of triples must be in [0, 1], got {share[wrong][0]:g}")
    mean = np.bincount(law.star, law.share * law.log_a)[law.star]
    variance = np.bincount(law.star, law.share * (law.log_a_sigma**2 + (law.log_a - mean) ** 2))
    alike = (share > 0) & (variance < _LEAST_SCATTER**2)
    if np.any(alike):
        raise ValueError(
            f"scatter of log10 of the semi-major axis must be at least {_LEAST_SCATTER:g} dex for stable triples, "
            f"got {np.sqrt(variance[alike][0]):.3g}"
        )
    again = np.flatnonzero(share[law.star] > 0)
    rows = np.concatenate([np.arange(law.star.size), again])
    is_triple = np.arange(rows.size) >= law.star.size
    order = np.lexsort((is_triple, law.star[rows]))
    both = CompanionLaw(**{f.name: getattr(law, f.name)[rows[order]] for f in fields(law)})
    is_triple, part = is_triple[order], share[both.star]
    return replace(both, share=both.share * np.where(is_triple, part, 1.0 - part), is_triple=is_triple)


def members(law: CompanionLaw) -> tuple[IntArray, IntArray]:
    """Classes of which a triple takes two: the first of its star, and how many there are.

    Parameters
    ----------
    law : CompanionLaw
        Of m classes.

    Returns
    -------
    first, count : (m,) int array
        Numbers of rows (count); 0 and 0 for classes of pairs.
    """
    of_triples = np.flatnonzero(law.is_triple)
    star, start, size = np.unique(law.star[of_triples], return_index=True, return_counts=True)
    first, count = np.zeros(law.star.size, np.int64), np.zeros(law.star.size, np.int64)
    where = np.searchsorted(star, law.star[of_triples])
    first[of_triples], count[of_triples] = of_triples[start][where], size[where]
    return first, count
