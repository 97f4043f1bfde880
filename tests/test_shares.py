import math

import pytest

from porrima.instruments import REQUIREMENTS, SURVEYS
from porrima.shares import Interval, Share, stars_needed


def share(total, low, high, required=1.0):
    known = Interval(total, low, high)
    return Share(
        group="psf", quantity="r2", required=required, bias=known, scatter=known, total=known, n_stars=known
    )


@pytest.mark.parametrize(
    ("ends", "verdict"),
    [
        ((0.2, 0.9), "within"),
        ((0.2, 1.0), "within"),
        ((0.9, 1.1), "uses all"),
        ((1.1, 3.0), "exceeds"),
        ((math.nan, math.nan), "uses all"),
    ],
)
def test_the_verdict_follows_from_where_the_interval_lies(ends, verdict):
    assert share(0.5 * sum(ends), *ends).verdict == verdict


def test_nothing_required_has_neither_share_nor_verdict():
    assert share(1.0, 0.5, 2.0, required=None).share is None
    assert share(1.0, 0.5, 2.0, required=None).verdict is None


def test_stars_needed_are_the_fewest_whose_error_is_small_enough():
    bias, spread, required = 3e-4, 5e-3, 1e-3
    n = stars_needed(bias, spread, required)
    assert math.hypot(bias, spread / math.sqrt(n)) <= required < math.hypot(bias, spread / math.sqrt(n - 1))
    assert stars_needed(0.0, 1e-9, required) == 1
    assert stars_needed(required, spread, required) == math.inf
    assert math.isnan(stars_needed(math.nan, spread, required))
    assert math.isnan(stars_needed(bias, math.nan, required))


def test_a_size_has_no_sign_and_reaches_zero_where_the_interval_does():
    assert Interval(-2.0, -3.0, -1.0).size == Interval(2.0, 1.0, 3.0)
    assert Interval(-1.0, -2.0, 3.0).size == Interval(1.0, 0.0, 3.0)


@pytest.mark.parametrize("name", REQUIREMENTS)
def test_every_set_of_requirements_has_a_survey_and_a_source(name):
    requirement = REQUIREMENTS[name]
    assert SURVEYS[name].requirement is requirement
    assert requirement.source
    values = [requirement.of(q) for q in ("e1", "e2", "r2", "m", "c1", "c2")]
    assert any(v is not None for v in values)
    assert all(v is None or 0 < v < 0.01 for v in values)


def test_requirements_are_those_of_their_sources():
    kcm16, roman, rubin = (REQUIREMENTS[name] for name in ("kcm16", "roman-h158", "rubin"))
    assert (kcm16.sigma_e, kcm16.sigma_r2, kcm16.m, kcm16.c) == (2e-4, 1e-3, None, None)
    assert (roman.m, roman.c) == (3.2e-4, None)
    assert (rubin.sigma_e, rubin.m, rubin.c) == (None, 1e-3, 1e-4)
