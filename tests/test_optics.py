import dataclasses

import galsim
import numpy as np
import pytest

from porrima.optics import EUCLID_LIKE, Pupil, diffraction_pattern, optical_image
from porrima.shapes import Adaptive
from porrima.spectra import Light

GRID = np.linspace(-1.2, 1.2, 161)


def test_without_struts_the_pattern_is_that_of_an_obscured_airy_disc():
    pupil = Pupil(diameter=1.2, obscuration=0.35, strut_pairs=0, strut_thickness=0.0)
    airy = galsim.Airy(lam=800, diam=1.2, obscuration=0.35)
    ours = diffraction_pattern(pupil, 800.0, GRID, GRID[:, None])
    theirs = np.array([[airy.xValue(x, y) for x in GRID[::10]] for y in GRID[::10]])
    np.testing.assert_allclose(ours[::10, ::10], theirs, rtol=0, atol=1e-5 * theirs.max())


def test_a_pupil_summed_point_by_point_gives_the_same_pattern():
    pupil = dataclasses.replace(EUCLID_LIKE, strut_thickness=0.04, strut_angle=17.0)
    n = 1500
    u = (np.arange(n) + 0.5) / n * 1.2 - 0.6
    r = np.hypot(u, u[:, None])
    open_ = (r < 0.6) & (r > 0.21)
    for pair in range(3):
        angle = np.radians(17.0) + np.pi * pair / 3
        open_ &= np.abs(np.cos(angle) * u + np.sin(angle) * u[:, None]) > 0.024
    x = np.linspace(-0.6, 0.6, 25)
    phase = np.exp(-2j * np.pi * np.outer(x * np.pi / 648_000, u) / 800e-9)
    amplitude = phase @ open_ @ phase.T * (1.2 / n) ** 2
    brute = np.abs(amplitude) ** 2 / (800e-9) ** 2 / (open_.sum() * (1.2 / n) ** 2) * (np.pi / 648_000) ** 2
    ours = diffraction_pattern(pupil, 800.0, x, x[:, None])
    np.testing.assert_allclose(ours, brute, rtol=0, atol=2e-3 * brute.max())


def test_all_light_arrives():
    radius = np.linspace(0, 60, 60_001)
    angle = np.linspace(0, np.pi / 6, 61)
    pupil = dataclasses.replace(EUCLID_LIKE, strut_thickness=1e-9)
    ring = diffraction_pattern(pupil, 800.0, radius * np.cos(angle[:, None]), radius * np.sin(angle[:, None]))
    flux = np.trapezoid(2 * np.pi * radius * ring.mean(axis=0), radius)
    assert flux == pytest.approx(1, abs=3e-3)  # what lies beyond a minute of arc falls as 1/r


def test_pattern_has_the_symmetry_of_its_struts():
    x, y = np.array([0.31, -0.2]), np.array([0.12, 0.44])
    turn = np.radians(60)
    turned = diffraction_pattern(
        EUCLID_LIKE, 800.0, np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y
    )
    np.testing.assert_allclose(diffraction_pattern(EUCLID_LIKE, 800.0, x, y), turned, rtol=1e-10)
    rotated = dataclasses.replace(EUCLID_LIKE, strut_angle=60.0)
    np.testing.assert_allclose(
        diffraction_pattern(EUCLID_LIKE, 800.0, x, y), diffraction_pattern(rotated, 800.0, x, y), rtol=1e-10
    )


def test_size_is_that_of_galsims_optical_psf_as_its_sampling_gets_finer():
    ours = Adaptive().measure(optical_image(EUCLID_LIKE, Light.of(800.0), 0, 0, 0.1 / 12, half_width=0.8))
    differences = []
    for oversampling, pad in ((1.5, 1.5), (4, 1.5), (4, 3)):
        psf = galsim.OpticalPSF(
            lam=800,
            diam=1.2,
            obscuration=0.35,
            nstruts=6,
            strut_thick=0.01,
            oversampling=oversampling,
            pad_factor=pad,
        )
        image = psf.drawImage(nx=193, ny=193, scale=0.1 / 12, method="no_pixel", dtype=float)
        differences.append(abs(float(Adaptive().measure(image).r2 / ours.r2) - 1))
    assert differences == sorted(differences, reverse=True)
    assert differences[-1] < 1e-3


def test_many_wavelengths_are_the_mean_of_their_patterns():
    light = Light(wavelength=(600.0, 800.0), share=(0.25, 0.75))
    both = optical_image(EUCLID_LIKE, light, 0.02, 0.01, 0.01, half_width=0.3).array
    each = [
        optical_image(EUCLID_LIKE, Light.of(w), 0.02, 0.01, 0.01, half_width=0.3).array for w in (600, 800)
    ]
    np.testing.assert_allclose(both, 0.25 * each[0] + 0.75 * each[1], rtol=1e-12)
