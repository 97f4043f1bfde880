"""The store on its own; runs that fill it are in `test_simulation`."""

import os
import socket
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

from porrima import store as module
from porrima.config import RunConfig, parse
from porrima.errors import InputError, RunError
from porrima.moments import N_MOMENTS
from porrima.store import Chunk, Store, header, opened
from porrima.tallies import changes, tally

CHUNK, N_STACKS = 50, 120
ALONE = np.array([[0.0, 0.05], [0.0, 0.0], [0.007, 0.007]])


@pytest.fixture
def known(stars):
    config = parse(RunConfig, {"stars": {"l": 0, "b": 90, "mag": [18, 19]}, "psf": ["psf0", "psf1"]})
    return header(config, stars, ALONE, method="moments", identity="one")


def made(path, known, **changed):
    return opened(path, known, **{"n_stacks": N_STACKS, "chunk": CHUNK, "resume": False} | changed)


def results(first, last):
    rng = np.random.Generator(np.random.Philox(first))
    shapes = ALONE[:, :, None] * (1 + 1e-3 * rng.normal(size=(3, 2, last - first)))
    fraction = rng.uniform(size=last - first)
    return Chunk(
        first=first,
        binary_fraction=fraction,
        shapes=shapes,
        moments=rng.normal(size=(last - first, N_MOMENTS)),
        tally=tally(fraction, changes(shapes, ALONE)),
    )


def test_chunks_come_back_as_they_were_written_in_any_order(tmp_path, known):
    with made(tmp_path / "run.zarr", known) as store:
        assert store.missing() == store.ranges == [(0, 50), (50, 100), (100, 120)]
        for some in ((100, 120), (0, 50), (50, 100)):
            store.write(results(*some))
            assert some not in store.missing()
    run = xr.open_zarr(tmp_path / "run.zarr", chunks=None)
    for number, (first, last) in enumerate(store.ranges):
        chunk = results(first, last)
        np.testing.assert_array_equal(run["binary_fraction"][first:last], chunk.binary_fraction)
        np.testing.assert_array_equal(run["r2"][:, first:last], chunk.shapes[2])
        np.testing.assert_array_equal(run["moments"][first:last], chunk.moments)
        np.testing.assert_array_equal(run["tally"][number], chunk.tally.to_array())


def test_the_tally_is_written_when_all_else_is_on_the_disk(tmp_path, known, monkeypatch):
    path, synced, sync = tmp_path / "run.zarr", [], module._sync

    def noted(file):
        synced.append((file.relative_to(path).as_posix(), (path / "tally" / "1.0.0.0.0").exists()))
        sync(file)

    with made(path, known) as store:
        monkeypatch.setattr(module, "_sync", noted)
        store.write(results(50, 100))
    before = {name for name, marked in synced if not marked}
    files = {"binary_fraction/1", "e1/0.1", "e2/0.1", "r2/0.1", "moments/1.0"}
    assert before == files | {name.split("/")[0] for name in files}
    assert {name for name, marked in synced if marked} == {"tally/1.0.0.0.0", "tally"}


def test_a_disk_that_fails_leaves_the_chunk_missing(tmp_path, known, monkeypatch):
    def full(file):
        raise OSError(28, "No space left on device")

    with made(tmp_path / "run.zarr", known) as store:
        monkeypatch.setattr(module, "_sync", full)
        with pytest.raises(RunError, match=r"cannot be written \(No space left on device\); .* --resume"):
            store.write(results(0, 50))
        assert len(store.missing()) == 3


def test_a_chunk_in_which_nothing_could_be_measured_counts(tmp_path, known):
    shapes = np.full((3, 2, 50), np.nan)
    fraction = np.full(50, 0.5)
    nothing = Chunk(
        first=0,
        binary_fraction=fraction,
        shapes=shapes,
        moments=np.full((50, N_MOMENTS), np.nan),
        tally=tally(fraction, changes(shapes, ALONE)),
    )
    with made(tmp_path / "run.zarr", known) as store:
        store.write(nothing)
        assert (0, 50) not in store.missing()


def test_only_who_knows_the_token_of_the_lock_writes(tmp_path, known):
    with made(tmp_path / "run.zarr", known) as store:
        assert Store.within_reach(store.path, store.token).missing() == store.missing()
        assert Store.within_reach(store.path, "another") is None
        assert Store.within_reach(tmp_path / "elsewhere.zarr", store.token) is None
    assert Store.within_reach(store.path, store.token) is None


def test_one_process_writes_at_a_time(tmp_path, known):
    path = tmp_path / "run.zarr"
    with made(path, known), pytest.raises(InputError, match=f"is being written by process {os.getpid()} on"):
        made(path, known, resume=True).__enter__()


def test_what_killed_processes_left_is_removed(tmp_path, known):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    host = socket.gethostname()
    for name in (
        f".run.zarr.{dead.pid}@{host}",
        f".run.zarr.{os.getppid()}@{host}",
        f".run.zarr.{dead.pid}@far",
    ):
        (tmp_path / name).mkdir()
    with made(tmp_path / "run.zarr", known) as store:
        (store.path / "e1" / "0.0.abc.partial").write_bytes(b"half")  # of a worker that dies meanwhile
    assert not list(store.path.rglob("*.partial"))
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        [f".run.zarr.{os.getppid()}@{host}", f".run.zarr.{dead.pid}@far", "run.zarr"]
    )


def test_another_run_or_none_is_refused(tmp_path, known):
    with made(tmp_path / "run.zarr", known):
        pass
    with pytest.raises(InputError, match="holds a run of another configuration"):
        made(tmp_path / "run.zarr", known.assign_attrs(identity="two"), resume=True).__enter__()
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="is not a run of porrima simulate"):
        made(tmp_path / "folder", known, resume=True).__enter__()
