"""One network for actions that are each other's rotations, against autograd; lessons against plain Python.

Mutants that die here: an input read at another action's place, a slope of ½ left out or of the wrong unit, weights
changed before the gradient below them is taken, a bias without its step, another action's network that moves too; a
target from the state that was left, from the worst action, or from beyond the end; merits taught V, or without δ, a
critic with the merits' step size; a softmax of the wrong sign or with its temperature multiplied, the last of the best
for the first; a ring that overwrites the latest lesson, a lesson begun with the steps of the one before, an oldest
lesson preferred; a lesson lived through forwards, one step short, or with all steps passed over but those that were.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from neuralq.learners import (
    Lessons,
    TurnedNetwork,
    begin_lesson,
    new_lessons,
    new_turned_network,
    note_step,
    recent_lesson,
    replay_actor_critic,
    replay_q,
    turned_action,
    turned_actor_critic_update,
    turned_policy,
    turned_q_update,
    turned_update,
    turned_values,
)
from neuralq.tabular import new_stream

NUM_INPUTS, NUM_ACTIONS = 6, 3


def drawn(seed: int = 0, num_actions: int = NUM_ACTIONS, *, shared: bool = True) -> TurnedNetwork:
    """Weights large enough that every one of them counts."""
    rng = np.random.default_rng(seed)
    places = [rng.permutation(NUM_INPUTS) for _ in range(num_actions)]
    return new_turned_network(places, 4, rng, scale=1.0, shared=shared)


def bits(rng: np.random.Generator) -> Any:
    return rng.integers(-1, 3, NUM_INPUTS).astype(np.int8)


def copied(network: TurnedNetwork) -> TurnedNetwork:
    return TurnedNetwork(*(part.copy() for part in network))


def written(weights: list[torch.Tensor], network: TurnedNetwork, x: Any, a: int) -> torch.Tensor:
    """The value of an action: input i stands at place i of that action's order."""
    w, b, v, c = (part[int(network.nets[a])] for part in weights)
    seen = torch.zeros(NUM_INPUTS, dtype=torch.float64)
    seen[torch.from_numpy(network.places[a])] = torch.as_tensor(x, dtype=torch.float64)
    return torch.tanh((c + v @ torch.tanh((b + seen @ w) / 2)) / 2)


def same(one: TurnedNetwork, other: TurnedNetwork) -> bool:
    return all(np.allclose(p, q, rtol=1e-12, atol=1e-14) for p, q in zip(one[:4], other[:4], strict=True))


@pytest.mark.parametrize("shared", [True, False])
def test_a_step_is_that_of_autograd(shared: bool) -> None:
    network, rng = drawn(shared=shared), np.random.default_rng(1)
    assert len(network.c) == (1 if shared else NUM_ACTIONS)
    for a in (0, 2, 1, 2):
        x, target = bits(rng), float(rng.normal())
        weights = [torch.tensor(part, requires_grad=True) for part in network[:4]]
        values = [written(weights, network, x, other).item() for other in range(NUM_ACTIONS)]
        assert turned_values(network, x) == pytest.approx(max(values), rel=1e-12)
        assert network.q == pytest.approx(values, rel=1e-12)
        value = written(weights, network, x, a)
        gradients = torch.autograd.grad(0.5 * (target - value) ** 2, weights)
        assert turned_update(network, x, a, target, 0.2) == pytest.approx(target - value.item(), rel=1e-12)
        for after, before, gradient in zip(network[:4], weights, gradients, strict=True):
            assert np.allclose(after, (before - 0.2 * gradient).detach().numpy(), rtol=1e-11, atol=1e-14)


def test_targets_of_q_learning_and_of_the_actor_critic() -> None:
    network, critic, rng = drawn(), drawn(5, 1), np.random.default_rng(2)
    for discount in (0.9, 0.0):
        x, x_t, expected = bits(rng), bits(rng), copied(network)
        target = 0.3 + discount * turned_values(expected, x_t)
        error = turned_update(expected, x, 1, target, 0.2)
        assert turned_q_update(network, x, 1, 0.3, discount, x_t, 0.2) == error and same(network, expected)
        merits, judge = copied(network), copied(critic)
        delta = 0.3 + discount * turned_values(judge, x_t) - turned_values(judge, x)
        turned_values(merits, x)
        turned_update(merits, x, 2, merits.q[2] + delta, 0.2)
        turned_update(judge, x, 0, turned_values(judge, x) + delta, 0.05)
        given = turned_actor_critic_update(network, critic, x, 2, 0.3, discount, x_t, 0.2, 0.05)
        assert given == pytest.approx(delta, rel=1e-12) and same(network, merits) and same(critic, judge)
    nothing = np.full(NUM_INPUTS, np.nan)  # where the world has ended there is nothing to look at
    assert math.isfinite(turned_q_update(network, np.ones(NUM_INPUTS), 0, 1.0, 0.0, nothing, 0.1))


def test_policy_and_action() -> None:
    network, x, stream = drawn(3), bits(np.random.default_rng(3)), new_stream(0)
    turned_values(network, x)
    q = network.q.copy()
    law = np.exp(q / 0.4) / np.exp(q / 0.4).sum()
    assert [turned_policy(network, x, a, 0.4) for a in range(3)] == pytest.approx(law.tolist(), rel=1e-12)
    shares = np.bincount([turned_action(network, x, 0.4, stream) for _ in range(4000)], minlength=3) / 4000
    assert np.abs(shares - law).max() < 4 * 0.5 / math.sqrt(4000)
    assert turned_action(network, x, 0.0, stream) == q.argmax()
    order = np.arange(NUM_INPUTS)
    tied = new_turned_network([order, order, order[::-1]], 4, np.random.default_rng(0), scale=1.0)
    for seed in range(20):
        x = bits(np.random.default_rng(seed))
        turned_values(tied, x)
        assert turned_action(tied, x, 0.0, stream) == (0 if tied.q[0] >= tied.q[2] else 2)


def test_the_latest_lessons_are_kept() -> None:
    lessons, rng, kept = new_lessons(3, 5, NUM_INPUTS), np.random.default_rng(4), []
    for _ in range(8):
        xs = [bits(rng)]
        begin_lesson(lessons, xs[0])
        steps: list[tuple[int, float, float]] = []
        for _ in range(int(rng.integers(6))):
            steps.append((int(rng.integers(3)), float(rng.normal()), float(rng.random())))
            xs.append(bits(rng))
            assert note_step(lessons, *steps[-1], xs[-1])
        kept = [*kept, (xs, steps)][-3:]
        for age, (seen, was) in enumerate(reversed(kept)):
            slot = (int(lessons.begun[0]) - 1 - age) % 3
            n = int(lessons.lengths[slot])
            parts = (lessons.actions[slot, :n], lessons.rewards[slot, :n], lessons.discounts[slot, :n])
            assert list(zip(*(part.tolist() for part in parts), strict=True)) == was
            assert np.array_equal(lessons.x[slot, : n + 1], seen)
    begin_lesson(lessons, xs[0])
    assert [note_step(lessons, 0, 0.0, 1.0, xs[0]) for _ in range(6)] == [True] * 5 + [False]


@pytest.mark.parametrize(("num_begun", "recency"), [(2, 3.0), (5, 3.0), (7, 0.0)])
def test_late_lessons_are_drawn_more_often(num_begun: int, recency: float) -> None:
    lessons, stream, n = new_lessons(4, 1, 1), new_stream(1), min(num_begun, 4)
    for _ in range(num_begun):
        begin_lesson(lessons, np.zeros(1))
    slots = [recent_lesson(lessons, recency, stream) for _ in range(4000)]
    ages = np.bincount([(num_begun - 1 - slot) % 4 for slot in slots], minlength=n) / 4000
    law = np.exp(-recency * np.arange(n) / n)
    assert len(ages) == n and np.abs(ages - law / law.sum()).max() < 4 * 0.5 / math.sqrt(4000)


def lesson() -> Lessons:
    """The second of two slots has six steps."""
    lessons, rng = new_lessons(2, 8, NUM_INPUTS), np.random.default_rng(6)
    begin_lesson(lessons, bits(rng))
    begin_lesson(lessons, bits(rng))
    for t in range(6):
        note_step(lessons, int(rng.integers(3)), float(rng.normal()), 0.9 * (t < 5), bits(rng))
    return lessons


@pytest.mark.parametrize("least", [0.0, 0.3])
def test_a_lesson_is_lived_through_backwards(least: float) -> None:
    lessons, network, merits, critic = lesson(), drawn(7), drawn(8), drawn(9, 1)
    expected, actor, judge, learned = copied(network), copied(merits), copied(critic), [0, 0]
    for t in reversed(range(6)):
        x, a, x_t = lessons.x[1, t], int(lessons.actions[1, t]), lessons.x[1, t + 1]
        r, discount = float(lessons.rewards[1, t]), float(lessons.discounts[1, t])
        if turned_policy(expected, x, a, 0.3) >= least:
            turned_q_update(expected, x, a, r, discount, x_t, 0.2)
            learned[0] += 1
        if turned_policy(actor, x, a, 0.3) >= least:
            turned_actor_critic_update(actor, judge, x, a, r, discount, x_t, 0.2, 0.1)
            learned[1] += 1
    assert replay_q(network, lessons, 1, 0.2, 0.3, least) == learned[0] and same(network, expected)
    assert replay_actor_critic(merits, critic, lessons, 1, 0.2, 0.1, 0.3, least) == learned[1]
    assert same(merits, actor) and same(critic, judge)
    assert learned == [6, 6] if least == 0.0 else 0 < min(learned) <= max(learned) < 6, learned


@pytest.mark.parametrize(
    ("places", "given", "said"),
    [
        ([[0, 1], [1, 1]], {}, "places must be a row for each action"),
        ([0, 1], {}, "places must be a row for each action"),
        ([], {}, "places must be a row for each action"),
        ([[0, 1]], {"num_hidden": 0}, "num_hidden must be"),
        ([[0, 1]], {"scale": 0.0}, "scale must be"),
    ],
)
def test_orders_that_are_none_are_refused(places: Any, given: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        new_turned_network(places, **{"num_hidden": 2, "rng": np.random.default_rng(0), **given})


@pytest.mark.parametrize("given", [(0, 1, 1), (1, 0, 1), (1, 1, 0)])
def test_no_room_is_refused(given: tuple[int, int, int]) -> None:
    with pytest.raises(ValueError, match="must be a whole number of at least 1"):
        new_lessons(*given)
