"""From the options of `correct` to corrected PSFs: patches, their stars, the prediction, and what is left in shear."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima import __version__
from porrima.answers import population_config
from porrima.correction import change_behind, correct, like, residual_shear, shear_covariance
from porrima.decision import N_DRAWN, galaxies_of, profile_of, seen_by, survey_of
from porrima.deconvolution import fit_response
from porrima.errors import InputError
from porrima.extrapolation import best_split, extrapolate, sample_covariance
from porrima.patches import one_patch, read_patches
from porrima.prediction import QUANTITIES, SeriesWarning, predict
from porrima.sample import catalog_of, draw_stars, selection_of
from porrima.samples import Fractions, samples_of
from porrima.shapes import estimator_from_name
from porrima.uncertainty import uncertainty

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from porrima.config import PopulationConfig
    from porrima.correction import Change, Correction
    from porrima.extrapolation import Extrapolation
    from porrima.galaxies import Galaxies
    from porrima.instruments import Requirement
    from porrima.patches import PatchTable
    from porrima.prediction import PopulationMoments, Prediction
    from porrima.response import Response
    from porrima.samples import Samples
    from porrima.shear import ShearResponse
    from porrima.stars import Stars
    from porrima.uncertainty import Uncertainty

    FloatArray = NDArray[np.float64]

__all__ = ["METHODS", "corrected"]

METHODS = ("predict", "extrapolate", "fields")
"""How a PSF is corrected: by the prediction, from samples of stars, or from fields of unlike binary fraction."""

MOST_UNLIKE = 2.0
"""Factor by which a size may differ from that of the PSF before it is taken for a slip (dimensionless)."""

UNLIKE = 1.2
"""Factor from which a warning is given (dimensionless)."""

_SHEAR = ("m", "c1", "c2")


class LikenessWarning(UserWarning):
    """A measured PSF is not much like the one that is given."""


class _StarsOfPlaces:
    """Stars by magnitudes and direction, each place drawn or selected once."""

    def __init__(
        self, *, options: dict[str, Any], mag: tuple[float, float] | None, cut: float, patches: PatchTable
    ) -> None:
        self._options, self._mag, self._patches = options, mag, patches
        self._found: dict[tuple[Any, ...], Stars] = {}
        if "mag_lo" not in patches.values and mag is None:
            raise InputError("is missing, or columns mag_lo and mag_hi of the patches", key="--mag")
        if "mag_lo" in patches.values and mag is not None:
            rule = "cannot be given together with columns mag_lo and mag_hi"
            raise InputError(rule, key="--mag", value=f"{mag[0]:g} {mag[1]:g}")
        if "l" in patches.values:
            for name in ("l", "b", "catalog"):
                if options.get(name) is not None:
                    rule = "cannot be given together with columns l and b"
                    raise InputError(rule, key=f"--{name}", value=options[name])
        self._options = options | {"cut": cut}
        self.config = self._config(self.place(0))
        self._read = catalog_of(self.config)

    def place(self, k: int) -> tuple[Any, ...]:
        """Magnitudes and direction of a row."""
        at = self._patches.at
        mag = (at("mag_lo", k), at("mag_hi", k)) if "mag_lo" in self._patches.values else self._mag
        return mag, at("l", k), at("b", k)

    def _config(self, place: tuple[Any, ...]) -> PopulationConfig:
        mag, l, b = place
        direction = {} if l is None else {"l": l, "b": b}
        return population_config(**self._options | direction, mag=mag)

    def of(self, k: int) -> Stars:
        """Stars of a row."""
        place = self.place(k)
        if place not in self._found:
            config = self._config(place)
            where = config.stars.model_copy(update={"n_drawn": N_DRAWN})
            self._found[place] = draw_stars(config.model_copy(update={"stars": where}), self._read)
        return self._found[place]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Scene:
    """All that does not differ between patches."""

    patches: PatchTable
    stars: _StarsOfPlaces | None
    fraction: float | None
    responses: tuple[Response, ...]
    methods: dict[str, ShearResponse | Galaxies]
    requirement: Requirement | None

    @property
    def reply(self) -> Response:
        """Response of the PSF as given."""
        return self.responses[0]

    @property
    def models(self) -> dict[str, Any]:
        """What a population is made with."""
        config = self.stars.config if self.stars is not None else None
        if config is None:
            return {}
        return {
            "multiplicity": config.multiplicity.build(),
            "photometry": config.photometry.build(),
            "cut": config.cut,
        }

    def binary_fraction(self, k: int) -> float | None:
        """That of a row; None for the model's own."""
        own = self.patches.at("binary_fraction", k)
        return self.fraction if own is None else own


def corrected(
    *,
    table: Path | None,
    shape: tuple[float, float, float] | None,
    shape_error: tuple[float, float, float] | None,
    n_stars: int | None,
    method: str,
    nested: bool,
    instrument: str | None,
    galaxy_size: float | None,
    galaxies: str | None,
    mag: tuple[float, float] | None,
    psf: str | None,
    pixel: float | None,
    pixel_scale: float | None,
    jitter: float | None,
    estimator: str,
    binary_fraction: float | None,
    cut: float | None,
    **options: Any,
) -> dict[str, Any]:
    """Corrected PSFs from the options of the command.

    Parameters
    ----------
    table : Path or None
        Of patches, or of samples of stars.
    shape, shape_error, n_stars
        The PSF of one patch instead, as `patches.one_patch` takes it, R² in arcsec².
    method : str
        One of `METHODS`.
    nested : bool
        Whether each sample is part of all larger ones.
    instrument, galaxy_size, galaxies
        As `decision.survey_of` and `decision.galaxies_of` take them; None for no survey.
    mag : (float, float) or None
        Of the stars, in mag, where the table does not say.
    psf, estimator : str
        Names; None for the survey's PSF.
    pixel, pixel_scale, jitter, cut : float or None
        In arcsec; None for the survey's pixel, jitter and cut.
    binary_fraction : float or None
        In [0, 1], where the table does not say; None for the model's own.
    options : dict
        Of `answers.population_config`.

    Returns
    -------
    answer : dict
        The keys of the contract.

    Raises
    ------
    InputError
        If an option or the table is wrong, or there are no stars.
    """
    if method not in METHODS:
        raise InputError(f"must be one of {', '.join(METHODS)}", key="--method", value=method)
    if method != "predict" and options.get("selection") is not None:
        raise InputError("goes with --method predict alone", key="--selection", value=options["selection"])
    for key, value in (("--shape", shape), ("--shape-error", shape_error), ("--n-stars", n_stars)):
        if table is not None and value is not None:
            raise InputError("cannot be given together with a table of patches", key=key)
    if instrument is None and psf is None:
        raise InputError("is missing, or --instrument", key="--psf")
    patches = one_patch(shape, shape_error, n_stars) if table is None else read_patches(table)
    survey, requirement = survey_of(instrument or "kcm16", None)
    sizes, shapes = galaxies_of(galaxy_size, galaxies), estimator_from_name(estimator)
    profile = profile_of(survey, psf, pixel, pixel_scale, jitter)
    methods: dict[str, ShearResponse | Galaxies] = {"fit": fit_response(profile, sizes)}
    seen = seen_by(shapes, sizes, profile)
    if seen is not None:
        methods["moments"] = seen
    stars = None
    if method == "predict" or "eta" not in patches.values:
        stars = _StarsOfPlaces(
            options=options, mag=mag, cut=survey.cut if cut is None else cut, patches=patches
        )
    scene = _Scene(
        patches=patches,
        stars=stars,
        fraction=binary_fraction,
        responses=like(profile, shapes),
        methods=methods,
        requirement=requirement if instrument else None,
    )
    _check_likeness(scene)
    found = _by_prediction(scene) if method == "predict" else _by_samples(scene, method, nested)
    return _head(scene, method, profile.name, estimator) | found


def _head(scene: _Scene, method: str, psf: str, estimator: str) -> dict[str, Any]:
    """What was corrected, with what."""
    shape, config = scene.reply.shape0, scene.stars.config if scene.stars is not None else None
    return {
        "method": method,
        "psf": psf,
        "estimator": estimator,
        "r2_0": float(shape.r2),
        "e1_0": float(shape.e1),
        "e2_0": float(shape.e2),
        "cut": None if config is None else config.cut,
        "requirement": None if scene.requirement is None else scene.requirement.name,
        "table": None if scene.patches.source is None else str(scene.patches.source),
        "configuration": None if config is None else config.model_dump(mode="json", exclude_none=True),
        "references": "" if config is None else "DucheneKraus2013, KCM16",
        "version": __version__,
    }


def _check_likeness(scene: _Scene) -> None:
    """Stop at a PSF that cannot be like the one given, and warn of one that is not much like it."""
    own, patches = float(scene.reply.shape0.r2), scene.patches
    apart = np.abs(np.log(patches.values["r2"] / own))
    k = int(np.argmax(apart))
    if apart[k] > math.log(MOST_UNLIKE):
        rule = (
            f"must be within a factor {MOST_UNLIKE:g} of the {own:.4g} arcsec² of the PSF without companions"
        )
        where: dict[str, Any] = {"source": patches.source, "row": int(patches.row[k]), "column": "r2"}
        raise InputError(
            rule,
            value=f"{patches.values['r2'][k]:g}",
            **(where if patches.source else {"key": "--shape, r2"}),
        )
    if apart[k] > math.log(UNLIKE):
        text = f"a measured R² is {math.exp(apart[k]):.2f} times larger or smaller than that of the PSF given"
        warnings.warn(text, LikenessWarning, stacklevel=2)


def _row_of(patches: PatchTable, k: int) -> dict[str, Any]:
    """Which patch a row of the answer is of."""
    names = ("x", "y", "l", "b", "mag_lo", "mag_hi", "binary_fraction")
    return {"patch": patches.name[k]} | {n: patches.at(n, k) for n in names if n in patches.values}


def _by_prediction(scene: _Scene) -> dict[str, Any]:
    """Each patch by the prediction for its own stars."""
    if scene.stars is None:
        raise InputError("is missing", key="stars")
    models = scene.models | {"selection": selection_of(scene.stars.config, scene.reply)}
    out: dict[str, Any] = {name: [] for name in ("values", "shear", "populations", "sources")}
    known: dict[tuple[Any, ...], tuple[int, Uncertainty]] = {}
    changes: dict[tuple[Any, ...], tuple[Change, Prediction]] = {}
    for k in range(len(scene.patches)):
        patch, fraction = scene.patches.patch(k), scene.binary_fraction(k)
        place = (*scene.stars.place(k), fraction)
        if place not in known:
            stars = scene.stars.of(k)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", SeriesWarning)  # said below
                found = uncertainty(
                    stars, scene.reply, binary_fraction=fraction, n_stars=patch.n_stars, **models
                )
            known[place] = len(known) + 1, found
            _add_population(out, *known[place], len(stars), place)
        number, one = known[place]
        if (place, patch.n_stars) not in changes:
            changes[place, patch.n_stars] = _change(scene, one.prediction.population, patch.n_stars)
        change, prediction = changes[place, patch.n_stars]
        correction = correct(patch, one, change, prediction)
        first = _row_of(scene.patches, k) | {"n_stars": patch.n_stars, "population": number}
        out["values"] += [first | row for row in _value_rows(correction)]
        for group, method in scene.methods.items():
            left = residual_shear(correction, prediction, scene.reply, method)
            error = np.sqrt(np.mean(left.error**2, axis=0))
            for j, quantity in enumerate(_SHEAR):
                row = {"patch": first["patch"], "group": group, "quantity": quantity, "before": left.bias[j]}
                row |= {"error": error[j], "model_error": _rms(left.model[:, j])}
                row |= {"choice_low": left.choices[0, j], "choice_high": left.choices[1, j]}
                row |= {"scatter": left.scatter[j]}
                row |= {"measurement_error": left.measurement[j]}
                out["shear"].append(_plain(row | _required(scene, quantity, left.bias[j], error[j])))
    return out


def _change(scene: _Scene, moments: PopulationMoments, n_stars: int) -> tuple[Change, Prediction]:
    """Change behind PSFs like the one given, and the prediction for that one; stops where pairs are too wide."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", SeriesWarning)
        found = predict(moments, scene.reply, n_stars)
    _refuse_wide(found.bias, moments.cut)
    for warning in said:
        warnings.warn(warning.message, stacklevel=2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SeriesWarning)
        return change_behind(moments, scene.responses, n_stars), found


def _refuse_wide(change: FloatArray, cut: float) -> None:
    """Stop where the series in kernel moments has not converged."""
    if np.any(np.isnan(change)):
        rule = "is too wide for the kernel moments of this PSF: use --estimator plain"
        raise InputError(rule, key="--cut", value=cut)


def _rms(ends: FloatArray) -> float:
    return float(np.sqrt(np.mean(ends**2)))


def _plain(row: dict[str, Any]) -> dict[str, Any]:
    """A row with Python's own numbers."""
    return {k: v.item() if isinstance(v, np.generic) else v for k, v in row.items()}


def _required(scene: _Scene, quantity: str, before: float | None, error: float) -> dict[str, Any]:
    """Shares of a requirement, before and after, where a survey is given."""
    if scene.requirement is None:
        return {}
    limit = scene.requirement.of(quantity)
    share = {"share_before": before, "share_after": error}
    return {"required": limit} | {
        name: None if limit is None or value is None else abs(value) / limit for name, value in share.items()
    }


def _value_rows(correction: Correction) -> list[dict[str, Any]]:
    """Each quantity as measured and corrected, with what makes its error."""
    (low, high), error = correction.interval(), correction.error()
    choices, model = correction.choice_shift(), correction.model_error()
    columns = {
        "measured": correction.patch.shape, "bias": correction.bias, "corrected": correction.corrected,
        "low": low, "high": high, "error": np.sqrt(np.mean(error**2, axis=0)),
        "model_error": np.sqrt(np.mean(model**2, axis=0)), "choice_low": choices[0], "choice_high": choices[1],
        "scatter": correction.scatter, "measurement_error": correction.patch.error,
    }  # fmt: skip
    return [
        {"quantity": quantity} | {name: float(values[j]) for name, values in columns.items()}
        for j, quantity in enumerate(QUANTITIES)
    ]


def _add_population(
    out: dict[str, Any], number: int, known: Uncertainty, n_catalog: int, place: tuple[Any, ...]
) -> None:
    """Stars of a place, and what the model does not know of their companions."""
    (mag_lo, mag_hi), l, b, fraction = place
    low, high = known.interval("eta")
    value = float(known.value[0])
    out["populations"].append(
        {
            "population": number, "mag_lo": mag_lo, "mag_hi": mag_hi, "l": l, "b": b, "binary_fraction": fraction,
            "population_binary_fraction": float(known.prediction.population.binary_fraction[0]),
            "n_catalog_stars": n_catalog, "eta": value, "eta_low": low, "eta_high": high,
        }
    )  # fmt: skip
    for source in known.sources:
        relative = [float(end[0]) / value if value else 0.0 for end in (source.low, source.high)]
        out["sources"].append(
            {
                "population": number,
                "source": source.name,
                "kind": source.kind,
                "low": relative[0],
                "high": relative[1],
            }
        )


def _by_samples(scene: _Scene, method: str, nested: bool) -> dict[str, Any]:
    """Each PSF from the samples of stars that see it."""
    patches = scene.patches
    if method == "fields" and "binary_fraction" not in patches.values:
        rule = "must give the binary fraction of each field, for --method fields"
        raise InputError(rule, source=patches.source, column="binary_fraction")
    groups: dict[str, list[int]] = {}
    for k in range(len(patches)):
        groups.setdefault(patches.name[k] if patches.named else "1", []).append(k)
    out: dict[str, Any] = {name: [] for name in ("values", "shear", "fits", "samples")}
    for name, rows in groups.items():
        try:
            _add_fit(out, scene, name, rows, nested)
        except InputError as error:
            raise InputError(str(error), source=patches.source, key=f"patch {name}") from None
    return out


def _add_fit(out: dict[str, Any], scene: _Scene, name: str, rows: list[int], nested: bool) -> None:
    """Rows of the answer for one PSF."""
    measured, change, per_star, model_error, quantities = _sampled(scene, rows)
    patches = [scene.patches.patch(k) for k in rows]
    n_stars = np.array([patch.n_stars for patch in patches])
    spread = sample_covariance(per_star, n_stars, nested, np.array([p.error[quantities] for p in patches]))
    found = extrapolate(measured, change, spread, model_error)
    split = None if nested else best_split(change[:, -1], np.sqrt(per_star[:, -1, -1]))
    r2 = float(found.shape[-1])
    first = {"patch": name}
    for j, k in enumerate(quantities):
        value, error = float(found.shape[j]), float(found.error[j])
        ends = {"corrected": value, "low": value - error, "high": value + error, "error": error}
        out["values"].append(first | {"quantity": QUANTITIES[k]} | ends)
    out["fits"].append(
        first
        | {
            "n_samples": len(rows), "n_stars": int(n_stars.max() if nested else n_stars.sum()),
            "amplitude": found.amplitude, "amplitude_error": found.amplitude_error,
            "chi2": found.chi2, "n_dof": found.n_dof, "error_r2": float(found.error[-1]) / r2,
            "best_error_r2": None if split is None else split.error / math.sqrt(n_stars.sum()) / r2,
            "dr2_dfraction": _slope(scene, rows, change[:, -1], found),
        }
    )  # fmt: skip
    for i, k in enumerate(rows):
        at = _row_of(scene.patches, k) | first
        numbers = {"r2": measured[i, -1], "predicted_change": change[i, -1] / r2}
        numbers |= {
            "residual": found.residual[i, -1] / r2,
            "best_share": None if split is None else split.share[i],
        }
        out["samples"].append(_plain(at | {"n_stars": int(n_stars[i])} | numbers))
    covariance = np.zeros((3, 3))
    covariance[np.ix_(quantities, quantities)] = found.covariance[:-1, :-1]
    unit = np.array([1.0, 1.0, r2])
    for group, by in scene.methods.items():
        errors = np.sqrt(np.diag(shear_covariance(covariance / np.outer(unit, unit), scene.reply, by)))
        for j, quantity in enumerate(_SHEAR if len(quantities) == len(QUANTITIES) else _SHEAR[:1]):
            row = first | {"group": group, "quantity": quantity, "error": float(errors[j])}
            out["shear"].append(row | _required(scene, quantity, None, float(errors[j])))


def _sampled(
    scene: _Scene, rows: list[int]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray | None, list[int]]:
    """Measured shapes of samples, their changes, scatter and errors of the model, and which quantities they are."""
    patches, size = scene.patches, [QUANTITIES.index("r2")]
    measured = np.array([patches.patch(k).shape for k in rows])
    if scene.stars is None:
        unit = float(scene.reply.shape0.r2)
        eta, sd = (patches.values[name][rows] * unit for name in ("eta", "sd"))
        return measured[:, size], eta[:, None], (sd**2)[:, None, None], None, size
    fractions = [scene.binary_fraction(k) for k in rows]
    errors = patches.values.get("binary_fraction_error", np.zeros(len(patches)))[rows]
    known = None
    if all(value is not None for value in fractions):
        known = Fractions(value=np.array(fractions, dtype=float), error=errors)
    n_stars = np.array([patches.patch(k).n_stars for k in rows])
    stars = [scene.stars.of(k) for k in rows]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SeriesWarning)  # an error below
        found: Samples = samples_of(stars, scene.reply, n_stars, fractions=known, **scene.models)
    _refuse_wide(found.change, scene.models["cut"])
    if "e1" in patches.values:
        return measured, found.change, found.per_star, found.model_error, list(range(len(QUANTITIES)))
    return measured[:, 2:], found.change[:, 2:], found.per_star[:, 2:, 2:], found.model_error[:, :, 2:], size


def _slope(scene: _Scene, rows: list[int], change: FloatArray, found: Extrapolation) -> float | None:
    """Change of R²/R0² by binary fraction between the lowest and the highest, at the amplitude found."""
    values = [scene.binary_fraction(k) for k in rows]
    if any(value is None for value in values):
        return None
    fraction = np.array(values, dtype=float)
    low, high = int(np.argmin(fraction)), int(np.argmax(fraction))
    if fraction[high] == fraction[low]:
        return None
    slope = (change[high] - change[low]) / (fraction[high] - fraction[low])
    return float(found.amplitude * slope / found.shape[-1])
