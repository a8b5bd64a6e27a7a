"""What a page may send in a game, checked: points, cells, dice, positions, and who begins."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neuralq_envs.backgammon import Position

__all__ = ["check_fields", "dice_of", "point_of", "position_of", "seed_of", "word_of"]

_MOST_SHOWN = 60


def check_fields(given: Mapping[str, Any], names: tuple[str, ...]) -> None:
    """``given`` has no other fields than ``names``.

    Raises:
        ValueError: it has.

    Example:
        >>> check_fields({"cell": 3, "sell": 4}, ("cell",))
        Traceback (most recent call last):
        ValueError: there is no field 'sell'; there are cell
    """
    for name in given:
        if name not in names:
            raise ValueError(f"there is no field {name[:_MOST_SHOWN]!r}; there are {', '.join(names) or 'none'}")


def point_of(given: Mapping[str, Any], name: str, lowest: int, highest: int) -> int:
    """The whole number in field ``name``.

    Raises:
        ValueError: another type, or out of range.

    Example:
        >>> point_of({"source": 25}, "source", 1, 25)
        25
    """
    value = given.get(name)
    if type(value) is not int or not lowest <= value <= highest:
        raise ValueError(f"{name} must be a whole number from {lowest} to {highest}, got {_shown(value)}")
    return value


def seed_of(given: Mapping[str, Any]) -> int | None:
    """The field ``seed``, or None where there is none.

    Raises:
        ValueError: no whole number from 0 to 2³² − 1.

    Example:
        >>> seed_of({"seed": 7}), seed_of({})
        (7, None)
    """
    return None if given.get("seed") is None else point_of(given, "seed", 0, 2**32 - 1)


def word_of(given: Mapping[str, Any], name: str, choices: tuple[str, ...]) -> str:
    """The field ``name``, one of ``choices``; the first if it is not given.

    Raises:
        ValueError: another value.

    Example:
        >>> word_of({}, "player", ("X", "O"))
        'X'
    """
    value = given.get(name, choices[0])
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {_shown(value)}")
    return value


def dice_of(given: Mapping[str, Any]) -> tuple[int, int] | None:
    """The field ``dice``, or None where there is none.

    Raises:
        ValueError: something else than two whole numbers of 1 to 6.

    Example:
        >>> dice_of({"dice": [6, 1]}), dice_of({})
        ((6, 1), None)
    """
    value = given.get("dice")
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != 2 or any(type(die) is not int or not 0 < die < 7 for die in value):
        raise ValueError(f"dice must be two whole numbers of 1 to 6, got {_shown(value)}")
    return value[0], value[1]


def position_of(given: Mapping[str, Any]) -> Position | None:
    """The field ``position``, a GNU Backgammon position ID, with the visitor to move; None where there is none.

    Raises:
        ValueError: no position ID, or one of a game that is over.

    Example:
        >>> position_of({"position": "4HPwATDgc/ABMA"}) == Position.initial()
        True
    """
    value = given.get("position")
    if value is None:
        return None
    if not isinstance(value, str) or len(value) > _MOST_SHOWN:
        raise ValueError(f"position must be a position ID of 14 characters, got {_shown(value)}")
    position = Position.from_gnubg_id(value.strip().partition(":")[0])
    if position.winner is not None:
        raise ValueError(f"the game is over in position {value}; give one in which both sides have checkers")
    return position


def _shown(value: Any) -> str:
    text = "nothing" if value is None else str(value)
    return text if len(text) <= _MOST_SHOWN else text[: _MOST_SHOWN - 3] + "..."
