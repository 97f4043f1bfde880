"""Verdicts follow from numbers and nothing else."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import yaml

import porrima.claims
from porrima.claim_table import BEGIN, END, claim_table, with_claims
from porrima.claims import VERDICTS, claims_kept, claims_of, judged, numbers_of, verdict_of
from porrima.evidence import Evidence, Measure, Number, bend_of, measure, ratio_of, slope_of
from porrima.multiplicity import MULTIPLICITY
from porrima.paper_tables import multiplicity_table
from porrima.statement_rules import RULES

DOCS = Path(__file__).parents[1] / "docs"
HOLDS, PARTLY, FAILS, OPEN = VERDICTS
GOOD, BAD = Number(1.0, 0.01), Number(2.0, 0.01)
NONE = Number(math.nan, math.nan)


def about(part, number, under=""):
    return measure(part, f"{part} {under}", number, 0.9, 1.1, under=under)


def one_number(name, value, error=0.01):
    numbers = xr.Dataset({"value": ("name", [value]), "error": ("name", [error])}, coords={"name": [name]})
    return {"statements": {"numbers": numbers}}


@pytest.mark.parametrize(
    ("measures", "verdict"),
    [
        ([about("a", GOOD), about("b", GOOD)], HOLDS),
        ([about("a", GOOD), about("b", BAD)], FAILS),
        ([about("a", BAD), about("a", GOOD, "many stars")], PARTLY),
        ([about("a", GOOD), about("a", BAD, "many stars")], HOLDS),
        ([about("a", BAD), about("a", BAD, "many stars")], FAILS),
        ([about("a", BAD), about("a", GOOD, "many stars"), about("b", BAD)], FAILS),
        ([about("a", GOOD, "many stars")], PARTLY),
        ([about("a", BAD, "many stars")], FAILS),
        ([about("a", NONE), about("b", GOOD)], HOLDS),
        ([about("a", NONE)], OPEN),
        ([], OPEN),
    ],
)
def test_a_verdict_follows_from_what_fits_with_and_without_an_assumption(measures, verdict):
    assert verdict_of(measures).verdict == verdict


def test_the_number_that_decides_is_the_first_that_does_not_fit():
    bad = about("b", BAD)
    found = verdict_of([about("a", GOOD), bad, about("c", NONE), about("b", GOOD, "many stars")])
    assert found.deciding == bad
    assert found.failed == (bad,)
    assert found.open_parts == ("c",)
    assert found.assumptions == ("many stars",)


def test_slack_is_counted_in_standard_errors_outside_or_inside():
    at = {"part": "a", "quantity": "q", "value": 1.12, "error": 0.01, "largest": 1.1}
    assert Measure(**at).fits
    assert not Measure(**at | {"slack": 1.0}).fits
    assert not Measure(**at | {"value": 1.08, "slack": -3.0}).fits
    assert Measure(**at | {"value": 1.06, "slack": -3.0}).fits


def test_slopes_ratios_and_bends_are_those_of_lines_and_parabolas():
    f = np.arange(0.025, 1.0, 0.05)
    error = np.full(f.size, 0.1)
    found = slope_of(f, 3 * f, error)
    assert found.value == pytest.approx(3.0)
    assert found.error == pytest.approx(0.1 / np.sqrt(f @ f))
    assert bend_of(f, 3 * f, error).value == pytest.approx(0.0)
    low, high = f[f < 0.3], f[f > 0.8]
    parabola = [1 + 0.2 * (one**3).sum() / (one**2).sum() for one in (low, high)]
    assert bend_of(f, f + 0.2 * f**2, error).value == pytest.approx(parabola[1] / parabola[0] - 1)
    assert ratio_of(Number(4, 0.4), Number(2, 0.2)) == pytest.approx((2.0, 2.0 * math.hypot(0.1, 0.1)))


def test_each_statement_has_its_words_its_rule_and_a_verdict():
    texts = yaml.safe_load(
        (Path(porrima.claims.__file__).parent / "data/report/statements.yaml").read_text("utf-8")
    )
    assert list(texts) == list(RULES)
    assert all(set(text) == {"statement", "paper", "why"} and all(text.values()) for text in texts.values())


def test_without_numbers_only_arithmetic_is_decided():
    claims = {claim["number"]: claim for claim in claims_of(judged({}))}
    assert {number for number, claim in claims.items() if claim["verdict"] != OPEN} == {"19"}
    assert claims["19"]["porrima"] == 500.0
    assert claims["19"]["verdict"] == FAILS
    assert math.isnan(claims["1"]["porrima"])


@pytest.mark.parametrize(
    ("number", "name", "good", "bad"),
    [
        ("15", "gain_dk13", 6.0, 1.2),
        ("16", "sharper_adaptive", 1.5, 0.9),
        ("13", "sampled_adaptive", 1.0, 0.5),
        ("21", "triples_dk13", 1.2, 0.8),
        ("22d", "clip_gain", 3.0, 1.0),
        ("22e", "gaia_gain", 2.0, 1.0),
    ],
)
def test_another_number_gives_another_verdict(number, name, good, bad):
    verdicts = [verdict_of(RULES[number](Evidence(one_number(name, value)))).verdict for value in (good, bad)]
    assert verdicts == [HOLDS, FAILS]


def test_the_trends_are_judged_by_the_table_itself():
    parts = multiplicity_table({"dk13": MULTIPLICITY["dk13"]})
    assert verdict_of(RULES["20"](Evidence({"multiplicity_table": parts}))).verdict == HOLDS
    turned = parts["table"].assign(multiplicity_fraction=-parts["table"]["multiplicity_fraction"])
    assert verdict_of(RULES["20"](Evidence({"multiplicity_table": {"table": turned}}))).verdict == FAILS


def test_claims_come_back_from_the_disk_and_are_made_again_for_other_numbers(tmp_path, monkeypatch):
    results = one_number("gain_dk13", 1.2)
    first = claims_kept(results, tmp_path)
    calls = []
    monkeypatch.setattr(porrima.claims, "judged", lambda results: calls.append(1) or judged(results))
    again = claims_kept(results, tmp_path)
    assert calls == []
    np.testing.assert_equal(claims_of(again), claims_of(first))
    np.testing.assert_equal(claims_of(first), claims_of(judged(results)))
    np.testing.assert_equal(numbers_of(first), numbers_of(judged(results)))
    other = claims_kept(one_number("gain_dk13", 6.0), tmp_path)
    assert calls == [1]
    assert {c["number"]: c["verdict"] for c in claims_of(other)}["15"] == HOLDS


def documented():
    return json.loads((DOCS / "claims.json").read_text(encoding="utf-8"))


def test_every_documented_claim_has_a_number_its_error_and_the_verdict_of_its_numbers():
    result = documented()
    assert [claim["number"] for claim in result["claims"]] == list(RULES)
    names = ("part", "quantity", "value", "error", "slack", "under")
    for claim in result["claims"]:
        assert claim["porrima"] is not None, claim["number"]
        assert claim["error"] is not None, claim["number"]
        rows = [row for row in result["numbers"] if row["claim"] == claim["number"]]
        measures = [
            Measure(
                **{name: row[name] for name in names},
                least=-math.inf if row["least"] is None else row["least"],
                largest=math.inf if row["largest"] is None else row["largest"],
            )
            for row in rows
        ]
        assert [m.fits for m in measures] == [row["fits"] for row in rows]
        found = verdict_of(measures)
        assert found.verdict == claim["verdict"] != OPEN
        assert found.deciding.value == claim["porrima"]


def test_the_document_has_the_table_of_the_claims():
    page = (DOCS / "readers-of-the-paper.md").read_text(encoding="utf-8")
    assert page.count(BEGIN) == page.count(END) == 1
    assert page == with_claims(page, documented())
    assert "| 19 |" in claim_table(documented())
    assert with_claims("no markers", documented()) == "no markers"
