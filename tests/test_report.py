"""Experiment, figure and report of the paper's six panels, on a small run."""

import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from astropy.table import Table

from porrima.config import RunConfig, StarsConfig
from porrima.experiments import effect_of_n_stars, errors_and_biases, n_stars_configs, paper_config
from porrima.figures import effect_of_n_stars as effect_of_n_stars_drawn
from porrima.figures import errors_and_biases as drawn
from porrima.instruments import EUCLID_VIS, KCM16
from porrima.report import write_report
from porrima.star_figures import selection
from porrima.stars import Stars
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


class _Page(HTMLParser):
    def __init__(self):
        super().__init__()
        self.open, self.links = [], []

    def handle_starttag(self, tag, attributes):
        self.links += [v for k, v in attributes if k in ("src", "href") and not v.startswith("#")]
        if tag not in ("meta", "br", "link", "img", "path", "use", "rect"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.links += [v for k, v in attributes if k in ("src", "href") and not v.startswith("#")]

    def handle_endtag(self, tag):
        if self.open and self.open[-1] == tag:
            self.open.pop()


def test_the_page_needs_no_network_and_quotes_the_saved_numbers(numbers, of_n_stars, tmp_path):
    path = write_report(numbers, of_n_stars, tmp_path)
    text = path.read_text(encoding="utf-8")
    page = _Page()
    page.feed(text)
    assert page.open == []
    assert not [link for link in page.links if link.startswith(("http", "//"))]
    first = numbers.summary["bias"].sel(psf="psf0", quantity="r2")[0].item()
    assert f"{first * 1e3:.4f} ± " in text
    assert '"seed": 1' in text.replace("&quot;", '"')
    stems = ("effect_of_n_stars", "errors_and_biases")
    files = [f"{stem}.{suffix}" for stem in stems for suffix in ("ecsv", "pdf", "png", "svg")]
    assert sorted(p.name for p in tmp_path.iterdir()) == [*files, "index.html"]


def test_the_same_numbers_give_the_same_files(numbers, of_n_stars, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_report(numbers, of_n_stars, tmp_path / name)
    for name in ("errors_and_biases.ecsv", "errors_and_biases.pdf"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_the_table_and_the_vector_figure_can_be_read(numbers, of_n_stars, tmp_path):
    write_report(numbers, of_n_stars, tmp_path)
    table = Table.read(tmp_path / "errors_and_biases.ecsv")
    assert len(table) == 3 * 3 * 20
    assert re.search("svg", ElementTree.parse(tmp_path / "errors_and_biases.svg").getroot().tag)


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
