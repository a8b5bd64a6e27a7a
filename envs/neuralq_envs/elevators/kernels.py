"""What happens in the building, event by event, until a car has something to decide.

A car takes 1.45 s from floor to floor and 7.19 s to stop, half of it before people move and half after; a turn costs
1 s. It stops at the lobby when it carries anybody, never turns while it does, and stops where people wait only if no
other car stands there; a full car passes. An empty car looks up first, then down, then on its own floor, else it parks;
a new call wakes the nearest parked one. An empty car on its way up may stop for people who want down, and turns there.

A car decides, to stop or to go on, where people wait whom it could take, and only if something lies further on:
everything else is forced. The wait of a passenger ends when boarding begins.

What waiting costs is a rate, scale · Σ w² over all who wait. A stretch of τ seconds in which nothing changes, with N
waiting, W₁ = Σ w and W₂ = Σ w² at its beginning, costs ∫ e^(−βt) Σ (w + t)² dt = N I₂ + 2 W₁ I₁ + W₂ I₀, where
I_n = ∫ tⁿ e^(−βt) dt from 0 to τ.

Source: Crites & Barto 1996 (Crites 1996 for the constants).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from neuralq.jit import lean_kernel
from neuralq_envs.elevators.building import (
    BETA,
    CAPACITY,
    COUNTED,
    DECIDING,
    LEFT,
    MOVING,
    NUM_WAITING,
    OPENING,
    PARKED,
    SCALE,
    SEEN,
    SETTLED,
    STANDING,
    SUM_SQUARES,
    SUM_WAITS,
    Building,
)

__all__ = ["ENDED", "PAUSED", "advance", "decide", "discounted_powers", "open_account", "rewind"]

ENDED, PAUSED = -1, -2

FLOOR_SECONDS, STOP_SECONDS, TURN_SECONDS = 1.45, 7.19, 1.0


@lean_kernel
def discounted_powers(seconds: float, beta: float) -> Any:
    """∫ e^(−βt), ∫ t e^(−βt) and ∫ t² e^(−βt) from 0 to ``seconds``, and e^(−β·seconds).

    Below β·seconds = 1 the last integral is a series of positive terms and the others follow from it by parts, because
    the closed forms are differences of nearly equal numbers there.

    Example:
        >>> [round(float(value), 9) for value in discounted_powers(2.0, 0.5)]
        [1.264241118, 1.056964471, 1.284822353, 0.367879441]
    """
    x = beta * seconds
    e = math.exp(-x)
    if x >= 1.0:
        i0 = (1.0 - e) / beta
        i1 = (1.0 - e * (1.0 + x)) / (beta * beta)
        return i0, i1, (2.0 - e * (2.0 + 2.0 * x + x * x)) / (beta * beta * beta), e
    term, total, k = 1.0 / 3.0, 0.0, 3
    while term > 1e-17:
        total += term
        k += 1
        term *= x / k
    i2 = seconds * seconds * seconds * e * total
    i1 = 0.5 * (beta * i2 + seconds * seconds * e)
    return beta * i1 + seconds * e, i1, i2, e


@lean_kernel
def _settle(building: Building, now: float) -> None:
    """Charges the waiting since the last change to every account that is open."""
    b = building
    seconds = now - b.clock[SETTLED]
    if seconds <= 0.0:
        return
    i0, i1, i2, e = discounted_powers(seconds, b.clock[BETA])
    n, w1, w2 = b.clock[NUM_WAITING], b.clock[SUM_WAITS], b.clock[SUM_SQUARES]
    cost = b.clock[SCALE] * (n * i2 + 2.0 * w1 * i1 + w2 * i0)
    for i in range(len(b.cost)):
        b.cost[i] += b.discount[i] * cost
        b.discount[i] *= e
    b.clock[SUM_SQUARES] = w2 + 2.0 * seconds * w1 + seconds * seconds * n
    b.clock[SUM_WAITS] = w1 + seconds * n
    b.clock[SETTLED] = now


@lean_kernel
def _calls_beyond(building: Building, floor: int, direction: int) -> bool:
    if direction > 0:
        for f in range(floor + 1, len(building.waiting)):
            if building.waiting[f] > 0:
                return True
    else:
        for f in range(floor):
            if building.waiting[f] > 0:
                return True
    return False


@lean_kernel
def _another_stands(building: Building, floor: int, car: int) -> bool:
    for c in range(len(building.floor)):
        if c != car and building.floor[c] == floor and building.phase[c] >= OPENING:
            return True
    return False


@lean_kernel
def _stop(building: Building, car: int, now: float) -> None:
    b = building
    b.phase[car] = OPENING
    b.event[car] = now + 0.5 * STOP_SECONDS
    if b.floor[car] > 0 and b.direction[car] > 0:
        b.direction[car] = -1
        b.event[car] += TURN_SECONDS


@lean_kernel
def _go(building: Building, car: int, direction: int, now: float) -> None:
    b = building
    b.phase[car] = MOVING
    b.event[car] = now + FLOOR_SECONDS
    if b.direction[car] != direction:
        b.direction[car] = direction
        b.event[car] += TURN_SECONDS


@lean_kernel
def _choose(building: Building, car: int, now: float) -> None:
    """Where an empty car goes."""
    b = building
    floor = b.floor[car]
    if _calls_beyond(b, floor, 1):
        _go(b, car, 1, now)
    elif _calls_beyond(b, floor, -1):
        _go(b, car, -1, now)
    elif b.waiting[floor] > 0 and not _another_stands(b, floor, car):
        _stop(b, car, now)
    else:
        b.phase[car] = PARKED
        b.event[car] = np.inf


@lean_kernel
def _call(building: Building, floor: int, now: float) -> None:
    """Wakes the nearest parked car that could stop there, if there is one; of equally near ones the first."""
    b = building
    nearest = -1
    for c in range(len(b.floor)):
        if b.phase[c] != PARKED or (b.floor[c] == floor and _another_stands(b, floor, c)):
            continue
        if nearest < 0 or abs(b.floor[c] - floor) < abs(b.floor[nearest] - floor):
            nearest = c
    if nearest < 0:
        return
    if b.floor[nearest] == floor:
        _stop(b, nearest, now)
    else:
        _go(b, nearest, 1 if floor > b.floor[nearest] else -1, now)


@lean_kernel
def _appear(building: Building, passenger: int, now: float) -> None:
    b = building
    _settle(b, now)
    b.clock[NUM_WAITING] += 1.0
    floor = b.origin[passenger]
    if b.waiting[floor] == 0:
        b.first[floor] = passenger
    else:
        b.behind[b.last[floor]] = passenger
    b.last[floor] = passenger
    b.waiting[floor] += 1
    if b.waiting[floor] == 1:
        _call(b, floor, now)


@lean_kernel
def _load(building: Building, car: int, now: float) -> None:
    """The next passenger boards, or the door closes; at the lobby everybody leaves, one after the other."""
    b = building
    floor = b.floor[car]
    if floor == 0:
        passenger = b.front[car]
        for _ in range(b.aboard[car]):
            now += b.leaving[passenger]
            b.left[passenger] = now
            passenger = b.behind[passenger]
        b.counts[LEFT] += b.aboard[car]
        b.aboard[car] = 0
    elif b.waiting[floor] > 0 and b.aboard[car] < b.counts[CAPACITY]:
        _settle(b, now)
        passenger = b.first[floor]
        b.first[floor] = b.behind[passenger]
        b.waiting[floor] -= 1
        b.boarded[passenger] = now
        wait = now - b.arrival[passenger]
        b.clock[NUM_WAITING] -= 1.0
        b.clock[SUM_WAITS] -= wait
        b.clock[SUM_SQUARES] -= wait * wait
        if b.clock[NUM_WAITING] == 0.0:  # what rounding has left over must not add up
            b.clock[SUM_WAITS] = 0.0
            b.clock[SUM_SQUARES] = 0.0
        if b.aboard[car] == 0:
            b.front[car] = passenger
        else:
            b.behind[b.rear[car]] = passenger
        b.rear[car] = passenger
        b.aboard[car] += 1
        b.event[car] = now + b.boarding[passenger]
        return
    b.phase[car] = STANDING
    b.event[car] = now + 0.5 * STOP_SECONDS


@lean_kernel
def _depart(building: Building, car: int, now: float) -> None:
    b = building
    if b.aboard[car] == 0:
        _choose(b, car, now)
        return
    floor = b.floor[car]
    _go(b, car, -1, now)
    if b.waiting[floor] > 0:
        _call(b, floor, now)  # whoever was left behind presses the button again


@lean_kernel
def _arrive(building: Building, car: int, now: float) -> bool:
    """Whether the car has reached a floor where it has to decide."""
    b = building
    b.floor[car] += b.direction[car]
    floor, direction = b.floor[car], b.direction[car]
    loaded = b.aboard[car] > 0
    if loaded and floor == 0:
        _stop(b, car, now)
        return False
    room = b.aboard[car] < b.counts[CAPACITY]
    could_serve = b.waiting[floor] > 0 and room and not _another_stands(b, floor, car)
    further = loaded or _calls_beyond(b, floor, direction)
    if could_serve and further:
        b.phase[car] = DECIDING
        b.event[car] = np.inf
        return True
    if could_serve:
        _stop(b, car, now)
    elif further:
        _go(b, car, direction, now)
    else:
        _choose(b, car, now)
    return False


@lean_kernel
def advance(building: Building, until: float) -> Any:
    """Goes on to the next decision, and returns the car that has it; the accounts are charged up to that moment.

    Returns `ENDED` when everybody is where they wanted to be, and `PAUSED` where nothing more happens up to the second
    ``until`` (``np.inf``: never).
    """
    b = building
    total = len(b.arrival)
    while b.counts[LEFT] < total:
        car = 0
        for c in range(1, len(b.event)):
            if b.event[c] < b.event[car]:
                car = c
        now = b.event[car]
        coming = b.counts[SEEN]
        comes = coming < total and b.arrival[coming] <= now
        if (b.arrival[coming] if comes else now) > until:
            return PAUSED
        if comes:
            b.counts[SEEN] += 1
            _appear(b, coming, b.arrival[coming])
            continue
        phase = b.phase[car]
        if phase == MOVING:
            if _arrive(b, car, now):
                _settle(b, now)
                b.counts[COUNTED] += 1
                return car
        elif phase == OPENING:
            _load(b, car, now)
        else:
            _depart(b, car, now)
    return ENDED


@lean_kernel
def decide(building: Building, car: int, stop: bool) -> None:
    """The car that `advance` has returned stops, or goes on."""
    b = building
    now = b.clock[SETTLED]
    if stop:
        _stop(b, car, now)
    else:
        _go(b, car, b.direction[car], now)


@lean_kernel
def open_account(building: Building, account: int) -> None:
    """Opens an account anew: nothing has been paid, and what comes is discounted to now."""
    building.cost[account] = 0.0
    building.discount[account] = 1.0


@lean_kernel
def rewind(building: Building) -> None:
    """Takes the building back to the beginning of the same hour."""
    b = building
    for p in range(len(b.arrival)):
        b.boarded[p] = np.nan
        b.left[p] = np.nan
    for f in range(len(b.waiting)):
        b.waiting[f] = 0
    for c in range(len(b.floor)):
        b.floor[c] = 0
        b.direction[c] = 1
        b.phase[c] = PARKED
        b.event[c] = np.inf
        b.aboard[c] = 0
    for account in range(len(b.cost)):
        open_account(b, account)
    for i in (SETTLED, NUM_WAITING, SUM_WAITS, SUM_SQUARES):
        b.clock[i] = 0.0
    for i in (SEEN, LEFT, COUNTED):
        b.counts[i] = 0
