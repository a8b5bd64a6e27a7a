"""Elevators at the hour when everybody goes home, one decision of one car a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_choice
from neuralq_envs.elevators.building import (
    BETA_PER_SECOND,
    SETTLED,
    Building,
    check_building,
    check_origins,
    open_building,
)
from neuralq_envs.elevators.inputs import num_inputs, write_inputs
from neuralq_envs.elevators.kernels import advance, decide, open_account
from neuralq_envs.elevators.passengers import DOWN_PEAK, Passengers, check_rates, draw_hour, given_passengers
from neuralq_envs.elevators.views import picture, text

__all__ = ["ElevatorsEnv", "make"]

_MOST_HOURS = 1000  # drawn in search of one in which anything is decided


class ElevatorsEnv(gymnasium.Env[Any, Any]):
    """Cars that decide, whenever they come to people whom they could take, whether to stop (1) or to go on (0).

    **How the decisions of several cars become steps.** A step begins when a car has to decide, and ends when any car
    has to, which is mostly another one; two that decide at the same moment do so one after the other. The observation
    is what the car sees that decides next (`neuralq_envs.elevators.inputs`), so that one value function serves all of
    them, and ``info["car"]`` tells which it is. An episode is an hour of arrivals and lasts until everybody has
    arrived.

    **What the discount between steps is.** Steps last between nothing and minutes (``info["duration"]``, seconds).
    The reward is −∫ e^(−βt) 10⁻⁶ Σ w² dt over the step, w the waits of all who wait, and what follows would have to
    be discounted by ``info["discount"]`` = e^(−βτ), a different number each time. An ordinary learner has one γ
    instead: 0.94 is e^(−βτ) of the mean duration, 6.5 s, where β is .01. `neuralq chapter
    elevators` learns with the true ones (`neuralq.rules.smdp_discount`), and there a step of a car lasts until the same
    car decides again.

    Args:
        render_mode: None, ``"ansi"`` or ``"rgb_array"``.
        num_cars: C.
        num_floors: F, the lobby among them, at least 3: with two floors nothing would be left to decide.
        capacity: of a car.
        passengers_per_five_minutes: expected on each floor above the lobby in each five minutes.
        passengers: (second, floor) of each, ``[P, 2]``, every hour the same and each a second at the door; None for
            the rates above.
        beta: β, per second.

    Raises:
        ValueError: no car, fewer than 3 floors, no room in a car, negative rates, or passengers who make no sense.

    Source: Crites & Barto 1996.

    Example:
        >>> env = ElevatorsEnv(num_cars=2, num_floors=6, passengers=[(0, 5), (0, 2)])
        >>> env.observation_space.shape, env.action_space
        ((27,), Discrete(2))
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 2}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        num_cars: int = 4,
        num_floors: int = 10,
        capacity: int = 20,
        passengers_per_five_minutes: Sequence[float] = DOWN_PEAK,
        passengers: ArrayLike | None = None,
        beta: float = BETA_PER_SECOND,
    ) -> None:
        check_choice("render_mode", render_mode, [None, *self.metadata["render_modes"]])
        check_building(num_cars, num_floors, capacity, beta)
        check_rates(passengers_per_five_minutes)
        self.render_mode = render_mode
        self._size = (num_cars, num_floors, capacity, beta)
        self._rates = tuple(passengers_per_five_minutes)
        self._given = None if passengers is None else given_passengers(passengers)
        if self._given is not None:
            check_origins(self._given, num_floors)
        self.observation_space = Box(0.0, max(1.0, num_cars - 1.0), (num_inputs(num_floors),), np.float32)
        self.action_space = Discrete(2)
        self._building: Building | None = None
        self._car = -1
        self._decided = 0.0

    @property
    def building(self) -> Building:
        """The building as it stands; compiled code may read it.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self._building is None:
            raise ResetNeeded("nobody has come yet: call reset() first")
        return self._building

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Draws an hour, and goes on to its first decision; ``options["passengers"]`` gives (second, floor) instead.

        Raises:
            ValueError: passengers who make no sense, or among whom there is nothing to decide.
        """
        super().reset(seed=seed)
        given = self._given
        if options is not None and "passengers" in options:
            given = given_passengers(options["passengers"])
        for _ in range(1 if given is not None else _MOST_HOURS):
            self._building, self._decided = open_building(self._draw() if given is None else given, *self._size), 0.0
            self._car = advance(self._building, np.inf)
            if self._car >= 0:
                return self._seen()
        raise ValueError(
            "there is nothing to decide: every car has to stop wherever it comes to; let more passengers come "
            "(passengers, passengers_per_five_minutes)"
        )

    def step(self, action: int) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """The car stops (1) or goes on (0), and time passes until the next decision of any car.

        Raises:
            ResetNeeded: before the first reset, or after everybody has arrived.
            ValueError: another action.
        """
        if self._building is None or self._car < 0:
            raise ResetNeeded("everybody has arrived, or nobody has come yet: call reset() before step()")
        if not self.action_space.contains(action):
            raise ValueError(f"action must be 0 (go on) or 1 (stop), got {action!r}")
        building = self._building
        decide(building, self._car, bool(action == 1))
        self._car = advance(building, np.inf)
        reward = -float(building.cost[-2])
        x, said = self._seen()
        return x, reward, self._car < 0, False, said

    def render(self) -> Any:
        """Text for ``ansi``, uint8 ``[H, W, 3]`` for ``rgb_array``, None without a render mode or before a reset."""
        if self._building is None or self.render_mode is None:
            return None
        return text(self._building, self._car) if self.render_mode == "ansi" else picture(self._building, self._car)

    def _draw(self) -> Passengers:
        return draw_hour(self.np_random, self._size[1], self._rates)

    def _seen(self) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """What the deciding car sees and what is told beside it; a new step begins."""
        building = self.building
        x = np.zeros(num_inputs(self._size[1]))
        second = float(building.clock[SETTLED])
        said: dict[str, Any] = {
            "car": self._car,
            "second": second,
            "duration": second - self._decided,
            "discount": float(building.discount[-2]),  # to the latest decision: the account was opened there
        }
        if self._car >= 0:
            write_inputs(building, self._car, x)
        else:
            waits = building.boarded - building.arrival
            said |= {"average_wait": float(waits.mean()), "average_squared_wait": float(np.square(waits).mean())}
        self._decided = second
        open_account(building, -2)
        return x.astype(np.float32), said


def make(render_mode: str | None = None, **given: Any) -> ElevatorsEnv:
    """What ``gymnasium.make("neuralq/Elevators-v0")`` calls.

    Example:
        >>> make(num_floors=6).observation_space.shape
        (27,)
    """
    return ElevatorsEnv(render_mode, **given)
