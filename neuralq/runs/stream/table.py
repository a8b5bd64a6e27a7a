"""One environment with finitely many states, or its model, in which a tabular learner walks by itself.

Everything else in `neuralq.runs.stream` hands experience out. A compiled loop takes its own: on a model without leaving
the loop, else one step of the environment at a time, without the general stream of batches around it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from neuralq.exact import evaluate
from neuralq.learners.kind import learner_kinds
from neuralq.learners.learner import Learner, Update
from neuralq.learners.tabular.learner import TabularLearner
from neuralq.mdp import FiniteMDP
from neuralq.runs.stop_request import StopRequest
from neuralq.runs.stream.encoding import Encoder, ObservationError, discrete_actions, encoder_for
from neuralq.runs.stream.faults import EnvironmentFault, describe_error
from neuralq.runs.stream.spec import ObservationSpec
from neuralq.runs.stream.stream import Episode, Step
from neuralq.runs.stream.vector_env import MASK_METHODS, legal_actions
from neuralq.tabular.kernels.acting import EPISODE_STEPS, LIMIT, RECORD, REPLAY, STEP, new_log
from neuralq.tabular.model import Model, compile_model
from neuralq.tabular.prediction import under_policy
from neuralq.tabular.walking import EnvironmentWalk, WalkFault, state_reader
from neuralq.types import Array, Floats

__all__ = ["TableWalk"]

_START = "initial_state_distrib"
_REMEMBERED = 64
_SIMULATED, _STEPPED = 1 << 16, 1 << 7  # steps before it is asked whether to stop


class TableWalk:
    """A walk through one environment or its model; what a session reads of an `Interaction`, it reads here, too.

    Args:
        env: a single environment with finitely many observations and Discrete actions; reset here.
        discount: γ.
        seed: of the first reset.
        simulate: whether its model is simulated in its place; None where it has one that does what it does.
        reward_scale: rewards are multiplied by it for learning.

    Raises:
        ValueError: for spaces that no table is over, and where ``simulate`` is true and there is no such model.
    """

    num_envs = 1
    normalisation = None

    def __init__(
        self, env: gym.Env[Any, Any], discount: float, seed: int, simulate: bool | None, reward_scale: float = 1.0
    ) -> None:
        self.envs, self.discount, self._scale = env, discount, reward_scale
        self.encoder: Encoder = encoder_for(env.observation_space, as_index=True, instead=_other_learners())
        self.num_actions, self._first_action = discrete_actions(env.action_space)
        self._read = _reader(env.observation_space, self.encoder)
        self._seed: int | None = seed
        try:
            observation, extras = env.reset(seed=seed)
            self._first_state = self._read(observation)
            mask = legal_actions(env, extras)
        except WalkFault as fault:
            raise EnvironmentFault(f"at reset, {fault}") from fault
        except Exception as error:
            raise EnvironmentFault(f"at reset, {describe_error(error)}") from error
        self.masked = mask is not None
        assert self.encoder.num_categories is not None
        self.spec = ObservationSpec(
            (1 + self.num_actions,) if self.masked else (), np.dtype(np.int64), (), self.encoder.num_categories,
            self.masked, self.num_actions,
        )  # fmt: skip
        self._allowed: Array | None = None
        self.mdp, self.why_stepped = (None, "--tabular.simulate false") if simulate is False else self._model()
        if simulate and self.mdp is None:
            raise ValueError(f"the environment cannot be simulated: {self.why_stepped}; leave simulate out to step it")
        self._learner: TabularLearner | None = None
        self._broken = False
        self._return = 0.0
        self._ended: tuple[Episode, ...] = ()
        self._exact_v: Floats | None = None

    @property
    def time_limit(self) -> int | None:
        """After how many steps an episode is cut, where a wrapper does that."""
        return _time_limit(self.envs)

    @property
    def simulated(self) -> bool:
        """Whether the model is simulated, and the environment left alone."""
        return self.mdp is not None

    def _model(self) -> tuple[FiniteMDP | None, str]:
        """The model, or why there is none."""
        inner = self.envs.unwrapped
        made = getattr(inner, "mdp", None)
        if callable(made) and inspect.signature(made).parameters:
            return None, "it changes with time, and has no one model"
        if not callable(made) and getattr(inner, "P", None) is not None and not hasattr(inner, _START):
            return None, f"its table P does not say where episodes begin ({_START})"
        if not isinstance(self.envs.observation_space, spaces.Discrete):
            return None, "its observations are not numbers, as those of a model are"
        try:
            mdp = FiniteMDP.from_gymnasium(self.envs)
        except ValueError as error:
            return None, str(error)
        if self.masked and not callable(getattr(inner, "mdp", None)):
            return self._restricted(mdp)
        return mdp, ""

    def _restricted(self, mdp: FiniteMDP) -> tuple[FiniteMDP | None, str]:
        """A table P says nothing of the actions that info masks; ``action_mask(s)``, as Taxi has it, does."""
        mask_of = getattr(self.envs.unwrapped, "action_mask", None)
        if not callable(mask_of):
            return None, "its info masks actions, and its table does not say of which states"
        try:
            allowed = np.array([np.asarray(mask_of(s)) != 0 for s in range(mdp.num_states)])
        except Exception as error:  # its own code, asked for states that it may not expect
            return None, f"its action_mask(state) raised {type(error).__name__}: {error}"
        self._allowed = np.where((allowed & mdp.legal).any(1, keepdims=True), allowed, mdp.legal)
        return mdp, ""

    def begin(self, walking: Learner) -> None:
        """From now on this learner walks; what it calls is compiled."""
        learner = cast(TabularLearner, walking)
        self._learner, walk = learner, learner.walk
        self.recent, self._num_recent = new_log(_REMEMBERED, REPLAY), 0
        if self.mdp is None:
            self._steps = EnvironmentWalk(
                self.envs, self._read, learner.loop, walk, self._seed, _REMEMBERED, self._mask_reader(), self._scale
            )
            self.recent = self._steps.recent
            self._steps.run(learner.gamma, 0)
            return
        walk.counters[LIMIT] = self.time_limit or 0
        legal = self.mdp.legal if self._allowed is None else self.mdp.legal & self._allowed
        self._model_arrays = self._compiled(learner, legal)
        for s in np.flatnonzero(~self.mdp.is_terminal & ~legal.all(1)):
            learner.loop.allow_only(int(s), legal[s])
        self._log = new_log(_SIMULATED, RECORD)
        learner.loop.run(self._model_arrays.arrays, walk, self._log, learner.gamma, 0)

    def _compiled(self, learner: TabularLearner, legal: Array) -> Model:
        assert self.mdp is not None
        model, terminal = self.mdp, self.mdp.is_terminal
        if learner.loop.acts_in is not None:
            shares = np.where(terminal[:, None], 0.0, legal / np.maximum(legal.sum(1, keepdims=True), 1))
            model = self._process = under_policy(self.mdp, shares)
        if learner.settings.algorithm == "r-learning" and compile_model(model).arrays.ends.any():
            raise ValueError(
                "r-learning is for worlds that go on for ever, and episodes of this one end; use another algorithm"
            )
        compiled = compile_model(model)
        learner.make_room(compiled.max_outcomes)
        return Model(
            compiled.arrays._replace(reward=compiled.arrays.reward * self._scale), compiled.legal, compiled.max_outcomes
        )

    def advance(self, until: int, request: StopRequest) -> tuple[Episode, ...]:
        """Walk and learn until so many steps were taken in all, or a stop is asked for; the episodes that ended.

        Raises:
            EnvironmentFault: the environment raised, or handed out what its spaces did not promise.
            ValueError: the learner cannot learn from this world.
        """
        if self._broken:
            raise EnvironmentFault("this walk has ended with an error; start a new one")
        assert self._learner is not None
        ended: list[tuple[float, int]] = []
        while (left := until - self.num_steps) > 0 and request.name is None:
            ended += self._simulate(min(left, _SIMULATED)) if self.simulated else self._step(min(left, _STEPPED))
        self._learner.publish()
        self._ended = tuple(Episode(0, episode_return, length) for episode_return, length in ended)
        return self._ended

    def _step(self, count: int) -> list[tuple[float, int]]:
        assert self._learner is not None
        try:
            return self._steps.run(self._learner.gamma, count)
        except WalkFault as fault:
            self._broken = True
            what = describe_error(fault.__cause__) if fault.__cause__ is not None else f"field {fault}"
            raise EnvironmentFault(f"after {self.num_steps:,} environment steps, {what}") from fault

    def _simulate(self, count: int) -> list[tuple[float, int]]:
        learner, log = self._learner, self._log
        assert learner is not None
        begun = int(learner.walk.counters[EPISODE_STEPS])
        learner.loop.run(self._model_arrays.arrays, learner.walk, log, learner.gamma, count)
        ends = np.flatnonzero(log.last_t[:count])
        # From the end of one episode to the next; the first began in an earlier call, the last goes on.
        sums = np.add.reduceat(log.r_t[:count], np.append(0, ends[ends + 1 < count] + 1)) / self._scale
        sums[0] += self._return
        lengths = np.diff(ends, prepend=-1 - begun)
        self._return = 0.0 if len(sums) == len(ends) else float(sums[-1])
        for column, source in zip(self.recent[2:], log[2:], strict=True):
            column[: min(count, _REMEMBERED)] = source[max(0, count - _REMEMBERED) : count]
        self._num_recent = min(count, _REMEMBERED)
        return list(zip(sums[: len(ends)].tolist(), lengths.tolist(), strict=True))

    def last_update(self) -> Update | None:
        """The errors of the last steps, by the values as they are now; None before the first."""
        assert self._learner is not None
        known = self._num_recent if self.simulated else min(self._steps.num_taken, _REMEMBERED)
        return self._learner.errors(self.recent, known) if known else None

    def measures(self) -> dict[str, float]:
        """What was learned besides action values, in the environment's units.

        Of TD(λ) the value of the start and, where a model tells the random policy's values, how far those are from
        what was learned; of R-learning the reward per step.
        """
        learner = self._learner
        assert learner is not None
        if learner.average_reward is not None:
            return {"average_reward": learner.average_reward}
        if learner.settings.acts:
            return {}
        v = learner.loop.table.q[:, 0] / self._scale
        if self.mdp is None:
            begun = self._steps.begun
            mean = np.average(v[list(begun)], weights=list(begun.values())) if begun else v[self._first_state]
            return {"start_value": float(mean)}
        start = self.mdp.start_distribution
        found = {"start_value": float(start @ v)}
        if self._exact_v is None:
            self._exact_v = evaluate(self._process, np.zeros(len(v), np.int64), self.discount)
        met = learner.loop.table.visits[:, 0] > 0
        error = (v - self._exact_v)[met]
        found["exact_start_value"] = float(start @ self._exact_v)
        return found if not met.any() else found | {"value_error_rms": float(np.sqrt(np.mean(error**2)))}

    def met(self) -> tuple[Array, Array]:
        """Every pair that was visited, states as they are seen, with their masks."""
        assert self._learner is not None
        s, a = np.nonzero(self._learner.loop.table.visits)
        legal = self._learner.loop.table.q[s] > -np.inf
        return (np.concatenate([s[:, None], legal], axis=1) if self.masked else s), a

    def last_step(self) -> Step:
        """The step taken last; nobody has computed how probable its action was (NaN)."""
        log, k = self.recent, 0 if self.simulated else (self.num_steps - 1) % _REMEMBERED
        s_tm1, a_tm1, r_t, discount_t, s_t, _, last_t = (column[k : k + 1].copy() for column in log[2:])
        rows = (s_tm1, a_tm1, np.full(1, np.nan, np.float32), r_t / self._scale, discount_t, s_t, last_t)
        return Step(rows, np.zeros(1, np.int64), self._ended)

    @property
    def num_steps(self) -> int:
        """Steps so far."""
        return 0 if self._learner is None else int(self._learner.walk.counters[STEP])

    @num_steps.setter
    def num_steps(self, steps: int) -> None:
        assert steps == self.num_steps, "the learner's walk counts them"

    def running_episodes(self) -> list[tuple[float, int]]:
        """Return so far and length of the unfinished episode."""
        assert self._learner is not None
        so_far = self._return if self.simulated else self._steps.running_return
        return [(so_far, int(self._learner.walk.counters[EPISODE_STEPS]))]

    def state_dict(self) -> dict[str, Any]:
        """What the learner's walk does not hold."""
        return {"running_return": self._return if self.simulated else self._steps.running_return, "scalings": {}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`; the environment must have been restored to the same point."""
        if self.simulated:
            self._return = float(state["running_return"])
        else:
            self._steps.continue_from(float(state["running_return"]))

    def load_normalisation(self, state: Mapping[str, Any]) -> None:
        """Nothing is normalised."""

    def restart(self, seed: int | None) -> None:
        """The next step begins an episode, with this seed."""
        self._return = 0.0
        if not self.simulated:
            self._steps.begin_anew(seed)

    def _mask_reader(self) -> Callable[[dict[str, Any]], Any]:
        if not self.masked:
            return lambda extras: None
        if any(self.envs.has_wrapper_attr(name) for name in MASK_METHODS):
            return lambda extras: legal_actions(self.envs, extras)
        return lambda extras: extras.get("action_mask")


def _other_learners() -> str:
    """What whoever wanted a table where there is none may do, in words."""
    others = [name for name, kind in learner_kinds().items() if kind.experience != "table"]
    return f"choose another learner ({', '.join(others)}), whose networks need no table,"


def _time_limit(env: gym.Env[Any, Any]) -> int | None:
    """After how many steps the wrapper cuts an episode."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, TimeLimit):
            return int(env._max_episode_steps)
        env = env.env
    return None


def _reader(space: spaces.Space[Any], encoder: Encoder) -> Callable[[Any], int]:
    """What makes states of observations, the quick way first; the states are the encoder's."""

    def slowly(observation: Any) -> int:
        try:
            return int(encoder.encode_single(observation))
        except ObservationError as error:
            raise WalkFault(f"{error.field} {error.problem}") from None

    if isinstance(space, spaces.Discrete):
        return state_reader(space)
    if not (isinstance(space, spaces.Tuple) and all(isinstance(part, spaces.Discrete) for part in space.spaces)):
        return slowly
    digits = [(int(part.start), int(part.n)) for part in space.spaces]  # type: ignore[attr-defined]

    def read(observation: Any) -> int:
        if type(observation) is not tuple or len(observation) != len(digits):
            return slowly(observation)
        state = 0
        for value, (first, size) in zip(observation, digits, strict=True):
            if type(value) is not int and type(value) is not np.int64:
                return slowly(observation)
            digit = int(value) - first
            if not 0 <= digit < size:
                return slowly(observation)
            state = state * size + digit
        return state

    return read
