"""TD-Gammon: backgammon values learned from self-play by TD(λ), and the player they make."""

from __future__ import annotations

from neuralq.backgammon.agent import BackgammonAgent, Chances, RankedTurn
from neuralq.backgammon.config import TdGammonConfig
from neuralq.backgammon.match import MatchResult, play_match
from neuralq.backgammon.network import ValueNetwork
from neuralq.backgammon.run import load_agent, resume_games, train_games
from neuralq.backgammon.selfplay import SelfPlay, SelfPlaySettings

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
