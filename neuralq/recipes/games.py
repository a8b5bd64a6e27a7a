"""Games of the extras: MinAtar (Young & Tian 2019) and Atari 2600 (Bellemare et al. 2013), registered when asked for.

Gymnasium looks for ``MinAtar/...`` and ``ALE/...`` only after the package that has them was told to register them. An
Atari screen is not played from as it is: 84 × 84 grey frames, the brighter of the last two of every four screens, the
last four of them stacked, and up to 30 idle steps at the start (Mnih et al. 2015), by Gymnasium's own wrappers. Rewards
are those of the game, and a lost life does not end the episode. The emulator's vectorised implementation is left alone:
it takes as much CPU time per step as these do (measured), and hands out clipped rewards.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation

__all__ = ["ATARI", "MINATAR", "make_single", "register_games"]

MINATAR, ATARI = "MinAtar/", "ALE/"
_NUM_NOOPS, _FRAME_SKIP, _SIDE, _NUM_STACKED = 30, 4, 84, 4
_CELL = 24


def register_games(env_id: str) -> None:
    """Make the ids of an extra known where ``env_id`` is one of them.

    Raises:
        ValueError: if the extra is not installed, with the command that installs it.

    Example:
        >>> register_games("CartPole-v1")  # nothing to do
    """
    for prefix, module, extra in ((MINATAR, "minatar.gym", "minatar"), (ATARI, "ale_py", "atari")):
        if env_id.startswith(prefix) and not any(known.startswith(prefix) for known in gym.registry):
            try:
                games = importlib.import_module(module)
                if extra == "atari":
                    importlib.import_module("cv2")  # Gymnasium's preprocessing resizes with it
            except ImportError as error:
                raise ValueError(
                    f"{env_id} needs the extra {extra!r} ({error}): pip install 'neuralq[{extra}]'"
                ) from error
            if extra == "minatar":
                games.register_envs()


def make_single(env: str, env_kwargs: Mapping[str, Any], render_mode: str | None = None) -> gym.Env[Any, Any]:
    """One environment, by the id that a configuration gives; Atari games come preprocessed.

    Args:
        env: Gymnasium id, or "module:id".
        env_kwargs: passed to `gymnasium.make`.
        render_mode: how it is to be drawn, if at all.

    Example:
        >>> make_single("CartPole-v1", {}).action_space.n
        np.int64(2)
    """
    register_games(env)
    kwargs = dict(env_kwargs) if render_mode is None else {**env_kwargs, "render_mode": render_mode}
    if env.startswith(MINATAR) and kwargs.get("render_mode") == "rgb_array":
        # Its pictures are floats of 10 × 10, at which the checker would take offence at every one.
        return _Enlarged(gym.make(env, disable_env_checker=True, **kwargs))
    if not _is_screen(env, env_kwargs):
        return gym.make(env, **kwargs)
    frame_skip = kwargs.pop("frameskip", _FRAME_SKIP)
    game = gym.make(env, frameskip=1, **kwargs)
    frames = AtariPreprocessing(game, noop_max=_NUM_NOOPS, frame_skip=frame_skip, screen_size=_SIDE)
    return FrameStackObservation(frames, _NUM_STACKED)


class _Enlarged(gym.Wrapper[Any, Any, Any, Any]):
    """Pictures in bytes, a square of pixels for each cell, ten a second."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.metadata = {**env.metadata, "render_fps": 10}

    def render(self) -> Any:
        cells = np.asarray(self.env.render())
        return np.rint(255 * cells).astype(np.uint8).repeat(_CELL, 0).repeat(_CELL, 1)


def _is_screen(env: str, env_kwargs: Mapping[str, Any]) -> bool:
    return env.startswith(ATARI) and env_kwargs.get("obs_type", "rgb") == "rgb"
