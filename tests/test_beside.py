"""The exact answer beside what is learned: its numbers by hand, what it is silent on, and that it changes nothing.

Mutants that must die here: the error of terminal or unreachable states counted · values left as the learner scales them
· illegal actions counted, or chosen · the regret of another policy than the greedy one · V^π in place of V* · pairs
that were not taken counted as visited, or forgotten by a resumed run · starts taken uniform where the environment has
its own · a model that its environment does not follow believed · another run with it than without.
"""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Discrete

from neuralq.apps.cli import main
from neuralq.learners import OnlineSettings, RolloutSettings
from neuralq.runs import RunConfig, evaluate_run, resume, train
from neuralq.runs.beside import Beside
from neuralq.runs.folder.files import read_json
from neuralq.runs.folder.run_folder import read_metrics
from neuralq.runs.stream import Interaction, make_vector_env


class Corridor(gym.Env[Any, Any]):
    """0 → 1 → end with reward 8: action 0 goes on, action 1 ends at once with reward 1. State 2 is never entered."""

    def __init__(self, lies: bool = False) -> None:
        self.observation_space, self.action_space = Discrete(3), Discrete(2)
        self.P = {
            s: {0: [(1.0, 1, 0.0, False)] if s == 0 else [(1.0, 2, 8.0, True)], 1: [(1.0, 2, 1.0, True)]}
            for s in range(3)
        }
        self._factor, self.s = (2.0 if lies else 1.0), 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self.s = 0
        return 0, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        ((_, self.s, reward, ends),) = self.P[self.s][int(action)]
        return self.s, self._factor * reward, ends, False, {}


gym.register("test/Hallway-v0", Corridor)

Q_STAR = [[4.0, 1.0], [8.0, 1.0]]  # γ = ½; state 2 begins no episode and is entered by none
CONFIG = RunConfig(
    env="test/Hallway-v0", layout="table", learner="online", gamma=0.5, total_steps=64, evaluate_every=32,
    evaluation_episodes=2, log_every=64, checkpoint_every=32, epsilon_end=1.0, online=OnlineSettings(step_size=0.5),
)  # fmt: skip


def beside(env: gym.Env[Any, Any], gamma: float = 0.5, asked: bool | None = None) -> Beside:
    envs = make_vector_env(lambda: env, 1)
    found = Beside.of(envs, Interaction(envs, gamma, 0, as_index=True).spec, gamma, asked)
    assert found is not None
    found.watch()
    return found


def table(*rows: list[float]) -> Any:
    return torch.tensor(rows, dtype=torch.float64).__getitem__


def test_the_numbers_are_those_by_hand() -> None:
    """Q = [[1, 3], [7, 2]]: |Q − Q*| = [[3, 2], [1, 1]]; the greedy action of state 0 is 1: V^π = 1, V* = 4."""
    one = beside(Corridor())
    found = one.compare(table([10.0, 30.0], [70.0, 20.0], [1e9, 0.0]), scale=10.0)
    assert found is not None and found.q_error_max is None and found.optimal_share is None
    assert (found.q_error_max_all, found.q_error_mean_all) == (3.0, 7 / 4)
    assert (found.regret, found.optimal_share_all, found.start_value, found.exact_start_value) == (3.0, 0.5, 3.0, 4.0)
    one.see(np.array([0, 1]), np.array([1, 0]))
    found = one.compare(table([10.0, 30.0], [70.0, 20.0], [1e9, 0.0]), scale=10.0)
    assert found is not None and (found.q_error_max, found.q_error_mean, found.optimal_share) == (2.0, 3 / 2, 0.5)
    assert "the greedy policy earns 3 less than an optimal one" in "; ".join(found.lines())


def test_right_values_have_no_error_and_no_regret() -> None:
    found = beside(Corridor()).compare(table(*Q_STAR, [0.0, 0.0]), 1.0)
    assert found is not None and (found.q_error_max_all, found.regret, found.optimal_share_all) == (0.0, 0.0, 1.0)


def test_illegal_actions_are_neither_compared_nor_taken() -> None:
    """MitchellGrid has a wall around it: an illegal move's value of 1e6 is no error, and nobody takes it."""
    env = gym.make("neuralq/MitchellGrid-v0")
    one = beside(env, 0.9)
    assert one.look() is not None
    from neuralq.exact import solve

    answer = solve(env.unwrapped.mdp(), 0.9)  # type: ignore[attr-defined]
    q = np.where(np.isnan(answer.q), 1e6, answer.q)
    found = one.compare(lambda s: torch.from_numpy(q)[s[:, 0]], 1.0)
    assert found is not None and found.q_error_max_all == 0.0 and found.optimal_share_all == 1.0
    assert found.regret == pytest.approx(0.0, abs=1e-9)


def test_a_policy_that_never_ends_has_no_finite_value() -> None:
    env = gym.make("CliffWalking-v1")
    found = beside(env, 1.0).compare(lambda s: torch.tensor([[0.0, 0.0, 0.0, 1.0]]).repeat(len(s), 1), 1.0)
    assert found is not None and math.isinf(found.regret) and "never ends" in " ".join(found.lines())
    assert found.exact_start_value == -13.0


def test_what_has_no_answer_says_why() -> None:
    for env, gamma, why in (
        (Corridor(lies=True), 0.5, "does not do what its table says"),
        (gym.make("neuralq/BlockingMaze-v0"), 0.5, "changes with time"),
        (gym.make("FrozenLake-v1"), 1.0, "a γ below 1 helps"),
    ):
        one = beside(env, gamma)
        assert why in str(one.look()) and one.look() is None
        assert one.compare(table(*Q_STAR, [0.0, 0.0]), 1.0) is None
        with pytest.raises(ValueError, match="exact=True, but there is no exact answer"):
            beside(env, gamma, asked=True)
    with pytest.raises(ValueError, match="has no model"):
        train(dataclasses.replace(CONFIG, env="CartPole-v1", layout="linear", exact=True))


def test_large_models_are_solved_only_when_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neuralq.runs.beside._MOST_PAIRS", 5)
    assert "--exact true asks for it" in str(beside(Corridor()).look())
    assert beside(Corridor(), asked=True).compare(table(*Q_STAR, [0.0, 0.0]), 1.0) is not None


@pytest.mark.parametrize("env", ["test/Hallway-v0", "neuralq/MitchellGrid-v0"])
def test_the_run_tells_it_and_is_the_same_without(tmp_path: Path, env: str) -> None:
    config = dataclasses.replace(CONFIG, env=env)
    run = train(config, tmp_path / "with")
    without = train(dataclasses.replace(config, exact=False), tmp_path / "without")
    assert run.parameters_sha256 == without.parameters_sha256 and without.exact is None
    rows = [row for row in read_metrics(tmp_path / "with") if row["kind"] == "evaluation"]
    assert all(row["regret"] >= 0 and row["q_error_max"] <= row["q_error_max_all"] for row in rows[:1]) and rows
    assert run.exact is not None and run.exact == read_json(tmp_path / "with" / "summary.json")["exact"]
    assert (tmp_path / "with" / "exact.json").exists() == (env != "test/Hallway-v0")
    again = evaluate_run(tmp_path / "with", 2)
    assert again.exact is not None and again.exact.plain() == run.exact
    assert evaluate_run(tmp_path / "without", 2).exact is None


def test_a_resumed_run_remembers_where_it_has_been(tmp_path: Path) -> None:
    whole = train(CONFIG, tmp_path / "whole")
    train(dataclasses.replace(CONFIG, total_steps=32), tmp_path / "parts")
    parts = resume(tmp_path / "parts", total_steps=64)
    assert parts.parameters_sha256 == whole.parameters_sha256 and parts.exact == whole.exact


def test_vectorised_models_and_networks_are_compared_too(tmp_path: Path) -> None:
    config = RunConfig(
        env="neuralq/DynaMaze-v0", total_steps=64, evaluate_every=64, evaluation_episodes=1, evaluation_max_steps=20,
        rollout=RolloutSettings(num_envs=2, num_steps=16),
    )  # fmt: skip
    run = train(config, tmp_path / "run")
    assert run.exact is not None and run.exact["exact_start_value"] == pytest.approx(0.99**13)


def test_the_command_shows_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--preset", "false", "--layout", "table", "--total-steps", "64", "--gamma", "0.9"]
    assert main(["train", "FrozenLake-v1", *words, "--run-dir", str(tmp_path / "run")]) == 0
    said = capsys.readouterr()
    assert "episodes are cut after 100 steps, which the model does not know" in said.err
    assert "|Q − Q*|" in said.out
    assert main(["evaluate", str(tmp_path / "run"), "--episodes", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["exact"]["exact_start_value"] == pytest.approx(0.0688909, rel=1e-5)
