r"""Which stars a survey keeps: the probability that it rejects a system, by separation, flux ratio and magnitude.

A selection is averaged over the position angle of the pair.  At flux ratio 0, or separation 0, it says how often a
single star of that magnitude is rejected.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from scipy.special import ndtr

from porrima.errors import InputError
from porrima.rows import refuse_unless
from porrima.tables import load_table, named_columns, open_catalog

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = ["SHARP", "Combined", "Layer", "Selection", "SelectionTable", "probability_layer", "read_selection"]

SHARP = 1e-6
"""Relative width of an edge that has none of its own (dimensionless)."""

_AXES = ("magnitude", "contrast", "separation")
_OWN = {  # how a table may say how bright companions are: unit, rule and largest value
    "contrast": ("mag", "must be from 0 to 30 mag", 30.0),
    "flux_ratio": ("", "must be in [0, 1]", 1.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    r"""A selection, or a factor of one, on a grid of magnitude, flux ratio and separation.

    Parameters
    ----------
    score : (n_m, n_f, n_r) float array
        Linear in :math:`f/(1+f)^2` and in the square of the separation between the nodes; n_m is 1 where the
        magnitude does not matter.  Dimensionless.
    normal : bool
        Whether a system is rejected where a normal deviate is below the score; otherwise the score is the probability
        itself, in [0, 1].

    Notes
    -----
    A size and a shape change in proportion to :math:`f/(1+f)^2` and the square of the separation, so the score of a
    star rejected by its own is nearly exact between nodes, however sharp the edge.
    """

    score: FloatArray
    normal: bool

    @property
    def probability(self) -> FloatArray:
        """Of being rejected, at the nodes, (n_m, n_f, n_r), in [0, 1]."""
        return np.asarray(ndtr(self.score)) if self.normal else self.score


class Selection(Protocol):
    """Which systems a survey rejects."""

    def rejected(self, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray) -> FloatArray:
        """Probability to be rejected, in [0, 1], (n,) float array: of pairs in arcsec, flux ratio and mag."""

    def layers(
        self, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray
    ) -> tuple[Layer, ...]:
        """Factors of what is kept, on a grid: (n_r,) float array from 0 in arcsec, (n_f,) from 0, (n_m,) in mag."""


def probability_layer(
    selection: Selection, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray
) -> Layer:
    """A selection on a grid by its probability alone, for those that vary little from node to node.

    Parameters
    ----------
    selection : Selection
        Any.
    separation : (n_r,) float array
        From 0, in arcsec.
    flux_ratio : (n_f,) float array
        From 0 to 1, dimensionless.
    magnitude : (n_m,) float array
        In mag.

    Returns
    -------
    layer : Layer
        In [0, 1].
    """
    m, f, r = np.meshgrid(magnitude, flux_ratio, separation, indexing="ij")
    return Layer(score=selection.rejected(r, f, m), normal=False)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Combined:
    """Several selections at work, each in ignorance of the others: what is kept are the products of what each keeps.

    Parameters
    ----------
    parts : tuple of Selection
        One or more.
    """

    parts: tuple[Selection, ...]

    def rejected(self, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray) -> FloatArray:
        """Probability to be rejected by any.

        Parameters
        ----------
        separation, flux_ratio, magnitude : (n,) float array
            In arcsec, dimensionless and mag.

        Returns
        -------
        probability : (n,) float array
            In [0, 1].
        """
        kept = np.array(1.0)
        for part in self.parts:
            kept = kept * (1 - part.rejected(separation, flux_ratio, magnitude))
        return 1 - kept

    def layers(
        self, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray
    ) -> tuple[Layer, ...]:
        """The layers of all.

        Parameters
        ----------
        separation, flux_ratio, magnitude : (n_r,), (n_f,), (n_m,) float array
            In arcsec, dimensionless and mag.

        Returns
        -------
        layers : tuple of Layer
            Dimensionless.
        """
        return tuple(layer for part in self.parts for layer in part.layers(separation, flux_ratio, magnitude))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SelectionTable:
    r"""Probability to be rejected, on a whole grid.

    Parameters
    ----------
    separation : (n_r,) float array
        Ascending, in arcsec, positive.
    contrast : (n_c,) float array
        Ascending: magnitude of the companion minus that of the primary, in mag, not negative.
    magnitude : (n_m,) float array
        Ascending, of the system, in mag; one alone serves stars of all magnitudes.
    probability : (n_m, n_c, n_r) float array
        In [0, 1].
    single : (n_m,) float array
        Of single stars, in [0, 1].

    Notes
    -----
    Linear in the logarithm of the separation, contrast and magnitude; in the square of the separation from the
    nearest tabulated down to 0, and in the flux ratio from the largest contrast down to 0, both from there to that of
    a single star; constant beyond the other ends.
    """

    separation: FloatArray
    contrast: FloatArray
    magnitude: FloatArray
    probability: FloatArray
    single: FloatArray

    def rejected(self, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray) -> FloatArray:
        """Probability to be rejected.

        Parameters
        ----------
        separation, flux_ratio, magnitude : (n,) float array
            In arcsec, dimensionless and mag.

        Returns
        -------
        probability : (n,) float array
            In [0, 1].

        Raises
        ------
        InputError
            If a magnitude lies outside those of the table.
        """
        r, f, m = np.broadcast_arrays(separation, flux_ratio, magnitude)
        if self.magnitude.size > 1 and m.size:
            low, high = self.magnitude[[0, -1]]
            for value in (m.min(), m.max()):
                if not low - 1e-9 <= value <= high + 1e-9:
                    raise InputError(
                        f"must cover the stars: it reaches from magnitude {low:g} to {high:g}",
                        key="selection", value=f"a star of {value:.4g}",
                    )  # fmt: skip
        least = 10 ** (-0.4 * self.contrast[-1])
        contrast = -2.5 * np.log10(np.maximum(f, least))
        near = np.maximum(r, self.separation[0])
        pair = self._between(m, contrast, np.log(near))
        single = np.interp(m, self.magnitude, self.single)
        share = np.minimum(f / least, 1.0) * np.minimum(r / self.separation[0], 1.0) ** 2
        return np.asarray(single + share * (pair - single))

    def _between(self, magnitude: FloatArray, contrast: FloatArray, log_separation: FloatArray) -> FloatArray:
        """Linear between the nodes of the grid."""
        places = [
            _place(self.magnitude, magnitude),
            _place(self.contrast, contrast),
            _place(np.log(self.separation), log_separation),
        ]
        found = np.zeros(np.shape(magnitude))
        for corner in range(8):
            weight, index = np.ones(found.shape), []
            for axis, (low, upper) in enumerate(places):
                is_upper = corner >> axis & 1
                weight = weight * (upper if is_upper else 1 - upper)
                index.append(np.minimum(low + is_upper, self.probability.shape[axis] - 1))
            found += weight * self.probability[tuple(index)]
        return found

    def layers(
        self, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray
    ) -> tuple[Layer, ...]:
        """The table on another grid.

        Parameters
        ----------
        separation, flux_ratio, magnitude : (n_r,), (n_f,), (n_m,) float array
            In arcsec, dimensionless and mag.

        Returns
        -------
        layers : tuple of Layer
            One, in [0, 1].
        """
        some = magnitude if self.magnitude.size > 1 else magnitude[:1]
        return (probability_layer(self, separation, flux_ratio, some),)


def _place(nodes: FloatArray, value: FloatArray) -> tuple[IntArray, FloatArray]:
    """Lower node of each value and the weight of the upper one; constant beyond the ends."""
    low = np.clip(np.searchsorted(nodes, value, side="right") - 1, 0, max(nodes.size - 2, 0))
    if nodes.size == 1:
        return low, np.zeros(np.shape(value))
    return low, np.clip((value - nodes[low]) / (nodes[low + 1] - nodes[low]), 0.0, 1.0)


def read_selection(path: Path) -> SelectionTable:
    """Selection from a table of the user's own.

    Parameters
    ----------
    path : Path
        Any table that astropy reads, with columns ``separation`` [arcsec], ``contrast`` [mag] or ``flux_ratio``,
        ``probability`` to be rejected and, optionally, ``magnitude``.  One row for each combination of the values in
        it; rows of separation 0 or flux ratio 0 are for single stars, one for each magnitude, who are never rejected
        where there are none.

    Returns
    -------
    selection : SelectionTable
        In arcsec and mag.

    Raises
    ------
    InputError
        If a column is missing, a value breaks its rule, or the grid has gaps: names row or column.
    """
    table, row = load_table(open_catalog(path, {}, None))
    own = next((name for name in _OWN if name in table.colnames), " or ".join(_OWN))
    unit, rule, largest = _OWN.get(own, _OWN["contrast"])
    needed = {"separation": "arcsec", own: unit, "probability": ""}
    values = named_columns(path, table, row, needed, {"magnitude": "mag"})
    values.setdefault("magnitude", np.zeros(len(table)))
    _refuse_dimensional(path, table, own)
    r, p, m, c = (values[name] for name in ("separation", "probability", "magnitude", own))
    rules = [
        ("separation", "must be from 0 to 10 arcsec", (r >= 0) & (r <= 10)),
        (own, rule, (c >= 0) & (c <= largest)),
        ("magnitude", "must be finite", np.isfinite(m)),
        ("probability", "must be in [0, 1]", (p >= 0) & (p <= 1)),
    ]
    refuse_unless(path, row, values, rules)
    single = (r == 0) | ((c == 0) & (own == "flux_ratio"))
    contrast = c if own == "contrast" else -2.5 * np.log10(np.where(single, 1.0, c)) + 0.0
    return _gridded(path, {"separation": r, "contrast": contrast, "magnitude": m}, p, row, single)


def _refuse_dimensional(path: Path, table: object, own: str) -> None:
    """Stop at a unit where there must be none."""
    for name in {"probability", own} - {"contrast"}:
        unit = getattr(table[name], "unit", None)  # type: ignore[index]
        if unit is not None and str(unit) != "":
            raise InputError("must be dimensionless", source=path, column=name, value=unit)


def _gridded(
    path: Path, axes: dict[str, FloatArray], probability: FloatArray, row: IntArray, single: FloatArray
) -> SelectionTable:
    """The grid that rows fill, each place once."""
    pairs = ~single.astype(bool)
    if not pairs.any():
        raise InputError("must have rows of pairs, with separation and flux ratio above 0", source=path)
    nodes = {name: np.unique(axes[name][pairs].round(9)) for name in _AXES}
    number = [np.searchsorted(nodes[name], axes[name].round(9)) for name in _AXES]
    grid = np.full([nodes[name].size for name in _AXES], np.nan)
    alone = np.full(nodes["magnitude"].size, np.nan)
    for k in range(row.size):
        m, c, r = (n[k] for n in number)
        if m >= alone.size or nodes["magnitude"][m] != axes["magnitude"][k].round(9):
            rule, value = "must be a magnitude of pairs, too", axes["magnitude"][k]
            raise InputError(rule, source=path, row=int(row[k]), column="magnitude", value=value)
        line = grid[m, c] if pairs[k] else alone
        at = r if pairs[k] else m
        if not np.isnan(line[at]):
            raise InputError("stands twice in the grid", source=path, row=int(row[k]))
        line[at] = probability[k]
    gaps = np.argwhere(np.isnan(grid))
    if gaps.size:
        named = [
            (name, i) for name, i in zip(_AXES, gaps[0], strict=True) if name != "magnitude" or alone.size > 1
        ]
        where = ", ".join(f"{name} {nodes[name][i]:g}" for name, i in named)
        raise InputError("must have a row for each combination", source=path, value=f"none for {where}")
    if np.isnan(alone).any() and not np.isnan(alone).all():
        where = f"none for magnitude {nodes['magnitude'][int(np.argmax(np.isnan(alone)))]:g}"
        raise InputError("must have a row of single stars for each magnitude", source=path, value=where)
    return SelectionTable(
        separation=nodes["separation"],
        contrast=nodes["contrast"],
        magnitude=nodes["magnitude"],
        probability=grid,
        single=np.nan_to_num(alone),
    )
