"""Where the tests find the real files, which are not shipped."""

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("PORRIMA_DATA") or Path(__file__).parents[2] / "shared" / "data")


def data_file(relative):
    """Path of a real file under the data folder; the test is skipped, with the reason, where it is absent."""
    path = DATA / relative
    if not path.is_file():
        pytest.skip(f"no {relative} under {DATA} (set PORRIMA_DATA to the folder of the real data files)")
    return path
