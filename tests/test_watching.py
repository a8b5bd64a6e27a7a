"""Hooks that are shown the session: when they are called, what they see, how they stop a run and go on with it.

Mutants that must die here: a step, update or evaluation that is not told, or told twice · values in the wrong units ·
arrays or the session left writable · a stop that forgets to save, to evaluate, or who it was · a state that is not
stored, given to another hook, or lost because its hook is missing once · a fault in the middle of a rollout that loses
the run · a hook that changes what is learned.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neuralq.apps.cli import main
from neuralq.learners import ReplaySettings, RolloutSettings
from neuralq.q import MLP
from neuralq.runs import RunConfig, load, resume, train
from neuralq.runs.folder.checkpoint import load_newest
from neuralq.runs.folder.run_folder import read_metrics, read_summary
from neuralq.runs.loop import HookFault
from neuralq.runs.recipe.config import config_to_dict
from neuralq.runs.sweep import create_sweep


def configuration(**given: Any) -> RunConfig:
    small = {
        "total_steps": 128,
        "evaluate_every": 32,
        "evaluation_episodes": 1,
        "log_every": 32,
        "epsilon_decay_steps": 64,
        "body": MLP((8,)),
    }
    rollout = {} if "learner" in given else {"rollout": RolloutSettings(num_envs=2, num_steps=8)}
    return RunConfig(**{**small, **rollout, "resume_probe": True, **given})


class Everything:
    """Notes whatever it is shown."""

    def __init__(self) -> None:
        self.steps, self.updates, self.evaluations, self.ends = [], [], [], []  # type: ignore[var-annotated]
        self.rewards, self.lengths = 0.0, []  # type: ignore[var-annotated]

    def on_step(self, session: Any) -> None:
        step = session.step
        self.steps.append((session.env_steps, len(step.env_indices)))
        self.rewards += float(step.r_t.sum())
        self.lengths += [episode.length for episode in step.episodes]
        assert step.s_tm1.shape == step.s_t.shape == (len(step.a_tm1), 4) and step.last_t.sum() == len(step.episodes)
        with pytest.raises(ValueError, match="read-only"):
            step.s_t[0] = 0

    def on_update(self, session: Any) -> None:
        self.updates.append((session.env_steps, session.num_updates))
        assert len(session.update["errors"]) == len(session.update["targets"])

    def on_evaluation(self, session: Any) -> None:
        assert session.metrics == read_metrics(session.run_dir)
        assert session.evaluation == session.metrics[-1] and session.evaluation["env_steps"] == session.env_steps
        self.evaluations.append((session.env_steps, session.values([0.0, 0.1, 0.02, -0.1])))
        assert np.array_equal(session.q([0.0, 0.1, 0.02, -0.1]), 0.5 * self.evaluations[-1][1])
        session.parameters()["trunk.layers.0.weight"][:] = 0  # a copy
        with pytest.raises(AttributeError, match="hooks read a session and change nothing"):
            session.env_steps = 3

    def on_end(self, session: Any) -> None:
        assert session.config.gamma == 0.99 and session.best_return is not None
        self.ends.append(session.ended_by)


@pytest.mark.parametrize("learner", ["rollout", "replay"])
def test_hooks_are_shown_every_step_update_and_evaluation_and_change_nothing(tmp_path: Path, learner: str) -> None:
    replay = {"learner": "replay", "replay": ReplaySettings(learning_starts=20, batch_size=8, train_period=2)}
    config = configuration(reward_scale=0.5, **(replay if learner == "replay" else {}))
    seen = Everything()
    run = train(config, tmp_path / "run", [seen])
    assert run.parameters_sha256 == train(config, tmp_path / "alone").parameters_sha256
    assert [n for n, _ in seen.steps] == np.cumsum([k for _, k in seen.steps]).tolist()
    assert seen.steps[-1][0] == run.env_steps == seen.rewards  # CartPole pays 1 a step
    assert seen.lengths and sum(seen.lengths) <= run.env_steps
    if learner == "replay":
        assert seen.updates == [(20 + 2 * k, k + 1) for k in range(55)]
    else:
        assert [n for n, _ in seen.updates] == [n for n, _ in seen.steps][7::8]
    rows = [row["env_steps"] for row in read_metrics(tmp_path / "run") if row["kind"] == "evaluation"]
    assert [n for n, _ in seen.evaluations] == rows and len(rows) == 4 and seen.ends == ["budget"]
    agent = load(tmp_path / "run")
    assert np.array_equal(seen.evaluations[-1][1], agent.values([0.0, 0.1, 0.02, -0.1]))


def mountain(**given: Any) -> RunConfig:
    """No episode ends within the budget, so that every rollout has sixteen steps."""
    return configuration(env="MountainCar-v0", evaluation_max_steps=10, **given)


class Counting:
    """Counts steps and asks for the end at some of them."""

    def __init__(self, until: int = 10**9) -> None:
        self.count, self.until, self.ended_by = 0, until, ""

    def on_step(self, session: Any) -> None:
        self.count += 1
        if self.count == self.until:
            session.stop("that will do")

    def on_end(self, session: Any) -> None:
        self.ended_by = session.ended_by

    def state_dict(self) -> dict[str, Any]:
        return {"count": self.count, "bytes": np.arange(3)}

    def load_state_dict(self, state: Any) -> None:
        assert state["bytes"].tolist() == [0, 1, 2]
        self.count = state["count"]


def test_a_stop_is_saved_evaluated_told_and_can_be_resumed_bit_for_bit(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    hook, other = Counting(until=20), Counting()
    run = train(mountain(), tmp_path / "run", [hook, other])
    assert run.env_steps == 48  # two environments: the 20th step stands in the third rollout, which is finished
    assert run.stopped_by == hook.ended_by == f"the hook {__name__}:Counting: that will do"
    assert run.interrupted_by is None and read_summary(run.run_dir)["stopped_by"] == run.stopped_by
    assert read_metrics(run.run_dir)[-1]["kind"] == "evaluation" and run.greedy_return is not None
    states = load_newest(run.run_dir / "checkpoints").state["hooks"]
    assert {name: state["count"] for name, state in states.items() if "count" in state} == {
        f"{__name__}:Counting": 24,
        f"{__name__}:Counting #2": 24,
    }
    with caplog.at_level(logging.WARNING, "neuralq"):
        assert resume(run.run_dir, 64).stopped_by is None
    assert f"the hook {__name__}:Counting #2, which is missing" in caplog.text and "its state is kept" in caplog.text
    hook, other = Counting(), Counting()
    whole = resume(run.run_dir, 128, [hook, other])
    assert (hook.count, other.count) == (24 + 32, 24 + 32)  # those of the 16 steps of nobody's are missing
    assert whole.parameters_sha256 == train(mountain(), tmp_path / "alone").parameters_sha256


class Raising:
    """Raises where it is told to."""

    def __init__(self, where: str) -> None:
        self.where, self.count = where, 0

    def on_step(self, session: Any) -> None:
        self.count += 1
        if self.where == "on_step" and self.count == 13:
            raise LookupError("no such step")

    def on_end(self, session: Any) -> None:
        if self.where == "on_end":
            raise LookupError("no end")

    def state_dict(self) -> dict[str, Any]:
        return {"count": {"state_dict": object(), "none": None}.get(self.where, self.count)}

    def load_state_dict(self, state: Any) -> None:
        if self.where == "load_state_dict":
            raise LookupError("no such state")


@pytest.mark.parametrize("where", ["on_step", "on_end", "state_dict"])
def test_a_hook_that_raises_costs_no_training(tmp_path: Path, where: str) -> None:
    config, path = mountain(checkpoint_every=64), tmp_path / "run"
    with pytest.raises(HookFault, match=rf"Raising raised .*the run is saved at .*resume {path}"):
        train(config, path, [Raising(where)])
    saved = load_newest(path / "checkpoints").step
    assert saved == {"on_step": 32, "on_end": 128, "state_dict": 64}[where]
    if where == "on_end":
        return
    with pytest.raises(HookFault, match=r"no such state .*the run is as it was"):
        resume(path, hooks=[Raising("load_state_dict")]) if where == "on_step" else _raise_as_if()
    assert load_newest(path / "checkpoints").step == saved
    assert resume(path).parameters_sha256 == train(config, tmp_path / "alone").parameters_sha256


def _raise_as_if() -> None:
    """A state that was never stored is never given back."""
    raise HookFault("no such state (nothing was stored): the run is as it was")


HOOKS = """
class Patient:
    def __init__(self):
        self.looks = 0
    def on_evaluation(self, session):
        self.looks += 1
        if self.looks >= 2:
            session.stop("two looks")
    def state_dict(self):
        return {"looks": self.looks}
    def load_state_dict(self, state):
        self.looks = state["looks"]
class Noting:
    def on_end(self, session):
        (session.run_dir / "noted.txt").write_text(session.ended_by)
"""


def test_several_hooks_from_the_shell_stop_a_run_and_seeds_of_a_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "shell_hooks.py").write_text(HOOKS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    words = ["--preset", "false", "--rollout.num-envs", "2", "--rollout.num-steps", "8", "--hidden", "4"]
    words += ["--evaluation-episodes", "1", "--evaluate-every", "16", "--total-steps", "64", "--resume-probe", "false"]
    words += ["--hook", "shell_hooks:Patient", "--hook", "shell_hooks:Noting"]
    assert main(["train", "MountainCar-v0", *words, "--run-dir", "run"]) == 0
    told = "the hook shell_hooks:Patient: two looks"
    assert f"stopped by {told}; go on: neuralq resume run" in capsys.readouterr().out
    assert Path("run/noted.txt").read_text() == told
    assert main(["resume", "run", "--hook", "shell_hooks:Patient", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["env_steps"] == 48 and result["stopped_by"] == told  # its count of looks went on
    status = main(["train", "MountainCar-v0", *words, "--run-dir", "aimed", "--stop-at-return", "0"])
    assert status == 1 and f"was not reached before {told}, after 32 steps" in capsys.readouterr().err
    sweep = create_sweep("sweep", config_to_dict(RunConfig()), [0], words[-4:])
    Path("run").rename(sweep.run_path(0))
    member = next(sweep.members())
    assert sweep.state(member).state == "finished" and sweep.task(member).options == tuple(words[-4:])


@pytest.mark.whole
def test_runs_of_other_kinds_say_what_they_do_not_show(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    from neuralq.systems.backgammon import TdGammonConfig
    from neuralq.systems.backgammon.run import train_games
    from neuralq.systems.backgammon.selfplay import SelfPlaySettings

    class Looking:
        def on_step(self, session: Any) -> None:
            raise AssertionError

        def on_evaluation(self, session: Any) -> None:
            session.stop("enough games")

        def on_end(self, session: Any) -> None:
            assert session.amount == 2 and session.metrics and session.ended_by.endswith("Looking: enough games")
            with pytest.raises(ValueError, match="show no action values to hooks"):
                session.values(0)

    settings = SelfPlaySettings(num_games=4, num_hidden=10)
    config = TdGammonConfig(settings, evaluate_against=("random",), evaluate_every=2, evaluation_games=2)
    with caplog.at_level(logging.WARNING, "neuralq"):
        run = train_games(config, tmp_path / "run", [Looking()])
    assert run.games == 2 and run.stopped_by is not None and run.stopped_by.endswith("Looking: enough games")
    assert "is never called: a run of this kind tells of no single ones" in caplog.text
