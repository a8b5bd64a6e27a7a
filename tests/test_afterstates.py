"""TD(λ) over afterstates against autograd and the library's λ-returns, and what a job-shop problem must not be.

Mutants that die here: a bias, a slope or a sign of the gradient left out, weights that are changed before the gradient
below them is taken, λ and 1 − λ exchanged, a target that bootstraps from the state that was left, or where the world
has ended, a last row that is not told what follows it, an episode learned forwards; a choice among rows that are no
actions, the last of the best, a draw among all but the last action; a problem whose fault is named wrongly or not at
all.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from neuralq.learners import ValueNetwork, choose_afterstate, learn_afterstates, new_value_network, value_of
from neuralq.rules import lambda_returns
from neuralq.tabular import new_stream
from neuralq_envs.job_shop import JobShop, random_job_shop


def drawn(num_rows: int, seed: int = 0) -> tuple[ValueNetwork, np.ndarray[Any, Any], Any, Any]:
    """A network whose every weight counts, features, rewards and discounts."""
    rng = np.random.default_rng(seed)
    network = new_value_network(3, 4, seed)
    for part in network[:4]:
        part[:] = rng.normal(size=part.shape)
    return network, rng.normal(size=(num_rows + 1, 3)), rng.normal(size=num_rows), np.full(num_rows, 0.9)


def written(weights: list[torch.Tensor], x: Any) -> torch.Tensor:
    w, b, v, c = weights
    return c[0] + (v * torch.sigmoid(b + w @ torch.as_tensor(x))).sum()


@pytest.mark.parametrize(("lambda_", "ends"), [(0.0, True), (0.7, True), (0.7, False), (1.0, True), (1.0, False)])
def test_an_episode_is_learned_backwards_as_autograd_would(lambda_: float, ends: bool) -> None:
    network, x, r, discounts = drawn(6)
    discounts[-1] = 0.0 if ends else 0.9
    successors = x[1:].copy()
    if ends:
        successors[-1] = np.nan  # where the world has ended there is nothing to look at
    weights = [torch.tensor(part, requires_grad=True) for part in network[:4]]
    following, squares = written(weights, x[-1]).item(), 0.0
    for t in reversed(range(6)):
        value = written(weights, x[t + 1]).item()
        target = r[t] + discounts[t] * ((1 - lambda_) * value + lambda_ * following)
        loss = 0.5 * (target - written(weights, x[t])) ** 2
        squares += 2 * loss.item()
        for part, gradient in zip(weights, torch.autograd.grad(loss, weights), strict=True):
            part.data -= 0.05 * gradient
        following = target
    mean = learn_afterstates(network, x[:-1], r, discounts, successors, lambda_, 0.05)
    assert mean == pytest.approx(squares / 6, rel=1e-12)
    for ours, theirs in zip(network[:4], weights, strict=True):
        assert np.allclose(ours, theirs.detach().numpy(), rtol=1e-11, atol=1e-13)
    assert value_of(network, x[2]) == pytest.approx(written(weights, x[2]).item(), rel=1e-12)


def test_small_steps_go_where_the_librarys_returns_point() -> None:
    network, x, r, discounts = drawn(8, seed=1)
    discounts[-1] = 0.0
    before = [part.copy() for part in network[:4]]
    values = torch.tensor([value_of(network, row) for row in x])
    ends = torch.arange(8) == 7
    returns = lambda_returns(torch.tensor(r), torch.tensor(discounts), values[1:], 0.6, ends)
    weights = [torch.tensor(part, requires_grad=True) for part in before]
    errors = (returns - values[:-1]).tolist()
    towards = torch.stack([error * written(weights, row) for error, row in zip(errors, x[:-1], strict=True)]).sum()
    expected = torch.autograd.grad(towards, weights)
    learn_afterstates(network, x[:-1], r, discounts, x[1:], 0.6, 1e-6)
    for after, old, gradient in zip(network, before, expected, strict=False):
        assert np.allclose((after - old) / 1e-6, gradient.numpy(), rtol=1e-3, atol=1e-4)


def test_the_choice_is_among_as_many_actions_as_there_are() -> None:
    network, x, r, _ = drawn(5, seed=2)
    discounts = np.array([1.0, 1.0, 0.0, 0.5, 1.0])
    x[2], stream = np.nan, new_stream(0)
    q = [r[a] + (discounts[a] * value_of(network, x[a]) if discounts[a] else 0.0) for a in range(5)]
    for count in range(1, 6):
        assert choose_afterstate(network, r, discounts, x, count, 0.0, stream) == int(np.argmax(q[:count]))
    same = np.zeros((5, 3))
    assert choose_afterstate(network, np.zeros(5), np.ones(5), same, 5, 0.0, stream) == 0
    found = [
        choose_afterstate(network, np.array([0.0, 9.0, 0.0]), np.zeros(3), same, 3, 0.6, stream) for _ in range(3000)
    ]
    shares = np.bincount(found) / 3000  # the others are drawn with .6 / 3
    assert np.abs(shares - [0.2, 0.6, 0.2]).max() < 4 * 0.5 / np.sqrt(3000)


FINE: dict[str, Any] = {
    "durations": [2, 3, 4], "requests": [[1], [0], [3]], "before": ((), (0,), (1,)), "capacities": [[2, 3]],
    "pools": [[0], [0], [1]],
}  # fmt: skip


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"before": ((2,), (0,), (1,))}, r"circle: 0 waits for 2 waits for 1 waits for 0; leave one out"),
        ({"before": ((), (1,), (0,))}, r"circle: 1 waits for 1"),
        ({"before": ((), (0,), (5,))}, r"task 2 waits for task 5, and tasks are numbered 0 to 2"),
        ({"requests": [[1], [0], [4]]}, r"task 2 asks for 4 units of type 0, and the largest pool of that type has 3"),
        ({"pools": [[0], [0], [0]]}, r"takes them from pool 0, where they never fit; take one of \[1\]"),
        ({"pools": [[0], [0], [2]]}, r"from pool 2, where they never fit"),
        ({"pools": [[0], [0]]}, r"pools must have the shape of requests"),
        ({"durations": [2, 0, 4]}, r"durations must be a row of whole numbers of at least 1"),
        ({"durations": [2, 2.5, 4]}, r"durations must be a row of whole numbers"),
        ({"capacities": [[-1, 3]]}, r"capacities must be a table of whole numbers of at least 0"),
        ({"requests": [[1], [0]]}, r"3 tasks and 1 types of resource need requests of shape \(3, 1\)"),
        ({"before": ((), ())}, r"3 entries of before, got \(3, 1\) and 2"),
    ],
)
def test_a_problem_that_makes_no_sense_is_refused_in_one_line(given: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said) as refused:
        JobShop(**{**FINE, **given})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("draw", "said"),
    [
        (lambda rng: random_job_shop(rng, 0), "num_missions must be"),
        (lambda rng: random_job_shop(rng, 1, 1), "num_tasks must be"),
        (lambda rng: random_job_shop(rng, 1, 4, [[2]]), "capacities must be a table of whole numbers of at least 3"),
    ],
)
def test_sizes_that_make_no_sense_are_refused(draw: Callable[[np.random.Generator], Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        draw(np.random.default_rng(0))
