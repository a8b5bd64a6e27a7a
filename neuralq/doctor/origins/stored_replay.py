"""The experience that a run of neuralq keeps in its newest checkpoint, in the environment's own units."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from neuralq.learners.replay.buffer import ReplayBuffer
from neuralq.runs.agent import Agent
from neuralq.runs.folder import checkpoint
from neuralq.types import Array

__all__ = ["rescaled", "stored_replay"]

_MOST_BYTES = 2**29
"""Of observations; of a larger buffer nothing is read."""


def stored_replay(run: Path, agent: Agent, gamma: float) -> dict[str, Array] | None:
    """The columns ``obs, action, reward, terminated, truncated, next_obs``, one environment after the other.

    Where actions are masked there are ``action_mask`` and ``next_action_mask``, too, which are stored in observations.

    Args:
        run: its folder.
        agent: says how observations were encoded.
        gamma: γ; where it is 0 nobody can tell afterwards whether a step ended the world.

    Returns:
        None where the run keeps no experience, too much of it, or keeps it normalised by statistics that moved on.
    """
    if gamma == 0 or agent.normalisation is not None:
        return None
    try:
        state = checkpoint.load_newest(run / "checkpoints").state
    except (checkpoint.CheckpointError, OSError):
        return None
    buffer = state.get("feed", {}).get("buffer") if isinstance(state.get("feed"), Mapping) else None
    if not isinstance(buffer, Mapping) or buffer["rows"].nbytes > _MOST_BYTES:
        return None
    lanes = [_lane(buffer, i) for i in range(int(buffer["layout"]["num_lanes"]))]
    found = {name: np.concatenate([lane[name] for lane in lanes if lane]) for name in (lanes[0] or {})}
    if not found:
        return None
    for name, mask in (("obs", "action_mask"), ("next_obs", "next_action_mask")):
        if agent.spec.masked:
            found[name], found[mask] = _apart(agent, found[name])
        found[name] = _decoded(agent, found[name])
    found["action"] = found["action"] + agent.first_action
    return found


def _lane(buffer: Mapping[str, Any], i: int) -> dict[str, Array]:
    """What one environment's stream holds, oldest first."""
    layout = buffer["layout"]
    own = ReplayBuffer(layout["per_lane"], tuple(layout["observation_shape"]), layout["observation_dtype"])
    own.load_state_dict(
        {
            "layout": {**layout, "num_lanes": 1, "prioritised": False},
            "rows": buffer["rows"][i : i + 1],
            "records": {name: column[i : i + 1] for name, column in buffer["records"].items()},
            "cursors": buffer["cursors"][i : i + 1],
        }
    )
    if not len(own):
        return {}
    held = own.sample_blocks(1, len(own), np.random.default_rng(0)).map(lambda x: x[:, 0])  # one block holds them all
    ended, last = held.discount_t.numpy() == 0, held.last_t.numpy()
    columns = {
        "obs": held.s_tm1.numpy(), "action": held.a_tm1.numpy(), "reward": held.r_t.numpy().astype(np.float64),
        "terminated": ended, "truncated": last & ~ended, "next_obs": held.s_t.numpy(),
    }  # fmt: skip
    return {name: column.copy() for name, column in columns.items()}


def _apart(agent: Agent, rows: Array) -> tuple[Array, Array]:
    """Observations as they are encoded, and which actions are legal, of rows that hold both."""
    width = rows.shape[1] - agent.spec.num_actions
    return rows[:, :width].reshape(len(rows), *agent.spec.inner_shape), rows[:, width:] != 0


def _decoded(agent: Agent, encoded: Array) -> Array:
    """Observations as the environment gives them; composite ones flat, as `gymnasium.spaces.flatten` has them."""
    encoder = agent.encoder
    if encoder.layout == "image":
        return encoded
    if encoder.layout == "index":
        return encoded + int(encoder.parts[0].starts[0])
    return rescaled(agent, encoded, back=True)


def rescaled(agent: Agent, rows: Array, back: bool = False) -> Array:
    """Each part of flat observations ``[N, ...]`` scaled as the agent sees it, or back to the environment's numbers."""
    flat, at, encoder = rows.reshape(len(rows), -1).astype(np.float64), 0, agent.encoder
    for part in encoder.parts:
        if part.scaling is not None:
            own = flat[:, at : at + part.width].reshape(len(flat), *part.shape)
            own = own * part.scaling.divisor + part.scaling.origin if back else part.scaling.apply(own)
            flat[:, at : at + part.width] = own.reshape(len(flat), -1)
        at += part.width
    dtype = encoder.parts[0].dtype if back and encoder.layout == "array" else encoder.dtype
    return flat.reshape(rows.shape).astype(dtype)
