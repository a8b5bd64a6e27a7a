"""Crites & Barto 1996: four elevators learn, by one network and each from its own decisions, when to stop."""

from neuralq.systems.elevators.system import ELEVATORS

__all__ = ["ELEVATORS"]
