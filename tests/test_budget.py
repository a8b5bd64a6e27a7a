"""Schedules that nobody set end within a budget that somebody did; what is set is left alone.

Mutants that must die here: a longer budget that stretches a schedule · the preset's own share of its budget taken from
the wrong budget · a value given on the command line or in the file overruled · ε that does not move called a schedule ·
a run that says nothing of it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from neuralq.apps.cli import main
from neuralq.runs import RunConfig, with_preset
from neuralq.runs.recipe.budget import cut_to_budget
from neuralq.runs.recipe.presets import PRESETS

Capture = pytest.CaptureFixture[str]
PRESET: dict[str, Any] = {
    "total_steps": 100,
    "epsilon_decay_steps": 70,
    "rollout": {"anneal": True, "anneal_env_steps": 30, "num_envs": 4},
}


@pytest.mark.parametrize(
    ("budget", "decay", "anneal"),
    [
        (None, 70, 30),
        (1_000, 70, 30),  # longer: what the preset says
        (100, 70, 30),
        (90, 63, 30),  # 70 % of it, as of the preset's own
        (20, 14, 20),
    ],
)
def test_both_schedules_by_hand(budget: int | None, decay: int, anneal: int) -> None:
    given = {} if budget is None else {"total_steps": budget}
    cut, notes = cut_to_budget(PRESET, given)
    assert (cut["epsilon_decay_steps"], cut["rollout"]["anneal_env_steps"]) == (decay, anneal)
    assert len(notes) == (decay != 70) + (anneal != 30)
    assert PRESET["rollout"]["anneal_env_steps"] == 30 and cut["rollout"]["num_envs"] == 4


def test_a_short_schedule_may_take_half_of_the_budget() -> None:
    cut, notes = cut_to_budget({"total_steps": 1000, "epsilon_decay_steps": 100}, {"total_steps": 300})
    assert cut["epsilon_decay_steps"] == 100 and notes == []  # 10 % would be 30 steps, and 100 fit
    cut, notes = cut_to_budget({"total_steps": 1000, "epsilon_decay_steps": 100}, {"total_steps": 30})
    assert cut["epsilon_decay_steps"] == 15
    assert notes == ["ε falls over 15 steps, not 100 (--epsilon-decay-steps)"]


@pytest.mark.parametrize(
    "given",
    [
        {"epsilon_decay_steps": 70, "rollout": {"anneal_env_steps": 60}},
        {"epsilon_start": 0.05, "rollout": {"anneal_env_steps": 60}},  # where it ends: nothing falls
    ],
)
def test_what_is_given_is_left_alone(given: dict[str, Any]) -> None:
    assert cut_to_budget(PRESET, {"total_steps": 20, **given}) == (PRESET, [])


def test_no_preset_of_this_version_is_cut_by_its_own_budget() -> None:
    for (env, learner), preset in PRESETS.items():
        config = with_preset({"env": env, "learner": learner})
        again = with_preset({"env": env, "learner": learner, "total_steps": config.total_steps})
        assert config == again and config.epsilon_decay_steps == preset.get("epsilon_decay_steps", 20_000)


def test_python_and_the_command_line_agree_and_the_run_says_so(tmp_path: Path, capsys: Capture) -> None:
    short = with_preset({"env": "MountainCar-v0", "total_steps": 2_000})
    assert short.epsilon_decay_steps == 1_000
    assert main(["train", "MountainCar-v0", "--total-steps", "2000", "--print-config"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["epsilon_decay_steps"] == 1_000
    file = tmp_path / "run.yaml"
    file.write_text("env: CartPole-v1\ntotal_steps: 64\nrollout: {num_envs: 2, num_steps: 16, num_minibatches: 2}\n")
    words = ["--config", str(file), "--evaluation-episodes", "1", "--evaluation-max-steps", "5"]
    assert main(["train", *words, "--run-dir", str(tmp_path / "run")]) == 0
    said = capsys.readouterr().err.splitlines()[0]
    assert (
        "within 64 steps ε falls over 32 steps, not 8,000 (--epsilon-decay-steps), the learning rate falls over" in said
    )
    assert main(["train", *words, "--epsilon-decay-steps", "900", "--print-config"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["epsilon_decay_steps"] == 900


@pytest.mark.parametrize("nonsense", ["many", True, -4, 0])
def test_a_budget_that_is_none_is_refused_as_ever(nonsense: Any) -> None:
    with pytest.raises(ValueError, match="total_steps"):
        with_preset({"env": "CartPole-v1", "total_steps": nonsense})
    assert RunConfig(total_steps=64).epsilon_decay_steps == 20_000  # a configuration in full is nobody's default
