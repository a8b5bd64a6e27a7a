"""The benchmark beside Stable-Baselines3: its arithmetic, its file of results, and that it runs.

Mutants that die here: a share from the wrong end · one environment's runs for all of them · a case trained again that
stands in the file · one of other steps taken from it · the default with the environment's preset under it.
"""

from __future__ import annotations

import dataclasses
import json
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "bench_dqn.py"


def one(env: str, seed: int, value: float, **more: Any) -> dict[str, Any]:
    names = {"env": env, "learner": "preset", "seed": seed, "env_steps": 300}
    return {**names, "final_return": value, "cpu_seconds": 1.0, **more}


def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *argv: str) -> list[str]:
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *argv])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    return capsys.readouterr().out.strip().splitlines()


def test_shares_lie_between_random_and_solved_and_are_averaged_over_environments() -> None:
    script = runpy.run_path(str(SCRIPT))
    assert script["share"]("MountainCar-v0", -200.0) == 0.0 and script["share"]("MountainCar-v0", -110.0) == 1.0
    results = [one("CartPole-v1", 0, 475.0), one("CartPole-v1", 1, 475.0), one("MountainCar-v0", 0, -200.0)]
    average = script["average_of"]("preset", [*results, one("MountainCar-v0", 1, -155.0)])
    assert average["mean"] == pytest.approx((1 + 1 + 0 + 0.5) / 4) and average["iqm"] == pytest.approx(0.75)
    row = script["summary_of"]("CartPole-v1", "preset", results[:2])
    assert (row["iqm"], row["share"], row["env_steps"]) == (475.0, 1.0, 300)


def test_the_default_knows_nothing_of_the_environment() -> None:
    configured = runpy.run_path(str(SCRIPT))["configured"]
    given = {"env": "CartPole-v1", "learner": "replay", "total_steps": 5000}
    default, preset = configured("default", given), configured("preset", given)
    assert default.reward_scale == 1.0 != preset.reward_scale
    other = configured("default", {**given, "env": "Acrobot-v1"})
    assert dataclasses.replace(default, env="Acrobot-v1") == other
    before = configured("before", given)
    assert before.replay.target_period_updates == 500 and before.replay.average_updates is None
    assert before.epsilon_decay_steps == default.epsilon_decay_steps == 2500 and before.reward_scale == 1.0


def test_a_benchmark_that_was_stopped_goes_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "cases.jsonl"
    known = [one("CartPole-v1", 7, 123.0), one("CartPole-v1", 8, 99.0, env_steps=50)]
    out.write_text("".join(json.dumps(case) + "\n" for case in known))
    words = ["CartPole-v1", "--learners", "preset", "--seeds=2", "--first-seed=7", "--total-steps=300", "--episodes=2"]
    lines = run(monkeypatch, capsys, *words, f"--out={out}", "--json")
    assert lines[0].startswith("CartPole-v1 preset seed 7: 123.0") and "99.0" not in lines[1]
    assert len(out.read_text().splitlines()) == 3
    found = json.loads(lines[-1])
    assert [row["learner"] for row in found["rows"]] == ["preset"] and len(found["rows"][0]["seeds"]) == 2
    assert run(monkeypatch, capsys, *words, f"--out={out}", "--json") == lines, "nothing is trained twice"


def test_the_zoos_agent_trains_where_the_package_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("stable_baselines3", reason="the bench extra is not installed")
    lines = run(
        monkeypatch, capsys, "CartPole-v1", "--learners", "sb3", "--seeds=1", "--total-steps=300", "--episodes=1"
    )
    assert lines[0].startswith("CartPole-v1 sb3 seed 2000: ") and lines[-1].split()[:2] == ["all", "sb3"]


def test_an_environment_that_the_zoo_has_not_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        run(monkeypatch, capsys, "Nowhere-v0")
    assert "settings for Nowhere-v0 are not written down; choose from CartPole-v1" in capsys.readouterr().err
