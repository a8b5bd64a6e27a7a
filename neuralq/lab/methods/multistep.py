"""Off-policy learning over several steps: n-step TD and V-trace.

n-step TD waits until n transitions followed a row, then moves it towards their return, weighted by the product of all n
ratios (not decision by decision; the mean is the same):

    w += α (Π ρ) (G_{t:t+n} − w·x_t) x_t,     A_n = Xᵀ D (I − (γP)ⁿ) X

V-trace clips ratios, in the error (ρ̄: this moves the fixed point, to the values of a policy between μ and π) and in the
trace (c̄: this changes only the speed):

    w += α min(ρ̄, ρ) δ z,  z = γ c_{t−1} z + x,  c = λ min(c̄, ρ);     A = Xᵀ D (I − γP_c)⁻¹ (K − γP_ρ) X

with P_c = Σ_a μ c P, P_ρ = Σ_a μ min(ρ̄, ρ) P and K the diagonal of Σ_a μ min(ρ̄, ρ).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neuralq.lab.linear.process import Process
from neuralq.lab.linear.sampling import SampledTransition
from neuralq.lab.methods.operators import traced_flow
from neuralq.lab.methods.record import LAMBDA, LARGEST, Expected, Method, Option, Options, flow
from neuralq.lab.methods.trace import Trace, errors
from neuralq.types import Floats

__all__ = ["NSTEP", "VTRACE"]


class _NStep:
    """Rows wait in a ring of n slots per seed. At an end those still waiting are updated in turn, the oldest first."""

    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()
        self._n = n = int(options["num_steps"])
        num_seeds, d = w0.shape
        self._x = np.zeros((num_seeds, n, d))
        self._return = np.zeros((num_seeds, n))
        self._ratio = np.zeros((num_seeds, n))
        self._discount = np.zeros((num_seeds, n))
        self._waits = np.zeros((num_seeds, n), dtype=bool)
        self._age = 0

    def update(self, sample: SampledTransition, step_size: float) -> None:
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

    def _learn(self, slot: int, ready: np.ndarray, sample: SampledTransition, step_size: float) -> None:
        x = self._x[:, slot]
        target = self._return[:, slot] + self._discount[:, slot] * np.einsum("nd,nd->n", self.theta, sample.x_next)
        error = ready * self._ratio[:, slot] * (target - np.einsum("nd,nd->n", self.theta, x))
        self.theta += step_size * error[:, None] * x
        self._waits[ready, slot] = False


class _VTrace:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()
        self._trace = Trace(w0.shape, options["lambda_"])
        self._rho_bar, self._c_bar = options["rho_bar"], options["c_bar"]

    def update(self, sample: SampledTransition, step_size: float) -> None:
        z = self._trace.advance(sample, fade=np.minimum(self._c_bar, sample.rho))
        weight = np.minimum(self._rho_bar, sample.rho) * errors(self.theta, sample)
        self.theta += step_size * weight[:, None] * z


def _expected_nstep(process: Process, options: Options) -> Expected:
    further, total = process.X, np.zeros(process.num_rows)
    for _ in range(int(options["num_steps"])):  # by Horner: r + γP(r + γP(...)), and (γP)ⁿ X
        further = process.gamma * (process.P @ further)
        total = process.r + process.gamma * (process.P @ total)
    back = process.D[:, None] * process.X
    return flow(back.T @ (process.X - further), back.T @ total)


def _expected_vtrace(process: Process, options: Options) -> Expected:
    ways, X = process.transitions, process.X
    error = ways.probability * np.minimum(options["rho_bar"], ways.rho)
    trace = ways.probability * options["lambda_"] * np.minimum(options["c_bar"], ways.rho)
    difference = ways.sums(error)[:, None] * X - process.gamma * (ways.matrix(error) @ X)
    return traced_flow(
        process, process.D, ways.matrix(trace), process.gamma, difference, ways.sums(error * ways.reward)
    )


NSTEP = Method(
    "n-step", "n-step TD", "Sutton & Barto 2018, equations 7.9 and 7.11; Precup, Sutton & Singh 2000",
    {"num_steps": Option(4.0, 1, 64, "n, steps before bootstrapping", "whole", most=100_000)},
    _expected_nstep, _NStep, remembers=lambda options: options["num_steps"] > 1,
    note="weights each return by the product of its ratios, whose variance grows with n", place=50,
)  # fmt: skip
VTRACE = Method(
    "v-trace", "V-trace", "Espeholt et al. 2018",
    {"lambda_": replace(LAMBDA, default=1.0),
     "rho_bar": Option(1.0, 0.1, 10.0, "ρ̄, cap on the ratio", "log", LARGEST),
     "c_bar": Option(1.0, 0.1, 10.0, "c̄, cap on the trace's ratio", "log", LARGEST)},
    _expected_vtrace, _VTrace,
    note="a rho_bar below the largest ratio moves the fixed point towards the behaviour's values", place=51,
)  # fmt: skip
