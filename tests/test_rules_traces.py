"""Traces: the backward view summed over a stream equals the forward view, in float64, to 1e-10.

With values held fixed, Σ δ_t z_t must equal Σ (G_t - Q(s,a)) ∇Q(s,a), where G_t is the sum written out in this file
(not the library's recursion). Streams exercise alone: the rollout's edge, termination, truncation, an exploring action,
discounts that vary. True online TD(λ) must equal the online λ-return algorithm, run from its definition, after every
step.

Mutants, each asserted to die: decay by the discount out of the state; decay by no discount; decay by the discount two
rows back; cut one step late (after the update with the exploring action's own gradient); cut one row late; cut one row
early; no cut; trace kept over the break; trace dropped only at termination; gradient added before decaying; truncation
as termination in δ; replacing for accumulating; true online with accumulating traces, without the correction, with a
stale V_old, with the discount out of the state.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from neuralq.rules import accumulate, cut, dutch, replace, true_online_increment

GAMMA, LAMBDA, ALPHA = 0.9, 0.7, 0.1
NUM_STATES, NUM_ACTIONS, NUM_ROWS = 4, 3, 9
NAMES = ["edge", "termination", "truncation", "exploring", "first row exploring", "discount per row", "everything"]


class Stream:
    """Nine rows in which only the named thing happens, with values Q[s, a] held fixed and dense features of (s, a)."""

    def __init__(self, name: str) -> None:
        rng = np.random.default_rng(1)
        self.q = rng.normal(size=(NUM_STATES, NUM_ACTIONS))
        self.features = rng.normal(size=(NUM_STATES, NUM_ACTIONS, 5))
        states = rng.integers(NUM_STATES, size=NUM_ROWS + 1)
        self.s_tm1, self.s_t = states[:-1], states[1:].copy()
        self.r = rng.normal(size=NUM_ROWS)
        self.discount = np.full(NUM_ROWS, GAMMA)
        self.last = np.zeros(NUM_ROWS, bool)
        self.greedy = np.ones(NUM_ROWS, bool)
        if name in ("termination", "truncation", "everything"):
            self.last[4] = True
            self.s_t[4] = (self.s_tm1[5] + 1) % NUM_STATES  # the true successor is not where the next row begins
        if name in ("termination", "everything"):
            self.discount[4] = 0.0
        if name in ("discount per row", "everything"):
            self.discount *= rng.uniform(0.5, 1.0, NUM_ROWS)
        if name in ("exploring", "everything"):
            self.greedy[[3, 6]] = False
        if name == "first row exploring":
            self.greedy[0] = False
        best, worst = self.q[self.s_tm1].argmax(-1), self.q[self.s_tm1].argmin(-1)
        self.a_tm1 = np.where(self.greedy, best, worst)
        self.q_tm1 = self.q[self.s_tm1, self.a_tm1]
        self.v_t = self.q[self.s_t].max(-1)
        self.grad = torch.from_numpy(self.features[self.s_tm1, self.a_tm1])


def forward_view(stream: Stream, watkins: bool = True) -> Tensor:
    """Σ (G - Q) ∇Q, with G = (1-λ) Σ λⁿ⁻¹ Q⁽ⁿ⁾ and all the rest of the weight on the longest return."""
    total = torch.zeros(5, dtype=torch.float64)
    for t in range(NUM_ROWS):
        longest = 1
        while t + longest < NUM_ROWS and not stream.last[t + longest - 1]:
            if watkins and not stream.greedy[t + longest]:
                break
            longest += 1
        returns = []
        for n in range(1, longest + 1):
            rewards = math.fsum(math.prod(stream.discount[t : t + i]) * stream.r[t + i] for i in range(n))
            returns.append(rewards + math.prod(stream.discount[t : t + n]) * stream.v_t[t + n - 1])
        g = (1 - LAMBDA) * math.fsum(LAMBDA**n * x for n, x in enumerate(returns[:-1]))
        g += LAMBDA ** (longest - 1) * returns[-1]
        total += (g - stream.q_tm1[t]) * stream.grad[t]
    return total


def backward_view(stream: Stream, change: str = "") -> Tensor:
    """Σ δ z with the library's `cut` and `accumulate`, in the documented order; ``change`` plants one bug."""
    total = torch.zeros(5, dtype=torch.float64)
    z = torch.zeros(5, dtype=torch.float64)
    discount_into = 1.0  # nothing leads into the first state
    for t in range(NUM_ROWS):
        exploring = torch.tensor(bool(not stream.greedy[t]))
        if change == "cut one row late":
            exploring = torch.tensor(bool(not stream.greedy[t - 1] and t > 0))
        if change == "cut one row early":
            exploring = torch.tensor(bool(t + 1 < NUM_ROWS and not stream.greedy[t + 1]))
        if change not in ("no cut", "cut after the update"):
            z = cut(z, exploring)
        decay = LAMBDA * discount_into
        if change == "discount out of the state":
            decay = LAMBDA * stream.discount[t]
        if change == "no discount":
            decay = LAMBDA
        if change == "discount two rows back":
            decay = LAMBDA * (stream.discount[t - 2] if t > 1 else 1.0)
        if change == "gradient before decay":
            z = (z + stream.grad[t]) * decay
        elif change == "replacing":
            z = replace(z, stream.grad[t], decay)
        else:
            z = accumulate(z, stream.grad[t], decay)
        bootstrap = stream.discount[t] * stream.v_t[t]
        if change == "truncation as termination" and stream.last[t]:
            bootstrap = 0.0
        total += (stream.r[t] + bootstrap - stream.q_tm1[t]) * z
        if change == "cut after the update":  # the streaming literature's cut: an algorithm of its own, not Watkins'
            z = cut(z, exploring)
        discount_into = stream.discount[t]
        drop = bool(stream.last[t])
        if change == "kept over the break":
            drop = False
        if change == "dropped only at termination":
            drop = stream.discount[t] == 0
        z = cut(z, torch.tensor(drop))
    return total


def check(name: str, change: str = "") -> None:
    """Backward and forward view agree on the named stream."""
    stream = Stream(name)
    torch.testing.assert_close(backward_view(stream, change), forward_view(stream), rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", NAMES)
def test_backward_view_equals_forward_view(name: str) -> None:
    check(name)


MUTANTS = {
    "discount out of the state": "discount per row",
    "discount two rows back": "discount per row",
    "no discount": "edge",
    "gradient before decay": "edge",
    "replacing": "edge",
    "no cut": "exploring",
    "cut after the update": "exploring",
    "cut one row late": "exploring",
    "cut one row early": "exploring",
    "kept over the break": "truncation",
    "dropped only at termination": "truncation",
    "truncation as termination": "truncation",
}


@pytest.mark.parametrize("mutant", MUTANTS)
def test_trace_mutant_dies(mutant: str) -> None:
    with pytest.raises(AssertionError):
        check(MUTANTS[mutant], mutant)


def test_a_trace_over_a_termination_is_cut_by_the_discount_too() -> None:
    """discount_t = 0 decays the trace to nothing by itself: keeping it over a termination is harmless."""
    check("termination", "kept over the break")


def test_peng_needs_two_errors() -> None:
    """Peng's Q(λ) backwards: the new gradient takes r + γV' - Q, the faded trace r + γV' - V (Peng & Williams 1996)."""
    stream = Stream("exploring")
    total, z = torch.zeros(5, dtype=torch.float64), torch.zeros(5, dtype=torch.float64)
    discount_into = 1.0
    for t in range(NUM_ROWS):
        faded = accumulate(z, torch.zeros_like(z), LAMBDA * discount_into)
        target = stream.r[t] + stream.discount[t] * stream.v_t[t]
        total += (target - stream.q[stream.s_tm1[t]].max()) * faded + (target - stream.q_tm1[t]) * stream.grad[t]
        z, discount_into = faded + stream.grad[t], stream.discount[t]
    torch.testing.assert_close(total, forward_view(stream, watkins=False), rtol=0, atol=1e-10)


# ------------------------------------------------------------------------------------------------- each rule by hand


def test_rules_by_hand() -> None:
    """z = (2, 4), x = (1, 0), decay ½, α = ¼: faded (1, 2); zᵀx·decay = 1; dutch adds (1 - ¼) x."""
    z, x = torch.tensor([2.0, 4.0]), torch.tensor([1.0, 0.0])
    assert accumulate(z, x, 0.5).tolist() == [2.0, 2.0]
    assert replace(z, x, 0.5).tolist() == [1.0, 2.0]
    assert dutch(z, x, 0.5, 0.25).tolist() == [1.75, 2.0]
    assert dutch(z, x, 0.5, 0.0).tolist() == accumulate(z, x, 0.5).tolist()
    assert dutch(z, x, 0.5, 1.0).tolist() == replace(z, x, 0.5).tolist()


def test_one_number_per_row() -> None:
    """[B] decays, step sizes and flags belong to the rows of [B, d]; [B] == [d] does not confuse them."""
    z, x = torch.ones(2, 2), torch.zeros(2, 2)
    per_row = torch.tensor([0.5, 0.25])
    assert accumulate(z, x, per_row).tolist() == [[0.5, 0.5], [0.25, 0.25]]
    assert replace(z, x, per_row).tolist() == [[0.5, 0.5], [0.25, 0.25]]
    assert dutch(z, torch.ones(2, 2), torch.ones(2), per_row).tolist() == [[1.0, 1.0], [1.5, 1.5]]  # 2 - α·2
    assert cut(z, torch.tensor([True, False])).tolist() == [[0.0, 0.0], [1.0, 1.0]]
    deep = accumulate(torch.ones(2, 3, 4), torch.zeros(2, 3, 4), per_row)  # two streams of three outputs each
    assert deep[:, 2, 3].tolist() == [0.5, 0.25]


def test_a_cut_removes_what_overflowed() -> None:
    assert cut(torch.tensor([torch.inf, torch.nan]), torch.tensor(True)).tolist() == [0.0, 0.0]


def test_traces_are_differentiable() -> None:
    g = torch.Generator().manual_seed(0)
    z, x = (torch.randn(2, 3, generator=g, dtype=torch.float64).requires_grad_() for _ in range(2))
    decay = torch.tensor([0.5, 0.8], dtype=torch.float64, requires_grad=True)
    for rule in (accumulate, replace, lambda *inputs: dutch(*inputs, 0.3)):
        assert torch.autograd.gradcheck(rule, (z, x, decay))


def test_bad_shapes_are_refused() -> None:
    z = torch.ones(2, 3)
    for call, message in [
        (lambda: accumulate(z, torch.ones(3), 0.5), "grad must have the shape of z"),
        (lambda: accumulate(z, z, torch.ones(3)), "decay must be a number or match the leading axes"),
        (lambda: replace(z, z, torch.ones(1, 3)), "decay must be a number or match"),
        (lambda: dutch(z, z, 0.5, torch.ones(3)), "step_size must be a number or match"),
        (lambda: cut(z, torch.ones(2)), "where must be a bool tensor"),
        (lambda: cut(z, torch.ones(3).bool()), "where must be a number or match"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()


# --------------------------------------------------------------- true online TD(λ) == the online λ-return algorithm


def episode() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features x_0 … x_6, rewards and discounts (varying, 0 at the end) of one episode of six steps."""
    rng = np.random.default_rng(4)
    discount = rng.uniform(0.5, 1.0, 6)
    discount[-1] = 0.0
    return rng.normal(size=(7, 3)), rng.normal(size=6), discount


def online_lambda_return() -> list[np.ndarray]:
    """For each horizon h: start again from 0 and visit rows 0 … h-1 with the λ-returns that stop at h.

    Source: van Seijen et al. 2016, section 3.

    The bootstraps V(x_k) use the weights the algorithm had when it first reached x_k: those of horizon k-1.
    """
    x, r, discount = episode()
    history = [np.zeros(3)]  # history[k]: the weights at the end of horizon k
    for h in range(1, 7):
        w = np.zeros(3)
        for t in range(h):
            returns = [
                math.fsum(math.prod(discount[t : t + i]) * r[t + i] for i in range(n))
                + math.prod(discount[t : t + n]) * float(history[t + n - 1] @ x[t + n])
                for n in range(1, h - t + 1)
            ]
            g = (1 - LAMBDA) * math.fsum(LAMBDA**n * value for n, value in enumerate(returns[:-1]))
            g += LAMBDA ** (h - t - 1) * returns[-1]
            w = w + ALPHA * (g - w @ x[t]) * x[t]
        history.append(w)
    return history[1:]


def true_online(change: str = "") -> list[Tensor]:
    """The library's rules in van Seijen & Sutton's algorithm; ``change`` plants one bug."""
    features, r, discount = (torch.from_numpy(a) for a in episode())
    w, z = torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    v_old, discount_into = torch.zeros((), dtype=torch.float64), 0.0
    weights = []
    for t in range(6):
        x = features[t]
        decay = LAMBDA * (float(discount[t]) if change == "discount out of the state" else discount_into)
        z = accumulate(z, x, decay) if change == "accumulating" else dutch(z, x, decay, ALPHA)
        v_tm1, v_t = w @ x, w @ features[t + 1]
        delta = r[t] + discount[t] * v_t - v_tm1
        if change == "no correction":
            w = w + ALPHA * delta * z
        else:
            w = w + true_online_increment(z, x, delta, v_tm1, v_old, ALPHA)
        v_old = v_tm1 if change == "stale V_old" else v_t
        discount_into = float(discount[t])
        weights.append(w)
    return weights


def check_true_online(change: str = "") -> None:
    """Both algorithms hold the same weights after every step."""
    for ours, expected in zip(true_online(change), online_lambda_return(), strict=True):
        torch.testing.assert_close(ours, torch.from_numpy(expected), rtol=0, atol=1e-10)


def test_true_online_equals_the_online_lambda_return_algorithm() -> None:
    check_true_online()


@pytest.mark.parametrize("mutant", ["accumulating", "no correction", "stale V_old", "discount out of the state"])
def test_true_online_mutant_dies(mutant: str) -> None:
    with pytest.raises(AssertionError):
        check_true_online(mutant)
