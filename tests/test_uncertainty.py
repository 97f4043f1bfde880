import dataclasses

import numpy as np
import pytest

from porrima import multiplicity, uncertainty
from porrima.averages import population_moments
from porrima.companions import RowErrors
from porrima.integrals import integrate
from porrima.multiplicity import COMPILATIONS, MULTIPLICITY, ROW_ERRORS, DucheneKraus2013
from porrima.photometry import PHOTOMETRY
from porrima.prediction import predict
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.shapes import estimator_from_name
from porrima.stars import Stars
from porrima.systems import Population
from porrima.uncertainty import NAMES

LIGHT = PHOTOMETRY["main-sequence"]
NONE = RowErrors(*[(0.0, 0.0)] * 4)


@pytest.fixture(scope="module")
def reply():
    return response(psf_from_name("psf1"), estimator_from_name("plain"))


def eta(stars, reply, model, photometry=LIGHT, fraction=None, cut=0.05):
    population = Population.of(stars, multiplicity=model, photometry=photometry, cut=cut)
    moments = population_moments(population, integrate(population), fraction)
    return predict(moments, reply, None).eta[0]


def source(found, name):
    (one,) = [s for s in found.sources if s.name == name]
    return one


@pytest.mark.parametrize("model", [DucheneKraus2013(), DucheneKraus2013(gap_rule="solar", a_max_factor=2.5)])
@pytest.mark.parametrize(
    "figure", ["multiplicity_fraction", "mass_ratio_exponent", "a_mean", "sigma_log_period"]
)
def test_a_figure_moved_is_another_table(stars, reply, monkeypatch, model, figure):
    """The change of eta by one figure of the table against the prediction from a table with that figure changed."""
    name = {"a_mean": "mean_separation"}.get(figure, figure)
    field = {"a_mean": "log_a"}.get(figure, figure)
    only = (NONE, NONE._replace(**{field: getattr(ROW_ERRORS[1], field)}), NONE)
    found = uncertainty.uncertainty(
        stars, reply, multiplicity=model, photometry=LIGHT, row_errors=only, cut_error=0.0
    )
    moved = []
    for sign, error in zip((-1, 1), getattr(ROW_ERRORS[1], field), strict=True):
        value = getattr(multiplicity._LOW, figure)
        changed = value * 10 ** (sign * error) if figure == "a_mean" else value + sign * error
        with monkeypatch.context() as patch:
            patch.setattr(multiplicity, "_LOW", multiplicity._LOW._replace(**{figure: changed}))
            moved.append(eta(stars, reply, model) - eta_given(found))
    assert source(found, name).low[0] == pytest.approx(min(0, *moved), rel=3e-3)
    assert source(found, name).high[0] == pytest.approx(max(0, *moved), rel=3e-3)


def eta_given(found):
    return found.value[NAMES.index("eta")]


def test_choices_and_the_cut_are_what_they_give_themselves(stars, reply):
    model = DucheneKraus2013()
    found = uncertainty.uncertainty(stars, reply, multiplicity=model, photometry=LIGHT, cut_error=0.2)
    others = {
        "photometry": eta(stars, reply, model, PHOTOMETRY["habets-heintze"]),
        "gap_rule": eta(stars, reply, DucheneKraus2013(gap_rule="solar")),
        "projection": eta(stars, reply, DucheneKraus2013(projection="inclination-uniform")),
    }
    for name, value in others.items():
        one = source(found, name)
        assert one.kind == "choice"
        assert one.low[0] + one.high[0] == pytest.approx(value - eta_given(found), rel=5e-3)
    cut = source(found, "cut")
    assert cut.low[0] == pytest.approx(eta(stars, reply, model, cut=0.04) - eta_given(found), rel=3e-3)
    assert cut.high[0] == pytest.approx(eta(stars, reply, model, cut=0.06) - eta_given(found), rel=3e-3)


def test_the_interval_is_the_envelope_of_the_choices_and_the_quadratic_sum_of_the_rest(stars, reply):
    found = uncertainty.uncertainty(
        stars, reply, multiplicity=DucheneKraus2013(), photometry=LIGHT, n_stars=40, binary_fraction=0.35
    )
    rest = [s for s in found.sources if s.kind in ("error", "sample")]
    spread = np.sqrt(sum(s.high**2 for s in rest))
    assert np.all(found.high >= found.value + spread - 1e-15)
    assert np.all(found.low <= found.value)
    for kind in ("eta", "sd_e1", "sigma_r2"):
        low, high = found.interval(kind)
        assert low < found.value[NAMES.index(kind)] < high
    assert found.value[NAMES.index("sd_r2")] == found.prediction.sd[2, 0]
    ranked = found.ranking()
    assert [reach for _, reach in ranked] == sorted((reach for _, reach in ranked), reverse=True)
    assert {name for name, _ in ranked} == {
        "multiplicity_fraction", "mass_ratio_exponent", "mean_separation", "sigma_log_period",
        "cut", "photometry", "gap_rule", "projection", "stars", "model",
    }  # fmt: skip


def test_the_spread_between_models_is_that_of_their_own_predictions_and_no_part_of_the_interval(stars, reply):
    found = uncertainty.uncertainty(stars, reply, multiplicity=MULTIPLICITY["dk13"], photometry=LIGHT)
    assert set(found.models) == set(COMPILATIONS) - {"dk13"}
    own = {name: eta(stars, reply, MULTIPLICITY[name]) for name in found.models}
    for name, values in found.models.items():
        assert values[0] == pytest.approx(own[name], rel=5e-3)
    one = source(found, "model")
    assert one.kind == "model"
    assert one.high[0] == pytest.approx(max(own.values()) - eta_given(found), rel=2e-2)
    assert found.high[0] < eta_given(found) + one.high[0]


@pytest.mark.parametrize("name", ["offner23", "sm22", "modern"])
def test_every_model_has_errors_of_its_own(stars, reply, name):
    """The fraction of each row moved down and up, in quadrature, against predictions of laws changed by hand."""
    model = MULTIPLICITY[name]
    found = uncertainty.uncertainty(stars, reply, multiplicity=model, photometry=LIGHT)
    population = Population.of(stars, multiplicity=model, photometry=LIGHT)
    integrals, row = integrate(population), model.rows(population.stars.mass)
    squares = 0.0
    for number, errors in enumerate(model.row_errors):
        more = np.where(row == number, errors.multiplicity_fraction[1], 0.0)
        law = population.law
        changed = dataclasses.replace(law, multiplicity_fraction=law.multiplicity_fraction + more)
        moments = population_moments(dataclasses.replace(population, law=changed), integrals)
        squares += (predict(moments, reply, None).eta[0] - eta_given(found)) ** 2
    assert source(found, "multiplicity_fraction").high[0] == pytest.approx(np.sqrt(squares), rel=0.01)
    for figure in ("mass_ratio_exponent", "mean_separation", "sigma_log_period", "eccentricity"):
        one = source(found, figure)
        assert one.high[0] - one.low[0] > 0


def test_fewer_stars_give_nearly_the_same_changes(stars, reply, monkeypatch):
    options = {"multiplicity": DucheneKraus2013(), "photometry": LIGHT, "binary_fraction": 0.35}
    every = uncertainty.uncertainty(stars, reply, **options)
    monkeypatch.setattr(uncertainty, "MOST_STARS", 150)
    half = uncertainty.uncertainty(stars, reply, **options)
    assert half.value[0] == every.value[0]
    for name in ("mean_separation", "cut", "photometry"):
        assert source(half, name).high[0] == pytest.approx(source(every, name).high[0], rel=0.15, abs=1e-5)


def test_a_sample_of_stars_has_the_error_of_a_resampled_one(stars, reply):
    """The bootstrap of the stars, written out, against the formula of a ratio of sums."""
    model = DucheneKraus2013()
    found = uncertainty.uncertainty(stars, reply, multiplicity=model, photometry=LIGHT)
    population = Population.of(stars, multiplicity=model, photometry=LIGHT)
    integrals = integrate(population)
    p = population.law.multiplicity_fraction
    x, kept = p * integrals.mean[:, 0], 1 - p * (1 - integrals.unresolved)
    rng = np.random.Generator(np.random.Philox(9))
    picked = rng.integers(0, len(stars), (4000, len(stars)))
    ratio = x[picked].sum(axis=1) / kept[picked].sum(axis=1) / float(reply.shape0.r2)
    assert source(found, "stars").high[0] == pytest.approx(ratio.std(), rel=0.06)  # 5 standard errors of 4000


def test_pairs_that_a_catalogue_has_made_have_no_law_to_be_wrong(reply):
    star = Stars.from_columns(
        mass=[0.3] * 4, distance=[300.0] * 4, magnitude=[18.5] * 4, mass_ratio=[0, 0.9, 0, 0.8]
    )
    found = uncertainty.uncertainty(star, reply, multiplicity=DucheneKraus2013(), photometry=LIGHT)
    assert {s.name for s in found.sources}.isdisjoint({"multiplicity_fraction", "mass_ratio_exponent"})
    assert source(found, "mean_separation").high[0] > 0


def test_an_error_of_the_cut_that_is_none_is_refused(stars, reply):
    with pytest.raises(ValueError, match=r"cut_error must be in \[0, 1\), got 1.5"):
        uncertainty.uncertainty(
            stars, reply, multiplicity=DucheneKraus2013(), photometry=LIGHT, cut_error=1.5
        )


def test_results_are_frozen(stars, reply):
    found = uncertainty.uncertainty(stars, reply, multiplicity=DucheneKraus2013(), photometry=LIGHT)
    with pytest.raises(dataclasses.FrozenInstanceError):
        found.low = found.high
