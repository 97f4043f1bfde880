r"""The predicted mean bias taken off a measured PSF, and the uncertainty that remains.

What companions add to the size of a PSF hardly depends on the PSF, and what they take of its ellipticity is in
proportion to it.  So the change predicted behind one PSF serves those that are like it: of every patch of a field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import galsim
import numpy as np

from porrima.moments import INDICES
from porrima.prediction import QUANTITIES, predict
from porrima.response import response
from porrima.shear import ShearResponse, deconvolution_bias, moments_bias
from porrima.uncertainty import NAMES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from porrima.galaxies import Galaxies
    from porrima.prediction import PopulationMoments, Prediction
    from porrima.psf import PSF
    from porrima.response import Response
    from porrima.shapes import Estimator, Shape
    from porrima.uncertainty import Uncertainty

    FloatArray = NDArray[np.float64]

__all__ = [
    "Change", "Correction", "Patch", "ResidualShear", "change_behind", "correct", "like", "residual_shear",
    "shear_covariance",
]  # fmt: skip

SHEAR = 0.02
"""Reduced shear, and relative stretch, of the PSFs between which the change is interpolated (dimensionless)."""

_ROUNDS = 3  # until the change at the corrected shape is that which was taken off
_SCATTER = [NAMES.index(f"sd_{quantity}") for quantity in QUANTITIES]
_SECOND = [INDICES.index(powers) for powers in ((2, 0), (1, 1), (0, 2))]


@dataclass(frozen=True, slots=True, kw_only=True)
class Patch:
    """Measured PSF of one patch of a field.

    Parameters
    ----------
    shape : (3,) float array
        e1, e2 (dimensionless) and R² in arcsec², of the stack.
    n_stars : int
        Stars that it is made of (count).
    error : (3,) float array
        Standard errors of the measurement itself, in the same units; 0 for none.
    """

    shape: FloatArray
    n_stars: int
    error: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """Mean change of the shape of PSFs that are like a given one.

    Parameters
    ----------
    shape0 : (3,) float array
        e1, e2 and R² [arcsec²] of that PSF without companions.
    value : (3,) float array
        Change of e1 and e2 times R0², and of R², in arcsec².
    slope : (3, 3) float array
        Its derivatives by e1, e2 and ln R² of the PSF, in arcsec².
    """

    shape0: FloatArray
    value: FloatArray
    slope: FloatArray

    def at(self, shape: FloatArray) -> FloatArray:
        """Change behind a PSF of some shape.

        Parameters
        ----------
        shape : (3,) float array
            e1, e2 (dimensionless) and R² in arcsec², without companions.

        Returns
        -------
        change : (3,) float array
            Of e1, e2 and R² [arcsec²].
        """
        apart = shape - self.shape0
        apart[2] = math.log(shape[2] / self.shape0[2])
        change: FloatArray = self.value + self.slope @ apart
        change[:2] /= shape[2]
        return change

    def taken_off(self, shape: FloatArray) -> FloatArray:
        """Shape without companions of a PSF that was measured with them.

        Parameters
        ----------
        shape : (3,) float array
            e1, e2 (dimensionless) and R² in arcsec², as measured.

        Returns
        -------
        shape : (3,) float array
            Corrected, in the same units.
        """
        corrected = shape.copy()
        for _ in range(_ROUNDS):
            corrected = shape - self.at(corrected.copy())
        return corrected


def like(psf: PSF, estimator: Estimator) -> tuple[Response, ...]:
    """Responses of a PSF and of three that are like it.

    Parameters
    ----------
    psf : PSF
        Of the survey.
    estimator : Estimator
        How shapes are measured.

    Returns
    -------
    responses : tuple of Response
        Of the PSF, of it sheared along e1 and along e2, and stretched.
    """
    profiles = {
        "": psf.profile,
        ", sheared along e1": psf.profile.shear(galsim.Shear(g1=SHEAR)),
        ", sheared along e2": psf.profile.shear(galsim.Shear(g2=SHEAR)),
        ", stretched": psf.profile.dilate(1 + SHEAR),
    }
    others = (
        replace(psf, name=psf.name + text, profile=profile, grid=psf.scale) if text else psf
        for text, profile in profiles.items()
    )
    return tuple(response(one, estimator) for one in others)


def change_behind(
    moments: PopulationMoments, responses: Sequence[Response], n_stars: int | None = None
) -> Change:
    r"""Mean change of shape behind a PSF and those that are like it.

    Parameters
    ----------
    moments : PopulationMoments
        Of one star, at one binary fraction.
    responses : sequence of Response
        From `like`; of the first one alone, the change in arcsec² is that of all PSFs.
    n_stars : int, optional
        Stars in the stack (count); None for infinitely many.

    Returns
    -------
    change : Change
        In arcsec².

    Notes
    -----
    First order in the difference between two PSFs.  With plain moments
    :math:`R^2 \delta e_i = -e_i \langle x\rangle` and :math:`\delta R^2 = \langle x\rangle` hold for every PSF, and
    so exactly.
    """
    shape0 = _values(responses[0].shape0)
    value = _in_square_seconds(predict(moments, responses[0], n_stars))
    slope = np.zeros((3, 3))
    if len(responses) > 1:
        limits = [_in_square_seconds(predict(moments, one)) for one in responses]
        apart = np.array([_values(one.shape0) - shape0 for one in responses[1:]])
        apart[:, 2] = [math.log(float(one.shape0.r2) / shape0[2]) for one in responses[1:]]
        slope = np.linalg.solve(apart, np.array(limits[1:]) - limits[0]).T
    return Change(shape0=shape0, value=value, slope=slope)


def _values(shape: Shape) -> FloatArray:
    return np.array([float(shape.e1), float(shape.e2), float(shape.r2)])


def _in_square_seconds(prediction: Prediction) -> FloatArray:
    """Mean change of e1 and e2 times R0², and of R²: all three are over R0² in the prediction, (3,)."""
    return prediction.bias[:, 0] * prediction.r2_0


@dataclass(frozen=True, slots=True, kw_only=True)
class Correction:
    """A PSF with the predicted bias taken off, and what is left: residuals are the corrected value minus the true one.

    Parameters
    ----------
    patch : Patch
        As measured.
    bias : (3,) float array
        Predicted mean change of e1, e2 (dimensionless) and R² [arcsec²].
    sources : dict
        Lowest and highest residual by each source of the model's uncertainty, over the bias, (2,) dimensionless.
    kinds : dict
        Kind of each source, as `uncertainty.Source` has it.
    choices : (2,) float array
        Lowest and highest residual by any combination of the choices of the models, over the bias, dimensionless.
    growth : (3,) float array
        Scatter of e1, e2 and R² averaged over the errors of the model, over that as predicted, dimensionless.
    covariance : (3, 3) float array
        Of e1, e2 and R² [arcsec²] between stacks of so many stars, averaged over the errors of the model: the scatter.
    """

    patch: Patch
    bias: FloatArray
    sources: dict[str, tuple[float, float]]
    kinds: dict[str, str]
    choices: FloatArray
    growth: FloatArray
    covariance: FloatArray

    @property
    def corrected(self) -> FloatArray:
        """e1, e2 (dimensionless) and R² [arcsec²] with the bias taken off, (3,)."""
        return self.patch.shape - self.bias

    @property
    def scatter(self) -> FloatArray:
        """Standard deviation of e1, e2 and R² [arcsec²] between stacks, (3,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def model(self) -> FloatArray:
        """Residuals of one standard deviation by the model's errors, over the bias, down and up, (2,)."""
        parts = [ends for name, ends in self.sources.items() if self.kinds[name] in ("error", "sample")]
        total: FloatArray = np.array([-1.0, 1.0]) * np.sqrt(np.sum(np.square(parts), axis=0))
        return total

    def model_error(self) -> FloatArray:
        """Residuals by the model's errors of e1, e2 and R² [arcsec²], down and up, (2, 3)."""
        return np.sort(self.model[:, None] * self.bias, axis=0)

    def choice_shift(self) -> FloatArray:
        """Residuals by the choices of the models of e1, e2 and R² [arcsec²], lowest and highest, (2, 3)."""
        return np.sort(self.choices[:, None] * self.bias, axis=0)

    def error(self) -> FloatArray:
        """Residuals of one standard deviation of e1, e2 and R² [arcsec²], choices as made, down and up, (2, 3)."""
        rest = self.scatter**2 + self.patch.error**2
        total: FloatArray = np.array([[-1.0], [1.0]]) * np.sqrt(self.model_error() ** 2 + rest)
        return total

    def interval(self, n_sigma: float = 1.0, choices: bool = True) -> FloatArray:
        """Ends of the interval of the true shape.

        Parameters
        ----------
        n_sigma : float
            Standard deviations on either side (dimensionless).
        choices : bool
            Whether the choices of the models may be made the other way.

        Returns
        -------
        ends : (2, 3) float array
            Of e1, e2 (dimensionless) and R² in arcsec².
        """
        residual = n_sigma * self.error() + (self.choice_shift() if choices else 0.0)
        return self.corrected - residual[::-1]


def correct(
    patch: Patch, known: Uncertainty, change: Change, prediction: Prediction | None = None
) -> Correction:
    r"""A measured PSF with the predicted mean bias taken off.

    Parameters
    ----------
    patch : Patch
        As measured.
    known : Uncertainty
        Of the prediction for the stars of the patch and a finite number of stars.
    change : Change
        Of the same stars.
    prediction : Prediction, optional
        For the number of stars of the patch, where `known` is for another.

    Returns
    -------
    correction : Correction
        In the units of the patch.

    Notes
    -----
    The bias is that at the corrected shape.  The model's errors are those of the size's bias, in proportion, for the
    ellipticity as well: behind Gaussian PSFs both follow eta.  Errors, scatter and the measurement's error are
    independent; the choices of the models (photometry, gap rule, projection) are no errors and stand beside them.  The
    scatter averages out between patches, the model's errors do not: they are the same in all.
    """
    prediction = known.prediction if prediction is None else prediction
    k = NAMES.index("bias_r2")
    own = float(known.value[k]) or 1.0
    sources = {s.name: _sorted(s.low[k] / own, s.high[k] / own) for s in known.sources}
    errors = [sources[s.name] for s in known.sources if s.kind in ("error", "sample")]
    down, up = np.sqrt(np.sum(np.square(errors), axis=0))
    low, high = _sorted(*((end - known.value[k]) / own for end in known.interval("bias_r2")))
    unit, growth = np.array([1.0, 1.0, prediction.r2_0]), _growth(known)
    return Correction(
        patch=patch,
        bias=patch.shape - change.taken_off(patch.shape),
        sources=sources,
        kinds={s.name: s.kind for s in known.sources},
        choices=np.array([min(low + down, 0.0), max(high - up, 0.0)]),
        growth=growth,
        covariance=prediction.covariance[:, :, 0] * np.outer(unit * growth, unit * growth),
    )


def _growth(known: Uncertainty) -> FloatArray:
    """Rms scatter of e1, e2 and R² over the errors of the model, to second order, over that as predicted, (3,)."""
    own = known.value[_SCATTER]
    own = np.where(own > 0, own, 1.0)
    more = np.zeros(len(_SCATTER))
    for source in known.sources:
        if source.kind == "error":
            ends = [1.0 + end[_SCATTER] / own for end in (source.low, source.high)]
            more += 0.5 * (ends[0] ** 2 + ends[1] ** 2) - 1.0
    return np.sqrt(1.0 + more)


def _sorted(one: float, other: float) -> tuple[float, float]:
    return float(min(one, other)), float(max(one, other))


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualShear:
    """m, c1 and c2 by one method before a correction, and what is left of them after it; all dimensionless.

    Parameters
    ----------
    bias : (3,) float array
        Mean of m, c1, c2 before.
    model : (2, 3) float array
        Residuals of one standard deviation by the model's errors, down and up.
    choices : (2, 3) float array
        Lowest and highest residual by the choices of the models.
    scatter : (3,) float array
        Standard deviation between patches.
    measurement : (3,) float array
        Standard error by that of the measurement of the PSF.
    """

    bias: FloatArray
    model: FloatArray
    choices: FloatArray
    scatter: FloatArray
    measurement: FloatArray

    @property
    def error(self) -> FloatArray:
        """Standard deviation of what is left, choices as made, down and up, (2, 3), dimensionless."""
        total: FloatArray = np.array([[-1.0], [1.0]]) * np.sqrt(
            self.model**2 + self.scatter**2 + self.measurement**2
        )
        return total


def residual_shear(
    correction: Correction, prediction: Prediction, reply: Response, method: ShearResponse | Galaxies
) -> ResidualShear:
    r"""What a corrected PSF leaves in the shear that is measured with it.

    Parameters
    ----------
    correction : Correction
        Of the PSF.
    prediction : Prediction
        For the number of stars of the patch.
    reply : Response
        Of the PSF and estimator.
    method : ShearResponse or Galaxies
        Of a method that fits galaxies with the stacked PSF; or the sizes as a method sees them that subtracts moments.

    Returns
    -------
    shear : ResidualShear
        Dimensionless.

    Notes
    -----
    What the model does not know of the bias is in proportion to it, for m and c as for the size.
    """
    if isinstance(method, ShearResponse):
        found = deconvolution_bias(prediction.population, method, prediction.n_stars)
    else:
        covariance = prediction.log_covariance.transpose(2, 0, 1)
        found = moments_bias(prediction.bias, covariance, reply.shape0, method)
    bias = np.array([found.m[0], found.c1[0], found.c2[0]])
    unit = np.array([1.0, 1.0, correction.patch.shape[2]])
    measured = shear_covariance(np.diag((correction.patch.error / unit) ** 2), reply, method)
    return ResidualShear(
        bias=bias,
        model=np.sort(correction.model[:, None] * bias, axis=0),
        choices=np.sort(correction.choices[:, None] * bias, axis=0),
        scatter=np.array([found.sd_m[0], found.sd_c1[0], found.sd_c2[0]]) * correction.growth[[2, 0, 1]],
        measurement=np.sqrt(np.diag(measured)),
    )


def shear_covariance(covariance: FloatArray, reply: Response, method: ShearResponse | Galaxies) -> FloatArray:
    r"""Covariance of m, c1 and c2 that an error of the PSF's shape makes, whatever made it.

    Parameters
    ----------
    covariance : (3, 3) float array
        Of e1, e2 and ln R², dimensionless.
    reply : Response
        Of the PSF and estimator.
    method : ShearResponse or Galaxies
        As for `residual_shear`.

    Returns
    -------
    covariance : (3, 3) float array
        Dimensionless.

    Notes
    -----
    For a method that fits, the error is taken for that of a PSF convolved with the small kernel, of second moments
    alone, which makes it: the response of the fit over that of the shape.
    """
    if isinstance(method, ShearResponse):
        of_shape = reply.first[:, _SECOND] / np.array([[1.0], [1.0], [float(reply.shape0.r2)]])
        jacobian = method.first[:, _SECOND] @ np.linalg.inv(of_shape)
        result: FloatArray = jacobian @ covariance @ jacobian.T
        return result
    found: FloatArray = moments_bias(np.zeros((3, 1)), covariance[None], reply.shape0, method).covariance[0]
    return found
