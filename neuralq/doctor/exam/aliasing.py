"""E6: does the past tell more about what comes next than the present observation does?

Where an observation is a state, the step before it adds nothing. The gain

    max_j  R²(Δo_j or r | o, a, o⁻, a⁻) − R²(the same | o, a)

of regressions held out by episode is above zero where something that matters is hidden, as velocities are. Beside it
stands, as evidence and no more, how far TD(0) and Monte Carlo disagree on values of the random policy, which they do
not where observations are states and the features can tell them.
"""

from __future__ import annotations

import numpy as np

from neuralq.doctor.estimates import held_out_r2, td_against_monte_carlo
from neuralq.doctor.exam.case import CannotMeasure, Case
from neuralq.doctor.findings import Finding
from neuralq.doctor.play import returns_from
from neuralq.types import Array, Floats

__all__ = ["aliasing"]

_MOST_ROWS, _MOST_WIDTH, _FEWEST_EPISODES = 4000, 200, 8
_THRESHOLD = 0.10
_SHORT = 0.9


def aliasing(case: Case) -> Finding:
    """E6: the gain, with an interval over six divisions of the episodes into fitted and predicted ones."""
    rows = _rows(case)
    now, past, ahead, names = rows
    gains = []
    for k in range(6):
        alone = held_out_r2(now, ahead, names, case.rng(600 + k))
        more = held_out_r2(np.concatenate([now, past], axis=1), ahead, names, case.rng(600 + k))
        gains.append(more - np.maximum(alone, 0.0))
    by_column = np.array(gains)  # [6, k]
    worst = int(by_column.mean(0).argmax())
    gain, spread = float(by_column[:, worst].mean()), float(by_column[:, worst].std(ddof=1))
    low, high = gain - 2 * spread, gain + 2 * spread
    what = "the reward" if worst == ahead.shape[1] - 1 else f"entry {worst} of the next observation"
    said = (
        f"the step before tells {100 * max(gain, 0):.0f} % more of the variance of {what} than the observation alone: "
        + ("something that matters is hidden" if low > _THRESHOLD else "nothing that matters is hidden")
        + _second_opinion(case)
    )
    return Finding(
        "E6", "observations hide part of the state", "environment", "B", gain, (low, high), _THRESHOLD,
        "our own, of CartPole, Acrobot and MountainCar with and without velocities", low > _THRESHOLD, said,
        "give the agent what is hidden: velocities, or the last observations stacked (FrameStackObservation)",
        "env = gymnasium.wrappers.FlattenObservation(gymnasium.wrappers.FrameStackObservation(env, 2))  # and train "
        "again",
    )  # fmt: skip


def _second_opinion(case: Case) -> str:
    """What TD(0) and Monte Carlo say of the random policy, at a discount whose returns are soon known."""
    gamma, rows = min(case.gamma, _SHORT), []
    for one in case.chance:
        g = returns_from(one, gamma, 0.05)
        n = len(g)
        o = case.world.as_rows(one.observations[: n + 1])
        rows.append((o[:n], one.rewards[:n], o[1:], np.arange(n) == (one.length - 1 if one.terminated else -1), g))
    x, r, x_t, ended, g = (np.concatenate(part)[:_MOST_ROWS] for part in zip(*rows, strict=True))
    if len(g) < 100 or g.std() == 0:
        return ""
    apart = td_against_monte_carlo(x, r, x_t, ended, g, gamma, case.rng(606))
    return f"; TD(0) and Monte Carlo differ by {100 * apart:.2g} % of the spread of returns of random play"


def _rows(case: Case) -> tuple[Floats, Floats, Floats, Array]:
    """What is seen now, what was before, what comes, and of which episode it is."""
    episodes = [one for one in (*case.explored, *case.chance, *case.greedy[:20]) if one.length >= 3]
    if len(episodes) < _FEWEST_EPISODES:
        raise CannotMeasure(f"it takes {_FEWEST_EPISODES} episodes of at least 3 steps, there were {len(episodes)}")
    if case.width > _MOST_WIDTH:
        raise CannotMeasure(f"observations of {case.width:,} numbers; up to {_MOST_WIDTH} are regressed on")
    actions = np.eye(case.world.num_actions)
    now, past, ahead, names = [], [], [], []
    each = max(5, _MOST_ROWS // len(episodes))
    rng = case.rng(6)
    for i, one in enumerate(episodes):
        o = case.world.as_rows(one.observations)
        t = np.sort(rng.permutation(np.arange(1, one.length))[:each])
        now.append(np.concatenate([o[t], actions[one.actions[t]]], axis=1))
        past.append(np.concatenate([o[t - 1], actions[one.actions[t - 1]]], axis=1))
        ahead.append(np.concatenate([o[t + 1] - o[t], one.rewards[t, None]], axis=1))
        names.append(np.full(len(t), i))
    found = tuple(np.concatenate(part) for part in (now, past, ahead, names))
    return found[0], found[1], found[2], found[3]
