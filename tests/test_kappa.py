import pytest

from porrima import figures
from porrima.errors import InputError
from porrima.kappa import COLUMNS, expanded, grouped, responses, row, shown, table, write_responses
from porrima.moments import INDICES, N_MOMENTS


def test_roman_stands_for_all_detectors_in_four_bands():
    names = expanded(["psf0", "roman", "roman:F146", "roman:H158:SCA07"])
    assert len(names) == 1 + 4 * 18 + 18 + 1
    assert names[0] == "psf0"
    assert {"roman:Y106:SCA01", "roman:F184:SCA18", "roman:F146:SCA09"} < set(names)
    assert names[-1] == "roman:H158:SCA07"


def test_gaussian_formulae_hold_for_adaptive_moments_of_gaussians():
    (found,) = responses(["psf2"], ["adaptive"])
    result = row(found)
    assert list(result) == COLUMNS
    assert result["kappa_r2"] == pytest.approx(1)
    assert result["kappa_e"] == pytest.approx(1)
    assert row(responses(["psf0"], ["adaptive"])[0])["kappa_e"] is None  # round


def test_one_response_is_shown_flat_and_several_as_a_list():
    seen = []
    found = responses(["psf1", "psf2"], ["adaptive", "gaussian:0.75"], seen.append)
    assert len(found) == len(seen) == 4
    assert set(shown(found[:1])) == {*COLUMNS, "derivatives"}
    listed = shown(found)["responses"]
    assert [(r["psf"], r["estimator"]) for r in listed[:2]] == [
        ("psf1", "adaptive"),
        ("psf1", "gaussian:0.75"),
    ]


def test_table_names_every_moment_once():
    lines = table(responses(["psf1"], ["plain"])[0])
    assert len(lines) == N_MOMENTS
    assert [line["order"] for line in lines] == [a + b for a, b in INDICES]
    assert next(line for line in lines if line["moment"] == "m20")["dr2"] == 1


def test_detectors_of_one_band_share_a_place_in_the_figure():
    base = {"estimator": "plain:0.75"}
    assert grouped(base | {"psf": "roman:H158:SCA02, pixel 0.11"})["group"] == "roman:H158, pixel 0.11"
    assert grouped(base | {"psf": "some/where/psf.fits[1]"})["group"] == "psf.fits[1]"
    assert grouped(base | {"psf": "psf1"})["kind"] == "plain"


def test_tables_and_figure_are_written(tmp_path):
    write_responses(responses(["psf0", "psf1"], ["adaptive", "gaussian:0.75"]), tmp_path / "out")
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["derivatives.ecsv", "response.ecsv", "response.png"]


def test_figure_shows_every_estimator_once_and_leaves_round_psfs_out_of_the_ellipticity():
    rows = [grouped(row(r)) for r in responses(["psf0", "psf1"], ["adaptive", "gaussian:0.75"])]
    size, ellipticity = figures.responses(rows).axes
    assert [line.get_label() for line in size.lines[:2]] == ["adaptive", "gaussian:0.75"]
    assert len(size.lines[0].get_xdata()) == 2
    assert len(ellipticity.lines[0].get_xdata()) == 1


def test_an_unknown_name_is_wrong_input():
    with pytest.raises(InputError, match="psf"):
        responses(["psf9"], ["adaptive"])
    with pytest.raises(InputError, match="estimator"):
        responses(["psf0"], ["hsm"])
