"""A replay buffer that keeps streams of experience whole, so that n-step returns and blocks come out of it correctly.

Each environment is a stream of steps in time order, stored apart from the others. Nothing drawn from the buffer
mixes two environments, crosses the newest step, or looks past a `last_t`. The successor of every step is the
true one, also at a time limit: observations are stored as a chain o₀ o₁ … of which step t uses oₜ₋₁ and oₜ, and a
stream that starts anew starts a new chain. A step whose ``s_tm1`` is not, byte for byte, the environment's previous
``s_t`` is stored correctly too; the step before it is then marked `last_t`, since the stream did break there.

Drawing fills arrays that are allocated once per batch size and handed out each time:
**a sample is valid until the next one of its kind**; keep it with ``batch.transition.map(torch.clone)``.

Prioritised sampling: Schaul, Quan, Antonoglou, Silver 2016, "Prioritized experience replay", §3.3 (proportional,
stratified) and §3.4 (importance weights). n-step returns: Sutton & Barto 2018, eq. 7.1, with the discount of each step.
"""

from __future__ import annotations

import math
import operator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numba.core.errors import TypingError
from numpy.typing import DTypeLike
from torch import Tensor

from neuralq.checks import check_fits, check_fraction, check_whole
from neuralq.jit import INTERPRETED
from neuralq.learners.replay.arrays import Batch, Output, Prioritised, as_array, scratch_file
from neuralq.learners.replay.kernels import RECORD, gather, gather_blocks, locate, store, store_one, synchronise
from neuralq.learners.replay.sum_tree import SumTree
from neuralq.types import Array, Indices, Transition

__all__ = ["Batch", "Prioritised", "ReplayBuffer"]


EXACT_ROW_BYTES = 1024
"""Observations up to this size get two rows per step, so that any stream fills the capacity exactly."""


class ReplayBuffer:
    """Keeps the newest steps of each environment; draws n-step transitions, and blocks of consecutive steps.

    From step t, ``sample`` gives (with m = n, or fewer if `last_t` or the environment's newest step comes first)
    r = Σ_{k<m} (Π_{j<k} γ_{t+j}) r_{t+k},  discount = Π_{k<m} γ_{t+k},  s_t = the successor of the last of the m steps.
    γ is the `discount_t` stored with each step: 0 where the world terminated, so nothing is bootstrapped there, while a
    time limit keeps its bootstrap.

    Args:
        capacity: steps to hold over all environments, rounded up to a multiple of ``num_envs``. Observations above
            1 KiB get 9/8 rows per step; a stream whose episodes are shorter than 8 steps then holds somewhat fewer
            (`len`).
        observation_shape: shape of one observation; ``()`` for a number.
        observation_dtype: any NumPy dtype without objects: ``np.float32``, ``np.uint8``, ``np.int64``, ...
        num_envs: number of parallel environments.
        num_steps: n of the n-step transitions that `sample` gives.
        prioritised: settings of prioritised sampling; None draws uniformly, with replacement.
        memory_map: folder in which observations are kept in a scratch file instead of memory. The file has no name
            and vanishes with the process; what should survive goes through `state_dict`.
        device: where sampled tensors live. On the CPU they are the reused arrays themselves.

    Raises:
        MemoryError: the arrays do not fit into the memory that is available; nothing has been allocated.
        ValueError: a number out of range.

    Example:
        >>> import numpy as np, torch
        >>> buffer = ReplayBuffer(100, (2,), np.float32, num_steps=2)
        >>> for t in range(3):
        ...     buffer.add_step(0, np.full(2, t, np.float32), 1, 0.5, 1.0, 0.9, np.full(2, t + 1, np.float32), t == 2)
        >>> batch = buffer.sample(32, np.random.default_rng(0))
        >>> sorted(set(batch.transition.r_t.tolist()))  # 1 + 0.9 · 1, and 1 from the last step
        [1.0, 1.899999976158142]
    """

    def __init__(
        self,
        capacity: int,
        observation_shape: tuple[int, ...],
        observation_dtype: DTypeLike,
        *,
        num_envs: int = 1,
        num_steps: int = 1,
        prioritised: Prioritised | None = None,
        memory_map: str | Path | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        for name, value in (("capacity", capacity), ("num_envs", num_envs), ("num_steps", num_steps)):
            check_whole(name, value)
        self.observation_shape = tuple(int(n) for n in observation_shape)
        self.observation_dtype = np.dtype(observation_dtype)
        self.num_envs, self.num_steps, self.prioritised = int(num_envs), int(num_steps), prioritised
        self.device = torch.device(device)
        self._row_bytes = self.observation_dtype.itemsize * math.prod(self.observation_shape)
        if self.observation_dtype.hasobject or self._row_bytes == 0:
            raise ValueError(
                f"observations must be numbers, got shape {self.observation_shape} of {self.observation_dtype}; "
                "flatten or encode them first"
            )
        self._per_env = -(-int(capacity) // self.num_envs)
        self._allocate(memory_map)
        self._env_indices = np.arange(self.num_envs)
        observed = (self.observation_dtype,)
        self._dtypes = (observed, (np.dtype(np.int64),), _REAL, _REAL, _REAL, observed, (np.dtype(np.bool_),))
        self._sample_out = self._output((0,))
        self._blocks_out = self._output((0, 0))

    def _allocate(self, memory_map: str | Path | None) -> None:
        exact = self._row_bytes <= EXACT_ROW_BYTES
        num_rows = 2 * self._per_env if exact else self._per_env + max(2, -(-self._per_env // 8))
        rows_bytes = self.num_envs * num_rows * self._row_bytes
        steps = self.num_envs * self._per_env
        other_bytes = steps * RECORD.itemsize + (32 * steps if self.prioritised else 0)
        check_fits(
            f"a replay buffer of {steps:,} steps",
            other_bytes + (0 if memory_map else rows_bytes),
            "take a smaller capacity, observations of a smaller dtype such as uint8, or memory_map=FOLDER",
        )
        shape = (self.num_envs, num_rows, self._row_bytes)
        self._rows: Array = np.zeros(shape, np.uint8) if memory_map is None else scratch_file(Path(memory_map), shape)
        self._records: Array = np.zeros((self.num_envs, self._per_env), RECORD)
        if INTERPRETED:  # interpreted, fields are found as attributes in record arrays only
            self._records = self._records.view(np.recarray)
        self._cursors: Indices = np.zeros((self.num_envs, 4), np.int64)  # see replay_kernels
        self._tree = SumTree(steps) if self.prioritised else None
        self._seen: Indices = np.zeros((self.num_envs, 2), np.int64)
        self._largest_weight = 1.0

    @property
    def capacity(self) -> int:
        """Steps it can hold."""
        return self.num_envs * self._per_env

    @property
    def least_steps(self) -> int:
        """Steps of one environment that are held for certain once it is full: short episodes take more rows."""
        return int(min(self._per_env, self._rows.shape[1] // 2))

    @property
    def num_bytes(self) -> int:
        """Bytes of the stored arrays, in memory or in the scratch file."""
        return self._rows.nbytes + self._records.nbytes + (self._tree.nodes.nbytes if self._tree else 0)

    @property
    def num_breaks(self) -> int:
        """Steps whose successor was not the stream's next ``s_tm1`` although `last_t` was false; marked last."""
        return int(self._cursors[:, 3].sum())

    def __len__(self) -> int:
        """Steps held."""
        return int(self._cursors[:, 1].sum())

    def add(self, transition: Transition, env_indices: Indices | None = None) -> None:
        """Copies one step of each environment in ``env_indices`` (default: all), or ``[T, k]`` steps, time first.

        Args:
            transition: fields ``[k]`` or ``[T, k]``; tensors, or arrays (which is quicker for few steps).
            env_indices: environment of each of the k columns, int64.

        Raises:
            ValueError: a wrong shape, dtype or environment, naming the field; nothing is stored then.
        """
        values = [as_array(x) for x in _fields(transition)]
        leading = values[1].shape
        env_indices = self._env_indices if env_indices is None else self._check_env_indices(env_indices)
        if len(leading) not in (1, 2) or leading[-1] != len(env_indices):
            raise ValueError(
                f"a_tm1 must have shape [k] or [T, k] with k = {len(env_indices)} environments, got {leading}; name "
                "the environments of the columns with env_indices="
            )
        observed = leading + self.observation_shape
        for i, (value, allowed) in enumerate(zip(values, self._dtypes, strict=True)):
            if value.dtype not in allowed or value.shape != (observed if i in _OBSERVED else leading):
                self._refuse(_FIELDS[i], value, observed if i in _OBSERVED else leading, allowed)
        self._store(env_indices, values)

    def add_step(
        self,
        env_index: int,
        s_tm1: Array,
        a_tm1: int,
        mu_tm1: float,
        r_t: float,
        discount_t: float,
        s_t: Array,
        last_t: bool,
    ) -> None:
        """Copies one step of one environment, given as a Gymnasium environment gives it: arrays and Python numbers.

        Raises:
            ValueError: a wrong environment, an observation of a wrong shape or dtype, or a reward that float32 cannot
                hold; nothing is stored then.
        """
        _check_reward(r_t)
        dtype = self.observation_dtype
        try:  # the quick way first: the checks cost more than the storing
            if (
                self.observation_shape
                and s_tm1.dtype is dtype
                and s_t.dtype is dtype
                and s_tm1.shape == self.observation_shape == s_t.shape
                and store_one(
                    self._records,
                    self._rows,
                    self._cursors,
                    env_index,
                    s_tm1,
                    a_tm1,
                    mu_tm1,
                    r_t,
                    discount_t,
                    s_t,
                    last_t,
                )
            ):
                return
        except (AttributeError, TypeError, TypingError):
            pass
        env_indices = self._check_env_indices(np.array([env_index]))
        reals = (np.float32(x) for x in (mu_tm1, r_t, discount_t))
        step = (s_tm1, np.int64(a_tm1), *reals, s_t, np.bool_(last_t))
        self.add(Transition(*(np.asarray(x)[None] for x in step)), env_indices)  # type: ignore[arg-type]

    def _store(self, env_indices: Indices, values: list[Array]) -> None:
        """Each field as one row without gaps, observations as bytes, reals as float32."""
        s_tm1, a_tm1, *reals, s_t, last_t = (x.ravel() for x in values)
        _check_reward(float(np.abs(reals[1]).max(initial=0.0)))
        mu_tm1, r_t, discount_t = (x if x.dtype is _FLOAT32 else x.astype(_FLOAT32) for x in reals)
        s_tm1, s_t = s_tm1.view(np.uint8), s_t.view(np.uint8)
        store(self._records, self._rows, self._cursors, env_indices, s_tm1, a_tm1, mu_tm1, r_t, discount_t, s_t, last_t)

    def sample(self, batch_size: int, rng: np.random.Generator, *, beta: float | None = None) -> Batch:
        """``batch_size`` n-step transitions, drawn with replacement; valid until the next `sample`.

        Args:
            batch_size: B.
            rng: where the draws come from.
            beta: β of the importance weights instead of ``prioritised.beta``.

        Raises:
            ValueError: the buffer is empty, or ``beta`` is given although sampling is uniform.
        """
        check_whole("batch_size", batch_size)
        out = self._sample_out
        if len(out.indices) != batch_size:
            out = self._sample_out = self._output((batch_size,))
        if self._tree is None:
            if beta is not None:
                raise ValueError("beta weighs prioritised samples, this buffer draws uniformly; leave it out")
            self._draw(1, out.indices, rng)
        else:
            self._draw_prioritised(self._tree, out, beta, rng)
        gather(self._records, self._rows, self._cursors, self.num_steps, out.indices, *out.arguments)
        if self.device.type == "cpu":
            return out.batch
        return Batch(out.batch.transition.map(self._move), self._move(out.batch.weights), out.indices)

    def sample_blocks(self, num_blocks: int, block_length: int, rng: np.random.Generator) -> Transition:
        """``[T, B]`` consecutive single steps of one environment per column, drawn uniformly; valid until the next.

        A block may contain `last_t`, also before its end. ``num_steps`` and priorities play no part.

        Raises:
            ValueError: no environment holds ``block_length`` steps.
        """
        check_whole("num_blocks", num_blocks)
        check_whole("block_length", block_length)
        out = self._blocks_out
        if out.leading != (block_length, num_blocks):
            out = self._blocks_out = self._output((block_length, num_blocks))
        self._draw(int(block_length), out.indices, rng)
        gather_blocks(self._records, self._rows, block_length, out.indices, *out.arguments)
        return out.batch.transition if self.device.type == "cpu" else out.batch.transition.map(self._move)

    def update_priorities(self, indices: Indices, td_errors: Tensor | Array) -> None:
        """The steps at ``indices`` have priority (|δ| + ε)^α from now on. To be called before more steps are added.

        Raises:
            ValueError: sampling is uniform; an index that holds no step; an error that is not finite.
        """
        if self._tree is None or self.prioritised is None:
            raise ValueError("this buffer draws uniformly and has no priorities; construct it with prioritised=")
        self._synchronise(self._tree)
        indices, errors = np.asarray(indices, np.int64), as_array(td_errors).astype(np.float64)
        if indices.shape != errors.shape or not np.isfinite(errors).all():
            raise ValueError(
                f"td_errors must be {indices.shape} finite numbers, got {errors.shape} of which "
                f"{np.count_nonzero(~np.isfinite(errors))} are not finite; a diverged learner makes these"
            )
        if indices.size and not ((indices >= 0) & (indices < self.capacity)).all():
            raise ValueError(f"indices must lie in [0, {self.capacity}), got {indices.min()} to {indices.max()}")
        held = self._tree.weights[indices] > 0
        if not held.all():
            raise ValueError(f"index {indices[~held][0]} holds no step; use the indices of the last sample")
        weights = (np.abs(errors) + self.prioritised.epsilon) ** self.prioritised.alpha
        self._tree.set(indices, weights)
        self._largest_weight = max(self._largest_weight, float(weights.max(initial=0.0)))

    def state_dict(self) -> dict[str, Any]:
        """All that sampling depends on, as arrays and numbers. **Views**: write or copy them before adding steps."""
        used_records = int(min(self._cursors[:, 0].max(), self._per_env))
        used_rows = int(min(self._cursors[:, 2].max(), self._rows.shape[1]))
        records = self._records[:, :used_records]
        state: dict[str, Any] = {
            "layout": self._layout(),
            "rows": self._rows[:, :used_rows],
            "records": {name: records[name] for name in RECORD.names or ()},
            "cursors": self._cursors,
        }
        if self._tree is not None:
            self._synchronise(self._tree)
            leaves = self._tree.weights.reshape(self.num_envs, self._per_env)
            state |= {"weights": leaves[:, :used_records], "largest_weight": self._largest_weight}
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """The buffer that `state_dict` described: from here on it draws the same, bit for bit.

        Raises:
            ValueError: the state is of a buffer of another layout, naming what differs.
        """
        for name, ours in self._layout().items():
            theirs = state["layout"].get(name)
            if theirs != ours:
                raise ValueError(
                    f"state was saved with {name}={theirs!r}, this buffer has {ours!r}; construct it alike"
                )
        rows, weights = np.asarray(state["rows"]), state.get("weights")
        self._rows[:, : rows.shape[1]] = rows
        for name, column in state["records"].items():
            self._records[name][:, : column.shape[1]] = column
        self._cursors[:] = state["cursors"]
        if self._tree is not None and weights is not None:
            leaves = np.zeros((self.num_envs, self._per_env))
            leaves[:, : weights.shape[1]] = weights
            self._tree.load(leaves.reshape(-1))
            self._largest_weight = float(state["largest_weight"])
            self._seen[:, 0] = self._cursors[:, 0]
            self._seen[:, 1] = self._cursors[:, 0] - self._cursors[:, 1]

    def _layout(self) -> dict[str, Any]:
        return {
            "per_lane": self._per_env,
            "num_lanes": self.num_envs,  # the name it has in checkpoints
            "observation_shape": list(self.observation_shape),
            "observation_dtype": self.observation_dtype.str,
            "prioritised": self.prioritised is not None,
        }

    def _draw(self, length: int, indices: Indices, rng: np.random.Generator) -> None:
        """Uniform over the starts of ``length`` held steps in a row, over all environments."""
        if self.num_envs == 1:
            starts = int(self._cursors[0, 1]) - length + 1
        else:
            starts = int(np.maximum(self._cursors[:, 1] - length + 1, 0).sum())
        if starts <= 0:
            longest = int(self._cursors[:, 1].max())
            raise ValueError(
                f"cannot draw {length} step(s) in a row: the fullest environment holds {longest} (capacity "
                f"{self._per_env} per environment); add steps first, or draw shorter blocks"
            )
        uniforms = rng.random(len(indices))  # five times as quick as rng.integers; its bias is below starts / 2⁵³
        locate(self._cursors, self._per_env, length, starts, uniforms, indices)

    def _draw_prioritised(self, tree: SumTree, out: Output, beta: float | None, rng: np.random.Generator) -> None:
        """One draw from each of B equal slices of the total priority, and its importance weight."""
        self._synchronise(tree)
        total, batch_size = tree.total, len(out.indices)
        if total <= 0:
            raise ValueError("cannot draw from an empty replay buffer; add steps first")
        beta = self.prioritised.beta if beta is None and self.prioritised else float(beta or 0.0)
        check_fraction("beta", beta)
        masses = (np.arange(batch_size) + rng.random(batch_size)) * (total / batch_size)
        out.indices[:] = tree.find(np.minimum(masses, np.nextafter(total, 0.0)))
        weights = (len(self) * tree.weights[out.indices] / total) ** -beta
        out.weights[:] = weights / weights.max()

    def _output(self, leading: tuple[int, ...]) -> Output:
        return Output(leading, self.observation_shape, self.observation_dtype)

    def _synchronise(self, tree: SumTree) -> None:
        synchronise(tree.nodes, self._cursors, self._seen, self._per_env, self._largest_weight)

    def _move(self, value: Tensor) -> Tensor:
        return value.to(self.device)

    def _refuse(self, name: str, value: Array, shape: tuple[int, ...], allowed: tuple[Any, ...]) -> None:
        if value.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, got {value.shape}")
        raise ValueError(f"{name} must be {' or '.join(map(str, allowed))}, got {value.dtype}; convert it first")

    def _check_env_indices(self, given: Array) -> Indices:
        env_indices: Indices = np.ascontiguousarray(given)
        if env_indices.ndim != 1 or env_indices.dtype != np.int64:
            raise ValueError(
                f"env_indices must be a row of int64, got shape {env_indices.shape} of {env_indices.dtype}"
            )
        if env_indices.size and not (env_indices.min() >= 0 and env_indices.max() < self.num_envs):
            raise ValueError(
                f"env_indices must lie in [0, {self.num_envs}), got {env_indices.min()} to {env_indices.max()}"
            )
        return env_indices


_FIELDS = tuple(f.name for f in fields(Transition))
_fields = operator.attrgetter(*_FIELDS)
_OBSERVED = (0, 5)
_FLOAT32 = np.dtype(np.float32)
_LARGEST_REAL = float(np.finfo(np.float32).max)
_REAL = (_FLOAT32, np.dtype(np.float64))


def _check_reward(r_t: float) -> None:
    if not abs(r_t) <= _LARGEST_REAL:
        raise ValueError(
            f"a reward of {float(r_t):g} cannot be kept: rewards are stored in float32, up to {_LARGEST_REAL:.2g}; "
            "scale it where the environment gives it"
        )
