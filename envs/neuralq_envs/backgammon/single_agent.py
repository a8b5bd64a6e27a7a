"""Backgammon against a chosen opponent, as a Gymnasium environment for one learner.

The learner is player 0. It is asked for a turn after its dice have been rolled: an action is the number of an
afterstate in ``info["afterstates"]``, which also lists them as positions, and ``info["action_mask"]`` has as many ones
as there are. The opponent's turns happen between its own. Reward is what the end pays, ±1, ±2 or ±3, else 0.

The world has some 10²⁰ positions, so there is no exact model beside this environment.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from neuralq.checks import check_choice
from neuralq_envs.backgammon.inputs import NUM_INPUTS
from neuralq_envs.backgammon.position import Position
from neuralq_envs.backgammon.rules import MAX_AFTERSTATES

__all__ = ["BackgammonEnv", "make", "observe", "roll", "roll_opening"]

Opponent = Callable[[Position, tuple[int, int]], Position]
_RENDER_MODES = ("ansi",)


def roll(rng: np.random.Generator) -> tuple[int, int]:
    """Two dice.

    Example:
        >>> all(1 <= die <= 6 for die in roll(np.random.default_rng(0)))
        True
    """
    die_1, die_2 = rng.integers(1, 7, size=2).tolist()
    return die_1, die_2


def roll_opening(rng: np.random.Generator) -> tuple[int, tuple[int, int]]:
    """Who begins, and with which dice: each player rolls one die until they differ, and the larger begins with both.

    Example:
        >>> player, (mine, theirs) = roll_opening(np.random.default_rng(0))
        >>> mine != theirs, player in (0, 1)
        (True, True)
    """
    while True:
        die_1, die_2 = roll(rng)
        if die_1 != die_2:
            return int(die_2 > die_1), (die_1, die_2)


def observe(position: Position, dice: tuple[int, int] | None) -> NDArray[np.float32]:
    """Tesauro's 198 inputs and the two dice, the larger first, as fractions of six; zeros where none is rolled.

    Example:
        >>> observe(Position.initial(), (1, 3))[198:].tolist()
        [0.5, 0.1666666716337204]
    """
    rolled = sorted(dice or (0, 0), reverse=True)
    return np.concatenate([position.inputs(), np.array(rolled, dtype=np.float32) / 6])


class BackgammonEnv(gymnasium.Env[NDArray[np.float32], np.int64]):
    """The game as a learner meets it.

    Args:
        opponent: ``"random"``, or a function of the position and the dice that gives one of the position's afterstates.
        render_mode: None or ``"ansi"``.

    Raises:
        ValueError: another opponent or render mode.

    Example:
        >>> env = BackgammonEnv()
        >>> _, extra = env.reset(seed=1)
        >>> len(extra["afterstates"]) == extra["action_mask"].sum().item()
        True
    """

    metadata: dict[str, Any] = {"render_modes": list(_RENDER_MODES), "render_fps": 1}  # noqa: RUF012

    def __init__(self, opponent: str | Opponent = "random", render_mode: str | None = None) -> None:
        if not callable(opponent):
            check_choice("opponent", opponent, ["random"])
        check_choice("render_mode", render_mode, [None, *_RENDER_MODES])
        self.render_mode = render_mode
        self.observation_space = spaces.Box(0.0, 7.5, (NUM_INPUTS + 2,), np.float32)  # 7.5: fifteen on the bar
        self.action_space = spaces.Discrete(MAX_AFTERSTATES)
        self._opponent = opponent
        self._position = Position.initial()
        self._dice: tuple[int, int] | None = None
        self._choices: list[Position] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """A new game, or ``options["position"]`` with the learner as its side to move.

        Raises:
            ValueError: a position where the game is over.
        """
        super().reset(seed=seed)
        start = (options or {}).get("position")
        player, dice = roll_opening(self.np_random) if start is None else (0, roll(self.np_random))
        self._position = Position.initial(player) if start is None else Position(start.own, start.other, turn=0)
        choices = self._position.afterstates(dice)
        if player == 1:  # the opponent begins
            self._position = self._answer(dice, choices)
            dice = roll(self.np_random)
            choices = self._position.afterstates(dice)
        self._dice, self._choices = dice, choices
        return self._seen()

    def step(self, action: np.int64) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """The learner's turn and the opponent's answer; an illegal action leaves the position, with reward 0.

        Raises:
            ValueError: the game is over.
        """
        if not self._choices:
            raise ValueError("the game is over or has not begun; call reset()")
        if not 0 <= action < len(self._choices):
            return self._after(0.0, terminated=False)
        self._position = self._choices[int(action)]
        if self._position.winner is None:
            dice = roll(self.np_random)
            self._position = self._answer(dice, self._position.afterstates(dice))
        winner = self._position.winner
        if winner is None:
            self._dice = roll(self.np_random)
            self._choices = self._position.afterstates(self._dice)
            return self._after(0.0, terminated=False)
        self._dice, self._choices = None, []
        return self._after(float(self._position.points if winner == 0 else -self._position.points), terminated=True)

    def render(self) -> Any:
        """The board and the dice as text for ``"ansi"``."""
        return self._position.text(dice=self._dice) if self.render_mode == "ansi" else None

    def _answer(self, dice: tuple[int, int], choices: list[Position]) -> Position:
        if not callable(self._opponent):
            return choices[int(self.np_random.integers(len(choices)))]
        chosen = self._opponent(self._position, dice)
        if chosen not in choices:
            raise ValueError(f"the opponent's {chosen!r} is no afterstate of {self._position!r} with {dice}")
        return choices[choices.index(chosen)]  # ours, which knows whose turn it is

    def _seen(self) -> tuple[NDArray[np.float32], dict[str, Any]]:
        mask = np.zeros(MAX_AFTERSTATES, dtype=np.int8)
        mask[: len(self._choices)] = 1
        return observe(self._position, self._dice), {"action_mask": mask, "afterstates": tuple(self._choices)}

    def _after(self, reward: float, terminated: bool) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        observation, extra = self._seen()
        return observation, reward, terminated, False, extra


def make(opponent: str | Opponent = "random", render_mode: str | None = None) -> BackgammonEnv:
    """What ``gymnasium.make("neuralq/Backgammon-v0")`` calls.

    Example:
        >>> env = make(opponent=lambda position, dice: position.afterstates(dice)[0])
        >>> env.reset(seed=0)[0].shape
        (200,)
    """
    return BackgammonEnv(opponent, render_mode)
