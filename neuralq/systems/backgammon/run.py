"""Runs of TD-Gammon: self-play that leaves a run folder, goes on where it was stopped, and is measured on the way.

A run stops only between games (between batches in batched mode). A checkpoint holds weights, dice, optimiser and how
far the run has come; so a run that was stopped or killed ends with the same bits as one that was not. Evaluation
games have dice of their own, drawn from the run's seed and the number of games behind it.

Budget and schedules are two things: a run that goes on beyond the games of its schedules keeps their last values.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.best import Best
from neuralq.runs.folder.files import replacing
from neuralq.runs.folder.origin import compared
from neuralq.runs.folder.run_folder import RunFolder, RunFolderError, default_run_path, read_config
from neuralq.runs.kinds import CommandLine, Kind, kind_in
from neuralq.runs.loop import Diverged, Hook, Plan, Progress
from neuralq.runs.stop_request import StopRequest, pass_on, raise_if_asked
from neuralq.systems.backgammon.agent import BackgammonAgent
from neuralq.systems.backgammon.config import KIND, TdGammonConfig, config_from_dict, config_to_dict
from neuralq.systems.backgammon.match import play_match
from neuralq.systems.backgammon.network import ValueNetwork
from neuralq.systems.backgammon.opponents import require_gnubg
from neuralq.systems.backgammon.selfplay import SelfPlay

__all__ = ["TD_GAMMON", "GammonRun", "load_agent", "resume_games", "train_games"]

WEIGHTS_NAME = "weights.safetensors"
_MOST_AT_ONCE = 200
"""Games between two looks at the clock and the signals."""


@dataclass(frozen=True)
class GammonRun:
    """The result of a run of TD-Gammon.

    Args:
        run_dir: its folder.
        games: games played.
        env_steps: turns played.
        cpu_seconds: CPU time of training on all cores, evaluations excluded.
        wall_seconds: wall time of training and evaluation.
        points_per_game: of the last evaluation, by opponent: points per game and their standard error.
        weights_sha256: of the weights' bytes.
        interrupted_by: name of the signal that ended it early, or None.
        stopped_by: which hook ended it before its budget was spent, and why; None if none did.
    """

    run_dir: Path
    games: int
    env_steps: int
    cpu_seconds: float
    wall_seconds: float
    points_per_game: dict[str, tuple[float, float]]
    weights_sha256: str
    interrupted_by: str | None
    stopped_by: str | None = None

    def plain(self) -> dict[str, Any]:
        """The same as plain values, for JSON."""
        return {"kind": KIND, **dataclasses.asdict(self), "run_dir": str(self.run_dir)}

    def lines(self) -> list[str]:
        """The same for people."""
        rate = self.games / self.cpu_seconds if self.cpu_seconds > 0 else 0.0
        return [
            f"{self.games:,} games in {self.cpu_seconds:.1f} CPU-seconds ({rate:,.0f} games per CPU-second), "
            f"{self.wall_seconds:.1f} seconds in all",
            *(
                f"against {name}: {points:+.3f} ± {error:.3f} points per game"
                for name, (points, error) in self.points_per_game.items()
            ),
        ]


class _Trainee:
    """Self-play as `neuralq.runs.loop` trains it: counted in games, with turns for environment steps."""

    observed = None

    def __init__(self, config: TdGammonConfig) -> None:
        settings = config.settings
        if set(config.evaluate_against) - {"random"}:
            require_gnubg()
        # A few games that nobody learns from compile the kernels, so that the run's clock counts games alone.
        SelfPlay(dataclasses.replace(settings, batch_games=settings.num_threads), 0).play(settings.num_threads)
        self.config, self.learner = config, SelfPlay(settings, config.seed)
        self.points: dict[str, tuple[float, float]] = {}
        self._logged: tuple[int, ...] = (0, 0, 0, 0)  # the tally at the last row of training metrics

    @property
    def amount(self) -> int:
        return self.learner.num_games

    @property
    def env_steps(self) -> int:
        return int(self.learner.tally[3])

    def advance(self, until: int, request: StopRequest) -> None:
        num_games = min(until - self.amount, _MOST_AT_ONCE)
        self.learner.play(self.config.whole_batches(max(num_games, 1)))

    def training_row(self) -> dict[str, Any]:
        self.require_finite()
        learner = self.learner
        plain, gammons, backgammons, turns = (learner.tally - np.array(self._logged)).tolist()
        self._logged = tuple(learner.tally.tolist())
        num_games, at = plain + gammons + backgammons, np.array([learner.num_games])
        return {
            "turns_per_game": turns / num_games,
            "gammon_rate": (gammons + backgammons) / num_games,
            "step_size": float(learner.settings.step_sizes(at)[0]),
            "lambda": float(learner.settings.lambdas(at)[0]),
        }

    def evaluate(self, seed: int) -> tuple[dict[str, Any], Best | None]:
        self.require_finite()
        row: dict[str, Any] = {}
        for opponent in self.config.evaluate_against:
            workers = self.config.settings.num_threads if opponent == "random" else 1  # more would have to be processes
            result = play_match(
                self.learner.network, opponent, self.config.evaluation_games, seed, workers=workers,
                progress=lambda *_: raise_if_asked(),
            )  # fmt: skip
            self.points[opponent] = (result.points_per_game, result.standard_error)
            row[f"ppg_{opponent}"], row[f"ppg_{opponent}_standard_error"] = self.points[opponent]
            row[f"win_rate_{opponent}"], row[f"gammon_rate_{opponent}"] = result.win_rate, result.gammon_rate
        return row, None

    def require_finite(self) -> None:
        if not np.isfinite(self.learner.network.flat).all():
            raise Diverged(
                f"after {self.amount:,} games the weights are no longer finite: training diverged; nothing "
                "was saved over the last checkpoint. Try a smaller step size"
            )

    def state_dict(self) -> dict[str, Any]:
        return {"progress": {"points": self.points, "logged": self._logged}, "learner": self.learner.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.learner.load_state_dict(state["learner"])
        self.points, self._logged = dict(state["progress"]["points"]), state["progress"]["logged"]

    def close(self) -> None:
        pass


def _plan(config: TdGammonConfig) -> Plan:
    periods = config.evaluate_every, config.checkpoint_every, config.log_every
    return Plan("games", config.budget, *periods, config.seed, log_whole_periods=True)


def _default_path(config: TdGammonConfig) -> Path:
    settings = config.settings
    layout = f"198-{settings.num_hidden}-{settings.num_outputs}-{settings.mode}"
    return default_run_path(KIND, layout, config.seed, datetime.now())


def _result(config: TdGammonConfig, trainee: _Trainee, progress: Progress, folder: RunFolder) -> GammonRun:
    network = trainee.learner.network
    notes = {"games": str(trainee.amount), "seed": str(config.seed), "mode": config.settings.mode}
    with replacing(folder.path / WEIGHTS_NAME) as temporary:
        network.save(temporary, notes)
    return GammonRun(
        run_dir=folder.named,
        games=trainee.amount,
        env_steps=trainee.env_steps,
        cpu_seconds=progress.cpu_seconds,
        wall_seconds=progress.wall_seconds,
        points_per_game=dict(trainee.points),
        weights_sha256=network.sha256(),
        interrupted_by=progress.interrupted_by,
        stopped_by=progress.stopped_by,
    )


def load_agent(path: str | Path | None = None) -> BackgammonAgent:
    """The player that a run has trained, or that a file of weights holds.

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
    if kind_in(path) != KIND:
        raise RunFolderError(f"there is no TD-Gammon run in {path}; start one with `neuralq train {KIND}`")
    if not any((path / "checkpoints").glob("step-*")) and (path / WEIGHTS_NAME).is_file():
        return BackgammonAgent(ValueNetwork.load(path / WEIGHTS_NAME))  # of a run whose checkpoints were deleted
    learner = SelfPlay(config_from_dict(read_config(path)).settings, 0)
    saved = checkpoint.load_newest(path / "checkpoints")
    compared(saved.state.get("origin"), read_config(path), saved.path)
    learner.load_state_dict(saved.state["learner"])
    return BackgammonAgent(learner.network)


def _notes(config: TdGammonConfig, latest: Mapping[str, Any]) -> list[str]:
    return [
        f"{name} {latest[f'ppg_{name}']:+.3f} ± {latest[f'ppg_{name}_standard_error']:.3f}"
        for name in config.evaluate_against
        if f"ppg_{name}" in latest
    ]


def _load(run_dir: Path, best: bool | None) -> BackgammonAgent:
    if best:
        raise ValueError(f"a TD-Gammon run keeps its newest weights only, and {run_dir} is one; leave best out")
    return load_agent(run_dir)


TD_GAMMON = Kind(
    name=KIND,
    title="a TD-Gammon run",
    config=TdGammonConfig,
    budget="num_games",
    to_plain=config_to_dict,
    from_plain=config_from_dict,
    default_path=_default_path,
    num_threads=lambda config: 1,  # the games share the cores; the optimiser's vectors are too short to
    build=_Trainee,
    plan=_plan,
    result=_result,
    load=_load,
    notes=_notes,
    changeable=frozenset(("evaluate_every", "evaluation_games", "evaluate_against", "checkpoint_every", "log_every")),
    command=CommandLine(
        "Learn backgammon from games against oneself by TD(λ): Tesauro's 198 inputs, one hidden layer.",
        (
            "neuralq train td-gammon --games 100000 --seed 3",
            "neuralq train td-gammon --hidden 40 --outputs 1 --lambda 0.7 --lambda-end 0",
            "neuralq train td-gammon --mode batched --threads 2 --batch-games 8",
            "neuralq train td-gammon --against random pubeval --evaluate-every 50000 --evaluation-games 5000",
            "neuralq train td-gammon --config runs/demo/config.json --seed 4",
        ),
        {
            "num_games": "games",
            "num_hidden": "hidden",
            "num_outputs": "outputs",
            "num_threads": "threads",
            "evaluate_against": "against",
        },
        measure="neuralq.apps.cli.backgammon_match:evaluate_backgammon",
        measures=("--against", "--error-rate", ".safetensors"),
        report="neuralq.apps.pages.gammon:write_gammon_report",
        instead="measured by `neuralq evaluate {run} --against pubeval` and played by `neuralq play backgammon "
        "--agent {run}`",
    ),
)


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
        KeyboardInterrupt: at Ctrl-C, once the run is saved; another signal has its effect then, too.

    Example:
        >>> import tempfile
        >>> from neuralq.systems.backgammon.selfplay import SelfPlaySettings
        >>> config = TdGammonConfig(SelfPlaySettings(num_games=3, num_hidden=10), evaluate_against=())
        >>> train_games(config, tempfile.mkdtemp() + "/run").games
        3
    """
    return _passed_on(TD_GAMMON.train(config, run_dir, hooks))


def resume_games(run_dir: str | Path, num_games: int | None = None, hooks: Sequence[Hook] = ()) -> GammonRun:
    """As `neuralq.resume`, with a new budget in games, of which those beyond the schedules keep their last values.

    Raises:
        ValueError: the run is of another kind.
    """
    return _passed_on(TD_GAMMON.resume(run_dir, num_games, hooks))


def _passed_on(run: GammonRun) -> GammonRun:
    pass_on(run.interrupted_by, f"the run was saved at {run.games:,} games; go on with: neuralq resume {run.run_dir}")
    return run
