"""The random walk of Sutton 1988: from the middle of a row of states, left or right with equal chances, off either end.

Walking off the left end pays one reward, off the right end another, everything else nothing. With γ = 1 the value of
state i of n lies on the line between the two: left + (right − left) i / (n + 1). So with n = 5 and rewards 0 and 1 the
values are 1/6 ... 5/6; with n = 19 and rewards −1 and 1 (Sutton & Barto 2018, example 7.1) they are −.9 ... .9.

State 0 is the left end, 1 to n are the walk, n + 1 is the right end. There is one action: this is a prediction problem.
"""

from __future__ import annotations

from neuralq.checks import check_whole
from neuralq.mdp import FiniteMDP
from neuralq_envs.graphs import GraphScene
from neuralq_envs.rendering import factories

__all__ = ["GAMMA", "make", "make_vector", "mdp"]

GAMMA = 1.0


def mdp(num_states: int = 5, left_reward: float = 0.0, right_reward: float = 1.0) -> FiniteMDP:
    """The exact model, ``num_states`` + 2 states with the two ends.

    Raises:
        ValueError: no state to walk in, or a reward that is not finite.

    Example:
        >>> model = mdp()
        >>> model.reward.tolist(), model.start_distribution.tolist()
        ([0.0, 0.0, 0.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    """
    check_whole("num_states", num_states)
    last = num_states + 1

    def transitions(s: int, a: int) -> list[tuple[float, int, float, bool]]:
        pays = {0: left_reward, last: right_reward}
        return [(0.5, s_t, pays.get(s_t, 0.0), s_t in pays) for s_t in (s - 1, s + 1)]

    return FiniteMDP.from_functions(
        num_states + 2,
        1,
        lambda s: [0] if 0 < s < last else [],
        transitions,
        start=[float(s == (num_states + 1) // 2) for s in range(num_states + 2)],
        state_names=["left end", *_labels(num_states), "right end"],
        action_names=("walk",),
    )


def _scene(num_states: int = 5, **_: float) -> GraphScene:
    size = num_states + 2
    return GraphScene(
        labels=("END", *_labels(num_states), "END"),
        places=tuple((0, s) for s in range(size)),
        edges=tuple((s, s + 1) for s in range(size - 1)),
        ends=(0, size - 1),
    )


def _labels(num_states: int) -> list[str]:
    """Letters as in the literature, numbers where the alphabet is too short."""
    return [chr(ord("A") + i) if num_states <= 26 else str(i + 1) for i in range(num_states)]


make, make_vector = factories(mdp, _scene)
