"""A loaded agent says what the trained representation says, in the environment's own actions and units.

Mutants that must die here: values in scaled units · actions without the space's start · the mask ignored, or only
respected by `predict` · an older checkpoint than the newest · a foreign folder half read.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

import neuralq
from neuralq.learners import OnlineSettings, RolloutSettings
from neuralq.q import MLP
from neuralq.runs import Run, RunConfig
from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.checkpoint import CheckpointError
from neuralq.runs.folder.run_folder import RunFolderError


class Bandit(gym.Env[Any, Any]):
    """Two states, actions 5, 6 and 7 that end the episode with 10, 20 and 30; in state 1 the last may be forbidden."""

    observation_space = spaces.Discrete(2)
    action_space = spaces.Discrete(3, start=5)

    def __init__(self, masked: bool = False) -> None:
        self.masked, self.s = masked, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.s = int(self.np_random.integers(2))
        return self.s, self._legal()

    def _legal(self) -> dict[str, Any]:
        return {"action_mask": np.array([1, 1, 1 - self.s], np.int8)} if self.masked else {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert 5 <= action <= 7 and not (self.masked and self.s == 1 and action == 7)
        return self.s, 10.0 * (int(action) - 4), True, False, self._legal()


gym.register("test/Bandit-v0", Bandit)


def bandit(layout: str, masked: bool, reward_scale: float = 0.1) -> RunConfig:
    learner = {"learner": "online", "online": OnlineSettings(step_size=0.5, lambda_=0.0)}
    return RunConfig(
        env="test/Bandit-v0", env_kwargs={"masked": masked}, layout=layout, reward_scale=reward_scale, total_steps=600,
        evaluate_every=600, evaluation_episodes=2, checkpoint_every=300, epsilon_end=1.0, **learner,
    )  # type: ignore[arg-type]  # fmt: skip


Trained = Callable[[str, bool], Run]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    @cache
    def run(layout: str, masked: bool) -> Run:
        return neuralq.train(bandit(layout, masked), tmp_path_factory.mktemp("trained") / "run")

    return run


@pytest.mark.parametrize("layout", ["table", "linear"])
def test_values_are_in_the_environments_units_and_actions_are_its_own(layout: str, trained: Trained) -> None:
    run = trained(layout, False)
    agent = neuralq.load(run.run_dir)
    for s in (0, 1):
        assert agent.values(s) == pytest.approx([10, 20, 30], abs=1e-6)
        assert agent.predict(s) == 7 and agent.predict(np.int64(s)) == 7
        assert agent.predict(s, action_mask=[1, 0, 0]) == 5
        assert agent.values(s, action_mask=np.array([False, True, False])).tolist()[::2] == [-np.inf, -np.inf]
    assert run.greedy_return == 30.0


def test_a_mask_of_the_environment_is_part_of_the_state(trained: Trained) -> None:
    agent = neuralq.load(trained("table", True).run_dir)
    assert agent.predict(0, action_mask=[1, 1, 1]) == 7
    assert agent.predict(1, action_mask=[1, 1, 0]) == 6
    assert agent.values(1, action_mask=[1, 1, 0]) == pytest.approx([10, 20, -np.inf])
    assert agent.values(0) == pytest.approx([10, 20, 30], abs=1e-6)


@pytest.mark.parametrize("masked", [False, True])
def test_wrong_masks_and_observations_are_refused(masked: bool, trained: Trained) -> None:
    agent = neuralq.load(trained("table", masked).run_dir)
    with pytest.raises(ValueError, match=r"action_mask must have 3 entries, got shape \(2,\)"):
        agent.values(0, action_mask=[1, 1])
    with pytest.raises(ValueError, match="must have 3 entries"):
        agent.predict(0, action_mask=[1])
    with pytest.raises(ValueError, match="allows nothing"):
        agent.predict(0, action_mask=[0, 0, 0])
    for observation in (2, -1, 0.5, np.zeros(3)):
        with pytest.raises(ValueError):
            agent.values(observation)


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = RunConfig(
        total_steps=200, evaluate_every=1000, evaluation_episodes=1, checkpoint_every=64, body=MLP((8,)),
        rollout=RolloutSettings(num_envs=2, num_steps=16), layout="separate", reward_scale=0.5,
    )  # fmt: skip
    return neuralq.train(config, tmp_path_factory.mktemp("cartpole") / "run").run_dir


def test_an_agent_is_the_network_of_the_newest_checkpoint(cartpole: Path) -> None:
    agent = neuralq.load(cartpole)
    parameters = torch.cat([p.detach().reshape(-1) for p in agent.q.parameters()])  # type: ignore[attr-defined]
    saved = checkpoint.load_newest(cartpole / "checkpoints")
    assert torch.equal(parameters, saved.state["learner"]["descent"]["parameters"])
    observation = np.array([0.01, -0.02, 0.03, 0.04], np.float32)
    expected = agent.q.all(torch.from_numpy(observation)[None])[0].detach().double().numpy() / 0.5
    assert agent.values(observation) == pytest.approx(expected, rel=1e-6)
    assert agent.predict(observation) == int(np.argmax(expected))
    env = gym.make("CartPole-v1")
    seen, _ = env.reset(seed=0)
    env.step(agent.predict(seen))
    env.close()


def test_an_observation_of_another_shape_is_refused(cartpole: Path) -> None:
    agent = neuralq.load(cartpole)
    for observation in (np.zeros(3, np.float32), np.zeros((1, 1, 4), np.float32), np.full(4, np.nan, np.float32)):
        with pytest.raises(ValueError):
            agent.predict(observation)


def test_loading_takes_no_lock(cartpole: Path) -> None:
    from neuralq.runs.folder.run_folder import RunFolder

    with RunFolder.open(cartpole):
        assert neuralq.load(cartpole).predict(np.zeros(4, np.float32)) in (0, 1)


def test_folders_that_hold_no_run_are_one_clear_error(cartpole: Path, tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match="no neuralq run in"):
        neuralq.load(tmp_path / "nowhere")
    (tmp_path / "run.json").write_text('{"format": "somebody else\'s"}')
    with pytest.raises(RunFolderError, match="not written by neuralq"):
        neuralq.load(tmp_path)
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in ("run.json", "config.json"):
        (bare / name).write_bytes((cartpole / name).read_bytes())
    with pytest.raises(CheckpointError, match="no checkpoint in"):
        neuralq.load(bare)


def test_a_batch_is_its_rows(cartpole: Path) -> None:
    agent, rows = neuralq.load(cartpole), np.random.default_rng(0).normal(size=(7, 4)).astype(np.float32)
    values, actions = agent.values(rows), agent.predict(rows)
    assert values.shape == (7, 2) and values.dtype == np.float64 and actions.dtype == np.int64
    np.testing.assert_allclose(values, [agent.values(row) for row in rows], rtol=1e-5)
    assert (
        actions.tolist()
        == [agent.predict(row) for row in rows]
        == agent(rows).tolist()
        == np.argmax(values, 1).tolist()
    )
    assert agent(rows[0]) == actions[0] and agent.predict(rows[:1]).shape == (1,)


@pytest.mark.parametrize("masked", [False, True])
def test_masks_of_a_batch(masked: bool, trained: Trained) -> None:
    agent = neuralq.load(trained("table", masked).run_dir)
    states, legal = np.array([0, 1, 1, 0]), np.array([[1, 1, 1], [1, 1, 0], [1, 0, 0], [0, 1, 0]])
    values = agent.values(states, legal)
    assert np.array_equal(np.isfinite(values), legal == 1)
    assert values[1] == pytest.approx(agent.values(1, [1, 1, 0]))
    assert agent.predict(states, legal).tolist() == [7, 6, 5, 6]
    assert agent.predict(states, action_mask=[1, 1, 0]).tolist() == [6, 6, 6, 6]  # one row stands for all
    with pytest.raises(ValueError, match="3 entries, or 4 rows of them"):
        agent.values(states, legal[:3])
    with pytest.raises(ValueError, match=r"3 entries, got shape \(4, 3\)"):
        agent.values(0, legal)


def test_what_other_libraries_write_is_told_what_to_write(cartpole: Path) -> None:
    agent, observation = neuralq.load(cartpole), np.zeros(4, np.float32)
    with pytest.raises(TypeError, match=r"takes no deterministic; .*: action = agent\.predict\(observation\)"):
        agent.predict(observation, deterministic=True)
    with pytest.raises(TypeError, match=r"nothing beside it: action = agent\.predict\(observation\)"):
        _, _ = agent.predict(observation)
    env = gym.make("CartPole-v1")
    env.reset(seed=0)
    env.step(agent.predict(observation))  # and is a number all the same
    env.close()
    with pytest.raises(AttributeError, match=r"no 'learn'; a run goes on with neuralq\.resume"):
        agent.learn(1000)
    assert not hasattr(agent, "anything_else")
