"""Which numbers decide on each statement of the paper, and within which limits they have to lie."""

from __future__ import annotations

from typing import TYPE_CHECKING

from porrima.evidence import N_SIGMA, READINGS, Number, measure, ratio_of
from porrima.instruments import EUCLID_VIS
from porrima.stack_rules import (
    AS_KCM16,
    UNWEIGHTED,
    barely,
    bias_is_error,
    calibration,
    few_stars,
    linear,
    not_averaged,
    opposite,
    optical,
    population_changes,
    rounder,
    square_root,
)  # fmt: skip
from porrima.star_rules import demography, mean_fraction, trends

if TYPE_CHECKING:
    from collections.abc import Callable

    from porrima.evidence import Evidence, Measure

__all__ = ["RULES"]


def _larger(data: Evidence) -> list[Measure]:
    return [
        measure(
            "less",
            "δR²/R² at 0.2″ over that at 0.137″, same pairs",
            data.named("larger"),
            largest=1.0,
            slack=-N_SIGMA,
        ),
        measure("as 1/R²", "the same times the ratio of R²", data.named("larger_law"), 0.95, 1.05),
        measure(
            "less",
            "δR²/R² at 0.2″ over that at 0.137″, cut in proportion",
            data.named("larger_scaled"),
            largest=1.0,
            slack=-N_SIGMA,
        ),
    ]


def _toy(data: Evidence) -> list[Measure]:
    if not data.has("toy"):
        return []
    found, (error, _) = (data.results["toy"]["findings"], data.named("toy_error"))
    equal, fainter = (float(one) for one in found["de_rel_at_0_01"][:2])
    return [
        measure("one per cent", "largest Δe/e at 0.01″, Δm = 0", Number(equal, error), least=0.01),
        measure(
            "same order", "the same at Δm = 1 over that at 0", Number(fainter / equal, error), 1 / 3, 3.0
        ),
        measure(
            "orientation",
            "difference of the maps of Δe/e between two PSFs, over their largest value",
            Number(float(found["e_depends_on_psf"]), error),
            least=0.1,
        ),
        measure(
            "no orientation",
            "the same for ΔR²/R²",
            Number(float(found["r2_depends_on_psf"]), error),
            largest=0.05,
        ),
    ]


def _sampled(data: Evidence) -> list[Measure]:
    out = []
    for name, words, under in (("adaptive", "adaptive", ""), ("wide", "weight of 0.75″", UNWEIGHTED)):
        change, share = data.named(f"sampled_{name}"), data.named(f"measured_{name}")
        pixels = f"on {EUCLID_VIS.pixel}″ pixels"
        out += [
            measure(
                "impact", f"change of size {pixels} over that without, {words}", change, 0.9, 1.1, under=under
            ),
            measure(
                "measurable",
                f"share of places in {EUCLID_VIS.pixel}″ pixels that are measured, {words}",
                share,
                0.9,
                under=under,
            ),
        ]
    return out


def _size_budget(data: Evidence) -> list[Measure]:
    limits: dict[int, dict[str, float]] = {
        16: {"least": 0.9},
        17: {"least": 0.9},
        18: {"least": 0.5, "largest": 0.7},
        20: {"largest": 0.2},
    }
    return [
        measure(
            f"{lo}–{lo + 1} mag",
            f"share of the budget of the size, Gaussian PSF, {lo} to {lo + 1} mag ({model})",
            data.named(f"size_share_{model}_{lo}"),
            under=under,
            **ends,
        )
        for model, under in zip(READINGS, ("", AS_KCM16), strict=True)
        for lo, ends in limits.items()
    ]


def _ellipticity_budget(data: Evidence) -> list[Measure]:
    return [
        measure(
            f"{lo}–{lo + 1} mag",
            f"share of the budget of the ellipticity, e = 0.05, {lo} to {lo + 1} mag ({model})",
            data.named(f"e_share_{model}_{lo}"),
            least=0.9,
            under=under,
        )
        for model, under in zip(READINGS, ("", AS_KCM16), strict=True)
        for lo in (16, 17)
    ] + [
        measure(
            "small",
            f"ellipticity whose bias takes all of the budget, 16 to 17 mag ({model})",
            data.named(f"e_for_all_{model}_16"),
            largest=0.05,
            under=under,
        )
        for model, under in zip(READINGS, ("", AS_KCM16), strict=True)
    ]


def _fainter(data: Evidence) -> list[Measure]:
    return [
        measure(
            "better",
            f"change of size at 18 to 19 mag over that at 20 to 21 ({model})",
            data.named(f"gain_{model}"),
            least=2.0,
            under=under,
        )
        for model, under in zip(READINGS, ("", AS_KCM16), strict=True)
    ]


def _sharper(data: Evidence) -> list[Measure]:
    return [
        measure(
            "more",
            f"change of size, Roman H158 over Euclid VIS, {words}",
            data.named(f"sharper_{name}"),
            least=1.0,
            slack=-N_SIGMA,
            under=under,
        )
        for name, words, under in (("adaptive", "adaptive", ""), ("unweighted", "unweighted", UNWEIGHTED))
    ]


def _resolved(data: Evidence) -> list[Measure]:
    separation, resolution = 50.0, 0.1
    return [
        measure(
            "distance",
            f"distance at which {separation:g} au are {resolution:g}″ [pc]",
            Number(separation / resolution, 0.0),
            2250.0,
            2750.0,
        )
    ]


def _triples(data: Evidence) -> list[Measure]:
    return [
        measure(
            "optimistic",
            f"⟨x⟩ with triples over that without ({model})",
            data.named(f"triples_{model}"),
            least=1.0,
            slack=-N_SIGMA,
        )
        for model in READINGS
    ]


def _varies(data: Evidence) -> list[Measure]:
    return [
        measure(
            "varies",
            f"range of δR²/R² among directions of b = 30° to 75°, over its mean ({model})",
            data.named(f"sky_variation_{model}"),
            least=0.02,
            slack=-N_SIGMA,
        )
        for model in READINGS
    ]


def _differential(data: Evidence) -> list[Measure]:
    out = []
    for model, under in zip(READINGS, ("", AS_KCM16), strict=True):
        needed, there = data.named(f"sky_stars_{model}"), data.named("field_stars")
        out += [
            measure(
                "more effect",
                f"δR²/R² of the direction with most binaries less that with fewest ({model})",
                data.named(f"sky_difference_{model}"),
                least=0.0,
                slack=-N_SIGMA,
                under=under,
            ),
            measure(
                "enough stars",
                f"stars needed in each field for five standard errors, over those in 1000 deg² ({model})",
                ratio_of(needed, there),
                largest=1.0,
                under=under,
            ),
        ]
    return out


def _images(data: Evidence) -> list[Measure]:
    return [
        measure(
            "helps",
            "η of all stars over that of those left by a clip at 1.6 % of their own size",
            data.named("clip_gain"),
            least=1.5,
        ),
        measure(
            "costs little", "share of the stars that the clip takes", data.named("clip_removed"), largest=0.1
        ),
    ]


def _gaia(data: Evidence) -> list[Measure]:
    return [
        measure(
            "helps",
            "η of all stars over that of those that Gaia’s flags leave, below the cut",
            data.named("gaia_gain"),
            least=1.05,
        )
    ]


RULES: dict[str, Callable[[Evidence], list[Measure]]] = {
    "1": linear,
    "2": bias_is_error,
    "3": opposite,
    "4": few_stars,
    "5": square_root,
    "6": barely,
    "7": not_averaged,
    "8": population_changes,
    "9": _larger,
    "10": rounder,
    "11": _toy,
    "12": optical,
    "13": _sampled,
    "14a": _size_budget,
    "14b": _ellipticity_budget,
    "15": _fainter,
    "16": _sharper,
    "17": mean_fraction,
    "18": demography,
    "19": _resolved,
    "20": trends,
    "21": _triples,
    "22a": calibration,
    "22b": _varies,
    "22c": _differential,
    "22d": _images,
    "22e": _gaia,
}
"""The numbers for each statement, by the number of the statement: 14 has two parts, 22 five."""
