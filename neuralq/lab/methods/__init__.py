"""Every method of the lab: its expected update and its sampled update, on any problem.

A method is a record in a module of this folder. All modules here are read, so that a new file is all that a new method
takes: commands, the page and the matrix then know it.
"""

from __future__ import annotations

import importlib
import pkgutil

from neuralq.lab.methods.record import Expected, Method, Option, SampledUpdate, flow

__all__ = ["METHODS", "Expected", "Method", "Option", "SampledUpdate", "flow", "method"]


def _discovered() -> dict[str, Method]:
    """The records of all modules here, by name."""
    found: dict[str, Method] = {}
    for module in pkgutil.iter_modules(__path__):
        for one in vars(importlib.import_module(f"{__name__}.{module.name}")).values():
            if isinstance(one, Method) and found.setdefault(one.name, one) is not one:
                raise ValueError(
                    f"two methods are named {one.name!r}, the second in {module.name}; give it another name"
                )
    return found


METHODS: tuple[Method, ...] = tuple(sorted(_discovered().values(), key=lambda one: (one.place, one.name)))


def method(name: str) -> Method:
    """The method of this name.

    Raises:
        ValueError: there is none; the message lists them.

    Example:
        >>> method("td").title
        'TD(λ)'
    """
    for one in METHODS:
        if one.name == name:
            return one
    raise ValueError(f"there is no method {name!r}; there are {', '.join(one.name for one in METHODS)}")
