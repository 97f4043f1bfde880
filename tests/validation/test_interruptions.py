"""The command killed at random moments, its workers too, and what a run and a summary hold in memory."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import psutil
import pytest

CHUNK, KILLS = 100, 20
CONFIG = "stars: {{l: 180, b: 45, mag: [18, 19], n_drawn: 2000}}\nn_stacks: {}\nn_stars: {}\n"
KILLED = (
    "20 Interruptions: `porrima simulate` of 80 000 stacks in chunks of 100, each process killed with SIGKILL at a "
    "random moment from its start to its fifteenth chunk or so, then started again with `--resume`; and "
    "workers of one run killed with SIGKILL.  The store at the end against that of an uninterrupted run, byte by byte; "
    "a chunk is lost that was begun and is not complete."
)
MEMORY = (
    "21 Memory: largest resident size of the command's process, the interpreter and all libraries "
    "(some 300 MB) included, for stacks of 40 stars behind three PSFs."
)
MEMORY_LIMIT = 600  # MB


MAIN = "from porrima.cli import main; main()"
WITH_PEAK = (
    "import atexit, sys; atexit.register(lambda: sys.stderr.write(open('/proc/self/status').read())); " + MAIN
)


def command(*arguments, code=MAIN, **options):
    words = [sys.executable, "-c", code, *map(str, arguments), "--json"]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def done(process):
    out, err = process.communicate()
    assert process.returncode == 0, err
    return json.loads(out)


def contents(path):
    return {str(p.relative_to(path)): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}


def chunks(path, name):
    return {int(p.name.split(".")[0]) for p in (path / name).glob("[0-9]*") if p.suffix != ".partial"}


def wait_for(n, path, process):
    """Until n chunks are there, or the process is not."""
    while process.poll() is None and len(chunks(path, "tally")) < n:
        time.sleep(0.005)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, full_size):
    """Folder with a configuration and the store of a whole run, its stacks, and the time to its first chunk."""
    folder, n_stacks = tmp_path_factory.mktemp("whole"), 80_000 if full_size else 12_000
    (folder / "run.yaml").write_text(CONFIG.format(n_stacks, 40))
    done(command("simulate", folder / "run.yaml", "-o", folder / "first.zarr", "--chunk", CHUNK))  # compiles
    start = time.monotonic()
    path = folder / "run.zarr"
    process = command("simulate", folder / "run.yaml", "-o", path, "--chunk", CHUNK)
    wait_for(1, path, process)
    first = time.monotonic() - start
    done(process)
    assert contents(path) == contents(folder / "first.zarr")
    return folder, n_stacks, first


def test_kills_at_random_moments_of_a_run_change_no_byte(whole, full_size, tmp_path, record):
    (folder, n_stacks, first), kills = whole, KILLS if full_size else 3
    path, rng = tmp_path / "run.zarr", np.random.Generator(np.random.Philox(20261123))
    lost, at_work = [], 0
    for _ in range(kills):
        before = len(chunks(path, "tally"))
        process = command("simulate", folder / "run.yaml", "-o", path, "--chunk", CHUNK, "--resume")
        if rng.uniform() < 1 / 3:
            time.sleep(rng.uniform(0, first))
        else:
            wait_for(before + rng.integers(1, 15), path, process)
            time.sleep(rng.uniform(0, 0.05))
        assert process.poll() is None
        process.kill()
        process.communicate()
        written = chunks(path, "tally")
        lost.append(len(chunks(path, "binary_fraction") - written))
        at_work += len(written) > before
    left = done(command("simulate", folder / "run.yaml", "-o", path, "--resume"))["n_stacks_computed"]
    assert max(lost) <= 1
    assert 0 < left < n_stacks
    assert contents(path) == contents(folder / "run.zarr")
    columns = [
        "killed",
        "times",
        "of these while chunks were written",
        "most chunks lost by one",
        "bytes that differ",
    ]
    record(KILLED, columns, ["the command", kills, at_work, max(lost), 0])


def test_killed_workers_and_a_killed_client_change_no_byte(whole, full_size, tmp_path, record):
    folder, n_stacks, _ = whole
    path, rng, kills = tmp_path / "run.zarr", np.random.Generator(np.random.Philox(20261124)), 0
    arguments = ("simulate", folder / "run.yaml", "-o", path, "--resume", "--workers", 2, "--chunk", CHUNK)
    for end in (
        n_stacks // 1000,
        n_stacks // 200,
        n_stacks,
    ):  # chunks after which the client itself is killed; the last time it is not
        process, before = command(*arguments, start_new_session=True), len(chunks(path, "tally"))
        while process.poll() is None and len(chunks(path, "tally")) < end:
            time.sleep(rng.uniform(0, 2))
            workers = [
                p for p in psutil.Process(process.pid).children() if "spawn_main" in " ".join(p.cmdline())
            ]
            if len(workers) == 2 and len(chunks(path, "tally")) > before and kills < 8:
                os.kill(rng.choice([p.pid for p in workers]), signal.SIGKILL)
                kills += 1
        if end < n_stacks:
            process.kill()
            process.communicate()
    done(process)
    assert kills > (3 if full_size else 1)
    assert contents(path) == contents(folder / "run.zarr")
    columns = [
        "killed",
        "times",
        "of these while chunks were written",
        "most chunks lost by one",
        "bytes that differ",
    ]
    record(KILLED, columns, ["workers of two, and twice their client", kills + 2, kills + 2, "", 0])


def peak(*arguments):
    """Largest resident size of a command since it was started, in MB."""
    process = command(*arguments, code=WITH_PEAK)
    _, err = process.communicate()
    assert process.returncode == 0
    return int(re.search(r"VmHWM:\s*(\d+) kB", err)[1]) / 1024


def test_memory_does_not_grow_with_the_number_of_stacks(tmp_path, full_size, record):
    file, peaks = tmp_path / "first.yaml", {}
    file.write_text(CONFIG.format(1000, 40))
    done(command("simulate", file, "-o", tmp_path / "first.zarr"))  # compiles
    for n_stacks in (100_000, 1_000_000) if full_size else (30_000, 300_000):
        file, path = tmp_path / f"{n_stacks}.yaml", tmp_path / f"{n_stacks}.zarr"
        file.write_text(CONFIG.format(n_stacks, 40))
        peaks[n_stacks] = {
            "simulate": peak("simulate", file, "-o", path),
            "summary --bins 20": peak("summary", path, "--bins", 20),
            "summary --bins 7": peak("summary", path, "--bins", 7),
        }
    few, many = peaks.values()
    for name in few:
        columns = ["command", *(f"{n:,} stacks [MB]".replace(",", " ") for n in peaks)]
        record(MEMORY, columns, [name, f"{few[name]:.0f}", f"{many[name]:.0f}"])
        assert many[name] < MEMORY_LIMIT
        assert many[name] < few[name] + 50
