"""Off-policy learning over several steps: n-step TD, V-trace, and the traces of action values.

n-step TD waits until n transitions followed a row, then moves it towards their return, weighted by the product of all n
ratios (not decision by decision; the mean is the same):

    w += α (Π ρ) (G_{t:t+n} − w·x_t) x_t,     A_n = Xᵀ D (I − (γP)ⁿ) X

V-trace clips ratios, in the error (ρ̄: this moves the fixed point, to the values of a policy between μ and π) and in the
trace (c̄: this changes only the speed):

    w += α min(ρ̄, ρ) δ z,  z = γ c_{t−1} z + x,  c = λ min(c̄, ρ);     A = Xᵀ D (I − γP_c)⁻¹ (K − γP_ρ) X

with P_c = Σ_a μ c P, P_ρ = Σ_a μ min(ρ̄, ρ) P and K the diagonal of Σ_a μ min(ρ̄, ρ).

Over pairs these back up the target's expectation, δ = r + γ Σ_a π(a|s') q(s', a) − q(s, a), along a trace cut by a
coefficient of the pair that was entered, z = γ c(s, a) z + x, and share the operator

    A = Xᵀ D (I − γP_c)⁻¹ (I − γP) X,   P_c(s, a → s', a') = p(s'|s, a) μ(a'|s') c(s', a')

    Sarsa(λ)  λρ      tree backup(λ)  λπ(a|s)      Retrace(λ)  λ min(1, ρ)      naive Q(λ)  λ
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse

from neuralq.checks import check_fraction, check_positive, check_whole
from neuralq.lab.linear.process import LARGEST_DENSE, Arcs, Process
from neuralq.lab.linear.sampling import Sample
from neuralq.lab.methods.chains import pairs_of, solve_chain
from neuralq.lab.methods.method import Expected, Learner, Method, Options, flow
from neuralq.lab.methods.td import errors
from neuralq.types import Floats

__all__ = ["EXPECTED_SARSA", "NAIVE_Q", "NSTEP", "RETRACE", "TREE_BACKUP", "VTRACE"]


class _NStep:
    """Rows wait in a ring of n slots per seed. At an end those still waiting are updated in turn, the oldest first."""

    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()
        check_whole("num_steps", options["num_steps"])  # type: ignore[arg-type]
        self._n = n = int(options["num_steps"])
        num_seeds, d = w0.shape
        self._x = np.zeros((num_seeds, n, d))
        self._return = np.zeros((num_seeds, n))
        self._ratio = np.zeros((num_seeds, n))
        self._discount = np.zeros((num_seeds, n))
        self._waits = np.zeros((num_seeds, n), dtype=bool)
        self._age = 0

    def update(self, sample: Sample, step_size: float) -> None:
        if (sample.begins[:, None] & self._waits).any():
            raise ValueError(
                "n-step TD needs transitions that follow one another: an episode began while rows of the last one were "
                "waiting; sample a chain (sampling 'markov'), or use num_steps=1"
            )
        new = self._age % self._n
        self._x[:, new], self._waits[:, new] = sample.x, True
        self._return[:, new], self._ratio[:, new], self._discount[:, new] = 0.0, 1.0, 1.0
        self._return += self._discount * sample.reward[:, None]
        self._ratio *= sample.rho[:, None]
        self._discount *= sample.discount[:, None]
        self._age += 1
        ended = sample.next_row < 0
        for ahead in range(self._n if ended.any() else 1):
            slot = (self._age + ahead) % self._n  # the next to be overwritten is the oldest
            full = self._age >= self._n if ahead == 0 else False
            self._learn(slot, (ended | full) & self._waits[:, slot], sample, step_size)

    def _learn(self, slot: int, ready: np.ndarray, sample: Sample, step_size: float) -> None:
        x = self._x[:, slot]
        target = self._return[:, slot] + self._discount[:, slot] * np.einsum("nd,nd->n", self.theta, sample.x_next)
        error = ready * self._ratio[:, slot] * (target - np.einsum("nd,nd->n", self.theta, x))
        self.theta += step_size * error[:, None] * x
        self._waits[ready, slot] = False


class _VTrace:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()
        _check_bars(options)
        self._z = np.zeros_like(w0)
        self._decay = np.zeros(len(w0))
        self._lambda, self._rho_bar, self._c_bar = options["lambda_"], options["rho_bar"], options["c_bar"]

    def update(self, sample: Sample, step_size: float) -> None:
        decay = np.where(sample.begins, 0.0, self._decay)
        self._z = decay[:, None] * self._z + sample.x
        weight = np.minimum(self._rho_bar, sample.rho) * errors(self.theta, sample)
        self.theta += step_size * weight[:, None] * self._z
        self._decay = sample.discount * self._lambda * np.minimum(self._c_bar, sample.rho)


class _PairTrace:
    """Expected backups along a trace; ``cut`` is c(s, a) of every row, ``[n]``."""

    def __init__(self, process: Process, w0: Floats, cut: Floats) -> None:
        self.theta = w0.copy()
        self._cut, self._state = cut, process.state
        self._z = np.zeros_like(w0)
        self._decay = np.zeros(len(w0))
        weight = process.target_policy[process.pairs[:, 0], process.pairs[:, 1]]  # type: ignore[index]
        choose = sparse.csr_array(
            (weight, (process.state, np.arange(process.num_rows))), shape=(len(process.target_policy), process.num_rows)
        )
        self._mean = choose @ process.X  # what the target expects to see in each state

    def update(self, sample: Sample, step_size: float) -> None:
        decay = np.where(sample.begins, 0.0, self._decay)
        self._z = decay[:, None] * self._z + sample.x
        change = sample.discount[:, None] * self._mean[self._state[sample.next_row]] - sample.x  # discount 0 at an end
        delta = sample.reward + np.einsum("nd,nd->n", self.theta, change)
        self.theta += step_size * delta[:, None] * self._z
        self._decay = sample.discount * self._cut[sample.next_row]


def _check_bars(options: Options) -> None:
    check_fraction("lambda_", options["lambda_"])
    for name in ("rho_bar", "c_bar"):
        check_positive(name, options[name])


def _expected_nstep(process: Process, options: Options) -> Expected:
    check_whole("num_steps", options["num_steps"])  # type: ignore[arg-type]
    ahead, total = process.X, np.zeros(process.num_rows)
    for _ in range(int(options["num_steps"])):  # by Horner: r + γP(r + γP(...)), and (γP)ⁿ X
        ahead = process.gamma * (process.P @ ahead)
        total = process.r + process.gamma * (process.P @ total)
    back = process.D[:, None] * process.X
    return flow(back.T @ (process.X - ahead), back.T @ total)


def _expected_vtrace(process: Process, options: Options) -> Expected:
    _check_bars(options)
    arcs, X = process.arcs, process.X
    error = arcs.probability * np.minimum(options["rho_bar"], arcs.rho)
    trace = arcs.probability * options["lambda_"] * np.minimum(options["c_bar"], arcs.rho)
    weight, reward = (
        np.bincount(arcs.row, weights=one, minlength=process.num_rows) for one in (error, error * arcs.reward)
    )
    bootstrap = process.gamma * (_chain(arcs, error, process.num_rows) @ X)
    ahead = np.column_stack([weight[:, None] * X - bootstrap, reward])
    traced = solve_chain(_chain(arcs, trace, process.num_rows), process.gamma, ahead)
    both = X.T @ (process.D[:, None] * traced)
    return flow(both[:, :-1], both[:, -1])


def _chain(arcs: Arcs, weight: Floats, n: int) -> Floats | sparse.csr_array:
    """Weights of arcs as a matrix from row to row."""
    inside = arcs.next_row >= 0
    entries = (weight[inside], (arcs.row[inside], arcs.next_row[inside]))
    chain = sparse.csr_array(sparse.coo_array(entries, shape=(n, n)))
    return chain.toarray() if n <= LARGEST_DENSE else chain


Cut = Callable[[Floats, Floats], Floats]  # (π, μ) of every row -> c / λ of every row


def _cut(process: Process, options: Options, name: str, cut: Cut) -> Floats:
    """c(s, a) of every row, ``[n]``; 0 where the behaviour never enters."""
    pairs_of(process, name)
    check_fraction("lambda_", options["lambda_"])
    s, a = process.pairs[:, 0], process.pairs[:, 1]  # type: ignore[index]
    mu = process.behaviour_policy[s, a]
    entered = np.where(mu > 0, mu, 1.0)
    c: Floats = np.where(mu > 0, options["lambda_"] * cut(process.target_policy[s, a], entered), 0.0)
    return c


def _pair_method(name: str, title: str, source: str, cut: Cut, note: str = "") -> Method:
    def expected(process: Process, options: Options) -> Expected:
        c = _cut(process, options, name, cut)
        P_c = process.P_mu * c if isinstance(process.P_mu, np.ndarray) else process.P_mu @ sparse.diags_array(c)
        ahead = np.column_stack([process.X - process.gamma * (process.P @ process.X), process.r])
        both = process.X.T @ (process.D[:, None] * solve_chain(P_c, process.gamma, ahead))
        return flow(both[:, :-1], both[:, -1])

    def learner(process: Process, w0: Floats, options: Options) -> Learner:
        return _PairTrace(process, w0, _cut(process, options, name, cut))

    return Method(
        name, title, source, {"lambda_": 0.0}, expected, learner, rows="pairs",
        remembers=lambda options: options["lambda_"] > 0, note=note,
    )  # fmt: skip


NSTEP = Method(
    "n-step", "n-step TD", "Sutton & Barto 2018, equations 7.9 and 7.11; Precup, Sutton & Singh 2000",
    {"num_steps": 4.0}, _expected_nstep, _NStep, remembers=lambda options: options["num_steps"] > 1,
    note="weights each return by the product of its ratios, whose variance grows with n",
)  # fmt: skip
VTRACE = Method(
    "v-trace", "V-trace", "Espeholt et al. 2018", {"lambda_": 1.0, "rho_bar": 1.0, "c_bar": 1.0},
    _expected_vtrace, _VTrace, remembers=lambda options: options["lambda_"] > 0,
    note="a rho_bar below the largest ratio moves the fixed point towards the behaviour's values",
)  # fmt: skip
EXPECTED_SARSA = _pair_method(
    "expected-sarsa", "expected Sarsa(λ), by importance", "van Seijen et al. 2009; Sutton & Barto 2018, section 12.8",
    lambda pi, mu: pi / mu,
)  # fmt: skip
TREE_BACKUP = _pair_method("tree-backup", "tree backup(λ)", "Precup, Sutton & Singh 2000", lambda pi, mu: pi)
RETRACE = _pair_method("retrace", "Retrace(λ)", "Munos et al. 2016", lambda pi, mu: np.minimum(1.0, pi / mu))
NAIVE_Q = _pair_method(
    "naive-q", "Q(λ) without cuts", "Harutyunyan et al. 2016", lambda pi, mu: np.ones_like(pi),
    note="a contraction only where λ is small against the distance between the policies, even for a table",
)  # fmt: skip
