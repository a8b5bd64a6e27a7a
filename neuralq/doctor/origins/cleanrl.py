"""Models of CleanRL: a state dict of ``network.N``, or of C51 a dictionary of the weights and the arguments."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from neuralq.doctor.networks import FromFrames, stack, under
from neuralq.doctor.origins.record import Origin
from neuralq.doctor.subject import Settings, Subject, of_network, plain_outputs
from neuralq.doctor.weights import CannotLoad, plain_bytes, read_state

__all__ = ["CLEANRL", "of_state"]


def _load(path: Path, net: str | None, env: Any) -> Subject:
    if net is not None:
        raise CannotLoad(f"{path} is a model of CleanRL, whose network follows from its weights; leave --net out")
    return of_state(read_state(plain_bytes(path), str(path)), path)


def of_state(state: Mapping[Any, Any], path: Path) -> Subject:
    """The subject in a dictionary that CleanRL saved.

    Raises:
        CannotLoad: a key or shape that does not fit.
    """
    given = state.get("args")
    weights = state.get("model_weights", state)
    if not isinstance(weights, Mapping):
        raise CannotLoad(f"{path}: model_weights must be a state dict, got {type(weights).__name__}")
    foreign = [key for key in weights if not str(key).startswith("network.") and key != "atoms"]
    if foreign:
        raise CannotLoad(
            f"{path} has the key {foreign[0]!r}, which CleanRL's DQN and C51 lack; pass --net module:Class"
        )
    layers = under(weights, "network.")
    network: nn.Module = stack(layers, f"{path}: network")
    first = next(iter(network.children()))
    if isinstance(first, nn.Conv2d):  # its forward divides bytes by 255 first
        network = FromFrames(cast(nn.Sequential, network), nn.Sequential(), nn.Sequential(), 255.0).eval()
    atoms = weights.get("atoms")
    outputs = plain_outputs if atoms is None else _expected(cast(Tensor, atoms).detach().float())
    kind = "DQN" if atoms is None else "C51"
    settings = _settings(given if isinstance(given, Mapping) else {})
    return of_network(network, f"{kind} of CleanRL ({path.name})", outputs=outputs, settings=settings)


def _expected(atoms: Tensor) -> Any:
    def outputs(network: nn.Module, x: Tensor) -> Tensor:
        """CleanRL lays atoms out within actions: ``[N, A·K] -> [N, A, K]``."""
        probabilities = torch.softmax(cast(Tensor, network(x)).reshape(len(x), -1, len(atoms)), dim=2)
        return (probabilities * atoms).sum(2)

    return outputs


def _settings(given: Mapping[Any, Any]) -> Settings:
    def number(name: str) -> float | None:
        value = given.get(name)
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None

    steps, every = number("total_timesteps"), number("train_frequency")
    updates = None if not steps or not every else max(steps - (number("learning_starts") or 0.0), 0.0) / every
    interval = number("target_network_frequency")  # in environment steps
    share = number("exploration_fraction")
    return Settings(
        gamma=number("gamma"), learning_rate=number("learning_rate"), tau=number("tau"), num_steps=1.0, lambda_=0.0,
        target_period_updates=None if interval is None or not every else max(interval / every, 1e-9), updates=updates,
        env_steps=steps, batch_size=number("batch_size"), capacity=number("buffer_size"),
        epsilon_start=number("start_e"), epsilon_end=number("end_e"),
        epsilon_decay_steps=share * steps if share and steps else None, learning_starts=number("learning_starts"),
    )  # fmt: skip


CLEANRL = Origin("a model of CleanRL", lambda path: path.suffix == ".cleanrl_model", _load, place=2)
