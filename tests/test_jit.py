"""Kernels where no cache folder can be written: they still compile, and say so once."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import pytest

from neuralq import jit


def test_without_a_writable_folder_kernels_compile_uncached_and_say_so_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def njit(*, cache: bool, **options: Any) -> Callable[..., Any]:
        def decorate(function: Callable[..., Any]) -> Any:
            if cache:  # what numba raises, word for word
                raise RuntimeError(f"cannot cache function {function.__name__!r}: no locator available for file 'x.py'")
            return numba.njit(**options)(function)

        return decorate

    monkeypatch.setattr(jit, "_njit", njit)
    monkeypatch.setattr(jit, "_said", False)

    def twice(x: float) -> float:
        return 2.0 * x

    def thrice(x: float) -> float:
        return 3.0 * x

    assert jit.kernel(twice)(4.0) == 8.0
    assert jit.kernel(thrice)(4.0) == 12.0
    written = capsys.readouterr().err
    assert written.count("\n") == 1
    assert "NUMBA_CACHE_DIR" in written


def test_other_errors_of_the_compiler_are_not_swallowed(monkeypatch: pytest.MonkeyPatch) -> None:
    def njit(**_: Any) -> Callable[..., Any]:
        def decorate(function: Callable[..., Any]) -> Any:
            raise RuntimeError("something else")

        return decorate

    monkeypatch.setattr(jit, "_njit", njit)
    with pytest.raises(RuntimeError, match="something else"):
        jit.kernel(lambda x: x)


def test_a_kernel_that_may_reorder_is_never_called_but_copied_into_its_caller() -> None:
    for decorate in (jit.reassociating_kernel, jit.lean_reassociating_kernel):
        compiled: Any = decorate(lambda x: x)
        assert compiled.targetoptions["forceinline"] and "reassoc" in compiled.targetoptions["fastmath"]


PROGRAM = """
import hashlib, numpy as np
from neuralq.learners.traces import streaming_kernels as kernels
for dtype in (np.float32, np.float64):
    for bound in (kernels.OBGD, kernels.ADAPTIVE, kernels.INTENTIONAL):
        rng, n = np.random.default_rng(0), 100
        values, z, v, means = np.zeros(n, dtype), np.zeros(n, dtype), np.zeros(n, dtype), np.array([0.0, 1.0])
        for t in range(1, 50):
            grad, delta = rng.standard_normal(n).astype(dtype), float(rng.standard_normal())
            kernels.advance(values, z, v, grad, means, 0.7, delta, bound, 0.5, 2.0, 0.999, 0.3, t)
        print(hashlib.sha256(values.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_a_process_that_compiles_gives_the_bits_of_one_that_reads_the_cache(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    options: dict[str, Any] = {"env": environment, "capture_output": True, "text": True, "check": True}
    said = [subprocess.run([sys.executable, "-c", PROGRAM], **options).stdout for _ in range(2)]
    assert said[0] == said[1] and len(said[0].split()) == 6
