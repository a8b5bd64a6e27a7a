"""Section 13.3.6 with a model: Dyna's imagined moves, and prioritized sweeping's sense of where they pay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.apps.chapter.ordering import path_to_end
from neuralq.apps.pages.grids import policy_grid
from neuralq.exact import solve
from neuralq.mdp import FiniteMDP
from neuralq.runs.report.claims import ChapterPage, Chart, Row, Series, claim, number, own, spread
from neuralq.tabular import (
    Learned,
    Model,
    RunOptions,
    compile_model,
    dyna_q,
    over_seeds,
    prioritized_sweeping,
)
from neuralq_envs import changing, dyna

__all__ = ["dyna_maze", "sweeping"]

_OPTIMUM = 14  # steps from S to G in the Dyna maze
_EPISODES = 30
_PLANNING = {0: 40_000, 5: 12_000, 50: 6_000}  # real steps, enough for 30 episodes
_PRINTED = {0: (25, "about 25"), 5: (5, "about 5"), 50: (3, "about 3")}


def dyna_maze(num_seeds: int = 30) -> ChapterPage:
    """Imagined moves between the real ones: the maze is learned in a few episodes instead of dozens.

    Args:
        num_seeds: independent runs.

    Source: Sutton 1990, 1991; numbers of Sutton & Barto 2018, figures 8.2, 8.4 and 8.5.

    Example:
        >>> dyna_maze(num_seeds=2).rows[0].verdict
        'agrees'
    """
    mdp, grid = dyna.mdp(), dyna.grid()
    answer = solve(mdp, dyna.GAMMA)
    shortest = 1 + round(np.log(answer.v[18]) / np.log(dyna.GAMMA))
    rows: list[Row] = [number("shortest way from S to G", _OPTIMUM, shortest)]
    curves = []
    means = {}
    for n, num_steps in _PLANNING.items():
        lengths = _episode_lengths(mdp, n, num_steps, num_seeds)
        means[n] = mean = lengths.mean(axis=0)
        rows.append(own(f"n = {n}: steps in episode 2", spread(lengths[:, 1]), "median [95% of seeds]"))
        reached = int(np.argmax(mean <= 20)) + 1 if (mean <= 20).any() else 0
        about, words = _PRINTED[n]
        rows.append(claim(f"n = {n}: episodes until at most 20 steps", words, reached, 0 < reached <= 1.5 * about + 1))
        low, high = np.quantile(lengths, [0.025, 0.975], axis=0)
        curves.append(Series(f"n = {n}", range(2, _EPISODES + 1), mean[1:], low[1:], high[1:]))
    ordered = bool(means[0][1] > means[5][1] > means[50][1])
    rows.append(claim("mean steps in episode 2 fall with n", "yes", "yes" if ordered else "no", ordered))
    rows.append(_blocking_row(min(num_seeds, 6)))
    text = (
        "After each real move Dyna repeats n remembered ones in its head and updates the table from them: the model is "
        "nothing but the last outcome of every move tried. Without planning (n = 0) the first episode teaches one "
        "move; with n = 50 the second episode is nearly straight.",
        "What Dyna saves is real moves. It spends n + 1 updates on each.",
        "When the world changes, the model is wrong until it is tested. Dyna-Q+ adds a bonus to moves not tried for "
        "long, so it goes and looks; in the maze whose gap moves it finds the new way sooner.",
    )
    drawings = (
        policy_grid("V* and every optimal move", grid.signs, grid.num_columns, answer.v, answer.optimal_actions),
        Chart("learning the maze", "episode", "mean steps", tuple(curves), log_y=True),
    )
    return ChapterPage("dyna", "Learning and planning at once", "13.3.6", text, tuple(rows), drawings)


def _episode_lengths(mdp: FiniteMDP, num_planning: int, num_steps: int, num_seeds: int) -> NDArray[np.int64]:
    """Steps of the first episodes, ``[N, 30]``."""
    model, options = compile_model(mdp), RunOptions(record_experience=True)

    def learn(seed: np.random.SeedSequence) -> Learned:
        return dyna_q(model, num_steps, dyna.GAMMA, num_planning=num_planning, seed=seed, options=options)

    runs = over_seeds(learn, num_seeds).runs
    short = [run for run in runs if len(run.episode_lengths) < _EPISODES]
    if short:
        raise RuntimeError(f"{len(short)} runs of n={num_planning} had fewer than {_EPISODES} episodes")
    return np.stack([run.episode_lengths[:_EPISODES] for run in runs])


def _blocking_row(num_seeds: int) -> Row:
    """Goals reached in the 2000 steps after the gap has moved."""
    goals = []
    for kappa in (0.0, 1e-3):
        counts = []
        for seed in range(num_seeds):
            run = dyna_q(
                changing.make("blocking"), 3000, changing.GAMMA, num_planning=10, kappa=kappa, seed=seed,
                options=RunOptions(record_experience=True),
            )  # fmt: skip
            assert run.experience is not None
            counts.append(int(run.experience.last_t[1000:].sum()))
        goals.append(counts)
    what = "blocking maze: goals after the change, Dyna-Q against Dyna-Q+"
    better = float(np.mean(goals[1])) > float(np.mean(goals[0]))
    return claim(what, "Dyna-Q+ more", f"{np.mean(goals[0]):.1f} against {np.mean(goals[1]):.1f}", better)


def sweeping(num_seeds: int = 20) -> ChapterPage:
    """Prioritized sweeping needs a fraction of Dyna's updates: it plans where the table is most wrong.

    Args:
        num_seeds: independent runs.

    Source: Moore & Atkeson 1993; Peng & Williams 1993.

    Example:
        >>> sweeping(num_seeds=2).rows[0].verdict
        'ours'
    """
    mdp = dyna.mdp()
    model = compile_model(mdp)
    found = np.array([[_until_optimal(mdp, model, name, seed) for name in _METHODS] for seed in range(num_seeds)])
    rows: list[Row] = []
    for i, name in enumerate(_METHODS):
        rows.append(
            own(f"{name}: real moves until the way is shortest", spread(found[:, i, 0]), "median [95% of seeds]")
        )
        rows.append(own(f"{name}: updates", spread(found[:, i, 1])))
    ratio = float(np.median(found[:, 0, 1]) / np.median(found[:, 1, 1]))
    rows.append(claim("median updates of Dyna, divided by prioritized sweeping's", "at least 3", ratio, ratio >= 3))
    text = (
        "Dyna imagines moves at random, and most of them change nothing: the news that a cell has become valuable "
        "concerns only those from which one can get there. Prioritized sweeping keeps a queue of the entries whose "
        "value is most wrong, repairs the worst, and puts its predecessors into the queue.",
        "A move that was never tried is believed to be worth 1, as much as any way can earn: so the agent explores on "
        "purpose. Otherwise both learners act alike, and may do five updates for each real move.",
    )
    ranks = range(1, num_seeds + 1)
    curves = tuple(Series(name, ranks, np.sort(found[:, i, 1])) for i, name in enumerate(_METHODS))
    charts = (Chart("updates until the way is shortest", "run, the quickest first", "updates", curves, log_y=True),)
    return ChapterPage("sweeping", "Planning where it matters", "13.3.6", text, tuple(rows), charts)


_METHODS = ("Dyna", "prioritized sweeping")


def _until_optimal(mdp: FiniteMDP, model: Model, name: str, seed: int) -> tuple[int, int]:
    """Real moves and updates of the shortest run (in steps of a tenth more) whose greedy way is optimal."""
    num_steps = 50
    while num_steps < 300_000:
        run = _run(model, name, num_steps, seed)
        way = path_to_end(mdp, run.policy, dyna.GAMMA, _OPTIMUM)
        if way.last_t[-1] and len(way) == _OPTIMUM:
            return num_steps, run.num_backups
        num_steps += max(10, num_steps // 10)
    raise RuntimeError(f"{name} found no shortest way in {num_steps} steps with seed {seed}")


def _run(model: Model, name: str, num_steps: int, seed: int) -> Learned:
    """A longer run with the same seed begins with the same steps. The optimism is r / (1 − γ) = 1."""
    if name == "Dyna":
        return dyna_q(model, num_steps, dyna.GAMMA, num_planning=5, step_size=1.0, seed=seed)
    return prioritized_sweeping(
        model, num_steps, dyna.GAMMA, num_planning=5, bored_after=1, optimistic_reward=1 - dyna.GAMMA, seed=seed
    )
