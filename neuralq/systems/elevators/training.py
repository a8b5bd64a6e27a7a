"""Training on hours that are drawn beforehand, and what it is worth on hours that were not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_fraction, check_positive, check_whole
from neuralq.jit import specialised
from neuralq.learners import SmdpNetwork, new_smdp_network
from neuralq.systems.elevators.controllers import NETWORK, Controller, new_controller, play
from neuralq.systems.elevators.kernels import learn_hour, new_memory
from neuralq.tabular.kernels.random_numbers import new_stream
from neuralq_envs.elevators.building import BETA_PER_SECOND, COST_SCALE, Building, num_decisions, open_building
from neuralq_envs.elevators.inputs import num_inputs
from neuralq_envs.elevators.passengers import Passengers, draw_hour

__all__ = ["Settings", "Training", "Waits", "held_out_hours", "measure", "train"]

_NUM_HIDDEN = 20
_NUM_MEASURED = 8
"""Times that a training is measured on its way."""
_LONG = 60.0  # seconds of waiting that nobody forgives


@dataclass(frozen=True)
class Settings:
    """How a training learns.

    Args:
        num_hours: simulated hours to learn from.
        num_drawn: different ones among them.
        beta: β, per second.
        cost_scale: of the cost of waiting.
        step_size: α in the first hour and in the last one, geometric in between.
        temperature: T of the softmax, likewise.
        max_error: to which errors are cut.
        averaged: share of the hours, the last ones, whose weights are averaged.

    Raises:
        ValueError: a number out of its range.
    """

    num_hours: int = 10_000
    num_drawn: int = 400
    beta: float = BETA_PER_SECOND
    cost_scale: float = COST_SCALE
    step_size: tuple[float, float] = (0.02, 0.001)
    temperature: tuple[float, float] = (0.3, 0.003)
    max_error: float = 0.1
    averaged: float = 0.3

    def __post_init__(self) -> None:
        check_whole("num_hours", self.num_hours)
        check_whole("num_drawn", self.num_drawn)
        check_fraction("averaged", self.averaged)
        for name in ("beta", "cost_scale", "max_error"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)!r}")
        for name in ("step_size", "temperature"):
            for value in getattr(self, name):
                check_positive(name, value)


@dataclass(frozen=True, eq=False)
class Waits:
    """How long everybody waited in some hours.

    Args:
        seconds: of every passenger, ``[P]``.
        hour: whose hour it was, ``[P]``.
        system_seconds: until they had left the car, ``[P]``.
    """

    seconds: NDArray[np.float64]
    hour: NDArray[np.int64]
    system_seconds: NDArray[np.float64]

    @property
    def average(self) -> float:
        """Mean wait, seconds."""
        return float(self.seconds.mean())

    @property
    def squared(self) -> float:
        """Mean squared wait, seconds²."""
        return float(np.square(self.seconds).mean())

    @property
    def long_percent(self) -> float:
        """Share of waits above a minute, per cent."""
        return float(100 * (self.seconds > _LONG).mean())

    @property
    def squared_by_hour(self) -> NDArray[np.float64]:
        """Mean squared wait of each hour."""
        return np.bincount(self.hour, np.square(self.seconds)) / np.bincount(self.hour)


@dataclass(frozen=True, eq=False)
class Training:
    """What came of one training.

    Args:
        network: with averaged weights.
        hours: after how many hours it was measured, ``[M]``.
        squared: mean squared wait at each of these, with the weights of that moment, ``[M]``.
        td_error: mean |TD error| of the last tenth of the hours, per hour.
    """

    network: SmdpNetwork
    hours: NDArray[np.int64]
    squared: NDArray[np.float64]
    td_error: float


def held_out_hours(seed: np.random.SeedSequence, num_hours: int = 50) -> list[Passengers]:
    """Hours on which all contenders of a seed are measured, and none learns.

    Example:
        >>> len(held_out_hours(np.random.SeedSequence(0), 3))
        3
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 1)))
    return [draw_hour(rng) for _ in range(num_hours)]


def measure(controller: Controller, hours: Sequence[Passengers]) -> Waits:
    """Plays hours in the building of four cars and ten floors.

    Example:
        >>> from neuralq.systems.elevators.controllers import LQF
        >>> measure(new_controller(LQF), held_out_hours(np.random.SeedSequence(0), 1)).average < 25
        True
    """
    played = []
    for passengers in hours:
        building = open_building(passengers)
        play(building, controller, np.inf)
        played.append(building)
    return Waits(
        np.concatenate([b.boarded - b.arrival for b in played]),
        np.repeat(np.arange(len(played)), [len(b.arrival) for b in played]),
        np.concatenate([b.left - b.arrival for b in played]),
    )


def train(
    seed: np.random.SeedSequence,
    settings: Settings = Settings(),
    watched: Sequence[Passengers] = (),
    buildings: Sequence[Building] | None = None,
) -> Training:
    """Learns from nothing.

    Args:
        seed: of the weights, the hours and the decisions.
        settings: how.
        watched: hours on which it is measured on the way; it does not learn from them.
        buildings: with the hours to learn from; None for hours that are drawn, in the building of four cars and ten
            floors.

    Example:
        >>> train(np.random.SeedSequence(0), Settings(num_hours=2)).network.flat.shape
        (1002,)
    """
    rng = np.random.default_rng(seed)
    if buildings is None:
        num = min(settings.num_drawn, settings.num_hours)
        buildings = [open_building(draw_hour(rng), beta=settings.beta, scale=settings.cost_scale) for _ in range(num)]
    num_cars, num_floors = len(buildings[0].floor), len(buildings[0].waiting)
    network = new_smdp_network(num_inputs(num_floors), _NUM_HIDDEN, 2, rng)
    controller = new_controller(NETWORK, num_cars, num_floors, seed, network)
    memory, stream = new_memory(num_cars, num_floors), new_stream(seed)
    learn = specialised(learn_hour, buildings[0], network, memory, 0.0, 0.0, 0.0, stream)
    step_sizes = _annealed(settings.step_size, settings.num_hours)
    temperatures = _annealed(settings.temperature, settings.num_hours)
    measured_at = np.unique(np.ceil(np.linspace(0, settings.num_hours, _NUM_MEASURED + 1)[1:]).astype(int))
    averaged_from = min(int(settings.num_hours * (1 - settings.averaged)), settings.num_hours - 1)
    mean, curve, errors = np.zeros_like(network.flat), [], np.zeros(settings.num_hours)
    for hour in range(settings.num_hours):
        building = buildings[int(rng.integers(len(buildings)))]
        total = learn(building, network, memory, step_sizes[hour], settings.max_error, temperatures[hour], stream)
        errors[hour] = total / max(num_decisions(building), 1)
        if hour >= averaged_from:
            mean += network.flat / (settings.num_hours - averaged_from)
        if len(watched) and hour + 1 in measured_at:
            curve.append(measure(controller, watched).squared)
    network.flat[:] = mean
    td_error = float(errors[-max(settings.num_hours // 10, 1) :].mean())
    return Training(network, measured_at[: len(curve)], np.array(curve), td_error)


def _annealed(ends: tuple[float, float], num_hours: int) -> NDArray[np.float64]:
    """From the first to the last, geometrically."""
    first, last = ends
    return np.asarray(np.geomspace(first, last, num_hours))
