"""Backgammon for two agents that take turns, by the conventions of PettingZoo's AEC environments.

The agents are ``player_0`` and ``player_1``; who wins the opening roll is asked first. The dice are rolled before an
agent is asked; its action is the number of an afterstate in ``infos[agent]["afterstates"]``. An agent that cannot move
is asked too: its one action leaves the board. PettingZoo is imported when the first environment is made.
"""

from __future__ import annotations

import functools
import importlib
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from neuralq.checks import check_choice
from neuralq_envs.backgammon.inputs import NUM_INPUTS
from neuralq_envs.backgammon.position import Position
from neuralq_envs.backgammon.rules import MAX_AFTERSTATES
from neuralq_envs.backgammon.single_agent import observe, roll, roll_opening

__all__ = ["make_aec"]

_AGENTS = ("player_0", "player_1")
_RENDER_MODES = ("ansi",)


def make_aec(render_mode: str | None = None) -> Any:
    """A PettingZoo ``AECEnv``: observations are dicts of ``observation`` (float32 ``[200]``) and ``action_mask``.

    An illegal action is an error of the caller, since in an AEC environment the mask comes with every observation.

    Args:
        render_mode: None or ``"ansi"``.

    Raises:
        ImportError: PettingZoo is not installed.
        ValueError: another render mode.

    Example:
        >>> make_aec(render_mode="video")
        Traceback (most recent call last):
        ValueError: render_mode must be one of None, 'ansi', got 'video'
    """
    check_choice("render_mode", render_mode, [None, *_RENDER_MODES])
    return _aec_class()(render_mode)


@functools.cache
def _aec_class() -> Any:
    try:
        aec_env = importlib.import_module("pettingzoo").AECEnv
    except ImportError as error:
        raise ImportError("the turn-based environment needs PettingZoo: pip install pettingzoo") from error

    return type("BackgammonAEC", (_Turns, aec_env), {"__doc__": _Turns.__doc__})


class _Turns:
    """The game between two agents; PettingZoo's ``AECEnv`` adds ``last``, ``agent_iter`` and the sums of rewards."""

    metadata: ClassVar[dict[str, Any]] = {
        "name": "backgammon_v0",
        "render_modes": list(_RENDER_MODES),
        "is_parallelizable": False,
    }

    def __init__(self, render_mode: str | None) -> None:
        self.render_mode = render_mode
        self.possible_agents = list(_AGENTS)
        seen: dict[str, spaces.Space[Any]] = {
            "observation": spaces.Box(0.0, 7.5, (NUM_INPUTS + 2,), np.float32),
            "action_mask": spaces.Box(0, 1, (MAX_AFTERSTATES,), np.int8),
        }
        self.observation_spaces = {agent: spaces.Dict(seen) for agent in _AGENTS}
        self.action_spaces = {agent: spaces.Discrete(MAX_AFTERSTATES) for agent in _AGENTS}
        self._rng = np.random.default_rng()
        self._choices: list[Position] = []
        self._dice: tuple[int, int] | None = None

    def observation_space(self, agent: str) -> Any:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """A new game; ``options["position"]`` starts one from there, with its own player to move."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        self.agents = list(_AGENTS)
        self.rewards = dict.fromkeys(_AGENTS, 0.0)
        self._cumulative_rewards = dict.fromkeys(_AGENTS, 0.0)
        self.terminations = dict.fromkeys(_AGENTS, False)
        self.truncations = dict.fromkeys(_AGENTS, False)
        start = (options or {}).get("position")
        player, dice = roll_opening(self._rng) if start is None else (0, roll(self._rng))
        self._set(Position.initial(player) if start is None else start, dice)

    def observe(self, agent: str) -> dict[str, Any]:
        """The board as everybody sees it; dice and mask are zeros for who is not to move."""
        is_asked = _AGENTS[self._position.turn] == agent and bool(self._choices)
        mask = np.zeros(MAX_AFTERSTATES, dtype=np.int8)
        mask[: len(self._choices) if is_asked else 0] = 1
        return {"observation": observe(self._position, self._dice if is_asked else None), "action_mask": mask}

    def step(self, action: int | None) -> None:
        """The turn of ``agent_selection``; None is the only action of an agent whose game is over."""
        agent = self.agent_selection
        if self.terminations[agent]:
            self._was_dead_step(action)  # type: ignore[attr-defined]
            return
        if action is None or not 0 <= action < len(self._choices):
            raise ValueError(f"action must be 0 to {len(self._choices) - 1}, of which the mask has ones, got {action}")
        self._cumulative_rewards[agent] = 0.0
        self.rewards = dict.fromkeys(_AGENTS, 0.0)
        position = self._choices[int(action)]
        if position.winner is None:
            self._set(position, roll(self._rng))
        else:
            self._set(position, None)
            self.rewards = {a: float(position.points * (1 if a == agent else -1)) for a in _AGENTS}
            self.terminations = dict.fromkeys(_AGENTS, True)
        self._accumulate_rewards()  # type: ignore[attr-defined]

    def render(self) -> Any:
        """The board and the dice as text for ``"ansi"``."""
        return self._position.text(dice=self._dice) if self.render_mode == "ansi" else None

    def close(self) -> None:
        """Nothing to close."""

    def _set(self, position: Position, dice: tuple[int, int] | None) -> None:
        self._position, self._dice = position, dice
        self._choices = [] if dice is None else position.afterstates(dice)
        self.agent_selection = _AGENTS[position.turn]
        self.infos: dict[str, dict[str, Any]] = {agent: {"afterstates": ()} for agent in _AGENTS}
        self.infos[self.agent_selection]["afterstates"] = tuple(self._choices)
