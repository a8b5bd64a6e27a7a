"""Q-learning from stored experience, by any rule of `neuralq.rules.target_rules` that freezes its targets.

One-step and n-step samples come ready from the replay buffer (its discount is that of the whole stretch), so the same
rule serves both. Blocks ``[T, B]`` get λ-returns from the target copy, as in DQN(λ) (Daley & Amato, 2019).
"""

from __future__ import annotations

import torch
from torch import Tensor

from neuralq.learners import state
from neuralq.learners.descent import Descent
from neuralq.learners.learner import Update
from neuralq.learners.replay.conservative import conservative_gradient
from neuralq.learners.replay.distributions.record import MEAN
from neuralq.learners.replay.iterates import average_for, evaluation_parameters, finish_update
from neuralq.learners.replay.settings import ReplaySettings
from neuralq.learners.replay.targets import q_learning_array_targets, q_learning_targets
from neuralq.learners.sequences import after_burn_in, has_memory, recalled
from neuralq.q.engine import Engine
from neuralq.rules import Seen
from neuralq.rules.one_step import Q_LEARNING
from neuralq.types import Array, Transition

__all__ = ["ReplayLearner"]


class ReplayLearner:
    """Q-learning on samples ``[B]`` or blocks ``[T, B]`` with a target network.

    Args:
        engine: values and gradients of the representation, with the loss in it.
        settings: how to learn.
        reward_scale: rewards are multiplied by it, so values are too.

    Raises:
        ValueError: for settings that another learner is for: a distribution, or "dqrc".

    Example:
        >>> import torch
        >>> from neuralq.q import TableQ
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> settings = ReplaySettings(optimiser="sgd", learning_rate=1.0, loss="squared")
        >>> learner = ReplayLearner(TorchEngine(TableQ(2, 1), Loss()), settings)
        >>> one = torch.ones(1)
        >>> step = Transition(torch.tensor([0]), torch.tensor([0]), one, 5 * one, 0 * one, torch.tensor([1]), one > 0)
        >>> learner.update(step).errors.tolist(), learner.engine.all(torch.tensor(0)).item()
        ([5.0], 5.0)
    """

    def __init__(self, engine: Engine, settings: ReplaySettings, reward_scale: float = 1.0) -> None:
        if settings.returns is not MEAN or settings.rule.correction:
            raise ValueError(
                f"a ReplayLearner learns means from frozen targets, got distribution={settings.distribution!r} and "
                f"target_rule={settings.target_rule!r}; use DistributionalLearner or DQRCLearner"
            )
        self.engine = engine
        self.settings = settings
        self.reward_scale = reward_scale
        self.num_updates = 0
        self._descent = Descent(engine, settings.optimiser_constants, settings.learning_rate, settings.max_grad_norm)
        self._average = average_for(engine, settings)
        self._has_memory = has_memory(engine)
        self._parts = {"descent": self._descent, "average": self._average}
        self._options = settings.options
        self._is_plain = settings.rule is Q_LEARNING
        self._seen: Transition | None = None
        self._seen_arrays: tuple[Array, ...] | None = None
        engine.sync_target()
        one = torch.ones(1, dtype=engine.flat.values.dtype)
        q_learning_targets(one, one, one[:, None])  # compiled here, so that a run's clock measures training

    def targets(self, transition: Transition) -> Tensor:
        """Targets of the chosen rule, with the shape of ``r_t``."""
        if self._is_plain:
            q_t = self.engine.all(transition.s_t, target=True)
            return q_learning_targets(transition.r_t, transition.discount_t, q_t, self.reward_scale)
        seen = Seen(transition, self.engine.all, self.reward_scale, self.settings.lambda_, self._options)
        return self.settings.rule.target(seen)

    def update(self, transition: Transition, weight: Tensor | None = None) -> Update:
        """One descent step on a batch; ``weight``, shaped like ``r_t``, multiplies each sample's loss."""
        if self._has_memory:
            return self._update_sequences(transition, weight)
        arrays = self._arrays_of(transition)
        if arrays is not None:
            return self._update_arrays(arrays, None if weight is None else weight.to(transition.r_t.dtype).numpy())
        targets = self.targets(transition)
        s, a = transition.s_tm1, transition.a_tm1
        weight = None if weight is None else weight.to(targets.device)
        if targets.dim() == 2:
            s, a, targets = s.flatten(0, 1), a.reshape(-1), targets.reshape(-1)
            weight = None if weight is None else weight.reshape(-1)
        if self.settings.conservative_alpha:
            errors = conservative_gradient(self.engine, s, a, targets, weight, self.settings.conservative_alpha)
            self._descent.step()
        else:
            errors = self._descent.fit(s, a, targets, weight)
        finish_update(self)
        return Update(errors, targets)

    def _update_sequences(self, transition: Transition, weight: Tensor | None) -> Update:
        """`update` by blocks ``[T, B]`` where the representation has a memory, after rows that bring it along.

        Values and targets each go by the memories that their own parameters have.
        """
        if transition.r_t.dim() != 2:
            raise ValueError(f"a memory is learned from blocks [T, B], got rows {tuple(transition.r_t.shape)}")
        burn_in = self.settings.burn_in
        frozen = recalled(self.engine, transition, target=True)
        targets = self.targets(frozen.map(lambda x: x[burn_in:]))
        step = after_burn_in(self.engine, transition, burn_in)
        weight = None if weight is None else weight[burn_in:].to(targets.device)
        errors = self._descent.fit(step.s_tm1, step.a_tm1, targets, weight, last=step.last_t)
        finish_update(self)
        return Update(errors.reshape(-1), targets.reshape(-1))

    def _arrays_of(self, transition: Transition) -> tuple[Array, ...] | None:
        """Observation, action, reward, discount and successor as arrays, where the quick way applies.

        A replay buffer hands out the same tensors every time, so their arrays are made once.
        """
        if transition is not self._seen:
            self._seen, self._seen_arrays = transition, None
            t, dtype = transition, self.engine.flat.values.dtype
            plain = self._descent.on_arrays is not None and self._is_plain and not self.settings.conservative_alpha
            alike = t.r_t.dtype == t.discount_t.dtype == dtype and t.r_t.shape == t.discount_t.shape == t.a_tm1.shape
            if plain and alike and t.r_t.dim() == 1 and len(t.s_tm1) == len(t.s_t) == len(t.r_t):
                self._seen_arrays = tuple(x.numpy() for x in (t.s_tm1, t.a_tm1, t.r_t, t.discount_t, t.s_t))
        return self._seen_arrays

    def _update_arrays(self, arrays: tuple[Array, ...], weight: Array | None) -> Update:
        """`update` by one-step Q-learning, without tensors."""
        s_tm1, a_tm1, r_t, discount_t, s_t = arrays
        assert self._descent.on_arrays is not None
        q_t = self._descent.on_arrays.all_arrays(s_t, target=True)
        targets = q_learning_array_targets(r_t, discount_t, q_t, self.reward_scale)
        errors = self._descent.fit(s_tm1, a_tm1, targets, weight)
        finish_update(self)
        return Update(torch.from_numpy(errors), torch.from_numpy(targets))

    evaluation_parameters = evaluation_parameters
    begin_streams = state.begin_streams
    state_dict = state.state_dict
    load_state_dict = state.load_state_dict
