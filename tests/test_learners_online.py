"""The online learners: forward view == backward view for every representation, and the named algorithms step by step.

`backward` is the textbook loop with a switch for each off-by-one of the field; `test_each_planted_mistake_is_found`
shows that the streams of these tests tell every one of them from the forward view: the cut one step late, the cut after
the gradient was added (Stream Q's published cut) instead of before, the decay by the discount out of the state, the
trace kept over `last_t`, truncation treated as termination. The importance ratio applied twice is planted in the test
of ratios.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuralq.learners import OnlineLearner, OnlineSettings, PredictionLearner
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, LinearQ, SeparateQ, TableQ
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Engine, Loss
from neuralq.types import Transition

LAYOUTS = ["table", "linear", "action-input", "separate", "action-output"]
NETWORKS = {"action-input": ActionInputQ, "separate": SeparateQ, "action-output": ActionOutputQ}
NUM_STATES, NUM_ACTIONS, LENGTH = 7, 3, 12
FEATURES = torch.from_numpy(np.random.default_rng(5).normal(size=(NUM_STATES, 4)))
SCENARIOS = ["edge", "termination", "truncation", "exploring", "everything"]
LAMBDA, ALPHA = 0.8, 0.1
PLANTS = {
    "cut one step late": "exploring",
    "cut after adding": "exploring",
    "decay out of the state": "edge",
    "kept over last": "truncation",
    "truncation as termination": "truncation",
}


def engine_of(layout: str, kind: str = "auto", outputs: int = NUM_ACTIONS) -> Engine:
    rng = np.random.default_rng(1)
    q: Any
    if layout == "table":
        q = TableQ(NUM_STATES, outputs)
    elif layout == "linear":
        q = LinearQ(4, outputs)
    else:
        q = NETWORKS[layout]((4,), outputs, MLP((6,), activation="tanh"), rng=rng, dtype=torch.float64)
    engine = make_engine(q, Loss(), kind)
    engine.flat.values.copy_(torch.from_numpy(rng.normal(size=engine.flat.values.shape)))
    return engine


def observe(layout: str, states: Tensor) -> Tensor:
    return states if layout == "table" else FEATURES[states]


def stream(layout: str, engine: Engine, scenario: str, seed: int = 0) -> Transition:
    """One environment ``[T]`` in which only the named thing happens; discounts vary from step to step."""
    rng = np.random.default_rng([seed, SCENARIOS.index(scenario)])
    everything = scenario == "everything"
    states = torch.from_numpy(rng.integers(NUM_STATES, size=LENGTH + 1))
    s_tm1, s_t = states[:-1], torch.from_numpy(rng.integers(NUM_STATES, size=LENGTH))
    last = np.zeros(LENGTH, bool)
    discount = rng.uniform(0.4, 1.0, LENGTH)
    if scenario == "termination" or everything:
        last[7] = True
        discount[7] = 0.0
    if scenario == "truncation" or everything:
        last[[3, 9]] = True
    s_t[:-1] = torch.where(torch.from_numpy(~last[:-1]), s_tm1[1:], s_t[:-1])
    s_t[-1] = states[-1]
    a = engine.all(observe(layout, s_tm1)).argmax(-1)
    if scenario == "exploring" or everything:
        explores = torch.zeros(LENGTH, dtype=torch.bool)
        explores[[0, 2, 5, 6]] = True
        a = torch.where(explores, (a + 1) % NUM_ACTIONS, a)
    r, one = torch.from_numpy(rng.normal(size=LENGTH)), torch.ones(LENGTH, dtype=torch.float64)
    d, end = torch.from_numpy(discount), torch.from_numpy(last)
    return Transition(observe(layout, s_tm1), a, one, r, d, observe(layout, s_t), end)


def parts(t: Transition, q: Any) -> tuple[list[float], list[float], list[bool], list[Tensor]]:
    """Per step: Q(s, a), max Q(s'), whether the action explored, and the gradient by autograd."""
    values, bootstraps, explores, grads = [], [], [], []
    parameters = list(q.parameters())
    for k in range(len(t.r_t)):
        every = q.all(t.s_tm1[k])
        picked = every[t.a_tm1[k]]
        found = torch.autograd.grad(picked, parameters, allow_unused=True)
        grads.append(torch.cat([torch.zeros_like(p).reshape(-1) if g is None else g.reshape(-1)
                                for p, g in zip(parameters, found, strict=True)]))  # fmt: skip
        values.append(float(picked.detach()))
        explores.append(bool(picked.detach() < every.detach().max()))
        bootstraps.append(float(q.all(t.s_t[k]).detach().max()))
    return values, bootstraps, explores, grads


def forward(t: Transition, q: Any, watkins: bool = True) -> Tensor:
    """Σ (G − Q) ∇Q with G summed from its definition: n-step returns, weighted, up to the first cut.

    Uncut ("naive") Q(λ) has no such mixture; there G − Q is the sum of the one-step errors, each faded.
    """
    values, bootstraps, explores, grads = parts(t, q)
    total = torch.zeros_like(grads[0])
    for start in range(len(values)):
        g, so_far, factor, weight, error, fade = 0.0, 0.0, 1.0, 1.0, 0.0, 1.0
        for k in range(start, len(values)):
            discount = float(t.discount_t[k])
            error += fade * (float(t.r_t[k]) + discount * bootstraps[k] - values[k])
            so_far += factor * float(t.r_t[k])
            factor *= discount
            n_step = so_far + factor * bootstraps[k]
            cut = k == len(values) - 1 or bool(t.last_t[k])
            if cut or (watkins and explores[k + 1]):
                g += weight * n_step
                break
            g += weight * (1 - LAMBDA) * n_step
            weight *= LAMBDA
            fade *= LAMBDA * discount
        total += ((g - values[start]) if watkins else error) * grads[start]
    return total


def backward(t: Transition, q: Any, plant: str = "") -> Tensor:
    """The trace loop with one mistake planted, or none."""
    values, bootstraps, explores, grads = parts(t, q)
    z, total, into = torch.zeros_like(grads[0]), torch.zeros_like(grads[0]), 0.0
    for k in range(len(values)):
        discount, last = float(t.discount_t[k]), bool(t.last_t[k])
        late = k > 0 and explores[k - 1]
        if plant != "cut after adding" and (late if plant == "cut one step late" else explores[k]):
            z = torch.zeros_like(z)
        z = LAMBDA * (discount if plant == "decay out of the state" else into) * z + grads[k]
        bootstrap = 0.0 if plant == "truncation as termination" and last else discount * bootstraps[k]
        total = total + (float(t.r_t[k]) + bootstrap - values[k]) * z
        if last and plant != "kept over last":
            z = torch.zeros_like(z)
        if plant == "cut after adding" and explores[k]:
            z = torch.zeros_like(z)
        into = discount
    return total


def frozen_sum(learner: OnlineLearner, t: Transition) -> Tensor:
    """The sum of the increments with the weights left alone, divided by the step size."""
    before = learner.engine.flat.values.clone()
    total = torch.zeros_like(before)
    for k in range(len(t.r_t)):
        total += learner.increment(t.map(lambda x, k=k: x[k : k + 1]))[0]
    assert torch.equal(learner.engine.flat.values, before)
    return total / ALPHA


def settings(**given: Any) -> OnlineSettings:
    return OnlineSettings(**({"lambda_": LAMBDA, "step_size": ALPHA} | given))


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("cut", ["watkins", "naive"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_forward_view_equals_backward_view(layout: str, cut: str, scenario: str) -> None:
    engine = engine_of(layout)
    t = stream(layout, engine, scenario)
    got = frozen_sum(OnlineLearner(engine, settings(cut=cut)), t)
    wanted = forward(t, copy.deepcopy(engine.q), cut == "watkins")
    torch.testing.assert_close(got, wanted, rtol=0, atol=1e-10)


@pytest.mark.parametrize("layout", ["linear", "action-output"])
def test_autograd_and_compiled_kernels_give_the_same_traces(layout: str) -> None:
    got = []
    for kind in ("auto", "torch"):
        engine = engine_of(layout, kind)
        got.append(frozen_sum(OnlineLearner(engine, settings()), stream(layout, engine, "everything")))
    torch.testing.assert_close(*got, rtol=0, atol=1e-10)


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("layout", ["table", "action-output"])
def test_each_planted_mistake_is_found(layout: str, plant: str) -> None:
    engine = engine_of(layout)
    t = stream(layout, engine, PLANTS[plant])
    q = copy.deepcopy(engine.q)
    wanted = forward(t, q)
    torch.testing.assert_close(backward(t, q), wanted, rtol=0, atol=1e-10)
    assert float((backward(t, q, plant) - wanted).abs().max()) > 1e-3
    got = frozen_sum(OnlineLearner(engine, settings()), t)
    assert float((got - backward(t, q, plant)).abs().max()) > 1e-3


def test_the_learner_with_its_own_drop_taken_out_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = engine_of("linear")
    t = stream("linear", engine, "truncation")
    learner = OnlineLearner(engine, settings())
    close = learner._core.traces.close
    monkeypatch.setattr(
        learner._core.traces, "close", lambda discount, last, moved: close(discount, last & False, moved)
    )
    assert float((frozen_sum(learner, t) - forward(t, copy.deepcopy(engine.q))).abs().max()) > 1e-3


@pytest.mark.parametrize("trace", ["accumulating", "replacing", "dutch"])
@pytest.mark.parametrize("layout", ["table", "linear"])
def test_each_trace_follows_its_formula_step_by_step(layout: str, trace: str) -> None:
    # Binary features for the linear function; the weights move, so the max and the greedy action do as well.
    bits = torch.from_numpy(np.random.default_rng(2).integers(2, size=(NUM_STATES, 4)).astype(np.float64))
    engine = engine_of(layout)
    states = torch.from_numpy(np.random.default_rng(3).integers(NUM_STATES, size=(2, LENGTH)))
    t = stream("table", engine_of("table"), "everything")
    t = Transition(states[0], t.a_tm1, t.mu_tm1, t.r_t, t.discount_t, states[1], t.last_t)
    learner = OnlineLearner(engine, settings(trace=trace), reward_scale=2.0)
    w = engine.flat.values.numpy().copy()

    def x(s: int, a: int) -> Any:
        """Features of the pair in the order of the flat weights: [S, A] (table) or [A, d] (linear)."""
        out = np.zeros((NUM_STATES, NUM_ACTIONS) if layout == "table" else (NUM_ACTIONS, 4))
        if layout == "table":
            out[s, a] = 1
        else:
            out[a] = bits[s]
        return out.reshape(-1)

    z, into, q_old = np.zeros_like(w), 0.0, 0.0
    for k in range(LENGTH):
        s, a, s_next = int(t.s_tm1[k]), int(t.a_tm1[k]), int(t.s_t[k])
        q = [w @ x(s, b) for b in range(NUM_ACTIONS)]
        best = max(w @ x(s_next, b) for b in range(NUM_ACTIONS))
        delta = 2 * float(t.r_t[k]) + float(t.discount_t[k]) * best - q[a]
        grad, z = x(s, a), np.zeros_like(w) if q[a] < max(q) else LAMBDA * into * z
        if trace == "replacing":
            z = np.where(grad != 0, grad, z)
        else:
            z = z + (1 - (ALPHA * (z @ grad) if trace == "dutch" else 0)) * grad
        change = q[a] - q_old if trace == "dutch" and not np.array_equal(z, grad) else 0.0
        w = w + ALPHA * ((delta + change) * z - change * grad)
        into, q_old = float(t.discount_t[k]), best
        if t.last_t[k]:
            z = np.zeros_like(w)
        row = t.map(lambda v, k=k: v[k : k + 1])
        if layout == "linear":
            row = Transition(bits[row.s_tm1], row.a_tm1, row.mu_tm1, row.r_t, row.discount_t, bits[row.s_t], row.last_t)
        learner.update(row)
        np.testing.assert_allclose(engine.flat.values.numpy(), w, rtol=0, atol=1e-12)
    assert learner.num_updates == LENGTH


def episode(seed: int, length: int, terminates: bool) -> tuple[Any, Any, Any]:
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(length + 1, 4))
    discounts = rng.uniform(0.5, 1.0, length)
    if terminates:
        discounts[-1] = 0
    return x, rng.normal(size=length), discounts


def online_lambda_return_weights(w: Any, x: Any, r: Any, discounts: Any, lambda_: float = LAMBDA) -> list[Any]:
    """The online λ-return algorithm (van Seijen et al., 2016, eqs. 7-9): at every horizon, all over again.

    The n-step return from t bootstraps from the weights that were current when it could first be computed.
    """
    current = [w.copy()]  # current[h]: the weights after the steps up to horizon h
    for horizon in range(1, len(r) + 1):
        v = w.copy()
        for t in range(horizon):
            g, so_far, factor = 0.0, 0.0, 1.0
            for n in range(1, horizon - t + 1):
                so_far += factor * r[t + n - 1]
                factor *= discounts[t + n - 1]
                n_step = so_far + factor * (current[t + n - 1] @ x[t + n])
                weight = lambda_ ** (n - 1) * (1 if n == horizon - t else 1 - lambda_)
                g += weight * n_step
            v = v + ALPHA * (g - v @ x[t]) * x[t]
        current.append(v)
    return current[1:]


def prediction_row(x: Any, r: Any, discounts: Any, k: int, last: bool) -> Transition:
    def row(value: Any) -> Tensor:
        return torch.as_tensor(np.asarray(value))[None]

    return Transition(row(x[k]), row(0), row(1.0), row(r[k]), row(discounts[k]), row(x[k + 1]), row(last))


@pytest.mark.parametrize("trace", ["dutch", "accumulating"])
def test_true_online_td_equals_the_online_lambda_return_algorithm(trace: str) -> None:
    engine = make_engine(LinearQ(4, 1), Loss())
    learner = PredictionLearner(engine, settings(trace=trace))
    w = np.random.default_rng(9).normal(size=4)
    engine.flat.values.copy_(torch.from_numpy(w))
    worst = 0.0
    for seed, terminates in ((0, True), (1, False), (2, True)):
        x, r, discounts = episode(seed, 7, terminates)
        for k, wanted in enumerate(online_lambda_return_weights(w, x, r, discounts)):
            learner.update(prediction_row(x, r, discounts, k, k == 6))
            worst = max(worst, float(np.abs(engine.flat.values.numpy() - wanted).max()))
        w = wanted
    # Accumulating traces are the negative control: equal only in the limit of small steps.
    assert worst < 1e-10 if trace == "dutch" else worst > 1e-3


@pytest.mark.parametrize("trace", ["accumulating", "dutch"])
def test_several_outputs_at_once_equal_as_many_learners(trace: str) -> None:
    joint = PredictionLearner(make_engine(LinearQ(4, 3), Loss()), settings(trace=trace))
    single = [PredictionLearner(make_engine(LinearQ(4, 1), Loss()), settings(trace=trace)) for _ in range(3)]
    for seed in range(3):
        x, r, discounts = episode(seed, 6, seed == 1)
        rewards = np.stack([r, r**2, 1 - r], axis=1)
        for k in range(6):
            joint.update(prediction_row(x, rewards, discounts, k, k == 5))
            for i, learner in enumerate(single):
                learner.update(prediction_row(x, rewards[:, i], discounts, k, k == 5))
    for i, learner in enumerate(single):
        torch.testing.assert_close(joint.engine.flat.values[4 * i : 4 * i + 4], learner.engine.flat.values)


@pytest.mark.parametrize("power", [1, 2])
def test_the_importance_ratio_is_applied_once(power: int) -> None:
    # Frozen weights: Σₖ δₖ Σ_{t≤k} ρ_t (Π_{t<j≤k} discount_{j-1} λ ρ_j) x_t. The square is the planted mistake.
    learner = PredictionLearner(make_engine(LinearQ(4, 1), Loss()), settings())
    w = np.random.default_rng(9).normal(size=4)
    learner.engine.flat.values.copy_(torch.from_numpy(w))
    x, r, discounts = episode(4, 8, True)
    rho = np.random.default_rng(4).uniform(0.2, 2.5, 8)
    got, wanted = torch.zeros(4, dtype=torch.float64), np.zeros(4)
    for k in range(8):
        row = prediction_row(x, r, discounts, k, k == 7)
        got += learner.increment(row, torch.tensor([rho[k]]))[0] / ALPHA
        delta = r[k] + discounts[k] * (w @ x[k + 1]) - w @ x[k]
        for t in range(k + 1):
            faded = np.prod([discounts[j - 1] * LAMBDA * rho[j] ** power for j in range(t + 1, k + 1)])
            wanted += delta * rho[t] ** power * faded * x[t]
    assert (np.abs(got.numpy() - wanted).max() < 1e-10) == (power == 1)


def test_ratios_need_accumulating_traces_and_prediction_has_no_cut() -> None:
    engine = make_engine(LinearQ(4, 1), Loss())
    x, r, discounts = episode(4, 2, True)
    with pytest.raises(ValueError, match="on-policy"):
        PredictionLearner(engine, settings(trace="dutch")).update(
            prediction_row(x, r, discounts, 0, False), torch.ones(1)
        )
    with pytest.raises(ValueError, match="leave cut at its default"):
        PredictionLearner(engine, settings(cut="naive"))
    with pytest.raises(ValueError, match="not derived for uncut"):
        settings(trace="dutch", cut="naive")
    for layout in NETWORKS:
        with pytest.raises(ValueError, match=r"tables and linear features only, got .*Q; use trace='accumulating'"):
            OnlineLearner(engine_of(layout), settings(trace="dutch"))


def lanes_of(layout: str, engine: Engine, count: int) -> Transition:
    each = [stream(layout, engine, "everything", seed) for seed in range(count)]
    names = Transition.__slots__
    return Transition(*(torch.stack([getattr(t, name) for t in each], 1) for name in names))


@pytest.mark.parametrize("trace", ["accumulating", "dutch"])
@pytest.mark.parametrize("layout", ["table", "linear", "action-output"])
def test_environments_add_up_and_keep_their_own_traces(layout: str, trace: str) -> None:
    if layout == "action-output" and trace == "dutch":
        return  # refused, see above
    engine = engine_of(layout)
    t = lanes_of(layout, engine, 3)
    together = OnlineLearner(engine, settings(trace=trace), num_envs=3)
    alone = [OnlineLearner(engine, settings(trace=trace)) for _ in range(3)]
    for k in range(LENGTH):
        row = t.map(lambda x, k=k: x[k])
        got, seen = together.increment(row)
        each = [learner.increment(row.map(lambda x, i=i: x[i : i + 1]))[0] for i, learner in enumerate(alone)]
        torch.testing.assert_close(got, torch.stack(each).sum(0), rtol=0, atol=1e-12)
        assert seen.errors.shape == (3,)


@pytest.mark.parametrize("layout", ["table", "action-input"])
def test_an_environment_of_weight_zero_neither_learns_nor_loses_its_trace(layout: str) -> None:
    engine = engine_of(layout)
    t = lanes_of(layout, engine, 2)
    plain, pausing = (OnlineLearner(engine, settings(), num_envs=2) for _ in range(2))
    for k in range(4):
        row = t.map(lambda x, k=k: x[k])
        wanted = plain.increment(row)[0]
        torch.testing.assert_close(pausing.increment(row)[0], wanted, rtol=0, atol=0)
        pause = t.map(lambda x: x[9])
        pause.r_t[1] = 1e6
        nobody = torch.tensor([0.0, 0.0])
        assert not pausing.increment(pause, nobody)[0].any()


@pytest.mark.parametrize("trace", ["accumulating", "replacing", "dutch"])
def test_a_saved_learner_goes_on_bit_for_bit_and_streams_can_begin_anew(trace: str) -> None:
    one = OnlineLearner(engine_of("linear"), settings(trace=trace))
    t = stream("linear", one.engine, "exploring")
    rows = [t.map(lambda x, k=k: x[k : k + 1]) for k in range(LENGTH)]
    for row in rows[:5]:
        one.update(row)
    two = OnlineLearner(engine_of("linear"), settings(trace=trace))
    two.load_state_dict(copy.deepcopy(one.state_dict()))
    for row in rows[5:8]:
        one.update(row)
        two.update(row)
    assert torch.equal(one.engine.flat.values, two.engine.flat.values)
    one.begin_streams()
    fresh = OnlineLearner(two.engine, settings(trace=trace))
    assert torch.equal(one.increment(rows[8])[0], fresh.increment(rows[8])[0])
    assert not torch.equal(two.increment(rows[8])[0], fresh.increment(rows[9])[0])
