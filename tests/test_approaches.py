import numpy as np
import pytest

from porrima.approaches import approaches, clip_forecast
from porrima.multiplicity import MULTIPLICITY
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.samples import Fractions
from porrima.shapes import Adaptive

MODEL = MULTIPLICITY["dk13"]
THRESHOLDS = np.array([0.008, 0.016, np.inf])


@pytest.fixture(scope="module")
def reply():
    return response(psf_from_name("psf1"), Adaptive())


@pytest.fixture(scope="module")
def bins(stars):
    far = np.flatnonzero(stars.distance > np.median(stars.distance))
    return [((18.0, 19.0), stars), ((20.0, 21.0), stars.take(far))]


@pytest.fixture(scope="module")
def rows(bins, reply):
    fields = Fractions(value=np.array([0.2, 0.5]), error=np.zeros(2))
    found = approaches(bins, reply, MODEL, n_stars=2000, fields=fields, thresholds=THRESHOLDS)
    return {row["approach"]: row for row in found}


def test_there_are_three_approaches_two_of_them_extrapolations(rows):
    assert list(rows) == ["prediction", "magnitudes", "clips", "fields"]


def test_the_model_and_its_choices_only_add_errors(rows):
    for row in rows.values():
        assert row["best_scatter"] <= row["scatter"] * 1.02
        assert row["scatter"] < row["error"] <= row["error_with_choices"] * (1 + 1e-9)


def test_two_fields_of_known_fractions_hardly_need_the_model(rows):
    assert rows["fields"]["error"] < 1.1 * rows["fields"]["scatter"]
    assert rows["prediction"]["error"] > 1.5 * rows["prediction"]["scatter"]


def test_four_times_the_stars_halve_the_scatter_of_a_clip(stars, reply):
    few, many = (clip_forecast(stars, reply, MODEL, THRESHOLDS, n)["scatter"] for n in (2000, 8000))
    assert few == pytest.approx(2 * many, rel=2e-3)


def test_shares_are_of_all_stars(rows):
    for name in ("magnitudes", "fields"):
        assert sum(rows[name]["best_share"]) == pytest.approx(1)
    assert np.all(np.diff(rows["clips"]["removed"]) < 0)
    assert np.all(np.diff(rows["clips"]["eta"]) > 0)
