"""What decides a run of TD-Gammon, beside the results: one frozen dataclass, and how it is written to JSON and read."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from neuralq.checks import check_choice, check_whole
from neuralq.systems.backgammon.match import OPPONENTS
from neuralq.systems.backgammon.selfplay import SelfPlaySettings

__all__ = ["KIND", "TdGammonConfig", "config_from_dict", "config_to_dict"]

KIND = "td-gammon"
"""What ``config.json`` of such a run says under ``kind``."""


@dataclass(frozen=True)
class TdGammonConfig:
    """Everything that decides a run.

    Args:
        settings: how to learn, and over how many games the schedules go.
        seed: of weights, dice and evaluations.
        num_games: budget; None for the games of the schedules. In batched mode the last batch is played whole.
        evaluate_every: games between evaluations.
        evaluation_games: games of each, against each opponent.
        evaluate_against: "random", "pubeval" and "gnubg"; none for no evaluation.
        checkpoint_every: games between checkpoints.
        log_every: games between rows of training metrics.

    Raises:
        ValueError: values outside their range.
    """

    settings: SelfPlaySettings = field(default_factory=SelfPlaySettings)
    seed: int = 0
    num_games: int | None = None
    evaluate_every: int = 10_000
    evaluation_games: int = 1_000
    evaluate_against: tuple[str, ...] = ("random",)
    checkpoint_every: int = 10_000
    log_every: int = 1_000

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_whole("seed", self.seed, 0)
        for name in ("evaluate_every", "checkpoint_every", "log_every"):
            check_whole(name, getattr(self, name))
        check_whole("evaluation_games", self.evaluation_games, 2)  # of one game nobody knows how sure it is
        if self.num_games is not None:
            check_whole("num_games", self.num_games)
        object.__setattr__(self, "evaluate_against", tuple(dict.fromkeys(self.evaluate_against)))
        for opponent in self.evaluate_against:
            check_choice("evaluate_against", opponent, OPPONENTS)

    @property
    def budget(self) -> int:
        """Games of the run, in whole batches."""
        asked = self.settings.num_games if self.num_games is None else self.num_games
        return self.whole_batches(asked)

    def whole_batches(self, num_games: int) -> int:
        """``num_games`` or as many more as complete a batch; the same number in online mode."""
        size = self.settings.batch_games if self.settings.mode == "batched" else 1
        return -(-num_games // size) * size


def config_to_dict(config: TdGammonConfig) -> dict[str, Any]:
    """Plain values, for JSON.

    Example:
        >>> config_to_dict(TdGammonConfig(seed=3))["kind"]
        'td-gammon'
    """
    return {"kind": KIND, **dataclasses.asdict(config), "evaluate_against": list(config.evaluate_against)}


def config_from_dict(plain: Mapping[str, Any]) -> TdGammonConfig:
    """The configuration that `config_to_dict` wrote.

    Raises:
        ValueError: it is of another kind, has unknown keys, or values outside their range.

    Example:
        >>> config_from_dict(config_to_dict(TdGammonConfig(seed=3))) == TdGammonConfig(seed=3)
        True
    """
    if plain.get("kind") != KIND:
        raise ValueError(f"this is no configuration of a TD-Gammon run: kind is {plain.get('kind')!r}, not {KIND!r}")
    values = {name: value for name, value in plain.items() if name not in ("kind", "settings")}
    settings = dict(plain.get("settings", {}))
    for given, of in ((values, TdGammonConfig), (settings, SelfPlaySettings)):
        unknown = set(given) - {f.name for f in dataclasses.fields(of)}
        if unknown:
            raise ValueError(f"unknown in the configuration of a TD-Gammon run: {', '.join(sorted(unknown))}")
    try:
        return TdGammonConfig(SelfPlaySettings(**settings), **values)
    except TypeError as error:  # text where a number belongs
        raise ValueError(f"the configuration of a TD-Gammon run holds a value of the wrong kind: {error}") from error
