import numpy as np
import pytest

from porrima.gain import gain
from porrima.multiplicity import MULTIPLICITY
from porrima.photometry import PHOTOMETRY
from porrima.prediction import integrate, population_moments
from porrima.stars import Stars
from porrima.systems import Population


@pytest.fixture(scope="module")
def bins():
    rng = np.random.Generator(np.random.Philox(5))
    near = {
        "mass": rng.uniform(0.2, 0.9, 60),
        "distance": rng.uniform(200, 900, 60),
        "magnitude": np.full(60, 18.5),
    }
    far = near | {"distance": 5 * near["distance"], "magnitude": np.full(60, 20.5)}
    return [((18.0, 19.0), Stars.from_columns(**near)), ((20.0, 21.0), Stars.from_columns(**far))]


def test_the_gain_is_the_ratio_of_mean_x(bins):
    model = MULTIPLICITY["dk13"]
    found = gain(bins, model, binary_fraction=0.35)
    populations = [
        Population.of(s, multiplicity=model, photometry=PHOTOMETRY["main-sequence"], cut=0.05)
        for _, s in bins
    ]
    x = [population_moments(p, integrate(p), np.array([0.35])).mean_x[0] for p in populations]
    np.testing.assert_allclose(found["gain"], [1.0, x[0] / x[1]])
    np.testing.assert_allclose(found["mean_x"], x)
    assert np.all(found["low"] <= found["gain"])
    assert np.all(found["gain"] <= found["high"])


def test_the_same_stars_gain_nothing_and_that_is_certain(bins):
    found = gain([bins[0], ((20.0, 21.0), bins[0][1])], MULTIPLICITY["dk13-kcm16"])
    for name in ("gain", "low", "high"):
        np.testing.assert_allclose(found[name], 1.0)
