"""Environments with a known answer: each gives its exact `FiniteMDP` beside the Gymnasium interface.

Beside them stand two of Gymnasium's own problems, vectorised (`CLASSIC`), and what has no exact model, or one too large
to write down (`WITHOUT_MODEL`). Importing this package registers them all, and Gymnasium imports it by itself where an
id names it: ``gymnasium.make("neuralq_envs:neuralq/MitchellGrid-v0")``.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from gymnasium.envs import registration
from gymnasium.envs.registration import EnvSpec

__all__ = ["CLASSIC", "ENVIRONMENTS", "WITHOUT_MODEL", "Classic", "Registration", "register", "vector_twin"]


class Registration(NamedTuple):
    """A module with `make` (and `make_vector`), and the arguments that make this environment of it.

    Args:
        module: where the functions are (`neuralq_envs.rendering.factories` makes them); imported when first needed.
        kwargs: arguments of both functions.
        has_vector: whether there is a `make_vector`; a world that changes with time is not one model to simulate.
        max_episode_steps: steps after which Gymnasium truncates an episode; None for never.
    """

    module: str
    kwargs: Mapping[str, Any] = MappingProxyType({})
    has_vector: bool = True
    max_episode_steps: int | None = None


ENVIRONMENTS = {
    "neuralq/BairdStar-v0": Registration("neuralq_envs.counterexamples.baird"),
    "neuralq/BlockingMaze-v0": Registration("neuralq_envs.changing", {"change": "blocking"}, has_vector=False),
    "neuralq/BoyanChain-v0": Registration("neuralq_envs.boyan"),
    "neuralq/CliffWalking-v0": Registration("neuralq_envs.cliff"),
    "neuralq/DynaMaze-v0": Registration("neuralq_envs.dyna"),
    "neuralq/ExerciseGrid-v0": Registration("neuralq_envs.mitchell", {"goal": 4, "goal_reward": 10.0}),
    "neuralq/Gridworld-v0": Registration("neuralq_envs.gridworld"),
    "neuralq/Landmarks-v0": Registration("neuralq_envs.landmarks"),
    "neuralq/MaximizationBias-v0": Registration("neuralq_envs.maximization_bias"),
    "neuralq/MitchellGrid-v0": Registration("neuralq_envs.mitchell"),
    "neuralq/RandomWalk-v0": Registration("neuralq_envs.random_walk"),
    "neuralq/RandomWalk19-v0": Registration(
        "neuralq_envs.random_walk", {"num_states": 19, "left_reward": -1.0, "right_reward": 1.0}
    ),
    "neuralq/ShortcutMaze-v0": Registration("neuralq_envs.changing", {"change": "shortcut"}, has_vector=False),
    "neuralq/SlideMaze-v0": Registration("neuralq_envs.slide_maze"),
    "neuralq/TicTacToe-v0": Registration("neuralq_envs.tictactoe"),
    "neuralq/WindyGridworld-v0": Registration("neuralq_envs.windy"),
}

WITHOUT_MODEL = {
    "neuralq/Backgammon-v0": Registration("neuralq_envs.backgammon.single_agent", has_vector=False),
    "neuralq/Checkers-v0": Registration("neuralq_envs.checkers.single_agent", has_vector=False),
    "neuralq/LinWorld-v0": Registration("neuralq_envs.lin_world.environment", has_vector=False),
    "neuralq/LinearQuadratic-v0": Registration(
        "neuralq_envs.linear_quadratic", has_vector=False, max_episode_steps=100
    ),
    "neuralq/Elevators-v0": Registration("neuralq_envs.elevators.environment", has_vector=False),
    # The repairs of 51 tasks are 50, those of 164 are 400.
    "neuralq/JobShop-v0": Registration("neuralq_envs.job_shop.env", has_vector=False, max_episode_steps=1000),
    # What is observed is not the state, so that the model of the states is not one of what is observed.
    "neuralq/LittmanMaze-v0": Registration(
        "neuralq_envs.aliased", {"maze": "littman"}, has_vector=False, max_episode_steps=500
    ),
    "neuralq/McCallumMaze-v0": Registration(
        "neuralq_envs.aliased", {"maze": "mccallum"}, has_vector=False, max_episode_steps=200
    ),
    "neuralq/Obelix-v0": Registration("neuralq_envs.obelix", has_vector=False, max_episode_steps=100),
    "neuralq/Pengo-v0": Registration("neuralq_envs.pengo", has_vector=False, max_episode_steps=60),
    # A pole that is balanced for good would never end an episode.
    "neuralq/PoleBoxes-v0": Registration("neuralq_envs.pole", has_vector=False, max_episode_steps=10_000),
    "neuralq/RingMaze-v0": Registration("neuralq_envs.ring_mazes", has_vector=False, max_episode_steps=1000),
    "neuralq/ThrunRobot-v0": Registration("neuralq_envs.thrun_robot", has_vector=False, max_episode_steps=30),
    "neuralq/Woods1-v0": Registration("neuralq_envs.woods", has_vector=False, max_episode_steps=500),
}


class Classic(NamedTuple):
    """One of Gymnasium's own problems, with a vectorised implementation that repeats it to the bit.

    Args:
        entry_point: Gymnasium's class.
        vector_entry_point: ours.
        max_episode_steps: as Gymnasium registers it.
        reward_threshold: as Gymnasium registers it.
        arguments: of Gymnasium's class that the vectorised one knows too.
    """

    entry_point: str
    vector_entry_point: str
    max_episode_steps: int
    reward_threshold: float
    arguments: frozenset[str] = frozenset()


CLASSIC = {
    "neuralq/Acrobot-v0": Classic(
        "gymnasium.envs.classic_control.acrobot:AcrobotEnv",
        "neuralq_envs.classic:make_acrobot_vector",
        max_episode_steps=500,
        reward_threshold=-100.0,
    ),
    "neuralq/MountainCar-v0": Classic(
        "gymnasium.envs.classic_control.mountain_car:MountainCarEnv",
        "neuralq_envs.classic:make_mountain_car_vector",
        max_episode_steps=200,
        reward_threshold=-110.0,
        arguments=frozenset({"goal_velocity"}),
    ),
}


def vector_twin(spec: EnvSpec, given: Mapping[str, Any]) -> tuple[str, dict[str, Any]] | None:
    """The id and arguments with which ``gymnasium.make_vec`` makes the environments of ``spec``, only quicker, or None.

    Gymnasium's ``MountainCar-v0`` and ``Acrobot-v1`` have one, and so has whatever else is registered with their
    classes, with its own time limit. Wrappers and arguments that the vectorised one does not know rule it out.

    Args:
        spec: of the environment that is wanted.
        given: arguments for ``gymnasium.make``.

    Example:
        >>> import gymnasium
        >>> vector_twin(gymnasium.spec("Acrobot-v1"), {})
        ('neuralq/Acrobot-v0', {'max_episode_steps': 500})
        >>> vector_twin(gymnasium.spec("Acrobot-v1"), {"render_mode": "human"}) is None
        True
    """
    arguments = {**spec.kwargs, **given}
    limit = arguments.pop("max_episode_steps", None)
    limit = spec.max_episode_steps if limit is None else limit
    for env_id, one in CLASSIC.items():
        if spec.entry_point == one.entry_point and not spec.additional_wrappers and one.arguments.issuperset(arguments):
            return env_id, {**arguments, "max_episode_steps": None if limit == -1 else limit}
    return None


def register() -> None:
    """Registers every environment with Gymnasium; calling it again does nothing.

    Example:
        >>> register()
        >>> import gymnasium
        >>> gymnasium.make("neuralq/MitchellGrid-v0").observation_space
        Discrete(6)
    """
    for env_id, one in (ENVIRONMENTS | WITHOUT_MODEL).items():
        if env_id not in registration.registry:
            registration.register(
                env_id,
                entry_point=f"{one.module}:make",
                vector_entry_point=f"{one.module}:make_vector" if one.has_vector else None,
                kwargs=dict(one.kwargs),
                max_episode_steps=one.max_episode_steps,
            )
    for env_id, classic in CLASSIC.items():
        if env_id not in registration.registry:
            registration.register(
                env_id,
                entry_point=classic.entry_point,
                vector_entry_point=classic.vector_entry_point,
                max_episode_steps=classic.max_episode_steps,
                reward_threshold=classic.reward_threshold,
            )


register()
