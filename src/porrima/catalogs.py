"""Real catalogues to `Stars`: the Besançon model's output, or any table with named columns."""

from __future__ import annotations

import gzip
import os
import re
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from porrima.errors import InputError
from porrima.stars import COMPONENTS, Stars
from porrima.tables import Table, load_table, write_table

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray
