import numpy as np
import pytest
import xarray as xr

import porrima.archive as archive
from porrima.archive import fingerprint, keep, kept, source_key


@pytest.fixture
def parts():
    values = np.array([[0.1, np.nan], [1 / 3, -0.0]])
    one = xr.Dataset(
        {"bias": (("psf", "bin"), values), "seen": ("psf", [True, False])},
        coords={"psf": ["psf0", "α"]},
        attrs={"n": 3, "none": None},
    )
    return {"summary": one, "findings": xr.Dataset({"pull": 2.5})}


def test_what_is_kept_comes_back_with_every_bit(parts, tmp_path):
    keep(tmp_path / "numbers" / "one", "k", parts)
    found = kept(tmp_path / "numbers" / "one", "k")
    assert sorted(found) == ["findings", "summary"]
    for name, part in parts.items():
        xr.testing.assert_identical(found[name], part)
    assert fingerprint(found) == fingerprint(parts)
    turned = parts["summary"][["seen", "bias"]].assign_attrs(dict(reversed(parts["summary"].attrs.items())))
    assert fingerprint(parts | {"summary": turned}) == fingerprint(parts)


def test_numbers_of_another_key_or_damaged_ones_are_not_there(parts, tmp_path):
    path = tmp_path / "one"
    assert kept(path, "k") is None
    keep(path, "k", parts)
    assert kept(path, "other") is None
    (path / "summary" / ".zgroup").unlink()
    assert kept(path, "k") is None
    keep(path, "k2", {"findings": parts["findings"]})
    assert list(kept(path, "k2")) == ["findings"]
    assert [one.name for one in tmp_path.iterdir()] == ["one"]


def test_a_number_a_label_or_an_attribute_makes_another_fingerprint(parts):
    first = fingerprint(parts)
    summary = parts["summary"]
    for other in (
        summary.assign(bias=summary["bias"] * (1 + 1e-15)),
        summary.assign_coords(psf=["psf0", "β"]),
        summary.assign_attrs(n=4),
    ):
        assert fingerprint(parts | {"summary": other}) != first


def test_the_key_of_the_source_follows_imports_and_nothing_else(monkeypatch, tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "table.ecsv").write_text("1")
    (tmp_path / "top.py").write_text("from porrima.middle import x\n")
    (tmp_path / "middle.py").write_text("def f():\n    from porrima import bottom\n")
    (tmp_path / "bottom.py").write_text("x = 1\n")
    (tmp_path / "figures.py").write_text("x = 1\n")
    monkeypatch.setattr(archive, "_HERE", tmp_path)

    def key():
        source_key.cache_clear()
        return source_key("top")

    first = key()
    (tmp_path / "figures.py").write_text("x = 2\n")
    assert key() == first
    (tmp_path / "bottom.py").write_text("x = 2\n")
    second = key()
    assert second != first
    (tmp_path / "data" / "table.ecsv").write_text("2")
    assert key() != second
    monkeypatch.undo()
    source_key.cache_clear()
