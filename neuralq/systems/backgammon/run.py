"""Runs of TD-Gammon: self-play that leaves a run folder, goes on where it was stopped, and is measured on the way.

A run stops only between games (between batches in batched mode). A checkpoint holds weights, dice, optimiser and how
far the run has come; so a run that was stopped or killed ends with the same bits as one that was not. Evaluation
games have dice of their own, drawn from the run's seed and the number of games behind it.

Budget and schedules are two things: a run that goes on beyond the games of its schedules keeps their last values.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from neuralq.runs.clock import Stopwatch
from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.run_folder import (
    RunFolder,
    RunFolderError,
    default_run_path,
    is_run_folder,
    read_config,
    refuse_old_run,
)
from neuralq.runs.loop import Diverged, Hook, seed_for
from neuralq.runs.stop_request import StopRequest
from neuralq.systems.backgammon.agent import BackgammonAgent
from neuralq.systems.backgammon.config import KIND, TdGammonConfig, config_from_dict, config_to_dict
from neuralq.systems.backgammon.match import play_match
from neuralq.systems.backgammon.network import ValueNetwork
from neuralq.systems.backgammon.opponents import require_gnubg
from neuralq.systems.backgammon.selfplay import SelfPlay

__all__ = [
    "GammonRun",
    "is_gammon_run",
    "load_agent",
    "resume_games",
    "train_games",
]

WEIGHTS_NAME = "weights.safetensors"
_MOST_AT_ONCE = 200
"""Games between two looks at the clock and the signals."""


@dataclass(frozen=True)
class GammonRun:
    """What a run came to.

    Args:
        run_dir: its folder.
        games: games played.
        env_steps: turns played.
        cpu_seconds: CPU time of training on all cores, evaluations excluded.
        wall_seconds: wall time of training and evaluation.
        points_per_game: of the last evaluation, by opponent: points per game and their standard error.
        weights_sha256: of the weights' bytes.
        interrupted_by: name of the signal that ended it early, or None.
    """

    run_dir: Path
    games: int
    env_steps: int
    cpu_seconds: float
    wall_seconds: float
    points_per_game: dict[str, tuple[float, float]]
    weights_sha256: str
    interrupted_by: str | None

    def summary(self) -> dict[str, Any]:
        """The same as plain values."""
        return {"kind": KIND, **dataclasses.asdict(self), "run_dir": str(self.run_dir)}


@dataclass
class _Progress:
    """How far a run has come, beside what the learner knows."""

    cpu_seconds: float = 0.0
    wall_seconds: float = 0.0
    points: dict[str, tuple[float, float]] = field(default_factory=dict)
    evaluated_at: int | None = None
    finished: bool = False
    interrupted_by: str | None = None
    next_log: int = 0
    next_evaluation: int = 0
    next_checkpoint: int = 0
    logged: tuple[int, ...] = (0, 0, 0, 0)
    """The tally at the last row of training metrics."""


def train_games(config: TdGammonConfig, run_dir: str | Path | None = None, hooks: Sequence[Hook] = ()) -> GammonRun:
    """Learn from self-play as configured and leave a run folder: configuration, metrics, checkpoints and weights.

    Args:
        config: what to run.
        run_dir: folder for the run; by default one under ``runs/``, named after the network, the seed and the time.
        hooks: called with every row of metrics.

    Raises:
        RunFolderError: if the folder already holds a run.
        MissingExtra: if pubeval or gnubg shall be played and gnubg-nn is not installed.
        Diverged: if the weights stop being finite.

    Example:
        >>> import tempfile
        >>> from neuralq.systems.backgammon.selfplay import SelfPlaySettings
        >>> config = TdGammonConfig(SelfPlaySettings(num_games=3, num_hidden=10), evaluate_against=())
        >>> train_games(config, tempfile.mkdtemp() + "/run").games
        3
    """
    path = default_path(config) if run_dir is None else Path(run_dir)
    refuse_old_run(path)  # `RunFolder.create` does too, but compiling takes seconds
    with _one_thread():
        learner = _ready(config)
        with RunFolder.create(path, config=config_to_dict(config), seed=config.seed) as folder:
            return _Loop(config, learner, _Progress(), folder, hooks).run()


def resume_games(run_dir: str | Path, num_games: int | None = None, hooks: Sequence[Hook] = ()) -> GammonRun:
    """Go on with a run from its newest intact checkpoint, or from the start if it was stopped before the first.

    The continued run ends with the same bits as one that was never stopped.

    Args:
        run_dir: folder of the run.
        num_games: a new budget; games beyond the schedules keep their last values.
        hooks: called with every row of metrics.

    Raises:
        RunFolderError: if there is no run, or another process is writing it.
        CheckpointError: if no checkpoint is intact.
        ValueError: the run is of another kind.
    """
    config = config_from_dict(read_config(run_dir))
    if num_games is not None:
        config = dataclasses.replace(config, num_games=num_games)
    with _one_thread(), RunFolder.open(run_dir) as folder:
        learner, progress = _ready(config), _Progress()
        if any(folder.checkpoints_path.glob("step-*")):
            state = checkpoint.load_newest(folder.checkpoints_path).state
            learner.load_state_dict(state["learner"])
            progress = _Progress(**state["progress"])
        folder.truncate_metrics(int(learner.tally[3]))
        if num_games is not None:
            folder.replace_config(config_to_dict(config))
        return _Loop(config, learner, progress, folder, hooks).run()


def default_path(config: TdGammonConfig) -> Path:
    """Where a run goes that was given no folder."""
    settings = config.settings
    layout = f"198-{settings.num_hidden}-{settings.num_outputs}-{settings.mode}"
    return default_run_path(KIND, layout, config.seed, datetime.now())


def is_gammon_run(path: str | Path) -> bool:
    """Whether a run of TD-Gammon was made in ``path``.

    Example:
        >>> is_gammon_run("/nowhere")
        False
    """
    return is_run_folder(path) and read_config(path).get("kind") == KIND


def load_agent(path: str | Path | None = None) -> BackgammonAgent:
    """The player that a run has come to, or that a file of weights holds.

    Args:
        path: run folder (its newest checkpoint counts) or safetensors file; None for the weights that come with
            the package.

    Raises:
        RunFolderError: if the folder holds no TD-Gammon run.
        CheckpointError: if no checkpoint of it is intact.
        ValueError: if the file is missing, damaged, or holds something else.
    """
    path = Path(__file__).with_name(WEIGHTS_NAME) if path is None else Path(path)
    if not path.is_dir():
        return BackgammonAgent(ValueNetwork.load(path))
    if not is_gammon_run(path):
        raise RunFolderError(f"there is no TD-Gammon run in {path}; start one with `neuralq train {KIND}`")
    if not any((path / "checkpoints").glob("step-*")) and (path / WEIGHTS_NAME).is_file():
        return BackgammonAgent(ValueNetwork.load(path / WEIGHTS_NAME))  # of a run whose checkpoints were deleted
    learner = SelfPlay(config_from_dict(read_config(path)).settings, 0)
    learner.load_state_dict(checkpoint.load_newest(path / "checkpoints").state["learner"])
    return BackgammonAgent(learner.network)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """The games share the cores; the optimiser's vectors are too short to."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(before)


def _ready(config: TdGammonConfig) -> SelfPlay:
    """A learner whose kernels are compiled, so that the run's clock counts games alone."""
    settings = config.settings
    if set(config.evaluate_against) - {"random"}:
        require_gnubg()
    SelfPlay(dataclasses.replace(settings, batch_games=settings.num_threads), 0).play(settings.num_threads)
    return SelfPlay(settings, config.seed)


class _Loop:
    def __init__(
        self, config: TdGammonConfig, learner: SelfPlay, progress: _Progress, folder: RunFolder, hooks: Sequence[Hook]
    ) -> None:
        self.config, self.learner, self.progress, self.folder, self.hooks = config, learner, progress, folder, hooks
        progress.interrupted_by = None
        progress.next_log = progress.next_log or config.log_every
        progress.next_evaluation = progress.next_evaluation or config.evaluate_every
        progress.next_checkpoint = progress.next_checkpoint or config.checkpoint_every
        self._clock = Stopwatch(progress)
        self._log_clock = (learner.num_games, time.perf_counter())

    def run(self) -> GammonRun:
        if not (self.progress.finished and self.learner.num_games >= self.config.budget):
            self.progress.finished = False
            request = StopRequest()
            with request.listening():
                self._play(request)
        return self._conclude()

    def _play(self, request: StopRequest) -> None:
        learner, progress, budget = self.learner, self.progress, self.config.budget
        while learner.num_games < budget:
            until = min(progress.next_log, progress.next_evaluation, progress.next_checkpoint, budget)
            num_games = min(until - learner.num_games, _MOST_AT_ONCE)
            learner.play(self.config.whole_batches(max(num_games, 1)))
            games = learner.num_games
            if games >= progress.next_log or games >= budget:
                self._log()
            if games >= progress.next_evaluation:
                self._evaluate()
            if request.name is not None:
                progress.interrupted_by = request.name
                self._save()
                return
            if games >= progress.next_checkpoint:
                self._save()
        if progress.evaluated_at != learner.num_games:
            self._evaluate()
        progress.finished = True
        self._save()

    def _row(self, kind: str) -> dict[str, Any]:
        return {
            "kind": kind,
            "env_steps": int(self.learner.tally[3]),
            "games": self.learner.num_games,
            "cpu_seconds": self.progress.cpu_seconds,
            "wall_seconds": self.progress.wall_seconds,
        }

    def _record(self, row: dict[str, Any]) -> None:
        self.folder.append_metrics(row)
        for hook in self.hooks:
            hook(row)
        self._clock.read(training=False)  # whoever watches costs wall time only

    def _after(self, period: int) -> int:
        return (self.learner.num_games // period + 1) * period

    def _log(self) -> None:
        self._clock.read()
        learner, progress = self.learner, self.progress
        self._refuse_divergence()
        progress.next_log = self._after(self.config.log_every)
        then, now = self._log_clock, (learner.num_games, time.perf_counter())
        self._log_clock = now
        plain, gammons, backgammons, turns = (learner.tally - np.array(progress.logged)).tolist()
        progress.logged = tuple(learner.tally.tolist())
        num_games, at = plain + gammons + backgammons, np.array([learner.num_games])
        self._record(
            {
                **self._row("train"),
                "games_per_second": (now[0] - then[0]) / max(now[1] - then[1], 1e-9),
                "turns_per_game": turns / num_games,
                "gammon_rate": (gammons + backgammons) / num_games,
                "step_size": float(learner.settings.step_sizes(at)[0]),
                "lambda": float(learner.settings.lambdas(at)[0]),
            }
        )

    def _evaluate(self) -> None:
        self._clock.read()
        config, progress, learner = self.config, self.progress, self.learner
        self._refuse_divergence()
        progress.next_evaluation = self._after(config.evaluate_every)
        progress.evaluated_at = learner.num_games
        if not config.evaluate_against:
            return
        row: dict[str, Any] = {}
        seed = seed_for(config.seed, 9, learner.num_games)
        for opponent in config.evaluate_against:
            workers = config.settings.num_threads if opponent == "random" else 1  # more would have to be processes
            result = play_match(learner.network, opponent, config.evaluation_games, seed, workers=workers)
            progress.points[opponent] = (result.points_per_game, result.standard_error)
            row[f"ppg_{opponent}"], row[f"ppg_{opponent}_standard_error"] = progress.points[opponent]
            row[f"win_rate_{opponent}"], row[f"gammon_rate_{opponent}"] = result.win_rate, result.gammon_rate
        self._clock.read(training=False)
        self._log_clock = (learner.num_games, time.perf_counter())
        self._record({**self._row("evaluation"), **row})

    def _refuse_divergence(self) -> None:
        if not np.isfinite(self.learner.network.flat).all():
            raise Diverged(
                f"after {self.learner.num_games:,} games the weights are no longer finite: training diverged; nothing "
                "was saved over the last checkpoint. Try a smaller step size"
            )

    def _save(self) -> None:
        progress, learner = self.progress, self.learner
        progress.next_checkpoint = self._after(self.config.checkpoint_every)
        self._refuse_divergence()
        self._clock.read()
        state = {"progress": dataclasses.asdict(progress), "learner": learner.state_dict()}
        checkpoint.save(self.folder.checkpoints_path, int(learner.tally[3]), state)

    def _conclude(self) -> GammonRun:
        progress, learner = self.progress, self.learner
        run = GammonRun(
            run_dir=self.folder.path,
            games=learner.num_games,
            env_steps=int(learner.tally[3]),
            cpu_seconds=progress.cpu_seconds,
            wall_seconds=progress.wall_seconds,
            points_per_game=dict(progress.points),
            weights_sha256=learner.network.sha256(),
            interrupted_by=progress.interrupted_by,
        )
        notes = {"games": str(learner.num_games), "seed": str(self.config.seed), "mode": learner.settings.mode}
        partial = self.folder.path / f".partial-{WEIGHTS_NAME}"
        learner.network.save(partial, notes)
        partial.replace(self.folder.path / WEIGHTS_NAME)
        self.folder.write_summary(run.summary())
        return run
