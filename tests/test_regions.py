"""Region-based dynamic programming against Bellman-Ford on the moves themselves, its mazes, and what its page may say.

Mutants that die here: a region moved the wrong way or by two, regions taken in the order in which they were found, a
part that was reached cheaper meanwhile regressed once more, boxes that overlap or leave cells out, illegal states that
get a value, slides that stop a cell early or where no wall is, a ratio upside down, a claim that ignores its bound.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest

from neuralq.systems import run_system, system_named
from neuralq.systems.regions import mazes, oracle, system
from neuralq.tabular.regions import Region, RegionOperator, cover, region_dp
from neuralq_envs.slide_maze import SlideMaze, draw_maze, successors


def by_definition(legal: np.ndarray, goal: Region, moves: list[tuple[tuple[int, ...], float]]) -> np.ndarray:
    """Costs by sweeps over all states until nothing changes; a move off the grid or onto what is illegal stays."""
    costs = np.full(legal.shape, np.inf)
    costs[goal] = np.where(legal[goal], 0.0, np.inf)
    for _ in range(legal.size):
        before = costs.copy()
        for s in np.argwhere(legal):
            for move, cost in moves:
                s_t = s + move
                if (s_t >= 0).all() and (s_t < legal.shape).all() and legal[tuple(s_t)]:
                    costs[tuple(s)] = min(costs[tuple(s)], cost + costs[tuple(s_t)])
        if np.array_equal(before, costs):
            return costs
    raise AssertionError("still changing")


def translation(shape: tuple[int, ...], move: tuple[int, ...], cost: float) -> RegionOperator:
    def regress(region: Region) -> list[Region]:
        sides = zip(region, move, shape, strict=True)
        return [tuple(slice(max(side.start - by, 0), min(side.stop - by, size)) for side, by, size in sides)]

    return RegionOperator(cost, regress)


@pytest.mark.parametrize("shape", [(40,), (9, 12), (4, 5, 6)])
def test_regions_have_the_values_of_single_states(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(len(shape))
    for _ in range(4):
        legal = rng.random(shape) > 0.15
        goal = tuple(slice(int(i), int(i) + 2) for i in rng.integers(0, np.array(shape) - 1))
        legal[goal] = True
        moves = [(tuple(int(by) for by in rng.integers(-2, 3, len(shape))), float(cost)) for cost in (1.0, 2.5, 0.4, 7)]
        plan = region_dp(legal, goal, [translation(shape, *move) for move in moves])
        expected = by_definition(legal, goal, moves)
        assert np.allclose(plan.costs, expected, atol=1e-12)
        times = np.zeros(shape, int)
        for region, cost in plan.regions:
            times[region] += 1
            assert (plan.costs[region] == cost).all()
        assert np.array_equal(times, np.isfinite(expected)) and plan.num_backups == 4 * len(plan.regions)
        assert [cost for _, cost in plan.regions] == sorted(cost for _, cost in plan.regions)
        assert np.array_equal(plan.operators >= 0, np.isfinite(expected) & (expected > 0))
        for s in np.argwhere(plan.operators >= 0):
            move, cost = moves[plan.operators[tuple(s)]]
            assert plan.costs[tuple(s)] == pytest.approx(cost + plan.costs[tuple(s + move)])


def test_a_cover_is_a_partition() -> None:
    rng = np.random.default_rng(0)
    for shape in ((30,), (7, 9), (4, 3, 5)):
        for share in (0.0, 0.3, 0.8, 1.0):
            states = rng.random(shape) < share
            times, boxes = np.zeros(shape, int), list(cover(states))
            for box in boxes:
                times[box] += 1
            assert np.array_equal(times, states) and (share < 1 or len(boxes) == 1)
    corner = [(box[0].stop, box[1].stop) for box in cover(np.array([[True, True], [True, False]]))]
    assert corner == [(1, 2), (2, 1)]  # along the last axis first
    runs = np.array([[1, 1, 0, 1], [1, 1, 0, 1], [1, 1, 1, 1]], bool)
    assert [(box[0].stop, box[1].start, box[1].stop) for box in cover(runs)] == [(3, 0, 2), (3, 3, 4), (3, 2, 3)]


def test_slides_go_on_until_a_wall() -> None:
    free = np.array([[1, 1, 1, 1], [1, 0, 1, 1], [1, 1, 1, 0]], bool)
    led = successors(free)
    # From (0, 2): north, east, south, west, and the same as far as it goes.
    assert led[2].tolist() == [2, 3, 6, 1, 2, 3, 10, 0]
    assert led[8].tolist() == [4, 9, 8, 8, 0, 10, 8, 8] and led[5].tolist() == [5] * 8
    assert mazes.by_regions(SlideMaze(free, (1, 3))).costs.tolist() == [
        [2, 2, 2, 1], [3, np.inf, 1, 0], [3, 3, 2, np.inf]
    ]  # fmt: skip


def test_regressions_and_plans_are_those_of_the_model() -> None:
    assert oracle.wrong_regressions(9, 60, seed=4) == 0
    assert oracle.model_difference(10) == 0.0


def test_a_maze_is_what_was_asked_for() -> None:
    maze, again = draw_maze(60, 4, seed=3), draw_maze(60, 4, seed=3)
    assert np.array_equal(maze.free, again.free) and maze.goal == again.goal and maze.free[maze.goal]
    assert not np.array_equal(maze.free, draw_maze(60, 4, seed=4).free)
    assert 0 < np.count_nonzero(~maze.free) <= 4 * 9 * 9  # sides below a sixth
    assert np.isfinite(mazes.by_states(maze)[0][maze.free]).all()
    assert abs(draw_maze(100, 0, 0.2).free.mean() - 0.8) < 0.02


@pytest.mark.parametrize("num_steps", [300, pytest.param(100_000, marks=pytest.mark.slow)])
def test_the_maze_is_walked_cell_by_cell_for_many_random_steps(num_steps: int) -> None:
    given = {"size": 14, "num_rectangles": 4, "wall_share": 0.1, "seed": 6}
    env, maze = gymnasium.make("neuralq/SlideMaze-v0", **given), draw_maze(**given)  # type: ignore[arg-type]
    rng, ends = np.random.default_rng(0), 0
    s, _ = env.reset(seed=0)
    at = divmod(int(s), 14)
    for a in rng.integers(0, 8, num_steps).tolist():
        down, across = ((-1, 0), (0, 1), (1, 0), (0, -1))[a % 4]
        for _ in range(1 if a < 4 else 14):
            ahead = (at[0] + down, at[1] + across)
            if 0 <= min(ahead) and max(ahead) < 14 and maze.free[ahead]:
                at = ahead
        s, reward, terminated, _, _ = env.step(a)
        assert divmod(int(s), 14) == at and reward == -1 and terminated == (at == maze.goal)
        if terminated:
            ends += 1
            s, _ = env.reset()
            at = divmod(int(s), 14)
            assert maze.free[at] and at != maze.goal
    assert ends


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (lambda: draw_maze(2), "size must be a whole number of at least 3"),
        (lambda: draw_maze(wall_share=1.0), r"wall_share must lie in \[0, 0.9\], got 1.0"),
        (lambda: draw_maze(3, 0, 0.9, seed=1), "ask for fewer, or for another seed"),
        (lambda: draw_maze(num_rectangles=-1), "num_rectangles must be a whole number of at least 0"),
        (lambda: plan(goal=(slice(0, 1),)), "a slice with start and stop for each of the 2 axes"),
        (lambda: plan(goal=(slice(0, 1), slice(3, 5))), r"inside \(3, 4\)"),
        (lambda: plan(legal=np.zeros((3, 4), bool)), "goal must hold a legal state"),
        (lambda: plan(operators=()), "at least one RegionOperator, got none"),
        (lambda: plan(operators=[RegionOperator(0.0, lambda region: [])]), "cost of operator 0 must be"),
        (
            lambda: plan(operators=[RegionOperator(1.0, lambda region: [(slice(0, 1), slice(-1, 1))])]),
            "cut off what is",
        ),
        (lambda: mazes.solve_mazes(np.random.SeedSequence(0), "round walls", [10]), "kind must be one of"),
    ],
)
def test_what_makes_no_sense_is_refused(act: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        act()
    assert draw_maze(3, 0, 0.9, seed=11).free.any()  # another seed


def plan(**given: Any) -> Any:
    return region_dp(**{
        "legal": np.ones((3, 4), bool), "goal": (slice(0, 1), slice(0, 1)),
        "operators": [translation((3, 4), (0, 1), 1.0)], **given,
    })  # fmt: skip


def test_the_page_says_what_came_out(monkeypatch: pytest.MonkeyPatch) -> None:
    for picture in ("maze_picture", "growth_picture"):
        monkeypatch.setattr(system, picture, lambda found: None)
    one = mazes.solve_mazes(np.random.SeedSequence(0), "5 rectangles", [20])[20]
    assert one.num_backups == 8 * np.count_nonzero(one.maze.free) and one.difference == 0
    assert one.ratio == len(one.plan.regions) / np.count_nonzero(one.maze.free)
    ratios = dict(zip(mazes.KINDS, (0.2, 0.119, 0.121, 0.299, 0.301), strict=True))
    backups = one.plan.num_backups
    found = {kind: ({100: replace(one, num_backups=backups / ratio)},) for kind, ratio in ratios.items()}
    page = system.REGIONS.page(found, False)
    verdicts = ["agrees", "not reproduced", "not reproduced", "agrees"]
    assert [row.verdict for row in page.rows[:4]] == verdicts and page.text[0].startswith("Not reproduced")
    page = system.REGIONS.page({**found, **dict.fromkeys(list(found)[2:4], found["15 rectangles"])}, False)
    assert [row.verdict for row in page.rows[:4]] == ["agrees", "agrees", "not reproduced", "agrees"]
    held = {**found, "40 rectangles": found["15 rectangles"], "10 % random walls": found["30 % random walls"]}
    page = system.REGIONS.page(held, False)
    assert page.reproduced and page.text[0].startswith("Reproduced")
    (wrong,) = found["5 rectangles"]
    held["5 rectangles"] = ({100: replace(wrong[100], difference=1.0)},)
    assert system.REGIONS.page(held, False).wrong == ["difference from breadth-first search, all cells"]


@pytest.mark.slow
def test_regions_pay_among_rectangles_and_not_among_random_walls() -> None:
    found = run_system(system_named("regions"), 12)
    median = {one.what.partition(":")[0]: one.median for one in found.measured}
    assert len(found.measured[0].values) == 12 and found.reproduced and not found.wrong
    assert median["15 rectangles, 100 x 100"] <= 0.12 and median["40 rectangles, 100 x 100"] <= 0.12
    assert median["10 % random walls, 100 x 100"] >= 0.3  # the control that must fail
    assert median["30 % random walls, 100 x 100"] >= 0.45
