"""Many thresholds at once: what clips leave, from pairs counted on cells, is what each leaves by itself."""

from dataclasses import replace

import numpy as np
import pytest

from hard_cut import HardCut
from porrima.clip import Clip, Noise
from porrima.clipping import clip_curve, count_pairs
from porrima.errors import InputError
from porrima.multiplicity import MULTIPLICITY
from porrima.photometry import PHOTOMETRY
from porrima.prediction import integrate, population_moments
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.shapes import Adaptive, Plain
from porrima.systems import Population

THRESHOLDS = np.array([0.004, 0.012, 0.05, np.inf])
SHARES = ("unresolved", "removed", "rejected", "false_rejection")


@pytest.fixture(scope="module")
def adaptive():
    return response(psf_from_name("psf0"), Adaptive())


@pytest.fixture(scope="module", params=["dk13", "modern"])
def some(request, stars):
    """Stars with one class of companions each, and with several."""
    models = {"multiplicity": MULTIPLICITY[request.param], "photometry": PHOTOMETRY["main-sequence"]}
    return Population.of(stars.take(np.arange(60)), **models)


def moments(population, selection, fraction=0.35):
    chosen = replace(population, selection=selection)
    return population_moments(chosen, integrate(chosen), None if fraction is None else np.array([fraction]))


@pytest.mark.parametrize(
    ("quantity", "noise"),
    [("r2", None), ("r2", Noise(magnitude=(18.0, 19.0), sigma=(0.002, 0.005))), ("e", Noise(sigma=(0.003,)))],
)
def test_many_thresholds_at_once_are_as_good_as_one_at_a_time(adaptive, some, quantity, noise):
    curve = clip_curve(count_pairs(some, 0.35), adaptive, THRESHOLDS, quantity, noise)
    for k, t in enumerate(THRESHOLDS):
        clip = (
            Clip(response=adaptive, threshold=t, quantity=quantity, noise=noise or Noise()) if t < 1 else None
        )
        expected = moments(some, clip)
        for name, tolerance in (("mean_x", 1e-3), ("mean_x2", 3e-3)):
            assert getattr(curve, name)[k] == pytest.approx(getattr(expected, name)[0], rel=tolerance)
        for name in SHARES:
            value = getattr(expected, f"{name}_fraction")[0]
            assert getattr(curve, f"{name}_fraction")[k] == pytest.approx(value, abs=3e-5)


def test_a_threshold_that_rises_to_infinity_ends_as_no_clip(some):
    """Plain sizes grow by x alone, at most cut²/4: from there on no pair is clipped."""
    plain = response(psf_from_name("psf0"), Plain())
    largest = some.cut**2 / 4 / float(plain.shape0.r2)
    curve = clip_curve(count_pairs(some), plain, np.array([0.5, 0.9, 1.01, np.inf]) * largest)
    assert np.all(np.diff(curve.mean_x[:3]) > 0)
    assert curve.mean_x[2] == pytest.approx(curve.mean_x[3], rel=1e-12)
    assert curve.rejected_fraction[2:] == pytest.approx(0, abs=1e-12)
    expected = moments(some, None, fraction=None)
    assert curve.mean_x[3] == pytest.approx(expected.mean_x[0], rel=1e-6)
    assert curve.mean_x2[3] == pytest.approx(expected.mean_x2[0], rel=1e-6)
    assert curve.removed_fraction[3] == pytest.approx(expected.removed_fraction[0], abs=1e-9)


def test_all_stars_are_counted_once(some):
    counts = count_pairs(some, 0.35)
    assert counts.single.sum() + counts.pairs == pytest.approx(some.law.star.size)
    assert counts.powers[:, :, 0, :, 0].sum() == pytest.approx(counts.pairs - counts.resolved, rel=1e-9)


def test_many_thresholds_need_equal_weights_and_no_other_selection_or_triples(population, stars):
    with pytest.raises(InputError, match="stack_weight"):
        count_pairs(replace(population, weight=np.linspace(0.5, 1.5, 300)))
    with pytest.raises(InputError, match="selection"):
        count_pairs(replace(population, selection=HardCut(separation=0.03)))
    triples = replace(MULTIPLICITY["modern"], triples=True)
    with pytest.raises(InputError, match=r"multiplicity\.triples"):
        count_pairs(Population.of(stars, multiplicity=triples, photometry=PHOTOMETRY["main-sequence"]))
