"""Runs of networks with a memory: what goes with one, and streams that carry it from step to step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from gymnasium.vector import VectorEnv

from neuralq.q import GRU
from neuralq.q.recurrent import recurrent_part
from neuralq.runs.stream import Interaction, Normalisation
from neuralq.runs.stream.encoding import discrete_actions
from neuralq.types import Array, QFunction

if TYPE_CHECKING:
    from neuralq.runs.recipe.config import RunConfig

__all__ = ["check_memory", "interaction", "memory_size", "remembering"]


def check_memory(config: RunConfig) -> None:
    """What remembers is learned from sequences.

    Raises:
        ValueError: where the learner has none, or something else does not go with a memory; with the way out.
    """
    if not isinstance(config.body, GRU):
        if getattr(config.settings, "burn_in", 0):
            raise ValueError("burn_in brings a memory along, and this network has none; use body='gru', or leave it")
        return
    settings: Any = config.settings
    if config.learner not in ("rollout", "replay"):
        raise ValueError(
            f"the {config.learner} learner takes steps one by one, and a memory is learned from sequences; use "
            "learner='rollout', or 'replay' with blocks"
        )
    if config.learner == "rollout" and settings.num_minibatches > settings.num_envs:
        raise ValueError(
            f"with a memory a minibatch is made of whole streams, and there are {settings.num_envs} for "
            f"num_minibatches={settings.num_minibatches}; take at most {settings.num_envs}, or more environments"
        )
    if config.learner == "replay" and settings.block_length == 1:
        raise ValueError(
            "a memory is learned from blocks, got block_length=1; use target_rule='peng' with block_length=16"
        )
    others = (
        (config.dataset is not None, "a data set has no memories", "dataset"),
        (getattr(settings, "noisy", False), "noisy layers would be other ones at every step of a memory", "noisy"),
        (getattr(settings, "conservative_alpha", 0) > 0, "the penalty knows no memories", "conservative_alpha"),
    )
    for given, why, name in others:
        if given:
            raise ValueError(f"{name} does not go with body='gru': {why}; leave one of them out")


def memory_size(config: RunConfig, num_actions: int) -> int:
    """Numbers that the configured network remembers from step to step, 0 for most."""
    if not isinstance(config.body, GRU):
        return 0
    return config.body.units * (num_actions if config.layout == "separate" else 1)


def interaction(
    config: RunConfig, envs: VectorEnv[Any, Any, Any], seed: int, normalisation: Normalisation | None
) -> Interaction:
    """The stream of an environment as the configured representation is to see it."""
    num_actions, _ = discrete_actions(envs.single_action_space)
    size = memory_size(config, num_actions)
    return Interaction(envs, config.gamma, seed, config.layout == "table", normalisation, size)


def remembering(stream: Interaction, q: QFunction) -> Interaction:
    """The stream, with ``q`` to remember what it has seen, if it has a memory."""
    recurrent = recurrent_part(q)
    if recurrent is not None:
        device = next(recurrent.parameters()).device

        def next_memory(s: Array) -> Array:
            with torch.no_grad():
                found: Array = recurrent.next_memory(torch.from_numpy(s).to(device)).cpu().numpy()
            return found

        stream.next_memory = next_memory
    return stream
