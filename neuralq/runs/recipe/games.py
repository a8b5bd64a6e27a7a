"""Games of the extras: MinAtar (Young & Tian 2019), Atari 2600 (Bellemare et al. 2013) and Gymnasium's with Box2D.

Gymnasium looks for ``MinAtar/...`` and ``ALE/...`` only after the package that has them was told to register them; ids
such as ``LunarLander-v3`` it always knows, and misses their engine, Box2D, only when one is made. An Atari screen is
not played from as it is: 84 × 84 grey frames, the brighter of the last two of every four screens, the last four of them
stacked, and up to 30 idle steps at the start (Mnih et al. 2015), by Gymnasium's own wrappers. Rewards are those of the
game, and a lost life does not end the episode, unless a run asks for that in training; it is evaluated without. The
emulator's vectorised implementation is left alone: it takes as much CPU time per step as these do (measured), and hands
out clipped rewards. The ids of neuralq's own environments are known wherever this module is: importing them registers
them.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import AtariPreprocessing, ClipReward, FrameStackObservation, TimeLimit

import neuralq_envs
from neuralq.checks import check_module_name
from neuralq.runs.recipe.stand_in import nameless, stand_in

__all__ = ["ATARI", "MINATAR", "is_screen", "make_single", "own_maker", "refusals_name", "register_games"]

MINATAR, ATARI = "MinAtar/", "ALE/"
_NUM_NOOPS, _FRAME_SKIP, _SIDE, _NUM_STACKED = 30, 4, 84, 4
_CELL = 24
_BOX2D = "gymnasium.envs.box2d."  # where Gymnasium's registry says that these are


def register_games(env_id: str) -> None:
    """Make the ids of an extra known where ``env_id`` is one of them.

    Raises:
        ValueError: if the extra is not installed, with the command that installs it.

    Example:
        >>> register_games("CartPole-v1")  # nothing to do
    """
    if str(getattr(gym.registry.get(env_id), "entry_point", "")).startswith(_BOX2D):
        try:
            importlib.import_module("Box2D")
        except ImportError as error:
            raise _missing(env_id, "box2d", error) from error
    for prefix, module, extra in ((MINATAR, "minatar.gym", "minatar"), (ATARI, "ale_py", "atari")):
        if env_id.startswith(prefix) and not any(known.startswith(prefix) for known in gym.registry):
            try:
                games = importlib.import_module(module)
                if extra == "atari":
                    importlib.import_module("cv2")  # Gymnasium's preprocessing resizes with it
            except ImportError as error:
                raise _missing(env_id, extra, error) from error
            if extra == "minatar":
                games.register_envs()


def _missing(env_id: str, extra: str, error: ImportError) -> ValueError:
    return ValueError(f"{env_id} needs the extra {extra!r} ({error}): pip install 'neuralq[{extra}]'")


@contextlib.contextmanager
def refusals_name(env: str) -> Iterator[None]:
    """Whatever goes wrong while ``env`` is made becomes one line that names it and what to do about it.

    Raises:
        ValueError: the environment is not registered, or its own code failed.

    Example:
        >>> with refusals_name("CartPole-v1"):
        ...     _ = gym.make("CartPole-v1")
    """
    if nameless(env) and stand_in() is None:
        raise ValueError(
            f"this run was trained on an environment that no name leads to, {env[1:-1]} of a Python program; hand it "
            "over again: neuralq.load(run, env=...), neuralq.resume(run, env=...) or neuralq.evaluate(run, env=...)"
        )
    if ":" in env:
        check_module_name("the environment", env.rpartition(":")[0], env)
    try:
        yield
    except gym.error.Error as error:
        way_out = "Name a registered Gymnasium id; an environment of your own is found as 'your_module:YourEnv-v0'"
        if env.startswith("neuralq/"):
            known = ", ".join(id.removeprefix("neuralq/") for id in neuralq_envs.ENVIRONMENTS)
            way_out = f"neuralq has {known}; elsewhere they are found as 'neuralq_envs:neuralq/MitchellGrid-v0'"
        raise ValueError(f"cannot make the environment {env!r}: {str(error).rstrip('.')}. {way_out}") from error
    except (Exception, SystemExit) as error:  # the environment's own code ran
        notes = "".join(f"; {note}" for note in getattr(error, "__notes__", ()))
        raise ValueError(f"cannot make the environment {env!r}: {type(error).__name__}: {error}{notes}") from error


def make_single(
    env: str,
    env_kwargs: Mapping[str, Any],
    render_mode: str | None = None,
    clip_rewards: bool = False,
    end_on_life_loss: bool = False,
) -> gym.Env[Any, Any]:
    """One environment, by the name that a configuration gives; Atari games come preprocessed.

    Args:
        env: Gymnasium id, "module:id", or "module:name" of a class or function that makes one. What stands in for it
            (`neuralq.runs.recipe.stand_in`) goes first.
        env_kwargs: passed to `gymnasium.make`, or to the class or function.
        render_mode: how it is to be drawn, if at all.
        clip_rewards: of Atari screens, to between −1 and 1.
        end_on_life_loss: of Atari screens, whether a lost life terminates the episode; the next one is a new game.

    Example:
        >>> make_single("CartPole-v1", {}).action_space.n
        np.int64(2)
    """
    if (make := stand_in()) is not None:
        return make()
    register_games(env)
    kwargs = dict(env_kwargs) if render_mode is None else {**env_kwargs, "render_mode": render_mode}
    if (maker := own_maker(env)) is not None:
        return _of_own(maker, kwargs)
    if env.startswith(MINATAR) and kwargs.get("render_mode") == "rgb_array":
        # Its pictures are floats of 10 × 10, at which the checker would take offence at every one.
        return _Enlarged(gym.make(env, **{**kwargs, "disable_env_checker": True}))
    if not is_screen(env, env_kwargs):
        return gym.make(env, **kwargs)
    frame_skip = kwargs.pop("frameskip", _FRAME_SKIP)
    game = gym.make(env, frameskip=1, **kwargs)
    try:
        frames = AtariPreprocessing(
            game, noop_max=_NUM_NOOPS, frame_skip=frame_skip, screen_size=_SIDE, terminal_on_life_loss=end_on_life_loss
        )
    except BaseException:
        game.close()
        raise
    stacked = FrameStackObservation(frames, _NUM_STACKED)
    return ClipReward(stacked, -1.0, 1.0) if clip_rewards else stacked


def own_maker(env: str) -> Callable[..., Any] | None:
    """The class or function that "module:name" names; None where that is a registered id.

    Example:
        >>> own_maker("gymnasium.envs.classic_control:CartPoleEnv").__name__, own_maker("CartPole-v1")
        ('CartPoleEnv', None)
    """
    module, _, name = env.rpartition(":")
    if not module:
        return None
    found: Any = importlib.import_module(module)  # may register ids
    if name in gym.registry:
        return None
    for part in name.split("."):
        found = getattr(found, part, None)
    return found if callable(found) else None


def _of_own(maker: Callable[..., Any], kwargs: Mapping[str, Any]) -> gym.Env[Any, Any]:
    """What a class or function makes; a limit of steps that it does not know is put around it, as Gymnasium does."""
    given = dict(kwargs)
    limit = given.pop("max_episode_steps", None)
    made = maker(**given)
    if not isinstance(made, gym.Env):
        raise TypeError(f"{maker!r} must make a gymnasium.Env, and made {type(made).__name__}")
    return made if limit in (None, -1) else TimeLimit(made, limit)


class _Enlarged(gym.Wrapper[Any, Any, Any, Any]):
    """Pictures in bytes, a square of pixels for each cell, ten a second."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.metadata = {**env.metadata, "render_fps": 10}

    def render(self) -> Any:
        cells = np.asarray(self.env.render())
        return np.rint(255 * cells).astype(np.uint8).repeat(_CELL, 0).repeat(_CELL, 1)


def is_screen(env: str, env_kwargs: Mapping[str, Any]) -> bool:
    """Whether these are the pictures of an Atari game, which are preprocessed.

    Example:
        >>> is_screen("ALE/Pong-v5", {}), is_screen("ALE/Pong-v5", {"obs_type": "ram"}), is_screen("CartPole-v1", {})
        (True, False, False)
    """
    return env.startswith(ATARI) and env_kwargs.get("obs_type", "rgb") == "rgb"
