"""Runs of TD-Gammon from the command line: what they leave, how they go on, and what they refuse.

Mutants that die here, each tried: the dice, the optimiser or the tally not taken from the checkpoint · evaluation that
draws from the training dice · the metrics of a killed run not cut back, so that rows are written twice · the next
evaluation or row, or the tally at the last row, forgotten · schedules stretched by a new budget · the older of two
checkpoints loaded as the agent.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import neuralq
from neuralq.apps.cli import main
from neuralq.apps.pages import gammon
from neuralq.apps.pages.gammon import points_against
from neuralq.runs.folder.run_folder import RunFolderError, read_config, read_metrics, read_summary
from neuralq.systems.backgammon import BackgammonAgent, SelfPlay, SelfPlaySettings, ValueNetwork
from neuralq.systems.backgammon.config import TdGammonConfig, config_from_dict, config_to_dict
from neuralq.systems.backgammon.run import TD_GAMMON, GammonRun, load_agent, resume_games, train_games
from neuralq_envs.backgammon import Position

ROOT = Path(__file__).parents[1]
CLOCKS = ("cpu_seconds", "wall_seconds", "games_per_second")
SMALL = SelfPlaySettings(num_games=60, num_hidden=10, lambda_=0.7, lambda_end=0.2, step_size=0.1, step_size_end=0.01)
MODES = {
    "online": SMALL,
    "batched, two threads": replace(SMALL, mode="batched", num_threads=2, batch_games=6, step_size=0.01),
}
each_mode = pytest.mark.parametrize("settings", MODES.values(), ids=MODES)


class Stopped(BaseException):
    """Ends a run in the middle as a kill would: nothing of the library catches it."""


def configuration(settings: SelfPlaySettings, **given: Any) -> TdGammonConfig:
    periods = {"evaluate_every": 25, "evaluation_games": 4, "checkpoint_every": 14, "log_every": 10}
    return TdGammonConfig(settings, **{"seed": 3, **periods, **given})


def at(games: int, then: Callable[[], None]) -> Callable[[Mapping[str, Any]], None]:
    def hook(row: Mapping[str, Any]) -> None:
        if row["kind"] == "train" and row["games"] == games:
            then()

    return hook


def stop() -> None:
    raise Stopped


def clockless(path: Path) -> list[dict[str, Any]]:
    return [{k: v for k, v in row.items() if k not in CLOCKS} for row in read_metrics(path)]


def outcome(run: GammonRun) -> tuple[Any, ...]:
    return run.weights_sha256, run.games, run.env_steps, run.points_per_game


@each_mode
def test_a_run_stopped_anywhere_ends_as_if_it_had_not_been(settings: SelfPlaySettings, tmp_path: Path) -> None:
    config = configuration(settings)
    whole = train_games(config, tmp_path / "whole")
    for games in (10, 42) if settings.mode == "batched" else (10, 40):  # before the first checkpoint, after the third
        path = tmp_path / str(games)
        begun = games if settings.mode == "online" else -(-games // 6) * 6
        with pytest.raises(Stopped):
            train_games(config, path, [at(begun, stop)])
        assert outcome(resume_games(path)) == outcome(whole)
        assert clockless(path) == clockless(tmp_path / "whole")
    path = tmp_path / "asked"
    asked = 30 if settings.mode == "batched" else 20  # between two checkpoints
    first = TD_GAMMON.train(config, path, [at(asked, lambda: os.kill(os.getpid(), signal.SIGTERM))])
    assert (first.interrupted_by, first.games) == ("SIGTERM", asked)
    assert outcome(resume_games(path)) == outcome(whole) and clockless(path) == clockless(tmp_path / "whole")
    with pytest.warns(UserWarning, match="nothing is left to do"):
        assert outcome(resume_games(path)) == outcome(whole)  # a finished run stays as it is


def test_the_rows_say_what_the_games_were_and_the_weights_are_the_learners(tmp_path: Path) -> None:
    config = configuration(SMALL)
    run = train_games(config, tmp_path / "run")
    learner = SelfPlay(SMALL, 3)
    rows = [row for row in read_metrics(run.run_dir) if row["kind"] == "train"]
    assert [row["games"] for row in rows] == [10, 20, 30, 40, 50, 60]
    for row in rows:
        before = learner.tally.copy()
        learner.play(10)
        played = learner.tally - before
        assert row["turns_per_game"] == played[3] / 10 and row["gammon_rate"] == (played[1] + played[2]) / 10
        assert row["env_steps"] == learner.tally[3]
    assert run.weights_sha256 == learner.network.sha256()  # so evaluation took none of the training's dice
    # 0.1 to 0.01 geometrically, 0.7 to 0.2 linearly: at half of the games their means
    assert rows[2]["step_size"] == pytest.approx(10**-1.5) and rows[2]["lambda"] == pytest.approx(0.45)
    evaluations = [row for row in read_metrics(run.run_dir) if row["kind"] == "evaluation"]
    assert [row["games"] for row in evaluations] == [25, 50, 60]
    last = evaluations[-1]["ppg_random"], evaluations[-1]["ppg_random_standard_error"]
    assert run.points_per_game == {"random": last} and read_summary(run.run_dir)["points_per_game"]["random"] == [*last]
    assert 0 < evaluations[0]["cpu_seconds"] <= evaluations[0]["wall_seconds"] * 1.5
    assert ValueNetwork.load(run.run_dir / "weights.safetensors").sha256() == run.weights_sha256


def test_a_larger_budget_keeps_the_schedules(tmp_path: Path) -> None:
    config = configuration(SMALL, evaluate_against=())
    longer = replace(config, num_games=80)
    train_games(config, tmp_path / "a")
    assert outcome(resume_games(tmp_path / "a", 80)) == outcome(train_games(longer, tmp_path / "b"))
    assert read_config(tmp_path / "a") == read_config(tmp_path / "b")
    assert read_metrics(tmp_path / "a")[-1]["step_size"] == pytest.approx(0.01)
    batched = configuration(replace(MODES["batched, two threads"], num_games=10), evaluate_against=())
    assert train_games(batched, tmp_path / "c").games == 12  # the last batch is played whole


DOOMED = """
import json, os, signal, sys
from neuralq.systems.backgammon.config import config_from_dict
from neuralq.systems.backgammon.run import train_games

def die(row):
    if row["games"] == 50:
        os.kill(os.getpid(), signal.SIGKILL)

train_games(config_from_dict(json.loads(sys.argv[1])), sys.argv[2], [die])
"""


@pytest.mark.slow
def test_a_killed_process_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = configuration(SMALL)
    whole = train_games(config, tmp_path / "whole")
    path = tmp_path / "killed"
    arguments = [json.dumps(config_to_dict(config)), str(path)]
    died = subprocess.run([sys.executable, "-c", DOOMED, *arguments], cwd=ROOT, check=False)
    assert died.returncode == -signal.SIGKILL and not (path / "summary.json").exists()
    assert read_metrics(path)[-1]["games"] == 50 and neuralq.load(path).network.sha256() != whole.weights_sha256
    assert main(["resume", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["weights_sha256"] == whole.weights_sha256
    assert clockless(path) == clockless(tmp_path / "whole")


def test_the_command_line_from_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run"
    options = f"--games 30 --hidden 10 --lambda 0.5 --seed 4 --evaluation-games 4 --run-dir {path} --json"
    assert main(["train", "td-gammon", *shlex.split(options)]) == 0
    shown = capsys.readouterr()
    result = json.loads(shown.out.splitlines()[-1])
    assert result["games"] == 30 and list(result["points_per_game"]) == ["random"] and str(path) in shown.err
    assert read_config(path)["settings"]["lambda_"] == 0.5 and read_config(path)["kind"] == "td-gammon"
    assert main(["resume", str(path), "--games", "40"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("40 games in ") and lines[1].startswith("against random: ") and str(path) in lines[-1]
    copied = f"--config {path}/config.json --games 30 --run-dir {tmp_path / 'again'} --json"
    assert main(["train", "td-gammon", *shlex.split(copied)]) == 0
    assert json.loads(capsys.readouterr().out)["weights_sha256"] == result["weights_sha256"]


def test_what_was_learned_plays(tmp_path: Path) -> None:
    run = train_games(configuration(SMALL, evaluate_against=()), tmp_path / "run")
    agent = neuralq.load(run.run_dir)
    assert isinstance(agent, BackgammonAgent) and agent.network.sha256() == run.weights_sha256
    start = Position.initial()
    assert agent.best_move(start, (6, 1)) in start.afterstates((6, 1)) and -3 <= agent.equity(start) <= 3
    assert load_agent(run.run_dir / "weights.safetensors").equity(start) == agent.equity(start)
    with pytest.raises(ValueError, match="newest weights only"):
        neuralq.load(run.run_dir, best=True)
    with pytest.raises(ValueError, match="cannot be read as weights"):
        load_agent(tmp_path / "nothing.safetensors")
    with pytest.raises(RunFolderError, match="no TD-Gammon run"):
        load_agent(tmp_path)
    with pytest.raises(ValueError, match="is a TD-Gammon run, whose budget is num_games and not total_steps"):
        neuralq.resume(run.run_dir, total_steps=10**6)
    with pytest.warns(UserWarning, match="nothing is left to do"):
        assert neuralq.resume(run.run_dir) == run  # finished, and stays as it is


def test_weights_that_are_no_numbers_are_not_saved(tmp_path: Path) -> None:
    def spoil(path: Path) -> None:
        saved = neuralq.runs.folder.checkpoint.load_newest(path / "checkpoints")
        saved.state["learner"]["weights"] = np.full_like(saved.state["learner"]["weights"], np.nan)
        neuralq.runs.folder.checkpoint.save(path / "checkpoints", saved.step, saved.state)

    run = train_games(configuration(SMALL), tmp_path / "run")
    spoil(run.run_dir)
    with pytest.raises(neuralq.runs.loop.Diverged, match="no longer finite"):
        resume_games(run.run_dir, 70)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("--games 0", "--games must be a whole number of at least 1, got 0"),
        ("--games many", "--games must be a whole number, got many"),
        ("--hidden", "--hidden: expected one argument"),
        ("--outputs 3", "--outputs must be one of 1, 4, 6, got 3"),
        ("--lambda 1.5", "--lambda must lie in [0, 1], got 1.5"),
        ("--lambda-end -0.1", "--lambda-end must lie in [0, 1]"),
        ("--step-size 0", "--step-size must be a finite number above 0"),
        ("--mode replay", "mode must be one of 'online', 'batched', got 'replay'"),
        ("--threads 2", "use mode='batched'"),
        ("--mode batched --threads 3", "--batch-games=8 games cannot be shared evenly by --threads=3"),
        ("--against nobody", "--against must be one of 'random', 'pubeval', 'gnubg', got 'nobody'"),
        ("--evaluation-games 1", "--evaluation-games must be a whole number of at least 2"),
        ("--sparkle 3", "unrecognized arguments: --sparkle 3"),
        ("--config nowhere.json", "cannot read --config nowhere.json"),
        ("100", "unrecognized arguments: 100"),
    ],
)
def test_bad_options_are_one_clear_error(options: str, expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "td-gammon", *options.split()]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("neuralq: ") and expected in lines[0]


def test_a_run_has_a_page_with_its_points_and_openings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = configuration(replace(SMALL, num_games=6), evaluate_every=3, evaluation_games=4)
    run = train_games(config, tmp_path / "run")
    assert main(["report", str(run.run_dir)]) == 0
    assert capsys.readouterr().out.strip() == str(run.run_dir / "report.html")
    page = (run.run_dir / "report.html").read_text()
    text = re.sub("<[^>]+>", " ", page)
    points, error = run.points_per_game["random"]
    assert f"{abs(points):.3f} ± {error:.3f} points per game against random play" in text
    assert f"{points - 1.96 * error:+.3f} to {points + 1.96 * error:+.3f}" in text
    rows = [row for row in read_metrics(run.run_dir) if row["kind"] == "evaluation"]
    assert [curve.tolist() for curve in points_against(rows, "random")][:2] == [
        [3.0, 6.0], [row["ppg_random"] for row in rows]
    ]  # fmt: skip
    turns = [{"env_steps": 10, "games": 1}, {"env_steps": 30, "games": 3}]
    assert gammon._games_at(turns, [20.0, 30.0]) == [2.0, 3.0] and gammon._games_at([], [20.0]) == []
    assert f"{run.games} games by TD(λ)" in text and f"{load_agent(run.run_dir).network.flat.size:,} weights" in text
    best = load_agent(run.run_dir).ranked_turns(Position.initial(), (2, 1), 1)[0]
    cells = re.findall(r'<th scope="row">2-1</th><td>([^<]+)</td><td>([^<]+)</td><td>([^<]+)</td>', page)
    assert [cells[0][1:]] == [(f"{best.equity:+.3f}", f"{best.chances.win:.0%}")]
    played = [list(map(int, step.split("/"))) for step in re.findall(r"\d+/\d+", cells[0][0])]
    pips = [sum((i + 1) * n for i, n in enumerate(row)) for row in (Position.initial().own, best.position.other)]
    assert sum(a - b for a, b in played) <= 3 == pips[0] - pips[1]  # of equal moves one is written
    assert page.count('scope="row">') > 15 and page.count('class="boards"') == 1 and "<script" not in page
    shutil.rmtree(run.run_dir / "checkpoints")
    (run.run_dir / "weights.safetensors").write_bytes(b"no weights")
    assert main(["report", str(run.run_dir)]) == 0
    assert "Its weights cannot be read" in (run.run_dir / "report.html").read_text()


def test_commands_for_other_runs_refuse_this_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = train_games(configuration(replace(SMALL, num_games=2), evaluate_against=()), tmp_path / "run").run_dir
    commands = ("compare", "watch", "record --gif a.gif", "export --onnx a.onnx", "resume --total-steps 9")
    for command in (
        *commands,
        "resume --workers 2",
        "resume --hook a:b",
        "resume --games 0",
        f"train td-gammon --run-dir {path}",
    ):
        words = command.split()
        assert main([*words, *([] if words[0] == "train" else [str(path)])]) in (1, 2)
        shown = capsys.readouterr()
        lines = [line for line in shown.err.splitlines() if "preparing" not in line]
        assert (
            shown.out == ""
            and len(lines) == 1
            and ("TD-Gammon" in lines[0] or "--games" in lines[0] or "already" in lines[0])
        )
    with pytest.raises(ValueError, match="unknown in the configuration"):
        config_from_dict({"kind": "td-gammon", "colour": "red"})


def test_help_names_every_option_with_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "td-gammon", "--help"]) == 0
    shown = capsys.readouterr().out
    assert "neuralq train td-gammon --games 100000 --seed 3" in shown
    for option in ("games", "hidden", "outputs", "inputs", "mode", "lambda", "lambda-end", "step-size", "threads"):
        assert f"--{option} " in shown
    assert main(["train", "--help"]) == 0 and "neuralq train td-gammon" in capsys.readouterr().out
