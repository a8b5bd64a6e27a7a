"""neuralq's own run folders."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.doctor.origins.record import Origin
from neuralq.doctor.origins.stored_replay import rescaled, stored_replay
from neuralq.doctor.subject import Settings, Subject, of_network
from neuralq.doctor.weights import CannotLoad
from neuralq.q import MaskedQ
from neuralq.runs import load
from neuralq.runs.agent import Agent
from neuralq.runs.folder.run_folder import is_run_folder, read_config, read_metrics
from neuralq.runs.recipe.config import RunConfig, config_from_dict
from neuralq.runs.recipe.stand_in import nameless
from neuralq.types import Array

__all__ = ["NEURALQ_RUN", "of_agent", "settings_of_run"]


def _load(path: Path, net: str | None, env: Any) -> Subject:
    if net is not None:
        raise CannotLoad(f"{path} is a run folder, which says itself what its network is; leave --net out")
    try:
        agent = load(path, env=env if nameless(str(read_config(path).get("env"))) else None)
    except (RuntimeError, ValueError) as error:
        raise CannotLoad(f"cannot load the run {path}: {error}") from error
    if not isinstance(agent, Agent):
        raise CannotLoad(f"{path} is a run of {type(agent).__name__}, whose moves are no actions of an environment")
    return of_agent(agent)


def of_agent(agent: Agent) -> Subject:
    """The subject that an agent of neuralq is, with what the folder of its run says.

    Raises:
        CannotLoad: there are action masks, and they are not around its values but inside.
    """
    if agent.spec.memory_size:
        raise CannotLoad(
            "this agent remembers, and the doctor examines functions of the present observation; neuralq report shows "
            "how its run went"
        )
    network = agent.q.inner if isinstance(agent.q, MaskedQ) else agent.q
    if agent.spec.masked and network is agent.q:
        raise CannotLoad(f"a {type(agent.q).__name__} with action masks inside it is not taken apart")

    def encode(observations: Array) -> Tensor:
        composite = bool(agent.encoder.parts[0].keys)  # which come flat
        encoded = rescaled(agent, observations) if composite else np.asarray(agent.encoder.encode(observations))
        if agent.normalisation is not None:
            encoded = agent.normalisation.observe(encoded)
        return torch.from_numpy(encoded)

    def outputs(network: nn.Module, x: Tensor) -> Tensor:
        given: Tensor = network.all(x)  # type: ignore[operator]
        return given

    assert isinstance(network, nn.Module)
    told: dict[str, Any] = {"settings": Settings(reward_scale=agent.reward_scale)}
    origin, path, replay = "an agent of neuralq", agent.run_dir, None
    if path is not None and is_run_folder(path):
        config, origin = config_from_dict(read_config(path)), f"neuralq run {path}"
        named = {name: getattr(config, name) for name in ("env", "env_kwargs", "wrappers", "frame_stack")}
        told = {
            "settings": _settings(config, path, agent.reward_scale),
            "env": None if nameless(config.env) else named,
        }
        replay = functools.partial(stored_replay, path, agent, config.gamma)
    subject = of_network(
        network, origin, encode=encode, outputs=outputs, num_actions=agent.spec.num_actions,
        first_action=agent.first_action, **told,
    )  # fmt: skip
    return replace(subject, replay=replay)


def _settings(config: RunConfig, path: Path, reward_scale: float) -> Settings:
    rows = [row for row in read_metrics(path) if isinstance(row.get("env_steps"), int)]
    return settings_of_run(config, float(max((row["env_steps"] for row in rows), default=0)) or None, reward_scale)


def settings_of_run(config: RunConfig, env_steps: float | None, reward_scale: float | None = None) -> Settings:
    """How a run was trained, or will have been, after so many steps.

    Args:
        config: of the run.
        env_steps: environment steps; None where that is not known.
        reward_scale: as `Settings` has it.

    Example:
        >>> settings_of_run(RunConfig(learner="rollout"), 1000.0).lambda_
        0.65
    """
    own = config.settings
    traits = config.kind.traits(own)
    per_step = getattr(own, "updates_per_period", 1) / getattr(own, "train_period", 1)
    learned = None if env_steps is None else max(env_steps - getattr(own, "learning_starts", 0), 0)
    epsilon = (None, None) if getattr(own, "noisy", False) else (config.epsilon_start, config.epsilon_end)
    capacity, batch, starts = (getattr(own, name, None) for name in ("capacity", "batch_size", "learning_starts"))
    return Settings(
        gamma=config.gamma,
        learning_rate=traits.step_size,
        num_steps=float(getattr(own, "num_steps", 1)) if traits.replay else 1.0,
        lambda_=traits.lambda_,
        target_period_updates=float(traits.target_period or 1),
        updates=None if learned is None else learned * per_step,
        env_steps=env_steps,
        batch_size=None if batch is None else float(batch),
        capacity=None if capacity is None else float(capacity),
        epsilon_start=epsilon[0],  # not known where noisy layers explore
        epsilon_end=epsilon[1],
        epsilon_decay_steps=float(config.epsilon_decay_steps),
        learning_starts=None if starts is None else float(starts),
        reward_scale=reward_scale,
    )


NEURALQ_RUN = Origin("a neuralq run folder", is_run_folder, _load, place=0)
