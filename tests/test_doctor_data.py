"""What was learned from, wherever it lies: a run's own replay, files of two layouts, data sets of Minari's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import neuralq
from neuralq.doctor import examination, load_subject
from neuralq.doctor.exam.stored import COLUMNS
from neuralq.runs.offline.minari_files import write_minari
from neuralq.runs.offline.recorded import Recorded


class Gears(gym.Env[Any, Any]):
    """Observations of two parts, one of them scaled by its bounds; counts up, and ends or is cut after seven steps."""

    observation_space = spaces.Dict({"speed": spaces.Box(-100, 100, (2,), np.float32), "gear": spaces.Discrete(3)})
    action_space = spaces.Discrete(2, start=1)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        self.t, self.ends = 0, bool(self.np_random.integers(2))
        return self.seen(), {}

    def seen(self) -> dict[str, Any]:
        return {"speed": np.array([10 * self.t, -self.t], np.float32), "gear": self.t % 3}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self.t += 1
        return self.seen(), 10.0 * self.t + float(action), self.t == 7 and self.ends, self.t == 7 and not self.ends, {}


def test_a_runs_own_replay_and_composite_observations_come_in_the_environments_units(tmp_path: Path) -> None:
    run = neuralq.train(
        Gears, tmp_path / "run", preset=False, learner="replay", total_steps=140, learning_starts=100, hidden=(8,),
        evaluation_episodes=1, reward_scale=0.5, num_envs=2, resume_probe=False,
    )  # fmt: skip
    agent = neuralq.load(run, env=Gears)
    subject = load_subject(run.run_dir, env=Gears)
    env = Gears()
    env.reset(seed=0)
    seen = [env.step(1)[0] for _ in range(5)]
    flat = np.stack([np.asarray(spaces.flatten(Gears.observation_space, one)) for one in seen])
    assert np.allclose(subject.values(flat), np.stack([agent.values(one) for one in seen]), atol=1e-6)
    assert subject.replay is not None
    found = subject.replay()
    assert found is not None and {len(column) for column in found.values()} == {140}
    t = np.tile(np.arange(7), 20)  # flat: gear, one-hot, then speed
    assert np.allclose(found["obs"][:, 3], 10 * t) and np.allclose(found["next_obs"][:, 3], 10 * (t + 1))
    assert (found["obs"][:, :3].argmax(1) == t % 3).all()
    assert set(found["action"]) == {1, 2} and np.allclose(found["reward"], 10 * (t + 1) + found["action"])
    ends = found["terminated"] | found["truncated"]
    assert (ends == (t == 6)).all() and found["terminated"].any() and found["truncated"].any()


STEPS: dict[str, Any] = {
    "observations": np.arange(6.0)[:, None], "actions": np.array([0, 1, 1, 0, 1, 0]), "rewards": np.ones(6),
    "terminations": np.array([0, 0, 1, 0, 0, 0], bool), "truncations": np.array([0, 0, 0, 0, 0, 1], bool),
}  # fmt: skip


def test_files_of_either_layout_are_read(tmp_path: Path) -> None:
    np.savez(tmp_path / "d4rl.npz", **STEPS)
    found = examination._columns(tmp_path / "d4rl.npz")
    assert found is not None and found["obs"][:, 0].tolist() == [
        0,
        1,
        2,
        3,
        4,
    ]  # what the last step led to is not known
    assert found["next_obs"][:, 0].tolist()[:2] == [1, 2] and found["terminated"].tolist() == [0, 0, 1, 0, 0]
    np.savez(tmp_path / "own.npz", **dict(zip(COLUMNS, [*STEPS.values(), np.ones((6, 1))], strict=True)))
    own = examination._columns(str(tmp_path / "own.npz"))
    assert own is not None and own["truncated"].tolist() == [0, 0, 0, 0, 0, 1]


def test_a_data_set_of_minaris_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    steps = {**STEPS, "observations": np.zeros((6, 4), np.float32), "next_observations": np.ones((6, 4), np.float32)}
    write_minari("doctor/cartpole-v0", Recorded(**steps), gym.make("CartPole-v1"), "none")
    found = examination._columns("minari:doctor/cartpole-v0")
    assert found is not None and found["action"].tolist() == [0, 1, 1, 0, 1, 0] and found["truncated"].tolist()[-1]
