"""The kernel of the GPU in numba's CUDA simulator, against the engine of the CPU.

That it compiles for a real GPU is shown by `tests/compile_ptx.py`, which needs the CUDA toolkit.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from cuda_simulator import drawn
from porrima import elementary, gpu, orbits, pairs, streams
from porrima.errors import InputError
from porrima.moments import INDICES
from porrima.stack import draw_stacks

RUN = {"n_stars": 5, "binary_fraction": "uniform", "seed": 1, "first": 0, "last": 2}


@pytest.fixture(scope="module")
def simulated():
    """What the simulator says, in a process of its own: it is chosen when numba is imported."""
    script = Path(__file__).with_name("cuda_simulator.py")
    environment = os.environ | {"NUMBA_ENABLE_CUDASIM": "1"}
    command = [sys.executable, "-W", "error", str(script)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    ("case", "n_stacks"),
    [
        ("uniform", 4),
        ("as the model", 1),
        ("capped", 4),
        ("weighted", 4),
        ("classes", 4),
        ("inclination-uniform", 4),
    ],
)
def test_the_kernel_draws_the_pairs_of_the_cpu(simulated, case, n_stacks):
    """The largest moment of each order to the rounding of float32 in log2(a), times the order."""
    here, there = drawn(case, "cpu"), simulated[case]
    np.testing.assert_array_equal(there["fraction"], here.binary_fraction)
    a, b = here.moments.values, np.array(there["moments"])
    assert np.count_nonzero(a.any(axis=1)) == n_stacks
    for order in range(2, 9):
        these = np.sum(INDICES, axis=1) == order
        largest = np.abs(a[:, these]).max(axis=1, keepdims=True)
        assert np.all(np.abs(b - a)[:, these] <= 3e-6 * order * largest), order


def test_a_stack_that_cannot_be_filled_is_given_up(simulated):
    assert simulated["given_up"].startswith("cut must leave some pairs unresolved")


@pytest.mark.parametrize("module", [elementary, gpu, orbits, pairs, streams], ids=lambda m: m.__name__)
def test_no_step_takes_relaxed_arithmetic_to_the_gpu(module):
    """A function that is called, not written out in its caller, would take its options along.

    There {"contract"} would switch on all of fast math.
    """
    steps = [step for step in vars(module).values() if isinstance(step, Dispatcher)]
    options = [step.targetoptions for step in steps if hasattr(step, "targetoptions")]
    assert options
    assert all(o.get("inline") == "always" for o in options if o.get("fastmath"))


def test_without_a_gpu_one_line_says_what_is_missing(population, monkeypatch):
    monkeypatch.setattr(gpu.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match=r"^device: no CUDA device found: it takes an NVIDIA GPU"):
        draw_stacks(population, device="cuda", **RUN)


def test_an_unknown_device_is_named(population):
    with pytest.raises(ValueError, match="device must be cpu or cuda, got tpu"):
        draw_stacks(population, device="tpu", **RUN)
