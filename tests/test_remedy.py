"""`porrima correct` as a user types it: three methods, what is written, and wrong input in one line."""

import json
from functools import partial

import numpy as np
import pytest
from astropy.table import Table

from porrima.psf import psf_from_name
from porrima.response import response
from porrima.shapes import Adaptive

ONE = ("--shape", 0.05396, -0.003, 6.7848e-3, "--n-stars", 2000)
SAMPLES = (
    "mag_lo,mag_hi,n_stars,e1,e2,r2\n18,19,2000,0.05395,-0.003,6.785e-3\n19,20,900,0.054,-0.003,6.783e-3\n"
)
FIELDS = "n_stars,r2,binary_fraction,binary_fraction_error\n2000,6.7815e-3,0.2,{error}\n900,6.7855e-3,0.5,{error}\n"
CLIPS = "n_stars,r2,eta,sd\n1900,6.7806e-3,1.9e-4,1.1e-3\n1950,6.7817e-3,3.4e-4,1.9e-3\n2000,6.786e-3,1.05e-3,5.7e-3\n"


@pytest.fixture
def porrima(porrima):
    """Run `porrima correct`; gives exit code, standard output and standard error."""
    return partial(porrima, "correct")


@pytest.fixture(scope="module")
def stars_file(tmp_path_factory):
    rng = np.random.Generator(np.random.Philox(8))
    path = tmp_path_factory.mktemp("correct") / "stars.csv"
    columns = rng.uniform(0.1, 1.4, 80), 10 ** rng.uniform(2.3, 3.6, 80), np.linspace(18, 19.99, 80)
    lines = [f"{m},{d},{i}" for m, d, i in zip(*columns, strict=True)]
    path.write_text("mass,distance,magnitude\n" + "\n".join(lines) + "\n")
    return path


@pytest.fixture
def write(tmp_path):
    def keep(text, name="table.csv"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return keep


def of(rows, **wanted):
    (row,) = [r for r in rows if all(r[k] == v for k, v in wanted.items())]
    return row


def test_one_psf_is_corrected(porrima, stars_file):
    code, out, _ = porrima(*ONE, "--psf", "psf1", "--stars", stars_file, "--mag", 18, 19, "--json")
    result = json.loads(out)
    assert code == 0
    size = of(result["values"], quantity="r2")
    assert size["corrected"] == pytest.approx(size["measured"] - size["bias"])
    assert size["low"] < size["corrected"] < size["high"]
    parts = [size[name] for name in ("model_error", "scatter", "measurement_error")]
    assert size["error"] == pytest.approx(np.sqrt(np.sum(np.square(parts))), rel=1e-6)
    assert 0.5e-3 < size["bias"] / size["measured"] < 3e-3
    shear = of(result["shear"], group="fit", quantity="m")
    assert 0 < shear["error"] < shear["before"]
    assert result["populations"][0]["n_catalog_stars"] == 40
    assert {row["source"] for row in result["sources"]} >= {"mean_separation", "cut", "photometry", "stars"}


def test_a_table_of_patches_keeps_names_and_places_and_is_written_with_its_provenance(
    porrima, stars_file, write, tmp_path
):
    text = "patch,x,y,mag_lo,mag_hi,n_stars,e1,e2,r2,r2_error\n"
    text += "a,1,2,18,19,400,0.05,0,6.79e-3,1e-6\nb,3,4,19,20,500,0.06,0.01,6.8e-3,2e-6\n"
    table, output, picture = write(text), tmp_path / "out.ecsv", tmp_path / "out.png"
    code, out, _ = porrima(
        table, "--instrument", "kcm16", "--stars", stars_file, "-o", output, "--plot", picture, "--json"
    )
    result = json.loads(out)
    assert code == 0
    assert [(r["patch"], r["x"]) for r in result["values"]] == [("a", 1.0)] * 3 + [("b", 3.0)] * 3
    assert of(result["values"], patch="b", quantity="r2")["measurement_error"] == 2e-6
    assert result["requirement"] == "KCM16"
    written = Table.read(output)
    assert written["corrected"].tolist() == [r["corrected"] for r in result["values"]]
    assert written.meta["configuration"]["multiplicity"]["model"] == "dk13"
    assert written.meta["version"] == result["version"]
    assert picture.stat().st_size > 1000


def test_stars_of_the_galaxy_may_differ_from_patch_to_patch(porrima, write):
    text = (
        "l,b,mag_lo,mag_hi,n_stars,e1,e2,r2\n180,45,21,22,400,0.05,0,6.79e-3\n0,80,21,22,400,0.05,0,6.79e-3\n"
    )
    code, out, _ = porrima(write(text), "--psf", "psf1", "--json")
    result = json.loads(out)
    assert code == 0
    assert [(p["l"], p["b"]) for p in result["populations"]] == [(180, 45), (0, 80)]
    first, second = (p["eta"] for p in result["populations"])
    assert first != second


def test_samples_are_extrapolated(porrima, stars_file, write, tmp_path):
    picture = tmp_path / "fit.svg"
    code, out, _ = porrima(
        write(SAMPLES), "--method", "extrapolate", "--psf", "psf1", "--stars", stars_file, "--plot", picture, "--json"
    )  # fmt: skip
    result = json.loads(out)
    assert code == 0
    (fit,) = result["fits"]
    assert (fit["n_samples"], fit["n_dof"], fit["n_stars"]) == (2, 2, 2900)
    assert [r["quantity"] for r in result["values"]] == ["e1", "e2", "r2"]
    assert sum(row["best_share"] for row in result["samples"]) == pytest.approx(1)
    assert {row["patch"] for row in result["samples"]} == {fit["patch"]}
    assert picture.exists()


def test_fields_of_unlike_fraction_need_it_known(porrima, stars_file, write):
    options = ("--method", "fields", "--psf", "psf1", "--stars", stars_file, "--mag", 18, 19, "--json")
    errors, slopes = [], []
    for error in (0, 0.05):
        code, out, _ = porrima(write(FIELDS.format(error=error)), *options)
        assert code == 0
        (fit,) = json.loads(out)["fits"]
        errors.append(fit["error_r2"])
        slopes.append(fit["dr2_dfraction"])
    assert errors[1] > 1.05 * errors[0]
    assert slopes[0] == pytest.approx((6.7855e-3 - 6.7815e-3) / 0.3 / 6.779e-3, rel=2e-3)


def test_clips_bring_their_own_changes_and_need_no_stars(porrima, write):
    code, out, _ = porrima(write(CLIPS), "--method", "extrapolate", "--nested", "--psf", "psf1", "--json")
    result = json.loads(out)
    assert code == 0
    assert result["configuration"] is None
    size = of(result["values"], quantity="r2")
    r2 = float(response(psf_from_name("psf1"), Adaptive()).shape0.r2)
    assert size["corrected"] == pytest.approx(r2, rel=1e-4)
    assert {row["quantity"] for row in result["shear"]} == {"m"}
    assert result["samples"][0]["best_share"] is None


def test_the_terminal_shows_patches_and_fits(porrima, stars_file, write):
    code, out, _ = porrima(*ONE, "--psf", "psf1", "--stars", stars_file, "--mag", 18, 19)
    assert code == 0
    assert "m (fit)" in out
    code, out, _ = porrima(write(CLIPS), "--method", "extrapolate", "--nested", "--psf", "psf1")
    assert "amplitude" in out
    assert code == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((*ONE, "--mag", 18, 19), "--psf: is missing, or --instrument"),
        ((*ONE, "--psf", "psf1", "--stars", "{stars}"), "--mag: is missing, or columns mag_lo and mag_hi"),
        ((*ONE[4:], "--psf", "psf1", "--mag", 18, 19), "--shape: is missing, or a table of patches"),
        ((*ONE, "--psf", "psf9", "--stars", "{stars}", "--mag", 18, 19), "psf9"),
        ((*ONE, "--psf", "psf1", "--mag", 18, 19), "must have either a direction (l and b) or a catalogue"),
        ((*ONE, "--psf", "psf1", "--stars", "{stars}", "--mag", 25, 26), "no main-sequence star"),
        ((*ONE, "--psf", "psf1", "--stars", "{stars}", "--mag", 19, 18), "mag"),
        ((*ONE, "--method", "guess", "--psf", "psf1"), "--method: must be one of predict, extrapolate, fields"),
        ((*ONE, "--psf", "psf1", "--binary-fraction", 1.5), "--binary-fraction: must be in [0, 1]"),
        ((*ONE[:-1], 0, "--psf", "psf1"), "--n-stars: must be a whole number"),
        ((*ONE, "--shape", 0, 0, 0.68, "--psf", "psf1", "--stars", "{stars}", "--mag", 18, 19), "within a factor 2"),
        ((*ONE, "--psf", "psf1", "--stars", "{stars}", "--mag", 18, 19, "--cut", -1), "cut"),
        ((*ONE, "--psf", "psf1", "--stars", "{stars}", "--mag", 18, 19, "--cut", 0.5), "--cut: is too wide"),
        ((*ONE, "--psf", "psf1", "--stars", "{stars}", "--mag", 18, 19, "--plot", "a.gif"), "must end in .png"),
        ((*ONE, "--psf", "psf1", "--stars", "{stars}", "--mag", 18, 19, "-o", "no/x.ecsv"), "cannot be written"),
        (("{table}", *ONE, "--psf", "psf1"), "--shape: cannot be given together with a table of patches"),
        (("none.csv", "--psf", "psf1"), "none.csv"),
        (("{table}", "--psf", "psf1", "--stars", "{stars}", "--mag", 18, 19), "cannot be given together with columns"),
        (("{table}", "--method", "fields", "--psf", "psf1", "--stars", "{stars}"), "column binary_fraction"),
        (("{one}", "--method", "extrapolate", "--psf", "psf1", "--stars", "{stars}"), "must be at least 2"),
        (("{same}", "--method", "extrapolate", "--psf", "psf1"), "must differ in the predicted change"),
    ],
)  # fmt: skip
def test_wrong_input_ends_in_one_line_and_code_2(porrima, stars_file, write, arguments, message):
    same = "n_stars,r2,eta,sd\n190,6.78e-3,1e-4,1e-3\n195,6.78e-3,1e-4,1e-3\n"
    files = {
        "{stars}": stars_file, "{table}": write(SAMPLES), "{same}": write(same, "same.csv"),
        "{one}": write("\n".join(SAMPLES.split("\n")[:2]) + "\n", "one.csv"),
    }  # fmt: skip
    code, out, err = porrima(*(files.get(word, word) for word in arguments), "--json")
    errors = [line for line in err.splitlines() if not line.startswith("warning:")]
    assert (code, out) == (2, "")
    assert len(errors) == 1
    assert errors[0].startswith("error: ")
    assert message in errors[0]


@pytest.mark.filterwarnings("default")  # as on the command line
def test_a_psf_that_is_not_much_like_the_one_given_is_warned_of(porrima, stars_file):
    code, _, err = porrima(
        "--shape",
        0.05,
        0,
        8.6e-3,
        *ONE[4:],
        "--psf",
        "psf1",
        "--stars",
        stars_file,
        "--mag",
        18,
        19,
        "--json",
    )
    assert code == 0
    assert "1.27 times larger or smaller" in err
