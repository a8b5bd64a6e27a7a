"""Environments are somebody else's code: how many may exist, how long they take, and how they break their word.

Mutants that must die here: an environment left open by a build that failed · evaluation environments made before they
are needed · a probe without an end · an evaluation that eats the run · an exit that looks like success.
"""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from neuralq.apps.cli import main
from neuralq.learners import RolloutSettings
from neuralq.runs import RunConfig, evaluate_run, load, train
from neuralq.runs.folder.env_probe import is_resumable, untried
from neuralq.runs.folder.run_folder import read_metrics
from neuralq.runs.recipe.build import build_session, make_envs
from neuralq.runs.session import cap_on_evaluation

OPEN: list[int] = []
"""Instances that are open, by id."""
BEHAVIOUR: dict[str, Any] = {}


class Other(gym.Env[Any, Any]):
    """Ten states in a row, action 1 goes right to the end; with whatever behaviour is asked for."""

    def __init__(self, most: int | None = None, late: int | None = None, **_: Any) -> None:
        if most is not None and len(OPEN) >= most:
            raise RuntimeError(f"only {most} at a time")
        OPEN.append(id(self))
        self.observation_space: Any = spaces.Discrete(10)
        if BEHAVIOUR.get("no learner takes it"):
            self.observation_space = spaces.Text(5)
        self.action_space = spaces.Discrete(2)
        self.state, self.num_steps = 0, 0
        self.late: Any = late

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.state = 0
        return 0, {}

    def step(self, action: Any) -> Any:
        self.num_steps += 1
        time.sleep(BEHAVIOUR.get("seconds", 0.0))
        move = int(action) if not BEHAVIOUR.get("never ends") else 0
        self.state = min(self.state + move, 9)
        result: tuple[Any, ...] = (self.state, -1.0, self.state == 9, False, {})
        if "returns" in BEHAVIOUR and self.num_steps > 3:
            result = BEHAVIOUR["returns"](*result)
        if "does" in BEHAVIOUR:
            BEHAVIOUR["does"](self)
        return result

    def close(self) -> None:
        if id(self) in OPEN:
            OPEN.remove(id(self))


@pytest.fixture(autouse=True)
def world() -> Iterator[None]:
    gym.register("Other-v0", entry_point=f"{__name__}:Other", disable_env_checker=True, order_enforce=False)
    gym.register(
        "Limited-v0", entry_point=f"{__name__}:Other", disable_env_checker=True, max_episode_steps=300
    )  # fmt: skip
    OPEN.clear()
    BEHAVIOUR.clear()
    yield
    for name in ("Other-v0", "Limited-v0"):
        gym.registry.pop(name)
    assert OPEN == [], "an environment was left open"


def config(num_envs: int = 1, **given: Any) -> RunConfig:
    usual: dict[str, Any] = {
        "total_steps": 120, "evaluate_every": 60, "evaluation_episodes": 3, "log_every": 60, "layout": "table"
    }  # fmt: skip
    return RunConfig(env="Other-v0", rollout=RolloutSettings(num_envs=num_envs, num_steps=10), **{**usual, **given})


# How many there may be


def test_an_environment_that_may_exist_once_is_trained_on_and_evaluated_afterwards(tmp_path: Path) -> None:
    alone = config(env_kwargs={"most": 1}, evaluation_max_steps=50)
    with pytest.warns(UserWarning, match="the run is not evaluated: .*only 1 at a time"):
        run = train(alone, tmp_path / "run")
    assert run.greedy_return is None and run.env_steps >= 120
    assert evaluate_run(tmp_path / "run", 2).lengths  # one after another
    assert load(tmp_path / "run").predict(0) in (0, 1)


def test_where_fewer_may_exist_at_a_time_the_same_episodes_are_played_one_after_another(tmp_path: Path) -> None:
    run = train(config(env_kwargs={"most": 2}), tmp_path / "few")  # one to train on, one to evaluate on
    many = train(config(), tmp_path / "many")
    assert run.greedy_return == many.greedy_return
    few, all_at_once = (
        [row["returns"] for row in read_metrics(tmp_path / name) if row["kind"] == "evaluation"]
        for name in ("few", "many")
    )
    assert few == all_at_once and len(few[0]) == 3


def test_too_many_at_a_time_is_said_and_none_is_left_open() -> None:
    with pytest.raises(ValueError, match=r"only 2 at a time; 2 of 4 were made before; there may have to be fewer"):
        build_session(config(4, env_kwargs={"most": 2}))


def test_evaluation_environments_are_made_when_they_are_first_needed() -> None:
    session = build_session(config(2))
    assert len(OPEN) == 2
    session.evaluate(1)
    assert len(OPEN) == 2 + 3
    session.close()


@pytest.mark.parametrize("wrong", ["space", "kernel", "argument"])
def test_a_build_that_fails_leaves_nothing_open(wrong: str, monkeypatch: pytest.MonkeyPatch) -> None:
    refused = config(2)
    if wrong == "space":
        BEHAVIOUR["no learner takes it"] = True
    elif wrong == "kernel":

        def broken(*_: Any) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr("neuralq.runs.recipe.build._warm", broken)
    else:
        refused = dataclasses.replace(refused, layout="action-output", env_kwargs={"late": 3})
        monkeypatch.setattr("neuralq.runs.recipe.build.make_engine", lambda *_: 1 / 0)
    with pytest.raises((ValueError, KeyboardInterrupt, ZeroDivisionError)):
        build_session(refused)
    assert OPEN == []


# How long they take


def test_the_probe_of_a_slow_environment_ends_and_says_how_far_it_came() -> None:
    BEHAVIOUR["seconds"] = 0.03
    begun = time.monotonic()
    found = is_resumable(Other, 0, np.random.default_rng(0), seconds=0.3)
    # 145 steps of .03 s would be 4.4 s; three thirds of .1 s, and a step more in each, are .4 s
    assert time.monotonic() - begun < 1.5
    assert found.exact and "as far as 60" not in found.reason
    assert 1 <= int(found.reason.split("as far as ")[1].split()[0]) <= 4


def test_the_probe_can_be_left_out_and_the_state_is_saved_all_the_same(tmp_path: Path) -> None:
    whole = train(config(total_steps=240), tmp_path / "whole")
    first = train(config(resume_probe=False), tmp_path / "parts")
    assert "whether bit-exact was not tried" in first.resumability
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        from neuralq.runs import resume

        assert resume(tmp_path / "parts", total_steps=240).parameters_sha256 == whole.parameters_sha256
    BEHAVIOUR["does"] = None
    env = Other()
    env.late = open(__file__, "rb")
    assert not untried(env).exact and "late" in untried(env).reason
    env.late.close()
    env.close()


def test_an_evaluation_without_a_time_limit_gets_a_share_of_the_budget_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    BEHAVIOUR["never ends"] = True
    run = train(config(), tmp_path / "run")
    rows = [row for row in read_metrics(tmp_path / "run") if row["kind"] == "evaluation"]
    # ten times 60 steps between evaluations over 3 episodes, where 10,000 steps each were played before
    assert [(row["num_cut"], row["max_steps"]) for row in rows] == [(3, 200), (3, 200)]
    assert run.greedy_return == -200.0
    assert set(evaluate_run(tmp_path / "run", 2).lengths) == {200}  # evaluate knows what training had
    argv = ["train", "Other-v0", "--layout", "table", "--total-steps", "60", "--evaluation-episodes", "3"]
    argv += ["--rollout.num-envs", "1", "--rollout.num-steps", "10", "--run-dir", str(tmp_path / "told")]
    assert main(argv) == 0
    said = capsys.readouterr()
    assert "3 of 3 evaluation episodes were cut off after" in said.out + said.err
    assert "--evaluation-max-steps" in said.out + said.err


def test_the_cap_is_ten_times_the_longest_episode_of_training(tmp_path: Path) -> None:
    run = train(config(epsilon_decay_steps=10_000, evaluate_every=600, total_steps=600), tmp_path / "run")
    longest = cap_on_evaluation(10**9, 600, 3)
    (row,) = [row for row in read_metrics(run.run_dir) if row["kind"] == "evaluation"]
    assert row["max_steps"] < longest and row["max_steps"] % 10 == 0
    # 9 steps to the right, half of the actions: 18 on average
    assert 100 <= row["max_steps"] <= 10 * 90


def test_with_a_time_limit_or_a_cap_of_ones_own_nothing_is_learned_from_training(tmp_path: Path) -> None:
    for number, one in enumerate((config(evaluation_max_steps=7), dataclasses.replace(config(), env="Limited-v0"))):
        path = train(one, tmp_path / str(number)).run_dir
        assert all("max_steps" not in row for row in read_metrics(path))
    envs = make_envs(dataclasses.replace(config(), env="Limited-v0"), 1)
    envs.close()
