"""The engine with a selection: exactly N stars that were kept, as the closed form has them."""

from dataclasses import replace

import numpy as np
import pytest

from hard_cut import HardCut
from porrima.distribution import size_distribution
from porrima.errors import InputError
from porrima.multiplicity import MULTIPLICITY
from porrima.photometry import PHOTOMETRY
from porrima.prediction import integrate, population_moments, predict
from porrima.psf import psf_from_name
from porrima.rejection import single_loss
from porrima.response import response
from porrima.screen import screen_of
from porrima.selection import Combined, SelectionTable
from porrima.shapes import Plain
from porrima.stack import draw_stacks, draw_systems
from porrima.systems import Population
from porrima.uncertainty import uncertainty
from statistics_helpers import assert_within_sigma

GRID = {"separation": np.array([0.01, 0.03, 0.05]), "contrast": np.array([0.0, 2.0, 5.0])}
SMOOTH = SelectionTable(
    **GRID,
    magnitude=np.array([18.0, 19.0]),
    probability=np.array(
        [
            [[0.1, 0.7, 1.0], [0.05, 0.5, 0.9], [0.02, 0.1, 0.4]],
            [[0.2, 0.4, 0.8], [0.1, 0.3, 0.6], [0.1, 0.1, 0.1]],
        ]
    ),
    single=np.array([0.02, 0.3]),
)
SELECTIONS = {"smooth": SMOOTH, "edge": HardCut(separation=0.03),
              "both": Combined(parts=(HardCut(separation=0.04), SMOOTH))}  # fmt: skip


def drawn(population, **options):
    given = {"n_stars": 200, "binary_fraction": 0.5, "seed": 7, "first": 0, "last": 20_000}
    return draw_stacks(population, **given | options).moments.values


@pytest.mark.parametrize("name", SELECTIONS)
@pytest.mark.parametrize("weight", ["equal", "flux"])
def test_stacks_have_the_moments_of_the_closed_form(population, name, weight):
    flux = 10 ** (-0.4 * population.stars.magnitude)
    chosen = replace(
        population,
        selection=SELECTIONS[name],
        weight=flux / flux.mean() if weight == "flux" else population.weight,
    )
    values = drawn(chosen)
    theory = population_moments(chosen, integrate(chosen), np.array([0.5]))
    for k in (0, 2, 7, 11):
        error = values[:, k].std() / np.sqrt(len(values))
        assert_within_sigma(values[:, k].mean(), (theory.mean + theory.shift / 200)[0, k], error)
    squares = (values[:, 0] - values[:, 0].mean()) ** 2 * 200
    error = squares.std() / np.sqrt(len(squares))
    assert_within_sigma(
        squares.mean(), theory.covariance[0, 0, 0], error + 1e-3 * squares.mean() * (weight == "flux")
    )


def test_an_empty_table_leaves_every_bit_as_it_is(population):
    nothing = SelectionTable(
        **GRID, magnitude=np.array([0.0]), probability=np.zeros((1, 3, 3)), single=np.zeros(1)
    )
    assert np.array_equal(drawn(replace(population, selection=nothing), last=50), drawn(population, last=50))


def test_a_stack_does_not_depend_on_those_drawn_with_it(population):
    chosen = replace(population, selection=SMOOTH)
    assert np.array_equal(drawn(chosen, first=40, last=50), drawn(chosen, last=50)[40:])


def test_systems_are_those_whose_moments_are_summed(population):
    chosen = replace(population, selection=SELECTIONS["both"])
    systems = draw_systems(chosen, n_stars=200, binary_fraction=0.5, seed=7, stack=3)
    assert len(systems) == 200
    assert systems.kernel_moments().values[0] == pytest.approx(drawn(chosen, last=4)[3], rel=1e-4, abs=1e-12)
    offset = np.hypot(np.diff(systems.x, axis=1), np.diff(systems.y, axis=1))
    assert offset.max() < 0.04


def test_single_stars_kept_are_those_of_the_magnitudes_that_keep_them(population):
    flux = 10 ** (-0.4 * population.stars.magnitude)
    chosen = replace(population, selection=SMOOTH, weight=flux / flux.mean())
    systems = draw_systems(chosen, n_stars=40_000, binary_fraction=0.0, seed=1, stack=0)
    kept = 1 - screen_of(chosen).single
    expected = (kept * chosen.weight).sum() / kept.sum()
    assert_within_sigma(systems.weight.mean(), expected, systems.weight.std() / np.sqrt(40_000))


def test_the_loss_of_single_stars_is_their_mean(population):
    chosen = replace(population, selection=SMOOTH)
    screen, scale = screen_of(chosen), np.array([0.0, 0.5, 1.0, 2.5, 4.0])
    single = 1 - np.minimum(1, scale[:, None] * population.law.multiplicity_fraction)
    expected = (single @ screen.single) / single.sum(axis=1)
    assert single_loss(chosen, screen, scale) == pytest.approx(expected, rel=1e-12)
    assert single_loss(chosen, screen, np.array([1e9])) == 0  # no single star, none lost


def test_pairs_alone_may_all_be_rejected_but_for_few(population):
    every = HardCut(separation=1e-9)
    with pytest.raises(ValueError, match="must leave some pairs unresolved"):
        drawn(replace(population, selection=every), n_stars=1, binary_fraction=1.0, last=1)


def test_a_gpu_is_refused_with_a_selection(population):
    with pytest.raises(InputError, match="device: must be cpu for a run with a selection, got cuda"):
        drawn(replace(population, selection=SMOOTH), device="cuda", last=1)


def test_quantiles_are_those_of_drawn_stacks(population):
    reply = response(psf_from_name("psf0"), Plain())
    chosen = replace(population, selection=SELECTIONS["both"])
    values = drawn(chosen, n_stars=40, last=40_000)
    size = (values[:, 0] + values[:, 2]) / float(reply.shape0.r2)
    found = size_distribution(chosen, reply, 40, 0.5)
    for p in (0.1, 0.5, 0.9):
        share = np.mean(size <= found.quantile(np.array([p]))[0])
        assert_within_sigma(share, p, np.sqrt(p * (1 - p) / size.size) + 2e-3)  # cells are 2 and 6 % wide


def test_an_uncertainty_is_that_of_the_stars_kept(stars):
    reply = response(psf_from_name("psf0"), Plain())
    models = {"multiplicity": MULTIPLICITY["dk13"], "photometry": PHOTOMETRY["main-sequence"]}
    narrow = uncertainty(stars, reply, **models, cut=0.03)
    chosen = uncertainty(stars, reply, **models, cut=0.05, selection=HardCut(separation=0.03), cut_error=0.0)
    assert chosen.value == pytest.approx(narrow.value, rel=1e-4, abs=1e-12)
    for one, other in zip(chosen.sources, narrow.sources, strict=True):
        if one.name not in ("cut", "stars"):
            assert one.high[0] == pytest.approx(other.high[0], rel=2e-2, abs=2e-3 * narrow.value[0])
    moments = population_moments(*_with_integrals(stars, models), np.array([0.35]))
    assert predict(moments, reply).eta[0] > chosen.value[0]


def _with_integrals(stars, models):
    population = Population.of(stars, **models)
    return population, integrate(population)
