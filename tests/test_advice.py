"""`porrima select` as a user types it: the choice and what is around it, files, and wrong input in one line."""

import json
import sys
from functools import partial

import numpy as np
import pytest
from astropy.table import Table

from porrima import cli

SHORT = ("--clip", 0.05, "--clip", 0.01, "--clip", 0.005, "--exposures", 1, "--exposures", 4)


@pytest.fixture
def porrima(porrima):
    """Run `porrima select`; gives exit code, standard output and standard error."""
    return partial(porrima, "select")


@pytest.fixture(scope="module")
def stars_file(tmp_path_factory):
    rng = np.random.Generator(np.random.Philox(8))
    path = tmp_path_factory.mktemp("select") / "stars.csv"
    columns = rng.uniform(0.1, 1.4, 200), 10 ** rng.uniform(2.3, 3.6, 200), np.linspace(17, 20.99, 200)
    lines = [f"{m},{d},{i}" for m, d, i in zip(*columns, strict=True)]
    path.write_text("mass,distance,magnitude\n" + "\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def answer(stars_file, tmp_path_factory):
    """What one run prints and writes."""
    folder = tmp_path_factory.mktemp("select") / "advice"
    with pytest.MonkeyPatch.context() as patch:
        words = [
            "select",
            "--survey",
            "euclid-vis",
            "--stars",
            stars_file,
            "--area",
            0.2,
            "--mag",
            17,
            21,
            *SHORT,
        ]
        patch.setattr(sys, "argv", ["porrima", *map(str, words), "-o", str(folder)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
    assert stop.value.code == 0
    return json.loads((folder / "select.json").read_text()), folder


def test_the_best_setting_is_the_smallest_of_the_table(answer):
    result, folder = answer
    table = Table.read(folder / "select.ecsv")
    assert len(table) == len(result["settings"]) == 10 * 4 * 2  # ranges of four bins, clips, exposures
    assert result["best"]["merit"] == pytest.approx(table["merit"].min())
    assert result["best"]["merit_low"] < result["best"]["merit"] < result["best"]["merit_high"]
    assert {"sigma_log_period", "cut", "star counts", "noise of a star", "stars", "choices"} <= {
        row["source"] for row in result["sources"]
    }
    assert (folder / "select.png").stat().st_size > 10_000
    assert sorted(p.name for p in folder.iterdir()) == ["select.ecsv", "select.json", "select.png"]


def test_saturated_stars_are_cut_off(answer):
    result, _ = answer
    assert [(row["mag_lo"], row["mag_hi"]) for row in result["bins"]] == [
        (17.8, 18), (18, 19), (19, 20), (20, 21),
    ]  # fmt: skip
    assert [row["n_per_deg2"] for row in result["bins"]] == [50, 250, 250, 250]


def test_advice_is_never_better_than_the_best_of_the_same_plan(answer):
    result, _ = answer
    of_plan = [
        r for r in result["runners_up"] if "weighted" not in r["advice"] and "above" not in r["advice"]
    ]
    assert len(of_plan) >= 6
    assert all(row["merit"] >= result["best"]["merit"] for row in of_plan)
    for row in [result["best"], *of_plan]:
        shares = [row[f"share_{q}"] for q in ("e1", "e2", "r2")]
        assert row["merit"] == pytest.approx(max(shares))


def test_more_exposures_and_a_larger_patch_lower_the_error(answer, porrima, stars_file):
    result, _ = answer
    merits = [row["merit"] for row in result["against_exposures"]]
    assert [row["n_exposures"] for row in result["against_exposures"]] == [1, 4]
    assert merits[1] < merits[0]
    where = ("--survey", "euclid-vis", "--stars", stars_file, "--area", 0.2, "--mag", 18, 19)
    merits = []
    for size in (0.5, 5):
        code, out, _ = porrima(*where, "--clip", 0.01, "--exposures", 4, "--patch-area", size, "--json")
        assert code == 0
        merits.append(json.loads(out)["best"]["merit"])
    assert merits[1] < merits[0]


def test_roman_of_the_galaxy_in_a_table(porrima):
    where = (
        "--survey",
        "roman-h158",
        "--l",
        180,
        "--b",
        60,
        "--mag",
        18,
        20,
        "--clip",
        0.01,
        "--exposures",
        6,
    )
    code, out, err = porrima(*where, "--corrected", "--weights", "inverse-variance")
    assert code == 0, err
    assert "best: 18.3-" in out
    assert "predicted bias taken off" in out
    assert "all stars, no clip" in out


WHERE = ["--stars", "{stars}", "--area", "1", "--mag", "18", "19"]
WRONG = [  # arguments, what the one line says
    (["--l", "180", "--b", "45"], "--survey: must be one of euclid-vis, roman-h158"),
    (["--survey", "rubin", *WHERE], "--survey: must be one of euclid-vis, roman-h158"),
    (["--survey", "euclid-vis", *WHERE[:2], *WHERE[4:]], "--area: is missing: of the sky that the catalogue covers"),
    (["--survey", "euclid-vis", "--l", "180", "--b", "45", "--area", "1"], "--area: is that of a catalogue, got 1.0"),
    (["--survey", "euclid-vis", *WHERE[:4], "--mag", "12", "17"], "--mag: must reach fainter than 17.8 mag"),
    (["--survey", "euclid-vis", *WHERE, "--patch-area", "0"], "--patch-area: must be positive and finite [deg²]"),
    (["--survey", "euclid-vis", *WHERE, "--clip", "-1"], "--clip: must be in (0, 0.2], got -1.0"),
    (["--survey", "euclid-vis", *WHERE, "--exposures", "0"], "--exposures: must be 1 to 32, got 0"),
    (["--survey", "euclid-vis", *WHERE, "--sides", "lower"], "--sides: must be one of both, upper"),
    (["--survey", "euclid-vis", *WHERE, "--weights", "flux"], "--weights: must be one of equal, inverse-variance"),
    (["--survey", "euclid-vis", *WHERE, "--centre", "x"], "--centre: must be one of stack, known"),
    (["--survey", "euclid-vis", *WHERE, "--noise", "none"], "--noise: must be one of fitted, measured"),
    (["--survey", "euclid-vis", *WHERE, "--noise", "measured"], "take --noise fitted, or another estimator"),
    (["--survey", "euclid-vis", *WHERE, "--binary-fraction", "2"], "--binary-fraction: must be in [0, 1], got 2.0"),
    (["--survey", "euclid-vis", *WHERE, "--cut", "0.5"], "cut: is too wide to clip stars by their shape"),
    (["--survey", "euclid-vis", *WHERE, "--requirements", "{shear}"], "must have sigma_e or sigma_r2"),
    (["--survey", "euclid-vis", *WHERE, "-o", "nowhere/advice"], "output: cannot be made (No such folder)"),
    (["--survey", "euclid-vis", *WHERE, "-o", "{stars}"], "output: must be a folder"),
    (["--survey", "euclid-vis", *WHERE, "--multiplicity", "dk12"], "must be one of"),
    (["--survey", "euclid-vis", *WHERE, "--multiplicity", "{{model: dk13, triples: true}}"], "triples"),
    (["--survey", "euclid-vis", *WHERE[:4], "--mag", "18", "25"], "no star with magnitude in [21, 22)"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "message"), WRONG, ids=lambda v: " ".join(v)[-40:] if isinstance(v, list) else ""
)
def test_wrong_input_gives_one_line_and_writes_nothing(
    porrima, tmp_path, monkeypatch, stars_file, arguments, message
):
    shear = tmp_path / "shear.yaml"
    shear.write_text("m: 1e-3\n")
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    code, out, err = porrima(*(word.format(stars=stars_file, shear=shear) for word in arguments))
    assert code == 2
    assert out == ""
    assert message in err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
