"""``neuralq train td-gammon``, and ``neuralq resume`` for the run that it leaves."""

from __future__ import annotations

import argparse
import json
import re
import signal
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from neuralq.apps.cli import Failure, print_result
from neuralq.runs.folder.run_folder import read_config, refuse_old_run
from neuralq.systems.backgammon.config import TdGammonConfig, config_from_dict, config_to_dict
from neuralq.systems.backgammon.match import OPPONENTS
from neuralq.systems.backgammon.run import TD_GAMMON, GammonRun, resume_games, train_games
from neuralq.systems.backgammon.selfplay import SelfPlaySettings

__all__ = ["GameBar", "resume_td_gammon", "train_td_gammon"]

_EXAMPLES = """examples:
  neuralq train td-gammon --games 100000 --seed 3
  neuralq train td-gammon --hidden 40 --outputs 1 --lambda 0.7 --lambda-end 0
  neuralq train td-gammon --mode batched --threads 2 --batch-games 8
  neuralq train td-gammon --against random pubeval --evaluate-every 50000 --evaluation-games 5000
  neuralq train td-gammon --config runs/demo/config.json --seed 4"""

_AGAINST = f"opponents of the evaluations: {', '.join(OPPONENTS)} (the last two need gnubg-nn), or none"
_QUIET_SECONDS = 10.0
_FIELD_OF = {
    "games": "num_games", "hidden": "num_hidden", "outputs": "num_outputs", "threads": "num_threads",
    "lambda": "lambda_", "against": "evaluate_against",
}  # fmt: skip
"""Options whose names are shorter than those of the fields that they set."""
_PLAIN = {"settings", "seed", "mode", "inputs", "dtype"}
"""Words of errors that are not written as options."""


def train_td_gammon(argv: list[str]) -> int:
    """Learn backgammon from self-play as the options say."""
    options = _parsed(argv)
    try:
        config = _config(options)
    except ValueError as error:
        raise Failure(_in_options(str(error)), 2) from error
    path = Path(options.run_dir or TD_GAMMON.default_path(config))
    refuse_old_run(path)  # also by train_games, but preparing takes seconds
    _say(f"run folder {path}; preparing (the first run on a machine compiles kernels)")
    with GameBar(config.budget) as bar:
        run = train_games(config, path, [bar])
    return _conclude(run, options.json)


def resume_td_gammon(options: argparse.Namespace) -> int:
    """Go on with a run, as the options of ``neuralq resume`` say."""
    for name, way_out in (("total_steps", "use --games"), ("workers", "leave it out"), ("hook", "leave it out")):
        if getattr(options, name) is not None:
            raise Failure(f"--{name.replace('_', '-')} is not for a TD-Gammon run like {options.run}; {way_out}", 2)
    if options.games is not None and options.games < 1:
        raise Failure(f"--games must be a whole number of at least 1, got {options.games}", 2)
    config = config_from_dict(read_config(options.run))
    with GameBar(options.games or config.budget) as bar:
        run = resume_games(options.run, options.games, [bar])
    return _conclude(run, options.json)


def _parser() -> argparse.ArgumentParser:
    settings, config = SelfPlaySettings(), TdGammonConfig()
    parser = argparse.ArgumentParser(
        prog="neuralq train td-gammon",
        usage="neuralq train td-gammon [options]",
        description="Learn backgammon from games against oneself by TD(λ): Tesauro's 198 inputs, one hidden layer.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        exit_on_error=False,
    )

    def add(name: str, default: Any, text: str, kind: Any = int, metavar: str = "N", **more: Any) -> None:
        field = _FIELD_OF.get(name, name.replace("-", "_"))
        text = f"{text} (default: {default})"
        parser.add_argument(f"--{name}", dest=field, type=kind, metavar=metavar, help=text, **more)

    _add_settings(add, settings)
    add("seed", config.seed, "of weights, dice and evaluations")
    add("evaluate-every", config.evaluate_every, "games between evaluations")
    add("evaluation-games", config.evaluation_games, "games of each, against each opponent")
    add("against", " ".join(config.evaluate_against), _AGAINST, str, "NAME", nargs="+")
    add("checkpoint-every", config.checkpoint_every, "games between checkpoints")
    add("log-every", config.log_every, "games between rows of training metrics")
    parser.add_argument("--config", metavar="FILE", help="config.json of a run, to start from its settings")
    parser.add_argument("--run-dir", metavar="FOLDER", help="where the run goes (default: a folder under runs/)")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object on the last line")
    return parser


def _add_settings(add: Callable[..., None], settings: SelfPlaySettings) -> None:
    add("games", settings.num_games, "games to play; the schedules go over them")
    add("hidden", settings.num_hidden, "hidden units")
    add(
        "outputs", settings.num_outputs, "6 (win, gammon, backgammon, each lost), 4 (backgammons as gammons) or 1 (win)"
    )
    add("inputs", settings.inputs, "tesauro (198 of the bare board) or expert (14 more)", str, "NAME")
    add("mode", settings.mode, "online: traces, a step after each turn; batched: λ-returns, Adam", str, "NAME")
    add("lambda", settings.lambda_, "λ in [0, 1] at the beginning", float, "X")
    add("lambda-end", "as at the beginning", "λ at the end, linear in between", float, "X")
    at_first = f"{settings.step_size}, batched {SelfPlaySettings(mode='batched').step_size}"
    add("step-size", at_first, "α at the beginning: of plain steps, or of Adam's in batched mode", float, "X")
    add("step-size-end", "a thirtieth", "α at the end, falling by the same factor in each game", float, "X")
    add("batch-games", settings.batch_games, "games between two steps; batched mode")
    add("threads", settings.num_threads, "cores that play; batched mode")
    add("weight-scale", settings.weight_scale, "initial weights are uniform in ± this", float, "X")
    add("dtype", settings.dtype, "float32 or float64", str, "NAME")
    add("engine", settings.engine, "compiled, or torch, which can use a GPU", str, "NAME")
    add("device", settings.device, "of the torch engine: cpu, cuda, cuda:1", str, "NAME")


def _parsed(argv: list[str]) -> argparse.Namespace:
    parser = _parser()
    try:
        options, unknown = parser.parse_known_args(argv)
    except argparse.ArgumentError as error:
        raise Failure(f"{error}; `neuralq train td-gammon --help` lists the options", 2) from error
    if unknown:
        raise Failure(f"unknown: {' '.join(unknown)}; `neuralq train td-gammon --help` lists the options", 2)
    return options


def _config(options: argparse.Namespace) -> TdGammonConfig:
    """Defaults, then the file, then the command line, the later winning."""
    plain = config_to_dict(TdGammonConfig())
    plain["settings"] |= {"step_size": None, "step_size_end": None}  # the mode decides
    if options.config is not None:
        plain = config_to_dict(config_from_dict(_read_file(options.config)))
    given = {name: value for name, value in vars(options).items() if value is not None}
    if given.get("evaluate_against") == ["none"]:
        given["evaluate_against"] = []
    for name in [f.name for f in fields(SelfPlaySettings)]:
        if name in given:
            plain["settings"][name] = given[name]
    if "num_games" in given:
        plain["num_games"] = None
    for name in [f.name for f in fields(TdGammonConfig) if f.name != "num_games"]:
        if name in given:
            plain[name] = given[name]
    return config_from_dict(plain)


def _read_file(path: str) -> dict[str, Any]:
    try:
        content = json.loads(Path(path).read_bytes())
    except (OSError, ValueError) as error:
        raise Failure(f"cannot read --config {path}: {error}", 2) from error
    if not isinstance(content, dict):
        raise Failure(f"--config {path} must hold an object, got {type(content).__name__}", 2)
    return content


def _in_options(message: str) -> str:
    """Names of fields as the options that set them."""
    option_of = {field: option for option, field in _FIELD_OF.items()}
    names = [f.name for of in (SelfPlaySettings, TdGammonConfig) for f in fields(of)]
    pattern = rf"(?<![\w-])({'|'.join(sorted({*names} - _PLAIN, key=len)[::-1])})(?!\w)"
    return re.sub(pattern, lambda m: f"--{option_of.get(m[1], m[1]).replace('_', '-')}", message)


def _say(line: str) -> None:
    print(f"neuralq: {line}", file=sys.stderr, flush=True)


def _conclude(run: GammonRun, as_json: bool) -> int:
    if run.interrupted_by is not None:
        _say(f"{run.interrupted_by}: saved after {run.games:,} games; go on with: neuralq resume {run.run_dir}")
    rate = run.games / run.cpu_seconds if run.cpu_seconds > 0 else 0.0
    lines = [
        f"{run.games:,} games in {run.cpu_seconds:.1f} CPU-seconds ({rate:,.0f} games per CPU-second), "
        f"{run.wall_seconds:.1f} seconds in all",
        *(f"against {name}: {ppg:+.3f} ± {error:.3f} points per game" for name, (ppg, error) in
          run.points_per_game.items()),
        f"run folder {run.run_dir}",
    ]  # fmt: skip
    print_result(run.plain(), as_json, lines)
    return 0 if run.interrupted_by is None else 128 + signal.Signals[run.interrupted_by].value


class GameBar:
    """Games, games per second, time left and points per game while a run goes on; plain lines without a terminal.

    Args:
        num_games: the run's budget.
        stream: where to draw; standard error by default.

    Example:
        >>> import io
        >>> with GameBar(100, io.StringIO()) as bar:
        ...     bar({"kind": "train", "games": 50, "games_per_second": 1000.0})
    """

    def __init__(self, num_games: int, stream: TextIO | None = None) -> None:
        self._console = Console(file=stream or sys.stderr)
        self._num_games = num_games
        self._latest: dict[str, Any] = {"games_per_second": 0.0}
        self._said = time.monotonic()
        self._bar = Progress(
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[text]}"),
            TimeRemainingColumn(compact=True),
            console=self._console,
            refresh_per_second=4,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task("games", total=num_games, text="")

    def __enter__(self) -> GameBar:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._bar.stop()

    def __call__(self, row: Mapping[str, Any]) -> None:
        """Take in a row of metrics."""
        self._latest.update(row)
        rate = self._latest["games_per_second"]
        parts = [f"{rate:,.0f} games/s"]
        for name in OPPONENTS:
            if f"ppg_{name}" in self._latest:
                error = self._latest[f"ppg_{name}_standard_error"]
                parts.append(f"{name} {self._latest[f'ppg_{name}']:+.3f} ± {error:.3f}")
        self._bar.update(self._task, completed=row["games"], text=" · ".join(parts))
        if not self._console.is_terminal and time.monotonic() - self._said > _QUIET_SECONDS:
            self._said = time.monotonic()
            left = (self._num_games - row["games"]) / rate if rate > 0 else float("inf")
            parts.insert(1, f"{left / 60:.0f} min left" if left >= 90 else f"{left:.0f} s left")
            games = f"{row['games']:,} of {self._num_games:,} games"
            self._console.print(f"{games} · {' · '.join(parts)}", highlight=False, soft_wrap=True)
