"""TRILEGAL files against hand-read rows, made-up files with other bands, and the model's own binaries."""

import numpy as np
import pytest

from data_files import data_file
from porrima.catalogs import read_catalog, write_stars
from porrima.errors import InputError
from porrima.multiplicity import MULTIPLICITY
from porrima.photometry import PHOTOMETRY
from porrima.prediction import integrate, population_moments
from porrima.systems import Population

REAL = "catalogues/trilegal_with_binaries.table"

# Made up in the model's format: a dwarf, a pair, a giant, a white dwarf, a brown dwarf, a pair whose heavier
# star has died, a halo dwarf.
TRILEGAL = """\
#Gc logAge [M/H] m_ini   logL   logTe logg  m-M0   Av    m2/m1 mbol   g      i      G      VIS    Mact
 1   8.00  0.03  0.50000 -1.400 3.579 4.900 10.00  0.030 0.00 18.270 21.100 18.500 19.600 18.900  0.500
 1   9.60 -0.10  0.80000 -0.500 3.700 4.600  5.00  0.030 0.80 10.600 11.900 11.000 11.300 11.100  0.800
 1   9.60 -0.10  1.30000  1.700 3.660 2.500 12.00  0.030 0.00 12.500 14.500 13.200 13.700 13.300  1.290
 2  10.05 -0.70  2.50000 -2.300 4.100 8.100  8.00  0.030 0.00 18.500 19.300 19.500 19.400 19.400  0.680
 1   7.20  0.10  0.03000 -2.700 3.400 4.250  6.00  0.030 0.00 17.500 24.100 19.100 20.000 19.300  0.030
 1   9.81 -0.31  1.40000  0.200 3.780 4.300 11.00  0.030 0.71 15.300 15.900 15.300 15.500 15.400  0.990
 3  10.11 -1.50  0.60000 -1.000 3.680 4.750 15.00  0.030 0.00 22.300 23.300 22.100 22.600 22.200  0.600
#TRILEGAL normally terminated
"""


def saved(folder, content, name="field.dat"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_rows_of_the_real_file_are_those_read_by_eye():
    catalog = read_catalog(data_file(REAL))
    stars = catalog.stars
    assert catalog.format == "trilegal"
    assert (catalog.n_rows, len(stars)) == (2963, 2819)
    assert catalog.rejected == {"not on the main sequence": 137, "below 0.08 M_sun": 7}
    np.testing.assert_allclose(stars.mass[[0, 1, -1]], [0.422, 0.103, 0.309])
    np.testing.assert_allclose(stars.distance[[0, 1, 2, -1]], [870.96, 524.81, 1000.0, 8317.6], rtol=1e-5)
    np.testing.assert_array_equal(stars.metallicity[[0, 1, -1]], [0.17, -0.15, -0.13])
    np.testing.assert_array_equal(stars.log_age[[0, 1, -1]], [7.67, 7.87, 10.11])
    assert stars.component[[0, 1, -1]].tolist() == ["thin1", "thin1", "halo"]
    assert (stars.band, stars.area) == ("i", None)
    # V = 19.396, I = 17.311: R - I = 1.09 along the dwarf sequence, i = I + 0.247 * 1.09 + 0.329
    assert stars.magnitude[0] == pytest.approx(17.909, abs=0.005)


def test_other_bands_of_the_real_file_are_its_columns():
    first = {band: read_catalog(data_file(REAL), band=band).stars.magnitude[0] for band in "UBVRIJHK"}
    expected = (21.891, 20.736, 19.396, 18.413, 17.311, 16.219, 15.626, 15.432)
    assert tuple(first.values()) == expected
    with pytest.raises(
        InputError, match=r"band: must be one of U, B, V, R, I, J, H, K, which the file has, got gaia_G$"
    ):
        read_catalog(data_file(REAL), band="gaia_G")


def test_dropping_the_model_s_binaries_takes_a_third_of_the_stars_and_leaves_their_masses():
    kept, dropped = (
        read_catalog(data_file(REAL), options={"binaries": choice}) for choice in ("replace", "drop")
    )
    assert kept.stars.mass.tolist() == read_catalog(data_file(REAL)).stars.mass.tolist()
    assert dropped.rejected["with a companion of its own"] == 915
    assert dropped.n_rows == len(dropped.stars) + sum(dropped.rejected.values())
    inside, alone = (c.stars.select(magnitude=(16, 23)) for c in (kept, dropped))
    assert (len(inside), len(alone)) == (2131, 1450)
    assert alone.mass.mean() / inside.mass.mean() == pytest.approx(1.02, abs=0.005)


def test_dwarfs_are_kept_and_everything_else_is_counted(tmp_path):
    catalog = read_catalog(saved(tmp_path, TRILEGAL))
    assert catalog.stars.mass.tolist() == [0.5, 0.8, 0.99, 0.6]
    assert catalog.rejected == {"not on the main sequence": 2, "below 0.08 M_sun": 1}
    assert catalog.assumed == {}
    assert catalog.stars.component.tolist() == ["thin1", "thin5", "thin6", "halo"]
    np.testing.assert_allclose(catalog.stars.distance, [1000.0, 100.0, 1584.893, 10000.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("band", "expected"), [("i", 18.5), ("g", 21.1), ("gaia_G", 19.6), ("euclid_VIS", 18.9), ("G", 19.6)]
)
def test_named_bands_are_taken_as_they_are(tmp_path, band, expected):
    stars = read_catalog(saved(tmp_path, TRILEGAL), band=band).stars
    assert (stars.magnitude[0], stars.band) == (expected, band)


def test_names_that_end_in_mag_are_the_same_bands(tmp_path):
    text = TRILEGAL.replace(" i      G  ", " imag   Gmag").replace("VIS ", "F158")
    assert read_catalog(saved(tmp_path, text)).stars.magnitude[0] == 18.5
    assert read_catalog(saved(tmp_path, text), band="gaia_G").stars.magnitude[0] == 19.6
    assert read_catalog(saved(tmp_path, text), band="roman_F158").stars.magnitude[0] == 18.9


@pytest.mark.parametrize(("age", "name"), [(0.1, "thin1"), (0.5, "thin2"), (1.5, "thin3"), (2.5, "thin4"),
                                           (4, "thin5"), (6, "thin6"), (8, "thin7"), (12, "thin7")])  # fmt: skip
def test_thin_disc_is_divided_by_age_as_the_other_model_divides_it(tmp_path, age, name):
    text = TRILEGAL.replace(" 1   8.00", f" 1   {9 + np.log10(age):.4f}")
    assert read_catalog(saved(tmp_path, text)).stars.component[0] == name


@pytest.mark.parametrize(("number", "name"), [(2, "thick"), (3, "halo"), (4, "bulge"), (5, "unknown")])
def test_other_components_have_their_numbers(tmp_path, number, name):
    text = TRILEGAL.replace(" 1   8.00", f" {number}   8.00")
    assert read_catalog(saved(tmp_path, text)).stars.component[0] == name


def test_file_without_the_mass_of_now_or_the_column_of_companions_is_read(tmp_path):
    lines = [line.split() for line in TRILEGAL.splitlines()[:-1]]
    names = [name.lstrip("#") for name in lines[0]]
    keep = [k for k, name in enumerate(names) if name not in ("Mact", "m2/m1")]
    text = "\n".join(",".join((names if k == 0 else line)[j] for j in keep) for k, line in enumerate(lines))
    catalog = read_catalog(saved(tmp_path, text))
    assert catalog.format == "trilegal"
    assert catalog.stars.mass.tolist() == [0.5, 0.8, 1.4, 0.6]


def test_companions_cannot_be_dropped_where_the_file_does_not_name_them(tmp_path):
    text = TRILEGAL.replace("m2/m1", "q    ")
    with pytest.raises(InputError, match=r"column m2/m1: must be there, for binaries = drop"):
        read_catalog(saved(tmp_path, text), options={"binaries": "drop"})


def test_wrong_options_are_refused_by_name(tmp_path):
    path = saved(tmp_path, TRILEGAL)
    with pytest.raises(InputError, match=r"^options, binaries: must be replace, keep or drop, got hide$"):
        read_catalog(path, options={"binaries": "hide"})
    with pytest.raises(InputError, match=r"^options: must be one of binaries, got binary$"):
        read_catalog(path, options={"binary": "drop"})
    with pytest.raises(InputError, match=r"^columns: must not be given for a TRILEGAL file"):
        read_catalog(path, columns={"mass": "Mact"})


BROKEN = {  # what is wrong: (old, new, the end of the message)
    "no gravity": (" logg ", " lgg  ", "column logg: must be there; the file has Gc logAge [M/H] m_ini logL"),
    "row cut": (" 22.200  0.600", "", "row 8: must have 16 fields, as the header, got 14"),
    "no number": (" 0.990", " o.990", "row 7, column Mact: must be a number, got 'o.990'"),
    "nan mass": (" 0.990", "   nan", "row 7, column Mact: must be positive and finite (0 where unknown), got nothing"),
    "nan modulus": (" 15.00 ", "   nan ", "row 8, column m-M0: must be finite, got nothing"),
    "distance for its modulus": (" 15.00 ", " 3000. ", "row 8, column m-M0: must be from -5 to 27 (is it m-M0?)"),
    "component": (" 3  10.11", " 9  10.11", "row 8, column Gc: must be the number of a component, 1 to 5, got 9"),
    "age in yr": (" 3  10.11", " 3  1.3e10", "row 8, column logAge: must be from 5 to 10.5 (is it log10 of yr?)"),
    "no rows": (TRILEGAL.split("\n", 1)[1], "", "must have a header line and rows"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_broken_file_is_refused_in_one_clear_line(tmp_path, name):
    old, new, message = BROKEN[name]
    assert old in TRILEGAL
    with pytest.raises(InputError) as caught:
        read_catalog(saved(tmp_path, TRILEGAL.replace(old, new)), format="trilegal")
    assert message in str(caught.value)


def test_the_model_s_own_binaries_can_be_used_as_they_are(tmp_path):
    own, replaced = (
        read_catalog(data_file(REAL), options={"binaries": choice}).stars for choice in ("keep", "replace")
    )
    np.testing.assert_array_equal(own.magnitude, replaced.magnitude)
    assert replaced.mass_ratio is None
    paired = own.mass_ratio > 0
    assert 0.25 < paired.mean() < 0.40  # the model's binary fraction is 0.3, of all its rows
    assert own.mass_ratio[paired].min() >= 0.69  # and it draws ratios from 0.7 to 1
    write_stars(own, tmp_path / "own.ecsv")
    back = read_catalog(tmp_path / "own.ecsv").stars
    np.testing.assert_array_equal(back.mass_ratio, own.mass_ratio)
    models = {"multiplicity": MULTIPLICITY["dk13"], "photometry": PHOTOMETRY["main-sequence"]}
    some = own.select(magnitude=(18, 20), mass_max=1.5)
    moments = population_moments(p := Population.of(some, **models), integrate(p))
    assert moments.binary_fraction[0] == np.mean(some.mass_ratio > 0)
