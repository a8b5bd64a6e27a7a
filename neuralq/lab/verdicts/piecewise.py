"""Where an update leads whose affine piece changes with the weights: Q-learning, Sarsa, policy iteration, projections.

While the piece (for control: the greedy policy) stays, θ ← M θ + c can be applied 2, 4, 8, ... times at once, and each
leap is kept if the piece at its end, and three quarters of the way, is still the same. So a run settles, or leaves
every bound, within some tens of leaps however slow its modes are; where the piece changes it goes step by step. An
unstable piece is therefore held against a run only if the run stays in it; a stable one counts only if its fixed point
lies in its own region, for otherwise the run leaves before it gets there. What neither settles nor grows and comes
back on itself chatters (Gordon 1996); what creeps on is left undecided.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from neuralq.lab.linear.spectrum import limit_of, moving_spectrum
from neuralq.lab.methods import Expected
from neuralq.lab.methods.record import Piece
from neuralq.lab.verdicts.words import MOST_REGIONS, Region
from neuralq.types import Floats

__all__ = ["Path", "follow"]


CAP = 1e12
"""A run has diverged when it is this many times as large as its start (at least 1)."""

MOST_LEAP = 40  # 2^40 applications: factors of 1 + 1e-16 still count as 1
SETTLED = 1e-12


@dataclass(frozen=True, eq=False)
class Path:
    """Where a run led.

    Args:
        outcome: ``"converges"``, ``"diverges"``, ``"chatters"`` or ``"undecided"``.
        theta: θ at its end.
        piece: M and c there.
        regions: distinct pieces it went through, at most 64, the last one last.
    """

    outcome: Literal["converges", "diverges", "chatters", "undecided"]
    theta: Floats
    piece: Piece
    regions: tuple[Region, ...]


class _Walk:
    """A run with the pieces it met."""

    def __init__(self, expected: Expected, theta: Floats, step_size: float) -> None:
        self.expected, self.alpha = expected, step_size
        self.theta, self.piece = theta, expected.at(theta, step_size)
        self.cap = CAP * float(np.abs(theta).max(initial=1.0))
        self.met: dict[bytes, tuple[Piece, Floats]] = {}
        self.meet()

    def meet(self) -> None:
        key = self.piece[0].tobytes() + self.piece[1].tobytes()
        self.met.pop(key, None)
        self.met[key] = (self.piece, self.theta)
        if len(self.met) > MOST_REGIONS:
            self.met.pop(next(iter(self.met)))

    def same(self, theta: Floats) -> bool:
        M, c = self.expected.at(theta, self.alpha)
        return np.array_equal(M, self.piece[0]) and np.array_equal(c, self.piece[1])

    def escapes(self, theta: Floats) -> bool:
        return bool((np.abs(theta) > self.cap).any())

    def leap(self) -> int:
        """Apply the piece for as long as it stays, by doubling; the number of doublings."""
        power, theta = self.piece, self.theta
        before: Piece | None = None
        for k in range(MOST_LEAP):
            half, power = power, (power[0] @ power[0], power[0] @ power[1] + power[1])
            ahead = power[0] @ self.theta + power[1]
            late = None if before is None else before[0] @ theta + before[1]  # 2^k + 2^(k−1) of 2^(k+1) steps
            if (
                not np.isfinite(ahead).all()  # the power of a mode that this run does not have
                or not self.same(ahead)
                or (late is not None and not self.same(late))
            ):
                self.theta = theta
                return k
            theta, before = ahead, half
            if self.escapes(theta):
                break
        self.theta = theta
        return MOST_LEAP

    def regions(self) -> tuple[Region, ...]:
        found = []
        for (M, c), theta in self.met.values():
            limit = limit_of(np.eye(len(c)) - M, c, theta).theta
            radius = float(np.abs(moving_spectrum(M)).max(initial=0.0))
            inside = False
            if limit is not None and np.isfinite(limit).all():
                again = self.expected.at(limit, self.alpha)
                inside = np.array_equal(again[0], M) and np.array_equal(again[1], c)
            found.append(Region(radius, limit, inside))
        return tuple(found)


def follow(expected: Expected, theta: Floats, step_size: float, num_steps: int = 4000) -> Path:
    """A run of the expected update from θ until it settles, leaves every bound, or has taken so many steps and leaps.

    Args:
        expected: the update.
        theta: where it starts, ``[size]``.
        step_size: α.
        num_steps: steps and leaps together.

    Example:
        >>> def at(theta, step_size):  # |w| decays towards a point on the other side: it never gets there
        ...     return np.eye(1) * (1 - step_size), np.array([-step_size if theta[0] > 0 else step_size])
        >>> path = follow(Expected(1, at, linear=False), np.ones(1), 0.1)
        >>> path.outcome, [region.consistent for region in path.regions]
        ('chatters', [False, False])
    """
    walk = _Walk(expected, theta.astype(np.float64), step_size)
    places, largest = [walk.theta], 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(num_steps):
            ahead = walk.piece[0] @ walk.theta + walk.piece[1]
            moved = np.abs(ahead - walk.theta).max(initial=0.0)
            stays, largest = walk.same(ahead), max(largest, moved)
            if not stays and moved <= SETTLED * largest:  # before numbers underflow, and with them the piece
                return Path("converges", walk.theta, walk.piece, walk.regions())
            far = MOST_LEAP if moved == 0 else walk.leap() if stays else 0
            if far == 0:
                walk.theta = ahead
                if not stays:
                    walk.piece = expected.at(ahead, step_size)
                    walk.meet()
            if walk.escapes(walk.theta):
                return Path("diverges", walk.theta, walk.piece, walk.regions())
            if far == MOST_LEAP:  # a trillion applications and still the same piece: this is where it stays
                return Path(_resting(walk), walk.theta, walk.piece, walk.regions())
            places.append(walk.theta)
    return Path(_wandering(np.array(places)), walk.theta, walk.piece, walk.regions())


def _resting(walk: _Walk) -> Literal["converges", "undecided"]:
    """A run that stays in its piece without growing has converged, unless a mode of modulus 1 still carries it."""
    M, c = walk.piece
    step = np.abs(M @ walk.theta + c - walk.theta).max(initial=0.0)
    still = step <= SETTLED * np.abs(walk.theta).max(initial=1.0)
    carried = limit_of(np.eye(len(c)) - M, c, walk.theta).theta is None  # so slowly that each step looks like rounding
    return "converges" if still and not carried else "undecided"


def _wandering(places: Floats) -> Literal["converges", "diverges", "chatters", "undecided"]:
    """What a run of many short steps does, from the lengths of its steps and how far they lead."""
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    late = len(steps) // 2
    first, last = float(np.median(steps[late : late + late // 4])), float(np.median(steps[-(late // 4) :]))
    size = float(np.abs(places[-1]).max(initial=1.0))
    if last <= SETTLED * size or last < 0.5 * first:
        return "converges"
    if last > 2 * first:
        return "diverges"
    back = np.linalg.norm(places[-1] - places[late]) < 0.2 * steps[late:].sum()
    return "chatters" if back else "undecided"
