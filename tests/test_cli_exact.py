"""`neuralq solve`: values, all optimal actions, grids and exit status.

Mutants that die here: FrozenLake's actions drawn as if they went clockwise · a wall drawn as a goal · only the lowest
optimal action named · a run that was stopped reported as a success · infinity written into JSON.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest

from neuralq.apps.cli import main

Capture = pytest.CaptureFixture[str]


def solved(capsys: Capture, *arguments: str) -> dict[str, Any]:
    """The JSON object of a run that succeeds."""
    assert main(["solve", *arguments, "--json"]) == 0
    result: dict[str, Any] = json.loads(capsys.readouterr().out.splitlines()[-1])
    return result


def test_all_optimal_actions_and_the_bound(capsys: Capture) -> None:
    result = solved(capsys, "neuralq/MitchellGrid-v0", "--gamma", "0.9")
    assert result["v"] == pytest.approx([90, 100, 0, 81, 90, 100])
    # Figure 13.2: north or east from the two bottom cells on the left, nothing in G.
    assert result["optimal_actions"] == [[1], [1], [], [0, 1], [0, 1], [0]]
    assert result["converged"] and 0 <= result["bound"] <= 1e-8 and result["num_states"] == 6


@pytest.mark.parametrize("method", ["value-iteration", "policy-iteration", "linear-programming"])
def test_methods_agree(method: str, capsys: Capture) -> None:
    result = solved(capsys, "neuralq/ExerciseGrid-v0", "--gamma", "0.8", "--method", method)
    assert result["method"] == method and result["v"] == pytest.approx([8, 10, 8, 10, 0, 10])


def test_grids_are_drawn_as_grids(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "grid.svg"
    assert main(["solve", "neuralq/MitchellGrid-v0", "--gamma", "0.9", "--svg", str(path)]) == 0
    out = capsys.readouterr().out
    assert "│  90 → │ 100 → │  end  │" in out and "│ 81 ↑→ │ 90 ↑→ │ 100 ↑ │" in out
    assert "deterministic optimal policies: 4" in out and "↑ is action 0" in out
    assert "100" in ["".join(element.itertext()) for element in ElementTree.parse(path).iter()]


def test_walls_are_no_ends(capsys: Capture) -> None:
    assert main(["solve", "neuralq/DynaMaze-v0", "--gamma", "0.95"]) == 0
    out = capsys.readouterr().out
    assert out.count("end") == 1 and out.count("█" * 7) >= 7
    assert "0.513 →" in out  # .95¹³ at the start, 14 moves from the goal


def test_gymnasiums_own_grids(capsys: Capture) -> None:
    without_slip = ("--env-kwargs", '{"is_slippery": false}')
    assert main(["solve", "FrozenLake-v1", "--gamma", "0.9", *without_slip]) == 0
    out = capsys.readouterr().out
    # S F F F / F H F H / F F F H / H F F G: from S down twice, or right twice, six moves in all: .9⁵ = .590.
    assert "│ 0.59 →↓ │ 0.656 → │ 0.729 ↓ │ 0.656 ← │" in out
    assert "← is action 0, ↓ is action 1, → is action 2, ↑ is action 3" in out
    assert main(["solve", "CliffWalking-v1", "--gamma", "0.99"]) == 0
    assert "│    -1 ↓    │" in capsys.readouterr().out  # above the goal


def test_what_is_no_grid_is_a_table(tmp_path: Path, capsys: Capture) -> None:
    assert main(["solve", "neuralq/RandomWalk-v0", "--gamma", "1"]) == 0
    out = capsys.readouterr().out
    assert "3    0.5000  walk  (C)" in out and "0    0.0000  terminal  (left end)" in out
    assert main(["solve", "neuralq/RandomWalk-v0", "--gamma", "1", "--svg", str(tmp_path / "x.svg")]) == 1
    assert "no grid to draw" in capsys.readouterr().err and not (tmp_path / "x.svg").exists()


def test_a_solver_that_is_stopped_fails(capsys: Capture) -> None:
    stopped = ["solve", "FrozenLake-v1", "--method", "value-iteration", "--max-iterations", "2", "--json"]
    assert main(stopped) == 1
    captured = capsys.readouterr()
    result = json.loads(captured.out.splitlines()[-1])
    assert result["converged"] is False and result["bound"] > 1e-8
    assert captured.err.startswith("neuralq: did not converge")


def test_a_table_that_is_not_the_environment_is_refused(capsys: Capture) -> None:
    # A fickle passenger changes the destination under way: step does it, and the table does not know.
    fickle = ["Taxi-v4", "--gamma", "1", "--env-kwargs", '{"fickle_passenger": true, "fickle_probability": 1.0}']
    assert main(["solve", *fickle]) == 1
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert "does not do what its table says: in state" in captured.err and "--no-check" in captured.err
    assert solved(capsys, *fickle, "--no-check")["converged"]  # the way out works


def test_a_time_limit_is_said(capsys: Capture) -> None:
    assert main(["solve", "FrozenLake-v1"]) == 0
    assert "episodes are cut after 100 steps; these are the values without the cut" in capsys.readouterr().out
    assert solved(capsys, "FrozenLake-v1")["max_episode_steps"] == 100


def test_values_of_every_size_are_printed_with_their_digits(capsys: Capture) -> None:
    for reward, seen in (("1e-9", "8.1e-10"), ("1e+9", "8.1e+08")):
        given = ["neuralq/MitchellGrid-v0", "--gamma", "0.9", "--env-kwargs", f'{{"goal_reward": {reward}}}']
        assert main(["solve", *given]) == 0
        assert seen in capsys.readouterr().out
