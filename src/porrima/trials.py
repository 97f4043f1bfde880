"""Corrections put to the test: stacks simulated with multiplicities that are wrong by their published errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from porrima.correction import Patch, change_behind, correct
from porrima.extrapolation import extrapolate, sample_covariance
from porrima.gain import with_figure_moved
from porrima.images import measure_stack
from porrima.photometry import PHOTOMETRY
from porrima.prediction import QUANTITIES
from porrima.response import response
from porrima.samples import samples_of
from porrima.stack import draw_stacks, draw_systems
from porrima.systems import Population
from porrima.uncertainty import CUT_ERROR, uncertainty

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import xarray as xr
    from numpy.typing import NDArray

    from porrima.companions import MultiplicityModel
    from porrima.psf import PSF
    from porrima.response import Response
    from porrima.shapes import Estimator, Shape
    from porrima.stars import Stars
    from porrima.uncertainty import Uncertainty

    FloatArray = NDArray[np.float64]

__all__ = ["Wrong", "coverage", "draw_wrong", "trials"]

_LIGHT = PHOTOMETRY["main-sequence"]
TWO_SIDED = 1.959964  # standard deviations that hold 95 %


@dataclass(frozen=True, slots=True, kw_only=True)
class Wrong:
    """By how much each figure of a multiplicity table is wrong, and the cut.

    Parameters
    ----------
    figures : dict
        Change of a figure in its unit, by row and name as in `uncertainty.RowErrors`.
    cut : float
        Factor on the cut (dimensionless).
    """

    figures: dict[tuple[int, str], float]
    cut: float

    def applied(self, population: Population, model: MultiplicityModel) -> Population:
        """A population with the wrong figures put right.

        Parameters
        ----------
        population : Population
            As the model has it.
        model : MultiplicityModel
            The model.

        Returns
        -------
        population : Population
            From which stacks are to be drawn.
        """
        for (row, figure), change in self.figures.items():
            population = with_figure_moved(population, model, row, figure, change)
        return replace(population, cut=population.cut * self.cut)


def draw_wrong(model: MultiplicityModel, rng: np.random.Generator) -> Wrong:
    """Errors of a multiplicity table and of the cut, each normal with its standard deviation on either side.

    Parameters
    ----------
    model : MultiplicityModel
        Whose table it is.
    rng : Generator
        Source of random numbers.

    Returns
    -------
    wrong : Wrong
        In the units of the figures: dimensionless and dex.
    """
    figures = {}
    for row, errors in enumerate(model.row_errors):
        for figure, (down, up) in errors._asdict().items():
            z = float(rng.standard_normal())
            figures[row, figure] = z * (down if z < 0 else up)
    return Wrong(figures=figures, cut=1.0 + CUT_ERROR * float(rng.standard_normal()))


def trials(
    bins: Sequence[tuple[tuple[float, float], Stars]],
    psf: PSF,
    estimator: Estimator,
    multiplicity: MultiplicityModel,
    *,
    n_stars: int,
    n_trials: int,
    seed: int,
    method: Literal["moments", "images"] = "moments",
    cut: float = 0.05,
    progress: Callable[[int], None] | None = None,
) -> xr.Dataset:
    """Residuals of corrections of simulated stacks, and the errors forecast for them.

    Parameters
    ----------
    bins : sequence of ((float, float), Stars)
        Ranges of magnitude with their stars, in mag.
    psf : PSF
        The true one.
    estimator : Estimator
        How stacks are measured.
    multiplicity : MultiplicityModel
        The model with which corrections are made.
    n_stars : int
        Stars in each stack (count).
    n_trials : int
        Multiplicities that are drawn, each with one stack in each range (count).
    seed : int
        Of all that is drawn.
    method : {"moments", "images"}
        By the engine and the response, or drawn with GalSim and measured there.
    cut : float
        Nominal separation from which pairs are resolved, in arcsec.
    progress : callable, optional
        Told the number of trials that are done.

    Returns
    -------
    dataset : Dataset
        ``before`` and ``after`` (trial, bin, quantity): measured and corrected minus true e1, e2 and R²/R0²; ``down``
        and ``up`` likewise: standard deviation forecast for ``after`` on either side, with ``model`` and ``scatter``,
        its parts; ``extrapolated``, ``extrapolated_error`` (trial, quantity) from all bins of a trial together, with
        the ``amplitude`` (trial).  Dimensionless.

    Notes
    -----
    The figures that are wrong are wrong in all bins of a trial.  The choices of the models are those of the correction.
    """
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for results only)

    reply = response(psf, estimator)
    true = _array(reply.shape0 if method == "moments" else estimator.measure(psf.draw()))
    unit = np.array([1.0, 1.0, true[2]])
    start = [Population.of(s, multiplicity=multiplicity, photometry=_LIGHT, cut=cut) for _, s in bins]
    measured = np.empty((n_trials, len(bins), 3))
    rng = np.random.Generator(np.random.Philox(seed))
    for trial in range(n_trials):
        wrong = draw_wrong(multiplicity, rng)
        for k, population in enumerate(start):
            run = {"n_stars": n_stars, "seed": seed, "stack": trial * len(bins) + k}
            drawn = wrong.applied(population, multiplicity)
            measured[trial, k] = _stack(drawn, psf, reply, estimator, run, method)
        if progress is not None:
            progress(1)
    known = [
        uncertainty(s, reply, multiplicity=multiplicity, photometry=_LIGHT, cut=cut, n_stars=n_stars)
        for _, s in bins
    ]
    found = _corrected(measured, known, reply)
    samples = samples_of(
        [s for _, s in bins],
        reply,
        np.full(len(bins), n_stars),
        multiplicity=multiplicity,
        cut=cut,
        choices=False,
    )
    spread = sample_covariance(samples.per_star, samples.n_stars)
    fits = [extrapolate(y, samples.change, spread, samples.model_error) for y in measured]
    edges = np.array([magnitude for magnitude, _ in bins])
    attrs = {"n_stars": n_stars, "psf": psf.name, "method": method, "seed": seed, "cut": cut}
    cubes = {"before": measured - true, "after": found.pop("after") - true} | found
    each = ("trial", "quantity")
    return xr.Dataset(
        {name: (("trial", "bin", "quantity"), values / unit) for name, values in cubes.items()}
        | {
            "extrapolated": (each, (np.array([f.shape for f in fits]) - true) / unit),
            "extrapolated_error": (each, np.array([f.error for f in fits]) / unit),
            "amplitude": ("trial", np.array([f.amplitude for f in fits])),
        },
        coords={"mag_lo": ("bin", edges[:, 0]), "mag_hi": ("bin", edges[:, 1]), "quantity": list(QUANTITIES)},
        attrs=attrs,
    )


def _stack(
    population: Population,
    psf: PSF,
    reply: Response,
    estimator: Estimator,
    run: dict[str, int],
    method: Literal["moments", "images"],
) -> FloatArray:
    """Shape of one stack, (3,)."""
    if method == "images":
        return _array(measure_stack(psf, draw_systems(population, binary_fraction="model", **run), estimator))
    stacks = draw_stacks(
        population,
        n_stars=run["n_stars"],
        binary_fraction="model",
        seed=run["seed"],
        first=run["stack"],
        last=run["stack"] + 1,
    )
    return _array(reply.shapes(stacks.moments))


def _array(shape: Shape) -> FloatArray:
    return np.array([float(np.squeeze(value)) for value in (shape.e1, shape.e2, shape.r2)])


def _corrected(measured: FloatArray, known: Sequence[Uncertainty], reply: Response) -> dict[str, FloatArray]:
    """Corrected shapes with the errors forecast for them, all (trial, bin, 3)."""
    names = ("after", "down", "up", "model", "scatter")
    out = {name: np.empty_like(measured) for name in names}
    for k, one in enumerate(known):
        n_stars = one.prediction.n_stars or 1
        change = change_behind(one.prediction.population, [reply], n_stars)
        for trial in range(len(measured)):
            patch = Patch(shape=measured[trial, k], n_stars=n_stars, error=np.zeros(3))
            found = correct(patch, one, change)
            down, up = found.error()
            values = (found.corrected, -down, up, found.model_error()[1], found.scatter)
            for name, value in zip(names, values, strict=True):
                out[name][trial, k] = value
    return out


def coverage(dataset: xr.Dataset, n_sigma: float = TWO_SIDED) -> xr.Dataset:
    """How often a correction ends within its forecast error.

    Parameters
    ----------
    dataset : Dataset
        From `trials`.
    n_sigma : float
        Standard deviations on either side; 95 % of a normal law where not given (dimensionless).

    Returns
    -------
    coverage : Dataset
        ``inside`` (bin, quantity) and ``extrapolated_inside`` (quantity): share of the trials, in [0, 1]; ``before``
        and ``after`` (bin, quantity): rms residuals, with ``forecast``, the rms of the forecast error; dimensionless.
    """
    import xarray as xr  # noqa: PLC0415

    after = dataset["after"]
    inside = (after <= n_sigma * dataset["up"]) & (after >= -n_sigma * dataset["down"])
    extrapolated = abs(dataset["extrapolated"]) <= n_sigma * dataset["extrapolated_error"]
    forecast = 0.5 * (dataset["up"] ** 2 + dataset["down"] ** 2)
    parts = {"before": dataset["before"] ** 2, "after": after**2, "forecast": forecast}
    return xr.Dataset(
        {"inside": inside.mean("trial"), "extrapolated_inside": extrapolated.mean("trial")}
        | {name: np.sqrt(values.mean("trial")) for name, values in parts.items()}
    )
