"""What memory a process may still take: the machine's and, inside a container, the container's."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["available_bytes", "check_fits"]


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
