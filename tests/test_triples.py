"""Triple stars: the engine, the quadrature and a third account in plain numpy, which shares nothing with either."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from hard_cut import HardCut
from porrima import triple_averages
from porrima.averages import population_moments
from porrima.clipping import count_pairs
from porrima.colour import colour_bias
from porrima.config import Multiplicity
from porrima.distribution import size_distribution
from porrima.errors import InputError
from porrima.hierarchy import INNER_AROUND_PRIMARY, triple_fraction, with_triples
from porrima.images import measure_stack
from porrima.integrals import integrate
from porrima.moments import INDICES
from porrima.multiplicity import MULTIPLICITY, DucheneKraus2013
from porrima.pairs import tables_of
from porrima.photometry import PHOTOMETRY, flux_ratio
from porrima.prediction import predict
from porrima.psf import psf_from_name
from porrima.published import Offner2023
from porrima.response import response
from porrima.shapes import Adaptive, estimator_from_name
from porrima.stack import draw_stacks, draw_systems
from porrima.stars import Stars
from porrima.systems import Population, Systems
from porrima.triples import _draw_triple, _hierarchy, member_rows
from statistics_helpers import assert_within_sigma

LIGHT = PHOTOMETRY["main-sequence"]
MODELS = {
    "dk13": DucheneKraus2013(triples=True),
    "kcm16": DucheneKraus2013(triples=True, gap_rule="solar", a_max_factor=2.5),
    "inclination-uniform": DucheneKraus2013(triples=True, projection="inclination-uniform"),
    "offner23": Offner2023(triples=True),
    "eccentric": Offner2023(triples=True, gap_rule="interpolated", eccentricity="uniform"),
}


def of(stars, model="dk13", **options):
    return Population.of(stars, multiplicity=MODELS[model], photometry=LIGHT, **options)


@pytest.fixture(scope="module")
def heavy():
    """Stars that the range of every model holds."""
    rng = np.random.Generator(np.random.Philox(20261125))
    n = 200
    return Stars.from_columns(
        mass=rng.uniform(0.09, 1.2, n),
        distance=10 ** rng.uniform(2.2, 3.6, n),
        magnitude=rng.uniform(18, 19, n),
        metallicity=rng.uniform(-2, 0.2, n),
        log_age=rng.uniform(9.0, 10.1, n),
    )


class BruteForce:
    """Triples of a population drawn in plain numpy, every class of a star by its share, unstable ones drawn again."""

    def __init__(self, population, rng, n):
        law, number = population.law, np.where(population.law.is_triple, population.abundance, 0.0)
        number = number * law.multiplicity_fraction
        self.population, self.rng, self.law = population, rng, law
        self.row = rng.choice(number.size, size=n, p=number / number.sum())
        self.number = number.sum()
        self.around = rng.random(n) < INNER_AROUND_PRIMARY
        self.axes, self.ratios = np.empty((2, n)), np.empty((2, n))
        todo = np.arange(n)
        while todo.size:
            self._draw(todo)
            todo = todo[~self._is_stable(todo)]

    def _draw(self, k):
        law, rng = self.law, self.rng
        for orbit in range(2):
            row = self._class(self.row[k])
            todo = np.arange(k.size)
            axis = np.empty(k.size)
            while todo.size:
                axis[todo] = rng.normal(law.log_a[row[todo]], law.log_a_sigma[row[todo]])
                todo = todo[axis[todo] > law.log_a_max[row[todo]]]
            g, low, high = (
                c[row] for c in (law.mass_ratio_exponent + 1, law.mass_ratio_min, law.mass_ratio_max)
            )
            self.axes[orbit, k] = axis
            self.ratios[orbit, k] = (low**g + rng.random(k.size) * (high**g - low**g)) ** (1 / g)

    def _class(self, row):
        """One of the classes of triples of the star of a row, by their shares."""
        star, share = self.law.star, np.where(self.law.is_triple, self.law.share, 0.0)
        out = row.copy()
        for one in np.unique(star[row]):
            mine, here = np.flatnonzero(star == one), star[row] == one
            p = share[mine] / share[mine].sum()
            out[here] = self.rng.choice(mine, size=here.sum(), p=p)
        return out

    def _is_stable(self, k):
        outer = np.argmax(self.axes[:, k], axis=0)
        q_out, q_in = self.ratios[outer, k], self.ratios[1 - outer, k]
        third = np.where(self.around[k], q_out / (1 + q_in), 1 / (q_out + q_out * q_in))
        gap = np.abs(self.axes[0, k] - self.axes[1, k])
        return gap > np.log10(2.8 * (1 + third) ** 0.4)

    def systems(self):
        """All of them, resolved or not, and the largest separation of each in arcsec."""
        stars, tracks, n = self.population.stars, self.population.tracks, self.row.size
        outer = np.argmax(self.axes, axis=0)
        q_out, q_in = self.ratios[outer, np.arange(n)], self.ratios[1 - outer, np.arange(n)]
        a = 10 ** np.stack([self.axes.max(axis=0), self.axes.min(axis=0)]) / stars.distance[self.row]
        vector = self.rng.normal(size=(2, n, 3))
        vector /= np.linalg.norm(vector, axis=2, keepdims=True)  # a random place on a sphere, seen along z
        wide, narrow = (a[:, :, None] * vector)[:, :, :2]
        m_b = np.where(self.around, q_in, q_out)
        m_c = np.where(self.around, q_out, q_in * q_out)
        pair = np.where(self.around, 1.0, m_b) + np.where(self.around, m_b, m_c)
        part = (np.where(self.around, m_b, m_c) / pair)[:, None]
        inner = np.stack([-part * narrow, (1 - part) * narrow])  # about their centre of mass
        around = self.around[:, None]
        place_a = np.where(around, inner[0], 0.0)
        place_b = np.where(around, inner[1], wide + inner[0])
        place_c = np.where(around, wide, wide + inner[1])
        tracks = replace(tracks, index=tracks.index[self.row], weight=tracks.weight[self.row])
        f = flux_ratio(tracks, stars.mass[self.row], np.stack([m_b, m_c], axis=1))
        d = np.stack([place_b - place_a, place_c - place_a], axis=1)
        between = np.hypot(*(place_c - place_b).T)
        widest = np.maximum(np.hypot(d[:, :, 0], d[:, :, 1]).max(axis=1), between)
        return Systems.from_companions(f, d[:, :, 0], d[:, :, 1]), widest


@pytest.mark.parametrize("model", ["dk13", "kcm16", "eccentric"])
def test_brute_force_gives_the_same_triples(heavy, model):
    population, n = of(heavy, model), 200_000
    drawn = BruteForce(population, np.random.Generator(np.random.Philox(7)), n)
    systems, widest = drawn.systems()
    kept = widest < population.cut
    x = np.where(kept, np.sum(systems.flux * (systems.x**2 + systems.y**2), axis=1), 0.0)
    found = triple_averages.triple_averages(population).sums(np.ones(1))
    assert found.number[0] == pytest.approx(drawn.number, rel=1e-9)
    share = found.kept[0] / found.number[0]
    assert_within_sigma(kept.mean(), share, np.sqrt(share * (1 - share) / n))
    mean = found.mean[0, 0, INDICES.index((2, 0))] + found.mean[0, 0, INDICES.index((0, 2))]
    assert_within_sigma(x.mean(), mean / found.number[0], x.std() / np.sqrt(n))
    square = found.product[0][np.ix_([0, 2], [0, 2])].sum()
    assert_within_sigma((x**2).mean(), square / found.number[0], (x**2).std() / np.sqrt(n))


@pytest.mark.parametrize("weight", ["equal", "flux"])
@pytest.mark.parametrize("model", MODELS)
def test_the_engine_agrees_with_the_quadrature(heavy, model, weight):
    population, n_stars, n_stacks = of(heavy, model, stack_weight=weight), 400, 4000
    for fraction in (0.35, 0.8):
        drawn = draw_stacks(
            population, n_stars=n_stars, binary_fraction=fraction, seed=5, first=0, last=n_stacks
        ).moments.values
        known = population_moments(population, integrate(population), np.array([fraction]))
        error = np.sqrt(np.diag(known.covariance[0]) / n_stars / n_stacks)
        assert_within_sigma(drawn.mean(axis=0), known.mean[0] + known.shift[0] / n_stars, error)
        batches = drawn.reshape(40, -1, drawn.shape[1])
        centred = batches - batches.mean(axis=1, keepdims=True)
        products = np.einsum("bsi,bsj->bij", centred, centred) / (centred.shape[1] - 1)
        few = [k for k, (a, b) in enumerate(INDICES) if a + b <= 4]
        error = products.std(axis=0, ddof=1) / np.sqrt(len(products))
        slack = 0.01 if weight == "flux" else 0.0  # the covariance of weighted stacks is first order in 1/N
        scale = np.sqrt(np.diag(known.covariance[0]) / n_stars)
        difference = np.abs(products.mean(axis=0) - known.covariance[0] / n_stars)
        too_far = difference > 5 * error + slack * np.outer(scale, scale)
        assert not np.any(too_far[np.ix_(few, few)])


@dataclass(frozen=True)
class AllTriples:
    """Every multiple star is a triple, with orbits near the cut and near the limit of stability."""

    projection = "isotropic"

    def companions(self, mass, metallicity=None):
        law = DucheneKraus2013(gap_rule="solar").companions(mass)
        law = replace(law, log_a_sigma=np.full(mass.size, 0.5), log_a=np.full(mass.size, 1.0))
        return with_triples(law, np.ones(mass.size))


def test_engine_and_quadrature_agree_to_a_thousandth_where_all_are_triples(heavy, monkeypatch):
    """Fine enough to tell limits of stability a tenth apart."""
    monkeypatch.setattr(triple_averages, "_POINTS", 15)
    population = Population.of(heavy, multiplicity=AllTriples(), photometry=LIGHT)
    n_stars, n_stacks = 400, 15_000
    known = population_moments(population, integrate(population), np.array([1.0]))
    drawn = draw_stacks(
        population, n_stars=n_stars, binary_fraction=1.0, seed=21, first=0, last=n_stacks
    ).moments.values
    even = [k for k, (a, b) in enumerate(INDICES) if a + b in (2, 4) and a % 2 == 0]
    error = np.sqrt(np.diag(known.covariance[0]) / n_stars / n_stacks)[even]
    of_points = known.relative_error[0] * known.mean[0, even]
    assert np.all(error[:1] < 2e-3 * known.mean[0, even[:1]])
    assert_within_sigma(drawn.mean(axis=0)[even], known.mean[0, even], np.hypot(error, of_points))


def test_orbits_are_about_centres_of_mass_stable_and_turned_independently(heavy):
    """Of single triples of the engine, with the axes and masses that it drew for them."""
    population = Population.of(heavy, multiplicity=AllTriples(), photometry=LIGHT)
    tables, member, n = tables_of(population), member_rows(population), 4000
    rows = np.flatnonzero(population.law.is_triple)
    three, found = np.zeros(6), []
    for pair in range(n):
        key = (
            tables,
            member,
            int(rows[pair % rows.size]),
            np.uint32(3),
            np.uint32(0),
            np.uint32(0),
            np.uint32(0),
        )
        outer, inner, m_outer, m_inner, around = _hierarchy(*key, np.uint32(pair))
        widest = _draw_triple(*key, np.uint32(pair), three)
        own = np.log2(population.stars.mass[key[2]])
        found.append([outer, inner, m_outer - own, m_inner - own, around, widest, *three])
    outer, inner, q_outer, q_inner = 2.0 ** np.array(found).T[:4]
    around, widest = np.array(found).T[4] > 0, np.array(found).T[5]
    _, x1, y1, _, x2, y2 = np.array(found).T[6:]
    first, second = (
        x1 + 1j * y1,
        x2 + 1j * y2,
    )  # of the third star or B, and of the companion in the inner pair
    heavier = np.where(around, 1.0, q_outer)
    share = q_inner / (heavier + q_inner)
    narrow = np.where(around, second, second - first)
    centre = np.where(around, share * narrow, first + share * narrow)
    wide = np.where(around, first - centre, centre)
    third = np.where(around, q_outer, 1.0) / (heavier + q_inner)
    assert np.all(outer / inner > 2.8 * (1 + third) ** 0.4 * (1 - 1e-5))
    assert np.all(q_inner <= heavier * (1 + 1e-5))
    at = np.max(np.abs([first, second, first - second]), axis=0)
    np.testing.assert_allclose(widest, at, rtol=1e-5)
    for vector, axis in ((wide, outer), (narrow, inner)):
        ratio = (np.abs(vector) / axis) ** 2
        assert ratio.max() < 1 + 1e-3
        assert_within_sigma(ratio.mean(), 2 / 3, ratio.std() / np.sqrt(n))
    for kind in (around, ~around):
        cosine = (wide * narrow.conj() / np.abs(wide * narrow)).real[kind]
        assert_within_sigma(cosine.mean(), 0.0, cosine.std() / np.sqrt(cosine.size))
    share = INNER_AROUND_PRIMARY
    assert_within_sigma(around.mean(), share, np.sqrt(share * (1 - share) / n))


@pytest.mark.parametrize("psf", ["psf1", "optical1"])
@pytest.mark.parametrize(("n_stars", "n_stacks"), [(1, 200_000), (40, 20_000)])
def test_bias_and_scatter_of_stacks_are_as_predicted(heavy, psf, n_stars, n_stacks):
    population, reply = of(heavy), response(psf_from_name(psf), estimator_from_name("adaptive"))
    stacks = draw_stacks(population, n_stars=n_stars, binary_fraction=0.35, seed=9, first=0, last=n_stacks)
    known = population_moments(population, integrate(population), np.array([0.35]))
    expected = predict(known, reply, n_stars)
    shapes, zero = reply.shapes(stacks.moments), reply.shape0
    change = np.stack([shapes.e1 - zero.e1, shapes.e2 - zero.e2, shapes.r2 / zero.r2 - 1])
    sd = expected.sd[:, 0]
    assert_within_sigma(change.mean(axis=1), expected.bias[:, 0], sd / np.sqrt(n_stacks))
    fourth = np.mean((change - change.mean(axis=1, keepdims=True)) ** 4, axis=1)
    error = np.sqrt((fourth - sd**4) / n_stacks) / (2 * sd)
    assert_within_sigma(change.std(axis=1), sd, error + 2e-3 * sd)


@pytest.mark.parametrize("n_stars", [1, 40])
def test_quantiles_hold_for_stacks_with_triples(heavy, n_stars):
    population, reply = of(heavy), response(psf_from_name("psf1"), estimator_from_name("plain"))
    n_stacks = 20_000
    stacks = draw_stacks(population, n_stars=n_stars, binary_fraction=0.35, seed=17, first=0, last=n_stacks)
    found = size_distribution(population, reply, n_stars, 0.35)
    value = found.quantile(np.array([0.5, 0.84, 0.95, 0.99])) + 1e-13
    below = np.mean((reply.shapes(stacks.moments).r2 / reply.shape0.r2 - 1)[:, None] <= value, axis=0)
    expected = found.probability(value)
    assert_within_sigma(below, expected, np.sqrt(expected * (1 - expected) / n_stacks))


def test_the_systems_listed_are_those_summed(heavy):
    population = of(heavy, stack_weight="flux")
    systems = draw_systems(population, n_stars=3000, binary_fraction=0.5, seed=2, stack=4)
    summed = draw_stacks(population, n_stars=3000, binary_fraction=0.5, seed=2, first=4, last=5)
    assert systems.flux.shape == (3000, 3)
    np.testing.assert_allclose(systems.flux.sum(axis=1), 1.0)
    both, listed = summed.moments.values[0], systems.kernel_moments().values[0]
    scale = np.array([population.cut ** (a + b) for a, b in INDICES])
    np.testing.assert_allclose(both / scale, listed / scale, atol=1e-8)


@pytest.mark.parametrize("psf", ["psf1", "optical1"])
def test_images_of_triples_have_the_shape_of_their_moments(heavy, psf):
    population, psf = of(heavy), psf_from_name(psf)
    reply = response(psf, Adaptive())
    alone = Adaptive().measure(psf.draw())
    for stack in range(3):
        systems = draw_systems(population, n_stars=40, binary_fraction=0.8, seed=3, stack=stack)
        assert np.any(systems.flux[:, 2] > 0)
        drawn, known = measure_stack(psf, systems, Adaptive()), reply.shapes(systems.kernel_moments())
        change = float(drawn.r2 - alone.r2)
        assert change == pytest.approx(float(known.r2[0] - reply.shape0.r2), rel=5e-4)
        for name in ("e1", "e2"):
            one = float(getattr(drawn, name) - getattr(alone, name))
            other = float(getattr(known, name)[0] - getattr(reply.shape0, name))
            assert one == pytest.approx(other, abs=5e-4 * change / float(alone.r2))


def test_triples_leave_the_fraction_of_multiple_stars_as_it_is(heavy):
    known = {
        on: population_moments(p, integrate(p))
        for on, p in (
            (True, of(heavy)),
            (False, Population.of(heavy, multiplicity=DucheneKraus2013(), photometry=LIGHT)),
        )
    }
    assert known[True].binary_fraction[0] == pytest.approx(known[False].binary_fraction[0], rel=1e-12)
    assert known[True].mean_x[0] > known[False].mean_x[0]
    assert known[False].triples is None


def test_companions_are_as_many_as_the_table_says():
    mass = np.array([0.09, 0.3, 1.0])
    law = DucheneKraus2013(triples=True).companions(mass)
    each = np.bincount(law.star, law.share * law.multiplicity_fraction * (1 + law.is_triple))
    np.testing.assert_allclose(each, [0.22, 0.33, 0.62])
    np.testing.assert_allclose(np.bincount(law.star, law.share), 1.0)
    law = Offner2023(triples=True).companions(mass)
    triples = np.bincount(law.star, law.share * law.multiplicity_fraction * law.is_triple)
    np.testing.assert_allclose(triples, [0.022, 0.063, 0.12])


def test_the_error_of_the_quadrature_is_as_large_as_it_says(heavy, monkeypatch):
    population = of(heavy)
    coarse = triple_averages.triple_averages(population).sums(np.ones(1))
    triple_averages.triple_averages.cache_clear()
    monkeypatch.setattr(triple_averages, "_POINTS", 15)
    fine = triple_averages.triple_averages(population).sums(np.ones(1))
    triple_averages.triple_averages.cache_clear()
    xx, yy = INDICES.index((2, 0)), INDICES.index((0, 2))
    x = [found.mean[0, 0, xx] + found.mean[0, 0, yy] for found in (coarse, fine)]
    assert abs(x[0] - x[1]) < 5 * coarse.error[0, 0]
    assert fine.error[0, 0] < coarse.error[0, 0] < 3e-3 * x[0]


def test_a_pair_of_a_catalogue_is_no_triple():
    columns = {"mass": [0.5, 0.8, 0.9], "distance": [300.0] * 3, "magnitude": [18.5] * 3}
    law = of(Stars.from_columns(**columns, mass_ratio=[0.0, 0.7, np.nan])).law
    assert not np.any(law.is_triple[law.star < 2])
    assert np.any(law.is_triple[law.star == 2])
    np.testing.assert_allclose(np.bincount(law.star, law.share), 1.0)


def test_impossible_hierarchies_are_refused(heavy):
    with pytest.raises(
        ValueError, match=r"companion_frequency must be at least multiplicity_fraction = 0.4, got 0.3"
    ):
        triple_fraction(np.array([0.4]), np.array([0.3]))
    with pytest.raises(ValueError, match=r"share of triples must be in \[0, 1\], got 1.5"):
        with_triples(DucheneKraus2013().companions(np.array([1.0])), np.array([1.5]))
    alike = replace(MODELS["dk13"], scatter_scale=0.05)
    with pytest.raises(InputError, match=r"must be at least 0.2 dex for stable triples, got 0.0433"):
        Population.of(heavy, multiplicity=alike, photometry=LIGHT)


def test_what_knows_pairs_only_refuses_triples(heavy):
    with pytest.raises(InputError, match=r"multiplicity.triples: must be off where there is a selection"):
        of(heavy, selection=HardCut(separation=0.03))
    with pytest.raises(InputError, match=r"triples: must be off for clips of many thresholds"):
        count_pairs(of(heavy))
    with pytest.raises(InputError, match=r"triples: must be off for the colour of companions"):
        colour_bias(of(heavy), None, None)
    with pytest.raises(InputError, match="device: must be cpu for a run with triples"):
        draw_stacks(of(heavy), n_stars=4, binary_fraction=0.3, seed=1, first=0, last=1, device="cuda")
    with pytest.raises(InputError, match=r"multiplicity.triples: is no option of mds17"):
        Multiplicity(model="mds17", triples=True).build()


def test_triples_are_an_option_of_a_configuration():
    assert Multiplicity(triples=True).build() == MODELS["dk13"]
    assert not MULTIPLICITY["dk13"].triples
