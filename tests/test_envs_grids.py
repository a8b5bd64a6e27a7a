"""The grid worlds against Gymnasium's own tables, breadth-first search and numbers from the literature.

Mutants that die here: north and south swapped; a slip to the intended direction or backwards; all of the slip to one
side; the wind of the column that is entered; wind through walls; a cliff that ends the episode or pays a step; a goal's
reward on top of a step's; a maze that changes one step late, or whose clock starts anew with each episode; a closed gap
that can be entered, or not be left.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import gymnasium
import numpy as np
import pytest

from neuralq.mdp import FiniteMDP
from neuralq_envs import changing, cliff, dyna, gridworld, mitchell, windy
from neuralq_envs.canvas import blank, write
from neuralq_envs.changing import ChangingEnv
from neuralq_envs.grids import Grid

N, E, S, W, NE, SE, SW, NW = range(8)
COMPASS = {N: (-1, 0), E: (0, 1), S: (1, 0), W: (0, -1)}


def optimal_values(model: FiniteMDP, gamma: float) -> np.ndarray:
    """V* by plain value iteration; for γ = 1 on problems that end."""
    v, lively = np.zeros(model.num_states), np.flatnonzero(~model.is_terminal)
    for _ in range(10_000):
        better = np.zeros_like(v)
        better[lively] = np.maximum.reduceat(model.reward + gamma * (model.transition @ v), model.row_starts[lively])
        if np.abs(better - v).max() < 1e-13:
            return better
        v = better
    raise AssertionError("value iteration did not converge")


def distances(is_open: Callable[[int, int], bool], goal: tuple[int, int]) -> dict[tuple[int, int], int]:
    """Steps to the goal from every cell that reaches it, by breadth-first search backwards."""
    found, frontier = {goal: 0}, deque([goal])
    while frontier:
        row, column = frontier.popleft()
        for down, right in COMPASS.values():
            cell = row + down, column + right
            if is_open(*cell) and cell not in found:
                found[cell] = found[row, column] + 1
                frontier.append(cell)
    return found


@pytest.mark.parametrize(
    ("goal", "values"),
    [
        (4, [[8, 10, 8], [10, 0, 10]]),
        (5, [[6.4, 8, 10], [8, 10, 0]]),
        (2, [[8, 10, 0], [6.4, 8, 10]]),
        (1, [[10, 0, 10], [8, 10, 8]]),
    ],
)
def test_exercise_13_2_has_the_values_worked_out_by_hand(goal: int, values: list[list[float]]) -> None:
    env = gymnasium.make("neuralq/ExerciseGrid-v0", goal=goal)
    v = optimal_values(FiniteMDP.from_gymnasium(env), mitchell.EXERCISE_GAMMA)
    assert v.reshape(2, 3) == pytest.approx(np.array(values), abs=1e-12)
    assert optimal_values(mitchell.mdp(goal, 10.0), 0.8) == pytest.approx(v, abs=0)


def test_the_registered_exercise_has_its_goal_at_the_bottom_middle() -> None:
    env = gymnasium.make("neuralq/ExerciseGrid-v0").unwrapped
    s, total = env.reset(options={"state": 3})[0], 0.0
    for a in (N, E, E, S, W):  # up, right, right, down, left: clockwise round the perimeter into G
        s, reward, terminated, _, _ = env.step(a)
        total += reward
    assert (s, total, terminated) == (4, 10.0, True)
    assert env.mdp().num_rows == 11  # 14 ways between neighbours less the three out of G
    with pytest.raises(ValueError, match=r"goal must be a cell of 0\.\.5"):
        mitchell.mdp(goal=6)


def test_slips_holes_and_goals_are_those_of_gymnasiums_frozen_lake() -> None:
    lake = gymnasium.make("FrozenLake8x8-v1").unwrapped
    layout = "\n".join("".join(sign.decode() for sign in line) for line in lake.desc)
    model = Grid(layout.replace("F", ".").replace("H", "T"), trap_reward=0.0, slip=2 / 3).mdp()
    same_action = (W, S, E, N)  # left, down, right, up
    for s in range(64):
        for a in range(4):
            if model.is_terminal[s]:
                assert layout.replace("\n", "")[s] in "HG"
                continue
            row, reach, reward = int(model.row_index[s, same_action[a]]), np.zeros(64), 0.0
            for p, s_t, r, terminated in lake.P[s][a]:
                reach[s_t] += 0.0 if terminated else p
                reward += p * r
            assert model.transition[[row]].toarray()[0] == pytest.approx(reach, abs=1e-12)
            assert model.reward[row] == pytest.approx(reward, abs=1e-12)


def test_the_cliff_is_gymnasiums() -> None:
    table = gymnasium.make("CliffWalking-v1").unwrapped.P
    model = cliff.mdp()
    assert np.flatnonzero(model.is_terminal).tolist() == list(range(37, 48))
    for s in range(37):
        for a in range(4):
            [(_, s_t, reward, terminated)] = table[s][a]
            row = int(model.row_index[s, a])
            assert model.reward[row] == reward and model.termination[row] == terminated
            assert terminated or model.transition[[row]].toarray()[0, s_t] == 1.0
    assert optimal_values(model, cliff.GAMMA)[36] == -13.0


def test_the_four_by_three_world_has_russell_and_norvigs_values() -> None:
    # The chapter on complex decisions: R = -.04, 80 % where one wants, 10 % to either side, γ = 1.
    grid = Grid(gridworld.LAYOUT, step_reward=-0.04, goal_reward=1 - 0.04, trap_reward=-1 - 0.04, slip=0.2)
    published = [[0.812, 0.868, 0.918, 0], [0.762, 0, 0.660, 0], [0.705, 0.655, 0.611, 0.388]]
    assert optimal_values(gridworld.mdp(grid), 1.0).reshape(3, 4) == pytest.approx(np.array(published), abs=5e-4)
    env = gridworld.make(slip=0.2, step_reward=-0.04, goal_reward=0.96, trap_reward=-1.04)
    assert (env.mdp().transition != grid.mdp().transition).nnz == 0
    assert (
        env.mdp().reward.tolist()
        == grid.mdp().reward.tolist()
        == gridworld.make_vector(2, slip=0.2, step_reward=-0.04, goal_reward=0.96, trap_reward=-1.04)
        .mdp()
        .reward.tolist()
    )


def test_the_dyna_maze_is_suttons() -> None:
    walls = {(1, 2), (2, 2), (3, 2), (0, 7), (1, 7), (2, 7), (4, 5)}  # Sutton & Barto 2018, figure 8.2
    steps = distances(lambda r, c: 0 <= r < 6 and 0 <= c < 9 and (r, c) not in walls, goal=(0, 8))
    assert len(steps) == 47 and steps[2, 0] == 14
    assert sum(steps.values()) == 404  # Littman 1994: the shortest ways of the 46 starts together
    model = dyna.mdp()
    v = optimal_values(model, dyna.GAMMA)
    expected = np.zeros(54)
    for (row, column), length in steps.items():
        expected[row * 9 + column] = 0.95 ** (length - 1) if length else 0.0
    assert v == pytest.approx(expected, abs=1e-12)
    assert model.start_distribution[18] == 1.0
    assert dyna.mdp(random_start=True).start_distribution[model.legal[:, 0]].tolist() == [1 / 46] * 46


@pytest.mark.parametrize(
    ("change", "gaps", "lengths"), [("blocking", ({8}, {0}), (10, 16)), ("shortcut", ({0}, {0, 8}), (16, 10))]
)
def test_the_changing_mazes_are_suttons(change: str, gaps: tuple[set[int], set[int]], lengths: tuple[int, int]) -> None:
    for changed in (False, True):

        def is_open(row: int, column: int, open_columns: set[int] = gaps[changed]) -> bool:
            return 0 <= row < 6 and 0 <= column < 9 and (row != 3 or column in open_columns)

        steps = distances(is_open, goal=(0, 8))
        assert steps[5, 3] == lengths[changed]
        model = changing.mdp(change, changed)
        v = optimal_values(model, 0.95)
        for (row, column), length in steps.items():
            assert v[row * 9 + column] == pytest.approx(0.95 ** (length - 1) if length else 0.0, abs=1e-12)
        assert model.start_distribution[5 * 9 + 3] == 1.0
        entered = np.flatnonzero(model.transition.sum(axis=0)).tolist()
        assert not {s for s in entered if s // 9 == 3 and s % 9 not in gaps[changed]} - {35}
    assert gymnasium.spec(f"neuralq/{change.capitalize()}Maze-v0").kwargs == {"change": change}


def test_the_change_comes_after_that_many_steps_of_all_episodes() -> None:
    env = gymnasium.make("neuralq/ShortcutMaze-v0", change_step=7).unwrapped
    assert isinstance(env, ChangingEnv)
    before, after = env.mdp(changed=False), env.mdp(changed=True)
    env.reset(seed=0)
    for _ in range(3):
        env.step(S)
    env.reset()  # a new episode does not turn the clock back
    for taken in range(3, 7):
        assert env.mdp() is before
        env.step(E if taken < 6 else N)
    assert env.mdp() is after
    s, _ = env.reset(options={"state": 4 * 9 + 8})
    assert env.step(N)[0] == 3 * 9 + 8  # through the new gap
    env.reset(seed=0)  # a seed begins the experiment anew
    assert env.mdp() is before
    env.reset(options={"state": s})
    assert env.step(N)[0] == s  # no gap yet


def test_the_published_changes_come_at_steps_1000_and_3000() -> None:
    for change, change_step in (("blocking", 1000), ("shortcut", 3000)):
        env = changing.make(change)
        env.reset(seed=0)
        for _ in range(change_step - 1):
            env.step(S)
        before = env.mdp()
        env.step(S)
        assert before is env.mdp(changed=False) and env.mdp() is env.mdp(changed=True)


def test_whoever_is_in_the_gap_that_closes_can_leave_it_but_not_return() -> None:
    env = gymnasium.make("neuralq/BlockingMaze-v0", change_step=1)
    env.reset(seed=0, options={"state": 4 * 9 + 8})
    gap, _, _, _, extra = env.step(N)
    assert gap == 3 * 9 + 8 and extra["action_mask"].tolist() == [1, 1, 1, 1]
    assert env.step(W)[0] == gap  # a wall
    assert env.step(S)[0] == 4 * 9 + 8
    assert env.step(N)[0] == 4 * 9 + 8  # closed


def test_two_different_worlds_cannot_change_into_each_other() -> None:
    with pytest.raises(ValueError, match="same observation_space"):
        ChangingEnv(Grid("S.G").env(), Grid("S..G").env(), 5)
    with pytest.raises(ValueError, match="change_step"):
        changing.make("shortcut", change_step=-1)
    with pytest.raises(ValueError, match="change must be one of"):
        changing.mdp("earthquake")


def landing(grid: Grid, row: int, column: int, a: int) -> tuple[int, int]:
    """Where a move that cannot fail ends."""
    s_t = next(iter(grid._transitions(grid.cell(row, column), a)))[1]
    return divmod(s_t, grid.num_columns)


def test_the_wind_is_the_books() -> None:
    grid = windy.grid()
    assert landing(grid, 3, 8, W) == (2, 7)  # "left takes you to the cell just above the goal"
    assert landing(grid, 3, 3, E) == (2, 4) and landing(grid, 3, 2, E) == (3, 3)
    assert landing(grid, 1, 6, N) == (0, 6) and landing(grid, 6, 3, S) == (5, 3)
    assert landing(grid, 0, 7, S) == (0, 7)
    assert optimal_values(windy.mdp(), windy.GAMMA)[30] == -15.0
    assert optimal_values(windy.mdp(num_moves=8), windy.GAMMA)[30] == -7.0  # exercise 6.9: king's moves


def test_wind_stops_at_walls_and_may_blow_into_a_goal_or_over_it() -> None:
    grid = Grid("G..\n.#.\n...\nS..", wind=(2, 3, 1))
    assert landing(grid, 3, 1, E) == (0, 2)  # by the three of the column where the move began
    assert landing(grid, 2, 1, N) == (2, 1)
    assert landing(grid, 2, 0, S) == (1, 0)
    assert grid._transitions(grid.cell(2, 0), N)[0][1:] == (0, 1.0, True)
    over = Grid("...\nG..\nS..", wind=(2, 0, 0))
    assert over._transitions(over.cell(2, 0), N)[0][1:] == (0, 0.0, False)


def test_eight_moves_go_where_they_say_and_slip_to_their_neighbours() -> None:
    grid = Grid("...\n...\n...", num_moves=8, slip=0.5)
    for a, cell in zip(range(8), ((0, 1), (1, 2), (2, 1), (1, 0), (0, 2), (2, 2), (2, 0), (0, 0)), strict=True):
        assert landing(grid, 1, 1, a) == cell
    slips = {(p, divmod(s_t, 3)) for p, s_t, _, _ in grid._transitions(4, NW)}
    assert slips == {(0.5, (0, 0)), (0.25, (0, 1)), (0.25, (1, 0))}
    assert {(p, divmod(s_t, 3)) for p, s_t, _, _ in grid._transitions(4, SE)} == {
        (0.5, (2, 2)), (0.25, (1, 2)), (0.25, (2, 1)),
    }  # fmt: skip


def test_each_sort_of_cell_pays_its_own_reward() -> None:
    grid = Grid("T.G\n.S.\n#C.", step_reward=-1, goal_reward=5, trap_reward=-7, cliff_reward=-20)
    model = grid.mdp()
    assert model.reward[model.row_index[1]].tolist() == [-1, 5, -1, -7]
    assert model.termination[model.row_index[1]].tolist() == [0, 1, 0, 1]
    fall = int(model.row_index[4, S])
    assert model.reward[fall] == -20 and model.transition[[fall]].toarray()[0].tolist() == [0, 0, 0, 0, 1, 0, 0, 0, 0]
    assert np.flatnonzero(model.is_terminal).tolist() == [0, 2, 6, 7]
    assert model.start_distribution[4] == 1.0
    illegal = Grid("T.G\n.S.\n#C.", blocked="illegal").mdp()
    assert illegal.legal[3].tolist() == [True, True, False, False]  # trap above, start beside, wall below


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"layout": "..\n..."}, "row 1 of the map must have 2 cells"),
        ({"layout": "..?"}, "sign must be one of"),
        ({"layout": "G#"}, "no cell to be in"),
        ({"layout": ".C."}, "one start 'S' to fall back to, got 0"),
        ({"slip": 1.5}, "slip must lie in"),
        ({"num_moves": 5}, "num_moves must be one of 4, 8"),
        ({"blocked": "never"}, "blocked must be one of"),
        ({"goal_reward": float("nan")}, "goal_reward must be finite"),
        ({"wind": (1, 2)}, "wind must have 3 numbers"),
        ({"wind": (1, 2, -1)}, "wind must be a whole number"),
    ],
)
def test_a_grid_that_makes_no_sense_is_refused(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Grid(**{"layout": "S.G", **wrong})  # type: ignore[arg-type]


def test_a_cell_is_found_by_row_and_column() -> None:
    assert Grid("...\n..G").cell(1, 0) == 3
    with pytest.raises(ValueError, match=r"\(2, 0\) is not on this grid of 2 x 3 cells"):
        Grid("...\n..G").cell(2, 0)


def test_a_picture_shows_walls_goal_traps_wind_and_the_agent() -> None:
    pixels = Grid("S.G\n#T.", wind=(0, 0, 2)).pixels(1).astype(int)
    corner = {(r, c): pixels[48 * r + 4, 48 * c + 4] for r in range(2) for c in range(3)}
    assert corner[0, 0].tolist() == corner[0, 1].tolist() == [255, 255, 255]
    assert corner[1, 0].max() < 100 and corner[0, 2][1] == corner[0, 2].max() and corner[1, 1][0] == corner[1, 1].max()
    assert corner[1, 2][2] == 255 > corner[1, 2][0]  # a breeze
    assert pixels[24, 72].tolist() == [40, 90, 190]
    with pytest.raises(ValueError, match="alphabet has no 'é'"):
        write(blank(9, 9), "é", (4, 4))
