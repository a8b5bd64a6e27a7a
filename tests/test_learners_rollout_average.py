"""Averages of the iterates: their weights by hand, what they leave alone, and that a stopped run keeps them.

Mutants that die here: weights that are not normalised (the start would count) · a window counted in rollouts, not in
gradient steps · the iterate taken in before the step in place of after it · evaluation with the learned parameters ·
evaluation that leaves the average behind in the engine, also when it fails · learning that sees the average · best
parameters or loaded agents that are not the average · an average, or its count, left out of the checkpoint · targets
that are refreshed when they should not be, or not when they should.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from neuralq.learners import RolloutLearner, RolloutSettings
from neuralq.learners.averaging import IterateAverage, evaluating_with, evaluation_parameters
from neuralq.q import MLP, ActionOutputQ, TableQ
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Loss, TorchEngine
from neuralq.runs import RunConfig, load, resume, train
from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.best import load_best
from neuralq.runs.folder.run_folder import read_metrics
from neuralq.runs.recipe.build import build_session
from neuralq.types import Transition

HALVES = {"num_envs": 1, "num_steps": 2, "num_minibatches": 1, "optimiser": "sgd", "learning_rate": 0.5}


def pair() -> Transition:
    """Two steps from state 0 that end with reward 8: the value of its only action moves half way to 8 at rate ½."""
    one = torch.ones(2, 1, dtype=torch.float64)
    zero = torch.zeros(2, 1, dtype=torch.int64)
    return Transition(zero, zero, one, 8 * one, 0 * one, zero, one > 0)


def learner_of(**given: Any) -> RolloutLearner:
    engine = make_engine(TableQ(1, 1), Loss())
    return RolloutLearner(engine, RolloutSettings(**{**HALVES, **given}), np.random.default_rng(0))


def test_weights_are_normalised_powers_of_beta() -> None:
    theta = torch.tensor([99.0, -99.0], dtype=torch.float64)
    average = IterateAverage(theta, window=4.0)  # β = ¾
    for x in (1.0, 2.0, 5.0):
        theta[:] = torch.tensor([x, -x])
        average.update()
    # (9/16·1 + 3/4·2 + 5) / (9/16 + 3/4 + 1) = (113/16)/(37/16)
    assert average.values.tolist() == pytest.approx([113 / 37, -113 / 37], rel=1e-14)
    assert theta.tolist() == [5.0, -5.0]


def test_a_window_of_one_step_is_the_last_iterate_and_a_wide_one_the_plain_mean() -> None:
    last, mean = (IterateAverage(theta := torch.zeros(1, dtype=torch.float64), window) for window in (1.0, 1e9))
    for average, expected in ((last, 5.0), (mean, 3.0)):
        theta = average._iterate
        for x in (1.0, 3.0, 5.0):
            theta.fill_(x)
            average.update()
        assert average.values.item() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("window", [0.5, float("nan"), float("inf"), -1.0])
def test_windows_below_one_are_refused(window: float) -> None:
    with pytest.raises(ValueError, match="window must be a finite number of at least 1"):
        IterateAverage(torch.zeros(1), window)


def test_a_window_of_rollouts_counts_the_gradient_steps_of_all_their_minibatches() -> None:
    learner = learner_of(num_epochs=2, num_minibatches=2, average_updates=1.0)  # four steps per rollout: β = ¾
    learner.update(pair())
    # each step goes half way to 8: 4, 6, 7, 7.5; weighted (27/64, 9/16, ¾, 1) = (27·4 + 36·6 + 48·7 + 64·7.5)/175
    assert evaluation_parameters(learner).tolist() == pytest.approx([1140 / 175], rel=1e-15)


def test_the_learner_averages_after_every_gradient_step() -> None:
    learner = learner_of(num_epochs=2, average_updates=1.0)  # two steps per rollout: β = ½
    learner.update(pair())
    # from 0 half way to 8, twice: 4, 6; the average (½·4 + 6)/(½ + 1) = 16/3
    assert learner.engine.flat.values.tolist() == [6.0]
    assert evaluation_parameters(learner).tolist() == pytest.approx([16 / 3], rel=1e-15)
    learner.update(pair())
    # 7, 7.5; (½³·4 + ½²·6 + ½·7 + 7.5)/(½³ + ½² + ½ + 1) = 13/1.875
    assert evaluation_parameters(learner).tolist() == pytest.approx([13 / 1.875], rel=1e-15)


def test_learning_never_sees_the_average() -> None:
    plain, averaged = learner_of(num_epochs=3), learner_of(num_epochs=3, average_updates=2.0)
    for learner in (plain, averaged):
        for _ in range(4):
            learner.update(pair())
            with evaluating_with(learner):
                pass
    assert torch.equal(plain.engine.flat.values, averaged.engine.flat.values)
    assert evaluation_parameters(plain) is plain.engine.flat.values, "without an average one plays what one learns"


@pytest.mark.parametrize("kind", ["torch", "compiled"])
def test_playing_swaps_for_the_block_only_even_if_it_fails(kind: str) -> None:
    engine = make_engine(ActionOutputQ((2,), 2, MLP((4,)), rng=np.random.default_rng(0)), Loss(), kind)
    assert isinstance(engine, TorchEngine) == (kind == "torch")
    learner = RolloutLearner(engine, RolloutSettings(average_updates=1.0), np.random.default_rng(0))
    s = torch.ones(1, 2)
    start = engine.all(s).clone()
    engine.flat.values.add_(1.0)
    learned = engine.all(s).clone()
    with pytest.raises(KeyError), evaluating_with(learner):
        assert torch.equal(engine.all(s), start)  # no step was taken: the average is still where it began
        raise KeyError
    assert torch.equal(engine.all(s), learned) and not torch.equal(start, learned)


def test_a_saved_learner_goes_on_with_its_average_bit_for_bit() -> None:
    one, two = (learner_of(num_epochs=2, average_updates=3.0) for _ in range(2))
    for _ in range(3):
        one.update(pair())
    two.load_state_dict(copy.deepcopy(one.state_dict()))
    two.rng.bit_generator.state = one.rng.bit_generator.state
    for learner in (one, two):
        learner.update(pair())
    assert torch.equal(evaluation_parameters(one), evaluation_parameters(two))
    assert not torch.equal(evaluation_parameters(one), one.engine.flat.values)


def test_refreshed_targets_are_those_of_the_moment() -> None:
    """One state that leads to itself with reward 1 and γ = ½; λ = 0, rate ½; the rollout is one step."""
    one = torch.ones(1, 1, dtype=torch.float64)
    zero = torch.zeros(1, 1, dtype=torch.int64)
    t = Transition(zero, zero, one, one, 0.5 * one, zero, one < 0)
    for refresh, expected in ((False, 0.75), (True, 0.875)):
        learner = learner_of(num_steps=1, num_epochs=2, lambda_=0.0, refresh_targets=refresh)
        learner.update(t)
        # from 0 half way to 1: ½; then half way to 1 again: ¾, or to the target of the moment 1 + ½·½: 7/8
        assert learner.engine.flat.values.tolist() == [expected]


def test_the_learning_rate_falls_to_its_share_and_stays() -> None:
    learner = learner_of(num_epochs=1, anneal=True, anneal_to=0.25)
    learner.total_updates = 2
    for expected in (4.0, 5.0, 5.375, 5.703125):  # rates ½, ¼, ⅛, ⅛ of what is missing to 8
        learner.update(pair())
        assert learner.engine.flat.values.tolist() == [expected]


@pytest.mark.parametrize(("given", "updates"), [({}, 19), ({"anneal_env_steps": 100}, 4)])
def test_annealing_lasts_the_run_or_the_steps_that_are_given(given: dict[str, int], updates: int) -> None:
    session = build_session(config_of(anneal=True, **given))  # 600 steps in rollouts of 32
    try:
        assert isinstance(session.learner, RolloutLearner) and session.learner.total_updates == updates
    finally:
        session.close()


@pytest.mark.parametrize("given", [{"anneal_to": 0.1}, {"anneal_env_steps": 10}, {"anneal": True, "anneal_to": 1.5}])
def test_annealing_that_would_be_ignored_is_refused(given: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="anneal_to"):
        RolloutSettings(**given)


def test_normalised_observations_travel_with_the_run(tmp_path: Path) -> None:
    train(config_of(normalise_observations=True), tmp_path / "run")
    agent = load(tmp_path / "run", best=False)
    assert agent.normalisation is not None
    counted = agent.normalisation.state_dict()["observation_count"].item()
    assert counted >= 600, "one observation per step and environment"
    s = np.full(4, 0.5, np.float32)
    mean, squares = (agent.normalisation.state_dict()[f"observation_{name}"] for name in ("mean", "squares"))
    seen = (s - mean) / np.sqrt(squares / (counted - 1) + 1e-8)  # Welford (1962): the sample variance
    q: Any = agent.q
    with torch.no_grad():
        expected = q.all(torch.from_numpy(seen.astype(np.float32))[None])[0].numpy()
    np.testing.assert_allclose(agent.values(s), expected, rtol=1e-5)
    with pytest.raises(ValueError, match="state indices have no mean"):
        build_session(
            RunConfig(env="FrozenLake-v1", layout="table", rollout=RolloutSettings(normalise_observations=True))
        )


@pytest.mark.parametrize("value", [0.0, -1.0, 0.01])
def test_windows_shorter_than_a_step_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match="average_updates"):
        RolloutSettings(average_updates=value)
    assert RolloutSettings().average_updates is None


class Stopped(BaseException):
    """Ends a run in the middle, as a kill would."""


def config_of(**settings: Any) -> RunConfig:
    small = {"num_envs": 4, "num_steps": 8, "num_epochs": 2, "num_minibatches": 2, "learning_rate": 0.01}
    return RunConfig(
        body=MLP((16,)), total_steps=600, evaluate_every=200, evaluation_episodes=2, checkpoint_every=150, log_every=50,
        rollout=RolloutSettings(**{**small, **settings}),
    )  # fmt: skip


def evaluations(path: Path) -> list[float]:
    return [row["greedy_return"] for row in read_metrics(path) if row["kind"] == "evaluation"]


def test_a_stopped_run_goes_on_with_its_average(tmp_path: Path) -> None:
    config = config_of(average_updates=4.0)
    whole = train(config, tmp_path / "whole")

    def stop(row: Mapping[str, Any]) -> None:
        if row["kind"] == "train" and row["env_steps"] >= 400:
            raise Stopped

    with pytest.raises(Stopped):
        train(config, tmp_path / "parts", [stop])
    parts = resume(tmp_path / "parts")
    assert parts.parameters_sha256 == whole.parameters_sha256
    assert evaluations(tmp_path / "parts") == evaluations(tmp_path / "whole")
    agents = [load(tmp_path / name) for name in ("whole", "parts")]
    s = np.zeros(4, np.float32)
    assert np.array_equal(agents[0].values(s), agents[1].values(s))


class Watcher:
    """Keeps what the learner would play with at each row."""

    def __init__(self) -> None:
        self.evaluation_parameters: dict[int, torch.Tensor] = {}

    def observe(self, learner: RolloutLearner, sample: object, /) -> None:
        self._now = evaluation_parameters(learner).clone()

    def __call__(self, row: Mapping[str, Any], /) -> None:
        self.evaluation_parameters[row["env_steps"]] = self._now


def test_evaluations_best_and_loaded_agents_play_the_average(tmp_path: Path) -> None:
    watcher = Watcher()
    train(config_of(average_updates=4.0), tmp_path / "run", [watcher])
    train(config_of(), tmp_path / "plain")
    assert evaluations(tmp_path / "run") != evaluations(tmp_path / "plain")
    state, plain = (
        checkpoint.load_newest(tmp_path / name / "checkpoints").state["learner"] for name in ("run", "plain")
    )
    learned = torch.as_tensor(state["descent"]["parameters"])
    assert torch.equal(learned, torch.as_tensor(plain["descent"]["parameters"])), "experience and learning are the same"
    average = torch.as_tensor(state["average"]["values"])

    def evaluation_parameters(path: Path, best: bool) -> torch.Tensor:
        q: Any = load(path, best).q
        return torch.cat([p.detach().reshape(-1) for p in q.parameters()])

    assert torch.equal(evaluation_parameters(tmp_path / "run", best=False), average) and not torch.equal(
        average, learned
    )
    assert torch.equal(evaluation_parameters(tmp_path / "plain", best=False), learned)
    best = load_best(tmp_path / "run")
    assert torch.equal(best.parameters, watcher.evaluation_parameters[best.env_steps])
    assert torch.equal(evaluation_parameters(tmp_path / "run", best=True), best.parameters)
