"""The folder of a sweep: what was asked for, and the run folders that it comes to."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from neuralq.checks import check_whole
from neuralq.runs.folder.files import FolderLock, read_json, to_json, write_durably
from neuralq.runs.folder.run_folder import RunFolderError, is_run_folder
from neuralq.runs.sweep.asked import Asked, cell_name, check_seeds
from neuralq.runs.sweep.states import RunState, state_of
from neuralq.runs.sweep.task import Task

__all__ = ["Member", "Sweep", "ask", "create_sweep", "is_sweep_folder", "open_sweep"]

FORMAT_NAME = "neuralq-sweep"
FORMAT_VERSION = 2
_MOST_CHECKED = 1_000
"""Combinations of values of which each is tried as a configuration when a sweep is asked for: about two seconds."""
_OF_SEEDS = 1
"""The version of sweeps whose configuration is whole and whose runs differ in their seed alone."""


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """One run of a sweep.

    Args:
        options: in which it differs from others, by name; empty where seeds are all there is.
        seed: of the run.
        name: of its folder within the sweep's, with ``/`` between folders.
        total_steps: its budget; None where a preset decides it.
    """

    options: Mapping[str, Any]
    seed: int
    name: str
    total_steps: int | None


@dataclass(frozen=True)
class Sweep:
    """A sweep folder.

    Args:
        path: the folder.
        config: what all runs share. Without ``axes`` a whole configuration, as
            `neuralq.runs.recipe.config.config_to_dict` writes it; with them keywords of `neuralq.train`, under which
            stand presets.
        seeds: one run each, of every combination of values.
        options: what else was asked for, as words of the command line.
        axes: the values of options along which runs differ; None where seeds are all there is.
    """

    path: Path
    config: dict[str, Any]
    seeds: tuple[int, ...]
    options: tuple[str, ...] = ()
    axes: dict[str, list[Any]] | None = None

    @property
    def asked(self) -> Asked:
        """What it was asked for."""
        return Asked(self.config, self.axes or {}, self.seeds)

    def __len__(self) -> int:
        """How many runs."""
        return self.asked.num_cells * len(self.seeds)

    def members(self) -> Iterator[Member]:
        """Every run, seed by seed: early on there is something of each combination of values."""
        cells = [(cell, f"{cell_name(cell)}/" if cell else "") for cell in self.asked.cells()]
        steps = self.config.get("total_steps")
        for seed in self.seeds:
            for cell, folder in cells:
                yield Member(cell, seed, f"{folder}seed-{seed}", cell.get("total_steps", steps))

    def configuration(self, member: Member) -> dict[str, Any]:
        """The whole configuration of a run.

        Raises:
            ValueError: if what was asked for is no configuration.
        """
        if self.axes is None:
            return {**self.config, "seed": member.seed}
        from neuralq.runs.sweep.resolving import resolved  # brings PyTorch, as in `_check_cells`

        return resolved(self.config, member.options, member.seed)

    def task(self, member: Member) -> Task:
        """What a process needs to know to make a run."""
        return Task(member.name, self.path / member.name, self.configuration(member), self.options)

    def state(self, member: Member) -> RunState:
        """How far a run has come."""
        return state_of(self.path / member.name, member.total_steps)

    def run_path(self, seed: int) -> Path:
        """Run folder of a seed, where seeds are all there is."""
        return self.path / f"seed-{seed}"


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
    """A new sweep of seeds in ``path``, which is made if missing and must hold neither a sweep nor a run.

    Raises:
        ValueError: without seeds, or with one named twice.
        RunFolderError: if there is a sweep or a run in ``path``.

    Example:
        >>> import tempfile
        >>> sweep = create_sweep(tempfile.mkdtemp() + "/s", {"env": "CartPole-v1", "total_steps": 100}, range(3))
        >>> open_sweep(sweep.path).seeds
        (0, 1, 2)
    """
    check_seeds(list(seeds))
    sweep = Sweep(Path(path), dict(config), tuple(seeds), tuple(options))
    if is_sweep_folder(path):
        raise RunFolderError(f"{path} already holds a sweep; continue it with `neuralq resume {path}`")
    _refuse_others(sweep.path)
    sweep.path.mkdir(parents=True, exist_ok=True)
    _write(sweep)
    return sweep


def ask(path: str | Path, asked: Asked, options: Sequence[str] = ()) -> Sweep:
    """The sweep of what is asked for in ``path``: a new one, or the one that is there, with new values and seeds.

    Raises:
        ValueError: if what is asked for is no configuration, for one of the combinations of values.
        RunFolderError: if there is a run in ``path``, or a sweep that was asked for otherwise.
        RunFolderBusy: if something is to be added to a sweep that is being run.

    Example:
        >>> import tempfile
        >>> path, base = Path(tempfile.mkdtemp(), "s"), {"env": "CartPole-v1", "total_steps": 100}
        >>> len(ask(path, Asked(base, {"gamma": [0.9]}, (0, 1)))), len(ask(path, Asked(base, {"gamma": [0.99]}, (0,))))
        (2, 4)
    """
    path = Path(path)
    sweep, is_known = _joined(path, asked, options)
    if is_known:
        return sweep
    _check_cells(sweep)
    _refuse_others(path)
    path.mkdir(parents=True, exist_ok=True)
    with contextlib.closing(FolderLock(path / "sweep.lock", f"the sweep in {path} is being run")):
        sweep, is_known = _joined(path, asked, options)  # another command may have asked meanwhile
        if not is_known:
            _write(sweep)
    return sweep


def _joined(path: Path, asked: Asked, options: Sequence[str]) -> tuple[Sweep, bool]:
    """The sweep in a folder with what is asked for beside, or a new one; whether it is there as it is."""
    if not is_sweep_folder(path):
        return Sweep(path, asked.base, asked.seeds, tuple(options), asked.axes), False
    old = open_sweep(path)
    if old.axes is None:
        raise RunFolderError(f"{path} is a sweep of seeds that `neuralq train --seeds` made; choose another folder")
    try:
        both = old.asked.joined(asked)
    except ValueError as error:
        raise RunFolderError(f"{path} already holds a sweep: {error}") from error
    sweep = Sweep(old.path, old.config, both.seeds, old.options, both.axes)
    return sweep, (both.axes, both.seeds) == (old.axes, old.seeds)


def _check_cells(sweep: Sweep) -> None:
    """Raises ValueError where a combination of values is no configuration: before anything is begun.

    Of very many only those are looked at that have each value once; of others the runs say so.
    """
    from neuralq.runs.sweep.resolving import resolved

    asked = sweep.asked
    for cell in asked.cells() if asked.num_cells <= _MOST_CHECKED else _each_value_once(asked):
        try:
            resolved(sweep.config, cell, sweep.seeds[0])
        except ValueError as error:
            where = ", ".join(f"{name} {value!r}" for name, value in cell.items())
            raise ValueError(f"{error}{f' (with {where})' if where else ''}") from error


def _each_value_once(asked: Asked) -> Iterator[dict[str, Any]]:
    first = {name: values[0] for name, values in asked.axes.items()}
    yield from ({**first, name: value} for name, values in asked.axes.items() for value in values)


def _refuse_others(path: Path) -> None:
    if is_run_folder(path):
        raise RunFolderError(f"{path} already holds a run; choose another folder")
    if path.exists() and not path.is_dir():
        raise RunFolderError(f"{path} is a file, and no folder for runs; choose another one")


def _write(sweep: Sweep) -> None:
    if not is_sweep_folder(sweep.path):
        write_durably(sweep.path / "config.json", to_json(sweep.config, "config"))
    marker: dict[str, Any] = {
        "format": FORMAT_NAME,
        "version": _OF_SEEDS if sweep.axes is None else FORMAT_VERSION,
        "seeds": list(sweep.seeds),
        "options": list(sweep.options),
    }
    if sweep.axes is not None:
        marker["axes"] = sweep.axes
    write_durably(sweep.path / "sweep.json", to_json(marker, "sweep", sealed=True))  # last: it marks a sweep


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


def _check_axes(axes: Any) -> None:
    """They become names of folders and of options."""
    if axes is not None and not (isinstance(axes, dict) and all(isinstance(values, list) for values in axes.values())):
        raise ValueError(f"its axes must hold a list for each option, got {axes!r}")


def open_sweep(
    path: str | Path, total_steps: int | None = None, changes: Mapping[str, Any] = MappingProxyType({})
) -> Sweep:
    """The sweep in ``path``, with a new budget for every run if ``total_steps`` is given, and other changes.

    Raises:
        RunFolderError: if there is none, or its files are damaged.
        ValueError: if what is to be changed is what runs differ in.
    """
    path = Path(path)
    if not is_sweep_folder(path):
        raise RunFolderError(f"there is no sweep in {path}; start one with `neuralq train ENV --seeds 10`")
    try:
        sweep = _read(path)
    except KeyError as error:
        raise RunFolderError(f"the sweep in {path} cannot be read: {error} is missing; restore its files") from error
    except (RunFolderError, OSError, ValueError, TypeError) as error:
        raise RunFolderError(f"the sweep in {path} cannot be read: {error}") from error
    if total_steps is not None:
        check_whole("total_steps", total_steps)
        changes = {**changes, "total_steps": total_steps}
    if differing := sorted(changes.keys() & (sweep.axes or {}).keys()):
        raise ValueError(f"{differing[0]} is what the runs of {path} differ in, and cannot be changed for all of them")
    if changes:
        sweep.config.update(changes)
        write_durably(path / "config.json", to_json(sweep.config, "config"))
    return sweep


def _read(path: Path) -> Sweep:
    marker, config = (read_json(path / name) for name in ("sweep.json", "config.json"))
    if marker["format"] != FORMAT_NAME or marker["version"] > FORMAT_VERSION:
        raise ValueError(f"it is of format {marker['format']!r}, version {marker['version']!r}")
    check_seeds(marker["seeds"])
    _check_options(marker["options"])
    axes = marker["axes"] if marker["version"] > _OF_SEEDS else None
    _check_axes(axes)
    if axes is None or "total_steps" in config:
        check_whole("total_steps", config["total_steps"])
    check_whole("threads", config.get("threads", 1))
    sweep = Sweep(path, config, tuple(marker["seeds"]), tuple(marker["options"]), axes)
    if sweep.asked.num_cells < 1:
        raise ValueError("it has no runs")
    return sweep
