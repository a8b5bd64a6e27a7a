"""What is examined: action values of any origin, with what is known of how they were learned."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.doctor.weights import CannotLoad
from neuralq.types import Array, Floats

__all__ = ["Settings", "Subject", "of_callable", "of_network", "plain_outputs", "with_settings"]

_AT_ONCE = 1024  # observations of a forward pass


@dataclass(frozen=True)
class Settings:
    """How a subject was trained, as far as its file or its owner says; None is unknown.

    Args:
        gamma: γ.
        learning_rate: the last one.
        tau: share of the online weights in each copy into the target network; 1 copies whole.
        num_steps: n of n-step targets.
        lambda_: λ of λ-returns; 0 for one-step targets.
        target_period_updates: updates between copies into the target network; 1 without one.
        updates: gradient steps in all.
        env_steps: environment steps in all.
        batch_size: transitions per update.
        capacity: transitions that were stored at most.
        epsilon_start: exploration at the first step.
        epsilon_end: exploration at the end.
        epsilon_decay_steps: environment steps over which it falls.
        learning_starts: environment steps before the first update.
        reward_scale: by which rewards were multiplied for learning, values being divided by it again.
    """

    gamma: float | None = None
    learning_rate: float | None = None
    tau: float | None = None
    num_steps: float | None = None
    lambda_: float | None = None
    target_period_updates: float | None = None
    updates: float | None = None
    env_steps: float | None = None
    batch_size: float | None = None
    capacity: float | None = None
    epsilon_start: float | None = None
    epsilon_end: float | None = None
    epsilon_decay_steps: float | None = None
    learning_starts: float | None = None
    reward_scale: float | None = None

    @property
    def steps_of_reach(self) -> float | None:
        """How many steps ahead rewards can have been carried into the values: n K.

        Example:
            >>> Settings(target_period_updates=500, updates=5_000).steps_of_reach
            10.0
        """
        if self.updates is None or self.target_period_updates is None:
            return None
        copies = self.updates / self.target_period_updates
        if self.tau is not None and self.tau < 1:
            copies *= self.tau
        else:
            copies = math.ceil(copies - 1e-9)
        ahead = max(self.num_steps or 1.0, 1.0 / max(1.0 - (self.lambda_ or 0.0), 1e-6))
        return float(copies * ahead)


def with_settings(settings: Settings, changes: Mapping[str, Any]) -> Settings:
    """Settings with what their owner says put in place of what the file says.

    Raises:
        ValueError: for a name that is none, or a value that is no number.

    Example:
        >>> with_settings(Settings(gamma=0.9), {"lr": 0.01}).learning_rate
        0.01
    """
    known = {one.name for one in fields(Settings)}
    short = {"lr": "learning_rate", "lambda": "lambda_", "buffer_size": "capacity", "n_steps": "num_steps"}
    given: dict[str, float] = {}
    for name, value in changes.items():
        full = short.get(name, name)
        if full not in known:
            raise ValueError(f"there is no setting {name!r}; there are {', '.join(sorted(known | set(short)))}")
        try:
            number = float(value)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name} must be a number, got {value!r}") from error
        if not (math.isfinite(number) and number >= 0):
            raise ValueError(f"{name} must be a finite number of at least 0, got {value!r}")
        given[full] = number
    return replace(settings, **given)


@dataclass(frozen=True, eq=False)
class Subject:
    """A value function and where it comes from.

    Args:
        origin: in words, for reports.
        values: batches of observations as the environment gives them, ``[N, *obs]``, to ``[N, A]`` in the units of the
            environment's return.
        settings: how it was trained.
        network: the module behind it, if there is one.
        encode: observations to what the network takes.
        outputs: the network and what it takes, to action values ``[N, A]`` (before ``reward_scale`` is divided out).
        target: the target network that was saved with it.
        first_action: the environment's name of action 0; None where the file does not say.
        num_actions: A; None where only a call tells.
        env: the environment that it was trained in, where the file names it.
        siblings: greedy returns of runs with the same settings and other seeds, its own among them; empty where it was
            given alone.
        replay: reads the experience that was stored with it, as the columns of ``data``; None where there is none.
    """

    origin: str
    values: Callable[[Array], Floats]
    settings: Settings = field(default_factory=Settings)
    network: nn.Module | None = None
    encode: Callable[[Array], Tensor] | None = None
    outputs: Callable[[nn.Module, Tensor], Tensor] | None = None
    target: nn.Module | None = None
    first_action: int | None = None
    num_actions: int | None = None
    env: Any = None
    siblings: tuple[float, ...] = ()
    replay: Callable[[], dict[str, Array] | None] | None = None


def plain_outputs(network: nn.Module, x: Tensor) -> Tensor:
    """What the module gives: ``[N, A]``."""
    return cast(Tensor, network(x))


def as_float_tensor(observations: Array) -> Tensor:
    """Observations as float32, as most libraries hand them to a network."""
    return torch.as_tensor(np.ascontiguousarray(observations, np.float32))


def of_network(
    network: nn.Module,
    origin: str,
    *,
    encode: Callable[[Array], Tensor] = as_float_tensor,
    outputs: Callable[[nn.Module, Tensor], Tensor] = plain_outputs,
    settings: Settings | None = None,
    target: nn.Module | None = None,
    num_actions: int | None = None,
    first_action: int | None = None,
    env: Any = None,
) -> Subject:
    """A subject that is a PyTorch module.

    Args:
        network: ``[N, *obs] -> [N, A]``, by ``outputs``; it is put into evaluation mode and never changed.
        origin: in words.
        encode: as for `Subject`.
        outputs: as for `Subject`.
        settings: as for `Subject`.
        target: as for `Subject`.
        num_actions: as for `Subject`.
        first_action: as for `Subject`.
        env: as for `Subject`.

    Example:
        >>> of_network(nn.Linear(4, 2), "a module").values(np.zeros((3, 4))).shape
        (3, 2)
    """
    known = settings or Settings()
    scale = known.reward_scale or 1.0
    network.eval()

    def values(observations: Array) -> Floats:
        found = []
        with torch.no_grad():
            for begin in range(0, len(observations), _AT_ONCE):
                found.append(outputs(network, encode(observations[begin : begin + _AT_ONCE])).double().cpu().numpy())
        return np.concatenate(found) / scale

    return Subject(origin, values, known, network, encode, outputs, target, first_action, num_actions, env)


def of_callable(function: Callable[[Array], Any], origin: str = "a function") -> Subject:
    """A subject that is a function of observations ``[N, *obs]`` to action values ``[N, A]``.

    Example:
        >>> of_callable(lambda obs: np.zeros((len(obs), 2))).values(np.zeros((3, 4))).shape
        (3, 2)
    """

    def values(observations: Array) -> Floats:
        given = function(observations)
        if isinstance(given, Tensor):
            given = given.detach().cpu().numpy()
        found = np.asarray(given, np.float64)
        if found.ndim != 2 or len(found) != len(observations):
            raise CannotLoad(
                f"the function must give action values [N, A] of observations [N, ...]; of {len(observations)} "
                f"observations it gave the shape {list(found.shape)}"
            )
        return found

    return Subject(origin, values)
