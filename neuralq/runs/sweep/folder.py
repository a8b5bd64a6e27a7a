"""The folder of a sweep: what it holds, and how far each seed has come."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from neuralq.checks import check_whole
from neuralq.runs.folder.files import open_regular, parse_json, read_json, to_json, write_durably
from neuralq.runs.folder.run_folder import RunFolderError, is_run_folder, read_summary

__all__ = ["Sweep", "create_sweep", "has_finished", "is_sweep_folder", "open_sweep", "steps_so_far"]

FORMAT_NAME = "neuralq-sweep"
FORMAT_VERSION = 1
_TAIL_BYTES = 1 << 16


@dataclass(frozen=True)
class Sweep:
    """A sweep folder.

    Args:
        path: the folder.
        config: what all seeds share, as `neuralq.runs.recipe.config.config_to_dict` writes it.
        seeds: one run each.
        options: what else was asked for, as words of the command line.
    """

    path: Path
    config: dict[str, Any]
    seeds: tuple[int, ...]
    options: tuple[str, ...] = ()

    @property
    def total_steps(self) -> int:
        """Environment steps of each seed."""
        return int(self.config["total_steps"])

    def run_path(self, seed: int) -> Path:
        """Run folder of a seed."""
        return self.path / f"seed-{seed}"

    def log_path(self, seed: int) -> Path:
        """What the process of a seed printed."""
        return self.path / f"seed-{seed}.log"


def is_sweep_folder(path: str | Path) -> bool:
    """Whether a sweep was made in ``path``.

    Example:
        >>> is_sweep_folder("/nowhere")
        False
    """
    return (Path(path) / "sweep.json").is_file()


def create_sweep(
    path: str | Path, config: Mapping[str, Any], seeds: Sequence[int], options: Sequence[str] = ()
) -> Sweep:
    """A new sweep in ``path``, which is made if missing and must hold neither a sweep nor a run.

    Raises:
        ValueError: without seeds, or with one named twice.
        RunFolderError: if there is a sweep or a run in ``path``.

    Example:
        >>> import tempfile
        >>> sweep = create_sweep(tempfile.mkdtemp() + "/s", {"env": "CartPole-v1", "total_steps": 100}, range(3))
        >>> open_sweep(sweep.path).seeds
        (0, 1, 2)
    """
    path = Path(path)
    _check_seeds(list(seeds))
    if is_sweep_folder(path):
        raise RunFolderError(f"{path} already holds a sweep; continue it with `neuralq resume {path}`")
    if is_run_folder(path):
        raise RunFolderError(f"{path} already holds a run; choose another folder with --run-dir")
    path.mkdir(parents=True, exist_ok=True)
    write_durably(path / "config.json", to_json(config, "config"))
    marker = {"format": FORMAT_NAME, "version": FORMAT_VERSION, "seeds": list(seeds), "options": list(options)}
    write_durably(path / "sweep.json", to_json(marker, "sweep", sealed=True))  # last: it marks a sweep
    return Sweep(path, dict(config), tuple(seeds), tuple(options))


def _check_seeds(seeds: Any) -> None:
    """They become names of folders, so nothing but whole numbers will do."""
    for seed in seeds if isinstance(seeds, list) else ():
        if not isinstance(seed, int):
            raise ValueError(f"seed must be a whole number, got {seed!r}")
        check_whole("seed", seed, 0)
    if not isinstance(seeds, list) or not seeds or len(set(seeds)) < len(seeds):
        raise ValueError(f"a sweep needs one seed or more, each named once, got {seeds!r}")


def _check_options(options: Any) -> None:
    """They become words of a command line, so nothing but what a sweep is begun with will do."""
    if not isinstance(options, list):
        raise ValueError(f"its options must be a list, got {options!r}")
    words = list(options)
    while words and words[0] in ("--tensorboard", "--wandb"):
        del words[0]
    while words[:1] == ["--hook"] and len(words) > 1 and re.fullmatch(r"[\w.]+:[\w.]+", str(words[1])):
        del words[:2]
    if words:
        raise ValueError(f"its options hold {words[0]!r}, which no sweep is begun with")


def open_sweep(
    path: str | Path, total_steps: int | None = None, changes: Mapping[str, Any] = MappingProxyType({})
) -> Sweep:
    """The sweep in ``path``, with a new budget for every seed if ``total_steps`` is given, and other changes.

    Raises:
        RunFolderError: if there is none, or its files are damaged.
    """
    path = Path(path)
    if not is_sweep_folder(path):
        raise RunFolderError(f"there is no sweep in {path}; start one with `neuralq train ENV --seeds 10`")
    try:
        marker, config = (read_json(path / name) for name in ("sweep.json", "config.json"))
        if marker["format"] != FORMAT_NAME or marker["version"] > FORMAT_VERSION:
            raise ValueError(f"it is of format {marker['format']!r}, version {marker['version']!r}")
        _check_seeds(marker["seeds"])
        _check_options(marker["options"])
        check_whole("total_steps", config["total_steps"])
        check_whole("threads", config.get("threads", 1))
        sweep = Sweep(path, config, tuple(marker["seeds"]), tuple(marker["options"]))
    except KeyError as error:
        raise RunFolderError(f"the sweep in {path} cannot be read: {error} is missing; restore its files") from error
    except (RunFolderError, OSError, ValueError, TypeError) as error:
        raise RunFolderError(f"the sweep in {path} cannot be read: {error}") from error
    if total_steps is not None:
        check_whole("total_steps", total_steps)
        changes = {**changes, "total_steps": total_steps}
    if changes:
        sweep.config.update(changes)
        write_durably(path / "config.json", to_json(sweep.config, "config"))
    return sweep


def has_finished(sweep: Sweep, seed: int) -> bool:
    """Whether the summary of a seed says that its budget is spent, its target reached, or that a hook stopped it."""
    path = sweep.run_path(seed)
    if not (is_run_folder(path) and (path / "summary.json").exists()):
        return False
    try:
        summary = read_summary(path)
    except RunFolderError:  # damaged; the run writes it anew
        return False
    if summary.get("interrupted_by") is not None:
        return False
    steps = summary.get("env_steps")
    if summary.get("stopped_by") is not None:  # by a hook, which would stop it again
        return True
    return bool(summary.get("reached")) or (isinstance(steps, int) and steps >= sweep.total_steps)


def steps_so_far(run_dir: Path) -> int:
    """Environment steps in the last whole line of ``metrics.jsonl``; the file may grow meanwhile."""
    try:
        with open(open_regular(run_dir / "metrics.jsonl", os.O_RDONLY), "rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL_BYTES))
            *_, last, _ = [b"", *file.read().split(b"\n")]
            return int(parse_json(last)["env_steps"])
    except (RunFolderError, OSError, ValueError, KeyError, TypeError, OverflowError):
        return 0
