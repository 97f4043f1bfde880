"""Validation tests can write what they measured: ``pytest tests/validation --write-validation``.

Of some files alone, they write the sections that these measure anew and leave the others on the page.
"""

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "validation.md"
HEAD = """# Validation

Every number of Porrima is checked against something that Porrima did not compute.  The checks are tests, in
`tests/validation`; `make validation` runs them and writes this page.  Statistical checks pass within five
standard errors, and a pull is a difference in standard errors.
"""
SECTIONS = pytest.StashKey[dict]()


def pytest_addoption(parser):
    parser.addoption("--write-validation", action="store_true", help="write docs/validation.md")


def pytest_configure(config):
    config.stash[SECTIONS] = {}


@pytest.fixture
def record(request):
    """Keep a line of a table under a heading: ``record(heading, columns, values)``."""

    def keep(heading, columns, values):
        table = request.config.stash[SECTIONS].setdefault(heading, (columns, []))
        table[1].append(values)

    return keep


@pytest.fixture(scope="session")
def full_size(request):
    """Whether the page is written: the longest checks are then at the size that it quotes, and shorter otherwise."""
    return request.config.getoption("--write-validation")


def _place(number):
    """Sections begin with their place on the page, 2 before 2b before 10."""
    figure, letter = re.match(r"(\d+)(\w*)", number).groups()
    return int(figure), letter


def _section(heading, columns, lines):
    """A section of the page, and its number."""
    title, _, words = heading.partition(": ")
    number, _, title = title.partition(" ")
    text = f"<!-- {number} -->\n## {title}\n\n{words}\n\n| " + " | ".join(columns) + " |\n"
    text += "|" + " --- |" * len(columns) + "\n"
    return number, text + "".join("| " + " | ".join(map(str, line)) + " |\n" for line in lines)


def pytest_sessionfinish(session, exitstatus):
    if not session.config.getoption("--write-validation") or exitstatus:
        return
    sections = {}
    if {item.path for item in session.items} != set(PAGE.parents[1].glob("tests/validation/test_*.py")):
        parts = re.split(r"^<!-- (\w+) -->$", PAGE.read_text(encoding="utf-8"), flags=re.M)
        sections = {
            number: f"<!-- {number} -->{text.rstrip()}\n"
            for number, text in zip(parts[1::2], parts[2::2], strict=True)
        }
    measured = session.config.stash[SECTIONS].items()
    sections |= dict(_section(heading, *table) for heading, table in measured)
    text = "\n".join([HEAD, *(sections[number] for number in sorted(sections, key=_place))])
    PAGE.write_text(text, encoding="utf-8")
