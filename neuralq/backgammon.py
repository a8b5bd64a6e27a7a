"""TD-Gammon by a short name: `neuralq.systems.backgammon`, for ``from neuralq.backgammon import load_agent``."""

from neuralq.systems.backgammon import (
    BackgammonAgent,
    Chances,
    MatchResult,
    RankedTurn,
    SelfPlay,
    SelfPlaySettings,
    TdGammonConfig,
    ValueNetwork,
    load_agent,
    play_match,
    resume_games,
    train_games,
)

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
