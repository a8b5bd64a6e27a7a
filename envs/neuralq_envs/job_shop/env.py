"""Job-shop scheduling by repair as a Gymnasium environment: a mask over padded actions, and what each would lead to.

The number of repairs is another one in every state, so the action is the number of a repair in a list that is padded:
``info["action_mask"]`` has as many ones as there are repairs. The observation is a table: its first row describes the
schedule as it is, row 1 + a what repair a would make of it, and rows without a repair are 0. An ordinary learner
reads it as it reads any observation; one for afterstates compares its rows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_positive, check_whole
from neuralq_envs.job_shop.drawing import draw, write_down
from neuralq_envs.job_shop.kernels import NUM_FEATURES, Plan, apply_repair, lay_out, look_ahead, measure
from neuralq_envs.job_shop.problem import JobShop, new_plan, new_repairs, random_job_shop

__all__ = ["JobShopEnv", "Repair", "make"]

_RENDER_MODES = ("ansi", "rgb_array")
_FARTHEST = 100.0  # features are about ±1; the bound is there for problems of another kind than those that are drawn


class Repair(NamedTuple):
    """One action.

    Args:
        task: that is changed.
        resource: the type of resource of which a pool is over-full.
        pool: that it is taken from instead; None where the task is moved.
        start: that it is moved to; None where it stays.
    """

    task: int
    resource: int
    pool: int | None
    start: int | None


class JobShopEnv(gymnasium.Env[NDArray[np.float32], np.int64]):
    """Repairs of a schedule, until no pool is over-full; every reset draws a problem.

    Rewards are −``step_cost`` for a repair, and −RDF on top for the one after which no conflict is left, which ends the
    episode. An episode is truncated where the horizon leaves no repair. ``info["repairs"]`` lists what may be done, and
    ``info["length"]`` is the schedule's.

    Args:
        render_mode: None, ``"ansi"`` or ``"rgb_array"``.
        num_missions: of the problems that are drawn.
        num_tasks: of each mission.
        most_repairs: actions; where a conflict has more repairs, the first so many are offered.
        step_cost: of a repair, above 0.

    Raises:
        ValueError: another render mode, or numbers out of range.

    Example:
        >>> env = JobShopEnv()
        >>> table, extra = env.reset(seed=1)
        >>> table.shape, len(extra["repairs"]) == extra["action_mask"].sum().item()
        ((65, 14), True)
        >>> env.step(0)[1]
        -0.001
    """

    metadata: dict[str, Any] = {"render_modes": list(_RENDER_MODES), "render_fps": 4}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        num_missions: int = 3,
        num_tasks: int = 17,
        most_repairs: int = 64,
        step_cost: float = 0.001,
    ) -> None:
        check_choice("render_mode", render_mode, [None, *_RENDER_MODES])
        check_whole("num_missions", num_missions)
        check_whole("num_tasks", num_tasks, 2)
        check_whole("most_repairs", most_repairs)
        check_positive("step_cost", step_cost)
        self.render_mode = render_mode
        self.observation_space = Box(-_FARTHEST, _FARTHEST, (1 + most_repairs, NUM_FEATURES), np.float32)
        self.action_space = Discrete(most_repairs)
        self._sizes = (num_missions, num_tasks)
        self._step_cost = float(step_cost)
        self._repairs = new_repairs(most_repairs)
        self._count = 0
        self._problem: JobShop | None = None
        self._plan: Plan | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """The first schedule of a new problem, or of ``options["problem"]``, a `JobShop`.

        Raises:
            ValueError: a problem whose first schedule has no conflict: there is nothing to repair.
        """
        super().reset(seed=seed)
        problem = (options or {}).get("problem")
        if problem is None:
            problem = random_job_shop(self.np_random, *self._sizes)
        elif not isinstance(problem, JobShop):
            raise ValueError(f"options['problem'] must be a JobShop, got {problem!r}")
        if problem.num_conflicts == 0:
            raise ValueError(
                "the problem's first schedule has no conflict, so there is nothing to repair; give another"
            )
        self._problem, self._plan = problem, new_plan(problem.arrays)
        lay_out(problem.arrays, self._plan)
        return self._look()

    def step(self, action: np.int64) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Carries a repair out; one that is not on the list costs as much and changes nothing.

        Raises:
            ResetNeeded: before the first reset, or after the episode has ended.
        """
        if self._problem is None or self._plan is None or self._count == 0:
            raise ResetNeeded("there is no conflict left, or no problem yet: call reset() before step()")
        if not 0 <= action < self._count:
            table, extra = self._look()
            return table, -self._step_cost, False, False, extra
        reward, solved = float(self._repairs.rewards[action]), self._repairs.discounts[action] == 0.0
        apply_repair(self._problem.arrays, self._plan, self._repairs, int(action))
        table, extra = self._look()
        return table, reward, bool(solved), not solved and self._count == 0, extra

    @property
    def problem(self) -> JobShop | None:
        """What is being repaired."""
        return self._problem

    def render(self) -> Any:
        """Pools over time as text for ``ansi``; tasks and pools as uint8 ``[H, W, 3]`` for ``rgb_array``."""
        if self._problem is None or self._plan is None or self.render_mode is None:
            return None
        return (write_down if self.render_mode == "ansi" else draw)(self._problem.arrays, self._plan)

    def _look(self) -> tuple[NDArray[np.float32], dict[str, Any]]:
        assert self._problem is not None and self._plan is not None
        shop, plan, listed = self._problem.arrays, self._plan, self._repairs
        table = np.zeros(self.observation_space.shape or ())
        measure(shop, plan, table[0])
        self._count = look_ahead(shop, plan, self._step_cost, listed)
        table[1 : 1 + self._count] = listed.features[: self._count]
        mask = np.zeros(len(listed.task), np.int8)
        mask[: self._count] = 1
        repairs = tuple(
            Repair(task, resource, None, to) if kind else Repair(task, resource, to, None)
            for task, kind, resource, to in zip(
                *(part[: self._count].tolist() for part in (listed.task, listed.kind, listed.resource, listed.to)),
                strict=True,
            )
        )
        extra = {"action_mask": mask, "repairs": repairs, "length": int(plan.length[0])}
        return table.clip(-_FARTHEST, _FARTHEST).astype(np.float32), extra


def make(render_mode: str | None = None, **given: Any) -> JobShopEnv:
    """What ``gymnasium.make("neuralq/JobShop-v0")`` calls.

    Example:
        >>> make(num_missions=1, num_tasks=8, most_repairs=9).action_space
        Discrete(9)
    """
    return JobShopEnv(render_mode, **given)
