from contextlib import contextmanager
from dataclasses import replace

import pytest
import xarray as xr

from porrima.errors import InputError
from porrima.programme import Experiment, carried_out, programme


class Told:
    """What was told of each experiment, and how far it came."""

    def __init__(self):
        self.there, self.done = {}, {}

    @contextmanager
    def __call__(self, name, size, unit, there):
        self.there[name] = there
        self.done[name] = 0

        def advance(n):
            self.done[name] += n

        yield advance


def experiment(name, calls, settings="a"):
    def make(advance):
        calls.append(name)
        advance(4)
        return {"findings": xr.Dataset({"value": float(len(calls))})}

    return Experiment(name=name, settings=settings, size=4, unit="steps", make=make)


def test_only_what_changed_is_made_again(tmp_path):
    calls = []
    experiments = [experiment("first", calls), experiment("second", calls)]
    told = Told()
    before = dict(carried_out(experiments, tmp_path, told))
    assert told.there == {"first": False, "second": False}
    assert told.done == {"first": 4, "second": 4}
    told = Told()
    experiments[1] = replace(experiments[1], settings="b")
    after = dict(carried_out(experiments, tmp_path, told))
    assert calls == ["first", "second", "second"]
    assert told.there == {"first": True, "second": False}
    xr.testing.assert_identical(before["first"]["findings"], after["first"]["findings"])
    assert float(after["second"]["findings"]["value"]) == 3.0


def test_what_one_made_before_it_was_interrupted_is_there_again(tmp_path):
    calls = []

    def stop(advance):
        raise KeyboardInterrupt

    experiments = [experiment("first", calls), replace(experiment("second", calls), make=stop)]
    with pytest.raises(KeyboardInterrupt):
        dict(carried_out(experiments, tmp_path, Told()))
    told = Told()
    dict(carried_out([experiments[0], experiment("second", calls)], tmp_path, told))
    assert told.there == {"first": True, "second": False}


def test_each_option_changes_what_it_is_about_and_no_other(tmp_path):
    def settings(**options):
        return {one.name: one.settings for one in programme(tmp_path, **options)}

    first = settings()
    assert list(first) == [
        "toy", "sketch", "multiplicity_table", "population", "psf_table", "errors_and_biases", "effect_of_n_stars",
        "errors_and_biases_kcm16", "errors_and_biases_optical", "magnitude", "statements",
    ]  # fmt: skip
    assert settings() == first
    stacks = {"errors_and_biases", "errors_and_biases_kcm16"}
    few = settings(n_stars=200)
    assert {name for name in first if few[name] != first[name]} == {*stacks, "errors_and_biases_optical"}
    other = settings(psf=("psf2",))
    assert {name for name in other if other[name] != first[name]} == {
        *stacks,
        "effect_of_n_stars",
        "statements",
    }
    assert "errors_and_biases_optical" not in other
    seeds = settings(seed=2)
    unseeded = {"toy", "sketch", "multiplicity_table", "population", "psf_table"}
    assert {name for name in first if seeds[name] == first[name]} == unseeded


def test_a_wrong_option_is_refused_before_anything_is_made(tmp_path):
    with pytest.raises(InputError, match="psf9"):
        programme(tmp_path, psf=("psf9",))
    with pytest.raises(InputError, match="n_stars"):
        programme(tmp_path, n_stars=0)
    assert not list(tmp_path.iterdir())
