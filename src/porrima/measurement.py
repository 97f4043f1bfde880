"""One stack's shape and its change against the PSF without companions, from moments or from images."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from porrima.errors import InputError
from porrima.images import measure_stack
from porrima.response import response
from porrima.shapes import Failure
from porrima.systems import Systems

if TYPE_CHECKING:
    from porrima.psf import PSF
    from porrima.shapes import Estimator, Shape

__all__ = ["measured"]


def measured(
    source: object, systems: Systems, psf: PSF, estimator: Estimator, method: Literal["response", "images"]
) -> dict[str, float]:
    """Shape of a stack and its change, as `porrima measure` shows it.

    Parameters
    ----------
    source : object
        Where the systems come from, for errors.
    systems : Systems
        The stars of the stack.
    psf : PSF
        Behind which they are seen.
    estimator : Estimator
        How they are measured.
    method : {"response", "images"}
        From kernel moments, or drawn with GalSim.

    Returns
    -------
    result : dict
        ``e1``, ``e2``, ``r2`` [arcsec²] of the stack, ``e1_0``, ``e2_0``, ``r2_0`` of the PSF, and the changes
        ``de1``, ``de2``, ``dr2_rel``.

    Raises
    ------
    InputError
        If the stack cannot be measured.
    """
    zero = np.zeros(1)
    stack = _values(_shape(source, systems, psf, estimator, method))
    single = _values(_shape(source, Systems.from_pairs(zero, zero, zero), psf, estimator, method))
    changes = {"de1": stack["e1"] - single["e1"], "de2": stack["e2"] - single["e2"]}
    without = {f"{name}_0": value for name, value in single.items()}
    return stack | without | changes | {"dr2_rel": stack["r2"] / single["r2"] - 1}


def _shape(source: object, systems: Systems, psf: PSF, estimator: Estimator, method: str) -> Shape:
    """Shape of one stack, or an error that says why there is none."""
    try:
        if method == "images":
            found = measure_stack(psf, systems, estimator)
        else:
            found = response(psf, estimator).shapes(systems.kernel_moments())
    except InputError:
        raise
    except ValueError as error:
        raise InputError(str(error), key="psf") from None
    flag = Failure(int(np.squeeze(found.flag)))
    if flag & Failure.SERIES:
        rule = "has pairs too wide for this PSF's kernel moments: use --method images"
        raise InputError(rule, source=source)
    if flag:
        raise InputError(f"gives a stack that cannot be measured ({flag.name})", source=source)
    return found


def _values(shape: Shape) -> dict[str, float]:
    return {name: float(np.squeeze(getattr(shape, name))) for name in ("e1", "e2", "r2")}
