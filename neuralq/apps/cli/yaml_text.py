"""YAML as people write it by hand: what another reader would drop without a word, or never finish, is refused.

Numbers are those of YAML 1.2, which are JSON's too: 1e5 and 1e-05 are numbers, for which YAML 1.1 needs a point and a
sign, 010 is ten and 1:30 is text. Underscores between digits are read as well.
"""

from __future__ import annotations

import json
import re
from typing import Any

import yaml  # type: ignore[import-untyped]

__all__ = ["read_text", "read_yaml", "write_yaml"]

_MOST_NODES = 10_000
"""Values that a text may hold with its aliases written out; the largest configuration has some hundred."""

_INT, _FLOAT = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"
_WHOLE = r"[-+]?\d+(?:_\d+)*"
_NUMBERS = (  # the first that matches
    (_INT, re.compile(rf"(?:{_WHOLE}|0o[0-7]+|0x[0-9a-fA-F]+)\Z", re.ASCII)),
    (_FLOAT, re.compile(rf"(?:(?:{_WHOLE}(?:\.\d*)?|[-+]?\.\d+)(?:[eE][-+]?\d+)?)\Z", re.ASCII)),
    (_FLOAT, re.compile(r"(?:[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))\Z")),
)


def _resolvers() -> dict[str, list[Any]]:
    """What makes a plain word more than text, by its first sign: as PyYAML has it, but for numbers and dates."""
    former = (_INT, _FLOAT, "tag:yaml.org,2002:timestamp")
    others = yaml.SafeLoader.yaml_implicit_resolvers.items()
    resolvers = {sign: [pair for pair in pairs if pair[0] not in former] for sign, pairs in others}
    for sign in "-+.0123456789":
        resolvers[sign] = [*_NUMBERS, *resolvers.get(sign, [])]
    return resolvers


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    yaml_implicit_resolvers = _resolvers()


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]
    """Puts into quotes what the loader would take for a number."""

    yaml_implicit_resolvers = _resolvers()


def _whole(loader: Any, node: Any) -> int:
    text = loader.construct_scalar(node)
    return int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))


def _real(loader: Any, node: Any) -> float:
    text = loader.construct_scalar(node).lower()
    return float(re.sub(r"\.(?=inf|nan)", "", text))


_Loader.add_constructor(_INT, _whole)
_Loader.add_constructor(_FLOAT, _real)


def write_yaml(value: Any) -> str:
    """A mapping as `read_yaml` reads it.

    Example:
        >>> print(write_yaml({"rate": 1e-05, "name": "1e5"}), end="")
        rate: 1.0e-05
        name: '1e5'
    """
    written: str = yaml.dump(value, Dumper=_Dumper, sort_keys=False)
    return written


def read_text(text: str) -> Any:
    """What a text in JSON or YAML says; JSON first, for as YAML it would have to do without tabs.

    Raises:
        ValueError: as `read_yaml`.
        yaml.YAMLError: neither.

    Example:
        >>> read_text('{"size": 1e39}') == read_text("size: 1e39") == {"size": 1e39}
        True
    """
    try:
        return json.loads(text, object_pairs_hook=_once)
    except (ValueError, RecursionError):
        return read_yaml(text)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(found := dict(pairs)) < len(pairs):
        raise ValueError("a key is given twice")
    return found


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
        node = yaml.compose(text, _Loader)
        if node is None:
            return None
        _check(node, {})
        return yaml.load(text, _Loader)
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
