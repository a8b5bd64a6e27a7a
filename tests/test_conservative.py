"""The conservative penalty: its gradient, its fixed point, and that without it nothing is otherwise.

Mutants that must die here: a sign · the softmax of the target's values · one action's share for all · a mean taken
twice · weights forgotten · α in the wrong place of the closed form.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from neuralq.learners import ReplaySettings
from neuralq.learners.replay.conservative import conservative_gradient
from neuralq.learners.replay.learner import ReplayLearner
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, MaskedQ, SeparateQ, TableQ
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Loss, TorchEngine
from neuralq.types import Transition

LAYOUTS = {"action-output": ActionOutputQ, "separate": SeparateQ, "action-input": ActionInputQ}


def batch(rng: np.random.Generator, masked: bool) -> dict[str, Any]:
    s = torch.from_numpy(rng.normal(size=(6, 3)).astype(np.float32))
    if masked:
        s = torch.cat([s, torch.tensor([[1, 1, 0, 1]] * 3 + [[1, 1, 1, 1]] * 3, dtype=torch.float32)], 1)
    a = torch.tensor([0, 1, 3, 2, 1, 0])
    targets, weight = (torch.from_numpy(rng.uniform(0.1, 2, 6).astype(np.float32)) for _ in range(2))
    return {"s": s, "a": a, "targets": targets, "weight": weight}


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("kind", ["torch", "compiled"])
@pytest.mark.parametrize("layout", sorted(LAYOUTS))
def test_the_gradient_is_that_of_the_written_loss(layout: str, kind: str, masked: bool) -> None:
    rng = np.random.default_rng(0)
    q: Any = LAYOUTS[layout]((3,), 4, MLP((5,)), None, rng)
    q = MaskedQ(q, (3,)) if masked else q
    given, engine = batch(rng, masked), make_engine(q, Loss("huber", 0.5), kind)
    for weight in (given["weight"], None):
        errors = conservative_gradient(engine, given["s"], given["a"], given["targets"], weight, 0.7)
        found = engine.flat.grad.clone()
        values = q.all(given["s"])
        taken = values.gather(-1, given["a"][:, None])[:, 0]
        td = torch.nn.functional.huber_loss(taken, given["targets"], reduction="none", delta=0.5)
        each = td + 0.7 * (torch.logsumexp(values, -1) - taken)
        loss = (each if weight is None else each * weight).mean()
        wanted = torch.cat([g.reshape(-1) for g in torch.autograd.grad(loss, list(q.parameters()))])
        assert torch.allclose(found, wanted, atol=1e-6) and found.abs().max() > 0.01
        assert torch.allclose(errors, (given["targets"] - taken).detach(), atol=1e-6)


def test_a_tables_fixed_point_has_its_closed_form() -> None:
    """One state of three actions, each of which ends the world with its reward; taken 1, 2 and 5 times in 8."""
    counts, rewards, alpha = torch.tensor([1, 2, 5]), torch.tensor([1.0, 0.0, 2.0], dtype=torch.float64), 0.3
    a = torch.repeat_interleave(torch.arange(3), counts)
    one, s = torch.ones(8, dtype=torch.float64), torch.zeros(8, dtype=torch.int64)
    step = Transition(s, a, one, rewards[a], 0 * one, s, one > 0)
    for penalty in (alpha, 0.0):
        settings = ReplaySettings(
            optimiser="sgd", learning_rate=0.5, loss="squared", max_grad_norm=None, conservative_alpha=penalty
        )
        learner = ReplayLearner(TorchEngine(TableQ(1, 3), Loss()), settings)
        for _ in range(2000):
            learner.update(step)
        q = learner.engine.all(torch.tensor(0))
        wanted = rewards - penalty * (torch.softmax(q, -1) / (counts / 8) - 1)
        assert torch.allclose(q, wanted, atol=1e-9)
    assert torch.allclose(q, rewards, atol=1e-9)  # without penalty, what is there


def test_what_it_does_not_go_with_is_refused() -> None:
    for given, said in (
        ({"conservative_alpha": -1.0}, "must be at least 0 and finite, got -1.0"),
        ({"conservative_alpha": 1.0, "distribution": "quantile"}, "got distribution='quantile'; leave one of them out"),
        ({"conservative_alpha": 1.0, "target_rule": "dqrc"}, "got target_rule='dqrc'; leave one of them out"),
    ):
        with pytest.raises(ValueError, match=said):
            ReplaySettings(**given)
    with pytest.raises(ValueError, match="one for each action of 2 states"):
        q = ActionOutputQ((3,), 4, MLP((5,)), None, np.random.default_rng(0))
        make_engine(q, Loss(), "compiled").sum_gradient(torch.zeros(2, 3), torch.zeros(2, 3))
