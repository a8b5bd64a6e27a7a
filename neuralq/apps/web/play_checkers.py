"""A game of checkers between a visitor and a program whose evaluation was learned, as the server keeps it.

Squares are 1 to 32. A capture of several pieces is made jump by jump; the agent answers as soon as a move is complete.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from neuralq.apps.web.play import Action, Offer
from neuralq.apps.web.play_requests import point_of, word_of
from neuralq.systems.checkers import CheckersPlayer, RankedMove, plies_to_the_end
from neuralq_envs.checkers import COLOURS, MOST_QUIET_PLIES, Move, Position

__all__ = ["NUM_SHOWN", "CheckersGame", "board_in_words", "checkers"]

_Rank = Callable[[Position], list[RankedMove]]
"""Every move, the best first."""

NUM_SHOWN = 6
_NAMES = ("you", "agent")
_SIGNS = {(0, False): "b", (0, True): "B", (1, False): "w", (1, True): "W"}


class _Turn(NamedTuple):
    """How a turn of the visitor's began.

    Args:
        position: with the visitor to move.
        quiet_plies: without a capture or a move of a man.
        num_recorded: moves that had been played.
        agent_move: what the page shows of the agent's last one.
    """

    position: Position
    quiet_plies: int
    num_recorded: int
    agent_move: dict[str, Any] | None


class CheckersGame:
    """Games of one visitor against the agent, with the score.

    Args:
        rank: the agent.
        rng: draws between the agent's best moves where several are equally good.

    Example:
        >>> game = CheckersGame(lambda position: [RankedMove(move, 0.0) for move in position.moves()],
        ...                     np.random.default_rng(0))
        >>> game.new({"player": "black"})
        >>> game.move({"source": 11, "target": 15})
        >>> state = game.state()
        >>> state["squares"][14], len(state["record"])
        ('b', 2)
    """

    def __init__(self, rank: _Rank, rng: np.random.Generator) -> None:
        self._rank = rank
        self._rng = rng
        self._score = {"you": 0, "draws": 0, "agent": 0}
        self._player = 0
        self._is_set_up = False
        self._turns: list[_Turn] = []
        self._position = Position.initial()
        self._quiet_plies = 0
        self._ways: list[Move] = []  # the moves that begin with the jumps made so far
        self._before: list[list[Move]] = []  # the same before each of those jumps
        self._ranked: list[RankedMove] | None = None  # of the visitor's turn, once somebody has asked
        self._record: list[dict[str, Any]] = []
        self._agent_move: dict[str, Any] | None = None
        self._result: dict[str, Any] | None = None
        self._shown: tuple[list[str], list[dict[str, Any]]] = ([], [])  # the board before, and what moved since

    def new(self, given: Mapping[str, Any]) -> None:
        """A new game as ``player`` black, who begins, or white; or from ``position`` with the visitor to move.

        A game that is broken off counts for nobody, nor does one from a position that was set up.

        Raises:
            ValueError: another player, no position, one of a game that is over, or a player besides a position.
        """
        position = _position_of(given)
        if position is not None and given.get("player") is not None:
            raise ValueError("the side to move of a position is yours; leave player out, or position")
        self._player = COLOURS.index(word_of(given, "player", COLOURS)) if position is None else position.turn
        self._is_set_up = position is not None
        self._turns, self._record, self._agent_move, self._result = [], [], None, None
        self._quiet_plies = 0
        self._position = Position.initial() if position is None else position
        self._shown = (_signs(self._position), [])
        if self._position.turn == self._player:
            self._begin_turn()
        else:
            self._answer()

    def move(self, given: Mapping[str, Any]) -> None:
        """Moves the visitor's piece on ``source`` by a step or a jump to ``target``.

        Raises:
            ValueError: no squares, or a move that is not legal.
        """
        source, target = point_of(given, "source", 1, 32), point_of(given, "target", 1, 32)
        self._check_going_on()
        made = len(self._before)
        ways = [way for way in self._ways if way.squares[made : made + 2] == (source, target)]
        if not ways:
            raise ValueError(f"{source} to {target} is not legal: {self._reason(source, target)}")
        before = self._board()
        self._before.append(self._ways)
        self._ways = ways
        self._shown = (before, [_step("you", (source, target), ways[0].taken[made : made + 1])])
        if made + 2 == len(ways[0].squares):
            self._complete(ways[0])

    def undo(self, given: Mapping[str, Any]) -> None:
        """Takes a jump back, or the visitor's last move with the answer to it; a result is taken off the score.

        Raises:
            ValueError: there is none.
        """
        if self._before:
            self._ways = self._before.pop()
        elif len(self._turns) > (self._result is None):
            if self._result is not None and not self._is_set_up:
                self._score[self._result["winner"] or "draws"] -= 1
            if self._result is None:
                self._turns.pop()
            turn = self._turns.pop()
            self._result = None
            self._position, self._quiet_plies, self._agent_move = turn.position, turn.quiet_plies, turn.agent_move
            del self._record[turn.num_recorded :]
            self._begin_turn()
        else:
            raise ValueError("there is nothing to take back, you have not moved in this game")
        self._shown = (self._board(), [])

    def hint(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The best of the visitor's moves, from how the turn began.

        Raises:
            ValueError: the game is over.
        """
        self._check_going_on()
        ranked = self._ranking()
        return {"best": _rows(ranked), "num_moves": len(ranked)}

    def state(self) -> dict[str, Any]:
        """Everything that the page shows."""
        made = len(self._before)
        moves: dict[str, list[int]] = {}
        for way in self._ways:
            targets = moves.setdefault(str(way.squares[made]), [])
            if way.squares[made + 1] not in targets:
                targets.append(way.squares[made + 1])
        board, (before, steps) = self._board(), self._shown
        return {
            "player": COLOURS[self._player],
            "score": self._score,
            "counts": not self._is_set_up,
            "squares": board,
            "before": before,
            "steps": steps,
            "moves": moves,
            "must_capture": bool(self._ways and self._ways[0].taken),
            "goes_on": made > 0,
            "can_undo": self._can_undo,
            "quiet_plies": self._quiet_plies,
            "fen": self._position.fen,
            "agent_move": self._agent_move,
            "record": self._record,
            "result": self._result,
            "words": board_in_words(board, self._player),
        }

    @property
    def _can_undo(self) -> bool:
        return bool(self._before) or len(self._turns) > (self._result is None)

    def _begin_turn(self) -> None:
        self._turns.append(_Turn(self._position, self._quiet_plies, len(self._record), self._agent_move))
        self._ways, self._before, self._ranked = self._position.moves(), [], None

    def _complete(self, move: Move) -> None:
        """Ends the visitor's turn: what the agent thinks of it is kept, and the agent answers."""
        ranking = self._ranking()
        rank = next(i for i, one in enumerate(ranking) if one.move == move)
        loss = ranking[0].score - ranking[rank].score
        rank = sum(one.score > ranking[rank].score for one in ranking)  # equal ones share the better place
        self._record.append({"who": "you", "text": str(move), "rank": rank + 1, "loss": loss})
        self._play(move)
        if self._result is None:
            self._answer()

    def _answer(self) -> None:
        before, ranked = _signs(self._position), self._rank(self._position)
        best = sorted((one.move for one in ranked if one.score == ranked[0].score), key=lambda move: move.squares)
        move = best[self._rng.integers(len(best))]
        ranked.sort(key=lambda one: one.move != move)  # stable: the others stay in their order
        self._record.append({"who": "agent", "text": str(move), "rank": 1, "loss": 0.0})
        self._agent_move = {"text": str(move), "best": _rows(ranked), "num_moves": len(ranked)}
        self._shown = (before, [_step("agent", move.squares, move.taken)])
        self._play(move)
        if self._result is None:
            self._begin_turn()

    def _play(self, move: Move) -> None:
        _, is_king = self._position.pieces()[move.squares[0]]
        self._quiet_plies = self._quiet_plies + 1 if is_king and not move.taken else 0
        self._position, self._ways, self._before = move.position, [], []
        winner = self._position.winner
        if winner is not None or self._quiet_plies >= MOST_QUIET_PLIES:
            named = None if winner is None else _NAMES[winner != self._player]
            blocked = winner is not None and self._position.own > 0
            self._result = {"winner": named, "blocked": blocked}
            if not self._is_set_up:
                self._score[named or "draws"] += 1

    def _ranking(self) -> list[RankedMove]:
        if self._ranked is None:
            self._ranked = self._rank(self._position)
        return self._ranked

    def _check_going_on(self) -> None:
        if self._result is not None:
            raise ValueError("the game is over; start a new one")

    def _board(self) -> list[str]:
        """As it is now, in the middle of a capture too."""
        board = _signs(self._position)
        if self._before:
            way, made = self._ways[0], len(self._before)
            board[way.squares[made] - 1] = board[way.squares[0] - 1]
            for gone in {way.squares[0], *way.taken[:made]} - {way.squares[made]}:
                board[gone - 1] = ""
        return board

    def _reason(self, source: int, target: int) -> str:
        made, board = len(self._before), self._board()
        if not board[source - 1] or "bw".index(board[source - 1].lower()) != self._player:
            return f"no piece of yours is on {source}"
        if made and self._ways[0].squares[made] != source:
            return f"the piece on {self._ways[0].squares[made]} must go on capturing"
        if board[target - 1]:
            return f"{target} is not empty"
        if self._ways[0].taken:
            return "a piece can be captured, and one must be"
        return "a man goes one square ahead and aslant, a king back as well"


def checkers(player: CheckersPlayer) -> Offer:
    """Checkers against a program that looks ahead.

    Example:
        >>> sorted(checkers(CheckersPlayer(depth=2)).actions)
        ['hint', 'move', 'undo']
    """
    lock = threading.Lock()  # a player has one desk to work on

    def rank(position: Position) -> list[RankedMove]:
        with lock:
            return player.ranked(position)

    actions = {
        "move": Action(CheckersGame.move, ("source", "target")),
        "undo": Action(CheckersGame.undo),
        "hint": Action(CheckersGame.hint, changes=False),
    }
    return Offer("checkers.html", functools.partial(CheckersGame, rank), ("player", "position"), actions)


def board_in_words(board: Sequence[str], player: int) -> str:
    """Where all pieces are, for who cannot see the board.

    Args:
        board: ``b``, ``w``, ``B`` or ``W`` for each of the 32 squares, or nothing.
        player: the visitor's side, 0 or 1.

    Example:
        >>> print(board_in_words(["b", "", "W", "W"] + [""] * 28, 1))
        You, white: kings on 3, 4. The agent, black: men on 1.
    """
    texts = []
    for who, side in (("You", player), ("The agent", 1 - player)):
        places = []
        for name, sign in (("men", "bw"[side]), ("kings", "BW"[side])):
            squares = ", ".join(str(i + 1) for i, one in enumerate(board) if one == sign)
            places += [f"{name} on {squares}"] if squares else []
        texts.append(f"{who}, {COLOURS[side]}: {'; '.join(places) or 'nothing left'}.")
    return " ".join(texts)


def _position_of(given: Mapping[str, Any]) -> Position | None:
    """The field ``position`` in portable draughts notation; None where there is none."""
    value = given.get("position")
    if value is None:
        return None
    if not isinstance(value, str) or len(value) > 200:
        raise ValueError(f"position must be a line like 'B:W21,22,K30:B1,2,K15', got {str(value)[:60]}")
    position = Position.from_fen(value)
    if position.winner is not None:
        raise ValueError(f"the game is over in {position.fen}; give a position in which the side to move can move")
    return position


def _signs(position: Position) -> list[str]:
    held = position.pieces()
    return [_SIGNS[held[square]] if square in held else "" for square in range(1, 33)]


def _step(who: str, squares: Sequence[int], taken: Sequence[int]) -> dict[str, Any]:
    return {"who": who, "squares": list(squares), "taken": list(taken)}


def _rows(ranked: Sequence[RankedMove]) -> list[dict[str, Any]]:
    """Moves with what the side that plays them expects."""
    return [
        {"text": str(one.move), "score": one.score, "plies": plies_to_the_end(one.score)} for one in ranked[:NUM_SHOWN]
    ]
