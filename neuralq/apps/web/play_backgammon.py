"""A game of backgammon between a visitor and a trained agent, as the server keeps it.

The visitor is player 0 and sees the board from its side: points are numbered 24 to 1 as it moves, its bar is 25 and off
is 0. Everything that is decided here is decided from this state: the dice are drawn here, moves are looked up among the
legal ones, and the agent answers as soon as a turn is confirmed. Money play, without a cube.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from neuralq.apps.web.play import Action, Offer
from neuralq.apps.web.play_requests import dice_of, point_of, position_of
from neuralq.apps.web.play_turns import BAR, CheckerStep, PartialTurn, WaysToPlay, notation, point_name
from neuralq.systems.backgammon import BackgammonAgent, RankedTurn
from neuralq_envs.backgammon import Position

__all__ = ["NUM_SHOWN", "BackgammonGame", "backgammon", "board_in_words"]

_Rank = Callable[[Position, tuple[int, int]], list[RankedTurn]]
"""Every way to play a roll, the best first."""

NUM_SHOWN = 5
_YOU, _AGENT = 0, 1
_NAMES = ("you", "agent")
_KINDS = {1: "game", 2: "gammon", 3: "backgammon"}


class BackgammonGame:
    """Games of one visitor against the agent, with the score.

    Args:
        rank: the agent.
        rng: draws the dice.

    Example:
        >>> game = BackgammonGame(lambda position, dice: [], np.random.default_rng(2))
        >>> game.new({"position": "4HPwATDgc/ABMA", "dice": [3, 1]})
        >>> game.move({"source": 8, "target": 5}), game.move({"source": 6, "target": 5})
        (None, None)
        >>> game.state()["complete"], game.state()["board"]["you"]["points"][4]
        (True, 2)
    """

    def __init__(self, rank: _Rank, rng: np.random.Generator) -> None:
        self._rank = rank
        self._rng = rng
        self._score = [0, 0]
        self._num_games = 0
        self._position = Position.initial()  # as the turn began; of the side to move
        self._turn: PartialTurn | None = None  # None when the game is over
        self._is_set_up = False
        self._record: list[dict[str, Any]] = []
        self._agent_turn: dict[str, Any] | None = None
        self._ranked: list[RankedTurn] | None = None  # of the visitor's roll, once somebody has asked
        self._shown: tuple[bytes, list[dict[str, Any]]] = (b"", [])  # the board before, and the steps since

    def new(self, given: Mapping[str, Any]) -> None:
        """A new game from the beginning, or from ``position`` with the visitor to play ``dice``.

        A game that is broken off counts for nobody, nor does one from a position that was set up.

        Raises:
            ValueError: no position ID, one of a game that is over, dice that are none, or dice without a position.
        """
        position, dice = position_of(given), dice_of(given)
        if position is None and dice is not None:
            raise ValueError("dice can be chosen only with a position; leave dice out, or give a position too")
        self._is_set_up = position is not None
        self._record, self._agent_turn = [], None
        self._num_games += 1
        if position is None:
            dice = self._rolled()
            while dice[0] == dice[1]:  # each throws one die, again if they are equal; the higher begins
                dice = self._rolled()
            position = Position.initial(_YOU if dice[0] > dice[1] else _AGENT)
        dice = _sorted(dice or self._rolled())
        if position.turn == _YOU:
            self._begin_turn(position, dice)
            self._shown = (self._board(), [])
        else:
            self._answer(position, dice)

    def move(self, given: Mapping[str, Any]) -> None:
        """Moves a checker of the visitor's from ``source`` to ``target``.

        Raises:
            ValueError: no points, or a move that is not legal.
        """
        source, target = point_of(given, "source", 1, BAR), point_of(given, "target", 0, BAR - 1)
        before = self._board()
        steps = self._going_on().move(source, target)
        self._shown = (before, [_plain(step, _YOU) for step in steps])

    def undo(self, given: Mapping[str, Any]) -> None:
        """Takes the visitor's last move of this turn back.

        Raises:
            ValueError: there is none.
        """
        self._going_on().undo()
        self._shown = (self._board(), [])

    def confirm(self, given: Mapping[str, Any]) -> None:
        """Ends the visitor's turn; the agent rolls and plays, and the visitor's next roll is drawn.

        Raises:
            ValueError: more can be played.
        """
        turn = self._going_on()
        if not turn.is_complete:
            dice = ", ".join(map(str, turn.dice_left))
            raise ValueError(f"the turn is not complete: {dice} can still be played")
        self._keep_record(turn)
        after = Position(turn.board[25:], turn.board[:25], _AGENT)
        if after.winner is not None:
            self._finish(after)
        else:
            self._answer(after, _sorted(self._rolled()))

    def hint(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The best ways to play the visitor's roll, from how the turn began.

        Raises:
            ValueError: the game is over.
        """
        ways = self._going_on().ways
        return {"best": _rows(self._ranking()[:NUM_SHOWN], ways), "num_turns": len(ways.ends)}

    def state(self) -> dict[str, Any]:
        """Everything that the page shows."""
        turn, (before, steps) = self._turn, self._shown
        board = self._board()
        left = [] if turn is None else list(turn.dice_left)
        moves = {} if turn is None else turn.moves()
        return {
            "num_games": self._num_games,
            "score": dict(zip(_NAMES, self._score, strict=True)),
            "counts": not self._is_set_up,
            "board": _counts(board),
            "before": _counts(before),
            "steps": steps,
            "dice": [] if turn is None else _dice(turn.ways.dice, left),
            "moves": {str(source): list(targets) for source, targets in moves.items()},
            "can_undo": turn is not None and turn.num_moves > 0,
            "complete": turn is not None and turn.is_complete,
            "no_move": turn is not None and turn.is_complete and turn.num_moves == 0,
            "position_id": self._position.gnubg_id,
            "agent_turn": self._agent_turn,
            "record": self._record,
            "result": self._result(),
            "words": board_in_words(board),
        }

    def _rolled(self) -> tuple[int, int]:
        die_1, die_2 = self._rng.integers(1, 7, 2).tolist()
        return die_1, die_2

    def _begin_turn(self, position: Position, dice: tuple[int, int]) -> None:
        """The visitor's turn."""
        self._position = position
        self._turn = PartialTurn(WaysToPlay(position, dice))
        self._ranked = None

    def _answer(self, position: Position, dice: tuple[int, int]) -> None:
        """The agent's turn, and the visitor's next roll."""
        ways = WaysToPlay(position, dice)
        ranked = self._rank(position, dice)
        after = ranked[0].position
        steps = ways.paths()[after.other + after.own]
        best = _rows(ranked[:NUM_SHOWN], ways)
        self._agent_turn = {"dice": list(dice), "text": notation(steps), "best": best, "num_turns": len(ways.ends)}
        self._record.append({"who": "agent", "dice": list(dice), "text": notation(steps), "rank": 1, "loss": 0.0})
        self._shown = (position.other + position.own, [_plain(step, _AGENT) for step in steps])
        if after.winner is not None:
            self._finish(after)
        else:
            self._begin_turn(after, _sorted(self._rolled()))

    def _keep_record(self, turn: PartialTurn) -> None:
        """What the visitor played, and what the agent thinks of it."""
        rank, loss, ranking = None, None, self._ranking()
        for i, one in enumerate(ranking):
            if one.position.other + one.position.own == turn.board:
                rank, loss = i + 1, max(0.0, ranking[0].equity - one.equity)
        text = notation(turn.steps)
        self._record.append({"who": "you", "dice": list(turn.ways.dice), "text": text, "rank": rank, "loss": loss})

    def _ranking(self) -> list[RankedTurn]:
        if self._ranked is None:
            self._ranked = self._rank(self._position, self._going_on().ways.dice)
        return self._ranked

    def _finish(self, position: Position) -> None:
        self._position, self._turn = position, None
        if position.winner == _YOU:
            self._shown = (position.other + position.own, [])
        if not self._is_set_up and position.winner is not None:
            self._score[position.winner] += position.points

    def _going_on(self) -> PartialTurn:
        if self._turn is None:
            raise ValueError("the game is over; start a new one")
        return self._turn

    def _board(self) -> bytes:
        """As it is now, the visitor's row first."""
        if self._turn is not None:
            return self._turn.board
        rows = (self._position.own, self._position.other)
        return rows[self._position.turn] + rows[1 - self._position.turn]

    def _result(self) -> dict[str, Any] | None:
        winner, points = self._position.winner, self._position.points
        return None if winner is None else {"winner": _NAMES[winner], "points": points, "kind": _KINDS[points]}


def backgammon(agent: BackgammonAgent) -> Offer:
    """Backgammon against a trained agent.

    Example:
        >>> from neuralq.systems.backgammon import ValueNetwork
        >>> sorted(backgammon(BackgammonAgent(ValueNetwork(40))).actions)
        ['confirm', 'hint', 'move', 'undo']
    """
    lock = threading.Lock()  # a network owns the memory that its values are computed in

    def rank(position: Position, dice: tuple[int, int]) -> list[RankedTurn]:
        with lock:
            return agent.ranked_turns(position, dice)

    actions = {
        "move": Action(BackgammonGame.move, ("source", "target")),
        "undo": Action(BackgammonGame.undo),
        "confirm": Action(BackgammonGame.confirm),
        "hint": Action(BackgammonGame.hint, changes=False),
    }
    return Offer("backgammon.html", functools.partial(BackgammonGame, rank), ("position", "dice"), actions)


def _sorted(dice: tuple[int, int]) -> tuple[int, int]:
    """The larger first, as rolls are written."""
    return max(dice), min(dice)


def board_in_words(board: bytes) -> str:
    """Where all checkers are, for who cannot see the board.

    Args:
        board: the visitor's row and the agent's, 25 numbers each.

    Example:
        >>> start = Position.initial()
        >>> print(board_in_words(start.own + start.other))
        You have 167 pips: 2 on 24, 5 on 13, 3 on 8, 5 on 6. The agent has 167 pips: 2 on 1, 5 on 12, 3 on 17, 5 on 19.
    """
    texts = []
    for who, row in (("You have", board[:25]), ("The agent has", board[25:])):
        yours = who.startswith("You")
        pips = sum((i + 1) * n for i, n in enumerate(row))
        where = [f"{n} on {i + 1 if yours else 24 - i}" for i, n in enumerate(row[:24]) if n][::-1]
        where = [f"{row[24]} on the bar"] * (row[24] > 0) + where + [f"{15 - sum(row)} off"] * (sum(row) < 15)
        texts.append(f"{who} {pips} pips: {', '.join(where)}.")
    return " ".join(texts)


def _counts(board: bytes) -> dict[str, Any]:
    """Both sides by the visitor's numbers; ``points[i]`` is point i + 1."""
    own, other = list(board[:25]), list(board[25:])
    rows = (own[:24], own[24]), (other[23::-1], other[24])
    pips = [sum((i + 1) * n for i, n in enumerate(row)) for row in (own, other)]
    return {
        who: {"points": points, "bar": bar, "off": 15 - sum(points) - bar, "pips": count}
        for who, (points, bar), count in zip(_NAMES, rows, pips, strict=True)
    }


def _dice(dice: tuple[int, int], left: Sequence[int]) -> list[dict[str, Any]]:
    """Each die with whether it has been used; a double is four dice."""
    values = dice * 2 if dice[0] == dice[1] else dice
    rest, shown = list(left), []
    for value in reversed(values):  # so that the first of a double is the first to be used
        used = value not in rest
        if not used:
            rest.remove(value)
        shown.append({"value": value, "used": used})
    return shown[::-1]


def _rows(ranked: Sequence[RankedTurn], ways: WaysToPlay) -> list[dict[str, Any]]:
    """Turns with what the side that plays them expects, in points, and its chances."""
    paths = ways.paths()
    return [
        {
            "text": notation(paths[one.position.other + one.position.own]),
            "equity": one.equity,
            "win": one.chances.win,
            "gammon": one.chances.gammon,
            "lost_gammon": one.chances.lost_gammon,
        }
        for one in ranked
    ]


def _plain(step: CheckerStep, who: int) -> dict[str, Any]:
    """A step by the visitor's numbers, for the page to draw; ``bar`` and ``off`` are the mover's own."""

    def seen(point: int) -> int | str:
        named = point_name(point)
        return named if not named.isdecimal() else point if who == _YOU else 25 - point

    return {"who": _NAMES[who], "source": seen(step.source), "target": seen(step.target), "hit": step.hit}
