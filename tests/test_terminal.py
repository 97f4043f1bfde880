import re
import sys

import pytest

from porrima import terminal
from porrima.terminal import Progress


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test moves."""
    now = [1000.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    return now


def advanced(progress, clock, steps, n, seconds):
    for _ in range(steps):
        clock[0] += seconds
        progress.advance(n)


def test_without_a_terminal_there_is_a_line_now_and_then(capsys, clock):
    with Progress(1_000_000, "stacks", ("stars", 40)) as progress:
        progress.advance(200_000)  # of an earlier call
        advanced(progress, clock, 8000, 100, 0.1)
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert out == ""
    assert 20 < len(lines) <= 80  # 800 seconds, every 10 000 stacks and 10 seconds
    assert lines[0] == "210000 of 1000000 stacks, 40 thousand stars/s, 0:13:10 left"
    assert lines[-1] == "1000000 of 1000000 stacks, 40 thousand stars/s, 0:00:00 left"


def test_what_was_there_before_counts_neither_as_speed_nor_as_time(capsys, clock):
    with Progress(1000, "stacks", ("stars", 10_000_000)) as progress:
        clock[0] += 500  # before the first call nothing is at work
        progress.advance(900)
        advanced(progress, clock, 1, 50, 20.0)
    assert capsys.readouterr().err == "950 of 1000 stacks, 25 million stars/s, 0:00:20 left\n"


def test_a_short_run_says_nothing(capsys, clock):
    with Progress(100, "stacks") as progress:
        advanced(progress, clock, 10, 10, 0.5)
    assert capsys.readouterr() == ("", "")


def test_a_terminal_has_a_bar_on_standard_error(capsys, monkeypatch, clock):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with Progress(100, "stacks", ("stars", 40)) as progress:
        progress.advance(0)
        advanced(progress, clock, 2, 50, 1.0)
    out, err = capsys.readouterr()
    assert out == ""
    shown = re.sub(r"\x1b\[[0-9;?]*\w", "", err)
    assert "100/100 stacks, 2 thousand stars/s, 0:00:00 left" in shown


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.5, "0.5"), (999, "999"), (81_234_567, "81.2 million"), (2.5e9, "2.5 thousand million")],
)
def test_rates_have_three_figures(value, text):
    assert terminal._short(value) == text
