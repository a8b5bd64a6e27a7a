"""McCallum's maze: what memory must reach there, and what must fail. (The learners: test_tabular_memories.py.)"""

from __future__ import annotations

import numpy as np
import pytest

from neuralq.systems import run_system, system_named
from neuralq.systems.mccallum.pictures import curves_svg, maze_picture, tree_svg
from neuralq.systems.mccallum.system import FEW, split_percepts
from neuralq.systems.mccallum.trials import Training, train


def test_trainings_repeat_and_say_when_they_had_learned() -> None:
    one, other = (train(3, "NSM", num_trials=60) for _ in range(2))
    assert np.array_equal(one.lengths, other.lengths) and 3 < one.steps < 30
    assert Training(np.array([200] * 5 + [4] * 12)).learned_after(4.0) == 1000 + 40
    assert Training(np.array([200] * 15)).learned_after(4.0) == 3000


def test_pictures_say_what_they_show() -> None:
    found = train(0, "USM", num_trials=60)
    nodes = {suffix[:d] for suffix in found.leaves for d in range(1, len(suffix) + 1)}
    lines = sum(len(node) > 1 for node in nodes)
    moves = len(found.leaves) + sum(
        len(node) % 2 == 0 and node[-1] >= 0 for node in nodes
    )  # best ones, and those before
    svg = tree_svg(found.leaves)
    assert svg.count("<path") == lines + moves and svg.count("<circle") == sum(node[-1] < 0 for node in nodes)
    assert maze_picture().svg.count("<rect") == 15 and "USM" in curves_svg({"USM": [found]})


@pytest.mark.slow
def test_memory_learns_the_m_and_percepts_alone_do_not() -> None:
    found = run_system(system_named("mccallum"))
    steps = {one.what.partition(":")[0]: float(np.mean(one.values)) for one in found.measured[:4]}
    assert len(found.measured[0].values) == 8 and not found.wrong and found.reproduced
    assert steps["NSM"] <= FEW == 1.2 * 4.3 and steps["USM"] <= FEW
    assert max(found.measured[4].values) <= 40
    assert steps["Q-learning on percepts"] >= 5 * 4.3 and steps["NSM, match 1"] >= 5 * 4.3  # what must fail
    (right,) = [row for row in found.rows if row.what.startswith("USM tells apart")]
    assert right.ours == "8 of 8 trees"
    assert split_percepts(train(11, "USM")) == {1, 4}  # the top and the strokes; not the feet, which need the same
