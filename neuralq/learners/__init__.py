"""Learners: short compositions of a representation, pure rules and an optimiser.

Each has ``update(transition, weight) -> Update``, ``state_dict()`` and ``load_state_dict()``, and decides, alone in the
library, what is held fixed when a gradient is taken. `RolloutLearner` uses the forward view of TD(λ) over rollouts,
`ReplayLearner` stored transitions or blocks of them, `DistributionalLearner` as well, for the whole distribution of the
return; `OnlineLearner` and `PredictionLearner` the backward view with eligibility traces, one step at a time;
`StreamingLearner` as well, with a step that is bounded by what it would do.

Prediction is control with one action. True online TD(λ) is `PredictionLearner` with ``trace="dutch"`` on a table or
linear features (its Q(λ) in runs: ``--learner online --online.trace dutch``); streaming TD(λ) is `StreamingLearner` on
a representation with one output, which bounds its step, or `PredictionLearner`, which does not.

`smdp_network_update` learns from actions that last, one decision at a time, from Python and from compiled loops.

`TabularLearner` runs the compiled loops of `neuralq.tabular`: every algorithm of the chapter on a table.

Where those diverge, others converge: `ResidualGradientLearner` descends the Bellman residual,
`GradientPredictionLearner` and `GradientQLearner` the projected Bellman error step by step, `DQRCLearner` from replay.

`learn_afterstates` learns values of what actions lead to, so that there may be others in every state (TD(λ), compiled).

`turned_q_update` and `turned_actor_critic_update` judge actions that are each other's rotations by one network, and
`Lessons` keeps whole episodes, a teacher's too, to live through them again (compiled).

`fit_slopes` fits a small network to values and slopes at once, for whoever has a model that explains what was seen.

A learner that runs can be made of ends with its `LearnerKind`; `learner_kinds` finds it, and nothing else lists it.
"""

from neuralq.learners.afterstates import (
    ValueNetwork,
    choose_afterstate,
    learn_afterstates,
    new_value_network,
    value_of,
)
from neuralq.learners.descent import Descent
from neuralq.learners.gradient.correction import HeadCorrection, TangentCorrection
from neuralq.learners.gradient.learner import GradientPredictionLearner, GradientQLearner
from neuralq.learners.gradient.residual import ResidualGradientLearner, ResidualGradientSettings
from neuralq.learners.gradient.settings import GradientSettings
from neuralq.learners.gradient.step import GradientTDSettings
from neuralq.learners.kind import LearnerKind, Parts, Representation, Traits, learner_kinds
from neuralq.learners.learner import HasEngineName, HasValues, Learner, Update
from neuralq.learners.lessons import (
    Lessons,
    begin_lesson,
    new_lessons,
    note_step,
    recent_lesson,
    replay_actor_critic,
    replay_q,
)
from neuralq.learners.replay.distributional import DistributionalLearner
from neuralq.learners.replay.dqrc import DQRCLearner, TwinHead
from neuralq.learners.replay.learner import ReplayLearner
from neuralq.learners.replay.settings import ReplaySettings
from neuralq.learners.rollout import RolloutLearner, RolloutSettings
from neuralq.learners.semi_markov import (
    SmdpNetwork,
    new_smdp_network,
    smdp_network_update,
    smdp_network_values,
)
from neuralq.learners.slopes import SlopeNet, fit_slopes, new_slope_net
from neuralq.learners.tabular.learner import TabularLearner
from neuralq.learners.tabular.settings import TabularSettings
from neuralq.learners.traces.learner import OnlineLearner, OnlineSettings, PredictionLearner
from neuralq.learners.traces.streaming import StreamingLearner, StreamingSettings
from neuralq.learners.turned import (
    TurnedNetwork,
    new_turned_network,
    turned_action,
    turned_actor_critic_update,
    turned_policy,
    turned_q_update,
    turned_update,
    turned_values,
)

__all__ = [
    "DQRCLearner",
    "Descent",
    "DistributionalLearner",
    "GradientPredictionLearner",
    "GradientQLearner",
    "GradientSettings",
    "GradientTDSettings",
    "HasEngineName",
    "HasValues",
    "HeadCorrection",
    "Learner",
    "LearnerKind",
    "Lessons",
    "OnlineLearner",
    "OnlineSettings",
    "Parts",
    "PredictionLearner",
    "ReplayLearner",
    "ReplaySettings",
    "Representation",
    "ResidualGradientLearner",
    "ResidualGradientSettings",
    "RolloutLearner",
    "RolloutSettings",
    "SlopeNet",
    "SmdpNetwork",
    "StreamingLearner",
    "StreamingSettings",
    "TabularLearner",
    "TabularSettings",
    "TangentCorrection",
    "Traits",
    "TurnedNetwork",
    "TwinHead",
    "Update",
    "ValueNetwork",
    "begin_lesson",
    "choose_afterstate",
    "fit_slopes",
    "learn_afterstates",
    "learner_kinds",
    "new_lessons",
    "new_slope_net",
    "new_smdp_network",
    "new_turned_network",
    "new_value_network",
    "note_step",
    "recent_lesson",
    "replay_actor_critic",
    "replay_q",
    "smdp_network_update",
    "smdp_network_values",
    "turned_action",
    "turned_actor_critic_update",
    "turned_policy",
    "turned_q_update",
    "turned_update",
    "turned_values",
    "value_of",
]
