import math
from dataclasses import replace

import numpy as np
import pytest

from porrima.budget import Premises, budget
from porrima.deconvolution import fit_response
from porrima.errors import InputError
from porrima.galaxies import Galaxies
from porrima.instruments import Requirement
from porrima.multiplicity import MULTIPLICITY
from porrima.photometry import PHOTOMETRY
from porrima.prediction import SeriesWarning, integrate, population_moments, predict
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.shapes import Adaptive, Plain
from porrima.systems import Population

OWN = Requirement(name="own", sigma_e=2e-4, sigma_r2=1e-3, m=1e-3, c=1e-4, source="here")
GALAXIES = Galaxies.of(0.05)
MODELS = {"multiplicity": MULTIPLICITY["dk13"], "photometry": PHOTOMETRY["main-sequence"]}
BIN = (18.0, 19.0)


@pytest.fixture(scope="module")
def premises():
    psf = psf_from_name("psf1")
    return Premises(
        requirement=OWN, response=response(psf, Adaptive()), n_stars=500, cut=0.05, binary_fraction=0.35,
        fit=fit_response(psf, GALAXIES), seen=GALAXIES, **MODELS,
    )  # fmt: skip


@pytest.fixture(scope="module")
def one(premises, stars):
    return budget(premises, [(BIN, stars)]).bins[0]


def of(one, group, quantity):
    return next(s for s in one.shares if (s.group, s.quantity) == (group, quantity))


def predicted(premises, stars, n_stars, cut=0.05):
    population = Population.of(stars, **MODELS, cut=cut)
    moments = population_moments(population, integrate(population), np.array([premises.binary_fraction]))
    return predict(moments, premises.response, n_stars)


def test_shares_of_the_psf_are_those_of_the_prediction(premises, stars, one):
    expected = predicted(premises, stars, premises.n_stars)
    for k, quantity in enumerate(("e1", "e2", "r2")):
        share = of(one, "psf", quantity)
        assert share.bias.value == pytest.approx(expected.bias[k, 0])
        assert share.scatter.value == pytest.approx(expected.sd[k, 0])
        assert share.total.value == pytest.approx(expected.sigma[k, 0])
        assert share.total.low <= share.total.value <= share.total.high


def test_m_of_gaussian_galaxies_is_mean_x_over_their_size(premises, stars, one):
    x = predicted(premises, stars, None).population
    m, c = of(one, "fit", "m"), of(one, "fit", "c1")
    # the fit also sees moments of order 4 and more, which make it some per cent smaller
    assert m.bias.value == pytest.approx(x.mean_x[0] / 0.05, rel=0.05)
    spread = math.sqrt((x.mean_x2[0] - x.mean_x[0] ** 2) / premises.n_stars) / 0.05
    assert m.scatter.value == pytest.approx(spread, rel=0.1)
    random = math.sqrt(x.mean_x2[0] / (2 * premises.n_stars)) / (2 * 0.05)
    assert c.scatter.value == pytest.approx(random, rel=0.1)
    assert abs(c.bias.value) < 1e-3 * m.bias.value


def test_moments_inherit_the_bias_of_the_size(premises, one):
    size, m = of(one, "psf", "r2"), of(one, "moments", "m")
    ratio = float(premises.response.shape0.r2) / 0.05
    assert m.bias.value == pytest.approx(size.bias.value * ratio, rel=0.01)
    assert m.bias.high / m.bias.value == pytest.approx(size.bias.high / size.bias.value)


def test_with_the_stars_needed_and_no_fewer_the_requirement_is_met(premises, stars):
    wide = replace(OWN, sigma_e=1.5e-3, sigma_r2=3e-3)
    for requirement in (OWN, wide):
        found = budget(replace(premises, requirement=requirement), [(BIN, stars)]).bins[0]
        for k, quantity in enumerate(("e1", "e2", "r2")):
            n = of(found, "psf", quantity).n_stars.value
            assert math.isinf(n) or n > 1
            if math.isinf(n):
                limit = predicted(premises, stars, None).bias[k, 0]
                assert abs(limit) >= requirement.of(quantity)
                continue
            enough, few = (predicted(premises, stars, int(n) + d).sigma[k, 0] for d in (1, -2))
            assert enough <= requirement.of(quantity) < few


def test_the_widest_cut_just_meets_the_requirement(premises, stars):
    strict = replace(OWN, sigma_r2=4e-4, sigma_e=None, m=None, c=None)
    found = budget(replace(premises, requirement=strict), [(BIN, stars)]).bins[0]
    cut = found.widest_cut["psf"]
    assert 0.01 < cut < 0.05
    assert predicted(premises, stars, premises.n_stars, cut).sigma[2, 0] == pytest.approx(4e-4, rel=0.02)


def test_no_cut_will_do_where_too_much_is_asked(premises, stars):
    found = budget(replace(premises, requirement=replace(OWN, sigma_e=1e-12)), [(BIN, stars)]).bins[0]
    assert math.isnan(found.widest_cut["psf"])
    assert found.verdict("psf") == "exceeds"


def test_without_binaries_everything_is_met(premises, stars):
    found = budget(replace(premises, binary_fraction=0.0), [(BIN, stars)])
    assert found.groups == ["psf", "fit", "moments"]
    for group in found.groups:
        assert found.bins[0].verdict(group) == "within"
        assert found.bins[0].n_stars(group) == 1
        assert found.bins[0].widest_cut[group] == pytest.approx(0.1)
        assert found.ranges(group) == [BIN]


def test_neighbouring_bins_that_meet_the_requirement_are_joined(premises, stars):
    easy = replace(OWN, sigma_e=1.0, sigma_r2=1.0)
    bins = [((18.0, 18.5), stars), ((18.5, 19.0), stars), ((20.0, 21.0), stars)]
    found = budget(replace(premises, requirement=easy, fit=None, seen=None), bins)
    assert found.groups == ["psf"]
    assert found.ranges("psf") == [(18.0, 19.0), (20.0, 21.0)]


def test_what_is_not_required_has_no_group(premises, stars):
    found = budget(replace(premises, requirement=replace(OWN, sigma_e=None, sigma_r2=None)), [(BIN, stars)])
    assert found.groups == ["fit", "moments"]


@pytest.mark.filterwarnings("ignore::porrima.prediction.SeriesWarning")
def test_a_cut_wider_than_the_psf_is_refused_with_the_order_at_which_the_series_ends(premises, stars):
    with pytest.raises(InputError, match=r"cut: is too wide .* stops being good at order 2, got 0.5"):
        budget(replace(premises, cut=0.5), [(BIN, stars)])


def test_where_only_the_ends_of_the_interval_are_too_wide_a_warning_says_so(premises, stars):
    with pytest.warns(SeriesWarning) as said:
        found = budget(replace(premises, cut=0.115), [(BIN, stars)])
    assert any("stops being good at order" in str(one.message) for one in said)
    assert math.isnan(of(found.bins[0], "psf", "r2").total.high)
    assert found.bins[0].verdict("psf") != "within"


def test_plain_moments_need_no_series(stars):
    premises = Premises(
        requirement=OWN, response=response(psf_from_name("psf0"), Plain()), n_stars=100, cut=0.3, **MODELS
    )
    share = of(budget(premises, [(BIN, stars)]).bins[0], "psf", "r2")
    population = Population.of(stars, **MODELS, cut=0.3)
    eta = population_moments(population, integrate(population)).mean_x[0] / premises.response.shape0.r2
    assert share.bias.value == pytest.approx(eta, rel=1e-6)
