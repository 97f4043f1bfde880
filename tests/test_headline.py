"""The headline: number of stars, magnitude and clips against what is required."""

import numpy as np
import pytest

from porrima.headline import MODELS, headline
from porrima.headline_figure import levers


@pytest.fixture(scope="module")
def data():
    return headline(crowds=(100, 10_000, 100_000_000), edges=(18, 19, 20), n_drawn=200)


def test_the_size_of_endless_stars_is_wrong_by_its_bias_and_the_ellipticity_of_fewer_by_its_scatter(data):
    size, ellipticity = data["error"].sel(quantity="r2"), data["error"].sel(quantity="e1")
    assert float(size[-1]) == pytest.approx(float(data["bias"].sel(way="dk13", bin=0)), rel=1e-4)
    assert float(size[1]) == pytest.approx(float(size[-1]), rel=0.01)
    assert float(ellipticity[0] / ellipticity[1]) == pytest.approx(10, rel=0.4)


def test_dropping_large_stars_takes_most_of_the_bias_of_any_magnitude(data):
    left = data["bias"].sel(way="clip") / data["bias"].sel(way="dk13")
    assert np.all((left > 0.05) & (left < 0.4))


def test_figure_shows_both_quantities_and_every_way_with_what_is_required(data):
    left, right = levers(data).axes
    assert len(left.get_lines()) == 2 + 1
    assert len(right.get_lines()) == len(MODELS) + 1 + 1
    assert "1%" in " ".join(text.get_text() for text in right.get_legend().get_texts())
