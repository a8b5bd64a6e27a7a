"""YAML as people write it by hand: what another reader would drop without a word, or never finish, is refused."""

from __future__ import annotations

from typing import Any

import yaml  # type: ignore[import-untyped]

__all__ = ["read_yaml"]

_MOST_NODES = 10_000
"""Values that a text may hold with its aliases written out; the largest configuration has some hundred."""


def read_yaml(text: str) -> Any:
    """What a text says.

    Raises:
        ValueError: a key that is given twice, aliases that stand for too much or for what holds them, or a nesting that
            is too deep.
        yaml.YAMLError: no YAML.

    Example:
        >>> read_yaml("{class: MLP, hidden: [64]}")
        {'class': 'MLP', 'hidden': [64]}
        >>> read_yaml("{gamma: 0.9, gamma: 0.8}")
        Traceback (most recent call last):
        ValueError: the key 'gamma' is given twice; leave one of them out
    """
    try:
        node = yaml.compose(text, yaml.SafeLoader)
        if node is None:
            return None
        _check(node, {})
        return yaml.safe_load(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _check(node: Any, sizes: dict[int, int | None]) -> int:
    """Values in a node with its aliases written out; ``sizes`` has those that were met, None while they are counted."""
    if id(node) in sizes:
        found = sizes[id(node)]
        if found is None:
            raise ValueError("an alias stands for what it is a part of; write it out")
        return found
    sizes[id(node)] = None
    inner: list[Any] = []
    if isinstance(node, yaml.MappingNode):
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for key in keys:
            if keys.count(key) > 1 and key != "<<":
                raise ValueError(f"the key {key!r} is given twice; leave one of them out")
        inner = [one for pair in node.value for one in pair]
    elif isinstance(node, yaml.SequenceNode):
        inner = node.value
    size = 1 + sum(_check(one, sizes) for one in inner)
    if size > _MOST_NODES:
        raise ValueError(f"it stands for more than {_MOST_NODES:,} values")
    sizes[id(node)] = size
    return size
