"""What decides whether learning with function approximation converges, in one frozen object.

A model says what can happen, features say what the learner sees, a target policy says whose values are wanted, a
behaviour policy says what is tried, and a state distribution says how often each state is updated. Together with γ, λ
and a step size nothing else matters to the expected update.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_discount, check_fraction, check_positive
from neuralq.mdp import FiniteMDP
from neuralq.types import Floats
from neuralq_envs.counterexamples.chains import stationary_distribution

__all__ = ["ParametricValue", "Problem"]


class ParametricValue(Protocol):
    """A value function that is not linear in its parameters: V(θ) of every state, with two derivatives."""

    def values(self, theta: Floats) -> Floats:
        """V(s) of every state, ``[d] -> [S]``."""
        ...

    def jacobian(self, theta: Floats) -> Floats:
        """∂V(s)/∂θ, ``[d] -> [S, d]``."""
        ...

    def hessian(self, theta: Floats) -> Floats:
        """∂²V(s)/∂θ², ``[d] -> [S, d, d]``."""
        ...


@dataclass(frozen=True, eq=False)
class Problem:
    """A model, features, two policies and an update distribution: all that decides whether learning converges.

    Args:
        name: one word that commands and files use, such as ``"baird"``.
        mdp: the model.
        features: X, one row per state, ``[S, d]``; or one per state and action, ``[S, A, d]``, to learn Q. Terminal
            states have rows of 0, for their value is 0.
        target_policy: π, whose values are learned, ``[S, A]``. Rows of terminal states do not matter.
        behaviour_policy: μ, which chooses the actions, ``[S, A]``.
        state_distribution: how often each state is updated, ``[S]``.
        initial_weights: where learning starts, ``[d]``.
        gamma: γ.
        step_size: α of the published experiment, or one that suits the problem.
        title: how people call it.
        source: author and year.
        known: what is known of it, in a sentence or two.
        control: whether the target policy is greedy in the learned Q instead of ``target_policy``.
        exploration: ε; where ``control`` is on-policy (Sarsa) the behaviour is ε-greedy in the learned Q. None: the
            behaviour policy is the one given, whatever is learned.
        value: a value function that is not linear in its parameters, instead of X w; ``features`` are then its Jacobian
            at ``initial_weights``.

    Raises:
        ValueError: shapes that do not fit the model, distributions that do not sum to 1, features at a terminal state,
            or a behaviour policy that never takes an action the target takes.

    Example:
        >>> mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 1.0]]], [[0.0], [0.0]])
        >>> Problem.from_mdp(mdp, [[1.0], [2.0]], gamma=0.9, state_distribution=[0.5, 0.5]).num_weights
        1
    """

    name: str
    mdp: FiniteMDP
    features: Floats
    target_policy: Floats
    behaviour_policy: Floats
    state_distribution: Floats
    initial_weights: Floats
    gamma: float
    step_size: float
    title: str = ""
    source: str = ""
    known: str = ""
    control: bool = False
    exploration: float | None = None
    value: ParametricValue | None = None

    def __post_init__(self) -> None:
        check_discount("gamma", self.gamma)
        check_positive("step_size", self.step_size)
        if self.exploration is not None:
            check_fraction("exploration", self.exploration)
        for field in ("features", "target_policy", "behaviour_policy", "state_distribution", "initial_weights"):
            array = np.array(getattr(self, field), dtype=np.float64)
            array.flags.writeable = False
            object.__setattr__(self, field, array)
        self._check_shapes()
        self._check_numbers()

    def _check_shapes(self) -> None:
        pairs = (self.mdp.num_states, self.mdp.num_actions)
        if self.features.ndim not in (2, 3):
            raise ValueError(f"features must be [S, d] or [S, A, d], got shape {self.features.shape}")
        expected = {
            "features": (*pairs[: self.features.ndim - 1], self.features.shape[-1]),
            "target_policy": pairs,
            "behaviour_policy": pairs,
            "state_distribution": pairs[:1],
            "initial_weights": self.features.shape[-1:],
        }
        for field, shape in expected.items():
            if getattr(self, field).shape != shape:
                raise ValueError(f"{field} must have shape {shape}, got {getattr(self, field).shape}")
        if (self.control or self.exploration is not None) and not self.learns_q:
            raise ValueError("control needs features of state-action pairs, [S, A, d], got one row per state")

    def _check_numbers(self) -> None:
        active, legal = ~self.mdp.is_terminal, self.mdp.legal
        for field in ("features", "initial_weights"):
            if not np.isfinite(getattr(self, field)).all():
                raise ValueError(f"{field} must be finite, got NaN or infinity")
        for field in ("target_policy", "behaviour_policy"):
            policy = getattr(self, field)
            bad = np.argwhere(~(np.where(legal, policy >= 0, policy == 0)) & active[:, None])
            if bad.size:
                s, a = bad[0]
                raise ValueError(
                    f"{field}[{s}, {a}] must be a probability of a legal action (or 0), got {policy[s, a]}"
                )
            off = np.flatnonzero(active & (np.abs(np.where(legal, policy, 0.0).sum(axis=1) - 1) > 1e-9))
            if off.size:
                raise ValueError(f"{field} in {self.mdp.state_name(off[0])} must sum to 1, got {policy[off[0]].sum()}")
        d = self.state_distribution
        bad_states = np.flatnonzero(~(d >= 0) | (~active & (d != 0)))
        if bad_states.size:
            s = bad_states[0]
            raise ValueError(f"state_distribution[{s}] must be at least 0 (and 0 at a terminal state), got {d[s]}")
        if abs(d.sum() - 1) > 1e-9:
            raise ValueError(f"state_distribution must sum to 1, got {d.sum()}")
        seen = np.flatnonzero(~active & (self.features.reshape(len(d), -1) != 0).any(axis=1))
        if seen.size:
            raise ValueError(
                f"features of the terminal {self.mdp.state_name(seen[0])} must be 0, for its value is 0 by definition; "
                "a nonzero row would be bootstrapped from and never updated"
            )
        uncovered = np.argwhere((self.behaviour_policy == 0) & (self.target_policy > 0) & legal)
        if uncovered.size and not self.learns_q:  # values of pairs need no ratio for their own action
            s, a = uncovered[0]
            raise ValueError(f"the behaviour policy never takes action {a} in state {s}, which the target policy takes")

    @property
    def learns_q(self) -> bool:
        """Whether features are those of state-action pairs."""
        return self.features.ndim == 3

    @property
    def num_weights(self) -> int:
        """D."""
        return int(self.features.shape[-1])

    @property
    def importance_ratio(self) -> Floats:
        """ρ = π / μ, ``[S, A]``; 0 where the target policy never goes."""
        covered = self.behaviour_policy > 0
        return np.where(covered, self.target_policy / np.where(covered, self.behaviour_policy, 1.0), 0.0)

    @classmethod
    def from_mdp(
        cls,
        mdp: FiniteMDP,
        features: ArrayLike,
        *,
        gamma: float,
        target_policy: ArrayLike | None = None,
        behaviour_policy: ArrayLike | None = None,
        state_distribution: ArrayLike | None = None,
        initial_weights: ArrayLike | None = None,
        step_size: float = 0.1,
        name: str = "mine",
        title: str = "",
        source: str = "",
        known: str = "",
    ) -> Problem:
        """A model and features make a problem; the rest has defaults.

        Args:
            mdp: the model.
            features: ``[S, d]`` or ``[S, A, d]``; rows of terminal states are set to 0.
            gamma: γ in [0, 1].
            target_policy: π as actions ``[S]`` or probabilities ``[S, A]``; default: uniform over legal actions.
            behaviour_policy: μ likewise; default: the target policy.
            state_distribution: ``[S]``; default: how often μ visits each state in the long run, episodes starting
                again from the model's start distribution.
            initial_weights: ``[d]``; default ones, so that growth shows even where every reward is 0.
            step_size: α.
            name: one word.
            title: how people call it.
            source: author and year.
            known: what is known of it.

        Raises:
            ValueError: what `Problem` refuses, or μ has more than one long-run distribution.

        Example:
            >>> walk = FiniteMDP.from_functions(3, 1, lambda s: [0], lambda s, a: [(1.0, (s + 1) % 3, 1.0, s == 2)])
            >>> Problem.from_mdp(walk, np.eye(3), gamma=1.0).state_distribution.round(3).tolist()
            [0.167, 0.333, 0.5]
        """
        table = np.array(features, dtype=np.float64)
        if table.ndim in (2, 3) and len(table) == mdp.num_states:
            table[mdp.is_terminal] = 0.0
        pi = _probabilities(mdp, target_policy)
        mu = pi if behaviour_policy is None else _probabilities(mdp, behaviour_policy)
        d = stationary_distribution(mdp, mu) if state_distribution is None else np.asarray(state_distribution)
        weights = np.ones(table.shape[-1:]) if initial_weights is None else np.asarray(initial_weights)
        return cls(
            name, mdp, table, pi, mu, d, weights, gamma, step_size, title or name, source, known
        )  # fmt: skip

    @classmethod
    def from_gymnasium(cls, env: str | gymnasium.Env[Any, Any], features: ArrayLike, *, gamma: float = 0.99) -> Problem:
        """The model inside a Gymnasium environment, with your features and uniformly random actions.

        Use `from_mdp` with ``FiniteMDP.from_gymnasium(env)`` for other policies and distributions.

        Raises:
            ValueError: the environment has no transition table, or what `Problem` refuses.

        Example:
            >>> problem = Problem.from_gymnasium("FrozenLake-v1", np.ones((16, 1)))
            >>> problem.name, problem.mdp.num_states
            ('FrozenLake-v1', 16)
        """
        made = gymnasium.make(env) if isinstance(env, str) else env
        try:
            mdp = FiniteMDP.from_gymnasium(made)
        finally:
            if isinstance(env, str):
                made.close()
        spec = made.spec
        return cls.from_mdp(mdp, features, gamma=gamma, name=spec.id if spec is not None else type(made).__name__)


def _probabilities(mdp: FiniteMDP, policy: ArrayLike | None) -> Floats:
    """A policy as probabilities ``[S, A]``."""
    legal = mdp.legal
    if policy is None:
        uniform: Floats = legal / np.maximum(legal.sum(axis=1, keepdims=True), 1)
        return uniform
    given: NDArray[Any] = np.asarray(policy)
    if given.ndim == 1:
        table = np.zeros(legal.shape)
        active = np.flatnonzero(~mdp.is_terminal)
        if len(given) != mdp.num_states or np.min(given[active]) < 0 or np.max(given[active]) >= mdp.num_actions:
            raise ValueError(f"a policy of actions must be [S] with actions in 0..{mdp.num_actions - 1}, got {given}")
        table[active, given[active].astype(np.int64)] = 1.0
        return table
    return np.asarray(given, dtype=np.float64)
