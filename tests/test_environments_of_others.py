"""Environments are somebody else's code: how many may exist, how long they take, and how they break their word.

Mutants that must die here: an environment left open by a build that failed · evaluation environments made before they
are needed · a probe without an end · an evaluation that eats the run · an exit that looks like success.
"""

from __future__ import annotations

import dataclasses
import io
import itertools
import json
import os
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from neuralq.apps.cli import main
from neuralq.learners import RolloutSettings
from neuralq.runs import RunConfig, evaluate_run, load, resume, train
from neuralq.runs.folder.env_probe import is_resumable, untried
from neuralq.runs.folder.run_folder import read_metrics
from neuralq.runs.recipe.build import build_session
from neuralq.runs.recipe.environments import make_envs
from neuralq.runs.session import cap_on_evaluation
from neuralq.runs.stream import EnvironmentFault, Interaction

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
        self.P = BEHAVIOUR.get("table", {0: "one"})

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


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing a report takes longer than all the rest, and is not what is asked here."""
    monkeypatch.setattr("neuralq.apps.cli.runs.write_report", lambda path: path)


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
        assert resume(tmp_path / "parts", total_steps=240).parameters_sha256 == whole.parameters_sha256
    BEHAVIOUR["does"] = None
    env = Other()
    env.late = threading.Lock()
    assert not untried(env).exact and "late" in untried(env).reason
    env.close()


def test_an_evaluation_without_a_time_limit_gets_a_share_of_the_budget_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    BEHAVIOUR["never ends"] = True
    argv = ["train", "Other-v0", "--layout", "table", "--total-steps", "60", "--evaluation-episodes", "3"]
    argv += [
        "--evaluate-every",
        "60",
        "--rollout.num-envs",
        "1",
        "--rollout.num-steps",
        "10",
        "--resume-probe",
        "false",
    ]
    assert main([*argv, "--run-dir", str(tmp_path / "run")]) == 0
    (row,) = [row for row in read_metrics(tmp_path / "run") if row["kind"] == "evaluation"]
    # ten times 60 steps between evaluations over 3 episodes, where 10,000 steps each were played before
    assert (row["num_cut"], row["max_steps"], row["greedy_return"]) == (3, 200, -200.0)
    assert set(evaluate_run(tmp_path / "run", 2).lengths) == {200}  # evaluate knows what training had
    said = capsys.readouterr()
    assert "3 of 3 evaluation episodes were cut off after 200 steps" in said.out + said.err
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


# How they break their word


def late(steps: int, what: Any) -> Any:
    """Does something once an instance has taken so many steps."""

    def does(env: Other) -> None:
        if env.num_steps == steps:
            what(env)

    return does


def test_an_environment_that_becomes_uncopyable_late_goes_on_and_says_what_is_promised(tmp_path: Path) -> None:
    BEHAVIOUR["does"] = late(150, lambda env: setattr(env, "late", threading.Lock()))
    long = config(total_steps=240, checkpoint_every=60, resume_probe=False)
    with pytest.warns(
        UserWarning, match=r"after 180 steps the environment's state can no longer be saved: .*late is a"
    ):
        run = train(long, tmp_path / "run")
    assert run.env_steps == 240 and "not bit-exact: after 180 steps" in run.resumability
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert resume(tmp_path / "run", total_steps=300).env_steps == 300


def test_an_environment_whose_saved_state_cannot_be_put_back_begins_a_new_episode(tmp_path: Path) -> None:
    train(config(), tmp_path / "run")
    BEHAVIOUR["table"] = {0: "another"}  # than the one it had when it was saved
    with pytest.warns(UserWarning, match="saved state could not be put back: env.*P is not what it was"):
        run = resume(tmp_path / "run", total_steps=180)
    assert run.env_steps == 180 and "not bit-exact" in run.resumability


@pytest.mark.parametrize("where", ["in a step", "while it is made"])
@pytest.mark.parametrize("status", [0, None, "no licence"])
def test_an_environment_that_exits_is_a_fault_and_no_success(
    where: str, status: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def leave(*_: Any, **__: Any) -> None:
        sys.exit(status)

    if where == "in a step":
        BEHAVIOUR["does"] = late(50, leave)
    else:
        monkeypatch.setattr(Other, "__init__", leave)
    argv = ["train", "Other-v0", "--layout", "table", "--total-steps", "100", "--resume-probe", "false"]
    argv += ["--rollout.num-envs", "1", "--rollout.num-steps", "10", "--run-dir", str(tmp_path / "run"), "--json"]
    assert main(argv) == 1
    captured = capsys.readouterr()
    assert captured.out == "" and "Traceback" not in captured.err
    told = "SystemExit" if where != "in a step" else "after 49 environment steps, environment 0 called sys.exit("
    assert told in captured.err and str(status or "") in captured.err


def test_what_an_environment_prints_stays_out_of_the_result_and_where_it_goes_it_comes_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()

    def noisy(env: Other) -> None:
        print("no end of line", end="")
        os.chdir(tmp_path / "elsewhere")

    def deaf(env: Other) -> None:
        sys.stdout = io.StringIO()

    before = sys.stdout
    argv = ["train", "Other-v0", "--layout", "table", "--total-steps", "40", "--resume-probe", "false"]
    argv += ["--rollout.num-envs", "1", "--rollout.num-steps", "10", "--evaluation-max-steps", "20", "--json"]
    for name, does in (("noisy", noisy), ("deaf", deaf)):
        BEHAVIOUR["does"] = does
        assert main([*argv, "--run-dir", name]) == 0
        assert sys.stdout is before
        assert json.loads(capsys.readouterr().out)["run_dir"] == name  # one object, and nothing else
        assert {"checkpoints", "metrics.jsonl", "summary.json"} <= set(os.listdir(tmp_path / name))
    assert os.listdir(tmp_path / "elsewhere") == [] and Path.cwd() == tmp_path


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda s, r, end, cut, info: (s, r, "no", cut, info), "terminated must be true or false, got 'no'"),
        (lambda s, r, end, cut, info: (s, r, end, None, info), "truncated must be true or false, got None"),
        (lambda s, r, end, cut, info: (s, r, [False, True], cut, info), "terminated must be true or false, got [False"),
        (lambda s, r, end, cut, info: (s, r, 2, cut, info), "terminated must be true or false, got 2"),
        (lambda s, r, end, cut, info: (s, r, end, cut, None), "environment 1: info must be a mapping, got None"),
        (lambda s, r, end, cut, info: (s, r, end, info), "not enough values to unpack"),
    ],
)  # fmt: skip
def test_what_a_step_hands_out_is_checked_field_by_field(change: Any, told: str) -> None:
    turn = itertools.cycle((False, True))

    def of_the_second(*result: Any) -> Any:
        return change(*result) if next(turn) else result

    envs = make_envs(config(2), 2)
    stream = Interaction(envs, 0.9, 0)
    always_left = lambda s: (torch.zeros(len(s), dtype=torch.int64), torch.ones(len(s)))  # noqa: E731
    for _ in range(3):
        stream.step(always_left)
    BEHAVIOUR["returns"] = of_the_second
    with pytest.raises(EnvironmentFault, match="after 6 environment steps, environment 1") as fault:
        stream.step(always_left)
    assert told in str(fault.value)
    envs.close()


def test_whole_numbers_and_arrays_of_one_are_flags_too() -> None:
    BEHAVIOUR["returns"] = lambda s, r, end, cut, info: (s, r, int(end), np.array([cut]), info)
    envs = make_envs(config(2), 2)
    stream = Interaction(envs, 0.9, 0)
    for _ in range(8):
        stream.step(lambda s: (torch.ones(len(s), dtype=torch.int64), torch.ones(len(s))))
    assert len(stream.step(lambda s: (torch.ones(2, dtype=torch.int64), torch.ones(2))).episodes) == 2
    envs.close()


class Batch(gym.vector.VectorEnv[Any, Any, Any]):
    """Two environments at once that hand out whatever they are told to."""

    def __init__(self, step: tuple[Any, ...]) -> None:
        self.num_envs, self.result = 2, step
        self.metadata = {"autoreset_mode": gym.vector.AutoresetMode.NEXT_STEP}
        self.single_observation_space, self.single_action_space = spaces.Box(0, 1, (3,)), spaces.Discrete(2)

    def reset(self, **_: Any) -> Any:
        return np.zeros((2, 3), np.float32), {}

    def step(self, actions: Any) -> Any:
        return self.result


RIGHT: tuple[Any, ...] = (np.zeros((2, 3), np.float32), np.zeros(2), np.zeros(2, bool), np.zeros(2, bool), {})


@pytest.mark.parametrize(
    ("place", "value", "told"),
    [
        (0, np.zeros((1, 3), np.float32), "observation: must have 2 rows, got 1"),
        (0, np.zeros((3, 3), np.float32), "observation: must have 2 rows, got 3"),
        (1, np.zeros(1), r"reward: must have shape \(2,\), got \(1,\)"),
        (2, np.zeros((2, 1), bool), r"terminated: must have shape \(2,\), got \(2, 1\)"),
        (2, False, r"terminated: must have shape \(2,\), got \(\)"),
        (3, np.array([False, "no"], object), "environment 1, step 1 of its episode, field truncated: .* got 'no'"),
        (3, np.array([0.0, 0.5]), "environment 1, step 1 of its episode, field truncated: .* got 0.5"),
    ],
)
def test_what_a_batch_hands_out_has_a_row_for_each_environment(place: int, value: Any, told: str) -> None:
    result = (*RIGHT[:place], value, *RIGHT[place + 1 :])
    stream = Interaction(Batch(result), 0.9, 0)
    with pytest.raises(EnvironmentFault, match=f"field {told}" if told.startswith(("o", "r", "t")) else told):
        stream.step(lambda s: (torch.zeros(2, dtype=torch.int64), torch.ones(2)))
    stream = Interaction(Batch((*RIGHT[:2], np.array([0, 1]), *RIGHT[3:])), 0.9, 0)  # numbers do
    assert [
        e.env_index for e in stream.step(lambda s: (torch.zeros(2, dtype=torch.int64), torch.ones(2))).episodes
    ] == [1]


def test_an_object_of_a_class_without_a_module_is_looked_into_and_one_that_raises_is_told_as_such() -> None:
    class FromNowhere(type):  # of classes that do not say so, as some of C++ libraries do not
        def __getattribute__(cls, name: str) -> Any:
            if name == "__module__":
                raise AttributeError(name)
            return super().__getattribute__(name)

    class Nameless(metaclass=FromNowhere):
        pass

    class Raising:
        __slots__ = ("held",)

        def __getattribute__(self, name: str) -> Any:
            raise OSError("no such part")

    env = Other()
    env.late = Nameless()
    assert untried(env).exact
    env.late = Raising()
    found = untried(env)
    assert (
        not found.exact
        and "cannot be looked into (asked for its parts it raised OSError: no such part)" in found.reason
    )
    env.close()
