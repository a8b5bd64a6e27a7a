"""Peng & Williams 1996: Q(λ) balances a pole sooner than one-step Q-learning."""

from neuralq.systems.peng_williams.system import PENG_WILLIAMS

__all__ = ["PENG_WILLIAMS"]
