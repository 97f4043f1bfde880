"""Work on many processes: a local Dask cluster, or one that is reached by its address."""

from __future__ import annotations

import logging
import signal
import threading
import time
import warnings
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from itertools import islice
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any, TypeVar

import numba

from porrima import __version__
from porrima.errors import InputError, RunError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    Work = Callable[[int, int], "Result"]

__all__ = ["Cluster", "cluster"]

Result = TypeVar("Result")

_AHEAD = 2  # tasks given out per worker, so that none waits for the next one; bounds what is held in memory
_TOGETHER = 16  # results fetched in one message
_RECOUNT = 5.0  # s between two looks at how many workers there are
_GO_ON = "what is written is whole: go on with --resume"
_ALONE = threading.Lock()  # one task at a time takes all threads of a worker


@dataclass(frozen=True, slots=True, kw_only=True)
class Cluster:
    """Workers that this process can give work to.

    Parameters
    ----------
    client : dask.distributed.Client
        The connection.
    address : str
        Of the scheduler.
    """

    client: Any
    address: str

    def results(self, work: Work[Result], ranges: list[tuple[int, int]]) -> Iterator[Result]:
        """Results of ranges, in the order in which they are done.

        Parameters
        ----------
        work : callable
            Of a first number and the one after the last; it travels to each worker once.
        ranges : list of (int, int)
            What to call it with (count).

        Yields
        ------
        result : object
            What it returns.

        Returns
        -------
        None
            A generator.

        Raises
        ------
        RunError
            If workers die of a range again and again, or the scheduler is gone.
        InputError
            If a worker has other versions, or no Porrima.

        Notes
        -----
        The work is itself a task, not scattered data: when the last worker that held it dies, the scheduler, which
        has its recipe, sends it to another.
        """
        from dask.distributed import as_completed  # noqa: PLC0415  (an extra)

        held = self.client.submit(_held, work, _versions(), pure=False)
        waiting = iter(ranges)
        of_future: dict[str, tuple[int, int]] = {}

        def submit(n: int) -> list[Any]:
            some = list(islice(waiting, max(n, 0)))
            futures = [self.client.submit(_on_worker, held, *one, pure=False) for one in some]
            of_future.update(zip((future.key for future in futures), some, strict=True))
            return futures

        queue, counted = as_completed(submit(_AHEAD * self._count())), time.monotonic()
        for batch in queue.batches():
            done = list(batch)
            queue.update(submit(len(done)))
            if time.monotonic() - counted > _RECOUNT:
                counted = time.monotonic()
                queue.update(submit(_AHEAD * self._count() - len(of_future) + len(done)))
            for k in range(0, len(done), _TOGETHER):
                yield from self._gathered({f: of_future.pop(f.key) for f in done[k : k + _TOGETHER]})

    def _gathered(self, futures: dict[Any, tuple[int, int]]) -> Iterator[Any]:
        """Results of some futures in one message; one by one where there is an error among them."""
        try:
            results = self.client.gather(list(futures))
        except Exception:
            results = (self._result(*one) for one in futures.items())
        yield from results

    def _count(self) -> int:
        """Number of workers, 1 at least."""
        try:
            return max(1, len(self.client.nthreads()))
        except OSError as error:
            raise self._gone(error) from None

    def _result(self, future: Any, some: tuple[int, int]) -> Any:
        from dask.distributed import CancelledError, KilledWorker  # noqa: PLC0415  (an extra)

        try:
            return future.result()
        except KilledWorker as error:
            message = (
                f"{error.allowed_failures + 1} workers died with stacks {some[0]} to {some[1] - 1} in hand"
            )
            raise RunError(f"{self.address}: {message}; {_GO_ON}") from None
        except (CancelledError, TimeoutError, OSError) as error:
            raise self._gone(error) from None
        except ImportError as error:
            rule = f"must have Porrima on its scheduler and workers ({error})"
            raise InputError(rule, key="scheduler", value=self.address) from None

    def _gone(self, error: BaseException) -> RunError:
        return RunError(f"{self.address}: is gone ({type(error).__name__}); {_GO_ON}")


@contextmanager
def cluster(workers: int | None, scheduler: str | None) -> Iterator[Cluster | None]:
    """Workers of a Dask cluster, made here or reached by address; None where neither is asked for.

    Parameters
    ----------
    workers : int or None
        Processes of a local cluster (count), each with its share of the cores.
    scheduler : str or None
        Address of a running scheduler.

    Yields
    ------
    cluster : Cluster or None
        A local one is closed at the end.

    Returns
    -------
    None
        A context manager.

    Raises
    ------
    InputError
        If Dask is not installed, or the scheduler cannot be reached.
    RunError
        If a worker dies before it is ready.
    """
    if workers is None and scheduler is None:
        yield None
        return
    try:
        from dask.distributed import Client  # noqa: PLC0415  (an extra)
        from distributed.utils import silence_logging_cmgr  # noqa: PLC0415
    except ImportError:
        raise InputError("needs Dask: install porrima[cluster]", key="workers") from None
    with ExitStack() as stack:
        stack.enter_context(silence_logging_cmgr(logging.CRITICAL))  # what goes wrong is said in one line
        try:
            where = stack.enter_context(_local(workers or 1)) if scheduler is None else scheduler
            client = stack.enter_context(Client(where, timeout="10s"))
            if not client.nthreads():
                warnings.warn(f"{scheduler} has no workers yet: waiting for one", stacklevel=3)
        except (OSError, ValueError, ImportError) as error:  # ImportError: of an unknown protocol, say
            raise InputError(f"cannot be reached ({error})", key="scheduler", value=scheduler) from None
        yield Cluster(client=client, address=client.scheduler.address)


@contextmanager
def _local(workers: int) -> Iterator[Any]:
    """A cluster of this machine, whose processes do not see Ctrl-C: the one that made them ends them.

    Dask takes a worker that is away for 15 s for lost, also one that is just being started anew after its death.
    """
    import dask  # noqa: PLC0415  (an extra)
    from dask.distributed import LocalCluster  # noqa: PLC0415
    from dask.system import CPU_COUNT  # noqa: PLC0415

    options = {"n_workers": workers, "threads_per_worker": max(1, CPU_COUNT // workers), "processes": True}
    with dask.config.set({"distributed.deploy.lost-worker-timeout": "1 day"}):
        resource_tracker.ensure_running()  # which would undo the mask
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # threads and processes inherit it
        try:
            here = LocalCluster(**options, dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL)
        except RuntimeError:  # a worker died before it was ready, killed for its memory, say
            raise RunError(f"{workers} workers cannot be started: one died; {_GO_ON}") from None
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        with here:
            yield here


def _versions() -> dict[str, str]:
    """What the bits of a result depend on."""
    return {"porrima": __version__} | {name: version(name) for name in ("numpy", "numba")}


def _held(work: Work[Result], versions: dict[str, str]) -> Work[Result]:
    """Work on a worker, which must have the versions of the process that gives it out."""
    here = _versions()
    for name, wanted in versions.items():
        if here[name] != wanted:
            raise InputError(f"must have {name} {wanted} on its workers", key="scheduler", value=here[name])
    return work


def _on_worker(work: Work[Result], first: int, last: int) -> Result:
    """Result of one range with all the threads that Dask gives this worker, and no more.

    Dask would run as many tasks at once, each on its own: together they would take the square of them.
    """
    from dask.distributed import get_worker  # noqa: PLC0415  (an extra)

    with _ALONE:
        numba.set_num_threads(min(get_worker().state.nthreads, numba.config.NUMBA_NUM_THREADS))
        return work(first, last)
