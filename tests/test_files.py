import json

import numpy as np
import pytest

from porrima.errors import InputError
from porrima.files import json_ready, make_folder, write_json, write_whole


def test_what_is_no_finite_number_is_null_however_deep():
    value = {
        "a": [np.float64(1.5), float("nan")],
        "b": ({"c": -np.inf},),
        "d": "text",
        "e": 3,
        "f": None,
        "g": True,
    }
    expected = {"a": [1.5, None], "b": [{"c": None}], "d": "text", "e": 3, "f": None, "g": True}
    assert json_ready(value) == expected
    assert type(json_ready(value)["a"][0]) is float


def test_json_is_read_back_as_it_was(tmp_path):
    write_json({"κ": [1, 2.5], "none": float("nan")}, tmp_path / "a.json")
    text = (tmp_path / "a.json").read_text(encoding="utf-8")
    assert json.loads(text) == {"κ": [1, 2.5], "none": None}
    assert text.endswith("}\n")


def test_a_file_is_there_whole_or_not_at_all(tmp_path):
    def fail(path):
        path.write_text("half")
        raise OSError(28, "No space left on device")

    (tmp_path / "a").write_text("before")
    with pytest.raises(InputError, match="cannot be written"):
        write_whole(tmp_path / "a", fail)
    assert (tmp_path / "a").read_text() == "before"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_a_folder_in_place_of_a_file_is_refused(tmp_path):
    (tmp_path / "a").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        make_folder(tmp_path / "a" / "b")
