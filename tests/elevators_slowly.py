"""The elevators once more, as objects and closures in plain Python, with the cost from every passenger's own wait."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

FLOOR, STOP, TURN = 1.45, 7.19, 1.0


@dataclass
class Person:
    second: float
    floor: int
    boarding: float = 1.0
    leaving: float = 1.0
    boarded: float = math.nan
    left: float = math.nan


@dataclass
class Car:
    number: int
    floor: int = 0
    direction: int = 1
    doing: str = "parked"
    at: float = math.inf
    aboard: list[Person] = field(default_factory=list)

    @property
    def stands(self) -> bool:
        return self.doing in ("opens", "loads", "closes")


class Decision(NamedTuple):
    """What whoever decides may look at."""

    second: float
    car: Car
    building: Any


class SlowBuilding:
    def __init__(self, people: Sequence[Person], num_cars: int, num_floors: int, capacity: int) -> None:
        self.coming, self.people = list(people), list(people)
        self.cars = [Car(i) for i in range(num_cars)]
        self.queues: list[list[Person]] = [[] for _ in range(num_floors)]
        self.capacity = capacity
        self.now = 0.0

    def run(self, stops: Callable[[Decision], bool]) -> None:
        while any(math.isnan(person.left) for person in self.people):
            car = min(self.cars, key=lambda c: (c.at, c.number))
            if self.coming and self.coming[0].second <= car.at:
                self._appears(self.coming.pop(0))
                continue
            self.now = car.at
            if car.doing == "moves":
                car.floor += car.direction
                self._arrives(car, stops)
            elif car.doing in ("opens", "loads"):
                self._loads(car)
            elif car.aboard:
                self._moves(car, -1)
                if self.queues[car.floor]:
                    self._wakes(car.floor)
            else:
                self._chooses(car)

    def _appears(self, person: Person) -> None:
        self.now = person.second
        self.queues[person.floor].append(person)
        if len(self.queues[person.floor]) == 1:
            self._wakes(person.floor)

    def _wakes(self, floor: int) -> None:
        stood = {car.floor for car in self.cars if car.stands}
        parked = [c for c in self.cars if c.doing == "parked" and not (c.floor == floor and floor in stood)]
        if parked:
            car = min(parked, key=lambda c: (abs(c.floor - floor), c.number))
            if car.floor == floor:
                self._stops(car)
            else:
                self._moves(car, 1 if floor > car.floor else -1)

    def _arrives(self, car: Car, stops: Callable[[Decision], bool]) -> None:
        if car.aboard and car.floor == 0:
            self._stops(car)
            return
        alone = not any(other.stands and other.floor == car.floor for other in self.cars if other is not car)
        could = bool(self.queues[car.floor]) and alone and len(car.aboard) < self.capacity
        further = bool(car.aboard) or self._calls(car, car.direction)
        if could and (not further or stops(Decision(self.now, car, self))):
            self._stops(car)
        elif further:
            self._moves(car, car.direction)
        else:
            self._chooses(car)

    def _calls(self, car: Car, direction: int) -> bool:
        beyond = self.queues[car.floor + 1 :] if direction > 0 else self.queues[: car.floor]
        return any(beyond)

    def _chooses(self, car: Car) -> None:
        if self._calls(car, 1):
            self._moves(car, 1)
        elif self._calls(car, -1):
            self._moves(car, -1)
        elif self.queues[car.floor] and not any(c.stands and c.floor == car.floor for c in self.cars if c is not car):
            self._stops(car)
        else:
            car.doing, car.at = "parked", math.inf

    def _moves(self, car: Car, direction: int) -> None:
        car.at = self.now + FLOOR + (TURN if direction != car.direction else 0.0)
        car.direction, car.doing = direction, "moves"

    def _stops(self, car: Car) -> None:
        car.at, car.doing = self.now + STOP / 2, "opens"
        if car.floor > 0 and car.direction > 0:
            car.at += TURN
            car.direction = -1

    def _loads(self, car: Car) -> None:
        if car.floor == 0:
            after = self.now
            for person in car.aboard:
                after += person.leaving
                person.left = after
            car.aboard = []
            car.doing, car.at = "closes", after + STOP / 2
        elif self.queues[car.floor] and len(car.aboard) < self.capacity:
            person = self.queues[car.floor].pop(0)
            person.boarded = self.now
            car.aboard.append(person)
            car.doing, car.at = "loads", self.now + person.boarding
        else:
            car.doing, car.at = "closes", self.now + STOP / 2

    def cost(self, beta: float = 0.01, scale: float = 1e-6) -> float:
        """From the beginning: the integral of e^(−βt) (t − second)² for everybody, in closed form."""
        total = 0.0
        for person in self.people:
            x = beta * (person.boarded - person.second)
            total += math.exp(-beta * person.second) * (2 - math.exp(-x) * (2 + 2 * x + x * x)) / beta**3
        return scale * total


MINI = ((0, 5), (0, 5), (0, 4), (0, 2), (0, 2), (0, 1), (10, 3), (20, 5))


def mini() -> SlowBuilding:
    return SlowBuilding([Person(second, floor) for second, floor in MINI], 2, 6, 20)


def all_sequences() -> list[tuple[float, tuple[bool, ...]]]:
    """Cost and decisions of every sequence of the mini building."""
    found, todo = [], [()]
    while todo:
        given = todo.pop()
        asked = []

        def stops(_: Decision, given: tuple[bool, ...] = given, asked: list[int] = asked) -> bool:
            asked.append(1)
            return given[len(asked) - 1] if len(asked) <= len(given) else False

        building = mini()
        building.run(stops)
        found.append((building.cost(), given + (False,) * (len(asked) - len(given))))
        todo += [given + (False,) * (i - len(given)) + (True,) for i in range(len(given), len(asked))]
    return found


def seen(decision: Decision) -> list[float]:
    """The numbers that a car sees, one after the other."""
    now, car, building = decision
    num_floors = len(building.queues)
    waits = {f: now - queue[0].second for f, queue in enumerate(building.queues) if queue}
    numbers = [waits[f] / (waits[f] + 30) if f in waits else 0.0 for f in range(1, num_floors)]
    numbers += [float(f not in waits) for f in range(1, num_floors)]
    numbers += [float(car.floor == f and car.direction == d) for d in (-1, 1) for f in range(1, num_floors - 1)]
    footprints = [0.0] * num_floors
    for other in building.cars:
        if other is not car:
            steps = range(5) if other.doing == "moves" else range(1)
            for k in steps:
                f = other.floor + k * other.direction
                if 0 <= f < num_floors:
                    footprints[f] += 1 - 0.2 * k
    numbers += footprints
    longest = max(waits, key=lambda f: (waits[f], -f))
    return [*numbers, float(car.floor == max(waits)), float(car.floor == longest), 1.0]
