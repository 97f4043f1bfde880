"""The machine that a measurement of speed was made on, in words and numbers."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numba
from llvmlite import binding

import porrima

__all__ = ["Machine", "peak_memory", "this_machine"]

_VECTOR_BITS = {"avx512f": 512, "avx2": 256, "avx": 256, "neon": 128, "sse2": 128}  # widest first
_TOLD = ("fma", "avx2", "avx512f", "avx512dq", "neon", "sve")
_PACKAGES = ("numpy", "scipy", "numba", "llvmlite", "GalSim")


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """Processor, memory and versions.

    Parameters
    ----------
    processor : str
        Its model.
    cores : int
        That this process may use (count).
    threads : int
        Of the compiled loops, and as many processes for what is not compiled (count).
    vector_bits : int
        Width of the processor's vector registers (count); the compiler may use half of it.
    vector_features : str
        Instruction sets that matter here.
    memory_gb : float or None
        Of the machine, in 10^9 bytes; None where it does not say.
    gpu : str or None
        Its name where numba sees one.
    versions : str
        Of Python and the packages that do the work.
    """

    processor: str
    cores: int
    threads: int
    vector_bits: int
    vector_features: str
    memory_gb: float | None
    gpu: str | None
    versions: str


def this_machine() -> Machine:
    """The machine that this process runs on.

    Returns
    -------
    machine : Machine
        As the operating system and the compiler describe it.
    """
    features = binding.get_host_cpu_features()
    packages = [f"{name.lower()} {version(name)}" for name in _PACKAGES]
    return Machine(
        processor=_processor(),
        cores=_cores(),
        threads=numba.get_num_threads(),
        vector_bits=next((bits for name, bits in _VECTOR_BITS.items() if features.get(name)), 64),
        vector_features=" ".join(name for name in _TOLD if features.get(name)),
        memory_gb=_memory_gb(),
        gpu=_gpu(),
        versions=", ".join(
            [f"python {platform.python_version()}", f"porrima {porrima.__version__}", *packages]
        ),
    )


def peak_memory() -> float:
    """Largest resident memory of this process so far, in 10^6 bytes.

    Returns
    -------
    peak : float
        In 10^6 bytes.

    Notes
    -----
    The kernel's VmHWM where there is one: ``getrusage`` starts from what the parent held.
    """
    try:
        status = Path("/proc/self/status").read_text(encoding="utf-8")
        return (
            next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) * 1.024e-3
        )
    except (OSError, StopIteration):
        import resource  # noqa: PLC0415  (not on every system)

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak * (1e-6 if platform.system() == "Darwin" else 1.024e-3)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _memory_gb() -> float | None:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") * 1e-9
    except (AttributeError, ValueError, OSError):
        return None


def _gpu() -> str | None:
    from numba import cuda  # noqa: PLC0415  (starts the driver)

    if not cuda.is_available():
        return None
    name = cuda.get_current_device().name
    return name.decode() if isinstance(name, bytes) else str(name)
