import galsim
import numpy as np
import pytest

from porrima.aperture import aperture_covariance, aperture_psf
from porrima.images import measure_stack
from porrima.moments import INDICES, KernelMoments
from porrima.psf import PSF, psf_from_name
from porrima.reach import settled, stamp_reach
from porrima.response import response
from porrima.shapes import Adaptive, GaussianWeight, Plain
from porrima.systems import Systems

WINGS = PSF(
    name="wings",
    profile=galsim.Sum(
        galsim.Moffat(beta=2.0, fwhm=0.13).shear(e1=0.1, e2=0.04),
        galsim.Gaussian(fwhm=0.2).shift(0.05, 0.02) * 0.2,
    ),
    extent=1.0,
)


def change(shape, shape0):
    differences = shape.e1 - shape0.e1, shape.e2 - shape0.e2, (shape.r2 - shape0.r2) / shape0.r2
    return np.array([np.squeeze(d) for d in differences])


def random_pairs(seed, n):
    rng = np.random.Generator(np.random.Philox(seed))
    r, angle = 0.05 * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    return Systems.from_pairs(rng.random(n), r * np.cos(angle), r * np.sin(angle))


@pytest.mark.parametrize("radius", [0.2, 0.5, 1.5])
@pytest.mark.parametrize("n", [1, 40])
def test_plain_shapes_in_an_aperture_are_those_of_the_drawn_stack(radius, n):
    systems, estimator = random_pairs(n, n), Plain(radius)
    alone = Systems.from_pairs(*np.zeros((3, 1)))
    drawn = change(measure_stack(WINGS, systems, estimator), measure_stack(WINGS, alone, estimator))
    found = response(WINGS, estimator)
    shape = found.shapes(systems.kernel_moments(), threshold=0.0)
    assert np.abs(change(shape, found.shape0) - drawn).max() < 2e-5 * np.abs(drawn).max()


def test_a_wide_aperture_leaves_a_gaussian_its_parallel_axis_theorem():
    found = response(psf_from_name("psf1"), Plain(0.6))
    np.testing.assert_allclose(
        [found.kappa_r2, found.de1_deta, found.de2_deta], [1, -0.054, 0.003], atol=1e-9
    )


def test_derivatives_are_those_of_the_closed_form():
    estimator = Plain(0.3)
    about, found = aperture_psf(WINGS.draw(), estimator), response(WINGS, estimator)
    direction = random_pairs(7, 3).kernel_moments().values[0]
    steps = np.array([-2.0, -1.0, 0.0, 1.0, 2.0]) * 1e-2
    covariance = aperture_covariance(about, steps[:, None] * direction)
    r2 = covariance[:, 0] + covariance[:, 2]
    for k, values in enumerate(((covariance[:, 0] - covariance[:, 2]) / r2, 2 * covariance[:, 1] / r2, r2)):
        slope = np.array([1, -8, 0, 8, -1]) @ values / 12 / 1e-2
        curvature = np.array([-1, 16, -30, 16, -1]) @ values / 12 / 1e-4
        assert slope == pytest.approx(found.first[k] @ direction, rel=1e-6)
        assert curvature == pytest.approx(direction @ found.second[k] @ direction, rel=1e-3)


def test_second_order_misses_the_closed_form_by_the_cube_of_the_change():
    found = response(WINGS, Plain(0.3))
    moments = random_pairs(16, 40).kernel_moments().values
    stacks = KernelMoments(values=0.5 ** np.arange(3)[:, None] * moments, n_stars=40)
    miss = np.abs(found.shapes(stacks, threshold=0.0).r2 - found.shapes(stacks, threshold=np.inf).r2)
    assert 7.0 < miss[1] / miss[2] < 9.0


def test_odd_moments_move_the_centre_and_only_through_it_the_shape():
    found = response(psf_from_name("psf1"), Plain(0.3))
    odd = np.array([sum(index) % 2 == 1 for index in INDICES])
    natural = 0.1 ** np.sum(INDICES, axis=1)
    assert np.abs(found.first[:, odd] * natural[odd]).max() < 1e-9


def test_plain_moments_that_diverge_get_an_aperture_and_others_none():
    assert settled(Plain(), psf_from_name("psf2")) == Plain()
    assert settled(Plain(), WINGS) == Plain(0.75)
    assert settled(Plain(0.3), WINGS) == Plain(0.3)
    assert settled(Adaptive(), WINGS) == Adaptive()
    assert response(WINGS, Plain()).estimator == "plain:0.75"


def test_stamps_reach_as_far_as_the_weight_where_the_psf_has_wings():
    assert stamp_reach(GaussianWeight(0.75), WINGS) == pytest.approx(5.25)
    assert stamp_reach(GaussianWeight(0.75), psf_from_name("psf1")) == 0.0
    assert stamp_reach(Adaptive(), WINGS) == 0.0


def test_a_psf_without_a_centroid_in_its_aperture_is_refused():
    star = galsim.Gaussian(fwhm=0.1)
    image = PSF(name="far", profile=star.shift(0.7, 0.0), extent=1.0).draw()
    with pytest.raises(ValueError, match="must have a centroid within its aperture"):
        aperture_psf(image, Plain(0.1))
