"""Checks of what callers hand in: each says what was wrong, what was got and the way out."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from numbers import Real
from pathlib import Path
from typing import Any

__all__ = [
    "ELSEWHERE",
    "MOST_WHOLE",
    "MissingExtra",
    "available_bytes",
    "check_choice",
    "check_discount",
    "check_fits",
    "check_fraction",
    "check_module_name",
    "check_positive",
    "check_whole",
]


MOST_WHOLE = 2**128
"""Whole numbers stay below this: seeds of 128 bits are the longest that anybody draws."""

ELSEWHERE = "neuralq runs on Linux and macOS (it needs file locks as they have them); on Windows install it in WSL 2"
"""What is said where the standard library has no ``fcntl``."""


class MissingExtra(ImportError):
    """An optional dependency is not installed; the message holds the command that installs it."""


def check_module_name(what: str, name: str, given: str) -> None:
    """``name`` can name a module; what it holds is imported, and a file is not a module's name.

    Raises:
        ValueError: otherwise, with the name that the file would have.

    Example:
        >>> check_module_name("the environment", "./my_env.py", "./my_env.py:X-v0")
        Traceback (most recent call last):
        ValueError: the environment './my_env.py:X-v0' must name a module before the colon, as in 'my_env:X-v0' ...
    """
    if all(part.isidentifier() for part in name.split(".")):
        return
    stem = Path(name).stem if Path(name).stem.isidentifier() else "my_module"
    raise ValueError(
        f"{what} {given!r} must name a module before the colon, as in '{stem}:{given.rpartition(':')[2]}' for a file "
        f"{stem}.py in the present folder"
    )


def check_fraction(name: str, value: float, hint: str = "") -> None:
    """``value`` lies in [0, 1].

    Raises:
        ValueError: otherwise (also for NaN), with ``hint`` as the way out.
    """
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"{name} must lie in [0, 1], got {value!r}" + (f"; {hint}" if hint else ""))


def check_discount(name: str, value: float) -> None:
    """``value`` is a discount factor in [0, 1].

    Raises:
        ValueError: otherwise.
    """
    check_fraction(name, value, "a discount above 1 makes returns grow without bound")


def check_positive(name: str, value: float) -> None:
    """``value`` is finite and greater than zero.

    Raises:
        ValueError: otherwise.
    """
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name} must be a finite number above 0, got {value!r}")


def check_whole(name: str, value: int, minimum: int = 1) -> None:
    """``value`` is a whole number of at least ``minimum`` (a bool is not), and one of 64 bits.

    Raises:
        ValueError: otherwise.
    """
    if type(value) is int and abs(value) >= MOST_WHOLE:  # beyond any use, and 10^309 is beyond any float
        raise ValueError(f"{name} must be a whole number below 2^128, got one of {value.bit_length():,} bits")
    is_number = isinstance(value, Real) and not isinstance(value, bool)
    if not is_number or not math.isfinite(value) or int(value) != value or value < minimum:
        raise ValueError(f"{name} must be a whole number of at least {minimum}, got {value!r}")


def check_choice(name: str, value: Any, choices: Iterable[Any]) -> None:
    """``value`` is one of ``choices``.

    Raises:
        ValueError: otherwise, listing them.
    """
    options = list(choices)
    if value not in options:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, options))}, got {value!r}")


def available_bytes() -> int | None:
    """Bytes that can be taken without swapping or being killed; None where the system does not say.

    The smallest of: ``MemAvailable`` of /proc/meminfo, and what the control group (v2 or v1) leaves.

    Example:
        >>> available_bytes() is None or available_bytes() > 0
        True
    """
    limits = [x for x in (_machine(), _group_v2(), _group_v1()) if x is not None]
    return max(0, min(limits)) if limits else None


def check_fits(name: str, num_bytes: int, way_out: str) -> None:
    """``num_bytes`` fit into the memory that is available now.

    Raises:
        MemoryError: they do not; the message names both numbers and ``way_out``.
    """
    available = available_bytes()
    if available is not None and num_bytes > available:
        raise MemoryError(
            f"{name} needs {num_bytes:,} bytes ({num_bytes / 2**30:.1f} GiB) but {available:,} bytes "
            f"({available / 2**30:.1f} GiB) are available; {way_out}"
        )


def _machine() -> int | None:
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    try:  # no /proc (macOS): all of the memory, for want of a better number
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None


def _group_v2() -> int | None:
    """The tightest limit on the way from the process's own group up to the root."""
    try:
        line = next(x for x in Path("/proc/self/cgroup").read_text().splitlines() if x.startswith("0::"))
    except (OSError, StopIteration):
        return None
    root = Path("/sys/fs/cgroup")
    folder = root / line[3:].strip().lstrip("/")
    found = [_left(x, "memory.max", "memory.current", "inactive_file") for x in (folder, *folder.parents)]
    return min((x for x in found if x is not None), default=None)


def _group_v1() -> int | None:
    return _left(Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")


def _left(folder: Path, limit: str, usage: str, cache: str) -> int | None:
    """Limit - usage + the page cache that the kernel would give back first."""
    try:
        bound = int((folder / limit).read_text())  # "max" (no limit) is not a number
        left = bound - int((folder / usage).read_text())
        for line in (folder / "memory.stat").read_text().splitlines():
            if line.split()[0] == cache:
                left += int(line.split()[1])
    except (OSError, ValueError, IndexError):
        return None
    return left
