"""The training loop: when it evaluates, logs, saves and stops, told by a learner that learns nothing.

Mutants that must die here: one step too many or too few · the last evaluation forgotten, or made twice · a target met
but not noticed, or noticed at another step · a checkpoint in the middle of a rollout · evaluation counted as training.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from neuralq.learners import OnlineSettings, RolloutSettings
from neuralq.runs import RunConfig, train
from neuralq.runs import loop as training
from neuralq.runs.evaluation import Evaluation
from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.run_folder import read_metrics, read_summary
from neuralq.runs.loop import seed_for
from neuralq.runs.session import Session


class Corridor(gym.Env[Any, Any]):
    """Ends after ``length`` steps whatever is done; every step is worth 1."""

    action_space = spaces.Discrete(2)

    def __init__(self, length: int = 7) -> None:
        self.length, self.t = length, 0
        self.observation_space = spaces.Discrete(length + 1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        return 0, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        return self.t, 1.0, self.t == self.length, False, {}


gym.register("test/Corridor-v0", Corridor)


def corridor(**given: Any) -> RunConfig:
    plan = {"total_steps": 100, "evaluate_every": 30, "evaluation_episodes": 3, "checkpoint_every": 40, "log_every": 25}
    kind = {"learner": "online", "layout": "table", "online": OnlineSettings()}
    return RunConfig(**{"env": "test/Corridor-v0", **plan, **kind, **given})


def steps_of(path: Path, kind: str) -> list[int]:
    return [row["env_steps"] for row in read_metrics(path) if row["kind"] == kind]


def test_evaluations_logs_and_checkpoints_come_when_they_are_due(tmp_path: Path) -> None:
    saved: list[int] = []
    with pytest.MonkeyPatch.context() as patched:
        save = checkpoint.save
        patched.setattr(checkpoint, "save", lambda folder, step, state: saved.append(step) or save(folder, step, state))
        run = train(corridor(), tmp_path / "run")
    assert run.env_steps == 100
    assert steps_of(tmp_path / "run", "evaluation") == [30, 60, 90, 100]
    assert steps_of(tmp_path / "run", "train") == [1, 26, 51, 76]
    assert saved == [40, 80, 100]
    assert len(list((tmp_path / "run" / "checkpoints").iterdir())) == 2
    assert run.greedy_return == 7.0 and run.reached is None and run.interrupted_by is None


def test_the_end_is_not_evaluated_twice(tmp_path: Path) -> None:
    train(corridor(total_steps=60), tmp_path / "run")
    assert steps_of(tmp_path / "run", "evaluation") == [30, 60]


@pytest.mark.parametrize(("target", "steps"), [(7.0, 30), (7.1, 100)])
def test_a_target_is_met_at_the_first_evaluation_that_meets_it(target: float, steps: int, tmp_path: Path) -> None:
    run = train(corridor(stop_at_return=target), tmp_path / "run")
    assert (run.env_steps, run.reached) == (steps, target == 7.0)
    assert checkpoint.load_newest(tmp_path / "run" / "checkpoints").step == steps
    assert read_summary(tmp_path / "run")["reached"] is (target == 7.0)


def test_a_rollout_that_was_begun_is_finished_and_saved_whole(tmp_path: Path) -> None:
    rollout = RolloutSettings(num_envs=3, num_steps=11, num_minibatches=1)
    config = corridor(learner="rollout", online=None, rollout=rollout, total_steps=100, log_every=1)
    run = train(config, tmp_path / "run")
    # Environments restart within the step, so every rollout is 33 steps: the fourth is begun at 99.
    assert run.env_steps == 132
    assert all(step % 33 == 0 for step in steps_of(tmp_path / "run", "evaluation"))
    assert all(int(p.name[5:]) % 33 == 0 for p in (tmp_path / "run" / "checkpoints").iterdir())


def test_training_rows_tell_the_mean_of_finished_episodes(tmp_path: Path) -> None:
    train(corridor(log_every=1, total_steps=20), tmp_path / "run")
    rows = [row for row in read_metrics(tmp_path / "run") if row["kind"] == "train"]
    assert [row["episode_return"] for row in rows] == [None] * 6 + [7.0] * 14
    assert [row["num_updates"] for row in rows] == list(range(1, 21))
    assert all(math.isfinite(row["loss"]) and row["abs_td_error"] >= 0 for row in rows)


def test_evaluation_counts_as_wall_time_but_not_as_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    play = Session.play_greedily

    def slow_evaluation(session: Session, seed: int) -> Evaluation:
        now[0] += 100.0
        return play(session, seed)

    def tick() -> float:
        now[0] += 0.001
        return now[0]

    monkeypatch.setattr(training, "time", SimpleNamespace(process_time=tick, perf_counter=tick))
    monkeypatch.setattr(Session, "play_greedily", slow_evaluation)
    run = train(corridor(), tmp_path / "run")
    assert run.cpu_seconds < 1.0 and 400.0 < run.wall_seconds < 401.0


def test_evaluating_changes_nothing(tmp_path: Path) -> None:
    often = train(corridor(evaluate_every=5, evaluation_episodes=40), tmp_path / "often")
    assert often.parameters_sha256 == train(corridor(evaluate_every=100), tmp_path / "once").parameters_sha256


def test_hooks_get_each_row_at_once(tmp_path: Path) -> None:
    seen: list[tuple[str, int]] = []

    def hook(row: Mapping[str, Any]) -> None:
        assert read_metrics(tmp_path / "run")[-1]["env_steps"] == row["env_steps"]
        seen.append((row["kind"], row["env_steps"]))

    train(corridor(), tmp_path / "run", [hook])
    assert seen == [(row["kind"], row["env_steps"]) for row in read_metrics(tmp_path / "run")]


def test_seeds_of_different_purposes_do_not_meet() -> None:
    seeds = {seed_for(seed, purpose, step) for seed in range(5) for purpose in range(10) for step in range(20)}
    assert len(seeds) == 1000 and all(0 <= seed < 2**31 for seed in seeds)
    assert seed_for(3, 1) == seed_for(3, 1)
    assert np.random.default_rng(seed_for(0, 1)).random() != np.random.default_rng(seed_for(0, 2)).random()


def test_what_is_reported_of_values_is_in_the_units_of_the_environment(tmp_path: Path) -> None:
    # A table's values and errors are linear in rewards, so that the scale of rewards changes no action and no return.
    rows = {}
    for scale in (1.0, 0.125):
        train(corridor(reward_scale=scale, log_every=1, total_steps=60), tmp_path / str(scale))
        rows[scale] = [row for row in read_metrics(tmp_path / str(scale)) if row["kind"] == "train"]
    for one, eighth in zip(rows[1.0], rows[0.125], strict=True):
        for name in ("max_q", "abs_td_error", "loss"):
            assert eighth[name] == pytest.approx(one[name], rel=1e-4, abs=1e-6), name
    assert max(row["max_q"] for row in rows[1.0]) > 0
