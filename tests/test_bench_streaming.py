"""The streaming benchmark: what a variant's name means, the row of an environment, and one tiny run from end to end.

Mutants that die here, each tried: bound and cut exchanged · a variant without a cut read as the published one · the
rollout learner given streaming settings · the preset's steps kept where others were asked for · the mean in place of
the interquartile mean · final and mean returns exchanged, of a seed or of a row · seeds that do not start at the first.
"""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "bench_streaming.py"


@pytest.mark.parametrize(
    ("variant", "bound", "cut"),
    [
        ("obgd", "obgd", "watkins"),
        ("adaptive-obgd/published", "adaptive-obgd", "published"),
        ("intentional", "intentional", "watkins"),
    ],
)
def test_a_variant_is_a_bound_and_a_cut_over_the_preset(variant: str, bound: str, cut: str) -> None:
    config = runpy.run_path(str(SCRIPT))["config_of"]("Acrobot-v1", variant, None)
    assert (config.env, config.learner, config.total_steps) == ("Acrobot-v1", "streaming", 500_000)
    assert (config.streaming.bound, config.streaming.cut) == (bound, cut)
    assert config.body.sparsity == 0.9, "the preset's network"


def test_the_rollout_learner_keeps_its_own_preset_and_takes_the_steps_that_are_given() -> None:
    config = runpy.run_path(str(SCRIPT))["config_of"]("MountainCar-v0", "rollout", 640)
    assert (config.learner, config.streaming, config.total_steps) == ("rollout", None, 640)
    assert config.rollout.normalise_observations


def test_a_row_is_made_of_interquartile_means_with_intervals() -> None:
    script = runpy.run_path(str(SCRIPT))
    outcomes: list[dict[str, Any]] = [
        {"seed": i, "env_steps": 5_000, "cpu_seconds": cpu, "final_return": final, "mean_return": final / 10}
        for i, (final, cpu) in enumerate(zip([0.0, 490.0, 500.0, 500.0], [1.0, 2.0, 4.0, 9.0], strict=True))
    ]
    row = script["row_of"]("CartPole-v1", "obgd/published", outcomes)
    assert row["iqm"] == 495.0 and row["along_iqm"] == pytest.approx(49.5)  # one of four dropped at each end
    assert row["low"] < 495.0 < row["high"] and row["num_seeds"] == 4 and row["median_cpu_seconds"] == 3.0
    words = script["line_of"](row).split()
    assert words[:5] == ["CartPole-v1", "obgd/published", "5,000", "4", "495.0"] and words[-1] == "3.0"
    alone = script["line_of"](script["row_of"]("CartPole-v1", "obgd", outcomes[1:2])).split()
    assert alone[4:] == ["490.0", "-", "49.0", "-", "2.0"], "one seed has no interval"


def test_a_seed_is_its_last_row_the_mean_of_its_evaluations_and_new_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    seed_of = runpy.run_path(str(SCRIPT))["seed_of"]
    evaluations = [
        {"kind": "evaluation", "env_steps": steps, "cpu_seconds": steps / 100, "greedy_return": greedy}
        for steps, greedy in ((100, 10.0), (300, 50.0))
    ]
    rows = [evaluations[0], {"kind": "train", "env_steps": 200}, evaluations[1], {"kind": "train", "env_steps": 400}]
    monkeypatch.setitem(seed_of.__globals__, "read_metrics", lambda _: rows)
    monkeypatch.setitem(seed_of.__globals__, "evaluate_run", lambda _, num_episodes: SimpleNamespace(mean=num_episodes))
    expected = {"env_steps": 300, "cpu_seconds": 3.0, "final_return": 20, "mean_return": 30.0}
    assert seed_of(Path("run"), 7, 20) == {"seed": 7, **expected}


@pytest.mark.slow
def test_it_sweeps_and_prints_rows_and_json(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["CartPole-v1", "--variants", "obgd/published", "--steps=300", "--seeds=1", "--first-seed=7"]
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *arguments, "--episodes=2", "--json"])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    header, line, last = capsys.readouterr().out.strip().splitlines()
    assert header.split()[:3] == ["environment", "variant", "steps"]
    assert line.split()[:4] == ["CartPole-v1", "obgd/published", "300", "1"]
    (row,) = json.loads(last)
    (seed,) = row["seeds"]
    assert seed["seed"] == 7 and seed["env_steps"] == 300 and row["iqm"] == seed["final_return"] >= 1.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(["Nowhere-v0"], "no streaming preset for Nowhere-v0; choose from CartPole-v1"), (["--seeds=0"], "at least 1")],
)
def test_what_it_cannot_measure_is_refused(
    arguments: list[str], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *arguments])
    with pytest.raises(SystemExit):
        runpy.run_path(str(SCRIPT), run_name="__main__")
    assert said in capsys.readouterr().err
