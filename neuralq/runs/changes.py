"""What a run may go on with otherwise than it began: which settings, how they are named, and what is kept of it.

Budgets, targets, evaluations and the device do not decide what is learned; step sizes do, from there on. Everything
else would make another run of it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any, TypeVar

from neuralq.runs.loop import Plan, Progress

__all__ = ["differences", "names_of_changes", "replaced", "told", "with_new_periods"]

C = TypeVar("C")


def names_of_changes(config: Any, changeable: Collection[str]) -> dict[str, str]:
    """The settings that may change, by every name that they may be given: those of a part by their own name, too.

    Args:
        config: of the run, a dataclass whose parts are dataclasses or None.
        changeable: names of fields, with a dot those of parts.

    Example:
        >>> from neuralq.runs.recipe.config import RunConfig
        >>> names_of_changes(RunConfig(), ["total_steps", "rollout.learning_rate", "online.step_size"])
        {'learning_rate': 'rollout.learning_rate', 'rollout.learning_rate': 'rollout.learning_rate',
         'total_steps': 'total_steps'}
    """
    full = sorted(n for n in changeable if "." not in n or getattr(config, n.partition(".")[0], None) is not None)
    return {**{n.rpartition(".")[2]: n for n in full if "." in n}, **{n: n for n in full}}


def replaced(config: C, values: Mapping[str, Any]) -> C:
    """The configuration with other values, by full names.

    Example:
        >>> from neuralq.runs.recipe.config import RunConfig
        >>> replaced(RunConfig(), {"rollout.learning_rate": 0.5, "seed": 3}).rollout.learning_rate
        0.5
    """
    whole: dict[str, Any] = {name: value for name, value in values.items() if "." not in name}
    for name, value in values.items():
        part, dot, field = name.partition(".")
        if dot:
            before = whole.get(part, getattr(config, part))
            whole[part] = dataclasses.replace(before, **{field: value})
    return dataclasses.replace(config, **whole)  # type: ignore[type-var]  # it is a dataclass


def differences(before: Any, now: Any, names: Collection[str]) -> dict[str, tuple[Any, Any]]:
    """Old and new of what differs between two configurations, by full name.

    Example:
        >>> from neuralq.runs.recipe.config import RunConfig
        >>> differences(RunConfig(), RunConfig(total_steps=5), {"total_steps", "rollout.learning_rate"})
        {'total_steps': (100000, 5)}
    """
    both = {name: (_value(before, name), _value(now, name)) for name in sorted(names)}
    return {name: values for name, values in both.items() if values[0] != values[1]}


def _value(config: Any, name: str) -> Any:
    part, dot, field = name.partition(".")
    inner = getattr(config, part)
    return getattr(inner, field) if dot and inner is not None else inner


def with_new_periods(progress: Progress, before: Plan, now: Plan, amount: int) -> None:
    """What is due next comes at the new periods, where they changed and it was not due already."""
    for due, period in (
        ("next_evaluation", "evaluate_every"), ("next_checkpoint", "checkpoint_every"), ("next_log", "log_every"),
    ):  # fmt: skip
        every = getattr(now, period)
        if every != getattr(before, period) and getattr(progress, due) > amount:
            setattr(progress, due, (amount // every + 1) * every)


def told(row: Mapping[str, Any]) -> str:
    """One row of ``changes.jsonl`` in words.

    Example:
        >>> told({"env_steps": 64, "changes": {"total_steps": [128, 256]}})
        'changed at 64 environment steps: total_steps 128 → 256'
    """
    parts = [f"{name} {_shown(old)} → {_shown(new)}" for name, (old, new) in row["changes"].items()]
    differs = "" if not any("." in name for name in row["changes"]) else (
        "; what is learned from there on is not what a run that was never changed learns"
    )  # fmt: skip
    return f"changed at {row['env_steps']:,} environment steps: {', '.join(parts)}{differs}"


def _shown(value: Any) -> str:
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
