"""Every script runs, tiny, and prints the columns its docstring promises; how fast and how well is not asked here.

They run inside this process, which spares importing torch for each; the slow lane runs them as a user does.
"""

from __future__ import annotations

import ast
import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from neuralq.runs.folder.run_folder import RunFolder

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted(path.name for path in (ROOT / "scripts").glob("*.py"))
TWO_SEEDS = ["--total-steps=600", "--seeds=2", "--processes=1"]


def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], script: str, *arguments: str) -> list[str]:
    """The lines that the script prints."""
    monkeypatch.setattr(sys, "argv", [script, *arguments])
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setattr(sys, "path", [*sys.path, str(ROOT / "scripts")])  # as Python has it; one script imports another
    runpy.run_path(str(ROOT / "scripts" / script), run_name="__main__")
    return capsys.readouterr().out.splitlines()


def numbers(text: str) -> list[float]:
    return [float(x.replace(",", "")) for x in re.findall(r"-?\d[\d,]*\.?\d*(?:e[+-]?\d+)?", text)]


@pytest.mark.parametrize("script", SCRIPTS)
def test_docstring_names_the_command_and_help_answers(
    script: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    docstring = ast.get_docstring(ast.parse((ROOT / "scripts" / script).read_text()))
    assert docstring is not None and f"python scripts/{script}" in docstring
    with pytest.raises(SystemExit) as ended:
        run(monkeypatch, capsys, script, "--help")
    assert ended.value.code == 0
    assert "usage:" in capsys.readouterr().out


def test_train_reports_the_run_and_plays_an_episode(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "run"
    lines = run(monkeypatch, capsys, "train.py", "--total-steps=1000", f"--run-dir={path}", "--seed=1")
    assert lines[0] == str(path) and (path / "metrics.jsonl").is_file()
    assert numbers(lines[1])[0] >= 1000 and "CPU-seconds" in lines[1]
    episode_return, num_steps = numbers(lines[2])[:2]
    assert episode_return == num_steps > 0  # CartPole pays 1 for each step


def test_train_knows_an_environment_with_action_masks_and_a_table(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    lines = run(
        monkeypatch, capsys, "train.py", "--env=neuralq/MitchellGrid-v0", "--layout=table",
        "--total-steps=4096", f"--run-dir={tmp_path / 'run'}",
    )  # fmt: skip
    episode_return, num_steps = numbers(lines[2])[:2]
    assert episode_return == 100 and num_steps <= 3  # Figure 13.2: the goal pays 100 and is at most 3 moves away


def test_three_layouts_prints_a_row_each_and_draws(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib", reason="the plot extra is not installed")
    figure = tmp_path / "layouts.svg"
    lines = run(monkeypatch, capsys, "three_layouts.py", *TWO_SEEDS, f"--figure={figure}", "--json")
    assert lines[0].split()[:2] == ["layout", "final"] and lines[0].split()[-2:] == ["best", "CPU-s"]
    assert [line.split()[0] for line in lines[1:4]] == ["action-input", "separate", "action-output"]
    for line in lines[1:4]:
        middle, low, high, best, _ = numbers(line.split(maxsplit=1)[1])
        assert low <= middle <= high <= best
    assert "action-output" in figure.read_text()
    curves = json.loads(lines[-1])["layouts"]["separate"]
    assert [curve["seed"] for curve in curves] == [0, 1]
    assert all(len(curve["steps"]) == len(curve["returns"]) for curve in curves)


def test_bands_are_the_quartiles_over_seeds() -> None:
    bands = runpy.run_path(str(ROOT / "scripts" / "three_layouts.py"))["bands"]
    curves = [{"steps": [0, 10], "returns": [0.0, last]} for last in (1.0, 2.0, 3.0, 4.0, 5.0)]
    steps, quartiles = bands(curves, num_points=3)
    assert steps.tolist() == [0, 5, 10]
    assert quartiles.tolist() == [[0, 1, 2], [0, 1.5, 3], [0, 2, 4]]  # rows: 25, 50 and 75 %


def test_bench_cartpole_counts_seeds(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--seeds=2", "--budget=600", "--evaluate-every=300", "--processes=1", "--json"]
    lines = run(monkeypatch, capsys, "bench_cartpole.py", *arguments)
    assert lines[0].split() == ["seed", "steps", "CPU-s", "next", "three"]
    summary = json.loads(lines[-1])
    assert summary["num_seeds"] == 2 and [x["seed"] for x in summary["seeds"]] == [0, 1]
    assert f"{summary['num_solved']} of 2 seeds within 600 steps" in lines[-2]


def test_bench_cartpole_reads_hit_and_following_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    script = runpy.run_path(str(ROOT / "scripts" / "bench_cartpole.py"))
    returns = [20.0, 480.0, 500.0, 475.0, 490.0, 10.0]
    rows = [
        {"kind": "evaluation", "env_steps": 100 * i, "cpu_seconds": float(i), "greedy_return": value}
        for i, value in enumerate(returns, 1)
    ]
    monkeypatch.setitem(script["solve"].__globals__, "read_metrics", lambda path: [{"kind": "train"}, *rows])
    monkeypatch.setattr(script["neuralq"], "train", lambda config, path: None)
    found: dict[str, Any] = script["solve"](0, 500, 100)
    assert (found["env_steps"], found["cpu_seconds"]) == (200, 2.0)
    assert found["next_returns"] == [500.0, 475.0, 490.0] and found["stays"]
    rows[4]["greedy_return"] = 474.9
    assert not script["solve"](0, 500, 100)["stays"]
    assert script["solve"](0, 199, 100)["env_steps"] is None  # solved, but after the budget
    del rows[4:]
    assert not script["solve"](0, 500, 100)["stays"]  # only two evaluations followed: nothing is known of the third


def test_bench_throughput_prints_three_rows(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--rounds=1", "--rollout-steps=512", "--replay-steps=150", "--json"]
    lines = run(monkeypatch, capsys, "bench_throughput.py", *arguments)
    assert lines[0].split()[0] == "learner" and lines[0].split()[-2:] == ["ratio", "peer"]
    results = json.loads(lines[-1])
    assert list(results) == ["rollout, 4 x 128", "rollout, 64 x 128", "replay, 1 environment"]
    for row in results.values():
        assert row["ours"] > 0
        assert "peer" not in row or row["ratio"] == pytest.approx(row["ours"] / row["peer"])


def test_bench_throughput_says_how_to_get_a_missing_peer(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)  # importing it now raises ImportError
    arguments = ["--rounds=1", "--rollout-steps=512", "--replay-steps=150"]
    last = run(monkeypatch, capsys, "bench_throughput.py", *arguments)[-1]
    assert 'pip install "neuralq[bench]"' in last and "-" in last


def test_baird_prints_prediction_and_measurement(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = "\n".join(run(monkeypatch, capsys, "baird.py", "--num-steps=60"))
    prediction, table = out.split("measured", 1)
    assert "before anything is trained" in prediction and "1.0023925" in prediction and "1.0023925" in table
    for representation in ("table", "linear", "action-input", "separate", "action-output"):
        assert out.count(f" {representation} ") >= 2, representation


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "arguments"),
    [
        ("train.py", ["--total-steps=1000", "--run-dir=RUN"]),
        ("three_layouts.py", ["--total-steps=600", "--seeds=2", "--figure=RUN.png"]),
        ("three_layouts.py", ["--env=neuralq/MitchellGrid-v0", "--layouts", "table", "linear", "--total-steps=600"]),
        ("bench_cartpole.py", ["--seeds=2", "--budget=600"]),
    ],
)
def test_runs_as_a_user_runs_it(script: str, arguments: list[str], tmp_path: Path) -> None:
    arguments = [x.replace("RUN", str(tmp_path / "run")) for x in arguments]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "envs")))}
    command = [sys.executable, "-W", "error", str(ROOT / "scripts" / script), *arguments]
    ran = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout and not ran.stderr


@pytest.mark.slow
def test_td_gammon_study_keeps_the_best_step_size_and_draws_what_it_wrote(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    pytest.importorskip("gnubg_nn", reason="gnubg-nn is not installed")
    table, figure = tmp_path / "study.csv", tmp_path / "study.svg"
    lines = run(
        monkeypatch, capsys, "td_gammon_study.py", "--games=40", "--tune-games=4", "--seeds=1", "--lambdas", "0",
        "--processes=1", "--match-games=2", f"--csv={table}", f"--svg={figure}",
    )  # fmt: skip
    written = table.read_text().splitlines()
    num_tried = sum(line.startswith("tune,") for line in written)  # three, and more where the best is at an end
    tuned = {numbers(line)[1]: numbers(line)[4] for line in lines[:num_tried]}
    kept = numbers(lines[-1])[1]
    assert num_tried >= 3 and tuned[kept] == max(tuned.values()) and len(written) == 1 + num_tried + 6
    first = figure.read_text()
    again = run(monkeypatch, capsys, "td_gammon_study.py", f"--draw={table}", f"--svg={figure}")
    assert again[-1].split()[:4] == lines[-1].split()[:4] and figure.read_text() == first


def test_td_gammon_curve_has_a_row_for_each_evaluation_and_opponent(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for seed in (1, 2):
        with RunFolder.create(tmp_path / f"run{seed}", config={"kind": "td-gammon"}, seed=seed) as folder:
            folder.append_metrics({"kind": "train", "env_steps": 50, "games": 1})
            for games in (10, 20):
                row: dict[str, float | str] = {"kind": "evaluation", "env_steps": 55 * games, "games": games}
                for name, points in (("random", 2.5), ("pubeval", 0.01 * games)):
                    row |= {f"ppg_{name}": points, f"ppg_{name}_standard_error": 0.1, f"win_rate_{name}": 0.6}
                folder.append_metrics({**row, "cpu_seconds": 1.26})
    runs = [str(tmp_path / "run1"), str(tmp_path / "run2")]
    table, figure = tmp_path / "curve.csv", tmp_path / "curve.svg"
    lines = run(monkeypatch, capsys, "td_gammon_curve.py", *runs, f"--csv={table}", f"--svg={figure}")
    assert [line.split()[-3] for line in lines] == ["+0.200", "+2.500"] * 2
    rows = table.read_text().splitlines()
    assert len(rows) == 1 + 8 and rows[1:3] == ["1,10,1.3,random,2.5,0.1,0.6", "1,10,1.3,pubeval,0.1,0.1,0.6"]
    first = figure.read_text()
    run(monkeypatch, capsys, "td_gammon_curve.py", f"--draw={table}", f"--svg={figure}")
    assert figure.read_text() == first and "against pubeval" not in first  # letters are drawn as paths


def test_learning_curves_has_a_panel_for_each_environment_and_a_mean_over_its_seeds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    runs = []
    for env, seed, returns in (("A/One-v1", 1, [2.0, 4.0]), ("A/One-v1", 2, [4.0, 6.0, 9.0]), ("Two-v0", 1, [-3.0])):
        with RunFolder.create(tmp_path / f"{env[-6]}{seed}", config={"env": env, "seed": seed}, seed=seed) as folder:
            folder.append_metrics({"kind": "train", "env_steps": 50})
            for i, greedy in enumerate(returns, 1):
                row: dict[str, float | str] = {"kind": "evaluation", "env_steps": 100 * i, "cpu_seconds": 1.26 * i}
                folder.append_metrics({**row, "greedy_return": greedy})
        runs.append(str(folder.path))
    table, figure, level = tmp_path / "curves.csv", tmp_path / "curves.svg", "--level=Two-v0=-1"
    lines = run(monkeypatch, capsys, "learning_curves.py", *runs, level, f"--csv={table}", f"--svg={figure}")
    assert [line.split()[-1] for line in lines] == ["9.0", "-3.0"]  # of one seed where the other has not come so far
    rows = table.read_text().splitlines()
    assert len(rows) == 1 + 6 and rows[1:3] == ["A/One-v1,1,100,1.3,2.0", "A/One-v1,1,200,2.5,4.0"]
    first = figure.read_text()
    run(monkeypatch, capsys, "learning_curves.py", f"--draw={table}", level, f"--svg={figure}")
    assert figure.read_text() == first
    run(monkeypatch, capsys, "learning_curves.py", f"--draw={table}", f"--svg={figure}")
    assert figure.read_text() != first, "the level is drawn"
    steps, means = runpy.run_path(str(ROOT / "scripts" / "learning_curves.py"))["mean_curve"](
        [
            {"env_steps": 2, "greedy_return": 1.0},
            {"env_steps": 1, "greedy_return": 3.0},
            {"env_steps": 2, "greedy_return": 2.0},
        ]
    )
    assert (steps, means) == ([1, 2], [3.0, 1.5])


@pytest.mark.whole
def test_what_a_machine_with_an_accelerator_is_asked_runs_here_in_a_small_form(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with pytest.raises(SystemExit) as ended:
        run(monkeypatch, capsys, "gpu_check.py", "--device=cpu", "--small", f"--out={tmp_path / 'gpu.json'}")
    assert ended.value.code == 0
    found = json.loads((tmp_path / "gpu.json").read_text())
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == found and found["ok"]
    assert len(found["learners"]["difference"]) == 5 and set(found["resume"]["difference"].values()) == {0.0}
    assert found["rates"]["steps_per_second"]["CartPole-v1, 8"]["ratio"] > 0
    assert "accelerator" in found["tests"]["left_out"] and "accelerator" in found["graphs"]["left_out"]
    monkeypatch.setattr(sys, "argv", ["gpu_check.py", "--parts=nothing", "--device=cpu"])
    with pytest.raises(SystemExit, match="there are the parts tests, learners, resume, rates, graphs, got nothing"):
        runpy.run_path(str(ROOT / "scripts" / "gpu_check.py"), run_name="__main__")
