"""The study of local verdicts: its statistics, training and controls, held to slower ways of saying the same."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from neuralq.lab.networks.expected import expected_backup, expected_td_step

LAYOUTS = ("action-input", "separate", "action-output", "linear")
SCRIPT = Path(__file__).parents[1] / "scripts" / "verdict_study.py"


@pytest.fixture(scope="module")
def study() -> dict[str, Any]:
    """The script's functions."""
    return runpy.run_path(str(SCRIPT))


def test_the_area_is_the_share_of_pairs_in_order_and_its_interval_is_delongs(study: dict[str, Any]) -> None:
    rng = np.random.default_rng(0)
    scores, positive = rng.integers(0, 8, 40).astype(float), rng.random(40) < 0.4  # with ties
    yes, no = scores[positive], scores[~positive]
    wins = np.array([[1.0 if x > y else 0.5 if x == y else 0.0 for y in no] for x in yes])
    half = 1.96 * np.sqrt(np.var(wins.mean(1), ddof=1) / len(yes) + np.var(wins.mean(0), ddof=1) / len(no))
    expected = (wins.mean(), wins.mean() - half, wins.mean() + half)
    assert study["roc"](scores, positive, np.arange(40)) == pytest.approx(expected)
    # What is counted twice, in clusters of two, is known no better than what is counted once.
    twice = study["roc"](np.tile(scores, 2), np.tile(positive, 2), np.tile(np.arange(40), 2))
    assert twice == pytest.approx(expected)
    assert np.isnan(study["roc"](scores, np.arange(40) < 1, np.arange(40))[0])  # one positive says nothing


def test_clusters_that_hold_both_sides_widen_the_interval_as_resampling_them_does(study: dict[str, Any]) -> None:
    rng = np.random.default_rng(1)
    cluster = np.repeat(np.arange(80), 4)
    positive = (rng.random(80) < 0.5)[cluster] ^ (rng.random(320) < 0.2)  # alike within a cluster, as are the scores
    scores = 0.5 * positive + rng.standard_normal(80)[cluster] + 0.3 * rng.standard_normal(320)
    area, low, high = study["roc"](scores, positive, cluster)
    draws = []
    for _ in range(300):
        rows = (4 * rng.integers(80, size=80)[:, None] + np.arange(4)).ravel()
        yes, no = scores[rows][positive[rows]], scores[rows][~positive[rows]]
        draws.append((yes[:, None] > no).mean())
    assert (high - low) / 3.92 == pytest.approx(np.std(draws), rel=0.15)
    alone = study["roc"](scores, positive, np.arange(320))
    assert alone[0] == area and (alone[2] - alone[1]) / (high - low) < 0.75  # clusters are not ignored


@pytest.mark.parametrize("layout", LAYOUTS)
def test_all_at_once_is_the_update_that_the_verdict_speaks_of(
    study: dict[str, Any], layout: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    cases = [study["draw"](seed) for seed in range(3)]
    assert {case.problem.control for case in cases} == {True, False}
    if layout == "linear":
        cases = [study["linear"](case) for case in cases]
    networks = study["starts"](layout, cases, 0)
    monkeypatch.setitem(study["train"].__globals__, "LOOKS", (0, 2))
    trained = study["train"](networks, cases, 2)
    for i, (q, case) in enumerate(zip(networks, cases, strict=True)):
        assert trained.outcome[i] != "diverges"
        for _ in range(2):
            expected_td_step(q, expected_backup(case.problem, case.seen), case.problem.step_size)
        for name, weight in q.named_parameters():
            torch.testing.assert_close(trained.weights[2][name][i], weight.detach(), rtol=1e-9, atol=1e-11)


def test_sampled_errors_are_the_expected_ones_on_average(
    study: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    cases = [study["draw"](seed) for seed in range(3)]
    many = study["_Many"](study["starts"]("separate", cases, 0), cases)
    monkeypatch.setitem(study["train"].__globals__, "BATCH", 40_000)
    q = many.values().detach()
    means = torch.stack([many.sampled(q, np.random.default_rng(seed)) for seed in range(8)])
    error = means.std(0) / np.sqrt(8)
    assert ((means.mean(0) - many.expected(q)).abs() <= 6 * error + 1e-4).all()


def test_the_linear_control_is_told_apart_without_a_miss(
    study: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    cases = [study["linear"](study["draw"](100 + seed)) for seed in range(12)]
    monkeypatch.setitem(study["learn"].__globals__, "LOOKS", (0,))
    rows = study["some"](study["learn"]("linear", cases, 0, 200, lambda: None), updates="expected")
    assert study["areas"](rows)["kernel"] == (1.0, 1.0, 1.0)
    assert {"diverges", "stays"} <= {row["outcome"] for row in rows}
    for row in rows:
        if abs(row["kernel"] - 1) > 0.02:
            assert (row["outcome"] == "diverges") == (row["kernel"] > 1)


@pytest.mark.slow
def test_it_prints_tables_and_draws(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    figure, rows = tmp_path / "verdict.svg", tmp_path / "rows.json"
    given = ["--problems=4", "--updates=30", f"--figure={figure}", f"--out={rows}", "--json"]
    monkeypatch.setattr(sys, "argv", ["verdict_study.py", *given])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("updates, layout, policy") for line in lines)
    found = json.loads(lines[-1])
    assert sum(x["runs"] for x in found["deciles"]["kernel"]) == 12
    kept = json.loads(rows.read_text())
    assert {(row["layout"], row["updates"]) for row in kept} == {
        (x, y) for x in LAYOUTS for y in ("expected", "sampled")
    }
    assert "<title" in figure.read_text()


@pytest.mark.parametrize("wrong", ["--problems=0", "--updates=many", "--figure=/nowhere/verdict.svg"])
def test_what_makes_no_sense_is_refused_before_anything_is_trained(
    wrong: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["verdict_study.py", wrong])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(SCRIPT), run_name="__main__")
    assert ended.value.code == 2 and wrong.split("=")[0] in capsys.readouterr().err
