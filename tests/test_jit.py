"""Kernels where no cache folder can be written: they still compile, and say so once."""

from __future__ import annotations

from collections.abc import Callable
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
