"""Keyword arguments as people write them: fields of a configuration and, flat, the settings of its learner."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Collection, Mapping
from typing import Any

from neuralq.q import NAMED_BODIES
from neuralq.q.custom import BODIES
from neuralq.runs.recipe.config import LEARNERS, RunConfig, body_to_dict

__all__ = ["BODY_NAMES", "as_mapping", "called_here", "nested", "with_body"]

BODY_NAMES = ("hidden", "layer_norm", "activation")
"""Settings of a body that may be given without it."""

_ELSEWHERE = {
    "total_steps": ("total_timesteps", "timesteps", "num_timesteps", "num_frames", "steps", "max_env_steps"),
    "env": ("env_id", "env_name", "task", "game"),
    "num_envs": ("n_envs", "num_environments", "training_num", "n_env"),
    "learning_rate": ("lr", "step_size", "alpha"),
    "step_size": ("learning_rate", "lr", "alpha"),
    "capacity": ("buffer_size", "replay_size", "memory_size"),
    "target_period_updates": ("target_update_interval", "target_network_frequency", "target_update_freq"),
    "train_period": ("train_freq", "train_frequency", "update_per_step"),
    "updates_per_period": ("gradient_steps",),
    "epsilon_start": ("exploration_initial_eps", "start_e", "eps_train"),
    "epsilon_end": ("exploration_final_eps", "end_e", "eps_train_final"),
    "epsilon_decay_steps": ("exploration_fraction",),
    "hidden": ("net_arch", "policy_kwargs", "hidden_sizes", "hidden_dims"),
    "lambda_": ("lam", "td_lambda", "q_lambda", "gae_lambda", "lambd"),
    "gamma": ("discount", "discount_factor"),
    "evaluate_every": ("eval_freq", "eval_interval"),
    "evaluation_episodes": ("n_eval_episodes", "eval_episodes", "test_num"),
    "stop_at_return": ("target_return", "reward_threshold"),
    "num_steps": ("n_steps", "estimation_step", "n_step"),
    "layout": ("policy", "network"),
    "run_dir": ("save_path", "log_dir", "out_dir"),
    "hooks": ("callback", "callbacks"),
}
"""What Stable-Baselines3, CleanRL and Tianshou call our settings."""


def called_here(name: str, accepted: Collection[str]) -> str | None:
    """What a setting of another library is called here, if it is among those that are accepted.

    Example:
        >>> called_here("total_timesteps", {"total_steps", "seed"})
        'total_steps'
    """
    return next((ours for ours, theirs in _ELSEWHERE.items() if name in theirs and ours in accepted), None)


def as_mapping(given: Mapping[str, Any] | RunConfig) -> dict[str, Any]:
    """A configuration, or a part of one, as plain values; bodies and settings may be the objects themselves.

    Example:
        >>> from neuralq.q import MLP
        >>> as_mapping({"env": "CartPole-v1", "body": MLP((8,))})["body"]["hidden"]
        (8,)
    """
    plain = (
        {f.name: getattr(given, f.name) for f in dataclasses.fields(given)} if isinstance(given, RunConfig) else given
    )
    return {name: _plain(value) for name, value in plain.items() if value is not None or name not in LEARNERS}


def _plain(value: Any) -> Any:
    if type(value) in BODIES.values():
        return body_to_dict(value)
    if type(value) in (kind.settings for kind in LEARNERS.values()):
        return dataclasses.asdict(value)
    return value


def nested(plain: Mapping[str, Any] | RunConfig, flat: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration's plain values with keyword arguments over them, settings of the learner in their place.

    Args:
        plain: of a configuration, or that itself.
        flat: fields of `RunConfig`, settings of the learner that runs, and `BODY_NAMES`, which `with_body` takes.

    Raises:
        ValueError: for names that are none of these, with the nearest; and what is given twice, here and there.

    Example:
        >>> nested({"env": "CartPole-v1"}, {"learner": "replay", "lambda_": 0.8})
        {'env': 'CartPole-v1', 'learner': 'replay', 'replay': {'lambda_': 0.8}}
    """
    fields, values = {f.name for f in dataclasses.fields(RunConfig)}, as_mapping(plain)
    flat = as_mapping(flat)
    learner = str(flat.get("learner", values.get("learner", RunConfig.learner)))
    if learner != values.get("learner", learner):  # its settings go with it
        values.pop(str(values["learner"]), None)
    kind = LEARNERS.get(learner)
    own = set() if kind is None else {f.name for f in dataclasses.fields(kind.settings)}
    values |= {name: value for name, value in flat.items() if name in fields or name in BODY_NAMES}
    mine = {name: value for name, value in flat.items() if name in own and name not in values}
    for name in flat:
        if name in own and name in (flat.get(learner) or {}):
            raise ValueError(f"{name} is given twice, by itself and in {learner}; leave one out")
        if name in own & fields:
            raise ValueError(
                f"{name} is a setting of the run and one of the {learner} learner; write {learner}={{{name!r}: …}} for "
                "the learner's, and leave the other to a mapping: neuralq.train({...})"
            )
        if name not in (fields | own | {*BODY_NAMES}) and kind is not None:  # a learner that is none is refused later
            raise ValueError(_unknown(name, flat[name], learner, fields | own | {*BODY_NAMES}))
    if mine:
        values[learner] = {**(values.get(learner) or {}), **mine}
    return values


def _unknown(name: str, value: Any, learner: str, accepted: set[str]) -> str:
    """What there is in place of a setting that there is not."""
    kind = LEARNERS[learner]
    everything = {"run_dir", "hooks", "preset", *accepted}
    others = [n for n, k in LEARNERS.items() if name in {f.name for f in dataclasses.fields(k.settings)}]
    close = difflib.get_close_matches(name, sorted(everything), 3)
    elsewhere = {f.name: n for n, k in LEARNERS.items() for f in dataclasses.fields(k.settings)}
    if (ours := called_here(name, everything)) is not None:
        hint = f"it is called {ours} here"
    elif (theirs := called_here(name, elsewhere)) is not None:
        hint = (
            f"it is called {theirs} here, and belongs to the {elsewhere[theirs]} learner: learner={elsewhere[theirs]!r}"
        )
    elif others:
        whose = " or ".join(others)
        hint = f"it belongs to the {whose} learner, and this is a {learner} run: add learner={others[0]!r}"
    elif close:
        hint = f"did you mean {' or '.join(close)}?"
    else:
        hint = f"an argument of the environment goes into env_kwargs={{{name!r}: {value!r}}}"
    return (
        f"there is no setting {name}; {hint} (accepted are the fields of neuralq.RunConfig and of "
        f"neuralq.learners.{kind.settings.__name__}, and {', '.join(BODY_NAMES)} of the network)"
    )


def with_body(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same, with `BODY_NAMES` in the body where they were given without it.

    Example:
        >>> with_body({"env": "CartPole-v1", "hidden": (8,)})["body"]
        {'class': 'MLP', 'hidden': (8,)}
    """
    short = {name: values[name] for name in BODY_NAMES if values.get(name) is not None}
    rest = {name: value for name, value in values.items() if name not in BODY_NAMES}
    if not short:
        return rest
    body = rest.get("body") or {}
    if isinstance(body, str):
        named = NAMED_BODIES.get(body)
        body = {"class": "Custom", "module": body} if named is None else body_to_dict(named)
    return {**rest, "body": {"class": "MLP", **body, **short} if isinstance(body, Mapping) else body}
