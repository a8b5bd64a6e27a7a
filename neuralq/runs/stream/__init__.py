"""Experience from vector environments: the one place where episodes end, and the place where they end right.

Gymnasium's vector environments restart finished episodes in one of three ways. NEXT_STEP (the default) inserts a step
that was never taken; storing it trains across episodes, so it is left out. SAME_STEP returns the next episode's first
observation and hides the true successor in ``info["final_obs"]``, which is read. DISABLED leaves the restart to the
caller, who asks for it here. What is experienced is the same in all three (tests/test_interact.py).
"""

from __future__ import annotations

from neuralq.runs.stream.faults import EnvironmentFault, faults_of
from neuralq.runs.stream.normalisation import Normalisation
from neuralq.runs.stream.spec import ObservationSpec
from neuralq.runs.stream.stream import Episode, Interaction, Policy, Step, interact
from neuralq.runs.stream.vector_env import MASK_METHODS, SubEnv, SubEnvFault, legal_actions, make_vector_env

__all__ = [
    "MASK_METHODS",
    "EnvironmentFault",
    "Episode",
    "Interaction",
    "Normalisation",
    "ObservationSpec",
    "Policy",
    "Step",
    "SubEnv",
    "SubEnvFault",
    "faults_of",
    "interact",
    "legal_actions",
    "make_vector_env",
]
