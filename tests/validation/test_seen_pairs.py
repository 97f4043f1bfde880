"""Pairs that a survey sees, against noisy images drawn with GalSim, each fitted on its own with the known PSF."""

from dataclasses import replace
from itertools import pairwise

import galsim
import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline
from scipy.stats import chi2

from porrima.config import PopulationConfig, parse
from porrima.detection import Detection
from porrima.exposure import EXPOSURES
from porrima.gaia_flags import GaiaFlags, along_scan_error, orbital_excess
from porrima.instruments import SURVEYS
from porrima.photometry import STEP
from porrima.pointings import dither_pattern
from porrima.precision import fitted_noise, measured_noise
from porrima.psf import psf_from_name
from porrima.sample import draw_stars, population_of
from porrima.shapes import Adaptive
from statistics_helpers import assert_within_sigma

FALSE_ALARM = 0.01
SIDE = 19
GRID = [
    (separation, 10 ** (-0.4 * contrast), magnitude)
    for separation in (0.01, 0.02, 0.03, 0.05, 0.1)
    for contrast in (0, 1, 2, 4)
    for magnitude in (17, 19, 21, 23)
]
EDGES = np.array([0, 0.03, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.001])
DETECTION = (
    "34 Detection of pairs: stars drawn with GalSim, with Poisson noise of star and sky and read noise, each fitted by "
    "a star of free flux and place and then by the second derivatives of the known PSF: separations 0.01 to 0.1″, "
    "contrasts 0 to 4 mag, 17 to 23 mag, false-alarm rate 1 %; share found against predicted, all pairs and those of "
    "intermediate probability, and single stars."
)
NOISE = "35 Noise of the shape of one star: scatter over predicted, of e and of R², with its standard error."

GAIA = (
    "36 What Gaia's flags remove of mean x: companions of Galaxy stars (l = 180°, b = 45°, dk13) drawn in plain numpy, "
    "flagged by the model of double peaks and RUWE of blends, and by RUWE of orbits; the last column is what the flags "
    "alone leave below 0.6″ over what the hard cut of 0.05″ leaves."
)


def survey_of(name, n_exposures):
    survey = SURVEYS[name]
    name_of_psf = survey.psf.replace(
        "roman:", "roman-exact:"
    )  # GalSim's own interpolation goes below 0 in the wings
    psf = psf_from_name(name_of_psf, pixel=survey.pixel, jitter=survey.jitter)
    return psf, replace(EXPOSURES[name](), n_exposures=n_exposures)


class Fit:
    """Fits of the known PSF, by scipy's tensor splines through an image that GalSim drew."""

    def __init__(self, psf, exposures):
        n, scale = 331, 0.01
        image = psf.profile.drawImage(nx=n, ny=n, scale=scale, method="no_pixel", dtype=float)
        axis = (np.arange(n) - n // 2) * scale
        area = (exposures.pixel / scale) ** 2
        self.spline = RectBivariateSpline(axis, axis, image.array * area, kx=5, ky=5)  # rows first
        self.axis = (np.arange(SIDE) - SIDE // 2) * exposures.pixel
        self.background = exposures.background

    def templates(self, places, orders):
        return np.stack(
            [
                np.concatenate(
                    [
                        (-1) ** (a + b) * self.spline(self.axis - y, self.axis - x, dx=b, dy=a).ravel()
                        for x, y in places
                    ]
                )
                for a, b in orders
            ]
        )

    def __call__(self, data, places, flux):
        """Fall of chi² by the three second derivatives, and their coefficients; the star starts at `places`."""
        shift = np.zeros(2)
        for _ in range(3):
            p, dx, dy = self.templates(places + shift, [(0, 0), (1, 0), (0, 1)])
            weight = 1 / (self.background + flux * np.maximum(p, 0))
            design = np.array([p, flux * dx, flux * dy])
            flux, *step = np.linalg.solve((design * weight) @ design.T, (design * weight) @ data)
            shift = shift + step
        orders = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
        design = self.templates(places + shift, orders) * flux
        weight = 1 / (self.background + np.maximum(design[0], 0))
        both = []
        for part in (design[:3], design):
            solution = np.linalg.solve((part * weight) @ part.T, (part * weight) @ data)
            both.append(((data - solution @ part) ** 2 @ weight, solution))
        return both[0][0] - both[1][0], both[1][1][3:]


def drawn(psf, exposures, places, separation, flux_ratio, magnitude, angle, rng):
    """Noisy stamps of one system, its flux centroid at the places, background subtracted."""
    flux, level = exposures.electrons(magnitude), exposures.background - exposures.read_noise**2
    share, d = flux_ratio / (1 + flux_ratio), separation * np.array([np.cos(angle), np.sin(angle)])
    stamps = []
    for place in places:
        sources = [psf.profile.shift(*(place - share * d)) * (1 - share)]
        if flux_ratio:
            sources.append(psf.profile.shift(*(place + (1 - share) * d)) * share)
        image = sum(
            s.drawImage(nx=SIDE, ny=SIDE, scale=exposures.pixel, method="no_pixel", dtype=float).array
            for s in sources
        )
        electrons = rng.poisson(np.maximum(flux * image + level, 0)) + rng.normal(
            0, exposures.read_noise, image.shape
        )
        stamps.append((electrons - level).ravel())
    return np.concatenate(stamps)


def sample(psf, exposures, fit, system, rng):
    """Fit of one system at a random place and position angle."""
    places = (rng.random(2) - 0.5 + dither_pattern(exposures.n_exposures)) % 1.0 - 0.5
    places = places * exposures.pixel
    data = drawn(psf, exposures, places, *system, rng.uniform(0, 2 * np.pi), rng)
    return fit(data, places, float(exposures.electrons(system[2])))


@pytest.mark.parametrize(
    ("name", "n_exposures"), [("euclid-vis", 1), ("euclid-vis", 3), ("euclid-vis", 4), ("roman-h158", 4)]
)
def test_the_share_of_pairs_found_is_the_predicted_probability(record, full_size, name, n_exposures):
    psf, exposures = survey_of(name, n_exposures)
    detection = Detection.of(psf, exposures, false_alarm=FALSE_ALARM)
    fit, rng = Fit(psf, exposures), np.random.Generator(np.random.PCG64(20261125 + n_exposures))
    repeats = 100 if full_size else 1
    systems = [system for system in GRID for _ in range(repeats)]
    limit = chi2.isf(FALSE_ALARM, 3)
    found = np.array([sample(psf, exposures, fit, system, rng)[0] > limit for system in systems])
    predicted = detection.rejected(*np.array(systems).T)
    line = [f"{exposures.name}", n_exposures]
    for lo, hi in pairwise(EDGES):
        here = (predicted >= lo) & (predicted < hi)
        variance = (predicted * (1 - predicted))[here].sum()
        assert_within_sigma(found[here].sum(), predicted[here].sum(), np.sqrt(variance + 1))
    for here in (predicted >= 0, (predicted > 0.1) & (predicted < 0.9)):
        n, error = here.sum(), np.sqrt((predicted * (1 - predicted))[here].sum())
        assert_within_sigma(found[here].sum(), predicted[here].sum(), error)
        line += [f"{found[here].mean():.4f} ({predicted[here].mean():.4f} ± {error / n:.4f})"]
    if full_size:
        p, n = predicted[::repeats], found.reshape(-1, repeats).sum(axis=1)
        assert_within_sigma(n, repeats * p, np.sqrt(repeats * p * (1 - p) + 1))
    n_single = 4000 if full_size else 100
    alarms = sum(
        sample(psf, exposures, fit, (0.0, 0.0, 17 + 2 * (k % 4)), rng)[0] > limit for k in range(n_single)
    )
    error = np.sqrt(n_single * FALSE_ALARM * (1 - FALSE_ALARM))
    assert_within_sigma(alarms, n_single * FALSE_ALARM, error)
    line += [f"{alarms / n_single:.4f} ({FALSE_ALARM} ± {error / n_single:.4f})"]
    record(DETECTION, ["survey", "exposures", "all pairs", "0.1 < probability < 0.9", "single stars"], line)


@pytest.mark.parametrize(("name", "magnitude"), [("euclid-vis", 19), ("euclid-vis", 22), ("roman-h158", 20)])
def test_the_fitted_moments_scatter_as_predicted(record, full_size, name, magnitude):
    psf, exposures = survey_of(name, 3)
    noise = fitted_noise(psf, exposures, 1.0)
    fit, rng = Fit(psf, exposures), np.random.Generator(np.random.PCG64(1))
    n = 4000 if full_size else 200
    q = np.array([sample(psf, exposures, fit, (0.0, 0.0, magnitude), rng)[1] for _ in range(n)]) * [2, 1, 2]
    e = np.concatenate([q[:, 0] - q[:, 2], 2 * q[:, 1]])
    ratios = [
        (e.std() / noise.sigma_e(magnitude), 1 / np.sqrt(4 * n)),
        ((q[:, 0] + q[:, 2]).std() / noise.sigma_r2(magnitude), 1 / np.sqrt(2 * n)),
    ]
    for ratio, error in ratios:
        assert_within_sigma(ratio, 1, error)
    shown = [f"{ratio:.3f} ± {error:.3f}" for ratio, error in ratios]
    record(NOISE, ["measured by", "mag", "e", "R²"], [noise.name + ", 3 exposures", magnitude, *shown])


def drawn_pairs(population, n, rng):
    """Companions of n of the stars, in plain numpy: projected orbits and flux ratios, none resolved."""
    law, tracks = population.law, population.tracks
    star = rng.choice(law.log_a.size, n, p=law.multiplicity_fraction / law.multiplicity_fraction.sum())
    g, low = law.mass_ratio_exponent[star] + 1, law.mass_ratio_min[star]
    q = (low**g + rng.random(n) * (1 - low**g)) ** (1 / g)
    mass, distance = population.stars.mass[star], population.stars.distance[star]
    a = 10 ** (law.log_a[star] + law.log_a_sigma[star] * rng.standard_normal(n))
    grid = tracks.log_mass_min + STEP * np.arange(tracks.magnitude.shape[0])
    f = np.empty(n)
    for s in np.unique(star):
        here, track = star == s, tracks.magnitude[:, tracks.index[s]] @ tracks.weight[s]
        faint, bright = (np.interp(np.log10(m), grid, track) for m in (q[here] * mass[here], mass[here]))
        f[here] = np.where(
            q[here] * mass[here] < tracks.dark_below, 0, np.minimum(10 ** (0.4 * (bright - faint)), 1)
        )
    excess = orbital_excess(np.sqrt(a**3 / (mass * (1 + q))))
    wobble = excess * (a / distance * (q / (1 + q) - f / (1 + f))) ** 2 / 3  # along scan, arcsec²
    return a * np.sqrt(1 - rng.random(n) ** 2) / distance, f, population.stars.magnitude[star], wobble


@pytest.mark.parametrize("lo", [16, 17, 18, 19, 20])
def test_gaias_flags_see_nothing_of_what_blurs_a_psf(record, full_size, lo):
    config = parse(PopulationConfig, {"stars": {"l": 180, "b": 45, "mag": [lo, lo + 1], "n_drawn": 500}})
    population = population_of(config, draw_stars(config))
    rng = np.random.Generator(np.random.PCG64(lo))
    r, f, magnitude, wobble = drawn_pairs(population, 1_000_000 if full_size else 50_000, rng)
    blended = GaiaFlags().rejected(r, f, magnitude)
    orbit = 1 + wobble / along_scan_error(magnitude) ** 2 > 1.4**2
    x = f * r**2 / (1 + f) ** 2
    close, wide = r < 0.05, (r >= 0.2) & (r < 0.6)
    shares = [(x * w)[h].sum() / x[h].sum() for w, h in ((blended, close), (orbit, close), (blended, wide))]
    assert shares[0] < 1e-3
    assert shares[1] < 0.01
    assert lo == 20 or shares[2] > 0.7
    left = (x * (1 - blended) * ~orbit)[r < 0.6].sum() / x[close].sum()
    line = [f"{lo}-{lo + 1}", *(f"{100 * s:.2f} %" for s in shares), f"{left:.1f}"]
    columns = [
        "i",
        "blends below 0.05″",
        "orbits below 0.05″",
        "blends at 0.2 to 0.6″",
        "mean x left, over 0.05″",
    ]
    record(GAIA, columns, line)


def hsm_shape(pixels):
    """e1, e2 and R² in pixels² as HSM measures them."""
    moments = galsim.hsm.FindAdaptiveMom(galsim.Image(pixels, scale=1.0))
    shape = moments.observed_shape
    return np.array([shape.e1, shape.e2, 2 * moments.moments_sigma**2 / np.sqrt(1 - shape.e**2)])


@pytest.mark.parametrize("magnitude", [19, 22])
def test_hsm_scatters_as_predicted(record, full_size, magnitude):
    exposures = replace(EXPOSURES["euclid-vis"](), pixel=0.05, n_exposures=1)
    psf = psf_from_name("optical1", pixel=0.05, jitter=0.04)
    noise = measured_noise(psf, exposures, Adaptive())
    rng, n = np.random.Generator(np.random.PCG64(2)), 4000 if full_size else 600
    flux, level = exposures.electrons(magnitude), exposures.background - exposures.read_noise**2
    found = []
    for k in range(n):
        if k % 20 == 0:
            x, y = (rng.random(2) - 0.5) * exposures.pixel
            clean = (
                psf.profile.shift(x, y)
                .drawImage(nx=35, ny=35, scale=0.05, method="no_pixel", dtype=float)
                .array
            )
            truth = hsm_shape(clean)
        electrons = (
            rng.poisson(flux * clean + level) + rng.normal(0, exposures.read_noise, clean.shape) - level
        )
        found.append((hsm_shape(electrons) - truth) / (1, 1, truth[2]))
    e1, e2, r2 = np.array(found).T
    ratios = [
        (np.sqrt((e1.var() + e2.var()) / 2) / noise.sigma_e(magnitude), 1 / np.sqrt(4 * n)),
        (r2.std() / noise.sigma_r2(magnitude), 1 / np.sqrt(2 * n)),
    ]
    for ratio, error in ratios:
        assert_within_sigma(ratio, 1, error)
    shown = [f"{ratio:.3f} ± {error:.3f}" for ratio, error in ratios]
    record(NOISE, ["measured by", "mag", "e", "R²"], ["HSM, pixels of 0.05 arcsec", magnitude, *shown])
