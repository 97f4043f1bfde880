import dataclasses
from functools import cache

import galsim
import numpy as np
import pytest

from porrima.images import measure_stack
from porrima.moments import INDICES, N_MOMENTS, KernelMoments
from porrima.psf import PSF, psf_from_name
from porrima.reach import stamp_reach
from porrima.response import response
from porrima.shapes import Adaptive, Failure, GaussianWeight, Plain, Shape
from porrima.systems import Systems
from porrima.weighted import exact_covariance, weighted_psf

GAUSSIANS = ["psf0", "psf1", "psf2"]
LOPSIDED = PSF(  # as general as can be: no symmetry, wings, centroid off the origin
    name="lopsided",
    profile=galsim.Sum(
        galsim.Gaussian(fwhm=0.12).shear(e1=0.1, e2=0.05) * 0.7,
        galsim.Gaussian(fwhm=0.2).shear(e1=-0.2, e2=0.1).shift(0.03, -0.01) * 0.25,
        galsim.Gaussian(fwhm=0.3).shift(-0.05, 0.02) * 0.05,
    ),
    extent=1.6,
)
WEIGHTED = [Adaptive(), GaussianWeight(0.06), GaussianWeight(0.75)]
EVERY = [Plain(), *WEIGHTED]
weighted_only = pytest.mark.parametrize("estimator", WEIGHTED, ids=lambda e: e.name)
every_estimator = pytest.mark.parametrize("estimator", EVERY, ids=lambda e: e.name)
every_gaussian = pytest.mark.parametrize("name", GAUSSIANS)


def psf_of(name):
    return LOPSIDED if name == "lopsided" else psf_from_name(name)


@cache
def image_shape0(name, estimator):
    return estimator.measure(psf_of(name).draw())


def random_pairs(seed, n, fraction):
    rng = np.random.Generator(np.random.Philox(seed))
    f = rng.random(n) * (rng.random(n) < fraction)
    r, angle = 0.05 * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    return Systems.from_pairs(f, r * np.cos(angle), r * np.sin(angle))


def one_pair(f, r, angle):
    return Systems.from_pairs(f, r * np.cos(angle), r * np.sin(angle))


def change(shape, shape0):
    """Of e1, e2, and R² relative."""
    differences = shape.e1 - shape0.e1, shape.e2 - shape0.e2, (shape.r2 - shape0.r2) / shape0.r2
    return np.array([np.squeeze(d) for d in differences])


def change_by_response(name, estimator, systems, **options):
    found = response(psf_of(name), estimator)
    return change(found.shapes(systems.kernel_moments(), **options), found.shape0)


def change_by_image(name, estimator, systems):
    return change(measure_stack(psf_of(name), systems, estimator), image_shape0(name, estimator))


def moments_of(values, n=1):
    """KernelMoments with a few entries, given as {(a, b): value}."""
    array = np.zeros((n, N_MOMENTS))
    for index, value in values.items():
        array[:, INDICES.index(index)] = value
    return KernelMoments(values=array, n_stars=1)


# The independent check: images drawn and measured with GalSim.


@every_gaussian
@pytest.mark.parametrize("fraction", [0.35, 1.0])
@pytest.mark.parametrize("seed", [11, 12, 13])
def test_adaptive_shapes_of_40_pairs_are_those_of_the_drawn_stack(name, fraction, seed):
    systems = random_pairs(seed, 40, fraction)
    drawn = change_by_image(name, Adaptive(), systems)
    assert np.abs(change_by_response(name, Adaptive(), systems) - drawn).max() < 2e-5 * drawn[2]


@every_gaussian
@pytest.mark.parametrize("f", [1.0, 0.3])
@pytest.mark.parametrize("angle", [0.0, 0.4, 1.9])
def test_adaptive_shape_of_one_worst_pair_is_that_of_the_drawn_pair(name, f, angle):
    drawn = change_by_image(name, Adaptive(), one_pair(f, 0.05, angle))
    found = change_by_response(name, Adaptive(), one_pair(f, 0.05, angle))
    assert np.abs(found - drawn).max() < 1e-5 * drawn[2]


@every_gaussian
def test_second_order_alone_is_enough_where_it_is_used(name):
    # 40 stars, few and close pairs: size changes of 0.3 %, below the threshold of the exact solution.
    for seed in range(20, 24):
        systems = random_pairs(seed, 40, 0.12)
        drawn = change_by_image(name, Adaptive(), systems)
        found = change_by_response(name, Adaptive(), systems, threshold=np.inf)
        assert np.abs(found - drawn).max() < 1e-4 * drawn[2]


@every_gaussian
@pytest.mark.parametrize("systems", [random_pairs(14, 40, 0.35), one_pair(0.7, 0.05, 1.0)], ids=["40", "1"])
def test_plain_shapes_are_those_of_the_drawn_stack(name, systems):
    drawn = change_by_image(name, Plain(), systems)
    assert np.abs(change_by_response(name, Plain(), systems) - drawn).max() < 1e-9 * drawn[2]


@weighted_only
@pytest.mark.parametrize("systems", [random_pairs(15, 40, 1.0), one_pair(0.4, 0.05, 2.5)], ids=["40", "1"])
def test_any_psf_and_weight_agree_with_the_drawn_stack(estimator, systems):
    drawn = change_by_image("lopsided", estimator, systems)
    found = change_by_response("lopsided", estimator, systems)
    assert np.abs(found - drawn).max() < 3e-5 * np.abs(drawn).max()


@every_estimator
@pytest.mark.parametrize("name", [*GAUSSIANS, "lopsided"])
def test_shape_without_companions_is_that_of_the_image(name, estimator):
    found, drawn = response(psf_of(name), estimator).shape0, image_shape0(name, estimator)
    np.testing.assert_allclose(found.covariance(), drawn.covariance(), rtol=0, atol=1e-11 * drawn.r2)


def drawn_ring(estimator, n, phase):
    """Change behind LOPSIDED per arcsec² of x for n equal companions around, at radius 0 by extrapolation."""
    angles = phase + 2 * np.pi * np.arange(n) / n
    rates = []
    for r in (0.002, 0.004):
        ring = Systems.from_pairs(np.ones(n), r * np.cos(angles), r * np.sin(angles))
        rates.append(change_by_image("lopsided", estimator, ring) / (r**2 / 4))
    return (4 * rates[0] - rates[1]) / 3  # what is left is of fourth order in r


@every_estimator
def test_isotropic_derivatives_are_those_of_drawn_rings(estimator):
    found = response(LOPSIDED, estimator)
    expected = drawn_ring(estimator, 8, 0.1) * found.shape0.r2  # per eta
    np.testing.assert_allclose(
        [found.de1_deta, found.de2_deta, found.kappa_r2], expected, atol=2e-5 * np.abs(expected).max()
    )


@every_estimator
def test_first_derivatives_by_each_second_moment_are_those_of_drawn_pairs(estimator):
    found = response(LOPSIDED, estimator)
    scale = np.array([1, 1, found.shape0.r2])
    xx, xy, yy = (found.first[:, INDICES.index(i)] / scale for i in ((2, 0), (1, 1), (0, 2)))
    tolerance = 2e-5 * np.abs(xx).max()
    np.testing.assert_allclose(drawn_ring(estimator, 2, 0.0), xx, atol=tolerance)
    np.testing.assert_allclose(drawn_ring(estimator, 2, np.pi / 2), yy, atol=tolerance)
    np.testing.assert_allclose(drawn_ring(estimator, 2, np.pi / 4), (xx + yy + xy) / 2, atol=tolerance)


@weighted_only
def test_first_derivatives_by_third_moments_are_those_of_drawn_pairs(estimator):
    # A pair and the same pair turned by 180 degrees have the same even moments and opposite odd ones.
    found = response(LOPSIDED, estimator)
    rates = []
    for r in (0.008, 0.016):
        there, back = (change_by_image("lopsided", estimator, one_pair(0.3, s * r, 0.5)) for s in (1, -1))
        rates.append((there - back) / 2 / r**3)
    drawn = (4 * rates[0] - rates[1]) / 3
    m3 = one_pair(0.3, 1.0, 0.5).kernel_moments().values[0, 3:7]
    expected = found.first[:, 3:7] @ m3 / np.array([1, 1, found.shape0.r2])
    np.testing.assert_allclose(drawn, expected, atol=2e-3 * np.abs(expected).max())


# Closed forms.


@every_gaussian
def test_a_gaussian_responds_to_adaptive_and_plain_moments_as_to_the_parallel_axis_theorem(name):
    for estimator in (Adaptive(), Plain()):
        found = response(psf_from_name(name), estimator)
        slopes = found.kappa_r2, found.de1_deta, found.de2_deta
        np.testing.assert_allclose(slopes, [1, -found.shape0.e1, -found.shape0.e2], atol=1e-11)


def test_first_order_response_of_a_round_gaussian_has_its_closed_form():
    # PSF and weight are Gaussians of variance s each, so J_ab is a derivative of a Gaussian of variance 2s:
    # J_20 = -1/2s, J_40 = 3/(2s)², J_60 = -15/(2s)³, J_22 = 1/(2s)², J_42 = -3/(2s)³ (over J_00).  The
    # kernel changes equation (2, 0) by m_ab / (a! b!) (J_{a+2,b} + J_ab / 2s), M11 answers with 4s² of it:
    # m40: 4s²/24 (-15 + 3)/(2s)³ = -1/4s in M11, none in M22; m22: 4s²/4 (-3 + 1)/(2s)³ in each;
    # m60: 4s²/720 (105 - 15)/(2s)⁴ in M11.
    found = response(psf_from_name("psf0"), Adaptive())
    s = float(found.shape0.r2) / 2
    expected = {  # index: by how much M11 and M22 change
        (2, 0): (1, 0),
        (4, 0): (-1 / (4 * s), 0),
        (2, 2): (-1 / (4 * s), -1 / (4 * s)),
        (0, 6): (0, 1 / (32 * s**2)),
    }
    for index, (m11, m22) in expected.items():
        e1, _, r2 = found.first[:, INDICES.index(index)]
        natural = s ** (1 - sum(index) / 2)
        assert r2 == pytest.approx(m11 + m22, abs=1e-9 * natural), index
        assert e1 == pytest.approx((m11 - m22) / (2 * s), abs=1e-9 * natural / s), index


@weighted_only
def test_even_psfs_do_not_respond_to_odd_moments(estimator):
    found = response(psf_from_name("psf1"), estimator)
    odd = np.array([sum(index) % 2 == 1 for index in INDICES])
    # In units of the separation where all orders would count alike.
    natural = 0.1 ** np.sum(INDICES, axis=1)
    assert np.abs(found.first[:, odd] * natural[odd]).max() < 1e-10


def gaussian_kernel(k11, k12, k22):
    """Kernel moments of a Gaussian of covariance K, from Isserlis' recursion."""
    m = {(0, 0): 1.0}
    for n in range(1, 9):
        for b in range(n + 1):
            a = n - b
            first = (a - 1) * k11 * m.get((a - 2, b), 0.0) + b * k12 * m.get((a - 1, b - 1), 0.0)
            m[a, b] = first if a > 0 else (b - 1) * k22 * m.get((0, b - 2), 0.0)
    return moments_of({index: m[index] for index in INDICES})


@every_gaussian
def test_a_gaussian_psf_and_a_gaussian_kernel_add_their_covariances(name):
    found = response(psf_from_name(name), Adaptive())
    kernel = np.array([1.6e-4, 3e-5, 0.9e-4])
    shape = found.shapes(gaussian_kernel(*kernel), threshold=0)
    excess = shape.covariance()[0] - found.shape0.covariance()
    np.testing.assert_allclose(excess, kernel, rtol=0, atol=3e-6 * kernel.max())  # order 10 is missing


def test_plain_moments_are_exact_for_any_kernel():
    found = response(LOPSIDED, Plain())
    shape = found.shapes(moments_of({(2, 0): 0.02, (1, 1): 0.003, (0, 2): 0.05, (4, 0): 1.0}))
    excess = shape.covariance()[0] - found.shape0.covariance()
    np.testing.assert_allclose(excess, [0.02, 0.003, 0.05], rtol=1e-13)


# Symmetries and derivatives.


@every_estimator
def test_turning_psf_and_pairs_by_45_degrees_turns_e1_into_e2(estimator):
    turned = dataclasses.replace(LOPSIDED, profile=LOPSIDED.profile.rotate(45 * galsim.degrees))
    before = response(LOPSIDED, estimator).shapes(one_pair(0.4, 0.04, 0.3).kernel_moments())
    after = response(turned, estimator).shapes(one_pair(0.4, 0.04, 0.3 + np.pi / 4).kernel_moments())
    np.testing.assert_allclose([after.e1, after.e2], [-before.e2, before.e1], atol=1e-10)
    np.testing.assert_allclose(after.r2, before.r2, rtol=1e-10)


@every_estimator
def test_isotropic_slope_of_ellipticity_turns_with_the_psf(estimator):
    turned = dataclasses.replace(LOPSIDED, profile=LOPSIDED.profile.rotate(45 * galsim.degrees))
    before, after = response(LOPSIDED, estimator), response(turned, estimator)
    assert after.de1_deta == pytest.approx(-before.de2_deta, abs=1e-9)
    assert after.de2_deta == pytest.approx(before.de1_deta, abs=1e-9)
    assert after.kappa_r2 == pytest.approx(before.kappa_r2, abs=1e-9)


@every_estimator
def test_second_derivative_is_symmetric(estimator):
    second = response(LOPSIDED, estimator).second
    np.testing.assert_allclose(
        second, second.transpose(0, 2, 1), rtol=1e-9, atol=1e-12 * np.abs(second).max()
    )


@every_estimator
def test_second_order_misses_the_exact_solution_by_the_cube_of_the_change(estimator):
    found = response(LOPSIDED, estimator)
    moments = random_pairs(16, 40, 1.0).kernel_moments().values
    factors = 0.5 ** np.arange(4)
    stacks = KernelMoments(values=factors[:, None] * moments, n_stars=40)
    exact, second = found.shapes(stacks, threshold=0), found.shapes(stacks, threshold=np.inf)
    if isinstance(estimator, Plain):
        np.testing.assert_array_equal(exact.e1, second.e1)
        return
    for quantity in ("e1", "e2", "r2"):
        miss = np.abs(getattr(exact, quantity) - getattr(second, quantity))
        # The ratio tends to 8 as the change halves; 4 would be an error in the second derivative.
        assert 7.5 < miss[2] / miss[3] < 8.5, quantity


@weighted_only
def test_derivatives_are_those_of_the_exact_solution(estimator):
    weighted = weighted_psf(LOPSIDED.draw(reach=stamp_reach(estimator, LOPSIDED)), estimator)
    found = response(LOPSIDED, estimator)
    direction = random_pairs(17, 5, 1.0).kernel_moments().values[0]
    steps = np.array([-2.0, -1.0, 0.0, 1.0, 2.0]) * 1e-3
    guess = np.tile(found.shape0.covariance(), (5, 1))
    shape = Shape.from_covariance(exact_covariance(weighted, steps[:, None] * direction, guess))
    for k, values in enumerate((shape.e1, shape.e2, shape.r2)):
        slope = np.array([1, -8, 0, 8, -1]) @ values / 12 / 1e-3
        curvature = np.array([-1, 16, -30, 16, -1]) @ values / 12 / 1e-6
        assert slope == pytest.approx(found.first[k] @ direction, rel=1e-7, abs=1e-12)
        assert curvature == pytest.approx(direction @ found.second[k] @ direction, rel=1e-3, abs=1e-9)


@pytest.mark.parametrize("name", [*GAUSSIANS, "lopsided"])
@pytest.mark.parametrize("f", [1.0, 0.3])
def test_exact_solution_has_converged_with_the_degree_of_the_effective_kernel(name, f):
    weighted = weighted_psf(psf_of(name).draw(), Adaptive())
    values = np.concatenate([one_pair(f, 0.05, a).kernel_moments().values for a in (0.0, 0.4, 1.9)])
    guess = np.tile(weighted.covariance * weighted.unit**2, (3, 1))
    best, lower = (
        exact_covariance(weighted, values, guess),
        exact_covariance(weighted, values, guess, order=18),
    )
    growth = np.abs(best[:, [0, 2]].sum(axis=1) - guess[:, [0, 2]].sum(axis=1))
    # Two degrees bring a factor of 7: 5e-7 at degree 18 is less than 1e-7 at the degree in use.
    limit = 1e-5 if name == "lopsided" else 5e-7
    assert np.all(np.abs(best - lower).max(axis=1) < limit * growth)


# How it is used.


def test_same_stack_gives_the_same_bits_in_any_chunk():
    found = response(psf_from_name("psf1"), Adaptive())
    values = np.concatenate([random_pairs(s, 40, 0.35).kernel_moments().values for s in range(30, 63)])
    together = found.shapes(KernelMoments(values=values, n_stars=40), threshold=0.01)
    alone = [found.shapes(KernelMoments(values=v[None], n_stars=40), threshold=0.01) for v in values]
    for quantity in ("e1", "e2", "r2"):
        np.testing.assert_array_equal(getattr(together, quantity), [getattr(s, quantity)[0] for s in alone])


def test_many_stacks_are_evaluated_in_order_across_chunks(monkeypatch):
    monkeypatch.setattr("porrima.response.CHUNK", 7)
    found = response(psf_from_name("psf1"), Adaptive())
    values = np.linspace(0, 1, 20)[:, None] * random_pairs(18, 40, 0.5).kernel_moments().values
    shape = found.shapes(KernelMoments(values=values, n_stars=40))
    assert shape.r2.shape == (20,)
    assert np.all(np.diff(shape.r2) > 0)


def test_no_stacks_give_no_shapes():
    shape = response(psf_from_name("psf1"), Adaptive()).shapes(moments_of({}, n=0))
    assert shape.r2.shape == shape.flag.shape == (0,)


@every_estimator
def test_no_companions_no_change(estimator):
    found = response(LOPSIDED, estimator)
    shape = found.shapes(moments_of({}, n=3), threshold=0)
    np.testing.assert_allclose(shape.covariance(), np.tile(found.shape0.covariance(), (3, 1)), rtol=1e-13)


@every_estimator
def test_moments_that_are_not_finite_are_flagged_and_spoil_no_other_stack(estimator):
    values = np.concatenate([random_pairs(s, 40, 1.0).kernel_moments().values for s in (1, 2, 3)])
    found = response(psf_from_name("psf1"), estimator)
    good = found.shapes(KernelMoments(values=values, n_stars=40))
    values[1, 4] = np.nan
    shape = found.shapes(KernelMoments(values=values, n_stars=40))
    np.testing.assert_array_equal(shape.flag, [0, Failure.NOT_FINITE, 0])
    np.testing.assert_array_equal(np.isnan(shape.e1), [False, True, False])
    np.testing.assert_array_equal(shape.r2[[0, 2]], good.r2[[0, 2]])


@pytest.mark.parametrize("f", [1.0, 0.3, 0.03])
def test_pairs_too_wide_for_the_series_are_flagged_and_the_rest_is_right(f):
    flags = []
    for r in (0.05, 0.06, 0.07, 0.08, 0.1, 0.15, 0.3, 1.0):
        found = response(psf_from_name("psf1"), Adaptive()).shapes(one_pair(f, r, 0.7).kernel_moments())
        flags.append(int(found.flag[0]))
        if not flags[-1]:
            drawn = change_by_image("psf1", Adaptive(), one_pair(f, r, 0.7))
            assert (
                np.abs(change_by_response("psf1", Adaptive(), one_pair(f, r, 0.7)) - drawn).max()
                < 4e-3 * drawn[2]
            )
    assert flags[0] == 0
    assert flags[-3:] == [Failure.SERIES] * 3


def test_moments_of_no_kernel_are_flagged():
    # Negative second moments that would leave no star at all.
    shape = response(psf_from_name("psf0"), Plain()).shapes(moments_of({(2, 0): -1.0, (0, 2): -1.0}))
    assert shape.flag[0] == Failure.NOT_POSITIVE
    assert np.isnan(shape.r2[0])


def test_unknown_estimators_are_refused():
    with pytest.raises(TypeError, match="estimator must be Plain, Adaptive or GaussianWeight, got str"):
        response(psf_from_name("psf0"), "adaptive")


def test_a_psf_without_a_fixed_point_is_refused():
    # Two equal stars far apart: a narrow weight between them slides off to either.
    star = galsim.Gaussian(fwhm=0.1)
    profile = galsim.Sum(star.shift(-0.12, 0) * 0.5, star.shift(0.12, 0) * 0.5)
    with pytest.raises(ValueError, match="split: psf must have a stable fixed point under its weight"):
        response(PSF(name="split", profile=profile, extent=1.0), GaussianWeight(0.03))
