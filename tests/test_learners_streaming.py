"""Streaming learners: the arithmetic by hand, the published program written plainly, both cuts as sums over pairs of
steps, compiled kernels against tensor operations.

Mutants that must die here: the trace decayed by the discount out of the state · the exact cut after the gradient,
or the published one before it · the trace kept over the last step · max(|δ|, 1) without the 1 · ‖z‖₂ for ‖z‖₁ · no bias
correction · v of the gradient in place of δz, or the reverse · the running mean of n without its own correction · δ not
clipped · a sign of the step · a layer's mean taken twice or its 1/σ forgotten on the way back · a stride or a channel
of a convolution dropped · NaN passed over by the maximum.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from neuralq.learners import OnlineSettings, PredictionLearner, StreamingLearner, StreamingSettings
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, Conv, LinearQ, MaskedQ, SeparateQ, TableQ
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Loss
from neuralq.q.single_row import SingleRowNetwork, runs_single_row
from neuralq.rules.streaming import adaptive_obgd, intentional, obgd_step_size
from neuralq.types import Transition

GAMMA, LAMBDA = 0.9, 0.8
BOUNDS = ("obgd", "adaptive-obgd", "intentional")
CUTS = ("watkins", "published")


def row(s: Any, a: int, r: float, discount: float, s_next: Any, last: bool) -> Transition:
    def pair(x: Any) -> Tensor:
        return torch.as_tensor(np.asarray(x))[None]

    return Transition(pair(s), pair(a), pair(1.0), pair(r), pair(discount), pair(s_next), pair(last))


def stream(rng: np.random.Generator, shape: tuple[int, ...], num_actions: int, length: int) -> list[Transition]:
    """Steps with random observations, rewards and actions; discounts vary, and the stream breaks with and without 0."""
    s = rng.standard_normal((length + 1, *shape))
    steps = []
    for t in range(length):
        last = t % 11 == 6 or t == length - 1
        discount = 0.0 if last and t % 2 else float(rng.choice([0.9, 0.7]))
        steps.append(row(s[t], int(rng.integers(num_actions)), float(rng.normal()), discount, s[t + 1], last))
    return steps


def learner_of(q: Any, settings: StreamingSettings, kind: str = "auto", discount: float = GAMMA) -> StreamingLearner:
    return StreamingLearner(
        make_engine(q, Loss(), "torch" if kind == "torch" else "auto"), settings, discount, 1.0, kind
    )


def weights(learner: StreamingLearner) -> Any:
    return learner.engine.flat.values.numpy().copy()


# By hand.


@pytest.mark.parametrize("kind", ["auto", "torch"])
def test_two_steps_of_obgd_by_hand(kind: str) -> None:
    learner = learner_of(TableQ(3, 2), StreamingSettings(lambda_=0.5), kind)
    seen = learner.update(row(0, 1, 0.5, 0.8, 1, False))
    # δ = 0.5, ‖z‖₁ = 1, M = 1·2·max(0.5, 1)·1 = 2, step 1/2: Q(0, 1) = 0.25.
    assert (float(seen.errors[0]), float(seen.targets[0])) == (0.5, 0.5)
    learner.update(row(1, 0, 4.0, 0.0, 2, True))
    # z = (0.8·0.5, 1) = (0.4, 1), δ = 4, M = 2·4·1.4 = 11.2: Q(0, 1) += 4·0.4/11.2 = 1/7, Q(1, 0) += 4/11.2.
    q = learner.engine.all(torch.arange(3)).numpy()
    np.testing.assert_allclose(q, [[0, 0.25 + 1 / 7], [4 / 11.2, 0], [0, 0]], rtol=1e-15)
    learner.update(row(2, 0, 1.0, 0.8, 0, False))
    # The stream broke: only Q(2, 0) moves. max Q(0) = 0.25 + 1/7; δ = 1 + 0.8·0.392857 = 1.3142857, M = 2δ: ½.
    q = learner.engine.all(torch.arange(3)).numpy()
    np.testing.assert_allclose(q, [[0, 0.25 + 1 / 7], [4 / 11.2, 0], [0.5, 0]], rtol=1e-15)


@pytest.mark.parametrize("kind", ["auto", "torch"])
def test_two_steps_of_adaptive_obgd_by_hand(kind: str) -> None:
    learner = learner_of(TableQ(3, 1), StreamingSettings(lambda_=0.5, bound="adaptive-obgd", beta2=0.75), kind)
    learner.update(row(0, 0, 2.0, 0.8, 1, False))
    # v = ¼·4 = 1, v̂ = 4, u = 1/2, ‖u‖₁ = ½, M = 2·2·½ = 2: += ½·2·½ = ½.
    np.testing.assert_allclose(weights(learner), [0.5, 0, 0], rtol=1e-7)
    learner.update(row(1, 0, 1.0, 0.0, 2, True))
    # z = (0.4, 1), δ = 1, v = ¾(1, 0) + ¼(0.16, 1) = (0.79, 0.25), v̂ = v/(1 − 0.5625); M = 2·‖u‖₁.
    u = np.array([0.4, 1.0]) / np.sqrt(np.array([0.79, 0.25]) / 0.4375)
    np.testing.assert_allclose(weights(learner), [0.5 + u[0] / (2 * u.sum()), u[1] / (2 * u.sum()), 0], rtol=1e-7)


@pytest.mark.parametrize("kind", ["auto", "torch"])
def test_an_adaptive_step_by_hand_where_the_bound_is_not_felt(kind: str) -> None:
    """Where M > 1 the length of u cancels, and a forgotten correction of v would go unseen."""
    settings = StreamingSettings(lambda_=0.5, bound="adaptive-obgd", beta2=0.75, step_size=0.01)
    learner = learner_of(TableQ(3, 1), settings, kind)
    learner.update(row(0, 0, 2.0, 0.8, 1, False))
    np.testing.assert_allclose(weights(learner), [0.01, 0, 0], rtol=1e-7)  # u = ½, M = 0.01·2·2·½ < 1: 0.01·2·½
    learner.update(row(1, 0, 1.0, 0.8, 2, True))
    u = np.array([0.4, 1.0]) / np.sqrt(np.array([0.79, 0.25]) / 0.4375)  # as above
    np.testing.assert_allclose(weights(learner), [0.01 + 0.01 * u[0], 0.01 * u[1], 0], rtol=1e-7)
    learner.update(row(2, 0, 0.0, 0.8, 0, False))
    # The stream broke, though its discount did not: only Q(2) moves. So small an error makes M > 1: half of it.
    moved = 0.8 * (0.01 + 0.01 * u[0]) / 2
    np.testing.assert_allclose(weights(learner), [0.01 + 0.01 * u[0], 0.01 * u[1], moved], rtol=1e-7)


@pytest.mark.parametrize("kind", ["auto", "torch"])
def test_two_intentional_steps_by_hand(kind: str) -> None:
    settings = StreamingSettings(lambda_=0.5, bound="intentional", step_size=0.25, beta2=0.75)
    learner = learner_of(TableQ(3, 1), settings, kind, discount=0.8)
    learner.update(row(0, 0, 2.0, 0.8, 1, False))
    # v̂ = 1, D = 1 (state 0), n = Z = 1, σ = 0.6/0.6 = 1, step ¼: += ¼·2.
    np.testing.assert_allclose(weights(learner), [0.5, 0, 0], rtol=1e-7)
    learner.update(row(1, 0, 1.0, 0.0, 2, True))
    # v = (¾·¼, ¼), v̂ = v/0.4375 = (3/7, 4/7); n = 1/√(4/7); z = (0.4, 1), Z = 0.16/√(3/7) + n;
    # σ = 0.4·0.6 + 0.6·n, σ̂ = σ/(1 − 0.4²); step = ¼/√(σ̂Z), δ = 1.
    scale = np.sqrt([3 / 7, 4 / 7])
    n = 1 / scale[1]
    step = 0.25 / np.sqrt((0.24 + 0.6 * n) / 0.84 * (0.16 / scale[0] + n))
    np.testing.assert_allclose(weights(learner), [0.5 + step * 0.4 / scale[0], step / scale[1], 0], rtol=1e-7)


def test_intentional_errors_are_clipped_at_twenty_times_their_usual_size() -> None:
    g, v, means = torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64), torch.tensor([1.0, 1e-4])
    t = 10**6  # corrections have gone
    change, _, after = intentional(g, g, torch.tensor(100.0, dtype=torch.float64), v, means.double(), t, 0.0, 1.0, 0.5)
    # e = 0.9998·1e-4 + 0.0002·10⁴ ≈ 2.0001, limit 20·√2.0001 = 28.285; D = √½; Z = n = √2, so step·z/D = 1.
    assert float(after[1]) == pytest.approx(2.0 + 0.9998e-4)
    assert float(change) == pytest.approx(20 * np.sqrt(2.0 + 0.9998e-4), rel=1e-6)


# What the bounds promise.

FINITE = st.floats(-1, 1, allow_subnormal=False)


@given(
    x=st.lists(FINITE, min_size=1, max_size=6), delta=st.floats(-50, 50), alpha=st.floats(1e-3, 100),
    kappa=st.floats(1.0, 5),
)  # fmt: skip
def test_obgd_removes_at_most_a_fraction_of_the_error(x: list[float], delta: float, alpha: float, kappa: float) -> None:
    """For features within [−1, 1] and a fixed target the error keeps its sign and loses at most 1/κ of itself."""
    z, error = torch.tensor(x, dtype=torch.float64), torch.tensor(delta, dtype=torch.float64)
    removed = float(obgd_step_size(z.abs().sum(), error, alpha, kappa) * (z @ z))
    assert -1e-12 <= removed <= 1 / kappa / max(abs(delta), 1) + 1e-12


@given(alpha=st.floats(1, 1e6), size=st.floats(1e-3, 1e3))
def test_a_larger_step_size_changes_nothing_once_the_bound_is_felt(alpha: float, size: float) -> None:
    one = obgd_step_size(torch.tensor(size).double() + 1, torch.tensor(0.0).double(), alpha, 2.0)
    assert float(one) == pytest.approx(1 / (2 * (size + 1)), rel=1e-6)


def test_an_intentional_step_removes_the_fraction_it_means_to() -> None:
    rng = np.random.default_rng(0)
    learner = learner_of(LinearQ(5, 1, bias=False), StreamingSettings(lambda_=0.0, bound="intentional"))
    for _ in range(50):
        s = rng.standard_normal(5)
        sigma_before = None if learner.num_updates else 0.0
        step = row(s, 0, float(rng.normal()), 0.0, s, True)
        q = float(learner.engine.all(step.s_tm1)[0, 0])
        error = float(learner.update(step).errors[0])
        moved = float(learner.engine.all(step.s_tm1)[0, 0]) - q
        assert sigma_before is None or moved == pytest.approx(0.25 * error)
        # With λ = 0 the running mean of n is n itself.
        assert moved == pytest.approx(0.25 * error, rel=1e-6)


def test_the_adaptive_direction_does_not_depend_on_the_scale_of_the_trace() -> None:
    z, delta = torch.tensor([0.5, -2.0, 1.0]).double(), torch.tensor(3.0).double()
    small, _ = adaptive_obgd(z, delta, torch.zeros(3).double(), 1, 1.0, 2.0, 0.999)
    large, _ = adaptive_obgd(1000 * z, delta, torch.zeros(3).double(), 1, 1.0, 2.0, 0.999)
    torch.testing.assert_close(small, large, rtol=1e-6, atol=0)


# Where the trace is cut: with weights held still, increments are sums over pairs of steps.

REPRESENTATIONS = {
    "table": lambda: TableQ(4, 3),
    "linear": lambda: LinearQ(3, 3, bias=True),
    "action-output": lambda: ActionOutputQ((3,), 3, MLP((5,), activation="tanh"), rng=1, dtype=torch.float64),
    "conv": lambda: ActionOutputQ((1, 4, 3), 3, Conv((2,), (2,), (1,), (4,)), rng=1, dtype=torch.float64),
    "separate": lambda: SeparateQ((3,), 3, MLP((5,)), rng=1, dtype=torch.float64),
    "action-input": lambda: ActionInputQ((3,), 3, MLP((5,)), rng=1, dtype=torch.float64),
}


def steps_for(name: str, q: Any, rng: np.random.Generator, length: int = 40) -> list[Transition]:
    shape = (1, 4, 3) if name == "conv" else (3,)
    steps = stream(rng, shape, 3, length)
    if name != "table":
        return steps
    return [
        row(int(rng.integers(4)), int(x.a_tm1), float(x.r_t), float(x.discount_t), int(rng.integers(4)), bool(x.last_t))
        for x in steps
    ]


def frozen_sum(learner: StreamingLearner, steps: list[Transition]) -> tuple[Any, list[Any], list[float], list[bool]]:
    """What the updates would add up to if none were made; and gradients, errors and greedy flags, by autograd."""
    q: Any = learner.engine.q
    if not learner.engine.flat.values.any():
        learner.engine.flat.values.copy_(torch.linspace(-1, 1, learner.engine.flat.values.numel()).cos() * 9 % 1)
    start, total = weights(learner), 0.0
    grads, errors, greedy = [], [], []
    for step in steps:
        learner.engine.flat.grad.zero_()
        value = q.at(step.s_tm1[0], step.a_tm1[0])
        value.backward()
        grads.append(learner.engine.flat.grad.numpy().copy())
        with torch.no_grad():
            best = float(q.all(step.s_t[0]).max())
            greedy.append(bool(value >= q.all(step.s_tm1[0]).max()))
        errors.append(float(step.r_t) + float(step.discount_t) * best - float(value.detach()))
        learner.update(step)
        total = total + weights(learner) - start
        learner.engine.flat.load(torch.from_numpy(start))
    return total, grads, errors, greedy


@pytest.mark.parametrize("kind", ["auto", "torch"])
@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_the_exact_cut_is_the_forward_view(name: str, kind: str) -> None:
    q = REPRESENTATIONS[name]()
    steps = steps_for(name, q, np.random.default_rng(3))
    # So loose a bound is never felt: M < 1, and the increments are δz.
    learner = learner_of(q, StreamingSettings(lambda_=LAMBDA, kappa=1e-9), kind)
    total, grads, errors, greedy = frozen_sum(learner, steps)
    assert any(greedy) and not all(greedy)
    expected, correction = 0.0, 0.0
    for t in reversed(range(len(steps))):
        # G_t − Q = δ_t + γ_t λ·[a_{t+1} greedy]·(G_{t+1} − Q), nothing from beyond the last step.
        later = t + 1 < len(steps) and not bool(steps[t].last_t) and greedy[t + 1]
        correction = errors[t] + (float(steps[t].discount_t) * LAMBDA * correction if later else 0.0)
        expected = expected + correction * grads[t]
    np.testing.assert_allclose(total, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("kind", ["auto", "torch"])
@pytest.mark.parametrize("cut", CUTS)
def test_each_cut_lets_through_the_pairs_it_should(cut: str, kind: str) -> None:
    q = REPRESENTATIONS["action-output"]()
    steps = steps_for("action-output", q, np.random.default_rng(5))
    learner = learner_of(q, StreamingSettings(lambda_=LAMBDA, kappa=1e-9, cut=cut), kind)
    total, grads, errors, greedy = frozen_sum(learner, steps)
    expected = np.zeros_like(total)
    for k, t in itertools.combinations_with_replacement(range(len(steps)), 2):
        # Exact: no exploring action after a_k up to and with a_t. Published: none from a_k on up to before a_t.
        crossed = greedy[k + 1 : t + 1] if cut == "watkins" else greedy[k:t]
        if all(crossed) and not any(bool(x.last_t) for x in steps[k:t]):
            fade = np.prod([float(x.discount_t) * LAMBDA for x in steps[k:t]])
            expected += errors[t] * fade * grads[k]
    np.testing.assert_allclose(total, expected, rtol=1e-10, atol=1e-10)


def test_the_cuts_differ_by_what_reaches_over_an_exploring_step() -> None:
    """Greedy, exploring, greedy: the exact cut keeps the error of the exploring step from the first state."""
    found = {}
    for cut in CUTS:
        q = TableQ(4, 2)
        learner = learner_of(q, StreamingSettings(lambda_=0.5, kappa=1e-9, cut=cut), discount=1.0)
        learner.engine.flat.values[:] = torch.tensor([0.0, -1.0] * 4)  # action 1 explores everywhere
        for s, a, r, last in ((0, 0, 0.0, False), (1, 1, 8.0, False), (2, 0, 4.0, True)):
            learner.update(row(s, a, r, 0.0 if last else 1.0, s + 1, last))
        found[cut] = (learner.engine.all(torch.arange(4)) - torch.tensor([0.0, -1.0])).tolist()
    # δ = 0, 9, 4 (values of successors are 0 when they are used). Exact: state 1 gets 9 + ½·4, state 0 nothing.
    assert found["watkins"][:3] == [[0.0, 0.0], [0.0, 11.0], [4.0, 0.0]]
    # Published: state 0 gets ½·9 over the exploring action, state 1 nothing of what followed.
    assert found["published"][:3] == [[4.5, 0.0], [0.0, 9.0], [4.0, 0.0]]


def test_lambda_zero_is_one_step_q_learning() -> None:
    rng = np.random.default_rng(2)
    one = learner_of(LinearQ(3, 2, bias=True), StreamingSettings(lambda_=0.0, step_size=0.01, kappa=1.0))
    w, b = np.zeros((2, 3)), np.zeros(2)
    for step in stream(rng, (3,), 2, 60):
        s, a, s_next = step.s_tm1[0].numpy(), int(step.a_tm1), step.s_t[0].numpy()
        delta = float(step.r_t) + float(step.discount_t) * (w @ s_next + b).max() - (w[a] @ s + b[a])
        bound = 0.01 * max(abs(delta), 1) * (np.abs(s).sum() + 1)
        w[a] += 0.01 / max(bound, 1) * delta * s
        b[a] += 0.01 / max(bound, 1) * delta
        one.update(step)
    got = one.engine.all(torch.eye(3).double()).numpy(), one.engine.all(torch.zeros(3).double()).numpy()
    np.testing.assert_allclose(got[0], w.T + b, rtol=1e-12)
    np.testing.assert_allclose(got[1], b, rtol=1e-12)


# Prediction: one action.


@pytest.mark.parametrize("kind", ["auto", "torch"])
def test_with_one_action_it_is_td_lambda(kind: str) -> None:
    """Where the bound is not felt: the plain TD(λ) learner, step for step."""
    steps = stream(np.random.default_rng(8), (3,), 1, 80)

    def network() -> ActionOutputQ:
        return ActionOutputQ((3,), 1, MLP((6,), activation="tanh"), rng=4, dtype=torch.float64)

    streaming = learner_of(network(), StreamingSettings(lambda_=0.7, step_size=0.01, kappa=1e-6), kind)
    plain = PredictionLearner(make_engine(network(), Loss(), "torch"), OnlineSettings(lambda_=0.7, step_size=0.01))
    for step in steps:
        streaming.update(step)
        plain.update(step)
    torch.testing.assert_close(streaming.engine.flat.values, plain.engine.flat.values, rtol=1e-11, atol=1e-13)


# The published program, written plainly: layers, loops over parameters, autograd.


class Published(torch.nn.Module):
    def __init__(self, sizes: tuple[int, ...]) -> None:
        super().__init__()
        self.layers = torch.nn.ModuleList(torch.nn.Linear(i, o) for i, o in itertools.pairwise(sizes))

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.layers[:-1]:
            x = layer(x)
            x = torch.nn.functional.leaky_relu(torch.nn.functional.layer_norm(x, x.shape[-1:]))
        return self.layers[-1](x)  # type: ignore[no-any-return]


def test_it_is_the_published_program() -> None:
    """Stream Q(λ) as Elsayed, Vasan & Mahmood (2024) describe it, in float64 over 200 steps."""
    body = MLP((8, 6), layer_norm=True, activation="leaky_relu", affine=False, sparsity=0.5)
    learner = learner_of(ActionOutputQ((3,), 3, body, rng=2, dtype=torch.float64), StreamingSettings(cut="published"))
    net = Published((3, 8, 6, 3)).double()
    for layer, ours in zip(net.layers, learner.engine.q.trunk.layers, strict=True):  # type: ignore[attr-defined]
        layer.weight.data.copy_(ours.weight[0].T)
        layer.bias.data.copy_(ours.bias[0])
    traces = [torch.zeros_like(p) for p in net.parameters()]
    num_greedy = 0
    for t, step in enumerate(steps_for("mlp", None, np.random.default_rng(1), 200)):
        s, a, s_next, last = step.s_tm1[0], int(step.a_tm1), step.s_t[0], bool(step.last_t)
        if t % 3:  # most actions are greedy
            a = int(net(s).argmax())
        learner.update(row(s.numpy(), a, float(step.r_t), 0.0 if last else GAMMA, s_next.numpy(), last))
        greedy = a == int(net(s).argmax())
        num_greedy += greedy
        with torch.no_grad():
            delta = float(step.r_t) + (0.0 if last else GAMMA * float(net(s_next).max())) - float(net(s)[a])
        grads = torch.autograd.grad(net(s)[a], list(net.parameters()))
        traces = [GAMMA * 0.8 * z + g for z, g in zip(traces, grads, strict=True)]
        bound = 1.0 * 2.0 * max(abs(delta), 1.0) * sum(float(z.abs().sum()) for z in traces)
        for p, z in zip(net.parameters(), traces, strict=True):
            p.data += 1.0 / max(bound, 1.0) * delta * z
        if last or not greedy:
            traces = [torch.zeros_like(z) for z in traces]
    assert 100 < num_greedy < 200
    x = torch.from_numpy(np.random.default_rng(9).standard_normal((20, 3)))
    torch.testing.assert_close(learner.engine.all(x), net(x).detach(), rtol=1e-9, atol=1e-11)


# Compiled and plain.

NORMED = {"layer_norm": True, "activation": "leaky_relu", "sparsity": 0.5}
NETWORKS: dict[str, tuple[tuple[int, ...], Any]] = {
    "plain": ((3,), MLP((8, 7))),
    "sigmoid": ((3,), MLP((8, 7), activation="sigmoid")),
    "tanh, no hidden": ((3,), MLP((), activation="tanh")),
    "normed": ((3,), MLP((8, 7), True, "tanh")),
    "normed, no scale": ((3,), MLP((8, 7), affine=False, **NORMED)),
    "conv": ((2, 6, 5), Conv((4,), (3,), (1,), (7,), affine=False, **NORMED)),
    "two convs": ((2, 9, 8), Conv((3, 4), (3, 2), (2, 1), (7,), layer_norm=True, activation="relu")),
    "conv, not normed": ((2, 7, 6), Conv((3, 2), (2, 2), (1, 2), (), layer_norm=False, activation="tanh")),
}
LAYOUTS = {"action-output": ActionOutputQ, "separate": SeparateQ, "action-input": ActionInputQ}


def both(make: Any, settings: StreamingSettings, steps: list[Transition]) -> tuple[Any, Any]:
    found = []
    for kind in ("auto", "torch"):
        learner = learner_of(make(), settings, kind)
        for step in steps:
            q = learner.values(step.s_tm1)  # all but every third action is greedy
            a = int(step.a_tm1) if len(found) % 2 and False else int(q[0].argmax()) if step.r_t > -0.5 else 0
            seen = learner.update(
                Transition(*(torch.tensor([a]) if f == "a_tm1" else getattr(step, f) for f in FIELDS))
            )
            assert seen.errors.shape == (1,)
        found.append(learner.engine.flat.values.double().numpy())
    return found[0], found[1]


FIELDS = ("s_tm1", "a_tm1", "mu_tm1", "r_t", "discount_t", "s_t", "last_t")


@pytest.mark.parametrize("bound", [BOUNDS[0], *(pytest.param(bound, marks=pytest.mark.slow) for bound in BOUNDS[1:])])
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name == "conv" else name for name in NETWORKS]
)
def test_the_kernels_are_the_tensor_operations(name: str, bound: str) -> None:
    shape, body = NETWORKS[name]
    steps = [
        x.map(lambda v: v.float() if v.dtype == torch.float64 else v)
        for x in stream(np.random.default_rng(6), shape, 3, 100)
    ]
    fast, plain = both(lambda: ActionOutputQ(shape, 3, body, rng=3), StreamingSettings(bound=bound), steps)
    assert np.linalg.norm(fast - plain) <= 1e-5 * np.linalg.norm(plain)


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("bound", BOUNDS)
@pytest.mark.parametrize(
    "layout", [*(pytest.param(name, marks=pytest.mark.slow) for name in LAYOUTS), "linear", "masked"]
)
def test_every_layout_learns_the_same_either_way(layout: str, bound: str, cut: str) -> None:
    steps = stream(np.random.default_rng(7), (3,), 3, 100)

    def make() -> Any:
        if layout == "linear":
            return LinearQ(3, 3)
        inner = LAYOUTS.get(layout, ActionOutputQ)(
            (3,), 3, MLP((6,), affine=False, **NORMED), rng=1, dtype=torch.float64
        )
        return MaskedQ(inner, (3,)) if layout == "masked" else inner

    if layout == "masked":
        legal = torch.tensor([[1.0, 1.0, 0.0]]).double()
        steps = [
            Transition(torch.cat([x.s_tm1, legal], 1), x.a_tm1, x.mu_tm1, x.r_t, x.discount_t,
                       torch.cat([x.s_t, legal], 1), x.last_t)
            for x in steps
        ]  # fmt: skip
    fast, plain = both(make, StreamingSettings(bound=bound, cut=cut), steps)
    assert np.linalg.norm(fast - plain) <= 1e-9 * np.linalg.norm(plain)


@pytest.mark.parametrize("name", NETWORKS)
def test_single_row_values_and_gradients_are_autograds(name: str) -> None:
    shape, body = NETWORKS[name]
    q = ActionOutputQ(shape, 3, body, rng=5, dtype=torch.float64)
    engine = make_engine(q, Loss(), "torch")
    engine.flat.values.add_(torch.from_numpy(0.3 * np.random.default_rng(1).standard_normal(len(engine.flat.values))))
    network = SingleRowNetwork(engine)
    s = torch.from_numpy(np.random.default_rng(0).standard_normal((4, *shape)))
    torch.testing.assert_close(network.values(s), engine.all(s), rtol=1e-12, atol=1e-12)
    for a in range(3):
        step = Transition(s[:1], torch.tensor([a]), s, s, s, s[1:2], s)
        value, target, greedy = network.learn(step, 2.0, 0.5)
        compiled = engine.flat.grad.clone()
        assert value == pytest.approx(float(engine.value_gradient(s[0], torch.tensor(a))), rel=1e-12)
        torch.testing.assert_close(compiled, engine.flat.grad, rtol=1e-10, atol=1e-12)
        assert target == pytest.approx(2 + 0.5 * float(engine.all(s[1]).max()), rel=1e-12)
        assert greedy == (a == int(engine.all(s[0]).argmax()))


def test_divergence_is_not_passed_over() -> None:
    engine = make_engine(ActionOutputQ((2,), 2, MLP(()), rng=0), Loss(), "torch")
    engine.flat.values.fill_(float("nan"))
    s = torch.ones(1, 2)
    step = Transition(s, torch.tensor([0]), s, s, s, s, s)
    assert np.isnan(SingleRowNetwork(engine).learn(step, 1.0, 0.9)[1])


def test_only_known_networks_run_on_single_rows() -> None:
    assert runs_single_row(ActionOutputQ((3,), 2)) and runs_single_row(ActionOutputQ((1, 5, 5), 2, Conv()))
    for other in (SeparateQ((3,), 2), ActionInputQ((3,), 2), TableQ(3, 2), MaskedQ(ActionOutputQ((3,), 2), (3,))):
        assert not runs_single_row(other)
    with pytest.raises(ValueError, match="no single-row kernels for TableQ"):
        SingleRowNetwork(make_engine(TableQ(3, 2), Loss()))


# Settings, shapes, state.


@pytest.mark.parametrize(
    "given",
    [
        {"lambda_": 1.5}, {"bound": "adam"}, {"cut": "naive"}, {"step_size": 0.0}, {"kappa": -1.0},
        {"bound": "adaptive-obgd", "beta2": 1.0}, {"bound": "intentional", "kappa": 2.0}, {"beta2": 0.9},
    ],
    ids=str,
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(given: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=list(given)[-1]):
        StreamingSettings(**given)


@pytest.mark.parametrize("kind", ["auto", "torch"])
def test_one_step_at_a_time_and_only_steps_that_were_taken(kind: str) -> None:
    learner = learner_of(TableQ(3, 2), StreamingSettings(), kind)
    step = row(0, 1, 1.0, 0.9, 1, False)
    with pytest.raises(ValueError, match=r"one step at a time, rows of shape \(1,\), got \(2,\)"):
        learner.update(step.map(lambda x: x.repeat(2)))
    learner.update(step, torch.zeros(1))
    assert learner.num_updates == 0 and not weights(learner).any()
    learner.update(step, torch.ones(1))
    assert learner.num_updates == 1 and weights(learner).any()
    with pytest.raises(ValueError, match=r"actions must lie in 0\.\.1, got 2"):
        learner_of(ActionOutputQ((2,), 2), StreamingSettings(), kind).update(
            row([0.0, 1.0], 2, 1.0, 0.9, [0.0, 1.0], False)
        )


@pytest.mark.parametrize("kind", ["auto", "torch"])
@pytest.mark.parametrize("bound", BOUNDS)
def test_a_restored_learner_goes_on_bit_for_bit(bound: str, kind: str) -> None:
    steps = stream(np.random.default_rng(4), (3,), 3, 60)
    first, second = (
        learner_of(ActionOutputQ((3,), 3, MLP((6,)), rng=seed), StreamingSettings(bound=bound), kind) for seed in (1, 2)
    )
    for step in steps[:26]:  # in the middle of an episode
        first.update(step)
    state = {
        name: {k: v.clone() for k, v in part.items()} if isinstance(part, dict) else part
        for name, part in first.state_dict().items()
    }
    state["parameters"] = first.engine.flat.values.clone()
    for step in steps[26:]:
        first.update(step)
    second.load_state_dict(state)
    for step in steps[26:]:
        second.update(step)
    assert (weights(first) == weights(second)).all() and first.num_updates == second.num_updates == 60


def test_a_new_stream_begins_without_a_trace() -> None:
    learner = learner_of(TableQ(3, 1), StreamingSettings(lambda_=0.5))
    learner.update(row(0, 0, 0.0, 0.9, 1, False))
    learner.begin_streams()
    learner.update(row(1, 0, 1.0, 0.0, 2, True))
    assert weights(learner).tolist() == [0.0, 0.5, 0.0]
