"""Environments with a known answer: each gives its exact `FiniteMDP` beside the Gymnasium interface.

`register` is the package's ``gymnasium.envs`` entry point, so ``gymnasium.make("neuralq/MitchellGrid-v0")`` finds them.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

__all__ = ["ENVIRONMENTS", "Registration", "register"]


class Registration(NamedTuple):
    """A module with `make` (and `make_vector`), and the arguments that make this environment of it.

    Args:
        module: where the functions are; imported when the environment is first made.
        kwargs: arguments of both functions.
        has_vector: whether there is a `make_vector`; a world that changes with time is not one model to simulate.
    """

    module: str
    kwargs: Mapping[str, Any] = MappingProxyType({})
    has_vector: bool = True


ENVIRONMENTS = {
    "neuralq/BairdStar-v0": Registration("neuralq_envs.counterexamples.baird"),
    "neuralq/BlockingMaze-v0": Registration("neuralq_envs.changing", {"change": "blocking"}, has_vector=False),
    "neuralq/BoyanChain-v0": Registration("neuralq_envs.boyan"),
    "neuralq/CliffWalking-v0": Registration("neuralq_envs.cliff"),
    "neuralq/DynaMaze-v0": Registration("neuralq_envs.dyna"),
    "neuralq/ExerciseGrid-v0": Registration("neuralq_envs.mitchell", {"goal": 4, "goal_reward": 10.0}),
    "neuralq/Gridworld-v0": Registration("neuralq_envs.gridworld"),
    "neuralq/MaximizationBias-v0": Registration("neuralq_envs.maximization_bias"),
    "neuralq/MitchellGrid-v0": Registration("neuralq_envs.mitchell"),
    "neuralq/RandomWalk-v0": Registration("neuralq_envs.random_walk"),
    "neuralq/RandomWalk19-v0": Registration(
        "neuralq_envs.random_walk", {"num_states": 19, "left_reward": -1.0, "right_reward": 1.0}
    ),
    "neuralq/ShortcutMaze-v0": Registration("neuralq_envs.changing", {"change": "shortcut"}, has_vector=False),
    "neuralq/TicTacToe-v0": Registration("neuralq_envs.tictactoe"),
    "neuralq/WindyGridworld-v0": Registration("neuralq_envs.windy"),
}


def register() -> None:
    """Registers every environment with Gymnasium; calling it again does nothing.

    Example:
        >>> register()
        >>> import gymnasium
        >>> gymnasium.make("neuralq/MitchellGrid-v0").observation_space
        Discrete(6)
    """
    # Imported here: importing Gymnasium calls this function, which must be there by then.
    from gymnasium.envs import registration

    for env_id, one in ENVIRONMENTS.items():
        if env_id not in registration.registry:
            registration.register(
                env_id,
                entry_point=f"{one.module}:make",
                vector_entry_point=f"{one.module}:make_vector" if one.has_vector else None,
                kwargs=dict(one.kwargs),
            )
