"""From the options of a command to what it shows: configurations checked, results as the contract names them."""

from __future__ import annotations

import tempfile
import warnings
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from porrima.colour import colour_bias, in_band, integrals_in_band
from porrima.config import PopulationConfig, parse
from porrima.distribution import size_distribution
from porrima.errors import InputError
from porrima.gaia import fetch_cone
from porrima.prediction import QUANTITIES, SeriesWarning, integrate, population_moments, predict
from porrima.sample import draw_stars, population_of
from porrima.uncertainty import NAMES, uncertainty

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from porrima.catalogs import Catalog
    from porrima.colour import Chromatic
    from porrima.integrals import PairIntegrals
    from porrima.prediction import Prediction
    from porrima.response import Response
    from porrima.stars import Stars
    from porrima.systems import Population

    FloatArray = NDArray[np.float64]

__all__ = [
    "COUNT_COLUMNS", "NUMBER_COLUMNS", "PREDICTED_COLUMNS", "colour_answer", "count_lines", "gaia_cone", "number_lines",
    "population_config", "predicted", "predicted_lines", "stars_answer",
]  # fmt: skip


@contextmanager
def gaia_cone(
    gaia: bool,
    l: float | None,
    b: float | None,
    radius: float | None,
    mag: tuple[float, float],
    save: Path | None,
    catalog: Path | None,
) -> Iterator[Path | None]:
    """File of a circle of Gaia's archive, which goes when it need not be saved; None where not asked for.

    Parameters
    ----------
    gaia : bool
        Whether it is asked for.
    l, b, radius : float or None
        Centre and radius of the circle, in deg.
    mag : (float, float)
        Range of G, in mag.
    save : Path or None
        Where the archive's table is to stay.
    catalog : Path or None
        Must not be given with `gaia`.

    Yields
    ------
    path : Path or None
        The table.

    Returns
    -------
    None
        A context manager.

    Raises
    ------
    InputError
        If options are missing, exclude each other, or the archive does not answer.
    """
    given = {"--catalog": catalog} if gaia else {"--radius": radius, "--save": save}
    for key, value in given.items():
        if value is not None:
            rule = "cannot be given together with --gaia" if gaia else "needs --gaia"
            raise InputError(rule, key=key, value=value)
    if not gaia:
        yield None
        return
    if l is None or b is None or radius is None:
        raise InputError("needs --l, --b and --radius", key="--gaia")

    with tempfile.TemporaryDirectory() as folder:
        path = save or Path(folder) / "gaia.ecsv"
        fetch_cone(l, b, radius, mag, path)
        yield path


def population_config(**options: Any) -> PopulationConfig:
    """Configuration from the options of a command, checked by the same rules as a file.

    Returns
    -------
    config : PopulationConfig
        Validated.

    Raises
    ------
    InputError
        Naming the option, the rule and the value.
    """
    where = ("l", "b", "catalog", "format", "map", "options", "band", "mag", "area")
    for name, rule in (("map", "column=name,column=name"), ("options", "option=value,option=value")):
        if options.get(name) is not None:
            parts = [part.split("=") for part in options[name].split(",")]
            if any(len(part) != 2 or not all(part) for part in parts):
                raise InputError(f"must be {rule}", key=f"--{name}", value=options[name])
            options[name] = dict(parts)
    for name in ("multiplicity", "photometry"):
        if str(options.get(name, "")).startswith("{"):
            options[name] = _model_with_options(name, options[name])
    chosen = options.get("selection")
    if chosen is not None:
        is_yaml = str(chosen).startswith(("{", "["))
        options["selection"] = _model_with_options("selection", chosen) if is_yaml else {"table": chosen}
    given = {key: value for key, value in options.items() if value is not None}
    stars = {key: value for key, value in given.items() if key in where}
    rest = {key: value for key, value in given.items() if key not in where}
    return parse(PopulationConfig, {"stars": stars} | rest)


def _model_with_options(name: str, text: str) -> Any:
    """A model with options as a configuration has it, such as {model: dk13, gap_rule: solar}."""
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        rule = (
            "a file, {clip: value, key: value} or a list of such"
            if name == "selection"
            else "a name or {model: name, option: value}"
        )
        raise InputError(f"must be {rule}", key=f"--{name}", value=text) from None


def predicted(
    config: PopulationConfig,
    reply: Response,
    binary_fraction: float | None,
    n_stars: int | None,
    waves: Chromatic | None = None,
) -> dict[str, Any]:
    """What `predict` shows.

    Parameters
    ----------
    config : PopulationConfig
        Stars and companions.
    reply : Response
        Of PSF and estimator.
    binary_fraction : float or None
        In [0, 1]; None for the model's own.
    n_stars : int or None
        In the stack (count); None for infinitely many.
    waves : Chromatic, optional
        What the wavelength does to the PSF, where the colour of companions is asked for.

    Returns
    -------
    answer : dict
        The keys of the contract: arcsec², arcsec⁴ and dimensionless.

    Raises
    ------
    InputError
        If the cut is too wide for kernel moments.
    """
    population = population_of(config, draw_stars(config), reply)
    fraction = None if binary_fraction is None else np.array([binary_fraction])
    integrals = integrate(population)
    moments = population_moments(population, integrals, fraction)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", SeriesWarning)
        prediction = predict(moments, reply, n_stars)
    if np.any(np.isnan(prediction.bias)):
        rule = (
            "is too wide for the kernel moments of this PSF, whose expansion stops being good at order "
            f"{prediction.last_order[0]}: use --estimator plain, or simulate --method images"
        )
        raise InputError(rule, key="--cut", value=config.cut)
    for warning in said:
        warnings.warn(warning.message, stacklevel=2)
    errors = {
        f"{name}_{quantity}": value
        for name in ("bias", "sigma", "sd")
        for quantity, value in zip(QUANTITIES, getattr(prediction, name)[:, 0], strict=True)
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SeriesWarning)  # said already
        known = _known(config, population, reply, binary_fraction, n_stars, integrals)
        known |= _quantiles(population, reply, binary_fraction, n_stars, integrals)
    return {
        "mean_x": moments.mean_x[0],
        "mean_x2": moments.mean_x2[0],
        "eta": prediction.eta[0],
        **errors,
        "n_stars": n_stars,
        "effective_n_stars": None if n_stars is None else n_stars * moments.effective_share[0],
        "binary_fraction": binary_fraction,
        "population_binary_fraction": moments.binary_fraction[0],
        "unresolved_fraction": moments.unresolved_fraction[0],
        "removed_fraction": moments.removed_fraction[0],
        "missed_fraction": moments.missed_fraction[0],
        "rejected_fraction": moments.rejected_fraction[0],
        "false_rejection_fraction": moments.false_rejection_fraction[0],
        "n_catalog_stars": len(population.primaries),
        **_spread(prediction),
        "quadrature_error": moments.relative_error[0],
        **known,
        **colour_answer(config, population, integrals, waves, float(reply.shape0.r2), fraction),
    }


def colour_answer(
    config: PopulationConfig,
    population: Population,
    integrals: PairIntegrals,
    waves: Chromatic | None,
    r2_0: float,
    binary_fraction: FloatArray | None,
) -> dict[str, Any]:
    """What the colour of companions does, beside what their separation does with flux ratios of the same band.

    Parameters
    ----------
    config : PopulationConfig
        Its photometry enters.
    population : Population
        The stars, in the band of their selection.
    integrals : PairIntegrals
        Of the same stars, dimensionless.
    waves : Chromatic or None
        Where None nothing is asked for.
    r2_0 : float
        Size of the PSF, in arcsec².
    binary_fraction : (1,) float array or None
        In [0, 1]; None for the model's own.

    Returns
    -------
    answer : dict
        Dimensionless; all None where nothing is asked for.
    """
    if waves is None:
        return dict.fromkeys(COLOUR_KEYS)
    here = in_band(population, config.photometry.build(), waves.band.name)
    of_pairs = integrals_in_band(here, integrals)
    found = colour_bias(here, waves, of_pairs, binary_fraction)
    eta = population_moments(here, of_pairs, binary_fraction).mean_x[0] / r2_0
    values = waves.band.name, waves.slope[2], eta, found.blind[2, 0], found.known[2, 0]
    return dict(zip(COLOUR_KEYS, values, strict=True))


def _spread(prediction: Prediction) -> dict[str, float]:
    """Covariance of e1, e2 and ln R², and the numbers of stars at which bias overtakes scatter."""
    names, c = ("e1", "e2", "lnr2"), prediction.log_covariance[..., 0]
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    return {f"covariance_{names[i]}_{names[j]}": float(c[i, j]) for i, j in pairs} | {
        f"crossover_n_stars_{quantity}": float(value)
        for quantity, value in zip(QUANTITIES, prediction.crossover_n_stars[:, 0], strict=True)
    }


def _known(
    config: PopulationConfig,
    population: Population,
    reply: Response,
    binary_fraction: float | None,
    n_stars: int | None,
    integrals: PairIntegrals,
) -> dict[str, Any]:
    """Interval of each quantity, and what moves eta; nothing for stars of unequal weight."""
    names = [f"{name}_{end}" for name in NAMES for end in ("low", "high")]
    if config.stack_weight != "equal":
        return dict.fromkeys([*names, "sources", "models"])
    found = uncertainty(
        population.primaries,
        reply,
        multiplicity=config.multiplicity.build(),
        photometry=config.photometry.build(),
        cut=config.cut,
        binary_fraction=binary_fraction,
        n_stars=n_stars,
        integrals=integrals,
        selection=population.selection,
    )
    ends = [end for name in NAMES for end in found.interval(name)]
    ranking = [{"source": source, "change": change} for source, change in found.ranking()]
    models = [{"model": name, "eta": float(values[0])} for name, values in found.models.items()]
    return dict(zip(names, ends, strict=True)) | {"sources": ranking, "models": models}


def _quantiles(
    population: Population,
    reply: Response,
    binary_fraction: float | None,
    n_stars: int | None,
    integrals: PairIntegrals,
) -> dict[str, Any]:
    """Quantiles of the size change of a stack of so many stars of equal weight."""
    if n_stars is None or n_stars > MOST_STARS or not np.all(population.weight == 1.0):
        return {"size_quantiles": None}
    found = size_distribution(population, reply, n_stars, binary_fraction, integrals)
    values = found.quantile(np.array(PROBABILITIES)).tolist()
    rows = [{"probability": p, "dr2_rel": v} for p, v in zip(PROBABILITIES, values, strict=True)]
    return {"size_quantiles": rows}


def predicted_lines(answer: dict[str, Any]) -> list[list[Any]]:
    """Lines of a prediction for the terminal: quantity, value, and the ends of its interval where it has one.

    Parameters
    ----------
    answer : dict
        From `predicted`: arcsec², arcsec⁴ and dimensionless.

    Returns
    -------
    lines : list of list
        Under `PREDICTED_COLUMNS`.
    """
    ends = ("_low", "_high")
    lines = []
    for key, value in answer.items():
        if isinstance(value, list) or key.endswith(ends) or (value is None and key in COLOUR_KEYS):
            continue
        known = [answer.get(key + end) for end in ends]
        lines.append([key, value, *("" if end is None else end for end in known)])
    for row in answer["size_quantiles"] or []:
        lines.append([f"dr2_rel at {row['probability']:g}", row["dr2_rel"], "", ""])
    for row in answer["models"] or []:
        lines.append([f"eta by {row['model']}", row["eta"], "", ""])
    for row in answer["sources"] or []:
        lines.append([f"eta moves by {row['source']}", row["change"], "", ""])
    return lines


PREDICTED_COLUMNS = ["quantity", "value", "low", "high"]

COLOUR_KEYS = ("colour_band", "colour_slope", "colour_eta", "colour_r2", "colour_r2_known")
"""Of what the colour of companions does: null where it is not asked for."""

PROBABILITIES = (0.05, 0.16, 0.5, 0.84, 0.95, 0.99)
"""At which the size change of a stack is given (dimensionless)."""

MOST_STARS = 100_000
"""Stars above which quantiles are those of a normal law, and finer than the lattice of `distribution` (count)."""

COUNT_COLUMNS = ["stars", "per deg²", "median distance [pc]", "mean mass [M_sun]", "multiplicity fraction"]


def stars_answer(
    stars: Stars, counts: list[dict[str, Any]], catalog: Catalog | None
) -> tuple[dict[str, Any], str]:
    """What `stars` shows: the keys of the contract, and a header for the terminal.

    Parameters
    ----------
    stars : Stars
        The selection.
    counts : list of dict
        From `Stars.counts`.
    catalog : Catalog or None
        Where they come from, with the account of its rows; None for the analytic Galaxy.

    Returns
    -------
    answer, header : dict, str
        Area in deg².
    """
    answer: dict[str, Any] = {"n": len(stars), "area_deg2": stars.area, "counts": counts}
    header = f"{len(stars)} stars, {stars.source}"
    if catalog is not None:
        answer |= {"rejected": dict(catalog.rejected), "assumed": dict(catalog.assumed)}
        for name in ("rejected", "assumed"):
            header += "".join(f"\n{name}: {count} {reason}" for reason, count in answer[name].items())
    return answer, header


def count_lines(counts: list[dict[str, Any]]) -> list[list[Any]]:
    """Lines of the counts for the terminal, under the band and `COUNT_COLUMNS`.

    Parameters
    ----------
    counts : list of dict
        From `Stars.counts`, mag.

    Returns
    -------
    lines : list of list
        One per magnitude.
    """
    return [[f"{c['mag_lo']:g}-{c['mag_hi']:g}", *list(c.values())[2:]] for c in counts]


NUMBER_COLUMNS = [
    "PSF", "quantity", "binary fraction", "stacks", "bias", "predicted", "sigma", "predicted", "sd", "predicted",
]  # fmt: skip


def number_lines(rows: list[dict[str, Any]]) -> list[list[Any]]:
    """Lines of a summary for the terminal: each number with its standard error, beside the prediction.

    Parameters
    ----------
    rows : list of dict
        From `summary.rows`, dimensionless.

    Returns
    -------
    lines : list of list
        Under `NUMBER_COLUMNS`.
    """
    return [
        [row["psf"], row["quantity"], f"{row['f_lo']:.2f}-{row['f_hi']:.2f}", row["n_stacks"]]
        + [
            text
            for name in ("bias", "sigma", "sd")
            for text in (
                f"{row[name]:.2e} ± {row[f'{name}_se']:.0e}",
                _predicted_text(row[f"prediction_{name}"]),
            )
        ]
        for row in rows
    ]


def _predicted_text(value: float) -> str:
    """A prediction with three figures; what symmetry makes 0 is not shown as its rounding error."""
    return "0" if abs(value) < 1e-12 else f"{value:.2e}"
