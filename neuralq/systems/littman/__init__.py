"""Littman 1994: the best that can be done in a maze by what is seen now, and who learns it."""

from neuralq.systems.littman.system import LITTMAN

__all__ = ["LITTMAN"]
