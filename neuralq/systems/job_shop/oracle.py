"""What no repairer can beat: the best of all that repairs can reach, found by trying everything on tiny problems."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from neuralq.runs.report.claims import Row, claim, number
from neuralq.systems.job_shop.trials import CHOOSERS, STEP_COST, Repaired, Settings, repair, train
from neuralq_envs.job_shop.kernels import apply_repair, lay_out, look_ahead
from neuralq_envs.job_shop.problem import JobShop, new_plan, new_repairs, random_job_shop

__all__ = ["least_cost", "oracle", "tiny_problems"]

_NUM_TINY = 40
_TINY_EPISODES = 1500


@cache
def tiny_problems(num: int = _NUM_TINY, seed: int = 0) -> tuple[JobShop, ...]:
    """Problems of two missions of four tasks that share one type of resource, two pools of three units.

    Example:
        >>> [one.num_tasks for one in tiny_problems(2)]
        [8, 8]
    """
    rng = np.random.default_rng(seed)
    return tuple(random_job_shop(rng, 2, 4, [[3, 3]]) for _ in range(num))


def least_cost(problem: JobShop, step_cost: float = STEP_COST) -> tuple[float, int]:
    """The least RDF + ``step_cost`` per repair that any sequence of repairs reaches, and how many schedules were tried.

    Breadth first over schedules: each is tried after the fewest repairs that lead to it, and left where what it has
    cost and the bound below every RDF are not less than the best found.

    Example:
        >>> shop = JobShop([2, 3], [[2], [2]], [(), ()], [[3]])
        >>> cost, schedules = least_cost(shop)
        >>> schedules, bool(abs(cost - (0.001 + shop.rdf(5))) < 1e-12)
        (1, True)
    """
    shop = problem.arrays
    plan, listed = new_plan(shop), new_repairs(problem.num_tasks * (shop.capacities.shape[1] + 2))
    lowest = problem.rdf(problem.bound)
    best, depth = np.inf, 0
    level: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = [(shop.start, shop.pool)]
    seen = {shop.start.tobytes() + shop.pool.tobytes()}
    while level and (depth + 1) * step_cost + lowest < best:
        following = []
        for start, pool in level:
            here = shop._replace(start=start, pool=pool)
            lay_out(here, plan)
            for r in range(look_ahead(here, plan, step_cost, listed)):
                if listed.discounts[r] == 0.0:
                    best = min(best, depth * step_cost - float(listed.rewards[r]))
                    continue
                lay_out(here, plan)
                apply_repair(here, plan, listed, r)
                key = plan.start.tobytes() + plan.pool.tobytes()
                if key not in seen:
                    seen.add(key)
                    following.append((plan.start.copy(), plan.pool.copy()))
        level, depth = following, depth + 1
    return best, len(seen)


def oracle() -> tuple[Row, ...]:
    """Everybody against the optimum of tiny problems, and the sum of rewards against its definition."""
    problems = tiny_problems()
    optimum = np.array([least_cost(one)[0] for one in problems])
    network = train(0, problems, problems, Settings(num_episodes=_TINY_EPISODES)).network
    found = {name: repair(problems, name, network) for name in CHOOSERS}
    gaps = {name: np.array([-one.reward for one in all_]) - optimum for name, all_ in found.items()}
    lowest = min(float(gap.min()) for gap in gaps.values())
    counted = "; ".join(
        f"{name}: {int((gap < 1e-9).sum())} optimal, mean excess {gap.mean():.3f}" for name, gap in gaps.items()
    )
    return (
        claim(
            f"{len(problems)} tiny problems: cost less the least of all sequences of repairs",
            "never below 0",
            lowest,
            lowest >= -1e-12,
            counted,
        ),
        number(
            "sum of rewards: difference from −RDF − .001 per repair",
            0.0,
            max(map(identity_difference, found.values())),
            tol=1e-12,
        ),
    )


def identity_difference(repaired: Sequence[Repaired]) -> float:
    """The largest difference of a sum of rewards from −RDF − .001 per repair.

    Example:
        >>> identity_difference(repair(tiny_problems(3), "random")) < 1e-12
        True
    """
    return max(abs(one.reward + one.rdf + STEP_COST * len(one.repairs)) for one in repaired if one.solved)
