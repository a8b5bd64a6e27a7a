"""Mazes that change while one learns (Sutton 1990; Sutton & Barto 2018, examples 8.2 and 8.3): 6 x 9 cells, 1 for G.

Start (5, 3), goal (0, 8), and a wall across row 3 with a gap.

* blocking: the gap at the right end (10 steps to the goal) moves to the left end after 1000 steps (16 steps);
* shortcut: beside the gap at the left end (16 steps) one opens at the right end after 3000 steps (10 steps).

The clock counts the steps of all episodes, since the environment was made or last seeded. So these environments are not
one finite model but two in turn; the gap that closes can still be left by whoever is in it.
"""

from __future__ import annotations

from typing import Any

import gymnasium

from neuralq.checks import check_choice, check_whole
from neuralq.mdp import FiniteMDP
from neuralq_envs.grids import Grid
from neuralq_envs.rendering import RenderedEnv

__all__ = ["GAMMA", "ChangingEnv", "grids", "make", "mdp"]

GAMMA = 0.95
_WALLS = {"blocking": ("########.", ".#######x"), "shortcut": (".########", ".#######.")}
_CHANGE_STEP = {"blocking": 1000, "shortcut": 3000}
_LAYOUT = "........G\n.........\n.........\n{}\n.........\n...S....."


def grids(change: str) -> tuple[Grid, Grid]:
    """The maze before and after the change, ``"blocking"`` or ``"shortcut"``.

    Raises:
        ValueError: another change.

    Example:
        >>> before, after = grids("shortcut")
        >>> before.layout.split()[3], after.layout.split()[3]
        ('.########', '.#######.')
    """
    check_choice("change", change, _WALLS)
    before, after = _WALLS[change]
    return Grid(_LAYOUT.format(before)), Grid(_LAYOUT.format(after))


def mdp(change: str, changed: bool = False) -> FiniteMDP:
    """The exact model before or after the change.

    Example:
        >>> mdp("blocking").num_states
        54
    """
    return grids(change)[changed].mdp()


class ChangingEnv(gymnasium.Env[Any, Any]):
    """One environment that turns into another after a number of steps, counted over all episodes.

    ``reset(seed=...)`` sets the clock to 0, for a seed begins the experiment anew; ``reset()`` begins the next episode.

    Args:
        before: the environment at first.
        after: what it becomes; the same spaces, and every state in which ``before`` can be has an action.
        change_step: how many steps are taken before the change.

    Raises:
        ValueError: different spaces or render modes, or fewer than 0 steps.

    Example:
        >>> env = make("shortcut", change_step=1)
        >>> _ = env.reset(seed=0)
        >>> env.mdp().num_rows, env.step(0)[0], env.mdp().num_rows  # a cell more can be in
        (180, 39, 184)
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 4}  # noqa: RUF012

    def __init__(self, before: RenderedEnv, after: RenderedEnv, change_step: int) -> None:
        check_whole("change_step", change_step, minimum=0)
        for name in ("observation_space", "action_space", "render_mode"):
            if getattr(before, name) != getattr(after, name):
                raise ValueError(
                    f"both environments must have the same {name}, got {getattr(before, name)} before and "
                    f"{getattr(after, name)} after"
                )
        self.render_mode = before.render_mode
        self.observation_space, self.action_space = before.observation_space, before.action_space
        self._before, self._after, self._change_step = before, after, int(change_step)
        self._clock_steps = 0

    def mdp(self, changed: bool | None = None) -> FiniteMDP:
        """The exact model before or after the change; by default the one that holds now."""
        if changed is None:
            return self._current.mdp()
        return (self._after if changed else self._before).mdp()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        """The start of an episode, in the maze as it is now; with a seed, of the whole experiment."""
        super().reset(seed=seed)
        if seed is not None:
            self._clock_steps = 0
        self._current.np_random = self.np_random
        return self._current.reset(options=options)

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """One move; the change happens at the end of step ``change_step``, wherever the agent is."""
        s_t, reward, terminated, truncated, extra = self._current.step(action)
        self._clock_steps += 1
        if self._clock_steps == self._change_step and not terminated:
            self._after.np_random = self.np_random
            _, extra = self._after.reset(options={"state": s_t})
        return s_t, reward, terminated, truncated, extra

    def render(self) -> Any:
        """As the present maze is drawn."""
        return self._current.render()

    @property
    def _current(self) -> RenderedEnv:
        return self._after if self._clock_steps >= self._change_step else self._before


def make(change: str = "blocking", change_step: int | None = None, render_mode: str | None = None) -> ChangingEnv:
    """What ``gymnasium.make("neuralq/BlockingMaze-v0")`` and ``"neuralq/ShortcutMaze-v0"`` call.

    Args:
        change: ``"blocking"`` or ``"shortcut"``.
        change_step: when; default as published, 1000 and 3000.
        render_mode: None, ``"ansi"`` or ``"rgb_array"``.

    Example:
        >>> make("blocking").reset(seed=0)[0]
        48
    """
    before, after = (grid.env(render_mode) for grid in grids(change))
    return ChangingEnv(before, after, _CHANGE_STEP[change] if change_step is None else change_step)
