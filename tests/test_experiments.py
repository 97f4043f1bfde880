import numpy as np
import pytest

from porrima.config import PopulationConfig
from porrima.diagrams import against_magnitude as figure_against_magnitude
from porrima.experiments import ELLIPTICITIES, against_magnitude
from porrima.instruments import KCM16
from porrima.multiplicity import MULTIPLICITY
from porrima.prediction import integrate, population_moments, predict
from porrima.psf import sheared_gaussian
from porrima.response import response
from porrima.sample import draw_stars, population_of
from porrima.shapes import Adaptive

MODELS = {name: MULTIPLICITY[name] for name in ("dk13", "dk13-kcm16")}


@pytest.fixture(scope="module")
def data():
    return against_magnitude(np.array([18.0, 19.0, 21.0]), MODELS, n_drawn=200)


def test_errors_of_gaussian_psfs_go_with_their_ellipticity(data):
    gaussian = data.isel(psf=slice(len(ELLIPTICITIES)))
    slope = gaussian["limit_e"] / (gaussian["e_0"] * gaussian["limit_r2"])
    np.testing.assert_allclose(slope, 1.0, atol=0.06)
    np.testing.assert_allclose(gaussian["e_0"], ELLIPTICITIES, rtol=1e-6)


def test_the_size_error_is_eta_but_for_moments_of_higher_order(data):
    one = data.isel(psf=0)
    np.testing.assert_allclose(one["limit_r2"] * one["r2_0"] / one["mean_x"], 0.97, atol=0.03)
    assert np.all(data["mean_x_low"] < data["mean_x"])
    assert np.all(data["mean_x"] < data["mean_x_high"])


def test_the_two_readings_differ_most_where_stars_are_faint(data):
    ratio = (data["mean_x"].sel(model="dk13") / data["mean_x"].sel(model="dk13-kcm16")).to_numpy()
    assert ratio[1] > 2 * ratio[0] > 2


def test_the_figure_has_a_column_for_each_model(data):
    figure = figure_against_magnitude(data, KCM16)
    titles = [axis.get_title() for axis in figure.axes]
    assert [title for title in titles if title] == list(MODELS)
    assert len(figure.axes) == 3 * 2 + 1


def test_the_same_binaries_hurt_a_larger_psf_less():
    config = PopulationConfig(stars={"l": 180, "b": 45, "mag": (18, 19), "n_drawn": 200})
    population = population_of(config, draw_stars(config))
    moments = population_moments(population, integrate(population), np.array([0.35]))
    found = [
        predict(moments, response(sheared_gaussian("g", 0.05, 0.0, w), Adaptive()))
        for w in (0.137, 0.17, 0.25)
    ]
    bias, r2_0 = np.array([p.bias[2, 0] for p in found]), np.array([p.r2_0 for p in found])
    np.testing.assert_allclose(
        bias * r2_0 / moments.mean_x[0], 1.0, atol=0.05
    )  # as 1/R², but for higher orders
    assert bias[0] > bias[1] > bias[2]
