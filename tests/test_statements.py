"""What the predictions for the statements must be where theory is exact."""

import numpy as np
import pytest

from porrima.multiplicity import MULTIPLICITY
from porrima.programme import READINGS
from porrima.statements import N_STEPS, statement_numbers

MODELS = {name: MULTIPLICITY[name] for name in READINGS}


@pytest.fixture(scope="module")
def found():
    seen = []
    parts = statement_numbers(
        psf=("psf1",), optical=("psf1",), models=MODELS, n_drawn=160, progress=seen.append
    )
    assert sum(seen) == N_STEPS
    return parts


def value(found, name):
    return float(found["numbers"]["value"].sel(name=name)), float(found["numbers"]["error"].sel(name=name))


def test_every_number_has_a_standard_error(found):
    numbers = found["numbers"]
    assert np.all(np.isfinite(numbers["value"]))
    assert np.all(np.isfinite(numbers["error"]))
    assert np.all(numbers["error"] >= 0)
    assert numbers["name"].size == np.unique(numbers["name"]).size


def test_an_unweighted_size_knows_the_psf_by_its_size_alone(found):
    ratio, error = value(found, "sharper_unweighted")
    assert error == 0
    assert 1.0 < ratio < 1.3  # 9.665e-3 over 8.471e-3 arcsec² by the magnitude figure
    assert value(found, "larger_law")[0] == pytest.approx(1.0, abs=0.05)


def test_a_wide_weight_responds_to_a_gaussian_as_unweighted_moments_do(found):
    assert value(found, "wide_size")[0] == pytest.approx(1.0, abs=0.02)
    assert value(found, "wide_e")[0] == pytest.approx(1.0, abs=0.02)


def test_the_share_of_the_ellipticity_is_that_of_the_size_times_the_ellipticity(found):
    for lo in (16, 18, 20):
        share = 0.05 * 1e-3 * value(found, f"size_share_dk13_{lo}")[0] / 2e-4
        assert value(found, f"e_share_dk13_{lo}")[0] == pytest.approx(share, rel=0.1)


def test_what_cleaning_leaves_is_less_and_triples_are_more(found):
    assert value(found, "clip_gain")[0] > 1
    assert 0 < value(found, "clip_removed")[0] < 0.1
    assert value(found, "gaia_gain")[0] == pytest.approx(1.0, abs=0.02)
    assert value(found, "triples_dk13")[0] > 1


def test_mean_x_rises_with_the_binary_fraction(found):
    assert np.all(np.diff(found["mean_x"]["mean_x"]) > 0)
    assert float(found["psfs"]["e1_0"].sel(psf="psf1")) == pytest.approx(0.054)
