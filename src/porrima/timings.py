"""Times of several pieces of work, taken in turn so that the noise of a shared machine hits all alike."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["Estimate", "estimate", "seconds_of", "taken_in_turn"]

Name = TypeVar("Name")

_OF_MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median over that of a mean


class Estimate(NamedTuple):
    """A number and its standard error."""

    value: float
    error: float


def estimate(values: FloatArray) -> Estimate:
    r"""Median of repeated values, and its standard error.

    Parameters
    ----------
    values : (n,) float array
        Of n rounds, n > 1, in any unit of the caller.

    Returns
    -------
    estimate : Estimate
        In the same unit; the error is :math:`\sqrt{\pi/2}` standard deviations over :math:`\sqrt{n}`.
    """
    error = _OF_MEDIAN * np.std(values, ddof=1) / math.sqrt(values.size)
    return Estimate(float(np.median(values)), float(error))


def seconds_of(work: Callable[[], object]) -> float:
    """Wall time of one call.

    Parameters
    ----------
    work : callable
        Its result is dropped.

    Returns
    -------
    seconds : float
        By the monotonic clock of highest resolution.
    """
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def taken_in_turn(tasks: Mapping[Name, Callable[[], float]], rounds: int) -> dict[Name, FloatArray]:
    """Times of several tasks, one of each in every round.

    Parameters
    ----------
    tasks : mapping of name to callable
        Each does its work and returns how many seconds of that count.
    rounds : int
        That count, at least 2; one more goes before them, in which code is compiled and caches fill (count).

    Returns
    -------
    seconds : dict of name to (rounds,) float array
        Times of each task, in s.
    """
    for task in tasks.values():
        task()
    table = np.array([[task() for task in tasks.values()] for _ in range(rounds)])
    return dict(zip(tasks, table.T, strict=True))
