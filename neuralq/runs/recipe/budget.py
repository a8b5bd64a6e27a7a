"""Schedules that nobody set, cut to a budget that somebody did.

A preset's exploration and learning rate fall over a number of steps that goes with its own budget. A run that is given
a tenth of that would explore to its end, and be judged by a policy that was never followed. So what the preset (or the
defaults) say of schedules gives way to a shorter budget; a longer budget changes nothing, and what is set explicitly
is never touched.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neuralq.runs.recipe.config import RunConfig

__all__ = ["cut_to_budget"]


def cut_to_budget(preset: Mapping[str, Any], given: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """A preset whose schedules end within the budget that is given, and what was changed, in words.

    ε reaches its end value by half of the budget, or by the share that it has of the preset's own budget where that is
    more; a learning rate that falls over a number of steps of its own has fallen by the end.

    Args:
        preset: as `neuralq.runs.preset_for` gives it; empty for the defaults.
        given: what is set explicitly, which wins; ``total_steps`` is the budget.

    Example:
        >>> preset = {"total_steps": 300_000, "epsilon_decay_steps": 150_000}
        >>> cut_to_budget(preset, {"total_steps": 20_000})[0]["epsilon_decay_steps"]
        10000
        >>> cut_to_budget(preset, {"total_steps": 400_000}) == (preset, [])
        True
    """
    changed: dict[str, Any] = dict(preset)
    notes: list[str] = []
    budget, own = given.get("total_steps"), preset.get("total_steps", RunConfig.total_steps)
    if not isinstance(budget, int | float) or not 0 < budget < own:  # what is no number is refused later
        return changed, notes
    merged = {**preset, **given}
    decay = preset.get("epsilon_decay_steps", RunConfig.epsilon_decay_steps)
    most = max(1, int(budget) // 2, int(decay * budget / own))
    explores = merged.get("epsilon_start", RunConfig.epsilon_start) != merged.get("epsilon_end", RunConfig.epsilon_end)
    if decay > most and explores and "epsilon_decay_steps" not in given:
        changed["epsilon_decay_steps"] = most
        notes.append(f"ε falls over {most:,} steps, not {decay:,} (--epsilon-decay-steps)")
    learner = merged.get("learner", RunConfig.learner)
    settings = preset.get(learner) or {}
    anneal = settings.get("anneal_env_steps")
    if anneal is not None and anneal > budget and "anneal_env_steps" not in (given.get(learner) or {}):
        changed[learner] = {**settings, "anneal_env_steps": int(budget)}
        notes.append(f"the learning rate falls over {int(budget):,} steps, not {anneal:,}")
    return changed, notes
