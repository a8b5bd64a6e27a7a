"""Runs through pieces against plain steps, and each rule of the walk on the smallest update that shows it.

Mutants that die here: a leap that looks only at where it lands; the powers of a piece one too high; pieces in the order
of their first visit; a run called still although it drifts; medians of other steps than the late ones.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from neuralq.lab.methods import Expected
from neuralq.lab.verdicts.piecewise import _Walk, _wandering, follow

Floats = NDArray[np.float64]


def line(piece_at: Callable[[float], tuple[float, float]], calls: list[float] | None = None) -> Expected:
    """θ ← m θ + c with (m, c) given by θ, one number."""

    def at(theta: Floats, step_size: float) -> tuple[Floats, Floats]:
        if calls is not None:
            calls.append(float(theta[0]))
        m, c = piece_at(float(theta[0]))
        return np.array([[m]]), np.array([c])

    return Expected(1, at, linear=False)


@pytest.mark.parametrize("seed", range(6))
def test_a_run_meets_the_pieces_that_plain_steps_meet(seed: int) -> None:
    """Shrinking maps of the plane, another in every quadrant: where they lead, and through what."""
    rng = np.random.default_rng(seed)
    turns = rng.uniform(-0.3, 0.3, size=4)
    M = 0.97 * np.array([[[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]] for t in turns])
    c = 0.2 * rng.normal(size=(4, 2))

    def number(theta: Floats) -> int:
        return int(2 * (theta[0] > 0) + (theta[1] > 0))

    w = 5 * rng.normal(size=2)
    path = follow(Expected(2, lambda theta, _: (M[number(theta)], c[number(theta)]), linear=False), w, 0.1)
    met: list[int] = []
    for _ in range(4000):
        met = [*(k for k in met if k != number(w)), number(w)]
        w = M[number(w)] @ w + c[number(w)]
    assert [region.spectral_radius for region in path.regions] == pytest.approx([0.97] * len(met))
    points = np.array([np.linalg.solve(np.eye(2) - M[k], c[k]) for k in met])
    if path.outcome == "converges":
        assert path.theta == pytest.approx(w, abs=1e-10)
        assert [region.fixed_point for region in path.regions] == [pytest.approx(point) for point in points]
        assert path.regions[-1].consistent
    else:
        assert path.outcome == "chatters"
        found = sorted(tuple(region.fixed_point) for region in path.regions if region.fixed_point is not None)
        assert found == [pytest.approx(point) for point in sorted(map(tuple, points))]
    inside = {tuple(point.round(9)): number(point) == k for k, point in zip(met, points, strict=True)}
    for region in path.regions:
        assert region.fixed_point is not None
        assert inside[tuple(region.fixed_point.round(9))] == region.consistent


@pytest.mark.parametrize(
    ("odd", "doublings", "steps"),
    [(2, 0, 0), (3, 1, 2), (4, 1, 2), (6, 2, 4), (8, 2, 4), (12, 3, 8), (16, 3, 8), (5, 40, 2**40), (7, 40, 2**40)],
)
def test_a_leap_looks_where_it_lands_and_at_three_quarters_of_the_way(odd: int, doublings: int, steps: int) -> None:
    """θ ← θ + 1 from 0, with another piece at one whole number only."""
    walk = _Walk(line(lambda x: (1.0, 2.0) if x == odd else (1.0, 1.0)), np.zeros(1), 0.1)
    assert walk.leap() == doublings and walk.theta.tolist() == [steps]


def test_a_leap_ends_beyond_the_cap_and_keeps_away_from_what_overflows() -> None:
    walk = _Walk(line(lambda x: (2.0, 1.0)), np.ones(1), 0.1)
    assert walk.leap() == 40 and walk.theta.tolist() == [2.0**65 - 1]  # 2 · 2^n − 1 after n = 64 steps
    turned = _Walk(line(lambda x: (-1e200, 0.0)), np.zeros(1), 0.1)  # its square is no number
    with np.errstate(over="ignore", invalid="ignore"):
        assert turned.leap() == 0 and turned.theta.tolist() == [0.0]
    for start, cap in (([0.25], 1e12), ([-3.0], 3e12)):
        walk = _Walk(line(lambda x: (1.0, 0.0)), np.array(start), 0.1)
        assert walk.cap == cap and walk.escapes(np.array([-1.001 * cap])) and not walk.escapes(np.array([cap]))


def test_of_a_long_way_the_last_pieces_are_kept() -> None:
    """θ ← θ/2 + n/2 + 1 between n and n + 1, up to 100: each piece pulls into the next, and has its point there."""
    path = follow(line(lambda x: (0.5, min(np.floor(x), 99.0) / 2 + 1.0)), np.zeros(1), 0.1)
    assert path.outcome == "converges" and path.theta == pytest.approx(101.0)
    points = [region.fixed_point for region in path.regions]
    assert points == [pytest.approx(n + 2.0) for n in range(36, 100)]
    assert [region.consistent for region in path.regions] == [False] * 63 + [True]


def test_pieces_without_a_point_or_without_motion() -> None:
    drifting, still = follow(line(lambda x: (1.0, 1.0) if x < 3 else (1.0, 0.0)), np.zeros(1), 0.1).regions
    assert (drifting.spectral_radius, drifting.fixed_point, drifting.consistent) == (0.0, None, False)
    assert (still.spectral_radius, still.consistent) == (0.0, True)
    assert still.fixed_point is not None and still.fixed_point.tolist() == [3.0]
    nothing = follow(Expected(0, lambda theta, _: (np.zeros((0, 0)), np.zeros(0)), linear=False), np.zeros(0), 0.1)
    assert nothing.outcome == "converges" and [region.spectral_radius for region in nothing.regions] == [0.0]


def test_a_step_of_length_one_is_no_rest() -> None:
    path = follow(line(lambda x: (1.0, -1.0) if x > 0 else (0.5, -1.0)), np.array([2.5]), 0.1)
    assert path.outcome == "converges" and path.theta == pytest.approx(np.array([-2.0]))
    assert [region.spectral_radius for region in path.regions] == [0.0, 0.5]


def test_a_run_at_rest_on_an_unstable_point_is_not_walked_on() -> None:
    calls: list[float] = []
    assert follow(line(lambda x: (1e200, 0.0), calls), np.zeros(1), 0.1).outcome == "converges"
    assert len(calls) <= 4


def test_a_step_into_another_piece_ends_a_run_where_it_is_rounding() -> None:
    def pieces(size: float) -> Callable[[float], tuple[float, float]]:
        return lambda x: (0.0, 0.0) if x == 4.0 else (1.0, size) if x == 0.0 else (1.0, 1e-3)

    start = np.array([4.0])  # the largest step leads from here to 0
    assert follow(line(pieces(4e-12)), start, 0.1).outcome == "converges"
    assert follow(line(pieces(4.04e-12)), start, 0.1).outcome == "undecided"


def test_a_run_that_leaves_every_bound_step_by_step() -> None:
    """A piece of its own for every sign, θ ← −2 θ ± 1: no leap is possible, and 2^n grows past 1e12."""
    path = follow(line(lambda x: (-2.0, 1.0 if x > 0 else -1.0)), np.array([2.0]), 0.1)
    assert path.outcome == "diverges" and 1e12 < abs(path.theta[0]) / 2 < 2.1e12


@pytest.mark.parametrize(
    ("M", "c", "start", "outcome"),
    [
        ([[1.0]], [1e-14], [0.0], "undecided"),  # too small a step to be seen, but it never ends
        ([[1.0, 1.0], [0.0, 1.0]], [0.0, 0.0], [0.0, 1e-3], "undecided"),  # nothing is added, and it never ends either
        ([[-1.0]], [0.0], [1.0], "undecided"),  # to and fro
        ([[-1.0]], [0.0], [5e-13], "converges"),  # a step of 1e-12: rounding beside 1
        ([[-1.0]], [0.0], [6e-13], "undecided"),
        ([[-1.0, 0.0], [0.0, 1.0]], [0.0, 0.0], [4e-10, 1e3], "converges"),  # rounding beside 1000
        ([[-1.0, 0.0], [0.0, 1.0]], [0.0, 0.0], [6e-10, 1e3], "undecided"),
        ([[0.5]], [1.0], [0.0], "converges"),
    ],
)
def test_what_rests(M: list[list[float]], c: list[float], start: list[float], outcome: str) -> None:
    piece = np.array(M), np.array(c)
    assert follow(Expected(len(c), lambda theta, _: piece, linear=False), np.array(start), 0.1).outcome == outcome


def places(scale: float, size: float = 1.0) -> Floats:
    """Forty steps to and fro; those from 20 to 24 have the median 4, the last five that of 4 times ``scale``."""
    steps = np.full(40, 100.0)
    steps[20:26], steps[26:34] = 2.0 ** np.arange(6), 6.0
    steps[34:] = scale * 2.0 ** np.arange(6)[::-1]
    signs = np.where(np.arange(40) % 2 == 0, 1.0, -1.0)
    return size * np.append(0.0, np.cumsum(signs * steps))[:, None]


def test_short_steps_are_judged_by_the_medians_of_a_quarter() -> None:
    assert [_wandering(places(scale)) for scale in (0.499, 1.999, 2.001)] == ["converges", "chatters", "diverges"]
    assert "converges" not in (_wandering(places(0.5)), _wandering(places(0.501)))
    assert _wandering(places(2.0)) != "diverges"
    assert _wandering(np.array([[0.0, 1e-12] * 20]).T) == "converges"
    # 4e-12 per step: rounding beside θ of size 5, steps beside θ of size 1
    tiny = np.array([[5.0, 5.0 + 4e-12] * 20]).T
    assert _wandering(tiny) == "converges" and _wandering(tiny - 4.0) == "chatters"


@pytest.mark.parametrize(("last", "outcome"), [(3.49, "chatters"), (3.5, "undecided"), (3.51, "undecided")])
def test_what_comes_back_on_itself_chatters(last: float, outcome: str) -> None:
    """Forty steps forward; of the late ones nine go back, and the last leads 1 + 3.5 away: a fifth of 19 + 3.5."""
    steps = np.ones(60)
    steps[41:59:2], steps[59] = -1.0, last
    assert _wandering(np.append(0.0, np.cumsum(steps))[20:, None]) == outcome
