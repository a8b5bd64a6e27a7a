"""The doctor as a whole: the contract of `examine`, the command, its exit status, and the page."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import nn

from neuralq.apps.cli import main
from neuralq.doctor import CannotLoad, Finding, Report, examination, examine
from neuralq.doctor.examination import NUM_PARTS
from neuralq.doctor.findings import CAUSES
from neuralq.learners import RolloutSettings
from neuralq.runs import RunConfig, train
from neuralq.runs.folder.files import read_json, to_json
from neuralq.runs.recipe.config import config_to_dict
from neuralq.runs.sweep import create_sweep

GAMMA = 0.9
FROZEN = {"env": "FrozenLake-v1", "env_kwargs": {"is_slippery": False}}


def best_values() -> Any:
    from neuralq.exact import solve
    from neuralq.mdp import FiniteMDP

    return np.nan_to_num(solve(FiniteMDP.from_gymnasium(gym.make("FrozenLake-v1", is_slippery=False)), GAMMA).q)


class Raising(gym.Wrapper[Any, Any, Any, Any]):
    def step(self, action: Any) -> Any:
        raise RuntimeError("the simulator crashed")


@pytest.fixture(autouse=True, scope="module")
def few_episodes() -> Iterator[None]:
    """What is asked here does not depend on how many are played."""
    with pytest.MonkeyPatch.context() as patch:
        for name, number in (("NUM_GREEDY", 12), ("NUM_EXPLORED", 8), ("NUM_OTHER", 8)):
            patch.setattr(f"neuralq.doctor.exam.case.{name}", number)
        yield


@pytest.fixture
def few_measurements(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is asked of commands does not depend on which are made; those that train or copy take the most time."""
    kept = {"V1", "X5", "V4", "V2", "V3", "E5", "R6a", "R1", "R2", "R4", "D4"}
    monkeypatch.setattr(examination, "_MEASUREMENTS", {n: m for n, m in examination._MEASUREMENTS.items() if n in kept})


@pytest.fixture(scope="module")
def told() -> list[tuple[int, str]]:
    return []


@pytest.fixture(scope="module")
def sick(told: list[tuple[int, str]]) -> Report:
    """Values that are three times too high, of a policy that is no better than chance, and no network to look into."""

    def values(s: Any) -> Any:
        return np.tile([300.0, 299.0], (len(s), 1))

    return examine(values, "CartPole-v1", budget_s=8, progress=lambda so_far, text: told.append((so_far, text)))


def test_findings_keep_the_contract(sick: Report) -> None:
    assert not sick.healthy and sick.cause == sick.findings[0].cause
    for one in (*sick.findings, *sick.measured):
        assert one.cause in CAUSES and one.grade in "ABC" and isinstance(one.value, float)
        assert one.interval is None or len(one.interval) == 2
        assert one.evidence and one.remedy and one.confirm and one.title and one.source
    assert [one.grade for one in sick.findings] == sorted(one.grade for one in sick.findings)
    assert {"V1", "V2", "V4"} <= {one.id for one in sick.findings if one.grade == "B"}
    assert json.loads(json.dumps(sick.plain(), allow_nan=False))["findings"][0]["id"] == sick.findings[0].id


def test_what_could_not_be_measured_is_listed_with_the_reason_and_blocks_nothing(sick: Report) -> None:
    assert "torch.nn.Module" in sick.not_measured["R1"] and "--data" in sick.not_measured["D1"]
    assert "--set" in sick.not_measured["V5"] and "no model" in sick.not_measured["V7"]
    assert {one.id for one in sick.measured} >= {"E1", "E2", "E3", "E4", "E5", "E6", "V1", "V2", "V3", "V4"}


def test_the_summary_fits_one_screen_and_progress_reaches_its_end(sick: Report, told: list[tuple[int, str]]) -> None:
    lines = sick.explain().splitlines()
    assert len(lines) <= 24 and max(map(len, lines)) <= 80
    assert all(any(line.startswith(cause) for line in lines) for cause in CAUSES)
    assert [so_far for so_far, _ in told] == list(range(NUM_PARTS))


@pytest.mark.slow
def test_the_page_is_one_file_and_says_what_was_found(sick: Report, tmp_path: Path) -> None:
    text = sick.write(tmp_path / "report.html").read_text(encoding="utf-8")
    assert sick.headline in text and "What was not measured, and why" in text and "prefers-color-scheme: dark" in text
    assert "<script" not in text and "http://" not in text.replace("http://www.w3.org/2000/svg", "")
    assert text.count("<svg") == 2 and all(one.title in text for one in sick.findings if one.grade in "AB")
    assert "mistakes that fit best" in text
    well = dataclasses.replace(sick, findings=()).write(tmp_path / "well.html").read_text(encoding="utf-8")
    assert "mistakes that fit best" not in well and "with γ = " not in well  # nobody is to be told apart
    fresh = (0.1, 0.2, 0.2, 0.3, 0.1, 0.2, 0.2, 0.3)
    signs = [Finding("R2", "", "algorithm", "C", x, threshold=3.0, fresh=fresh) for x in (0.2, 4.0)]
    signs += [Finding("R4", "", "algorithm", "C", 0.0, threshold=0.1, fresh=(0.0,) * 8)]
    text = dataclasses.replace(sick, measured=tuple(signs)).write(tmp_path / "signs.html").read_text(encoding="utf-8")
    assert text.count("<svg") == 3 and "R2, effective rank of the last hidden layer (directions): 4, fresh" in text


@pytest.mark.slow
def test_exact_values_of_a_model_are_healthy() -> None:
    q = best_values()
    report = examine(lambda s: q[s], FROZEN, gamma=GAMMA, budget_s=20)
    assert report.healthy and report.headline.startswith("Healthy") and report.cause is None


def test_the_caller_has_the_last_word_on_the_discount() -> None:
    first, second = (
        examine(lambda s: np.zeros((len(s), 2)), "CartPole-v1", gamma=g, budget_s=0.2) for g in (None, 0.5)
    )
    assert (first.gamma, second.gamma) == (0.99, 0.5)


def test_an_environment_that_raises_is_the_finding() -> None:
    report = examine(lambda s: np.zeros((len(s), 2)), lambda: Raising(gym.make("CartPole-v1")), budget_s=5)
    assert report.cause == "environment" and "the simulator crashed" in report.findings[0].evidence


def test_a_budget_that_is_spent_is_said_and_kept() -> None:
    report = examine(lambda s: np.zeros((len(s), 2)), "CartPole-v1", budget_s=0.001)
    assert report.seconds < 3 and "the budget of 0.001 s was spent" in report.not_measured["R5"]


@pytest.mark.parametrize(
    ("subject", "env", "message"),
    [
        (nn.Linear(3, 2), "CartPole-v1", r"shape \[4\].*--env"),
        (nn.Linear(4, 3), "CartPole-v1", "3 action values.*2 actions"),
        (lambda s: np.zeros(2), "CartPole-v1", r"\[N, A\]"),
        (7, "CartPole-v1", "must be a path"),
    ],
)
def test_subjects_that_do_not_fit_say_why(subject: Any, env: str, message: str) -> None:
    with pytest.raises(CannotLoad, match=message):
        examine(subject, env)


def test_environments_and_settings_that_do_not_fit_say_why() -> None:
    with pytest.raises(ValueError, match="pass env"):
        examine(nn.Linear(4, 2))
    with pytest.raises(ValueError, match="Discrete"):
        examine(nn.Linear(3, 2), "Pendulum-v1")
    with pytest.raises(ValueError, match="there is no setting 'speed'"):
        examine(nn.Linear(4, 2), "CartPole-v1", settings={"speed": 1})
    with pytest.raises(ValueError, match="level must be one of"):
        examine(nn.Linear(4, 2), "CartPole-v1", level="guess")  # type: ignore[arg-type]


def test_a_finding_says_itself_in_json_without_what_is_not_finite() -> None:
    one = Finding("V4", "t", "algorithm", "B", float("nan"), (float("-inf"), 1.0), None, "s", True)
    assert one.plain()["value"] is None and one.plain()["interval"] == [None, 1.0]


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "q.pth"
    torch.save(nn.Sequential(nn.Linear(4, 32), nn.ReLU(), nn.Linear(32, 2)).state_dict(), path)
    return path


@pytest.mark.usefixtures("few_measurements")
def test_the_command_prints_json_last_writes_the_page_and_exits_by_its_findings(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "report.html"
    monkeypatch.setattr("neuralq.doctor.page.draw_svg", lambda name, *told: f"<svg id={name}>")
    command = ["doctor", str(weights), "--env", "CartPole-v1", "--set", "lr=1e-3", "--json"]
    assert main([*command, "--report", str(page)]) == 1
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["healthy"] is False and said["report"] == str(page)
    beside = {one["id"]: one["fresh"] for one in said["measured"] if one["fresh"]}
    assert set(beside) == {"R1", "R2", "R4", "R6a"} and {len(of_eight) for of_eight in beside.values()} == {8}
    assert "<svg id=signs>" in (text := page.read_text(encoding="utf-8")) and "of fresh networks" in text


@pytest.mark.usefixtures("few_measurements")
def test_the_command_exits_with_2_where_nothing_can_be_loaded(
    weights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["doctor", "/nowhere/agent.zip", "--env", "CartPole-v1"]) == 2
    assert main(["doctor", str(weights), "--env", "Acrobot-v1"]) == 2
    assert main(["doctor", str(weights)]) == 1
    error = capsys.readouterr().err
    assert "there is no /nowhere/agent.zip" in error and "Acrobot-v1" in error and "--env ID" in error
    assert "Traceback" not in error


@pytest.mark.usefixtures("few_measurements")
def test_the_command_exits_with_0_where_all_is_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The best action of every state is worth 1 at γ = 0 where each step pays 1, whatever one does."""
    (tmp_path / "ones.py").write_text(
        "import gymnasium, numpy, torch\n"
        "class World(gymnasium.Env):\n"
        "    observation_space = gymnasium.spaces.Box(0, 1, (2,))\n"
        "    action_space = gymnasium.spaces.Discrete(2)\n"
        "    def reset(self, *, seed=None, options=None):\n"
        "        super().reset(seed=seed)\n"
        "        self.t = 0\n"
        "        return numpy.zeros(2, numpy.float32), {}\n"
        "    def step(self, action):\n"
        "        paid = float(action == self.t % 2)\n"
        "        self.t += 1\n"
        "        return numpy.array([self.t % 2, self.t / 9], numpy.float32), paid, self.t == 9, False, {}\n"
        "class Net(torch.nn.Module):\n"
        "    def __init__(self):\n"
        "        super().__init__()\n"
        "        self.scale = torch.nn.Parameter(torch.ones(1))\n"
        "    def forward(self, x):\n"
        "        return self.scale * torch.cat([1 - x[:, :1], x[:, :1]], dim=1)\n"
    )
    monkeypatch.chdir(tmp_path)
    torch.save({"scale": torch.ones(1)}, "ones.pth")
    status = main(["doctor", "ones.pth", "--net", "ones:Net", "--env", "ones:World", "--gamma", "0"])
    assert status == 0 and "Healthy" in capsys.readouterr().out


@pytest.mark.usefixtures("few_measurements")
def test_of_a_sweep_the_worst_seed_is_examined_and_what_the_others_return_says_whether_it_was_luck(
    tmp_path: Path,
) -> None:
    """Two seeds that learned next to nothing; of one of them its summary says otherwise, or the same."""
    config = RunConfig(
        total_steps=64, evaluation_episodes=1, epsilon_decay_steps=64, rollout=RolloutSettings(num_envs=2, num_steps=16)
    )  # fmt: skip
    sweep = create_sweep(tmp_path / "sweep", config_to_dict(config), (0, 1))
    with pytest.raises(CannotLoad, match=f"neuralq resume {sweep.path}"):
        examine(str(sweep.path))
    for seed in sweep.seeds:
        train(dataclasses.replace(config, seed=seed), sweep.run_path(seed))
    for best in (500.0, 9.5):
        for seed in sweep.seeds:
            path = sweep.run_path(seed) / "summary.json"
            told = {**read_json(path), "greedy_return": best if seed == 0 else 9.0, "play_off": None}
            path.write_text(to_json(told, "summary", sealed=True))
        report = examine(sweep.path, budget_s=20)
        luck = next(one for one in report.measured if one.id == "X5")
        assert report.subject.startswith("seed 1, the worst of 2") and luck.value == (0.5 if best == 500 else 0)
        assert luck.flagged == (best == 500) == (report.cause == "luck") == ("X5" in report.headline)
        assert best != 500 or "neuralq train CartPole-v1 --seeds 5" in luck.confirm


@pytest.mark.usefixtures("few_measurements")
def test_a_run_that_misses_its_target_ends_with_three_findings_and_one_that_asks_with_all(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["train", "CartPole-v1", "--preset", "false", "--total-steps", "64", "--rollout.num-envs", "2"]
    command += ["--rollout.num-steps", "16", "--evaluation-episodes", "1", "--resume-probe", "false"]
    command += ["--stop-at-return", "475"]
    assert main([*command, "--run-dir", str(tmp_path / "short")]) == 1
    said = capsys.readouterr().err
    assert said.count("neuralq: doctor: [") == 3 and f"neuralq doctor {tmp_path / 'short'}" in said
    assert "the target of 475 was not reached" in said
    assert main(["train", "CartPole-v1", "--seeds", "2", "--doctor"]) == 2
    assert "--doctor examines one run" in capsys.readouterr().err
