"""Processes of our own: they look for modules where this one does, the standard library's and installed ones first.

A child of ``python -c`` or `multiprocessing` looks into the present folder before anything else, and so does one whose
PYTHONPATH names it: a ``queue.py`` that lies beside the user would be imported in place of the standard library's, and
run. Folders of the user's own are searched last.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

__all__ = ["python_command", "safe_path", "with_environment", "without_main"]

_SEARCH = """import sys
own, last = {own!r}, {last!r}
at = next((i for i, e in enumerate(sys.path) if e.endswith(("site-packages", "dist-packages"))), len(sys.path))
sys.path[at:at] = [e for e in own if e not in sys.path]
sys.path += [e for e in last if e not in sys.path]
"""


def python_command(code: str) -> list[str]:
    """The beginning of a command line that runs ``code`` in a Python of its own; what follows is its ``sys.argv[1:]``.

    Example:
        >>> python_command("print(1)")[1:3]
        ['-P', '-c']
    """
    found = (find_spec(name) for name in ("neuralq", "neuralq_envs"))
    own = [str(Path(spec.origin).parents[1]) for spec in found if spec is not None and spec.origin is not None]
    search = _SEARCH.format(own=own, last=[entry for entry in sys.path if entry])
    return [sys.executable, "-P", "-c", search + code]


@contextlib.contextmanager
def with_environment(values: Mapping[str, str]) -> Iterator[None]:
    """Processes that are started in the block find these variables in their environment.

    Example:
        >>> with with_environment({"NEURALQ_EXAMPLE": "1"}):
        ...     os.environ["NEURALQ_EXAMPLE"]
        '1'
        >>> "NEURALQ_EXAMPLE" in os.environ
        False
    """
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def safe_path() -> Iterator[None]:
    """Processes that are started in the block, by `multiprocessing` too, do not begin with the present folder.

    Example:
        >>> with safe_path():
        ...     os.environ["PYTHONSAFEPATH"]
        '1'
    """
    with with_environment({"PYTHONSAFEPATH": "1"}):
        yield


@contextlib.contextmanager
def without_main() -> Iterator[None]:
    """Processes started in the block by `multiprocessing` do not run the program's main file again, which trains."""
    main: Any = sys.modules["__main__"]
    kept = {name: main.__dict__[name] for name in ("__file__", "__spec__") if name in main.__dict__}
    main.__dict__.pop("__file__", None)
    main.__spec__ = None
    try:
        yield
    finally:
        main.__dict__.update(kept)
