"""Settings known to work, by environment and learner. A preset gives defaults; whatever is set explicitly wins."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neuralq.checks import check_choice
from neuralq.q.named_bodies import NAMED_BODIES
from neuralq.rules.target_rule import target_rules
from neuralq.runs.recipe.budget import cut_to_budget
from neuralq.runs.recipe.config import LEARNERS, NETWORKS, RunConfig, body_to_dict, config_from_dict, layout_for
from neuralq.runs.recipe.games import ATARI
from neuralq.runs.recipe.keywords import nested, with_body
from neuralq.runs.recipe.replay_presets import ANY, REPLAY_PRESETS, agent_preset

__all__ = ["PRESETS", "REACHED", "of_agent", "preset_for", "started", "under", "with_preset", "yielding"]

_GAMES = ("Asterix", "Breakout", "Freeway", "Seaquest", "SpaceInvaders")
_MINATAR: dict[str, Any] = {
    "total_steps": 5_000_000,
    "evaluate_every": 250_000,
    "checkpoint_every": 500_000,
    "log_every": 20_000,
}

PRESETS: dict[tuple[str, str], dict[str, Any]] = {
    # PQN (Gallici et al., 2024) scaled down. What matters (docs/performance.md): many small gradient steps per rollout,
    # λ-returns refreshed between passes so that values arrive at their height, 1/(1 − γ), within 12,000 steps, a rate
    # that falls once they have, no target network, and rewards scaled so that values stay within tens.
    ("CartPole-v1", "rollout"): {
        "reward_scale": 0.1,
        "epsilon_start": 0.5,
        "epsilon_end": 0.1,
        "epsilon_decay_steps": 8_000,
        "body": {"class": "MLP", "hidden": [64, 64], "layer_norm": True},
        "rollout": {
            "lambda_": 0.9,
            "learning_rate": 7e-4,
            "num_envs": 16,
            "num_steps": 32,
            "num_epochs": 12,
            "num_minibatches": 8,
            "anneal": True,
            "anneal_env_steps": 16_000,
            "anneal_to": 0.1,
            "refresh_targets": True,
            "average_updates": 8.0,
        },
    },
    # Rewards of −1 until the goal: values that start at 0 are optimistic, and explore by themselves: ε may fall soon.
    # Long rollouts and wide layers keep policies from forgetting the few starts that take long (docs/benchmarks.md).
    ("Acrobot-v1", "rollout"): {
        "total_steps": 200_000,
        "gamma": 0.995,
        "reward_scale": 0.1,
        "epsilon_end": 0.01,
        "epsilon_decay_steps": 20_000,
        "evaluate_every": 10_000,
        "body": {"class": "MLP", "hidden": [256, 256], "layer_norm": True},
        "rollout": {
            "lambda_": 0.6,
            "learning_rate": 5e-4,
            "num_envs": 16,
            "num_steps": 128,
            "num_epochs": 8,
            "num_minibatches": 32,
            "anneal": True,
            "normalise_observations": True,
            "refresh_targets": True,
            "average_updates": 8.0,
        },
    },
    # As Acrobot. The velocity is a twentieth of the position's size, and as important.
    ("MountainCar-v0", "rollout"): {
        "total_steps": 300_000,
        "gamma": 0.995,
        "reward_scale": 0.1,
        "epsilon_end": 0.01,
        "epsilon_decay_steps": 150_000,
        "evaluate_every": 15_000,
        "body": {"class": "MLP", "hidden": [128, 128], "layer_norm": True},
        "rollout": {
            "lambda_": 0.8,
            "learning_rate": 1e-3,
            "num_envs": 16,
            "num_steps": 32,
            "num_epochs": 8,
            "num_minibatches": 16,
            "anneal": True,
            "normalise_observations": True,
            "average_updates": 16.0,
        },
    },
    # As CartPole: refreshed targets, and an average that plays. Observations are of similar size as they come, and the
    # rewards of ±100 at the end become ±10.
    ("LunarLander-v3", "rollout"): {
        "total_steps": 500_000,
        "gamma": 0.99,
        "reward_scale": 0.1,
        "epsilon_end": 0.02,
        "epsilon_decay_steps": 100_000,
        "evaluate_every": 25_000,
        "body": {"class": "MLP", "hidden": [128, 128], "layer_norm": True},
        "rollout": {
            "lambda_": 0.9,
            "learning_rate": 5e-4,
            "num_envs": 16,
            "num_steps": 32,
            "num_epochs": 8,
            "num_minibatches": 8,
            "anneal": True,
            "refresh_targets": True,
            "average_updates": 32.0,
        },
    },
    # Plain gradient steps without replay or step bounds need small values and normalised layers to stay finite.
    ("CartPole-v1", "online"): {
        "reward_scale": 0.1,
        "body": {"class": "MLP", "hidden": [64, 64], "layer_norm": True},
        "online": {"lambda_": 0.8, "step_size": 1e-3},
    },
    # Stream Q(λ) as published for classic control (Elsayed, Vasan & Mahmood 2024): α = 1, κ = 2, λ = 0.8, γ = 0.99,
    # ε from 1 to 0.01 over 5 % of 500,000 steps, 32-32 units normalised without a scale of their own, nine weights in
    # ten at 0. The cut is the exact one; --streaming.cut published gives theirs. Their observations hold the elapsed
    # time of the episode, which ours do not.
    **{
        (env, "streaming"): {
            "total_steps": 500_000,
            "epsilon_end": 0.01,
            "epsilon_decay_steps": 25_000,
            "evaluate_every": 25_000,
            "log_every": 5_000,
            "body": {
                "class": "MLP",
                "hidden": [32, 32],
                "layer_norm": True,
                "affine": False,
                "activation": "leaky_relu",
                "sparsity": 0.9,
            },
        }
        for env in ("CartPole-v1", "Acrobot-v1", "MountainCar-v0")
    },
    # PQN's settings on MinAtar (Gallici et al., 2024), published over 10,000,000 steps, ε over the first tenth of them
    # as here. Our layer norm after the convolution is over all its outputs (134,483 parameters), theirs over channels
    # (132,467).
    **{
        (f"MinAtar/{game}-v1", "rollout"): {
            **_MINATAR,
            "epsilon_decay_steps": 500_000,
            "body": body_to_dict(NAMED_BODIES["minatar"]),
            "rollout": {
                "lambda_": 0.65,
                "num_envs": 128,
                "num_steps": 32,
                "num_epochs": 2,
                "num_minibatches": 32,
                "learning_rate": 5e-4,
                "anneal": True,
            },
        }
        for game in _GAMES
    },
    # Stream Q(λ) on MinAtar, as above but for the network and ε over the first fifth of 5,000,000 steps to 0.01; QRC(λ)
    # (Elelimy et al. 2025) as published, on the same network, with the defaults of `GradientSettings`.
    **{
        (f"MinAtar/{game}-v1", learner): {
            **_MINATAR,
            "epsilon_end": 0.01,
            "epsilon_decay_steps": 1_000_000,
            "body": {
                **body_to_dict(NAMED_BODIES["minatar"]),
                "init": "uniform",
                "affine": False,
                "activation": "leaky_relu",
                "sparsity": 0.9,
            },
        }
        for game in _GAMES
        for learner in ("streaming", "gradient")
    },
    # A card says little: α = 1/n averages over all of them, undiscounted, with every action taken now and then.
    ("Blackjack-v1", "tabular"): {
        "total_steps": 200_000,
        "gamma": 1.0,
        "epsilon_end": 0.1,
        "epsilon_decay_steps": 100_000,
        "evaluate_every": 50_000,
        "evaluation_episodes": 200,
        "tabular": {"schedule": "one-over-n"},
    },
    # The goal is rarely found on slippery ice: large steps as long as it is far away, then averages.
    ("FrozenLake-v1", "tabular"): {
        "epsilon_end": 0.1,
        "evaluate_every": 20_000,
        "evaluation_episodes": 100,
        "tabular": {"schedule": "search-then-converge"},
    },
    ("FrozenLake8x8-v1", "tabular"): {
        "total_steps": 500_000,
        "epsilon_end": 0.1,
        "epsilon_decay_steps": 100_000,
        "evaluate_every": 100_000,
        "evaluation_episodes": 100,
        "tabular": {"schedule": "search-then-converge"},
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
    **REPLAY_PRESETS,
}


REACHED: dict[tuple[str, str], str] = {
    ("CartPole-v1", "rollout"): "500.0 (486.1 to 500.0)",
    ("Acrobot-v1", "rollout"): "−77.5 (−79.7 to −75.2)",
    ("MountainCar-v0", "rollout"): "−101.7 (−119.5 to −100.3)",
    ("LunarLander-v3", "rollout"): "272.8 (269.1 to 279.0)",
    ("CartPole-v1", "streaming"): "500.0 (498.8 to 500.0)",
    ("Acrobot-v1", "streaming"): "−116.0 (−298.3 to −91.1)",
    ("MountainCar-v0", "streaming"): "−200 (−200 to −200)",
    ("Acrobot-v1", "replay"): "−80.8 (−82.7 to −79.2)",
    ("MountainCar-v0", "replay"): "−168.5 (−200.0 to −101.2)",
    ("MinAtar/Asterix-v1", "rollout"): "57.1",
    ("MinAtar/Breakout-v1", "rollout"): "29.0",
    ("MinAtar/Freeway-v1", "rollout"): "65.5",
    ("MinAtar/Seaquest-v1", "rollout"): "123.4",
    ("MinAtar/SpaceInvaders-v1", "rollout"): "462.4",
}
"""Returns at the end, interquartile mean over seeds and interval, where docs/benchmarks.md has measured a preset."""

_YIELDS = {
    "target_rule": ("num_steps",),  # n was chosen for the preset's rule; others may refuse it
    "block_length": ("num_steps", "target_rule"),
    "target_rate": ("target_period_updates",),
    "target_period_updates": ("target_rate",),
}
"""What of a preset gives way to a setting that is given."""

_OF_FROZEN_TARGETS = {"target_period_updates", "target_rate", "average_updates", "noisy", "loss"}
"""What gives way to a rule that corrects the gradient instead of freezing its targets, and takes none of it."""


def preset_for(env: str, learner: str) -> dict[str, Any]:
    """The preset's values: of the environment, else of any environment, empty where the learner has none.

    Example:
        >>> preset_for("CartPole-v1", "rollout")["reward_scale"]
        0.1
        >>> preset_for("Unknown-v0", "rollout")
        {}
    """
    found = PRESETS.get((env, learner))
    if found is None and not env.startswith(ATARI):
        found = PRESETS.get((ANY, learner))
    return found or {}


def started(env: str, learner: str, name: str | None = None) -> str:
    """Which preset a run starts from, in words; empty where there is none.

    Example:
        >>> started("CartPole-v1", "rollout"), started("CartPole-v1", "replay", "rainbow")
        ('preset for CartPole-v1, rollout learner', 'preset rainbow')
    """
    if name is not None:
        return f"preset {name}"
    where = env if (env, learner) in PRESETS else "any environment"
    return f"preset for {where}, {learner} learner" if preset_for(env, learner) else ""


def under(given: Mapping[str, Any], name: str | None = None) -> tuple[str, dict[str, Any]]:
    """The learner of what is given, and the preset that stands under it.

    Args:
        given: settings by name; env, learner and layout decide.
        name: of a whole agent, in place of the environment's preset.

    Raises:
        ValueError: there is no such learner or agent, or the agent is one of another learner.

    Example:
        >>> under({"env": "CartPole-v1"}, "rainbow")[0]
        'replay'
    """
    env = str(given.get("env", RunConfig.env))
    agent = {} if name is None else agent_preset(name, env)
    learner = given.get("learner", agent.get("learner", RunConfig.learner))
    check_choice("learner", learner, LEARNERS)
    if learner != agent.get("learner", learner):
        raise ValueError(f"preset {name} is for the {agent['learner']} learner, got {learner}; leave one of them out")
    preset = agent or preset_for(env, learner)
    if layout_for(learner, given.get("layout", RunConfig.layout)) not in NETWORKS:
        own = (env, learner) in PRESETS  # tables and linear functions need other rates than networks
        preset = {key: value for key, value in preset.items() if own and key != "body"}
    return learner, preset


def of_agent(plain: Mapping[str, Any], name: str | bool | None, given: Mapping[str, Any]) -> Mapping[str, Any]:
    """Settings with the learner of a named agent, where neither they nor others that are given name one.

    Example:
        >>> of_agent({"env": "CartPole-v1"}, "rainbow", {})
        {'learner': 'replay', 'env': 'CartPole-v1'}
    """
    if not isinstance(name, str) or "learner" in plain or "learner" in given:
        return plain
    return {"learner": agent_preset(name, "")["learner"], **plain}


def yielding(settings: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """What of a preset's settings of a learner can stand beside those that are given.

    Example:
        >>> yielding({"target_period_updates": 250, "learning_rate": 1e-3}, {"target_rate": 0.01})
        {'learning_rate': 0.001}
        >>> yielding({"average_updates": 1000.0, "noisy": True}, {"target_rule": "dqrc"})
        {}
    """
    gone = {over for name, overs in _YIELDS.items() if name in given for over in overs}
    rule = target_rules().get(given.get("target_rule", ""))
    if rule is not None and rule.correction:
        gone |= _OF_FROZEN_TARGETS
    if given.get("anneal") is False:
        gone |= {"anneal_env_steps", "anneal_to"}
    return {name: value for name, value in settings.items() if name not in gone}


def with_preset(given: Mapping[str, Any] | str, *, preset: str | None = None, **settings: Any) -> RunConfig:
    """The configuration of what is given, over the preset of its environment and learner, over the defaults.

    Schedules that are not given end within a ``total_steps`` that is (`neuralq.runs.recipe.budget`).

    Args:
        given: an environment's id; or as `config_to_dict` writes it, or any part of that; settings of the learner may
            be partial too.
        preset: name of a whole agent, such as "rainbow", in place of the environment's preset.
        settings: fields of the configuration and, flat, settings of its learner; they win.

    Raises:
        ValueError: for unknown names and values out of range, as `RunConfig` does.

    Example:
        >>> config = with_preset("CartPole-v1", num_envs=8)
        >>> config.rollout.num_envs, config.reward_scale
        (8, 0.1)
    """
    if not isinstance(given, Mapping | str):
        raise ValueError(
            f"a preset belongs to the id of an environment, or a mapping that holds it as 'env', got {given!r}; an "
            "environment itself is taken by neuralq.train"
        )
    plain = nested(of_agent({"env": given} if isinstance(given, str) else given, preset, settings), settings)
    learner, base = under(plain, preset)
    base, _ = cut_to_budget(base, {**plain, "learner": learner})
    given_settings = plain.get(learner) or {}
    merged = {learner: {**yielding(base.get(learner, {}), given_settings), **given_settings}}
    return config_from_dict(with_body({**base, **plain, **merged}))
