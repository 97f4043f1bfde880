"""Selections: who is rejected, how several go together, and what a user's table must hold."""

from dataclasses import replace

import numpy as np
import pytest

from hard_cut import HardCut
from porrima.errors import InputError
from porrima.prediction import integrate, population_moments
from porrima.screen import FOUR_Y, SQUARE, flux_ratio_of, kept_share, magnitude_nodes, screen_of
from porrima.selection import Combined, SelectionTable, read_selection

HEADER = "separation,contrast,magnitude,probability\n"
ROWS = [(r, c, m, 0.1 * k) for k, (r, c, m) in enumerate(
    (r, c, m) for r in (0.02, 0.04) for c in (0, 3) for m in (18, 19))]  # fmt: skip


def written(tmp_path, rows, header=HEADER):
    path = tmp_path / "rejected.csv"
    path.write_text(header + "".join(",".join(map(str, row)) + "\n" for row in rows))
    return path


def table(**changes):
    parts = {
        "separation": np.array([0.01, 0.04]), "contrast": np.array([0.0, 4.0]), "magnitude": np.array([18.0, 19.0]),
        "probability": np.arange(8.0).reshape(2, 2, 2) / 10, "single": np.array([0.0, 0.1]),
    }  # fmt: skip
    return SelectionTable(**parts | changes)


def everything(probability):
    """A table that rejects pairs and single stars alike."""
    return table(
        magnitude=np.array([0.0]), probability=np.full((1, 2, 2), probability), single=np.array([probability])
    )


def moments(population, selection, fraction=0.35):
    chosen = replace(population, selection=selection)
    return population_moments(chosen, integrate(chosen), np.array([fraction]))


def test_a_table_gives_its_own_nodes_back():
    found = table()
    for m, c, r in np.ndindex(2, 2, 2):
        place = found.separation[r], 10 ** (-0.4 * found.contrast[c]), found.magnitude[m]
        assert found.rejected(*map(np.array, place)) == pytest.approx(found.probability[m, c, r])


def test_a_table_is_linear_in_contrast_magnitude_and_the_logarithm_of_separation():
    found = table().rejected(np.array([0.02]), np.array([10**-0.8]), np.array([18.5]))
    assert found == pytest.approx([table().probability.mean()])


@pytest.mark.parametrize(("separation", "flux_ratio"), [(0.0, 1.0), (0.05, 0.0), (0.0, 0.0)])
def test_a_pair_without_separation_or_light_is_a_single_star(separation, flux_ratio):
    found = table().rejected(np.array(separation), np.array(flux_ratio), np.array(18.5))
    assert found == pytest.approx(0.05)


def test_beyond_the_smallest_separation_and_flux_ratio_a_table_falls_to_single_stars_as_the_size_does():
    half = table().rejected(np.array([0.005, 0.01]), np.array([1.0, 0.5 * 10**-1.6]), np.array([18.0, 18.0]))
    assert half == pytest.approx([0.25 * 0.0, 0.5 * 0.2])


def test_a_star_outside_the_magnitudes_of_a_table_is_refused():
    with pytest.raises(InputError, match=r"reaches from magnitude 18 to 19, got a star of 19\.4"):
        table().rejected(np.array(0.02), np.array(0.5), np.array([18.2, 19.4]))


def test_what_is_kept_by_several_is_the_product():
    parts = (HardCut(separation=0.03), everything(0.25), everything(0.5))
    found = Combined(parts=parts).rejected(
        np.array([0.02, 0.03]), np.array([0.5, 0.5]), np.array([18.0, 18.0])
    )
    assert found == pytest.approx([1 - 0.75 * 0.5, 1.0])


def test_a_table_that_is_read_is_the_table_that_was_written(tmp_path):
    found = read_selection(written(tmp_path, ROWS[::-1]))
    for r, c, m, p in ROWS:
        where = np.array(r), np.array(10 ** (-0.4 * c)), np.array(float(m))
        assert found.rejected(*where) == pytest.approx(p)
    assert np.all(found.single == 0)


def test_flux_ratios_and_milliarcseconds_are_understood(tmp_path):
    path = tmp_path / "rejected.ecsv"
    names = [("separation", ", unit: mas"), ("flux_ratio", ""), ("probability", "")]
    columns = "".join(f"# - {{name: {name}, datatype: float64{unit}}}\n" for name, unit in names)
    rows = "20 0.1 0.2\n40 0.1 0.6\n0 0 0.01\n"
    path.write_text(f"# %ECSV 1.0\n# ---\n# datatype:\n{columns}separation flux_ratio probability\n{rows}")
    found = read_selection(path)
    assert found.rejected(np.array([0.04]), np.array([0.1]), np.array([12.0])) == pytest.approx([0.6])
    assert found.single == pytest.approx([0.01])


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([*ROWS[:-1], (0.04, 3, 19, 1.2)], r"row 9, column probability: must be in \[0, 1\], got 1.2"),
        ([*ROWS[:-1], (0.04, 3, 19, -0.1)], "row 9, column probability"),
        ([*ROWS[:-1], (0.04, 3, 19, "nan")], "row 9, column probability"),
        ([*ROWS[:-1], (-0.04, 3, 19, 0.1)], "row 9, column separation: must be from 0 to 10 arcsec"),
        ([*ROWS[:-1], (0.04, 3, "inf", 0.1)], "row 9, column magnitude: must be finite"),
        (ROWS[:-1], "must have a row for each combination, got none for magnitude 19, contrast 3, separation 0.04"),
        ([*ROWS, ROWS[2]], "row 10: stands twice in the grid"),
        ([*ROWS, (0, 0, 18, 0.1)], "must have a row of single stars for each magnitude, got none for magnitude 19"),
        ([*ROWS, (0, 0, 18.5, 0.1)], "row 10, column magnitude: must be a magnitude of pairs, too, got 18.5"),
        ([], "must have"),
    ],
)  # fmt: skip
def test_a_wrong_table_ends_in_one_line_that_names_the_place(tmp_path, rows, message):
    with pytest.raises(InputError, match=message):
        read_selection(written(tmp_path, rows))


def test_a_gap_in_a_table_without_magnitudes_is_named_without_one(tmp_path):
    path = written(tmp_path, [(0.02, 0, 0.1), (0.04, 3, 0.2)], "separation,contrast,probability\n")
    with pytest.raises(InputError, match=r"got none for contrast 0, separation 0.04$"):
        read_selection(path)


@pytest.mark.parametrize("missing", ["separation", "probability", "contrast"])
def test_a_missing_column_is_named(tmp_path, missing):
    path = written(tmp_path, ROWS, HEADER.replace(missing, "other"))
    with pytest.raises(InputError, match=f"column {missing}.*: is missing"):
        read_selection(path)


@pytest.mark.parametrize(("name", "unit"), [("separation", "s"), ("probability", "'%'"), ("magnitude", "Jy")])
def test_a_wrong_unit_is_named(tmp_path, name, unit):
    path = tmp_path / "rejected.ecsv"
    columns = "".join(
        f"# - {{name: {n}, datatype: float64{f', unit: {unit}' if n == name else ''}}}\n"
        for n in HEADER.strip().split(",")
    )
    rows = "".join(" ".join(map(str, row)) + "\n" for row in ROWS)
    path.write_text(f"# %ECSV 1.0\n# ---\n# datatype:\n{columns}{HEADER.replace(',', ' ')}{rows}")
    with pytest.raises(InputError, match=f"column {name}"):
        read_selection(path)


def test_stars_take_the_nearest_node_of_magnitude():
    own = np.array([18.0, 18.03, 18.52, 19.0])
    nodes, number = magnitude_nodes(own)
    assert np.all(np.abs(nodes[number] - own) <= 0.5 * (nodes[1] - nodes[0]) + 1e-12)
    assert nodes[1] - nodes[0] <= 0.05 + 1e-12
    assert magnitude_nodes(np.array([18.0, 18.0]))[0].size == 1


def test_flux_ratios_are_those_of_their_coefficients():
    f = flux_ratio_of(FOUR_Y)
    assert 4 * f / (1 + f) ** 2 == pytest.approx(FOUR_Y, rel=1e-6)
    assert f[0] == 0


def test_the_grid_has_the_probability_of_the_table(population):
    chosen = replace(population, selection=table())
    screen = screen_of(chosen)
    nodes, _ = magnitude_nodes(population.stars.magnitude)
    r, f = population.cut * np.sqrt(SQUARE), flux_ratio_of(FOUR_Y)
    for number in (0, nodes.size // 2, nodes.size - 1):
        expected = 1 - table().rejected(r, f[:, None], nodes[number])
        assert kept_share(screen, number, FOUR_Y, SQUARE) == pytest.approx(expected, abs=1e-6)


def test_a_selection_of_a_separation_is_a_cut(population):
    found, expected = (
        moments(population, HardCut(separation=0.03)),
        moments(replace(population, cut=0.03), None),
    )
    assert found.mean_x == pytest.approx(expected.mean_x, rel=1e-5)
    assert found.mean_x2 == pytest.approx(expected.mean_x2, rel=2e-5)
    assert found.mean[0] == pytest.approx(expected.mean[0], rel=1e-4)
    assert found.removed_fraction == pytest.approx(expected.removed_fraction, rel=1e-5)
    assert found.unresolved_fraction == pytest.approx(expected.unresolved_fraction, rel=1e-5)
    assert found.false_rejection_fraction == 0


def test_an_edge_may_lie_anywhere_between_nodes(population):
    for separation in np.geomspace(0.02, 0.0225, 7):
        found = moments(population, HardCut(separation=separation))
        expected = moments(replace(population, cut=separation), None)
        assert found.mean_x == pytest.approx(expected.mean_x, rel=2e-5)


def test_rejecting_all_alike_changes_no_average(population):
    found, expected = moments(population, everything(0.3)), moments(population, None)
    for name in ("mean_x", "mean_x2", "unresolved_fraction"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-5)
    assert found.covariance == pytest.approx(expected.covariance, rel=1e-4)
    assert found.false_rejection_fraction == pytest.approx(0.3)
    assert found.rejected_fraction == pytest.approx(0.3, abs=1e-6)
    assert 1 - found.removed_fraction == pytest.approx(0.7 * (1 - expected.removed_fraction), rel=1e-6)


def test_a_table_of_nothing_changes_nothing(population):
    found, expected = moments(population, everything(0.0)), moments(population, None)
    assert found.mean_x == pytest.approx(expected.mean_x, rel=1e-5)
    assert found.rejected_fraction == pytest.approx(0.0, abs=1e-6)


def test_two_edges_are_one_where_the_nearer_is(population):
    both = Combined(parts=(HardCut(separation=0.03), HardCut(separation=0.045)))
    one = moments(population, HardCut(separation=0.03))
    assert moments(population, both).mean_x == pytest.approx(one.mean_x, rel=1e-5)


def test_stars_weighted_by_flux_may_be_selected(population):
    flux = 10 ** (-0.4 * population.stars.magnitude)
    weighed = replace(population, weight=flux / flux.mean())
    found = moments(weighed, HardCut(separation=0.03))
    expected = moments(replace(weighed, cut=0.03), None)
    assert found.mean_x == pytest.approx(expected.mean_x, rel=1e-5)
    assert found.effective_share == pytest.approx(expected.effective_share, rel=1e-6)
    assert found.covariance[0, 0, 0] == pytest.approx(expected.covariance[0, 0, 0], rel=1e-4)


def test_a_selection_that_leaves_no_single_star_is_refused(population):
    with pytest.raises(InputError, match="must leave some single stars"):
        moments(population, everything(1.0))
