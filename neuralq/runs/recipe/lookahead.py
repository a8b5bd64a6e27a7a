"""What can be known of a run before it has cost anything: that it cannot learn, or not in this memory or this life.

Everything here is arithmetic on the configuration and the spaces of the environment.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np

from neuralq.checks import check_fits
from neuralq.q import MLP
from neuralq.rules import Linear
from neuralq.runs.offline.playback import Playback
from neuralq.runs.recipe.config import RunConfig
from neuralq.runs.stream import Interaction, ObservationSpec
from neuralq.runs.stream.table import TableWalk

__all__ = ["num_updates", "require_room", "warnings_ahead"]

_BYTES_PER_WEIGHT = 28  # drawn in float64; then parameters, gradient, two moments and a target in float32
_FLOPS_PER_SECOND = 1e10  # of one core; a product of matrices does several times as much
_LONG_SECONDS = 0.01


def num_updates(config: RunConfig) -> int:
    """How often the learner is called within the budget.

    Example:
        >>> num_updates(RunConfig(learner="replay", total_steps=999))
        0
    """
    settings: Any = config.settings
    if config.dataset is not None:
        return config.total_steps // int(settings.train_period) * int(settings.updates_per_period)
    if config.kind.experience == "replay":
        left: int = config.total_steps - settings.learning_starts
        return 0 if left < 0 else (left // int(settings.train_period) + 1) * int(settings.updates_per_period)
    if config.kind.experience == "rollouts":
        return -(-config.total_steps // int(settings.num_envs * settings.num_steps))
    return config.total_steps


def warnings_ahead(config: RunConfig, stream: Interaction | TableWalk | Playback) -> list[str]:
    """A line for each reason for which this run cannot learn what it is meant to; none for most runs.

    Example:
        >>> import gymnasium as gym
        >>> from neuralq.runs.stream import make_vector_env
        >>> stream = Interaction(make_vector_env(lambda: gym.make("CartPole-v1"), 1), 0.9, 0)
        >>> warnings_ahead(RunConfig(learner="replay", total_steps=900, epsilon_decay_steps=450), stream)
        ['nothing will be learned: the first update comes after 1,000 steps (--replay.learning-starts) of 900']
    """
    found = [_updates(config), _target(config), _exploration(config), _rate(config), *_unused_masks(stream)]
    if stream.num_actions == 1:
        found.append("the environment has one action: there is nothing to choose, only values to predict")
    return [*(line for line in found if line is not None), *_long(config, stream.spec)]


def _updates(config: RunConfig) -> str | None:
    if num_updates(config) > 0:
        return None
    return (
        f"nothing will be learned: the first update comes after {config.settings.learning_starts:,} steps "
        f"(--{config.learner}.learning-starts) of {config.total_steps:,}"
    )


def _target(config: RunConfig) -> str | None:
    period, updates = getattr(config.settings, "target_period_updates", None), num_updates(config)
    if period is None or not 0 < updates < period:
        return None
    return (
        f"targets stay those of the initial values: they are copied every {period:,} updates "
        f"(--{config.learner}.target-period-updates), and there will be {updates:,}"
    )


def _exploration(config: RunConfig) -> str | None:
    if config.dataset is not None:
        return None
    start, end = config.epsilon_start, config.epsilon_end
    last = Linear(start, end, config.epsilon_decay_steps).value(config.total_steps)
    if abs(last - end) <= 0.5 * abs(start - end):
        return None
    return (
        f"ε is still {last:.2g} when the run ends, not {end:g}: it falls over {config.epsilon_decay_steps:,} steps "
        f"(--epsilon-decay-steps) and there are {config.total_steps:,}"
    )


def _rate(config: RunConfig) -> str | None:
    settings: Any = config.settings
    steps = getattr(settings, "anneal_env_steps", None)
    if steps is None or settings.anneal_to > 0 or steps >= 0.9 * config.total_steps:
        return None
    return (
        f"the learning rate is 0 from step {steps:,} on (--{config.learner}.anneal-env-steps), and the run has "
        f"{config.total_steps:,}; --{config.learner}.anneal-to leaves a part of it"
    )


def _unused_masks(stream: Interaction | TableWalk | Playback) -> Iterator[str]:
    """Parts of an observation that are named as masks are, where no mask is told in the place that is obeyed."""
    for part in [] if stream.spec.masked else stream.encoder.parts:
        name = str(part.keys[-1]).lower() if part.keys else ""
        if part.shape == (stream.num_actions,) and any(word in name for word in ("mask", "legal", "valid", "avail")):
            where = "".join(f"[{key!r}]" for key in part.keys)
            yield (
                f"observation{where} looks like a mask of legal actions and is only seen, not obeyed: give it as "
                "info['action_mask'] as well"
            )


def _long(config: RunConfig, spec: ObservationSpec) -> Iterator[str]:
    """Where the network is passed for so many inputs, outputs or actions that a step takes a noticeable time."""
    weights = _num_weights(config, spec)
    if weights is None or config.layout == "table":
        return
    settings: Any = config.settings
    passes = spec.num_actions if config.layout == "action-input" else 1
    # Forwards to act; forwards and twice as much backwards to learn; and the optimiser, ten operations per weight.
    per_row = (2 * weights + 8 * _num_inputs(spec)) * passes
    rows = _rows_per_step(config)
    operations = per_row * (1 + 3 * rows) + 10 * weights * rows / max(1, getattr(settings, "batch_size", 64))
    per_step = operations / _FLOPS_PER_SECOND
    if per_step > _LONG_SECONDS:
        hours = per_step * config.total_steps / 3600
        once = f"is passed once for each of {passes:,} actions" if passes > 1 else f"has {weights:,} weights"
        yield (
            f"the {config.layout} representation {once}: about {per_step:.2g} s per step, {hours:,.1f} hours for "
            f"{config.total_steps:,} steps; {_way_out(config, spec)}"
        )


def _rows_per_step(config: RunConfig) -> float:
    """States whose action values are computed for learning, per environment step."""
    settings: Any = config.settings
    if config.kind.experience == "replay":
        return float(settings.batch_size * settings.updates_per_period / settings.train_period)
    return float(getattr(settings, "num_epochs", 1))


def _num_inputs(spec: ObservationSpec) -> int:
    return int(np.prod(spec.inner_shape)) if spec.num_categories is None else spec.num_categories


def _way_out(config: RunConfig, spec: ObservationSpec) -> str:
    if config.layout == "table":
        return "merge states, or take a function of them: --layout action-output"
    if spec.num_categories is not None and spec.num_categories > spec.num_actions:
        return "give each state a few numbers of its own (gymnasium.wrappers.TransformObservation), or --layout table"
    if config.layout == "action-input":
        return "--layout action-output passes all of them at once"
    return "take narrower layers (--hidden 64,64), --layout action-output or linear, or fewer actions"


def _num_weights(config: RunConfig, spec: ObservationSpec) -> int | None:
    """Of a table, a linear function or an MLP; None for bodies whose size is not plain from the configuration."""
    inputs = _num_inputs(spec)
    outputs = spec.num_actions * config.kind.outputs(config.settings, config.layout)
    if config.layout in ("table", "linear"):
        return inputs * outputs
    body = config.body or MLP()
    if not isinstance(body, MLP):
        return None
    if config.layout == "action-input":
        inputs, outputs = inputs + spec.num_actions, 1
    copies = 1
    if config.layout == "separate":
        copies, outputs = spec.num_actions, outputs // spec.num_actions
    return copies * sum(below * above for below, above in pairwise((inputs, *body.hidden, outputs)))


def require_room(config: RunConfig, spec: ObservationSpec) -> None:
    """Refuse a representation that does not fit into the memory there is, before it is made.

    Raises:
        MemoryError: with both numbers and the way out.
    """
    weights = _num_weights(config, spec)
    if weights is None:
        return
    states = "observations" if spec.num_categories is None else f"{spec.num_categories:,} states"
    what = f"the {config.layout} representation of {states} and {spec.num_actions:,} actions ({weights:,} weights)"
    check_fits(what, _BYTES_PER_WEIGHT * weights, _way_out(config, spec))
    if config.layout != "table":
        rows, per_row = _rows_at_once(config), _bytes_per_row(config, spec)
        check_fits(f"what is computed of {rows:,} observations at once", rows * per_row, _way_out(config, spec))


def _rows_at_once(config: RunConfig) -> int:
    """States whose values are computed together."""
    settings: Any = config.settings
    num_envs = getattr(settings, "num_envs", 1)
    if config.kind.experience == "rollouts":
        return int(num_envs * settings.num_steps)
    return int(max(num_envs, getattr(settings, "batch_size", 1)))


def _bytes_per_row(config: RunConfig, spec: ObservationSpec) -> int:
    """Inputs with their copies, units with what is kept for the gradient, and outputs, in float32."""
    hidden = () if config.layout == "linear" else (config.body or MLP()).hidden
    if config.layout == "action-input":
        return 4 * spec.num_actions * (_num_inputs(spec) + spec.num_actions + 3 * sum(hidden))
    outputs = spec.num_actions * config.kind.outputs(config.settings, config.layout)
    copies = spec.num_actions if config.layout == "separate" else 1
    return 4 * (3 * _num_inputs(spec) + 3 * copies * sum(hidden) + 2 * outputs)
