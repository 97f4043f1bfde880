"""The paper's tables as printed are those that the models have."""

import math

import numpy as np
import pytest

from porrima.multiplicity import MULTIPLICITY
from porrima.paper_tables import TABLE_1, multiplicity_table, pair_sketch, psf_table
from porrima.systems import Systems


def test_each_reading_takes_the_printed_row_and_fills_the_gaps_its_own_way():
    table = multiplicity_table({name: MULTIPLICITY[name] for name in ("dk13", "dk13-kcm16")})["table"]
    printed = table.dropna("row", subset=["multiplicity_fraction"])
    below = printed.where(printed["mass_hi"] <= 1.5, drop=True)
    for name, column in (("multiplicity_fraction", "read_multiplicity_fraction"),
                         ("mass_ratio_exponent", "read_mass_ratio_exponent"),
                         ("mean_separation", "read_separation")):  # fmt: skip
        for model in ("dk13", "dk13-kcm16"):
            np.testing.assert_allclose(below[column].sel(model=model), below[name])
    np.testing.assert_allclose(
        below["read_scatter_log_a"].sel(model="dk13"), 2 / 3 * below["scatter_log_period"]
    )
    gap = table.where(table["mass_lo"] == 0.5, drop=True)
    assert gap["read_multiplicity_fraction"].to_numpy().ravel().tolist() == [0.26, 0.44]
    assert np.all(np.isnan(table["read_largest_separation"].sel(model="dk13")))
    assert float(gap["read_largest_separation"].sel(model="dk13-kcm16")[0]) == pytest.approx(2.5 * 45)
    assert np.all(np.isnan(table["read_separation"].where(table["mass_lo"] == 1.5, drop=True)))
    assert [row.mass_lo for row in TABLE_1] == [0.0, 0.1, 0.7, 1.5]


def test_the_printed_position_angles_are_a_quarter_turn_off():
    parts = psf_table()
    table, found = parts["table"], parts["findings"]
    angle = table["angle"].to_numpy()
    assert angle[1:] == pytest.approx([178.4, 57.5], abs=0.05)
    assert float(found["most_turned"]) == pytest.approx(90.0, abs=0.05)
    assert float(found["turned"]) == pytest.approx(88.0, abs=0.05)
    e = table["e"].to_numpy()
    expected = 2 * (0.137 / (2 * math.sqrt(2 * math.log(2)))) ** 2 / np.sqrt(1 - e**2)
    np.testing.assert_allclose(table["r2_0"], expected, rtol=1e-9)


def test_the_photocentre_of_the_sketch_is_that_of_the_pair():
    parts = pair_sketch()
    points, found = parts["points"], parts["findings"]
    x, y, flux = (points[name].to_numpy() for name in ("x", "y", "flux"))
    assert x[2] == pytest.approx((flux[:2] @ x[:2]) / flux[2])
    assert y[2] == pytest.approx((flux[:2] @ y[:2]) / flux[2])
    pair = Systems.from_pairs(flux[1:2], x[1:2], y[1:2])
    second = (pair.flux * (pair.x**2 + pair.y**2)).sum() / pair.flux.sum()
    assert float(found["x_second"]) == pytest.approx(second)
