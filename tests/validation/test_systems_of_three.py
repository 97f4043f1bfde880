"""Triple stars: the engine against the quadrature, and drawn systems of three sources against kernel moments."""

import numpy as np
import pytest

from porrima.config import PopulationConfig, parse
from porrima.images import measure_stack
from porrima.moments import INDICES
from porrima.prediction import integrate, population_moments, predict
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.sample import draw_stars, population_of
from porrima.shapes import Adaptive
from porrima.stack import draw_stacks
from porrima.systems import Systems
from statistics_helpers import assert_within_sigma

ENGINE = (
    "18 Triple stars: 18 to 19 mag at l = 180, b = 45, 1500 stars, 35 % multiple, triples on; stacks of 40 stars by "
    "the engine against the quadrature over hierarchies; pulls in standard errors, that of the quadrature included."
)
SHAPES = (
    "18b Shapes of stacks with triples: the same stacks, measured by adaptive moments, against the prediction for 40 "
    "stars; bias and standard deviation of R²/R0² and of e1; pulls in standard errors."
)
IMAGES = (
    "18c Systems of three sources against drawn images: each drawn with GalSim where its sources are and measured by "
    "its HSM, against shapes from kernel moments; largest difference of e1, e2 and R²/R0² over the size change."
)
FRACTION, N_STARS, N_STACKS = 0.35, 40, 200_000
MODELS = {
    "dk13": {"model": "dk13", "triples": True},
    "dk13-kcm16": {"model": "dk13-kcm16", "triples": True},
    "modern": {"model": "modern", "triples": True},
}


@pytest.fixture(scope="module", params=MODELS)
def triples(request):
    """Name, the closed form, and stacks that the engine has drawn."""
    stars = {"l": 180, "b": 45, "mag": [18, 19], "n_drawn": 1500}
    config = parse(PopulationConfig, {"stars": stars, "multiplicity": MODELS[request.param]})
    population = population_of(config, draw_stars(config))
    known = population_moments(population, integrate(population), np.array([FRACTION]))
    drawn = draw_stacks(
        population, n_stars=N_STARS, binary_fraction=FRACTION, seed=31, first=0, last=N_STACKS
    )
    return request.param, known, drawn.moments


def mean_and_error(values):
    return values.mean(), values.std() / np.sqrt(values.size)


def test_moments_of_drawn_stacks_are_those_of_the_quadrature(triples, record):
    name, known, moments = triples
    values, numerical = moments.values, known.relative_error[0]
    pulls = {}
    for a, b in ((2, 0), (1, 1), (0, 2), (4, 0), (2, 2)):
        k = INDICES.index((a, b))
        value, error = mean_and_error(values[:, k])
        error = np.hypot(error, numerical * abs(known.mean[0, k]))
        assert_within_sigma(value, known.mean[0, k], error)
        pulls[f"m{a}{b}"] = (value - known.mean[0, k]) / error
    size = values[:, INDICES.index((2, 0))] + values[:, INDICES.index((0, 2))]
    square = (size - known.mean_x[0]) ** 2 * N_STARS
    expected = known.mean_x2[0] - known.mean_x[0] ** 2
    value, error = mean_and_error(square)
    error = np.hypot(error, numerical * expected)
    assert_within_sigma(value, expected, error)
    columns = [
        "model",
        "mean x [arcsec²]",
        "error of it",
        "pulls of m20, m11, m02, m40, m22",
        "pull of var x",
    ]
    shown = " ".join(f"{pull:+.1f}" for pull in pulls.values())
    record(ENGINE, columns, [f"`{name}`", f"{known.mean_x[0]:.4e}", f"{numerical:.0e}", shown,
                             f"{(value - expected) / error:+.1f}"])  # fmt: skip


@pytest.mark.parametrize("psf", ["psf1", "optical1"])
def test_shapes_of_stacks_are_as_predicted_behind_gaussian_and_optical_psfs(triples, psf, record):
    name, known, moments = triples
    reply = response(psf_from_name(psf), Adaptive())
    expected, shapes, zero = predict(known, reply, N_STARS), reply.shapes(moments), reply.shape0
    numerical = known.relative_error[0]
    change = {"R²": (shapes.r2 / zero.r2 - 1, 2), "e1": (shapes.e1 - zero.e1, 0)}
    for quantity, (value, k) in change.items():
        bias, sd = expected.bias[k, 0], expected.sd[k, 0]
        mean, error = mean_and_error(value)
        error = np.hypot(error, numerical * abs(bias))
        assert_within_sigma(mean, bias, error)
        square, wrong = mean_and_error((value - value.mean()) ** 2)
        wrong = wrong / (2 * sd) + (numerical + 1e-3) * sd / 5  # two pairs of a stack: second order
        assert_within_sigma(np.sqrt(square), sd, wrong)
        columns = ["model", "PSF", "quantity", "bias", "pull", "scatter", "pull of it"]
        pulls = f"{(mean - bias) / error:+.1f}", f"{(np.sqrt(square) - sd) / wrong:+.1f}"
        record(SHAPES, columns, [f"`{name}`", psf, quantity, f"{bias:.3e}", pulls[0], f"{sd:.3e}", pulls[1]])


@pytest.mark.parametrize("reach", [0.02, 0.05])
@pytest.mark.parametrize("psf", ["psf1", "optical1"])
def test_systems_of_three_sources_have_the_shapes_of_their_images(psf, reach, record):
    rng, profile = np.random.Generator(np.random.Philox(13)), psf_from_name(psf)
    reply, alone, worst = response(profile, Adaptive()), Adaptive().measure(profile.draw()), 0.0
    n = 12
    for _ in range(n):
        flux_ratio = rng.uniform(0.05, 1.0, (1, 2))
        radius, angle = reach * np.sqrt(rng.uniform(0.2, 1.0, (1, 2))), 2 * np.pi * rng.random((1, 2))
        one = Systems.from_companions(flux_ratio, radius * np.cos(angle), radius * np.sin(angle))
        assert one.flux.shape == (1, 3)
        drawn, known = measure_stack(profile, one, Adaptive()), reply.shapes(one.kernel_moments())
        change = [
            [
                float(np.squeeze(s.e1 - z.e1)),
                float(np.squeeze(s.e2 - z.e2)),
                float(np.squeeze(s.r2 / z.r2 - 1)),
            ]
            for s, z in ((drawn, alone), (known, reply.shape0))
        ]
        worst = max(worst, np.abs(np.subtract(*change)).max() / change[0][2])
    record(IMAGES, ["PSF", "companions within [arcsec]", "systems", "largest difference"],
           [psf, reach, n, f"{worst:.1e}"])  # fmt: skip
    assert worst < 2e-3
