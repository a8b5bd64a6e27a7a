"""The types of the house: naming them costs rooms that know arrays only nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

from neuralq.types import Array, Floats, Indices

ROOT = Path(__file__).parents[1]


def test_naming_a_type_does_not_import_torch() -> None:
    program = "import sys, neuralq.types; print(sorted({'torch', 'numba', 'scipy', 'gymnasium'} & set(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_arrays_are_named_by_what_they_hold() -> None:
    floats: Floats = np.zeros(2)
    indices: Indices = np.zeros(2, np.int64)
    anything: list[Array] = [floats, indices]
    assert [x.dtype.name for x in anything] == ["float64", "int64"]
