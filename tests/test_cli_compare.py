"""Comparing runs: what is one group, its numbers and curve, and what is left out; folders are written by hand.

Mutants that must die here: runs of different settings in one group · the seed counted as a setting · the seeds of two
sweeps in one group · the best return in place of the last · a run that ended early taken for zero after its end · a
repeated seed counted twice · a curve before every run has begun · runs without evaluations in the mean.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neuralq.apps.cli import main
from neuralq.runs.folder.run_folder import RunFolder, RunFolderError
from neuralq.runs.recipe.presets import PRESETS, REACHED
from neuralq.runs.report.comparison import group_curve, read_groups
from neuralq.runs.report.options import by_option
from neuralq.runs.report.sweep import write_sweep_report
from neuralq.runs.sweep import Asked, ask, create_sweep
from neuralq.runs.sweep.statistics import bootstrap_interval

Capture = pytest.CaptureFixture[str]


def write_run(path: Path, seed: int, returns: dict[int, float], cpu: float = 1.0, **config: Any) -> Path:
    settings = {"env": "CartPole-v1", "gamma": 0.99, "rollout": {"lambda_": 0.9}, "seed": seed, **config}
    with RunFolder.create(path, config=settings, seed=seed) as folder:
        folder.append_metrics({"kind": "train", "env_steps": 1, "cpu_seconds": 0.1, "episode_return": 3.0})
        for steps, value in returns.items():
            row = {"kind": "evaluation", "env_steps": steps, "cpu_seconds": cpu, "greedy_return": value}
            folder.append_metrics(row)
    return path


def write_sweep(path: Path, returns: list[float], **config: Any) -> Path:
    sweep = create_sweep(path, {"total_steps": 200, **config}, range(len(returns)))
    for seed, value in enumerate(returns):
        write_run(sweep.run_path(seed), seed, {100: 0.0, 200: value}, **config)
    return path


def test_runs_alike_but_for_their_seed_are_one_group(tmp_path: Path) -> None:
    paths = [write_run(tmp_path / f"a{s}", s, {100: 900.0, 200: value}) for s, value in enumerate((1.0, 2.0, 6.0))]
    paths.append(write_run(tmp_path / "b", 0, {200: 7.0}, rollout={"lambda_": 0.5}))
    groups, left_out = read_groups(paths)
    assert left_out == []
    assert [group.returns for group in groups] == [[1.0, 2.0, 6.0], [7.0]]
    assert groups[0].estimate.iqm == 3.0  # fewer than four runs: nothing is dropped
    assert [group.settings for group in groups] == [{"rollout.lambda_": 0.9}, {"rollout.lambda_": 0.5}]
    assert [(group.name, group.label) for group in groups] == [("a0", "lambda 0.9"), ("b", "lambda 0.5")]
    plain = groups[0].plain()
    assert plain["seeds"] == [0, 1, 2] and plain["env_steps"] == [200] * 3 and plain["cpu_seconds"] == [1.0] * 3


def test_sweeps_stay_apart_even_if_alike(tmp_path: Path) -> None:
    paths = [write_sweep(tmp_path / "old", [1.0, 2.0]), write_sweep(tmp_path / "new", [3.0, 4.0])]
    groups, _ = read_groups([*paths, paths[0] / "seed-1"])
    assert [(group.label, group.returns) for group in groups] == [("old", [1.0, 2.0]), ("new", [3.0, 4.0])]


def test_sweeps_of_other_seeds_stay_apart_too(tmp_path: Path) -> None:
    for name, seed in (("old", 3), ("new", 4)):
        sweep = create_sweep(tmp_path / name, {"total_steps": 200}, [seed])
        write_run(sweep.run_path(seed), seed, {200: float(seed)})
    groups, _ = read_groups([tmp_path / "old", tmp_path / "new"])
    assert [group.returns for group in groups] == [[3.0], [4.0]]


def test_a_repeated_seed_is_no_further_evidence(tmp_path: Path) -> None:
    paths = [write_run(tmp_path / name, 5, {100: 9.0}) for name in ("one", "two")]
    groups, _ = read_groups([*paths, write_run(tmp_path / "three", 6, {100: 8.0}), paths[0]])
    assert [(group.label, group.returns) for group in groups] == [("one", [9.0, 8.0]), ("two", [9.0])]


def test_what_cannot_be_compared_is_named(tmp_path: Path) -> None:
    good, empty = write_run(tmp_path / "good", 0, {100: 1.0}), write_run(tmp_path / "empty", 1, {})
    groups, left_out = read_groups([good, empty])
    assert len(groups) == 1 and left_out == [f"{empty} has no greedy evaluation yet"]
    with pytest.raises(RunFolderError, match=r"nothing to compare: .*empty has no greedy evaluation"):
        read_groups([empty])
    with pytest.raises(RunFolderError, match="neither a run nor a sweep"):
        read_groups([good, tmp_path])


def test_folders_of_one_name_are_told_by_their_paths(tmp_path: Path) -> None:
    paths = [write_run(tmp_path / side / "run", 0, {100: 1.0}) for side in ("left", "right")]
    groups, _ = read_groups(paths)
    assert [group.name for group in groups] == list(map(str, paths))


def test_a_curve_is_the_interquartile_mean_of_interpolated_runs(tmp_path: Path) -> None:
    paths = [
        write_run(tmp_path / "0", 0, {100: 0.0, 300: 20.0}),  # 10 at 200
        write_run(tmp_path / "1", 1, {200: 4.0, 300: 2.0}),
        write_run(tmp_path / "2", 2, {100: 0.0, 200: 7.0}),  # ended early: 7 at 300
        write_run(tmp_path / "3", 3, {100: 0.0, 200: 500.0, 300: 0.0}),
    ]
    ((group,), _) = read_groups(paths)
    curve = group_curve(group)
    assert curve.steps.tolist() == [200.0, 300.0], "before 200 the second run has no value"
    assert curve.iqm.tolist() == [8.5, 4.5]  # (7 + 10) / 2 of 4, 7, 10, 500; (2 + 7) / 2 of 0, 2, 7, 20
    assert curve.low is not None and curve.high is not None
    assert np.all(curve.low <= curve.iqm) and np.all(curve.iqm <= curve.high) and np.all(curve.high <= 500.0)
    ((alone,), _) = read_groups(paths[:1])
    assert group_curve(alone).low is None


def test_a_long_curve_is_thinned_and_keeps_its_ends(tmp_path: Path) -> None:
    path = write_run(tmp_path / "long", 0, {10 * step: float(step) for step in range(1, 1001)})
    ((group,), _) = read_groups([path])
    curve = group_curve(group)
    assert len(curve.steps) <= 120 and (curve.steps[0], curve.steps[-1], curve.iqm[-1]) == (10.0, 10_000.0, 1000.0)


def test_the_table_and_its_json(tmp_path: Path, capsys: Capture) -> None:
    sweep = write_sweep(tmp_path / "ten", [float(value) for value in range(10)], gamma=0.9)
    single = write_run(tmp_path / "single", 4, {100: 12.25}, cpu=2.5)
    assert main(["compare", str(sweep), str(single)]) == 0
    header, first, second = capsys.readouterr().out.splitlines()
    assert header.split() == "run seeds greedy return 95 % interval mean steps CPU s gamma".split()
    assert first.split()[:3] == ["ten", "10", "4.5"] and first.split()[-4:] == ["4.5", "200", "1.0", "0.9"]
    assert second.split() == ["single", "1", "12.2", "–", "12.2", "100", "2.5", "0.99"]
    assert main(["compare", str(sweep), str(single), "--json"]) == 0
    groups = json.loads(capsys.readouterr().out)["groups"]
    assert groups[0]["iqm"] == 4.5 and groups[0]["low"] < 4.5 < groups[0]["high"]
    assert groups[1]["low"] is None and groups[1]["greedy_returns"] == [12.25]


def test_many_settings_stand_below_the_table(tmp_path: Path, capsys: Capture) -> None:
    wide = {f"setting_{number}": 0.5 for number in range(30)}
    paths = [
        write_run(tmp_path / "a", 0, {10: 1.0}, streaming=wide),
        write_run(tmp_path / "b", 0, {10: 2.0}, gradient={}),
    ]
    assert main(["compare", *map(str, paths)]) == 0
    header, first, second, *below = capsys.readouterr().out.splitlines()
    assert header.split() == "run seeds greedy return 95 % interval mean steps CPU s".split()
    assert first.split()[:3] == ["a", "1", "1.000"] and second.split()[:3] == ["b", "1", "2.0"]
    assert len(below) == 2 and below[0].startswith("a: streaming.setting_0 0.5, ") and below[1].startswith("b: ")
    assert "setting" not in below[1], "what a run does not have is not listed for it"


@pytest.mark.parametrize("suffix", ["svg", "png"])
def test_the_plot(suffix: str, tmp_path: Path, capsys: Capture) -> None:
    pytest.importorskip("matplotlib")
    paths = [str(write_sweep(tmp_path / "a", [1.0, 2.0, 3.0])), str(write_run(tmp_path / "b", 0, {50: 1.0, 90: 2.0}))]
    out = tmp_path / "new" / f"curves.{suffix}"
    assert main(["compare", *paths, "--out", str(out)]) == 0
    assert f"learning curves: {out}" in capsys.readouterr().out
    content = out.read_bytes()
    if suffix == "png":
        assert content.startswith(b"\x89PNG")
    else:
        assert b"<svg" in content and b"a: 2" in content and b"b: 2" in content


def test_wrong_usage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    run = write_run(tmp_path / "run", 0, {50: 1.0})
    assert main(["compare", str(run), "--out", "x.pdf"]) == 2
    assert "--out must end in .svg or .png" in capsys.readouterr().err
    assert main(["compare", "/nowhere"]) == 1
    assert "neither a run nor a sweep in /nowhere" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert main(["compare", str(run), "--out", str(tmp_path / "x.svg")]) == 1
    assert 'pip install "neuralq[plot]"' in capsys.readouterr().err


def test_presets_are_an_overview_of_one_line_each_and_one_is_shown_whole(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    rollout = {
        "gamma": 0.9,
        "body": {"class": "MLP", "hidden": [64, 32], "layer_norm": True},
        "rollout": {"lambda_": 0},
    }
    known = {
        ("CartPole-v1", "rollout"): rollout, ("Acrobot-v1", "online"): {"gamma": 1.0, "total_steps": 5000},
        ("CartPole-v1", "online"): {},
    }  # fmt: skip
    monkeypatch.setattr("neuralq.apps.cli.presets.PRESETS", known)
    monkeypatch.setattr("neuralq.apps.cli.presets.REACHED", {("CartPole-v1", "rollout"): "500.0 (486.1 to 500.0)"})
    assert main(["presets"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(maxsplit=3) for line in lines[1:4]] == [
        ["CartPole-v1", "rollout", "100,000", "500.0 (486.1 to 500.0)"],
        ["CartPole-v1", "online", "100,000", "-"],
        ["Acrobot-v1", "online", "5,000", "-"],
    ]
    assert lines[4] == "agents for any environment, by --preset NAME: rainbow (replay learner)"
    assert main(["presets", "CartPole-v1"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "CartPole-v1, rollout learner: neuralq train CartPole-v1",
        "    reaches 500.0 (486.1 to 500.0)",
        "    gamma = 0.9",
        "    body.class = MLP",
        "    body.hidden = 64,32",
        "    body.layer_norm = true",
        "    rollout.lambda = 0",
        "CartPole-v1, online learner: neuralq train CartPole-v1 --learner online",
    ]
    assert main(["presets", "Acrobot-v1", "--json"]) == 0
    (preset,) = json.loads(capsys.readouterr().out)["presets"]
    assert preset["settings"] == {"gamma": 1.0, "total_steps": 5000} and preset["reached"] is None
    assert main(["presets", "CartPol-v1"]) == 1
    assert "no preset for 'CartPol-v1'; did you mean CartPole-v1?" in capsys.readouterr().err
    assert main(["presets", "rainbow"]) == 0
    assert "    replay.noisy = true" in capsys.readouterr().out.splitlines()


def test_what_a_preset_reaches_stands_in_the_benchmarks() -> None:
    text = (Path(__file__).parents[1] / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    for key, reached in REACHED.items():
        assert key in PRESETS
        for figure in re.findall(r"[−\d.]*\d", reached):
            assert figure in text, (key, figure)


def write_options(path: Path) -> Path:
    """Two values of λ times two of γ, two seeds each; .1 of λ is worth 10, the larger γ 10, a seed 2."""
    sweep = ask(path, Asked({"env": "CartPole-v1"}, {"lambda_": [0.9, 0.5], "gamma": [0.5, 0.25]}, (0, 1)))
    for member in sweep.members():
        lambda_, gamma = member.options["lambda_"], member.options["gamma"]
        score = 100 * lambda_ + (10 if gamma == 0.5 else 0) + (1 if member.seed else -1)
        write_run(sweep.path / member.name, member.seed, {200: score}, gamma=gamma, rollout={"lambda_": lambda_})
    return path


def test_runs_by_the_value_of_an_option(tmp_path: Path, capsys: Capture) -> None:
    path = write_options(tmp_path / "sweep")
    groups, _ = read_groups([path])
    assert [len(group.runs) for group in groups] == [2] * 4 and len({group.name for group in groups}) == 4
    found = by_option(groups, "lambda")
    assert [(group.label, group.estimate.iqm, len(group.runs)) for group in found] == [("0.5", 55, 4), ("0.9", 95, 4)]
    scores = [[59, 49], [61, 51]]  # [seed, γ]: each γ has its runs drawn by themselves
    low, high = bootstrap_interval(scores, np.random.default_rng(0))
    assert (found[0].estimate.low, found[0].estimate.high) == (float(low), float(high))
    assert [group.label for group in by_option(groups, "rollout.lambda")] == ["0.5", "0.9"]
    with pytest.raises(ValueError, match="they differ in gamma, lambda"):
        by_option(groups, "alpha")
    assert main(["compare", str(path), "--by", "gamma", "--out", str(tmp_path / "by.svg"), "--json"]) == 0
    assert [group["label"] for group in json.loads(capsys.readouterr().out)["groups"]] == ["0.25", "0.5"]
    assert "Return by gamma" in (tmp_path / "by.svg").read_text()
    assert main(["compare", str(path), "--by", "alpha"]) == 2
    page = write_sweep_report(path).read_text()
    assert page.index("By lambda") < page.index("Learning curves") and "By gamma" in page
    assert page.index("gamma 0.5, lambda 0.9") < page.index("gamma 0.5, lambda 0.5"), "the best is first"
