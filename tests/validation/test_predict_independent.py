"""The closed form of `porrima predict` against companions drawn from scratch.

No code of the package runs here: the command answers from a process of its own, and the
physics (KCM16 Sect. 3 and 4; Duchene & Kraus 2013) is written again below with numpy alone.
Tolerances are five standard errors of the Monte Carlo, taken from the sample's own third and
fourth moments, since x is heavy-tailed.
"""

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from data_files import data_file
from statistics_helpers import assert_within_sigma

CUT = 0.05
SIGMA_PSF = 0.137 / (2 * np.sqrt(2 * np.log(2)))
PSF_ELLIPTICITY = {"psf0": (0.0, 0.0), "psf1": (0.054, -0.003)}
MODELS = ("dk13", "dk13-kcm16")
PHOTOMETRIES = ("main-sequence", "habets-heintze")
CHUNK = 250_000
ONE_STAR = (
    "4 The closed form for one star: 0.8 M_sun at 1000 pc, `porrima predict` / ten million pairs drawn in plain numpy "
    "by code that shares nothing with the package, with its standard error."
)
GM_SUN = 4 * np.pi**2  # au^3 / yr^2

# Duchene & Kraus (2013) as in Table 1: MF, gamma, mean a [au], sigma of log10 P
LATE, MIDDLE, SUNLIKE = (0.22, 4.2, 4.5, 0.5), (0.26, 0.4, 5.3, 1.3), (0.44, 0.3, 45.0, 2.3)

ONE = [{"mass": 0.8, "distance": 1000.0, "metallicity": 0.0, "log_age": 9.7}]
MIXED = [
    {"mass": 0.09, "distance": 150.0, "metallicity": 0.1, "log_age": 9.9},
    {"mass": 0.3, "distance": 400.0, "metallicity": -0.3, "log_age": 9.6},
    {"mass": 0.6, "distance": 900.0, "metallicity": -1.7, "log_age": 10.1},
    {"mass": 1.1, "distance": 2500.0, "metallicity": -0.2, "log_age": 9.3},
]


def psf_matrix(name):
    """R0^2 and (e1, e2) of a Gaussian sheared at constant area."""
    e1, e2 = PSF_ELLIPTICITY[name]
    return 2 * SIGMA_PSF**2 / np.sqrt(1 - e1**2 - e2**2), e1, e2


def statistics_of(mass, model):
    """MF, gamma, mean a, sigma_logP: gaps take the next lower bin (dk13) or solar values (kcm16)."""
    if mass < 0.1:
        return LATE
    if mass < (0.5 if model == "dk13-kcm16" else 0.7):
        return MIDDLE
    return SUNLIKE


def pair_probabilities(masses, model, fraction):
    """p_i = min(1, s MF_i), with s by bisection such that the mean of p_i is the wanted fraction."""
    mf = np.array([statistics_of(m, model)[0] for m in masses])
    if fraction is None:
        return mf
    low, high = 0.0, 1 / mf.min()
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.minimum(1, middle * mf).mean() < fraction else (low, middle)
    return np.minimum(1, high * mf)


def habets_heintze(mass):
    x = np.log10(mass)
    return np.where(x > 0.13, 4.00 - 6.41 * x, np.where(x > -0.62, 4.80 - 12.47 * x, 9.02 - 5.61 * x))


def main_sequence_track(metallicity, log_age):
    """log10 masses and magnitudes of one star's track: PARSEC, i band, on the union of its nodes."""
    path = data_file("main_sequence_photometry.ecsv")
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    names = lines[0].split()
    table = np.array([[float(word) for word in line.split()] for line in lines[1:]])
    mh, age, mass, light = (table[:, names.index(name)] for name in ("mh", "log_age", "mass", "i"))

    def track(z, t):
        here = (mh == z) & (age == t)
        m, v = mass[here], light[here]
        if m[0] > 0.095:
            solar = light[(mh == 0) & (age == t)]
            m, v = np.append(0.09, m), np.append(v[0] + solar[0] - solar[1], v)
        m, v = np.append(0.08, m), np.append(v[0] + 1.73, v)
        if m[-1] < 1.5:
            x = np.log10(m)
            end = v[-1] + (v[-1] - v[-2]) / (x[-1] - x[-2]) * (np.log10(1.5) - x[-1])
            m, v = np.append(m, 1.5), np.append(v, end)
        return np.log10(m), v

    def two_nodes(values, value):
        k = min(np.searchsorted(values, value, side="right") - 1, values.size - 2)
        weight = (value - values[k]) / (values[k + 1] - values[k])
        return ((k, 1 - weight), (k + 1, weight))

    zs, ts = np.unique(mh), np.unique(age)
    corners = [
        (wz * wt, *track(zs[j], ts[k]))
        for j, wz in two_nodes(zs, metallicity)
        for k, wt in two_nodes(10**ts, 10**log_age)
        if wz * wt > 0
    ]
    nodes = np.unique(np.concatenate([x for _, x, _ in corners]))
    return nodes, sum(weight * np.interp(nodes, x, v) for weight, x, v in corners)


def flux_ratio(star, q, photometry):
    mass = star["mass"]
    if photometry == "habets-heintze":
        return np.minimum(10 ** (-0.4 * (habets_heintze(q * mass) - habets_heintze(mass))), 1)
    nodes, magnitude = star["track"]
    difference = np.interp(np.log10(q * mass), nodes, magnitude) - np.interp(np.log10(mass), nodes, magnitude)
    return np.where(q * mass < 0.08, 0.0, np.minimum(10 ** (-0.4 * difference), 1))


def draw_pairs(rng, star, model, n):
    """Mass ratio and projected offset (2, n) [arcsec] of the companions of one star."""
    mass = star["mass"]
    _, gamma, mean_a, sigma_log_p = statistics_of(mass, model)
    low = 0.1 ** (gamma + 1)
    q = (low + rng.random(n) * (1 - low)) ** (1 / (gamma + 1))
    total = mass * (1 + q)
    mean_log_p = 0.5 * np.log10(4 * np.pi**2 * mean_a**3 / (GM_SUN * total))
    log_p = mean_log_p + sigma_log_p * rng.standard_normal(n)
    a = np.cbrt(total * 10 ** (2 * log_p))
    if model == "dk13-kcm16":
        while (wide := np.flatnonzero(a > 2.5 * mean_a)).size:
            log_p = mean_log_p[wide] + sigma_log_p * rng.standard_normal(wide.size)
            a[wide] = np.cbrt(total[wide] * 10 ** (2 * log_p))
    # a point of a circular orbit in its plane, turned by a random rotation (unit quaternion), seen along z
    phase = 2 * np.pi * rng.random(n)
    x, y = a * np.cos(phase), a * np.sin(phase)
    w, i, j, k = rng.standard_normal((4, n))
    norm = w * w + i * i + j * j + k * k
    dx = ((w * w + i * i - j * j - k * k) * x + 2 * (i * j - w * k) * y) / norm
    dy = (2 * (i * j + w * k) * x + (w * w - i * i + j * j - k * k) * y) / norm
    return q, np.stack([dx, dy]) / star["distance"]


def with_tracks(stars):
    return [{**s, "track": main_sequence_track(s["metallicity"], s["log_age"])} for s in stars]


def in_chunks(work, n, seed):
    """Sum of work(generator, size) over chunks, two at a time; same numbers for any order."""
    seeds = np.random.SeedSequence(seed).spawn(n // CHUNK)
    with ThreadPoolExecutor(2) as pool:
        parts = pool.map(lambda s: work(np.random.Generator(np.random.PCG64(s)), CHUNK), seeds)
        return sum(parts)


def powers(x):
    return np.array([x.size, x.sum(), *(np.sum(x**k) for k in (2, 3, 4))])


def closed_forms(y, psf, n_stars=40):
    """What `predict` answers, from y = mean x, mean x^2 of the stars of the stack.

    The first-order closed form with e = (e_0 + D)/(1 + X) expanded about the mean stack, X = eta, instead of
    about the PSF: the same to first order, without its error of relative size eta (0.4 % of bias
    and sd where all stars are double), and with the term of a finite stack in the mean of 1/(1 + X).
    """
    r0, e1, e2 = psf_matrix(psf)
    eta, variance = y[0] / r0, (y[1] - y[0] ** 2) / n_stars / r0**2
    out = {"mean_x": y[0], "mean_x2": y[1], "eta": eta, "bias_r2": eta, "sd_r2": np.sqrt(variance)}
    out["sigma_r2"] = np.hypot(out["sd_r2"], eta)
    for name, e in (("e1", e1), ("e2", e2)):
        out[f"bias_{name}"] = -e * (eta / (1 + eta) - variance / (1 + eta) ** 3)
        turned = y[1] / 2 / n_stars / r0**2
        out[f"sd_{name}"] = np.sqrt(turned + (e / (1 + eta)) ** 2 * variance) / (1 + eta)
        out[f"sigma_{name}"] = np.hypot(out[f"sd_{name}"], out[f"bias_{name}"])
    return out


def with_errors(function, y, covariance):
    """Values of a function of sample means, each with its standard error (delta method)."""
    values = function(y)
    errors = dict.fromkeys(values, 0.0)
    gradient = {name: np.zeros(y.size) for name in values}
    for k in range(y.size):
        step = np.zeros(y.size)
        step[k] = 1e-4 * abs(y[k])
        up, down = function(y + step), function(y - step)
        for name in values:
            gradient[name][k] = (up[name] - down[name]) / (2 * step[k])
    for name, g in gradient.items():
        errors[name] = np.sqrt(g @ covariance @ g)
    return values, errors


def check(answer, values, errors):
    """Every key within five standard errors; what has none (exact zeros) is zero."""
    for name, value in values.items():
        if errors[name] == 0:
            assert abs(answer[name] - value) < 1e-12, name
        else:
            assert_within_sigma(answer[name], value, errors[name])


# --- the command ------------------------------------------------------------------------------

DRIVER = """
import json, sys
from porrima.cli import main
for arguments in json.load(sys.stdin):
    sys.argv = ["porrima", *arguments]
    try:
        main()
    except SystemExit as end:
        if end.code:
            raise
"""


def arguments_of(table, psf, model, photometry, fraction, n_stars):
    words = ["predict", "--stars", str(table), "--mag", "18", "19", "--psf", psf, "--estimator", "plain"]
    words += ["--multiplicity", model, "--photometry", photometry, "--json"]
    words += [] if fraction is None else ["--binary-fraction", str(fraction)]
    return words + ([] if n_stars is None else ["--n-stars", str(n_stars)])


def write_table(path, stars, columns):
    header = ["# %ECSV 1.0", "# ---", "# datatype:"]
    header += [f"# - {{name: {name}, datatype: float64}}" for name in columns]
    rows = [" ".join(str(star.get(name, 18.5)) for name in columns) for star in stars]
    path.write_text("\n".join([*header, " ".join(columns), *rows]) + "\n")
    return path


ONE_CASES = [
    ("one", psf, model, photometry, fraction, 40)
    for psf in PSF_ELLIPTICITY
    for model in MODELS
    for photometry in PHOTOMETRIES
    for fraction in (None, 0.35, 1.0)
]
MIXED_CASES = [
    ("mixed", "psf1", model, photometry, fraction, 40)
    for model in MODELS
    for photometry in PHOTOMETRIES
    for fraction in (0.5, 0.95)
]
STACK_CASES = [("one", psf, "dk13", "main-sequence", 0.35, n) for psf in PSF_ELLIPTICITY for n in (5, None)]


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    needed = ["mass", "distance", "magnitude"]
    return {
        "one": write_table(folder / "one.ecsv", ONE, needed),
        "mixed": write_table(folder / "mixed.ecsv", MIXED, [*needed, "metallicity", "log_age"]),
    }


@pytest.fixture(scope="module")
def predicted(tables):
    """The command's answers to all cases, from one process (starting it anew costs two seconds each)."""
    cases = [*ONE_CASES, *MIXED_CASES, *STACK_CASES]
    questions = json.dumps([arguments_of(tables[c[0]], *c[1:]) for c in cases])
    done = subprocess.run(
        [sys.executable, "-c", DRIVER], input=questions, capture_output=True, text=True, check=True
    )
    return dict(zip(cases, (json.loads(line) for line in done.stdout.splitlines()), strict=True))


def test_the_installed_command_gives_one_json_object(tables, predicted):
    case = ("one", "psf1", "dk13", "main-sequence", 0.35, 40)
    command = [Path(sys.executable).with_name("porrima"), *arguments_of(tables["one"], *case[1:])]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    answer = json.loads(done.stdout)
    assert answer == predicted[case]
    assert answer["n_stars"] == 40
    assert answer["binary_fraction"] == 0.35


# --- one star ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def one_star():
    """Moments of (x, x^2, resolved) of ten million pairs of one star: means and their covariance."""
    (star,) = with_tracks(ONE)

    def work(model, rng, n):
        q, offset = draw_pairs(rng, star, model, n)
        r2 = np.sum(offset**2, axis=0)
        kept = r2 < CUT**2
        sums = []
        for photometry in PHOTOMETRIES:
            f = flux_ratio(star, q[kept], photometry)
            sums.append(np.append(powers(f * r2[kept] / (1 + f) ** 2), n))
        return np.array(sums)

    out = {}
    for seed, model in enumerate(MODELS):
        sums = in_chunks(lambda rng, n, model=model: work(model, rng, n), 10_000_000, 7100 + seed)
        for photometry, (n_kept, s1, s2, s3, s4, n) in zip(PHOTOMETRIES, sums, strict=True):
            y = np.array([s1, s2, n - n_kept]) / n
            second = np.array([[s2, s3, 0], [s3, s4, 0], [0, 0, n - n_kept]]) / n
            out[model, photometry] = y, (second - np.outer(y, y)) / n
    return out


def of_one_star(y, p, psf):
    """Closed forms of a population of one star from E[x], E[x^2] and P_res of its pairs."""
    survivors = 1 - p * y[2]
    out = closed_forms(p * y[:2] / survivors, psf)
    return out | {"removed_fraction": y[2], "unresolved_fraction": p * (1 - y[2]) / survivors}


@pytest.mark.parametrize("case", ONE_CASES, ids=str)
def test_one_star_agrees_with_ten_million_drawn_pairs(case, one_star, predicted, record):
    _, psf, model, photometry, fraction, _ = case
    p = 0.44 if fraction is None else fraction
    values, errors = with_errors(lambda y: of_one_star(y, p, psf), *one_star[model, photometry])
    assert errors["mean_x"] < 0.003 * values["mean_x"]
    check(predicted[case], values, errors)
    if psf == "psf0":
        shown = [
            f"{predicted[case][name]:.4e} / {values[name]:.4e} ± {errors[name]:.0e}"
            for name in ("mean_x", "mean_x2", "removed_fraction")
        ]
        columns = [
            "multiplicity",
            "photometry",
            "binary fraction",
            "mean x [arcsec²]",
            "mean x² [arcsec⁴]",
            "removed",
        ]
        record(ONE_STAR, columns, [model, photometry, "model" if fraction is None else fraction, *shown])


# --- four stars -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mixed_stars():
    """Ten million candidates of the mixed table, singles and resolved pairs included, per model."""
    stars = with_tracks(MIXED)
    masses = [s["mass"] for s in stars]

    def work(model, rng, n):
        sums = np.zeros((2, 2, 7))
        for index, star in enumerate(stars):
            q, offset = draw_pairs(rng, star, model, n // 4)
            r2 = np.sum(offset**2, axis=0)
            chance = rng.random(n // 4)
            fs = [flux_ratio(star, q, photometry) for photometry in PHOTOMETRIES]
            for a, fraction in enumerate((0.5, 0.95)):
                pair = chance < pair_probabilities(masses, model, fraction)[index]
                unresolved = pair & (r2 < CUT**2)
                n_single = np.sum(~pair)
                for b, f in enumerate(fs):
                    x = f[unresolved] * r2[unresolved] / (1 + f[unresolved]) ** 2
                    sums[a, b] += [n_single + x.size, *powers(x)[1:], x.size, np.sum(pair)]
        return sums

    return {
        model: in_chunks(lambda rng, n, model=model: work(model, rng, n), 10_000_000, 7200 + seed)
        for seed, model in enumerate(MODELS)
    }


def test_the_greatest_fraction_makes_some_star_always_double():
    for model, full in (("dk13", 1), ("dk13-kcm16", 2)):
        masses = [s["mass"] for s in MIXED]
        p = pair_probabilities(masses, model, 0.95)
        assert np.sum(p == 1) == full
        np.testing.assert_allclose(p.mean(), 0.95)
        assert np.all(pair_probabilities(masses, model, 0.5) < 1)


@pytest.mark.parametrize("case", MIXED_CASES, ids=str)
def test_a_mixed_table_agrees_with_drawn_stars(case, mixed_stars, predicted):
    _, psf, model, photometry, fraction, _ = case
    sums = mixed_stars[model][(0.5, 0.95).index(fraction), PHOTOMETRIES.index(photometry)]
    n, s1, s2, s3, s4, n_unresolved, n_pair = sums
    y = np.array([s1, s2]) / n
    covariance = (np.array([[s2, s3], [s3, s4]]) / n - np.outer(y, y)) / n
    answer = predicted[case]
    check(answer, *with_errors(lambda y: closed_forms(y, psf), y, covariance))
    removed, unresolved = 1 - n_unresolved / n_pair, n_unresolved / n
    assert_within_sigma(answer["removed_fraction"], removed, np.sqrt(removed * (1 - removed) / n_pair))
    assert_within_sigma(answer["unresolved_fraction"], unresolved, np.sqrt(unresolved * (1 - unresolved) / n))


# --- stacks -----------------------------------------------------------------------------------


def drawn_stacks(n_stacks, n_stars, seed):
    """Mean second moments (qxx, qyy, qxy) of the companions of stacks of one star's kind, F = 0.35."""
    (star,) = with_tracks(ONE)
    rng = np.random.Generator(np.random.PCG64(seed))
    wanted, rows = n_stacks * n_stars, []
    while wanted > 0:
        q, offset = draw_pairs(rng, star, "dk13", CHUNK)
        pair = rng.random(CHUNK) < 0.35
        f = np.where(pair, flux_ratio(star, q, "main-sequence"), 0)
        kept = np.flatnonzero(~(pair & (np.sum(offset**2, axis=0) >= CUT**2)))[:wanted]
        (dx, dy), f = offset[:, kept], f[kept]
        rows.append(f / (1 + f) ** 2 * np.stack([dx * dx, dy * dy, dx * dy]))
        wanted -= kept.size
    return np.concatenate(rows, axis=1).reshape(3, n_stacks, n_stars).mean(axis=2)


def shapes(psf, companions):
    """(R^2, e1, e2) of stacks, exact for plain moments."""
    r0, e1, e2 = psf_matrix(psf)
    xx, yy, xy = np.array([[1 + e1], [1 - e1], [e2]]) * r0 / 2 + companions
    return np.stack([xx + yy, (xx - yy) / (xx + yy), 2 * xy / (xx + yy)])


def scatter_about(values, centre, dof):
    """Root mean square about a centre, and its standard error from the fourth moment."""
    square = (values - centre) ** 2
    rms = np.sqrt(square.sum() / (values.size - dof))
    return rms, np.std(square) / np.sqrt(values.size) / (2 * rms)


N_STACKS = 20_000


@pytest.fixture(scope="module")
def stacks():
    return {n: drawn_stacks(N_STACKS, n, 7300 + n) for n in (5, 40)} | {
        1: drawn_stacks(20 * N_STACKS, 1, 7301)
    }


@pytest.mark.parametrize("psf", PSF_ELLIPTICITY)
@pytest.mark.parametrize("n_stars", [5, 40])
def test_stacks_scatter_as_predicted(psf, n_stars, stacks, predicted):
    answer = predicted["one", psf, "dk13", "main-sequence", 0.35, n_stars]
    for name, drawn, true in zip(
        ("r2", "e1", "e2"), shapes(psf, stacks[n_stars]), psf_matrix(psf), strict=True
    ):
        scale = true if name == "r2" else 1.0
        first_order = 0.009 * answer[f"sd_{name}"] if name != "r2" and n_stars == 5 else 0.0
        for key, centre in (("sd", drawn.mean()), ("sigma", true)):
            rms, error = scatter_about(drawn / scale, centre / scale, dof=1)
            assert_within_sigma(answer[f"{key}_{name}"] - first_order, rms, error)


@pytest.mark.parametrize("n_stars", [5, 40])
def test_the_first_order_scatter_of_ellipticity_is_slightly_too_large(n_stars, stacks):
    # with turned T = mean(x cos 2 theta) / R0^2 and e = T / (1 + X): var(e) = E[T^2 (1 - 2 X + ...)], whence
    # sd(first order) / sd(exact) - 1 = <x> / R0^2 + <x^3> / (<x^2> N R0^2): 1.1 % at 5, 0.2 % at 40 stars
    r0, *_ = psf_matrix("psf0")
    companions = stacks[n_stars]
    _, e1, e2 = shapes("psf0", companions)
    first = np.stack([companions[0] - companions[1], 2 * companions[2]]) / r0
    # one batch holds 1000 stacks: the ratio of the two variances, of the same stacks, in each
    first, exact = (
        np.mean(v.reshape(2, 20, -1) ** 2, axis=2).sum(axis=0) for v in (first, np.stack([e1, e2]))
    )
    excess = np.sqrt(first / exact) - 1
    x = (stacks[1][0] + stacks[1][1]) / r0
    expected = x.mean() + np.sum(x**3) / np.sum(x**2) / n_stars
    assert_within_sigma(excess.mean(), expected, np.hypot(excess.std() / np.sqrt(20), 0.02 * expected))
    assert excess.mean() < (0.012 if n_stars == 5 else 0.0025)


@pytest.mark.parametrize("n_stars", [5, 40])
def test_stacks_are_biased_as_predicted(n_stars, stacks, predicted):
    answer = predicted["one", "psf1", "dk13", "main-sequence", 0.35, n_stars]
    for name, drawn, true in zip(
        ("r2", "e1", "e2"), shapes("psf1", stacks[n_stars]), psf_matrix("psf1"), strict=True
    ):
        change = (drawn - true) / (true if name == "r2" else 1.0)
        assert_within_sigma(answer[f"bias_{name}"], change.mean(), change.std() / np.sqrt(N_STACKS))
