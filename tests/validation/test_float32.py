"""The engine in float32 against a twin in float64: the same random words turned into pairs by numpy and scipy."""

import numpy as np
import pytest
from numba import njit
from scipy.special import ndtr, ndtri

from data_files import data_file
from porrima.config import PopulationConfig, parse
from porrima.moments import KernelMoments, moments_of_points
from porrima.photometry import flux_ratio
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.sample import draw_stars, population_of
from porrima.shapes import Adaptive
from porrima.stack import draw_stacks
from porrima.streams import binomial, philox

SAME = (
    "4d Float32 against float64: the same random words turned into pairs and moments by the engine and by numpy and "
    "scipy in float64; the largest difference of any bias, sigma and sd (size and ellipticity, adaptive, PSF1; bins "
    "of binary fraction where it is uniform), in its standard error, and the share of stacks with another set of pairs."
)
SEED = 20261125


@njit
def words_of(seed, first, n_stacks, n_pairs):
    """Words (n_stacks, n_pairs, 4) of the pairs of stacks; of stage 2, as the engine has it."""
    words = np.empty((n_stacks, n_pairs, 4), np.uint32)
    for s in range(n_stacks):
        for pair in range(n_pairs):
            a, b, c, d = philox(seed, 0, pair, 2, first + s, 0)
            words[s, pair, 0], words[s, pair, 1], words[s, pair, 2], words[s, pair, 3] = a, b, c, d
    return words


@njit
def kept_of(seed, first, n_stars, fraction, valid, resolved):
    """Which pairs of each stack are kept, by the rule of docs/how-it-works.md."""
    kept = np.zeros(valid.shape, np.bool_)
    for s in range(valid.shape[0]):
        wanted, draw = binomial(n_stars, fraction[s], seed, 0, 1, first + s, 0, 0)
        pair, again = 0, 0
        while wanted > 0:
            if valid[s, pair]:
                wanted -= 1
                kept[s, pair] = not resolved[s, pair]
                again += resolved[s, pair]
            pair += 1
            if wanted == 0 and again > 0:
                wanted, draw = binomial(again, fraction[s], seed, 0, 1, first + s, 0, draw)
                again = 0
    return kept


def alias_of(weight):
    """Alias table in float64, in plain Python (Vose 1991): the engine's own is built by other code in float32."""
    stay, alias = weight * (weight.size / weight.sum()), np.arange(weight.size)
    small = [k for k in range(weight.size) if stay[k] < 1]
    large = [k for k in range(weight.size) if stay[k] >= 1]
    while small and large:
        low, high = small.pop(), large[-1]
        alias[low] = high
        stay[high] -= 1 - stay[low]
        if stay[high] < 1:
            small.append(large.pop())
    return np.minimum(stay, 1.0), alias


def twin(population, n_stars, fraction, first):
    """Kernel moments of stacks in float64, and how many pairs of each are kept."""
    law, stars = population.law, population.stars
    n_pairs = 64 + int(1.5 * n_stars * fraction.max() + 8 * np.sqrt(n_stars))
    words = words_of(SEED, first, fraction.size, n_pairs)
    product = words[..., 0].astype(np.uint64) * np.uint64(len(stars))
    star, stay_word = (product >> np.uint64(32)).astype(int), (product & np.uint64(0xFFFFFFFF)).astype(float)
    stay, alias = alias_of(law.multiplicity_fraction)
    star = np.where((np.floor(stay_word / 2**9) + 0.5) / 2**23 < stay[star], star, alias[star])
    spare = ((words[..., 1] & 0xFF) << 8) | (words[..., 2] & 0xFF)
    scale = population.scale(fraction)[:, None]
    valid = (spare + 0.5) / 2**16 * scale * law.multiplicity_fraction[star] < 1
    u = (words[..., 1] // 2**9 + 0.5) / 2**23
    g = law.mass_ratio_exponent[star] + 1
    start = law.mass_ratio_min[star] ** g
    q = (start + u * (1 - start)) ** (1 / g)
    uniform = (words[..., 2].astype(np.int32) // 2**8 + 0.5) / 2**23
    cumulative = 0.5 * (uniform + 1) * ndtr((law.log_a_max - law.log_a) / law.log_a_sigma)[star]
    log_a = law.log_a[star] + law.log_a_sigma[star] * ndtri(cumulative)
    mu = (words[..., 3] // 2**16 + 0.5) / 2**16
    r = 10**log_a / stars.distance[star] * np.sqrt(1 - mu**2)
    angle = 2 * np.pi * ((words[..., 3] & 0xFFFF) + 0.5) / 2**16 - np.pi
    kept = kept_of(SEED, first, n_stars, fraction, valid, r >= population.cut)
    sums = np.empty((fraction.size, 42))
    for s in range(fraction.size):
        k = star[s][kept[s]]
        tracks = type(population.tracks)(
            log_mass_min=population.tracks.log_mass_min,
            magnitude=population.tracks.magnitude,
            dark_below=population.tracks.dark_below,
            index=population.tracks.index[k],
            weight=population.tracks.weight[k],
        )
        f = flux_ratio(tracks, stars.mass[k], q[s][kept[s], None])
        share = np.hstack([1 / (1 + f), f / (1 + f)])
        distance = np.hstack([-f / (1 + f), 1 / (1 + f)]) * r[s][kept[s], None]
        x, y = (distance * turn(angle[s][kept[s], None]) for turn in (np.cos, np.sin))
        sums[s] = moments_of_points(share, x, y).sum(axis=0) / n_stars
    return sums, kept.sum(axis=1)


def statistics(change):
    """Bias, sigma and sd of the changes of a bin, and their standard errors (docs/how-it-works.md)."""
    n, bias, sd = change.size, change.mean(), change.std(ddof=1)
    sigma, fourth = np.sqrt((change**2).sum() / (n - 1)), ((change - bias) ** 4).mean()
    return {
        "bias": (bias, sd / np.sqrt(n)),
        "sigma": (sigma, (change**2).std() / np.sqrt(n) / (2 * sigma)),
        "sd": (sd, np.sqrt((fourth - sd**4 * (n - 3) / (n - 1)) / n) / (2 * sd)),
    }


@pytest.mark.parametrize(("n_stars", "fractions", "n_stacks"), [(40, "uniform", 20_000), (10_000, 0.35, 150)])
def test_no_reported_figure_feels_float32(record, full_size, n_stars, fractions, n_stacks):
    n_stacks = n_stacks if full_size else n_stacks // 3 // 50 * 50
    catalogue = {"catalog": data_file("catalogues/besancon_l200_b90.dat"), "mag": [18, 19]}
    config = parse(PopulationConfig, {"stars": catalogue})
    population = population_of(config, draw_stars(config))
    run = {"n_stars": n_stars, "binary_fraction": fractions, "seed": SEED}
    drawn = draw_stacks(population, first=0, last=n_stacks, **run)
    parts = [
        twin(population, n_stars, drawn.binary_fraction[first : first + 50], first)
        for first in range(0, n_stacks, 50)
    ]
    moments = np.concatenate([part[0] for part in parts])
    reply = response(psf_from_name("psf1"), Adaptive())
    shapes = [reply.shapes(KernelMoments(values=v, n_stars=n_stars)) for v in (drawn.moments.values, moments)]
    bins = np.minimum((drawn.binary_fraction * 20).astype(int), 19)
    worst = 0.0
    for name in ("e1", "e2", "r2"):
        unit = float(reply.shape0.r2) if name == "r2" else 1.0
        one, two = ((getattr(s, name) - getattr(reply.shape0, name)) / unit for s in shapes)
        for k in np.unique(bins):
            a, b = (statistics(values[bins == k]) for values in (one, two))
            worst = max(worst, *(abs(a[q][0] - b[q][0]) / b[q][1] for q in a))
    far = np.abs(drawn.moments.values[:, 0] / np.where(moments[:, 0] > 0, moments[:, 0], 1) - 1) > 1e-3
    other = float(np.mean(far & (moments[:, 0] > 0)))
    record(
        SAME,
        [
            "stars in a stack",
            "binary fraction",
            "stacks",
            "largest difference [standard errors]",
            "other pairs",
        ],
        [n_stars, str(fractions), n_stacks, f"{worst:.1e}", f"{other:.1e}"],
    )
    assert worst < 1e-3
    assert other < 1e-3
