"""Distributional Q-learning from replay: the target is where a transition moves the whole distribution.

From the target copy, the action with the best *mean* in the successor is followed (with "double" it is chosen by the
online network, with "munchausen" the softmax policy mixes all of them), and every represented value z of it becomes
r + γ z. `QuantileQ` regresses its values on these (QR-DQN, Dabney et al. 2018), `CategoricalQ` takes their projection
on its grid for labels (C51, Bellemare, Dabney & Munos 2017).

What is reported as an error is the difference of the means; priorities are made of it as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neuralq import rules
from neuralq.learners.learner import Descent, Update
from neuralq.learners.optim import Optimiser
from neuralq.learners.replay.settings import ReplaySettings
from neuralq.q.distributional import CategoricalQ, atoms, distribution_of
from neuralq.q.engine import Engine, TorchEngine
from neuralq.q.masked import MaskedQ
from neuralq.rules.shapes import check_same_shape
from neuralq.types import QFunction, Transition

__all__ = ["DistributionalLearner"]


class DistributionalLearner:
    """QR-DQN or C51 on samples ``[B]`` with a target network.

    Args:
        engine: of a `QuantileQ` or a `CategoricalQ`, masked or not.
        settings: how to learn; ``distribution`` must name that representation.
        reward_scale: rewards are multiplied by it, so values are too (and a categorical grid must be).

    Raises:
        ValueError: if representation and settings do not go together.

    Example:
        >>> from neuralq.q import CategoricalQ, TableQ
        >>> from neuralq.q.engine import Loss
        >>> engine = TorchEngine(CategoricalQ(TableQ(2, 3), 3, value_min=0.0, value_max=2.0), Loss())
        >>> settings = ReplaySettings(distribution="categorical", num_atoms=3, value_min=0.0, value_max=2.0)
        >>> learner = DistributionalLearner(engine, settings)
        >>> row = torch.tensor
        >>> step = Transition(row([0]), row([0]), row([1.0]), row([1.5]), row([0.0]), row([1]), row([True]))
        >>> learner.targets(step).tolist()  # half of the mass on 1, half on 2
        [[0.0, 0.5, 0.5]]
    """

    def __init__(self, engine: TorchEngine, settings: ReplaySettings, reward_scale: float = 1.0) -> None:
        kind = "categorical" if isinstance(distribution_of(engine.q), CategoricalQ) else "quantile"
        if settings.distribution != kind or settings.num_atoms != distribution_of(engine.q).num_atoms:
            raise ValueError(
                f"settings with distribution={settings.distribution!r} and num_atoms={settings.num_atoms} do not go "
                f"with a {kind} representation of {distribution_of(engine.q).num_atoms} atoms; make them alike"
            )
        self.engine: Engine = engine
        self._networks = engine
        self.settings = settings
        self.reward_scale = reward_scale
        self.num_updates = 0
        self._descent = Descent(engine, Optimiser(settings.optimiser), settings.learning_rate, settings.max_grad_norm)
        engine.sync_target()

    @torch.no_grad()
    def targets(self, transition: Transition) -> Tensor:
        """What the pair's K numbers should describe, ``[B, K]``: equally likely values, or probabilities."""
        target = self._networks.network(target=True)
        q_t, outputs_t = target.all(transition.s_t), atoms(target, transition.s_t)
        r_t = transition.r_t.to(q_t.dtype) * self.reward_scale
        discount_t = transition.discount_t.to(q_t.dtype)[:, None]
        if self.settings.target_rule == "munchausen":
            temperature, alpha, floor = self.settings.munchausen_numbers
            q_tm1 = target.all(transition.s_tm1)
            r_t = r_t + rules.munchausen_bonus(q_tm1, transition.a_tm1, temperature, alpha, floor)
            soft = _soft(q_t, outputs_t, temperature)
            return rules.one_step(r_t[:, None].expand_as(soft), discount_t.expand_as(soft), soft)
        chooser = self.engine.q.all(transition.s_t) if self.settings.target_rule == "double" else q_t
        followed = _at(outputs_t, chooser.argmax(-1))
        distribution = distribution_of(target)
        if isinstance(distribution, CategoricalQ):
            moved = r_t[:, None] + discount_t * distribution.support
            return rules.categorical_projection(moved, torch.softmax(followed, -1), distribution.support)
        return r_t[:, None] + discount_t * followed

    def update(self, transition: Transition, weight: Tensor | None = None) -> Update:
        """One descent step on a batch; ``weight`` ``[B]`` multiplies each sample's loss."""
        s, a = transition.s_tm1, transition.a_tm1
        check_same_shape("a_tm1", a, "r_t", transition.r_t)
        _check_legal(self.engine.q, s, a, weight)
        targets = self.targets(transition)
        self.engine.flat.grad.zero_()
        outputs = _at(atoms(self.engine.q, s), a)
        distribution = distribution_of(self.engine.q)
        if isinstance(distribution, CategoricalQ):
            each = rules.categorical_cross_entropy(outputs, targets)
            aim = (targets * distribution.support).sum(-1)
        else:
            each, aim = rules.quantile_huber(outputs, targets), targets.mean(-1)
        if weight is not None:
            check_same_shape("weight", weight, "r_t", transition.r_t)
            each = each * weight.to(each)
        each.mean().backward()  # type: ignore[no-untyped-call]
        errors = aim - distribution.mean(outputs.detach())
        self._descent.follow()
        self.num_updates += 1
        if self.num_updates % (self.settings.target_period_updates or 1) == 0:
            self.engine.sync_target()
        return Update(errors, aim)

    def begin_streams(self) -> None:
        """Nothing connects one sample to the next."""

    def state_dict(self) -> dict[str, Any]:
        """Parameters, optimiser, target copy and counters."""
        return {"num_updates": self.num_updates, "descent": self._descent.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit."""
        self.num_updates = int(state["num_updates"])
        self._descent.load_state_dict(state["descent"])


def _at(outputs: Tensor, a: Tensor) -> Tensor:
    """The K numbers of the given actions: ``([B, A, K], [B]) -> [B, K]``."""
    return outputs.gather(1, a[:, None, None].expand(-1, 1, outputs.shape[-1]))[:, 0]


def _soft(q: Tensor, outputs: Tensor, temperature: float) -> Tensor:
    """Values whose mean is the soft value of the state: the policy's mixture of each, and its entropy."""
    pi = rules.softmax(q, temperature)
    entropy = rules.soft_value(q, temperature) - rules.expected_value(q, pi)
    return (pi[..., None] * outputs).sum(-2) + entropy[..., None]


def _check_legal(q: QFunction, s: Tensor, a: Tensor, weight: Tensor | None) -> None:
    if isinstance(q, MaskedQ):
        q.check_legal(s, a, weight)
