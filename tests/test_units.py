import numpy as np
import pytest
from astropy import units as u

from porrima.errors import InputError
from porrima.units import SIGMA_PER_FWHM, UNITS, to_internal


def test_quantities_become_numbers_in_the_unit_of_their_kind():
    assert to_internal(1.5 * u.kpc, "distance") == pytest.approx(1500.0)
    np.testing.assert_allclose(to_internal([60, 120] * u.mas, "angle"), [0.06, 0.12])


def test_bare_numbers_are_internal_already():
    assert to_internal(3.0, "mass") == 3.0


def test_a_unit_of_another_kind_is_refused():
    with pytest.raises(ValueError, match="distance must be in a unit convertible to pc, got kg"):
        to_internal(1 * u.kg, "distance")


@pytest.mark.parametrize("unit", UNITS.values())
def test_every_internal_unit_is_one(unit):
    u.Unit(unit)


def test_fwhm_of_a_gaussian():
    assert np.exp(-0.5 * (0.5 / SIGMA_PER_FWHM) ** 2) == pytest.approx(0.5)


def test_an_input_error_names_place_rule_and_value_on_one_line():
    error = InputError("must be positive", source="stars.csv", row=7, column="mass", value="-1\n")
    assert str(error) == "stars.csv, row 7, column mass: must be positive, got -1"
    assert str(InputError("must be in [0, 1]", key="cut", value=2)) == "cut: must be in [0, 1], got 2"
