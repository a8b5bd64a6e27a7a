"""The page of one run, from what its folder holds."""

from __future__ import annotations

import importlib
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.files import as_float, read_json, read_rows
from neuralq.runs.folder.run_folder import warn_of_lost_rows
from neuralq.runs.held import DRAWING_NAME
from neuralq.runs.kinds import KINDS, kind_in, kind_named
from neuralq.runs.report.curves import SIGNALS, curve_words, learning_curve_svg, signals_svg
from neuralq.runs.report.grid import grid_svg
from neuralq.runs.report.outcome import (
    exact_table,
    kept_words,
    network_table,
    play_off_words,
    sentence,
    tiles_of,
    watched_words,
)
from neuralq.runs.report.page import Page, facts_table, flatten, tiles
from neuralq.runs.report.readings import Row, finite_series, first_not_finite, read_present_summary, read_told_changes

__all__ = ["write_report"]

_FILES = ("metrics.jsonl", "config.json", "versions.json", "summary.json")
_TARGET_KEYS = ("stop_at_return", "target_return")
_NAME_KEYS = ("env_id", "environment", "env")


def write_report(run_dir: str | Path, film: Sequence[tuple[bytes, str]] = ()) -> Path:
    """Writes ``report.html`` into a run folder and returns its path; may be called while the run goes on.

    A run of a kind with a page of its own gets that. Reads ``metrics.jsonl``, ``config.json``, ``versions.json`` and
    ``summary.json``; each may still be missing.

    Args:
        run_dir: the folder.
        film: pictures of an episode, each the bytes of a PNG file and words on it, to be shown in the page.

    Raises:
        FileNotFoundError: the folder holds none of them.
        RunFolderError: one of them is damaged; names it.
        MissingExtra: matplotlib is not installed.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> _ = (folder / "metrics.jsonl").write_text('{"kind": "train", "env_steps": 64, "episode_return": 9.5}')
        >>> write_report(folder).name
        'report.html'
    """
    folder = Path(run_dir)
    if not any((folder / file).exists() for file in _FILES):
        raise FileNotFoundError(f"{folder} is no run folder: it holds none of {', '.join(_FILES)}; pass one that does")
    command = kind_named(name).command if (name := kind_in(folder)) in KINDS else None
    if command is not None and command.report is not None:
        module, _, function = command.report.partition(":")
        path: Path = getattr(importlib.import_module(module), function)(folder)
        return path
    rows = read_rows(folder / "metrics.jsonl")
    files = (folder / f"{name}.json" for name in ("config", "versions"))
    config, versions = (read_json(file) if file.exists() else {} for file in files)
    summary = read_present_summary(folder, rows)
    warn_of_lost_rows(folder, len(rows), summary.pop("num_rows", None))
    target = _first_number(config, _TARGET_KEYS)
    page = Page(_title(config, folder), lead=_lead(rows, summary, target))
    _outcome(page, folder, rows, summary, config)
    if film:
        page.heading("A greedy episode")
        page.film(film, "One episode without exploration (seed 0), at even intervals.")
    changes = read_told_changes(folder)
    changed_at = [at for at, _ in changes]
    page.heading("Learning curve")
    page.figure(learning_curve_svg(rows, target, changed_at=changed_at), curve_words(rows))
    _soundness(page, rows, summary, changed_at)
    page.heading("How it was made")
    for _, words in changes:
        page.paragraph(sentence(words))
    if (network := network_table(_layers(folder))) is not None:
        page.folded(f"What was learned: {network[0]}", network[1])
    page.folded("Everything that was recorded", facts_table(_facts(rows, summary)))
    page.folded("Effective configuration", _recorded(config))
    page.folded("Versions", _recorded(versions))
    return page.write(folder / "report.html")


def _outcome(
    page: Page, folder: Path, rows: Sequence[Row], summary: Mapping[str, Any], config: Mapping[str, Any]
) -> None:
    """How well it plays, and the exact answer beside it."""
    target = _first_number(config, _TARGET_KEYS)
    if found := tiles_of(rows, summary, target):
        page.table(tiles(found))
    if (decided := play_off_words(summary)) is not None:
        page.paragraph(decided)
    if (beside := exact_table(summary)) is None:
        return
    page.heading("Beside the exact answer")
    gamma = as_float(config.get("gamma"))
    known = f" = {gamma:g}" if math.isfinite(gamma) else ""
    page.paragraph(
        f"{beside[0]} Q* and V* are those of the environment's model with the run's γ{known}, in the environment's "
        "units; numbers have four digits, those in cells of the map three."
    )
    page.table(beside[1])
    path = folder / DRAWING_NAME
    drawn = grid_svg(read_json(path)) if path.exists() else None
    if drawn is not None:
        page.figure(*drawn)


def _soundness(page: Page, rows: Sequence[Row], summary: Mapping[str, Any], changed_at: Sequence[float]) -> None:
    """Whether learning diverged: the monitor's word, and the signals."""
    page.heading("Is learning sound?")
    if (watched := watched_words(summary)) is not None:
        page.paragraph(watched[0], warning=watched[1])
    for column, label in SIGNALS.items():
        step = first_not_finite(rows, "train", column)
        if step is not None:
            page.paragraph(
                f"At {step:,} environment steps the {label} was not a finite number: learning had diverged. "
                "The signals below show how it grew before.",
                warning=True,
            )
    signals = signals_svg(rows, changed_at=changed_at)
    if signals is None:
        page.paragraph("No TD error, Q value or loss was recorded yet.")
        return
    page.figure(
        signals,
        "δ is the TD error: how far a prediction is from its target. A largest Q that climbs past every return "
        "that can be had, with |δ| climbing along, is divergence.",
    )


def _layers(folder: Path) -> Any:
    """Name, offset and shape of every tensor, as the newest checkpoint has them; None where there is none to read."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a damaged one is named by whoever needs it
            return checkpoint.load_newest(folder / "checkpoints").state.get("layers")
    except (checkpoint.CheckpointError, OSError):
        return None


def _recorded(facts: Mapping[str, Any]) -> str:
    return facts_table(facts) if facts else "<p>Not recorded.</p>"


def _first_number(facts: Mapping[str, Any], keys: Sequence[str]) -> float | None:
    values = (as_float(value) for name, value in flatten(facts) if name.rsplit(".", 1)[-1] in keys)
    return next((value for value in values if math.isfinite(value)), None)


def _title(config: Mapping[str, Any], folder: Path) -> str:
    named = {key.rsplit(".", 1)[-1]: value for key, value in flatten(config) if isinstance(value, str)}
    name = next((named[key] for key in _NAME_KEYS if key in named), folder.resolve().name)
    return f"{name}: what was learned"


def _lead(rows: Sequence[Row], summary: Mapping[str, Any], target: float | None) -> str:
    steps, returns = finite_series(rows, "evaluation", "greedy_return")
    if not len(steps):
        return _measured(rows) or "No greedy evaluation has been recorded yet."
    text = f"After {steps[-1]:,.0f} environment steps the greedy policy scores {returns[-1]:.4g} per episode."
    if (kept := kept_words(summary)) is not None:
        text = f"The agent that was kept scores {kept[0]} per episode ({kept[1]}). " + text.replace(
            "the greedy policy scores", "the last evaluation scored"
        )
    if target is None:
        return text
    reached = steps[returns >= target]
    if len(reached):
        return f"{text} The target of {target:g} was first reached at {reached[0]:,.0f}."
    return f"{text} The target of {target:g} was not reached."


def _measured(rows: Sequence[Row]) -> str | None:
    """Of a run that predicts and does not act, the value of the start."""
    steps, values = finite_series(rows, "evaluation", "start_value")
    if not len(steps):
        return None
    text = f"After {steps[-1]:,.0f} environment steps the start is worth {values[-1]:.4g} under the policy watched"
    _, errors = finite_series(rows, "evaluation", "value_error_rms")
    exact = f"; values are {errors[-1]:.2g} from the exact ones (root mean square)" if len(errors) else ""
    return f"{text}{exact}."


def _facts(rows: Sequence[Row], summary: Mapping[str, Any]) -> dict[str, Any]:
    """The summary of a finished run; for one still going, what its last rows say."""
    facts = dict(summary)
    for column in ("env_steps", "wall_seconds", "cpu_seconds", "steps_per_second"):
        _, values = finite_series(rows, "train", column)
        if len(values):
            facts.setdefault(column, float(values[-1]))
    steps, returns = finite_series(rows, "evaluation", "greedy_return")
    if len(steps):
        facts.setdefault("greedy_return", float(returns[-1]))
        facts["best_greedy_return"] = float(returns.max())
        facts["greedy_evaluations"] = len(steps)
    return {key.replace("_", " "): value for key, value in facts.items()} or {"rows recorded": len(rows)}
