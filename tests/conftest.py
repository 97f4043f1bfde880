"""Fixtures that several tests share."""

import hashlib
import os
import sys
from pathlib import Path

import numpy as np
import pytest

# numba's cache looks at the file of a compiled function, not at those of what is inlined in it: a cache per source
ROOT = Path(__file__).parents[1]
SOURCE = hashlib.sha256(
    b"".join(p.read_bytes() for p in sorted((ROOT / "src" / "porrima").glob("*.py")))
).hexdigest()
os.environ["NUMBA_CACHE_DIR"] = str(ROOT / ".numba_cache" / SOURCE[:16])

from porrima import cli
from porrima.multiplicity import MULTIPLICITY
from porrima.photometry import PHOTOMETRY
from porrima.stars import Stars
from porrima.systems import Population


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """A cache that is empty at first and that no other run shares."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PORRIMA_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def porrima(monkeypatch, capsys):
    """Run a command in this process; gives exit code, standard output and standard error."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["porrima", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
        out, err = capsys.readouterr()
        return stop.value.code, out, err

    return run


@pytest.fixture(scope="session")
def stars():
    """Three hundred stars of all kinds, as a magnitude bin holds them."""
    rng = np.random.Generator(np.random.Philox(20261122))
    n = 300
    return Stars.from_columns(
        mass=rng.uniform(0.085, 1.2, n),
        distance=10 ** rng.uniform(2.2, 3.6, n),
        magnitude=rng.uniform(18, 19, n),
        metallicity=rng.uniform(-2, 0.2, n),
        log_age=rng.uniform(9.0, 10.1, n),
    )


@pytest.fixture(scope="session")
def population(stars):
    return Population.of(stars, multiplicity=MULTIPLICITY["dk13"], photometry=PHOTOMETRY["main-sequence"])
