"""Gaia's columns: distances against brute force, masses against the model's own, cuts, formats and the archive."""

import json
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from porrima import gaia
from porrima.catalogs import read_catalog
from porrima.errors import InputError
from porrima.gaia import distance_from_parallax, fetch_cone, mass_from_magnitude, sequence_magnitude
from porrima.galaxy import Robin2003
from porrima.photometry import MainSequence, magnitudes

ANSWER = Path(__file__).parent / "data" / "gaia_cone.vot"  # made up from model stars; it says so itself

# A dwarf, a giant, a white dwarf, a source without parallax, one with a negative parallax, one that is double.
CSV = """\
source_id,parallax,parallax_error,phot_g_mean_mag,bp_rp,ruwe,ipd_frac_multi_peak,distance_cat,A
1,2.483,0.01,16.0,1.75,1.00,0,410,0.2
2,0.183,0.01,13.0,1.20,1.00,0,5000,0.0
3,9.983,0.05,17.0,0.20,1.00,0,100,
4,,,20.5,1.00,,1,,
5,-0.317,0.30,19.0,0.80,1.10,0,6000,0.1
6,4.983,0.05,15.0,1.40,2.50,30,200,0.0
"""


def saved(folder, content, name="gaia.csv"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


# ---------------------------------------------------------------- distance


def test_distance_is_the_first_mode_of_the_posterior_found_by_brute_force():
    rng = np.random.Generator(np.random.Philox(1))
    several_modes = 10 ** rng.uniform(0.5, 2, 60)  # where the cubic may have three roots
    parallax = np.concatenate([rng.uniform(-2, 2, 30), 10 ** rng.uniform(-1, 2, 30), several_modes, [0.0]])
    wide = np.sqrt(0.75 * several_modes / 1.35) * rng.uniform(1.0, 1.3, 60)
    error = np.concatenate([10 ** rng.uniform(-2, 0.5, 60), wide, [0.3]])
    found = distance_from_parallax(parallax, error, 1350.0)
    r = np.geomspace(1e-3, 200, 200_001)  # kpc
    several = 0
    for k in range(parallax.size):
        posterior = 2 * np.log(r) - r / 1.35 - 0.5 * ((parallax[k] - 1 / r) / error[k]) ** 2
        rising = np.diff(posterior) > 0
        modes = np.flatnonzero(rising[:-1] & ~rising[1:]) + 1
        several += modes.size > 1
        assert found[k] == pytest.approx(1000 * r[modes[0]], rel=2e-4)
    assert several >= 5


def test_good_parallax_gives_its_inverse_and_a_useless_one_the_prior():
    near = distance_from_parallax(np.array([10.0, 1.0]), np.array([1e-4, 1e-4]), 1350.0)
    np.testing.assert_allclose(near, [100.0, 1000.0], rtol=1e-6)
    useless = distance_from_parallax(np.array([0.5, -0.5, 0.0]), np.full(3, 1e4), 1350.0)
    np.testing.assert_allclose(useless, 2700.0, rtol=1e-6)


def test_negative_parallax_has_a_distance_beyond_the_prior_s_mode():
    distance = distance_from_parallax(np.array([-0.01, -0.3, -1.0]), np.full(3, 0.3), 1350.0)
    assert np.all(np.diff(distance) > 0)
    assert np.all((distance > 2700) & (distance < 50_000))


# ---------------------------------------------------------------- mass


def test_mass_is_the_one_whose_magnitude_it_was():
    mass = np.array([0.08, 0.1, 0.3, 0.6, 1.0, 1.4])
    same = np.ones(mass.size)
    tracks = MainSequence().tracks(mass, -0.5 * same, 9.9 * same, "gaia_G")
    absolute = magnitudes(tracks, mass[:, None])[:, 0]
    np.testing.assert_allclose(mass_from_magnitude(absolute, -0.5, 9.9), mass, rtol=2e-3)
    beyond = mass_from_magnitude(np.array([absolute[0] + 0.01, 0.0]), -0.5, 9.9)
    assert beyond.tolist() == [0.0, np.inf]


def test_sequence_passes_through_the_sun_and_an_m4_dwarf():
    np.testing.assert_allclose(sequence_magnitude(np.array([0.823, 2.94])), [4.635, 11.21], atol=0.05)


def test_masses_of_model_stars_come_back_with_the_bias_and_scatter_that_the_docstring_states():
    rng = np.random.Generator(np.random.Philox(7))
    stars = Robin2003(extinction_per_kpc=0.0).draw(180.0, 45.0, 1.0, "gaia_G", (16.0, 20.0), rng, n=4000)
    true = 1000.0 / stars.distance
    measured = true * (1 + 0.1 * rng.normal(size=len(stars)))
    distance = distance_from_parallax(measured, 0.1 * true, 1350.0)
    absolute = stars.magnitude - 5 * np.log10(distance) + 5
    for metallicity, median, scatter in ((0.0, 1.13, 0.115), (-0.4, 1.015, 0.115)):
        ratio = mass_from_magnitude(absolute, metallicity, 9.7) / stars.mass
        low, middle, high = np.percentile(ratio, [16, 50, 84])
        assert middle == pytest.approx(median, abs=0.015)
        assert 0.5 * (high - low) == pytest.approx(scatter, abs=0.015)


# ---------------------------------------------------------------- tables


def test_rows_are_those_computed_by_hand(tmp_path):
    catalog = read_catalog(saved(tmp_path, CSV))
    stars = catalog.stars
    assert (catalog.format, stars.band, catalog.n_rows) == ("gaia", "gaia_G", 6)
    assert stars.magnitude.tolist() == [16.0, 19.0, 15.0]
    # parallax + 0.017 = 2.5 and 5 mas: 400 and 200 pc; M_G = 7.99 and 8.49 where 0.6 M_sun has 7.97
    np.testing.assert_allclose(stars.distance[[0, 2]], [400.0, 200.0], rtol=1e-3)
    assert 3000 < stars.distance[1] < 6000
    same = np.ones(2)
    tracks = MainSequence().tracks(stars.mass[[0, 2]], 0 * same, 9.7 * same, "gaia_G")
    absolute = magnitudes(tracks, stars.mass[[0, 2], None])[:, 0]
    np.testing.assert_allclose(absolute, [16 - 5 * np.log10(40), 15 - 5 * np.log10(20)], atol=5e-3)
    assert catalog.rejected == {
        "no distance": 1,
        "more than 1.5 mag above the main sequence": 1,
        "more than 4.0 mag below the main sequence": 1,
    }
    assert catalog.assumed == {
        "distance from the parallax and a prior": 3,
        "extinction neglected": 3,
        "mass from G at [M/H] 0 and log_age 9.7": 3,
        "component not given": 3,
    }


def test_distance_and_extinction_come_from_the_columns_named_for_them(tmp_path):
    path = saved(tmp_path, CSV)
    catalog = read_catalog(path, columns={"distance": "distance_cat", "extinction": "A"})
    assert catalog.stars.distance.tolist() == [410.0, 6000.0, 200.0]
    assert "distance from the parallax and a prior" not in catalog.assumed
    assert "extinction neglected" not in catalog.assumed
    plain = read_catalog(path, columns={"distance": "distance_cat"}).stars
    assert catalog.stars.mass[0] > plain.mass[0]
    assert catalog.stars.mass[2] == plain.mass[2]


@pytest.mark.parametrize("name", ["r_med_photogeo", "distance_gspphot"])
def test_the_archive_s_own_distances_are_taken_unless_the_parallax_is_named(tmp_path, name):
    text = CSV.replace("distance_cat", name).replace("30,200,", "30,,")
    catalog = read_catalog(saved(tmp_path, text))
    np.testing.assert_allclose(catalog.stars.distance, [410.0, 6000.0, 200.0], rtol=1e-3)
    assert catalog.assumed["distance from the parallax and a prior"] == 1
    parallax = read_catalog(saved(tmp_path, text), columns={"distance": "parallax"})
    assert parallax.stars.distance[0] == pytest.approx(400.0, rel=1e-3)


def test_table_with_distances_needs_no_parallax(tmp_path):
    rows = [line.split(",") for line in CSV.splitlines()]
    text = "\n".join(",".join([row[0], *row[3:]]) for row in rows).replace("distance_cat", "r_med_photogeo")
    catalog = read_catalog(saved(tmp_path, text))
    assert catalog.stars.distance.tolist() == [410.0, 6000.0, 200.0]


def test_other_names_of_the_columns_are_mapped(tmp_path):
    text = CSV.replace("phot_g_mean_mag", "Gmag").replace("bp_rp", "BP-RP").replace("parallax", "Plx")
    columns = {"phot_g_mean_mag": "Gmag", "bp_rp": "BP-RP", "parallax": "Plx", "parallax_error": "Plx_error"}
    stars = read_catalog(saved(tmp_path, text), format="gaia", columns=columns).stars
    np.testing.assert_array_equal(stars.mass, read_catalog(saved(tmp_path, CSV, "b")).stars.mass)


def test_quality_cuts_are_off_until_asked_for_and_then_counted(tmp_path):
    path = saved(tmp_path, CSV)
    assert 15.0 in read_catalog(path).stars.magnitude
    cut = read_catalog(path, options={"ruwe_max": "1.4", "ipd_frac_multi_peak_max": 2})
    assert cut.stars.magnitude.tolist() == [16.0, 19.0]
    assert cut.rejected["ruwe of 1.4 or more"] == 2  # one of them has no ruwe at all
    assert "ipd_frac_multi_peak above 2" not in cut.rejected  # the same row, counted once
    only = read_catalog(path, options={"ipd_frac_multi_peak_max": 2})
    assert only.rejected["ipd_frac_multi_peak above 2"] == 1


def test_zero_point_and_prior_can_be_changed(tmp_path):
    path = saved(tmp_path, CSV)
    shifted = read_catalog(path, options={"zero_point": 0.0}).stars
    assert shifted.distance[0] == pytest.approx(1000 / 2.483, rel=1e-3)
    short = read_catalog(path, options={"length_scale": 300.0})
    assert short.stars.distance[0] == pytest.approx(400.0, rel=1e-3)
    assert len(short.stars) < 3 or short.stars.distance[1] < 3000


def test_recorded_answer_is_read_in_every_format_alike(tmp_path):
    from astropy.table import Table  # noqa: PLC0415  (only here)

    catalog = read_catalog(ANSWER)
    assert (catalog.format, catalog.n_rows, len(catalog.stars)) == ("gaia", 62, 58)
    table = Table.read(ANSWER, format="votable")
    for form in ("ascii.ecsv", "ascii.csv", "fits"):
        path = tmp_path / form
        table.write(path, format=form)
        other = read_catalog(path)
        assert (other.format, other.rejected) == ("gaia", catalog.rejected)
        np.testing.assert_allclose(other.stars.mass, catalog.stars.mass, rtol=1e-5)


def test_wrong_options_are_refused_by_name(tmp_path):
    path = saved(tmp_path, CSV)
    for options, message in (
        ({"ruwe": 1.4}, r"^options: must be one of zero_point, .*, got ruwe$"),
        ({"ruwe_max": "low"}, r"^options, ruwe_max: must be a number, got 'low'$"),
        ({"ruwe_max": "nan"}, r"^options, ruwe_max: must be a number, got nan$"),
        ({"length_scale": 0}, r"^options, length_scale: must be in \[10, 100000\], got 0.0$"),
        ({"log_age": 5e9}, r"^options, log_age: must be in \[6, 10.3\], got 5000000000.0$"),
    ):
        with pytest.raises(InputError, match=message):
            read_catalog(path, options=options)
    with pytest.raises(InputError, match=r"band: must be gaia_G, the band of Gaia's magnitudes, got i$"):
        read_catalog(path, band="i")
    with pytest.raises(InputError, match=r"^columns: must be one of parallax, .*, got mass$"):
        read_catalog(path, columns={"mass": "A"})
    with pytest.raises(InputError, match=r"column Plx: must be in the table, for parallax; it has source_id"):
        read_catalog(path, columns={"parallax": "Plx"})
    bare = saved(tmp_path, CSV.replace(",ruwe", ",rwe"), "bare")
    with pytest.raises(
        InputError, match=r"^options, ruwe_max: needs its column, which the table lacks, got 1.4$"
    ):
        read_catalog(bare, options={"ruwe_max": 1.4})


BROKEN = {  # what is wrong: (old, new, the end of the message)
    "no parallax": (",parallax,", ",plx,", "column parallax: must be in the table, for parallax; it has source_id"),
    "no error": ("1,2.483,0.01", "1,2.483,", "row 2, column parallax_error: must be positive and finite, got nothing"),
    "error 0": ("1,2.483,0.01", "1,2.483,0", "row 2, column parallax_error: must be positive and finite, got 0"),
    "distance for parallax": ("1,2.483", "1,4100", "row 2, column parallax: must be from -1000 to 1000 mas"),
    "no number": ("1.75", "red", "row 2, column bp_rp: must be a number, got 'red'"),
    "row cut": (",0,410,0.2", "", "row 2: must have 9 fields, as the header, got 6"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_broken_file_is_refused_in_one_clear_line(tmp_path, name):
    old, new, message = BROKEN[name]
    assert old in CSV
    with pytest.raises(InputError) as caught:
        read_catalog(saved(tmp_path, CSV.replace(old, new)), format="gaia")
    assert message in str(caught.value)


# ---------------------------------------------------------------- the archive


@pytest.fixture
def archive(monkeypatch):
    """The archive's module with a recorded answer instead of the network; the queries it was sent."""
    from astropy.table import Table  # noqa: PLC0415  (only here)

    queries = []

    def launch_job_async(query):
        print("greetings")  # it is not silent
        queries.append(query)
        return types.SimpleNamespace(get_results=lambda: Table.read(ANSWER, format="votable"))

    module = types.ModuleType("astroquery.gaia")
    module.Gaia = types.SimpleNamespace(launch_job_async=launch_job_async)
    monkeypatch.setitem(sys.modules, "astroquery", types.ModuleType("astroquery"))
    monkeypatch.setitem(sys.modules, "astroquery.gaia", module)
    return types.SimpleNamespace(queries=queries, module=module)


def test_cone_is_asked_for_in_the_archive_s_language_and_read_back(tmp_path, archive, capsys):
    path = tmp_path / "cone.ecsv"
    fetch_cone(266.4, -28.9, 0.5, (15.0, 21.0), path)
    (query,) = archive.queries
    assert query.startswith("SELECT source_id, parallax, parallax_error, phot_g_mean_mag, bp_rp, ruwe, ")
    assert "FROM gaiadr3.gaia_source WHERE 1 = CONTAINS(POINT('ICRS', ra, dec), CIRCLE('ICRS', " in query
    assert query.endswith(", 0.50000000)) AND phot_g_mean_mag >= 15 AND phot_g_mean_mag < 21")
    catalog = read_catalog(path)
    assert (catalog.format, len(catalog.stars)) == ("gaia", 58)
    assert catalog.stars.area == pytest.approx(np.pi * 0.25, rel=1e-5)
    assert catalog.stars.source == "Gaia DR3, 0.5 deg around l = 266.4, b = -28.9"
    assert capsys.readouterr().out == ""


def test_centre_of_the_cone_is_turned_into_the_archive_s_coordinates(tmp_path, archive):
    fetch_cone(0.0, 90.0, 0.1, (15.0, 21.0), tmp_path / "pole.ecsv")  # north Galactic pole of 1958, in ICRS
    assert "CIRCLE('ICRS', 192.8594" in archive.queries[0]
    assert ", 27.12825" in archive.queries[0]


def test_missing_package_and_silent_archive_are_said_in_one_line(tmp_path, archive, monkeypatch):
    def no_network(_):
        raise OSError("[Errno -2] Name or service not known")

    archive.module.Gaia.launch_job_async = no_network
    with pytest.raises(
        InputError, match=r"^the Gaia archive: must answer, got \[Errno -2\] Name or service not known$"
    ):
        fetch_cone(0.0, 45.0, 0.1, (15.0, 21.0), tmp_path / "x")
    monkeypatch.setitem(sys.modules, "astroquery.gaia", None)
    with pytest.raises(InputError, match=r"^gaia: needs the package astroquery, which is not installed"):
        fetch_cone(0.0, 45.0, 0.1, (15.0, 21.0), tmp_path / "x")


def test_answer_that_the_archive_has_cut_is_refused(tmp_path, archive, monkeypatch):
    monkeypatch.setattr(gaia, "_ROWS_MAX", 62)
    with pytest.raises(InputError, match=r"^the Gaia archive: ends its answer at 62 sources: take a smaller"):
        fetch_cone(0.0, 45.0, 1.0, (15.0, 21.0), tmp_path / "x")
    assert not list(tmp_path.iterdir())


def test_empty_cone_and_wrong_arguments_are_refused(tmp_path, archive):
    from astropy.table import Table  # noqa: PLC0415  (only here)

    with pytest.raises(InputError, match=r"^radius: must be positive and no more than 10 deg, got 0$"):
        fetch_cone(0.0, 45.0, 0, (15.0, 21.0), tmp_path / "x")
    with pytest.raises(InputError, match=r"^gaia: must be a direction"):
        fetch_cone(0.0, 95.0, 1.0, (15.0, 21.0), tmp_path / "x")
    with pytest.raises(InputError, match=r"cannot be written \(No such file or directory\)"):
        fetch_cone(0.0, 45.0, 1.0, (15.0, 21.0), tmp_path / "none" / "x")
    archive.module.Gaia.launch_job_async = lambda _: types.SimpleNamespace(get_results=Table)
    with pytest.raises(InputError, match=r"^the Gaia archive: has no source in that circle"):
        fetch_cone(0.0, 45.0, 1.0, (15.0, 21.0), tmp_path / "x")


# ---------------------------------------------------------------- the command


def test_command_fetches_counts_and_writes_stars_and_the_archive_s_table(tmp_path, archive, porrima):
    raw, stars = tmp_path / "gaia.ecsv", tmp_path / "stars.ecsv"
    cone = ["--gaia", "--l", 200, "--b", 59, "--radius", 0.5, "--mag", 15, 21]
    code, out, _ = porrima("stars", *cone, "--save", raw, "-o", stars, "--json")
    assert code == 0
    result = json.loads(out)
    assert result["n"] == len(read_catalog(stars).stars) == 58
    assert result["area_deg2"] == pytest.approx(0.7854, rel=1e-3)
    assert result["rejected"]["no distance"] == 1
    assert result["assumed"]["extinction neglected"] == 58
    assert read_catalog(raw).format == "gaia"
    assert read_catalog(stars).format == "table"
    again = porrima("stars", "--catalog", raw, "--mag", 15, 21, "--options", "ruwe_max=1.4", "--json")
    assert json.loads(again[1])["n"] == 57
    assert porrima("stars", *cone, "--json")[0] == 0  # and with nothing written
    assert sorted(tmp_path.iterdir()) == [raw, stars]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--gaia", "--l", 1, "--b", 1], "--gaia: needs --l, --b and --radius"),
        (["--l", 1, "--b", 1, "--radius", 1], "--radius: needs --gaia, got 1.0"),
        (["--gaia", "--catalog", "x"], "--catalog: cannot be given together with --gaia, got x"),
        (["--gaia", "--l", 1, "--b", 1, "--radius", -1], "radius: must be positive and no more than 10 deg"),
        (
            ["--gaia", "--l", 1, "--b", 1, "--radius", 1, "--band", "i"],
            "band: must be gaia_G, the band of Gaia's",
        ),
        (
            ["--catalog", ANSWER, "--options", "ruwe_max"],
            "--options: must be option=value,option=value, got ruwe_max",
        ),
        (["--catalog", ANSWER, "--options", "ruwe=1"], "options: must be one of zero_point"),
    ],
)
def test_wrong_arguments_give_one_line(archive, porrima, arguments, message):
    code, out, err = porrima("stars", *arguments)
    assert (code, out) == (2, "")
    (line,) = [line for line in err.splitlines() if line.startswith("error: ")]
    assert message in line


def test_stars_written_in_one_band_are_not_read_in_another(tmp_path, archive, porrima):
    stars = tmp_path / "stars.ecsv"
    porrima("stars", "--gaia", "--l", 200, "--b", 59, "--radius", 0.5, "-o", stars)
    code, _, err = porrima("predict", "--stars", stars, "--mag", 16, 20, "--psf", "psf1", "--band", "i")
    assert code == 2
    assert "stars.ecsv, band: must be gaia_G, the file's own, got i" in err
