"""Observation spaces to arrays: what an environment hands out becomes what a value function takes.

Two targets. *Arrays* for networks and linear features: a `Box` becomes float32, scaled by its bounds
(`neuralq.runs.stream.scaling`; frames keep uint8 or bool, and the network scales them), a `Discrete` becomes a state
index that `OneHot` widens inside the network, everything composite becomes one flat float32 vector with a one-hot block
for each discrete part, in the order of `gymnasium.spaces.utils.flatten`. *Indices* for tables: every finite space
becomes one whole number in mixed radix, the first part the most significant digit.

Batches come as Gymnasium's vector environments give them: an array with one row per environment for `Box`, `Discrete`,
`MultiDiscrete` and `MultiBinary`, a tuple of batches for `Tuple`, a dict of batches for `Dict`. Whatever is encoded is
a fresh array: environments may reuse theirs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from gymnasium import Space, spaces

from neuralq.runs.stream.scaling import Scaling, scaling_of
from neuralq.types import Array

__all__ = ["MAX_TABLE_STATES", "Encoder", "ObservationError", "Part", "discrete_actions", "encoder_for"]

MAX_TABLE_STATES = 10_000_000
"""The most states that a table is built for; beyond it a table is no longer the right representation."""

_LAYOUTS = "choose another layout (linear, action-input, separate, action-output)"
_FLOAT, _WHOLE, _BINARY, _FRAMES = "f", "iu", "biu", (np.uint8, np.bool_)
_KIND_WORDS = {_FLOAT: "floating-point", _WHOLE: "whole-number", _BINARY: "0/1", "b": "boolean"}


class ObservationError(ValueError):
    """An observation is not what its space promised; says in which environment and in which field.

    Args:
        problem: what was wrong and what was got.
        env_index: index of the environment in the batch; None when the whole batch is at fault (its shape or type).
        field: the part of the observation, written as Python would index it.

    Example:
        >>> print(ObservationError("is nan", env_index=3, field="observation['speed']"))
        environment 3: observation['speed'] is nan
    """

    def __init__(self, problem: str, env_index: int | None = None, field: str = "observation") -> None:
        super().__init__(problem, env_index, field)
        self.problem = problem
        self.env_index = env_index
        self.field = field

    def __str__(self) -> str:
        """The message: environment, field, problem."""
        where = "" if self.env_index is None else f"environment {self.env_index}: "
        return f"{where}{self.field} {self.problem}"


def _nothing() -> Array:
    return np.empty(0, np.int64)


def _name(keys: tuple[int | str, ...]) -> str:
    return "observation" + "".join(f"[{key!r}]" for key in keys)


@dataclass(frozen=True, slots=True)
class Part:
    """One array of an observation: where to find it, what it must look like, and how it is encoded."""

    keys: tuple[int | str, ...]
    shape: tuple[int, ...]
    kinds: str
    dtype: np.dtype[Any]
    sizes: tuple[int, ...] | None  # categories per flattened entry; None for a Box
    starts: Array = field(default_factory=_nothing, compare=False, repr=False)
    limits: Array = field(default_factory=_nothing, compare=False, repr=False)
    columns: Array = field(default_factory=_nothing, compare=False, repr=False)
    scaling: Scaling | None = field(default=None, compare=False, repr=False)  # of a Box

    @property
    def width(self) -> int:
        """Entries that this part takes in a flat vector."""
        return math.prod(self.shape) if self.sizes is None or self.is_binary else sum(self.sizes)

    @property
    def is_binary(self) -> bool:
        """Whether its entries are bits, which stand in a flat vector as they are."""
        return self.kinds == _BINARY

    def find(self, observation: Any) -> Any:
        """This part of an observation, or of a batch."""
        for depth, key in enumerate(self.keys):
            kind: type[Any] = dict if isinstance(key, str) else tuple
            try:
                observation = (observation if isinstance(observation, kind) else kind())[key]
            except LookupError:
                problem = f"must be a {kind.__name__} holding {key!r}, got {_describe(observation)}"
                raise ObservationError(problem, field=_name(self.keys[:depth])) from None
        return observation

    def read(self, batch: Any) -> Array:
        """This part of a batch as an array ``[N, *shape]`` of the right kind, not copied."""
        value = self.find(batch) if self.keys else batch
        array = value if type(value) is np.ndarray else _as_array(value, self.keys)
        if array.shape[1:] != self.shape or array.ndim == 0:
            shape = ", ".join(["N", *map(str, self.shape)])
            way_out = "; a single observation goes to encode_single" if array.shape == self.shape else ""
            raise ObservationError(
                f"must have shape [{shape}], got {list(array.shape)}{way_out}", field=_name(self.keys)
            )
        exact = self.dtype in _FRAMES and self.sizes is None
        if array.dtype.kind not in self.kinds or (exact and array.dtype != self.dtype):
            wanted = str(self.dtype) if exact else f"{_KIND_WORDS[self.kinds]} (its space says {self.dtype})"
            way_out = "make the environment return what its observation_space declares"
            raise ObservationError(f"must be {wanted}, got dtype {array.dtype}; {way_out}", field=_name(self.keys))
        return array

    def floats(self, batch: Any, dtype: np.dtype[Any]) -> Array:
        """A fresh copy ``[N, *shape]`` of a Box part, scaled and finite throughout."""
        array = self.read(batch)
        if self.scaling is None and array.dtype == dtype:
            copy = array.copy()
        else:
            # In float64, where a large offset loses nothing; of numbers that float32 holds the rounding is the same.
            wide = array if self.scaling is None else self.scaling.apply(array)
            with np.errstate(over="ignore"):  # beyond float32 becomes inf, which is refused below
                copy = wide.astype(dtype)
        if array.dtype.kind == "f" and np.count_nonzero(np.isfinite(copy)) < copy.size:
            self._refuse_not_finite(array, copy)
        return copy

    def _refuse_not_finite(self, array: Array, copy: Array) -> None:
        env_index, *inner = (int(i) for i in np.argwhere(~np.isfinite(copy))[0])
        got = float(array[(env_index, *inner)])
        place = f" at index {tuple(inner)}" if inner else ""
        beyond = " (beyond the range of float32)" if math.isfinite(got) else ""
        raise ObservationError(f"must be finite, got {got!r}{place}{beyond}", env_index, _name(self.keys))

    def digits(self, batch: Any) -> Array:
        """The entries of a discrete part counted from zero, int64 ``[N, number of entries]``, each within its range."""
        array = self.read(batch)
        digits = array.astype(np.int64).reshape(len(array), len(self.sizes or ())) - self.starts
        bad = (digits < 0) | (digits >= self.limits)
        if bad.any():
            env_index, entry = (int(i) for i in np.argwhere(bad)[0])
            low, limit = int(self.starts[entry]), int(self.limits[entry])
            got = f"got {digits[env_index, entry] + low}" + (f" at flat index {entry}" if self.shape else "")
            raise ObservationError(f"must lie in {low}..{low + limit - 1}, {got}", env_index, _name(self.keys))
        return digits

    def write(self, batch: Any, out: Array) -> None:
        """Fill ``out [N, width]`` (zeros) with this part: values, bits or one-hot blocks."""
        if self.sizes is None:
            out[:] = self.floats(batch, out.dtype).reshape(out.shape)
        elif self.is_binary:
            out[:] = self.digits(batch)
        else:
            out[np.arange(len(out))[:, None], self.digits(batch) + self.columns] = 1.0


@dataclass(frozen=True, slots=True)
class Encoder:
    """Turns a batch of observations into one fresh array and refuses what the space did not promise.

    Made by `encoder_for`.

    Args:
        shape: shape of one encoded observation, without the axis of environments.
        dtype: float32 (float64 where that was asked for), uint8 or bool (frames) or int64 (state indices).
        num_categories: number of states when the encoded observation is a state index (shape ``()``), else None.
        layout: what becomes of the parts: an "array" or an "image" of its own, one "vector" of all, or an "index".
        parts: the arrays that an observation consists of.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    num_categories: int | None
    layout: Literal["array", "image", "vector", "index"]
    parts: tuple[Part, ...]

    @property
    def frame_scaling(self) -> Scaling | None:
        """Of frames, which are encoded as they are: how the network is to scale them. Other numbers are scaled."""
        return self.parts[0].scaling if self.layout == "image" else None

    @property
    def scalings(self) -> dict[str, list[list[float]]]:
        """Origin and divisor of every part that is scaled, here or in the network, by its name."""
        return {_name(part.keys): part.scaling.plain() for part in self.parts if part.scaling is not None}

    def require_scalings(self, saved: Mapping[str, Any] | None) -> None:
        """Refuse what was learned from observations that were scaled otherwise.

        Args:
            saved: `scalings` of then; None where nobody wrote them down, when frames of bytes were divided by 255 and
                nothing else was scaled.

        Raises:
            ValueError: with the way out.
        """
        bytes_ = self.layout == "image" and self.dtype == np.uint8
        then = ({"observation": [[0.0], [255.0]]} if bytes_ else {}) if saved is None else dict(saved)
        if then != self.scalings:
            raise ValueError(
                "the observations of this run were scaled otherwise when it learned: its environment had other bounds, "
                "or its version of neuralq took bytes, and nothing else, for 0..255; train it anew, or use it with "
                "both as they were"
            )

    def encode(self, batched_observation: Any) -> Array:
        """A fresh array ``[N, *shape]`` of the batch of N observations.

        Raises:
            ObservationError: NaN or inf, a wrong shape or kind of dtype, a missing part, a discrete value out of range;
                names the environment and the field.

        Example:
            >>> encoder = encoder_for(spaces.Dict({"speed": spaces.Box(-1, 1, (1,)), "gear": spaces.Discrete(3)}))
            >>> encoder.encode({"speed": np.array([[0.5], [-0.5]], np.float32), "gear": np.array([2, 0])}).tolist()
            [[0.0, 0.0, 1.0, 0.5], [1.0, 0.0, 0.0, -0.5]]
        """
        if self.layout == "array":
            return self.parts[0].floats(batched_observation, self.dtype)
        if self.layout == "image":
            return self.parts[0].read(batched_observation).copy()
        if self.layout == "index":
            return self._index(batched_observation)
        num_envs = self._num_envs(batched_observation)
        out = np.zeros((num_envs, *self.shape), self.dtype)
        offset = 0
        for part in self.parts:
            part.write(batched_observation, out[:, offset : offset + part.width])
            offset += part.width
        return out

    def encode_single(self, observation: Any, env_index: int = 0) -> Array:
        """A fresh array ``[*shape]`` of a single observation; ``env_index`` is what errors name.

        Raises:
            ObservationError: as `encode`.

        Example:
            >>> encoder_for(spaces.Discrete(3, start=5)).encode_single(6).item()
            1
        """
        nested = bool(self.parts[0].keys)
        try:
            encoded = self.encode(_add_env_axis(observation) if nested else _as_array(observation)[None])
        except ObservationError as error:
            raise ObservationError(error.problem, env_index, error.field) from None
        row: Array = encoded[0]
        return row if row.shape else np.array(row)

    def is_batch(self, observation: Any) -> bool:
        """Whether this is one observation or, with an axis before its own, many; what is neither is taken for one.

        Example:
            >>> encoder = encoder_for(spaces.Box(-1, 1, (4,)))
            >>> encoder.is_batch(np.zeros(4)), encoder.is_batch(np.zeros((1, 4)))
            (False, True)
        """
        part = self.parts[0]
        try:
            value = part.find(observation) if part.keys else observation
            return bool(np.ndim(value) == len(part.shape) + 1)
        except ValueError:
            return False

    def _index(self, batch: Any) -> Array:
        index = np.zeros(self._num_envs(batch), np.int64)
        for part in self.parts:  # Horner's rule
            digits = part.digits(batch)
            for entry, size in enumerate(part.sizes or ()):
                index = index * size + digits[:, entry]
        return index

    def _num_envs(self, batch: Any) -> int:
        lengths = [len(part.read(batch)) for part in self.parts]
        for part, length in zip(self.parts, lengths, strict=True):
            if length != lengths[0]:
                problem = f"has {length} rows where {_name(self.parts[0].keys)} has {lengths[0]}"
                raise ObservationError(f"{problem}; every part needs one row per environment", field=_name(part.keys))
        return lengths[0]


def encoder_for(space: Space[Any], *, as_index: bool = False, wide: bool = False, instead: str = _LAYOUTS) -> Encoder:
    """The encoder of an observation space: arrays for networks and linear features, or one state index for a table.

    Args:
        space: the space of a single environment (``envs.single_observation_space``).
        as_index: encode as one whole number; only for finite spaces.
        wide: numbers as float64 and not scaled, for whoever normalises them before they become float32; frames too.
        instead: what to choose where no index exists.

    Raises:
        ValueError: the space has no batched form or holds nothing, or no index exists (a `Box`, or more than
            `MAX_TABLE_STATES` states); says what to do instead.

    Example:
        >>> encoder_for(spaces.Box(-1, 1, (4,))).shape
        (4,)
        >>> encoder_for(spaces.Discrete(16)).num_categories
        16
        >>> encoder_for(spaces.MultiDiscrete([3, 4]), as_index=True).encode(np.array([[2, 1]])).tolist()
        [9]
    """
    parts = tuple(_parts_of(space, ()))
    if not any(part.width for part in parts):
        raise ValueError(f"{space} holds nothing to observe; give it at least one number, for example Discrete(1)")
    numbers: np.dtype[Any] = np.dtype(np.float32)
    if wide:
        numbers, parts = np.dtype(np.float64), tuple(replace(part, scaling=None) for part in parts)
    if as_index:
        return Encoder((), np.dtype(np.int64), _count_states(space, parts, instead), "index", parts)
    if isinstance(space, spaces.Discrete):
        return Encoder((), np.dtype(np.int64), int(space.n), "index", parts)
    if isinstance(space, spaces.Box):
        if parts[0].dtype in _FRAMES and len(space.shape) >= 2 and not wide:
            return Encoder(space.shape, parts[0].dtype, None, "image", parts)
        return Encoder(space.shape, numbers, None, "array", parts)
    width = sum(part.width for part in parts)
    return Encoder((width,), numbers, None, "vector", parts)


def _parts_of(space: Space[Any], keys: tuple[int | str, ...]) -> Iterator[Part]:
    if isinstance(space, spaces.Tuple):
        for position, inner in enumerate(space.spaces):
            yield from _parts_of(inner, (*keys, position))
    elif isinstance(space, spaces.Dict):
        for key, inner in space.spaces.items():
            yield from _parts_of(inner, (*keys, key))
    elif isinstance(space, spaces.Box):
        dtype = np.dtype(space.dtype)
        kinds = _WHOLE if dtype.kind in _WHOLE else dtype.kind
        yield Part(keys, space.shape, kinds, dtype, None, scaling=scaling_of(space))
    elif isinstance(space, spaces.Discrete):
        yield _discrete_part(keys, (), _WHOLE, space, np.array([space.n]), np.array([space.start]))
    elif isinstance(space, spaces.MultiDiscrete):
        yield _discrete_part(keys, space.shape, _WHOLE, space, space.nvec.ravel(), space.start.ravel())
    elif isinstance(space, spaces.MultiBinary):
        bits = math.prod(space.shape)
        yield _discrete_part(keys, space.shape, _BINARY, space, np.full(bits, 2), np.zeros(bits, np.int64))
    else:
        where = f" at {_name(keys)}" if keys else ""
        way_out = (
            "a Box, Discrete, MultiDiscrete, MultiBinary, Tuple or Dict with gymnasium.wrappers.TransformObservation"
        )
        raise ValueError(f"observation space {space}{where} has no batched array form; turn it into {way_out}")


def _discrete_part(
    keys: tuple[int | str, ...], shape: tuple[int, ...], kinds: str, space: Space[Any], sizes: Array, starts: Array
) -> Part:
    limits = sizes.astype(np.int64)
    columns = np.cumsum(limits) - limits
    dtype = np.dtype(space.dtype)
    return Part(keys, shape, kinds, dtype, tuple(limits.tolist()), starts.astype(np.int64), limits, columns)


def _count_states(space: Space[Any], parts: tuple[Part, ...], instead: str) -> int:
    for part in parts:
        if part.sizes is None:
            place = f" in {_name(part.keys)}" if part.keys else ""
            problem = f"a table needs a finite observation space, got a Box{place}: {space}"
            raise ValueError(f"{problem}; {instead} or discretise it with gymnasium.wrappers.TransformObservation")
    num_states = math.prod(size for part in parts for size in part.sizes or ())
    if num_states > MAX_TABLE_STATES:
        problem = f"a table of {num_states:,} states is refused (the most is {MAX_TABLE_STATES:,}) for {space}"
        raise ValueError(f"{problem}; {instead} or merge states")
    return num_states


def _as_array(value: Any, keys: tuple[int | str, ...] = ()) -> Array:
    if isinstance(value, Mapping):
        raise ObservationError(f"must be an array, got {_describe(value)}", field=_name(keys))
    try:
        return np.asarray(value)
    except ValueError:
        raise ObservationError(f"must be an array, got a ragged {type(value).__name__}", field=_name(keys)) from None


def _add_env_axis(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _add_env_axis(inner) for key, inner in value.items()}
    if isinstance(value, tuple):
        return tuple(_add_env_axis(inner) for inner in value)
    return _as_array(value)[None]


def _describe(value: Any) -> str:
    return type(value).__name__ + (f" of {list(value)}" if isinstance(value, dict) else "")


def discrete_actions(space: Space[Any]) -> tuple[int, int]:
    """The number of actions and the environment's name of action 0: ``(num_actions, start)``.

    Raises:
        ValueError: any space but `Discrete`; names it and the way out.

    Example:
        >>> discrete_actions(spaces.Discrete(3, start=-1))
        (3, -1)
    """
    if isinstance(space, spaces.Discrete):
        return int(space.n), int(space.start)
    if isinstance(space, spaces.Box):
        way_out = "pick a finite set of its actions"
    elif isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary):
        way_out = "number its joint actions"
    else:
        way_out = "number the actions to choose from"
    wrapper = "wrap the environment with gymnasium.wrappers.TransformAction"
    raise ValueError(f"the action space must be Discrete, got {space}; {way_out} and {wrapper}")
