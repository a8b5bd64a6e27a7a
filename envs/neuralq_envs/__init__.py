"""Environments with a known answer: each gives its exact `FiniteMDP` beside the Gymnasium interface.

`register` is the package's ``gymnasium.envs`` entry point, so ``gymnasium.make("neuralq/MitchellGrid-v0")`` finds them.
"""

from __future__ import annotations

from gymnasium.envs import registration

__all__ = ["ENVIRONMENTS", "register"]

# What is registered, and the module that holds its `make` and `make_vector`.
ENVIRONMENTS = {
    "neuralq/BairdStar-v0": "neuralq_envs.counterexamples.baird",
    "neuralq/MitchellGrid-v0": "neuralq_envs.mitchell",
}


def register() -> None:
    """Registers every environment with Gymnasium; calling it again does nothing.

    Example:
        >>> register()
        >>> import gymnasium
        >>> gymnasium.make("neuralq/MitchellGrid-v0").observation_space
        Discrete(6)
    """
    for env_id, module in ENVIRONMENTS.items():
        if env_id not in registration.registry:
            registration.register(
                env_id,
                entry_point=f"{module}:make",
                vector_entry_point=f"{module}:make_vector",
            )
