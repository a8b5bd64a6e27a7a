"""``neuralq watch`` and ``neuralq record``: see a trained run play."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym

from neuralq.apps.cli import Failure, command_parser, print_result
from neuralq.apps.cli.film import caption, drawn, frame_rate, make_shown, picture, play, writers_for
from neuralq.apps.cli.progress import ProgressBar, Told
from neuralq.apps.cli.sweeps import add_trust, add_which, single_run
from neuralq.runs import RunConfig, load
from neuralq.runs.control import last_cap
from neuralq.runs.folder.run_folder import read_config
from neuralq.runs.kinds import same_folder
from neuralq.runs.offline.files import write_recorded
from neuralq.runs.offline.minari_files import write_minari
from neuralq.runs.offline.recording import record_steps
from neuralq.runs.recipe.config import config_from_dict
from neuralq.runs.recipe.environments import make_one
from neuralq.runs.recipe.games import make_single, refusals_name

__all__ = ["record", "watch"]


def watch(argv: list[str]) -> int:
    """Show greedy episodes in a window, or as text where there is no window to be had."""
    parser = command_parser(
        "watch",
        "Watch a trained run play in a window, or as text where the environment draws text and there is no display.",
        "neuralq watch RUN",
        "neuralq watch RUN --best --episodes 10",
    )
    _add_options(parser, num_episodes=3)
    options = parser.parse_args(argv)
    path = single_run(options.run, options.trust)
    config = config_from_dict(read_config(path))
    agent = load(path, options.best)  # imports the module that registers the environment, too
    mode = _shown_mode(config, path)
    env = make_shown(config, mode)
    returns, pause = [], 1.0 / frame_rate(env)
    print(f"neuralq: {options.episodes} episodes; Ctrl-C ends", file=sys.stderr)
    try:
        for moment in play(env, agent, options.episodes, options.seed, _limit(options, config)):
            if mode == "ansi":
                print(f"{drawn(env)}\n{caption(moment)}\n", file=sys.stderr)
                time.sleep(pause)
            if moment.over:
                returns.append(moment.episode_return)
                if not options.json:
                    print(f"episode {moment.episode}: return {moment.episode_return:g} in {moment.step} steps")
    finally:
        env.close()
    print_result({"returns": returns, "run_dir": str(path), "mode": mode}, options.json, [])
    return 0


def record(argv: list[str]) -> int:
    """Film greedy episodes."""
    parser = command_parser(
        "record",
        "Film a trained run; needs no display. Step, return and the largest action value stand below the picture. Or "
        "record its steps as a data set, to learn from with neuralq train ENV --dataset.",
        "neuralq record RUN --gif run.gif",
        "neuralq record RUN --to data.npz --episodes 100 --epsilon 0.2",
        "neuralq record RUN --mp4 run.mp4 --episodes 3 --best",
    )
    _add_options(parser, num_episodes=1)
    parser.add_argument("--gif", metavar="FILE", help="write a GIF")
    parser.add_argument("--mp4", metavar="FILE", help="write an MP4")
    parser.add_argument("--fps", type=float, metavar="X", help="steps per second (default: what the environment says)")
    parser.add_argument("--width", type=int, default=480, metavar="N", help="of the picture in pixels (default: 480)")
    parser.add_argument("--to", metavar="FILE.npz", help="record the steps as arrays")
    parser.add_argument("--minari", metavar="ID", help="record the steps as a data set of Minari's (extra minari)")
    parser.add_argument(
        "--epsilon", type=float, metavar="X", help="of recorded steps, the share of random actions (default: 0.1)"
    )
    options = parser.parse_args(argv)
    if options.to is not None or options.minari is not None:
        return _record_steps(options)
    if options.epsilon is not None:
        raise Failure("--epsilon is for recorded steps, and a film is greedy; add --to FILE.npz or leave it out", 2)
    return _record_pictures(options)


def _record_pictures(options: argparse.Namespace) -> int:
    if (options.fps is not None and not 0 < options.fps <= 1000) or not 16 <= options.width <= 4096:
        raise Failure("--fps must lie above 0 and up to 1000, --width between 16 and 4096", 2)
    path = single_run(options.run, options.trust)
    config = config_from_dict(read_config(path))
    with same_folder() as here:  # environments may change it
        agent, limit = load(here / path, options.best), _limit(options, config)
        _refuse_mode(config, "rgb_array", f"neuralq evaluate {path} plays without pictures")
        env = make_shown(config, "rgb_array")
        try:
            rate = options.fps or frame_rate(env)
            game = play(env, agent, options.episodes, options.seed, limit)
            returns = _film(env, game, rate, options, here)
        finally:
            env.close()
    files = [Path(name) for name in (options.gif, options.mp4) if name is not None]
    plain = {
        "returns": returns,
        "run_dir": str(path),
        "files": {str(file): file.stat().st_size for file in files},
        "frames_per_second": rate,
    }
    lines = [f"{file}: {file.stat().st_size / 1e6:.2f} MB" for file in files]
    print_result(plain, options.json, [f"returns {', '.join(f'{value:g}' for value in returns)}", *lines])
    return 0


def _record_steps(options: argparse.Namespace) -> int:
    """Steps in place of pictures."""
    if options.gif or options.mp4 or (options.to and options.minari):
        raise Failure("one at a time of --gif and --mp4, --to, and --minari", 2)
    epsilon = 0.1 if options.epsilon is None else options.epsilon
    if not 0 <= epsilon <= 1 or not str(options.to or ".npz").endswith(".npz"):
        raise Failure("--epsilon must lie in [0, 1], and --to be a file.npz", 2)
    path = single_run(options.run, options.trust)
    config = config_from_dict(read_config(path))
    with same_folder() as here:  # environments may change it
        agent, limit = load(here / path, options.best), _limit(options, config)
        with refusals_name(config.env):
            env = make_one(config)
        try:
            data = record_steps(env, agent, options.episodes, epsilon, options.seed, limit)
            if options.to is not None:
                write_recorded(str(here / options.to), data)
            else:
                write_minari(options.minari, data, env, f"neuralq {config.learner}, ε = {epsilon:g}")
        finally:
            env.close()
    name = options.to or f"minari:{options.minari}"
    counts = {"num_steps": len(data.actions), "num_episodes": data.num_episodes, "epsilon": epsilon}
    told = f"{name}: {counts['num_steps']:,} steps in {data.num_episodes:,} episodes, ε = {epsilon:g}"
    plain = {"dataset": name, "run_dir": str(path), "mean_return": data.rewards.sum() / data.num_episodes, **counts}
    print_result(plain, options.json, [told, f"neuralq train {config.env} --learner replay --dataset {name}"])
    return 0


def _add_options(parser: argparse.ArgumentParser, num_episodes: int) -> None:
    add = parser.add_argument
    add("run", help="run folder")
    add("--episodes", type=int, default=num_episodes, metavar="N", help=f"how many (default: {num_episodes})")
    add("--seed", type=int, default=0, metavar="N", help="of the episodes (default: 0)")
    add_which(parser)
    add_trust(parser)
    add("--max-steps", type=int, metavar="N", help="cut an episode after so many (default: as in evaluations)")


def _limit(options: argparse.Namespace, config: RunConfig) -> int:
    for name, low in (("episodes", 1), ("seed", 0), ("max_steps", 1)):
        value = getattr(options, name)
        if value is not None and value < low:
            raise Failure(f"--{name.replace('_', '-')} must be a whole number of at least {low}, got {value}", 2)
    limit: int = options.max_steps or config.evaluation_max_steps or last_cap(options.run)
    return limit


def _modes(config: RunConfig) -> Sequence[str]:
    """What the environment can draw itself as."""
    # Not as None: an environment that draws nothing need not know the word.
    kwargs = {name: value for name, value in config.env_kwargs.items() if name != "render_mode"}
    with refusals_name(config.env):
        env = make_single(config.env, kwargs)
    try:
        return list(env.metadata.get("render_modes") or [])
    finally:
        env.close()


def _refuse_mode(config: RunConfig, mode: str, way_out: str) -> None:
    modes = _modes(config)
    if mode not in modes:
        offered = f"only as {', '.join(modes)}" if modes else "not at all"
        raise Failure(f"{config.env} cannot draw itself as {mode}, {offered}; {way_out}")


def _shown_mode(config: RunConfig, path: Path) -> str:
    modes = _modes(config)
    if "human" in modes and _has_display():
        return "human"
    if "ansi" in modes:
        return "ansi"
    if "human" in modes:
        raise Failure(f"there is no display to open a window on; film it instead: neuralq record {path} --gif run.gif")
    way_out = (
        f"film it: neuralq record {path} --gif run.gif"
        if "rgb_array" in modes
        else f"neuralq evaluate {path} plays without"
    )
    raise Failure(f"{config.env} opens no window (it draws itself as: {', '.join(modes) or 'nothing'}); {way_out}")


def _has_display() -> bool:
    """Whether a window would be seen: without one, SDL draws into memory and says nothing."""
    if not sys.platform.startswith("linux"):
        return True
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"))


def _film(env: gym.Env[Any, Any], game: Any, rate: float, options: argparse.Namespace, here: Path) -> list[float]:
    gif, mp4 = (name and str(here / name) for name in (options.gif, options.mp4))
    writers = writers_for(gif, mp4, rate)
    returns: list[float] = []
    try:
        with ProgressBar[tuple[int, str]](options.episodes, lambda report: Told(report[0], report[1:])) as bar:
            for moment in game:
                image = picture(drawn(env), caption(moment), options.width)
                for _ in range(max(1, round(rate)) if moment.over else 1):  # the end stays for a second
                    for writer in writers:
                        writer.add(image)
                if moment.over:
                    returns.append(moment.episode_return)
                bar((moment.episode - (not moment.over), caption(moment)))
            bar((options.episodes, "writing"))
            for writer in writers:
                writer.close()
    except BaseException:
        for writer in writers:
            writer.discard()
        raise
    return returns
