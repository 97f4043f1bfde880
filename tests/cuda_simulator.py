"""Stacks drawn by the kernel of `porrima.gpu` in numba's CUDA simulator, compared with those of a CPU, as JSON.

The simulator is chosen when numba is imported: run it with NUMBA_ENABLE_CUDASIM=1.
"""

import json

import numpy as np

from porrima import gpu
from porrima.moments import INDICES
from porrima.multiplicity import DucheneKraus2013
from porrima.photometry import PHOTOMETRY
from porrima.stack import draw_stacks
from porrima.stars import Stars
from porrima.systems import Population

gpu._on_device = lambda tables: tables  # compiled functions do not take the simulator's arrays
ORDER = np.sum(INDICES, axis=1)
CASES = {
    "uniform": ({}, {}, {"n_stars": 40, "binary_fraction": "uniform"}),
    "as the model": ({}, {}, {"n_stars": 2000, "binary_fraction": "model"}),
    "capped": ({}, {}, {"n_stars": 100, "binary_fraction": 0.95}),
    "weighted": ({}, {"stack_weight": "flux"}, {"n_stars": 40, "binary_fraction": 0.9}),
    "classes": (
        {"eccentricity": "thermal"},
        {"stack_weight": "flux"},
        {"n_stars": 40, "binary_fraction": 0.35},
    ),
    "inclination-uniform": (
        {"projection": "inclination-uniform", "a_max_factor": 2.5},
        {},
        {"n_stars": 40, "binary_fraction": 0.35},
    ),
}


def population(stars, options, choices):
    """Stars and their companions."""
    models = {"multiplicity": DucheneKraus2013(**options), "photometry": PHOTOMETRY["main-sequence"]}
    return Population.of(stars, **models, **choices)


def stars():
    """Fifty stars of all kinds."""
    rng = np.random.Generator(np.random.Philox(8))
    return Stars.from_columns(
        mass=rng.uniform(0.085, 1.2, 50),
        distance=10 ** rng.uniform(2.2, 3.6, 50),
        magnitude=rng.uniform(18, 19, 50),
        metallicity=rng.uniform(-2, 0.2, 50),
        log_age=rng.uniform(9.0, 10.1, 50),
    )


def compare(options, choices, run):
    """Whether fractions are the same, and how far moments of each order differ over the largest of them in a stack."""
    here = population(stars(), options, choices)
    last = 2**33 + (4 if run["n_stars"] < 1000 else 1)
    cpu, cuda = (
        draw_stacks(here, seed=2**40 + 7, first=2**33, last=last, device=device, **run)
        for device in ("cpu", "cuda")
    )
    a, b = cpu.moments.values, cuda.moments.values
    largest = np.stack([np.abs(a[:, n == ORDER]).max(axis=1) for n in ORDER], axis=1)
    difference = np.abs(b - a) / np.where(largest > 0, largest, 1.0)
    return {
        "same_fractions": bool(np.array_equal(cpu.binary_fraction, cuda.binary_fraction)),
        "stacks_with_pairs": int(np.count_nonzero(largest[:, 0])),
        "difference": {int(n): float(np.max(difference[:, n == ORDER])) for n in np.unique(ORDER)},
    }


def given_up():
    """What is said where all pairs are resolved."""
    near = Stars.from_columns(mass=[0.09], distance=[5.0], magnitude=[18.0])
    try:
        draw_stacks(
            population(near, {}, {"cut": 1e-6}),
            n_stars=1, binary_fraction=1.0, seed=1, first=0, last=1, device="cuda",
        )  # fmt: skip
    except ValueError as error:
        return str(error)
    return ""


if __name__ == "__main__":
    print(json.dumps({"given_up": given_up()} | {name: compare(*case) for name, case in CASES.items()}))
