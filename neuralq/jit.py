"""One decorator for every compiled kernel, so that all of them compile alike and none depends on a writable folder.

Kernels release the GIL, divide as NumPy does (no ZeroDivisionError) and keep IEEE arithmetic: no reordering, so a
run gives the same bits whatever the compiler vectorises. The compiled code is kept between processes (in the
package's ``__pycache__``, the user's cache folder, or ``NUMBA_CACHE_DIR``); where no such folder can be written the
kernel is compiled anew in each process, which costs seconds and is said once on stderr. A shared folder such as
``/tmp`` is deliberately not used instead: the cache holds executable code, and a predictable path that others can
write would let them plant theirs.

The cache notices a change of the file that holds a kernel, not of kernels it calls in other files; delete
``__pycache__`` after editing a kernel that another module's kernel calls.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numba

__all__ = ["INTERPRETED", "kernel", "lean_kernel", "lean_reassociating_kernel", "reassociating_kernel", "specialised"]

P = ParamSpec("P")
R = TypeVar("R")

INTERPRETED = bool(getattr(numba.config, "DISABLE_JIT", False))
"""Whether kernels are run as the Python they are written in (``NUMBA_DISABLE_JIT=1``), for debuggers."""

_njit: Any = numba.njit
_said = False
_REASSOCIATES: dict[str, bool | set[str]] = {
    "fastmath": {"reassoc", "contract", "nsz", "arcp"},
    # A kernel that another one calls is compiled by itself and as a copy inside the caller, optimised once more. The
    # process that compiled both would run the first, and one that reads the cache the second, with another order.
    "forceinline": True,
}


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """The same function compiled to machine code at its first call, and cached on disk where that is possible.

    Example:
        >>> import numpy as np
        >>> @kernel
        ... def total(x: np.ndarray) -> float:
        ...     result = 0.0
        ...     for value in x:
        ...         result += value
        ...     return result
        >>> total(np.arange(4.0))
        6.0
    """
    return _compile(function, fastmath=False)


def lean_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """As `kernel`, for functions that create no array: those they are given are not reference counted.

    The caller holds the arrays for as long as the call lasts, so counting is waste; for kernels that pass tuples of
    arrays to each other it takes three quarters of the time. A function that creates an array does not compile.

    Example:
        >>> import numpy as np
        >>> @lean_kernel
        ... def first(x: np.ndarray) -> float:
        ...     return x[0]
        >>> first(np.arange(4.0))
        0.0
    """
    return _compile(function, fastmath=False, _nrt=False)


def reassociating_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """As `kernel`, but sums may be added in another order, so that they vectorise.

    The order is fixed when the kernel is compiled: on one machine the same input still gives the same bits, in the
    process that compiles and in those that find the kernel in the cache. NaN and
    infinity keep their meaning.

    Example:
        >>> import numpy as np
        >>> @reassociating_kernel
        ... def total(x: np.ndarray) -> float:
        ...     result = 0.0
        ...     for value in x:
        ...         result += value
        ...     return result
        >>> total(np.arange(4.0))
        6.0
    """
    return _compile(function, **_REASSOCIATES)


def lean_reassociating_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """As `lean_kernel` and `reassociating_kernel` at once.

    Example:
        >>> import numpy as np
        >>> @lean_reassociating_kernel
        ... def total(x: np.ndarray) -> float:
        ...     result = 0.0
        ...     for value in x:
        ...         result += value
        ...     return result
        >>> total(np.arange(4.0))
        6.0
    """
    return _compile(function, **_REASSOCIATES, _nrt=False)


def specialised(function: Callable[P, R], *like: Any) -> Callable[P, R]:
    """The machine code of a kernel for arguments of these types, which does not look at their types again.

    Looking costs 7 µs where a kernel takes tuples of arrays, ten times what a short call does itself. Arguments of
    other types than those of ``like`` must not be given: nothing would notice.

    Example:
        >>> import numpy as np
        >>> @lean_kernel
        ... def first(x: np.ndarray) -> float:
        ...     return x[0]
        >>> specialised(first, np.zeros(1))(np.arange(4.0))
        0.0
    """
    compile_for: Any = getattr(function, "compile", None)
    if compile_for is None:  # it is run as the Python that it is written in
        return function
    code: Callable[P, R] = compile_for(tuple(map(numba.typeof, like)))
    return code


def _compile(function: Callable[P, R], **special: bool | set[str]) -> Callable[P, R]:
    # No kernel is handed to C code, so none needs the wrapper for it: a tenth of what compiling takes.
    options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, **special}
    try:
        compiled = _njit(cache=True, **options)(function)
    except RuntimeError as error:  # numba: "cannot cache function ...: no locator available for file ..."
        if "cannot cache function" not in str(error):
            raise
        _say_once(function.__code__.co_filename)
        compiled = _njit(cache=False, **options)(function)
    return cast("Callable[P, R]", compiled)


def _say_once(filename: str) -> None:
    """One line on stderr per process; not for functions without a file (an interpreter prompt, a doctest)."""
    global _said
    if _said or filename.startswith("<"):
        return
    _said = True
    print(
        "neuralq: no writable folder for compiled kernels, so they are compiled anew in each process (some seconds); "
        "set NUMBA_CACHE_DIR to a folder of yours that can be written",
        file=sys.stderr,
    )
