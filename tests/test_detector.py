import galsim
import numpy as np
import pytest

from porrima.detector import on_pixels, recentred
from porrima.psf import PSF, psf_from_name
from porrima.response import response
from porrima.shapes import Adaptive, Plain
from porrima.systems import Systems


def random_pairs(seed, n, r_max=0.05):
    rng = np.random.Generator(np.random.Philox(seed))
    r, angle = r_max * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    return Systems.from_pairs(rng.random(n), r * np.cos(angle), r * np.sin(angle))


def test_fine_pixels_give_the_change_of_the_response_at_any_phase():
    systems = random_pairs(1, 20)
    found = response(psf_from_name("psf1"), Adaptive())
    shape = found.shapes(systems.kernel_moments(), threshold=0.0)
    changes = on_pixels(psf_from_name("psf1"), systems, Adaptive(), 0.03, phases=3, half_width=0.8)
    np.testing.assert_allclose(changes["dr2_rel"], shape.r2[0] / found.shape0.r2 - 1, rtol=1e-5)
    np.testing.assert_allclose(changes["de1"], shape.e1[0] - found.shape0.e1, atol=1e-7)


def test_survey_pixels_make_the_change_depend_on_the_phase():
    psf = PSF(name="pixel", profile=galsim.Convolve(psf_from_name("psf1").profile, galsim.Pixel(0.1)))
    changes = on_pixels(psf, random_pairs(2, 10), Adaptive(), 0.1)
    spread = float(changes["dr2_rel"].std() / changes["dr2_rel"].mean())
    assert 1e-3 < spread < 0.3


def test_recentring_leaves_equal_pairs_and_plain_moments_alone():
    equal = Systems.from_pairs([1.0, 1.0], [0.03, 0.0], [0.0, 0.04])
    moved = recentred(psf_from_name("psf1"), equal, Adaptive())
    np.testing.assert_allclose(moved.x, equal.x, atol=1e-12)
    pairs = random_pairs(3, 4)
    np.testing.assert_allclose(recentred(psf_from_name("psf1"), pairs, Plain()).x, pairs.x, atol=1e-12)


def test_measured_centres_lie_towards_the_brighter_star():
    pair = Systems.from_pairs([0.3, 0.0], [0.05, 0.0], [0.0, 0.0])
    moved = recentred(psf_from_name("psf0"), pair, Adaptive())
    # the stack's mean shift is taken out: the pair moves by half of the difference to the single star
    assert 1e-5 < float(moved.x[0, 0] - pair.x[0, 0]) < 2e-3
    assert float(moved.x[1, 0]) == pytest.approx(-float(moved.x[0, 0] - pair.x[0, 0]), rel=1e-9)


def test_centring_changes_the_size_change_by_a_few_thousandths():
    systems = random_pairs(4, 12)
    found = response(psf_from_name("psf1"), Adaptive())
    flux, measured = (
        float(found.shapes(s.kernel_moments(), threshold=0.0).r2[0] / found.shape0.r2 - 1)
        for s in (systems, recentred(psf_from_name("psf1"), systems, Adaptive()))
    )
    assert 1e-5 < abs(measured / flux - 1) < 5e-3
