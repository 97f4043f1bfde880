"""Validation tests can write what they measured: ``pytest tests/validation --write-validation``."""

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


def _number(section):
    """Headings begin with their place on the page."""
    number, letter = re.match(r"(\d+)(\w*)", section[0]).groups()
    return int(number), letter


def pytest_sessionfinish(session, exitstatus):
    if not session.config.getoption("--write-validation") or exitstatus:
        return
    text = HEAD
    for heading, (columns, lines) in sorted(session.config.stash[SECTIONS].items(), key=_number):
        title, _, words = heading.partition(": ")
        text += f"\n## {title.split(' ', 1)[1]}\n\n{words}\n\n| " + " | ".join(columns) + " |\n"
        text += "|" + " --- |" * len(columns) + "\n"
        text += "".join("| " + " | ".join(map(str, line)) + " |\n" for line in lines)
    PAGE.write_text(text, encoding="utf-8")
