"""The benchmark says what it measured, on what, and how well; no test knows how long anything takes."""

import io
import json
import sys
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from porrima import bench
from porrima.bench import FULL, PSF_NAMES, QUICK, Sizes, n_steps
from porrima.cli import main
from porrima.peers import PEERS
from porrima.performance import BEGIN, END, lines, tables, with_tables

TINY = Sizes(
    rounds=2, seconds=1e-3, n_stars=(3, 20), scan_stars=(1, 10), scan_stacks=(2, 30), memory_stacks=(100,)
)
SAVED = Path(__file__).parents[1] / "docs" / "bench.json"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """What ``porrima bench --quick --json -o FOLDER`` says and writes, on very little."""
    folder = tmp_path_factory.mktemp("bench")
    page = f"before\n\n{BEGIN}\nold\n{END}\n\nafter\n"
    (folder / "performance.md").write_text(page)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "QUICK", TINY)
        patch.setattr(
            sys, "argv", ["porrima", "bench", "--quick", "--json", "--seed", "3", "-o", str(folder)]
        )
        with redirect_stdout(io.StringIO()) as printed, pytest.raises(SystemExit) as stop:
            main()
    assert stop.value.code == 0
    return json.loads(printed.getvalue()), folder


@pytest.fixture(scope="module")
def result(run):
    return run[0]


def test_a_benchmark_describes_its_machine(result):
    assert result["processor"]
    assert result["threads"] >= 1
    assert result["cores"] >= 1
    assert result["vector_bits"] in (64, 128, 256, 512)
    assert "numba" in result["versions"]
    assert result["seed"] == 3
    assert result["wall_s"] > 0


def test_a_benchmark_has_the_keys_of_the_saved_one(result):
    saved = json.loads(SAVED.read_text(encoding="utf-8"))
    assert set(result) == set(saved)
    for key, value in result.items():
        if isinstance(value, list):
            assert {frozenset(row) for row in value} == {frozenset(row) for row in saved[key]}


def test_every_peer_and_the_floor_is_measured_behind_every_psf(result):
    expected = {(psf, n) for psf in PSF_NAMES for n in TINY.n_stars}
    for who in ("moments", "shapes", "floor", *PEERS):
        rows = [row for row in result["speeds"] if row["who"] == who and row["device"] == "cpu"]
        assert {(row["psf"], row["n_stars"]) for row in rows} == expected
        assert all(row["stars_per_s"] > 0 and row["stars_per_s_error"] >= 0 for row in rows)


def test_ratios_are_those_of_the_speeds(result):
    speed = {(r["psf"], r["n_stars"], r["who"]): r["stars_per_s"] for r in result["speeds"]}
    assert {row["against"] for row in result["ratios"]} == {"floor", *PEERS}
    for row in result["ratios"]:
        kind = row["psf"], row["n_stars"]
        for key, who in (("ratio", "shapes"), ("ratio_moments", "moments")):
            of_medians = speed[*kind, who] / speed[*kind, row["against"]]
            assert row[key] > 0
            assert row[f"{key}_error"] >= 0
            assert of_medians / 100 < row[key] < 100 * of_medians  # medians of few rounds of a noisy machine


def test_shapes_are_measured_three_ways(result):
    rows = {(row["psf"], row["measurer"]): row for row in result["shape_speeds"]}
    assert set(rows) == {(psf, name) for psf in PSF_NAMES for name in ("response", "stamps", "hsm")}
    assert all(row["shapes_per_s"] > 0 and row["ratio_to_hsm"] > 0 for row in rows.values())
    assert all(rows[psf, "hsm"]["ratio_to_hsm"] == 1 for psf in PSF_NAMES)


def test_the_cost_is_measured_at_every_point(result):
    assert [row["n_stars"] for row in result["cost_of_stars"]] == [*TINY.scan_stars]
    assert [row["n_stacks"] for row in result["cost_of_stacks"]] == [*TINY.scan_stacks]
    for row in result["cost_of_stars"] + result["cost_of_stacks"]:
        assert row["us_per_stack"] > 0
        assert row["us_per_stack_with_shape"] > 0


def test_memory_is_that_of_a_process_of_its_own(result):
    (row,) = result["memory"]
    assert row["n_stacks"] == TINY.memory_stacks[0]
    assert 50 < row["peak_mb"] < 2000  # an interpreter with numba and galsim, and not this whole test session
    assert row["run_s"] > 0


def test_files_are_written_and_the_page_gets_its_tables(run):
    result, folder = run
    assert {path.name for path in folder.iterdir()} == {
        "bench.json", "performance.png", "performance.svg", "performance.md",
    }  # fmt: skip
    assert json.loads((folder / "bench.json").read_text(encoding="utf-8")) == result
    page = (folder / "performance.md").read_text(encoding="utf-8")
    assert page.startswith("before\n")
    assert page.endswith("after\n")
    assert "old" not in page
    assert tables(result) in page
    assert with_tables(page, result) == page


def test_every_number_of_the_terminal_comes_with_its_error(result):
    told = lines(result)
    assert all(len(line) == 3 for line in told)
    assert sum("±" in value for _, value, _ in told) >= len(result["speeds"]) + 2 * len(result["ratios"])


def test_a_document_without_markers_stays_as_it_is(result):
    assert with_tables("# Other\n", result) == "# Other\n"


@pytest.mark.parametrize("sizes", [FULL, QUICK, TINY])
def test_progress_knows_how_many_steps_there_are(sizes):
    assert n_steps(sizes) > len(sizes.scan_stars) + len(sizes.scan_stacks)
