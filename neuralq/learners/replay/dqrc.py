"""DQRC: Q-learning from replay with the gradient correction of QRC, without a target network (Patterson et al. 2022).

Deep Q-learning freezes its targets for stability; QRC corrects the gradient instead. A second function h(s, a) ≈ E[δ]
is fitted by squares, pulled to 0 with strength β, and the values descend

    L(θ) = mean[ ½ (r + γ max Q(s') − Q(s, a))² ] + mean[ h(s, a) · γ max Q(s') ],

where the target in the first term and h in the second are held fixed, so that the bootstrap is differentiated in the
second term only: −∇L = δ ∇Q − h γ ∇max Q', the direction of TDC. Any optimiser may follow it.

`TwinHead` is the h of the paper: a second last layer on the hidden units of Q, whose gradient does not reach them.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import cast

import torch
from torch import Tensor, nn

from neuralq import rules
from neuralq.learners import state
from neuralq.learners.gradient.correction import HeadCorrection
from neuralq.learners.gradient.differentiation import gradient, greedy_value, module_parameters
from neuralq.learners.learner import Update
from neuralq.learners.optim import FlatOptimiser, clip_norm_
from neuralq.learners.replay.settings import ReplaySettings
from neuralq.q.bodies import Trunk
from neuralq.q.compiled import MlpEngine
from neuralq.q.engine import Engine
from neuralq.q.masked import MaskedQ
from neuralq.rules.shapes import check_same_shape
from neuralq.types import QFunction, Transition

__all__ = ["DQRCLearner", "TwinHead", "has_hidden_units"]


def _trunk_of(q: QFunction) -> Trunk | None:
    """The dense layers of a network, None where there are none: a table or a linear function."""
    trunk = getattr(q.inner if isinstance(q, MaskedQ) else q, "trunk", None)
    return trunk if isinstance(trunk, Trunk) else None


def has_hidden_units(q: QFunction) -> bool:
    """Whether there are hidden units that a second function could share, as there are in a network.

    Example:
        >>> from neuralq.q import ActionOutputQ, TableQ
        >>> has_hidden_units(TableQ(3, 2)), has_hidden_units(ActionOutputQ((4,), 2))
        (False, True)
    """
    return _trunk_of(q) is not None


class TwinHead(nn.Module):
    """A second last layer, from 0, on the detached hidden units of a network of any layout.

    Args:
        q: one of the three layouts, or one under `neuralq.q.MaskedQ`.

    Raises:
        ValueError: if ``q`` has no layers; a table or a linear function is its own last layer.

    Example:
        >>> from neuralq.q import MLP, ActionOutputQ
        >>> head = TwinHead(ActionOutputQ((4,), num_actions=2, body=MLP(hidden=(8,)), rng=0))
        >>> head.all(torch.ones(3, 4)).tolist(), sum(p.numel() for p in head.parameters())
        ([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]], 18)
    """

    def __init__(self, q: QFunction) -> None:
        super().__init__()
        trunk = _trunk_of(q)
        if trunk is None:
            inner = q.inner if isinstance(q, MaskedQ) else q
            raise ValueError(
                f"{type(inner).__name__} has no hidden units to share; hand in a function of its own, such as another "
                f"{type(inner).__name__}"
            )
        self.num_actions = q.num_actions
        # In a tuple, so that the parameters of Q do not become those of h.
        self._shared = (q, trunk.layers[-1])
        self.layer = copy.deepcopy(trunk.layers[-1])
        for p in self.layer.parameters():
            p.data = torch.zeros_like(p)

    def _in_place_of_the_last_layer(self, call: Callable[[], Tensor]) -> Tensor:
        """Run Q with this layer for its last: whatever the layout makes of the outputs, it makes of ours."""

        def instead(_module: nn.Module, hidden: tuple[Tensor, ...], _output: Tensor) -> Tensor:
            return cast(Tensor, self.layer(hidden[0].detach()))

        hook = self._shared[1].register_forward_hook(instead)
        try:
            return call()
        finally:
            hook.remove()

    def all(self, s: Tensor) -> Tensor:
        """Values of h for every action: ``[*n, *obs] -> [*n, A]``."""
        return self._in_place_of_the_last_layer(lambda: self._shared[0].all(s))

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        """Values of h for the given actions: ``([*n, *obs], [*n] int64) -> [*n]``."""
        return self._in_place_of_the_last_layer(lambda: self._shared[0].at(s, a))


class DQRCLearner:
    """Gradient-corrected Q-learning on samples ``[B]``.

    Args:
        engine: action values of any representation.
        head: the second function, with as many actions: a `TwinHead`, or any other Q-function.
        settings: how to learn; ``target_rule`` must be "dqrc".
        reward_scale: rewards are multiplied by it, so values are too.

    Raises:
        ValueError: for another target rule.

    Source: Patterson, White, White 2022 (DQRC); Ghiassian et al. 2020 (QRC).

    Example:
        >>> from neuralq.q import TableQ
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> settings = ReplaySettings(target_rule="dqrc", learning_rate=0.5, optimiser="sgd")
        >>> learner = DQRCLearner(TorchEngine(TableQ(2, 1), Loss()), TableQ(2, 1), settings)
        >>> row = torch.tensor
        >>> step = Transition(row([0]), row([0]), row([1.0]), row([4.0]), row([0.5]), row([1]), row([False]))
        >>> _ = learner.update(step)  # δ = 4, h = 0
        >>> _ = learner.update(step)  # δ = 2, h = 2: Q(0) += ½·2, Q(1) −= ½·½·2
        >>> learner.engine.all(torch.arange(2))[:, 0].tolist()
        [3.0, -0.5]
    """

    def __init__(self, engine: Engine, head: QFunction, settings: ReplaySettings, reward_scale: float = 1.0) -> None:
        if not settings.rule.correction:
            raise ValueError(
                f"a DQRCLearner learns by target_rule='dqrc', got {settings.target_rule!r}; use ReplayLearner"
            )
        self.engine = engine
        self.head = head
        self.settings = settings
        self.reward_scale = reward_scale
        self.num_updates = 0
        self._correction = HeadCorrection(head)
        self._parameters = module_parameters(engine.q)
        self._parameters_h = module_parameters(head)
        self._beta, self._rate_h = settings.options["dqrc_beta"], settings.options["dqrc_learning_rate"]
        self._state = FlatOptimiser(settings.optimiser_constants, engine.flat.values)
        self._state_h = FlatOptimiser(settings.optimiser_constants, self._correction.values)
        optimisers = {"optimiser": self._state, "optimiser_h": self._state_h}
        self._parts = {"parameters": engine.flat, "h": self._correction.values, **optimisers}

    @property
    def engine_name(self) -> str:
        """What computes: "torch", or where there are kernels for values "compiled and torch"."""
        return "compiled and torch" if isinstance(self.engine, MlpEngine) else "torch"

    def update(self, transition: Transition, weight: Tensor | None = None) -> Update:
        """One step of both functions on a batch; ``weight`` ``[B]`` multiplies each sample's losses."""
        s, a, dtype = transition.s_tm1, transition.a_tm1, self.engine.flat.values.dtype
        if isinstance(self.engine.q, MaskedQ):
            self.engine.q.check_legal(s, a, weight)
        q = self.engine.q.at(s, a)
        h = self.head.at(s, a)
        v_t = greedy_value(self.engine.q.all(transition.s_t))
        bootstrap = rules.weighted_value(transition.discount_t.to(dtype), v_t)
        target = transition.r_t.to(dtype) * self.reward_scale + bootstrap.detach()
        delta = target - q.detach()
        corrected = rules.squared(target - q) + h.detach() * bootstrap
        regression = rules.squared(delta - h)
        if weight is not None:
            check_same_shape("weight", weight, "r_t", transition.r_t)
            weight = weight.to(delta.device)
            corrected, regression = corrected * weight, regression * weight
        grad = gradient(corrected.mean(), self._parameters)
        grad_h = gradient(regression.mean(), self._parameters_h) + self._beta * self._correction.values
        if self.settings.max_grad_norm is not None:
            clip_norm_(grad, self.settings.max_grad_norm)
            clip_norm_(grad_h, self.settings.max_grad_norm)
        self._state.step(grad, self.settings.learning_rate)
        self._state_h.step(grad_h, self._rate_h)
        self.num_updates += 1
        return Update(delta, target)

    begin_streams = state.begin_streams
    state_dict = state.state_dict
    load_state_dict = state.load_state_dict
