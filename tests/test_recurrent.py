"""Networks with a memory: the units against PyTorch's, sequences against a slow loop, streams against a counter."""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import Tensor, nn

import neuralq
from neuralq.learners import ReplaySettings, RolloutLearner, RolloutSettings
from neuralq.learners.replay.learner import ReplayLearner
from neuralq.learners.sequences import after_burn_in, recalled
from neuralq.q import GRU, MLP, ActionInputQ, ActionOutputQ, DuelingQ, MaskedQ, RecurrentQ, SeparateQ
from neuralq.q.engine import Loss, TorchEngine
from neuralq.q.inputs import OneHot, Pixels
from neuralq.q.recurrent import recurrent_part
from neuralq.rules import lambda_returns
from neuralq.runs import RunConfig
from neuralq.runs.loop import seed_for
from neuralq.runs.recipe.build import build_session
from neuralq.runs.recipe.environments import make_evaluation_envs
from neuralq.runs.recipe.handed import handed_over
from neuralq.runs.recipe.stand_in import standing_in
from neuralq.runs.stop_request import StopRequest
from neuralq.runs.stream import Interaction
from neuralq.types import Transition

D, H, A, T, B = 3, 5, 2, 6, 4
LAYOUTS: dict[str, Any] = {
    "action-output": ActionOutputQ,
    "separate": SeparateQ,
    "action-input": ActionInputQ,
    "dueling": DuelingQ,
}


def network(
    layout: str = "action-output", dtype: torch.dtype = torch.float64, seed: int = 0, **body: Any
) -> RecurrentQ:
    size = H * (A if layout == "separate" else 1)
    inner = LAYOUTS[layout](D + size, A, GRU(H, hidden=(7,), **body), rng=seed, dtype=dtype)
    return RecurrentQ(inner, (D,))


def sequence(q: RecurrentQ, seed: int = 0, num_masks: int = 0) -> tuple[Tensor, Tensor]:
    """Rows with memories of long ago, 0 after the breaks, and where the breaks are."""
    drawn = torch.Generator().manual_seed(seed)
    s = torch.randn(T, B, D + q.memory_size + num_masks, generator=drawn, dtype=torch.float64)
    s[..., D + q.memory_size :] = 1.0
    last = torch.rand(T, B, generator=drawn) < 0.3
    s[1:, :, D : D + q.memory_size][last[:-1]] = 0.0
    return s, last


def slowly(q: RecurrentQ, s: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """Action values ``[T, B, A]`` and the memories before the steps, each stream by itself, step after step."""
    values, memories = [], []
    for b in range(s.shape[1]):
        memory, row, before = s[0, b, D : D + q.memory_size], [], []
        for t in range(s.shape[0]):
            if t > 0 and last[t - 1, b]:
                memory = torch.zeros_like(memory)
            before.append(memory)
            x = torch.cat([s[t, b, :D], memory])[None]
            row.append(q.all(x)[0])
            memory = q.next_memory(x)[0]
        values.append(torch.stack(row))
        memories.append(torch.stack(before))
    return torch.stack(values, 1), torch.stack(memories, 1)


def transition(q: RecurrentQ, seed: int = 0) -> Transition:
    """Steps of streams that go on: what was reached is what is left next."""
    s, last = sequence(q, seed)
    drawn = np.random.default_rng(seed)
    s_t = torch.cat([s[1:], torch.randn(1, B, s.shape[-1], dtype=s.dtype)])
    a = torch.from_numpy(drawn.integers(0, A, (T, B)))
    r = torch.from_numpy(drawn.normal(size=(T, B)))
    discount = torch.where(last, 0.0, 0.9).to(s.dtype)
    return Transition(s, a, torch.ones(T, B), r, discount, s_t, last)


@pytest.mark.parametrize("layout", ["action-output", "separate"])
def test_the_units_are_those_of_pytorch(layout: str) -> None:
    q = network(layout)
    stem, s = q.stem, torch.randn(9, D + q.memory_size, dtype=torch.float64)
    for copy in range(stem.copies):
        cell = nn.GRUCell(D, H, dtype=torch.float64)
        with torch.no_grad():
            for mine, theirs in ((stem.input_gates, "ih"), (stem.memory_gates, "hh")):
                getattr(cell, f"weight_{theirs}").copy_(mine.weight[copy].T)
                getattr(cell, f"bias_{theirs}").copy_(mine.bias[copy])
        place = slice(D + copy * H, D + (copy + 1) * H)
        expected = cell(s[:, :D], s[:, place])
        torch.testing.assert_close(q.next_memory(s)[:, copy * H : (copy + 1) * H], expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_sequence_is_what_a_loop_makes_of_it_and_so_is_its_gradient(layout: str) -> None:
    q = network(layout, before=(6,), layer_norm=layout != "dueling")
    s, last = sequence(q)
    drawn = np.random.default_rng(1)
    a, target = torch.from_numpy(drawn.integers(0, A, (T, B))), torch.from_numpy(drawn.normal(size=(T, B)))
    values, memories = slowly(q, s, last)
    error = target - values.gather(-1, a[..., None])[..., 0]
    expected = torch.autograd.grad(0.5 * (error**2).mean(), tuple(q.parameters()))
    engine = TorchEngine(q, Loss())
    found = engine.loss_gradient(s, a, target, None, last)
    torch.testing.assert_close(found, error.detach(), rtol=0, atol=1e-12)
    torch.testing.assert_close(engine.flat.grad, torch.cat([g.reshape(-1) for g in expected]), rtol=0, atol=1e-12)
    rows, after = q.recalled(s, last)
    torch.testing.assert_close(rows[..., D:], memories, rtol=0, atol=1e-12)
    torch.testing.assert_close(after[:-1][~last[:-1]], memories[1:][~last[:-1]], rtol=0, atol=1e-12)
    assert not torch.equal(rows, s)


def test_the_gradient_is_that_of_finite_differences() -> None:
    q = network()
    s, last = sequence(q)
    a, target = torch.zeros(T, B, dtype=torch.int64), torch.ones(T, B, dtype=torch.float64)
    engine = TorchEngine(q, Loss())
    engine.loss_gradient(s, a, target, None, last)
    gradient, flat = engine.flat.grad.clone(), engine.flat.values
    for i in range(0, len(flat), 17):
        ends = []
        for step in (1e-6, -1e-6):
            flat[i] += step
            ends.append(0.5 * ((target - slowly(q, s, last)[0][..., 0]) ** 2).mean().item())
            flat[i] -= step
        assert abs((ends[0] - ends[1]) / 2e-6 - gradient[i].item()) < 1e-8


def test_masks_and_weights_go_with_sequences() -> None:
    inner = network()
    q = MaskedQ(inner, (D + H,))
    s, last = sequence(inner, num_masks=A)
    s[0, 0, -1] = 0.0
    assert recurrent_part(q) is inner and torch.isneginf(q.all(s)[0, 0, 1])
    engine = TorchEngine(q, Loss())
    a, target = torch.zeros(T, B, dtype=torch.int64), torch.ones(T, B, dtype=torch.float64)
    held = torch.ones(T, B, dtype=torch.float64)
    held[3:, 1] = 0.0  # the end of a stream is no experience
    engine.loss_gradient(s, a, target, held * held.numel() / held.sum(), last)
    error = 1.0 - slowly(inner, s, last)[0][..., 0]
    (0.5 * (error**2 * held).sum() / held.sum()).backward()
    slow = torch.cat([p.grad.reshape(-1) for p in inner.parameters() if p.grad is not None])
    torch.testing.assert_close(engine.flat.grad / 2, slow / 2, rtol=0, atol=1e-12)


def plain(q: RecurrentQ) -> ActionOutputQ:
    """The same weights without anything that knows of a memory: a function of the vector."""
    twin = network(dtype=torch.float32).inner
    twin.load_state_dict(q.inner.state_dict())  # type: ignore[attr-defined]
    return twin  # type: ignore[return-value]


def test_with_sequences_of_one_step_a_rollout_teaches_what_it_teaches_a_plain_network() -> None:
    settings = RolloutSettings(num_envs=8, num_steps=1, num_minibatches=4, num_epochs=3, returns="watkins")
    q = network(dtype=torch.float32)
    twins = [RolloutLearner(TorchEngine(one, Loss()), settings, np.random.default_rng(0)) for one in (q, plain(q))]
    for seed in range(3):
        steps = transition(q, seed).map(lambda x: x.reshape(1, T * B, *x.shape[2:])[:, :8])
        steps = dataclasses.replace(steps, s_tm1=steps.s_tm1.float(), s_t=steps.s_t.float())
        updates = [learner.update(steps) for learner in twins]
        assert torch.equal(updates[0].errors, updates[1].errors)
    assert torch.equal(twins[0].engine.flat.values, twins[1].engine.flat.values)


def test_where_every_row_is_an_end_replay_teaches_what_it_teaches_a_plain_network() -> None:
    settings = ReplaySettings(target_rule="peng", block_length=T, batch_size=T * B)
    q = network(dtype=torch.float32)
    twins = [ReplayLearner(TorchEngine(one, Loss()), settings) for one in (q, plain(q))]
    steps = transition(q)
    steps = dataclasses.replace(
        steps, s_tm1=steps.s_tm1.float(), s_t=steps.s_t.float(), r_t=steps.r_t.float(),
        discount_t=torch.zeros(T, B), last_t=torch.ones(T, B, dtype=torch.bool),
    )  # fmt: skip
    for _ in range(3):
        updates = [learner.update(steps) for learner in twins]
        assert torch.equal(updates[0].errors, updates[1].errors)
    assert torch.equal(twins[0].engine.flat.values, twins[1].engine.flat.values)


def test_minibatches_are_whole_streams_and_leave_out_what_is_no_experience() -> None:
    """One pass in two minibatches by plain steps is two gradients of the slow loop, each over half of the streams."""
    q, twin = network(), network()
    settings = RolloutSettings(
        num_envs=B, num_steps=T, num_minibatches=2, num_epochs=1, optimiser="sgd", learning_rate=0.1, max_grad_norm=None
    )
    learner = RolloutLearner(TorchEngine(q, Loss()), settings, np.random.default_rng(3))
    steps = transition(q)
    weight = torch.ones(T, B)
    weight[4, 2] = 0.0
    targets = learner.targets(steps)
    learner.update(steps, weight)
    for part in np.array_split(np.random.default_rng(3).permutation(B), 2):
        values, _ = slowly(twin, steps.s_tm1[:, part], steps.last_t[:, part])
        error = targets[:, part] - values.gather(-1, steps.a_tm1[:, part, None])[..., 0]
        held = weight[:, part].double()
        gradient = torch.autograd.grad(0.5 * (error**2 * held).sum() / held.sum(), tuple(twin.parameters()))
        with torch.no_grad():
            for parameter, g in zip(twin.parameters(), gradient, strict=True):
                parameter -= 0.1 * g
    for mine, theirs in zip(q.parameters(), twin.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=0, atol=1e-12)


def test_targets_are_by_the_memories_of_who_values() -> None:
    q = network()
    engine = TorchEngine(q, Loss())
    engine.sync_target()
    with torch.no_grad():
        engine.flat.values.mul_(1.5)
    steps = transition(q)
    settings = RolloutSettings(num_envs=B, num_steps=T, target_period_updates=5, lambda_=0.0)
    learner = RolloutLearner(engine, settings, np.random.default_rng(0))
    with torch.no_grad():
        engine.flat.values.mul_(1.1)  # the constructor copied them
    frozen = engine.network(target=True)
    assert isinstance(frozen, RecurrentQ)
    _, memories = slowly(frozen, steps.s_tm1, steps.last_t)
    for t in range(T):
        after = frozen.next_memory(torch.cat([steps.s_tm1[t, :, :D], memories[t]], -1))
        v = frozen.all(torch.cat([steps.s_t[t, :, :D], after], -1)).amax(-1)
        expected = steps.r_t[t] + steps.discount_t[t] * v
        torch.testing.assert_close(learner.targets(steps)[t], expected.detach(), rtol=0, atol=1e-12)
    assert not torch.allclose(recalled(engine, steps).s_t, recalled(engine, steps, target=True).s_t)


@pytest.mark.parametrize("burn_in", [0, 1, 3])
def test_burning_in_brings_the_first_memory_up_to_date(burn_in: int) -> None:
    q = network()
    engine, steps = TorchEngine(q, Loss()), transition(q)
    _, memories = slowly(q, steps.s_tm1, steps.last_t)
    rest = after_burn_in(engine, steps, burn_in)
    expected = steps.s_tm1[0, :, D:] if burn_in == 0 else memories[burn_in]
    torch.testing.assert_close(rest.s_tm1[0, :, D:], expected.detach(), rtol=0, atol=1e-12)
    assert torch.equal(rest.r_t, steps.r_t[burn_in:]) and not rest.s_tm1.requires_grad
    settings = ReplaySettings(target_rule="peng", block_length=2, burn_in=burn_in, batch_size=8, loss="squared")
    learner = ReplayLearner(engine, settings)
    values, _ = slowly(q, steps.s_tm1, steps.last_t)
    taken = values.gather(-1, steps.a_tm1[..., None])[burn_in : burn_in + 2, :, 0]
    rows = slice(burn_in, burn_in + 2)
    after = q.next_memory(torch.cat([steps.s_tm1[rows, :, :D], memories[rows]], -1).flatten(0, 1)).unflatten(0, (2, B))
    v_t = q.all(torch.cat([steps.s_t[rows, :, :D], after], -1)).amax(-1).detach()
    update = learner.update(steps.map(lambda x: x[: burn_in + 2]))
    returns = lambda_returns(steps.r_t[rows], steps.discount_t[rows], v_t, 0.8, steps.last_t[rows])
    torch.testing.assert_close(update.targets, returns.reshape(-1), rtol=0, atol=1e-12)
    torch.testing.assert_close(update.targets - update.errors, taken.detach().reshape(-1), rtol=0, atol=1e-12)


class Clock(gym.Env[Any, Any]):
    """Observes how many steps the episode has had; episodes last as long as the number of their environment says."""

    observation_space, action_space = gym.spaces.Box(0, 9, (1,)), gym.spaces.Discrete(2)

    def __init__(self, length: int, masks: bool) -> None:
        self._length, self._masks = length, masks

    def _seen(self) -> tuple[Any, dict[str, Any]]:
        mask = {"action_mask": np.array([1, self._steps % 2], np.int8)} if self._masks else {}
        return np.array([self._steps], np.float32), mask

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self._steps = 0
        return self._seen()

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._steps += 1
        observation, info = self._seen()
        return observation, 0.0, self._steps == self._length, False, info


@pytest.mark.parametrize("masks", [False, True])
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_streams_remember_within_an_episode_and_not_across(mode: AutoresetMode, masks: bool) -> None:
    """A memory that counts the steps it has seen knows what the clock shows, on both sides of every transition."""
    envs = SyncVectorEnv([lambda n=n: Clock(n, masks) for n in (1, 2, 5)], autoreset_mode=mode)
    stream = Interaction(envs, 0.9, 0, memory_size=2)
    assert stream.spec.memory_size == 2 and stream.spec.shape == (1 + 2 + (2 if masks else 0),)
    stream.next_memory = lambda s: (s[:, 1:3] + [1, 10]).astype(np.float32)
    for _ in range(12):
        step = stream.step(lambda s: (torch.zeros(len(s), dtype=torch.int64), torch.ones(len(s))))
        shown = step.rows[0][:, 0]
        np.testing.assert_allclose(step.rows[0][:, 1:3], np.outer(shown, [1, 10]), atol=1e-5)
        np.testing.assert_allclose(step.rows[5][:, 1:3], np.outer(step.rows[5][:, 0], [1, 10]), atol=1e-5)
        if masks:
            assert (step.rows[0][:, 3] == 1).all() and (step.rows[0][:, 4] == np.round(shown) % 2).all()


SMALL: dict[str, Any] = {
    "body": {"class": "GRU", "units": 4, "hidden": [4]}, "evaluation_episodes": 2, "evaluate_every": 256,
    "evaluation_max_steps": 50, "monitor": False,
}  # fmt: skip
ROLLOUT = {"learner": "rollout", "rollout": {"num_envs": 4, "num_steps": 8, "num_minibatches": 2, "num_epochs": 2}}
REPLAY = {
    "learner": "replay",
    "replay": {"target_rule": "watkins", "block_length": 4, "burn_in": 2, "batch_size": 16, "learning_starts": 64},
}


@pytest.mark.whole
@pytest.mark.parametrize("learner", [ROLLOUT, REPLAY], ids=["rollout", "replay"])
def test_runs_go_on_bit_for_bit(learner: dict[str, Any], tmp_path: Any) -> None:
    config = {"env": "CartPole-v1", **SMALL, **learner}
    config |= {"total_steps": 320, "checkpoint_every": 100, "log_every": 32}

    def killed(row: Any) -> None:
        if row["kind"] == "train" and row["env_steps"] >= 160:
            raise KeyboardInterrupt

    whole = neuralq.train(config, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        neuralq.train(config, tmp_path / "half", hooks=[killed])
    half = neuralq.resume(tmp_path / "half")
    assert (half.parameters_sha256, half.greedy_return) == (whole.parameters_sha256, whole.greedy_return)


def test_blocks_from_replay_are_as_long_as_what_is_learned_from_and_what_is_not() -> None:
    session = build_session(neuralq.with_preset({"env": "CartPole-v1", **SMALL, **REPLAY, "resume_probe": False}))
    session.advance(80, StopRequest())
    assert session.observed is not None
    learned, sample = session._last  # type: ignore[misc]
    assert sample.transition.r_t.shape == (2 + 4, 16 // 4) and learned.errors.shape == (16,)
    session.close()


def test_an_agent_plays_by_hand_as_its_evaluation_did(tmp_path: Any) -> None:
    run = neuralq.train({"env": "CartPole-v1", **SMALL, **ROLLOUT, "total_steps": 64}, tmp_path / "run")
    agent = neuralq.load(run)
    with pytest.raises(ValueError, match=r"memory = agent.first_memory\(\).*agent.next_memory\(observation, memory\)"):
        agent.predict(np.zeros(4, np.float32))
    with pytest.raises(ValueError, match=r"memory must be of shape \(4,\)"):
        agent.predict(np.zeros(4, np.float32), memory=np.zeros(3))
    envs = make_evaluation_envs(neuralq.with_preset({"env": "CartPole-v1", **SMALL, **ROLLOUT}), 2)
    observations, _ = envs.reset(seed=seed_for(0, 7))
    memories, returns, running = agent.first_memory(2), np.zeros(2), np.ones(2, bool)
    while running.any():
        actions = agent.predict(observations, memory=memories)
        assert actions[1] == agent(observations[1], memory=memories[1])
        memories = agent.next_memory(observations, memories)
        observations, rewards, terminated, truncated, _ = envs.step(actions)
        returns += rewards * running
        running &= ~(terminated | truncated)
    assert tuple(returns) == neuralq.evaluate(run, num_episodes=2, seed=0).returns


@pytest.mark.whole
def test_the_file_is_one_step_of_the_memory(tmp_path: Any) -> None:
    pytest.importorskip("onnx")
    ort = pytest.importorskip("onnxruntime")
    run = neuralq.train({"env": "CartPole-v1", **SMALL, **ROLLOUT, "total_steps": 64}, tmp_path / "run")
    file = neuralq.export(run, tmp_path / "q.onnx")
    session, agent = ort.InferenceSession(str(file.path)), neuralq.load(run)
    assert [one.name for one in session.get_inputs()] == ["observation", "memory"]
    memory = agent.first_memory(1)
    for x in np.random.default_rng(0).normal(size=(5, 1, 4)).astype(np.float32):
        expected = agent.values(x, memory=memory), agent.next_memory(x, memory)
        values, _, memory = session.run(["values", "action", "next_memory"], {"observation": x, "memory": memory})
        np.testing.assert_allclose(values, expected[0], atol=1e-5)
        np.testing.assert_allclose(memory, expected[1], atol=1e-6)
    with pytest.raises(ValueError, match=r"no chain of layers.*onnx"):
        neuralq.export(run, tmp_path / "q.safetensors")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"learner": "online"}, "the online learner takes steps one by one"),
        ({**ROLLOUT, "rollout": {"num_envs": 2, "num_minibatches": 4}}, "take at most 2, or more environments"),
        ({"learner": "replay"}, "use target_rule='peng' with block_length=16"),
        ({**REPLAY, "replay": {**REPLAY["replay"], "noisy": True}}, "noisy does not go with body='gru'"),  # type: ignore[dict-item]
        ({**REPLAY, "replay": {**REPLAY["replay"], "conservative_alpha": 1.0}}, "conservative_alpha does not go"),  # type: ignore[dict-item]
        ({**REPLAY, "dataset": "steps.npz"}, "dataset does not go with body='gru'"),
        ({**REPLAY, "body": "mlp"}, "use body='gru', or leave it"),
        ({"learner": "replay", "replay": {"burn_in": 2}}, "burn_in=2 goes before blocks"),
        ({"engine": "compiled"}, "engine='compiled' has kernels for MLP networks only"),
        ({"layout": "table"}, "a table has no network body"),
        ({"layout": "action-input", "body": {"class": "GRU", "hidden": []}}, "give the body hidden"),
        ({"body": {"class": "GRU", "units": 0}}, "units must be"),
        ({"env": "FrozenLake-v1", "exact": True, "total_steps": 32}, "an agent with a memory values what it remembers"),
    ],
)
def test_what_does_not_go_with_a_memory_is_refused_with_the_way_out(changed: dict[str, Any], message: str) -> None:
    config = {"env": "CartPole-v1", **SMALL, **changed}
    with pytest.raises(ValueError, match=message):
        build_session(neuralq.with_preset(config)).close()


def test_the_ways_out_of_refusals_are_ways() -> None:
    RunConfig(body=GRU(), learner="replay", replay=ReplaySettings(target_rule="peng", block_length=16))
    RunConfig(body=GRU(), learner="rollout", rollout=RolloutSettings(num_envs=4, num_minibatches=4))


@pytest.mark.parametrize("layout", ["action-output", "separate", "action-input"])
@pytest.mark.parametrize("env", ["FrozenLake-v1", "Frames", "Masked"])
def test_every_kind_of_observation_can_be_remembered(env: str, layout: str) -> None:
    made: Any = env
    if env == "Frames":
        made = lambda: gym.wrappers.TransformObservation(  # noqa: E731
            gym.make("CartPole-v1"),
            lambda o: np.full((3, 3, 1), 128, np.uint8),
            gym.spaces.Box(0, 255, (3, 3, 1), np.uint8),
        )
    if env == "Masked":
        made = lambda: Clock(3, True)  # noqa: E731
    handed = handed_over(made)
    with standing_in(handed.make):
        config = neuralq.with_preset({"env": handed.env, **SMALL, **ROLLOUT, "layout": layout, "resume_probe": False})
        session = build_session(config)
        before = session.learner.engine.flat.values.clone()
        session.advance(32, StopRequest())
        assert not torch.equal(before, session.learner.engine.flat.values)
        assert session.evaluate(0)[0]["returns"]
        part = recurrent_part(session.learner.engine.q)
        assert part is not None
        assert isinstance(part.features, {"FrozenLake-v1": OneHot, "Frames": Pixels, "Masked": type(None)}[env])
        session.close()


def test_what_has_no_memory_is_not_called_recurrent() -> None:
    with pytest.raises(ValueError, match=r"remembers nothing; give it the body GRU\(units=...\)"):
        RecurrentQ(ActionOutputQ(4, 2, MLP((3,))), (4,))
    with pytest.raises(ValueError, match="add the memory's size to input_shape"):
        ActionOutputQ(4, 2, GRU(units=4))
    with pytest.raises(ValueError, match="an episode begins with a memory of zeros"):
        network().all(torch.zeros(2, D, dtype=torch.float64))
    q = network()
    assert q(torch.zeros(2, D + H, dtype=torch.float64)).shape == (2, A)
