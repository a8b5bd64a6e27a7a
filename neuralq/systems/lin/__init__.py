"""Lin 1992: an agent that learns to eat and not to be eaten, by replay, by teaching and by models."""

from neuralq.systems.lin.system import LIN

__all__ = ["LIN"]
