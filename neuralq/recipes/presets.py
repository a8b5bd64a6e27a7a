"""Settings known to work, by environment and learner. A preset gives defaults; whatever is set explicitly wins."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neuralq.recipes.config import NETWORKS, RunConfig, config_from_dict

__all__ = ["PRESETS", "preset_for", "with_preset"]

PRESETS: dict[tuple[str, str], dict[str, Any]] = {
    # PQN (Gallici et al., 2024) scaled down. What matters, found on seeds 100 to 107 (docs/performance.md): many epochs
    # at a small learning rate, λ near 1, no target network, and rewards scaled so that values stay within tens.
    ("CartPole-v1", "rollout"): {
        "reward_scale": 0.1,
        "epsilon_decay_steps": 20_000,
        "body": {"class": "MLP", "hidden": [128, 128], "layer_norm": True},
        "rollout": {"lambda_": 0.95, "learning_rate": 5e-4, "num_envs": 32, "num_steps": 32, "num_epochs": 16},
    },
    # Plain gradient steps without replay or step bounds need small values and normalised layers to stay finite.
    ("CartPole-v1", "online"): {
        "reward_scale": 0.1,
        "body": {"class": "MLP", "hidden": [64, 64], "layer_norm": True},
        "online": {"lambda_": 0.8, "step_size": 1e-3},
    },
    # Mitchell (1997), Figure 13.2, γ = 0.9 as there: one-step targets and actions drawn uniformly, for Q-learning needs
    # every pair and not a good policy. Values up to 1 and plain gradient steps serve a table and a network alike.
    ("neuralq/MitchellGrid-v0", "rollout"): {
        "total_steps": 16_000,
        "gamma": 0.9,
        "reward_scale": 0.01,
        "epsilon_start": 1.0,
        "epsilon_end": 1.0,
        "evaluate_every": 16_000,
        "rollout": {
            "lambda_": 0.0,
            "num_envs": 16,
            "num_steps": 8,
            "num_epochs": 8,
            "num_minibatches": 1,
            "optimiser": "sgd",
            "learning_rate": 0.5,
        },
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


def with_preset(plain: Mapping[str, Any]) -> RunConfig:
    """The configuration of what is given, over the preset of its environment and learner, over the defaults.

    Args:
        plain: as `config_to_dict` writes it, or any part of that; settings of the learner may be partial too.

    Raises:
        ValueError: for unknown keys and values out of range, as `RunConfig` does.

    Example:
        >>> config = with_preset({"env": "CartPole-v1", "rollout": {"num_envs": 8}})
        >>> config.rollout.num_envs, config.reward_scale
        (8, 0.1)
    """
    learner = plain.get("learner", RunConfig.learner)
    preset = preset_for(plain.get("env", RunConfig.env), learner)
    if plain.get("layout", RunConfig.layout) not in NETWORKS:
        preset = {name: value for name, value in preset.items() if name != "body"}
    settings = {learner: {**preset.get(learner, {}), **(plain.get(learner) or {})}}
    return config_from_dict({**preset, **plain, **settings})
