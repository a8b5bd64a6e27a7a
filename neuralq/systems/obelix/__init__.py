"""Mahadevan & Connell 1992: a robot learns to push boxes, by behaviours and at once."""

from neuralq.systems.obelix.system import OBELIX

__all__ = ["OBELIX"]
