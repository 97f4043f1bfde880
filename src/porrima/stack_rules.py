"""Which numbers decide on the paper's statements about stacks: those of the simulations."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.evidence import (
    FIRST,
    MANY,
    N_SIGMA,
    NONE,
    OPTICAL,
    OTHER,
    READINGS,
    Number,
    bend_of,
    measure,
    ratio_of,
    slope_of,
)  # fmt: skip

if TYPE_CHECKING:
    from porrima.evidence import Evidence, Measure

__all__ = [
    "AS_KCM16", "UNWEIGHTED", "barely", "bias_is_error", "calibration", "few_stars", "linear", "not_averaged",
    "opposite", "optical", "population_changes", "rounder", "square_root",
]  # fmt: skip

AS_KCM16 = "the table read with orbits cut off and solar values in its gaps (dk13-kcm16)"
UNWEIGHTED = "moments that are unweighted, or have a wide fixed weight"
_ENDLESS = "stacks of very many stars"
_MOSTLY_PAIRS = "nearly all stars are binaries"
_FRACTION = 0.35  # at which the paper reads its figures
_ROUND = 1e-6  # ellipticity of a round PSF
_DIFFERENT = 0.01  # of ellipticities


def _size_bend(data: Evidence, experiment: str, psf: str) -> Number:
    return bend_of(data.fractions(experiment), *data.bins(experiment, psf, "r2", "bias"))


def _along(data: Evidence, experiment: str, psf: str) -> Number:
    """Bias of the ellipticity along the PSF's own over -e η, from all bins."""
    e_0 = np.array(data.ellipticity(psf))
    both = [data.bins(experiment, psf, q, "bias") for q in ("e1", "e2")]
    e = np.hypot(*e_0)
    value = -(e_0[0] * both[0][0] + e_0[1] * both[1][0]) / e
    error = np.hypot(e_0[0] * both[0][1], e_0[1] * both[1][1]) / e
    return slope_of(e * data.eta(experiment, psf), value, error)


def _size_response(data: Evidence, experiment: str, psf: str) -> Number:
    """Bias of the size over η, from all bins."""
    return slope_of(data.eta(experiment, psf), *data.bins(experiment, psf, "r2", "bias"))


def _most_elliptical(data: Evidence, experiment: str) -> str | None:
    names = data.psfs(experiment)
    return names[-1] if names and data.size_of(names[-1]) > _ROUND else None


def _missing(part: str) -> Measure:
    return measure(part, "", NONE)


def _reading(experiment: str) -> str:
    return READINGS[experiment == OTHER]


def linear(data: Evidence) -> list[Measure]:
    """Numbers for the size in proportion to the binary fraction."""
    out = []
    for experiment, under in ((FIRST, ""), (OTHER, AS_KCM16)):
        for psf in data.psfs(experiment)[:1]:
            number = _size_bend(data, experiment, psf)
            out.append(
                measure(
                    "in proportion",
                    f"rise of δR²/F from small to large F ({_reading(experiment)})",
                    number,
                    -0.1,
                    0.1,
                    under=under,
                )
            )
    psfs = data.psfs(FIRST)
    for name, words in (("bias", "bias"), ("sigma", "error")):
        slopes = [slope_of(data.fractions(FIRST), *data.bins(FIRST, psf, "r2", name)) for psf in psfs]
        if len(psfs) > 1 and data.size_of(psfs[-1]) - data.size_of(psfs[0]) > _DIFFERENT:
            values = [slope.value for slope in slopes]
            error = slopes[0].error / slopes[0].value
            out.append(
                measure(
                    "whatever the ellipticity",
                    f"spread of the {words} of the size among PSFs",
                    Number(max(values) / min(values) - 1, error),
                    largest=0.02,
                    slack=0.0,
                )
            )
        else:
            out.append(_missing("whatever the ellipticity"))
    return out


def bias_is_error(data: Evidence) -> list[Measure]:
    """Numbers for bias and error of the size."""
    out = []
    for experiment, under in ((FIRST, ""), (MANY, _ENDLESS)):
        for psf in data.psfs(experiment)[:1]:
            n_stars = data.n_stars(experiment)[-1]
            k, several = data.at(experiment, _FRACTION), n_stars if experiment == MANY else None
            both = [data.bins(experiment, psf, "r2", name, several) for name in ("sigma", "bias")]
            number = ratio_of(*(Number(value[k], error[k]) for value, error in both))
            out.append(
                measure(
                    "the same",
                    f"σ(R²) over the bias, {n_stars} stars, {data.words(experiment, k)}",
                    number,
                    0.9,
                    1.1,
                    under=under,
                )
            )
    return out


def opposite(data: Evidence) -> list[Measure]:
    """Numbers for the bias of the ellipticity."""
    out, psf = [], _most_elliptical(data, FIRST)
    if psf:
        out.append(measure("in proportion", f"δe over −e η ({psf})", _along(data, FIRST, psf), 0.9, 1.1))
    round_psf = [name for name in data.psfs(FIRST) if data.size_of(name) < _ROUND]
    for name in round_psf:
        both = [data.bins(FIRST, name, q, "bias") for q in ("e1", "e2")]
        means = [Number(abs(v.mean()), float(np.sqrt(np.sum(e**2)) / e.size)) for v, e in both]
        number = max(means, key=lambda one: one.value)
        out.append(measure("round", "mean bias of a component, round PSF", number, largest=2e-06))
    return out if round_psf else [*out, _missing("round")]


def few_stars(data: Evidence) -> list[Measure]:
    """Numbers for stacks of few stars."""
    psfs, out = data.psfs(FIRST), []
    if len(psfs) > 1 and data.size_of(psfs[-1]) - data.size_of(psfs[0]) > _DIFFERENT:
        means = []
        for psf in psfs:
            both = [data.bins(FIRST, psf, q, "sigma") for q in ("e1", "e2")]
            errors = np.concatenate([e for _, e in both])
            means.append(
                Number(np.mean([v.mean() for v, _ in both]), float(np.sqrt(np.sum(errors**2)) / errors.size))
            )
        values = [one.value for one in means]
        out.append(
            measure(
                "same error",
                "spread of σ(e) among PSFs",
                Number(max(values) / min(values) - 1, means[0].error / means[0].value),
                largest=0.05,
                slack=0.0,
            )
        )
    else:
        out.append(_missing("same error"))
    for experiment, under in ((FIRST, ""), (OTHER, AS_KCM16)):
        for psf in data.psfs(experiment)[:1]:
            k, n_stars = data.at(experiment, _FRACTION), data.n_stars(experiment)[0]
            value, error = data.bins(experiment, psf, "r2", "sigma")
            eta = data.eta(experiment, psf)[k]
            out.append(
                measure(
                    "error of the size",
                    f"σ(R²) over η, {n_stars} stars, {data.words(experiment, k)} ({_reading(experiment)})",
                    Number(value[k] / eta, error[k] / eta),
                    0.9,
                    1.1,
                    under=under,
                )
            )
    for psf in psfs[:1]:
        out.append(measure("biases", "bias of the size over η", _size_response(data, FIRST, psf), 0.95, 1.05))
    return out + [m for m in opposite(data) if m.part == "in proportion"]


def square_root(data: Evidence) -> list[Measure]:
    """Numbers for the scatter and the number of stars."""
    out = []
    for psf in data.psfs(MANY)[:1]:
        many, y, error = data.n_stars(MANY), [], []
        for n in many:
            both = [data.bins(MANY, psf, q, "sd", n) for q in ("e1", "e2")]
            square = np.mean([v**2 for v, _ in both])
            y.append(0.5 * math.log(square))
            error.append(
                math.sqrt(sum((np.sum((v * e) ** 2) for v, e in both))) / (square * 2 * both[0][0].size)
            )
        x = np.log(many) - np.mean(np.log(many))
        norm = x @ x
        out.append(
            measure(
                "power",
                "power of the number of stars in the scatter of the ellipticity",
                Number(float(x @ y / norm), float(np.sqrt(x**2 @ np.square(error)) / norm)),
                -0.52,
                -0.48,
            )
        )
    return out


def barely(data: Evidence) -> list[Measure]:
    """Numbers for how many stars are enough."""
    for psf in data.psfs(MANY):
        for q, e in zip(("e1", "e2"), data.ellipticity(psf), strict=True):
            if abs(abs(e) - 0.021) > 0.002:
                continue
            n, limit, out = data.n_stars(MANY)[-1], abs(e) * data.eta(MANY, psf), []
            value, error = data.bins(MANY, psf, q, "sigma", n)
            for k, under in ((data.at(MANY, _FRACTION), ""), (-1, _MOSTLY_PAIRS)):
                out.append(
                    measure(
                        "enough",
                        f"σ({q}) over its limit, {n} stars, {data.words(MANY, k)} ({psf})",
                        Number(value[k] / limit[k], error[k] / limit[k]),
                        1.0,
                        math.sqrt(2),
                        under=under,
                    )
                )
            return out
    return []


def not_averaged(data: Evidence) -> list[Measure]:
    """Numbers for averages over many stars."""
    out = []
    for psf in data.psfs(MANY)[:1]:
        few, many = data.n_stars(MANY)[0], data.n_stars(MANY)[-1]
        along = data.fractions(MANY)
        number = ratio_of(*(slope_of(along, *data.bins(MANY, psf, "r2", "bias", n)) for n in (many, few)))
        out.append(
            measure("stays", f"bias of the size with {many} stars over that with {few}", number, 0.95, 1.05)
        )
    return out


def population_changes(data: Evidence) -> list[Measure]:
    """Numbers for the departure from a line."""
    out = []
    for experiment in (FIRST, OTHER):
        for psf in data.psfs(experiment)[:1]:
            bend, words = _size_bend(data, experiment, psf), _reading(experiment)
            eta = data.eta(experiment, psf)
            of_x = bend_of(data.fractions(experiment), eta, np.zeros_like(eta))
            if experiment == FIRST:
                out.append(
                    measure(
                        "departs",
                        f"rise of δR²/F, without its sign ({words})",
                        Number(abs(bend.value), bend.error),
                        least=0.01,
                        slack=-N_SIGMA,
                    )
                )
            out.append(
                measure(
                    "the population",
                    f"rise of δR²/F less that of ⟨x⟩/F ({words})",
                    Number(bend.value - of_x.value, bend.error),
                    -0.02,
                    0.02,
                )
            )
    return out


def rounder(data: Evidence) -> list[Measure]:
    """Numbers for stacks rounder than their PSF."""
    out = []
    for psf in data.psfs(FIRST):
        if data.size_of(psf) > _ROUND:
            k = data.at(FIRST, _FRACTION)
            slope, eta = _along(data, FIRST, psf), data.eta(FIRST, psf)[k]
            out.append(
                measure(
                    "rounder",
                    f"change of the ellipticity over itself, {data.words(FIRST, k)} ({psf})",
                    Number(-slope.value * eta, slope.error * eta),
                    largest=0.0,
                    slack=-N_SIGMA,
                )
            )
    return out


def optical(data: Evidence) -> list[Measure]:
    """Numbers for optical PSFs."""
    experiment = OPTICAL if data.has(OPTICAL) else FIRST
    psfs, out = data.psfs(experiment), []
    limits: dict[str, Any] = {"least": 0.9, "largest": 1.1}
    for psf in psfs[-1:]:
        out.append(
            measure(
                "size", f"δR²/R² over η, adaptive ({psf})", _size_response(data, experiment, psf), **limits
            )
        )
        if data.size_of(psf) > _ROUND:
            out.append(
                measure(
                    "ellipticity", f"δe over −e η, adaptive ({psf})", _along(data, experiment, psf), **limits
                )
            )
    out += [
        measure(part, f"{words}, weight of 0.75″", data.named(name), under=UNWEIGHTED, **limits)
        for part, words, name in (
            ("size", "δR²/R² over η", "wide_size"),
            ("ellipticity", "δe over −e η", "wide_e"),
        )
    ]
    turned = [name for name in psfs if f"{name}-rotated" in psfs]
    for name in turned:
        both = [_size_response(data, experiment, one) for one in (f"{name}-rotated", name)]
        out.append(
            measure(
                "struts",
                "change of size with struts turned over that without",
                Number(both[0].value / both[1].value, both[0].error / both[0].value),
                0.98,
                1.02,
                slack=0.0,
            )
        )
    return out if turned else [*out, _missing("struts")]


def calibration(data: Evidence) -> list[Measure]:
    """Numbers for a calibration by the linear relation."""
    out = []
    for experiment, part in ((FIRST, "first PSFs"), (OPTICAL, "optical PSFs")):
        psf = _most_elliptical(data, experiment) if data.has(experiment) else None
        if psf is None:
            out.append(_missing(part))
            continue
        e, size = _along(data, experiment, psf), _size_response(data, experiment, psf)
        out.append(measure(part, f"−δe/e over δR²/R² ({psf})", ratio_of(e, size), 0.9, 1.1))
        out.append(
            measure(
                part,
                f"scatter of δe about the line beyond its noise, over it ({psf})",
                _scatter(data, experiment, psf, e.value),
                largest=0.1,
            )
        )
    return out


def _scatter(data: Evidence, experiment: str, psf: str, slope: float) -> Number:
    """Rms distance of the bias of the ellipticity from a line through its bins, less that of its noise."""
    e_0, eta = data.ellipticity(psf), data.eta(experiment, psf)
    square, noise, signal = [], [], []
    for q, e in zip(("e1", "e2"), e_0, strict=True):
        value, error = data.bins(experiment, psf, q, "bias")
        square.append((value + slope * e * eta) ** 2)
        noise.append(error**2)
        signal.append((e * eta) ** 2)
    mean, of_noise, of_signal = (float(np.mean(one)) for one in (square, noise, signal))
    excess = math.sqrt(max(mean - of_noise, 0.0) / of_signal)
    return Number(excess, math.sqrt(of_noise / of_signal / math.sqrt(2 * eta.size)))
