"""What must be exact: the cost against quadrature, and a building so small that everything can be tried.

Eight passengers, two cars, six floors (`MINI`): every sequence of decisions is played, so the cheapest one is known,
and nobody, whatever he has learned, may come in below it.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from scipy.integrate import quad

from neuralq.runs.report.claims import Row, claim, number
from neuralq.systems.elevators.controllers import ALWAYS_STOP, LQF, NETWORK, new_controller, play
from neuralq.systems.elevators.training import Settings, train
from neuralq.tabular import smdp_q_update
from neuralq_envs.elevators.building import BETA, SETTLED, copied, open_building
from neuralq_envs.elevators.environment import ElevatorsEnv
from neuralq_envs.elevators.kernels import advance, decide, open_account
from neuralq_envs.elevators.passengers import MINI, draw_hour

__all__ = ["brute_force", "cost_error", "mini_cost", "mini_network_cost", "oracle", "tabular_cost"]

PUBLISHED_OPTIMUM = 0.01367532  # of the mini building, found by another program
_MINI_SIZE = (2, 6)
_MOST_EPISODES = 20_000


def oracle() -> tuple[Row, ...]:
    """All of it, as rows."""
    optimum, num_sequences = brute_force()
    hour = draw_hour(np.random.default_rng(0))
    building = open_building(hour)
    play(building, new_controller(LQF), np.inf)
    brought = int(np.count_nonzero(building.left > building.boarded))
    cheapest = min(*(mini_cost(rule) for rule in range(ALWAYS_STOP, NETWORK)), mini_network_cost())
    return (
        number("cost of waiting: largest relative difference from quadrature", 0.0, cost_error(), tol=1e-9),
        number(
            "an hour's passengers who came, less those who were brought down", 0.0, len(hour.arrival) - brought, 0.0
        ),
        number(
            "two cars, six floors, eight passengers: the least that it can cost",
            PUBLISHED_OPTIMUM,
            optimum,
            tol=5e-9,
            note=f"the cheapest of all {num_sequences} sequences of decisions",
        ),
        number("what tabular SMDP-Q comes to there", optimum, tabular_cost(), tol=1e-12),
        claim(
            "the cheapest of all contenders there, the network among them",
            f"not below {optimum:.8f}",
            f"{cheapest:.8f}",
            cheapest >= optimum - 1e-12,
        ),
    )


def mini_cost(rule: int, seed: int = 0) -> float:
    """What a rule of thumb costs in the mini building, discounted to the beginning.

    Example:
        >>> round(mini_cost(LQF), 8)
        0.04663334
    """
    building = open_building(MINI, *_MINI_SIZE)
    play(building, new_controller(rule, *_MINI_SIZE, seed), np.inf)
    return float(building.cost[-1])


@functools.cache
def brute_force() -> tuple[float, int]:
    """The least discounted cost of the mini building, and of how many sequences of decisions."""
    open_branches, least, num_sequences = [open_building(MINI, *_MINI_SIZE)], math.inf, 0
    while open_branches:
        building = open_branches.pop()
        car = advance(building, np.inf)
        if car < 0:
            num_sequences += 1
            least = min(least, float(building.cost[-1]))
            continue
        for stop in (False, True):
            branch = copied(building)
            decide(branch, car, stop)
            open_branches.append(branch)
    return least, num_sequences


def tabular_cost() -> float:
    """What SMDP Q-learning on a table comes to in the mini building, as an environment that is stepped.

    It acts greedily and begins with values of 0, which are better than anything that can happen, so it tries whatever
    might be; it has come to the end when an episode teaches it nothing, and then no sequence is cheaper than its own.
    """
    env = ElevatorsEnv(num_cars=2, num_floors=6, passengers=np.stack([MINI.arrival, MINI.origin], axis=1))
    env.reset()
    before, first = float(env.building.cost[-1]), float(env.building.clock[SETTLED])
    beta = -math.log(env.building.discount[-1]) / first
    q = np.zeros((_MOST_EPISODES, 2))
    numbers: dict[bytes, int] = {}
    for _ in range(_MOST_EPISODES):
        env.reset()
        s, terminated, learned = _state(env, numbers), False, 0.0
        while not terminated:
            a = int(q[s].argmax())
            _, reward, terminated, _, said = env.step(a)
            s_t = -1 if terminated else _state(env, numbers)
            learned += abs(smdp_q_update(q, s, a, reward, said["duration"], beta, s_t, terminated, 1.0))
            s = s_t
        if learned == 0.0:
            break
    return before - math.exp(-beta * first) * float(q[0].max())


def _state(env: ElevatorsEnv, numbers: dict[bytes, int]) -> int:
    """The number of everything that decides how it goes on."""
    b = env.building
    now = b.clock[SETTLED]
    parts = (
        np.round(b.event - now, 9),
        np.round(now, 9),
        b.floor,
        b.direction,
        b.phase,
        b.aboard,
        b.waiting,
        b.boarded > 0,
    )
    key = b"".join(np.asarray(part).tobytes() for part in parts)
    return numbers.setdefault(key, len(numbers))


def mini_network_cost(seed: int = 0, num_hours: int = 3000) -> float:
    """What the network costs in the mini building after so many times in it."""
    settings = Settings(num_hours=num_hours, step_size=(0.05, 0.01), temperature=(0.05, 0.0005))
    learned = train(np.random.SeedSequence(seed), settings, buildings=[open_building(MINI, *_MINI_SIZE)])
    building = open_building(MINI, *_MINI_SIZE)
    play(building, new_controller(NETWORK, *_MINI_SIZE, network=learned.network), np.inf)
    return float(building.cost[-1])


def cost_error(num_decisions: int = 150, seed: int = 0) -> float:
    """The largest relative difference of a car's account from adaptive quadrature, over decisions at random.

    The account is what the time between two decisions of the same car has cost; the quadrature is of every passenger's
    own wait, from the times at which they came and boarded.
    """
    rng = np.random.default_rng(seed)
    building = open_building(draw_hour(rng))
    beta, accounts = float(building.clock[BETA]), []
    latest: dict[int, float] = {}
    for _ in range(num_decisions):
        car = advance(building, np.inf)
        now = float(building.clock[SETTLED])
        if car in latest:
            accounts.append((latest[car], now, float(building.cost[car])))
        latest[car] = now
        open_account(building, car)
        decide(building, car, bool(rng.random() < 0.5))
    end = accounts[-1][1]
    boarded = np.where(np.isnan(building.boarded), end, building.boarded)
    worst = 0.0
    for begin, now, cost in accounts:
        expected = 0.0
        for came, went in zip(building.arrival, boarded, strict=True):
            low, high = max(came, begin), min(went, now)
            if low < high:
                expected += quad(
                    lambda t, came=came, begin=begin: math.exp(-beta * (t - begin)) * (t - came) ** 2,
                    low, high, epsabs=0.0, epsrel=1e-13,
                )[0]  # fmt: skip
        worst = max(worst, abs(cost - 1e-6 * expected) / max(1e-6 * expected, 1e-300) if expected else abs(cost))
    return worst
