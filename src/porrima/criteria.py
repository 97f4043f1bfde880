"""What else a survey rejects, as a configuration says it: a clip, a table, what its images or Gaia's flags show."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

__all__ = ["OPTIONS", "SelectionConfig"]

OPTIONS: dict[str, tuple[str, ...]] = {
    "clip": ("quantity", "noise", "psf"),
    "table": (),
    "detection": ("exposures", "false_alarm", "statistic", "psf", "pixel", "psf_error"),
    "gaia": ("ruwe_max", "multi_peak", "false_alarm", "colour"),
}
"""Kinds of selections, of which each has one, and the options of each."""


class SelectionConfig(BaseModel):
    """One selection; several stand in a list, and what is kept are the products of what each keeps."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    clip: float | None = Field(default=None, gt=0, le=0.2)  # largest change of a star's own shape
    table: Path | None = None  # of the user's own
    detection: Literal["euclid-vis", "roman-h158"] | None = None  # exposures on which pairs are recognised
    gaia: Literal["dr3"] | None = None  # release whose flags are heeded
    quantity: Literal["r2", "e"] | None = None  # that is clipped; r2
    noise: float | dict[float, float] | None = None  # sigma of the change, or sigma by magnitude
    psf: str | None = None  # that stars are clipped, or pairs recognised, behind
    pixel: float | None = Field(default=None, gt=0, allow_inf_nan=False)  # arcsec, with which it is convolved
    exposures: int | None = Field(default=None, ge=1, le=100, strict=True)  # of each star; the survey's
    false_alarm: float | None = Field(default=None, gt=0, lt=1)  # share of single stars taken for pairs
    statistic: Literal["shape", "residuals"] | None = None
    psf_error: float | None = Field(default=None, ge=0, lt=1)  # of the known PSF in R², e1 and e2
    ruwe_max: float | None = Field(default=None, gt=1)
    multi_peak: bool | None = Field(default=None, strict=True)
    colour: float | None = Field(default=None, allow_inf_nan=False)  # magnitude of the stars' band minus G

    @model_validator(mode="after")
    def _one_kind(self) -> SelectionConfig:
        kinds = [name for name in OPTIONS if getattr(self, name) is not None]
        if not kinds:
            raise ValueError(f"must have one of {', '.join(OPTIONS)}")
        if len(kinds) > 1:
            raise ValueError(f"must have one of {' and '.join(kinds)}; several selections make a list")
        for name in type(self).model_fields:
            if name not in (kinds[0], *OPTIONS[kinds[0]]) and getattr(self, name) is not None:
                raise ValueError(f"has {name}, which is no option of {kinds[0]}")
        if self.pixel is not None and self.psf is None:
            raise ValueError("must have psf, too, where it has pixel")
        return self

    @field_validator("noise")
    @classmethod
    def _sigma(cls, value: Any) -> Any:
        sigmas = value.values() if isinstance(value, dict) else [0.0 if value is None else value]
        if not sigmas or not all(
            0 <= s < math.inf and (s > 0 or not isinstance(value, dict)) for s in sigmas
        ):
            raise ValueError(f"must be a positive sigma, or one for each magnitude, got {value}")
        return value

    def within(self, folder: Path) -> SelectionConfig:
        """The selection with its table in a folder, where the table's path is relative.

        Parameters
        ----------
        folder : Path
            Of the file that the configuration is in.

        Returns
        -------
        selection : SelectionConfig
            With an absolute path; the same where there is no table.
        """
        if self.table is None:
            return self
        return self.model_copy(update={"table": (folder / self.table).resolve()})

    def given(self, *names: str) -> dict[str, Any]:
        """Values of those options that are given.

        Parameters
        ----------
        *names : str
            Options.

        Returns
        -------
        values : dict
            By name.
        """
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}
