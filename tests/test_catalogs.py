"""Real catalogues against hand-read rows, and every broken variant that we could think of."""

import gzip
import io
import os
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from data_files import data_file
from porrima import stars as stars_module
from porrima import tables
from porrima.besancon import COMPONENT_AGES, sdss_i
from porrima.catalogs import READERS, read_catalog, write_stars
from porrima.errors import InputError
from porrima.stars import Stars
from test_gaia import CSV as GAIA
from test_trilegal import TRILEGAL

POLE = "catalogues/besancon_l200_b90.dat"
JOHNSON = "catalogues/besancon_l200_b59.csv"
SMALL = "catalogues/besancon_small_header_complete.txt"

# i (AB) from 16 mag on: count, median distance in pc, mean mass in M_sun
POLE_BINS = [
    (167, 726, 0.620),
    (282, 1026, 0.569),
    (336, 976, 0.487),
    (438, 1350, 0.444),
    (585, 2025, 0.420),
    (770, 4725, 0.445),
    (954, 10125, 0.454),
]
JOHNSON_BINS = [  # with i = V - (V-I) + 0.45
    (237, 835, 0.623),
    (330, 855, 0.533),
    (479, 855, 0.421),
    (632, 1080, 0.370),
    (638, 1390, 0.354),
    (751, 3335, 0.379),
    (820, 10170, 0.449),
]

# A made-up file in the model's format: a dwarf, a giant, a dwarf whose age is missing, a halo star.
BESANCON = """\
1                   ***************************
                    *      BESANCON MODEL OF STELLAR POPULATION SYNTHESIS 2003-12
  (l =    10.6; b =   -0.4)  Distance  0.0 a  50.0 kpc;  Solid angle      0.250  square degree
  Dist    Mv  CL Typ  LTef  logg Age Mass  B-V    U-B    V-I    V-K    V   [Fe/H] l      b      Av     Mbol
  0.091 10.20  5 7.20 3.559  4.85  7 0.48  1.400  1.200  2.000  4.175 15.133  0.02  10.62  -0.38  0.056  8.671
  2.000  1.20  3 6.20 3.660  2.85  6 1.10  1.000  0.900  1.000  2.500 14.000 -0.10  10.62  -0.38  0.056  1.671
  0.151 14.80  5 7.90 3.473  5.09    0.13  1.600  1.300  2.831  5.155 20.710  0.21  10.62  -0.38  0.098 12.985
 49.990  6.80  5 6.40 3.660  4.61  9 0.76  0.700  0.300  0.713  2.181 17.102 -1.57  10.62  -0.38  0.622  5.695
  Dist    Mv  CL Typ  LTef  logg Age Mass  B-V    U-B    V-I    V-K    V   [Fe/H] l      b      Av     Mbol
  Star density before selection    34935208.927 after  theorical selection   34935205.961

  TOTAL NUMBER OF STARS :    4
"""
CSV = """\
mass,distance,magnitude,metallicity,log_age,component
0.5,100.0,18.5,-0.1,9.5,thin5
1.0,2000.0,16.0,,,
"""


def saved(folder, content, name="catalogue"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def bins(stars, magnitude=None):
    magnitude = stars.magnitude if magnitude is None else magnitude
    rows = []
    for low in range(16, 23):
        inside = (magnitude >= low) & (magnitude < low + 1) & (stars.mass <= 1.5)
        rows.append((inside.sum(), np.median(stars.distance[inside]), stars.mass[inside].mean()))
    return rows


def assert_bins(found, expected):
    for (n, distance, mass), (n_facts, distance_facts, mass_facts) in zip(found, expected, strict=True):
        assert n == n_facts
        assert distance == pytest.approx(distance_facts, abs=0.51)
        assert mass == pytest.approx(mass_facts, abs=5.1e-4)


# ---------------------------------------------------------------- the real files


def test_the_pole_has_the_stars_of_each_magnitude_that_the_facts_list():
    catalog = read_catalog(data_file(POLE))
    assert_bins(bins(catalog.stars), POLE_BINS)
    assert catalog.format == "besancon"
    assert (catalog.n_rows, len(catalog.stars)) == (3865, 3655)
    assert catalog.rejected == {"not on the main sequence": 210}
    assert catalog.assumed == {}
    assert catalog.pointing == (200.0, 90.0)
    assert (catalog.stars.area, catalog.stars.band) == (1.0, "i")


def test_rows_of_the_pole_are_those_read_by_eye():
    stars = read_catalog(data_file(POLE)).stars
    np.testing.assert_allclose(stars.mass[[0, 1, 2]], [0.14, 0.09, 0.13])
    np.testing.assert_allclose(stars.distance[[0, 1, -1]], [33.0, 52.0, 49875.0])
    np.testing.assert_allclose(stars.magnitude[[0, 1, -1]], [15.549, 18.928, 22.806])
    np.testing.assert_allclose(stars.metallicity[[0, 2, -1]], [0.02, -0.07, -2.07])
    assert stars.component[[0, 1, 2, -1]].tolist() == ["thin6", "thin2", "thin5", "halo"]
    np.testing.assert_allclose(10 ** (stars.log_age[[0, 1, -1]] - 9), [6.0, 0.575, 14.0])


def test_other_bands_of_the_pole_come_from_its_colours():
    first = {band: read_catalog(data_file(POLE), band=band).stars.magnitude[0] for band in "ugriz"}
    i, r = 15.549, 15.549 + 1.663
    expected = {"i": i, "r": r, "g": r + 1.286, "u": r + 1.286 + 2.750, "z": i - 0.698}
    assert first == pytest.approx(expected)


def test_johnson_file_with_the_rough_term_has_the_stars_that_the_facts_list():
    cousins = read_catalog(data_file(JOHNSON), band="I").stars
    assert_bins(bins(cousins, cousins.magnitude + 0.45), JOHNSON_BINS)


def test_johnson_file_reads_as_the_same_model_without_an_area():
    catalog = read_catalog(data_file(JOHNSON))
    assert (catalog.n_rows, len(catalog.stars)) == (6145, 5865)
    assert catalog.rejected == {"not on the main sequence": 280}
    assert catalog.assumed == {"i from V and V-I": 5865}
    assert catalog.pointing == (200.0, 59.0)
    assert catalog.stars.area is None
    np.testing.assert_allclose(catalog.stars.mass[[0, 3, -1]], [0.20, 0.09, 0.62])
    np.testing.assert_allclose(catalog.stars.distance[[0, 3, -1]], [65.0, 85.0, 49975.0])
    assert catalog.stars.component[[0, 1, 2, -1]].tolist() == ["thin7", "thin5", "thin3", "halo"]


def test_better_colour_term_dims_red_dwarfs_and_moves_the_counts_by_less_than_an_eighth():
    stars = read_catalog(data_file(JOHNSON)).stars
    ratio = [n / rough[0] for (n, _, _), rough in zip(bins(stars), JOHNSON_BINS, strict=True)]
    assert min(ratio) > 0.88
    assert max(ratio) < 1.06


def test_small_file_without_hashes_has_its_thirteen_stars():
    catalog = read_catalog(data_file(SMALL), band="V")
    assert (catalog.n_rows, catalog.rejected) == (13, {"not on the main sequence": 1})
    assert catalog.stars.area == 0.111
    assert catalog.pointing == (10.62, -0.38)
    np.testing.assert_allclose(catalog.stars.magnitude[:3], [15.133, 20.568, 20.710])
    np.testing.assert_allclose(catalog.stars.distance[[0, -1]], [91.0, 49995.0])
    assert read_catalog(data_file(SMALL), band="J").stars.magnitude[0] == pytest.approx(
        15.133 - 4.175 + 0.824
    )


def test_small_file_has_no_i_and_says_which_bands_it_has():
    with pytest.raises(InputError, match=r"band: must be one of H, J, K, V, which the file has, got i$"):
        read_catalog(data_file(SMALL))


# ---------------------------------------------------------------- the Besançon format


def test_row_without_its_age_is_kept_with_what_it_lacks_counted(tmp_path):
    catalog = read_catalog(saved(tmp_path, BESANCON))
    assert catalog.stars.component.tolist() == ["thin7", "unknown", "halo"]
    np.testing.assert_allclose(catalog.stars.log_age, [9 + np.log10(8.5), 9.7, 9 + np.log10(14)])
    np.testing.assert_allclose(catalog.stars.mass, [0.48, 0.13, 0.76])
    assert catalog.assumed == {
        "i from V and V-I": 3,
        "log_age not given, 9.7 taken": 1,
        "component not given": 1,
    }
    assert catalog.rejected == {"not on the main sequence": 1}
    assert catalog.n_rows == 4
    assert (catalog.stars.area, catalog.pointing) == (0.25, (10.62, -0.38))


def test_empty_age_of_a_csv_row_is_a_missing_one(tmp_path):
    text = "Dist,CL,Typ,LTef,Age,Mass,V-I,V,[Fe/H]\n0.1,5,7,3.5,,0.2,2.0,18,0.1\n"
    stars = read_catalog(saved(tmp_path, text)).stars
    assert stars.component.tolist() == ["unknown"]
    assert stars.log_age.tolist() == [9.7]


def test_ages_missing_from_a_catalogue_are_those_that_stars_takes():
    defaults = stars_module.Stars.from_columns(mass=[1.0], distance=[1.0], magnitude=[1.0])
    assert (defaults.metallicity[0], defaults.log_age[0]) == (0.0, 9.7)


def test_mean_ages_lie_in_the_middle_of_their_components():
    edges = [0.0, 0.15, 1, 2, 3, 5, 7, 10]
    np.testing.assert_allclose(COMPONENT_AGES[:7], 0.5 * (np.array(edges[1:]) + edges[:-1]))


def test_columns_are_found_by_name_not_by_place(tmp_path):
    text = "V,V-I,CL,Typ,LTef,Mass,Dist,Age,[Fe/H],mul,mub,Vr\n18,2.0,5,7.2,3.5,0.3,0.4,8,-0.8,1,2,3\n"
    stars = read_catalog(saved(tmp_path, text), band="V").stars
    assert (stars.mass[0], stars.distance[0], stars.magnitude[0]) == (0.3, 400.0, 18.0)
    assert stars.component.tolist() == ["thick"]


def test_unused_column_that_overflowed_does_not_matter(tmp_path):
    text = BESANCON.replace("  0.056  8.671", "  0.056 ******")
    np.testing.assert_array_equal(
        read_catalog(saved(tmp_path, text)).stars.mass,
        read_catalog(saved(tmp_path, BESANCON, "b")).stars.mass,
    )


def test_hash_crlf_byte_order_mark_and_gzip_change_nothing(tmp_path):
    plain = read_catalog(saved(tmp_path, BESANCON)).stars
    lines = BESANCON.splitlines()
    hashed = "\r\n".join(line if line.lstrip()[:2] in ("0.", "2.", "49") else "#" + line for line in lines)
    for content in (hashed, "\ufeff" + BESANCON, gzip.compress(BESANCON.encode())):
        other = read_catalog(saved(tmp_path, content)).stars
        np.testing.assert_array_equal(other.magnitude, plain.magnitude)
        assert other.area == plain.area


def test_star_without_mass_or_magnitude_is_rejected_and_counted(tmp_path):
    text = BESANCON.replace(" 0.48 ", " 0.00 ").replace("17.102", "99.000")
    catalog = read_catalog(saved(tmp_path, text))
    assert catalog.rejected == {"not on the main sequence": 1, "no mass": 1, "no magnitude": 1}
    assert catalog.n_rows == len(catalog.stars) + sum(catalog.rejected.values())


# ---------------------------------------------------------------- the colour term


def test_colour_term_is_the_published_line_at_a_hand_computed_star():
    # V - I = 2.831 has R - I = 1.590: i = 20 - 2.831 + 0.247 * 1.590 + 0.329
    assert sdss_i(np.array([20.0]), np.array([2.831]))[0] == pytest.approx(17.89073)


def test_colour_term_agrees_with_two_other_published_routes():
    # Spectral type, V-Ic, V-Rc, i-z of Pecaut & Mamajek; Lupton: I = i - 0.3780 (i-z) - 0.3974
    dwarfs = np.array([[1.766, 0.889, 0.33], [2.173, 1.001, 0.53], [2.42, 1.079, 0.61], [3.277, 1.446, 0.91]])
    v_minus_i, v_minus_r, i_minus_z = dwarfs.T
    i_minus_cousins = sdss_i(np.zeros(4), v_minus_i) + v_minus_i
    np.testing.assert_allclose(i_minus_cousins, 0.3780 * i_minus_z + 0.3974, atol=0.05)
    # Jordi et al.: r - i = 1.007 (R-I) - 0.236, r - R = 0.267 (V-R) + 0.088, or 0.77 (V-R) - 0.37 beyond 0.93
    v_minus_i, v_minus_r = np.array([[0.713, 0.363], [1.272, 0.685], [1.766, 0.889], [2.42, 1.079]]).T
    r_minus_i = v_minus_i - v_minus_r
    r_minus_cousins = np.where(v_minus_r > 0.93, 0.77 * v_minus_r - 0.37, 0.267 * v_minus_r + 0.088)
    other = r_minus_cousins - (1.007 * r_minus_i - 0.236) + r_minus_i
    np.testing.assert_allclose(sdss_i(np.zeros(4), v_minus_i) + v_minus_i, other, atol=0.03)


# ---------------------------------------------------------------- tables


def test_csv_needs_no_more_than_mass_distance_and_magnitude(tmp_path):
    catalog = read_catalog(saved(tmp_path, "mass,distance,magnitude\n0.5,100,18.5\n"))
    assert catalog.format == "table"
    assert (catalog.stars.metallicity[0], catalog.stars.log_age[0]) == (0.0, 9.7)
    assert catalog.stars.component.tolist() == ["unknown"]
    assert catalog.assumed["luminosity class not given, main sequence taken"] == 1


def test_empty_cells_of_optional_columns_are_filled_and_counted(tmp_path):
    catalog = read_catalog(saved(tmp_path, CSV))
    assert catalog.stars.component.tolist() == ["thin5", "unknown"]
    np.testing.assert_array_equal(catalog.stars.log_age, [9.5, 9.7])
    assert catalog.assumed["metallicity not given, 0.0 taken"] == 1


@pytest.mark.parametrize(
    "text",
    [
        "M,D,imag,class\n0.5,100,18.5,5\n2,50,12,3\n",
        "M\tD\timag\tclass\n0.5\t100\t18.5\t5\n2\t50\t12\t3\n",
        "  M   D    imag  class\n 0.5  100  18.5   5\n 2  50  12  3\n",
        "# made by hand\n# M D imag class\n0.5 100 18.5 5\n2 50 12 3\n",
    ],
    ids=["commas", "tabs", "spaces", "commented header"],
)
def test_columns_are_mapped_and_luminosity_class_selects(tmp_path, text):
    columns = {"mass": "M", "distance": "D", "magnitude": "imag", "luminosity_class": "class"}
    catalog = read_catalog(saved(tmp_path, text), columns=columns)
    assert (catalog.stars.mass.tolist(), catalog.stars.distance.tolist()) == ([0.5], [100.0])
    assert catalog.rejected == {"not on the main sequence": 1}


@pytest.mark.parametrize("form", ["fits", "votable", "ascii.ecsv"])
def test_units_are_honoured_in_every_format_that_has_them(tmp_path, form):
    from astropy import units as u  # noqa: PLC0415  (only here)
    from astropy.table import QTable  # noqa: PLC0415

    table = QTable()
    table["M"] = [500.0, 1000.0] * u.Unit("1e-3 solMass") if form != "fits" else [0.5, 1.0] * u.solMass
    table["D"] = [0.1, 2.0] * u.kpc
    table["imag"] = [18.5, 16.0] * u.mag
    path = tmp_path / "table"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        table.write(path, format=form)
    stars = read_catalog(path, columns={"mass": "M", "distance": "D", "magnitude": "imag"}).stars
    np.testing.assert_allclose(stars.distance, [100.0, 2000.0])
    np.testing.assert_allclose(stars.mass, [0.5, 1.0])


def test_decades_keep_their_zero_point(tmp_path):
    text = "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: mass, datatype: float64}\n"
    text += (
        "# - {name: distance, datatype: float64}\n# - {name: magnitude, unit: mag(AB), datatype: float64}\n"
    )
    text += (
        "# - {name: log_age, unit: dex(Gyr), datatype: float64}\nmass distance magnitude log_age\n1 2 3 0.5\n"
    )
    stars = read_catalog(saved(tmp_path, text)).stars
    assert (stars.magnitude[0], stars.log_age[0]) == pytest.approx((3.0, 9.5))
    plain = read_catalog(saved(tmp_path, text.replace("dex(Gyr)", "dex"))).stars
    assert plain.log_age[0] == 0.5


def test_metadata_of_a_table_gives_band_area_and_source(tmp_path):
    from astropy.table import Table  # noqa: PLC0415

    table = Table([[0.5], [100.0], [18.5]], names=["mass", "distance", "magnitude"])
    table.meta = {"band": "z", "area_deg2": 2.5, "source": "by hand"}
    table.write(tmp_path / "t", format="ascii.ecsv")
    stars = read_catalog(tmp_path / "t").stars
    assert (stars.band, stars.area, stars.source) == ("z", 2.5, "by hand")
    with pytest.raises(InputError, match=r"t, band: must be z, the file's own, got i$"):
        read_catalog(tmp_path / "t", band="i")


@pytest.mark.parametrize("area", [None, 0.25])
def test_stars_written_are_stars_read(tmp_path, area):
    rng = np.random.Generator(np.random.Philox(5))
    stars = Stars(
        mass=rng.uniform(0.1, 1.5, 50),
        distance=rng.uniform(1, 5e4, 50),
        magnitude=rng.uniform(-5, 30, 50),
        metallicity=rng.normal(size=50),
        log_age=rng.uniform(6, 10.2, 50),
        component=rng.choice(["thin1", "halo", "unknown"], 50),
        band="euclid_VIS",
        area=area,
        source="Besançon: l = 10°, “quoted”, 50 %",
    )
    path = tmp_path / "stars.ecsv"
    path.write_text("an older file")
    write_stars(stars, path)
    back = read_catalog(path).stars
    for name in ("mass", "distance", "magnitude", "metallicity", "log_age", "component"):
        np.testing.assert_array_equal(getattr(back, name), getattr(stars, name))
    assert (back.band, back.area, back.source) == (stars.band, stars.area, stars.source)
    assert os.listdir(tmp_path) == ["stars.ecsv"]


def test_real_catalogue_survives_writing_and_reading(tmp_path):
    stars = read_catalog(data_file(POLE)).stars
    write_stars(stars, tmp_path / "s")
    back = read_catalog(tmp_path / "s").stars
    np.testing.assert_array_equal(back.magnitude, stars.magnitude)
    np.testing.assert_array_equal(back.component, stars.component)
    assert (back.area, back.source) == (stars.area, stars.source)


def test_astropy_reads_the_written_file_with_its_units(tmp_path):
    from astropy.table import QTable  # noqa: PLC0415

    write_stars(
        Stars.from_columns(mass=[1.0], distance=[10.0], magnitude=[4.8], log_age=9.66), tmp_path / "s"
    )
    table = QTable.read(tmp_path / "s", format="ascii.ecsv")
    assert {name: str(table[name].unit) for name in ("mass", "distance", "magnitude", "log_age")} == {
        "mass": "solMass",
        "distance": "pc",
        "magnitude": "mag",
        "log_age": "dex(yr)",
    }


def test_failed_writing_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "stars.ecsv"
    path.write_text("an older file")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(
        InputError, match=r"output: cannot be written \(No space left on device\), got .*stars.ecsv$"
    ):
        write_stars(Stars.from_columns(mass=[1.0], distance=[10.0], magnitude=[4.8]), path)
    assert path.read_text() == "an older file"
    assert os.listdir(tmp_path) == ["stars.ecsv"]


def test_writing_into_a_folder_that_is_not_there_is_an_input_error(tmp_path):
    stars = Stars.from_columns(mass=[1.0], distance=[10.0], magnitude=[4.8])
    with pytest.raises(InputError, match=r"cannot be written \(No such file or directory\)"):
        write_stars(stars, tmp_path / "none" / "s")
    with pytest.raises(InputError, match=r"cannot be written \(Is a directory\)"):
        write_stars(stars, tmp_path)


# ---------------------------------------------------------------- what is on the main sequence, and large files


def test_brown_dwarfs_are_counted_so_that_they_do_not_stop_a_command(tmp_path):
    catalog = read_catalog(saved(tmp_path, CSV + "0.05,10,18,0,9,thin5\n0.08,10,18,0,9,thin5\n"))
    assert catalog.stars.mass.tolist() == [0.5, 1.0, 0.08]
    assert catalog.rejected == {"below 0.08 M_sun": 1}


def test_large_fits_file_is_read_in_pieces_with_the_columns_in_use_only(tmp_path, monkeypatch):
    from astropy.table import Table  # noqa: PLC0415

    rng = np.random.Generator(np.random.Philox(3))
    n = 1000
    table = Table({f"x{k}": rng.normal(size=n) for k in range(20)})
    table["M"] = rng.uniform(0.1, 1.0, n)
    table["D"] = rng.uniform(0.1, 2.0, n)
    table["D"].unit = "kpc"
    table["i"] = np.ma.masked_greater(rng.integers(15, 20, n), 18)
    table["component"] = rng.choice(["thin5", "halo"], n)
    table.meta["BAND"] = "z"
    path = tmp_path / "large.fits"
    table.write(path)
    columns = {"mass": "M", "distance": "D", "magnitude": "i"}
    whole = read_catalog(path, columns=columns)
    monkeypatch.setattr(tables, "_PIECE", 50_000)
    pieces = read_catalog(path, columns=columns)
    assert whole.rejected == pieces.rejected == {"no magnitude": int(np.sum(table["i"].mask))}
    for name in ("mass", "distance", "magnitude", "component"):
        np.testing.assert_array_equal(getattr(whole.stars, name), getattr(pieces.stars, name))
    assert pieces.stars.band == "z"
    np.testing.assert_allclose(pieces.stars.distance, 1000 * np.asarray(table["D"])[~table["i"].mask])
    with pytest.raises(InputError, match="column mass: must be in the table, for mass; it has x0, x1, x2"):
        read_catalog(path)


def test_parquet_is_read_where_its_package_is_installed(tmp_path):
    pytest.importorskip("pyarrow")
    from astropy.table import Table  # noqa: PLC0415

    table = Table.read(GAIA, format="ascii.csv")
    table.write(tmp_path / "t", format="parquet")
    catalog = read_catalog(tmp_path / "t")
    assert catalog.format == "gaia"
    np.testing.assert_array_equal(catalog.stars.mass, read_catalog(saved(tmp_path, GAIA)).stars.mass)


def test_parquet_without_its_package_is_said_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"is a Parquet file, which needs the package pyarrow: install it"):
        read_catalog(saved(tmp_path, b"PAR1" + bytes(100) + b"PAR1"))


# ---------------------------------------------------------------- broken files

ROW = BESANCON.splitlines()[4]
NAMES = "Dist Mv CL Typ LTef logg Age Mass B-V U-B V-I V-K V [Fe/H] l b Av Mbol"
MASS_RULE = "must be positive and finite (0 where unknown)"
NO_STAR = "must hold at least one main-sequence star with mass and magnitude"
CODED = "must be UTF-8 text or a FITS table"
COMPONENT_RULE = "must be one of thin1, thin2, thin3, thin4, thin5, thin6, thin7, thick, halo, bulge, unknown"


def replaced(old, new, text=BESANCON):
    assert old in text
    return text.replace(old, new)


def in_csv(old, new):
    return replaced(old, new, CSV)


BROKEN = {  # what is wrong: (content, the end of the message)
    "empty": ("", ": must not be empty"),
    "blank": (" \n\n  \n", ": must not be empty"),
    "binary": (b"MZ\x00\x01\x02", f", row 1: {CODED}, got byte 0x00"),
    "latin1": (replaced("POPULATION", "éa").encode("latin1"), f", row 2: {CODED}, got byte 0xe9"),
    "utf16": (CSV.encode("utf-16"), f", row 1: {CODED}, got byte 0xff"),
    "no header line": (
        replaced("LTef", "Teff"),
        ": must have the header line of the Besançon model (Dist Mv CL Typ LTef ...)",
    ),
    "no mass column": (
        replaced(" Mass ", " Mini "),
        f", row 4, column Mass: must be there; the file has {NAMES.replace('Mass', 'Mini')}",
    ),
    "no distance column": (
        replaced("  Dist  ", "  Mu  "),
        f", row 4, column Dist: must be there; the file has {NAMES.replace('Dist', 'Mu')}",
    ),
    "column twice": (replaced(" Mv ", " Mass "), ", row 4, column Mass: must be there once only"),
    "no rows": ("\n".join(BESANCON.splitlines()[:4]), ", row 4: must have rows below its header line"),
    "row cut at its end": (
        replaced("  0.056  8.671", "  0.056"),
        ", row 5: must have 18 fields, as the header, got 17",
    ),
    "row cut in half": (replaced(ROW, ROW[:40]), ", row 5: must have 18 fields, as the header, got 8"),
    "row too long": (replaced(ROW, ROW + " 1"), ", row 5: must have 18 fields, as the header, got 19"),
    "prose in the rows": (
        replaced(ROW, ROW + "\nsee text"),
        ", row 6: must have 18 fields, as the header, got 2",
    ),
    "no number": (replaced(" 0.76 ", " o.76 "), ", row 8, column Mass: must be a number, got 'o.76'"),
    "nan mass": (replaced(" 0.76 ", "  nan "), f", row 8, column Mass: {MASS_RULE}, got nothing"),
    "negative mass": (replaced(" 0.76 ", " -.76 "), f", row 8, column Mass: {MASS_RULE}, got -0.76"),
    "zero distance": (
        replaced(" 49.990 ", " 0.000 "),
        ", row 8, column Dist: must be positive and finite, got 0",
    ),
    "negative distance of a giant": (
        replaced("  2.000  1.20", " -2.000  1.20"),
        ", row 6, column Dist: must be positive and finite, got -2",
    ),
    "component 12": (
        replaced(" 9 0.76", "12 0.76"),
        ", row 8, column Age: must be the number of a component, 1 to 10, got 12",
    ),
    "infinite metallicity": (
        replaced("-1.57", "  inf"),
        ", row 8, column [Fe/H]: must be finite, got inf",
    ),
    "rows lost": (
        replaced(ROW + "\n", ""),
        ": must have as many rows as its TOTAL NUMBER OF STARS says, 4 (or no such line), got 3",
    ),
    "no area": (
        replaced("0.250", "0.000"),
        ": Solid angle must be positive and no more than the sky, got 0.000",
    ),
    "no band": (
        replaced("  V  ", "  W  ").replace("V-", "W-"),
        ", band: must be one of none, which the file has, got i",
    ),
    "giants only": (replaced("  5 ", "  3 "), f": {NO_STAR}, got 4 not on the main sequence"),
    "csv without mass": (
        in_csv("mass", "M"),
        ", column mass: must be in the table, for mass;"
        " it has M, distance, magnitude, metallicity, log_age, component",
    ),
    "csv with no rows": (CSV.splitlines()[0], ", row 1: must have rows below its header line"),
    "csv row too short": (CSV + "0.5,100\n", ", row 4: must have 6 fields, as the header, got 2"),
    "csv row too long": (CSV + "1,2,3,4,5,halo,7\n", ", row 4: must have 6 fields, as the header, got 7"),
    "csv no number": (
        "# note\n" + in_csv("2000.0", "2 kpc"),
        ", row 4, column distance: must be a number, got '2 kpc'",
    ),
    "csv empty mass": (in_csv("1.0,", ","), f", row 3, column mass: {MASS_RULE}, got nothing"),
    "csv negative distance": (
        in_csv("2000.0", "-1"),
        ", row 3, column distance: must be positive and finite, got -1",
    ),
    "csv infinite mass": (in_csv("1.0,", "inf,"), f", row 3, column mass: {MASS_RULE}, got inf"),
    "csv odd component": (in_csv("thin5", "disc"), f", row 2, column component: {COMPONENT_RULE}, got disc"),
    "csv without header": (
        "0.5,100,18\n0.6,100,19\n",
        ", row 1: must be a header line that names the columns, got 0.5,100,18",
    ),
    "comments only": ("# nothing\n", ": must have a header line and rows"),
    "distance in pc for kpc": (
        replaced(" 49.990 ", " 49990. "),
        ", row 8, column Dist: must be in kpc and no more than the 50.0 of the header, got 49990",
    ),
    "csv distance in kpc": (
        in_csv("100.0", "0.1"),
        ", row 2, column distance: must be from 1 to 2e+06 pc (is it in pc?), got 0.1",
    ),
    "csv mass in kg": (
        in_csv("1.0,", "1.99e30,"),
        ", row 3, column mass: must be no more than 500 M_sun (is it in M_sun?), got 1.99e+30",
    ),
    "no mass anywhere": (
        in_csv("0.5,", "0,").replace("1.0,", "0,"),
        f": {NO_STAR}, got 2 no mass",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_file_is_refused_in_one_clear_line(tmp_path, name):
    content, message = BROKEN[name]
    path = saved(tmp_path, content)
    with pytest.raises(InputError) as caught:
        read_catalog(path)
    assert str(caught.value) == f"{path}{message}"


def test_gzip_file_that_was_cut_is_refused(tmp_path):
    with pytest.raises(InputError, match="must be a whole gzip file, got Compressed file ended before"):
        read_catalog(saved(tmp_path, gzip.compress(BESANCON.encode())[:-9]))


def test_unit_of_another_kind_is_refused_by_name(tmp_path):
    text = "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: mass, datatype: float64}\n"
    text += "# - {name: distance, unit: kg, datatype: float64}\n# - {name: magnitude, datatype: float64}\n"
    text += "mass distance magnitude\n1 2 3\n"
    with pytest.raises(InputError, match=r"column distance: must be in a unit like pc, got kg$"):
        read_catalog(saved(tmp_path, text))
    with pytest.raises(InputError, match=r"column distance: must be in a unit like pc, got parsnip$"):
        read_catalog(saved(tmp_path, text.replace("kg", "parsnip")))


def test_row_of_a_fits_table_is_named(tmp_path):
    from astropy.table import Table  # noqa: PLC0415

    table = Table([[0.5, 1.0], [100.0, -3.0], [18.0, 99.0]], names=["mass", "distance", "magnitude"])
    stream = io.BytesIO()
    table.write(stream, format="fits")
    content = stream.getvalue()
    with pytest.raises(InputError, match=r"row 2, column distance: must be positive and finite, got -3$"):
        read_catalog(saved(tmp_path, content))
    with pytest.raises(InputError, match="must be a table that astropy reads"):
        read_catalog(saved(tmp_path, content[:3000]))


def test_what_is_no_file_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"must be a file, not a directory$"):
        read_catalog(tmp_path)
    with pytest.raises(InputError, match=r"none: must be a readable file, got No such file or directory$"):
        read_catalog(tmp_path / "none")
    with pytest.raises(InputError, match="must be the name of a file"):
        read_catalog("a\0b")
    with pytest.raises(InputError, match=r"must be a file, not a device$"):
        read_catalog("/dev/null")


def test_file_that_may_not_be_read_is_refused(tmp_path, monkeypatch):
    def refused(*_):
        raise PermissionError(13, "Permission denied")

    path = saved(tmp_path, CSV)
    monkeypatch.setattr(Path, "open", refused)  # for root there is no such file
    with pytest.raises(InputError, match=r"must be a readable file, got Permission denied$"):
        read_catalog(path)


def test_wrong_options_are_refused_by_name(tmp_path):
    path = saved(tmp_path, CSV)
    with pytest.raises(
        InputError, match=r"^format: must be one of besancon, trilegal, gaia, table, got trilegall$"
    ):
        read_catalog(path, format="trilegall")
    with pytest.raises(InputError, match=r"^columns: must be one of mass, distance, .*, got weight$"):
        read_catalog(path, columns={"weight": "mass"})
    with pytest.raises(
        InputError, match=r"column Mini: must be in the table, for mass; it has mass, distance"
    ):
        read_catalog(path, columns={"mass": "Mini"})
    with pytest.raises(InputError, match=r"^columns: must not be given for a Besançon file"):
        read_catalog(saved(tmp_path, BESANCON), columns={"mass": "Mass"})
    with pytest.raises(InputError, match="must have the header line of the Besançon model"):
        read_catalog(saved(tmp_path, CSV), format="besancon")
    for content in (CSV, BESANCON):
        with pytest.raises(
            InputError, match=r"^options: must be one of none, for this format, got binaries$"
        ):
            read_catalog(saved(tmp_path, content), options={"binaries": "drop"})


# ---------------------------------------------------------------- anything at all

FUZZ = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
JUNK = st.one_of(
    st.sampled_from(
        ["nan", "inf", "-1", "1e999", "99", "", "#", ",", '"', "\t", "0", "é", "1_0", "9" * 5000]
    ),
    st.text(max_size=8),
)


def only_input_errors(path, **options):
    try:
        catalog = read_catalog(path, **options)
    except InputError:
        return
    assert catalog.n_rows == len(catalog.stars) + sum(catalog.rejected.values())


@given(content=st.binary(max_size=400), form=st.sampled_from([None, *READERS]))
@FUZZ
def test_random_bytes_raise_nothing_but_input_errors(tmp_path, content, form):
    only_input_errors(saved(tmp_path, content), format=form)


@given(
    start=st.sampled_from(["besancon", "csv", "ecsv", "fits", "votable", "trilegal", "gaia", "gaia-ecsv"]),
    edits=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 10**6), JUNK), min_size=1, max_size=4),
    band=st.sampled_from([None, "i", "V", "gaia_G", "x"]),
)
@FUZZ
def test_mutated_files_raise_nothing_but_input_errors(tmp_path, start, edits, band):
    content = seeds()[start]
    for where, length, junk in edits:
        k = where % (len(content) + 1)
        content = content[:k] + junk.encode(errors="replace") + content[k + length % 12 :]
    only_input_errors(saved(tmp_path, content), band=band)


@given(
    start=st.sampled_from(["besancon", "trilegal", "gaia"]),
    edits=st.lists(st.tuples(st.integers(0, 11), st.integers(0, 60), JUNK), min_size=1, max_size=3),
    band=st.sampled_from([None, "i", "V"]),
    options=st.sampled_from([{}, {"binaries": "drop"}, {"ruwe_max": 1.4}, {"log_age": "1e1"}]),
)
@FUZZ
def test_fields_of_a_catalogue_replaced_by_junk_raise_nothing_but_input_errors(
    tmp_path, start, edits, band, options
):
    mark = "," if start == "gaia" else " "
    lines = [line.split(mark) for line in seeds()[start].decode().splitlines()]
    for row, field, junk in edits:
        line = lines[row % len(lines)]
        line[field % len(line)] = junk
    content = "\n".join(mark.join(line) for line in lines)
    only_input_errors(saved(tmp_path, content), band=band, options=options)


def seeds():
    if not _SEEDS:
        from astropy.table import Table  # noqa: PLC0415

        table = Table([[0.5, 1.0], [100.0, 3.0], [18.0, 99.0]], names=["mass", "distance", "magnitude"])
        table["distance"].unit = "pc"
        _SEEDS.update(besancon=BESANCON.encode(), csv=CSV.encode())
        _SEEDS.update(trilegal=TRILEGAL.encode(), gaia=GAIA.encode())
        stream = io.StringIO()
        Table.read(GAIA, format="ascii.csv").write(stream, format="ascii.ecsv")
        _SEEDS["gaia-ecsv"] = stream.getvalue().encode()
        for name in ("ecsv", "fits", "votable"):
            stream = io.StringIO() if name == "ecsv" else io.BytesIO()
            table.write(stream, format="ascii.ecsv" if name == "ecsv" else name)
            value = stream.getvalue()
            _SEEDS[name] = value.encode() if isinstance(value, str) else value
    return _SEEDS


_SEEDS = {}
