r"""Responses of many PSFs and estimators side by side: what a survey's PSF makes of the same companions.

:math:`\kappa = \delta R^2 / (R_0^2 \eta)` for an isotropic population, r → 0; 1 in the formulae of KCM16.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from porrima import figures
from porrima.errors import InputError
from porrima.files import make_folder, write_whole
from porrima.io import write_rows
from porrima.moments import INDICES
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.shapes import estimator_from_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from porrima.response import Response

__all__ = ["COLUMNS", "expanded", "grouped", "responses", "row", "shown", "table", "write_responses"]

ROMAN_BANDS = ("Y106", "J129", "H158", "F184")
"""Bands of ``roman`` without more words: those of the weak-lensing survey."""

ROUND = 0.003
"""Ellipticity below which a PSF is round: the ratio of its response says nothing (dimensionless)."""

COLUMNS = ["psf", "estimator", "r2_0", "e1_0", "e2_0", "kappa_r2", "de1_deta", "de2_deta", "kappa_e"]
"""Keys of `row`."""

ROMAN_DETECTORS = tuple(f"SCA{n:02d}" for n in range(1, 19))


def expanded(names: Iterable[str]) -> list[str]:
    """Names of single PSFs.

    Parameters
    ----------
    names : iterable of str
        As `psf_from_name` takes them; ``roman`` stands for all 18 detectors in the four bands of
        `ROMAN_BANDS`, ``roman:BAND`` for all detectors in one band.

    Returns
    -------
    names : list of str
        In the order given.
    """
    found: list[str] = []
    for name in names:
        kind, *rest = name.split(":")
        if kind != "roman" or len(rest) > 1:
            found.append(name)
        else:
            found += [f"roman:{band}:{sca}" for band in rest or ROMAN_BANDS for sca in ROMAN_DETECTORS]
    return found


def responses(
    psfs: Iterable[str],
    estimators: Iterable[str],
    progress: Callable[[int], None] = lambda _: None,
    **options: Any,
) -> list[Response]:
    """Responses of every estimator behind every PSF.

    Parameters
    ----------
    psfs : iterable of str
        Names, from `expanded`.
    estimators : iterable of str
        Names, as `estimator_from_name` takes them.
    progress : callable
        Called with 1 for each response.
    **options : float or None
        Of `psf_from_name`, such as ``pixel``, in arcsec.

    Returns
    -------
    responses : list of Response
        PSF by PSF.

    Raises
    ------
    InputError
        If a name is unknown, or a PSF has no shape under an estimator.
    """
    kinds = [estimator_from_name(name) for name in estimators]
    found = []
    for name in psfs:
        psf = psf_from_name(name, **options)
        for estimator in kinds:
            try:
                found.append(response(psf, estimator))
            except InputError:
                raise
            except ValueError as error:
                raise InputError(str(error), key="psf", value=name) from None
            progress(1)
    return found


def row(found: Response) -> dict[str, Any]:
    r"""Shape of a PSF and its response to an isotropic population.

    Parameters
    ----------
    found : Response
        Of one PSF and estimator.

    Returns
    -------
    row : dict
        ``psf``, ``estimator``, ``r2_0`` [arcsec²], ``e1_0``, ``e2_0``, ``kappa_r2``, ``de1_deta``, ``de2_deta``
        and ``kappa_e``, the response of the ellipticity over that of the formulae of KCM16,
        :math:`-\delta e \cdot e_0 / (e_0^2 \eta)`.
    """
    shape = found.shape0
    e1, e2 = float(shape.e1), float(shape.e2)
    along = -(found.de1_deta * e1 + found.de2_deta * e2)
    e2_total = e1 * e1 + e2 * e2
    return {
        "psf": found.psf,
        "estimator": found.estimator,
        "r2_0": float(shape.r2),
        "e1_0": e1,
        "e2_0": e2,
        "kappa_r2": found.kappa_r2,
        "de1_deta": found.de1_deta,
        "de2_deta": found.de2_deta,
        "kappa_e": along / e2_total if e2_total > ROUND**2 else None,
    }


def table(found: Response) -> list[dict[str, Any]]:
    """All derivatives of a response.

    Parameters
    ----------
    found : Response
        Of one PSF and estimator.

    Returns
    -------
    derivatives : list of dict
        One for each kernel moment, ``moment`` such as m20, and ``order``, with the first derivatives ``de1``,
        ``de2`` [arcsec^-order] and ``dr2`` [arcsec^(2-order)].
    """
    return [
        {
            "moment": f"m{a}{b}",
            "order": a + b,
            **{name: float(found.first[k, i]) for k, name in enumerate(("de1", "de2", "dr2"))},
        }
        for i, (a, b) in enumerate(INDICES)
    ]


def shown(found: list[Response]) -> dict[str, Any]:
    """What `porrima response` prints.

    Parameters
    ----------
    found : list of Response
        One or more.

    Returns
    -------
    result : dict
        `row` and ``derivatives`` of the only one, or ``responses``, a list of such.
    """
    rows = [row(one) | {"derivatives": table(one)} for one in found]
    return rows[0] if len(rows) == 1 else {"responses": rows}


def grouped(one: dict[str, Any]) -> dict[str, Any]:
    """Row with its place in the figure.

    Parameters
    ----------
    one : dict
        From `row`.

    Returns
    -------
    row : dict
        With ``group``, the PSF, where detectors of one Roman band are together and a file goes by its last
        name, and ``kind``, the estimator, where plain moments are together whatever their aperture.
    """
    name, _, added = one["psf"].partition(", ")
    if name.startswith("roman:"):
        name = ":".join(name.split(":")[:2])
    group = ", ".join(part for part in (name.rsplit("/", 1)[-1], added) if part)
    kind = "plain" if one["estimator"].startswith("plain") else one["estimator"]
    return one | {"group": group, "kind": kind}


def write_responses(found: list[Response], folder: Path) -> None:
    """Table and figure of responses, written to a folder.

    Parameters
    ----------
    found : list of Response
        As `responses` gives them.
    folder : Path
        Made where it is not there.

    Returns
    -------
    None
        The result is ``response.ecsv``, ``derivatives.ecsv`` and ``response.png``.
    """
    make_folder(folder)
    rows = [row(one) for one in found]
    write_rows(
        [{k: float("nan") if v is None else v for k, v in one.items()} for one in rows],
        folder / "response.ecsv",
    )
    derivatives = [
        {"psf": one.psf, "estimator": one.estimator} | line for one in found for line in table(one)
    ]
    write_rows(derivatives, folder / "derivatives.ecsv")
    figure = figures.responses([grouped(one) for one in rows])
    write_whole(folder / "response.png", lambda path: figure.savefig(path, dpi=160))
