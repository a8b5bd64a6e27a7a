"""Schedules against hand arithmetic.

Mutants that these tests kill: reaching the end a step late or early; going on beyond it; 1/n for 1/(1 + n).
"""

from __future__ import annotations

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuralq.rules import Constant, Exponential, Linear, Power, Schedule


def test_linear_by_hand() -> None:
    schedule = Linear(1.0, 0.0, 4)
    assert [schedule.value(step) for step in range(6)] == [1.0, 0.75, 0.5, 0.25, 0.0, 0.0]


def test_linear_may_rise() -> None:
    assert [Linear(1.0, 3.0, 2).value(step) for step in range(4)] == [1.0, 2.0, 3.0, 3.0]


def test_exponential_by_hand() -> None:
    schedule = Exponential(8.0, 1.0, 3)
    assert [schedule.value(step) for step in range(5)] == pytest.approx([8, 4, 2, 1, 1])
    assert Exponential(1e-200, 1e200, 2).value(1) == pytest.approx(1.0)  # end / start would overflow


def test_power_by_hand() -> None:
    assert [Power(1.0).value(n) for n in range(4)] == [1.0, 1 / 2, 1 / 3, 1 / 4]
    assert Power(0.5, scale=6.0, offset=4.0).value(5) == pytest.approx(2.0)  # 6 / √9


def test_power_meets_the_convergence_conditions() -> None:
    """ω = 1: the sum grows like ln n (13.11's visits), the sum of squares stays below π²/6."""
    steps = [Power(1.0).value(n) for n in range(10_000)]
    assert sum(steps) > 9.2
    assert sum(x * x for x in steps) < 1.6449341


@given(st.floats(1e-3, 10), st.floats(1e-3, 10), st.integers(1, 10**9), st.integers(0, 2 * 10**9))
def test_always_between_the_ends(start: float, end: float, num_steps: int, step: int) -> None:
    low, high = sorted((start, end))
    for schedule in (Linear(start, end, num_steps), Exponential(start, end, num_steps)):
        assert low * (1 - 1e-12) <= schedule.value(step) <= high * (1 + 1e-12)
        assert schedule.value(0) == pytest.approx(start) and schedule.value(num_steps) == end


def test_schedules_are_values() -> None:
    """Frozen, comparable, without memory: any point may be asked for in any order."""
    all_of_them: list[Schedule] = [Constant(0.5), Linear(1.0, 0.1, 9), Exponential(1.0, 0.1, 9), Power(0.7)]
    for schedule in all_of_them:
        late = schedule.value(7)
        schedule.value(2)
        assert schedule.value(7) == late
        assert schedule == dataclasses.replace(schedule)  # type: ignore[type-var]
        with pytest.raises(ValueError, match="step must be a whole number"):
            schedule.value(-1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        Constant(0.5).level = 1.0  # type: ignore[misc]


def test_bad_settings_are_refused() -> None:
    for call, message in [
        (lambda: Constant(float("nan")), "level must be a finite number"),
        (lambda: Linear(1.0, float("inf"), 3), "end must be a finite number"),
        (lambda: Linear(1.0, 0.0, 0), "num_steps must be a whole number"),
        (lambda: Exponential(1.0, 0.0, 3), "end must be a finite number above 0"),
        (lambda: Power(0.0), "exponent must be a finite number above 0"),
        (lambda: Power(1.0, offset=0.0), "offset must be a finite number above 0"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()
