"""Who comes to the elevators in an hour: when, on which floor, and how long boarding and leaving take."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuralq.checks import check_positive

__all__ = ["DOWN_PEAK", "MINI", "Passengers", "check_rates", "draw_hour", "given_passengers"]

DOWN_PEAK = (1.0, 2.0, 4.0, 4.0, 18.0, 12.0, 8.0, 7.0, 18.0, 5.0, 3.0, 2.0)
"""Passengers a floor that are expected in each five minutes of the hour when everybody goes home."""

_SECONDS = 300.0
_SHAPE = 20  # of Erlang's distribution of the time that a passenger takes, whose mean is 1 s
_SHORTEST, _LONGEST = 0.6, 6.0


class Passengers(NamedTuple):
    """Everybody who comes, in the order in which they do, all ``[P]``.

    Args:
        arrival: seconds from the beginning.
        origin: floor.
        boarding: seconds.
        leaving: seconds.
    """

    arrival: NDArray[np.float64]
    origin: NDArray[np.int64]
    boarding: NDArray[np.float64]
    leaving: NDArray[np.float64]


def draw_hour(
    rng: np.random.Generator, num_floors: int = 10, passengers_per_five_minutes: Sequence[float] = DOWN_PEAK
) -> Passengers:
    """Poisson arrivals on every floor above the lobby; boarding and leaving take a second, as Erlang-20 has it.

    Args:
        rng: what draws.
        num_floors: F, the lobby among them.
        passengers_per_five_minutes: how many are expected on each floor in each five minutes, one after the other.

    Raises:
        ValueError: a rate that is negative or not finite, or none above 0.

    Example:
        >>> hour = draw_hour(np.random.default_rng(0))
        >>> 600 < len(hour.arrival) < 900, bool((np.diff(hour.arrival) >= 0).all())
        (True, True)
    """
    rates = check_rates(passengers_per_five_minutes)
    counts = rng.poisson(np.repeat(rates[:, None], num_floors - 1, axis=1))  # [five minutes, floor]
    begin, floor = (np.repeat(index.ravel(), counts.ravel()) for index in np.indices(counts.shape))
    arrival = _SECONDS * (begin + rng.random(counts.sum()))
    order = np.argsort(arrival, kind="stable")
    boarding, leaving = np.clip(rng.gamma(_SHAPE, 1 / _SHAPE, (2, len(arrival))), _SHORTEST, _LONGEST)
    return Passengers(arrival[order], floor[order] + 1, boarding, leaving)


def check_rates(passengers_per_five_minutes: Sequence[float]) -> NDArray[np.float64]:
    """The rates as an array.

    Raises:
        ValueError: a rate that is negative or not finite, or none above 0.
    """
    rates = np.asarray(passengers_per_five_minutes, dtype=np.float64)
    if rates.ndim != 1 or not np.isfinite(rates).all() or not (rates >= 0).all() or not rates.any():
        raise ValueError(
            "passengers_per_five_minutes must be finite numbers of at least 0, one for each five minutes and not all "
            f"of them 0, got {passengers_per_five_minutes!r}"
        )
    return rates


def given_passengers(arrivals: ArrayLike, seconds: float = 1.0) -> Passengers:
    """Passengers who come as they are told to, each of whom takes the same time.

    Args:
        arrivals: (second, floor) of each, ``[P, 2]``, in the order of their seconds.
        seconds: that boarding takes, and leaving.

    Raises:
        ValueError: no pairs, seconds that are negative, not finite or not in order, or floors that are not whole.

    Example:
        >>> given_passengers([(0, 5), (2.5, 1)]).origin.tolist()
        [5, 1]
    """
    pairs = np.asarray(arrivals, dtype=np.float64)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not len(pairs) or not np.isfinite(pairs).all():
        raise ValueError(f"passengers must be pairs (second, floor) of finite numbers, got {arrivals!r}")
    arrival, floor = pairs.T
    if (arrival < 0).any() or (np.diff(arrival) < 0).any() or (floor != np.rint(floor)).any():
        raise ValueError(
            "passengers must be pairs (second, floor), with seconds of at least 0 in ascending order and whole floors, "
            f"got {arrivals!r}"
        )
    check_positive("seconds", seconds)
    takes = np.full(len(pairs), float(seconds))
    return Passengers(arrival.copy(), floor.astype(np.int64), takes, takes.copy())


MINI = given_passengers([(0, 5), (0, 5), (0, 4), (0, 2), (0, 2), (0, 1), (10, 3), (20, 5)])
"""Eight passengers of a building with 2 cars and 6 floors, so few that every sequence of decisions can be tried."""
