"""Selections of a configuration: what may be asked for, and that prediction and engine reject just that."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from porrima.clip import Clip
from porrima.config import PopulationConfig, RunConfig, canonical, load, parse
from porrima.detection import Detection
from porrima.errors import InputError
from porrima.exposure import EUCLID_VIS_WIDE
from porrima.gaia_flags import GaiaFlags
from porrima.photometry import flux_ratio
from porrima.prediction import integrate, population_moments
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.sample import selection_of
from porrima.screen import FOUR_Y, SQUARE, flux_ratio_of, kept_share, magnitude_nodes, screen_of
from porrima.selection import Combined
from porrima.shapes import Plain
from porrima.stack import draw_stacks
from statistics_helpers import assert_within_sigma

STARS = {"l": 180, "b": 45, "mag": [18, 19]}
VIS = "{detection: euclid-vis, exposures: 1}"
FRACTION = np.array([0.5])


def selection(text, reply=None):
    return selection_of(
        parse(PopulationConfig, {"stars": STARS, "selection": yaml.safe_load(text)}), response=reply
    )


@pytest.fixture(scope="module")
def vis():
    return selection(VIS)


def test_a_detection_is_that_of_the_survey_behind_its_own_psf(vis):
    own = Detection.of(
        psf_from_name("optical1", pixel=0.1, jitter=0.029), replace(EUCLID_VIS_WIDE, n_exposures=1)
    )
    place = np.array([0.03, 0.05, 0.0]), np.array([0.3, 1.0, 0.0]), np.array([20.0, 18.0, 19.0])
    assert np.array_equal(vis.rejected(*place), own.rejected(*place))
    assert vis.rejected(*place)[2] == pytest.approx(1e-3)


def test_options_of_a_detection_are_heeded(vis):
    place = np.array([0.0, 0.03]), np.array([0.0, 0.5]), np.array([20.0, 20.0])
    more = selection("{detection: euclid-vis, exposures: 1, false_alarm: 0.01}").rejected(*place)
    assert more[0] == pytest.approx(0.01)
    assert more[1] > vis.rejected(*place)[1]


def test_several_selections_keep_the_product(vis):
    both = selection(f"[{VIS}, {{gaia: dr3, ruwe_max: 1.2, colour: 0.3, false_alarm: 0.02}}]")
    flags = GaiaFlags(ruwe_max=1.2, colour=0.3, false_alarm=0.02)
    assert isinstance(both, Combined)
    assert both.parts[1] == flags
    place = np.array([0.04, 0.14]), np.array([0.3, 0.8]), np.array([18.0, 18.5])
    kept = (1 - vis.rejected(*place)) * (1 - flags.rejected(*place))
    assert both.rejected(*place) == pytest.approx(1 - kept)


def test_a_clip_is_behind_the_psf_of_the_command():
    reply = response(psf_from_name("psf1"), Plain())
    found = selection("{clip: 0.01, quantity: e, noise: {18: 0.002, 19: 0.004}}", reply)
    assert isinstance(found, Clip)
    assert (found.response, found.threshold, found.quantity) == (reply, 0.01, "e")
    assert found.noise.at(np.array([18.0, 19.0])) == pytest.approx([0.002, 0.004])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "selection: must have one of clip, table, detection, gaia"),
        ([], "selection: must hold at least one selection"),
        ({"detection": "euclid"}, "selection.detection: must be 'euclid-vis' or 'roman-h158', got euclid"),
        ({"detectoin": "euclid-vis"}, "selection.detectoin: is not a key (did you mean detection?)"),
        ([{"gaia": "dr3"}, {"clp": 0.1}], "selection.1.clp: is not a key (did you mean clip?)"),
        ({"gaia": "dr3", "clip": 0.1}, "selection: must have one of clip and gaia; several selections make a list"),
        ({"gaia": "dr3", "exposures": 2}, "selection: has exposures, which is no option of gaia"),
        ({"table": "t", "noise": 0.1}, "selection: has noise, which is no option of table"),
        ({"gaia": "dr3", "ruwe_max": 1}, "selection.ruwe_max: must be greater than 1, got 1"),
        ([{"detection": "euclid-vis", "exposures": 0}], "selection.0.exposures: must be greater than or equal to 1"),
        ({"detection": "euclid-vis", "exposures": 1.5}, "selection.exposures: must be a valid integer"),
        ({"detection": "euclid-vis", "false_alarm": 1}, "selection.false_alarm: must be less than 1, got 1"),
        ({"detection": "euclid-vis", "psf_error": -1}, "selection.psf_error: must be greater than or equal to 0"),
        ({"detection": "euclid-vis", "pixel": 0.1}, "selection: must have psf, too, where it has pixel"),
        ({"clip": 0.3}, "selection.clip: must be less than or equal to 0.2, got 0.3"),
        ({"clip": 0.1, "noise": {18: -1}}, "selection.noise: must be a positive sigma"),
        (3, "selection: must be a valid tuple, got 3"),
    ],
)  # fmt: skip
def test_a_wrong_selection_names_key_and_rule(given, message):
    with pytest.raises(InputError) as error:
        parse(PopulationConfig, {"stars": STARS, "selection": given})
    assert message in str(error.value)


def test_tables_of_a_file_are_relative_to_its_folder(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text(
        f"stars: {{l: 180, b: 45, mag: [18, 19]}}\nselection: [{VIS}, {{table: t.csv}}, {{table: /u.csv}}]\n"
    )
    assert [one.table for one in load(path).selection] == [
        None,
        (tmp_path / "t.csv").resolve(),
        Path("/u.csv"),
    ]


def test_one_selection_and_a_list_of_it_are_the_same_run():
    one, listed = (
        parse(RunConfig, {"stars": STARS, "selection": given})
        for given in ({"gaia": "dr3"}, [{"gaia": "dr3"}])
    )
    assert canonical(one) == canonical(listed)


def brute_force(population, chosen, n=700):
    """Mean of x over the stars kept by pairs drawn one by one, with its standard error."""
    rng, law, stars = np.random.Generator(np.random.Philox(5)), population.law, population.stars
    shape = (len(stars), n)
    g, low = law.mass_ratio_exponent[:, None] + 1, law.mass_ratio_min[:, None]
    q = (low**g + rng.random(shape) * (1 - low**g)) ** (1 / g)
    a = 10 ** (law.log_a[:, None] + law.log_a_sigma[:, None] * rng.standard_normal(shape))
    r = a / stars.distance[:, None] * np.sqrt(1 - rng.uniform(-1, 1, shape) ** 2)
    f = flux_ratio(population.tracks, stars.mass, q)
    m = np.broadcast_to(stars.magnitude[:, None], shape)
    kept = (r < population.cut) * (1 - chosen.rejected(r, f, m))
    pair = np.minimum(1, population.scale(FRACTION)[0] * law.multiplicity_fraction)
    zero = np.zeros(len(stars))
    alone = (1 - pair) * (1 - chosen.rejected(zero, zero, stars.magnitude))
    x = (pair[:, None] * kept * f * r**2 / (1 + f) ** 2).sum(axis=0)
    number = (alone[:, None] + pair[:, None] * kept).sum(axis=0)
    mean = x.sum() / number.sum()
    return mean, np.std(x - mean * number) / number.mean() / np.sqrt(n)


@pytest.mark.parametrize("cut", [0.05, 0.15])
def test_prediction_averages_the_probabilities_over_pairs(population, vis, cut):
    """To the Monte Carlo error; where Gaia's flags have edges below the cut, to the error that is stated, too."""
    for chosen in (vis, GaiaFlags(), Combined(parts=(vis, GaiaFlags()))):
        some = replace(population, selection=chosen, cut=cut)
        found = population_moments(some, integrate(some), FRACTION)
        expected, error = brute_force(some, chosen)
        stated = found.relative_error[0] * expected
        assert found.relative_error[0] < (2e-3 if cut == 0.05 else 5e-3 if chosen is vis else 0.05)
        assert_within_sigma(found.mean_x[0], expected, error + (stated / 5 if cut > 0.05 else 0))


def test_drawn_stacks_are_selected_as_predicted(population, vis):
    some = replace(population, selection=Combined(parts=(vis, GaiaFlags())), cut=0.15)
    moments = draw_stacks(some, n_stars=200, binary_fraction=0.5, seed=3, first=0, last=10_000).moments.values
    size = moments[:, 0] + moments[:, 2]
    theory = population_moments(some, integrate(some), FRACTION)
    assert_within_sigma(size.mean(), theory.mean_x[0], size.std() / np.sqrt(size.size))
    square = (size - size.mean()) ** 2 * 200
    spread = theory.mean_x2[0] - theory.mean_x[0] ** 2
    assert_within_sigma(square.mean(), spread, square.std() / np.sqrt(square.size))


@pytest.mark.parametrize("cut", [0.05, 0.25])
def test_the_grid_of_a_selection_has_its_probability_on_nodes_and_between(population, vis, cut):
    for chosen, between in ((vis, 5e-4), (GaiaFlags(ruwe_max=np.inf), 5e-3)):
        some = replace(population, selection=chosen, cut=cut)
        screen, (nodes, _) = screen_of(some), magnitude_nodes(population.stars.magnitude)
        y, v = (0.5 * (grid[1:] + grid[:-1]) for grid in (FOUR_Y, SQUARE))
        for four_y, square in ((FOUR_Y, SQUARE), (y, v)):
            r, f = cut * np.sqrt(square), flux_ratio_of(four_y)
            expected = 1 - chosen.rejected(r, f[:, None], nodes[3])
            apart = np.abs(kept_share(screen, 3, four_y, square) - expected)
            assert apart.max() < 2e-6 or (four_y is y and apart.mean() < between)


def test_the_edge_of_ruwe_is_sharp_between_nodes(population):
    flags = GaiaFlags(multi_peak=False)
    some = replace(population, selection=flags, cut=0.25)
    magnitude = magnitude_nodes(population.stars.magnitude)[0][3]
    v = np.linspace(0.0, 1.0, 20_001)
    found = kept_share(screen_of(some), 3, np.array([8 / 9]), v)[0]
    expected = 1 - flags.rejected(0.25 * np.sqrt(v), np.full(v.size, 0.5), np.full(v.size, magnitude))
    assert set(np.unique(found.round(6))) == {0.0, 1.0}
    assert np.mean(np.abs(found - expected)) < 5e-3
