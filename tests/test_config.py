import json
import re

import pytest
import yaml

from porrima.config import EXAMPLE, PopulationConfig, RunConfig, canonical, load, parse
from porrima.errors import InputError
from porrima.multiplicity import MULTIPLICITY, DucheneKraus2013
from porrima.photometry import HabetsHeintze1981, MainSequence


def example(**changes):
    return yaml.safe_load(EXAMPLE) | changes


def test_the_example_is_valid_and_states_the_defaults():
    config = parse(RunConfig, example())
    assert config.stars.mag == (18, 19)
    bare = parse(RunConfig, {"stars": example()["stars"]})
    assert bare == config


def test_models_by_name_and_with_options():
    config = parse(RunConfig, example(multiplicity="dk13-kcm16", photometry="habets-heintze"))
    assert config.multiplicity.build() == DucheneKraus2013(gap_rule="solar", a_max_factor=2.5)
    assert config.photometry.build() == HabetsHeintze1981()
    changed = parse(
        RunConfig, example(multiplicity={"model": "dk13-kcm16", "a_max_factor": None, "mass_ratio_min": 0.2})
    )
    assert changed.multiplicity.build() == DucheneKraus2013(gap_rule="solar", mass_ratio_min=0.2)
    branch = parse(RunConfig, example(photometry={"model": "habets-heintze", "branch": "primary"}))
    assert branch.photometry.build() == HabetsHeintze1981(branch="primary")
    assert parse(RunConfig, example()).photometry.build() == MainSequence()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"binary_fractoin": 0.3}, "binary_fractoin: is not a key (did you mean binary_fraction?)"),
        ({"binary_fraction": 1.2}, "binary_fraction: must be in [0, 1], uniform or model, got 1.2"),
        (
            {"binary_fraction": "uniformly"},
            "binary_fraction: must be in [0, 1], uniform or model, got uniformly",
        ),
        ({"binary_fraction": True}, "binary_fraction: must be in [0, 1], uniform or model, got True"),
        ({"binary_fraction": float("nan")}, "binary_fraction: must be in [0, 1], uniform or model, got nan"),
        ({"n_stars": 0}, "n_stars: must be greater than or equal to 1, got 0"),
        ({"n_stacks": 1.5}, "n_stacks: must be a valid integer"),
        ({"cut": -0.05}, "cut: must be greater than 0, got -0.05"),
        ({"n_stars": True}, "n_stars: must be a valid integer, got True"),
        ({"n_stars": 10**24}, "n_stars: must be less than or equal to 1000000000"),
        (
            {"multiplicity": {"a_max_factor": float("inf")}},
            "multiplicity.a_max_factor: must be a finite number",
        ),
        (
            {"stars": {"l": 180, "b": 45, "mag": [18, float("inf")]}},
            "stars: mag must be [lo, hi) with lo < hi, within",
        ),
        ({"seed": -3}, "seed: must be greater than or equal to 0, got -3"),
        ({"psf": []}, "psf: "),
        ({"psf": ["psf0", "psf0"]}, "psf: must name each PSF once, got psf0, psf0"),
        ({"stars": {"l": 180, "b": 45}}, "stars.mag: is missing"),
        ({"stars": {"mag": [18, 19]}}, "stars: must have either a direction (l and b) or a catalogue"),
        (
            {"stars": {"l": 180, "mag": [18, 19]}},
            "stars: must have either a direction (l and b) or a catalogue",
        ),
        (
            {"stars": {"l": 1, "b": 1, "catalog": "x", "mag": [18, 19]}},
            "stars: must have either a direction (l and b) or a catalogue",
        ),
        (
            {"stars": {"l": 180, "b": 95, "mag": [18, 19]}},
            "stars.b: must be less than or equal to 90, got 95",
        ),
        (
            {"stars": {"l": 180, "b": 45, "mag": [19, 18]}},
            "stars: mag must be [lo, hi) with lo < hi, within -50 to 50, got [19.0, 18.0]",
        ),
        ({"stars": {"l": 180, "b": 45, "magn": [18, 19]}}, "stars.magn: is not a key (did you mean mag?)"),
        (
            {"multiplicity": {"model": "dk13", "gap": "solar"}},
            "multiplicity.gap: is not a key (did you mean gap_rule?)",
        ),
        (
            {"multiplicity": {"gap_rule": "upper"}},
            "multiplicity.gap_rule: must be 'lower', 'solar', 'nearest' or 'interpolated', got upper",
        ),
    ],
)
def test_a_wrong_key_or_value_is_named(changes, message):
    with pytest.raises(InputError) as error:
        parse(RunConfig, example(**changes))
    assert str(error.value).startswith(message)


def test_unknown_models_suggest_the_nearest():
    config = parse(RunConfig, example(multiplicity="dk14", photometry="main-sequense"))
    with pytest.raises(
        InputError,
        match=re.escape(
            f"multiplicity: must be one of {', '.join(MULTIPLICITY)} (did you mean dk13?), got dk14"
        ),
    ):
        config.multiplicity.build()
    with pytest.raises(InputError, match="did you mean main-sequence"):
        config.photometry.build()
    wrong = parse(RunConfig, example(photometry={"branch": "primary"}))
    with pytest.raises(InputError, match=re.escape("photometry.branch: is an option of habets-heintze only")):
        wrong.photometry.build()


def test_a_file_s_catalogue_is_relative_to_the_file(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text("stars: {catalog: stars.dat, mag: [18, 19]}\n")
    assert load(path).stars.catalog == tmp_path / "stars.dat"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"stars: {l: 180\n", "run.yaml, row 2: is not YAML"),
        (b"seed: 1\nseed: 2\n", "run.yaml, row 2: is not YAML (key seed stands twice)"),
        (b"- 1\n- 2\n", "run.yaml: must hold keys and values, got list"),
        (b"", "run.yaml: must hold keys and values, got NoneType"),
        (b"\xff\xfe\x00", "run.yaml: must be a UTF-8 text file"),
    ],
)
def test_files_that_are_no_configuration(tmp_path, content, message):
    path = tmp_path / "run.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError) as error:
        load(path)
    assert message in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"absent.yaml: cannot be read \(No such file or directory\)"):
        load(tmp_path / "absent.yaml")


@pytest.mark.parametrize(
    "changes",
    [
        {"multiplicity": {"model": "dk13-kcm16", "a_max_factor": None}},
        {
            "multiplicity": {"gap_rule": "solar"},
            "photometry": {"model": "habets-heintze", "branch": "primary"},
        },
        {"multiplicity": "dk13-kcm16"},
        {},
    ],
)
def test_what_is_written_is_what_is_read(changes):
    config = parse(RunConfig, example(**changes))
    back = parse(RunConfig, json.loads(canonical(config)))
    assert back.multiplicity.build() == config.multiplicity.build()
    assert back.photometry.build() == config.photometry.build()
    assert canonical(back) == canonical(config)


def test_a_null_option_is_not_the_model_s_own():
    full = parse(RunConfig, example(multiplicity={"model": "dk13-kcm16", "a_max_factor": None}))
    assert canonical(full) != canonical(parse(RunConfig, example(multiplicity="dk13-kcm16")))


@pytest.mark.parametrize("options", [{"gap_rule": None}, {"scatter_scale": None}, {"projection": None}])
def test_options_that_may_not_be_null_are_refused(options):
    with pytest.raises(InputError, match="multiplicity: "):
        parse(RunConfig, example(multiplicity=options)).multiplicity.build()


def test_equal_configurations_are_written_alike():
    one = parse(RunConfig, example())
    assert canonical(one) == canonical(parse(RunConfig, dict(reversed(example().items()))))
    assert canonical(one) != canonical(parse(RunConfig, example(seed=2)))
    assert "psf" not in canonical(parse(PopulationConfig, {"stars": example()["stars"]}))
