"""TD(λ) in the forward view: λ-returns over a rollout of parallel streams, fitted for a few epochs, then forgotten.

The method is PQN (Gallici et al., 2024): Peng's Q(λ) with neither replay nor, by default, a target network. Watkins'
returns cut λ at exploring actions. Values are computed once per rollout, with the parameters that collected it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuralq import rules
from neuralq.checks import check_choice, check_fraction, check_positive, check_whole
from neuralq.learners import state
from neuralq.learners.averaging import IterateAverage
from neuralq.learners.descent import Descent, count_update
from neuralq.learners.kind import LearnerKind, Parts, Traits
from neuralq.learners.learner import Update
from neuralq.learners.optim import Optimiser
from neuralq.learners.sequences import has_memory, recalled, stream_weights
from neuralq.q.engine import Engine
from neuralq.types import Array, Transition

__all__ = ["ROLLOUT", "RolloutLearner", "RolloutSettings"]


@dataclass(frozen=True)
class RolloutSettings:
    """How a `RolloutLearner` learns. Defaults: PQN (Gallici et al., 2024) scaled down to small control problems.

    Args:
        lambda_: λ in [0, 1]; 0 is one-step Q-learning, 1 the observed return.
        returns: "peng" (never cut) or "watkins" (λ = 0 where the next action explored).
        num_envs: parallel environments N.
        num_steps: steps of each environment per rollout T.
        num_epochs: passes over the rollout.
        num_minibatches: parts each pass is split into.
        learning_rate: of the optimiser.
        optimiser: "radam", "adam" or "sgd".
        adam_epsilon: what Adam and RAdam add to the root of the second moment; None for 1e-8.
        max_grad_norm: bound on the gradient's norm; None for none.
        target_period_updates: rollouts between copies into a target network; None for no target network.
        anneal: whether the learning rate falls linearly over the run's steps.
        anneal_env_steps: environment steps over which it falls in place of the run's; only with ``anneal``.
        anneal_to: share of the learning rate that is left then, in [0, 1]; only with ``anneal``.
        normalise_observations: whether observations are centred and divided by their standard deviation so far
            (`neuralq.runs.stream.Normalisation`), as quantities of very different size need.
        refresh_targets: whether the λ-returns are computed anew, with the values of the moment, before every pass; else
            once per rollout, as published.
        average_updates: rollouts over which the parameters are averaged that greedy evaluations and the saved agent use
            (`IterateAverage`, a window of that many rollouts' gradient steps); None to use those that are learned.
    """

    lambda_: float = 0.65
    returns: str = "peng"
    num_envs: int = 32
    num_steps: int = 32
    num_epochs: int = 4
    num_minibatches: int = 4
    learning_rate: float = 1e-3
    optimiser: str = "radam"
    adam_epsilon: float | None = None
    max_grad_norm: float | None = 10.0
    target_period_updates: int | None = None
    anneal: bool = False
    anneal_env_steps: int | None = None
    anneal_to: float = 0.0
    normalise_observations: bool = False
    refresh_targets: bool = False
    average_updates: float | None = None

    def __post_init__(self) -> None:
        """Refuse values outside their range and minibatches that would be empty."""
        check_fraction("lambda_", self.lambda_, "for Monte Carlo use lambda_=1")
        check_choice("returns", self.returns, ("peng", "watkins"))
        for name in ("num_envs", "num_steps", "num_epochs", "num_minibatches"):
            check_whole(name, getattr(self, name))
        check_positive("learning_rate", self.learning_rate)
        if self.optimiser == "sgd" and self.adam_epsilon is not None:
            raise ValueError("adam_epsilon would be ignored with optimiser='sgd'; leave it out")
        if self.adam_epsilon is not None:
            check_positive("adam_epsilon", self.adam_epsilon)
        Optimiser(self.optimiser)
        if self.max_grad_norm is not None:
            check_positive("max_grad_norm", self.max_grad_norm)
        if self.target_period_updates is not None:
            check_whole("target_period_updates", self.target_period_updates)
        check_fraction("anneal_to", self.anneal_to)
        if self.anneal_env_steps is not None:
            check_whole("anneal_env_steps", self.anneal_env_steps)
        if not self.anneal and (self.anneal_env_steps is not None or self.anneal_to > 0):
            raise ValueError("anneal_env_steps and anneal_to would be ignored with anneal=False; set anneal=True")
        if self.average_updates is not None:
            check_positive("average_updates", self.average_updates)
            if self.average_updates * self.num_epochs * self.num_minibatches < 1:
                raise ValueError(
                    f"average_updates={self.average_updates!r} is less than one of the "
                    f"{self.num_epochs * self.num_minibatches} gradient steps of a rollout; leave it out"
                )
        if self.num_minibatches > self.num_envs * self.num_steps:
            rows = self.num_envs * self.num_steps
            raise ValueError(f"num_minibatches={self.num_minibatches} exceeds the {rows} samples of a rollout")

    @property
    def optimiser_constants(self) -> Optimiser:
        """The optimiser with its constants."""
        own = {} if self.adam_epsilon is None else {"eps": self.adam_epsilon}
        return Optimiser(self.optimiser, **own)


class RolloutLearner:
    """Q(λ) on rollouts ``[T, N]``.

    Args:
        engine: values and gradients of the representation.
        settings: how to learn.
        rng: draws the minibatches.
        reward_scale: rewards are multiplied by it, so values are too.
        total_updates: rollouts without a gap over which the learning rate falls; None for a constant one. Steps count:
            where environments wait for their reset, more rollouts hold as many.

    Example:
        >>> from neuralq.q import TableQ
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> settings = RolloutSettings(num_envs=1, num_steps=1, num_epochs=1, num_minibatches=1,
        ...                            optimiser="sgd", learning_rate=1.0)
        >>> learner = RolloutLearner(TorchEngine(TableQ(2, 1), Loss()), settings, np.random.default_rng(0))
        >>> one = torch.ones(1, 1)
        >>> s_tm1, a_tm1, s_t = torch.tensor([[0]]), torch.tensor([[0]]), torch.tensor([[1]])
        >>> step = Transition(s_tm1, a_tm1, one, 5 * one, 0 * one, s_t, one > 0)
        >>> learner.update(step).errors.item(), learner.engine.all(torch.tensor(0)).item()
        (5.0, 5.0)
    """

    def __init__(
        self,
        engine: Engine,
        settings: RolloutSettings,
        rng: np.random.Generator,
        reward_scale: float = 1.0,
        total_updates: int | None = None,
    ) -> None:
        self.engine = engine
        self.settings = settings
        self.rng = rng
        self.reward_scale = reward_scale
        self.num_updates = 0
        self.total_updates = total_updates
        self._descent = Descent(engine, settings.optimiser_constants, settings.learning_rate, settings.max_grad_norm)
        self._has_memory = has_memory(engine)
        self._average: IterateAverage | None = None
        if settings.average_updates is not None:
            window = settings.average_updates * settings.num_epochs * settings.num_minibatches
            self._average = IterateAverage(engine.flat.values, window)
        self._num_steps = torch.zeros((), dtype=torch.int64)  # environment steps learned from
        self._parts = {"descent": self._descent, "average": self._average, "num_steps": self._num_steps}
        if settings.target_period_updates is not None:
            engine.sync_target()

    def targets(self, transition: Transition) -> Tensor:
        """λ-returns ``[T, N]`` under the present (or the target) values."""
        target = self.settings.target_period_updates is not None
        online = seen = transition
        # The memories of a rollout are those of the parameters that collected it, as its values are.
        if self._has_memory and (target or self.settings.refresh_targets):
            online = recalled(self.engine, transition)
            seen = recalled(self.engine, transition, target) if target else online
        q_t = self.engine.all(seen.s_t, target)
        v_t = q_t.amax(-1)
        lambda_: Tensor | float = self.settings.lambda_
        if self.settings.returns == "watkins":
            greedy = rules.is_greedy(self.engine.all(online.s_tm1), transition.a_tm1)
            lambda_ = rules.watkins_lambda(self.settings.lambda_, greedy, v_t.dtype)
        r_t = transition.r_t.to(v_t.dtype) * self.reward_scale
        return rules.lambda_returns(r_t, transition.discount_t.to(v_t.dtype), v_t, lambda_, transition.last_t)

    def update(self, transition: Transition, weight: Tensor | None = None) -> Update:
        """Fit one rollout ``[T, N]``; rows of weight 0 (an autoreset's step that was never taken) are left out.

        The weights are looked through on the host; where they are on an accelerator it is waited for.
        """
        if self._has_memory:
            return self._update_sequences(transition, weight)
        targets = self.targets(transition).reshape(-1)
        rows = None if weight is None else weight.reshape(-1).nonzero()[:, 0].cpu().numpy()
        num_rows = len(targets) if rows is None else len(rows)
        errors = picked = targets
        annealed = self._annealed(len(targets), num_rows)
        for epoch in range(self.settings.num_epochs):
            if epoch > 0 and self.settings.refresh_targets:
                targets = self.targets(transition).reshape(-1)
            order = self.rng.permutation(num_rows)
            order = order if rows is None else rows[order]
            parts = [part for part in np.array_split(order, self.settings.num_minibatches) if len(part)]
            errors, picked = self._fit(transition, targets, parts, annealed) if parts else (errors, picked)
        count_update(self, self.settings.target_period_updates)
        return Update(errors, picked)

    def _annealed(self, room: int, num_rows: int) -> float:
        """Factor of the learning rate; ``num_rows`` more steps have been learned from, and a rollout has ``room``."""
        before = int(self._num_steps) / room  # in rollouts
        self._num_steps += num_rows
        return 1.0 if self.total_updates is None else max(self.settings.anneal_to, 1.0 - before / self.total_updates)

    def _update_sequences(self, transition: Transition, weight: Tensor | None) -> Update:
        """`update` where the representation has a memory: minibatches are of whole streams.

        The gradient goes back through the memory to a rollout's first step, or that of an episode.
        """
        targets = self.targets(transition)
        held = None if weight is None else weight.to(targets.device) > 0
        annealed = self._annealed(targets.numel(), targets.numel() if held is None else int(held.sum()))
        errors = picked = targets
        for epoch in range(self.settings.num_epochs):
            if epoch > 0 and self.settings.refresh_targets:
                targets = self.targets(transition)
            streams = np.array_split(self.rng.permutation(targets.shape[1]), self.settings.num_minibatches)
            for part in filter(len, streams):
                index = torch.from_numpy(part).to(targets.device)
                step = transition.map(lambda x, index=index: x[:, index])
                picked, taken = targets[:, index], None if held is None else held[:, index]
                if taken is not None and not taken.any():
                    continue
                weights = None if taken is None else stream_weights(taken, targets.dtype)
                errors = self._descent.fit(step.s_tm1, step.a_tm1, picked, weights, annealed, step.last_t)
                if taken is not None:
                    errors, picked = errors[taken], picked[taken]
                if self._average is not None:
                    self._average.update()
        count_update(self, self.settings.target_period_updates)
        return Update(errors.reshape(-1), picked.reshape(-1))

    def _fit(
        self, transition: Transition, targets: Tensor, parts: list[Array], annealed: float
    ) -> tuple[Tensor, Tensor]:
        """A gradient step for each part of the rows; errors and targets of the last.

        Where the engine computes on arrays no tensors are made of the parts: for small networks that costs a fifth.
        """
        rows: Any = (transition.s_tm1.flatten(0, 1), transition.a_tm1.reshape(-1), targets)
        on_arrays, errors, picked = self._descent.on_arrays is not None, targets, targets
        if on_arrays:
            rows = tuple(x.numpy() for x in rows)
        for part in parts:
            index = part if on_arrays else torch.from_numpy(part).to(targets.device)
            s, a, picked = (x[index] for x in rows)
            errors = self._descent.fit(s, a, picked, None, annealed)
            if self._average is not None:
                self._average.update()
        return torch.as_tensor(errors), torch.as_tensor(picked)

    def evaluation_parameters(self) -> Tensor:
        """The parameters for greedy play: the average where one is kept, else those that are learned."""
        return self.engine.flat.values if self._average is None else self._average.values

    begin_streams = state.begin_streams
    state_dict = state.state_dict

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit; before 0.4 steps were not counted apart from rollouts."""
        rows = self.settings.num_envs * self.settings.num_steps
        steps = torch.tensor(int(state_dict["num_updates"]) * rows)
        state.load_state_dict(self, {"num_steps": steps, **state_dict})


def _build(parts: Parts) -> RolloutLearner:
    settings: RolloutSettings = parts.settings
    rows = settings.num_envs * settings.num_steps
    annealed_over = settings.anneal_env_steps or parts.total_steps
    total_updates = -(-annealed_over // rows) if settings.anneal else None
    return RolloutLearner(parts.engine, settings, parts.rng, parts.reward_scale, total_updates)


def _on_table(given: Mapping[str, Any]) -> dict[str, Any]:
    """Plain steps that bring an entry by 0.03 of the way to each target of it, in small minibatches, and fall to 0.

    An entry that all B samples of a minibatch are of moves by 0.03 B of the way at most, which is kept below 1.
    """
    if given.get("optimiser", "sgd") != "sgd":
        return {}
    num_envs, num_steps = given.get("num_envs", 8), given.get("num_steps", 32)
    rows = max(1, num_envs * num_steps)
    minibatches = given.get("num_minibatches", max(1, rows // 8))
    return {
        "num_envs": num_envs,
        "num_steps": num_steps,
        "num_minibatches": minibatches,
        "optimiser": "sgd",
        "learning_rate": min(1.0, 0.03 * rows / max(1, minibatches)),
        "max_grad_norm": None,
        "anneal": True,
        "returns": "watkins",
        "lambda_": 0.5,
    }


ROLLOUT = LearnerKind(
    name="rollout",
    title="λ-returns over rollouts of parallel environments (PQN)",
    source="Peng & Williams 1996; Gallici et al. 2024",
    settings=RolloutSettings,
    build=_build,
    experience="rollouts",
    traits=lambda s: Traits(s.learning_rate, s.optimiser == "sgd", s.lambda_, s.target_period_updates),
    normalises=lambda s: (s.normalise_observations, False),
    place=1,
    step_sizes=("learning_rate",),
    on_table=_on_table,
    space={
        "learning_rate": {"from": 1e-4, "to": 5e-3, "scale": "log"},
        "lambda_": {"from": 0.3, "to": 1.0},
        "num_envs": [8, 16, 32],
        "num_steps": [16, 32, 64, 128],
        "num_epochs": {"from": 1, "to": 12, "scale": "log"},
        "num_minibatches": [4, 8, 16, 32],
        "anneal": [True, False],
        "refresh_targets": [True, False],
        "average_updates": {"from": 2.0, "to": 64.0, "scale": "log", "or": None},
        "normalise_observations": [True, False],
    },
    updates_per_step=lambda s: s.num_epochs * s.num_minibatches / (s.num_envs * s.num_steps),
)
