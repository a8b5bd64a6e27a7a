"""Section 13.3.6: the same transitions learned backwards, and learned again.

The training rule ``Q(s,a) ← r + γ maxₐ' Q(s',a')`` reads the table it writes, so order matters. From a table of zeros
and one reward at the goal, an episode replayed forwards changes only the last entry of its path; replayed backwards,
each update finds its successor already updated, and one episode carries the reward along the whole path.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neuralq.apps.pages.grids import policy_grid
from neuralq.checks import check_fraction
from neuralq.exact import solve
from neuralq.mdp import FiniteMDP
from neuralq.rules.shapes import check_actions, check_same_shape
from neuralq.rules.targets import one_step
from neuralq.runs.report.claims import ChapterPage, Chart, Series, claim, own, spread
from neuralq.tabular import Experience, RunOptions, apply, compile_model, q_learning
from neuralq_envs import dyna

__all__ = ["episode_update", "part_of", "path_to_end", "replaying", "update_order"]

Update = Callable[..., Tensor]

_MAZE_STEPS = 14
_NUM_STEPS = 30_000


def update_order(num_seeds: int = 10) -> ChapterPage:
    """Updating an episode backwards carries the reward along the whole path at once; forwards, one move per episode.

    Args:
        num_seeds: independent random walks.

    Source: Mitchell 1997, section 13.3.6.

    Example:
        >>> update_order(num_seeds=2).reproduced
        True
    """
    mdp, gamma = dyna.mdp(), dyna.GAMMA
    answer = solve(mdp, gamma)
    path = path_to_end(mdp, answer.policy, gamma)
    zeros = torch.where(torch.from_numpy(mdp.legal), 0.0, -torch.inf).to(torch.float64)
    once = {name: _after(rule, zeros, path, 1) for name, rule in _RULES.items()}
    filled = {name: int(torch.count_nonzero(torch.isfinite(q) & (q != 0))) for name, q in once.items()}
    needed = {name: _episodes_until_right(rule, zeros, path, answer.v) for name, rule in _RULES.items()}
    forwards, backwards = np.array([_walks(mdp, answer.v, seed) for seed in range(num_seeds)]).T
    rows = (
        claim("moves of the path", f"{_MAZE_STEPS}, the shortest", len(path), len(path) == _MAZE_STEPS),
        claim("entries learned in one episode, forwards", "1", filled["forwards"], filled["forwards"] == 1),
        claim("entries learned in one episode, backwards", "all 14", filled["backwards"], filled["backwards"] == 14),
        claim("episodes until the start is right, forwards", "14", needed["forwards"], needed["forwards"] == 14),
        claim("episodes until the start is right, backwards", "1", needed["backwards"], needed["backwards"] == 1),
        own("random walks, forwards: updates until the start is right", spread(forwards), "median [95% of seeds]"),
        claim("random walks, backwards", "fewer", spread(backwards), float(np.median(backwards)) < np.median(forwards)),
    )
    text = (
        "An update reads the table it writes. Replay an episode forwards from a table of zeros, and only the last move "
        "finds a reward; the next episode reaches the move before it. Replay it backwards, and every move finds its "
        "successor already updated: one episode does the work of all.",
        "The agent has to remember one episode, no more. On random walks, where paths wind and cross, the gain is "
        "smaller but of the same kind.",
    )
    grid = dyna.grid()
    signs, width = grid.signs, grid.num_columns
    drawings = tuple(
        policy_grid(f"one episode, updated {name}", signs, width, _best(q), (q > 0).numpy()) for name, q in once.items()
    )
    return ChapterPage("order", "The order of updates", "13.3.6", text, rows, drawings)


def episode_update(
    q: Tensor, s_tm1: Tensor, a_tm1: Tensor, r_t: Tensor, discount_t: Tensor, s_t: Tensor, step_size: float = 1.0,
    *, backwards: bool,
) -> Tensor:  # fmt: skip
    """The table after Q-learning on an episode's transitions ``[T]``, in the order they happened or last one first.

    For t = 0, …, T-1, or backwards: ``q[s_tm1, a_tm1] += step_size · (r_t + discount_t · maxₐ q[s_t, a] - q[s_tm1,
    a_tm1])``, each update reading what the ones before it wrote. Step size 1 is the deterministic rule (eq. 13.7), a
    smaller one averages over chance (eq. 13.10). ``q`` is ``[S, A]``, -∞ for illegal actions, and is not changed.

    Raises:
        ValueError: if the shapes differ or ``step_size`` is outside [0, 1].

    Source: Mitchell 1997, Table 13.1, section 13.3.6.

    Example:
        A corridor of three states, reward 100 at its end, γ = .9: backwards, one episode fills it.

        >>> path, right = torch.tensor([0, 1, 2]), torch.tensor([0, 0, 0])
        >>> r_t, discount_t = torch.tensor([0.0, 0.0, 100.0]), torch.tensor([0.9, 0.9, 0.0])
        >>> episode_update(torch.zeros(4, 1), path, right, r_t, discount_t, path + 1, backwards=True)[:, 0]
        tensor([ 81.,  90., 100.,   0.])
        >>> episode_update(torch.zeros(4, 1), path, right, r_t, discount_t, path + 1, backwards=False)[:, 0]
        tensor([  0.,   0., 100.,   0.])
    """
    check_fraction("step_size", step_size, "1 is the deterministic rule")
    if r_t.ndim != 1 or q.ndim != 2:
        raise ValueError(f"one episode [T] and a table [S, A] are needed, got r_t {list(r_t.shape)}, q {list(q.shape)}")
    for name, tensor in (("discount_t", discount_t), ("s_tm1", s_tm1), ("s_t", s_t)):
        check_same_shape(name, tensor, "r_t", r_t)
    check_actions("a_tm1", a_tm1, "the episode", r_t[:, None])
    table, rows = q.clone(), zip(s_tm1.tolist(), a_tm1.tolist(), s_t.tolist(), r_t, discount_t, strict=True)
    for s, a, successor, reward, discount in list(rows)[:: -1 if backwards else 1]:
        # The clones are what autograd remembers; the table itself may then be written in place.
        target = one_step(reward, discount, table[successor].clone().amax())
        table[s, a] = torch.lerp(table[s, a].clone(), target, step_size)
    return table


_RULES: dict[str, Update] = {
    "forwards": partial(episode_update, backwards=False),
    "backwards": partial(episode_update, backwards=True),
}


def _after(rule: Update, q: Tensor, path: Experience, num_episodes: int) -> Tensor:
    columns = [torch.from_numpy(c) for c in (path.s_tm1, path.a_tm1, path.r_t, path.discount_t, path.s_t)]
    for _ in range(num_episodes):
        q = rule(q, *columns)
    return q


def _episodes_until_right(rule: Update, q: Tensor, path: Experience, v: NDArray[np.float64]) -> int:
    start = int(path.s_tm1[0])
    for episode in range(1, 10 * len(path)):
        q = _after(rule, q, path, 1)
        if abs(float(q[start].max()) - v[start]) < 1e-12:
            return episode
    return 0


def _best(q: Tensor) -> NDArray[np.float64]:
    best = q.amax(dim=1)
    return torch.where(torch.isfinite(best), best, 0.0).numpy()


def path_to_end(mdp: FiniteMDP, policy: NDArray[np.int64], gamma: float, most: int = 1000) -> Experience:
    """What happens under the policy in a world without chance, from the start to the end or for ``most`` moves."""
    s = int(np.argmax(mdp.start_distribution))
    steps: list[tuple[int, int, float, float, int, bool]] = []
    for _ in range(most):
        row = mdp.row_index[s, policy[s]]
        ends = bool(mdp.termination[row] > 0)
        s_t = s if ends else int(mdp.transition[[row]].indices[0])
        steps.append((s, int(policy[s]), float(mdp.reward[row]), 0.0 if ends else gamma, s_t, ends))
        if ends:
            break
        s = s_t
    return Experience(*(np.array(column) for column in zip(*steps, strict=True)))


def part_of(e: Experience, rows: slice) -> Experience:
    """The transitions in ``rows``."""
    return Experience(e.s_tm1[rows], e.a_tm1[rows], e.r_t[rows], e.discount_t[rows], e.s_t[rows], e.last_t[rows])


def _random_walk(mdp: FiniteMDP, seed: int) -> tuple[Experience, list[slice]]:
    """Random moves, and the rows of each complete episode."""
    options = RunOptions(record_experience=True)
    walk = q_learning(compile_model(mdp), _NUM_STEPS, dyna.GAMMA, policy="random", seed=seed, options=options)
    assert walk.experience is not None
    ends = (np.flatnonzero(walk.experience.last_t) + 1).tolist()
    return walk.experience, [slice(lo, hi) for lo, hi in zip([0, *ends[:-1]], ends, strict=True)]


def _walks(mdp: FiniteMDP, v: NDArray[np.float64], seed: int) -> tuple[int, int]:
    """Updates until the value of the start is exact, forwards and backwards."""
    experience, episodes = _random_walk(mdp, seed)
    counts = []
    for backwards in (False, True):
        q = np.where(mdp.legal, 0.0, np.nan)
        for rows in episodes:
            part = part_of(experience, rows)
            q = apply(q, part_of(part, slice(None, None, -1)) if backwards else part, step_size="deterministic").q
            if _start_is_right(mdp, q, v):
                break
        counts.append(rows.stop)
    return counts[0], counts[1]


def _start_is_right(mdp: FiniteMDP, q: NDArray[np.float64], v: NDArray[np.float64]) -> bool:
    start = int(np.argmax(mdp.start_distribution))
    return bool(abs(np.nanmax(q[start]) - v[start]) < 1e-12)


def replaying(num_seeds: int = 10) -> ChapterPage:
    """Learning the stored transitions again after every episode spares real moves and costs computation.

    Args:
        num_seeds: independent random walks.

    Source: Mitchell 1997, section 13.3.6; Lin 1992.

    Example:
        >>> replaying(num_seeds=2).reproduced
        True
    """
    mdp, gamma = dyna.mdp(), dyna.GAMMA
    v = solve(mdp, gamma).v
    found = np.array([[_replayed(mdp, v, seed, times) for times in (0, 1, 5)] for seed in range(num_seeds)])
    real, updates = found[..., 0], found[..., 1]
    rows = []
    for i, times in enumerate((0, 1, 5)):
        how = "no replay" if times == 0 else f"memory replayed {times}× after each episode"
        rows.append(own(f"{how}: real moves until the start is right", spread(real[:, i]), "median [95% of seeds]"))
        rows.append(own(f"{how}: updates", spread(updates[:, i])))
    saved = real[:, 0] - real[:, 2]
    rows.append(
        claim("runs in which replay (5×) needs more real moves", "0", int((saved < 0).sum()), (saved >= 0).all())
    )
    ratio = float(np.median(real[:, 0] / real[:, 2]))
    rows.append(claim("real moves without replay, divided by with (5×)", "more than 1", ratio, ratio > 1))
    text = (
        "What was seen can be learned from again: the reward of an old transition stays what it was, but the table "
        "entry of the state it led to has improved since. Where moves are expensive (a robot) and computation is not, "
        "storing and replaying is a good bargain.",
        "The walks are random and the same with and without replay, so each pair of runs differs in nothing else. The "
        "world is the Dyna maze, 14 moves from start to goal.",
    )
    ranks, names = range(1, num_seeds + 1), ("no replay", "replayed once", "replayed 5 times")
    curves = tuple(Series(name, ranks, np.sort(real[:, i])) for i, name in enumerate(names))
    charts = (Chart("real moves until the start is right", "run, the quickest first", "moves", curves),)
    return ChapterPage("replay", "Learning again from stored transitions", "13.3.6", text, tuple(rows), charts)


def _replayed(mdp: FiniteMDP, v: NDArray[np.float64], seed: int, times: int) -> tuple[int, int]:
    """Real moves and updates until the value of the start is exact."""
    experience, episodes = _random_walk(mdp, seed)
    q = np.where(mdp.legal, 0.0, np.nan)
    updates = 0
    for rows in episodes:
        for part in (rows, *[slice(0, rows.stop)] * times):
            q = apply(q, part_of(experience, part), step_size="deterministic").q
            updates += part.stop - part.start
        if _start_is_right(mdp, q, v):
            break
    return rows.stop, updates
