"""Simulated stacks against the closed form, on real stars and on the analytic Galaxy, bin by bin."""

import numpy as np
import pytest

from data_files import data_file
from porrima.config import RunConfig, parse
from porrima.moments import INDICES
from porrima.prediction import integrate, population_moments
from porrima.simulation import simulate
from porrima.store import open_run
from porrima.summary import predicted_curves, summarise

POPULATIONS = {
    "Besançon, b = 90°": lambda: {"catalog": data_file("catalogues/besancon_l200_b90.dat")},
    "Galaxy, l = 180°, b = 45°": lambda: {"l": 180, "b": 45},
}
STACKS = (
    "2 Simulation against prediction: 100 000 stacks of 40 stars, 18-19 mag in i, binary fraction uniform in 0-1, "
    "three PSFs, 20 bins of binary fraction: 180 numbers each of bias, sigma and sd.  Largest and rms pull."
)
EXPLAINED = (
    "3 Adaptive against plain moments: change of shape of the same stacks, mean over all binary fractions.  The "
    "response predicts the ratio from the kernel moments up to order 8: with order 2 alone it would be 1, and the "
    "missing per cents are the weight's dimmer view of wide pairs (order 4)."
)


def finished(tmp_path, population, estimator, model, n_stacks):
    stars = POPULATIONS[population]() | {"mag": [18, 19]}
    config = parse(
        RunConfig,
        {
            "stars": stars,
            "n_stacks": n_stacks,
            "estimator": estimator,
            "multiplicity": model,
            "seed": 20261122,
        },
    )
    simulate(config, tmp_path / f"{estimator}.zarr")
    return open_run(tmp_path / f"{estimator}.zarr")


@pytest.mark.parametrize("model", ["dk13", "dk13-kcm16"])
@pytest.mark.parametrize("population", POPULATIONS)
def test_every_bin_of_every_panel_agrees_with_the_closed_form(tmp_path, record, full_size, population, model):
    n_stacks = 100_000 if full_size else 25_000
    runs = {
        estimator: finished(tmp_path, population, estimator, model, n_stacks)
        for estimator in ("plain", "adaptive")
    }
    for estimator, run in runs.items():
        summary = summarise(run)
        pulls = {
            name: ((summary[name] - summary[f"prediction_{name}"]) / summary[f"{name}_se"]).to_numpy()
            for name in ("bias", "sigma", "sd")
        }
        columns = ["stars", "multiplicity", "estimator", *(f"{n}: largest, rms" for n in pulls)]
        shown = [f"{np.abs(p).max():.1f}, {np.sqrt(np.mean(p**2)):.2f}" for p in pulls.values()]
        record(STACKS, columns, [population, model, estimator, *shown])
        for name, pull in pulls.items():
            assert pull.size == 180
            assert np.abs(pull).max() < 5, (estimator, name)
        assert not np.any(summary["n_failed"])
    np.testing.assert_array_equal(runs["plain"].dataset["moments"], runs["adaptive"].dataset["moments"])
    check_moments(runs["plain"])
    explain(runs, record, population, model)


def check_moments(run):
    """The kernel moments themselves, every order, against quadrature at each stack's own binary fraction."""
    dataset, population = run.dataset, run.population
    grid = np.linspace(0, 1, 501)
    moments = population_moments(population, integrate(population), grid)
    fraction, drawn = dataset["binary_fraction"].to_numpy(), dataset["moments"].to_numpy()
    for k, index in enumerate(INDICES):
        difference = drawn[:, k] - np.interp(fraction, grid, moments.mean[:, k])
        assert abs(difference.mean()) < 5 * difference.std() / np.sqrt(difference.size), index


def explain(runs, record, population, model):
    """Adaptive over plain change of shape, measured on the same stacks and predicted by the response."""
    fraction = runs["plain"].dataset["binary_fraction"].to_numpy()
    curves = {
        e: predicted_curves(run.population, run.config, run.config.n_stars)["bias"] for e, run in runs.items()
    }
    for p, name in (("psf0", "r2"), ("psf1", "r2"), ("psf1", "e1"), ("psf2", "e2")):
        found = {e: (r.dataset[name] - r.dataset[f"{name}_0"]).sel(psf=p).to_numpy() for e, r in runs.items()}
        ratio = found["adaptive"].mean() / found["plain"].mean()
        deviation = found["adaptive"] - ratio * found["plain"]
        error = deviation.std() / np.sqrt(deviation.size) / abs(found["plain"].mean())
        mean = {
            e: np.interp(fraction, c["binary_fraction"], c.sel(psf=p, quantity=name)).mean()
            for e, c in curves.items()
        }
        expected = mean["adaptive"] / mean["plain"]
        columns = ["stars", "multiplicity", "PSF", "quantity", "adaptive / plain", "by the response"]
        record(
            EXPLAINED, columns, [population, model, p, name, f"{ratio:.4f} ± {error:.4f}", f"{expected:.4f}"]
        )
        assert (
            abs(ratio - expected) < 5 * error + 5e-4
        )  # third order in size changes of 3e-3 and their scatter
