"""Any grid world from a text map; the signs of a map and the rules of a move are those of `neuralq_envs.grids.Grid`.

The default map is the 4 x 3 world of Russell & Norvig (Artificial Intelligence: A Modern Approach). With their rewards
(step −.04, goal and trap ±1 on top), slip .2 and γ = 1 its values are .812 .868 .918 / .762 .660 / .705 .655 .611 .388.
"""

from __future__ import annotations

from collections.abc import Sequence

from neuralq.mdp import FiniteMDP
from neuralq.mdp.environment import ModelVectorEnv
from neuralq_envs.drawn import DrawnEnv
from neuralq_envs.grids import Grid

__all__ = ["LAYOUT", "make", "make_vector", "mdp"]

LAYOUT = """
...G
.#.T
S...
"""


def mdp(grid: Grid | None = None) -> FiniteMDP:
    r"""The exact model of a grid world; default: the one that is registered.

    Example:
        >>> mdp(Grid("S..\n.#G", slip=0.1)).num_states
        6
    """
    return (Grid(LAYOUT) if grid is None else grid).mdp()


def make(
    layout: str = LAYOUT,
    step_reward: float = 0.0,
    goal_reward: float = 1.0,
    trap_reward: float = -1.0,
    cliff_reward: float = -1.0,
    wind: Sequence[int] = (),
    slip: float = 0.0,
    num_moves: int = 4,
    blocked: str = "legal",
    render_mode: str | None = None,
) -> DrawnEnv:
    r"""What ``gymnasium.make("neuralq/Gridworld-v0")`` calls: every parameter of `Grid` is one of the environment.

    Example:
        >>> import gymnasium
        >>> gymnasium.make("neuralq/Gridworld-v0", layout="S....\n.##.G", slip=0.2).observation_space
        Discrete(10)
    """
    rewards = (step_reward, goal_reward, trap_reward, cliff_reward)
    return Grid(layout, *rewards, tuple(wind), slip, num_moves, blocked).env(render_mode)


def make_vector(
    num_envs: int = 1,
    layout: str = LAYOUT,
    step_reward: float = 0.0,
    goal_reward: float = 1.0,
    trap_reward: float = -1.0,
    cliff_reward: float = -1.0,
    wind: Sequence[int] = (),
    slip: float = 0.0,
    num_moves: int = 4,
    blocked: str = "legal",
    max_episode_steps: int | None = None,
) -> ModelVectorEnv:
    """What ``gymnasium.make_vec`` calls in mode ``"vector_entry_point"``.

    Example:
        >>> make_vector(num_envs=2).reset(seed=0)[0].tolist()
        [8, 8]
    """
    rewards = (step_reward, goal_reward, trap_reward, cliff_reward)
    grid = Grid(layout, *rewards, tuple(wind), slip, num_moves, blocked)
    return grid.vector_env(num_envs, max_episode_steps)
