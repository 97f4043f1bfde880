"""What a reader wants to know of an experiment, as single numbers: all that the report says in its sentences."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from porrima.config import canonical
from porrima.toy import headline

if TYPE_CHECKING:
    from porrima.experiments import EffectOfNStars, ErrorsAndBiases
    from porrima.instruments import Requirement

    Parts = dict[str, xr.Dataset]

__all__ = ["of_errors_and_biases", "of_magnitude", "of_n_stars", "of_population", "of_toy"]

_COMPARED = ("bias", "sigma", "sd")


def of_errors_and_biases(numbers: ErrorsAndBiases, requirement: Requirement) -> Parts:
    """Simulated and predicted numbers of a run, with what is found in them.

    Parameters
    ----------
    numbers : ErrorsAndBiases
        From `experiments.errors_and_biases` or `experiments.numbers_of_run`.
    requirement : Requirement
        The shares are of it.

    Returns
    -------
    parts : dict
        ``summary``, ``curves``, ``limit`` and ``findings``: single numbers at the binary fraction ``fraction``, over
        ``psf`` where they differ, dimensionless but for ``mean_x`` [arcsec²]; its attributes are the configuration
        and the requirement.
    """
    here = numbers.curves.sel(binary_fraction=numbers.fraction, method="nearest", drop=True)
    limit = numbers.limit.sel(binary_fraction=numbers.fraction, method="nearest", drop=True)
    ends = ["e1", "e2"]
    bias_r2 = limit["bias"].sel(quantity="r2", drop=True)
    bias_e = abs(limit["bias"].sel(quantity=ends)).max("quantity")
    n_failed, n_stacks = numbers.summary["n_failed"].sum("bin"), numbers.summary["n_stacks"].sum()
    widest = [int(np.argmax(np.nan_to_num(np.abs(bias.to_numpy())))) for bias in (bias_r2, bias_e)]
    findings = {
        "fraction": numbers.fraction,
        "mean_x": numbers.mean_x,
        "removed_fraction": numbers.removed_fraction,
        "n_stacks": n_stacks,
        "failed_share": (n_failed / n_stacks).max(),
        "bias_r2": bias_r2,
        "bias_e": bias_e,
        "sd_r2": here["sd"].sel(quantity="r2", drop=True),
        "sd_e": here["sd"].sel(quantity=ends).max("quantity"),
        "largest_sd_r2": here["sd"].sel(quantity="r2", drop=True).max(),
        "largest_sd_e": here["sd"].sel(quantity=ends).max(),
        "widest_bias_r2": bias_r2.isel(psf=widest[0], drop=True),
        "widest_bias_e": bias_e.max(),
        **_agreement(numbers.summary),
    }
    if requirement.sigma_r2 is not None:
        shares = abs(bias_r2) / requirement.sigma_r2
        findings |= {"required_r2": requirement.sigma_r2, "least_share_r2": shares.min()}
        findings |= {"largest_share_r2": shares.max()}
    if requirement.sigma_e is not None:
        findings |= {"required_e": requirement.sigma_e, "largest_share_e": bias_e.max() / requirement.sigma_e}
    about = {
        "config": canonical(numbers.config),
        "requirement": requirement.name,
        "source": requirement.source,
        "widest_r2": numbers.config.psf[widest[0]],
        "widest_e": numbers.config.psf[widest[1]],
    }
    return {
        "summary": numbers.summary,
        "curves": numbers.curves,
        "limit": numbers.limit,
        "findings": xr.Dataset(findings, attrs=about),
    }


def of_n_stars(numbers: EffectOfNStars, requirement: Requirement) -> Parts:
    """Numbers of stacks of few and many stars, with what is found in them.

    Parameters
    ----------
    numbers : EffectOfNStars
        From `experiments.effect_of_n_stars`.
    requirement : Requirement
        Drawn beside them.

    Returns
    -------
    parts : dict
        ``numbers``, ``limit`` and ``findings``, dimensionless.
    """
    findings = _agreement(numbers.numbers) | {
        "n_stacks": numbers.numbers.attrs["n_stacks"],
        "required_e": np.nan if requirement.sigma_e is None else requirement.sigma_e,
    }
    return {"numbers": numbers.numbers, "limit": numbers.limit, "findings": xr.Dataset(findings)}


def of_population(sky: xr.Dataset) -> Parts:
    """Mass classes and binary fraction over the sky, with what is found in them.

    Parameters
    ----------
    sky : Dataset
        From `star_experiments.population`.

    Returns
    -------
    parts : dict
        ``sky`` and ``findings``: least and largest mean binary fraction for each way to fill the gaps of the table,
        and the largest share of stars that the photometry leaves out, dimensionless.
    """
    fractions = sky["binary_fraction"]
    findings: dict[str, xr.DataArray] = {}
    for rule in fractions["gap_rule"].to_numpy().tolist():
        here = fractions.sel(gap_rule=rule, drop=True)
        findings |= {f"least_{rule}": here.min(), f"largest_{rule}": here.max()}
    findings["bright_limit"] = sky["bright_limit"].max()
    return {"sky": sky, "findings": xr.Dataset(findings)}


def of_magnitude(magnitude: xr.Dataset) -> Parts:
    """Mean x and errors against magnitude, with what is found in them.

    Parameters
    ----------
    magnitude : Dataset
        From `experiments.against_magnitude`.

    Returns
    -------
    parts : dict
        ``magnitude`` and ``findings``: the error of the size behind the first PSF in the bin at 18 mag over that at
        20 mag for each model (``gain``, over ``model``), dimensionless.
    """
    size = magnitude["limit_r2"].isel(psf=0, drop=True)
    bins = [int(np.argmin(np.abs(magnitude["mag_lo"].to_numpy() - mag))) for mag in (18.0, 20.0)]
    bright, faint = (size.isel(bin=k).drop_vars(["mag_lo", "mag_hi"]) for k in bins)
    gain = bright / faint
    return {"magnitude": magnitude, "findings": xr.Dataset({"gain": gain})}


def of_toy(maps: xr.Dataset) -> Parts:
    """Maps of the toy model, with what is found in them.

    Parameters
    ----------
    maps : Dataset
        From `toy.toy_maps`.

    Returns
    -------
    parts : dict
        ``maps`` and ``findings``: the numbers of `toy.headline`, those of a contrast over ``delta_m`` [mag].
    """
    found = headline(maps)
    contrasts = found.pop("contrasts")
    of_contrast = {
        name: ("delta_m", [row[name] for row in contrasts]) for name in contrasts[0] if name != "delta_m"
    }
    findings = xr.Dataset(
        of_contrast | found,
        coords={"delta_m": [row["delta_m"] for row in contrasts]},
        attrs={"fwhm": maps.attrs["fwhm"], "ellipticity": maps.attrs["ellipticity"]},
    )
    return {"maps": maps, "findings": findings}


def _agreement(summary: xr.Dataset) -> dict[str, float]:
    """Largest difference between simulation and prediction in standard errors, and of how many numbers."""
    pulls = {
        name: abs((summary[name] - summary[f"prediction_{name}"]) / summary[f"{name}_se"])
        for name in _COMPARED
    }
    found = {f"pull_{name}": float(pull.max()) for name, pull in pulls.items()}
    found["pull"] = max((pull for pull in found.values() if np.isfinite(pull)), default=np.nan)
    return found | {"n_compared": float(sum(int(pull.notnull().sum()) for pull in pulls.values()))}
