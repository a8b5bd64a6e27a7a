"""Littman's maze: what Sarsa(λ) must reach on percepts, and what must fail. (Exact answers: test_aliased.py.)"""

from __future__ import annotations

import numpy as np
import pytest

from neuralq.systems import run_system, system_named
from neuralq.systems.littman.trainings import LOST, Training, train
from neuralq_envs.aliased import littman, walked


def test_walks_are_charged_where_they_never_arrive() -> None:
    maze = littman()
    steps = walked(maze, np.zeros(maze.num_observations, dtype=int), LOST)  # always north: only below the goal
    assert np.flatnonzero(steps < LOST).size == 5 and sorted(steps)[:5] == [1, 2, 3, 4, 5]
    assert Training(steps, steps, 1).num_lost == 41 and Training(steps, steps, 1).total == 41 * LOST + 15
    with pytest.raises(ValueError, match="method must be one of"):
        train(0, "TD(0)")
    with pytest.raises(ValueError, match="num_steps must be"):
        train(0, num_steps=0)


@pytest.mark.slow
def test_traces_find_the_best_policy_of_percepts_and_one_step_methods_none_near_it() -> None:
    found = run_system(system_named("littman"))
    traced, *plain = (np.array(one.values) for one in found.measured)
    assert len(traced) == 10 and not found.wrong and found.reproduced
    assert (traced == 416).sum() >= 8
    assert all((one > 420).all() for one in plain) and len(plain) == 2  # what must fail
