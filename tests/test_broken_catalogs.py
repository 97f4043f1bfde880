"""Thirty-odd ways in which real catalogues arrive broken: one clear error with file and row, or a count."""

import gzip

import numpy as np
import pytest

from data_files import data_file
from porrima.catalogs import read_catalog
from porrima.errors import InputError
from test_gaia import ANSWER

POLE = "catalogues/besancon_l200_b90.dat"  # rows from line 82 on; 3865 stars
JOHNSON = "catalogues/besancon_l200_b59.csv"
TRILEGAL = "catalogues/trilegal_with_binaries.table"
GAIA = "gaia"


def content(name):
    return (ANSWER if name == GAIA else data_file(name)).read_bytes()


def at_line(number, change):
    """A change of one line of a file, counted from 1."""

    def changed(data):
        lines = data.split(b"\n")
        lines[number - 1] = change(lines[number - 1])
        return b"\n".join(lines)

    return changed


def at_byte(data, first, new):
    return data[:first] + new + data[first + len(new) :]


def swap(old, new, count=-1):
    def changed(data):
        assert old in data
        return data.replace(old, new, count)

    return changed


def field(place, value, mark=None):
    """One field of a line replaced."""

    def changed(line):
        parts = line.split(mark)
        parts[place] = value
        return (mark or b" ").join(parts)

    return changed


MASS, DIST = ", row 200, column Mass: must be ", ", row 200, column Dist: must be "
CODED = "must be UTF-8 text or a FITS table"
FIELDS_18 = "must have 18 fields, as the header"
HEADER = "must have the header line of the Besançon model"

REFUSED = {  # what is wrong: (file, what is done to it, format given, part of the message after the file's name)
    "last line cut": (POLE, lambda d: b"\n".join(d.split(b"\n")[:3000])[:-15], None, ", row 3000: "),
    "half the file": (POLE, lambda d: d[: len(d) // 2], None, ", row "),
    "a hundred lines lost": (
        POLE, lambda d: b"\n".join(d.split(b"\n")[:500] + d.split(b"\n")[600:]), None,
        ": must have as many rows as its TOTAL NUMBER OF STARS says, 3865 (or no such line), got 3765",
    ),
    "a line cut in the middle": (POLE, at_line(200, lambda line: line[:50]), None, f", row 200: {FIELDS_18}, got "),
    "two lines run together": (POLE, at_line(200, lambda d: d.rstrip() + d), None, f", row 200: {FIELDS_18}, got 36"),
    "a note in the rows": (POLE, at_line(200, lambda _: b"see the log"), None, f", row 200: {FIELDS_18}, got 3"),
    "header of another model": (POLE, swap(b" LTef ", b" Teff "), None, f": {HEADER}"),
    "header lost, format given": (JOHNSON, lambda d: d[d.index(b"\n") + 1 :], "besancon", f": {HEADER}"),
    "header lost": (JOHNSON, lambda d: d[d.index(b"\n") + 1 :], None, ", row 1: must be a header line that names"),
    "mass called otherwise": (POLE, swap(b" Mass ", b" Mini "), None, "column Mass: must be there; the file has Dist"),
    "a mass that is NaN": (
        POLE, at_line(200, field(7, b"nan")), None, MASS + "positive and finite (0 where unknown), got nothing",
    ),
    "a mass below zero": (POLE, at_line(200, field(7, b"-0.3")), None, MASS + "positive and finite"),
    "a mass in g": (POLE, at_line(200, field(7, b"1e33")), None, MASS + "no more than 500 M_sun"),
    "a distance in pc": (POLE, at_line(200, field(0, b"830.0")), None, DIST + "in kpc and no more"),
    "a distance of zero": (POLE, at_line(200, field(0, b"0")), None, DIST + "positive and finite, got 0"),
    "a letter in a number": (POLE, at_line(200, field(12, b"1O.5")), None, ", row 200, column i: must be a number"),
    "an unknown component": (POLE, at_line(200, field(6, b"44")), None, ", row 200, column Age: must be the number"),
    "all distances in pc": (
        JOHNSON, lambda d: swap_column(d, b",", 0, lambda x: b"%.1f" % (1000 * float(x))), None,
        ", column Dist: must be from 0.001 to 2000 kpc (is it in kpc?), got 2005",
    ),
    "another alphabet": (POLE, swap(b"BESANCON", b"BESAN\xc7ON"), None, f", row 3: {CODED}, got byte 0xc7"),
    "two bytes a letter": (TRILEGAL, lambda d: d.decode().encode("utf-16"), None, f", row 1: {CODED}, got byte 0xff"),
    "zeros in the rows": (POLE, at_line(200, lambda line: line[:20] + bytes(8)), None, f", row 200: {CODED}"),
    "noise": (POLE, lambda _: np.random.default_rng(0).bytes(5000), None, f", row 1: {CODED}, got byte 0x"),
    "nothing": (TRILEGAL, lambda _: b"", None, ": must not be empty"),
    "blank lines": (TRILEGAL, lambda _: b"\n" * 100_000, None, ": must not be empty"),
    "gzip cut short": (TRILEGAL, lambda d: gzip.compress(d)[:-2000], None, ": must be a whole gzip file"),
    "gzip damaged": (TRILEGAL, lambda d: at_byte(gzip.compress(d), 9000, bytes(60)), None, ": must be a"),
    "gzip of gzip": (TRILEGAL, lambda d: gzip.compress(gzip.compress(d)), None, f", row 1: {CODED}, got byte 0x"),
    "a page of the web": (
        TRILEGAL, lambda _: b"<html>TRILEGAL: please wait\n</html>\n", "trilegal", ", row 2: must have 3 fields",
    ),
    "a band that is not there": (TRILEGAL, swap(b" I ", b" X ", 1), None, "band: must be one of U, B, V, R, X,"),
    "modulus and extinction swapped": (
        TRILEGAL, swap(b"m-M0   Av ", b"Av    m-M0"), None, ", row 2, column m-M0: must be mbol of a single star",
    ),
    "a row of another run": (TRILEGAL, at_line(99, lambda d: d + b" 12.0"), None, ", row 99: must have 20 fields"),
    "age and its logarithm": (TRILEGAL, at_line(99, field(1, b"5.0e9")), None, ", row 99, column logAge: must be"),
    "a parallax in m": (GAIA, swap(b'"parallax" unit="mas"', b'"parallax" unit="m"'), None, "like mas, got m"),
    "a Gaia table without its colour": (GAIA, swap(b'"bp_rp"', b'"bprp"'), "gaia", "column bp_rp: must be in"),
    "a Gaia table cut": (GAIA, lambda d: d[:9000], None, ": must be a table that astropy reads"),
    "a Gaia error of zero": (GAIA, swap(b"0.0267", b"0.0000", 1), None, ", row 1, column parallax_error: must"),
}  # fmt: skip


def swap_column(data, mark, place, change):
    lines = data.strip().split(b"\n")
    rows = [line.split(mark) for line in lines[1:]]
    for row in rows:
        row[place] = change(row[place])
    return b"\n".join([lines[0], *(mark.join(row) for row in rows)])


@pytest.mark.parametrize("name", REFUSED)
def test_broken_real_file_is_refused_in_one_line_with_its_place(tmp_path, name):
    source, change, form, message = REFUSED[name]
    path = tmp_path / "broken"
    path.write_bytes(change(content(source)))
    with pytest.raises(InputError) as caught:
        read_catalog(path, format=form)
    text = str(caught.value)
    assert text.startswith(str(path))
    assert message in text
    assert "\n" not in text


def rejection(tmp_path, source, change):
    """What a change of a file adds to the count of the rejected rows."""
    path = tmp_path / "changed"
    path.write_bytes(content(source))
    before = read_catalog(path)
    path.write_bytes(change(content(source)))
    after = read_catalog(path)
    assert after.n_rows == len(after.stars) + sum(after.rejected.values()) == before.n_rows
    reasons = {*before.rejected, *after.rejected}
    more = {reason: after.rejected.get(reason, 0) - before.rejected.get(reason, 0) for reason in reasons}
    return {reason: count for reason, count in more.items() if count}


COUNTED = {  # what is odd, but not wrong: (file, what is done to it, more rejected rows)
    "no magnitude": (POLE, at_line(200, field(12, b"99.000")), {"no magnitude": 1}),
    "magnitude NaN": (POLE, at_line(200, field(12, b"nan")), {"no magnitude": 1}),
    "no mass": (POLE, at_line(200, field(7, b"0.00")), {"no mass": 1}),
    "brown dwarf": (POLE, at_line(200, field(7, b"0.06")), {"below 0.08 M_sun": 1}),
    "giant": (POLE, at_line(200, field(2, b"3")), {"not on the main sequence": 1}),
    "negative parallax": (GAIA, swap(b"<TD>1.3804</TD>", b"<TD>-0.0104</TD>"), {}),
    "no parallax": (GAIA, swap(b"<TD>1.3804</TD>", b"<TD/>"), {"no distance": 1}),
    "no colour": (GAIA, swap(b"<TD>1.1322</TD>", b"<TD/>"), {"no colour": 1}),
}


@pytest.mark.parametrize("name", COUNTED)
def test_row_without_what_is_needed_is_counted_and_not_an_error(tmp_path, name):
    source, change, more = COUNTED[name]
    found = rejection(tmp_path, source, change)
    if name == "negative parallax":  # far away and bright: perhaps a giant, but no error
        assert set(found) <= {"more than 1.5 mag above the main sequence", "brighter than 1.5 M_sun"}
    else:
        assert found == more


def test_directory_is_refused_and_gzip_is_read(tmp_path):
    with pytest.raises(InputError, match="must be a file, not a directory"):
        read_catalog(tmp_path)
    path = tmp_path / "trilegal.gz"
    path.write_bytes(gzip.compress(content(TRILEGAL)))
    catalog = read_catalog(path)
    assert (catalog.format, len(catalog.stars)) == ("trilegal", 2819)
