"""Maclin & Shavlik 1996 (RATLE): advice becomes units of the network, before or during training, and is refined."""

from neuralq.systems.advice.system import ADVICE

__all__ = ["ADVICE"]
