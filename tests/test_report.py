"""Reports: well-formed pages that load nothing, the right numbers in the drawing, and inputs of every unpleasant kind.

Planted mutants that these tests kill: ids not prefixed; `href` or `url(#…)` left pointing at the old id; the SVG's
style rule left global; the user's matplotlib settings let in; text not escaped; the first row of a repeated step kept;
a torn last line not forgiven or a torn middle line forgiven; the quartiles replaced by the extremes; the prediction
drawn from g·e₀ or with gⁿ in plain float64; null taken for zero; an axis up to 10³⁰⁰, whose ticks overflow.
"""

from __future__ import annotations

import base64
import builtins
import io
import json
import math
import re
import sys
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import gymnasium as gym
import numpy as np
import pytest
import torch
from PIL import Image

import neuralq
from neuralq.apps.cli import main
from neuralq.apps.pages import star
from neuralq.apps.pages.star import divergence_svg, growth_table, values_table, write_demo_report
from neuralq.checks import MissingExtra
from neuralq.learners import RolloutSettings
from neuralq.mdp import FiniteMDP
from neuralq.runs import RunConfig
from neuralq.runs.folder.files import RunFolderError
from neuralq.runs.recipe.config import config_to_dict
from neuralq.runs.report import (
    learning_curve_svg,
    read_rows,
    signals_svg,
    write_report,
)
from neuralq.runs.report.grid import grid_svg
from neuralq.runs.report.readings import finite_series, first_not_finite, quartiles, standard_errors, thin
from neuralq.runs.sweep import create_sweep

VOID = {"meta", "br", "link", "img", "hr", "input"}


class Outline(HTMLParser):
    """Checks that tags balance and collects ids, references, links and text."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.outside: list[tuple[str, str]] = []
        self.text = ""
        self.feed(page)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            value = value or ""
            if name == "id":
                self.ids.append(value)
            if name in {"href", "xlink:href"} and value.startswith("#"):
                self.references.append(value[1:])
            elif name in {"href", "src", "xlink:href", "action", "srcset"}:
                self.outside.append((name, value))
            if name.startswith("on"):
                self.outside.append((name, value))
            if name == "aria-labelledby":
                self.references += value.split()
            self.references += re.findall(r"url\(#([^)]+)\)", value)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data: str) -> None:
        self.text += data


def check_page(page: str) -> Outline:
    outline = Outline(page)
    assert page.startswith("<!DOCTYPE html>\n<html lang=")
    assert len(outline.ids) == len(set(outline.ids))
    assert set(outline.references) <= set(outline.ids)
    assert not outline.outside
    assert not {"script", "link", "img", "iframe", "object", "embed", "base"} & set(outline.tags)
    assert "@import" not in page and not re.findall(r"url\((?!#)", page)
    assert set(re.findall(r"https?://[^\"'\s<]+", page)) <= {"http://www.w3.org/2000/svg"}
    assert 'name="viewport"' in page and "default-src 'none'" in page
    return outline


def check_fragment(fragment: str) -> Outline:
    outline = Outline(fragment)
    assert set(outline.references) <= set(outline.ids)
    return outline


@dataclass(frozen=True)
class Result:
    representation: str
    predicted_growth: float
    prediction_scope: str
    verdict: str
    measured_growth: float
    steps: int | np.ndarray[Any, Any]
    rmsve: np.ndarray[Any, Any]
    values: np.ndarray[Any, Any]
    exact_values: np.ndarray[Any, Any]


def result(name: str = "linear", growth: float = 1.01, **changes: Any) -> Result:
    steps = np.arange(0, 101, 10)
    made = Result(name, growth, "global", "diverges", growth, steps, 2.0 * growth**steps, np.arange(7.0), np.zeros(7))
    return replace(made, **changes)


def train_row(steps: int, **columns: Any) -> dict[str, Any]:
    return {"kind": "train", "env_steps": steps, "episode_return": 10.0, "loss": 0.5, "max_q": 3.0} | columns


def evaluation_row(steps: int, returns: list[float]) -> dict[str, Any]:
    return {"kind": "evaluation", "env_steps": steps, "greedy_return": float(np.mean(returns)), "returns": returns}


ROWS = [train_row(64, abs_td_error=0.4), train_row(128), evaluation_row(128, [1.0, 2.0, 3.0, 4.0, 5.0]), train_row(192)]


def make_run(folder: Path, rows: list[dict[str, Any]], config: dict[str, Any] | None = None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (folder / "config.json").write_text(json.dumps(config or {"env_id": "CartPole-v1", "learner": {"lambda_": 0.85}}))
    (folder / "versions.json").write_text(json.dumps({"torch": "2.13.0"}))
    return folder


def test_a_run_becomes_one_page_with_its_facts(tmp_path: Path) -> None:
    run = make_run(
        tmp_path, ROWS, {"env_id": "CartPole-v1", "train": {"stop_at_return": 2.5}, "learner": {"lambda_": 0.85}}
    )
    (run / "summary.json").write_text(
        json.dumps({"env_steps": 40960, "greedy_return": 481.5, "parameters_sha256": "ab" * 32})
    )
    path = write_report(run)
    assert path == run / "report.html"
    outline = check_page(path.read_text(encoding="utf-8"))
    assert outline.tags.count("svg") == 2
    for words in ("CartPole-v1", "40,960", "481.5", "ab" * 32, "learner.lambda_", "0.85", "2.13.0"):
        assert words in outline.text
    assert "The target of 2.5 was first reached at 128." in outline.text
    assert not list(run.glob("*.partial")) and not list(run.glob(".*.partial"))


EXACT = {
    "q_error_max": 0.5, "q_error_mean": 0.25, "q_error_max_all": 2.0, "q_error_mean_all": 1.0, "regret": 3.0,
    "optimal_share": 0.75, "optimal_share_all": 0.5, "start_value": 4.0, "exact_start_value": 5.0,
}  # fmt: skip
GRID = {
    "num_columns": 2, "signs": ["", "H", "", "G"], "arrows": [2, None, 1, None], "optimal": [True, None, False, None],
    "learned": [1.0, None, 2.5, None], "error": [0.5, None, 0.0, None], "visited": [True, False, False, False],
}  # fmt: skip


def test_the_page_begins_with_what_a_person_wants(tmp_path: Path) -> None:
    run = make_run(tmp_path, [train_row(64), evaluation_row(64, [9.0]), evaluation_row(128, [0.0, 1.0, 1.0, 0.0])])
    off = {
        "agent": "best", "final_return": 0.5, "best_return": 9.0, "num_episodes": 100, "standard_error": 0.125,
        "best_standard_error": 0.25, "final_standard_error": 0.75,
    }  # fmt: skip
    monitor = {"alarms": [{"kind": "soft divergence"}], "seen": "It grew.", "advice": ["a target network"]}
    (run / "summary.json").write_text(
        json.dumps({"exact": EXACT, "play_off": off, "monitor": monitor, "env_steps": 128})
    )
    (run / "exact.json").write_text(json.dumps(GRID))
    text = check_page(page := write_report(run).read_text()).text
    error = math.sqrt(1 / 3) / 2  # of two zeros and two ones
    for words in (
        "kept scores 9 ± 0.25 per episode (the best parameters, 100 fresh episodes", "return of the agent9 ± 0.25",
        f"last evaluation0.5 ± {error:.2g}", "4 episodes at 128 steps", "at 64 steps", "exactly 5", "soft divergence",
        "the last parameters score 0.500, the best 9.0, ± 0.12 between them: the best are the run's agent",
        "Value of the start 4.0, exactly 5.0; the greedy policy earns 3 less",
        "the largest |Q − Q*| over its actions",
        "It grew. What may help: a target",
    ):  # fmt: skip
        assert words in text, words
    rows = re.findall(r"<th scope=\"row\">([^<]*)</th><td>([^<]*)</td><td>([^<]*)</td>", page)
    assert ("mean |Q − Q*|", "0.25", "1") in rows and ("states with an optimal action", "75%", "50%") in rows
    assert 'id="grid"' in page and "errors up to 0.5." in text and "data:" not in page
    assert (
        page.index("9 ± 0.25")
        < page.index("0.5 ±")
        < page.index("Learning curve")
        < page.index("Everything that was recorded")
    )


def test_a_summary_that_the_run_has_gone_beyond_is_not_told(tmp_path: Path) -> None:
    run = make_run(tmp_path, [evaluation_row(128, [1.0]), evaluation_row(256, [3.0])])
    off = {"agent": "best", "best_return": 9.0, "num_episodes": 100, "standard_error": 0.125, "final_return": 1.0}
    for steps, told in (128, False), (256, True):
        (run / "summary.json").write_text(json.dumps({"play_off": off, "env_steps": steps}))
        text = check_page(write_report(run).read_text()).text
        assert ("return of the agent9" in text) == told and ("return per episode3" in text) == (not told)


def test_a_map_shows_the_error_of_action_values_and_scrolls_where_it_is_wide() -> None:
    from neuralq.exact import solve
    from neuralq.runs.beside import Beside
    from neuralq.runs.stream import Interaction, make_vector_env

    env = gym.make("CliffWalking-v1")
    envs = make_vector_env(lambda: env, 1)
    beside = Beside.of(envs, Interaction(envs, 1.0, 0, as_index=True).spec, 1.0)
    assert beside is not None
    q = solve(FiniteMDP.from_gymnasium(env), 1.0).q + np.array([0.25, -0.5, 0.0, 0.0])
    held = beside.held(torch.from_numpy(q).__getitem__, 1.0)
    assert held is not None
    drawing = held.drawing()
    assert drawing is not None and drawing["visited"] is None  # nobody watched
    errors = [x for x in drawing["error"] if x is not None]
    assert len(errors) == 37 and errors == pytest.approx([0.5] * 37)  # of up and right, the larger
    found = grid_svg(drawing)
    assert found is not None and "min-width:552px" in found[0] and "errors up to 0.5." in found[0]
    assert "never visited" not in found[1] and "never visited" in grid_svg(GRID)[1]  # type: ignore[index]


def test_changes_of_a_resumed_run_are_told_and_marked(tmp_path: Path) -> None:
    run = make_run(tmp_path, ROWS)
    before = write_report(run).read_text()
    change = {"env_steps": 128, "time": "now", "changes": {"rollout.learning_rate": [0.01, 0.5]}}
    damaged = [{"env_steps": 64}, {"env_steps": 96, "changes": {"gamma": 1}}]
    (run / "changes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in [change, *damaged]))
    text = check_page(page := write_report(run).read_text()).text
    assert "Changed at 128 environment steps: rollout.learning_rate 0.01 → 0.5; what is learned" in text
    assert text.lower().count("changed at") == 1
    assert len(re.findall("#009e73", page)) > len(re.findall("#009e73", before))  # the mark's colour


def test_a_film_stands_in_the_page_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = str(tmp_path / "run")
    words = "--learner tabular --total-steps 300 --evaluation-episodes 1 --evaluation-max-steps 40 --monitor false"
    assert main(["train", "neuralq/MitchellGrid-v0", *words.split(), "--run-dir", run]) == 0
    page = (tmp_path / "run" / "report.html").read_text()  # of our own environments unasked
    films = re.findall(r'<img src="data:image/png;base64,([^"]+)" alt="([^"]+)">', page)
    assert 2 <= len(films) <= 8 and films[0][1].startswith("step 0 · return 0") and films[-1][1].endswith("the end")
    assert "img-src data:" in page and not re.findall(r"https?://(?!www.w3.org/2000/svg)", page)
    for png, _ in films:
        with Image.open(io.BytesIO(base64.b64decode(png))) as image:
            assert image.format == "PNG" and image.width == 144  # 48 pixels a cell, 3 columns
    first, second = (np.asarray(Image.open(io.BytesIO(base64.b64decode(films[i][0]))).convert("L")) for i in (0, -1))
    assert (first != second).any()
    assert main(["report", run, "--no-film"]) == 0
    assert "<img" not in check_page((tmp_path / "run" / "report.html").read_text()).text
    assert "img-src" not in (tmp_path / "run" / "report.html").read_text()


def test_a_band_of_zeros_and_ones_is_their_standard_error(tmp_path: Path) -> None:
    chances, scores = [evaluation_row(64, [0.0, 1.0, 1.0])], [evaluation_row(64, [0.0, 1.0, 2.0])]
    steps, low, high = standard_errors(chances)
    assert steps.tolist() == [64.0] and (high - low)[0] == pytest.approx(2 * math.sqrt(1 / 3) / math.sqrt(3))
    assert "standard error wide" in check_page(write_report(make_run(tmp_path / "a", chances)).read_text()).text
    assert "middle half" in check_page(write_report(make_run(tmp_path / "b", scores)).read_text()).text


@pytest.mark.parametrize("change", [{"num_columns": 3}, {"num_columns": 0}, {"signs": 1}, {"learned": [1.0]}])
def test_a_map_that_is_none_is_left_out(change: dict[str, Any]) -> None:
    assert grid_svg(GRID) is not None and grid_svg({**GRID, **change}) is None


@pytest.mark.parametrize("value", [None, "text", [1], {}, math.nan, 1e400, True], ids=lambda value: str(value)[:6])
def test_a_summary_of_unpleasant_values_is_shown_as_far_as_it_goes(value: Any, tmp_path: Path) -> None:
    run = make_run(tmp_path, ROWS)
    exact, off = dict.fromkeys(EXACT, value), dict.fromkeys(("agent", "final_return", "best_return"), value)
    monitor = {"alarms": value, "seen": value, "advice": value}
    summary = {"exact": exact, "play_off": off, "monitor": monitor, "env_steps": value, "stopped_by": value}
    (run / "summary.json").write_text(json.dumps(summary))
    (run / "exact.json").write_text(json.dumps({**GRID, "learned": [value] * 4, "arrows": [value] * 4}))
    check_page(write_report(run).read_text())


def test_a_sweep_has_a_page_whose_seeds_lead_to_theirs(tmp_path: Path) -> None:
    settings = RolloutSettings(num_envs=2, num_steps=16)
    config = RunConfig(env="CartPole-v1", total_steps=64, evaluation_episodes=2, rollout=settings)
    create_sweep(tmp_path / "s", config_to_dict(config), (0, 1))
    for seed in (0, 1):
        neuralq.train(replace(config, seed=seed), tmp_path / "s" / f"seed-{seed}")
        assert main(["report", str(tmp_path / "s" / f"seed-{seed}")]) == 0
    assert main(["report", str(tmp_path / "s")]) == 0
    page = (tmp_path / "s" / "report.html").read_text()
    outline = Outline(page)
    assert "CartPole-v1: 2 seeds" in outline.text and page.count("<svg") == 1
    assert "none was chosen. Rollout, layout action-output, γ = 0.99." in outline.text
    assert "return of the agent" in outline.text
    assert outline.outside == [("href", f"seed-{n}/report.html") for n in (0, 1)]
    assert '<a href="seed-1/report.html">seed 1</a>' in page


def test_the_same_run_gives_the_same_bytes_whatever_the_users_matplotlib_settings(tmp_path: Path) -> None:
    import matplotlib

    first = write_report(make_run(tmp_path, ROWS)).read_bytes()
    with matplotlib.rc_context({"font.size": 31, "svg.fonttype": "none", "axes.grid": False}):
        assert write_report(tmp_path).read_bytes() == first
    assert not re.search(rb"<dc:date>|20\d\d-\d\d-\d\dT", first)


def test_a_run_that_has_not_logged_yet_and_one_without_config(tmp_path: Path) -> None:
    outline = check_page(write_report(make_run(tmp_path / "empty", [])).read_text())
    assert "No greedy evaluation has been recorded yet." in outline.text and outline.tags.count("svg") == 1
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "metrics.jsonl").write_text("")
    assert "Not recorded." in check_page(write_report(bare).read_text()).text
    with pytest.raises(FileNotFoundError, match=r"no run folder: it holds none of metrics\.jsonl"):
        write_report(tmp_path / "nowhere")


HOSTILE = "</title><script>alert('x')</script>&\"$\\frac$"


def test_every_text_is_escaped(tmp_path: Path) -> None:
    rows = [train_row(64), evaluation_row(64, [1.0])]
    run = make_run(tmp_path / "run", rows, {"env_id": HOSTILE, HOSTILE: HOSTILE, "list": [HOSTILE]})
    (run / "summary.json").write_text(json.dumps({HOSTILE: HOSTILE, "lone surrogate": "\ud800"}))
    assert HOSTILE in check_page(write_report(run).read_text()).text
    page = write_demo_report(tmp_path / "demo.html", rows, {HOSTILE: HOSTILE}, [result(HOSTILE, verdict=HOSTILE)])
    assert HOSTILE in check_page(page.read_text()).text


@pytest.mark.parametrize(
    "huge",
    [
        *(-1e300, math.nan, 10**400, "text"),
        *(pytest.param(value, marks=pytest.mark.slow) for value in (1.7e308, -math.inf, None, True, [1])),
    ],
    ids=lambda value: str(value)[:9],
)
def test_unpleasant_values_are_drawn_or_left_out(tmp_path: Path, huge: Any) -> None:
    columns = dict.fromkeys(("episode_return", "loss", "max_q", "abs_td_error"), huge)
    evaluation = {"kind": "evaluation", "env_steps": 96, "greedy_return": huge, "returns": [huge, 0.0]}
    rows = [train_row(32), train_row(64, **columns), evaluation, evaluation_row(128, [5.0]), train_row(128)]
    outline = check_page(write_report(make_run(tmp_path, rows)).read_text())
    diverged = isinstance(huge, float | int) and not isinstance(huge, bool) and not abs(huge) <= sys.float_info.max
    assert ("At 64 environment steps the largest Q was not a finite number" in outline.text) == diverged


def test_demo_page_holds_both_figures_and_both_tables(tmp_path: Path) -> None:
    results = [result("table", 0.99, verdict="converges"), result("linear", 1.0023925), result("separate", 1.02)]
    results[2] = replace(results[2], prediction_scope="local")
    path = write_demo_report(tmp_path / "deep" / "report.html", ROWS, {"greedy_return": 480.25, "target": 475}, results)
    outline = check_page(path.read_text(encoding="utf-8"))
    assert outline.tags.count("svg") == 2 and outline.tags.count("table") == 3
    for words in ("1.0023925", "near the start", "everywhere", "greedy return", "480.25", "Target 475"):
        assert words in outline.text


def test_figures_are_standalone_xml_with_title_and_description() -> None:
    signals = signals_svg(ROWS)
    assert signals is not None and signals_svg([]) is None
    for svg in (learning_curve_svg(ROWS, 475.0), signals, divergence_svg([result()]), learning_curve_svg([])):
        root = ElementTree.fromstring(svg)
        assert root.tag == "{http://www.w3.org/2000/svg}svg" and root.get("role") == "img"
        assert root.get("width") is None and len((root.get("viewBox") or "").split()) == 4
        assert [child.tag.rsplit("}")[-1] for child in root][:2] == ["title", "desc"]
        assert all(rule.startswith("#") for rule in re.findall(r"<style[^>]*>\s*([^{]*)\{", svg))
    assert "at 128; best 3 at 128. Target 475" in learning_curve_svg(ROWS, 475.0)


def test_two_figures_of_one_kind_can_share_a_page() -> None:
    page = learning_curve_svg(ROWS, name="one") + learning_curve_svg(ROWS, name="two")
    ids = Outline(page).ids
    assert len(ids) == len(set(ids)) > 20 and set(Outline(page).references) <= set(ids)


def test_series_keep_finite_numbers_in_order_and_the_later_of_two_rows() -> None:
    rows = [train_row(30, loss=3.0), train_row(10, loss=9.0), train_row(20, loss=None), train_row(10, loss=1.0)]
    rows += [
        train_row(40, loss=math.nan),
        {"kind": "train", "loss": 7.0},
        {"kind": "evaluation", "env_steps": 5, "loss": 5.0},
    ]
    steps, losses = finite_series(rows, "train", "loss")
    assert steps.tolist() == [10, 30] and losses.tolist() == [1, 3]
    assert first_not_finite(rows, "train", "loss") == 40 and first_not_finite(rows, "train", "max_q") is None


def test_quartiles_by_hand() -> None:
    # of 0, 4, 8, 12, 16 a quarter lies at or below 4 and a quarter at or above 12
    steps, low, high = quartiles(
        [evaluation_row(7, [16.0, 0.0, 8.0, 4.0, 12.0]), {"kind": "evaluation", "env_steps": 9}]
    )
    assert (steps.tolist(), low.tolist(), high.tolist()) == ([7], [4], [12])


def test_thinning_keeps_ends_and_spikes() -> None:
    rng = np.random.default_rng(0)
    x, y = np.arange(50_000.0), rng.normal(size=50_000)
    y[31_234], y[7] = 99.0, -99.0
    few_x, few_y = thin(x, y)
    assert len(few_x) <= 1202 and (np.diff(few_x) > 0).all()
    assert (few_x[0], few_x[-1], few_y.max(), few_y.min()) == (0, 49_999, 99, -99)
    np.testing.assert_array_equal(few_y, y[few_x.astype(int)])


def test_a_torn_last_line_is_forgiven_and_a_torn_middle_line_named(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"env_steps": 1}\n\n{"env_steps": 2}\n{"env_st')
    assert [row["env_steps"] for row in read_rows(path)] == [1, 2]
    path.write_text('{"env_steps": 1}\n{"env_st\n{"env_steps": 3}\n')
    with pytest.raises(RunFolderError, match=r"metrics\.jsonl, line 2, is no row of metrics"):
        read_rows(path)
    (tmp_path / "config.json").write_text("[1]")
    path.write_text("")
    with pytest.raises(RunFolderError, match=r"config\.json is damaged: it must hold a JSON object, got list"):
        write_report(tmp_path)
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(RunFolderError, match=r"config\.json is damaged"):
        write_report(tmp_path)


def test_the_prediction_starts_at_the_first_error_and_multiplies_every_step() -> None:
    # e₀ = 2, g = 1.5, steps 3, 4, 6: 2, 3, 6.75
    steps = np.array([3, 4, 6])
    drawn = star._predicted(result(growth=1.5, steps=steps, rmsve=np.array([2.0, 9.0, 9.0])))
    np.testing.assert_allclose(drawn, [2.0, 3.0, 6.75], rtol=1e-12)
    counted = star._predicted(result(growth=1.5, steps=2, rmsve=np.array([2.0, 9.0, 9.0])))
    np.testing.assert_allclose(counted, [2.0, 3.0, 4.5], rtol=1e-12)  # only their number: before and after each sweep
    far = star._predicted(result(growth=10.0, steps=np.array([0, 100, 900]), rmsve=np.ones(3)))
    np.testing.assert_allclose(far[:2], [1.0, 1e100])
    assert math.isnan(far[2])


@pytest.mark.parametrize(
    "changes",
    [
        {"rmsve": np.r_[1.0, np.full(10, math.inf)]},
        {"rmsve": np.geomspace(1e-290, 1e300, 11)},
        {"predicted_growth": math.nan, "measured_growth": math.nan},
        {"steps": np.empty(0), "rmsve": np.empty(0)},
        pytest.param({"rmsve": np.full(11, 1e300)}, marks=pytest.mark.slow),
        pytest.param({"rmsve": np.r_[math.nan, np.ones(10)]}, marks=pytest.mark.slow),
        pytest.param({"rmsve": np.zeros(11)}, marks=pytest.mark.slow),
        pytest.param({"predicted_growth": math.inf}, marks=pytest.mark.slow),
        pytest.param({"predicted_growth": 0.0}, marks=pytest.mark.slow),
    ],
    ids=range(9),
)
def test_divergence_figures_survive_every_blow_up(changes: dict[str, Any]) -> None:
    results = [result("table", 0.9), result("network", **changes)]
    assert len(check_fragment(divergence_svg(results)).ids) > 20
    assert "network" in growth_table(results)


def test_tables_put_exact_beside_learned_and_predicted_beside_measured() -> None:
    exact, learned = np.array([0.0, 1.0]), np.array([2.5, -3.5])
    table = values_table(
        [result("a", values=learned, exact_values=exact), result("b", values=exact, exact_values=exact)]
    )
    assert re.findall(r"<t[hd](?: [^>]*)?>([^<]*)<", table) == [
        "state",
        "exact",
        "a",
        "b",
        "0",
        "0",
        "2.5",
        "0",
        "1",
        "1",
        "-3.5",
        "1",
    ]
    cells = re.findall(r"<td>([^<]*)<", growth_table([result("a", 1.0023925, measured_growth=1.0024)]))
    assert cells[:4] == ["1.0023925", "everywhere", "diverges", "1.0024"]
    assert "state" in values_table([])
    assert len(check_fragment(divergence_svg([])).ids) > 2


def test_without_matplotlib_one_error_names_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, module)
    real = builtins.__import__

    def refuse(name: str, *rest: Any) -> Any:
        if name.split(".")[0] == "matplotlib":
            raise ModuleNotFoundError("No module named 'matplotlib'", name="matplotlib")
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(MissingExtra, match=r'pip install "neuralq\[plot\]"'):
        write_report(make_run(tmp_path, ROWS))
    assert not (tmp_path / "report.html").exists()
