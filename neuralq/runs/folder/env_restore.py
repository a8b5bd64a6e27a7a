"""From a tree back into an environment: written in place, so that views and shared objects stay what they were.

The environment must have been made as the saved one was. What it made itself and cannot change (functions, spaces,
constant tables) is compared with the saved one; what can change is overwritten. Afterwards the environment is encoded
again and compared with the tree, so a restore is exact or it raises.
"""

from __future__ import annotations

import enum
import hashlib
import random
import sys
import types
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Space
from gymnasium.vector import VectorEnv

from neuralq.runs.folder.env_encode import (
    FORMAT_VERSION,
    Encoder,
    NotCopyable,
    array_digest,
    attributes_of,
    callable_parts,
    constants_of,
    difference,
    encode_env,
    filled_cells,
    fixed_description,
    module_of,
    spaces_within,
    type_name,
)

__all__ = ["restore_env"]


def restore_env(env: Any, tree: Mapping[str, Any]) -> None:
    """After this call ``env`` takes the very steps that the saved environment would have taken.

    Args:
        env: freshly made as the saved one was. It is reset first, because some attributes exist only from then on.
        tree: from `encode_env`, possibly through `neuralq.runs.folder.checkpoint`.

    Raises:
        NotCopyable: if ``env`` was made otherwise, or comes out different from ``tree``; ``env`` is then spoilt.

    Example:
        >>> env, fresh = (gymnasium.make("Blackjack-v1") for _ in range(2))
        >>> _ = env.reset(seed=4)
        >>> restore_env(fresh, encode_env(env))
        >>> env.step(1)[0] == fresh.step(1)[0]
        True
    """
    if tree.get("snapshot") != FORMAT_VERSION:
        raise NotCopyable(
            "this is no environment state that this version of neuralq reads; start a new episode instead"
        )
    try:
        env.reset(seed=0)
        saved = _with_present_names(dict(tree))
        _Restorer().restore(env, saved["root"], "env", type(env))
        where = difference(saved, encode_env(env))
    except NotCopyable:
        raise
    except Exception as error:  # the environment's own code ran, or the tree was not made by `encode_env`
        raise NotCopyable(f"restoring the environment failed: {type(error).__name__}: {error}") from error
    if where is not None:
        raise NotCopyable(
            f"{where} differs after restoring; was the environment made in the same way as the saved one?"
        )


_FORMER_NAMES = {
    "neuralq.interact.lanes.Lane": "neuralq.runs.stream.vector_env.SubEnv",
    "neuralq_envs.drawn.DrawnEnv": "neuralq_envs.rendering.RenderedEnv",
    "neuralq.features.": "neuralq.runs.stream.encoding.",
    "neuralq.recipes.games.": "neuralq.runs.recipe.games.",
    "neuralq.mdp.FiniteMDP": "neuralq.mdp.model.FiniteMDP",
    "neuralq.simulate.Outcomes": "neuralq.mdp.outcomes.Outcomes",
    "neuralq.simulate.Sampler": "neuralq.mdp.sampler.Sampler",
    "neuralq.simulate.Model": "neuralq.mdp.environment.Model",
}
"""How names of classes and functions began in trees that neuralq 0.3.1 wrote, and how they begin now."""


def _with_present_names(node: Any) -> Any:
    if isinstance(node, list | tuple):
        return type(node)(map(_with_present_names, node))
    if isinstance(node, dict):
        return {key: _with_present_names(value) for key, value in node.items()}
    if isinstance(node, str) and node.startswith("neuralq"):
        for former, present in _FORMER_NAMES.items():
            if node.startswith(former):
                return present + node.removeprefix(former)
    return node


class _Restorer:
    """One walk over a tree and a fresh object graph at once."""

    def __init__(self) -> None:
        self.made: dict[int, Any] = {}
        self.used: dict[int, Any] = {}  # objects of the fresh graph that already hold a saved one

    def restore(self, existing: Any, node: Any, path: str, owner: type) -> Any:
        """What the saved value is in the fresh graph: ``existing``, overwritten, where that is possible."""
        if not isinstance(node, dict):
            return node
        kind = node["kind"]
        if kind == "same":
            return self.made[node["ref"]]
        if kind == "skip":
            return existing
        if kind in _COMPARED:
            if _COMPARED[kind](existing) != node["value" if kind == "fixed" else "sha256"]:
                raise NotCopyable(f"{path} is not what it was when the environment was saved")
            return existing
        if kind in _LEAVES:
            return _LEAVES[kind](node)
        handler: Callable[..., Any] = self._seeded if kind in _SEEDED else getattr(self, f"_{kind}")
        if "ref" not in node:
            return handler(existing, node, path, owner)
        free = id(existing) not in self.used and (node["shared"] or id(existing) not in constants_of(owner))
        # An object that is taken, or that belongs to the class, must not be overwritten: a new one takes its place.
        target = handler(existing if free else None, node, path, owner)
        self.made[node["ref"]] = target
        self.used[id(target)] = target
        return target

    def _begin(self, target: Any, node: dict[str, Any]) -> Any:
        """Announces a container before its contents, which may refer back to it."""
        self.made[node["ref"]] = target
        self.used[id(target)] = target
        return target

    def _members(self, existing: Any, nodes: list[Any], path: str, owner: type) -> list[Any]:
        found = list(existing) if isinstance(existing, list | tuple | deque) else []
        found += [None] * (len(nodes) - len(found))
        return [self.restore(e, n, f"{path}[{i}]", owner) for i, (e, n) in enumerate(zip(found, nodes, strict=False))]

    def _enum(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> enum.Enum:
        cls = _loaded_class(node["type"])
        if cls is None or not issubclass(cls, enum.Enum):
            raise NotCopyable(f"{path} was a {node['type']}, which is no enumeration here")
        return cls[node["name"]]

    def _tuple(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> tuple[Any, ...]:
        return tuple(self._members(existing, node["items"], path, owner))

    def _named_tuple(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> Any:
        cls = _class_for(node["type"], existing, owner, path)
        if not (issubclass(cls, tuple) and hasattr(cls, "_fields")):
            raise NotCopyable(f"{path} was the named tuple {node['type']}, which is none here")
        return tuple.__new__(cls, self._members(existing, node["items"], path, owner))

    def _frozenset(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> frozenset[Any]:
        return frozenset(self._members(None, node["items"], path, owner))

    def _frozen(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> Any:
        cls = _class_for(node["type"], existing, owner, path)
        if type(existing) is cls and difference(node["attributes"], Encoder().attributes(existing, path)) is None:
            return existing
        target: Any = object.__new__(cls)
        alone = _Restorer()
        for name, item in node["attributes"].items():
            object.__setattr__(target, name, alone.restore(None, item, f"{path}.{name}", cls))
        return target

    def _array(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> Any:
        saved = node["value"]
        fits = type(existing) is np.ndarray and existing.dtype == saved.dtype and existing.shape == saved.shape
        if fits and existing.flags.writeable:
            existing[...] = saved
            return existing
        return saved.copy(order="K")

    def _tensor(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> Any:
        saved = node["value"]
        if isinstance(existing, torch.Tensor) and existing.dtype == saved.dtype and existing.shape == saved.shape:
            with torch.no_grad():
                return existing.copy_(saved)
        return saved.clone()

    def _generator(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> np.random.Generator:
        name = node["state"]["bit_generator"]
        if not (isinstance(existing, np.random.Generator) and type(existing.bit_generator).__name__ == name):
            if name not in ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64"):
                raise NotCopyable(f"{path} was a generator over {name!r}, which NumPy does not have")
            existing = np.random.Generator(getattr(np.random, name)(0))
        target: np.random.Generator = existing
        target.bit_generator.state = node["state"]
        return target

    def _seeded(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> Any:
        cls, make, set_state = _SEEDED[node["kind"]]
        target = existing if type(existing) is cls else make(node)
        set_state(target, node["state"])
        return target

    def _list(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> list[Any]:
        target: list[Any] = self._begin(existing if type(existing) is list else [], node)
        target[:] = self._members(list(target), node["items"], path, owner)
        return target

    def _deque(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> deque[Any]:
        fits = type(existing) is deque and existing.maxlen == node["maxlen"]
        target: deque[Any] = self._begin(existing if fits else deque(maxlen=node["maxlen"]), node)
        members = self._members(list(target), node["items"], path, owner)
        target.clear()
        target.extend(members)
        return target

    def _set(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> set[Any]:
        target: set[Any] = self._begin(existing if type(existing) is set else set(), node)
        target.clear()
        target.update(self._members(None, node["items"], path, owner))
        return target

    def _dict(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> dict[Any, Any]:
        makers: dict[str, type] = {"dict": dict, "OrderedDict": OrderedDict, "Counter": Counter}
        if type(existing).__name__ != node["type"] or not isinstance(existing, dict):
            if node["type"] not in makers:
                raise NotCopyable(f"{path} was a {node['type']}, and a fresh environment has none there to fill")
            existing = makers[node["type"]]()
        target: dict[Any, Any] = self._begin(existing, node)
        old = dict(target)
        target.clear()
        for key_node, value_node in node["items"]:
            key = self.restore(None, key_node, path, owner)
            target[key] = self.restore(old.get(key), value_node, f"{path}[{key!r}]", owner)
        return target

    def _space(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> Any:
        within = spaces_within(existing) if isinstance(existing, Space) else []
        if len(within) != len(node["generators"]):
            raise NotCopyable(f"{path} was a space of {len(node['generators'])} parts, and is not here")
        self._begin(existing, node)
        for space, generator in zip(within, node["generators"], strict=True):
            space._np_random = self.restore(space._np_random, generator, f"{path}._np_random", owner)
        return existing

    def _callable(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> Any:
        parts = callable_parts(existing)
        if parts is None or type_name(existing) != node["name"] or parts.keys() != node["parts"].keys():
            raise NotCopyable(f"{path} was the function {node['name']}, and is another here")
        self._begin(existing, node)
        for name, item in node["parts"].items():
            part = self.restore(parts[name], item, f"{path}.{name}", owner)
            if isinstance(existing, types.FunctionType):
                filled_cells(existing)[name].cell_contents = part
        return existing  # a part of a method or partial is bound for good: the final comparison tells if it differs

    def _object(self, existing: Any, node: dict[str, Any], path: str, owner: type) -> Any:
        cls = _class_for(node["type"], existing, owner, path)
        if type(existing) is not cls:
            if issubclass(cls, gymnasium.Env | VectorEnv):
                raise NotCopyable(f"{path} was a {node['type']}, which a fresh environment does not have there")
            existing = object.__new__(cls)
        self._begin(existing, node)
        current = attributes_of(existing)
        for name, item in node["attributes"].items():
            _write(existing, name, self.restore(current.get(name), item, f"{path}.{name}", cls))
        if "own_state" in node:
            existing.set_state(_Restorer().restore(None, node["own_state"], f"{path}.get_state()", cls))
        else:
            for name in current.keys() - node["attributes"].keys():
                object.__delattr__(existing, name)
        return existing


def _write(target: Any, name: str, value: Any) -> None:
    """Past any property of that name: the instance dict if there is one, else the slot."""
    slot = getattr(type(target), name, None)
    if hasattr(target, "__dict__") and not isinstance(slot, types.MemberDescriptorType):
        target.__dict__[name] = value
    else:
        object.__setattr__(target, name, value)


def _loaded_class(name: str) -> type | None:
    """The class of that name if its module is imported already; nothing is imported on a file's word."""
    for split in [i for i, letter in enumerate(name) if letter == "."][::-1]:
        found: Any = sys.modules.get(name[:split])
        for part in name[split + 1 :].split(".") if found is not None else []:
            found = getattr(found, part, None)
        if isinstance(found, type):
            return found
    return None


def _class_for(name: str, existing: Any, owner: type, path: str) -> type:
    """The class of a saved object: that of the fresh one in its place, or one of the module of the object around it."""
    if type_name(type(existing)) == name:
        return type(existing)
    cls = _loaded_class(name)
    if cls is None or module_of(cls) != module_of(owner):
        raise NotCopyable(f"{path} was a {name}, and a fresh environment has a {type_name(type(existing))} there")
    return cls


_LEAVES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "scalar": lambda node: node["value"][()],
    "complex": lambda node: complex(*node["parts"]),
    "bytes": lambda node: bytes(node["value"].tobytes()),
}
_SEEDED: dict[str, tuple[type, Callable[[dict[str, Any]], Any], Callable[[Any, Any], object]]] = {
    "random_state": (np.random.RandomState, lambda node: np.random.RandomState(0), np.random.RandomState.set_state),
    "python_random": (random.Random, lambda node: random.Random(0), random.Random.setstate),
    "torch_generator": (torch.Generator, lambda node: torch.Generator(node["device"]), torch.Generator.set_state),
}
"""Generators beside NumPy's: class, how one is made, and how it takes a state."""
_COMPARED: dict[str, Callable[[Any], str | None]] = {
    "fixed": fixed_description,
    "constant": lambda value: hashlib.sha256(repr(value).encode()).hexdigest(),
    "constant_array": lambda value: array_digest(value) if isinstance(value, np.ndarray) else None,
}
