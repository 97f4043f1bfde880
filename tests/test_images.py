import ast
import dataclasses
import time
from pathlib import Path

import galsim
import numpy as np
import pytest

import porrima.images
from porrima.images import draw_stack, measure_stack
from porrima.psf import PSFS, psf_from_name
from porrima.shapes import Adaptive, GaussianWeight, Plain
from porrima.systems import Systems


def random_systems(rng, n, fraction=1.0, weighted=False):
    f = rng.random(n) * (rng.random(n) < fraction)
    r, angle = 0.05 * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    weight = 0.1 + rng.random(n) if weighted else None
    return Systems.from_pairs(f, r * np.cos(angle), r * np.sin(angle), weight)


def parallel_axis(systems):
    """Excess second moments, KCM16 Eq. 4, from the sources themselves."""
    w = systems.weight[:, None] * systems.flux / systems.weight.sum()
    x, y = systems.x, systems.y
    return np.array([np.sum(w * x * x), np.sum(w * x * y), np.sum(w * y * y)])


def test_images_share_no_code_with_the_response():
    tree = ast.parse(Path(porrima.images.__file__).read_text())
    modules = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    assert not modules & {"porrima.response", "porrima.weighted", "porrima.moments"}


@pytest.mark.parametrize("name", PSFS)
def test_plain_moments_of_the_image_obey_the_parallel_axis_theorem(name):
    psf = psf_from_name(name)
    systems = random_systems(np.random.Generator(np.random.Philox(1)), 40, weighted=True)
    excess = measure_stack(psf, systems, Plain()).covariance() - Plain().measure(psf.draw()).covariance()
    np.testing.assert_allclose(excess, parallel_axis(systems), atol=1e-10 * np.abs(excess).max())


def test_image_is_the_weighted_mean_of_images_of_the_single_systems():
    psf = psf_from_name("psf1")
    systems = random_systems(np.random.Generator(np.random.Philox(2)), 6, weighted=True)
    stack = draw_stack(psf, systems)
    total = np.zeros_like(stack.array)
    for star in range(6):
        for flux, x, y in zip(systems.flux[star], systems.x[star], systems.y[star], strict=True):
            one = psf.profile.shift(x, y).drawImage(
                nx=total.shape[1], ny=total.shape[0], scale=stack.scale, method="no_pixel", dtype=float
            )
            total += flux * systems.weight[star] / systems.weight.sum() * one.array
    np.testing.assert_allclose(stack.array, total, atol=1e-14 * total.max())


def test_image_has_unit_flux_and_its_centroid_in_the_middle():
    systems = random_systems(np.random.Generator(np.random.Philox(3)), 30)
    image = draw_stack(psf_from_name("psf2"), systems)
    ny, nx = image.array.shape
    assert image.array.dtype == np.float64
    assert image.array.sum() == pytest.approx(1, abs=1e-13)
    assert image.array.sum(axis=0) @ (np.arange(nx) - (nx - 1) / 2) == pytest.approx(0, abs=1e-12)
    assert image.array.sum(axis=1) @ (np.arange(ny) - (ny - 1) / 2) == pytest.approx(0, abs=1e-12)


def test_single_stars_are_the_psf():
    psf, nothing = psf_from_name("psf1"), np.zeros(500)
    stack = draw_stack(psf, Systems.from_pairs(nothing, nothing + 0.03, nothing))
    np.testing.assert_allclose(stack.array, psf.draw().array, atol=1e-16)


def test_tighter_drawing_changes_no_shape():
    psf = psf_from_name("psf1")
    systems = random_systems(np.random.Generator(np.random.Philox(4)), 40)
    tighter = psf.profile.withGSParams(
        psf.profile.gsparams.withParams(
            folding_threshold=1e-12, maxk_threshold=1e-12, xvalue_accuracy=1e-15, kvalue_accuracy=1e-15
        )
    )
    tight = dataclasses.replace(psf, profile=tighter, extent=1.2)
    np.testing.assert_allclose(
        measure_stack(tight, systems, Adaptive()).covariance(),
        measure_stack(psf, systems, Adaptive()).covariance(),
        rtol=0,
        atol=1e-15,
    )


def test_a_finer_grid_changes_no_shape():
    psf = psf_from_name("psf1")
    systems = random_systems(np.random.Generator(np.random.Philox(5)), 10)
    image = draw_stack(psf, systems)
    fine = galsim.Sum(
        [
            psf.profile.shift(x, y) * (flux / len(systems))
            for flux, x, y in zip(systems.flux.ravel(), systems.x.ravel(), systems.y.ravel(), strict=True)
        ]
    ).drawImage(nx=401, ny=401, scale=image.scale / 2, method="no_pixel", dtype=float)
    for estimator in (Plain(), Adaptive(), GaussianWeight(0.75)):
        coarse, finer = estimator.measure(image), estimator.measure(fine)
        np.testing.assert_allclose(finer.covariance(), coarse.covariance(), rtol=0, atol=1e-11 * coarse.r2)


def test_a_thousand_systems_are_drawn_and_measured_in_seconds():
    systems = random_systems(np.random.Generator(np.random.Philox(6)), 1000)
    start = time.perf_counter()
    shape = measure_stack(psf_from_name("psf1"), systems, Adaptive())
    assert time.perf_counter() - start < 5
    assert shape.flag == 0
