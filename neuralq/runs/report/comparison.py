"""Runs side by side: groups of runs that differ in their seed alone, their scores, what sets them apart, one figure."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neuralq.figures import COLOURS, MARKERS, band, draw_png, draw_svg, steps_axis, tame
from neuralq.runs.folder.files import as_float
from neuralq.runs.folder.run_folder import RunFolderError, is_run_folder, read_config, read_metrics, read_seed
from neuralq.runs.play_off import Score, score_of
from neuralq.runs.report.page import flatten
from neuralq.runs.report.readings import finite_series, read_present_summary
from neuralq.runs.sweep import is_sweep_folder, open_sweep
from neuralq.runs.sweep.statistics import Estimate, bootstrap_interval, estimate, interquartile_mean
from neuralq.types import Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Group", "GroupCurve", "algorithm_in", "comparison_png", "comparison_svg", "group_curve", "read_groups"]

_MOST_POINTS = 120
_CURVE_RESAMPLES = 1_000


@dataclass(frozen=True)
class SeedRun:
    """One run: its folder, seed, greedy evaluations ``[E]``, what its agent scores, and costs.

    Its task is what it shares with the runs that differ from it in nothing but their seed, where others are compared.
    """

    path: Path
    seed: int
    steps: Floats
    returns: Floats
    score: Score
    env_steps: int
    cpu_seconds: float
    task: str = ""


@dataclass(frozen=True)
class Group:
    """Runs that differ in their seed alone, or that have the value of one option in common.

    Args:
        name: of the sweep's folder, or of the first run's.
        label: what sets the group apart, in words; its name where that is not short and clear.
        settings: of its configuration, those in which the groups differ.
        runs: each with at least one greedy evaluation; one per seed, of each task.
    """

    name: str
    label: str
    settings: dict[str, Any]
    runs: tuple[SeedRun, ...]

    @property
    def returns(self) -> list[float]:
        """Greedy return of each run's agent."""
        return [run.score.mean for run in self.runs]

    @property
    def estimate(self) -> Estimate:
        """Their interquartile mean with its interval; of several tasks stratified, where all have as many runs."""
        tasks: dict[str, list[float]] = {}
        for run in self.runs:
            tasks.setdefault(run.task, []).append(run.score.mean)
        even = len({len(scores) for scores in tasks.values()}) == 1
        return estimate(np.transpose(list(tasks.values())) if even and len(tasks) > 1 else self.returns)

    def plain(self) -> dict[str, Any]:
        """The same as plain values."""
        found = self.estimate
        return {
            "name": self.name,
            "label": self.label,
            "settings": self.settings,
            "iqm": found.iqm,
            "low": found.low,
            "high": found.high,
            "mean": float(np.mean(self.returns)),
            "seeds": [run.seed for run in self.runs],
            "agent_returns": self.returns,
            "greedy_returns": [float(run.returns[-1]) for run in self.runs],
            "env_steps": [run.env_steps for run in self.runs],
            "cpu_seconds": [run.cpu_seconds for run in self.runs],
            "run_dirs": [str(run.path) for run in self.runs],
        }


@dataclass(frozen=True)
class GroupCurve:
    """Interquartile mean over a group's runs at each of ``steps`` ``[P]``; the band is None for a single run."""

    steps: Floats
    iqm: Floats
    low: Floats | None
    high: Floats | None


def read_groups(paths: Sequence[str | Path]) -> tuple[list[Group], list[str]]:
    """The runs in these folders, grouped: the seeds of one sweep, and runs alike in all but their seed.

    Args:
        paths: run folders and sweep folders.

    Returns:
        The groups in the order of the folders, and the runs left out, each with the reason.

    Raises:
        RunFolderError: if a folder holds neither a run nor a sweep, or no run has been evaluated.
    """
    gathered: dict[tuple[str, int], list[SeedRun]] = {}
    found: dict[tuple[str, int], tuple[str, dict[str, Any]]] = {}
    left_out: list[str] = []
    seen: set[Path] = set()
    for path in map(Path, paths):
        for folder in _run_folders(path):
            if folder.resolve() in seen:
                continue
            seen.add(folder.resolve())
            run = _read_run(folder) if is_run_folder(folder) else None
            if run is None:
                left_out.append(f"{folder} has no greedy evaluation yet")
                continue
            settings = {name: value for name, value in flatten(read_config(folder)) if name != "seed"}
            words = json.dumps([settings, str(path) if is_sweep_folder(path) else ""], sort_keys=True, default=str)
            # A seed that comes again under one configuration is no further evidence: it stands in a group of its own.
            again = next(n for n in range(len(seen)) if run.seed not in {r.seed for r in gathered.get((words, n), [])})
            gathered.setdefault((words, again), []).append(run)
            cell = folder.parent.name if folder.parent not in (path, path.parent) else path.name
            found.setdefault((words, again), (cell, settings))
    if not gathered:
        raise RunFolderError("nothing to compare: " + "; ".join(left_out))
    return _named([(*found[key], tuple(runs)) for key, runs in gathered.items()]), left_out


def _named(found: Sequence[tuple[str, dict[str, Any], tuple[SeedRun, ...]]]) -> list[Group]:
    """Groups with names and labels that tell them apart."""
    differing = _differing([settings for _, settings, _ in found])
    groups = []
    for name, settings, runs in found:
        own = {key: settings[key] for key in differing if key in settings}
        if [other for other, _, _ in found].count(name) > 1:
            name = str(runs[0].path)
        groups.append(Group(name, _label(own), own, runs))
    if len(groups) == 1:
        return [dataclasses.replace(groups[0], label=algorithm_in(found[0][1]) or groups[0].name)]
    labels = [group.label for group in groups]
    # A label that is empty, long or not the only one of its kind gives way to the name.
    return [
        group if group.label and labels.count(group.label) == 1 and len(group.label) <= 60
        else dataclasses.replace(group, label=group.name)
        for group in groups
    ]  # fmt: skip


def algorithm_in(settings: Mapping[str, Any]) -> str:
    """What learns, in words, by the names of a flat configuration; "" where it does not say.

    Example:
        >>> algorithm_in({"learner": "tabular", "tabular.algorithm": "q-learning", "layout": "table"})
        'tabular q-learning'
        >>> algorithm_in({"learner": "rollout", "layout": "separate"})
        'rollout, layout separate'
    """
    learner = settings.get("learner")
    if not isinstance(learner, str):
        return ""
    own = [settings.get(f"{learner}.{name}") for name in ("algorithm", "target_rule")]
    named = " ".join([learner, *(one for one in own if isinstance(one, str))])
    layout = settings.get("layout")
    return f"{named}, layout {layout}" if isinstance(layout, str) and layout != "table" else named


def _run_folders(path: Path) -> list[Path]:
    if is_sweep_folder(path):
        sweep = open_sweep(path)
        return [sweep.path / member.name for member in sweep.members()]
    if not is_run_folder(path):
        raise RunFolderError(f"there is neither a run nor a sweep in {path}; name folders that `neuralq train` made")
    return [path]


def _read_run(path: Path) -> SeedRun | None:
    rows = read_metrics(path)
    steps, returns = finite_series(rows, "evaluation", "greedy_return")
    if not len(steps):
        return None
    cpu = max((as_float(row.get("cpu_seconds")) for row in rows), default=0.0)
    score = score_of({**read_present_summary(path, rows), "greedy_return": float(returns[-1])})
    assert score is not None, "there is an evaluation"
    return SeedRun(path, read_seed(path), steps, returns, score, max(int(row["env_steps"]) for row in rows), cpu)


def _differing(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names whose values are not the same everywhere; one that is missing somewhere differs."""
    names = dict.fromkeys(name for one in settings for name in one)
    missing = object()
    return [n for n in names if any(one.get(n, missing) != settings[0].get(n, missing) for one in settings)]


def _label(own: Mapping[str, Any]) -> str:
    return ", ".join(f"{name.rsplit('.', 1)[-1].rstrip('_')} {value}" for name, value in own.items())


def group_curve(group: Group) -> GroupCurve:
    """Greedy return over environment steps: the interquartile mean of the runs and its pointwise 95 % interval.

    Runs are evaluated at steps of their own, so each is interpolated between its evaluations. A run that ended early
    keeps its last value; before the first evaluation of every run there is no curve.
    """
    begin = max(run.steps[0] for run in group.runs)
    every = np.unique(np.concatenate([run.steps for run in group.runs]))
    every = every[every >= begin]
    if len(every) > _MOST_POINTS:
        every = every[np.unique(np.linspace(0, len(every) - 1, _MOST_POINTS).astype(int))]
    values = np.stack([np.interp(every, run.steps, run.returns) for run in group.runs], axis=-1)  # [P, runs]
    iqm = interquartile_mean(values)
    if len(group.runs) < 2:
        return GroupCurve(every, iqm, None, None)
    low, high = bootstrap_interval(values[:, :, None], np.random.default_rng(0), num_resamples=_CURVE_RESAMPLES)
    return GroupCurve(every, iqm, low, high)


def comparison_svg(groups: Sequence[Group]) -> str:
    """The learning curves of all groups, as an ``<svg>`` element.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    ends = "; ".join(f"{group.label}: {group.estimate.iqm:.4g}" for group in groups)
    text = f"Greedy return of the agent of each run, interquartile mean over seeds. {ends}."
    return draw_svg("comparison", "Learning curves", text, _SIZE, lambda figure: _paint(figure, groups))


def comparison_png(groups: Sequence[Group]) -> bytes:
    """The same as a PNG file.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    return draw_png(_SIZE, lambda figure: _paint(figure, groups))


_SIZE = (7.0, 4.6)


def _paint(figure: Figure, groups: Sequence[Group]) -> None:
    axes = figure.subplots()
    for number, group in enumerate(groups):
        curve = group_curve(group)
        colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
        counted = "seeds" if len({run.seed for run in group.runs}) == len(group.runs) else "runs"
        seeds = f" ({len(group.runs)} {counted})" if len(group.runs) > 1 else f" (seed {group.runs[0].seed})"
        if curve.low is not None and curve.high is not None:
            band(axes, curve.steps, curve.low, curve.high, colour)
        every = max(1, len(curve.steps) // 12)
        axes.plot(curve.steps, tame(curve.iqm), color=colour, marker=marker, markevery=every, label=group.label + seeds)
    steps_axis(axes, "environment steps")
    axes.set_ylabel("greedy return per episode")
    figure.legend(loc="outside upper left", ncols=1 if max(len(group.label) for group in groups) > 28 else 2)
