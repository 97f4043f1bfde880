"""Dask workers with work of their own; the tests of a run on workers are in `test_simulation`."""

import os
import signal
import time
from itertools import pairwise

import dask
import numba
import pytest
from dask.distributed import Client
from dask.system import CPU_COUNT

from porrima import cluster as module
from porrima.cluster import cluster
from porrima.errors import InputError, RunError

RANGES = [(k, k + 2) for k in range(0, 40, 2)]


def numbers(first, last):
    return list(range(first, last))


def slow_numbers(first, last):
    time.sleep(0.1)
    return numbers(first, last)


def deadly(first, last):
    if first == 4:
        os.kill(os.getpid(), signal.SIGKILL)
    return numbers(first, last)


def spell(first, last):
    """When this range was at work, in which process, on how many threads."""
    start = time.monotonic()
    time.sleep(0.05)
    return os.getpid(), start, time.monotonic(), numba.get_num_threads()


@pytest.fixture(scope="module")
def two():
    with cluster(2, None) as workers:
        yield workers


def test_without_workers_there_is_no_cluster():
    with cluster(None, None) as none:
        assert none is None


def test_all_ranges_come_back_once(two):
    assert sorted(two.results(numbers, RANGES)) == [[k, k + 1] for k in range(0, 40, 2)]
    assert list(two.results(numbers, [])) == []


def test_a_worker_has_its_share_of_the_cores(two):
    found = list(two.results(spell, RANGES))
    assert {threads for *_, threads in found} == {max(1, CPU_COUNT // 2)}
    assert len({pid for pid, *_ in found}) == 2


def test_killed_workers_lose_nothing(two):
    """One, then all at once: what they had to do, and the work itself, are sent anew."""
    results, found = two.results(slow_numbers, RANGES), []
    for victims in (1, 2):
        found += [next(results) for _ in range(3)]
        for pid in list(two.client.run(os.getpid).values())[:victims]:
            os.kill(pid, signal.SIGKILL)
    assert sorted(found + list(results)) == [[k, k + 1] for k in range(0, 40, 2)]


def test_a_range_that_kills_its_worker_ends_the_run():
    message = r"1 workers died with stacks [2-6] to [3-7] in hand; .* --resume"  # 2 and 6 were there as well
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}), cluster(1, None) as one:
        results = one.results(deadly, RANGES)
        with pytest.raises(RunError, match=message):
            list(results)


def test_a_worker_that_dies_before_it_is_ready_is_told_in_one_line(tmp_path):
    deadly_start = tmp_path / "deadly_start.py"
    deadly_start.write_text("import os\nos._exit(1)\n")
    with (
        dask.config.set({"distributed.worker.preload": [str(deadly_start)]}),
        pytest.raises(RunError, match=r"2 workers cannot be started: one died; .* --resume"),
        cluster(2, None),
    ):
        pass


def test_a_worker_of_many_threads_does_one_range_at_a_time_with_all_of_them():
    with cluster(1, None) as one:
        found = list(one.results(spell, RANGES[:6]))
    spells = sorted((start, end) for _, start, end, _ in found)
    assert all(end <= start for (_, end), (start, _) in pairwise(spells))
    assert {threads for *_, threads in found} == {min(CPU_COUNT, numba.config.NUMBA_NUM_THREADS)}


def test_workers_with_other_versions_are_refused():
    assert module._held(numbers, module._versions()) is numbers
    with pytest.raises(InputError, match=r"scheduler: must have numpy 1\.0 on its workers, got "):
        module._held(numbers, {"numpy": "1.0"})


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "foo://bar", ""])
def test_a_scheduler_that_is_not_there_is_named(address, monkeypatch):
    monkeypatch.setattr("dask.distributed.Client", lambda where, timeout: Client(where, timeout="1s"))
    with pytest.raises(InputError, match="scheduler: cannot be reached"), cluster(None, address):
        pass


def test_local_workers_do_not_see_ctrl_c(two):
    def blocked():
        return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])

    assert set(two.client.run(blocked).values()) == {True}
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
