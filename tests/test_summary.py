from dataclasses import replace

import numpy as np
import pytest

from porrima.config import RunConfig, parse
from porrima.simulation import simulate
from porrima.store import open_run
from porrima.summary import STATISTICS, predicted_curves, rows, statistics, summarise
from porrima.tallies import changes, tally
from statistics_helpers import assert_within_sigma


def config(**changes):
    base = {
        "stars": {"l": 180, "b": 45, "mag": [18, 19], "n_drawn": 300},
        "n_stacks": 20_000,
        "psf": ["psf0", "psf1"],
    }
    return parse(RunConfig, base | changes)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("summary") / "run.zarr"
    simulate(config(estimator="plain"), path)
    return open_run(path)


def statistics_of(values):
    """Of the last axis of (..., 3, n) values, as of stacks in one range."""
    found = statistics(tally(np.full(values.shape[-1], 0.5), values, bins=1))
    return {name: value[..., 0] for name, value in found.items()}


def test_statistics_of_known_numbers():
    found = statistics_of(np.tile([1.0, 2.0, 3.0, 6.0], (1, 3, 1)))
    assert np.all(found["bias"] == 3.0)
    assert found["sd"][0, 0] == pytest.approx(np.sqrt(14 / 3))
    assert found["sigma"][0, 0] == pytest.approx(np.sqrt(50 / 3))
    assert found["bias_se"][0, 0] == pytest.approx(np.sqrt(14 / 3 / 4))
    squares = np.array([1.0, 4.0, 9.0, 36.0])
    error = squares.std(ddof=1) / np.sqrt(4) / (2 * np.sqrt(50 / 3))
    assert found["sigma_se"][0, 0] == pytest.approx(error, rel=1e-12)


def test_standard_errors_are_the_scatter_of_repeated_samples():
    """Heavy tails (kurtosis 9 of an exponential): a Gaussian error of the standard deviation would be half."""
    rng = np.random.Generator(np.random.Philox(6))
    repeats = statistics_of(rng.exponential(size=(700, 3, 2000)))
    for name in ("bias", "sigma", "sd"):
        spread = repeats[name].std(ddof=1)
        # the spread of 2100 values is known to 1.6 %; the mean error is low by a few per cent at this size
        assert repeats[f"{name}_se"].mean() == pytest.approx(spread, rel=0.12)


def test_no_change_at_all_has_no_error():
    assert not any(np.any(value) for value in statistics_of(np.zeros((1, 3, 10))).values())


def test_fewer_than_two_stacks_have_no_statistics():
    values = np.full((1, 3, 2), np.nan)
    values[0, 0, 0] = 1.0
    assert all(np.all(np.isnan(value)) for value in statistics_of(values).values())


def test_bins_hold_all_stacks_and_agree_with_prediction(run):
    summary = summarise(run, bins=5)
    assert summary["n_stacks"].sum() == 20_000
    assert not np.any(summary["n_failed"])
    for name in ("bias", "sigma", "sd"):
        assert_within_sigma(summary[name], summary[f"prediction_{name}"], summary[f"{name}_se"])


def test_the_number_of_bins_does_not_move_the_truth(run):
    one = summarise(run, bins=1)
    assert_within_sigma(one["sigma"], one["prediction_sigma"], one["sigma_se"])
    # within one bin from 0 to 1 the bias itself varies: the prediction must hold its spread
    curves = predicted_curves(run.population, run.config, 40)
    centre = curves["sd"].sel(psf="psf0", quantity="r2").interp(binary_fraction=0.5)
    assert float(one["prediction_sd"].sel(psf="psf0", quantity="r2")[0]) > 1.15 * float(centre)


def test_rows_have_the_keys_of_the_contract(run):
    first = rows(summarise(run, bins=4))[0]
    assert list(first) == ["psf", "quantity", "f_lo", "f_hi", "n_stacks", "n_failed", *STATISTICS]
    assert (first["psf"], first["quantity"], first["f_lo"], first["f_hi"]) == ("psf0", "r2", 0.0, 0.25)


def test_a_fixed_fraction_fills_one_bin(tmp_path):
    simulate(config(n_stacks=500, binary_fraction=0.35), tmp_path / "run.zarr")
    found = rows(summarise(open_run(tmp_path / "run.zarr")))
    assert {(r["f_lo"], r["n_stacks"]) for r in found} == {(0.35, 500)}
    assert len(found) == 6


def test_stacks_that_could_not_be_measured_are_counted(run):
    broken = run.dataset.drop_vars("tally").load().copy(deep=True)
    broken["r2"][0, :7] = np.nan
    summary = summarise(replace(run, dataset=broken), bins=1)
    assert summary["n_failed"].to_numpy().tolist() == [[7], [0]]


@pytest.mark.parametrize("bins", [1, 20, 100])
def test_stored_tallies_say_what_the_stacks_themselves_say(run, bins):
    stored, counted = (
        summarise(r, bins) for r in (run, replace(run, dataset=run.dataset.drop_vars("tally")))
    )
    for name in STATISTICS:
        size = np.maximum(np.abs(counted[name]), 1e-3 * counted["sd"])  # a bias may cancel
        assert float((np.abs(stored[name] - counted[name]) / size).max()) < 1e-11, name
    np.testing.assert_array_equal(stored["n_stacks"], counted["n_stacks"])


@pytest.fixture(scope="module")
def one_by_one(run):
    """Binary fraction and changes of each stack, and the prediction at its own binary fraction."""
    dataset = run.dataset
    shapes, alone = (np.stack([dataset[f"{q}{end}"] for q in ("e1", "e2", "r2")]) for end in ("", "_0"))
    fraction = dataset["binary_fraction"].to_numpy()
    order = np.argsort(fraction)
    curves = predicted_curves(run.population, run.config, 40, fraction[order])
    bias, sd = (curves[name].to_numpy()[:, :, np.argsort(order)] for name in ("bias", "sd"))
    return fraction, changes(shapes, alone), bias, sd


@pytest.mark.parametrize("bins", [1, 7, 20])
def test_every_number_is_that_of_the_stacks_of_the_bin_taken_alone(run, one_by_one, bins):
    """Against plain numpy on all stacks."""
    fraction, change, bias, sd = one_by_one
    found = summarise(run, bins)
    for k in range(bins):
        here = (fraction >= k / bins) & (fraction < (k + 1) / bins)
        x, n = change[:, :, here], here.sum()
        b, v = bias[:, :, here], sd[:, :, here] ** 2
        expected = {
            "bias": x.mean(axis=-1),
            "sd": x.std(axis=-1, ddof=1),
            "sigma": np.sqrt((x**2).sum(axis=-1) / (n - 1)),
            "sigma_se": (x**2).std(axis=-1, ddof=1) / np.sqrt((x**2).sum(axis=-1) / (n - 1)) / 2 / np.sqrt(n),
            "prediction_bias": b.mean(axis=-1),
            "prediction_sigma": np.sqrt((v + b**2).mean(axis=-1)),
            "prediction_sd": np.sqrt(v.mean(axis=-1) + b.var(axis=-1)),
        }
        for name, value in expected.items():
            limit = 1e-6 if name.startswith("prediction") else 1e-10
            size = np.maximum(np.abs(value), 1e-3 * expected[name.replace("_se", "").replace("bias", "sd")])
            assert np.all(np.abs(found[name][:, :, k] - value) < limit * size), (name, k)


def test_there_must_be_a_bin(run):
    with pytest.raises(ValueError, match="bins must be at least 1, got 0"):
        summarise(run, bins=0)
