"""X4: probe environments, in which one thing alone can go wrong, for a training function of one's own.

Five are Andy Jones' (2021, "Debugging RL,
without the agonizing pain"): a constant reward (does the value learn at all?),
a reward that depends on the observation (does the network see it?), one that comes a step later (is it discounted?),
one
that depends on the action (is the better one found?), and one on both. Three are ours: a constant reward that is
truncated every few steps (Q = 1 / (1 − γ) if the limit is bootstrapped past), two states that look alike (Q is their
mean), and a reward that is noise (Q must not exceed 0, as a maximum over noisy values would).

Each has known values. The first probe that fails names what is broken, for each needs what those before it need.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from neuralq.doctor.findings import Cause, Finding
from neuralq.doctor.loading import load_subject
from neuralq.types import Array, Floats

__all__ = ["PROBES", "Probe", "ProbeEnv", "probe"]

GAMMA = 0.9
"""Discount of all probes; the training function reads it from ``env.gamma``."""
_TOLERANCE, _NOISE = 0.2, 0.5


@dataclass(frozen=True)
class Probe:
    """One environment and what its values are.

    Args:
        name: what is tried.
        length: steps of an episode.
        num_actions: A.
        sees: the observation at step t of an episode that drew x ∈ {−1, 1}.
        pays: the reward of the action a at step t.
        cut: whether the last step truncates, in place of terminating.
        values: Q of each observation in `asked`, ``[K, A]``; NaN where any value is right.
        asked: observations, ``[K, 1]``.
        cause: what a failure speaks for.
        says: what a failure means.
        remedy: where to look.
        above: whether only values above ``values`` are wrong.
    """

    name: str
    length: int
    num_actions: int
    sees: Callable[[int, float], float]
    pays: Callable[[int, float, int, np.random.Generator], float]
    values: Floats
    asked: Floats
    cause: Cause
    says: str
    remedy: str
    cut: bool = False
    above: bool = False


class ProbeEnv(gym.Env[Array, np.int64]):
    """The environment of a probe; ``gamma`` is the discount that its values are for.

    Args:
        probe: what it does.
    """

    def __init__(self, probe: Probe) -> None:
        self.probe, self.gamma = probe, GAMMA
        self.observation_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.action_space = spaces.Discrete(probe.num_actions)
        self.t, self.x = 0, 1.0

    def _seen(self) -> Array:
        return np.array([self.probe.sees(self.t, self.x)], np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """A new episode, which draws −1 or 1."""
        super().reset(seed=seed)
        self.t, self.x = 0, float(self.np_random.choice([-1.0, 1.0]))
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One step; the last of an episode ends the world, or is cut."""
        paid = self.probe.pays(self.t, self.x, int(action), self.np_random)
        self.t += 1
        last = self.t == self.probe.length
        return self._seen(), float(paid), last and not self.probe.cut, last and self.probe.cut, {}


_ANY = np.array([[-1.0], [1.0]])

PROBES: tuple[Probe, ...] = (
    Probe("a constant reward", 1, 1, lambda t, x: 0.0, lambda t, x, a, rng: 1.0, np.array([[1.0]]), np.array([[0.0]]),
          "algorithm", "the value of a constant is not learned: the loss or the optimiser is broken",
          "the loss, its sign, the step size, and whether the optimiser has the network's parameters"),
    Probe("a reward that the observation tells", 1, 1, lambda t, x: x, lambda t, x, a, rng: x, np.array([[-1.0],
    [1.0]]),
          _ANY, "representation", "the observation does not reach the value",
          "how observations are batched, scaled and handed to the network"),
    Probe("a reward that comes a step later", 2, 1, lambda t, x: float(t), lambda t, x, a, rng: float(t == 1),
          np.array([[GAMMA], [1.0]]), np.array([[0.0], [1.0]]), "algorithm", "values are not carried back a step",
          "the discount, the bootstrap, and the mask at the end of an episode"),
    Probe("a reward that the action decides", 1, 2, lambda t, x: 0.0, lambda t, x, a, rng: 2.0 * a - 1.0,
          np.array([[-1.0, 1.0]]), np.array([[0.0]]), "algorithm", "actions are not told apart",
          "which output is updated (the index of the action), and whether both actions are tried"),
    Probe("a reward that observation and action decide", 1, 2, lambda t, x: x, lambda t, x, a, rng: x * (2.0 * a - 1.0),
          np.array([[1.0, -1.0], [-1.0, 1.0]]), _ANY, "data", "actions are not matched with the observations they "
          "belong to",
          "whether the buffer keeps observation, action and reward of one step together"),
    Probe("a constant reward that is cut", 5, 1, lambda t, x: 0.0, lambda t, x, a, rng: 1.0,
          np.array([[1 / (1 - GAMMA)]]), np.array([[0.0]]), "algorithm", "a time limit is taken for the end of the "
          "world",
          "bootstrap past `truncated`; only `terminated` ends the return", cut=True),
    Probe("two states that look alike", 1, 1, lambda t, x: 0.0, lambda t, x, a, rng: x + 0.5, np.array([[0.5]]),
          np.array([[0.0]]), "algorithm", "the value is not the mean over what cannot be told apart",
          "the loss: only a squared one has the mean for its minimum", ),
    Probe("a reward that is noise", 2, 4, lambda t, x: float(t), lambda t, x, a, rng: float(rng.standard_normal()),
          np.zeros((2, 4)), np.array([[0.0], [1.0]]), "algorithm", "noise is taken for value: values are overestimated",
          "double Q-learning, a smaller step size, larger batches", above=True),
)  # fmt: skip


def probe(
    train: Callable[[gym.Env[Any, Any], int], Any],
    budget: int = 5_000,
    seed: int = 0,
    say: Callable[[str], None] = print,
) -> tuple[Finding, ...]:
    """Every probe on a training function.

    Args:
        train: ``train(env, budget) -> q``: from an environment and a number of its steps to a value function, as
            `load_subject` takes it. It should learn with the discount ``env.gamma``.
        budget: environment steps of each probe.
        seed: of the environments' first reset.
        say: told which probe comes next.

    Returns:
        A finding per probe, flagged where its values are off by more than 0.2 of their size (at least of 1); of the
        reward that is noise, above 0 by more than 0.5.

    Raises:
        CannotLoad: what it returns is no value function.

    Example:
        >>> mean = lambda env, budget: (lambda obs: np.ones((len(obs), env.action_space.n)))
        >>> [one.flagged for one in probe(mean, say=lambda text: None)][:2]
        [False, True]
    """
    found = []
    for number, one in enumerate(PROBES):
        say(f"probe {number + 1} of {len(PROBES)}: {one.name}")
        env = ProbeEnv(one)
        env.reset(seed=seed)
        subject = load_subject(train(env, budget))
        found.append(_judged(one, subject.values(one.asked.astype(np.float32))))
    return tuple(found)


def _judged(one: Probe, values: Floats) -> Finding:
    if values.shape != one.values.shape:
        raise ValueError(
            f"train must give values of shape {list(one.values.shape)} for {len(one.asked)} observations, got "
            f"{list(values.shape)}"
        )
    scale = max(float(np.abs(one.values).max()), 1.0)
    off = (values - one.values) / scale
    worst = float(off.max() if one.above else np.abs(off).max())
    allowed = _NOISE if one.above else _TOLERANCE
    wrong = not worst <= allowed  # NaN is wrong, too
    got, right = (np.array2string(v, precision=2, separator=", ") for v in (values, one.values))
    said = f"on {one.name} Q is {right} and was learned as {got}".replace("\n", "")
    return Finding(
        "X4", one.says if wrong else f"{one.name}: learned", one.cause, "A", worst, None, allowed,
        "own; the probes are Jones' (2021) and three of ours", wrong, said, f"look at: {one.remedy}",
        "neuralq probe your_module:train --budget 50000  # is it the budget?",
    )  # fmt: skip
