"""Training by TD(λ) over the schedules that repairs lead to, and everything that it is compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_fraction, check_positive, check_whole
from neuralq.learners.afterstates import ValueNetwork, learn_afterstates, new_value_network
from neuralq.systems.job_shop.kernels import ANNEALED, GREEDY, LEARNED, RANDOM, repair_all
from neuralq.tabular.kernels.random_numbers import Seed, new_stream
from neuralq_envs.job_shop.kernels import NUM_FEATURES
from neuralq_envs.job_shop.problem import JobShop, new_plan, new_repairs

__all__ = ["CHOOSERS", "STEP_COST", "Repaired", "Settings", "Training", "list_schedule", "repair", "train"]

STEP_COST = 0.001
CHOOSERS = {"learned": LEARNED, "least TRUI": GREEDY, "random": RANDOM, "IR-V": ANNEALED}

_COOLING = np.array([50.0, 0.95, 5.0])  # of IR-V: in units of excess; colder it may stay where every repair adds some
_MOST_REPAIRS_PER_TASK = 20
_NUM_SCORES = 25  # how often validation looks, in the second half of a training
_NO_NETWORK = new_value_network(NUM_FEATURES, 1, 0)

Reals = NDArray[np.float64]


@dataclass(frozen=True)
class Settings:
    """How V is learned.

    Args:
        num_episodes: E.
        lambda_: λ in [0, 1].
        num_hidden: units.
        first_step_size: α at first.
        last_step_size: and in the end; it falls geometrically.
        first_epsilon: ε in episode e is this times (1 − e/E)².
        replay_period: after so many episodes the best one of a problem is learned from again; 0 for never.
        step_cost: of a repair while learning. A smaller one than the task's buys shorter schedules with more repairs.
        shuffled: whether every episode is told the final reward of another one.

    Raises:
        ValueError: a value out of range.
    """

    num_episodes: int = 6000
    lambda_: float = 1.0
    num_hidden: int = 20
    first_step_size: float = 0.03
    last_step_size: float = 0.003
    first_epsilon: float = 0.5
    replay_period: int = 4
    step_cost: float = 0.0003
    shuffled: bool = False

    def __post_init__(self) -> None:
        check_whole("num_episodes", self.num_episodes)
        check_fraction("lambda_", self.lambda_)
        check_whole("num_hidden", self.num_hidden)
        check_positive("first_step_size", self.first_step_size)
        check_positive("last_step_size", self.last_step_size)
        check_fraction("first_epsilon", self.first_epsilon)
        check_whole("replay_period", self.replay_period, 0)
        check_positive("step_cost", self.step_cost)


class Repaired(NamedTuple):
    """One problem, repaired.

    Args:
        length: of the last schedule.
        rdf: its resource dilation factor.
        repairs: task, kind (0 another pool, 1 another start), type and pool or start of each, ``[N, 4]``.
        reward: the sum of all rewards.
        solved: whether no conflict is left.
        start: when each task starts, ``[n]``.
        pool: which pool of each type it takes from, −1 for none, ``[n, K]``.
    """

    length: int
    rdf: float
    repairs: NDArray[np.int64]
    reward: float
    solved: bool
    start: NDArray[np.int64]
    pool: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Training:
    """What came of one training.

    Args:
        network: the one that repaired the problems for validation best, or the last one if there are none.
        episodes: after which validation looked, ``[scores]``.
        scores: the mean return on the problems for validation, greedily, ``[scores]``.
    """

    network: ValueNetwork
    episodes: NDArray[np.int64]
    scores: Reals


class _Recorded(NamedTuple):
    """An episode as `learn_afterstates` takes it."""

    features: Reals  # [T + 1, F]
    rewards: Reals  # [T]
    discounts: Reals  # [T]


class Workshop:
    """Problems, and room for episodes on them.

    Args:
        problems: of any sizes.
        stream: random numbers of every episode.
        step_cost: of a repair.
    """

    def __init__(self, problems: Sequence[JobShop], stream: NDArray[np.uint64], step_cost: float = STEP_COST) -> None:
        self.shops = [one.arrays for one in problems]
        self.plans = [new_plan(shop) for shop in self.shops]
        most_tasks = max(len(shop.durations) for shop in self.shops)
        most_pools = max(shop.capacities.shape[1] for shop in self.shops)
        most_steps = _MOST_REPAIRS_PER_TASK * most_tasks
        self.listed = new_repairs(most_tasks * (most_pools + 2))
        self.features = np.zeros((most_steps + 1, NUM_FEATURES))
        self.rewards = np.zeros(most_steps)
        self.chosen = np.zeros((most_steps, 4), np.int64)
        self.stream, self.step_cost = stream, step_cost

    def episode(
        self, which: int, chooser: int = LEARNED, network: ValueNetwork = _NO_NETWORK, epsilon: float = 0.0
    ) -> tuple[int, bool]:
        """Repairs one problem; returns how many repairs that took and whether no conflict is left."""
        steps, solved = repair_all(
            self.shops[which], self.plans[which], self.listed, chooser, network, epsilon, _COOLING, self.step_cost,
            self.stream, self.features, self.rewards, self.chosen,
        )  # fmt: skip
        return steps, bool(solved)

    def score(self, network: ValueNetwork) -> float:
        """The mean return over all problems."""
        return float(
            np.mean([self.rewards[: self.episode(i, LEARNED, network)[0]].sum() for i in range(len(self.shops))])
        )


def train(
    seed: Seed, problems: Sequence[JobShop], validation: Sequence[JobShop] = (), settings: Settings | None = None
) -> Training:
    """Learns V from nothing by repairing problems.

    Args:
        seed: of the network, the exploration and the order of the problems.
        problems: to learn from.
        validation: to choose a network by, out of those of the second half.
        settings: how to learn.

    Raises:
        ValueError: no problems, or one without a conflict.

    Example:
        >>> from neuralq_envs.job_shop import random_job_shop
        >>> shops = [random_job_shop(np.random.default_rng(seed), 2, 6) for seed in range(3)]
        >>> train(0, shops, settings=Settings(num_episodes=20)).network.w.shape
        (20, 14)
    """
    settings = settings or Settings()
    _check_problems("problems", problems)
    first, second, third = _sequence(seed).spawn(3)
    network = new_value_network(NUM_FEATURES, settings.num_hidden, first)
    shop, rng = Workshop(problems, new_stream(second), settings.step_cost), np.random.default_rng(third)
    judge = Workshop(validation, shop.stream, settings.step_cost) if validation else None
    best: dict[int, _Recorded] = {}
    finals: list[float] = []
    episodes, scores, kept, highest = [], [], network, -np.inf
    period = max(1, settings.num_episodes // (2 * _NUM_SCORES))
    for episode in range(settings.num_episodes):
        along = episode / settings.num_episodes
        step_size = settings.first_step_size * (settings.last_step_size / settings.first_step_size) ** along
        which = int(rng.integers(len(problems)))
        steps, solved = shop.episode(which, LEARNED, network, settings.first_epsilon * (1 - along) ** 2)
        told = _recorded(shop, steps, solved)
        if settings.shuffled and solved:
            finals.append(float(told.rewards[-1]))
            told.rewards[-1] = finals[int(rng.integers(len(finals)))]
        _learn(network, told, settings.lambda_, step_size)
        if solved and (which not in best or told.rewards.sum() > best[which].rewards.sum()):
            best[which] = told
        if settings.replay_period and best and (episode + 1) % settings.replay_period == 0:
            again = sorted(best)[int(rng.integers(len(best)))]
            _learn(network, best[again], settings.lambda_, step_size)
        if judge is not None and (episode + 1) % period == 0:
            episodes.append(episode + 1)
            scores.append(judge.score(network))
            if along >= 0.5 and scores[-1] >= highest:
                kept, highest = ValueNetwork(*(part.copy() for part in network)), scores[-1]
    return Training(kept, np.array(episodes, np.int64), np.array(scores))


def _recorded(shop: Workshop, steps: int, solved: bool) -> _Recorded:
    discounts = np.ones(steps)
    discounts[-1] = 0.0 if solved else 1.0
    return _Recorded(shop.features[: steps + 1].copy(), shop.rewards[:steps].copy(), discounts)


def _learn(network: ValueNetwork, told: _Recorded, lambda_: float, step_size: float) -> None:
    x = told.features
    learn_afterstates(network, x[:-1], told.rewards, told.discounts, x[1:], lambda_, step_size)


def repair(
    problems: Sequence[JobShop], chooser: str, network: ValueNetwork | None = None, seed: Seed = 0
) -> list[Repaired]:
    """Repairs every problem from its S0.

    Args:
        problems: what to repair.
        chooser: ``"learned"`` (greedily by ``network``), ``"least TRUI"``, ``"random"`` or ``"IR-V"``, which takes a
            random repair and keeps it if units in excess do not grow, or with the chance that annealing gives.
        network: that has learned.
        seed: of what is drawn.

    Raises:
        ValueError: another chooser, or ``"learned"`` without a network; no problems, or one without a conflict.

    Example:
        >>> from neuralq_envs.job_shop import random_job_shop
        >>> (one,) = repair([random_job_shop(np.random.default_rng(0), 2, 6)], "least TRUI")
        >>> one.solved, abs(one.reward + one.rdf + 0.001 * len(one.repairs)) < 1e-12
        (True, True)
    """
    check_choice("chooser", chooser, CHOOSERS)
    _check_problems("problems", problems)
    if chooser == "learned" and network is None:
        raise ValueError("chooser 'learned' needs a network: network=train(0, problems).network")
    shop, repaired = Workshop(problems, new_stream(seed)), []
    for i, problem in enumerate(problems):
        steps, solved = shop.episode(i, CHOOSERS[chooser], network or _NO_NETWORK)
        plan = shop.plans[i]
        length = int(plan.length[0])
        chosen, reward = shop.chosen[:steps].copy(), float(shop.rewards[:steps].sum())
        repaired.append(Repaired(length, problem.rdf(length), chosen, reward, solved, plan.start, plan.pool))
    return repaired


def list_schedule(problem: JobShop) -> Repaired:
    """No repairs: whatever fits starts, first what has the longest way to the end, in the pools with the least room.

    Source: Graham 1969 (list scheduling), with the critical path as priority.

    Example:
        >>> shop = JobShop([2, 3], [[2], [2]], [(), ()], [[3]])
        >>> list_schedule(shop).start.tolist()
        [3, 0]
    """
    shop = problem.arrays
    n, num_types = shop.requests.shape
    start, pool = np.full(n, -1, np.int64), np.full((n, num_types), -1, np.int64)
    left = np.repeat(shop.capacities[:, :, None], int(shop.durations.sum()) + 1, axis=2)
    now, waiting = 0, sorted(range(n), key=lambda i: (-shop.tail[i], i))
    while waiting:
        for i in tuple(waiting):
            ready = all(start[j] >= 0 and start[j] + shop.durations[j] <= now for j in problem.before[i])
            found = _pools_now(shop.requests[i], left[:, :, now]) if ready else None
            if found is not None:
                start[i], pool[i] = now, found
                for k in np.flatnonzero(shop.requests[i]).tolist():
                    left[k, found[k], now : now + shop.durations[i]] -= shop.requests[i, k]
                waiting.remove(i)
        now += 1
    length = int((start + shop.durations).max())
    rdf = problem.rdf(length)
    return Repaired(length, rdf, np.zeros((0, 4), np.int64), -rdf, True, start, pool)


def _pools_now(requests: NDArray[np.int64], left: NDArray[np.int64]) -> list[int] | None:
    """For each type the pool with the least room that is enough; None where there is none. What runs only ends."""
    found = []
    for units, room in zip(requests.tolist(), left.tolist(), strict=True):
        enough = [(r, p) for p, r in enumerate(room) if r >= units]
        if units and not enough:
            return None
        found.append(min(enough)[1] if units else -1)
    return found


def _sequence(seed: Seed) -> np.random.SeedSequence:
    return seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)


def _check_problems(name: str, problems: Sequence[JobShop]) -> None:
    if not problems:
        raise ValueError(f"{name} must hold at least one JobShop, got none")
    for i, one in enumerate(problems):
        if one.num_conflicts == 0:
            raise ValueError(f"{name}[{i}] has no conflict in its first schedule, so there is nothing to repair")
