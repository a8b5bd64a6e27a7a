"""Experience: what reaches the learner, when, and with which weight.

Mutants that these tests kill: an idle environment that carries a λ-return across its pause; rows of the last rollout
that show through; a sample drawn one step early or late; a period that is forgotten when several environments step at
once; priorities given to the wrong steps; a rollout saved half collected.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import Tensor

from neuralq.learners import OnlineLearner, OnlineSettings, ReplaySettings, RolloutLearner, RolloutSettings
from neuralq.learners.replay.buffer import Prioritised, ReplayBuffer
from neuralq.q import MLP, TableQ
from neuralq.q.engine import Loss, TorchEngine
from neuralq.runs import RunConfig
from neuralq.runs.recipe.build import build_session
from neuralq.runs.stream import Interaction, Step
from neuralq.runs.stream.experience import ReplayExperience, RolloutExperience, Sample
from neuralq.types import Transition

LENGTHS = (3, 1, 4, 2)
GAMMA, N, T = 0.9, 3, 12


class Corridor(gym.Env[Any, Any]):
    """Episodes of scripted lengths; every other one is cut off by a time limit. No environment repeats a state."""

    def __init__(self, env_index: int) -> None:
        self.observation_space = spaces.Discrete(1000)
        self.action_space = spaces.Discrete(2)
        self.env_index, self.episode, self.t, self.clock = env_index, env_index, 0, 0

    def _state(self) -> int:
        return 300 * self.env_index + self.clock

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        self.episode, self.t, self.clock = self.episode + 1, 0, self.clock + 1
        return self._state(), {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        self.t, self.clock = self.t + 1, self.clock + 1
        ends, cut_off = self.t == LENGTHS[self.episode % 4], self.episode % 2 == 0
        return (
            self._state(),
            float(np.sin(self.clock + self.env_index)) + action,
            ends and not cut_off,
            ends and cut_off,
            {},
        )


def stream_of(mode: AutoresetMode, num_envs: int = N) -> Interaction:
    envs = SyncVectorEnv([lambda i=i: Corridor(i) for i in range(num_envs)], autoreset_mode=mode)
    return Interaction(envs, GAMMA, seed=0, as_index=True)


def act(s: Tensor) -> tuple[Tensor, Tensor]:
    return s % 2, torch.full((len(s),), 0.5)


def learner_of(returns: str) -> RolloutLearner:
    engine = TorchEngine(TableQ(1000, 2), Loss())
    engine.flat.values.copy_(torch.from_numpy(np.random.default_rng(0).normal(size=2000)))
    settings = RolloutSettings(lambda_=0.8, returns=returns, num_envs=N, num_steps=T, optimiser="sgd", num_epochs=1)
    return RolloutLearner(engine, settings, np.random.default_rng(0))


def rollout_of(stream: Interaction, experience: RolloutExperience) -> Sample:
    while True:
        experience.add(stream.step(act))
        for sample in experience.draw():
            return sample


@pytest.mark.parametrize("moved", [[0, 1, 2], [0, 2]])
def test_a_step_without_all_its_fields_does_not_leave_those_of_an_earlier_one(moved: list[int]) -> None:
    stream = stream_of(AutoresetMode.NEXT_STEP)
    rows = tuple(row[moved] for row in stream.step(act).rows)
    experience = RolloutExperience(T, N, stream.spec)
    with pytest.raises(ValueError, match="zip"):
        experience.add(Step(rows[:-1], np.array(moved), ()))


@pytest.mark.parametrize("returns", ["peng", "watkins"])
def test_returns_of_real_rows_are_those_of_a_stream_without_pauses(returns: str) -> None:
    learner = learner_of(returns)
    paused, plain = stream_of(AutoresetMode.NEXT_STEP), ByEnvironment(stream_of(AutoresetMode.DISABLED))
    experience = RolloutExperience(T, N, paused.spec)
    for _ in range(3):  # later rollouts are written over earlier ones
        sample = rollout_of(paused, experience)
        assert sample.weight is not None
        held = sample.weight > 0
        assert 0 < int((~held).sum()) < T * N
        targets = learner.targets(sample.transition)
        for env_index in range(N):
            rows = held[:, env_index]
            alone = sample.transition.map(
                lambda x, env_index=env_index, rows=rows: x[rows][:, env_index : env_index + 1]
            )
            wanted = plain.take(env_index, int(rows.sum()))
            for ours, theirs in zip(_fields(alone), _fields(wanted), strict=True):
                assert torch.equal(ours, theirs)
            torch.testing.assert_close(targets[rows, env_index], learner.targets(wanted)[:, 0], rtol=0, atol=1e-12)


class ByEnvironment:
    """Each environment's steps of a stream that never pauses, as many as are asked for."""

    def __init__(self, plain: Interaction) -> None:
        self.plain = plain
        self.waiting: list[list[Transition]] = [[] for _ in range(N)]

    def take(self, env_index: int, count: int) -> Transition:
        """The next ``count`` steps of one environment, ``[count, 1]``."""
        while len(self.waiting[env_index]) < count:
            step = self.plain.step(act)
            for i, queue in enumerate(self.waiting):
                queue.append(step.transition.map(lambda x, i=i: x[i : i + 1]))
        taken, self.waiting[env_index] = self.waiting[env_index][:count], self.waiting[env_index][count:]
        return Transition(*(torch.stack(list(field)) for field in zip(*map(_fields, taken), strict=True)))


def _fields(t: Transition) -> tuple[Tensor, ...]:
    return t.s_tm1, t.a_tm1, t.mu_tm1, t.r_t, t.discount_t, t.s_t, t.last_t


def test_rows_without_experience_have_weight_zero_and_break_the_stream() -> None:
    stream = stream_of(AutoresetMode.NEXT_STEP)
    experience = RolloutExperience(T, N, stream.spec)
    moved = np.zeros((T, N))
    for row in range(T):
        assert experience.between_samples == (row == 0)
        step = stream.step(act)
        experience.add(step)
        moved[row, step.env_indices] = 1
        if row < T - 1:
            assert list(experience.draw()) == []
            with pytest.raises(ValueError, match=rf"half collected \({row + 1} of {T} rows\)"):
                experience.state_dict()
    (sample,) = experience.draw()
    assert sample.weight is not None
    np.testing.assert_array_equal(sample.weight.numpy(), moved)
    idle = sample.weight == 0
    assert sample.transition.last_t[idle].all() and not sample.transition.discount_t[idle].any()
    assert list(experience.draw()) == [] and experience.between_samples and experience.state_dict() == {}


def test_a_full_rollout_has_no_weights_and_keeps_double_precision() -> None:
    stream = stream_of(AutoresetMode.DISABLED)
    sample = rollout_of(stream, RolloutExperience(T, N, stream.spec))
    assert sample.weight is None
    assert sample.transition.r_t.dtype == sample.transition.discount_t.dtype == torch.float64
    assert set(sample.transition.discount_t.unique().tolist()) == {0.0, GAMMA}


def steps_of(num_envs: int, count: int) -> list[Step]:
    stream = stream_of(AutoresetMode.DISABLED, num_envs)
    return [stream.step(act) for _ in range(count)]


def replay_of(num_envs: int, *cadence: int, block_length: int = 1, prioritised: bool = False) -> ReplayExperience:
    settings = Prioritised(alpha=1.0, epsilon=1e-12) if prioritised else None
    buffer = ReplayBuffer(300, (), np.int64, num_envs=num_envs, prioritised=settings)
    return ReplayExperience(buffer, np.random.default_rng(0), 8, block_length, *cadence)


@pytest.mark.parametrize(
    ("num_envs", "cadence", "wanted"),
    [
        (1, (4, 1, 1), [0, 0, 0, 1, 1, 1, 1, 1]),
        (1, (4, 3, 2), [0, 0, 0, 2, 0, 0, 2, 0]),
        (3, (4, 1, 1), [0, 3, 3, 3]),  # six steps stored when the fourth was due: the fifth and sixth are made up for
        (3, (4, 4, 1), [0, 1, 1, 1, 0, 1]),  # due at 4, 8, 12, 16; stored 3, 6, 9, 12, 15, 18
        (3, (1, 2, 1), [2, 1, 2, 1]),  # due at 1, 3 | 5 | 7, 9 | 11
        (2, (2, 5, 3), [3, 0, 0, 3, 0, 3]),  # due at 2, 7, 12
    ],
)
def test_samples_come_when_they_are_due(num_envs: int, cadence: tuple[int, ...], wanted: list[int]) -> None:
    experience = replay_of(num_envs, *cadence)
    got = []
    for step in steps_of(num_envs, len(wanted)):
        experience.add(step)
        got.append(sum(1 for _ in experience.draw()))
        assert experience.between_samples
    assert got == wanted
    assert len(experience.buffer) == num_envs * len(wanted)


def test_what_is_drawn_is_what_was_added() -> None:
    experience = replay_of(3, 1, 1, 1)
    added: dict[int, tuple[float, ...]] = {}
    for step in steps_of(3, 20):
        experience.add(step)
        added |= {int(row[0]): tuple(map(float, row)) for row in zip(*_fields(step.transition), strict=True)}
        for sample in experience.draw():
            assert sample.weight is None and sample.indices is None
            for row in zip(*_fields(sample.transition), strict=True):
                assert tuple(map(float, row)) == pytest.approx(added[int(row[0])], rel=1e-6)


def test_blocks_are_consecutive_steps_of_one_environment() -> None:
    experience = replay_of(3, 12, 3, 1, block_length=4)
    seen = 0
    for step in steps_of(3, 30):
        experience.add(step)
        for sample in experience.draw():
            t, seen = sample.transition, seen + 1
            assert t.r_t.shape == (4, 2)
            goes_on = ~t.last_t[:-1]
            assert torch.equal(t.s_tm1[1:][goes_on], t.s_t[:-1][goes_on])
            assert bool((t.s_tm1[1:] > t.s_tm1[:-1]).all()) and bool((t.s_tm1 // 300 == t.s_tm1[0] // 300).all())
    assert seen == 27


def test_errors_come_back_as_the_priorities_of_the_steps_they_belong_to() -> None:
    experience = replay_of(1, 5, 100, 1, prioritised=True)
    for step in steps_of(1, 5):
        experience.add(step)
    (sample,) = experience.draw()
    assert sample.weight is not None and sample.indices is not None
    # Only the step at index 2 was surprising; from now on it is what is drawn.
    experience.buffer.update_priorities(np.arange(5), np.full(5, 1e-12))
    experience.return_errors(Sample(sample.transition, sample.weight, np.array([2, 4])), torch.tensor([-7.0, 1e-12]))
    assert set(experience.buffer.sample(32, np.random.default_rng(0)).indices.tolist()) == {2}


def test_a_restored_replay_of_draws_the_same() -> None:
    steps = steps_of(2, 12)
    one, two = replay_of(2, 3, 3, 1, prioritised=True), replay_of(2, 3, 3, 1, prioritised=True)
    for step in steps[:7]:
        one.add(step)
        for sample in one.draw():
            one.return_errors(sample, sample.transition.r_t)
    two.load_state_dict(one.state_dict())
    two.rng.bit_generator.state = one.rng.bit_generator.state
    for step in steps[7:]:
        one.add(step)
        two.add(step)
        for ours, theirs in zip(one.draw(), two.draw(), strict=True):
            for x, y in zip(_fields(ours.transition), _fields(theirs.transition), strict=True):
                assert torch.equal(x, y)


def test_every_step_is_passed_on_once_with_pauses_left_out() -> None:
    stream = stream_of(AutoresetMode.NEXT_STEP)
    experience = RolloutExperience(None, N, stream.spec)
    pauses = 0
    for _ in range(20):
        step = stream.step(act)
        experience.add(step)
        assert not experience.between_samples
        (sample,) = experience.draw()
        assert experience.between_samples and list(experience.draw()) == []
        weight = torch.ones(N) if sample.weight is None else sample.weight
        assert torch.nonzero(weight)[:, 0].tolist() == step.env_indices.tolist()
        pauses += N - len(step.env_indices)
        for ours, theirs in zip(_fields(sample.transition), _fields(step.transition), strict=True):
            assert torch.equal(ours[weight > 0], theirs)
    assert pauses > 5


def test_traces_learn_the_same_with_and_without_pauses() -> None:
    # Each environment alone, so that the order of updates is the same in both modes.
    weights = []
    for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED):
        stream = stream_of(mode, 1)
        learner = OnlineLearner(TorchEngine(TableQ(1000, 2), Loss()), OnlineSettings(step_size=0.5))
        experience = RolloutExperience(None, 1, stream.spec)
        while stream.num_steps < 40:
            experience.add(stream.step(act))
            for sample in experience.draw():
                learner.update(sample.transition, sample.weight)
        weights.append(learner.engine.flat.values.clone())
    assert torch.equal(*weights)
    assert bool(weights[0].any())


# The numbers of prioritised sampling, of Adam and of Huber's loss.


def test_beta_rises_with_the_steps_and_weighs_the_samples() -> None:
    settings = ReplaySettings(
        prioritised=True, priority_alpha=0.5, priority_beta=0.2, priority_beta_end=1.0, priority_beta_steps=40,
        priority_epsilon=0.25,
    )  # fmt: skip
    assert [settings.importance(steps) for steps in (0, 10, 40, 99)] == pytest.approx([0.2, 0.4, 1.0, 1.0], abs=1e-12)
    buffer = ReplayBuffer(300, (), np.int64, num_envs=1, prioritised=settings.priorities)
    experience = ReplayExperience(buffer, np.random.default_rng(0), 8, 1, 20, 1, 1, importance=settings.importance)
    for step in steps_of(1, 20):
        experience.add(step)
    buffer.update_priorities(np.arange(20), np.arange(20.0))
    [sample] = experience.draw()
    assert sample.indices is not None and sample.weight is not None
    priority = (np.arange(20.0) + 0.25) ** 0.5
    chances = (priority / priority.sum())[np.asarray(sample.indices)]
    weights = (20 * chances) ** -0.6  # β after 20 of 40 steps is .6
    assert sample.weight.numpy() == pytest.approx(weights / weights.max(), rel=1e-5)


@pytest.mark.parametrize(
    ("given", "filled"),
    [
        ({}, {"adam_epsilon": 1e-8, "huber_delta": 1.0, "priority_beta": None, "priority_beta_steps": None}),
        ({"optimiser": "sgd", "loss": "squared"}, {"adam_epsilon": None, "huber_delta": None}),
        ({"distribution": "quantile"}, {"huber_delta": None}),
        ({"prioritised": True}, {"priority_alpha": 0.6, "priority_beta_end": 0.4, "priority_beta_steps": None}),
        ({"prioritised": True, "priority_beta_end": 1.0}, {"priority_beta": 0.4, "priority_beta_steps": 100_000}),
    ],
)
def test_what_is_left_out_is_as_it_was(given: dict[str, Any], filled: dict[str, Any]) -> None:
    settings = ReplaySettings(**given)
    assert {name: getattr(settings, name) for name in filled} == filled
    assert ReplaySettings(**dataclasses.asdict(settings)) == settings, "what is stored says what was done"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"priority_alpha": 0.5}, "priority_alpha=0.5 would be ignored: prioritised=False"),
        ({"priority_beta_end": 1.0}, "prioritised=False weighs none"),
        ({"prioritised": True, "priority_beta_steps": 9}, "would be ignored: priority_beta_end is what priority_beta"),
        ({"prioritised": True, "priority_beta": 1.5}, "priority_beta must"),
        ({"prioritised": True, "priority_epsilon": 0.0}, "priority_epsilon must"),
        ({"adam_epsilon": 0.0}, "adam_epsilon must"),
        ({"optimiser": "sgd", "adam_epsilon": 1e-4}, "adam_epsilon=0.0001 would be ignored: optimiser='sgd'"),
        ({"loss": "squared", "huber_delta": 2.0}, "huber_delta=2.0 would be ignored"),
        ({"huber_delta": -1.0}, "huber_delta must"),
    ],
)
def test_a_number_that_would_be_ignored_or_means_nothing_is_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        ReplaySettings(**given)


def test_the_epsilon_of_adam_reaches_a_rollout() -> None:
    session = build_session(RunConfig(body=MLP((4,)), rollout=RolloutSettings(num_envs=1, adam_epsilon=0.5)))
    learner: Any = session.learner
    assert learner._descent._state.optimiser.eps == 0.5
    for given, said in (({"optimiser": "sgd"}, "would be ignored"), ({"adam_epsilon": 0.0}, "adam_epsilon must")):
        with pytest.raises(ValueError, match=said):
            RolloutSettings(**{"adam_epsilon": 0.5, **given})


@pytest.mark.parametrize("engine", ["torch", "compiled"])
def test_the_constants_of_adam_and_of_hubers_loss_reach_the_step(engine: str) -> None:
    """Against torch's own Adam and Huber loss, for an error of 3 with a loss that is linear from 2 on."""
    config = RunConfig(
        env="CartPole-v1", learner="replay", body=MLP((4,)), engine=engine, reward_scale=1.0,
        replay=ReplaySettings(learning_rate=0.1, adam_epsilon=0.5, huber_delta=2.0, max_grad_norm=None, batch_size=1),
    )  # fmt: skip
    session = build_session(config)
    learner: Any = session.learner
    weights = learner.engine.flat.values.clone().requires_grad_()
    s = torch.from_numpy(session.stream.state_dict()["s"])
    one, zero = torch.ones(1), torch.zeros(1)
    learner.update(Transition(s, zero.long(), one, 3 * one, zero, s, one > 0))
    inner = learner.engine.q
    expected = torch.optim.Adam([weights], 0.1, eps=0.5)
    with torch.no_grad():
        before = weights.clone()
    values = torch.func.functional_call(inner, _unflattened(inner, weights), (s,))
    torch.nn.functional.huber_loss(values[0, 0], torch.tensor(3.0, dtype=values.dtype), delta=2.0).backward()
    expected.step()
    assert not torch.equal(before, weights)
    assert learner.engine.flat.values.numpy() == pytest.approx(weights.detach().numpy(), abs=1e-6)


def _unflattened(module: torch.nn.Module, flat: Tensor) -> dict[str, Tensor]:
    found, at = {}, 0
    for name, parameter in module.named_parameters():
        found[name] = flat[at : at + parameter.numel()].view_as(parameter)
        at += parameter.numel()
    return found
