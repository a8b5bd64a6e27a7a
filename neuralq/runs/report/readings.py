"""The rows of a ``metrics.jsonl`` as series that can be drawn."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuralq.runs.changes import told
from neuralq.runs.folder.files import as_float, read_json
from neuralq.runs.folder.run_folder import read_changes
from neuralq.types import Floats

__all__ = [
    "Row",
    "finite_series",
    "first_not_finite",
    "quartiles",
    "read_present_summary",
    "read_told_changes",
    "standard_errors",
    "thin",
]

Row = Mapping[str, Any]


def read_present_summary(folder: Path, rows: Sequence[Row]) -> dict[str, Any]:
    """``summary.json``; empty where there is none, or where the run has gone on since it was written.

    Raises:
        RunFolderError: it is damaged.
    """
    file = folder / "summary.json"
    summary = read_json(file) if file.exists() else {}
    at = as_float(summary.get("env_steps"))
    return {} if any(as_float(row.get("env_steps")) > at for row in rows) else summary


def read_told_changes(folder: Path) -> list[tuple[float, str]]:
    """When a run went on otherwise than before, in environment steps, and with what; what is damaged is left out."""
    found = []
    for row in read_changes(folder):
        changes = row.get("changes")
        both = changes.items() if isinstance(changes, Mapping) else ()
        if pairs := {str(name): pair for name, pair in both if isinstance(pair, list) and len(pair) == 2}:
            found.append((float(row["env_steps"]), told({**row, "changes": pairs})))
    return found


def rows_by_step(rows: Iterable[Row], kind: str) -> list[tuple[float, Row]]:
    """The rows of one kind in order of environment steps; of two at the same step (after a resume) the later counts."""
    latest: dict[float, Row] = {}
    for row in rows:
        steps = as_float(row.get("env_steps"))
        if row.get("kind") == kind and math.isfinite(steps):
            latest[steps] = row
    return sorted(latest.items(), key=lambda pair: pair[0])


def finite_series(rows: Iterable[Row], kind: str, name: str) -> tuple[Floats, Floats]:
    """Steps and values of one column where the value is a finite number.

    Example:
        >>> rows = [{"kind": "train", "env_steps": 8, "loss": 0.5}, {"kind": "train", "env_steps": 16, "loss": None}]
        >>> finite_series(rows, "train", "loss")
        (array([8.]), array([0.5]))
    """
    pairs = [(steps, as_float(row.get(name))) for steps, row in rows_by_step(rows, kind)]
    kept = np.array([pair for pair in pairs if math.isfinite(pair[1])], np.float64).reshape(-1, 2)
    return kept[:, 0], kept[:, 1]


def first_not_finite(rows: Iterable[Row], kind: str, name: str) -> int | None:
    """The environment step at which a column first was NaN or infinite (null does not count), or None."""
    for steps, row in rows_by_step(rows, kind):
        value = row.get(name)
        if isinstance(value, int | float) and not isinstance(value, bool) and not math.isfinite(as_float(value)):
            return int(steps)
    return None


def quartiles(rows: Iterable[Row]) -> tuple[Floats, Floats, Floats]:
    """Steps, first and third quartile of the returns of each greedy evaluation."""
    return _bands(rows, lambda returns: (np.percentile(returns, 25), np.percentile(returns, 75)))


def standard_errors(rows: Iterable[Row]) -> tuple[Floats, Floats, Floats]:
    """Steps, and the mean of the returns of each greedy evaluation less and plus its standard error.

    Example:
        >>> rows = [{"kind": "evaluation", "env_steps": 8, "returns": [0.0, 0.0, 1.0, 1.0]}]
        >>> [round(float(edge[0]), 3) for edge in standard_errors(rows)]
        [8.0, 0.211, 0.789]
    """

    def around(returns: Floats) -> tuple[float, float]:
        error = returns.std(ddof=1) / np.sqrt(len(returns)) if len(returns) > 1 else 0.0
        return returns.mean() - error, returns.mean() + error

    return _bands(rows, around)


def _bands(rows: Iterable[Row], edges: Callable[[Floats], tuple[float, float]]) -> tuple[Floats, Floats, Floats]:
    kept = []
    for steps, row in rows_by_step(rows, "evaluation"):
        listed = row.get("returns")
        returns = np.array([as_float(value) for value in listed] if isinstance(listed, list | tuple) else [])
        if returns.size and np.isfinite(returns).all():
            kept.append((steps, *edges(np.clip(returns, -1e150, 1e150))))
    table = np.array(kept, np.float64).reshape(-1, 3)
    return table[:, 0], table[:, 1], table[:, 2]


def thin(x: Floats, y: Floats, most: int = 1200) -> tuple[Floats, Floats]:
    """At most about ``most`` points that keep each stretch's lowest and highest value, so no spike is lost.

    Example:
        >>> x = np.arange(10_000.0)
        >>> spike = np.where(x == 5001, 7.0, 0.0)
        >>> thin(x, spike)[1].max()
        np.float64(7.0)
    """
    if len(y) <= most:
        return x, y
    kept = {0, len(y) - 1}
    for stretch in np.array_split(np.arange(len(y)), most // 2):
        kept |= {int(stretch[np.argmin(y[stretch])]), int(stretch[np.argmax(y[stretch])])}
    order = sorted(kept)
    return x[order], y[order]
