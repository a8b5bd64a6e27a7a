"""Exploring by noisy networks: a learner from replay whose noise is drawn anew for every action and every update.

An action is greedy by values under noise of its own (all environments of a step share it), so ε may be 0. In an update
the network and its target copy each get noise of their own, which all samples of the batch share. Everything else,
greedy evaluation above all, computes with the means. The draws come from the run's generator of samples, whose state
is part of a checkpoint, and nothing of the noise outlives a step, so that runs resume bit for bit.

Source: Fortunato et al. (2018), section 3.1; one draw for choosing and valuing in double Q-learning as in Hessel et al.
(2018), where they draw two.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from neuralq.learners.averaging import evaluation_parameters
from neuralq.learners.learner import Update
from neuralq.learners.replay.distributional import DistributionalLearner
from neuralq.learners.replay.learner import ReplayLearner
from neuralq.q.engine import Engine, TorchEngine
from neuralq.q.noisy import draw_noise, noisy_layers, remove_noise
from neuralq.types import Transition

__all__ = ["NoisyLearner"]


class NoisyLearner:
    """A replay learner on a network with noisy layers (`neuralq.q.noisy.made_noisy`).

    Args:
        learner: what learns; its engine is a `TorchEngine`.
        rng: draws the noise.

    Example:
        >>> import torch
        >>> from neuralq.learners.replay.settings import ReplaySettings
        >>> from neuralq.q import MLP, ActionOutputQ
        >>> from neuralq.q.engine import Loss
        >>> from neuralq.q.noisy import made_noisy
        >>> rng = np.random.default_rng(0)
        >>> q = made_noisy(ActionOutputQ((4,), 2, MLP((8,)), rng=0), rng)
        >>> learner = NoisyLearner(ReplayLearner(TorchEngine(q, Loss()), ReplaySettings(noisy=True)), rng)
        >>> s = torch.zeros(3, 4)
        >>> bool((learner.values(s) != learner.values(s)).all()), torch.equal(q.all(s), q.all(s))
        (True, True)
    """

    def __init__(self, learner: ReplayLearner | DistributionalLearner, rng: np.random.Generator) -> None:
        assert isinstance(learner.engine, TorchEngine), "kernels know no noisy layers"
        self._learner, self.settings = learner, learner.settings
        self.engine: Engine = learner.engine
        self.rng = rng
        self._layers = noisy_layers(learner.engine.q)
        self._all_layers = [*self._layers, *noisy_layers(learner.engine.network(target=True))]

    @property
    def num_updates(self) -> int:
        """Updates so far."""
        return self._learner.num_updates

    def values(self, s: Tensor) -> Tensor:
        """Action values under new noise, by which to act: ``[N, *obs] -> [N, A]``."""
        draw_noise(self._layers, self.rng)
        try:
            return self.engine.all(s)
        finally:
            remove_noise(self._layers)

    def update(self, transition: Transition, weight: Tensor | None = None) -> Update:
        """One descent step under new noise."""
        draw_noise(self._all_layers, self.rng)
        try:
            return self._learner.update(transition, weight)
        finally:
            remove_noise(self._all_layers)

    def evaluation_parameters(self) -> Tensor:
        """The parameters for greedy play, which is by their means."""
        return evaluation_parameters(self._learner)

    def begin_streams(self) -> None:
        """Every stream of experience starts anew."""
        self._learner.begin_streams()

    def state_dict(self) -> dict[str, Any]:
        """That of what learns."""
        return self._learner.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`."""
        self._learner.load_state_dict(state)
