"""Compile the kernel of `porrima.gpu` for a GPU that need not be there, and say what it takes.

    CUDA_HOME=/usr/local/cuda python tests/compile_ptx.py 8.0

With `nvidia`'s `ptxas` on the path, registers and spills are printed too.  The kernel must hold no approximate
division or square root and no flush to zero outside the logarithm and the power of the binomial draw.
"""

import re
import shutil
import subprocess
import sys
import tempfile
from types import SimpleNamespace

import numba
from numba import cuda, float32, float64, int64, types
from numba.cuda import dispatcher

from porrima.gpu import _kernel
from porrima.pairs import Tables

RELAXED = re.compile(r"\b(?:div|sqrt|rsqrt|rcp|add|sub|mul|fma|ex2|lg2)\.[a-z.]*(?:approx|ftz)[a-z0-9.]*")


def signature():
    """Types of the arguments of the kernel."""
    rows, column = float32[:, ::1], float32[::1]
    fields = {"star": rows, "track": rows, "weight": column, "alias": rows}
    fields |= {"n_grid": int64, "isotropic": types.boolean, "largest_fraction": float64}
    tables = types.NamedTuple([fields.get(name, float32) for name in Tables._fields], Tables)
    return tables, types.uint64, int64, int64[::1], float64[::1], float64[::1], float64[:, ::1]


def compiled(capability):
    """PTX of the kernel for a compute capability."""
    dispatcher.get_current_device = lambda: SimpleNamespace(compute_capability=capability)
    return cuda.compile_ptx(_kernel.py_func, signature(), cc=capability)[0]


def assembled(ptx, capability):
    """What ptxas says of it."""
    with tempfile.NamedTemporaryFile("w", suffix=".ptx") as file:
        file.write(ptx)
        file.flush()
        limit = str(_kernel.targetoptions["max_registers"])
        command = [
            "ptxas",
            "-v",
            f"-arch=sm_{''.join(map(str, capability))}",
            "-maxrregcount",
            limit,
            file.name,
        ]
        done = subprocess.run([*command, "-o", "/dev/null"], capture_output=True, text=True, check=False)
    return [
        line for line in done.stderr.splitlines() if "registers" in line or "spill" in line or "fatal" in line
    ]


if __name__ == "__main__":
    capability = tuple(int(part) for part in sys.argv[1].split("."))
    ptx = compiled(capability)
    print(
        f"numba {numba.__version__}, {cuda.__name__} of {cuda.__file__}: {len(ptx.splitlines())} lines of PTX"
    )
    print("relaxed:", sorted(set(RELAXED.findall(ptx))))
    if shutil.which("ptxas"):
        print(*assembled(ptx, capability)[:2], sep="\n")
