"""Stars rejected by their own shape: closed form and engine against stars drawn one by one, measured and clipped.

The stars are stacks of one star that the engine draws without a selection.  Each one's shape is solved exactly,
Gaussian noise is added in numpy and the clip made there: nothing is shared with the grid that a selection stands on.
"""

from dataclasses import replace

import numpy as np
import pytest

from porrima.clip import Clip, Noise
from porrima.config import PopulationConfig, parse
from porrima.prediction import integrate, population_moments
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.sample import draw_stars, population_of
from porrima.shapes import Adaptive
from porrima.stack import draw_stacks
from statistics_helpers import assert_within_sigma

FRACTION = 0.35
AT_ONCE = 500_000  # stacks
STARS = "16 Stars rejected by their own shape: {}."
CLIPPED = STARS.format(
    "18 to 19 mag, 35 % pairs, `psf0`, adaptive; ten million stars drawn, measured and clipped one by one against the "
    "closed form, for thresholds of size (`r2`) or of the ellipticity (`e`) and noise sigma at all magnitudes; "
    "pulls in standard errors"
)
FACTS = "16b What rejection does without noise: 18 to 19 mag, 35 % pairs, `psf0`, 20 000 stars at l = 180, b = 45."


def population(model, n_drawn=5000):
    stars = {"l": 180, "b": 45, "mag": [18, 19], "n_drawn": n_drawn}
    config = parse(PopulationConfig, {"stars": stars, "multiplicity": model})
    return population_of(config, draw_stars(config))


@pytest.fixture(scope="module")
def reply():
    return response(psf_from_name("psf0"), Adaptive())


def predicted(stars, selection):
    chosen = replace(stars, selection=selection)
    return population_moments(chosen, integrate(chosen), np.array([FRACTION]))


def mean_and_error(values):
    return values.mean(), values.std() / np.sqrt(values.size)


@pytest.fixture(scope="module")
def single_stars(reply, full_size):
    """x [arcsec²] and change of shape of single stars, most of them without a companion."""
    stars, n = population("dk13"), 10_000_000 if full_size else 2_500_000
    x, change = [], []
    for first in range(0, n, AT_ONCE):
        moments = draw_stacks(
            stars, n_stars=1, binary_fraction=FRACTION, seed=11, first=first, last=first + AT_ONCE
        ).moments
        some = moments.values[:, 0] + moments.values[:, 2]
        shape, zero = reply.shapes(moments), reply.shape0
        change.append([shape.e1 - zero.e1, shape.e2 - zero.e2, shape.r2 / zero.r2 - 1])
        x.append(some)
    return stars, np.concatenate(x), np.concatenate(change, axis=1)


@pytest.mark.parametrize(
    ("quantity", "threshold", "sigma"),
    [
        ("r2", 0.016, 0.0),
        ("r2", 0.008, 0.0),
        ("r2", 0.016, 0.004),
        ("r2", 0.008, 0.004),
        ("r2", 0.008, 0.0004),
        ("e", 0.008, 0.0),
        ("e", 0.008, 0.003),
    ],
)
def test_what_a_clip_keeps_is_what_is_left_of_stars_clipped_one_by_one(
    reply, single_stars, record, quantity, threshold, sigma
):
    stars, x, change = single_stars
    rng = np.random.Generator(np.random.Philox(5))
    noisy = change + sigma * rng.standard_normal(change.shape)
    kept = (noisy[2] if quantity == "r2" else np.hypot(noisy[0], noisy[1])) <= threshold
    clip = Clip(response=reply, threshold=threshold, quantity=quantity, noise=Noise(sigma=(sigma,)))
    theory = predicted(stars, clip)
    pulls, shown = [], []
    pairs = x > 0
    for value, expected in (
        (mean_and_error(x[kept]), theory.mean_x[0]),
        (mean_and_error(x[kept] ** 2), theory.mean_x2[0]),
        (mean_and_error(~kept), theory.rejected_fraction[0]),
    ):
        assert_within_sigma(value[0], expected, value[1])
        pulls.append(f"{(value[0] - expected) / value[1]:+.1f}")
        shown.append(f"{expected:.3e}")
    if theory.false_rejection_fraction[0] > 1e-6:  # dark companions, whose x is 0, are as good as none
        wrong = mean_and_error(~kept[~pairs])
        assert_within_sigma(wrong[0], theory.false_rejection_fraction[0], wrong[1])
    record(
        CLIPPED,
        ["clip", "sigma", "mean x [arcsec²]", "mean x²", "rejected", "false", "pulls"],
        [f"{quantity} > {threshold}", sigma, *shown, f"{theory.false_rejection_fraction[0]:.2e}", " ".join(pulls)],
    )  # fmt: skip


@pytest.mark.parametrize("name", ["psf1", "optical1"])
def test_position_angle_can_be_averaged_behind_a_psf_that_is_not_round(single_stars, name, record):
    stars, x, _ = single_stars
    reply = response(psf_from_name(name), Adaptive())
    moments = draw_stacks(stars, n_stars=1, binary_fraction=FRACTION, seed=11, first=0, last=AT_ONCE).moments
    shape, zero = reply.shapes(moments), reply.shape0
    kept = shape.r2 / zero.r2 - 1 <= 0.008
    theory = predicted(stars, Clip(response=reply, threshold=0.008))
    some = x[: kept.size]
    for found, expected in ((some[kept], theory.mean_x[0]), (~kept, theory.rejected_fraction[0])):
        value, error = mean_and_error(found)
        assert_within_sigma(value, expected, error)
    left = moments.values[kept]
    along, error = mean_and_error(left[:, 0] - left[:, 2])  # what the average over position angle leaves out
    assert abs(along) < 0.01 * some[kept].mean() + 5 * error


@pytest.mark.parametrize(
    ("quantity", "threshold", "sigma"), [("r2", 0.016, 0.0), ("r2", 0.008, 0.004), ("e", 0.008, 0.003)]
)
def test_the_engine_with_a_clip_agrees_with_the_closed_form(reply, full_size, quantity, threshold, sigma):
    clip = Clip(response=reply, threshold=threshold, quantity=quantity, noise=Noise(sigma=(sigma,)))
    stars = replace(population("dk13"), selection=clip)
    last = 200_000 if full_size else 50_000
    drawn = draw_stacks(stars, n_stars=1000, binary_fraction=FRACTION, seed=3, first=0, last=last)
    theory, values = predicted(stars, clip), drawn.moments.values
    for column in (0, 2, 7, 11):
        value, error = mean_and_error(values[:, column])
        assert_within_sigma(value, theory.mean[0, column], error)
    expected = theory.covariance[0, 0, 0]
    squares = (values[:, 0] - theory.mean[0, 0]) ** 2 * 1000
    value, error = mean_and_error(squares)
    assert_within_sigma(value, expected, error)


@pytest.mark.parametrize("model", ["dk13", "dk13-kcm16"])
def test_the_known_figures_of_rejection_without_noise(reply, record, model):
    stars = population(model, 20_000)
    eta = {}
    for threshold in (None, 0.016, 0.008):
        theory = predicted(stars, None if threshold is None else Clip(response=reply, threshold=threshold))
        eta[threshold] = theory.mean_x[0] / float(reply.shape0.r2)
        record(
            FACTS,
            ["model", "rejected above", "share of stars", "eta", "quadrature error"],
            [f"`{model}`", "none" if threshold is None else f"{threshold:.1%}",
             f"{theory.rejected_fraction[0]:.2%}", f"{eta[threshold]:.2e}", f"{theory.relative_error[0]:.0e}"],
        )  # fmt: skip
        if model == "dk13" and threshold is not None:
            share, known = {0.016: (0.020, 3.4e-4), 0.008: (0.033, 1.9e-4)}[threshold]
            assert theory.rejected_fraction[0] == pytest.approx(share, rel=0.05)
            assert eta[threshold] == pytest.approx(known, rel=0.06)
    assert eta[0.008] < eta[0.016] < eta[None]
