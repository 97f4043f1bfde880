import numpy as np
import pytest
from astropy import units as u
from astropy.table import Table

from porrima.errors import InputError
from porrima.files import make_folder, write_whole
from porrima.io import read_systems, write_rows


def table(tmp_path, text):
    path = tmp_path / "pairs.csv"
    path.write_text(text)
    return path


def test_pairs_are_read_with_and_without_weights(tmp_path):
    systems = read_systems(table(tmp_path, "flux_ratio,dx,dy\n0.5,0.01,0.02\n0,0,0\n"))
    assert systems.weight.tolist() == [1.0, 1.0]
    np.testing.assert_allclose(systems.x[0, 1] - systems.x[0, 0], 0.01)
    weighted = read_systems(table(tmp_path, "weight,dy,dx,flux_ratio\n2,0.02,0.01,0.5\n1,0,0,0\n"))
    assert weighted.weight.tolist() == [2.0, 1.0]
    np.testing.assert_allclose(weighted.y, systems.y)


def test_units_of_a_table_are_honoured(tmp_path):
    path = tmp_path / "pairs.ecsv"
    Table({"flux_ratio": [0.5], "dx": [10.0] * u.mas, "dy": [0.0] * u.mas}).write(path)
    systems = read_systems(path)
    np.testing.assert_allclose(systems.x[0, 1] - systems.x[0, 0], 0.01)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("flux_ratio,dx\n0.5,0.1\n", "pairs.csv, column dy: is missing; the table has flux_ratio, dx"),
        (
            "flux_ratio,dx,dy\n0.5,0,0\n1.5,0,0\n",
            r"pairs.csv, row 3, column flux_ratio: must be in \[0, 1\], got 1.5",
        ),
        ("flux_ratio,dx,dy\n0.5,nan,0\n", "pairs.csv, row 2, column dx: must be within 10 arcsec, got nan"),
        (
            "flux_ratio,dx,dy,weight\n0.5,0,0,-1\n",
            "row 2, column weight: must be finite and not negative, got -1",
        ),
        ("flux_ratio,dx,dy,weight\n0.5,0,0,0\n", "column weight: must have a positive sum, got 0"),
        ("flux_ratio,dx,dy\n0.5,x,0\n", "row 2, column dx: must be a number, got 'x'"),
        ("flux_ratio,dx,dy\n", "must have rows below its header"),
        ("flux_ratio,dx,dy\n0.5,0\n", "row 2"),
        ("", "must not be empty"),
    ],
)
def test_a_bad_table_is_named_by_row_and_column(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read_systems(table(tmp_path, text))


def test_a_missing_table_is_named(tmp_path):
    with pytest.raises(InputError, match=r"absent.csv: must be a readable file"):
        read_systems(tmp_path / "absent.csv")


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "out.txt"
    path.write_text("old")

    def broken(unfinished):
        unfinished.write_text("half")
        raise OSError(28, "No space left on device")

    with pytest.raises(
        InputError, match=r"output: cannot be written \(No space left on device\), got .*out.txt"
    ):
        write_whole(path, broken)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["out.txt"]


def test_rows_round_trip(tmp_path):
    write_rows([{"psf": "psf0", "bias": 0.1}, {"psf": "psf1", "bias": np.pi}], tmp_path / "rows.ecsv")
    back = Table.read(tmp_path / "rows.ecsv")
    assert back["bias"].tolist() == [0.1, np.pi]


def test_a_folder_is_made_or_refused(tmp_path):
    make_folder(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="output: cannot be made"):
        make_folder(tmp_path / "file")
    with pytest.raises(InputError, match="output: cannot be made"):
        make_folder(tmp_path / "file" / "inside")


def test_a_folder_without_permission_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda *_: False)  # for root there is no such folder
    with pytest.raises(InputError, match="output: must be a folder that can be written"):
        make_folder(tmp_path)
