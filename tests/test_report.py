"""Experiment, figure and report of the paper's six panels, on a small run."""

import base64
import json
import re
from pathlib import Path

import html5lib
import numpy as np
import pytest
import yaml
from astropy.table import Table

from browser import Browser, executable
from porrima.claims import VERDICTS
from porrima.config import RunConfig, StarsConfig, parse
from porrima.evidence import Number, measure
from porrima.experiments import (
    against_magnitude,
    effect_of_n_stars,
    errors_and_biases,
    n_stars_configs,
    paper_config,
)
from porrima.figures import effect_of_n_stars as effect_of_n_stars_drawn
from porrima.figures import errors_and_biases as drawn
from porrima.findings import of_errors_and_biases, of_magnitude, of_population, of_toy
from porrima.findings import of_n_stars as effect_parts
from porrima.instruments import EUCLID_VIS, KCM16
from porrima.multiplicity import MULTIPLICITY
from porrima.paper_tables import multiplicity_table, pair_sketch, psf_table
from porrima.programme import READINGS
from porrima.report import write_paper, write_run
from porrima.star_experiments import population
from porrima.star_figures import selection
from porrima.stars import Stars
from porrima.summary import rows
from porrima.toy import toy_maps
from statistics_helpers import assert_within_sigma


@pytest.fixture(scope="module")
def numbers(tmp_path_factory):
    config = RunConfig(stars=StarsConfig(l=180, b=45, mag=(18, 19), n_drawn=500), n_stacks=20_000)
    return errors_and_biases(config, tmp_path_factory.mktemp("paper") / "run.zarr")


@pytest.fixture(scope="module")
def of_n_stars(tmp_path_factory):
    stars = StarsConfig(l=180, b=45, mag=(18, 19), n_drawn=500)
    configs = [
        c.model_copy(update={"n_stacks": 4000, "stars": stars}) for c in n_stars_configs() if c.n_stars < 1000
    ]
    seen, folder = [], tmp_path_factory.mktemp("n_stars")
    numbers = effect_of_n_stars(configs, folder, seen.append)
    assert sum(seen) == sum(c.n_stars * c.n_stacks for c in configs)
    return numbers


def test_more_stars_lower_the_scatter_as_their_square_root_and_not_the_bias(of_n_stars):
    numbers = of_n_stars.numbers
    assert numbers["n_stars"].to_numpy().tolist() == [40, 750]
    few, many = (numbers.sel(n_stars=n, quantity="e2", psf="psf1") for n in (40, 750))
    ratio = few["sd"] / many["sd"]
    error = ratio * np.hypot(few["sd_se"] / few["sd"], many["sd_se"] / many["sd"])
    assert_within_sigma(ratio, np.sqrt(750 / 40), error)
    sizes = [numbers.sel(n_stars=n, quantity="r2", psf="psf1") for n in (40, 750)]
    assert_within_sigma(
        sizes[0]["bias"], sizes[1]["bias"], np.hypot(sizes[0]["bias_se"], sizes[1]["bias_se"])
    )


def test_the_setting_of_the_number_of_stars_is_that_of_the_paper():
    full = n_stars_configs(full=True)
    assert [c.n_stars for c in full] == [40, 750, 2100, 10_000]
    assert {(c.n_stacks, c.psf) for c in full} == {(100_000, ("psf1", "psf2"))}


def test_each_number_of_stars_and_psf_has_its_symbols_and_line(of_n_stars):
    figure = effect_of_n_stars_drawn(of_n_stars.numbers, of_n_stars.limit, KCM16)
    for axis, quantity in zip(figure.axes, ("e1", "e2"), strict=True):
        assert len(axis.containers) == 4
        shown = [np.asarray(bars.lines[0].get_ydata(), dtype=float) for bars in axis.containers]
        for psf in ("psf1", "psf2"):
            for n_stars in (40, 750):
                expected = of_n_stars.numbers["sigma"].sel(n_stars=n_stars, psf=psf, quantity=quantity)
                assert any(np.array_equal(y, expected) for y in shown)


def test_the_setting_is_that_of_the_paper():
    config = paper_config()
    assert (config.stars.l, config.stars.b, config.stars.mag) == (180, 45, (18, 19))
    assert (config.n_stars, config.psf, config.estimator) == (40, ("psf0", "psf1", "psf2"), "adaptive")
    assert config.n_stacks >= 100_000
    assert paper_config(full=True).n_stacks > config.n_stacks


def test_requirements_and_instruments_name_their_source():
    assert (KCM16.sigma_e, KCM16.sigma_r2) == (2e-4, 1e-3)
    assert "Paulin-Henriksson" in KCM16.source
    assert EUCLID_VIS.pixel == 0.1
    assert EUCLID_VIS.source


def test_an_experiment_uses_its_stacks_again(numbers, tmp_path):
    seen = []
    errors_and_biases(numbers.config, tmp_path / "run.zarr", seen.append)
    again = []
    errors_and_biases(numbers.config, tmp_path / "run.zarr", again.append)
    assert sum(seen) == sum(again) == 20_000
    assert again == [20_000]


def test_each_panel_shows_its_symbols_and_lines(numbers):
    figure = drawn(numbers.summary, numbers.curves, numbers.limit, KCM16)
    axes = figure.axes
    assert len(axes) == 6
    for axis, (quantity, statistic) in zip(
        axes, [(q, s) for q in ("r2", "e1", "e2") for s in ("sigma", "bias")], strict=True
    ):
        assert axis.get_ylabel()
        assert len(axis.containers) == 3
        for p, bars in enumerate(axis.containers):
            here = {"psf": numbers.summary["psf"].to_numpy()[p], "quantity": quantity}
            np.testing.assert_allclose(
                np.asarray(bars.lines[0].get_ydata(), dtype=float), numbers.summary[statistic].sel(here)
            )
        lines = [np.asarray(line.get_ydata(), dtype=float) for line in axis.lines]
        assert any(
            np.array_equal(y, numbers.curves[statistic].sel(psf="psf1", quantity=quantity)) for y in lines
        )
        if statistic == "sigma":
            assert any(
                np.array_equal(y, numbers.limit["sigma"].sel(psf="psf1", quantity=quantity)) for y in lines
            )
    assert {axis.get_xlabel() for axis in axes[-2:]} == {"binary fraction of the population"}


@pytest.fixture(scope="module")
def results(numbers, of_n_stars):
    sky = population(magnitude=(18.0, 19.0))
    magnitude = against_magnitude(
        np.array([18.0, 19.0, 20.0, 21.0]), {name: MULTIPLICITY[name] for name in READINGS}, n_drawn=100
    )
    return {
        "toy": of_toy(toy_maps(points=9)),
        "sketch": pair_sketch(),
        "multiplicity_table": multiplicity_table({name: MULTIPLICITY[name] for name in READINGS}),
        "population": of_population(sky),
        "psf_table": psf_table(),
        "errors_and_biases": of_errors_and_biases(numbers, KCM16),
        "effect_of_n_stars": effect_parts(of_n_stars, KCM16),
        "magnitude": of_magnitude(magnitude),
    }


CLAIMS = [
    {"number": str(k), "statement": "Bias and error of the size are the same.", "paper": "σ ≃ bias",
     "quantity": "σ over the bias", "porrima": 1.25, "error": 0.0625, "verdict": verdict,
     "why": "The scatter of few stars < is added & counts."}
    for k, verdict in enumerate(VERDICTS)
]  # fmt: skip
NUMBERS = [
    {"claim": "0", "part": "same"}
    | measure("same", "σ over the bias", Number(1.25, error), 0.5, under=under).record()
    for error, under in ((0.0625, ""), (0.0, "many stars"))
]


@pytest.fixture(scope="module")
def folder(results, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    write_paper(results, folder, CLAIMS, NUMBERS)
    return folder


@pytest.fixture(scope="module")
def page(folder):
    """The page as a parser reads it that takes nothing that is not HTML 5."""
    return parsed(folder / "index.html")


def parsed(path):
    parser = html5lib.HTMLParser(strict=True, namespaceHTMLElements=False)
    return parser.parse(path.read_text(encoding="utf-8"))


def words_of(element, skip=()):
    if not isinstance(element.tag, str) or element.tag.rpartition("}")[2] in skip:
        return element.tail or ""
    return (element.text or "") + "".join(words_of(one, skip) for one in element) + (element.tail or "")


def numbers_in(value):
    """All numbers in datasets and configurations."""
    if isinstance(value, dict):
        return set().union(*map(numbers_in, value.values()), set())
    if isinstance(value, list | tuple):
        return set().union(*map(numbers_in, value), set())
    if isinstance(value, str):
        return numbers_in(json.loads(value)) if value.startswith("{") else set()
    if value is None or isinstance(value, bool):
        return set()
    return {float(value)}


def saved(results):
    parts = [part for one in results.values() for part in one.values()]
    values = [variable.to_numpy().ravel() for part in parts for variable in part.variables.values()]
    known = {float(number) for some in values if some.dtype.kind in "fiub" for number in some}
    return known.union(*(numbers_in(dict(part.attrs)) for part in parts))


def labels(results):
    """Words that come with the numbers."""
    parts = [part for one in results.values() for part in one.values()]
    values = [variable.to_numpy().ravel() for part in parts for variable in part.variables.values()]
    words = {str(word) for some in values if some.dtype.kind in "UOT" for word in some}
    words |= {str(word) for part in parts for word in part.attrs.values() if isinstance(word, str)}
    return words | {"Kuntzer, Courbin & Meylan (2016)", "R²", "(PSF)", "arcsec²", "deg²", "10−3", *results}


def test_every_number_in_the_page_is_one_that_was_saved(results, page):
    known = saved(results) | numbers_in(CLAIMS) | numbers_in(NUMBERS)
    quotes = list(page.iter("data"))
    assert len(quotes) > 1000
    for quote in quotes:
        value = float(quote.get("value"))
        assert value in known, value
        text = words_of(quote).removesuffix(quote.tail or "").replace(" ", "").replace("−", "-")
        mantissa, _, exponent = text.removesuffix(" %").replace(" ", "").replace("%", "").partition("×10")
        shown = float(mantissa) * 10.0 ** int(exponent or 0) * (0.01 if text.endswith("%") else 1.0)
        shown *= float(quote.get("data-scale", 1.0))
        places = len(mantissa.partition(".")[2])
        unit = 10.0 ** (int(exponent or 0) - places) * (0.01 if text.endswith("%") else 1.0)
        unit *= float(quote.get("data-scale", 1.0))
        assert abs(abs(shown) - abs(value)) <= 0.5001 * unit, (text, value)


def test_there_is_no_number_that_the_page_does_not_mark_as_saved(results, page):
    sections = [one for one in page.iter("section") if one.get("aria-labelledby") not in
                ("methods", "configuration", "versions", "references", "claims")]  # fmt: skip
    assert len(sections) == 2 + len(results)
    for section in sections:
        text = words_of(section, skip=("data", "svg", "summary"))
        for words in sorted(labels(results), key=len, reverse=True):
            text = text.replace(words, "")
        text = re.sub(r"\be[12]\b|latitude at l = \d+°|longitude at b = 45°|[a-z_]+, e = [\d.]+", "", text)
        assert not re.search(r"\d", text), re.search(r".{0,60}\d.{0,60}", text, re.S)[0]


def test_the_page_loads_nothing(page, folder):
    for element in page.iter():
        for name, value in element.attrib.items():
            if str(name).split("}")[-1] in ("src", "href", "data", "poster", "srcset", "action"):
                link = element.tag == "a" and value.startswith("https://")
                assert value.startswith(("#", "data:")) or link, (element.tag, value[:80])
    text = (folder / "index.html").read_text(encoding="utf-8")
    assert not re.findall(r"@import|url\((?!#)[^)]{0,40}", text)
    policy = next(one for one in page.iter("meta") if one.get("http-equiv") == "Content-Security-Policy")
    assert policy.get("content").startswith("default-src 'none'")


def test_the_tables_can_be_taken_away_with_all_their_digits(results, page):
    links = {one.get("download"): one.get("href") for one in page.iter("a") if one.get("download")}
    for suffix in ("csv", "ecsv"):
        text = base64.b64decode(links[f"errors_and_biases.{suffix}"].partition("base64,")[2]).decode()
        table = Table.read(text, format=f"ascii.{suffix}")
        assert table.colnames == list(rows(results["errors_and_biases"]["summary"])[0])
        expected = results["errors_and_biases"]["summary"]["bias"].sel(psf="psf0", quantity="r2").to_numpy()
        np.testing.assert_array_equal(table["bias"][:20], expected)
    config = yaml.safe_load(base64.b64decode(links["errors_and_biases.yaml"].partition("base64,")[2]))
    assert parse(RunConfig, config) == parse(
        RunConfig, json.loads(results["errors_and_biases"]["findings"].attrs["config"])
    )
    claims = base64.b64decode(links["claims.csv"].partition("base64,")[2]).decode()
    assert len(Table.read(claims, format="ascii.csv")) == len(CLAIMS)


def test_only_what_the_models_in_use_ask_for_is_cited(page):
    cited = {one.get("id").removeprefix("reference-") for one in page.iter("li") if one.get("id")}
    assert {"KCM16", "DucheneKraus2013", "Robin2003", "Bressan2012", "Hirata2003"} <= cited
    assert not cited & {"Habets1981", "Offner2023", "Winters2019", "Kaiser1995"}


def test_claims_have_a_section_only_where_there_are_some(results, page, tmp_path):
    ids = {one.get("id") for one in page.iter() if one.get("id")}
    table = next(one for one in page.iter("table") if one.get("id") == "table-claims")
    assert "claims" in ids
    assert len(table.findall("tbody/tr")) == len(CLAIMS)
    one = {"errors_and_biases": results["errors_and_biases"]}
    without = parsed(write_paper(one, tmp_path))
    assert not [one for one in without.iter() if "claims" in (one.get("id") or one.get("href") or "")]
    with pytest.raises(ValueError, match="a claim must have error, number, paper"):
        write_paper(one, tmp_path, [{"number": 1}])
    with pytest.raises(ValueError, match="verdict must be one of holds"):
        write_paper(one, tmp_path, [CLAIMS[0] | {"verdict": "maybe"}])


def test_the_claims_lie_beside_the_page_with_all_their_digits(folder):
    result = json.loads((folder / "claims.json").read_text(encoding="utf-8"))
    assert result["claims"] == CLAIMS
    assert [row["largest"] for row in result["numbers"]] == [None, None]
    assert [row["value"] for row in result["numbers"]] == [1.25, 1.25]
    assert len(Table.read(folder / "claims.ecsv")) == len(CLAIMS)
    assert len(Table.read(folder / "claim_numbers.ecsv")) == len(NUMBERS)


def test_figures_have_the_colours_of_the_page_and_names_of_their_own(folder, page):
    drawings = list(page.iter("{http://www.w3.org/2000/svg}svg")) or list(page.iter("svg"))
    assert len(drawings) == 6
    ids = [one.get("id") for one in page.iter() if one.get("id")]
    assert len(ids) == len(set(ids))
    text = (folder / "index.html").read_text(encoding="utf-8").split("<svg")
    assert sum("var(--blue)" in one for one in text[1:]) >= 3
    assert sum("drawing card" in one for one in text) == 2  # maps of colours stand on white


def test_the_same_numbers_give_the_same_files_and_are_drawn_once(results, tmp_path):
    stems = ("errors_and_biases", "magnitude")
    results = {name: results[name] for name in stems}
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_paper(results, tmp_path / name)
    files = [f"{stem}.{suffix}" for stem in stems for suffix in ("ecsv", "pdf", "png", "svg")]
    assert {p.name for p in (tmp_path / "a").iterdir() if p.name[0] != "."} == {*files, "index.html"}
    for name in (*files, "index.html"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    times = {name: (tmp_path / "a" / name).stat().st_mtime_ns for name in files if "ecsv" not in name}
    (tmp_path / "a" / "magnitude.png").unlink()
    write_paper(results, tmp_path / "a")
    again = {name: (tmp_path / "a" / name).stat().st_mtime_ns for name in times}
    assert {name for name in times if times[name] != again[name]} == {
        f"magnitude.{suffix}" for suffix in ("svg", "pdf", "png")
    }


@pytest.mark.parametrize("fraction", [0.3, "model"])
def test_a_run_of_one_binary_fraction_has_its_page(tmp_path, fraction):
    stars = StarsConfig(l=180, b=45, mag=(18, 19), n_drawn=200)
    config = RunConfig(stars=stars, n_stacks=500, psf=("psf1",), binary_fraction=fraction)
    found = errors_and_biases(config, tmp_path / "run.zarr")
    assert found.fraction == pytest.approx(0.3, abs=0.03)
    path = write_run(of_errors_and_biases(found, KCM16), "run.zarr", tmp_path / "report.html")
    page = parsed(path)
    text = words_of(next(one for one in page.iter("main")), skip=("svg", "math"))
    assert "The run run.zarr" in words_of(next(one for one in page.iter("h1")))
    assert f"{found.fraction:.0%}".replace("%", " %") in text
    assert float(found.mean_x) in {float(one.get("value")) for one in page.iter("data")}


def test_a_selection_is_drawn_with_all_its_stars():
    stars = Stars.from_columns(
        mass=[0.1, 0.4, 0.9],
        distance=[100, 500, 3000],
        magnitude=[18, 18.5, 18.9],
        component=["thin1", "thick", "thin7"],
    )
    figure = selection(stars)
    for axis in figure.axes:
        assert sum(patch.get_height() for patch in axis.patches) == 3
        assert axis.get_xlabel()
    assert [t.get_text() for t in figure.axes[2].get_legend().get_texts()] == ["thin disc", "thick disc"]


@pytest.fixture(scope="module")
def browser():
    if executable() is None:
        pytest.skip("no Chromium is installed")
    window = Browser()
    yield window
    window.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 360])
def test_a_browser_shows_the_page_without_complaint(browser, folder, width, scheme):
    browser.show(folder / "index.html", width, prefers_color_scheme=scheme)
    browser.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    browser.evaluate("dispatchEvent(new Event('resize'))")
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    assert browser.complaints() == []
    assert [url[:5] for url in browser.requests() if not url.startswith("data:")] == ["file:"]
    script = (Path(__file__).parent / "accessible.js").read_text(encoding="utf-8")
    assert browser.evaluate(script) == []
    columns = browser.evaluate("getComputedStyle(document.querySelector('nav')).position")
    assert columns == ("sticky" if width == 1280 else "static")


def test_a_table_is_copied_by_its_button(browser, folder):
    browser.show(folder / "index.html", 1280)
    browser.evaluate("document.querySelector('button[data-copies]').click()")
    said = "new Promise((done) => setTimeout(() => done(document.getElementById('said').textContent), 300))"
    assert browser.evaluate(said).startswith("Copied: ")
    assert browser.complaints() == []


def test_print_leaves_the_contents_and_buttons_out_and_is_dark_on_light(browser, folder):
    browser.show(folder / "index.html", 800, medium="print", prefers_color_scheme="dark")
    shown = (
        "[...document.querySelectorAll('nav, button, .tools')].filter((one) => one.checkVisibility()).length"
    )
    assert browser.evaluate(shown) == 0
    assert browser.evaluate("getComputedStyle(document.body).color") == "rgb(0, 0, 0)"
    assert browser.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
