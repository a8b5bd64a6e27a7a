"""Checkers against a chosen opponent, as a Gymnasium environment for one learner.

An action is a square and a direction, both as the learner sees the board, with its own men moving upwards: four times
the square (0 to 31, row by row from its own right) plus the direction (`Move.directions`). A capture of several pieces
is several actions, and the opponent answers when the last one is made; until then the piece that must go on is part
of the observation. Reward is 1 for a win and −1 for a loss, else 0.

The world has some 5·10²⁰ positions (Schaeffer et al. 2007), so there is no exact model beside this environment.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_whole
from neuralq_envs.checkers.drawing import pixels
from neuralq_envs.checkers.position import COLOURS, MOST_QUIET_PLIES, Move, Position

__all__ = ["CheckersEnv", "make"]

Opponent = Callable[[Position], Move]
_RENDER_MODES = ("ansi", "rgb_array")
_NUM_SQUARES = 32


class CheckersEnv(gymnasium.Env[NDArray[np.float32], np.int64]):
    """The game as a learner meets it.

    Observations are 161 numbers from 0 to 1: for each of the 32 squares as the learner sees them whether an own man,
    an own king, another man, another king, or the piece that must go on jumping is there; and the share of the quiet
    plies that make a draw. ``info["action_mask"]`` has a one for each legal action, ``info["position"]`` is the
    `Position` as the turn began.

    Args:
        opponent: ``"random"``, or a function of a position that gives one of its moves.
        player: the learner's colour, ``"black"``, which begins, or ``"white"``.
        most_quiet_plies: plies without a capture or a move of a man after which the game is a draw.
        render_mode: None, ``"ansi"`` or ``"rgb_array"``.

    Raises:
        ValueError: another opponent, player or render mode, or fewer than one ply.

    Example:
        >>> env = CheckersEnv()
        >>> observation, extra = env.reset(seed=0)
        >>> np.flatnonzero(extra["action_mask"]).tolist()  # seven moves of the men on squares 9 to 12
        [32, 33, 36, 37, 40, 41, 44]
    """

    metadata: dict[str, Any] = {"render_modes": list(_RENDER_MODES), "render_fps": 2}  # noqa: RUF012

    def __init__(
        self,
        opponent: str | Opponent = "random",
        player: str = "black",
        most_quiet_plies: int = MOST_QUIET_PLIES,
        render_mode: str | None = None,
    ) -> None:
        if not callable(opponent):
            check_choice("opponent", opponent, ["random"])
        check_choice("player", player, COLOURS)
        check_whole("most_quiet_plies", most_quiet_plies)
        check_choice("render_mode", render_mode, [None, *_RENDER_MODES])
        self.render_mode = render_mode
        self.observation_space = spaces.Box(0.0, 1.0, (5 * _NUM_SQUARES + 1,), np.float32)
        self.action_space = spaces.Discrete(4 * _NUM_SQUARES)
        self._opponent = opponent
        self._player = COLOURS.index(player)
        self._most_quiet_plies = most_quiet_plies
        self._position = Position.initial()
        self._ways: list[Move] = []  # the moves that begin with what has been played of this turn
        self._num_played = 0
        self._quiet_plies = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """A new game, or ``options["position"]``, a `Position` or its FEN, in which the learner is to move.

        Raises:
            ValueError: no position, one in which the other side is to move, or one where the game is over.
        """
        super().reset(seed=seed)
        given = (options or {}).get("position")
        start = Position.from_fen(given) if isinstance(given, str) else given or Position.initial()
        if given is not None and start.turn != self._player:
            raise ValueError(
                f"{COLOURS[self._player]}, the learner, must be to move, got {start.fen!r}; "
                f"or make the environment with player={COLOURS[start.turn]!r}"
            )
        if start.winner is not None:
            raise ValueError(f"the game is over in {start.fen!r}; give a position in which a move is left")
        self._quiet_plies = 0
        if start.turn != self._player:
            start = self._answered(start)
        self._begin(start)
        return self._seen()

    def step(self, action: np.int64) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """A step or a jump, and after the last one the opponent's answer; an illegal action changes nothing.

        Raises:
            ResetNeeded: the game is over or has not begun.
        """
        if not self._ways:
            raise ResetNeeded("the game is over, or has not begun yet: call reset() before step()")
        ways = [way for way in self._ways if self._action(way) == action]
        if not ways:
            return self._after(0.0, terminated=False)
        self._ways, self._num_played = ways, self._num_played + 1
        if self._num_played < len(ways[0].directions):
            return self._after(0.0, terminated=False)
        position = self._played(ways[0])
        if position.winner is None and not self._is_drawn:
            position = self._answered(position)
        self._begin(position)
        if position.winner is not None:
            return self._after(1.0 if position.winner == self._player else -1.0, terminated=True)
        if self._is_drawn:
            self._ways = []
        return self._after(0.0, terminated=self._is_drawn)

    def render(self) -> Any:
        """The board as text for ``ansi``, uint8 ``[384, 384, 3]`` for ``rgb_array``, None without a render mode."""
        if self.render_mode is None:
            return None
        return f"{self._position}\n" if self.render_mode == "ansi" else pixels(self._position.pieces(), self._must_go)

    @property
    def _is_drawn(self) -> bool:
        return self._quiet_plies >= self._most_quiet_plies

    @property
    def _must_go(self) -> int | None:
        """The square of the piece in the middle of its jumps."""
        return self._ways[0].squares[self._num_played] if self._num_played and self._ways else None

    def _begin(self, position: Position) -> None:
        self._position, self._ways, self._num_played = position, position.moves(), 0

    def _played(self, move: Move) -> Position:
        """After a move, whose quiet plies are counted."""
        _, is_king = self._position.pieces()[move.squares[0]]
        self._quiet_plies = self._quiet_plies + 1 if is_king and not move.taken else 0
        return move.position

    def _answered(self, position: Position) -> Position:
        self._position, ways = position, position.moves()
        if callable(self._opponent):
            move = self._opponent(position)
            if move not in ways:
                raise ValueError(f"the opponent's {move} is no move of {position.fen!r}")
        else:
            move = ways[int(self.np_random.integers(len(ways)))]
        return self._played(move)

    def _action(self, way: Move) -> int:
        """The action that goes on with a move."""
        return 4 * self._seen_as(way.squares[self._num_played]) + way.directions[self._num_played]

    def _seen_as(self, square: int) -> int:
        """The number 0 to 31 of a square, as the learner counts."""
        return square - 1 if self._player == 0 else _NUM_SQUARES - square

    def _seen(self) -> tuple[NDArray[np.float32], dict[str, Any]]:
        mask = np.zeros(4 * _NUM_SQUARES, dtype=np.int8)
        mask[[self._action(way) for way in self._ways]] = 1
        return self._observed(), {"action_mask": mask, "position": self._position}

    def _observed(self) -> NDArray[np.float32]:
        seen = np.zeros((5, _NUM_SQUARES), dtype=np.float32)
        held = self._position.pieces()
        gone: tuple[int, ...] = ()
        if self._must_go is not None:  # the board in the middle of the jumps
            way = self._ways[0]
            gone = way.taken[: self._num_played]
            held[self._must_go] = held.pop(way.squares[0])
        for square, (side, is_king) in held.items():
            if square not in gone:
                i = self._seen_as(square)
                seen[2 * (side != self._player) + is_king, i] = 1
                seen[4, i] = square == self._must_go
        return np.append(seen, np.float32(min(self._quiet_plies / self._most_quiet_plies, 1.0)))

    def _after(self, reward: float, terminated: bool) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        observation, extra = self._seen()
        return observation, reward, terminated, False, extra


def make(render_mode: str | None = None, **given: Any) -> CheckersEnv:
    """What ``gymnasium.make("neuralq/Checkers-v0")`` calls.

    Example:
        >>> env = make(opponent=lambda position: position.moves()[0], player="white")
        >>> env.reset(seed=0)[1]["position"].turn
        1
    """
    return CheckersEnv(render_mode=render_mode, **given)
