"""From an environment to a tree of plain leaves: every mutable object once, with a number, so that sharing survives.

A node is a plain leaf or a dict with a ``kind``. Objects that can change carry a ``ref``; their second mention is
``{"kind": "same", "ref": …}``. So a generator that an environment shares with its helper is one generator again after
restoring. Attributes are visited by name, so that equal states give equal trees.
"""

from __future__ import annotations

import contextlib
import enum
import functools
import hashlib
import inspect
import logging
import pathlib
import random
import re
import sys
import types
from abc import ABCMeta
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, is_dataclass
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Space
from gymnasium.vector import AsyncVectorEnv, VectorEnv
from gymnasium.wrappers import PassiveEnvChecker

__all__ = [
    "FORMAT_VERSION",
    "Encoder",
    "NotCopyable",
    "array_digest",
    "attributes_of",
    "callable_parts",
    "constants_of",
    "difference",
    "encode_env",
    "filled_cells",
    "fixed_description",
    "module_of",
    "spaces_within",
    "type_name",
]

FORMAT_VERSION = 1
# What Gymnasium itself keeps on environments and never changes while stepping.
_NOT_STATE = frozenset(
    "metadata _metadata spec _cached_spec _saved_kwargs env_fns render_mode _ezpickle_args _ezpickle_kwargs".split()
)
_SKIPPED_TYPES = (EnvSpec, logging.Logger, logging.LoggerAdapter, pathlib.PurePath)
_FIXED_TYPES = (type, types.ModuleType, np.dtype, np.ufunc, torch.dtype, torch.device, re.Pattern, range, slice)
_MAPPINGS = (dict, OrderedDict, defaultdict, Counter)
_BIT_GENERATORS = frozenset(("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64"))
_NATIVE_BINDINGS = ("pybind11", "nanobind", "Boost")
# Read-only arrays from this size are compared by digest instead of being copied into every checkpoint.
_CONSTANT_BYTES = 1 << 16


class NotCopyable(Exception):
    """An environment's state cannot be taken or put back exactly; the message says where it failed and why."""


def encode_env(env: Any) -> dict[str, Any]:
    """The state of ``env`` as a tree that shares no memory with it and that a checkpoint can store.

    Args:
        env: a `gymnasium.Env` or `gymnasium.vector.VectorEnv` in this process, wrapped or not.

    Raises:
        NotCopyable: naming the attribute that cannot be read as plain values, and its type.

    Example:
        >>> from neuralq.runs.folder.env_restore import restore_env
        >>> env, fresh = gymnasium.make("CartPole-v1"), gymnasium.make("CartPole-v1")
        >>> _ = env.reset(seed=1)
        >>> tree = encode_env(env)
        >>> restore_env(fresh, tree)
        >>> bool((env.step(1)[0] == fresh.step(1)[0]).all())
        True
    """
    try:
        return {"snapshot": FORMAT_VERSION, "root": Encoder().encode(env, "env", type(env))}
    except RecursionError as error:
        raise NotCopyable("env holds structures that are nested too deeply to be copied") from error
    except NotCopyable:
        raise
    except Exception as error:  # objects of C++ libraries answer to nothing that every Python object has
        raise NotCopyable(
            f"env holds an object that cannot be looked into (asked for its parts it raised {type(error).__name__}: "
            f"{error})"
        ) from error


@dataclass
class Encoder:
    """One walk over one object graph; ``refs`` numbers what was met."""

    refs: dict[int, int] = field(default_factory=dict)
    alive: list[Any] = field(default_factory=list)  # so that no id is used twice while it is remembered

    def encode(self, value: Any, path: str, owner: type) -> Any:
        """The node of ``value``, found at ``path`` in an object of class ``owner``."""
        kind = type(value)
        if value is None or kind in (bool, int, float, str):
            return value
        node = _immutable_node(value, path)
        if node is not None:
            return node
        if kind in (tuple, frozenset):
            return {"kind": kind.__name__, "items": self._items(value, path, owner)}
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            return {"kind": "named_tuple", "type": type_name(kind), "items": self._items(value, path, owner)}
        if is_dataclass(kind) and vars(kind)["__dataclass_params__"].frozen:
            # Immutable by contract, so its sharing does not matter; it may well be the whole state, replaced each step.
            return {"kind": "frozen", "type": type_name(kind), "attributes": Encoder().attributes(value, path)}
        if id(value) in self.refs:
            return {"kind": "same", "ref": self.refs[id(value)]}
        ref = self.refs[id(value)] = len(self.alive)
        self.alive.append(value)
        return {"ref": ref, "shared": id(value) in constants_of(owner), **self._body(value, path, owner)}

    def attributes(self, value: Any, path: str) -> dict[str, Any]:
        """Name and node of each attribute that is state."""
        nodes: dict[str, Any] = {}
        for name, item in attributes_of(value).items():
            if name == "P" and isinstance(item, dict):
                # Gymnasium's transition table: constant by convention, and far larger than all the rest.
                nodes[name] = {"kind": "constant", "sha256": hashlib.sha256(repr(item).encode()).hexdigest()}
            else:
                nodes[name] = self.encode(item, f"{path}.{name}", type(value))
        return nodes

    def _items(self, values: Iterable[Any], path: str, owner: type) -> list[Any]:
        return [self.encode(v, f"{path}[{i}]", owner) for i, v in enumerate(values)]

    def _body(self, value: Any, path: str, owner: type) -> dict[str, Any]:
        kind = type(value)
        if kind is np.ndarray:
            return _array_body(value, path)
        if isinstance(value, torch.Tensor):
            return {"kind": "tensor", "value": value.detach().clone()}
        if isinstance(value, np.random.Generator | np.random.RandomState | random.Random | torch.Generator):
            return _generator_body(value, path)
        if kind is list or kind is set:
            return {"kind": kind.__name__, "items": self._items(value, path, owner)}
        if kind is deque:
            return {"kind": "deque", "maxlen": value.maxlen, "items": self._items(value, path, owner)}
        if kind in _MAPPINGS:
            pairs = [
                [self.encode(k, f"{path} key", owner), self.encode(v, f"{path}[{k!r}]", owner)]
                for k, v in value.items()
            ]
            return {"kind": "dict", "type": kind.__name__, "items": pairs}
        if isinstance(value, Space):
            generators = [self.encode(s._np_random, f"{path}._np_random", owner) for s in spaces_within(value)]
            return {"kind": "space", "generators": generators}
        if (parts := callable_parts(value)) is not None:
            nodes = {name: self.encode(part, f"{path}.{name}", owner) for name, part in parts.items()}
            return {"kind": "callable", "name": type_name(value), "parts": nodes}
        return self._object_body(value, path)

    def _object_body(self, value: Any, path: str) -> dict[str, Any]:
        _check_walkable(value, path)
        body: dict[str, Any] = {"kind": "object", "type": type_name(type(value))}
        own_state = _protocol_state(value)
        if own_state is None:
            return {**body, "attributes": self.attributes(value, path)}
        kept = {n: v for n, v in attributes_of(value).items() if n in PROTOCOL_ATTRIBUTES}
        nodes = {n: self.encode(v, f"{path}.{n}", type(value)) for n, v in kept.items()}
        return {
            **body,
            "attributes": nodes,
            "own_state": Encoder().encode(own_state, f"{path}.get_state()", type(value)),
        }


# What a state from `get_state()` need not cover: Gymnasium's own generators, and what is wrapped.
PROTOCOL_ATTRIBUTES = frozenset(("_np_random", "_np_random_seed", "action_space", "observation_space", "env", "envs"))


def type_name(value: Any) -> str:
    """Module and qualified name of a class or function."""
    value = getattr(value, "func", value) if isinstance(value, functools.partial) else value
    return f"{getattr(value, '__module__', None)}.{getattr(value, '__qualname__', type(value).__qualname__)}"


def module_of(cls: type) -> str:
    """The name of the module that a class comes from; "" for one of a C++ library that does not say."""
    return str(getattr(cls, "__module__", ""))


def attributes_of(value: Any) -> dict[str, Any]:
    """The attributes of an object that may be state: instance dict and slots by name, without Gymnasium's constants."""
    cls = type(value)
    if cls is PassiveEnvChecker:
        return {"env": value.env}  # the rest of it only decides which warnings are still to come
    found = dict(getattr(value, "__dict__", {}))
    for ancestor in cls.__mro__:
        slots = ancestor.__dict__.get("__slots__", ())
        for slot in (slots,) if isinstance(slots, str) else slots:
            name = f"_{ancestor.__name__.lstrip('_')}{slot}" if slot.startswith("__") and slot[-2:] != "__" else slot
            if name not in ("__dict__", "__weakref__") and hasattr(value, name):
                found[name] = getattr(value, name)
    skipped = _NOT_STATE if isinstance(value, gymnasium.Env | VectorEnv) else frozenset()
    return {
        name: found[name]
        for name in sorted(found)
        if name not in skipped and not isinstance(inspect.getattr_static(cls, name, None), functools.cached_property)
    }


@functools.cache
def constants_of(owner: type) -> frozenset[int]:
    """Ids of the objects that an instance may share with its class or module, such as an array START.

    Looked up once per class: constants are there when the class is, and they live as long as it does.
    """
    namespaces: list[Mapping[str, Any]] = [vars(c) for c in owner.__mro__ if c is not object]
    if module_of(owner) in sys.modules:
        namespaces.append(vars(sys.modules[module_of(owner)]))
    return frozenset(id(v) for names in namespaces for v in names.values() if v is not None)


def spaces_within(space: Space[Any]) -> list[Space[Any]]:
    """The space and all that it is composed of, in a fixed order."""
    found = [space]
    inner = getattr(space, "spaces", ())
    children = list(inner.values()) if isinstance(inner, Mapping) else list(inner)
    for name in ("feature_space", "stacked_feature_space", "node_space", "edge_space"):
        child = getattr(space, name, None)
        children += [child] if isinstance(child, Space) else []
    for child in children:
        found += spaces_within(child)
    return found


def callable_parts(value: Any) -> dict[str, Any] | None:
    """What a function, bound method or partial holds that may change; None for anything else."""
    if isinstance(value, types.FunctionType):
        return {name: cell.cell_contents for name, cell in filled_cells(value).items()}
    if isinstance(value, types.MethodType | types.BuiltinMethodType):
        return {"__self__": value.__self__}
    if isinstance(value, functools.partial):
        return {"func": value.func, "args": value.args, "keywords": value.keywords}
    return None


def filled_cells(function: types.FunctionType) -> dict[str, types.CellType]:
    """The variables that a function closes over, by name; those not assigned yet are left out."""
    found = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):  # what an empty cell raises
            _ = cell.cell_contents
            found[name] = cell
    return found


def fixed_description(value: Any) -> str | None:
    """What identifies an object that never changes; None if ``value`` is not of that sort."""
    if isinstance(value, type):
        return type_name(value)
    if isinstance(value, types.ModuleType):
        return value.__name__
    if type(value) is types.BuiltinFunctionType:  # a function of a C module, or a bound method of a C object
        return type_name(value) if type(value.__self__) in (types.ModuleType, type(None)) else None
    if hasattr(value, "py_func"):  # compiled by numba
        return type_name(value)
    return repr(value) if isinstance(value, _FIXED_TYPES) else None


def _immutable_node(value: Any, path: str) -> dict[str, Any] | None:
    if isinstance(value, np.generic):
        return {"kind": "scalar", "value": np.array(value)}
    if type(value) is complex:
        return {"kind": "complex", "parts": [value.real, value.imag]}
    if type(value) is bytes:
        return {"kind": "bytes", "value": np.frombuffer(value, np.uint8).copy()}
    if isinstance(value, enum.Enum):
        if value.name not in type(value).__members__:
            raise NotCopyable(f"{path} is {value!r}, a combination of flags without a name")
        return {"kind": "enum", "type": type_name(type(value)), "name": value.name}
    if isinstance(value, _SKIPPED_TYPES) or module_of(type(value)).partition(".")[0] == "pygame":
        return {"kind": "skip"}
    description = fixed_description(value)
    return None if description is None else {"kind": "fixed", "value": description}


def array_digest(value: np.ndarray[Any, Any]) -> str:
    """SHA-256 of an array's values, shape and dtype."""
    return hashlib.sha256(f"{value.dtype.str}{value.shape}".encode() + value.tobytes()).hexdigest()


def _array_body(value: np.ndarray[Any, Any], path: str) -> dict[str, Any]:
    if value.dtype.hasobject:
        raise NotCopyable(f"{path} is an array of Python objects; keep its parts in plain arrays")
    if not value.flags.writeable and value.nbytes >= _CONSTANT_BYTES:
        return {"kind": "constant_array", "sha256": array_digest(value)}
    return {"kind": "array", "value": value.copy(order="K")}


def _generator_body(value: Any, path: str) -> dict[str, Any]:
    if isinstance(value, np.random.Generator):
        if type(value.bit_generator).__name__ not in _BIT_GENERATORS:
            raise NotCopyable(
                f"{path} is a generator over {type(value.bit_generator).__name__}, which is not NumPy's own"
            )
        return {"kind": "generator", "state": value.bit_generator.state}
    if isinstance(value, np.random.RandomState):
        return {"kind": "random_state", "state": value.get_state(legacy=False)}
    if isinstance(value, torch.Generator):
        return {"kind": "torch_generator", "state": value.get_state(), "device": str(value.device)}
    if type(value) is not random.Random:
        raise NotCopyable(f"{path} is a {type_name(type(value))}, which draws from the operating system")
    return {"kind": "python_random", "state": value.getstate()}


def _protocol_state(value: Any) -> Mapping[str, Any] | None:
    cls: Any = type(value)
    if not issubclass(cls, gymnasium.Env | VectorEnv):
        return None
    if not (
        inspect.isfunction(getattr(cls, "get_state", None)) and inspect.isfunction(getattr(cls, "set_state", None))
    ):
        return None
    try:
        inspect.signature(value.get_state).bind()
        inspect.signature(value.set_state).bind(None)
    except TypeError:
        return None  # the same names with another meaning
    state = value.get_state()
    return state if isinstance(state, Mapping) and _is_plain(state) else None


def _is_plain(value: Any) -> bool:
    if isinstance(value, Mapping):
        return type(value) is dict and all(type(k) is str and _is_plain(v) for k, v in value.items())
    if type(value) in (list, tuple):
        return all(map(_is_plain, value))
    if isinstance(value, np.ndarray | np.generic):
        return not value.dtype.hasobject
    return value is None or type(value) in (bool, int, float, str)


def _check_walkable(value: Any, path: str) -> None:
    """Raises unless every bit of state of ``value`` is among its Python attributes."""
    cls: Any = type(value)
    if issubclass(cls, AsyncVectorEnv):
        raise NotCopyable(f"{path} steps its environments in other processes, whose state is out of reach")
    native = any(
        not c.__flags__ & (1 << 9) for c in cls.__mro__ if c is not object
    )  # 1 << 9: defined by a class statement
    bound = type(cls) not in (type, ABCMeta) and module_of(type(cls)).startswith(_NATIVE_BINDINGS)
    own_reduce = cls.__reduce_ex__ is not object.__reduce_ex__ or cls.__reduce__ is not object.__reduce__
    has_attributes = hasattr(value, "__dict__") or any("__slots__" in c.__dict__ for c in cls.__mro__)
    is_env = issubclass(cls, gymnasium.Env | VectorEnv)
    if native or bound or not has_attributes or (own_reduce and not is_env):
        raise NotCopyable(f"{path} is a {type_name(cls)}, which holds state outside of Python's reach")


def difference(a: Any, b: Any, path: str = "env") -> str | None:
    """Where two trees differ first, bit for bit (NaN equals NaN, -0.0 is not 0.0); None if nowhere."""
    if isinstance(a, dict) and a.get("kind") == "skip":
        return None
    if type(a) is not type(b):
        return path
    if isinstance(a, dict):
        if a.get("kind") in ("set", "frozenset"):  # members count, not their order
            a, b = ({**x, "items": sorted(x["items"], key=repr)} for x in (a, b))
        keys = a.keys() - {"shared"}
        if keys != b.keys() - {"shared"}:
            return path
        inner = ((a[k], b[k], path if k in ("attributes", "items", "root") else f"{path}.{k}") for k in sorted(keys))
        return next((d for x, y, p in inner if (d := difference(x, y, p))), None)
    if isinstance(a, list | tuple):
        if len(a) != len(b):
            return path
        return next(
            (d for i, (x, y) in enumerate(zip(a, b, strict=True)) if (d := difference(x, y, f"{path}[{i}]"))), None
        )
    if isinstance(a, np.ndarray):
        return None if a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes() else path
    if isinstance(a, torch.Tensor):
        same = a.dtype == b.dtype and a.shape == b.shape
        return None if same and torch.equal(*(x.cpu().reshape(-1).view(torch.uint8) for x in (a, b))) else path
    if isinstance(a, float):
        return None if a.hex() == b.hex() else path
    return None if a == b else path
