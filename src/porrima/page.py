"""One page that needs no network and no server: what it holds, and how that becomes HTML."""

from __future__ import annotations

import base64
import csv
import io
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import jinja2
from markupsafe import Markup

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from porrima.bibliography import Reference
    from porrima.drawing import Drawing

__all__ = [
    "Claim",
    "Configuration",
    "Page",
    "PageFigure",
    "Section",
    "Table",
    "claims_from",
    "data_link",
    "html",
    "plain",
    "quoted",
]

Verdict = Literal[
    "holds", "holds under the paper's assumption only", "does not hold", "not checked with these options"
]  # fmt: skip
_KINDS: dict[str, str] = dict(zip(get_args(Verdict), ("holds", "partly", "fails", "open"), strict=True))
_LONG = 24  # rows that stand open
_FOLDER = Path(__file__).parent / "data" / "report"


@dataclass(frozen=True, slots=True, kw_only=True)
class PageFigure:
    """A figure with its caption.

    Parameters
    ----------
    name : str
        Unique in the page.
    label : str
        What it is, in a few words.
    drawing : Drawing
        Itself.
    caption : str or Markup
        What to see in it.
    """

    name: str
    label: str
    drawing: Drawing
    caption: str

    @property
    def svg(self) -> Markup:
        """Its element."""
        return Markup(self.drawing.svg)


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table to read, with all its digits to take away.

    Parameters
    ----------
    name : str
        Unique in the page; of the files.
    label : str
        What it is, in a few words.
    caption : str or Markup
        Above it.
    heads : tuple of str
        Of the columns shown.
    rows : list of list
        The cells shown.
    n_labels : int
        Columns of words at its left (count).
    records : list of dict
        All columns, with their full numbers.
    """

    name: str
    label: str
    caption: str
    heads: tuple[str, ...]
    rows: list[list[Any]]
    n_labels: int
    records: list[dict[str, Any]]

    @property
    def folded(self) -> bool:
        """Whether it is too long to stand open."""
        return len(self.rows) > _LONG

    @property
    def csv(self) -> str:
        """A link that holds the records as CSV."""
        return data_link(_csv(self.records), "text/csv")

    @property
    def ecsv(self) -> str:
        """A link that holds the records as ECSV."""
        from astropy.table import Table as AstropyTable  # noqa: PLC0415  (slow to import)

        text = io.StringIO()
        AstropyTable(rows=self.records).write(text, format="ascii.ecsv")
        return data_link(text.getvalue(), "text/plain")


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """Results that belong together.

    Parameters
    ----------
    name, title : str
        Of the section.
    text : tuple of str or Markup
        Paragraphs before the figures.
    figures : tuple of PageFigure
        In order.
    tables : tuple of Table
        After the figures.
    """

    name: str
    title: str
    text: tuple[str, ...] = ()
    figures: tuple[PageFigure, ...] = ()
    tables: tuple[Table, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """A statement of the paper beside what Porrima finds.

    Parameters
    ----------
    number : int or str
        By which it is known.
    statement : str
        What is stated.
    paper : str
        The number that the paper gives, or its words.
    quantity : str
        What the number that is found is of.
    porrima : float
        What is found; NaN where nothing is.
    error : float
        Its standard error; 0 where it is exact.
    verdict : str
        Whether it holds: one of `Verdict`.
    why : str
        In a sentence.

    Raises
    ------
    ValueError
        If the verdict is another.
    """

    number: int | str
    statement: str
    paper: str
    quantity: str
    porrima: float
    error: float
    verdict: Verdict
    why: str

    def __post_init__(self) -> None:
        if self.verdict not in _KINDS:
            raise ValueError(f"verdict must be one of {', '.join(_KINDS)}, got {self.verdict}")

    @property
    def kind(self) -> str:
        """Class of the verdict in the page."""
        return _KINDS[self.verdict]


def claims_from(records: Sequence[Mapping[str, Any]]) -> tuple[Claim, ...]:
    """Claims from plain records.

    Parameters
    ----------
    records : sequence of dict
        With the keys of `Claim`.

    Returns
    -------
    claims : tuple of Claim
        In the same order.

    Raises
    ------
    ValueError
        If a key is missing or is another, or a verdict is.
    """
    names = {field.name for field in fields(Claim)}
    for record in records:
        if set(record) != names:
            raise ValueError(f"a claim must have {', '.join(sorted(names))}, got {', '.join(sorted(record))}")
    return tuple(Claim(**record) for record in records)


@dataclass(frozen=True, slots=True, kw_only=True)
class Configuration:
    """A configuration as `porrima simulate` takes it.

    Parameters
    ----------
    name : str
        What it is of.
    file : str
        Name to save it under.
    text : str
        YAML.
    """

    name: str
    file: str
    text: str

    @property
    def link(self) -> str:
        """A link that holds it."""
        return data_link(self.text, "text/plain")


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """All that a page says.

    Parameters
    ----------
    title, subtitle : str or Markup
        At its head.
    asked : tuple of str or Markup
        Paragraphs.
    answer : str or Markup
        Three sentences.
    sections : tuple of Section
        The results.
    claims : tuple of Claim
        Left out where there are none.
    claim_numbers : Table or None
        All numbers behind them.
    configurations : tuple of Configuration
        What was run.
    versions : dict
        Of Porrima and of what it rests on.
    references : list of Reference
        Of the models in use.
    """

    title: str
    subtitle: str
    asked: tuple[str, ...]
    answer: str
    sections: tuple[Section, ...]
    claims: tuple[Claim, ...] = ()
    claim_numbers: Table | None = None
    configurations: tuple[Configuration, ...]
    versions: dict[str, str]
    references: list[Reference]

    @property
    def version(self) -> str:
        """Of Porrima."""
        return self.versions["porrima"]

    @property
    def verdicts(self) -> dict[str, int]:
        """How many claims have each verdict."""
        found = [claim.verdict for claim in self.claims]
        return {verdict: found.count(verdict) for verdict in _KINDS if verdict in found}

    @property
    def bibtex(self) -> str:
        """Entries of the references."""
        return "\n\n".join(reference.bibtex for reference in self.references) + "\n"

    @property
    def bibtex_link(self) -> str:
        """A link that holds them."""
        return data_link(self.bibtex, "text/plain")

    @property
    def claims_csv(self) -> str:
        """A link that holds the claims as CSV."""
        names = [field.name for field in fields(Claim)]
        return data_link(
            _csv([{name: getattr(claim, name) for name in names} for claim in self.claims]), "text/csv"
        )


def html(page: Page) -> str:
    """A page as one HTML file.

    Parameters
    ----------
    page : Page
        All that it says.

    Returns
    -------
    text : str
        The same for the same page; it loads nothing.
    """
    styles, script = ((_FOLDER / f"page.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    template = _environment().get_template("page.html")
    return template.render(page=page, css=Markup(styles), js=Markup(script))


def words(
    piece: str, findings: Mapping[str, Any], config: Any = None, about: Mapping[str, Any] | None = None
) -> Markup:
    """A piece of what the page says.

    Parameters
    ----------
    piece : str
        A macro of ``words.html``.
    findings : dict
        Numbers that it quotes.
    config : RunConfig, optional
        Of the run that it is about.
    about : dict, optional
        Attributes of its datasets.

    Returns
    -------
    text : Markup
        In one line.
    """
    module = (
        _environment().get_template("words.html").make_module({"f": findings, "c": config, "about": about})
    )
    return Markup(" ".join(getattr(module, piece)().split()))


def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_FOLDER),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_shown,
    )
    environment.filters |= {"quoted": quoted, "plain": plain, "finite": math.isfinite}
    return environment


def quoted(
    value: float,
    digits: int = 3,
    *,
    percent: bool = False,
    scale: float = 1.0,
    fixed: bool = False,
    sign: bool = True,
) -> Markup:
    """A saved number as it is read, with its full value beside it in the page.

    Parameters
    ----------
    value : float
        As saved.
    digits : int
        That are shown: significant ones, or decimal places where `fixed` (count).
    percent : bool
        Whether it is shown in per cent.
    scale : float
        Unit in which it is shown.
    fixed : bool
        Whether places are counted from the decimal point.
    sign : bool
        Whether it has its sign, or words beside it say that.

    Returns
    -------
    text : Markup
        A ``data`` element, or words where there is no number.
    """
    if not math.isfinite(value):
        return Markup("–")
    shown = value * 100 if percent else value / scale
    shown = shown if sign else abs(shown)
    text = f"{shown:.{digits}f}" if fixed else _significant(shown, digits)
    text = text.replace("-", "−") + (" %" if percent else "")
    unit = Markup(' data-scale="{}"').format(f"{scale:g}") if scale != 1.0 else Markup("")
    return Markup('<data value="{}"{}>{}</data>').format(repr(float(value)), unit, Markup(text))


def plain(value: float) -> Markup:
    """A number of a configuration as it was given, with its value beside it in the page.

    Parameters
    ----------
    value : float
        As given.

    Returns
    -------
    text : Markup
        A ``data`` element.
    """
    whole = float(value).is_integer() and abs(value) < 1e15
    text = f"{value:,.0f}".replace(",", " ") if whole and abs(value) >= 1e4 else f"{value:g}"
    text = text.replace("-", "−")
    return Markup('<data value="{}">{}</data>').format(repr(value), text)


def _significant(value: float, digits: int) -> str:
    """A number with so many figures, with a power of ten where it is small or large."""
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        text = f"{value:#.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"
        whole = text.rstrip(".")
        return (
            f"{int(whole):,}".replace(",", " ")
            if whole.lstrip("-").isdigit() and abs(value) >= 1e4
            else whole
        )
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa} × 10<sup>{int(exponent)}</sup>"


def data_link(text: str, kind: str) -> str:
    """A link that holds a file.

    Parameters
    ----------
    text : str
        Of the file.
    kind : str
        Its media type.

    Returns
    -------
    link : str
        For ``href``.
    """
    return f"data:{kind};charset=utf-8;base64,{base64.b64encode(text.encode()).decode()}"


def _csv(records: Sequence[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(records[0]) if records else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue()


def _shown(value: Any) -> Any:
    """What a template prints of a value: a number always in the same way."""
    return quoted(value) if isinstance(value, float) else value
