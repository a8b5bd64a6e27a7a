"""Finite Markov decision processes: the model, its outcomes, samples of it, and environments made of it."""

from neuralq.mdp.aliased import AliasedMDP
from neuralq.mdp.environment import ModelEnv, ModelVectorEnv
from neuralq.mdp.model import FiniteMDP
from neuralq.mdp.outcomes import Outcomes
from neuralq.mdp.sampler import Sampler

__all__ = ["AliasedMDP", "FiniteMDP", "ModelEnv", "ModelVectorEnv", "Outcomes", "Sampler"]
