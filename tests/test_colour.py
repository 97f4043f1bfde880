from dataclasses import replace

import numpy as np
import pytest

from porrima.colour import chromatic, colour_bias, in_band, integrals_in_band
from porrima.errors import InputError
from porrima.multiplicity import MULTIPLICITY
from porrima.passbands import black_body, photon_averages
from porrima.photometry import PHOTOMETRY, flux_ratio, magnitudes
from porrima.prediction import integrate, population_moments
from porrima.psf import psf_from_name
from porrima.selection import SelectionTable
from porrima.shapes import Adaptive, Plain
from porrima.spectra import Light
from porrima.stars import Stars
from porrima.systems import Population
from statistics_helpers import assert_within_sigma

MODELS = {"multiplicity": MULTIPLICITY["dk13"], "photometry": PHOTOMETRY["main-sequence"]}


@pytest.fixture(scope="module")
def waves():
    return chromatic("optical1", Adaptive(), "euclid_VIS", pixel=0.1, jitter=0.029)


@pytest.fixture(scope="module")
def in_vis(population):
    return in_band(population, MODELS["photometry"], "euclid_VIS")


@pytest.fixture(scope="module")
def integrals(in_vis):
    return integrate(in_vis)


def test_the_adaptive_size_at_the_limit_of_diffraction_grows_with_the_square_of_the_wavelength():
    slope = chromatic("optical0", Adaptive(), "euclid_VIS").slope
    assert slope[2] == pytest.approx(2.0, abs=2e-3)
    np.testing.assert_allclose(slope[:2], 0.0, atol=1e-6)


def test_pixel_and_jitter_make_the_size_depend_less_on_wavelength_and_the_shape_more(waves):
    assert 0.5 < waves.slope[2] < 1.2
    assert waves.slope[0] > 0.01  # less of a round pixel at long wavelengths


def test_the_reference_itself_has_no_influence(waves):
    wavelength = np.array(waves.band.wavelength)
    photons = black_body(wavelength, 4500.0) * np.array(waves.band.throughput)
    np.testing.assert_allclose(waves.influence @ photons / photons.sum(), 0.0, atol=2e-5)


def test_the_size_of_a_star_of_another_colour_is_that_of_its_own_image(waves):
    wavelength, throughput = np.array(waves.band.wavelength), np.array(waves.band.throughput)
    sizes, expected = [], []
    for temperature in (4200.0, 4800.0):
        photons = black_body(wavelength, temperature)
        light = Light.through(wavelength, throughput, (wavelength, photons), n=6)
        psf = psf_from_name("optical1", light=light, pixel=0.1, jitter=0.029)
        sizes.append(float(Adaptive().measure(psf.draw()).r2))
        expected.append(waves.influence[2] @ (photons * throughput) / np.sum(photons * throughput))
    assert expected[1] - expected[0] == pytest.approx(np.log(sizes[1] / sizes[0]), rel=0.03)


def test_plain_moments_are_those_of_each_wavelength():
    estimator = Plain(0.75)
    waves = chromatic("optical0", estimator, "euclid_VIS")
    ends = []
    for wavelength in (600.0, 850.0):
        psf = psf_from_name("optical0", light=Light.of(wavelength))
        ends.append(psf.draw(reach=1.0))
    found = np.interp([600.0, 850.0], waves.band.wavelength, waves.influence[2])
    sizes = [float(estimator.measure(image).r2) for image in ends]
    flux = [inside(image) for image in ends]
    mean = np.average(flux)
    changes = np.array(flux) * (np.array(sizes) / float(waves.shape0.r2) - 1) / mean
    measured = changes[1] - changes[0]
    assert found[1] - found[0] == pytest.approx(measured, rel=0.02)


def inside(image):
    """Light within the aperture."""
    n = image.array.shape[0]
    along = (np.arange(n) - n // 2) * image.scale
    return float(image.array[np.hypot(along, along[:, None]) < 0.75].sum())


@pytest.mark.parametrize(
    ("name", "band", "rule"),
    [
        ("psf1", "euclid_VIS", "needs an optical, Roman or chromatic PSF"),
        ("roman:H158:SCA01", "euclid_VIS", "must be roman_F158"),
        ("optical0", "gaia_G", "must be one of euclid_VIS"),
    ],
)
def test_what_has_no_wavelength_or_another_band_is_refused(name, band, rule):
    with pytest.raises(InputError, match=rule):
        chromatic(name, Adaptive(), band)


def test_flux_ratios_of_another_band_come_from_its_own_column(population, in_vis):
    relation, stars = MODELS["photometry"], population.stars
    for band, here in (("euclid_VIS", in_vis), ("roman_F158", in_band(population, relation, "roman_F158"))):
        tracks = relation.tracks(stars.mass, stars.metallicity, stars.log_age, band)
        expected = 10 ** (
            -0.4 * (magnitudes(tracks, 0.6 * stars.mass[:, None]) - magnitudes(tracks, stars.mass[:, None]))
        )
        found = flux_ratio(here.tracks, stars.mass, np.full((len(stars), 1), 0.6))
        np.testing.assert_allclose(found, np.minimum(expected, 1.0), rtol=1e-12)
    with pytest.raises(InputError, match="band: band must be one of"):
        in_band(population, relation, "V")


def test_integrals_in_another_band_are_those_made_anew(in_vis, population):
    again, fresh = integrals_in_band(in_vis, integrate(population)), integrate(in_vis)
    np.testing.assert_allclose(again.mean, fresh.mean, rtol=1e-12)


def test_companions_are_brighter_in_the_infrared(population):
    x = [
        population_moments(p, integrate(p)).mean_x[0]
        for p in (population, in_band(population, MODELS["photometry"], "roman_F158"))
    ]
    assert 1.02 < x[1] / x[0] < 1.6


def test_no_companions_have_no_colour(in_vis, waves, integrals):
    found = colour_bias(in_vis, waves, integrals, np.array([0.0]))
    assert not np.any(found.blind)
    assert not np.any(found.known)


def test_twins_have_the_colour_of_one_star(waves):
    n = 20
    stars = Stars.from_columns(
        mass=np.linspace(0.2, 1.0, n),
        distance=np.full(n, 1000.0),
        magnitude=np.full(n, 18.5),
        mass_ratio=np.ones(n),
    )
    twins = in_band(Population.of(stars, **MODELS), MODELS["photometry"], "euclid_VIS")
    found = colour_bias(twins, waves, integrate(twins))
    np.testing.assert_allclose(found.blind, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.known, 0.0, atol=1e-4)  # to the grid of masses


def test_the_mean_is_that_of_drawn_companions(in_vis, waves, integrals):
    rng = np.random.Generator(np.random.Philox(11))
    population, law, n_draws = in_vis, in_vis.law, 400
    mass = population.stars.mass
    g = law.mass_ratio_exponent[:, None] + 1
    low = law.mass_ratio_min[:, None] ** g
    q = (low + rng.random((mass.size, n_draws)) * (1 - low)) ** (1 / g)
    f = flux_ratio(population.tracks, mass, q)
    size = photon_averages(waves.band, waves.influence[2:])[0]
    tracks = replace(population.tracks, magnitude=np.ascontiguousarray(size))
    own, other = magnitudes(tracks, mass[:, None]), magnitudes(tracks, mass[:, None] * q)
    each = np.where(f > 0, f / (1 + f) * (np.where(f > 0, other, 0.0) - own), 0.0)
    p, unresolved = law.multiplicity_fraction, integrals.unresolved
    kept = np.sum(1 - p * (1 - unresolved))
    mean = np.sum(p * unresolved * each.mean(axis=1)) / kept
    error = np.sqrt(np.sum((p * unresolved) ** 2 * each.var(axis=1) / n_draws)) / kept
    found = colour_bias(population, waves, integrals).blind[2, 0]
    assert_within_sigma(found, mean, error)
    assert found > 0


def test_a_psf_that_follows_the_colour_of_the_star_leaves_little(in_vis, waves, integrals):
    found = colour_bias(in_vis, waves, integrals)
    assert abs(found.known[2, 0]) < 0.1 * found.blind[2, 0]


def test_the_effect_follows_the_share_of_unresolved_pairs(in_vis, waves, integrals):
    fractions = np.array([0.1, 0.2])
    found = colour_bias(in_vis, waves, integrals, fractions).blind[2]
    moments = population_moments(in_vis, integrals, fractions)
    assert found[1] / found[0] == pytest.approx(
        moments.unresolved_fraction[1] / moments.unresolved_fraction[0], rel=1e-6
    )


def test_masses_below_the_photometry_take_its_least(waves):
    stars = Stars.from_columns(
        mass=np.array([0.05, 0.5]), distance=np.full(2, 300.0), magnitude=np.full(2, 18.5)
    )
    light = PHOTOMETRY["habets-heintze"]
    population = Population.of(stars, multiplicity=MODELS["multiplicity"], photometry=light)
    assert np.all(np.isfinite(colour_bias(population, waves, integrate(population)).blind))


def test_a_chromatic_stanza_has_colours_too(tmp_path):
    file = tmp_path / "psf.yaml"
    file.write_text("psf: {type: ChromaticOpticalPSF, lam: 800, diam: 1.2}\n")
    waves = chromatic(str(file), Adaptive(), "roman_F062")
    assert waves.slope[2] == pytest.approx(2.0, abs=0.05)


def mixed(population, share, **of_second):
    """Every star with two classes of companions, the second with other figures."""
    n = len(population.stars)
    star = np.repeat(np.arange(n), 2)
    second = np.arange(2 * n) % 2 == 1
    law = population.law.take(star)
    law = replace(law, star=star, share=np.where(second, share, 1 - share))
    law = replace(law, **{k: np.where(second, v, getattr(law, k)) for k, v in of_second.items()})
    tracks = population.tracks
    return replace(
        population,
        stars=population.stars.take(star),
        law=law,
        tracks=replace(tracks, index=tracks.index[star], weight=tracks.weight[star]),
        weight=population.weight[star],
    )


def test_two_classes_alike_are_one(in_vis, waves, integrals):
    one = colour_bias(in_vis, waves, integrals, np.array([0.35]))
    two = mixed(in_vis, 0.3)
    found = colour_bias(two, waves, integrate(two), np.array([0.35]))
    np.testing.assert_allclose(found.blind, one.blind, rtol=1e-12)
    np.testing.assert_allclose(found.known, one.known, rtol=1e-12)


@pytest.mark.parametrize("figures", [{"mass_ratio_max": 0.6}, {"mass_ratio_exponent": 3.0}])
def test_classes_count_by_their_shares(in_vis, waves, figures):
    parts = [mixed(in_vis, share, **figures) for share in (0.0, 0.25, 1.0)]
    first, both, second = (colour_bias(p, waves, integrate(p)).blind[2, 0] for p in parts)
    assert abs(second / first - 1) > 0.1
    assert both == pytest.approx(
        0.75 * first + 0.25 * second, rel=1e-9
    )  # orbits, so those resolved, are the same


def table(pair, single):
    """Selection that rejects wide, bright pairs with a probability, and single stars with another."""
    separation, contrast = np.array([0.003, 0.01, 0.02, 0.05]), np.array([0.0, 1.0, 2.5, 5.0])
    wide = np.array([0.3, 0.7, 0.9, 1.0])
    bright = np.array([1.0, 0.9, 0.5, 0.1])
    return SelectionTable(
        separation=separation,
        contrast=contrast,
        magnitude=np.array([18.5]),
        probability=(pair * bright[:, None] * wide)[None],
        single=np.array([single]),
    )


def test_a_selection_that_rejects_nothing_changes_nothing(in_vis, waves, integrals):
    selected = replace(in_vis, selection=table(0.0, 0.0))
    found, expected = colour_bias(selected, waves, integrate(selected)), colour_bias(in_vis, waves, integrals)
    np.testing.assert_allclose(found.blind, expected.blind, rtol=2e-3)


def test_a_selection_keeps_what_it_keeps_of_each_mass_ratio(in_vis, waves):
    selected = replace(in_vis, selection=table(1.0, 0.05))
    integrals = integrate(selected)
    found = colour_bias(selected, waves, integrals).blind[2, 0]
    law, mass, q = selected.law, selected.stars.mass, np.linspace(0.1, 1.0, 73)
    steps = 0.5 * np.append(np.diff(q), 0.0) + 0.5 * np.append(0.0, np.diff(q))
    g = law.mass_ratio_exponent + 1
    size = photon_averages(waves.band, waves.influence[2:])[0]
    tracks = replace(selected.tracks, magnitude=np.ascontiguousarray(size))
    total = np.zeros(mass.size)
    for ratio, step in zip(q, steps, strict=True):
        given = replace(selected, law=replace(law, mass_ratio=np.full(mass.size, ratio)))
        kept = integrate(given).kept  # of pairs of this mass ratio alone
        f = flux_ratio(selected.tracks, mass, np.full((mass.size, 1), ratio))[:, 0]
        own, other = (magnitudes(tracks, m[:, None])[:, 0] for m in (mass, mass * ratio))
        change = np.where(f > 0, f / (1 + f) * (np.where(f > 0, other, 0.0) - own), 0.0)
        total += step * g * ratio ** (g - 1) / (1 - 0.1**g) * kept * change
    p = law.multiplicity_fraction
    expected = np.sum(p * total) / np.sum((1 - p) * integrals.single_kept + p * integrals.kept)
    everything = colour_bias(in_vis, waves, integrate(in_vis)).blind[2, 0]
    assert found < 0.9 * everything
    assert found == pytest.approx(expected, rel=0.01)


def test_a_selection_sees_the_flux_ratios_of_the_band(population):
    selected = replace(population, selection=table(1.0, 0.0))
    here = in_band(selected, MODELS["photometry"], "roman_F158")
    again, fresh = integrals_in_band(here, integrate(selected)), integrate(here)
    np.testing.assert_allclose(again.joint, fresh.joint, rtol=1e-12)
