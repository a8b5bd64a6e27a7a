"""Learners: short compositions of a representation, pure rules and an optimiser.

Each has ``update(transition, weight) -> Update``, ``state_dict()`` and ``load_state_dict()``, and decides, alone in the
library, what is held fixed when a gradient is taken. `RolloutLearner` uses the forward view of TD(λ) over rollouts,
`ReplayLearner` stored transitions or blocks of them, `OnlineLearner` and `PredictionLearner` the backward view with
eligibility traces, one step at a time.
"""

from neuralq.learners.batch import ReplayLearner, ReplaySettings
from neuralq.learners.online import OnlineLearner, OnlineSettings, PredictionLearner
from neuralq.learners.rollout import RolloutLearner, RolloutSettings
from neuralq.learners.update import Descent, Learner, Update

__all__ = [
    "Descent",
    "Learner",
    "OnlineLearner",
    "OnlineSettings",
    "PredictionLearner",
    "ReplayLearner",
    "ReplaySettings",
    "RolloutLearner",
    "RolloutSettings",
    "Update",
]
