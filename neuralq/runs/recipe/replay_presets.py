"""Settings of DQN known to work: by environment, for environments that have none, and by the name of an agent."""

from __future__ import annotations

from typing import Any

from neuralq.checks import check_choice
from neuralq.q.named_bodies import NAMED_BODIES
from neuralq.runs.recipe.config import body_to_dict
from neuralq.runs.recipe.games import ATARI

__all__ = ["AGENTS", "ANY", "REPLAY_PRESETS", "agent_preset"]

ANY = "any"
"""In the place of an environment: what one without a preset of its own begins with, screens excepted."""

_GAMES = ("Asterix", "Breakout", "Freeway", "Seaquest", "SpaceInvaders")
_MULTISTEP: dict[str, Any] = {
    "learning_rate": 1e-3,
    "batch_size": 128,
    "learning_starts": 1_000,
    "train_period": 2,
    "target_rule": "double",
    "num_steps": 5,
    "target_rate": 0.01,
    "average_updates": 1_000.0,
}

REPLAY_PRESETS: dict[tuple[str, str], dict[str, Any]] = {
    (ANY, "replay"): {"replay": _MULTISTEP},
    # Three rewards and double Q-learning: with one reward values are too slow, with the plain maximum they fall again.
    ("CartPole-v1", "replay"): {
        "total_steps": 60_000,
        "reward_scale": 0.1,
        "epsilon_end": 0.05,
        "epsilon_decay_steps": 10_000,
        "evaluate_every": 5_000,
        "body": {"class": "MLP", "hidden": [64, 64], "layer_norm": True},
        "replay": {
            "learning_rate": 1e-3,
            "batch_size": 128,
            "learning_starts": 1_000,
            "train_period": 2,
            "target_rule": "double",
            "num_steps": 3,
            "target_period_updates": 250,
        },
    },
    # The general settings, for the budgets of the RL zoo.
    **{
        (env, "replay"): {"total_steps": 100_000, "evaluate_every": 5_000, "replay": _MULTISTEP}
        for env in ("Acrobot-v1", "LunarLander-v3")
    },
    ("MountainCar-v0", "replay"): {"total_steps": 120_000, "evaluate_every": 6_000, "replay": _MULTISTEP},
    # DQN of Young & Tian (2019, examples/dqn.py of the games' repository), but Adam for centred RMSProp with momentum,
    # and the network with PQN's layer normalisation.
    **{
        (f"MinAtar/{game}-v1", "replay"): {
            "total_steps": 5_000_000,
            "gamma": 0.99,
            "epsilon_end": 0.1,
            "epsilon_decay_steps": 100_000,
            "evaluate_every": 250_000,
            "checkpoint_every": 500_000,
            "log_every": 20_000,
            "body": body_to_dict(NAMED_BODIES["minatar"]),
            "replay": {
                "learning_rate": 2.5e-4,
                "batch_size": 32,
                "capacity": 100_000,
                "learning_starts": 5_000,
                "train_period": 1,
                "target_period_updates": 1_000,
            },
        }
        for game in _GAMES
    },
}

AGENTS: dict[str, dict[str, Any]] = {
    # Hessel et al. (2018): double, prioritised, dueling, three-step, categorical (51 atoms) and noisy, without ε. The
    # rate, batches and periods are for small environments; on Atari's screens they are Table 1's.
    "rainbow": {
        "learner": "replay",
        "dueling": True,
        "epsilon_start": 0.0,
        "epsilon_end": 0.0,
        "replay": {
            "target_rule": "double",
            "prioritised": True,
            "num_steps": 3,
            "distribution": "categorical",
            "num_atoms": 51,
            "noisy": True,
            "learning_rate": 5e-4,
            "batch_size": 64,
            "learning_starts": 1_000,
            "train_period": 2,
            "target_period_updates": 250,
        },
    },
}
"""Whole agents by name: what `neuralq train ENV --preset NAME` begins with, on any environment."""

_SCREENS: dict[str, Any] = {
    "learning_rate": 6.25e-5,
    "batch_size": 32,
    "capacity": 1_000_000,
    "learning_starts": 20_000,
    "train_period": 4,
    "target_period_updates": 2_000,  # 32,000 frames
    "value_min": -10.0,
    "value_max": 10.0,
}
_RETURNS = {  # the discounted returns that there are, by γ = 0.99
    "CartPole-v1": (0.0, 100.0),
    "Acrobot-v1": (-100.0, 0.0),
    "MountainCar-v0": (-100.0, 0.0),
    "LunarLander-v3": (-400.0, 300.0),
}


def agent_preset(name: str, env: str) -> dict[str, Any]:
    """The settings of an agent by name, for an environment.

    Args:
        name: one of `AGENTS`.
        env: whose range of returns is filled in where it is known; else it has to be given (``value_min``,
            ``value_max``).

    Raises:
        ValueError: there is no such agent.

    Example:
        >>> agent_preset("rainbow", "CartPole-v1")["replay"]["value_max"]
        100.0
    """
    check_choice("preset", name, AGENTS)
    preset, settings = dict(AGENTS[name]), dict(AGENTS[name]["replay"])
    if env.startswith(ATARI):
        preset["clip_rewards"] = True
        settings |= _SCREENS
    elif env in _RETURNS:
        settings["value_min"], settings["value_max"] = _RETURNS[env]
    return {**preset, "replay": settings}
