"""Settings that are known to work, by environment and learner. A preset gives defaults; whatever is set explicitly wins."""

from __future__ import annotations

from typing import Any

__all__ = ["PRESETS", "preset_for"]

PRESETS: dict[tuple[str, str], dict[str, Any]] = {
    # PQN (Gallici et al., 2024) scaled down: many short rollouts with several epochs each, λ near 1, rewards scaled so
    # that values stay within tens.
    ("CartPole-v1", "rollout"): {
        "reward_scale": 0.1,
        "epsilon_decay_steps": 20_000,
        "body": {"class": "MLP", "hidden": [128, 128], "layer_norm": True},
        "rollout": {"lambda_": 0.9, "learning_rate": 1e-3, "num_envs": 32, "num_steps": 32},
    },
}


def preset_for(env: str, learner: str) -> dict[str, Any]:
    """The preset's values, empty where there is none.

    Example:
        >>> preset_for("CartPole-v1", "rollout")["reward_scale"]
        0.1
        >>> preset_for("Unknown-v0", "rollout")
        {}
    """
    return PRESETS.get((env, learner), {})
