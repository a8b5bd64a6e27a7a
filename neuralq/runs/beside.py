"""The exact answer beside what is learned, wherever an environment has a model.

The model is solved once (`neuralq.exact`), at the first evaluation; then the learned action values of all states are
held against Q*, and the greedy policy is evaluated exactly. Nothing here is random, and nothing that learns is written
to: a run ends with the same bits with and without it. A model whose steps are not those of its environment is left out
with the reason, and so is one that is too large to be solved within about a second, unless it is asked for.

Q* is that of the model and of the run's γ, whatever the learner aims at: what Sarsa learns while it explores, or what a
regularised learner learns, differs from it by as much as it should.
"""

from __future__ import annotations

import copy
import inspect
import math
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Discrete
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor

from neuralq.mdp import FiniteMDP
from neuralq.mdp.grid import grid_plan
from neuralq.runs.held import Answer, Comparison, Held
from neuralq.runs.stream import ObservationSpec
from neuralq.runs.stream.vector_env import SubEnv
from neuralq.types import Floats

if TYPE_CHECKING:
    from neuralq.exact import Solution

__all__ = ["Beside"]

_MOST_PAIRS = 200_000  # a model of more is not built unasked: that alone would take a second
_SMALL_ROWS = 20_000  # up to here every method needs well under a second
_MOST_SECONDS = 1.0
_NUM_STARTS = 200  # resets that tell where episodes begin, where no distribution is stated
_ENTRIES = 4_000_000  # of one-hot vectors at a time
_RARELY = 20.0  # a comparison may cost a twentieth of the CPU time of the run
_ASK = "--exact true asks for it"


class Beside:
    """Which states and actions a run has met, and the exact answer that its values are held against.

    Args:
        envs: those of the run; they are read, and stepped in copies only.
        spec: of their observations.
        gamma: γ.
        asked: True to solve a model of any size, and refuse where there is none to solve.

    Raises:
        ValueError: the exact answer was asked for and cannot be given; says why.
    """

    def __init__(
        self, envs: VectorEnv[Any, Any, Any], spec: ObservationSpec, gamma: float, asked: bool | None = None
    ) -> None:
        self._envs, self._spec, self._gamma, self._asked = envs, spec, gamma, asked
        self._answer: Answer | None = None
        self._looked = False
        self._due = -math.inf
        self.visited: NDArray[np.bool_] | None = None
        """Which actions were taken in which states, ``[S, A]``; None where it is not known."""
        self._masks: NDArray[np.bool_] | None = None
        if asked:
            self.look()

    @classmethod
    def of(
        cls, envs: VectorEnv[Any, Any, Any], spec: ObservationSpec, gamma: float, asked: bool | None = None
    ) -> Beside | None:
        """What compares for these environments; None where there is no model, or it is not wanted (``asked=False``).

        Raises:
            ValueError: the exact answer was asked for and cannot be given; says why.
        """
        if asked and spec.memory_size:
            raise ValueError(
                "exact=True compares the values of states, and an agent with a memory values what it remembers; leave "
                "exact out"
            )
        if spec.memory_size:
            return None
        if asked is False or (asked is None and (spec.num_categories is None or _with_model(envs) is None)):
            return None
        return cls(envs, spec, gamma, asked)

    def watch(self) -> None:
        """From now on `see` is told what happens."""
        shape = self._spec.num_categories or 0, self._spec.num_actions
        if self.visited is None and (self._asked or np.prod(shape) <= _MOST_PAIRS):
            self.visited = np.zeros(shape, bool)
            if self._spec.masked:
                self._masks = np.ones(shape, bool)

    def see(self, s: NDArray[Any], a: NDArray[np.int64]) -> None:
        """Take in encoded states ``[k]``, or ``[k, 1 + A]`` with a mask, and the actions taken there ``[k]``."""
        if self.visited is None:
            return
        if self._masks is not None:
            index = s[:, 0]
            self._masks[index] = s[:, 1:] != 0
            s = index
        self.visited[s, a] = True

    def look(self) -> str | None:
        """Solve the model if that has not been tried; a line on what came of it, the first time.

        Raises:
            ValueError: the exact answer was asked for and cannot be given.
        """
        if self._looked:
            return None
        self._looked = True
        try:
            self._answer = _solved(self._envs, self._spec, self._gamma, bool(self._asked))
        except ValueError as error:
            if self._asked:
                raise ValueError(f"exact=True, but there is no exact answer: {error}; leave exact out") from error
            return f"the exact answer is left out: {error}"
        return self._answer.line()

    def columns(self, values: Callable[[Tensor], Tensor], scale: float) -> dict[str, Any]:
        """Columns of an evaluation, none where there is no answer, or where they would cost too much of the run."""
        began = time.process_time()
        if began < self._due:
            return {}
        found = self.compare(values, scale)
        self._due = time.process_time() + _RARELY * (time.process_time() - began)
        return {} if found is None else found.plain()

    def compare(self, values: Callable[[Tensor], Tensor], scale: float) -> Comparison | None:
        """Learned values beside the exact ones; None where there is no answer.

        Args:
            values: encoded observations ``[N, …]`` to action values ``[N, A]``, as the learner counts.
            scale: by what its values are larger than returns.
        """
        held = self.held(values, scale)
        return None if held is None else held.compared()

    def held(self, values: Callable[[Tensor], Tensor], scale: float) -> Held | None:
        """Learned values of all states, held against the exact ones; None where there is no answer.

        Args:
            values: as for `compare`.
            scale: likewise.
        """
        self.look()
        if self._answer is None:
            return None
        mdp = self._answer.mdp
        legal = mdp.legal & self._answer.alive[:, None]
        if self._masks is not None:
            legal &= self._masks
        index = np.arange(mdp.num_states)
        s = index if not self._spec.masked else np.concatenate([index[:, None], mdp.legal.astype(np.int64)], axis=1)
        few = max(1, _ENTRIES // mdp.num_states)
        with torch.no_grad():
            parts = [values(torch.from_numpy(s[at : at + few])).cpu().numpy() for at in range(0, len(s), few)]
        return Held(self._answer, np.concatenate(parts).astype(np.float64) / scale, legal, self.visited)

    def state_dict(self) -> dict[str, Any] | None:
        """What was met, in bits; None where it is not watched."""
        if self.visited is None:
            return None
        masks = None if self._masks is None else np.packbits(self._masks)
        return {"visited": np.packbits(self.visited), "masks": masks}

    def load_state_dict(self, state: Mapping[str, Any] | None) -> None:
        """Continue from `state_dict`; nothing has been met where it was not watched."""
        self.watch()
        if state is None or self.visited is None:
            return
        for name, mine in (("visited", self.visited), ("masks", self._masks)):
            if mine is not None and state.get(name) is not None:
                bits = np.unpackbits(np.asarray(state[name], np.uint8), count=mine.size)
                mine[:] = bits.reshape(mine.shape) != 0


def _with_model(envs: VectorEnv[Any, Any, Any]) -> Any:
    """What has the model: the vector environment itself, or the first of those that it steps; None where nothing has.

    Our own frame around each of them is taken off: it changes nothing.
    """
    inner = envs.unwrapped
    if callable(getattr(inner, "mdp", None)):
        return inner
    if not getattr(inner, "envs", None):
        return None
    env = inner.envs[0]  # type: ignore[attr-defined]
    while isinstance(env, SubEnv):
        env = env.env
    has = callable(getattr(env.unwrapped, "mdp", None)) or getattr(env.unwrapped, "P", None) is not None
    return env if has else None


def _solved(envs: VectorEnv[Any, Any, Any], spec: ObservationSpec, gamma: float, asked: bool) -> Answer:
    """The answer.

    Raises:
        ValueError: there is none, with the reason.
    """
    env = _with_model(envs)
    if env is None:
        raise ValueError("the environment has no model (a transition table P, or a method mdp())")
    pairs = (spec.num_categories or 0) * spec.num_actions
    if pairs > _MOST_PAIRS and not asked:
        raise ValueError(f"{pairs:,} pairs of states and actions are not solved within a second; {_ASK}")
    single = isinstance(env, gym.Env)
    made = getattr(env.unwrapped, "mdp", None)
    if callable(made) and inspect.signature(made).parameters:
        raise ValueError("the environment changes with time, and has no one model")
    mdp = FiniteMDP.from_gymnasium(env) if single else env.mdp()
    _require_states(mdp, envs, spec)
    solution = _solve(mdp, gamma, asked)
    start = _start_of(env, mdp) if single else mdp.start_distribution
    plan = grid_plan(env.unwrapped, mdp)
    limit = env.spec.max_episode_steps if single and env.spec is not None else None
    return Answer(mdp, gamma, solution, start, _alive(mdp, start), plan, limit)


def _require_states(mdp: FiniteMDP, envs: VectorEnv[Any, Any, Any], spec: ObservationSpec) -> None:
    """What is observed must be the number of a state of the model, and what is done that of an action."""
    for what, space, size in (
        ("observations", envs.single_observation_space, mdp.num_states),
        ("actions", envs.single_action_space, mdp.num_actions),
    ):
        if not isinstance(space, Discrete) or space.start != 0 or space.n != size:
            raise ValueError(f"its {what} are {space}, and not the numbers 0..{size - 1} of its model")
    if spec.num_categories != mdp.num_states:
        raise ValueError(f"the run sees {spec.num_categories} states, its model has {mdp.num_states}")


def _solve(mdp: FiniteMDP, gamma: float, asked: bool) -> Solution:
    from neuralq.exact import solve  # half a second of SciPy and kernels, for whom it is of use

    limit: int | None = None
    if mdp.num_rows > _SMALL_ROWS and not asked:
        tried = solve(mdp, gamma, max_iterations=2)
        limit = max(2, int(2 * _MOST_SECONDS / max(tried.seconds, 1e-6)))
    solution = solve(mdp, gamma, max_iterations=limit)
    if not solution.converged:
        if limit is not None:
            raise ValueError(f"{mdp.num_rows:,} pairs of states and actions are not solved within a second; {_ASK}")
        raise ValueError(f"with γ={gamma:g} its values are proven to {solution.bound:.2g} only; a γ below 1 helps")
    return solution


def _alive(mdp: FiniteMDP, start: Floats) -> NDArray[np.bool_]:
    """States with an action that an episode can reach, ``[S]``."""
    leads_to = sparse.csr_array(
        ((mdp.transition.data > 0).astype(np.float64), (mdp.s_tm1[_row_of(mdp)], mdp.transition.indices)),
        shape=(mdp.num_states, mdp.num_states),
    )
    found = frontier = start > 0
    while frontier.any():
        frontier = (leads_to.T @ frontier.astype(np.float64) > 0) & ~found
        found = found | frontier
    return np.asarray(found & ~mdp.is_terminal)


def _row_of(mdp: FiniteMDP) -> NDArray[np.int64]:
    """The row of each entry of the transition matrix."""
    return np.repeat(np.arange(mdp.num_rows), np.diff(mdp.transition.indptr))


def _start_of(env: gym.Env[Any, Any], mdp: FiniteMDP) -> Floats:
    """Where episodes begin, ``[S]``: as the environment states it, else as a copy of it does when it is reset."""
    inner = env.unwrapped
    if callable(getattr(inner, "mdp", None)) or getattr(inner, "initial_state_distrib", None) is not None:
        return mdp.start_distribution
    try:
        twin = copy.deepcopy(env)
        twin.reset(seed=0)
        first = np.array([int(twin.reset()[0]) for _ in range(_NUM_STARTS)])
    except Exception:  # whatever a foreign environment cannot copy: then as its model takes it, anywhere alike
        return mdp.start_distribution
    return np.bincount(first, minlength=mdp.num_states) / _NUM_STARTS
