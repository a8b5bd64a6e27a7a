"""Gradient-TD learners: linear recursions by hand, forward views, the gradient of the MSPBE by finite differences.

Four kinds of oracle, none of which shares code with the learners:

* recursions of linear TDC, GTD2 and TDRC, for values and for control, in numpy on the same transitions;
* synchronous runs on Baird's star, whose numbers were computed by an independent float64 matrix iteration;
* the forward view: autograd on one scalar whose gradient is the sum of all increments of a stream, for every layout;
* the gradient of the mean squared projected Bellman error by finite differences.

Mutants that were tried, and die: the sign of the correction; the decay out of the state; the trace kept over
``last_t``; no cut at exploring actions; ρ also on the h² terms of the regression, left out of the trace, left out of c;
β left out; the Hessian term left out, halved, of the other sign; no trace of h, or of ∇Q; rows of
weight 0 that move traces; the mean over environments for their sum; 0 · ∞ in such rows; the policy or
its μ ignored; h of the other sign; state dicts without h, traces or decay.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from neuralq import rules
from neuralq.learners import (
    GradientPredictionLearner,
    GradientQLearner,
    GradientTDSettings,
    HeadCorrection,
    ResidualGradientLearner,
    ResidualGradientSettings,
    TangentCorrection,
)
from neuralq.learners.gradient.differentiation import gradient_rows, module_parameters
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, Conv, FlatParameters, LinearQ, MaskedQ, SeparateQ, TableQ
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Engine, Loss, TorchEngine
from neuralq.types import Transition
from neuralq_envs.counterexamples import star

Array = NDArray[np.float64]
STAR = star()
X: Array = np.array(STAR.features)
START: Array = np.array(STAR.initial_weights)
GAMMA = 0.99
SOLID, DASHED = 0, 1

LAYOUTS = ["table", "linear", "action-input", "separate", "action-output"]
NETWORKS: dict[str, Any] = {"action-input": ActionInputQ, "separate": SeparateQ, "action-output": ActionOutputQ}
NUM_STATES, NUM_ACTIONS, LENGTH = 7, 3, 10
FEATURES = torch.from_numpy(np.random.default_rng(5).normal(size=(NUM_STATES, 4)))


def column(values: Any) -> Tensor:
    return torch.as_tensor(np.asarray(values))


def settings(**changes: Any) -> GradientTDSettings:
    """λ = 0, no pull on h."""
    return GradientTDSettings(**{"lambda_": 0.0, "beta": 0.0, **changes})


# --- Baird's star, row by row ---------------------------------------------------------------------------------------


def star_engine() -> Engine:
    engine = TorchEngine(LinearQ(8, 1), Loss())
    engine.flat.values.copy_(column(START))
    return engine


def star_rows(s: Any, s_next: Any, gamma: float = GAMMA, r: Any = None) -> Transition:
    n = len(s)
    one, rewards = torch.ones(n, dtype=torch.float64), column(np.zeros(n) if r is None else r)
    return Transition(
        column(X[s]), torch.zeros(n, dtype=torch.int64), one, rewards, gamma * one, column(X[s_next]), one < 0
    )


def star_samples(num_steps: int, seed: int) -> list[tuple[int, int, float]]:
    """State, successor and ρ, drawn independently of one another."""
    rng = np.random.default_rng(seed)
    drawn = []
    for _ in range(num_steps):
        solid = rng.random() < 1 / 7
        drawn.append((int(rng.integers(7)), 6 if solid else int(rng.integers(6)), 7.0 if solid else 0.0))
    return drawn


def linear_recursion(method: str, samples: list[Any], alpha: float, alpha_h: float, beta: float) -> tuple[Array, Array]:
    """The updates as the literature writes them, in numpy."""
    w, h = START.copy(), np.zeros(8)
    for s, s_next, rho in samples:
        x, x_t = X[s], X[s_next]
        delta = 0.5 + GAMMA * w @ x_t - w @ x
        if method == "gtd2":
            change = (x @ h) * x - rho * GAMMA * (x @ h) * x_t
        else:
            change = rho * delta * x - rho * GAMMA * (x @ h) * x_t
        h = h + alpha_h * (rho * delta * x - (x @ h) * x - beta * h)
        w = w + alpha * change
    return w, h


@pytest.mark.parametrize("form", ["tangent", "head"])
@pytest.mark.parametrize(("method", "beta"), [("tdc", 0.0), ("gtd2", 0.0), ("tdc", 1.0)], ids=["TDC", "GTD2", "TDRC"])
def test_with_linear_features_it_is_the_linear_recursion_update_for_update(method: str, beta: float, form: str) -> None:
    engine = star_engine()
    correction = TangentCorrection(engine) if form == "tangent" else HeadCorrection(LinearQ(8, 1))
    learner = GradientPredictionLearner(
        engine, correction, settings(method=method, step_size=0.01, step_size_h=0.03, beta=beta)
    )
    samples = star_samples(150, seed=1)
    for k, (s, s_next, rho) in enumerate(samples):
        learner.update(star_rows([s], [s_next], r=[0.5]), column([rho]))
        if k in (0, 1, 10, 149):
            w, h = linear_recursion(method, samples[: k + 1], 0.01, 0.03, beta)
            np.testing.assert_allclose(engine.flat.values, w, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(correction.values, h, rtol=1e-12, atol=1e-12)


def sweep() -> tuple[Transition, Tensor, Tensor]:
    """Every state with both actions, their ratios and their probabilities: one batch is one expected update."""
    s = np.repeat(np.arange(7), 2)
    solid = np.tile([True, False], 7)
    rows = star_rows(s, np.where(solid, 6, 0))  # the dashed successor does not matter: ρ = 0
    return rows, column(np.where(solid, 7.0, 0.0)), column(np.where(solid, 1 / 49, 6 / 49))


def rms_value(w: Tensor) -> float:
    return float(np.sqrt(np.mean((X @ w.numpy()) ** 2)))


# An independent float64 matrix iteration of the expected updates: step size, that of h, β, then RMSVE by sweep.
SWEEPS = [
    ("tdc", 0.005, 0.05, 0.0, {100: 3.322961, 200: 2.283301, 500: 1.936275, 1000: 1.935465}),
    ("gtd2", 0.005, 0.05, 0.0, {1000: 1.935281}),
    ("tdc", 0.015625, 0.015625, 1.0, {1000: 5.673566}),
]


@pytest.mark.parametrize(("method", "alpha", "alpha_h", "beta", "known"), SWEEPS, ids=["TDC", "GTD2", "TDRC"])
@pytest.mark.slow
def test_expected_updates_on_the_star(
    method: str, alpha: float, alpha_h: float, beta: float, known: dict[int, float]
) -> None:
    engine = star_engine()
    chosen = settings(method=method, step_size=alpha, step_size_h=alpha_h, beta=beta)
    learner = GradientPredictionLearner(engine, TangentCorrection(engine), chosen)
    rows, rho, weight = sweep()
    for k in range(1, 1001):
        learner.update(rows, rho, weight)
        if k in known:
            assert rms_value(engine.flat.values) == pytest.approx(known[k], rel=1e-6)
    if alpha_h == 0.05 and method == "tdc":
        np.testing.assert_allclose(engine.flat.values, [2.135314] * 6 + [6.628051, -2.337956], atol=1e-6)


def run_on_star(kind: str, seed: int, num_steps: int) -> float:
    """max |V| after sampled updates, all with the same step size of the values."""
    engine = star_engine()
    correction = TangentCorrection(engine)
    beta = float(kind == "TDRC")
    chosen = settings(step_size=0.01, step_size_h=0.01 if beta else 0.05, beta=beta)
    learner = GradientPredictionLearner(engine, correction, chosen)
    td = ResidualGradientLearner(engine, ResidualGradientSettings(phi=0.0, step_size=0.01))
    for s, s_next, rho in star_samples(num_steps, seed):
        step, ratio = star_rows([s], [s_next]), column([rho])
        if kind == "TD":
            td.update(step, ratio)
        elif kind == "flipped":
            w = engine.flat.values.clone()
            learner.update(step, ratio)
            corrected = engine.flat.values.clone()
            engine.flat.values.copy_(w)
            td.update(step, ratio)
            engine.flat.values.mul_(2).sub_(corrected)  # TD − correction
        else:
            learner.update(step, ratio)
    return float(np.abs(X @ engine.flat.values.numpy()).max())


@pytest.mark.slow
def test_td_diverges_on_the_sampled_star_and_its_corrections_do_not() -> None:
    for seed in range(3):
        assert run_on_star("TD", seed, 500) > 90, "12 at the start"
        assert run_on_star("TDC", seed, 500) < 12
        assert run_on_star("TDRC", seed, 500) < 12


@pytest.mark.slow
def test_negative_control_the_other_sign_of_the_correction_diverges() -> None:
    for seed in range(3):
        assert run_on_star("flipped", seed, 400) > 1e3


class FeatureQ(nn.Module):
    """Q(s, a) = Φ[s, a]·θ on state indices."""

    def __init__(self, phi: Array) -> None:
        super().__init__()
        self.phi = column(phi)
        self.num_actions = phi.shape[1]
        self.theta = nn.Parameter(torch.zeros(phi.shape[2], dtype=torch.float64))

    def all(self, s: Tensor) -> Tensor:
        return self.phi[s] @ self.theta

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        return self.phi[s, a] @ self.theta


def control_star() -> tuple[Array, Array, Array]:
    """Features of Maei 2010 (solid first), start weights, and the probabilities of the behaviour policy."""
    phi = np.zeros((7, 2, 15))
    phi[:, SOLID, 0] = [1.0] * 6 + [2.0]
    phi[range(7), SOLID, range(1, 8)] = [2.0] * 6 + [1.0]
    phi[range(7), DASHED, range(8, 15)] = 1.0
    theta = np.ones(15)
    theta[7] = 10.0
    return phi, theta, np.tile([1 / 49, 6 / 49], (7, 1))


@pytest.mark.slow
def test_greedy_gq_on_bairds_control_star() -> None:
    phi, theta, d = control_star()
    engine = TorchEngine(FeatureQ(phi), Loss())
    engine.flat.values.copy_(column(theta))
    learner = GradientQLearner(engine, TangentCorrection(engine), settings(step_size=0.05, step_size_h=0.25))
    s, a, s_t = np.array([(s, a, t) for s in range(7) for a in range(2) for t in ([6] if a == SOLID else range(6))]).T
    weight = column(d[s, a] / np.where(a == SOLID, 1, 6))
    one = torch.ones(len(s), dtype=torch.float64)
    rows = Transition(column(s), column(a), one, 0 * one, GAMMA * one, column(s_t), one < 0)
    known = {0: 3.603113, 49: 1.633462, 999: 0.014658}  # updates so far; independent matrix iteration, ties to solid
    flat, mass = phi.reshape(14, 15), d.reshape(14)
    for k in range(1000):
        if k in known:
            q = phi @ engine.flat.values.numpy()
            best = q.max(1)
            backup = np.stack([np.full(7, GAMMA * best[6]), np.full(7, GAMMA * best[:6].mean())], 1)
            b = flat.T @ (mass * (backup - q).reshape(14))
            error = np.sqrt(b @ np.linalg.pinv(flat.T @ (mass[:, None] * flat)) @ b)
            assert error == pytest.approx(known[k], rel=4e-5)
        learner.update(rows, weight)


def test_qrc_without_traces_is_tdrc_for_control() -> None:
    # "It must equal TDRC": the linear recursion in numpy, with the best next action.
    phi, theta, _ = control_star()
    engine = TorchEngine(FeatureQ(phi), Loss())
    engine.flat.values.copy_(column(theta))
    head = HeadCorrection(FeatureQ(phi))
    learner = GradientQLearner(engine, head, GradientTDSettings(lambda_=0.0, step_size=0.01, step_size_h=0.02))
    rng, h = np.random.default_rng(4), np.zeros(15)
    for _ in range(200):
        s, a, t, r = int(rng.integers(7)), int(rng.integers(2)), int(rng.integers(7)), rng.normal()
        one = torch.ones(1, dtype=torch.float64)
        learner.update(Transition(column([s]), column([a]), one, r * one, 0.9 * one, column([t]), one < 0))
        x, x_t = phi[s, a], phi[t, np.argmax(phi[t] @ theta)]
        delta = r + 0.9 * theta @ x_t - theta @ x
        theta, h = (
            theta + 0.01 * (delta * x - 0.9 * (x @ h) * x_t),
            h + 0.02 * ((delta - x @ h) * x - 1.0 * h),
        )
        np.testing.assert_allclose(engine.flat.values, theta, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(head.values, h, rtol=1e-12, atol=1e-12)


# --- The forward view -----------------------------------------------------------------------------------------------


def function_of(layout: str, outputs: int, seed: int, hidden: int = 5) -> Any:
    rng = np.random.default_rng(seed)
    if layout == "table":
        q: Any = TableQ(NUM_STATES, outputs)
    elif layout == "linear":
        q = LinearQ(4, outputs)
    else:
        q = NETWORKS[layout]((4,), outputs, MLP((hidden,), activation="tanh"), rng=rng, dtype=torch.float64)
    for p in q.parameters():
        p.data.copy_(torch.from_numpy(rng.normal(size=p.shape)))
    return q


def correction_of(form: str, layout: str, engine: Engine) -> Any:
    made = TangentCorrection(engine) if form == "tangent" else HeadCorrection(
        function_of(layout, engine.q.num_actions, seed=8, hidden=3)
    )  # fmt: skip
    made.values.copy_(torch.from_numpy(np.random.default_rng(9).normal(size=made.values.shape)))
    return made


def stream(layout: str, q: Any, control: bool, seed: int = 0) -> Transition:
    """One environment ``[T]``: discounts vary, it terminates once, is truncated once, and explores four times."""
    rng = np.random.default_rng(seed)
    states = rng.integers(NUM_STATES, size=LENGTH + 1)
    s_tm1, s_t = states[:-1], states[1:].copy()
    last, discount = np.zeros(LENGTH, bool), rng.uniform(0.4, 1.0, LENGTH)
    last[[3, 6]] = True
    discount[3] = 0.0
    s_t[last] = rng.integers(NUM_STATES, size=2)
    observe: Callable[[Any], Tensor] = column if layout == "table" else (lambda s: FEATURES[column(s)])
    a = torch.zeros(LENGTH, dtype=torch.int64)
    if control:
        a = q.all(observe(s_tm1)).detach().argmax(-1)
        a[[0, 2, 5, 9]] = (a[[0, 2, 5, 9]] + 1) % NUM_ACTIONS
    mu = column(rng.uniform(0.3, 1.0, LENGTH))
    r = column(rng.normal(size=LENGTH))
    return Transition(observe(s_tm1), a, mu, r, column(discount), observe(s_t), column(last))


def flat_gradient(value: Tensor, q: Any) -> Tensor:
    parameters = list(q.parameters())
    found = torch.autograd.grad(value, parameters, allow_unused=True, retain_graph=True)
    return torch.cat([torch.zeros(p.numel(), dtype=torch.float64) if g is None else g.reshape(-1)
                      for p, g in zip(parameters, found, strict=True)])  # fmt: skip


def forward_errors(t: Transition, q: Any, v_t: Tensor, rho: Tensor, trace_decay: Tensor, lambda_: float) -> Tensor:
    """D_k = ρ_k (δ_k + γ_k λ c_{k+1} D_{k+1}): how far each λ-return lies from its prediction, differentiable."""
    values = q.at(t.s_tm1, t.a_tm1)
    errors: list[Tensor] = []
    after = torch.zeros((), dtype=torch.float64)
    for k in reversed(range(LENGTH)):
        ends = k == LENGTH - 1 or bool(t.last_t[k])
        onward = 0.0 if ends else t.discount_t[k] * lambda_ * trace_decay[k + 1]
        after = rho[k] * (t.r_t[k] + t.discount_t[k] * v_t[k] - values[k] + onward * after)
        errors.insert(0, after)
    return torch.stack(errors)


def forward_view(
    t: Transition, q: Any, correction: Any, v_t: Tensor, rho: Tensor, trace_decay: Tensor, s: GradientTDSettings
) -> Any:
    """The sum of all increments with every weight held fixed, from scalars that autograd differentiates."""
    errors = forward_errors(t, q, v_t, rho, trace_decay, s.lambda_)
    values = q.at(t.s_tm1, t.a_tm1)
    if isinstance(correction, TangentCorrection):
        # ½ MSPBE = maxₕ D·h − ½ h², and its gradient is that of the bracket, at h held fixed (the tangent space turns).
        h = torch.stack([_along(values[k], q, correction.values) for k in range(LENGTH)])
        objective = (errors * h - 0.5 * h**2).sum()
        grads = torch.stack([flat_gradient(v, q) for v in values])
        for_h = (errors.detach() - h.detach()) @ grads
    else:
        h = correction.head.at(t.s_tm1, t.a_tm1)
        objective = (errors * h.detach()).sum()
        for_h = flat_gradient((errors.detach() * h - 0.5 * h**2).sum(), correction.head)
    fixed = h.detach()
    total = -flat_gradient(objective, q) + flat_gradient(((1 - rho) * fixed * values).sum(), q)  # E ρ = 1
    if s.method == "tdc":
        total = total + flat_gradient(((errors.detach() - fixed) * values).sum(), q)
    return s.step_size * total, s.step_size_h * (for_h - LENGTH * s.beta * correction.values)


def _along(value: Tensor, q: Any, direction: Tensor) -> Tensor:
    found = torch.autograd.grad(value, list(q.parameters()), create_graph=True)
    return torch.cat([g.reshape(-1) for g in found]) @ direction


def backward_view(learner: Any, t: Transition, *ratios: Tensor) -> tuple[Tensor, Tensor]:
    total: Any = 0.0
    total_h: Any = 0.0
    for k in range(LENGTH):
        row, ratio = t.map(lambda x, k=k: x[k : k + 1]), [x[k : k + 1] for x in ratios]
        increment, increment_h, _ = learner.increments(row, *ratio)
        total, total_h = total + increment, total_h + increment_h
    return total, total_h


@pytest.mark.parametrize("form", ["tangent", "head"])
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(("method", "cut"), [("tdc", "watkins"), ("gtd2", "watkins"), ("tdc", "naive")])
def test_forward_view_equals_backward_view_for_control(form: str, layout: str, method: str, cut: str) -> None:
    engine = make_engine(function_of(layout, NUM_ACTIONS, seed=1), Loss())
    q: Any = engine.q
    correction, t = correction_of(form, layout, engine), stream(layout, q, control=True)
    chosen = GradientTDSettings(method, 0.8, 0.3, 0.2, 0.7, cut)
    one = torch.ones(LENGTH, dtype=torch.float64)
    trace_decay = one if cut == "naive" else rules.is_greedy(q.all(t.s_tm1), t.a_tm1).double()
    assert trace_decay.sum() == (10 if cut == "naive" else 6)
    expected = forward_view(t, q, correction, q.all(t.s_t).amax(-1), one, trace_decay, chosen)
    found = backward_view(GradientQLearner(engine, correction, chosen), t)
    torch.testing.assert_close(found[0], expected[0], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(found[1], expected[1], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("form", ["tangent", "head"])
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("method", ["tdc", "gtd2"])
def test_forward_view_equals_backward_view_for_prediction_with_ratios(form: str, layout: str, method: str) -> None:
    engine = make_engine(function_of(layout, 1, seed=2), Loss())
    q: Any = engine.q
    correction, t = correction_of(form, layout, engine), stream(layout, q, control=False)
    chosen = GradientTDSettings(method, 0.7, 0.3, 0.2, 0.7)
    one, rho = torch.ones(LENGTH, dtype=torch.float64), column(np.random.default_rng(6).uniform(0, 2, LENGTH))
    expected = forward_view(t, q, correction, q.all(t.s_t)[:, 0], rho, one, chosen)
    found = backward_view(GradientPredictionLearner(engine, correction, chosen), t, rho)
    torch.testing.assert_close(found[0], expected[0], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(found[1], expected[1], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("layout", ["linear", "action-output"])
def test_forward_view_equals_backward_view_for_a_target_policy(layout: str) -> None:
    engine = make_engine(function_of(layout, NUM_ACTIONS, seed=3), Loss())
    q: Any = engine.q
    correction, t = correction_of("tangent", layout, engine), stream(layout, q, control=True)
    chosen = GradientTDSettings("tdc", 0.8, 0.3, 0.2, 0.0)

    def policy(values: Tensor) -> Tensor:
        return rules.epsilon_greedy(values, 0.3)

    trace_decay = policy(q.all(t.s_tm1)).detach().gather(-1, t.a_tm1[:, None])[:, 0] / t.mu_tm1
    v_t = (policy(q.all(t.s_t).detach()) * q.all(t.s_t)).sum(-1)
    expected = forward_view(t, q, correction, v_t, torch.ones_like(trace_decay), trace_decay, chosen)
    found = backward_view(GradientQLearner(engine, correction, chosen, policy=policy), t)
    torch.testing.assert_close(found[0], expected[0], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(found[1], expected[1], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("form", ["tangent", "head"])
def test_environments_are_learners_of_their_own_and_rows_of_weight_0_are_no_experience(form: str) -> None:
    engine = make_engine(function_of("action-output", NUM_ACTIONS, seed=1), Loss())
    correction = correction_of(form, "action-output", engine)
    chosen = GradientTDSettings("tdc", 0.8, 0.3, 0.2, 0.7)
    streams = [stream("action-output", engine.q, True, seed) for seed in (1, 2)]
    alone = [backward_view(GradientQLearner(engine, correction, chosen), t) for t in streams]
    both = GradientQLearner(engine, correction, chosen, num_envs=2)
    total: Any = 0.0
    total_h: Any = 0.0
    blank = streams[0].map(lambda x: x[4:5])
    # The second environment starts one step later, and the first has ended by then.
    for k in range(LENGTH + 1):
        halves = [streams[0].map(lambda x, k=k: x[k : k + 1]) if k < LENGTH else blank,
                  streams[1].map(lambda x, k=k: x[k - 1 : k]) if k else blank]  # fmt: skip
        names = ("s_tm1", "a_tm1", "mu_tm1", "r_t", "discount_t", "s_t", "last_t")
        rows = Transition(*(torch.cat([getattr(half, name) for half in halves]) for name in names))
        weight = column([float(k < LENGTH), float(k > 0)])
        increment, increment_h, _ = both.increments(rows, weight)
        total, total_h = total + increment, total_h + increment_h
    torch.testing.assert_close(total, alone[0][0] + alone[1][0], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(total_h, alone[0][1] + alone[1][1], rtol=1e-10, atol=1e-10)


# --- The gradient of the MSPBE --------------------------------------------------------------------------------------


class Chance:
    """A random Markov reward process off policy: observations, P under μ with ratios, rewards, state distribution."""

    def __init__(self, num_states: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.n = num_states
        self.x = rng.normal(size=(num_states, 2))
        p = rng.dirichlet(np.ones(num_states), size=(2, num_states))  # two actions
        mu, pi = rng.dirichlet(np.ones(2), size=num_states), rng.dirichlet(np.ones(2), size=num_states)
        d = rng.dirichlet(np.ones(num_states))
        rows = [(s, t, d[s] * mu[s, a] * p[a, s, t], pi[s, a] / mu[s, a])
                for s in range(num_states) for a in range(2) for t in range(num_states)]  # fmt: skip
        s, t, weight, rho = (np.array(c) for c in zip(*rows, strict=True))
        self.s, self.t, self.d = s, t, d
        self.weight, self.rho, self.r = column(weight), column(rho), column(rng.normal(size=len(s)))
        self.discount = column(np.where(rng.random(len(s)) < 0.2, 0.0, 0.9))

    def transition(self) -> Transition:
        x, one = column(self.x), torch.ones(len(self.s), dtype=torch.float64)
        a = torch.zeros(len(self.s), dtype=torch.int64)
        return Transition(x[column(self.s)], a, one, self.r, self.discount, x[column(self.t)], one < 0)

    def parts(self, q: Any) -> tuple[Array, Array]:
        """b = E[ρ δ ∇V] and C = E[∇V ∇Vᵀ]."""
        v = q.all(column(self.x))[:, 0]
        j = torch.stack([flat_gradient(each, q) for each in v]).numpy()
        v = v.detach().numpy()
        delta = self.r.numpy() + self.discount.numpy() * v[self.t] - v[self.s]
        b = j[self.s].T @ (self.weight.numpy() * self.rho.numpy() * delta)
        return b, j.T @ (self.d[:, None] * j)


@pytest.mark.parametrize("method", ["gtd2", "tdc"])
def test_expected_update_of_a_network_is_minus_half_the_gradient_of_the_mspbe(method: str) -> None:
    # Maei et al. 2009, theorem 1: h at its fixed point, fewer parameters (9) than states (14).
    problem = Chance(14, seed=3)
    q = ActionOutputQ((2,), 1, MLP((2,), activation="tanh"), rng=4, dtype=torch.float64)
    engine = make_engine(q, Loss())
    theta = engine.flat.values
    theta.mul_(2.0)

    def mspbe() -> float:
        b, c = problem.parts(q)
        return float(b @ np.linalg.solve(c, b))

    slopes = []
    for i in range(len(theta)):
        centre, step = theta[i].item(), 1e-5
        theta[i] = centre + step
        above = mspbe()
        theta[i] = centre - step
        slopes.append((above - mspbe()) / (2 * step))
        theta[i] = centre
    b, c = problem.parts(q)
    correction = TangentCorrection(engine)
    correction.values.copy_(column(np.linalg.solve(c, b)))
    learner = GradientPredictionLearner(engine, correction, settings(method=method, step_size=1.0, step_size_h=1.0))
    found, found_h, _ = learner.increments(problem.transition(), problem.rho, problem.weight)
    assert max(map(abs, slopes)) > 1e-2
    np.testing.assert_allclose(found, -0.5 * np.array(slopes), rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(found_h, 0.0, atol=1e-10)


# --- Derivatives ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", list(NETWORKS))
@pytest.mark.parametrize(
    ("shape", "body"),
    [
        ((4,), MLP((5,), layer_norm=True, activation="leaky_relu")),
        ((2, 4, 4), Conv(channels=(3,), hidden=(5,), activation="tanh")),
    ],
    ids=["MLP", "Conv"],
)
def test_derivatives_of_every_layout_and_body(layout: str, shape: tuple[int, ...], body: Any) -> None:
    q: Any = NETWORKS[layout](shape, 3, body, rng=0, dtype=torch.float64)
    flat, parameters = FlatParameters(q), module_parameters(q)
    rng = np.random.default_rng(1)
    s, a = column(rng.uniform(size=(4, *shape))), torch.tensor([0, 1, 2, 1])
    direction, origin = column(rng.normal(size=flat.values.shape)), flat.values.clone()

    def rows(offset: float) -> Tensor:
        flat.values.copy_(origin + offset * direction)
        return gradient_rows(q.at(s, a), parameters, differentiable=True)

    by_difference = ((rows(1e-5) - rows(-1e-5)) / 2e-5).detach()
    found = rows(0.0)
    values = q.at(s, a)
    torch.testing.assert_close(
        found.detach(), torch.stack([flat_gradient(v, q) for v in values]), rtol=1e-10, atol=1e-12
    )
    assert gradient_rows(values, parameters).equal(found), "with or without the means to go on"
    torch.testing.assert_close(gradient_rows(found @ direction, parameters), by_difference, rtol=1e-4, atol=1e-4)


# --- State, masks, refusals -----------------------------------------------------------------------------------------


def build(kind: str, seed: int) -> Any:
    engine = make_engine(
        function_of("action-output", 1 if kind.startswith("prediction") else NUM_ACTIONS, seed), Loss()
    )
    form = kind.split()[1]
    correction = TangentCorrection(engine) if form == "tangent" else HeadCorrection(
        function_of("linear", engine.q.num_actions, seed + 1)
    )  # fmt: skip
    chosen = GradientTDSettings("tdc", 0.8, 0.01, 0.02, 0.5)
    cls: Any = GradientPredictionLearner if kind.startswith("prediction") else GradientQLearner
    return cls(engine, correction, chosen)


@pytest.mark.parametrize(
    "kind",
    ["prediction tangent", "prediction head", "control tangent", "control head"],
)
def test_a_saved_learner_goes_on_bit_for_bit(kind: str) -> None:
    one, two = build(kind, 1), build(kind, 20)
    t = stream("action-output", one.engine.q, control=not kind.startswith("prediction"))
    rows = [t.map(lambda x, k=k: x[k : k + 1]) for k in range(LENGTH)]
    for row in rows[:6]:  # into the middle of an episode
        one.update(row)
    saved = copy.deepcopy(one.state_dict())
    two.load_state_dict(saved)
    for row in rows[6:]:
        one.update(row)
        two.update(row)
    assert one.num_updates == two.num_updates == LENGTH
    assert torch.equal(one.engine.flat.values, two.engine.flat.values)
    again = build(kind, 30)
    again.load_state_dict(saved)
    again.begin_streams()
    again.update(rows[6])
    two.load_state_dict(saved)
    two.update(rows[6])
    assert not torch.equal(two.engine.flat.values, again.engine.flat.values), "begin_streams drops the traces"


@pytest.mark.parametrize("form", ["tangent", "head"])
def test_illegal_actions_are_neither_bootstrapped_from_nor_differentiated(form: str) -> None:
    inner = TableQ(3, 2)
    engine = make_engine(MaskedQ(inner, ()), Loss())
    engine.flat.values.copy_(column([1.0, 9.0, 2.0, 9.0, 3.0, 9.0]))
    correction = TangentCorrection(engine) if form == "tangent" else HeadCorrection(MaskedQ(TableQ(3, 2), ()))
    correction.values.fill_(1.0)
    learner = GradientQLearner(engine, correction, settings(step_size=1.0, step_size_h=0.5))
    one = torch.ones(3, dtype=torch.float64)
    # State 0, only action 0 legal, to state 1, likewise; state 2 ends where nothing is legal; the end is no experience.
    s, s_t = torch.tensor([[0, 1, 0], [2, 1, 1], [0, 0, 0]]), torch.tensor([[1, 1, 0], [0, 0, 0], [0, 1, 1]])
    step = Transition(s, torch.tensor([0, 1, 0]), one, one, column([0.5, 0.0, 1.0]), s_t, column([False, True, False]))
    seen = learner.update(step, column([1.0, 1.0, 0.0]))
    assert seen.errors.tolist() == [1.0, -8.0, 0.0]  # 1 + ½·2 − 1; 1 − 9
    assert engine.flat.values.tolist() == [2.0, 9.0, 1.5, 9.0, 3.0, 1.0]  # δ at the near side, −γ h at the far one
    assert correction.values.tolist() == [1.0, 1.0, 1.0, 1.0, 1.0, -3.5]  # 1 + ½(δ − 1)


def test_refusals_name_the_way_out() -> None:
    with pytest.raises(ValueError, match="method must be one of"):
        GradientTDSettings(method="td")
    with pytest.raises(ValueError, match="beta must be"):
        GradientTDSettings(beta=-1.0)
    many, single = TorchEngine(TableQ(3, 2), Loss()), star_engine()
    with pytest.raises(ValueError, match="use GradientQLearner"):
        GradientPredictionLearner(many, TangentCorrection(many), GradientTDSettings())
    with pytest.raises(ValueError, match="no exploring actions"):
        GradientPredictionLearner(single, TangentCorrection(single), GradientTDSettings(cut="naive"))
    with pytest.raises(ValueError, match="importance ratio cuts"):
        GradientQLearner(many, TangentCorrection(many), GradientTDSettings(cut="naive"), policy=rules.greedy)
    with pytest.raises(ValueError, match="set num_envs"):
        GradientQLearner(single, TangentCorrection(single), GradientTDSettings()).update(star_rows([2, 3], [1, 1]))
    learner = GradientQLearner(single, TangentCorrection(single), GradientTDSettings())
    with pytest.raises(ValueError, match="the network it was saved with"):
        learner.load_state_dict({**learner.state_dict(), "h": torch.zeros(4)})
