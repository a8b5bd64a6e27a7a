"""What a car sees when it decides: 5F − 3 numbers, of how old calls are, where it is and where the others are."""

from __future__ import annotations

from neuralq.jit import lean_kernel
from neuralq.types import Array
from neuralq_envs.elevators.building import MOVING, SETTLED, Building

__all__ = ["num_inputs", "write_inputs"]

_HALF_WAIT = 30.0  # seconds after which a call counts half
_FOOTPRINT = (1.0, 0.8, 0.6, 0.4, 0.2)


def num_inputs(num_floors: int) -> int:
    """How many numbers describe what a car sees in a building with so many floors.

    Example:
        >>> num_inputs(10)  # as Crites and Barto have them
        47
    """
    return 5 * num_floors - 3


@lean_kernel
def write_inputs(building: Building, car: int, x: Array) -> None:
    """Writes what ``car``, which has to decide, sees.

    For each floor above the lobby, w / (w + 30 s) with w the wait of whoever has waited longest, and whether nobody
    waits; where the car is and which way it goes, one of 2 (F − 2); on each floor the footprints of the other cars, 1
    where one stands or is, fading by .2 a floor over the five floors that one is about to pass; whether nobody waits
    higher up; whether nobody has waited longer; and 1.

    Args:
        building: at the moment of the decision.
        car: which.
        x: ``[num_inputs(F)]``, written.

    Source: Crites & Barto 1996; how waits and footprints become numbers is ours.
    """
    b = building
    now, here, num_floors = b.clock[SETTLED], b.floor[car], len(b.waiting)
    for i in range(len(x)):
        x[i] = 0.0
    highest, longest, longest_wait = 0, 0, -1.0
    for f in range(1, num_floors):
        if b.waiting[f] == 0:
            x[num_floors - 2 + f] = 1.0
            continue
        wait = now - b.arrival[b.first[f]]
        x[f - 1] = wait / (wait + _HALF_WAIT)
        highest = f
        if wait > longest_wait:
            longest, longest_wait = f, wait
    at = 2 * (num_floors - 1)
    x[at + here - 1 + (num_floors - 2 if b.direction[car] > 0 else 0)] = 1.0
    at += 2 * (num_floors - 2)
    for c in range(len(b.floor)):
        if c == car:
            continue
        if b.phase[c] != MOVING:
            x[at + b.floor[c]] += 1.0
            continue
        f = b.floor[c]
        for strength in _FOOTPRINT:
            if f < 0 or f >= num_floors:
                break
            x[at + f] += strength
            f += b.direction[c]
    at += num_floors
    x[at] = 1.0 if here == highest else 0.0
    x[at + 1] = 1.0 if here == longest else 0.0
    x[at + 2] = 1.0
