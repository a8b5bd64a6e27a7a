"""Problems on which learning with function approximation is known to go wrong, with what is known about them."""

from neuralq_envs.counterexamples.baird import star
from neuralq_envs.counterexamples.problem import Problem

__all__ = ["Problem", "star"]
