"""The configuration of a run: validated YAML, every error naming its key.

What each key means, with its unit and default, is said under `porrima simulate` and `porrima budget` in the reference
of the commands.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from porrima.criteria import SelectionConfig
from porrima.errors import InputError

__all__ = [
    "EXAMPLE", "GalaxiesConfig", "Multiplicity", "PopulationConfig", "RequirementConfig", "RunConfig",
    "SelectionConfig", "StarsConfig", "load", "load_requirement", "parse",
]  # fmt: skip

Model = TypeVar("Model", bound=BaseModel)

EXAMPLE = """\
stars: {l: 180, b: 45, band: i, mag: [18, 19]}     # or {catalog: FILE, format: besancon, mag: [18, 19]}
multiplicity: dk13                                  # or {model: dk13, gap_rule: solar, a_max_factor: 2.5, ...}
photometry: main-sequence                           # or habets-heintze, {model: habets-heintze, branch: primary}
cut: 0.05                                           # arcsec
# selection: {clip: 0.016, noise: 0.004, psf: psf0}   # or {table: FILE}, {detection: euclid-vis}, {gaia: dr3}, a list
stack_weight: equal                                 # or flux
psf: [psf0, psf1, psf2]
estimator: adaptive                                 # or plain, gaussian:0.75
n_stars: 40
n_stacks: 100000
binary_fraction: uniform                            # uniform (0 to 1, one value per stack), model, or a number
seed: 1
"""
"""What ``porrima simulate --example`` prints."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class StarsConfig(_Strict):
    """Where the stars come from: the analytic Galaxy in a direction, or a catalogue."""

    l: float | None = Field(default=None, ge=0, lt=360)
    b: float | None = Field(default=None, ge=-90, le=90)  # Galactic latitude, deg
    n_drawn: int = Field(
        default=20_000, ge=1, le=10**8, strict=True
    )  # stars drawn from the Galaxy in the magnitude range
    area: float | None = Field(
        default=None, gt=0, le=41253
    )  # deg²: a Poisson number of stars fills it instead
    catalog: Path | None = None
    format: str | None = None
    map: dict[str, str] | None = None  # Porrima's column: the file's column
    options: dict[str, str | float] | None = None  # of the catalogue's format
    band: str | None = None  # i, or the catalogue's own
    mag: tuple[float, float]

    @model_validator(mode="after")
    def _one_source(self) -> StarsConfig:
        direction = self.l is not None and self.b is not None
        if direction == (self.catalog is not None) or (self.l is None) != (self.b is None):
            raise ValueError("must have either a direction (l and b) or a catalogue")
        if not -50 <= self.mag[0] < self.mag[1] <= 50:
            raise ValueError(f"mag must be [lo, hi) with lo < hi, within -50 to 50, got {list(self.mag)}")
        return self


class Multiplicity(_Strict):
    """A named multiplicity model with any of its options changed."""

    model: str = "dk13"
    gap_rule: Literal["lower", "solar", "nearest", "interpolated"] | None = None
    a_max_factor: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    scatter_scale: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    projection: Literal["isotropic", "inclination-uniform"] | None = None
    mass_ratio_min: float | None = Field(default=None, gt=0, lt=1)
    eccentricity: Literal["circular", "uniform", "thermal", "mds17"] | None = None
    metallicity: Literal["none", "moe19"] | None = None
    triples: bool | None = None

    def build(self) -> Any:
        """The model itself.

        Returns
        -------
        model : MultiplicityModel
            The named one with the options given.

        Raises
        ------
        InputError
            If no model has that name, or an option is wrong for it.
        """
        from porrima.multiplicity import MULTIPLICITY  # noqa: PLC0415  (compiled code, where used)

        named = known("multiplicity", self.model, MULTIPLICITY)
        options = self.model_dump(exclude={"model"}, exclude_unset=True)
        own = {field.name for field in dataclasses.fields(named)}
        for name in options.keys() - own:
            raise InputError(
                f"is no option of {self.model}, which has {', '.join(sorted(own))}",
                key=f"multiplicity.{name}",
            )
        try:
            return dataclasses.replace(named, **options)
        except (TypeError, ValueError) as error:
            raise InputError(str(error), key="multiplicity") from None


class Photometry(_Strict):
    """A named mass-luminosity relation with any of its options changed."""

    model: str = "main-sequence"
    branch: Literal["own", "primary"] | None = None

    def build(self) -> Any:
        """The relation itself.

        Returns
        -------
        relation : MassLuminosity
            The named one with the options given.

        Raises
        ------
        InputError
            If no relation has that name, or it has no such option.
        """
        from porrima.photometry import PHOTOMETRY, HabetsHeintze1981  # noqa: PLC0415  (compiled code)

        named = known("photometry", self.model, PHOTOMETRY)
        if self.branch is None:
            return named
        if not isinstance(named, HabetsHeintze1981):
            raise InputError(
                "is an option of habets-heintze only", key="photometry.branch", value=self.branch
            )
        return dataclasses.replace(named, branch=self.branch)


class PopulationConfig(_Strict):
    """Stars, companions and what is resolved."""

    stars: StarsConfig
    multiplicity: Multiplicity = Multiplicity()
    photometry: Photometry = Photometry()
    cut: float = Field(default=0.05, gt=0, allow_inf_nan=False)
    selection: tuple[SelectionConfig, ...] | None = None  # all at work
    stack_weight: Literal["equal", "flux"] = "equal"
    seed: int = Field(default=1, ge=0, lt=2**64, strict=True)

    @field_validator("multiplicity", "photometry", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        return {"model": value} if isinstance(value, str) else value

    @field_validator("selection", mode="before")
    @classmethod
    def _one_or_several(cls, value: Any) -> Any:
        if isinstance(value, list) and not value:
            raise ValueError("must hold at least one selection")
        return (value,) if isinstance(value, dict | SelectionConfig) else value


class RunConfig(PopulationConfig):
    """A whole run of `porrima simulate`."""

    psf: tuple[str, ...] = Field(default=("psf0", "psf1", "psf2"), min_length=1)
    pixel: float | None = Field(default=None, gt=0, allow_inf_nan=False)  # arcsec, convolved with each PSF
    pixel_scale: float | None = Field(default=None, gt=0, allow_inf_nan=False)  # arcsec, of FITS images
    jitter: float | None = Field(default=None, gt=0, allow_inf_nan=False)  # arcsec, sigma of a Gaussian
    estimator: str = "adaptive"
    n_stars: int = Field(default=40, ge=1, le=10**9, strict=True)
    n_stacks: int = Field(default=100_000, ge=1, le=10**10, strict=True)
    binary_fraction: float | Literal["uniform", "model"] = "uniform"

    @property
    def psf_options(self) -> dict[str, Any]:
        """What `psf.psf_from_name` is to add to each PSF, in arcsec."""
        return {"pixel": self.pixel, "pixel_scale": self.pixel_scale, "jitter": self.jitter}

    @field_validator("psf", mode="before")
    @classmethod
    def _one_or_more(cls, value: Any) -> Any:
        return (value,) if isinstance(value, str) else value

    @field_validator("psf")
    @classmethod
    def _distinct(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(value)) < len(value):
            raise ValueError(f"must name each PSF once, got {', '.join(value)}")
        return value

    @field_validator("binary_fraction", mode="before")
    @classmethod
    def _fraction(cls, value: Any) -> Any:
        if value in ("uniform", "model"):
            return value
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not 0 <= value <= 1:
            raise ValueError(f"must be in [0, 1], uniform or model, got {value}")
        return float(value)


class RequirementConfig(_Strict):
    """Requirements of a user's own; what is not given is not required."""

    name: str = "own"
    sigma_e: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    sigma_r2: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    m: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    c: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    source: str = "not stated"

    @model_validator(mode="after")
    def _some(self) -> RequirementConfig:
        if all(value is None for value in (self.sigma_e, self.sigma_r2, self.m, self.c)):
            raise ValueError("must have at least one of sigma_e, sigma_r2, m, c")
        return self


class GalaxiesConfig(_Strict):
    """Galaxies whose shear is measured: one size, a law of sizes, or a table of them."""

    half_light_radius: float | None = Field(
        default=None, gt=0, allow_inf_nan=False
    )  # arcsec; the law's median
    scatter: float = Field(default=0.0, ge=0, allow_inf_nan=False)  # of log10 of the radius, dex
    smallest: float = Field(default=0.0, ge=0, allow_inf_nan=False)  # radius, arcsec
    file: Path | None = None
    index: float = Field(default=1.0, ge=0.3, le=6.2)  # Sersic
    mean_e2: float = Field(default=0.16, ge=0, lt=1)

    @model_validator(mode="after")
    def _one_source(self) -> GalaxiesConfig:
        if (self.half_light_radius is None) == (self.file is None):
            raise ValueError("must have either half_light_radius or a file")
        return self


class _UniqueKeys(yaml.SafeLoader):
    """YAML whose keys may stand only once."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for k, key in enumerate(keys):
            if key in keys[:k]:
                mark = node.value[k][0].start_mark
                raise yaml.constructor.ConstructorError(None, None, f"key {key} stands twice", mark)
        return super().construct_mapping(node, deep)


def known(key: str, name: str, choices: Any) -> Any:
    """The value of a name in a visible dict of models.

    Parameters
    ----------
    key : str
        Key or option that the name was given for.
    name : str
        The name.
    choices : dict
        Names and models.

    Returns
    -------
    value : object
        ``choices[name]``.

    Raises
    ------
    InputError
        If the name is not there; the nearest one is suggested.
    """
    if name not in choices:
        near = difflib.get_close_matches(str(name), list(choices), n=1)
        hint = f" (did you mean {near[0]}?)" if near else ""
        raise InputError(f"must be one of {', '.join(choices)}{hint}", key=key, value=name)
    return choices[name]


def load(path: Path) -> RunConfig:
    """Configuration read from a YAML file.

    Parameters
    ----------
    path : Path
        The file; a relative ``catalog`` or ``table`` in it is relative to its folder.

    Returns
    -------
    config : RunConfig
        Validated.

    Raises
    ------
    InputError
        If the file cannot be read, is not YAML, or a key or value in it is wrong.
    """
    config = parse(RunConfig, _mapping(path), source=path)
    if config.stars.catalog is not None:
        stars = config.stars.model_copy(update={"catalog": path.parent / config.stars.catalog})
        config = config.model_copy(update={"stars": stars})
    if config.selection is not None:
        selection = tuple(one.within(path.parent) for one in config.selection)
        config = config.model_copy(update={"selection": selection})
    return config


def load_requirement(path: Path) -> RequirementConfig:
    """Requirements read from a YAML file.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    requirement : RequirementConfig
        Validated, dimensionless.

    Raises
    ------
    InputError
        As `load`.
    """
    return parse(RequirementConfig, _mapping(path), source=path)


def _mapping(path: Path) -> dict[str, Any]:
    """Keys and values of a YAML file."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", source=path) from None
    except UnicodeDecodeError:
        raise InputError("must be a UTF-8 text file", source=path) from None
    try:
        data = yaml.load(text, _UniqueKeys)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        row = mark.line + 1 if mark else None
        raise InputError(f"is not YAML ({getattr(error, 'problem', error)})", source=path, row=row) from None
    if not isinstance(data, dict):
        raise InputError("must hold keys and values", source=path, value=type(data).__name__)
    return data


def parse(model: type[Model], data: Any, source: Path | None = None) -> Model:
    """Validated configuration.

    Parameters
    ----------
    model : type
        `RunConfig` or another model of this module.
    data : dict
        Keys and values.
    source : Path, optional
        File they come from, for messages.

    Returns
    -------
    config : model
        Validated, frozen.

    Raises
    ------
    InputError
        For the first key that is wrong: its dotted name, the rule and the value.
    """
    try:
        return model.model_validate(data)
    except ValidationError as failure:
        errors = failure.errors(include_url=False)
        misspelt = [
            e for e in errors if e["type"] == "extra_forbidden"
        ]  # tells more than the key it stood for
        error = (misspelt or errors)[0]
        location = _place(error["loc"], data)
        key = ".".join(location) or None
        if error["type"] == "extra_forbidden":
            near = difflib.get_close_matches(location[-1], _keys(model, location[:-1]), n=1, cutoff=0.5)
            hint = f" (did you mean {near[0]}?)" if near else ""
            raise InputError(f"is not a key{hint}", source=source, key=key) from None
        if error["type"] == "missing":
            raise InputError("is missing", source=source, key=key) from None
        if error["type"] == "value_error":
            raise InputError(error["msg"].removeprefix("Value error, "), source=source, key=key) from None
        rule = error["msg"].replace("Input should be", "must be")
        raise InputError(rule, source=source, key=key, value=error["input"]) from None


def canonical(config: BaseModel) -> str:
    """One line of JSON with sorted keys that identifies a configuration.

    Parameters
    ----------
    config : BaseModel
        Any configuration.

    Returns
    -------
    text : str
        The same for equal configurations.
    """
    data = config.model_dump(mode="json", exclude_none=True)
    for name in ("multiplicity", "photometry"):  # where an option that is null says something
        model = getattr(config, name, None)
        if model is not None:
            data[name] = {"model": model.model} | model.model_dump(mode="json", exclude_unset=True)
    return json.dumps(data, sort_keys=True)


def _place(location: tuple[int | str, ...], data: Any) -> list[str]:
    """Keys and numbers that lead to a value, without the number of one that stands alone for a list."""
    out = []
    for part in location:
        if isinstance(part, int) and not isinstance(data, list | tuple):
            continue
        out.append(str(part))
        data = data.get(part) if isinstance(data, dict) else data[part] if isinstance(part, int) else None
    return out


def _keys(model: type[BaseModel], location: list[str]) -> list[str]:
    """Names of the keys at a place inside a model."""
    for part in location:
        if part.isdigit():  # in a list of one kind
            continue
        inner: Any = model.model_fields[part].annotation if part in model.model_fields else None
        while get_args(inner):
            inner = next(kind for kind in get_args(inner) if kind is not type(None))
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return []
        model = inner
    return list(model.model_fields)
