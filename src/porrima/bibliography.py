"""The bibliography: which papers the models in use ask to be cited, as BibTeX and as lines to read."""

from __future__ import annotations

import inspect
import re
import unicodedata
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["Reference", "bibliography", "keys_of"]

_FILE = Path(__file__).parent / "data" / "references.bib"
_KEY = re.compile(r"\b[A-Z][A-Za-z]*\d{2,4}[a-z]?\b")  # KCM16, Robin2003
_FIELD = re.compile(r"^\s*(\w+)\s*=\s*\{(.*)\},?\s*$", re.M)
_ACCENTS = {
    "'": "\u0301",
    "`": "\u0300",
    "^": "\u0302",
    '"': "\u0308",
    "~": "\u0303",
    "v": "\u030c",
    "c": "\u0327",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """One paper.

    Parameters
    ----------
    key : str
        By which docstrings name it.
    bibtex : str
        Its entry, as it is in the file.
    fields : dict
        Author, title and so on, in plain text.
    """

    key: str
    bibtex: str
    fields: dict[str, str]

    @property
    def line(self) -> str:
        """Authors, year, title and place, to be read."""
        get = self.fields.get
        authors = (get("author") or "").split(" and ")
        names = [name.split(",")[0].strip() for name in authors[:3]]
        more = " et al." if len(authors) > 3 or "others" in authors[:3] else ""
        names = [name for name in names if name != "others"]
        who = ", ".join(names) if more or len(names) < 2 else f"{', '.join(names[:-1])} & {names[-1]}"
        where = get("journal") or get("booktitle") or get("publisher") or get("institution") or get("note")
        place = ", ".join(part for part in (where, get("volume"), get("pages")) if part)
        return f"{who}{more} ({get('year')}). {get('title')}. {place}."

    @property
    def address(self) -> str | None:
        """Where it can be read: its DOI or its preprint; None where it has neither."""
        if "doi" in self.fields:
            return f"https://doi.org/{self.fields['doi']}"
        return f"https://arxiv.org/abs/{self.fields['eprint']}" if "eprint" in self.fields else None


def bibliography(keys: set[str]) -> list[Reference]:
    """The papers of some keys.

    Parameters
    ----------
    keys : set of str
        Such as ``KCM16``; what is no key of the bibliography is passed over.

    Returns
    -------
    references : list of Reference
        By first author and year.
    """
    found = []
    for entry in re.split(r"\n(?=@)", _FILE.read_text(encoding="utf-8")):
        head = re.match(r"@\w+\{(\w+),", entry)
        if head and head[1] in keys:
            fields = {name.lower(): _plain(value) for name, value in _FIELD.findall(entry)}
            found.append(Reference(key=head[1], bibtex=entry.strip(), fields=fields))
    return sorted(found, key=lambda one: (one.fields["author"], one.fields["year"]))


def keys_of(*models: Any) -> set[str]:
    """Keys under "References" in the docstrings of models.

    Parameters
    ----------
    *models : object
        Instances, classes or functions; those of the classes that an instance is made of count too.

    Returns
    -------
    keys : set of str
        Such as ``KCM16``.
    """
    out: set[str] = set()
    for model in models:
        kind = model if inspect.isclass(model) or inspect.isfunction(model) else type(model)
        text = inspect.cleandoc(kind.__doc__ or "")
        body = re.search(r"^References\n-+\n(.*?)(?=\n\n|\Z)", text, re.M | re.S)
        out |= set(_KEY.findall(body[1])) if body else set()
    return out


def _plain(value: str) -> str:
    """A field without BibTeX's marks."""
    text = re.sub(
        r"\{?\\([\'`^\"~vc])\s*\{?(\w)\}?\}?",
        lambda m: unicodedata.normalize("NFC", m[2] + _ACCENTS[m[1]]),
        value,
    )
    text = text.replace("\\&", "&").replace("--", "–").replace("$^{1/n}$", "^(1/n)")
    return re.sub(r"[{}$]", "", text)
