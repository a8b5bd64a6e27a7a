"""Distributional Q-learning from replay: the target is where a transition moves the whole distribution.

What the target rule follows in the successor is decided by the *means*, and every represented value z of it, by the
target copy, becomes r + γ z. What is made of these is said in `neuralq.learners.replay.distributions`: `QuantileQ`
regresses its values on them (QR-DQN, Dabney et al. 2018), `ImplicitQuantileQ` its values at levels drawn anew (IQN,
Dabney, Ostrovski, Silver & Munos 2018), `CategoricalQ` takes their projection on its grid for labels (C51, Bellemare,
Dabney & Munos 2017).

What is reported as an error is the difference of the means; priorities are made of it as well.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from neuralq.learners import state
from neuralq.learners.descent import Descent
from neuralq.learners.learner import Update
from neuralq.learners.replay.distributions.record import Distribution, Moved, distributions
from neuralq.learners.replay.iterates import average_for, evaluation_parameters, finish_update
from neuralq.learners.replay.settings import ReplaySettings
from neuralq.q.distributional import atoms, distribution_of
from neuralq.q.engine import Engine, TorchEngine
from neuralq.q.masked import MaskedQ
from neuralq.rules import Seen
from neuralq.rules.shapes import check_same_shape
from neuralq.types import QFunction, Transition

__all__ = ["DistributionalLearner"]


class DistributionalLearner:
    """Distributional Q-learning on samples ``[B]`` with a target network.

    Args:
        engine: of a `QuantileQ`, an `ImplicitQuantileQ` or a `CategoricalQ`, masked or not.
        settings: how to learn; ``distribution`` must name that representation.
        reward_scale: rewards are multiplied by it, so values are too (and a categorical grid must be).
        rng: draws the levels of an update where the description has them drawn.

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

    def __init__(
        self,
        engine: TorchEngine,
        settings: ReplaySettings,
        reward_scale: float = 1.0,
        rng: np.random.Generator | None = None,
    ) -> None:
        self._record = _record_for(engine.q, settings)
        self.engine: Engine = engine
        self._networks = engine
        self.settings = settings
        self.reward_scale = reward_scale
        self.rng = np.random.default_rng(0) if rng is None else rng
        self.num_updates = 0
        self._options = settings.options
        self._descent = Descent(engine, settings.optimiser_constants, settings.learning_rate, settings.max_grad_norm)
        self._average = average_for(engine, settings)
        self._parts = {"descent": self._descent, "average": self._average}
        engine.sync_target()

    def targets(self, transition: Transition) -> Tensor:
        """What the pair's numbers should describe: values ``[B, J]``, or probabilities ``[B, K]`` on a grid."""
        moved = self._moved(transition)
        return moved.values if moved.probabilities is None or moved.values.dim() > 1 else moved.probabilities

    @torch.no_grad()
    def _moved(self, transition: Transition) -> Moved:
        target, move, follows = self._networks.network(target=True), self._record.move, self.settings.rule.follows
        assert move is not None and follows is not None
        seen = Seen(transition, self.engine.all, self.reward_scale, self.settings.lambda_, self._options)
        outputs_t = atoms(target, transition.s_t, self._levels(len(transition.a_tm1)))
        return move(distribution_of(target), seen.r_t, seen.discount_t, outputs_t, follows(seen))

    def _levels(self, num_rows: int) -> Tensor | None:
        """Levels ``[B, K]`` drawn for one side of an update, where they are drawn."""
        if self._record.levels is None or self.settings.num_atoms is None:
            return None
        drawn = self._record.levels(num_rows, self.settings.num_atoms, self.rng)
        return drawn.to(self.engine.flat.values.device, non_blocking=True)

    def update(self, transition: Transition, weight: Tensor | None = None) -> Update:
        """One descent step on a batch; ``weight`` ``[B]`` multiplies each sample's loss."""
        s, a = transition.s_tm1, transition.a_tm1
        check_same_shape("a_tm1", a, "r_t", transition.r_t)
        if isinstance(self.engine.q, MaskedQ):
            self.engine.q.check_legal(s, a, weight)
        moved, levels = self._moved(transition), self._levels(len(a))
        self.engine.flat.grad.zero_()
        outputs = atoms(self.engine.q, s, levels)
        outputs = outputs.gather(1, a[:, None, None].expand(-1, 1, outputs.shape[-1]))[:, 0]
        assert self._record.loss is not None
        each, aim = self._record.loss(outputs, moved, levels), moved.mean()
        if weight is not None:
            check_same_shape("weight", weight, "r_t", transition.r_t)
            each = each * weight.to(each)
        each.mean().backward()  # type: ignore[no-untyped-call]
        errors = aim - distribution_of(self.engine.q).mean(outputs.detach())
        self._descent.step()
        finish_update(self)
        return Update(errors, aim)

    evaluation_parameters = evaluation_parameters
    begin_streams = state.begin_streams
    state_dict = state.state_dict
    load_state_dict = state.load_state_dict


def _record_for(q: QFunction, settings: ReplaySettings) -> Distribution:
    """The distribution that the settings name, if ``q`` describes it."""
    named, inner = settings.returns, distribution_of(q)
    num_atoms = getattr(inner, "num_atoms", settings.num_atoms)  # where levels are drawn any number will do
    if named.q_class is None or not isinstance(inner, named.q_class) or settings.num_atoms != num_atoms:
        known = [x.name for x in distributions().values() if x.q_class is not None and isinstance(inner, x.q_class)]
        raise ValueError(
            f"settings with distribution={settings.distribution!r} and num_atoms={settings.num_atoms} do not go "
            f"with a {', '.join(known)} representation of {num_atoms} atoms; make them alike"
        )
    return named
