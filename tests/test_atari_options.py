"""Atari as Mnih et al. (2015) trained on it, on request: clipped rewards and lives as episodes, in training alone.

Mutants that must die here: an option that reaches the evaluation, or does not reach training · rewards clipped below
the frame skip, where four of them add up · an option taken and ignored where there is no screen.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from neuralq.learners import RolloutSettings
from neuralq.q import MLP
from neuralq.runs import RunConfig
from neuralq.runs.recipe.build import build_session
from neuralq.runs.recipe.environments import make_envs
from neuralq.runs.recipe.games import make_single
from neuralq.runs.stream import Interaction

needs_atari = pytest.mark.skipif(
    not all(__import__("importlib.util").util.find_spec(name) for name in ("ale_py", "cv2")),
    reason="needs the extra atari",
)


def played(env_id: str, num_steps: int, clip: bool, lives: bool) -> tuple[list[float], int]:
    """Rewards, and how many episodes ended with lives left, of one sequence of actions."""
    env = make_single(env_id, {}, None, clip, lives)
    rng, rewards, lost = np.random.default_rng(0), [], 0
    env.reset(seed=0)
    for _ in range(num_steps):
        _, reward, terminated, truncated, extra = env.step(rng.integers(int(env.action_space.n)))  # type: ignore[attr-defined]
        rewards.append(float(reward))
        if terminated or truncated:
            lost += extra["lives"] > 0
            env.reset()
    env.close()
    return rewards, lost


@needs_atari
def test_rewards_are_clipped_after_the_frame_skip() -> None:
    plain, _ = played("ALE/Qbert-v5", 150, False, False)
    clipped, _ = played("ALE/Qbert-v5", 150, True, False)
    assert max(plain) == 25.0 and clipped == np.clip(plain, -1, 1).tolist()


@needs_atari
def test_a_lost_life_ends_the_episode() -> None:
    assert played("ALE/Breakout-v5", 200, False, False)[1] == 0
    assert played("ALE/Breakout-v5", 200, False, True)[1] >= 3


@needs_atari
def test_training_sees_them_and_evaluation_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    config = RunConfig(
        env="ALE/Breakout-v5", clip_rewards=True, end_on_life_loss=True, evaluation_episodes=1, body=MLP((4,)),
        rollout=RolloutSettings(num_envs=2),
    )  # fmt: skip
    session = build_session(config)

    def wrappers(stream: Interaction) -> tuple[bool, bool]:
        env = stream.envs.unwrapped.envs[0]  # type: ignore[attr-defined]
        text = str(env)
        return "ClipReward" in text, bool(env.get_wrapper_attr("terminal_on_life_loss"))

    try:
        assert wrappers(session.stream) == (True, True)
        assert wrappers(session.evaluation_stream) == (False, False)
    finally:
        session.close()
    plain = dataclasses.replace(config, clip_rewards=False, end_on_life_loss=False)
    for num_envs in (1, 2):
        envs = make_envs(plain, num_envs, training=True)
        assert wrappers(Interaction(envs, 0.99, 0)) == (False, False)
        envs.close()


@pytest.mark.parametrize("name", ["clip_rewards", "end_on_life_loss"])
@pytest.mark.parametrize(("env", "kwargs"), [("CartPole-v1", {}), ("ALE/Pong-v5", {"obs_type": "ram"})])
def test_elsewhere_they_are_refused(name: str, env: str, kwargs: dict[str, str]) -> None:
    with pytest.raises(ValueError, match=rf"{name} is for the screens of Atari games"):
        RunConfig(env=env, env_kwargs=kwargs, **{name: True})  # type: ignore[arg-type]
