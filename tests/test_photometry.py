import numpy as np
import pytest
from astropy.table import Table

from data_files import data_file
from porrima.photometry import PHOTOMETRY, HabetsHeintze1981, MainSequence, flux_ratio, magnitudes


def place(model, mass, mh=0.0, log_age=9.0, band="i"):
    mass = np.atleast_1d(np.asarray(mass, dtype=float))
    return model.tracks(mass, np.full(mass.shape, mh), np.full(mass.shape, log_age), band)


@pytest.mark.parametrize("band", ["i", "euclid_VIS", "gaia_G", "roman_F158"])
def test_the_table_is_met_at_its_own_points(band):
    table = Table.read(str(data_file("main_sequence_photometry.ecsv")), format="ascii.ecsv")
    for mh, log_age in ((-2.0, 9.0), (-0.5, 9.8), (0.0, 10.2), (0.3, 9.8)):
        rows = table[(table["mh"] == mh) & (table["log_age"] == log_age)]
        mass = np.asarray(rows["mass"], dtype=float)
        tracks = place(MainSequence(), mass, mh, log_age, band)
        # linear on a grid of 0.0025 dex: off by a quarter of a step times the change of slope at a node
        np.testing.assert_allclose(magnitudes(tracks, mass[:, None])[:, 0], rows[band], atol=0.02)


def test_between_points_magnitudes_are_linear_in_log_mass_metallicity_and_age():
    model = MainSequence()
    middle = np.sqrt(0.5 * 0.55)
    ends = magnitudes(place(model, [0.5, 0.55]), np.array([[0.5], [0.55]]))
    assert magnitudes(place(model, middle), np.array([[middle]]))[0, 0] == pytest.approx(
        ends.mean(), abs=2e-3
    )
    mean_age = np.log10(0.5 * (10**9.0 + 10**9.8))
    for points in (((0.0, 9.0), (-0.5, 9.0), (-0.25, 9.0)), ((0.0, 9.0), (0.0, 9.8), (0.0, mean_age))):
        m = np.array([[0.4]])
        at = [magnitudes(place(model, 0.4, *point), m)[0, 0] for point in points]
        assert at[2] == pytest.approx(0.5 * (at[0] + at[1]), abs=1e-12)


def test_low_masses_end_where_besancon_has_them():
    model = MainSequence()
    m = magnitudes(place(model, 0.1), np.array([[0.09, 0.08, 0.0799]]))[0]
    assert m[1] - m[0] == pytest.approx(16.28 - 14.55, abs=0.02)
    assert np.isinf(m[2])


def test_a_dark_companion_gives_no_light():
    assert flux_ratio(place(MainSequence(), 0.5), np.array([0.5]), np.array([[0.1, 0.159]])).tolist() == [
        [0, 0]
    ]


@pytest.mark.parametrize("name", PHOTOMETRY)
@pytest.mark.parametrize("mh", [-2.5, -1.0, 0.0, 0.5])
@pytest.mark.parametrize("log_age", [8.0, 9.8, 10.3])
def test_flux_ratios_rise_to_one(name, mh, log_age):
    mass = np.linspace(0.08, 1.5, 60)
    q = np.linspace(0.1, 1.0, 91)[None, :]
    f = flux_ratio(place(PHOTOMETRY[name], mass, mh, log_age), mass, np.repeat(q, mass.size, axis=0))
    assert np.all((f >= 0) & (f <= 1))
    # The table of PARSEC is not monotonic near the turn-off of old, metal-rich stars to better than this.
    assert np.all(np.diff(f, axis=1) > -1e-12)
    np.testing.assert_allclose(f[:, -1], 1.0, rtol=1e-12)


def test_a_main_sequence_star_is_not_older_than_its_turn_off():
    model = MainSequence()
    old, young = (place(model, 1.3, 0.0, age) for age in (10.1, 9.0))
    oldest = magnitudes(old, np.array([[1.3]]))[0, 0]
    zero_age = magnitudes(young, np.array([[1.3]]))[0, 0]
    assert zero_age - 1.0 < oldest < zero_age


@pytest.mark.parametrize(
    ("mass", "expected"),
    [(0.1, 14.63), (0.5, 4.80 - 12.47 * np.log10(0.5)), (1.0, 4.80), (2.0, 4.0 - 6.41 * np.log10(2.0))],
)
def test_habets_and_heintze_as_printed(mass, expected):
    assert magnitudes(place(HabetsHeintze1981(), mass), np.array([[mass]]))[0, 0] == pytest.approx(
        expected, abs=1e-3
    )


def test_the_primary_s_branch_can_serve_both_stars():
    model = HabetsHeintze1981(branch="primary")
    f = flux_ratio(place(model, 0.5), np.array([0.5]), np.array([[0.2]]))[0, 0]
    assert -2.5 * np.log10(f) == pytest.approx(-12.47 * np.log10(0.2), abs=1e-3)


def test_masses_and_bands_beyond_the_relation_are_refused():
    with pytest.raises(ValueError, match=r"mass must be in \[0.08, 1.5\] M_sun for main-sequence, got 1.6"):
        place(MainSequence(), [1.0, 1.6])
    with pytest.raises(ValueError, match=r"band must be one of g, r, i, z, .* got J"):
        place(MainSequence(), 1.0, band="J")
