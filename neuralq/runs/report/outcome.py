"""What comes first on a run's page: how well it plays, the exact answer beside it, and whether learning is sound.

Everything is read from files that may be damaged or from elsewhere: what is not as it should be is left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from neuralq.runs.folder.files import as_float
from neuralq.runs.held import Comparison
from neuralq.runs.play_off import about, score_of
from neuralq.runs.report.page import html_table, short_number
from neuralq.runs.report.readings import Row, finite_series, rows_by_step

__all__ = ["exact_table", "kept_words", "network_table", "play_off_words", "sentence", "tiles_of", "watched_words"]

Tile = tuple[str, str, str]


def tiles_of(rows: Sequence[Row], summary: Mapping[str, Any], target: float | None) -> list[Tile]:
    """Name, value and a remark of each number that comes first.

    Example:
        >>> rows = [{"kind": "evaluation", "env_steps": 64, "greedy_return": 2.0, "returns": [1.0, 3.0]}]
        >>> tiles_of(rows, {}, None)[0]
        ('return per episode', '2 ± 1', 'greedy policy, 2 episodes at 64 steps, standard error')
    """
    found = [*_returns(rows, summary), *_budget(rows, summary, target)]
    exact = summary.get("exact")
    if isinstance(exact, Mapping) and math.isfinite(start := as_float(exact.get("start_value"))):
        right = as_float(exact.get("exact_start_value"))
        found.append(("value of the start", short_number(start), f"exactly {short_number(right)}"))
    monitor = summary.get("monitor")
    if isinstance(monitor, Mapping):
        alarms = [str(one.get("kind")) for one in _mappings(monitor.get("alarms"))]
        found.append(("divergence", ", ".join(alarms) or "no alarm", "watched all along"))
    return found


def kept_words(summary: Mapping[str, Any]) -> tuple[str, str] | None:
    """What the agent that a play-off chose scores, and which it is; None without a play-off.

    Example:
        >>> off = {"agent": "best", "best_return": 9.0, "best_standard_error": 0.25, "num_episodes": 100}
        >>> kept_words({"greedy_return": 0.5, "play_off": off})
        ('9 ± 0.25', 'the best parameters, 100 fresh episodes, standard error')
    """
    score = score_of(summary)
    if score is None or score.num_episodes is None:
        return None
    which = f"the {'best' if score.agent == 'best' else 'last'} parameters, {score.num_episodes:,} fresh episodes"
    if score.standard_error is None:
        return short_number(score.mean), which
    return f"{short_number(score.mean)} ± {short_number(score.standard_error, 2)}", f"{which}, standard error"


def _returns(rows: Sequence[Row], summary: Mapping[str, Any]) -> list[Tile]:
    kept = kept_words(summary)
    found = [] if kept is None else [("return of the agent", *kept)]
    steps, returns = finite_series(rows, "evaluation", "greedy_return")
    if not len(steps):
        return found
    at, row = rows_by_step(rows, "evaluation")[-1]
    listed = row.get("returns")
    each = np.array([as_float(one) for one in listed] if isinstance(listed, list) else [])
    value, remark = short_number(as_float(row.get("greedy_return"))), f"greedy policy, at {at:,.0f} steps"
    if len(each) > 1 and np.isfinite(each).all() and np.abs(each).max() < 1e150:
        value += f" ± {short_number(float(each.std(ddof=1)) / math.sqrt(len(each)), 2)}"
        remark = f"greedy policy, {len(each)} episodes at {at:,.0f} steps, standard error"
    best = int(returns.argmax())
    return [
        *found,
        ("return per episode" if kept is None else "last evaluation", value, remark),
        ("best evaluation", short_number(returns[best]), f"at {steps[best]:,.0f} steps"),
    ]


def _budget(rows: Sequence[Row], summary: Mapping[str, Any], target: float | None) -> list[Tile]:
    values = {name: as_float(summary.get(name)) for name in ("env_steps", "cpu_seconds")}
    for name, value in values.items():
        recorded = finite_series(rows, "train", name)[1]
        if not math.isfinite(value) and len(recorded):
            values[name] = float(recorded[-1])
    if not math.isfinite(values["env_steps"]):
        return []
    remark = (
        f"{short_number(values['cpu_seconds'])} CPU-seconds of training" if math.isfinite(values["cpu_seconds"]) else ""
    )
    for name, words in (("stopped_by", "stopped by"), ("interrupted_by", "interrupted by")):
        if isinstance(summary.get(name), str):
            remark = f"{words} {summary[name]}"
    found = [("environment steps", f"{values['env_steps']:,.0f}", remark)]
    steps, returns = finite_series(rows, "evaluation", "greedy_return")
    if target is not None:
        reached = steps[returns >= target]
        found.append(
            ("target", short_number(target), f"first reached at {reached[0]:,.0f}" if len(reached) else "not reached")
        )
    return found


def play_off_words(summary: Mapping[str, Any]) -> str | None:
    """What decided between the last and the best parameters, of a run that ended below its best evaluation."""
    found = summary.get("play_off")
    text = about(found) if isinstance(found, Mapping) else None
    return None if text is None else sentence(text)


def sentence(text: str) -> str:
    """A line of the terminal as a sentence of a page.

    Example:
        >>> sentence("it ended; so be it")
        'It ended; so be it.'
    """
    return f"{text[:1].upper()}{text[1:]}."


_EXACT = (
    ("largest |Q − Q*|", "q_error_max", "q_error_max_all"),
    ("mean |Q − Q*|", "q_error_mean", "q_error_mean_all"),
    ("states with an optimal action", "optimal_share", "optimal_share_all"),
)


def exact_table(summary: Mapping[str, Any]) -> tuple[str, str] | None:
    """A sentence and a table on what is learned beside the exact answer; None without one."""
    found = summary.get("exact")
    if not isinstance(found, Mapping):
        return None
    numbers = {one.name: as_float(found.get(one.name)) for one in fields(Comparison)}
    text = sentence("; ".join(Comparison(**numbers).lines()[:2]))
    body = [[name, *(_share(name, as_float(found.get(key))) for key in keys)] for name, *keys in _EXACT]
    return text, html_table("Learned beside exact", ("", "states it has visited", "all states"), body)


def _share(name: str, value: float) -> str:
    return f"{value:.0%}" if "states" in name and math.isfinite(value) else short_number(value)


def watched_words(summary: Mapping[str, Any]) -> tuple[str, bool] | None:
    """What the divergence monitor saw and advises, and whether it raised an alarm; None where it did not watch."""
    found = summary.get("monitor")
    if not isinstance(found, Mapping) or not isinstance(found.get("seen"), str):
        return None
    advice = found.get("advice")
    listed = [str(one) for one in advice] if isinstance(advice, list) else []
    text = f"{found['seen']}" + (f" What may help: {'; '.join(listed)}." if listed else "")
    return text, bool(_mappings(found.get("alarms")))


def network_table(layers: Any) -> tuple[str, str] | None:
    """How many numbers were learned, and a table of their tensors, from ``{name: [offset, shape]}`` of a checkpoint."""
    if not isinstance(layers, Mapping) or not layers:
        return None
    shapes = {str(name): list(where[1]) for name, where in layers.items()}
    count = sum(math.prod(shape) for shape in shapes.values())
    body = [[name, " × ".join(map(str, shape)), f"{math.prod(shape):,}"] for name, shape in shapes.items()]
    return f"{count:,} parameters", html_table("Tensors by name", ("tensor", "shape", "numbers"), body)


def _mappings(value: Any) -> list[Mapping[str, Any]]:
    return [one for one in value if isinstance(one, Mapping)] if isinstance(value, list) else []
