"""The learning benchmark's arithmetic: where a run is solved, whether it stays, and the row for its environment.

Mutants that die here: a hit that must exceed the threshold · the hit counted among the three that follow · fewer than
three evaluations taken for staying · the mean in place of the interquartile mean.
"""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "bench_learning.py"


def test_a_hit_and_the_three_that_follow() -> None:
    first_hit = runpy.run_path(str(SCRIPT))["first_hit"]
    returns = [-200.0, -110.0, -100.0, -109.0, -110.0, -150.0]
    rows = [
        {"env_steps": 10 * i, "cpu_seconds": float(i), "greedy_return": value} for i, value in enumerate(returns, 1)
    ]
    found = first_hit(rows, -110.0)
    assert (found["solved_at"], found["solved_cpu_seconds"]) == (20, 2.0)
    assert found["next_returns"] == [-100.0, -109.0, -110.0] and found["stays"]
    assert not first_hit(rows, -108.0)["stays"]  # −100, then −109
    assert not first_hit(rows[:4], -110.0)["stays"], "only two followed: nothing is known of the third"
    assert first_hit(rows, 0.0) == {"solved_at": None, "solved_cpu_seconds": None, "next_returns": [], "stays": False}


def test_a_row_is_the_interquartile_mean_of_the_finals() -> None:
    script = runpy.run_path(str(SCRIPT))
    results: list[dict[str, Any]] = [
        {"seed": i, "final_return": final, "env_steps": 100, "cpu_seconds": 4.0, "solved_at": at,
         "solved_cpu_seconds": at, "next_returns": [], "stays": at == 1}
        for i, (final, at) in enumerate(zip([0.0, 490.0, 500.0, 500.0], [None, 1, 2, 3], strict=True))
    ]  # fmt: skip
    row = script["summary_of"]("CartPole-v1", results)
    assert row["iqm"] == 495.0  # one of four dropped at each end
    assert (row["num_solved"], row["num_stay"], row["median_solved_cpu_seconds"]) == (3, 1, 2)
    assert script["summary_row"](row).split()[:3] == ["CartPole-v1", "100", "495.0"]


def test_it_trains_and_prints_one_json_object(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["CartPole-v1", "--seeds=2", "--total-steps=600", "--episodes=2", "--processes=1", "--json"]
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *arguments])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    lines = capsys.readouterr().out.strip().splitlines()
    assert lines[0] == "CartPole-v1" and [line.split()[0] for line in lines[2:4]] == ["1000", "1001"]
    (row,) = json.loads(lines[-1])
    assert row["num_seeds"] == 2 and [x["seed"] for x in row["seeds"]] == [1000, 1001]
    assert row["low"] <= row["iqm"] <= row["high"]


def test_an_environment_without_a_threshold_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), "Nowhere-v0"])
    with pytest.raises(SystemExit):
        runpy.run_path(str(SCRIPT), run_name="__main__")
    assert "no threshold for Nowhere-v0; choose from CartPole-v1" in capsys.readouterr().err
