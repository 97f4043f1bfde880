"""The report: one page that needs no network, and the figures and tables beside it, from saved numbers only."""

from __future__ import annotations

import json
import platform
from typing import TYPE_CHECKING, Any

import yaml
from markupsafe import Markup

from porrima import __version__
from porrima.archive import fingerprint, source_key, versions
from porrima.bibliography import bibliography, keys_of
from porrima.cache import content_key
from porrima.config import RunConfig, parse
from porrima.diagrams import against_magnitude
from porrima.drawing import drawing, svg_of
from porrima.figures import at_one_fraction, effect_of_n_stars, errors_and_biases
from porrima.files import write_whole
from porrima.galaxy import Robin2003
from porrima.instruments import KCM16
from porrima.io import write_figure, write_rows
from porrima.page import (
    Configuration,
    Page,
    PageFigure,
    Section,
    Table,
    claims_from,
    html,
    plain,
    quoted,
    words,
)  # fmt: skip
from porrima.shapes import estimator_from_name
from porrima.star_figures import population
from porrima.summary import rows

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    import xarray as xr
    from matplotlib.figure import Figure

    Parts = dict[str, xr.Dataset]

__all__ = ["write_paper", "write_run"]

_TITLES = {
    "population": "The stars",
    "errors_and_biases": "Errors and biases against binary fraction",
    "effect_of_n_stars": "Number of stars in a stack",
    "errors_and_biases_kcm16": "The other reading of the multiplicity table",
    "errors_and_biases_optical": "Optical PSFs",
    "magnitude": "Against magnitude",
}
_ONE = "Bias and scatter at one binary fraction"
_HEADS = (
    "PSF", "quantity", "binary fraction", "stacks", "bias", "predicted", "σ", "predicted", "sd", "predicted",
)  # fmt: skip
_QUANTITIES = {"r2": Markup("R²"), "e1": Markup("e<sub>1</sub>"), "e2": Markup("e<sub>2</sub>")}
_WIDEST = 10  # columns shown; all are in the files
_SCANS = {"l = 0": "latitude at l = 0°", "l = 180": "latitude at l = 180°", "b = 45": "longitude at b = 45°"}


def write_paper(results: Mapping[str, Parts], folder: Path, claims: Sequence[Mapping[str, Any]] = ()) -> Path:
    """Path of the page of the paper, with its figures (SVG, PDF, PNG) and tables (ECSV) beside it.

    Parameters
    ----------
    results : dict
        Datasets of each experiment, from `programme.carried_out`.
    folder : Path
        Where to write; it exists.
    claims : sequence of dict
        Records with the keys of `page.Claim`: ``number, statement, paper, porrima, error, verdict, why``.  Without
        any the section is left out.

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
        section = _section(name, parts, _drawn(name, parts, folder))
        for table in section.tables:
            write_rows(table.records, folder / f"{table.name}.ecsv")
        sections.append(section)
    runs = {name: parts["findings"] for name, parts in results.items() if "config" in parts["findings"].attrs}
    page = Page(
        title="Errors and biases of the PSF from unresolved binary stars",
        subtitle="The figures of Kuntzer, Courbin & Meylan (2016), simulated and predicted",
        sections=tuple(sections),
        claims=stated,
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
        sections=(_section("errors_and_biases", parts, svg_of(_figure("errors_and_biases", parts))),),
        **_said(parts["findings"]),
        **_provenance({name: parts["findings"]}),
    )
    return _written(page, path)


def _written(page: Page, path: Path) -> Path:
    text = html(page)
    write_whole(path, lambda unfinished: unfinished.write_text(text, encoding="utf-8"))
    return path


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


def _drawn(name: str, parts: Parts, folder: Path) -> str:
    """The figure of an experiment as SVG, drawn to its files unless they show the same numbers already."""
    files = [folder / f"{name}.{suffix}" for suffix in ("svg", "pdf", "png")]
    note = folder / f".{name}.key"
    key = content_key(fingerprint(parts), source_key("figures", "star_figures", "diagrams", "drawing"))
    if not all(file.is_file() for file in (*files, note)) or note.read_text(encoding="ascii") != key:
        figure = _figure(name, parts)
        svg = svg_of(figure)
        write_whole(files[0], lambda unfinished: unfinished.write_text(svg, encoding="utf-8"))
        for file in files[1:]:
            write_figure(figure, file)
        write_whole(note, lambda unfinished: unfinished.write_text(key, encoding="ascii"))
    return files[0].read_text(encoding="utf-8")


def _section(name: str, parts: Parts, svg: str) -> Section:
    """All that the page says of an experiment."""
    findings, kind = parts["findings"], _kind(name, parts)
    config = _config(findings) if "config" in findings.attrs else None
    about = {key: value for part in parts.values() for key, value in part.attrs.items()} | {
        "experiment": name
    }
    label, caption, text = (
        words(f"{kind}_{piece}", _numbers(findings), config, about) for piece in ("label", "caption", "text")
    )
    shown = PageFigure(
        name=name,
        label=label,
        drawing=drawing(svg, name, label.striptags(), caption.striptags()),
        caption=caption,
    )
    title = _ONE if kind == "one" else _TITLES[name]
    make = _plain if kind in ("population", "magnitude") else _statistics
    table = make(name, title, _records(kind, parts))
    return Section(name=name.replace("_", "-"), title=title, text=(text,), figures=(shown,), tables=(table,))


def _kind(name: str, parts: Parts) -> str:
    """What an experiment is like: its words and its figure go by it."""
    if name in ("population", "magnitude"):
        return name
    if name == "effect_of_n_stars":
        return "n_stars"
    return "errors" if _config(parts["findings"]).binary_fraction == "uniform" else "one"


def _figure(name: str, parts: Parts) -> Figure:
    kind = _kind(name, parts)
    if kind == "population":
        return population(parts["sky"])
    if kind == "magnitude":
        return against_magnitude(parts["magnitude"], KCM16)
    if kind == "n_stars":
        return effect_of_n_stars(parts["numbers"], parts["limit"], KCM16)
    if kind == "errors":
        return errors_and_biases(parts["summary"], parts["curves"], parts["limit"], KCM16)
    return at_one_fraction(parts["summary"], KCM16)


def _records(kind: str, parts: Parts) -> list[dict[str, Any]]:
    """The table of an experiment, with all its digits."""
    if kind == "population":
        return list(_by_direction(parts["sky"]))
    if kind == "magnitude":
        return list(_by_magnitude(parts["magnitude"]))
    if kind == "n_stars":
        numbers = parts["numbers"]
        stars = numbers["n_stars"].to_numpy().tolist()
        return [{"n_stars": n} | row for n in stars for row in rows(numbers.sel(n_stars=n))]
    return rows(parts["summary"])


def _by_direction(sky: xr.Dataset) -> Iterator[dict[str, Any]]:
    """One record for each direction of each scan."""
    for scan in sky["scan"].to_numpy().tolist():
        here = sky.sel(scan=scan).dropna("angle", subset=["n_per_deg2"])
        for k in range(here.sizes["angle"]):
            one = here.isel(angle=k)
            yield (
                {"along": _SCANS[scan], "angle": float(one["angle"])}
                | {
                    f"stars {kind}": float(one["share"].sel(mass_class=kind))
                    for kind in one["mass_class"].to_numpy()
                }
                | {
                    f"binary fraction, {rule} row": float(one["binary_fraction"].sel(gap_rule=rule))
                    for rule in one["gap_rule"].to_numpy()
                }
                | {"stars per deg²": float(one["n_per_deg2"])}
            )


def _by_magnitude(data: xr.Dataset) -> Iterator[dict[str, Any]]:
    """One record for each model and bin."""
    for model in data["model"].to_numpy().tolist():
        for k in range(data.sizes["bin"]):
            one = data.sel(model=model).isel(bin=k)
            names = ("mag_lo", "mag_hi", "mean_x", "mean_x_low", "mean_x_high")
            yield (
                {"model": model}
                | {name: float(one[name]) for name in names}
                | {
                    f"{name}, {psf}": float(one[name].sel(psf=psf))
                    for name in ("limit_e", "limit_r2")
                    for psf in one["psf"].to_numpy()
                }
            )


def _statistics(name: str, label: str, records: list[dict[str, Any]]) -> Table:
    """Bias, error and scatter with their standard errors beside the predictions."""
    many = "n_stars" in records[0]
    shown = [
        [
            *([plain(row["n_stars"])] if many else []),
            row["psf"],
            _QUANTITIES[row["quantity"]],
            Markup("{}–{}").format(plain(row["f_lo"]), plain(row["f_hi"])),
            plain(row["n_stacks"]),
            *(cell for one in ("bias", "sigma", "sd") for cell in _compared(row, one)),
        ]
        for row in records
    ]
    return Table(
        name=name,
        label=label,
        caption=Markup("Bias, rms error σ and scatter sd, with standard errors, in units of 10<sup>−3</sup>"),
        heads=(*(("stars",) if many else ()), *_HEADS),
        rows=shown,
        n_labels=3 if many else 2,
        records=records,
    )


def _compared(row: dict[str, Any], name: str) -> tuple[Markup, Markup]:
    """A simulated number with its standard error, and the predicted one."""
    value, error, predicted = (
        quoted(row[key], 4, scale=1e-3, fixed=True) for key in (name, f"{name}_se", f"prediction_{name}")
    )
    return Markup("{} ± {}").format(value, error), predicted


def _plain(name: str, label: str, records: list[dict[str, Any]]) -> Table:
    """Records as they are, with three figures; the first columns of them."""
    heads = tuple(records[0])[:_WIDEST]
    return Table(
        name=name,
        label=label,
        caption=words(f"{name}_table", {}),
        heads=heads,
        rows=[
            [row[head] if isinstance(row[head], str) else quoted(row[head]) for head in heads]
            for row in records
        ],
        n_labels=1,
        records=records,
    )
