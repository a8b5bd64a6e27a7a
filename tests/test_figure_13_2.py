"""Every representation learns the action values of Mitchell's Figure 13.2 from one configuration but for a word.

Negative controls: with truncation taken for termination, with the successor taken for the state that was left, and with
the step reversed, the same assertion fails.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from neuralq.learners import RolloutLearner
from neuralq.q.engine import TorchEngine
from neuralq.runs import load, train, with_preset
from neuralq.runs.loop import Diverged
from neuralq.runs.stream import Step
from neuralq.runs.stream.experience import RolloutExperience

# Figure 13.2, γ = 0.9, cells row by row with G at (0, 2): the values printed on the arrows. A move is worth γⁿ · 100,
# n the moves to G after it.
NORTH, EAST, SOUTH, WEST = range(4)
FIGURE = {
    (0, EAST): 90.0, (0, SOUTH): 72.9,
    (1, EAST): 100.0, (1, SOUTH): 81.0, (1, WEST): 81.0,
    (3, NORTH): 81.0, (3, EAST): 81.0,
    (4, NORTH): 90.0, (4, EAST): 90.0, (4, WEST): 72.9,
    (5, NORTH): 100.0, (5, WEST): 81.0,
}  # fmt: skip
BOUND = {"table": 1e-6, "linear": 1e-6, "action-input": 1.0, "separate": 1.0, "action-output": 1.0}


def largest_error(folder: Path, layout: str, seed: int, **changes: Any) -> float:
    """Over all legal pairs; the learned legal actions must be those of the figure."""
    config = with_preset({"env": "neuralq/MitchellGrid-v0", "layout": layout, "seed": seed, **changes})
    run = train(config, folder / f"{layout}-{seed}")
    agent = load(run.run_dir)
    errors = []
    for s in range(6):
        if s == 2:
            continue  # no action leaves G
        legal = np.array([(s, a) in FIGURE for a in range(4)])
        values = agent.values(s, legal)
        assert np.isneginf(values[~legal]).all()
        errors += [abs(values[a] - FIGURE[s, a]) for a in np.flatnonzero(legal)]
    assert len(errors) == 12
    return float(np.max(errors))


# The table and the network of the chapter; the rest of the layouts with the slow seeds.
FAST = [pytest.param(name, marks=[] if name in ("table", "action-output") else pytest.mark.slow) for name in BOUND]
ALSO_SLOWLY = ["table", pytest.param("action-output", marks=pytest.mark.slow)]


@pytest.mark.parametrize("layout", FAST)
def test_the_figure_is_learned(layout: str, tmp_path: Path) -> None:
    assert largest_error(tmp_path, layout, seed=0) <= BOUND[layout]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 5))
@pytest.mark.parametrize("layout", BOUND)
def test_the_figure_is_learned_from_every_seed(layout: str, seed: int, tmp_path: Path) -> None:
    assert largest_error(tmp_path, layout, seed) <= BOUND[layout]


def test_the_configurations_differ_in_one_word() -> None:
    plain = [dataclasses.asdict(with_preset({"env": "neuralq/MitchellGrid-v0", "layout": layout})) for layout in BOUND]
    for one in plain:
        assert {name for name in one if one[name] != plain[0][name]} <= {"layout"}


def test_a_linear_function_of_one_hot_states_is_the_table(tmp_path: Path) -> None:
    values = []
    for layout in ("table", "linear"):
        config = with_preset({"env": "neuralq/MitchellGrid-v0", "layout": layout, "total_steps": 1280})
        agent = load(train(config, tmp_path / layout).run_dir)
        values.append([agent.values(s) for s in range(6)])
    np.testing.assert_allclose(*values, rtol=0, atol=1e-9)


SHORT = {"env_kwargs": {"max_episode_steps": 2}}
LIMITED = {"env_kwargs": {"max_episode_steps": 20}}  # or the evaluation of a wrong policy would never end


@pytest.mark.parametrize("layout", ALSO_SLOWLY)
def test_a_time_limit_changes_nothing(layout: str, tmp_path: Path) -> None:
    assert largest_error(tmp_path, layout, 0, **SHORT) <= BOUND[layout]


@pytest.mark.parametrize("layout", ALSO_SLOWLY)
def test_truncation_taken_for_termination_fails(layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add = RolloutExperience.add

    def merged(self: RolloutExperience, step: Step) -> None:
        step.transition.discount_t[step.transition.last_t] = 0.0
        add(self, step)

    monkeypatch.setattr(RolloutExperience, "add", merged)
    assert largest_error(tmp_path, layout, 0, **SHORT) > 10


def test_the_bootstrap_from_the_state_that_was_left_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    targets = RolloutLearner.targets
    monkeypatch.setattr(RolloutLearner, "targets", lambda self, t: targets(self, dataclasses.replace(t, s_t=t.s_tm1)))
    assert largest_error(tmp_path, "table", 0, **LIMITED) > 10


def test_a_step_in_the_wrong_direction_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gradient = TorchEngine.loss_gradient

    def reversed_gradient(self: TorchEngine, *args: torch.Tensor) -> torch.Tensor:
        errors = gradient(self, *args)
        self.flat.grad.neg_()
        return errors

    monkeypatch.setattr(TorchEngine, "loss_gradient", reversed_gradient)
    try:
        assert largest_error(tmp_path, "table", 0, **LIMITED) > 10
    except (Diverged, ValueError) as error:
        assert "diverged" in str(error)
