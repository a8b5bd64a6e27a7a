"""Signals at any moment: what was learned is saved, and then the program ends as whoever sent the signal expects.

Mutants that must die here: an evaluation that is played to its end first · one that was abandoned and is not made up
for · a second signal that loses what was being saved · a loop over seeds that goes on after Ctrl-C · SIGHUP not heard ·
a Ctrl-C that a compiler swallowed and nobody remembers.
"""

from __future__ import annotations

import dataclasses
import io
import itertools
import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

import neuralq
from neuralq.apps import cli
from neuralq.apps.cli.kinds import say
from neuralq.apps.cli.progress import training_bar
from neuralq.learners import RolloutSettings
from neuralq.runs import RunConfig, control, loop
from neuralq.runs.control import CONTROL
from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.run_folder import read_metrics, read_summary
from neuralq.runs.recipe.build import build_session
from neuralq.runs.session import Session
from neuralq.runs.stop_request import StopAsked, StopRequest, pass_on, raise_if_asked
from neuralq.systems.backgammon.config import TdGammonConfig
from neuralq.systems.backgammon.run import TD_GAMMON
from neuralq.systems.backgammon.selfplay import SelfPlaySettings

CLOCKS = ("cpu_seconds", "wall_seconds", "steps_per_second", "games_per_second")
CONFIG = RunConfig(
    env="Signalled-v0", total_steps=160, evaluate_every=60, evaluation_episodes=2, checkpoint_every=1000, log_every=20,
    layout="linear", rollout=RolloutSettings(num_envs=2, num_steps=10),
)  # fmt: skip
SENT: list[tuple[int, ...]] = []
"""Signals that an environment sends at the fifth step of an episode of evaluation, some for each in turn."""


class Signalled(gym.Env[Any, Any]):
    """CartPole that sends this process signals where it is being evaluated."""

    def __init__(self) -> None:
        self.inner = gym.make("CartPole-v1")
        self.observation_space, self.action_space = self.inner.observation_space, self.inner.action_space
        self.num_steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.num_steps = 0
        return self.inner.reset(seed=seed)

    def step(self, action: Any) -> Any:
        self.num_steps += 1
        if self.num_steps == 5 and EVALUATING and SENT:
            for number in SENT.pop(0):
                os.kill(os.getpid(), number)
        return self.inner.step(action)


EVALUATING: list[bool] = []


@pytest.fixture(autouse=True)
def world(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    gym.register("Signalled-v0", entry_point=f"{__name__}:Signalled", max_episode_steps=30)
    play = Session.play_greedily

    def played(session: Any, seed: int) -> Any:
        EVALUATING.append(True)
        try:
            return play(session, seed)
        finally:
            EVALUATING.pop()

    monkeypatch.setattr(Session, "play_greedily", played)
    heard = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may have been started by `nohup`
    yield
    signal.signal(signal.SIGHUP, heard)
    gym.registry.pop("Signalled-v0")
    SENT.clear()


def clockless(path: Path) -> list[dict[str, Any]]:
    return [{k: v for k, v in row.items() if k not in CLOCKS} for row in read_metrics(path)]


@pytest.mark.parametrize(
    ("which", "number"),  # in the middle, and at the end of the budget
    [
        (0, signal.SIGTERM),
        (0, signal.SIGINT),
        (2, signal.SIGHUP),
        pytest.param(0, signal.SIGHUP, marks=pytest.mark.slow),
        pytest.param(2, signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param(2, signal.SIGINT, marks=pytest.mark.slow),
    ],
)
def test_a_signal_in_an_evaluation_ends_it_at_once_and_the_resumed_run_makes_up_for_it(
    number: int, which: int, tmp_path: Path
) -> None:
    whole = CONTROL.train(CONFIG, tmp_path / "whole")
    SENT.extend([()] * 2 * which + [(number,)])  # two environments each
    stopped = CONTROL.train(CONFIG, tmp_path / "parts")
    assert stopped.interrupted_by == signal.Signals(number).name
    evaluations = [row for row in read_metrics(tmp_path / "parts") if row["kind"] == "evaluation"]
    assert len(evaluations) == which  # the one that was begun was not played to its end
    SENT.clear()
    parts = CONTROL.resume(tmp_path / "parts")
    assert (parts.parameters_sha256, parts.greedy_return) == (whole.parameters_sha256, whole.greedy_return)
    assert clockless(tmp_path / "parts") == clockless(tmp_path / "whole")


def test_a_second_signal_in_an_evaluation_loses_nothing(tmp_path: Path) -> None:
    whole = CONTROL.train(CONFIG, tmp_path / "whole")
    SENT.append((signal.SIGTERM, signal.SIGTERM))
    with pytest.raises(KeyboardInterrupt):
        CONTROL.train(CONFIG, tmp_path / "parts")
    assert checkpoint.load_newest(tmp_path / "parts" / "checkpoints").step == 60
    assert CONTROL.resume(tmp_path / "parts").parameters_sha256 == whole.parameters_sha256
    assert clockless(tmp_path / "parts") == clockless(tmp_path / "whole")


def test_a_second_signal_waits_while_a_checkpoint_is_being_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill = checkpoint._fill

    def disturbed(*args: Any) -> None:
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGTERM)
        fill(*args)

    monkeypatch.setattr(loop, "keep_best", lambda *_: None)
    monkeypatch.setattr(checkpoint, "_fill", disturbed)
    with pytest.raises(KeyboardInterrupt):
        CONTROL.train(CONFIG, tmp_path / "run")
    assert checkpoint.load_newest(tmp_path / "run" / "checkpoints").step == 160


@pytest.mark.slow
def test_a_match_that_measures_td_gammon_is_abandoned_and_made_up_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from neuralq.systems.backgammon import match
    from neuralq.systems.backgammon import run as module

    settings = SelfPlaySettings(num_games=20, num_hidden=10)
    config = TdGammonConfig(settings, evaluate_every=10, evaluation_games=600, log_every=10)
    whole = TD_GAMMON.train(config, tmp_path / "whole")
    play = match.play_match
    told: list[int] = []

    def signalled(*args: Any, progress: Any, **more: Any) -> Any:
        def heard(done: int, so_far: Any) -> None:
            told.append(done)
            if len(told) == 1:
                os.kill(os.getpid(), signal.SIGTERM)
            progress(done, so_far)

        return play(*args, progress=heard, **more)

    monkeypatch.setattr(module, "play_match", signalled)
    assert TD_GAMMON.train(config, tmp_path / "parts").interrupted_by == "SIGTERM"
    assert told[0] < 600 and len(told) == 1
    parts = TD_GAMMON.resume(tmp_path / "parts")
    assert (parts.weights_sha256, parts.points_per_game) == (whole.weights_sha256, whole.points_per_game)
    assert clockless(tmp_path / "parts") == clockless(tmp_path / "whole")


def test_ctrl_c_ends_a_loop_over_seeds_and_not_one_run_of_it(tmp_path: Path) -> None:
    SENT.append((signal.SIGINT,))
    begun = []
    with pytest.raises(KeyboardInterrupt, match=r"the run was saved at 60 steps; go on with: neuralq resume .*s0"):
        for seed in range(3):
            begun.append(seed)
            neuralq.train(dataclasses.replace(CONFIG, seed=seed), tmp_path / f"s{seed}")
    assert begun == [0] and read_summary(tmp_path / "s0")["interrupted_by"] == "SIGINT"


def test_another_signal_has_its_own_effect_once_the_run_is_saved(tmp_path: Path) -> None:
    SENT.append((signal.SIGTERM,))
    heard: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))
    try:
        neuralq.train(CONFIG, tmp_path / "run")
    finally:
        signal.signal(signal.SIGTERM, before)
    assert heard == [signal.SIGTERM] and read_summary(tmp_path / "run")["interrupted_by"] == "SIGTERM"
    died = subprocess.run(
        [sys.executable, "-c", "from neuralq.runs.stop_request import pass_on; pass_on('SIGHUP', '')"], check=False
    )
    assert died.returncode == -signal.SIGHUP
    pass_on(None, "nothing came")


def test_a_hangup_that_is_ignored_stays_ignored_and_one_that_is_not_is_heard() -> None:
    request = StopRequest()
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with request.listening():
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert request.name is None
    with request.listening():
        os.kill(os.getpid(), signal.SIGHUP)
    assert request.name == "SIGHUP"


def test_a_request_inside_another_hears_what_that_one_was_asked() -> None:
    outer, inner = StopRequest(), StopRequest()
    with outer.listening((signal.SIGINT,)):
        os.kill(os.getpid(), signal.SIGINT)
        with inner.listening(), pytest.raises(StopAsked), inner.abandoning():
            raise_if_asked()
    assert inner.name == "SIGINT"


def swallowing(argv: list[str]) -> int:
    """A command in which Ctrl-C comes while a compiler's callback runs, where Python swallows what is raised."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:
            pass
    return 0


def test_a_ctrl_c_that_was_swallowed_ends_the_command_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(cli.COMMANDS, "lab", cli.Command(__name__, "swallowing", "", ""))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    try:
        assert cli.main(["lab"]) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == "neuralq: interrupted\n"


def test_ctrl_c_while_a_run_is_prepared_ends_it_before_it_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    built, closed = build_session, list[bool]()

    def build(config: RunConfig) -> Any:
        session = built(config)
        os.kill(os.getpid(), signal.SIGINT)  # heard, and not raised into whatever goes on here
        close = session.close

        def noted() -> None:
            closed.append(True)
            close()

        monkeypatch.setattr(session, "close", noted)
        return session

    monkeypatch.setattr(control, "build_session", build)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        neuralq.train(CONFIG)
    assert closed == [True] and list((tmp_path / "runs").iterdir()) == []


def test_ctrl_c_while_a_run_is_put_away_is_not_forgotten(tmp_path: Path) -> None:
    result = CONTROL.result

    def late(*args: Any) -> Any:
        os.kill(os.getpid(), signal.SIGINT)
        return result(*args)

    kind = dataclasses.replace(CONTROL, result=late)
    with pytest.raises(KeyboardInterrupt):
        kind.train(CONFIG, tmp_path / "run")
    assert read_summary(tmp_path / "run")["env_steps"] == 160


def test_no_progress_is_lost_where_a_hook_hears_the_signal(tmp_path: Path) -> None:
    def hook(row: Mapping[str, Any]) -> None:
        if row["env_steps"] == 40:
            os.kill(os.getpid(), signal.SIGHUP)

    run = CONTROL.train(CONFIG, tmp_path / "run", [hook])
    assert (run.interrupted_by, run.env_steps) == ("SIGHUP", 40)


class Gone(io.StringIO):
    """A terminal that was closed: whatever is written to it fails."""

    def write(self, text: str) -> int:
        raise OSError(5, "Input/output error")


@pytest.mark.parametrize("is_terminal", [False, True])
def test_a_terminal_that_has_gone_costs_what_is_told_and_nothing_else(
    is_terminal: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = Gone()
    monkeypatch.setattr(gone, "isatty", lambda: is_terminal)
    monkeypatch.setattr("sys.stderr", gone)
    with training_bar(CONTROL, CONFIG, gone, clock=itertools.count(step=60.0).__next__) as bar:
        bar.say("a line")
        run = CONTROL.train(CONFIG, tmp_path / "run", [bar])
    say("another")
    assert run.env_steps == 160
