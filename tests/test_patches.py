import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable

from porrima.errors import InputError
from porrima.patches import one_patch, read_patches

HEADER = "patch,mag_lo,mag_hi,n_stars,e1,e2,r2,r2_error,binary_fraction"
ROW = "a,18,19,400,0.05,-0.01,6.8e-3,1e-6,0.3"
GIVEN = {"shape": (0.05, 0.0, 6.8e-3), "shape_error": None, "n_stars": 400}


def table(tmp_path, *lines):
    path = tmp_path / "patches.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_patches_keep_their_numbers(tmp_path):
    found = read_patches(table(tmp_path, HEADER, ROW, ROW.replace("a,18,19,400", "b,19,20,500")))
    assert found.name == ("a", "b")
    assert found.named
    assert found.patch(1).n_stars == 500
    assert found.patch(0).shape == pytest.approx([0.05, -0.01, 6.8e-3])
    assert found.patch(0).error == pytest.approx([0, 0, 1e-6])
    assert found.at("mag_hi", 1) == 20
    assert found.at("x", 0) is None


def test_units_of_a_table_are_honoured(tmp_path):
    path = tmp_path / "patches.ecsv"
    QTable({"r2": [6800] * u.mas**2, "n_stars": [3], "e1": [0.0], "e2": [0.0]}).write(path)
    assert read_patches(path).patch(0).shape[2] == pytest.approx(6.8e-3)


def test_patches_without_names_are_numbered(tmp_path):
    found = read_patches(table(tmp_path, "r2,n_stars", "6.8e-3,3", "6.9e-3,4"))
    assert found.name == ("1", "2")
    assert not found.named
    assert np.all(found.patch(0).shape[:2] == 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("n_stars", "stars"), "column n_stars: is missing; the table has"),
        (("binary_fraction", "binary_fractoin"), "did you mean binary_fraction"),
        (("r2,", "r3,"), "column r2: is missing"),
        (("mag_lo,", "low,"), "column mag_lo: is missing beside mag_hi"),
        (("e2,", "other,"), "column e2: is missing beside e1"),
        (("400", "400.5"), "row 2, column n_stars: must be a whole number from 1 to 1e9, got 400.5"),
        (("400", "0"), "n_stars: must be a whole number"),
        (("6.8e-3", "-1"), "column r2: must be positive and finite"),
        (("6.8e-3", "nan"), "column r2: must be positive and finite"),
        (("6.8e-3", "big"), "row 2, column r2"),
        (("0.05", "1.2"), r"column e1: must be in \(-1, 1\), got 1.2"),
        (("0.05", "0.9999"), "must make e1² \\+ e2² less than 1"),
        (("1e-6", "-1e-6"), "column r2_error: must be finite and not negative"),
        (("0.3", "1.3"), r"column binary_fraction: must be in \[0, 1\], got 1.3"),
        (("18,19", "19,18"), "column mag_hi: must be above mag_lo"),
    ],
)
def test_a_table_that_is_wrong_is_refused_with_its_row(tmp_path, change, message):
    text = f"{HEADER}\n{ROW}".replace(*change, 1)
    if change[1] == "0.9999":
        text = text.replace("-0.01", "0.5")
    with pytest.raises(InputError, match=message):
        read_patches(table(tmp_path, text))


def test_an_error_needs_its_quantity(tmp_path):
    with pytest.raises(InputError, match="column e1: is missing beside e1_error"):
        read_patches(table(tmp_path, "r2,n_stars,e1_error", "6.8e-3,3,0.1"))
    with pytest.raises(InputError, match="must have"):
        read_patches(table(tmp_path, "r2,n_stars"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shape": None}, "--shape: is missing, or a table of patches"),
        ({"n_stars": None}, "--n-stars: is missing"),
        ({"n_stars": 0}, "--n-stars: must be a whole number"),
        ({"shape": (0.0, 0.0, -1.0)}, "--shape, r2: must be positive and finite"),
        ({"shape": (1.5, 0.0, 1.0)}, "--shape, e1: must be in"),
        ({"shape_error": (0.0, 0.0, -1.0)}, "--shape-error, r2: must be finite and not negative"),
    ],
)
def test_options_that_are_wrong_are_named(change, message):
    assert len(one_patch(**GIVEN)) == 1
    with pytest.raises(InputError, match=message):
        one_patch(**GIVEN | change)
