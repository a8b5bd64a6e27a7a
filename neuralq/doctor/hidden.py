"""Whether observations hide part of the state, by what the past tells beyond them.

Where an observation is a state, the step before it adds nothing. The gain

    max_j  R²(Δo_j or r | o, a, o⁻, a⁻) − R²(the same | o, a)

of regressions held out by episode is above zero where something that matters is hidden, as velocities are. Beside it
stands, as evidence and no more, how far TD(0) and Monte Carlo disagree on values of the random policy (λ-discrepancy,
Allen et al. 2024), which they do not where observations are states and the features can tell them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from neuralq.checks import check_discount, check_whole
from neuralq.doctor.estimates import held_out_r2, td_against_monte_carlo
from neuralq.doctor.play import Episode, play, returns_from
from neuralq.doctor.worlds import World, open_world
from neuralq.types import Array, Floats, Indices

__all__ = ["HiddenState", "gain_of_the_past", "hidden_state", "lambda_discrepancy"]

_MOST_ROWS, _MOST_WIDTH, _FEWEST_EPISODES = 4000, 200, 8
_NUM_SPLITS = 6
THRESHOLD = 0.10
"""Gains of CartPole, Acrobot and MountainCar lie below 0.01; without their velocities they are 0.67 and more."""
_SHORT = 0.9

Draws = Callable[[int], np.random.Generator]


@dataclass(frozen=True)
class HiddenState:
    """What the past tells beyond the observation.

    Args:
        gain: share of the variance of what comes next that the step before explains and the observation does not.
        low: two standard errors below, over divisions of the episodes into fitted and predicted ones.
        high: as much above.
        entry: of the next observation, which the gain is about; None where it is about the reward.
        discrepancy: how far TD(0) and Monte Carlo differ on values of random play, over the spread of its returns; None
            where there were too few returns.
    """

    gain: float
    low: float
    high: float
    entry: int | None
    discrepancy: float | None = None

    @property
    def hides(self) -> bool:
        """Whether something that matters is hidden for all that this can tell."""
        return self.low > THRESHOLD


def hidden_state(env: Any, num_episodes: int = 100, gamma: float = 0.9, seed: int = 0) -> HiddenState:
    """Whether an environment hides part of its state, from random play.

    It sees what random play meets and one step back: what is hidden for longer, or only where random play does not
    come, it does not find.

    Args:
        env: a Gymnasium id, an environment, a class or function that makes one, or a `neuralq.mdp.FiniteMDP`.
        num_episodes: of random play, at least 8 of which have to have three steps.
        gamma: γ of the values that TD(0) and Monte Carlo are compared by.
        seed: of every draw.

    Raises:
        ValueError: if the environment cannot be played, its episodes are too short or its observations too wide.

    Example:
        >>> found = hidden_state("neuralq/McCallumMaze-v0")
        >>> found.hides, hidden_state("neuralq/MitchellGrid-v0").hides
        (True, False)
    """
    check_whole("num_episodes", num_episodes)
    check_discount("gamma", gamma)
    world = open_world(env)

    def chance(s: Array, legal: Array, rng: np.random.Generator) -> tuple[Indices, Floats]:
        drawn: Indices = np.where(legal, rng.random(legal.shape), -1.0).argmax(1)
        return drawn, np.full(legal.shape, np.nan)

    def draws(number: int) -> np.random.Generator:
        return np.random.default_rng([seed, number])

    episodes = play(world, chance, num_episodes, seed, seconds=60.0)
    found = gain_of_the_past(world, episodes, draws)
    return HiddenState(
        found.gain, found.low, found.high, found.entry, lambda_discrepancy(world, episodes, gamma, draws)
    )


def gain_of_the_past(world: World, episodes: Sequence[Episode], draws: Draws) -> HiddenState:
    """The gain, with an interval over six divisions of the episodes into fitted and predicted ones.

    Args:
        world: of the episodes.
        episodes: of any policies; those of fewer than three steps are left out.
        draws: a generator for a number, which belongs to one purpose.

    Raises:
        ValueError: if there are too few episodes, or observations are too wide.
    """
    now, past, ahead, names = _rows(world, episodes, draws(6))
    gains = []
    for k in range(_NUM_SPLITS):
        alone = held_out_r2(now, ahead, names, draws(600 + k))
        more = held_out_r2(np.concatenate([now, past], axis=1), ahead, names, draws(600 + k))
        gains.append(more - np.maximum(alone, 0.0))
    by_column = np.array(gains)  # [6, k]
    worst = int(by_column.mean(0).argmax())
    gain, spread = float(by_column[:, worst].mean()), float(by_column[:, worst].std(ddof=1))
    return HiddenState(gain, gain - 2 * spread, gain + 2 * spread, None if worst == ahead.shape[1] - 1 else worst)


def lambda_discrepancy(world: World, episodes: Sequence[Episode], gamma: float, draws: Draws) -> float | None:
    """How far TD(0) and Monte Carlo differ on the values of whoever played, at a discount whose returns are soon known.

    Args:
        world: of the episodes.
        episodes: of one policy.
        gamma: γ; at most 0.9 is used.
        draws: as for `gain_of_the_past`.

    Returns:
        Over the spread of the returns; None where fewer than a hundred are known or all are the same.
    """
    gamma, rows = min(gamma, _SHORT), []
    for one in episodes:
        g = returns_from(one, gamma, 0.05)
        n = len(g)
        o = world.as_rows(one.observations[: n + 1])
        rows.append((o[:n], one.rewards[:n], o[1:], np.arange(n) == (one.length - 1 if one.terminated else -1), g))
    x, r, x_t, ended, g = (np.concatenate(part)[:_MOST_ROWS] for part in zip(*rows, strict=True))
    if len(g) < 100 or g.std() == 0:
        return None
    return td_against_monte_carlo(x, r, x_t, ended, g, gamma, draws(606))


def _rows(world: World, episodes: Sequence[Episode], rng: np.random.Generator) -> tuple[Floats, Floats, Floats, Array]:
    """What is seen now, what was before, what comes, and of which episode it is."""
    episodes = [one for one in episodes if one.length >= 3]
    if len(episodes) < _FEWEST_EPISODES:
        raise ValueError(f"it takes {_FEWEST_EPISODES} episodes of at least 3 steps, there were {len(episodes)}")
    width = world.as_rows(episodes[0].observations[:1]).shape[1]
    if width > _MOST_WIDTH:
        raise ValueError(f"observations of {width:,} numbers; up to {_MOST_WIDTH} are regressed on")
    actions = np.eye(world.num_actions)
    now, past, ahead, names = [], [], [], []
    each = max(5, _MOST_ROWS // len(episodes))
    for i, one in enumerate(episodes):
        o = world.as_rows(one.observations)
        t = np.sort(rng.permutation(np.arange(1, one.length))[:each])
        now.append(np.concatenate([o[t], actions[one.actions[t]]], axis=1))
        past.append(np.concatenate([o[t - 1], actions[one.actions[t - 1]]], axis=1))
        ahead.append(np.concatenate([o[t + 1] - o[t], one.rewards[t, None]], axis=1))
        names.append(np.full(len(t), i))
    found = tuple(np.concatenate(part) for part in (now, past, ahead, names))
    return found[0], found[1], found[2], found[3]
