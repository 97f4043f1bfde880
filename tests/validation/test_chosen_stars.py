"""A choice of stars from end to end: noisy images of stars and pairs drawn with GalSim, each measured with HSM, clipped
by its own size, and the images of those kept stacked and measured again.

Kernel moments, responses and noise covariances of Porrima are only in the expectation.
"""

from dataclasses import replace

import galsim
import numpy as np
import pytest

from porrima.choice import Plan, StarBin, stacked
from porrima.clipping import count_pairs
from porrima.config import PopulationConfig, parse
from porrima.exposure import EUCLID_VIS_WIDE
from porrima.instruments import KCM16
from porrima.own_sizes import own_sizes, sorting
from porrima.precision import covariance_at, measured_covariance
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.sample import draw_stars, population_of
from porrima.shapes import Adaptive
from porrima.stack import draw_systems
from statistics_helpers import assert_within_sigma

N_STACKS, N_STARS, SIDE = 100, 400, 33
PIXEL, MAGNITUDE, FRACTION = 0.04, 20.0, 0.7
EXPOSURE = replace(EUCLID_VIS_WIDE, pixel=PIXEL, n_exposures=1)
TABLE = (
    "17 Stars chosen by their own size, from end to end: 100 stacks of 400 stars of 20 mag behind `psf1` with a pixel "
    "of 0.04″, 70 % pairs, one exposure with the noise of Euclid's; drawn with GalSim, measured with HSM, clipped "
    "about the known PSF, stacked, measured again, against the closed form; R² relative; pulls in standard errors"
)


@pytest.fixture(scope="module")
def psf():
    return psf_from_name("psf1", pixel=PIXEL)


@pytest.fixture(scope="module")
def population():
    stars = {"l": 180, "b": 45, "mag": [19.5, 20.5], "n_drawn": 2000}
    config = parse(PopulationConfig, {"stars": stars})
    drawn = draw_stars(config)
    return population_of(config, replace(drawn, magnitude=np.full(len(drawn), MAGNITUDE)))


def hsm(image):
    found = galsim.hsm.FindAdaptiveMom(galsim.Image(image, scale=PIXEL), guess_sig=0.06 / PIXEL)
    shape = found.observed_shape
    return 2 * (found.moments_sigma * PIXEL) ** 2 / np.sqrt(1 - shape.e1**2 - shape.e2**2)


@pytest.fixture(scope="module")
def images(psf, population):
    """Images of all stars with noise, (stack, star, pixel, pixel), and the size measured on each."""
    rng = np.random.Generator(np.random.Philox(77))
    systems = draw_systems(population, n_stars=N_STACKS * N_STARS, binary_fraction=FRACTION, seed=9, stack=0)
    flux = float(EXPOSURE.electrons(MAGNITUDE))
    single = psf.profile.drawImage(nx=SIDE, ny=SIDE, scale=PIXEL, method="no_pixel", dtype=float).array
    out = np.empty((N_STACKS * N_STARS, SIDE, SIDE), dtype=np.float32)
    sizes = np.empty(len(out))
    for k in range(len(out)):
        clean = single
        if k < systems.flux.shape[0] and systems.flux[k, 1] > 0:
            sources = zip(systems.flux[k], systems.x[k], systems.y[k], strict=True)
            clean = sum(
                (psf.profile * f).shift(x, y)
                .drawImage(nx=SIDE, ny=SIDE, scale=PIXEL, method="no_pixel", dtype=float).array
                for f, x, y in sources
            )  # fmt: skip
        mean = flux * np.maximum(clean, 0.0)
        out[k] = (mean + np.sqrt(mean + EXPOSURE.background) * rng.standard_normal(mean.shape)) / flux
        sizes[k] = hsm(out[k].astype(float))
    order = rng.permutation(len(out))  # pairs come first
    shape = (N_STACKS, N_STARS)
    return out[order].reshape(*shape, SIDE, SIDE), sizes[order].reshape(shape)


@pytest.mark.parametrize("sides", ["both", "upper"])
@pytest.mark.parametrize("threshold", [0.008, 0.02])
def test_stacks_of_clipped_images_are_off_as_the_choice_says(
    psf, population, images, record, sides, threshold
):
    reply = response(psf, Adaptive())
    r2_0 = hsm(psf.profile.drawImage(nx=SIDE, ny=SIDE, scale=PIXEL, method="no_pixel", dtype=float).array)
    pictures, sizes = images
    own = sizes / r2_0 - 1
    kept = (own <= threshold) & ((own >= -threshold) | (sides == "upper"))
    found = np.array(
        [hsm(p[k].mean(axis=0, dtype=float)) / r2_0 - 1 for p, k in zip(pictures, kept, strict=True)]
    )

    noise = covariance_at(measured_covariance(psf, EXPOSURE, Adaptive()), np.array([MAGNITUDE]))
    edges = (MAGNITUDE - 0.1, MAGNITUDE + 0.1)
    pairs = own_sizes(count_pairs(population, FRACTION), sorting(reply, population.cut), edges)
    seen = N_STARS * pairs.total / pairs.number.sum()
    one = StarBin(magnitude=edges, per_deg2=seen, parts=(pairs,), covariance=noise[None])
    plan = Plan(
        requirement=KCM16,
        area=1.0,
        exposures=(1,),
        threshold=np.array([threshold]),
        sides=sides,
        centre="known",
    )
    theory = stacked([one], plan)
    expected = (
        theory.n_stars[0, 0, 0] / N_STARS,
        (theory.binaries + theory.clip)[0, 0, 0, 2],
        theory.sd[0, 0, 0, 2],
    )
    errors = (kept.mean(axis=1).std() / 10, found.std() / 10, found.std() / np.sqrt(2 * N_STACKS))
    values = (kept.mean(), found.mean(), found.std())
    pulls = [(v - e) / s for v, e, s in zip(values, expected, errors, strict=True)]
    record(
        TABLE,
        ["sides", "clip", "noise of a star", "kept", "bias", "of it by the clip", "standard deviation", "pulls"],
        [sides, threshold, f"{np.sqrt(noise[0, 2, 2]):.2e}", f"{expected[0]:.3f}", f"{expected[1]:.2e}",
         f"{theory.clip[0, 0, 0, 2]:.2e}", f"{expected[2]:.2e}", " ".join(f"{p:+.1f}" for p in pulls)],
    )  # fmt: skip
    for value, wanted, error in zip(values, expected, errors, strict=True):
        assert_within_sigma(value, wanted, error)
