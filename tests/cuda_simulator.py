"""Stacks drawn by the kernel of `porrima.gpu` in numba's CUDA simulator, as JSON.

The simulator is chosen when numba is imported: run it with NUMBA_ENABLE_CUDASIM=1.  The same stacks of a CPU are for
who compares them to draw, in a process whose engine is compiled.
"""

import json

import numpy as np

from porrima import gpu
from porrima.multiplicity import DucheneKraus2013
from porrima.photometry import PHOTOMETRY
from porrima.stack import draw_stacks
from porrima.stars import Stars
from porrima.systems import Population

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


def drawn(case, device):
    """Stacks of a case."""
    options, choices, run = CASES[case]
    last = 2**33 + (4 if run["n_stars"] < 1000 else 1)
    here = population(stars(), options, choices)
    return draw_stacks(here, seed=2**40 + 7, first=2**33, last=last, device=device, **run)


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


def simulated(case):
    """Binary fractions and moments of a case, as lists."""
    stacks = drawn(case, "cuda")
    return {"fraction": stacks.binary_fraction.tolist(), "moments": stacks.moments.values.tolist()}


if __name__ == "__main__":
    gpu._on_device = lambda tables: tables  # compiled functions do not take the simulator's arrays
    print(json.dumps({"given_up": given_up()} | {case: simulated(case) for case in CASES}))
