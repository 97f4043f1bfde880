import numpy as np
import pytest

from porrima import response as module
from porrima.cache import cache_folder, content_key, load, save
from porrima.psf import sheared_gaussian
from porrima.response import response
from porrima.shapes import Adaptive, GaussianWeight, Plain

ARRAYS = {"a": np.arange(3.0), "n": np.array(2)}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("PORRIMA_CACHE", str(tmp_path / "kept"))
    module._response.cache_clear()
    return tmp_path / "kept"


def test_what_was_saved_is_loaded(folder):
    save("key", ARRAYS)
    np.testing.assert_array_equal(load("key")["a"], ARRAYS["a"])
    assert load("other") is None
    assert [p.name for p in folder.iterdir()] == ["key.npz"]


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", "half"], ids=["empty", "garbage", "half"])
def test_a_damaged_file_counts_for_nothing_and_is_replaced(folder, content):
    save("key", ARRAYS)
    whole = (folder / "key.npz").read_bytes()
    (folder / "key.npz").write_bytes(whole[: len(whole) // 2] if content == "half" else content)
    assert load("key") is None
    save("key", ARRAYS)
    assert (folder / "key.npz").read_bytes()[:2] == b"PK"
    assert load("key") is not None


def test_a_changed_byte_is_noticed(folder):
    save("key", {"a": np.arange(100.0)})
    content = bytearray((folder / "key.npz").read_bytes())
    content[400] ^= 1
    (folder / "key.npz").write_bytes(content)
    assert load("key") is None


def test_a_folder_that_cannot_be_written_is_passed_over(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("PORRIMA_CACHE", str(tmp_path / "file" / "below"))
    save("key", ARRAYS)
    assert load("key") is None


def test_folder_follows_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("PORRIMA_CACHE", "")
    assert cache_folder() is None
    save("key", ARRAYS)
    assert load("key") is None
    monkeypatch.delenv("PORRIMA_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "porrima"


def test_keys_differ_wherever_contents_differ():
    a = np.arange(4.0)
    keys = [
        content_key(*p)
        for p in ([a], [a.reshape(2, 2)], [a + 1e-16], [a, ""], ["a", "b"], ["ab", ""], [1], [1.0])
    ]
    assert len(set(keys)) == len(keys)
    assert content_key(a, "x") == content_key(a.copy(), "x")


@pytest.mark.parametrize(
    "estimator", [Plain(), Plain(0.4), Adaptive(), GaussianWeight(0.1)], ids=lambda e: e.name
)
def test_a_response_from_disk_is_the_one_that_was_built(folder, estimator, monkeypatch):
    psf = sheared_gaussian("mine", 0.1, 0.02)
    built = response(psf, estimator)
    assert len(list(folder.iterdir())) == 1
    module._response.cache_clear()
    monkeypatch.setattr(module, "_arrays", None)  # not built again
    kept = response(psf, estimator)
    for name in ("first", "second"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(built, name))
    np.testing.assert_array_equal(kept.shape0.covariance(), built.shape0.covariance())
    assert type(kept.weighted) is type(built.weighted)
    if built.weighted is not None:
        np.testing.assert_array_equal(kept.weighted.integrals, built.weighted.integrals)
        assert kept.weighted.unit == built.weighted.unit


def test_another_version_of_the_code_is_another_response(folder, monkeypatch):
    psf = sheared_gaussian("mine", 0.1, 0.02)
    response(psf, Adaptive())
    module._response.cache_clear()
    monkeypatch.setattr(module, "_code_version", lambda: "changed")
    response(psf, Adaptive())
    assert len(list(folder.iterdir())) == 2
