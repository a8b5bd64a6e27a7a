"""TD-Gammon: backgammon values learned from self-play by TD(λ), and the player they make."""

from __future__ import annotations

from neuralq.systems.backgammon.agent import BackgammonAgent, Chances, RankedTurn
from neuralq.systems.backgammon.config import TdGammonConfig
from neuralq.systems.backgammon.match import MatchResult, play_match
from neuralq.systems.backgammon.network import ValueNetwork
from neuralq.systems.backgammon.run import load_agent, resume_games, train_games
from neuralq.systems.backgammon.selfplay import SelfPlay, SelfPlaySettings

__all__ = [
    "BackgammonAgent",
    "Chances",
    "MatchResult",
    "RankedTurn",
    "SelfPlay",
    "SelfPlaySettings",
    "TdGammonConfig",
    "ValueNetwork",
    "load_agent",
    "play_match",
    "resume_games",
    "train_games",
]
