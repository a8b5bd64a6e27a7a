"""A trained agent: a representation, how observations reach it, and what its values mean."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuralq.q.recurrent import recurrent_part
from neuralq.runs.stream import Normalisation, ObservationSpec
from neuralq.runs.stream.acting import choose_greedy
from neuralq.runs.stream.encoding import Encoder
from neuralq.types import Array, QFunction

__all__ = ["Agent"]

_ALONE = "predict returns the greedy action and nothing beside it: action = agent.predict(observation)"
_ELSEWHERE = {
    "learn": "a run goes on with neuralq.resume(run, total_steps=...)",
    "save": "the run folder holds it, and neuralq.load(run) takes it from there; neuralq.export(run, 'q.safetensors') "
    "writes a plain torch network",
    "load": "neuralq.load(run) makes an agent of a run folder",
    "policy": "the network is agent.q, and agent.predict(observation) its greedy action",
    "q_net": "the network is agent.q",
    "evaluate": "neuralq.evaluate(agent) plays greedy episodes",
    "act": "the greedy action is agent.predict(observation)",
    "forward": "the greedy action is agent.predict(observation), action values are agent.values(observation)",
}
"""What other libraries' agents have, and what there is instead."""


class _Action(int):
    """A number of an action, which is no pair: two names on the left of it are two too many."""

    def __iter__(self) -> Any:
        raise TypeError(_ALONE)


class Agent:
    """Acts greedily and tells what it expects, of one observation or of a batch.

    ``agent(observations)`` is `predict`.

    An agent with a memory (`neuralq.q.GRU`) is given what it remembers, and says what it remembers next:
    ``memory = agent.first_memory()`` where an episode begins, then ``action = agent.predict(observation,
    memory=memory)`` and ``memory = agent.next_memory(observation, memory)`` at every step.

    Args:
        q: the representation.
        encoder: from the environment's observations to arrays.
        spec: shape and kind of the encoded observations.
        first_action: smallest action of the environment (0 unless its space starts elsewhere).
        reward_scale: by which rewards were multiplied for learning; values are given in the environment's units.
        normalisation: through which observations were seen, frozen.
        run_dir: folder of the run that it comes from, if it comes from one.
    """

    def __init__(
        self,
        q: QFunction,
        encoder: Encoder,
        spec: ObservationSpec,
        first_action: int = 0,
        reward_scale: float = 1.0,
        normalisation: Normalisation | None = None,
        run_dir: Path | None = None,
    ) -> None:
        self.q = q
        self.encoder = encoder
        self.spec = spec
        self.first_action = first_action
        self.reward_scale = reward_scale
        self.normalisation = normalisation
        self.run_dir = run_dir

    def __getattr__(self, name: str) -> Any:
        """Only asked for what there is not.

        Raises:
            AttributeError: always; of what agents of other libraries have it says what there is instead.
        """
        hint = f"; {_ELSEWHERE[name]}" if name in _ELSEWHERE else ""
        raise AttributeError(f"an agent has no {name!r}{hint}", name=name, obj=self)

    def inputs(self, observations: Any, action_mask: Any = None, memory: Any = None) -> Array:
        """What ``agent.q`` is given for observations, a row for each: ``[n, *spec.shape]``, one row for a single one.

        Arguments and errors as for `values`.
        """
        single = not self.encoder.is_batch(observations)
        encoded = self.encoder.encode_single(observations)[None] if single else self.encoder.encode(observations)
        if self.normalisation is not None:
            encoded = self.normalisation.observe(encoded)
        flat = encoded.reshape(len(encoded), -1)
        remembered = self._memory(memory, len(encoded), single)
        if self.spec.memory_size:
            encoded = flat = np.concatenate([flat, remembered], axis=1).astype(self.spec.dtype)
        if self.spec.masked:
            mask = self._mask(action_mask, len(encoded), single)
            encoded = np.concatenate([flat, mask], axis=1).astype(self.spec.dtype)
        return encoded

    def first_memory(self, num_rows: int | None = None) -> Array:
        """What is remembered where episodes begin: ``[M]``, or ``[n, M]`` of n; M is 0 for agents without a memory."""
        size = self.spec.memory_size
        return np.zeros(size if num_rows is None else (num_rows, size), np.float32)

    def next_memory(self, observations: Any, memory: Any) -> Array:
        """What is remembered after observations were seen, in the shape of ``memory``.

        Args:
            observations: as for `values`.
            memory: what was remembered before them.
        """
        recurrent = recurrent_part(self.q)
        if recurrent is None:
            return np.asarray(memory, np.float32)
        rows = self.inputs(observations, None, memory)
        with torch.no_grad():
            after: Array = recurrent.next_memory(torch.from_numpy(rows).to(self._device)).cpu().numpy()
        return after if self.encoder.is_batch(observations) else after[0]

    def _memory(self, given: Any, num_rows: int, single: bool) -> Array:
        size = self.spec.memory_size
        if given is None and size:
            raise ValueError(
                "this agent has a memory and was not told what it remembers; begin an episode with memory = "
                "agent.first_memory(), and after each step take memory = agent.next_memory(observation, memory)"
            )
        memory = np.zeros((num_rows, 0)) if given is None else np.asarray(given)
        wanted = (size,) if single else (num_rows, size)
        if given is not None and memory.shape != wanted:
            raise ValueError(f"memory must be of shape {wanted}, as agent.first_memory gives it, got {memory.shape}")
        return memory.reshape(num_rows, size)

    @property
    def _device(self) -> torch.device:
        return next(iter(self.q.parameters())).device  # type: ignore[attr-defined,no-any-return]

    def _mask(self, given: Any, num_rows: int, single: bool) -> Array:
        """Which actions are legal, ``[n, A]``; one row may stand for all."""
        num_actions = self.spec.num_actions
        mask = np.ones(num_actions, bool) if given is None else np.asarray(given) != 0
        if mask.shape != (num_actions,) and (single or mask.shape != (num_rows, num_actions)):
            many = "" if single else f", or {num_rows} rows of them"
            raise ValueError(f"action_mask must have {num_actions} entries{many}, got shape {mask.shape}")
        return np.broadcast_to(mask, (num_rows, num_actions))

    def values(self, observations: Any, action_mask: Any = None, memory: Any = None) -> Array:
        """Action values, in units of the environment's return.

        Args:
            observations: one, as the environment gives it; or n of them, as a vector environment gives them.
            action_mask: which actions are legal, ``[A]``, or ``[n, A]``; all of them where it is left out.
            memory: of an agent that has one, ``[M]``, or ``[n, M]`` (`first_memory`, `next_memory`).

        Returns:
            ``[A]`` float64, or ``[n, A]``; −∞ for illegal actions.

        Raises:
            ValueError: if an observation or the mask is not what the environment's spaces promise.
        """
        single, rows = not self.encoder.is_batch(observations), self.inputs(observations, action_mask, memory)
        with torch.no_grad():
            q = self.q.all(torch.from_numpy(rows).to(self._device))
        values = q.cpu().numpy().astype(np.float64) / self.reward_scale
        values = np.where(self._mask(action_mask, len(rows), single), values, -np.inf)
        return values[0] if single else values

    def predict(self, observations: Any, action_mask: Any = None, memory: Any = None, **elsewhere: Any) -> Any:
        """The greedy action, ready for ``env.step``: of one observation a whole number, of n ``[n]`` int64.

        It is always greedy, and comes alone; ``deterministic`` and the second result of other libraries there are not.
        Arguments and errors as for `values`.

        Raises:
            TypeError: for arguments of theirs, with what to write.
        """
        if elsewhere:
            raise TypeError(f"predict takes no {next(iter(elsewhere))}; {_ALONE}")
        values = self.values(observations, action_mask, memory)
        action, _ = choose_greedy(torch.from_numpy(values if values.ndim == 2 else values[None]))
        chosen = action.numpy() + self.first_action
        return chosen if values.ndim == 2 else _Action(chosen[0])

    def __call__(self, observations: Any, action_mask: Any = None, memory: Any = None) -> Any:
        """As `predict`."""
        return self.predict(observations, action_mask, memory)
