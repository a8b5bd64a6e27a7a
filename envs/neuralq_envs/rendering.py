"""A finite model with a picture: the one environment class behind all problems of this package, and how it is made."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_choice
from neuralq.mdp import FiniteMDP
from neuralq.mdp.environment import ModelVectorEnv

__all__ = ["NoisyRewards", "RenderedEnv", "Scene", "factories"]


class Scene(Protocol):
    """How a state looks; ``None`` is the empty scene, before the first reset."""

    def text(self, state: int | None) -> str:
        """The scene as lines of text."""

    def pixels(self, state: int | None) -> NDArray[np.uint8]:
        """The scene as a picture, ``[H, W, 3]``."""


class RenderedEnv(gymnasium.Env[Any, Any]):
    """A finite model as an environment that can be looked at; ``info["action_mask"]`` names the legal actions.

    Args:
        model: the exact model, which is simulated.
        scene: how its states are drawn.
        render_mode: None, ``"ansi"`` or ``"rgb_array"``.
        reward_noise: standard deviation of the normal noise that each pair's reward carries, ``[S, A]``; default none.
            The model holds the expected rewards.

    Raises:
        ValueError: another render mode, or noise of another shape.

    Example:
        >>> from neuralq_envs import cliff
        >>> env = RenderedEnv(cliff.mdp(), cliff.GRID, "ansi")
        >>> env.reset(seed=0)[1]["action_mask"].tolist()
        [1, 1, 1, 1]
        >>> env.render().splitlines()[-1]
        'A C C C C C C C C C C G'
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 4}  # noqa: RUF012

    def __init__(
        self,
        model: FiniteMDP,
        scene: Scene,
        render_mode: str | None = None,
        reward_noise: ArrayLike | None = None,
    ) -> None:
        check_choice("render_mode", render_mode, [None, *self.metadata["render_modes"]])
        self.render_mode = render_mode
        self._model, self._scene = model.as_env(), scene
        self._noise = _noise_table(model, reward_noise)
        self.observation_space = self._model.observation_space
        self.action_space = self._model.action_space
        self._state: int | None = None

    def mdp(self) -> FiniteMDP:
        """The exact model."""
        return self._model.mdp()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        """A first state drawn from the model's start distribution, or ``options["state"]``."""
        super().reset(seed=seed)
        self._model.np_random = self.np_random  # one generator, so that the seed decides everything
        self._state, extra = self._model.reset(options=options)
        return self._state, extra

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """One transition drawn from the model; an illegal action leaves the state, with reward 0."""
        s_tm1 = self._state
        self._state, reward, terminated, truncated, extra = self._model.step(action)
        spread = 0.0 if self._noise is None else float(self._noise[s_tm1, action])
        if spread > 0:
            reward += spread * float(self.np_random.standard_normal())
        return self._state, reward, terminated, truncated, extra

    def render(self) -> Any:
        """Text for ``ansi``, uint8 ``[H, W, 3]`` for ``rgb_array``, None without a render mode."""
        if self.render_mode == "ansi":
            return self._scene.text(self._state)
        if self.render_mode == "rgb_array":
            return self._scene.pixels(self._state)
        return None


class NoisyRewards(gymnasium.vector.VectorWrapper):
    """Copies of a model whose rewards carry independent normal noise; the model itself holds the expected rewards.

    Args:
        envs: the copies; each observation is the number of a state.
        model: their model.
        reward_noise: standard deviation for each pair, ``[S, A]``.

    Example:
        >>> from neuralq_envs import maximization_bias
        >>> envs = maximization_bias.make_vector(num_envs=2)
        >>> _ = envs.reset(seed=0)
        >>> envs.step(np.array([0, 1]))[1].tolist()  # both leave A, which pays exactly 0
        [0.0, 0.0]
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any], model: FiniteMDP, reward_noise: ArrayLike) -> None:
        super().__init__(envs)
        table = _noise_table(model, reward_noise)
        assert table is not None
        self._noise: NDArray[np.float64] = table
        self._s_tm1 = np.zeros(envs.num_envs, dtype=np.int64)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """As the copies do it."""
        s, extra = self.env.reset(seed=seed, options=options)
        self._s_tm1 = s.copy()
        return s, extra

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """As the copies do it, with noise on the rewards."""
        s, reward, terminations, truncations, extra = self.env.step(actions)
        spread = self._noise[self._s_tm1, np.asarray(actions)]
        self._s_tm1 = s.copy()
        # One draw per copy and step, so that what a copy draws does not depend on where the others are.
        reward = reward + spread * self.env.np_random.standard_normal(self.num_envs)
        return s, reward, terminations, truncations, extra


def factories(
    mdp: Callable[..., FiniteMDP], scene: Callable[..., Scene], parameters: Callable[..., Any] | None = None
) -> tuple[Callable[..., RenderedEnv], Callable[..., ModelVectorEnv]]:
    """What ``gymnasium.make`` and ``gymnasium.make_vec`` call for a problem: its ``make`` and ``make_vector``.

    Both take the arguments of ``mdp`` by name. ``make`` takes ``render_mode`` too; ``make_vector`` (array operations,
    autoreset disabled) ``num_envs`` and ``max_episode_steps``.

    Args:
        mdp: makes the exact model.
        scene: makes its picture from the same arguments.
        parameters: whose parameters these are; default ``mdp``.

    Example:
        >>> from neuralq_envs import cliff
        >>> make, make_vector = factories(cliff.mdp, lambda: cliff.GRID)
        >>> make("ansi").reset(seed=0)[0], make_vector(2).reset(seed=0)[0].tolist()
        (36, [36, 36])
    """

    def make(render_mode: str | None = None, **given: Any) -> RenderedEnv:
        """What ``gymnasium.make`` calls: the problem with its picture."""
        return RenderedEnv(mdp(**given), scene(**given), render_mode)

    def make_vector(num_envs: int = 1, max_episode_steps: int | None = None, **given: Any) -> ModelVectorEnv:
        """What ``gymnasium.make_vec`` calls in mode ``"vector_entry_point"``."""
        return mdp(**given).as_vector_env(num_envs, max_episode_steps=max_episode_steps)

    known = inspect.signature(mdp if parameters is None else parameters).parameters.values()
    named = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in known]
    made: tuple[Any, Any] = (make, make_vector)
    for function in made:
        signature = inspect.signature(function)
        own = list(signature.parameters.values())[:-1]
        function.__signature__ = signature.replace(parameters=[*own, *named])
    return make, make_vector


def _noise_table(model: FiniteMDP, reward_noise: ArrayLike | None) -> NDArray[np.float64] | None:
    """The standard deviations, 0 where an action is not legal and nothing is paid."""
    if reward_noise is None:
        return None
    table = np.array(reward_noise, dtype=np.float64)
    if table.shape != model.legal.shape or not (np.isfinite(table) & (table >= 0)).all():
        raise ValueError(
            f"reward_noise must be {model.legal.shape} numbers of at least 0, one standard deviation for each pair, "
            f"got shape {table.shape} with smallest {table.min() if table.size else None}"
        )
    return np.where(model.legal, table, 0.0)
