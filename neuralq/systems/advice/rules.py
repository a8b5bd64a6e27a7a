"""What somebody who knows the game would say, four times each, for the four directions; and what nobody should say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from neuralq.q import Rule
from neuralq_envs.pengo_kernels import input_of

__all__ = ["BAD", "GOOD", "Advice"]

Advice = Mapping[str, Sequence[Rule]]
"""Rules by what they say."""

_NEAR = 0.5  # what a sector says of something two steps away: nothing is nearer that is not beside the player


def _good(d: int) -> dict[str, Rule]:
    """Of direction d; the sector straight ahead is the even one."""
    back, ahead = (d + 2) % 4, 2 * d
    food, enemy = input_of("food", sector=ahead), input_of("enemy", sector=ahead)
    return {
        "food beside you: take it": Rule({input_of("food", d): True}, d),
        "an enemy beside you, the other way free: flee": Rule(
            {input_of("enemy", d): True, input_of("free", back): True}, back
        ),
        "food near, no enemy there, the way free: go": Rule(
            {
                food: (0.0, _NEAR),
                enemy: (_NEAR, 0.0),
                input_of("free", d): True,
                input_of("food", d): False,  # who is beside it would make up for what is not free
            },
            d,
        ),
        "a block beside you, an enemy behind it: push": Rule(
            {input_of("block", d): True, enemy: (0.0, _NEAR), input_of("enemy", d): False}, 4 + d
        ),
    }


def _bad(d: int) -> dict[str, Rule]:
    return {
        "food beside you: go the other way": Rule({input_of("food", d): True}, (d + 2) % 4),
        "an enemy beside you: go there": Rule({input_of("enemy", d): True}, d),
    }


GOOD: Advice = {name: [_good(d)[name] for d in range(4)] for name in _good(0)}
BAD: Advice = {name: [_bad(d)[name] for d in range(4)] for name in _bad(0)}
