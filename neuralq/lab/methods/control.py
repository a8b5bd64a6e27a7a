"""Control: what is backed up, or even what is visited, depends on the greedy action of the weights themselves.

    Q-learning   w += α (r + γ max_a q(s', a) − q(s, a)) x            visits stay those of the behaviour
    Sarsa        w += α (r + γ q(s', a') − q(s, a)) x                 a and a' are ε-greedy in w, visits are its own

While the greedy actions stay, both are linear: A_g = Xᵀ D (I − γP_g) X with the chain, and for Sarsa also the visits D,
of the policy g. So the expected update is piecewise affine, and the piece returned is that of the θ it was asked for. A
piece that is unstable matters only where a run stays in its region; pieces whose fixed points all lie in another's
region leave no policy to converge to, and the weights slide along the border between them: chattering (Gordon 1996).

Sarsa visits what its own policy visits, which no fixed behaviour can sample. Its learner therefore weighs each
transition by d_g(s, a) / D(s, a), with the exact visits d_g of the present policy, and its next action by
π_g(a'|s') / μ(a'|s'): for independent draws the mean is the on-policy one exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from neuralq.lab.linear.process import Process
from neuralq.lab.linear.sampling import SampledTransition
from neuralq.lab.methods.chains import chain_of, epsilon_greedy, greedy_values, pairs_of, visits_of
from neuralq.lab.methods.record import Expected, Method, Option, Options, Piece
from neuralq.types import Floats, Indices

__all__ = ["Q_LEARNING", "SARSA", "piece_of_policy"]

REMEMBERED_POLICIES = 256
"""Greedy policies whose matrices are kept; a run meets few."""


def piece_of_policy(process: Process, policy: Floats, on_policy: bool = False) -> tuple[Floats, Floats]:
    """A_g and b_g of the expected update w += α (b_g − A_g w) while the policy is g.

    Args:
        process: of pairs.
        policy: g as probabilities, ``[S, A]``.
        on_policy: whether updates are made where g itself goes (Sarsa) instead of where the behaviour goes.

    Raises:
        ValueError: rows are states, or g has several long-run distributions.

    Source: Gordon 2000; Tsitsiklis & Van Roy 1997.

    Example:
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq_envs.counterexamples.chattering import chattering
        >>> process = linear_process(chattering())  # one state, two actions with the features 1 and 2
        >>> A, b = piece_of_policy(process, np.array([[0.95, 0.05]]), on_policy=True)
        >>> A.round(12).tolist(), b.round(12).tolist()  # .95 · 1 + .05 · 4, .95 · 1 · 1 − .05 · 2 · 1
        ([[1.15]], [0.85])
    """
    row_of = pairs_of(process, "control")
    D = visits_of(process, row_of, policy) if on_policy else process.D
    back = D[:, None] * process.X
    A = back.T @ (process.X - process.gamma * (chain_of(process, row_of, policy) @ process.X))
    return A, back.T @ process.r


class _QLearning:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()
        self._row_of = pairs_of(process, "q-learning")
        self._X, self._state = process.X, process.state

    def update(self, sample: SampledTransition, step_size: float) -> None:
        rows = self._row_of[self._state[sample.next_row]]
        values = np.einsum("nad,nd->na", self._X[rows], self.theta)
        best = np.where(rows >= 0, values, -np.inf).max(axis=1)
        target = sample.reward + sample.discount * best  # discount 0 at an end, where the state was a wrong one
        error = target - np.einsum("nd,nd->n", self.theta, sample.x)
        self.theta += step_size * error[:, None] * sample.x


class _Sarsa:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()
        self._row_of = row_of = pairs_of(process, "sarsa")
        self._process, self._epsilon = process, options["epsilon"]
        s, a = np.nonzero(row_of >= 0)
        self._mu = np.empty(process.num_rows)
        self._mu[row_of[s, a]] = process.behaviour_policy[s, a]
        if (self._mu == 0).any() or (process.D == 0).any():
            raise ValueError(
                "the samples of sarsa are weighted by how often its own policy visits each pair, but the behaviour "
                "leaves some out; give a behaviour policy and a state distribution that reach every pair"
            )
        _, self._visits = _pieces(process, row_of, self._epsilon)

    def update(self, sample: SampledTransition, step_size: float) -> None:
        best = greedy_values(self._process, self._row_of, self.theta).argmax(axis=-1)
        greedy, which = np.unique(best, axis=0, return_inverse=True)
        policy = np.empty((len(greedy), self._process.num_rows))
        weight = np.empty_like(policy)
        for k, actions in enumerate(greedy):
            table = epsilon_greedy(self._row_of, actions, self._epsilon)
            s, a = np.nonzero(self._row_of >= 0)
            policy[k, self._row_of[s, a]] = table[s, a]
            weight[k] = self._visits(actions.tobytes()) / self._process.D
        which = which.reshape(-1)
        ratio = np.where(sample.next_row < 0, 1.0, (policy / self._mu)[which, sample.next_row])
        ahead = sample.discount * ratio * np.einsum("nd,nd->n", self.theta, sample.x_next)
        error = sample.reward + ahead - np.einsum("nd,nd->n", self.theta, sample.x)
        self.theta += (step_size * weight[which, sample.row] * error)[:, None] * sample.x


def _pieces(
    process: Process, row_of: Indices, epsilon: float | None
) -> tuple[Callable[[bytes], tuple[Floats, Floats]], Callable[[bytes], Floats]]:
    """What greedy actions, as bytes, lead to: A and b, and how often their own policy visits each row; remembered."""

    def policy(actions: bytes) -> Floats:
        return epsilon_greedy(row_of, np.frombuffer(actions, dtype=np.int64), epsilon or 0.0)

    @lru_cache(maxsize=REMEMBERED_POLICIES)
    def operators(actions: bytes) -> tuple[Floats, Floats]:
        return piece_of_policy(process, policy(actions), on_policy=epsilon is not None)

    @lru_cache(maxsize=REMEMBERED_POLICIES)
    def visits(actions: bytes) -> Floats:
        return visits_of(process, row_of, policy(actions))

    return operators, visits


def _piecewise(process: Process, name: str, epsilon: float | None) -> Expected:
    row_of, d = pairs_of(process, name), process.num_weights
    operators, _ = _pieces(process, row_of, epsilon)

    def at(theta: Floats, step_size: float) -> Piece:
        A, b = operators(greedy_values(process, row_of, theta).argmax(axis=-1).tobytes())
        return np.eye(d) - step_size * A, step_size * b

    return Expected(d, at, linear=False)


def _expected_q_learning(process: Process, options: Options) -> Expected:
    return _piecewise(process, "q-learning", None)


def _expected_sarsa(process: Process, options: Options) -> Expected:
    return _piecewise(process, "sarsa", options["epsilon"])


Q_LEARNING = Method(
    "q-learning", "Q-learning", "Watkins 1989; Baird 1995", {}, _expected_q_learning, _QLearning, rows="pairs",
    note="piecewise linear: an unstable piece matters only where a run stays in its region", place=90,
)  # fmt: skip
SARSA = Method(
    "sarsa", "Sarsa(0), ε-greedy", "Rummery & Niranjan 1994; Gordon 1996, 2000",
    {"epsilon": Option(0.1, 0.0, 1.0, "ε, exploration")}, _expected_sarsa, _Sarsa, rows="pairs",
    note="updates what its own ε-greedy policy visits, whatever the behaviour; bounded, but it may chatter", place=91,
)  # fmt: skip
