"""The chapter's pages: every number beside what hand arithmetic or enumeration gives, and what a wrong one does.

Mutants that die here: s_t for s_{t+1} in the recursion · the exponent of k lost · an episode replayed forwards where
backwards is said · north and south swapped in a drawing · a differing number that leaves the exit status 0 · a misprint
taken for the truth · a table written in place · the JSON object not on the last line · an arrow of a bad move drawn as
a good one.
"""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ElementTree
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from neuralq.apps import chapter
from neuralq.apps.chapter import PAGES, run_page
from neuralq.apps.chapter.exercises import exercise_13_2, exercise_13_4
from neuralq.apps.chapter.figures import exercise_13_1, figure_13_2, figure_13_3
from neuralq.apps.chapter.learning import table_13_1
from neuralq.apps.chapter.models import dyna_maze, sweeping
from neuralq.apps.chapter.ordering import episode_update, replaying, update_order
from neuralq.apps.chapter.prediction import lambda_recursion, random_walk_page
from neuralq.apps.chapter.tic_tac_toe import exercise_13_3
from neuralq.apps.cli import main
from neuralq.apps.pages.grids import best_actions
from neuralq.apps.pages.svg import page_svg
from neuralq.apps.pages.text import drawing_lines
from neuralq.runs.report.claims import (
    Arrow,
    ChapterPage,
    Chart,
    GridDrawing,
    Row,
    Series,
    Square,
    claim,
    misprint,
    number,
    own,
)
from neuralq.systems import SYSTEMS

Capture = pytest.CaptureFixture[str]

NAMES = (
    "fig-13.2 fig-13.3 table-13.1 ex-13.1 ex-13.2 ex-13.3 ex-13.4 order replay dyna sweeping td-lambda random-walk"
).split()


def ours(found: ChapterPage, what: str) -> float:
    """The one number of that name."""
    (row,) = [row for row in found.rows if row.what == what]
    assert not isinstance(row.ours, str)
    return row.ours


def test_every_page_is_listed() -> None:
    assert list(PAGES) == NAMES
    with pytest.raises(ValueError, match="page must be one of"):
        run_page("fig-13.9")


def test_figure_13_2_has_the_printed_numbers_and_names_the_misprint() -> None:
    found = figure_13_2()
    assert found.reproduced
    assert [row.ours for row in found.rows[:6]] == pytest.approx([90, 100, 0, 81, 90, 100])
    wrong = {row.what: (row.book, row.ours) for row in found.rows if row.verdict == "misprint"}
    assert wrong == {
        "Q(top left, south)": (72.0, pytest.approx(72.9)),
        "Q(bottom middle, west)": (72.0, pytest.approx(72.9)),
    }
    assert ours(found, "Q(bottom right, west)") == pytest.approx(81)
    assert sum(row.what.startswith("Q(") for row in found.rows) == 12
    values, actions = found.drawings
    assert isinstance(values, GridDrawing) and isinstance(actions, GridDrawing)
    assert [cell.label for cell in values.cells] == ["90", "100", "G", "81", "90", "100"]
    # From the bottom middle: up and right are equally good; only those are drawn.
    assert [arrow.direction for arrow in values.cells[4].arrows] == [0, 1]
    assert actions.cells[4].arrows == (Arrow(0, "90", True), Arrow(1, "90", True), Arrow(3, "72.9", False))


def test_figure_13_3_changes_one_entry() -> None:
    found = figure_13_3()
    assert found.reproduced and ours(found, "Q̂(s₁, right) after") == 90.0
    assert ours(found, "Q̂(s₁, right) before") == 72.9 and ours(found, "entries changed") == 1


def test_exercise_13_1_draws_the_four_policies() -> None:
    found = exercise_13_1()
    assert found.reproduced and ours(found, "optimal policies") == 4
    assert ours(found, "deterministic policies in all") == 2 * 3 * 2 * 3 * 2
    drawn = {tuple(tuple(a.direction for a in cell.arrows) for cell in d.cells) for d in found.drawings}  # type: ignore[union-attr]
    east, north = (1,), (0,)
    assert drawn == {(east, east, (), left, middle, north) for left in (north, east) for middle in (north, east)}


def test_exercise_13_2_is_learned_one_move_an_episode() -> None:
    found = exercise_13_2()
    assert found.reproduced
    assert [ours(found, f"episode {i}: entries changed") for i in (1, 2, 3)] == [1, 1, 1]
    assert ours(found, "episode 1: Q̂(bottom right, west)") == 10
    assert ours(found, "episode 2: Q̂(top right, south)") == 8
    assert ours(found, "episode 3: Q̂(top middle, east)") == pytest.approx(6.4)
    assert [row.ours for row in found.rows[:6]] == [8, 10, 8, 10, 0, 10]
    # One Q changes by the cost of one move; all eleven change when G pays twice as much.
    assert ours(found, "G pays 20: entries of Q that change") == 11
    assert ours(found, "leaving the top middle westwards costs 1: entries of Q that change") == 1


def test_exercise_13_4_finds_one_policy_for_all_starts() -> None:
    found = exercise_13_4(num_models=8)
    assert found.reproduced
    # The contrast: without the state, no policy is best from everywhere in some of them.
    assert ours(found, "models in which no single blind policy is best from every start") > 0


def test_table_13_1_keeps_what_the_text_proves() -> None:
    found = table_13_1(num_seeds=3)
    assert found.reproduced
    assert ours(found, "largest fall of an entry") == 0 and ours(found, "smallest Q̂") == 0
    assert 0 < ours(found, "error after each full round, divided by the error before") <= 0.9 + 1e-12
    # 2¹, 2², 2³ share 2 : 4 : 8.
    assert ours(found, "P(best of 1, 2, 3), k = 2") == pytest.approx(8 / 14)
    learned = found.drawings[1]
    assert isinstance(learned, GridDrawing) and learned.cells == figure_13_2().drawings[1].cells  # type: ignore[union-attr]


def test_order_and_replay() -> None:
    found = update_order(num_seeds=2)
    assert found.reproduced
    assert ours(found, "entries learned in one episode, forwards") == 1
    assert ours(found, "entries learned in one episode, backwards") == 14
    forwards, backwards = found.drawings
    assert isinstance(forwards, GridDrawing) and isinstance(backwards, GridDrawing)
    assert backwards.cells[18].label == "0.513" and forwards.cells[18].label == "S"  # .95¹³
    assert replaying(num_seeds=2).reproduced


def test_the_recursion_needs_the_next_state() -> None:
    found = lambda_recursion()
    assert found.reproduced
    # λ = .7 with V̂ = 60, 80, 60, 80 after the moves, γ = .9, reward 100 at the fifth, term by term:
    returns = [0.9 * 60, 0.9**2 * 80, 0.9**3 * 60, 0.9**4 * 80, 0.9**4 * 100]
    total = 0.3 * sum(0.7**n * value for n, value in enumerate(returns[:4])) + 0.7**4 * returns[4]
    assert ours(found, "λ = 0.7: recursion with max Q̂(s_t+1, ·), against the sum") == pytest.approx(total)
    (printed,) = [r for r in found.rows if r.what == "λ = 0.7: recursion with max Q̂(s_t, ·), as printed"]
    assert printed.verdict == "misprint" and abs(float(printed.book) - total) > 1


def test_random_walk_values() -> None:
    found = random_walk_page(num_sets=20)
    assert [row.ours for row in found.rows[:5]] == pytest.approx(np.arange(1, 6) / 6)
    chart = found.drawings[1]
    assert isinstance(chart, Chart) and chart.series[3].name == "λ = 1"
    assert min(chart.series[3].y) > 1.3 * min(chart.series[1].y)


def test_planning_pages() -> None:
    found = sweeping(num_seeds=4)
    assert found.reproduced and ours(found, "median updates of Dyna, divided by prioritized sweeping's") > 3


@pytest.mark.slow
@pytest.mark.parametrize("page", [dyna_maze, exercise_13_3, random_walk_page, sweeping, replaying, update_order])
def test_the_long_pages_are_reproduced_in_full(page: object) -> None:
    assert callable(page)
    found = page()
    assert found.reproduced, [row for row in found.rows if row.verdict == "differs"]


# Verdicts, drawings and the command.


def test_verdicts() -> None:
    assert number("", 1.0, 1.0 + 1e-12).verdict == "agrees" and number("", 1.0, 1.1).verdict == "differs"
    assert number("", 1.0, float("nan")).verdict == "differs"
    assert claim("", "few", 9.0, False).verdict == "differs"
    # A misprint is one only while ours is right and the printed number is not ours.
    assert misprint("", 72.0, 72.9, 72.9, "").verdict == "misprint"
    assert misprint("", 72.0, 72.9, 72.0, "").verdict == "differs"
    assert misprint("", 72.9, 72.9, 72.9, "").verdict == "differs"
    assert misprint("", 72.0, 72.9, 80.0, "").verdict == "differs"
    fine = ChapterPage("p", "t", "s", (), (own("", 1.0), misprint("", 72.0, 72.9, 72.9, "")))
    assert fine.reproduced
    assert not ChapterPage("p", "t", "s", (), (*fine.rows, number("", 1.0, 2.0))).reproduced


def test_a_grid_as_text() -> None:
    grid = GridDrawing("a title", 2, (Square("", (Arrow(1, "9"), Arrow(2, "8", False))), Square(wall=True)))
    assert drawing_lines(grid) == [
        "a title",
        "┌───────────┬───────────┐",
        "│           │███████████│",
        "│       →9* │███████████│",
        "│     ↓8    │███████████│",
        "└───────────┴───────────┘",
    ]


def test_the_best_actions_of_a_drawing_do_not_depend_on_the_unit_of_rewards() -> None:
    # A tie but for rounding, a second best by one part in a thousand, and a state that is worth nothing.
    values = np.array([[1 / 3, 1 / 3 * (1 + 2e-16), np.nan, 1 / 3 * 0.999], [0.0, 0.0, 0.0, np.nan]])
    for unit in (1e-200, 1e-12, 1.0, 1e12, 1e200):
        assert best_actions(unit * values).tolist() == [[True, True, False, False], [True, True, True, False]]
    assert best_actions([[-np.inf, np.nan]]).tolist() == [[False, False]]
    assert best_actions([[1e12, 2.0], [1.0, 2.0]], tol=1e-11).tolist() == [[True, False], [True, True]]  # 10 apart


def test_a_chart_as_text() -> None:
    chart = Chart("t", "x", "y", (Series("up", (0.0, 1.0), (1.0, 3.0)), Series("flat", (0.0, 1.0), (1.0, 1.0))))
    assert drawing_lines(chart) == ["t", "y, by x 0 … 1", "  up ▁█  1 → 3", "flat ▁▁  1 → 1"]


def test_an_arrow_points_where_it_says() -> None:
    svg = page_svg(ChapterPage("p", "t", "s", (), (), (GridDrawing("g", 1, (Square("5", (Arrow(0),)),)),)))
    tree = ElementTree.fromstring(svg)
    (stroke,) = [path for path in tree.iter("{http://www.w3.org/2000/svg}path") if path.get("stroke")]
    start, end = (tuple(map(float, point.split())) for point in str(stroke.get("d"))[1:].split("L"))
    assert start[0] == end[0] and end[1] < start[1]  # upwards: y grows downwards


def test_the_command_lists_and_runs_pages(tmp_path: Path, capsys: Capture) -> None:
    assert main(["chapter"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in out if line[:1].isdigit()] == [f"13.{i}" for i in range(1, 9)]
    assert {line.split()[0] for line in out if line[:2] == "  " and "neuralq " not in line} == {*NAMES, *SYSTEMS}
    assert main(["chapter", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert list(listed["pages"]) == NAMES and list(listed["systems"]) == list(SYSTEMS)
    assert all(entry.seconds >= 5 for entry in SYSTEMS.values()), "a system says what it takes"
    path, page = tmp_path / "grid.svg", tmp_path / "grid.html"
    assert main(["chapter", "fig-13.2", "--svg", str(path), "--html", str(page)]) == 0
    html = page.read_text()
    assert "V* and every optimal move" in html and "✓ agrees" in html and html.count("<svg") == 1
    out = capsys.readouterr().out
    assert "72.9" in out and "misprint" in out and "│ 81 ↑→ │ 90 ↑→ │ 100 ↑ │" in out
    texts = ["".join(element.itertext()) for element in ElementTree.parse(path).iter()]
    assert "72.9" in texts and "V* and every optimal move" in texts
    assert main(["chapter", "td-lambda", "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["reproduced"] is True and {"what", "book", "ours", "verdict", "note"} == set(result["rows"][0])


def test_a_number_that_is_not_reproduced_ends_with_status_1(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    def broken() -> ChapterPage:
        return ChapterPage("fig-13.3", "t", "s", (), (Row("V*", 90.0, 91.0, "differs"),))

    monkeypatch.setattr("neuralq.apps.chapter.figures.figure_13_3", broken)
    assert chapter.run_page("fig-13.3").rows[0].ours == 91.0
    assert main(["chapter", "fig-13.3", "--json"]) == 1
    captured = capsys.readouterr()
    assert json.loads(captured.out.splitlines()[-1])["reproduced"] is False
    assert captured.err.strip() == "neuralq: fig-13.3: not reproduced: V*"


def test_wrong_usage(capsys: Capture) -> None:
    assert main(["chapter", "--svg", "x.svg"]) == 2
    assert "need a name" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["chapter", "fig-13.9"])


def test_every_page_has_a_drawing_and_an_explanation() -> None:
    for page in (figure_13_3, exercise_13_1, exercise_13_2, lambda_recursion):
        found = page()
        ElementTree.fromstring(page_svg(found))
        assert found.text and all(paragraph.endswith(".") for paragraph in found.text)


# --------------------------------------------------------------------------------- the order of updates in an episode

forwards, backwards = (partial(episode_update, backwards=order) for order in (False, True))
PATH = torch.tensor([0, 1, 2])
RIGHT = torch.tensor([0, 0, 0])
REWARDS = torch.tensor([0.0, 0.0, 100.0])
CORRIDOR = (PATH, RIGHT, REWARDS, torch.tensor([0.9, 0.9, 0.0]), PATH + 1)


def test_reverse_order_carries_the_reward_along_the_whole_path() -> None:
    """Mitchell 13.3.6: backwards one episode fills the path (100, 90, 81), forwards it moves one entry per episode."""
    table = torch.zeros(4, 1)
    assert backwards(table, *CORRIDOR)[:, 0].tolist() == pytest.approx([81, 90, 100, 0])
    seen = []
    for _ in range(3):
        table = forwards(table, *CORRIDOR)
        seen.append(table[:3, 0].tolist())
    assert seen[0] == pytest.approx([0, 0, 100])
    assert seen[1] == pytest.approx([0, 90, 100])
    assert seen[2] == pytest.approx([81, 90, 100])


def test_step_size_by_hand() -> None:
    """α = ½ from zeros: 50; then ½·.9·50 = 22.5; then ½·.9·22.5 = 10.125. The table handed in is not written."""
    table = torch.zeros(4, 1)
    assert backwards(table, *CORRIDOR, step_size=0.5)[:, 0].tolist() == [10.125, 22.5, 50.0, 0.0]
    assert table.eq(0).all()


def test_a_repeated_pair_is_updated_twice_and_illegal_actions_stay() -> None:
    """The loop 0 → 0 → goal: backwards first q = 10, then 1 + .5·10 = 6 overwrites it; forwards the other way round."""
    table = torch.tensor([[0.0, -math.inf], [-math.inf, -math.inf]])
    twice = torch.tensor([0, 0])
    episode = (twice, twice, torch.tensor([1.0, 10.0]), torch.tensor([0.5, 0.0]), torch.tensor([0, 1]))
    assert backwards(table, *episode).tolist() == [[6.0, -math.inf], [-math.inf, -math.inf]]
    assert forwards(table, *episode).tolist() == [[10.0, -math.inf], [-math.inf, -math.inf]]


def test_order_rules_are_differentiable() -> None:
    table = torch.rand(4, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    episode = tuple(x.double() if x.is_floating_point() else x for x in CORRIDOR)
    assert torch.autograd.gradcheck(lambda q: backwards(q, *episode, 0.5), (table,))


def test_an_episode_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="one episode"):
        backwards(torch.zeros(4, 1), *(x[:, None] for x in CORRIDOR))
    with pytest.raises(ValueError, match="step_size must lie"):
        backwards(torch.zeros(4, 1), *CORRIDOR, step_size=2.0)
    with pytest.raises(ValueError, match="s_t must have the shape"):
        backwards(torch.zeros(4, 1), *CORRIDOR[:4], PATH[:2])
