"""A building with its cars and everybody who comes in an hour, as arrays that compiled code changes in place."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_positive, check_whole
from neuralq_envs.elevators.passengers import Passengers

__all__ = [
    "BETA",
    "BETA_PER_SECOND",
    "CAPACITY",
    "COST_SCALE",
    "COUNTED",
    "DECIDING",
    "LEFT",
    "MOVING",
    "NUM_WAITING",
    "OPENING",
    "PARKED",
    "SCALE",
    "SEEN",
    "SETTLED",
    "STANDING",
    "SUM_SQUARES",
    "SUM_WAITS",
    "Building",
    "check_building",
    "check_origins",
    "copied",
    "num_decisions",
    "open_building",
]

COST_SCALE = 1e-6
"""What a second of waiting costs whoever has waited for one; so small that values are of size 1."""
BETA_PER_SECOND = 0.01

PARKED, DECIDING, MOVING, OPENING, STANDING = range(5)
"""What a car does; from `OPENING` on it stands at its floor, opening, loading, and then closing its door."""

SETTLED, NUM_WAITING, SUM_WAITS, SUM_SQUARES, BETA, SCALE = range(6)
SEEN, LEFT, COUNTED, CAPACITY = range(4)


class Building(NamedTuple):
    """Everything that a moment of the simulation consists of: P passengers, F floors, C cars.

    Args:
        arrival: when each passenger comes, in seconds, ascending, ``[P]``.
        origin: the floor on which, ``[P]``; everybody wants to the lobby, floor 0.
        boarding: seconds that boarding takes, ``[P]``.
        leaving: seconds that leaving takes, ``[P]``.
        boarded: when boarding began, NaN before, ``[P]``.
        left: when the passenger had left the car, NaN before, ``[P]``.
        behind: who stands behind each passenger, on the floor or in the car, ``[P]``.
        waiting: how many wait on each floor, ``[F]``.
        first: who has waited longest, ``[F]``; of no meaning where nobody waits, as `last` is.
        last: who came last, ``[F]``.
        floor: the floor at which a car is, or that it passed last, ``[C]``.
        direction: 1 up, −1 down, ``[C]``.
        phase: what it does, ``[C]``.
        event: when the next thing happens to it, ``[C]``.
        aboard: how many it carries, ``[C]``.
        front: who boarded first, ``[C]``.
        rear: who boarded last, ``[C]``.
        cost: accounts of what waiting has cost, discounted to when each was opened, ``[C + 2]``: since the latest
            decision of each car, since the latest of any car, and since the beginning.
        discount: of each account up to now, ``[C + 2]``.
        clock: seconds up to which is settled, the number who wait, the sum of their waits and of its squares; β, scale.
        counts: passengers that have come, that have left, decisions, capacity of a car.
    """

    arrival: NDArray[np.float64]
    origin: NDArray[np.int64]
    boarding: NDArray[np.float64]
    leaving: NDArray[np.float64]
    boarded: NDArray[np.float64]
    left: NDArray[np.float64]
    behind: NDArray[np.int64]
    waiting: NDArray[np.int64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    floor: NDArray[np.int64]
    direction: NDArray[np.int64]
    phase: NDArray[np.int64]
    event: NDArray[np.float64]
    aboard: NDArray[np.int64]
    front: NDArray[np.int64]
    rear: NDArray[np.int64]
    cost: NDArray[np.float64]
    discount: NDArray[np.float64]
    clock: NDArray[np.float64]
    counts: NDArray[np.int64]


def open_building(
    passengers: Passengers,
    num_cars: int = 4,
    num_floors: int = 10,
    capacity: int = 20,
    beta: float = BETA_PER_SECOND,
    scale: float = COST_SCALE,
) -> Building:
    """A building at the beginning of an hour: every car is parked at the lobby.

    Args:
        passengers: who comes.
        num_cars: C.
        num_floors: F, the lobby among them.
        capacity: of a car.
        beta: β, the rate at which costs are discounted, per second.
        scale: of the cost.

    Raises:
        ValueError: no car, fewer than 3 floors, no room in a car, or somebody who waits where there is no floor.

    Example:
        >>> from neuralq_envs.elevators.passengers import MINI
        >>> open_building(MINI, num_cars=2, num_floors=6).floor.tolist()
        [0, 0]
    """
    check_building(num_cars, num_floors, capacity, beta)
    check_positive("scale", scale)
    check_origins(passengers, num_floors)
    num = len(passengers.arrival)
    building = Building(
        passengers.arrival, passengers.origin, passengers.boarding, passengers.leaving,
        boarded=np.full(num, np.nan), left=np.full(num, np.nan), behind=np.zeros(num, np.int64),
        waiting=np.zeros(num_floors, np.int64), first=np.zeros(num_floors, np.int64),
        last=np.zeros(num_floors, np.int64), floor=np.zeros(num_cars, np.int64), direction=np.ones(num_cars, np.int64),
        phase=np.full(num_cars, PARKED, np.int64), event=np.full(num_cars, np.inf), aboard=np.zeros(num_cars, np.int64),
        front=np.zeros(num_cars, np.int64), rear=np.zeros(num_cars, np.int64),
        cost=np.zeros(num_cars + 2), discount=np.ones(num_cars + 2), clock=np.zeros(6), counts=np.zeros(4, np.int64),
    )  # fmt: skip
    building.clock[BETA], building.clock[SCALE] = beta, scale
    building.counts[CAPACITY] = capacity
    return building


def copied(building: Building) -> Building:
    """The same moment once more; what happens to one does not touch the other.

    Example:
        >>> from neuralq_envs.elevators.passengers import MINI
        >>> building = open_building(MINI)
        >>> copied(building).floor is building.floor
        False
    """
    return building._replace(**{name: getattr(building, name).copy() for name in Building._fields})


def check_building(num_cars: int, num_floors: int, capacity: int, beta: float) -> None:
    """Raises ValueError where that is no building in which there is anything to decide."""
    check_whole("num_cars", num_cars)
    check_whole("num_floors", num_floors, minimum=3)
    check_whole("capacity", capacity)
    check_positive("beta", beta)


def check_origins(passengers: Passengers, num_floors: int) -> None:
    """Raises ValueError where somebody waits at the lobby, or where there is no floor."""
    floors = passengers.origin
    if len(floors) and not 1 <= floors.min() <= floors.max() < num_floors:
        raise ValueError(
            f"passengers must wait on floors 1 to {num_floors - 1}, got floors {floors.min()} to {floors.max()}"
        )


def num_decisions(building: Building) -> int:
    """How many there have been."""
    return int(building.counts[COUNTED])
