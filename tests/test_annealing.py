"""Step sizes that fall over a run, of the learners that take one step at a time.

Mutants that must die here: a step late or early · a row in which nothing was done counted · a step size that turns
negative past the end · only one of the two step sizes of gradient TD · a count that is forgotten on resuming · an
option that does nothing.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch

from neuralq.learners import GradientSettings, OnlineLearner, OnlineSettings, StreamingLearner, StreamingSettings
from neuralq.learners.gradient.settings import gradient_learner
from neuralq.learners.traces.learner import PredictionLearner
from neuralq.q import TableQ
from neuralq.q.engine import Loss, TorchEngine
from neuralq.types import Transition

TOTAL = 4


def made(which: str, anneal: bool = True) -> Any:
    engine = TorchEngine(TableQ(1, 1), Loss())
    if which == "online":
        return OnlineLearner(engine, OnlineSettings(0.0, 0.1, anneal=anneal), total_steps=TOTAL)
    if which == "gradient":
        settings = GradientSettings(lambda_=0.0, step_size=0.1, step_size_h=0.2, beta=0.0, anneal=anneal)
        return gradient_learner(engine, settings, TableQ(1, 1), total_steps=TOTAL)
    settings_ = StreamingSettings(lambda_=0.0, step_size=0.1, bound=which.split()[0], anneal=anneal)
    return StreamingLearner(engine, settings_, kind=which.split()[1], total_steps=TOTAL)


def learn(learner: Any, weight: float = 1.0) -> float:
    """The value after an episode of one step that earns 1."""
    row = torch.tensor
    step = Transition(row([0]), row([0]), row([1.0]), row([1.0]), row([0.0]), row([0]), row([True]))
    learner.update(step, row([weight]))
    return learner.engine.all(torch.tensor(0)).item()


@pytest.mark.parametrize("which", ["online", "gradient", "obgd torch", "obgd compiled", "intentional compiled"])
def test_the_step_size_falls_to_nothing_over_the_steps_that_were_taken(which: str) -> None:
    learner, expected = made(which), 0.0
    for n in range(TOTAL + 3):
        if n == 2:  # a row in which the environment waited for its reset, and a checkpoint
            assert learn(learner, 0.0) == pytest.approx(expected)
            saved, learner = learner.state_dict(), made(which)
            learner.load_state_dict(saved)
        expected += 0.1 * max(0.0, 1 - n / TOTAL) * (1 - expected)
        assert learn(learner) == pytest.approx(expected)
    constant = made(which, anneal=False)
    assert [learn(constant) for _ in range(TOTAL + 3)][-1] == pytest.approx(1 - 0.9 ** (TOTAL + 3))


def test_the_second_step_size_of_gradient_td_falls_too() -> None:
    learner = made("gradient")
    first = learn(learner), float(learner._core.correction.values[0])
    assert first == (pytest.approx(0.1), pytest.approx(0.2))
    learn(learner)
    delta, h = 1 - 0.1, 0.2
    assert float(learner._core.correction.values[0]) == pytest.approx(h + 0.75 * 0.2 * (delta - h))


def test_what_cannot_fall_is_refused() -> None:
    engine = TorchEngine(TableQ(1, 1), Loss())
    with pytest.raises(ValueError, match="give total_steps, or leave anneal out"):
        OnlineLearner(engine, OnlineSettings(anneal=True))
    with pytest.raises(ValueError, match="constant step size; leave anneal out"):
        OnlineSettings(anneal=True, trace="dutch")
    with pytest.raises(ValueError, match="leave anneal out"):
        PredictionLearner(engine, OnlineSettings(anneal=True))
    PredictionLearner(engine, OnlineSettings())
