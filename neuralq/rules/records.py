"""Records: what a module says about the thing it defines, found by looking and not by being listed.

A learner, a target rule or a distribution is one file. It ends with a record (its name, its options, what it goes
with), and whatever offers a choice of them, from the command line to the tests, asks `discovered` which there are.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import Protocol, TypeVar

__all__ = ["discovered"]


class _Listed(Protocol):
    @property
    def name(self) -> str: ...

    @property
    def place(self) -> int: ...


Record = TypeVar("Record", bound=_Listed)


def discovered(package: str, kind: type[Record]) -> dict[str, Record]:
    """The records of one kind in every module of a package and of the packages in it, by name.

    They come in the order of their places, those of one place in that of the alphabet.

    Args:
        package: dotted name; every module below it is imported. A folder of one's own joins by its ``__path__``.
        kind: class of the records; they are looked for among the modules' names.

    Raises:
        ValueError: if two records have one name.

    Example:
        >>> from neuralq.learners import LearnerKind
        >>> list(discovered("neuralq.learners.traces", LearnerKind))
        ['online', 'streaming']
    """
    found: dict[str, Record] = {}
    for module in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
        for record in vars(importlib.import_module(module.name)).values():
            if isinstance(record, kind) and found.setdefault(record.name, record) is not record:
                raise ValueError(
                    f"two records of {kind.__name__} are named {record.name!r}, the second in {module.name}; "
                    "give one of them another name"
                )
    return dict(sorted(found.items(), key=lambda item: (item[1].place, item[0])))
