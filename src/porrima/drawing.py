"""A figure as it stands in a page: lines and letters in the page's own colours, on no ground."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from matplotlib import rc_context

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Drawing", "drawing", "svg_of"]

_NAMES = {
    "#0072b2": "blue", "#d55e00": "vermilion", "#009e73": "green", "#cc79a7": "purple", "#e69f00": "orange",
    "#56b4e9": "sky", "#b00020": "red", "#ff0000": "red", "#ffffff": "paper",
}  # fmt: skip
_GREYS = ((0.25, "ink"), (0.5, "soft"), (0.8, "grid"), (1.0, "grid-soft"))  # up to which lightness
_COLOUR = re.compile(r"#[0-9a-f]{6}\b")


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawing:
    """A figure for a page.

    Parameters
    ----------
    svg : str
        Its element.
    themed : bool
        Whether all colours are the page's, light or dark; a map of colours stands on white.
    """

    svg: str
    themed: bool


def svg_of(figure: Figure) -> str:
    """A figure as SVG, the same for the same figure.

    Parameters
    ----------
    figure : Figure
        From `figures`.

    Returns
    -------
    svg : str
        A whole file.
    """
    text = io.StringIO()
    with rc_context({"svg.hashsalt": "porrima"}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()


def drawing(svg: str, name: str, title: str, description: str) -> Drawing:
    """A figure as an element of a page.

    Parameters
    ----------
    svg : str
        From `svg_of`.
    name : str
        Of the figure in the page; it makes the names within it unique.
    title, description : str
        For readers who do not see it.

    Returns
    -------
    drawing : Drawing
        No part of it lies outside.
    """
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"\s*<metadata>.*?</metadata>", "", svg, flags=re.S)
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", svg)
    # what has no colour of its own in the file is black by the rules of SVG, and here the page's ink
    about = (
        f"<title id='{name}-title'>{escape(title)}</title><desc id='{name}-desc'>{escape(description)}</desc>"
    )
    label = f"fill='currentColor' role='img' aria-labelledby='{name}-title {name}-desc'"
    svg = re.sub(r"<svg ([^>]*)>", rf"<svg {label} \g<1>>{about}", svg, count=1)
    inked = _COLOUR.sub(_of_the_page, svg)
    themed = not _COLOUR.search(inked) and "<image" not in inked
    return Drawing(svg=inked, themed=themed)


def _of_the_page(colour: re.Match[str]) -> str:
    """A colour of the figures by its name in the page; others as they are."""
    if colour[0] in _NAMES:
        return f"var(--{_NAMES[colour[0]]})"
    channels = {colour[0][k : k + 2] for k in (1, 3, 5)}
    if len(channels) > 1:
        return colour[0]
    lightness = int(channels.pop(), 16) / 255
    return f"var(--{next(name for limit, name in _GREYS if lightness <= limit)})"
