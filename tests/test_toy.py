import numpy as np
import pytest

from porrima.errors import InputError
from porrima.images import measure_stack
from porrima.psf import sheared_gaussian
from porrima.shapes import Adaptive
from porrima.systems import Systems
from porrima.toy import _pairs, headline, toy_maps, write_toy


@pytest.fixture(scope="module")
def maps():
    return toy_maps(points=9)


def test_maps_are_those_of_drawn_pairs(maps):
    psf = sheared_gaussian("drawn", 0.05, 0.0)
    for x, y, dm in ((0.025, -0.0375, 0.0), (0.05, 0.05, 1.0)):
        pair = Systems.from_pairs([10 ** (-0.4 * dm)], [x], [y])
        drawn = measure_stack(psf, pair, Adaptive())
        here = maps.sel(psf="PSF along e1", delta_m=dm).sel(x=x, y=y, method="nearest")
        r2_0 = float(here["r2_0"])
        assert float(here["dr2_rel"]) == pytest.approx(float(drawn.r2) / r2_0 - 1, abs=1e-4)
        assert float(here["e"]) == pytest.approx(float(np.hypot(drawn.e1, drawn.e2)), abs=1e-4)


def test_nothing_changes_for_a_companion_on_its_primary(maps):
    middle = maps.sel(x=0.0, y=0.0, method="nearest")
    assert np.abs(middle["de_rel"]).max() < 1e-10
    assert np.abs(middle["dr2_rel"]).max() < 1e-10


def test_maps_along_e2_are_those_along_e1_turned_by_45_degrees_on_the_axes_of_the_psf(maps):
    # the companion on the major axis: (r, 0) for e1 and (r, r) / sqrt(2) for e2
    psfs = [sheared_gaussian("a", 0.05, 0.0), sheared_gaussian("b", 0.0, 0.05)]
    along = _pairs(psfs[0], 1.0, np.array([0.03]), np.array([0.0]))
    turned = _pairs(psfs[1], 1.0, np.array([0.03]) / np.sqrt(2), np.array([0.03]) / np.sqrt(2))
    assert along["e1"][0] == pytest.approx(turned["e2"][0], abs=1e-10)
    assert along["r2"][0] == pytest.approx(turned["r2"][0], rel=1e-10)


def test_places_beyond_the_series_are_drawn_instead():
    sharp = toy_maps(fwhm=0.08, points=3)  # corners at 0.07 arcsec
    assert sharp["by_images"].any()
    assert np.isfinite(sharp["e"]).all()
    np.testing.assert_allclose(sharp["e"], sharp["e"][:, :, ::-1, ::-1], atol=1e-9)


def test_headline_says_what_the_paper_says_of_its_maps(maps):
    numbers = headline(maps)
    equal, fainter = numbers["contrasts"]
    assert equal["de_rel_at_0_01"] > 0.01
    assert 0.5 < fainter["de_rel_at_0_01"] / equal["de_rel_at_0_01"] < 1
    assert equal["radius_of_1_percent"] < 0.01
    assert numbers["e_depends_on_psf"] > 0.2
    assert numbers["r2_depends_on_psf"] < 0.02


def test_figure_and_numbers_are_written(tmp_path):
    result = write_toy(tmp_path / "toy", points=5)
    with np.load(result["maps"]) as file:
        assert file["de_rel"].shape == (2, 2, 5, 5)
    assert (tmp_path / "toy" / "toy.png").stat().st_size > 1e4


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        ({"fwhm": 0.0}, "--psf-fwhm: must be positive"),
        ({"ellipticity": 1.0}, "--ellipticity: must be between 0 and 1"),
        ({"points": 4}, "--points: must be odd"),
    ],
)
def test_wrong_arguments_are_answered_with_the_rule(options, rule):
    with pytest.raises(InputError, match=rule):
        toy_maps(**options)
