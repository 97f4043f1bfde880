"""The report: one page that needs no network, and the figures and tables beside it, from saved numbers only."""

from __future__ import annotations

import json
import platform
from typing import TYPE_CHECKING, Any

import yaml

from porrima import __version__
from porrima.archive import fingerprint, source_key, versions
from porrima.bibliography import bibliography, keys_of
from porrima.cache import content_key
from porrima.config import RunConfig, parse
from porrima.diagrams import against_magnitude, pair_sketch
from porrima.drawing import drawing, svg_of
from porrima.figures import at_one_fraction, effect_of_n_stars, errors_and_biases, toy_maps
from porrima.files import write_json, write_whole
from porrima.galaxy import Robin2003
from porrima.instruments import KCM16
from porrima.io import write_figure, write_rows
from porrima.page import Configuration, Page, PageFigure, Section, claims_from, html, words
from porrima.shapes import estimator_from_name
from porrima.star_figures import population
from porrima.tabulation import claim_numbers, table_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    import xarray as xr
    from markupsafe import Markup
    from matplotlib.figure import Figure

    Parts = dict[str, xr.Dataset]

__all__ = ["write_paper", "write_run"]

_TITLES = {
    "toy": "One companion anywhere",
    "sketch": "A pair",
    "multiplicity_table": "The multiplicity table",
    "population": "The stars",
    "psf_table": "The PSFs",
    "errors_and_biases": "Errors and biases against binary fraction",
    "effect_of_n_stars": "Number of stars in a stack",
    "errors_and_biases_kcm16": "The other reading of the multiplicity table",
    "errors_and_biases_optical": "Optical PSFs",
    "magnitude": "Against magnitude",
}
_KINDS = (
    "toy",
    "sketch",
    "multiplicity_table",
    "population",
    "psf_table",
    "magnitude",
)  # alone of their kind
_WITHOUT_SECTION = ("statements",)  # whose numbers stand with the claims
_ONE = "Bias and scatter at one binary fraction"


def write_paper(
    results: Mapping[str, Parts],
    folder: Path,
    claims: Sequence[Mapping[str, Any]] = (),
    numbers: Sequence[Mapping[str, Any]] = (),
) -> Path:
    """Path of the page of the paper, with its figures (SVG, PDF, PNG) and tables (ECSV) beside it.

    Parameters
    ----------
    results : dict
        Datasets of each experiment, from `programme.carried_out`.
    folder : Path
        Where to write; it exists.
    claims : sequence of dict
        Records with the keys of `page.Claim`.  Without any the section is left out.
    numbers : sequence of dict
        All numbers behind the claims, from `claims.numbers_of`.

    Returns
    -------
    page : Path
        ``index.html`` in the folder.

    Raises
    ------
    ValueError
        If a claim is not whole.
    """
    stated, sections = claims_from(claims), []
    for name, parts in results.items():
        if name in _WITHOUT_SECTION:
            continue
        section = _section(name, parts, _drawn(name, parts, folder))
        for table in section.tables:
            write_rows(table.records, folder / f"{table.name}.ecsv")
        sections.append(section)
    behind = claim_numbers(numbers) if numbers else None
    if claims:
        _write_claims(claims, behind.records if behind else [], folder)
    runs = {name: parts["findings"] for name, parts in results.items() if "config" in parts["findings"].attrs}
    page = Page(
        title="Errors and biases of the PSF from unresolved binary stars",
        subtitle="The figures of Kuntzer, Courbin & Meylan (2016), simulated and predicted",
        sections=tuple(sections),
        claims=stated,
        claim_numbers=behind,
        **_said(results["errors_and_biases"]["findings"]),
        **_provenance(runs),
    )
    return _written(page, folder / "index.html")


def write_run(parts: Parts, name: str, path: Path) -> Path:
    """Path of the page of one run.

    Parameters
    ----------
    parts : dict
        From `findings.of_errors_and_biases`.
    name : str
        Of the run.
    path : Path
        The file, replaced if it exists.

    Returns
    -------
    page : Path
        The same path.
    """
    page = Page(
        title=f"The run {name}",
        subtitle="What unresolved binary stars do to the PSF of its stacks, simulated and predicted",
        sections=(_section("errors_and_biases", parts, svg_of(_drawing_of("errors_and_biases", parts))),),
        **_said(parts["findings"]),
        **_provenance({name: parts["findings"]}),
    )
    return _written(page, path)


def _written(page: Page, path: Path) -> Path:
    text = html(page)
    write_whole(path, lambda unfinished: unfinished.write_text(text, encoding="utf-8"))
    return path


def _write_claims(
    claims: Sequence[Mapping[str, Any]], numbers: Sequence[Mapping[str, Any]], folder: Path
) -> None:
    """Claims and the numbers behind them as ECSV, and all in one JSON file, in which what is no number is null."""
    both = {"claims": claims, "numbers": numbers}
    for name, records in zip(("claims", "claim_numbers"), both.values(), strict=True):
        if records:
            write_rows([dict(record) for record in records], folder / f"{name}.ecsv")
    whole = {name: [dict(record) for record in records] for name, records in both.items()}
    write_json(whole, folder / "claims.json")


def _said(findings: xr.Dataset) -> dict[str, Any]:
    """What was asked of a run, and the answer."""
    found, config = _numbers(findings), _config(findings)
    return {
        "asked": tuple(words(name, found, config) for name in ("asked", "setting")),
        "answer": words("answer", found, config, findings.attrs),
    }


def _provenance(runs: Mapping[str, xr.Dataset]) -> dict[str, Any]:
    """Configurations, versions and references of some runs."""
    keys = {"KCM16"}.union(*(_keys(_config(findings)) for findings in runs.values()))
    configurations = [
        Configuration(
            name=_TITLES.get(name, name),
            file=f"{name}.yaml",
            text=yaml.safe_dump(json.loads(findings.attrs["config"]), sort_keys=False, allow_unicode=True),
        )
        for name, findings in runs.items()
    ]
    return {
        "configurations": tuple(configurations),
        "versions": {"porrima": __version__, "python": platform.python_version()} | versions(),
        "references": bibliography(keys),
    }


def _keys(config: RunConfig) -> set[str]:
    """Papers that the models of a run ask to be cited."""
    companions = config.multiplicity.build()
    keys = keys_of(companions, config.photometry.build(), estimator_from_name(config.estimator))
    keys |= {"MoeDiStefano2017"} if getattr(companions, "eccentricity", "") == "mds17" else set()
    keys |= {"Moe2019"} if getattr(companions, "metallicity", "") == "moe19" else set()
    return keys if config.stars.catalog else keys | keys_of(Robin2003)


def _config(findings: xr.Dataset) -> RunConfig:
    return parse(RunConfig, json.loads(findings.attrs["config"]))


def _numbers(findings: xr.Dataset) -> dict[str, Any]:
    """Findings as plain numbers; those over an axis by its labels."""
    return {
        str(name): {
            str(label): float(one)
            for label, one in zip(values[values.dims[0]].to_numpy(), values, strict=True)
        }
        if values.dims
        else float(values)
        for name, values in findings.data_vars.items()
    }


def _drawn(name: str, parts: Parts, folder: Path) -> str | None:
    """The figure of an experiment as SVG, drawn to its files unless they show the same numbers already."""
    if _kind(name, parts) not in _FIGURES:
        return None
    files = [folder / f"{name}.{suffix}" for suffix in ("svg", "pdf", "png")]
    note = folder / f".{name}.key"
    key = content_key(fingerprint(parts), source_key("figures", "star_figures", "diagrams", "drawing"))
    if not all(file.is_file() for file in (*files, note)) or note.read_text(encoding="ascii") != key:
        figure = _drawing_of(name, parts)
        svg = svg_of(figure)
        write_whole(files[0], lambda unfinished: unfinished.write_text(svg, encoding="utf-8"))
        for file in files[1:]:
            write_figure(figure, file)
        write_whole(note, lambda unfinished: unfinished.write_text(key, encoding="ascii"))
    return files[0].read_text(encoding="utf-8")


def _section(name: str, parts: Parts, svg: str | None) -> Section:
    """All that the page says of an experiment."""
    findings, kind = parts["findings"], _kind(name, parts)
    config = _config(findings) if "config" in findings.attrs else None
    about = {key: value for part in parts.values() for key, value in part.attrs.items()} | {
        "experiment": name
    }

    def said(piece: str) -> Markup:
        return words(f"{kind}_{piece}", _numbers(findings), config, about)

    title = _ONE if kind == "one" else _TITLES[name]
    figures = []
    if svg is not None:
        label, caption = said("label"), said("caption")
        drawn = drawing(svg, name, label.striptags(), caption.striptags())
        figures.append(PageFigure(name=name, label=label, drawing=drawn, caption=caption))
    return Section(
        name=name.replace("_", "-"),
        title=title,
        text=(said("text"),),
        figures=tuple(figures),
        tables=(table_of(kind, name, title, parts),),
    )


def _kind(name: str, parts: Parts) -> str:
    """What an experiment is like: its words and its figure go by it."""
    if name in _KINDS:
        return name
    if name == "effect_of_n_stars":
        return "n_stars"
    return "errors" if _config(parts["findings"]).binary_fraction == "uniform" else "one"


def _drawing_of(name: str, parts: Parts) -> Figure:
    return _FIGURES[_kind(name, parts)](parts)


_FIGURES: dict[str, Callable[[Parts], Figure]] = {
    "toy": lambda parts: toy_maps(parts["maps"]),
    "sketch": lambda parts: pair_sketch(parts["points"]),
    "population": lambda parts: population(parts["sky"]),
    "magnitude": lambda parts: against_magnitude(parts["magnitude"], KCM16),
    "n_stars": lambda parts: effect_of_n_stars(parts["numbers"], parts["limit"], KCM16),
    "errors": lambda parts: errors_and_biases(parts["summary"], parts["curves"], parts["limit"], KCM16),
    "one": lambda parts: at_one_fraction(parts["summary"], KCM16),
}
