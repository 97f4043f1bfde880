"""The paper's two tables and the sketch of a pair: as printed, and as Porrima has them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import xarray as xr

from porrima.psf import TABLE_2, TABLE_2_FWHM, psf_from_name
from porrima.response import response
from porrima.shapes import Adaptive

if TYPE_CHECKING:
    from collections.abc import Mapping

    from porrima.multiplicity import MultiplicityModel

    Parts = dict[str, xr.Dataset]

__all__ = ["TABLE_1", "PrintedRow", "multiplicity_table", "pair_sketch", "psf_table"]


class PrintedRow(NamedTuple):
    """One row of KCM16 Table 1 with its errors, masses in M_sun, mean separation in au, scatter in dex; NaN: none."""

    mass_lo: float
    mass_hi: float
    multiplicity_fraction: float
    multiplicity_fraction_down: float
    multiplicity_fraction_up: float
    companion_frequency: float
    companion_frequency_error: float
    mass_ratio_exponent: float
    mass_ratio_exponent_error: float
    mean_separation: float
    scatter_log_period: float


TABLE_1 = (
    PrintedRow(0.0, 0.1, 0.22, 0.04, 0.06, 0.22, 0.05, 4.2, 1.0, 4.5, 0.5),
    PrintedRow(0.1, 0.5, 0.26, 0.03, 0.03, 0.33, 0.05, 0.4, 0.2, 5.3, 1.3),
    PrintedRow(0.7, 1.3, 0.44, 0.02, 0.02, 0.62, 0.03, 0.3, 0.1, 45.0, 2.3),
    PrintedRow(1.5, 5.0, 0.50, 0.00, math.inf, 1.00, 0.10, -0.5, 0.2, math.nan, math.nan),
)
"""KCM16 Table 1.  The last row has two peaks, at 10 d and 350 au; its multiplicity fraction is a lower limit."""

_GAPS = ((0.5, 0.7), (1.3, 1.5))  # M_sun, between the rows
PRINTED_ANGLES = {"psf0": 0.0, "psf1": 88.4, "psf2": 145.5}
"""Position angles of KCM16 Table 2, in deg."""

_SKETCH = {"flux_ratio": 0.5, "dx": 0.036, "dy": 0.024}  # a pair to look at, arcsec


def multiplicity_table(models: Mapping[str, MultiplicityModel]) -> Parts:
    """Multiplicity by mass as the paper prints it, and as models read it, the gaps between its rows included.

    Parameters
    ----------
    models : dict
        Readings of the table by name.

    Returns
    -------
    parts : dict
        ``table`` over ``row``, in the order of mass: the fields of `PrintedRow`, NaN in gaps, and over ``model``
        besides what each model takes in the middle of the row: ``read_multiplicity_fraction``,
        ``read_mass_ratio_exponent``, ``read_separation`` [au], ``read_scatter_log_a`` and ``read_largest_separation``
        [au], NaN where it has none.  ``findings``: how many rows there are.

    References
    ----------
    KCM16, DucheneKraus2013
    """
    blank = PrintedRow(*[math.nan] * len(PrintedRow._fields))
    rows = sorted([*TABLE_1, *(blank._replace(mass_lo=lo, mass_hi=hi) for lo, hi in _GAPS)])
    names = (
        "multiplicity_fraction",
        "mass_ratio_exponent",
        "separation",
        "scatter_log_a",
        "largest_separation",
    )
    read = np.full((len(names), len(models), len(rows)), np.nan)
    for i, model in enumerate(models.values()):
        for k, row in enumerate(rows):
            middle = 0.5 * (row.mass_lo + row.mass_hi)
            if model.mass_range[0] <= row.mass_lo and row.mass_hi <= model.mass_range[1]:
                law = model.companions(np.array([middle]))
                a, most = 10 ** law.log_a[0], 10 ** law.log_a_max[0]
                read[:, i, k] = (law.multiplicity_fraction[0], law.mass_ratio_exponent[0], a, law.log_a_sigma[0],
                                 most if math.isfinite(most) else math.nan)  # fmt: skip
    printed = {field: ("row", [getattr(row, field) for row in rows]) for field in PrintedRow._fields}
    table = xr.Dataset(
        printed | {f"read_{name}": (("model", "row"), read[n]) for n, name in enumerate(names)},
        coords={"model": list(models)},
    )
    return {"table": table, "findings": xr.Dataset({"n_rows": float(len(rows))})}


def psf_table() -> Parts:
    r"""Shapes of the paper's PSFs as printed and as they are.

    Returns
    -------
    parts : dict
        ``table`` over ``psf``: ``e1``, ``e2`` and ``angle_printed`` [deg] of KCM16 Table 2; ``e`` and ``angle`` [deg]
        that follow from them, :math:`\frac12 \mathrm{atan2}(e_2, e_1)` in [0, 180); ``fwhm_printed`` and ``fwhm``
        [arcsec]; ``e1_measured``, ``e2_measured`` and ``r2_0`` [arcsec²] by adaptive moments, of the Gaussian PSF, and
        ``r2_0_optical`` of the diffraction-limited one of that shape.  ``findings``: ``turned``, least and
        ``most_turned``, largest difference of the printed angles of elliptical PSFs from those that follow [deg].

    References
    ----------
    KCM16, Hirata2003
    """
    names = [f"psf{number}" for number in TABLE_2]
    e1, e2 = np.array(list(TABLE_2.values())).T
    psfs = [psf_from_name(name) for name in names]
    shapes = [response(psf, Adaptive()).shape0 for psf in psfs]
    optical = [response(psf_from_name(f"optical{number}"), Adaptive()).shape0 for number in TABLE_2]
    angle = np.degrees(0.5 * np.arctan2(e2, e1)) % 180.0
    printed = np.array([PRINTED_ANGLES[name] for name in names])
    turned = (printed - angle) % 180.0
    columns = {
        "e1": e1, "e2": e2, "e": np.hypot(e1, e2), "angle_printed": printed, "angle": angle,
        "fwhm_printed": np.full(len(names), TABLE_2_FWHM), "fwhm": np.array([psf.fwhm for psf in psfs]),
        "e1_measured": np.array([float(s.e1) for s in shapes]), "e2_measured": np.array([float(s.e2) for s in shapes]),
        "r2_0": np.array([float(s.r2) for s in shapes]), "r2_0_optical": np.array([float(s.r2) for s in optical]),
    }  # fmt: skip
    elliptical = np.hypot(e1, e2) > 0
    return {
        "table": xr.Dataset(
            {name: ("psf", values) for name, values in columns.items()}, coords={"psf": names}
        ),
        "findings": xr.Dataset({"turned": turned[elliptical].min(), "most_turned": turned[elliptical].max()}),
    }


def pair_sketch() -> Parts:
    r"""A pair with the symbols of KCM16 Fig. 2: where its stars and its photocentre are.

    Returns
    -------
    parts : dict
        ``points`` over ``point`` (primary, companion, photocentre): ``x`` and ``y`` from the primary [arcsec] and
        ``flux`` over that of the primary.  ``findings``: ``flux_ratio``, ``dx``, ``dy`` and ``separation`` [arcsec],
        ``shift``, of the photocentre from the primary [arcsec], and ``x_second``, :math:`f r^2/(1+f)^2` [arcsec²].

    References
    ----------
    KCM16
    """
    f, dx, dy = _SKETCH.values()
    share = f / (1 + f)
    points = xr.Dataset(
        {
            "x": ("point", [0.0, dx, share * dx]),
            "y": ("point", [0.0, dy, share * dy]),
            "flux": ("point", [1.0, f, 1.0 + f]),
        },
        coords={"point": ["primary", "companion", "photocentre"]},
    )
    r = math.hypot(dx, dy)
    found = {**_SKETCH, "separation": r, "shift": share * r, "x_second": share * r**2 / (1 + f)}
    return {"points": points, "findings": xr.Dataset(found)}
