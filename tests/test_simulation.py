import json
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import xarray as xr
from dask.distributed import LocalCluster

from porrima import simulation
from porrima.config import RunConfig, canonical, load, parse
from porrima.errors import InputError, RunError
from porrima.lock import locked
from porrima.moments import INDICES
from porrima.sample import draw_stars
from porrima.simulation import simulate
from porrima.store import Chunk, Store, open_run


def small(**changes):
    base = {
        "stars": {"l": 180, "b": 45, "mag": [18, 19], "n_drawn": 300},
        "n_stacks": 250,
        "n_stars": 20,
        "seed": 3,
    }
    return parse(RunConfig, base | changes)


def contents(path):
    return {str(p.relative_to(path)): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "run.zarr"
    assert simulate(small(), path, chunk=100) == 250
    return path


def test_a_store_has_the_dimensions_and_variables_of_the_contract(finished):
    run = xr.open_zarr(finished, chunks=None)
    assert {name: run.sizes[name] for name in ("stack", "psf", "moment", "star", "chunk")} == {
        "stack": 250, "psf": 3, "moment": len(INDICES), "star": 300, "chunk": 3,
    }  # fmt: skip
    assert run["psf"].to_numpy().tolist() == ["psf0", "psf1", "psf2"]
    assert run["moment"].to_numpy()[:3].tolist() == ["m20", "m11", "m02"]
    for name in ("e1", "e2", "r2"):
        assert run[name].dims == ("psf", "stack")
        assert run[f"{name}_0"].dims == ("psf",)
        assert np.all(np.isfinite(run[name]))
    assert run["binary_fraction"].dims == ("stack",)
    assert json.loads(run.attrs["config"])["seed"] == 3
    assert "numba" in json.loads(run.attrs["versions"])


def test_the_psfs_without_companions_are_those_of_the_paper(finished):
    run = xr.open_zarr(finished, chunks=None)
    np.testing.assert_allclose(run["e1_0"], [0, 0.054, -0.021], atol=1e-10)
    np.testing.assert_allclose(run["e2_0"], [0, -0.003, 0.045], atol=1e-10)
    np.testing.assert_allclose(run["r2_0"][:2], [6.7695e-3, 6.7794e-3], rtol=1e-5)


def test_chunk_size_changes_no_number(finished, tmp_path):
    simulate(small(), tmp_path / "other.zarr", chunk=37)
    a, b = (xr.open_zarr(p, chunks=None) for p in (finished, tmp_path / "other.zarr"))
    for name in ("binary_fraction", "moments", "e1", "e2", "r2"):
        np.testing.assert_array_equal(a[name], b[name])


def test_workers_give_the_same_bytes(finished, tmp_path):
    simulate(small(), tmp_path / "run.zarr", chunk=100, workers=2)
    assert contents(tmp_path / "run.zarr") == contents(finished)


@pytest.fixture(scope="module")
def threads_as_workers():
    """Scheduler and workers in this process, so that a test can see and change what a worker does."""
    with LocalCluster(n_workers=2, threads_per_worker=2, processes=False, dashboard_address=":0") as cluster:
        yield cluster.scheduler_address


@pytest.mark.parametrize("reached", [True, False])
def test_workers_write_where_they_see_the_store_and_else_the_client_does(
    finished, tmp_path, monkeypatch, threads_as_workers, reached
):
    by_worker, write = [], Store.write

    def noted(store, chunk):
        by_worker.append(threading.current_thread() is not threading.main_thread())
        write(store, chunk)

    monkeypatch.setattr(Store, "write", noted)
    if not reached:
        monkeypatch.setattr(Store, "within_reach", lambda path, token: None)
    simulate(small(), tmp_path / "run.zarr", chunk=100, scheduler=threads_as_workers)
    assert by_worker == [reached] * 3
    assert contents(tmp_path / "run.zarr") == contents(finished)


def test_a_worker_of_a_process_that_has_died_leaves_another_run_alone(finished, tmp_path):
    path = tmp_path / "run.zarr"
    shutil.copytree(finished, path)
    run = simulation._Run.of(small(seed=4), open_run(path).population, "moments", "cpu")
    with locked(path):
        result = simulation._write_there(run, path, "token of the dead", 0, 100)
    assert isinstance(result, Chunk)
    assert contents(path) == contents(finished)


@pytest.mark.parametrize("lost", ["tally/1.0.0.0.0", "tally/2.0.0.0.0"])
def test_an_interrupted_run_is_resumed_to_the_same_bytes(finished, tmp_path, lost):
    path = tmp_path / "run.zarr"
    shutil.copytree(finished, path)
    (path / lost).unlink()  # as if killed before its last write
    (path / "e1" / "0.1.123abc.partial").write_bytes(b"half")
    with pytest.raises(InputError, match=r"is not complete \(1 chunks missing\): run again with --resume"):
        open_run(path)
    simulate(small(), path, resume=True)
    assert contents(path) == contents(finished)


def test_an_interruption_inside_a_chunk_loses_that_chunk_only(finished, tmp_path, monkeypatch):
    path, done = tmp_path / "run.zarr", []
    write = Store.write

    def interrupted(store, chunk):
        if len(done) == 1:
            store.group["e1"][:, chunk.first : chunk.first + 100] = -7.0  # half of a chunk
            raise KeyboardInterrupt
        done.append(chunk.first)
        write(store, chunk)

    monkeypatch.setattr(Store, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        simulate(small(), path, chunk=100)
    monkeypatch.undo()
    assert simulate(small(), path, resume=True) == 150
    assert contents(path) == contents(finished)


COMMAND = [sys.executable, "-c", "from porrima.cli import main; main()", "simulate"]


def started(config, path, *options):
    """The command itself, as its own process."""
    arguments = [str(config), "-o", str(path), "--resume", "--json", *options]
    return subprocess.Popen([*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for_chunks(path, n, process):
    """Until n chunks are there; the process must still be at work."""
    while len(list((path / "tally").glob("*.0"))) < n:
        assert process.poll() is None, process.communicate()
        time.sleep(0.005)


@pytest.fixture(scope="module")
def long_run(tmp_path_factory):
    """Configuration of some hundred chunks, and what an uninterrupted run makes of it."""
    folder = tmp_path_factory.mktemp("long")
    config = small(n_stacks=5000, psf="psf0", estimator="plain")
    (folder / "run.yaml").write_text(canonical(config))
    simulate(config, folder / "whole.zarr", chunk=25)
    return folder / "run.yaml", folder / "whole.zarr"


def test_kills_at_random_moments_of_a_run_change_no_byte(long_run, tmp_path):
    file, whole = long_run
    path, rng = tmp_path / "run.zarr", np.random.Generator(np.random.Philox(5))
    for kill in range(4):
        process = started(file, path, "--chunk", "25")
        wait_for_chunks(path, 30 * kill + 20, process)
        time.sleep(rng.uniform(0, 0.05))
        process.kill()
        process.communicate()
        with pytest.raises(InputError, match="is not complete"):
            open_run(path)
    process = started(file, path)
    out, err = process.communicate()
    assert process.returncode == 0, err
    assert 0 < json.loads(out)["n_stacks_computed"] <= 5000 - 25 * 110
    assert contents(path) == contents(whole)


def test_ctrl_c_says_in_one_line_how_to_go_on(long_run, tmp_path):
    file, whole = long_run
    path = tmp_path / "run.zarr"
    process = started(file, path, "--chunk", "25")
    wait_for_chunks(path, 20, process)
    with pytest.raises(InputError, match=rf"is being written by process {process.pid} on "):
        simulate(load(file), path, resume=True)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    assert (process.returncode, out) == (1, "")
    assert err == "error: interrupted; --resume goes on with a run\n"
    simulate(load(file), path, resume=True)
    assert contents(path) == contents(whole)


def test_a_finished_run_is_left_alone(finished, tmp_path):
    path = tmp_path / "run.zarr"
    shutil.copytree(finished, path)
    assert simulate(small(), path, resume=True) == 0
    assert contents(path) == contents(finished)


def test_another_configuration_does_not_mix(finished):
    before = contents(finished)
    for config in (small(seed=4), small(multiplicity="dk13-kcm16")):
        with pytest.raises(InputError, match="holds a run of another configuration, stars or version"):
            simulate(config, finished, resume=True)
    with pytest.raises(InputError, match="holds a run of another configuration"):
        simulate(small(), finished, resume=True, method="images")
    with pytest.raises(InputError, match="exists already"):
        simulate(small(), finished)
    assert contents(finished) == before


def test_a_psf_whose_file_has_changed_does_not_mix(tmp_path):
    psf = tmp_path / "psf.yaml"
    config = small(psf=str(psf), n_stacks=10)
    psf.write_text("psf: {type: Gaussian, fwhm: 0.14}\n")
    simulate(config, tmp_path / "run.zarr")
    assert simulate(config, tmp_path / "run.zarr", resume=True) == 0
    psf.write_text("psf: {type: Gaussian, fwhm: 0.15}\n")
    with pytest.raises(InputError, match="holds a run of another configuration"):
        simulate(config, tmp_path / "run.zarr", resume=True)


def test_a_full_disk_stops_the_run_and_leaves_it_whole(finished, tmp_path):
    """A limit on the size of files stands for the full disk: the kernel refuses the largest file of a chunk."""
    path, before = tmp_path / "run.zarr", resource.getrlimit(resource.RLIMIT_FSIZE)

    def limited(n):
        if n:  # one chunk is there
            resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))

    try:
        with pytest.raises(RunError, match=r"run\.zarr: cannot be written \(File too large\); .* --resume"):
            simulate(small(), path, chunk=100, progress=limited)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(path.rglob("*.partial"))
    assert simulate(small(), path, resume=True) == 150
    assert contents(path) == contents(finished)


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(InputError, match=r"output: must lie in a folder that can be written, got .*nowhere"):
        simulate(small(), tmp_path / "nowhere" / "run.zarr")
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="output: "):
        simulate(small(), tmp_path / "file", resume=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file"]


def test_unknown_psfs_and_estimators_leave_nothing_behind(tmp_path):
    for change, name in (({"psf": "psf9"}, "psf9"), ({"estimator": "adaptove"}, "adaptove")):
        with pytest.raises(InputError, match=f"got {name}"):
            simulate(small(**change), tmp_path / "run.zarr")
    assert not list(tmp_path.iterdir())


def test_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(InputError, match="is not a run of porrima simulate"):
        open_run(tmp_path)
    with pytest.raises(InputError, match="is not a run of porrima simulate"):
        open_run(tmp_path / "absent.zarr")


def test_images_measure_what_moments_say(tmp_path):
    config = small(n_stacks=4, n_stars=10, binary_fraction=0.8)
    for method in ("moments", "images"):
        simulate(config, tmp_path / f"{method}.zarr", method=method)
    moments, images = (xr.open_zarr(tmp_path / f"{m}.zarr", chunks=None) for m in ("moments", "images"))
    np.testing.assert_array_equal(moments["moments"], images["moments"])
    change = images["r2"] - images["r2_0"]
    for name, unit in (("r2", 1.0), ("e1", images["r2_0"]), ("e2", images["r2_0"])):
        difference = (moments[name] - moments[f"{name}_0"]) - (images[name] - images[f"{name}_0"])
        assert np.all(np.abs(difference * unit) < 1e-4 * change)


def test_stars_are_the_same_for_a_seed_and_others_for_another():
    one, same, other = (draw_stars(small(seed=s)) for s in (3, 3, 4))
    np.testing.assert_array_equal(one.mass, same.mass)
    assert not np.array_equal(one.mass, other.mass)


def test_a_run_keeps_its_stars(finished):
    run = open_run(finished)
    np.testing.assert_array_equal(run.population.stars.distance, draw_stars(run.config).distance)


def test_no_star_in_the_range_is_an_error():
    with pytest.raises(InputError, match="no main-sequence star"):
        draw_stars(small(stars={"l": 180, "b": 45, "mag": [-20, -19], "area": 0.1}))
