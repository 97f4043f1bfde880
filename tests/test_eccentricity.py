"""Eccentric orbits: nodes against Kepler's orbits drawn one by one, in numpy alone."""

import numpy as np
import pytest

from porrima.eccentricity import (
    NODES,
    eccentric,
    eccentricity_index,
    largest_eccentricity,
    log_period,
    orbit_nodes,
)
from porrima.integrals import _log_moments, separation_moments
from porrima.moe import MoeDiStefano2017
from porrima.multiplicity import DucheneKraus2013
from porrima.photometry import PHOTOMETRY
from porrima.published import Offner2023
from porrima.stars import Stars
from porrima.systems import Population
from statistics_helpers import assert_within_sigma

LIGHT = PHOTOMETRY["main-sequence"]
LAWS = ["circular", "uniform", "thermal", "mds17"]
N = 300_000


def drawn_eccentricities(law, period, rng):
    """As each law has them, written out."""
    u = rng.random(N)
    if law == "mds17":
        eta = 0.6 - 0.7 / (period - 0.5)
        return (1 - (10**period / 2) ** (-2 / 3)) * u ** (1 / (eta + 1))
    return {"circular": 0 * u, "uniform": u, "thermal": np.sqrt(u)}[law]


def projected(e, rng):
    """Separation on the sky over the semi-major axis: Kepler's equation, true anomaly, three angles."""
    mean = rng.uniform(0, 2 * np.pi, N)
    anomaly = mean + e * np.sin(mean)
    for _ in range(30):
        step = (anomaly - e * np.sin(anomaly) - mean) / (1 - e * np.cos(anomaly))
        anomaly -= np.clip(step, -1, 1)
    assert np.max(np.abs(anomaly - e * np.sin(anomaly) - mean)) < 1e-9
    x, y = np.cos(anomaly) - e, np.sqrt(1 - e**2) * np.sin(anomaly)
    periastron, inclination = rng.uniform(0, 2 * np.pi, N), np.arccos(rng.uniform(-1, 1, N))
    along = x * np.cos(periastron) - y * np.sin(periastron)
    across = (x * np.sin(periastron) + y * np.cos(periastron)) * np.cos(inclination)
    return np.hypot(along, across)


def within(population, k):
    """E[(r/cut)^(2k); r < cut] of a population of one star."""
    return population.law.share @ separation_moments(population)[0, :, k]


def of_one(model, mass=0.9, distance=700.0, cut=0.05):
    star = Stars.from_columns(mass=[mass], distance=[distance], magnitude=[18.5])
    return Population.of(star, multiplicity=model, photometry=LIGHT, cut=cut)


@pytest.mark.parametrize("law", LAWS)
def test_orbits_drawn_from_kepler_s_equation_have_the_moments_of_the_nodes(law):
    """Separations below the cut: their number and mean square, for the log-normal of solar-type stars."""
    rng = np.random.Generator(np.random.Philox(LAWS.index(law)))
    population = of_one(DucheneKraus2013(eccentricity=law))
    one = DucheneKraus2013().companions(np.array([0.9]))
    period = 0.25 * np.round(float(log_period(one.log_a, np.array([1.35]))[0]) / 0.25)
    axis = 10 ** (one.log_a + one.log_a_sigma * rng.standard_normal(N))
    r = axis * projected(drawn_eccentricities(law, period, rng), rng) / 700.0 / 0.05
    for k in (0, 1, 2):
        value = np.where(r < 1, r ** (2 * k), 0.0)
        assert_within_sigma(value.mean(), within(population, k), value.std() / np.sqrt(N))


@pytest.mark.parametrize("sigma", [1 / 3, 0.87, 1.5])
@pytest.mark.parametrize("law", ["uniform", "thermal"])
def test_five_nodes_are_as_good_as_thirty(law, sigma):
    """For any place of the cut: the mean square below it to 1e-3, also of the narrowest log-normal."""
    place = np.linspace(-0.6, 1.2, 7)
    found = []
    for nodes in (NODES, 30):
        shift, weight = orbit_nodes(law, 0.0, nodes)
        table = [np.exp(_log_moments(sigma, np.inf, "isotropic", place - s, 0)[:, 1]) for s in shift]
        found.append(weight @ np.array(table))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-3)


@pytest.mark.parametrize(("law", "square"), [("uniform", 1.5), ("thermal", 1.75)])
def test_mean_square_of_the_distance_is_that_of_the_law(law, square):
    """1 + 3 <e²>/2 (Kepler)."""
    shift, weight = orbit_nodes(law, 5.0)
    assert weight.sum() == pytest.approx(1)
    assert weight @ 10 ** (2 * shift) == pytest.approx(square, rel=2e-3)


def test_eccentricities_of_moe_and_di_stefano():
    """Their Eq. 17 and 3."""
    assert eccentricity_index(np.array([0.2, 0.7, 1.5, 5.5])) == pytest.approx([-2.9, -2.9, -0.1, 0.46])
    assert largest_eccentricity(np.array([np.log10(2.0), np.log10(16.0)])) == pytest.approx([0.0, 0.75])


def test_circles_are_left_as_they_are():
    law = DucheneKraus2013().companions(np.array([0.3, 1.0]))
    assert eccentric(law, np.array([0.3, 1.0]), "circular") is law
    shift, weight = orbit_nodes("circular", 0.0)
    assert weight @ shift == 0


def test_narrow_classes_together_are_as_good_as_nodes():
    """The classes of Moe & Di Stefano, shifted and widened, against each of them with thirty nodes."""
    mass = np.array([0.9])
    circles = MoeDiStefano2017(eccentricity="circular").companions(mass)
    for distance in (150.0, 700.0, 5000.0):
        expected = np.zeros(3)
        for share, log_a, sigma in zip(circles.share, circles.log_a, circles.log_a_sigma, strict=True):
            period = 0.25 * np.round(float(log_period(log_a, 1.5 * mass)[0]) / 0.25)
            shift, weight = orbit_nodes("mds17", period, 30)
            place = np.log10(0.05 * distance) - log_a - shift
            expected += share * (
                weight @ np.exp(_log_moments(float(sigma), np.inf, "isotropic", place, 0)[:, :3])
            )
        population = of_one(MoeDiStefano2017(), distance=distance)
        np.testing.assert_allclose([within(population, k) for k in range(3)], expected, rtol=4e-3)


def test_an_unknown_law_is_refused():
    with pytest.raises(
        ValueError, match="eccentricity must be one of circular, uniform, thermal, mds17, got flat"
    ):
        Offner2023(eccentricity="flat")
