"""What a policy is worth, by experience of others: fitted Q evaluation (Le, Voloshin & Yue, 2019).

Q ← regression of r + γ Q(s′, π(s′)) on (s, a), over and over. Where states are finite the regression is a table of
means and the fixed point is solved for: it is v^π of the empirical model, the world in which what was recorded is all
that happens, exactly. Elsewhere the run's own representation is fitted, from new weights, by steps of an optimiser.

An action that nobody took where the policy would take it is worth 0 in a table, and whatever the fit says in a network:
how often that happens is told.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import splu

from neuralq.learners import ReplaySettings
from neuralq.learners.descent import Descent
from neuralq.learners.optim import Optimiser
from neuralq.q.compiled import make_engine
from neuralq.q.engine import Engine, Loss
from neuralq.runs.agent import Agent
from neuralq.runs.loop import seed_for
from neuralq.runs.offline.playback import rows_of
from neuralq.runs.offline.recorded import Recorded
from neuralq.runs.recipe.build import build_q
from neuralq.runs.recipe.config import RunConfig
from neuralq.runs.stream.acting import choose_greedy
from neuralq.types import Array, Floats, Indices

__all__ = ["PolicyEstimate", "estimate_policy", "fitted_values", "table_values"]

_RESAMPLES = 200
_BATCH = 128
_UPDATES = 50
_MOST_ITERATIONS = 500


@dataclass(frozen=True)
class PolicyEstimate:
    """Discounted value of a policy at the beginning of episodes, estimated from recorded ones.

    Args:
        value: mean over the recorded episodes' first states, in units of the environment's rewards.
        low: lower end of a 95 % interval; None of one episode.
        high: upper end.
        interval: what the interval is over.
        method: how it was estimated.
        unseen_share: share of states, successors and first ones, in which the policy's action was never recorded; None
            where states are not finite.
        num_steps: steps that were used.
        num_episodes: of so many episodes.
        gamma: γ.
    """

    value: float
    low: float | None
    high: float | None
    interval: str
    method: str
    unseen_share: float | None
    num_steps: int
    num_episodes: int
    gamma: float

    def plain(self) -> dict[str, Any]:
        """The same as plain values, for JSON."""
        return dataclasses.asdict(self)

    def lines(self) -> list[str]:
        """The same for people."""
        around = "" if self.low is None else f", 95 % interval {self.low:.4g} to {self.high:.4g} ({self.interval})"
        lines = [
            f"discounted value of the greedy policy {self.value:.4g}{around}",
            f"fitted Q evaluation by {self.method} over {self.num_steps:,} steps in {self.num_episodes:,} episodes, "
            f"γ = {self.gamma:g}",
        ]
        if self.unseen_share:
            lines.append(f"in {self.unseen_share:.0%} of the states that were reached nobody has taken its action")
        return lines


def estimate_policy(agent: Agent, config: RunConfig, data: Recorded, seed: int = 0) -> PolicyEstimate:
    """What an agent's greedy policy is worth by recorded experience.

    Args:
        agent: of a run.
        config: of the run: γ and the representation.
        data: steps in the run's environment.
        seed: of resampling, and of new weights.

    Raises:
        ValueError: if the data are not of the run's environment; or, with γ = 1, hold no end that the policy comes to.
    """
    if agent.spec.masked:
        raise ValueError("a data set says nothing of illegal actions, and this environment masks some; play it instead")
    rows = rows_of(data, agent.encoder, agent.first_action, agent.spec.num_actions, config.gamma)
    firsts = np.append(True, data.ends[:-1])
    starts = agent.encoder.encode(data.observations[firsts])
    rng = np.random.default_rng(seed_for(seed, 15))
    common: dict[str, Any] = {"num_steps": len(rows[1]), "num_episodes": data.num_episodes, "gamma": config.gamma}
    if agent.spec.num_categories is not None:
        found = _by_table(agent, rows, starts, data.episodes[data.known], rng)
        return PolicyEstimate(**found, interval="episodes, resampled", method="a table, solved for", **common)
    values = _by_network(agent, config, rows, starts, rng, seed) / config.reward_scale
    spread = 1.96 * float(np.std(values, ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else None
    mean = float(values.mean())
    return PolicyEstimate(
        mean, None if spread is None else mean - spread, None if spread is None else mean + spread,
        "the first states; not the fit", "the run's representation, fitted anew", None, **common,
    )  # fmt: skip


def _policy(agent: Agent, s: Array) -> Indices:
    seen = s if agent.normalisation is None else agent.normalisation.observe(s)
    device = next(iter(agent.q.parameters())).device  # type: ignore[attr-defined]
    with torch.no_grad():
        chosen: Indices = choose_greedy(agent.q.all(torch.from_numpy(seen).to(device)))[0].cpu().numpy()
    return chosen


def _by_table(agent: Agent, rows: tuple[Array, ...], starts: Array, episodes: Array, rng: np.random.Generator) -> Any:
    num_states, num_actions = int(agent.spec.num_categories or 0), agent.spec.num_actions
    s_tm1, a_tm1, _, r_t, discount_t, s_t, _ = rows
    policy = _policy(agent, np.arange(num_states))
    at, num = a_tm1 == policy[s_tm1], len(starts)  # Q of what the policy does not do is not asked for
    steps = (s_tm1[at], r_t[at], discount_t[at], s_t[at])

    def value(counts: Floats | None) -> float:
        weight = np.ones(at.sum()) if counts is None else counts[episodes[at]]
        return float(np.average(table_values(num_states, *steps, weight)[starts], weights=counts))

    draws = [value(np.bincount(rng.integers(num, size=num), minlength=num).astype(float)) for _ in range(_RESAMPLES)]
    low, high = np.percentile(draws, (2.5, 97.5)).tolist() if num > 1 else (None, None)
    taken = np.zeros((num_states, num_actions), bool)
    taken[s_tm1, a_tm1] = True
    reached = np.concatenate([s_t[discount_t > 0], starts])
    unseen = float(1 - taken[reached, policy[reached]].mean())
    return {"value": value(None), "low": low, "high": high, "unseen_share": unseen}


def table_values(
    num_states: int, s_tm1: Array, r_t: Floats, discount_t: Floats, s_t: Array, weight: Floats | None = None
) -> Floats:
    """V of the chain that these steps are of: the mean of r + γ v(s′) in each state, 0 where there is none.

    Args:
        num_states: S.
        s_tm1: states that were left by the policy's action ``[M]``.
        r_t: rewards ``[M]``.
        discount_t: γ, or 0 where the world ended ``[M]``.
        s_t: successors ``[M]``.
        weight: how often each step counts ``[M]``; None for once.

    Raises:
        ValueError: if it never ends and nothing is discounted.

    Example:
        >>> v = table_values(2, np.array([0, 0]), np.array([1.0, 3.0]), np.array([0.5, 0.0]), np.array([0, 1]))
        >>> v.round(3).tolist()
        [2.667, 0.0]
    """
    weight = np.ones(len(s_tm1)) if weight is None else weight
    total = np.bincount(s_tm1, weight, num_states)
    share = weight / np.where(total > 0, total, 1)[s_tm1]
    rewards = np.bincount(s_tm1, share * r_t, num_states)
    moves = sparse.csc_array((share * discount_t, (s_tm1, s_t)), shape=(num_states, num_states))
    try:
        values: Floats = splu(sparse.csc_array(sparse.eye_array(num_states) - moves)).solve(rewards)
    except RuntimeError as error:
        raise ValueError("with γ = 1 the policy must come to an end, and in these data it never does") from error
    return values


def _by_network(
    agent: Agent, config: RunConfig, rows: tuple[Array, ...], starts: Array, rng: np.random.Generator, seed: int
) -> Floats:
    plain: dict[str, Any] = {
        "learner": "replay",
        config.learner: None,
        "replay": ReplaySettings(),
        "dataset": None,
        "engine": "auto",
    }
    fresh: Any = dataclasses.replace(config, **plain)
    q: Any = build_q(fresh, agent.spec, np.random.default_rng(seed_for(seed, 16)))
    chosen = _policy(agent, rows[5]), _policy(agent, starts)
    if agent.normalisation is not None:
        rows = (agent.normalisation.observe(rows[0]), *rows[1:5], agent.normalisation.observe(rows[5]), rows[6])
        starts = agent.normalisation.observe(starts)
    scaled = (rows[0], rows[1], rows[3] * config.reward_scale, rows[4], rows[5])
    return fitted_values(make_engine(q, Loss("huber")), scaled, chosen[0], starts, chosen[1], config.gamma, rng)


def fitted_values(
    engine: Engine, rows: tuple[Array, ...], a_t: Indices, starts: Array, a_0: Indices, gamma: float,
    rng: np.random.Generator, learning_rate: float = 1e-3,
) -> Floats:  # fmt: skip
    """Values of a policy in some states, by fitted iteration with an engine.

    Args:
        engine: of the representation, with the loss in it; changed in place.
        rows: observations, actions, rewards, discounts and successors ``[M, …]``.
        a_t: the policy's actions in the successors ``[M]``.
        starts: states whose values are wanted ``[K, *obs]``.
        a_0: the policy's actions there ``[K]``.
        gamma: γ, by which it is decided how many iterations there are.
        rng: draws the batches.
        learning_rate: of Adam.

    Returns:
        ``[K]`` float64.
    """
    s_tm1, a_tm1, r_t, discount_t, s_t = (torch.from_numpy(np.ascontiguousarray(row)) for row in rows)
    dtype, count = engine.flat.values.dtype, len(a_tm1)
    followed = torch.from_numpy(a_t)
    descent = Descent(engine, Optimiser("adam"), learning_rate, max_grad_norm=10.0)
    until_small = (
        math.ceil(math.log(0.01) / math.log(gamma)) if 0 < gamma < 1 else 1 if gamma == 0 else _MOST_ITERATIONS
    )
    for _ in range(min(_MOST_ITERATIONS, until_small)):
        engine.sync_target()
        for at in torch.from_numpy(rng.integers(count, size=(_UPDATES, min(_BATCH, count)))):
            follow = engine.all(s_t[at], target=True).gather(-1, followed[at][:, None])[:, 0]
            targets = r_t[at].to(dtype) + discount_t[at].to(dtype) * follow
            engine.loss_gradient(s_tm1[at], a_tm1[at], targets)
            descent.step()
    found = engine.all(torch.from_numpy(starts)).gather(-1, torch.from_numpy(a_0)[:, None])[:, 0]
    return found.double().numpy()
