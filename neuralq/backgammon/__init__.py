"""TD-Gammon: backgammon values learned from self-play by TD(λ), and the player they make."""

from __future__ import annotations

from neuralq.backgammon.agent import BackgammonAgent, Chances, RankedTurn
from neuralq.backgammon.network import ValueNetwork
from neuralq.backgammon.selfplay import SelfPlay, SelfPlaySettings

__all__ = ["BackgammonAgent", "Chances", "RankedTurn", "SelfPlay", "SelfPlaySettings", "ValueNetwork"]
