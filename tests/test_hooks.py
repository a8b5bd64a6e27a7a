"""Hooks show what happens and change nothing.

Mutants that must die here: a line for every row where nobody watches · no line at all · returns forgotten between rows
· a target that is not shown · numbers written at another step · a hook that changes the run · a hook
of the user's own that is not called, or not closed.
"""

from __future__ import annotations

import io
import re
import sys
import time
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from neuralq.apps.cli import _show_warning, main
from neuralq.apps.cli.progress import ProgressBar, training_bar
from neuralq.checks import MissingExtra
from neuralq.learners import RolloutSettings
from neuralq.q import MLP
from neuralq.runs import RunConfig, train
from neuralq.runs.control import CONTROL
from neuralq.runs.evaluation import Evaluation, shown
from neuralq.runs.folder.run_folder import read_metrics
from neuralq.runs.hooks import TensorBoard, own_hook
from neuralq.runs.kinds import kind_named
from neuralq.systems.backgammon import TdGammonConfig


def row(steps: int, **more: Any) -> dict[str, Any]:
    return {"kind": "train", "env_steps": steps, "steps_per_second": 1234.0, "episode_return": 20.25, **more}


def run_bar(
    stream: io.StringIO | None = None, clock: Callable[[], float] = time.monotonic, **config: Any
) -> ProgressBar[Mapping[str, Any]]:
    return training_bar(CONTROL, RunConfig(**{"epsilon_end": 0.0, "epsilon_decay_steps": 100, **config}), stream, clock)


def test_without_a_terminal_there_is_a_line_every_ten_seconds() -> None:
    now, stream = [0.0], io.StringIO()
    config = {"total_steps": 10_000, "stop_at_return": 475.0, "epsilon_decay_steps": 10_000}
    with run_bar(stream, lambda: now[0], **config) as bar:
        for second in range(25):
            now[0] = float(second)
            bar(row(100 * second))
            bar({"kind": "evaluation", "env_steps": 100 * second, "greedy_return": 99.5})
    lines = stream.getvalue().splitlines()
    assert lines == [
        "1,100 of 10,000 steps · 7 s left · 1,234 steps/s · ε 0.89 · return 20.2 · greedy 99.5 (target 475)",
        "2,200 of 10,000 steps · 6 s left · 1,234 steps/s · ε 0.78 · return 20.2 · greedy 99.5 (target 475)",
    ]


def test_exploration_error_and_the_largest_value_are_told() -> None:
    now, stream = [0.0], io.StringIO()
    with run_bar(stream, lambda: now[0], total_steps=200_000) as bar:
        now[0] = 11.0
        bar(row(25, abs_td_error=0.12345, max_q=8.0))
    told = "25 of 200,000 steps · 3 min left · 1,234 steps/s · ε 0.75 · |δ| 0.123 · max Q 8 · return 20.2\n"
    assert stream.getvalue() == told


def test_games_are_told_as_steps_are() -> None:
    now, stream = [0.0], io.StringIO()
    with training_bar(kind_named("td-gammon"), TdGammonConfig(num_games=100), stream, lambda: now[0]) as bar:
        bar({"kind": "evaluation", "games": 40, "ppg_random": 0.5, "ppg_random_standard_error": 0.01})
        now[0] = 11.0
        bar({"kind": "train", "games": 50, "games_per_second": 10.0})
    assert stream.getvalue() == "50 of 100 games · 5 s left · 10 games/s · random +0.500 ± 0.010\n"


OWN = """
seen = []
def note(row):
    seen.append(dict(row))
class Closing:
    closed = 0
    def __call__(self, row):
        seen.append(row["kind"])
    def close(self):
        Closing.closed += 1
number = 3
"""


def test_a_hook_of_ones_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own_hooks.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    words = ["--preset", "false", "--rollout.num-envs", "2", "--rollout.num-steps", "16", "--hidden", "4"]
    words += ["--evaluation-episodes", "1", "--total-steps", "64", "--log-every", "32"]
    path = str(tmp_path / "run")
    assert main(["train", "CartPole-v1", *words, "--run-dir", path, "--hook", "own_hooks:note"]) == 0
    module = sys.modules.pop("own_hooks")
    assert module.seen == read_metrics(path)
    assert main(["resume", path, "--total-steps", "128", "--hook", "own_hooks:Closing"]) == 0
    module = sys.modules.pop("own_hooks")
    assert "train" in module.seen and module.Closing.closed == 1
    for name, said in (("own_hooks:nobody", "cannot import the hook"), ("nowhere", "name it as 'module:function'")):
        assert main(["resume", path, "--total-steps", "256", "--hook", name]) == 1
        assert said in capsys.readouterr().err
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match="must take a row of metrics when called, got 3"):
        own_hook("own_hooks:number")


def test_a_row_without_returns_keeps_the_last_ones() -> None:
    now, stream = [0.0], io.StringIO()
    with run_bar(stream, lambda: now[0], total_steps=100) as bar:
        bar(row(10))
        now[0] = 11.0
        bar(row(20, episode_return=None))
    assert stream.getvalue() == "20 of 100 steps · 0 s left · 1,234 steps/s · ε 0.8 · return 20.2\n"


def test_in_a_terminal_there_is_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "120")
    stream = Terminal()
    with run_bar(stream, total_steps=1000, stop_at_return=475.0) as bar:
        bar(row(250))
        bar({"kind": "evaluation", "env_steps": 250, "greedy_return": 99.5})
    assert "250/1000" in stream.getvalue() and "1,234 steps/s" in stream.getvalue()
    assert "greedy 99.5 (target 475)" in stream.getvalue()


def test_the_bar_is_drawn_on_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    with run_bar(clock=lambda: now[0]) as bar:
        now[0] = 11.0
        bar(row(10))
    captured = capsys.readouterr()
    assert captured.out == "" and "10 of 100,000 steps" in captured.err


def test_tensorboard_holds_every_number_at_its_step(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    board = TensorBoard(tmp_path)
    board(row(64, loss=0.5))
    board(row(128, loss=0.25, episode_return=None))
    board({"kind": "evaluation", "env_steps": 128, "greedy_return": 30.0, "returns": [30.0]})
    board.close()
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert {t: [(e.step, e.value) for e in events.Scalars(t)] for t in events.Tags()["scalars"]} == {
        "train/steps_per_second": [(64, 1234.0), (128, 1234.0)],
        "train/episode_return": [(64, 20.25)],
        "train/loss": [(64, 0.5), (128, 0.25)],
        "evaluation/greedy_return": [(128, 30.0)],
    }


def test_a_missing_tensorboard_is_one_error_with_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(MissingExtra, match=r'pip install "neuralq\[tensorboard\]"'):
        TensorBoard(tmp_path / "board")
    assert not (tmp_path / "board").exists()


def test_hooks_see_every_row_that_is_stored_and_change_nothing(tmp_path: Path) -> None:
    small = RolloutSettings(num_envs=2, num_steps=8)
    config = RunConfig(
        total_steps=96, evaluate_every=40, evaluation_episodes=1, log_every=20, rollout=small, body=MLP((8,))
    )
    seen: list[Any] = []
    with training_bar(CONTROL, config, io.StringIO()) as bar:
        watched = train(config, tmp_path / "watched", [bar, lambda row: seen.append(dict(row))])
    assert seen == read_metrics(tmp_path / "watched")
    assert {row["kind"] for row in seen} == {"train", "evaluation"}
    assert watched.parameters_sha256 == train(config, tmp_path / "alone").parameters_sha256


def drawn(columns: int, monkeypatch: pytest.MonkeyPatch) -> str:
    """The last state of a bar in a terminal of this width, without what moves the cursor."""

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", str(columns))
    stream = Terminal()
    with run_bar(stream, total_steps=100_000, stop_at_return=475.0) as bar:
        bar(row(25_000, abs_td_error=0.12345, max_q=8.0))
        bar({"kind": "evaluation", "env_steps": 25_000, "greedy_return": 99.5})
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", stream.getvalue()).replace("\r", "\n").strip().splitlines()[-1]


@pytest.mark.parametrize("columns", [40, 60, 80, 120])
def test_a_narrow_terminal_keeps_the_bar_the_count_and_the_time(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    line = drawn(columns, monkeypatch)
    assert "━" in line and " 25000/100000 --:-- " in line and len(line) <= columns
    assert columns < 60 or columns >= 100 or "greedy 99.5" in line


def test_in_a_notebook_the_first_line_comes_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ipykernel", types.ModuleType("ipykernel"))
    now, stream = [0.0], io.StringIO()
    with run_bar(stream, lambda: now[0], total_steps=10_000) as bar:
        for second in (0.0, 1.0, 3.0):
            now[0] = second
            bar(row(int(1000 * second)))
    assert [line.split(" of ")[0] for line in stream.getvalue().splitlines()] == ["0", "3,000"]


@pytest.mark.parametrize(("value", "wanted"), [(20.24, "20.2"), (0.9731, "0.973"), (-0.05, "-0.050"), (1.25, "1.2")])
def test_returns_within_one_are_told_in_three_decimals(value: float, wanted: str) -> None:
    assert shown(value) == wanted
    lines = Evaluation((value, value), (1, 1), 0).lines()
    assert lines[0].startswith(
        f"mean return {value:.4f} ± 0.0000" if abs(value) < 1 else f"mean return {value:.2f} ± 0.00"
    )
    assert f"lowest {wanted}, quartiles {wanted} {wanted} {wanted}, highest {wanted}" == lines[1]


def test_warnings_of_others_come_without_their_colours(capsys: pytest.CaptureFixture[str]) -> None:
    _show_warning("\x1b[33mWARN: The obs is not within the observation space.\x1b[0m", UserWarning, "x.py", 1)
    assert capsys.readouterr().err == "neuralq: warning: The obs is not within the observation space.\n"
