import numpy as np
import pytest

from porrima.config import RunConfig, parse
from porrima.simulation import simulate
from porrima.store import open_run
from porrima.summary import STATISTICS, predicted_curves, rows, statistics, summarise
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


def test_statistics_of_known_numbers():
    found = statistics(np.array([1.0, 2.0, 3.0, 6.0]))
    assert found["bias"] == 3.0
    assert found["sd"] == pytest.approx(np.sqrt(14 / 3))
    assert found["sigma"] == pytest.approx(np.sqrt(50 / 3))
    assert found["bias_se"] == pytest.approx(np.sqrt(14 / 3 / 4))


def test_standard_errors_are_the_scatter_of_repeated_samples():
    """Heavy tails (kurtosis 9 of an exponential): a Gaussian error of the standard deviation would be half."""
    rng = np.random.Generator(np.random.Philox(6))
    repeats = [statistics(rng.exponential(size=2000)) for _ in range(2000)]
    for name in ("bias", "sigma", "sd"):
        values = np.array([r[name] for r in repeats])
        errors = np.array([r[f"{name}_se"] for r in repeats])
        spread = values.std(ddof=1)
        # the spread of 2000 values is known to 1.6 %; the mean error is low by a few per cent at this size
        assert errors.mean() == pytest.approx(spread, rel=0.12)


def test_no_change_at_all_has_no_error():
    found = statistics(np.zeros(10))
    assert set(found.values()) == {0.0}


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
    curves = predicted_curves(run[2], run[1], 40)
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
    dataset, settings, population = run
    broken = dataset.copy(deep=True)
    broken["r2"][0, :7] = np.nan
    summary = summarise(broken, settings, population, bins=1)
    assert summary["n_failed"].to_numpy().tolist() == [[7], [0]]


def test_there_must_be_a_bin(run):
    with pytest.raises(ValueError, match="bins must be at least 1, got 0"):
        summarise(run, bins=0)
