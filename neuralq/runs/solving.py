"""The exact answer of an environment, by whatever it is named: what `neuralq.solve` is."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from neuralq.exact import Solution
from neuralq.exact import solve as solve_mdp
from neuralq.mdp import FiniteMDP
from neuralq.runs.recipe.games import make_single, refusals_name
from neuralq.runs.recipe.handed import handed_over
from neuralq.runs.recipe.stand_in import standing_in

__all__ = ["solve"]

_NOTHING: Mapping[str, Any] = MappingProxyType({})


def solve(
    env: Any,
    gamma: float = 0.99,
    method: str = "auto",
    tol: float | None = None,
    *,
    env_kwargs: Mapping[str, Any] = _NOTHING,
    check: bool = True,
    max_iterations: int | None = None,
    seed: int = 0,
    **more_env_kwargs: Any,
) -> Solution:
    """Optimal values and every optimal action of an environment that has a model, within a guaranteed bound.

    Args:
        env: a Gymnasium id, "module:id", an environment, a class or function that makes one, or a `FiniteMDP`.
        gamma: γ in [0, 1].
        method: as for `neuralq.exact.solve`.
        tol: likewise.
        env_kwargs: passed to `gymnasium.make`.
        check: whether a few thousand steps of the environment are compared with its table first.
        max_iterations: as for `neuralq.exact.solve`.
        seed: likewise.
        more_env_kwargs: as ``env_kwargs``.

    Raises:
        ValueError: the environment cannot be made or has no model, or what `neuralq.exact.solve` refuses.

    Source: as for `neuralq.exact.solve`.

    Example:
        >>> round(float(solve("FrozenLake-v1", 0.9, is_slippery=False).v[0]), 5)
        0.59049
    """
    model = env if isinstance(env, FiniteMDP) else _model_of(env, {**env_kwargs, **more_env_kwargs}, check)
    return solve_mdp(model, gamma, method, tol, max_iterations=max_iterations, seed=seed)


def _model_of(env: Any, kwargs: Mapping[str, Any], check: bool) -> FiniteMDP:
    handed = handed_over(env)
    if handed.make is not None and kwargs:
        raise ValueError(
            f"{', '.join(kwargs)} cannot be given to an environment that is made already; they go with its name"
        )
    with standing_in(handed.make), refusals_name(handed.env):
        made = make_single(handed.env, {**handed.env_kwargs, **kwargs})
    try:
        return FiniteMDP.from_gymnasium(made, check=check)
    finally:
        made.close()
