"""Ways to run the elevators: rules of thumb, a die, and a network that has learned. One compiled loop plays an hour.

All face the same decisions, to stop or to go on; what is forced is forced on all of them.

* *always stop*;
* *random*: heads or tails;
* *sector*: the floors are shared out, as many to each car as can be, and a car stops for calls of its own as it meets
  them;
* *sector, top first*: as well, but a rising car passes them until none of its own is higher;
* *nearest car*: a call belongs to the car that has the fewest floors to go to it, each call that a car already has
  counting as one more; it rises to the highest of its own and collects the others on the way down;
* *HUFF* (highest unanswered floor first): an empty rising car goes to the highest call that no other such car goes to,
  and collects all on the way down;
* *LQF* (longest queue first): to the one that has waited longest.

Source: Crites & Barto 1996 name sectors, HUFF and LQF; what they are in detail is ours.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.learners import SmdpNetwork, new_smdp_network, smdp_network_values
from neuralq.tabular.kernels.random_numbers import Seed, new_stream, uniform
from neuralq_envs.elevators.building import DECIDING, MOVING, PARKED, Building
from neuralq_envs.elevators.inputs import num_inputs, write_inputs
from neuralq_envs.elevators.kernels import advance, decide

__all__ = [
    "ALWAYS_STOP", "HUFF", "LQF", "NEAREST", "NETWORK", "RANDOM", "SECTOR", "SECTOR_TOP", "Controller",
    "new_controller", "play",
]  # fmt: skip

ALWAYS_STOP, RANDOM, SECTOR, SECTOR_TOP, NEAREST, HUFF, LQF, NETWORK = range(8)


class Controller(NamedTuple):
    """One way to run the elevators, and what it keeps in mind.

    Args:
        rule: which, ``[1]``.
        target: the floor that each car goes to, −1 for none, ``[C]``.
        owner: the car that each call belongs to, ``[F]``.
        owned: for whose sake: the passenger who had waited longest, −1 for nobody, ``[F]``.
        network: what has learned.
        x: room for what a car sees, ``[I]``.
        stream: draws.
    """

    rule: NDArray[np.int64]
    target: NDArray[np.int64]
    owner: NDArray[np.int64]
    owned: NDArray[np.int64]
    network: SmdpNetwork
    x: NDArray[np.float64]
    stream: NDArray[np.uint64]


def new_controller(
    rule: int, num_cars: int = 4, num_floors: int = 10, seed: Seed = 0, network: SmdpNetwork | None = None
) -> Controller:
    """A controller for a building of that size.

    Args:
        rule: a number of this module.
        num_cars: C.
        num_floors: F.
        seed: of the die.
        network: what has learned, for `NETWORK`.

    Example:
        >>> new_controller(HUFF, num_cars=2, num_floors=6).target.tolist()
        [-1, -1]
    """
    size = num_inputs(num_floors)
    return Controller(
        np.array([rule]), np.full(num_cars, -1), np.zeros(num_floors, np.int64), np.full(num_floors, -1),
        new_smdp_network(size, 1, 2, np.random.default_rng(0)) if network is None else network,
        np.zeros(size), new_stream(seed),
    )  # fmt: skip


@lean_kernel
def _sector(b: Building, floor: int) -> int:
    return (floor - 1) * len(b.floor) // (len(b.waiting) - 1)


@lean_kernel
def _own_call_above(b: Building, car: int, mine: Controller) -> bool:
    """Whether somebody waits higher up on a floor of the car's sector, or who belongs to it."""
    for f in range(b.floor[car] + 1, len(b.waiting)):
        if b.waiting[f] > 0:
            if mine.rule[0] == NEAREST:
                if mine.owner[f] == car:
                    return True
            elif _sector(b, f) == car:
                return True
    return False


@lean_kernel
def _floors_to_go(b: Building, car: int, floor: int) -> Any:
    """As a car goes that turns only at the lobby, at the top, and where it is parked."""
    here, top = b.floor[car], len(b.waiting) - 1
    if b.phase[car] == PARKED:
        return abs(here - floor)
    if b.aboard[car] > 0 or b.direction[car] < 0:
        return here - floor if floor <= here else here + floor
    return floor - here if floor >= here else 2 * top - here - floor


@lean_kernel
def _assign(b: Building, mine: Controller) -> None:
    """Gives every call that is new to a car."""
    num_cars, num_floors = len(b.floor), len(b.waiting)
    for f in range(1, num_floors):
        if b.waiting[f] == 0:
            mine.owned[f] = -1
            continue
        if mine.owned[f] == b.first[f]:
            continue
        mine.owned[f] = -1
        fewest = 0
        for c in range(num_cars):
            floors = _floors_to_go(b, c, f)
            for g in range(1, num_floors):
                if mine.owned[g] >= 0 and mine.owner[g] == c:
                    floors += 1
            if c == 0 or floors < fewest:
                mine.owner[f], fewest = c, floors
        mine.owned[f] = b.first[f]


@lean_kernel
def _choose_target(b: Building, car: int, mine: Controller) -> int:
    """The highest call, or the one that has waited longest, that no other empty rising car goes to; −1 for none."""
    best = -1
    for f in range(b.floor[car], len(b.waiting)):
        taken = b.waiting[f] == 0
        for c in range(len(b.floor)):
            rising = b.aboard[c] == 0 and b.direction[c] > 0 and (b.phase[c] == MOVING or b.phase[c] == DECIDING)
            taken = taken or (c != car and rising and mine.target[c] == f)
        if taken:
            continue
        if best < 0 or mine.rule[0] == HUFF or b.arrival[b.first[f]] < b.arrival[b.first[best]]:
            best = f
    return best


@lean_kernel
def _stops(b: Building, car: int, mine: Controller) -> Any:
    rule, floor = mine.rule[0], b.floor[car]
    if rule == NETWORK:
        write_inputs(b, car, mine.x)
        smdp_network_values(mine.network, mine.x)
        return mine.network.q[1] > mine.network.q[0]
    if rule == RANDOM:
        return uniform(mine.stream) < 0.5
    if rule == SECTOR:
        return _sector(b, floor) == car
    if rule == SECTOR_TOP:
        return _sector(b, floor) == car and (b.direction[car] < 0 or not _own_call_above(b, car, mine))
    if rule == NEAREST:
        _assign(b, mine)
        return mine.owner[floor] == car and (b.direction[car] < 0 or not _own_call_above(b, car, mine))
    if rule == ALWAYS_STOP or b.direction[car] < 0:
        return True
    mine.target[car] = _choose_target(b, car, mine)
    return mine.target[car] == floor or mine.target[car] < 0


@lean_kernel
def play(building: Building, controller: Controller, until: float) -> None:
    """Plays on until everybody has arrived, or nothing more happens up to the second ``until``."""
    while True:
        car = advance(building, until)
        if car < 0:
            return
        decide(building, car, _stops(building, car, controller))
