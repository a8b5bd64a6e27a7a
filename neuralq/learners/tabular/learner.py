"""A table learned by the compiled loops of `neuralq.tabular`, as runs know learners."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from neuralq.learners.kind import LearnerKind, Parts, Representation, Traits
from neuralq.learners.learner import Update
from neuralq.learners.tabular.settings import TabularSettings
from neuralq.q.masked import MaskedQ
from neuralq.tabular.average import r_learner
from neuralq.tabular.control import one_step_learner
from neuralq.tabular.kernels.acting import (
    ACTION,
    EPISODE_STEPS,
    REPLAY,
    STATE,
    STEP,
    Log,
    Table,
    choose,
    new_log,
    new_walk,
)
from neuralq.tabular.kernels.sweeping import FULL, new_memory
from neuralq.tabular.learner import Learner as Loop
from neuralq.tabular.model import empty_arrays
from neuralq.tabular.n_step import n_step_learner
from neuralq.tabular.planning import dyna_learner, sweeping_learner
from neuralq.tabular.policies import (
    EpsilonGreedy,
    KToTheQ,
    Policy,
    Power,
    RandomPolicy,
    SearchThenConverge,
    Softmax,
    StepCode,
    UpperConfidence,
    step_code,
)
from neuralq.tabular.prediction import td_learner
from neuralq.tabular.traces import trace_learner
from neuralq.types import Floats, Transition

__all__ = ["TABULAR", "TabularLearner"]


class TabularLearner:
    """A compiled loop of `neuralq.tabular` over the entries of a `TableQ`.

    Whoever has an environment or a model lets the loop walk through it (`loop`, `walk`) and then calls `publish`;
    `update` learns from transitions that somebody else made.

    Args:
        parts: what the run gives: an engine of a table, the settings, and the rest.

    Raises:
        ValueError: the engine's representation is no table in float64 on the CPU.
    """

    def __init__(self, parts: Parts) -> None:
        self.engine, self.settings = parts.engine, parts.settings
        self.plan: dict[str, Any] = parts.settings.plan
        self.gamma = 1.0 if self.settings.algorithm == "r-learning" else parts.discount
        self._reward_scale = parts.reward_scale
        values = parts.engine.flat.values
        if values.dtype != torch.float64 or values.device.type != "cpu":
            raise ValueError(
                f"the tabular learner computes in float64 on the CPU, got {values.dtype} on {values.device}"
            )
        self._masked = isinstance(parts.engine.q, MaskedQ)
        num_actions = parts.engine.q.num_actions
        values.fill_(self.settings.initial_q * parts.reward_scale)
        self._entries: Floats = values.numpy().reshape(-1, num_actions)
        predicts = self.settings.algorithm == "td-lambda"
        own = self._entries[:, :1] if predicts else self._entries
        # Illegal actions are −∞ within the loop, and the parameters of a run are finite.
        self.shares = not (self._masked or predicts)
        table = _table(own if self.shares else own.copy())
        acts_in = _table(np.zeros_like(self._entries)) if predicts else None
        self._made_of = (table, acts_in, _policy(self.plan, parts), _schedule(self.plan))
        self.loop = _loop(self.plan, *self._made_of)
        self.walk = new_walk(int(parts.rng.integers(2**63)))
        self._nothing, self._one = empty_arrays(), new_log(1, REPLAY)

    @property
    def num_updates(self) -> int:
        """How often the value of a pair was changed, in imagination, too."""
        return int(self.walk.counters[STEP] if self.loop.backups is None else self.loop.backups[0])

    @property
    def engine_name(self) -> str:
        """Kernels do everything but evaluate."""
        return "compiled"

    @property
    def average_reward(self) -> float | None:
        """The reward per step that R-learning has learned, in the environment's units; None of other algorithms."""
        return (
            float(self.loop.arguments[1][0]) / self._reward_scale if self.settings.algorithm == "r-learning" else None
        )

    def make_room(self, max_outcomes: int) -> None:
        """Before the first step: a pair has so many different outcomes at most."""
        if self.settings.algorithm == "prioritized-sweeping" and self.settings.max_outcomes is None:
            self.loop = _loop({**self.plan, "max_outcomes": max_outcomes}, *self._made_of)

    def publish(self) -> None:
        """What was learned becomes the parameters of the representation, where they are not the same memory."""
        if not self.shares:
            np.copyto(self._entries, self.loop.table.q, where=self.loop.table.q > -np.inf)

    def errors(self, log: Log, num_rows: int) -> Update:
        """Target − value of the first rows of a log, with the values of the moment."""
        rows, q = slice(0, num_rows), self.loop.table.q
        s, a, s_t = log.s_tm1[rows], log.a_tm1[rows], log.s_t[rows]
        ahead = q[s_t].max(1)
        if self.loop.on_policy:
            ahead = q[s_t, np.maximum(log.a_t[rows], 0)]
        bootstrap = np.where(log.discount_t[rows] == 0, 0.0, log.discount_t[rows] * ahead)
        gain = self.loop.arguments[1][0] if self.settings.algorithm == "r-learning" else 0.0
        target = log.r_t[rows] - gain + bootstrap
        return Update(torch.from_numpy(target - q[s, a]), torch.from_numpy(target))

    def update(self, transition: Transition, weight: torch.Tensor | None = None) -> Update:
        """Learn from steps that were taken elsewhere, one after another; on-policy rules draw the next action here."""
        fields = (transition.s_tm1, transition.a_tm1, transition.r_t, transition.discount_t, transition.s_t)
        columns = [np.atleast_1d(x.cpu().numpy()) for x in (*fields, transition.last_t)]
        errors, targets = [], []
        for i in range(len(columns[1])):
            if weight is not None and float(weight.reshape(-1)[i]) == 0:
                continue
            seen = self._learn_from(*(column[i] for column in columns))
            errors.append(seen.errors)
            targets.append(seen.targets)
        self.publish()
        return Update(torch.cat(errors), torch.cat(targets))

    def _learn_from(self, s_tm1: Any, a_tm1: Any, r_t: Any, discount_t: Any, s_t: Any, last_t: Any) -> Update:
        loop, log = self.loop, self._one
        before, after = self._state(s_tm1), self._state(s_t)
        a_t = -1
        if loop.on_policy and discount_t != 0:
            step = int(self.walk.counters[STEP]) + 1
            a_t = int(choose(loop.table, np.uint64(after), step, loop.policy, self.walk.rng))
        predicts = loop.acts_in is not None
        row = (before, 0 if predicts else a_tm1, r_t, discount_t, after, a_t, last_t)
        for column, value in zip(log[2:], row, strict=True):
            column[0] = value
        seen = self.errors(log, 1)
        loop.run(self._nothing, self.walk, log, 0.0, 1)
        return seen

    def _state(self, s: Any) -> int:
        """The state of an observation, whose mask, if it has one, is believed."""
        if not self._masked:
            return int(s)
        if np.any(s[1:]):
            self.loop.allow_only(int(s[0]), s[1:] != 0)
        return int(s[0])

    def begin_streams(self) -> None:
        """The walk begins anew."""
        self.walk.counters[[STATE, ACTION, EPISODE_STEPS]] = -1, -1, 0
        self.loop.begin_stream()

    def _saved(self) -> list[np.ndarray[Any, Any]]:
        arrays = self.loop.arrays()
        return arrays[1:] if self.shares else arrays

    def state_dict(self) -> dict[str, Any]:
        """The table, and everything else that the loop changes: visits, traces, models, queues, the random stream."""
        return {
            "num_updates": self.num_updates,
            "parameters": self.engine.flat.values,
            "counters": self.walk.counters,
            "rng": self.walk.rng,
            "arrays": self._saved(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit.

        Raises:
            ValueError: it was saved by another algorithm or of another environment.
        """
        own = [self.walk.counters, self.walk.rng, *self._saved()]
        saved = [state["counters"], state["rng"], *state["arrays"]]
        if [array.shape for array in own] != [np.shape(array) for array in saved]:
            raise ValueError("this table was saved by another algorithm or of other states; load it with its own")
        self.engine.flat.load(torch.as_tensor(state["parameters"]))
        for array, values in zip(own, saved, strict=True):
            array[...] = values
        self._take_parameters()

    def _take_parameters(self) -> None:
        """The parameters are what counts: a run may begin with those of another one."""
        q = self.loop.table.q
        np.copyto(q, self._entries[:, : q.shape[1]], where=q > -np.inf)
        for copies in self.loop.copies:
            changed = copies.mean(0) != q
            copies[:, changed] = q[changed]


def _table(q: Floats) -> Table:
    """A table over this very memory, in which every action is legal."""
    return Table(q, np.zeros(q.shape, np.int64), np.full(len(q), q.shape[1], np.uint64))


def _policy(plan: Mapping[str, Any], parts: Parts) -> Policy:
    start, end, num_steps = parts.exploration
    made: dict[str, Callable[[], Policy]] = {
        "epsilon-greedy": lambda: EpsilonGreedy(start, end, num_steps),
        "k-to-the-q": lambda: KToTheQ(plan["k"], plan["k_growth"]),
        "softmax": lambda: Softmax(plan["temperature"]),
        "ucb": lambda: UpperConfidence(plan["confidence"]),
        "random": RandomPolicy,
    }
    return made[plan["policy"]]()


def _schedule(plan: Mapping[str, Any]) -> StepCode:
    made: dict[str, Callable[[], Any]] = {
        "constant": lambda: plan["step_size"],
        "one-over-n": lambda: "one-over-n",
        "power": lambda: Power(plan["power"]),
        "search-then-converge": lambda: SearchThenConverge(plan["step_size"], plan["turn_visits"]),
    }
    return step_code(made[plan["schedule"]](), 1)


def _loop(plan: Mapping[str, Any], table: Table, acts_in: Table | None, policy: Policy, alpha: StepCode) -> Loop:
    """The compiled loop of an algorithm."""
    algorithm, planning = plan["algorithm"], plan["num_planning"]
    made: dict[str, Callable[[], Loop]] = {
        "n-step": lambda: n_step_learner(table, policy, alpha, plan["rule"], plan["n"]),
        "q-lambda": lambda: trace_learner(table, policy, alpha, plan["rule"], plan["lambda_"], plan["trace"]),
        "dyna": lambda: dyna_learner(table, policy, alpha, planning, plan["kappa"]),
        "prioritized-sweeping": lambda: sweeping_learner(
            table, policy, step_code(1.0, 1), new_memory(table.q.shape, plan["max_outcomes"]), FULL, planning,
            plan["threshold"],
        ),
        "td-lambda": lambda: td_learner(table, alpha, plan["lambda_"], plan["trace"], "step", acts_in=acts_in),
        "r-learning": lambda: r_learner(table, policy, alpha, plan["beta"]),
    }  # fmt: skip
    if algorithm in made:
        return made[algorithm]()
    return one_step_learner("double-q" if algorithm == "double" else algorithm, table, policy, alpha)


def _check(settings: TabularSettings, representation: Representation) -> None:
    if representation.layout != "table":
        raise ValueError(
            f"the tabular learner learns a table, got layout={representation.layout!r}; leave layout out, or use "
            "learner='online', whose updates are the same for every layout"
        )


def _traits(settings: TabularSettings) -> Traits:
    plan = settings.plan
    traced = settings.algorithm in ("q-lambda", "td-lambda")
    return Traits(plan["step_size"], lambda_=plan["lambda_"] if traced else 0.0, double=settings.algorithm == "double")


TABULAR = LearnerKind(
    name="tabular",
    title="the chapter's algorithms on a table, in compiled loops, from a model or from the environment",
    source="Mitchell 1997, chapter 13; Watkins 1989; Rummery & Niranjan 1994; Sutton 1990; Moore & Atkeson 1993",
    settings=TabularSettings,
    build=TabularLearner,
    experience="table",
    traits=_traits,
    check=_check,
    layout="table",
    place=6,
    step_sizes=("step_size", "power", "turn_visits"),
    space={
        "algorithm": ["q-learning", "sarsa", "expected-sarsa", "double"],
        "schedule": ["constant", "one-over-n", "power", "search-then-converge"],
        "step_size": {
            "from": 0.01,
            "to": 1.0,
            "scale": "log",
            "when": {"schedule": ["constant", "search-then-converge"]},
        },
        "power": {"from": 0.51, "to": 1.0, "when": {"schedule": "power"}},
        "turn_visits": {"from": 10.0, "to": 10_000.0, "scale": "log", "when": {"schedule": "search-then-converge"}},
    },
)
