import json
import shutil

import numpy as np
import pytest
import xarray as xr

from porrima import simulation
from porrima.config import RunConfig, parse
from porrima.errors import InputError
from porrima.moments import INDICES
from porrima.sample import draw_stars
from porrima.simulation import simulate
from porrima.store import open_run


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


@pytest.mark.parametrize("lost", ["moments/1.0", "moments/2.0"])
def test_an_interrupted_run_is_resumed_to_the_same_bytes(finished, tmp_path, lost):
    path = tmp_path / "run.zarr"
    shutil.copytree(finished, path)
    (path / lost).unlink()  # as if killed before its last write
    (path / "e1" / "0.1.123abc.partial").write_bytes(b"half")
    with pytest.raises(InputError, match=r"is not complete \(1 chunks missing\): run again with --resume"):
        open_run(path)
    simulate(small(), path, resume=True)
    assert contents(path) == contents(finished)


def test_a_kill_at_any_write_loses_one_chunk_at_most(finished, tmp_path, monkeypatch):
    path, done = tmp_path / "run.zarr", []
    write = simulation._write_chunk

    def killed(store, path, chunk):
        if len(done) == 1:
            store["e1"][:, chunk.first : chunk.last] = -7.0  # half of a chunk
            raise KeyboardInterrupt
        done.append(chunk.first)
        write(store, path, chunk)

    monkeypatch.setattr(simulation, "_write_chunk", killed)
    with pytest.raises(KeyboardInterrupt):
        simulate(small(), path, chunk=100)
    monkeypatch.undo()
    assert simulate(small(), path, resume=True) == 150
    assert contents(path) == contents(finished)


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
