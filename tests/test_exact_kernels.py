"""The oracle's compiled loops beside plain Python on lists, and its counts beside methods written out from their text.

Mutants that die here: an index, a comparison or a first value of any kernel; ties that move the policy; a row at the
very edge of the slack; a queue that is no longer a heap; backups or iterations counted once too often.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from neuralq.exact import asynchronous_kernels, kernels, sweeping
from neuralq.exact.asynchronous_kernels import greedy_trials, predecessors, process_queue, settle
from neuralq.exact.problem import prepare, rows_of
from neuralq.mdp import FiniteMDP

# Quarters and whole numbers: every sum is exact, so that ties are ties. Ends stand first, in between and last.
ENDS = (0, 4, 7)
GAMMA = 0.5


def model() -> FiniteMDP:
    rng = np.random.default_rng(0)
    rows, s_tm1, a_tm1, reward = [], [], [], []
    for s in (s for s in range(8) if s not in ENDS):
        for a in range(3 if s != 5 else 1):
            row = np.zeros(8)
            for _ in range(rng.integers(0, 5)):  # none: the row ends the episode
                row[rng.integers(8)] += 0.25
            rows.append(row)
            s_tm1.append(s)
            a_tm1.append(a)
            reward.append(float(rng.integers(-2, 3)))
        rows[-1], reward[-1] = rows[-2].copy(), reward[-2]  # two rows that tie
    rows, s_tm1, a_tm1, reward = [*rows, np.zeros(8)], [*s_tm1, 6], [*a_tm1, 3], [*reward, -9.0]
    order = np.lexsort((a_tm1, s_tm1))
    return FiniteMDP(
        8,
        4,
        np.array(s_tm1)[order],
        np.array(a_tm1)[order],
        sparse.csr_array(np.array(rows)[order]),
        np.array(reward)[order],
        np.where(np.arange(len(rows)) % 3 == 0, 0.5, 1.0),
    )


MDP = model()
ROWS = rows_of(MDP, GAMMA)
DENSE, DECAY = MDP.transition.toarray(), GAMMA * MDP.row_discount
OF = [range(MDP.row_starts[s], MDP.row_starts[s + 1]) for s in range(8)]  # the rows of each state
V = np.array([0.0, 4.0, -2.0, 1.0, 0.0, -4.0, 2.0, 0.0])


def row_values(v: NDArray[np.float64]) -> list[float]:
    return [float(MDP.reward[k] + DECAY[k] * DENSE[k] @ v) for k in range(MDP.num_rows)]


def index(values: list[int]) -> NDArray[np.unsignedinteger]:
    return np.array(values, dtype=ROWS.starts.dtype)


def test_the_model_of_these_tests_has_every_kind_of_row() -> None:
    lengths = np.diff(MDP.transition.indptr)
    assert 0 in lengths and lengths.max() > 2 and [len(rows) for rows in OF] == [0, 3, 3, 3, 0, 1, 4, 0]
    values = row_values(V)
    ties = [sorted(values[k] for k in rows)[-1] == sorted(values[k] for k in rows)[-2] for rows in OF if len(rows) > 1]
    assert any(ties) and not all(ties)


def test_sweeps_are_those_of_lists() -> None:
    values, out, better = np.array(row_values(V)), np.empty(MDP.num_rows), np.full(8, np.nan)
    kernels.look_ahead(ROWS, V, out)
    assert out.tolist() == values.tolist()
    best = [max((values[k] for k in rows), default=0.0) for rows in OF]
    changes = [best[s] - V[s] for s in range(8) if len(OF[s])]
    lowest = [next((k for k in rows if values[k] == max(values[list(rows)])), 0) for rows in OF]
    for slack in (0.0, 0.25, 1.0, np.inf):
        beaten = sum(values[k] < max(values[i] for i in rows if i < k) - slack for rows in OF for k in list(rows)[1:])
        assert kernels.sweep(ROWS, V, better, slack) == (min(changes), max(changes), beaten)
        assert better.tolist() == best
    one = np.full(8, -7, dtype=np.int64)
    assert kernels.best_of_rows(ROWS, values, V, better, one) == (min(changes), max(changes))
    assert one.tolist() == lowest and better.tolist() == best

    for kept in (lowest, [rows[-1] if len(rows) else 0 for rows in OF]):  # the policy stays unless strictly beaten
        policy = index(kept)
        assert kernels.improve(ROWS, V, better, policy) == (min(changes), max(changes)) and better.tolist() == best
        stays = [values[kept[s]] == best[s] for s in range(8)]
        assert [policy[s] for s in range(8) if OF[s]] == [kept[s] if stays[s] else lowest[s] for s in range(8) if OF[s]]


@pytest.mark.parametrize("backwards", [False, True])
def test_a_sweep_in_place_sees_what_it_has_written(backwards: bool) -> None:
    v, slow, largest = V.copy(), V.copy(), 0.0
    for s in reversed(range(8)) if backwards else range(8):
        if OF[s]:
            best = max(row_values(slow)[k] for k in OF[s])
            largest, slow[s] = max(largest, abs(best - slow[s])), best
    assert kernels.improve_in_place(ROWS, v, backwards) == largest and v.tolist() == slow.tolist()


@pytest.mark.parametrize("slack", [0.0, 0.25, 0.5, 100.0])
def test_rows_within_the_slack_are_kept_and_its_edge_is_within(slack: float) -> None:
    values = np.array(row_values(V))
    keeps = [[k for k in rows if values[k] >= max(values[list(rows)]) - slack] for rows in OF]
    kept = [k for rows in keeps for k in rows]
    count = kernels.survivors(ROWS, values, slack)
    assert count == (len(kept), sum(np.diff(MDP.transition.indptr)[kept]))

    q, near, first = np.full((8, 4), np.nan), np.zeros((8, 4), dtype=bool), np.full(8, -7, dtype=np.int64)
    kernels.spread(ROWS, MDP.a_tm1, values, slack, q, near, first)
    assert [q[MDP.s_tm1[k], MDP.a_tm1[k]] for k in range(MDP.num_rows)] == values.tolist()
    assert np.isnan(q).sum() == 32 - MDP.num_rows
    assert sorted(map(tuple, np.argwhere(near).tolist())) == [(MDP.s_tm1[k], MDP.a_tm1[k]) for k in kept]
    assert first.tolist() == [MDP.a_tm1[ks[0]] if ks else -1 for ks in keeps]

    reward = np.empty(count[0])
    fixed = reward.view()
    fixed.flags.writeable = False
    out = kernels.Rows(
        index([99] * 9),
        index([99] * (count[0] + 1)),
        index([99] * count[1]),
        np.empty(count[1]),
        fixed,
        np.empty(count[0]),
    )
    kernels.copy_survivors(ROWS, values, slack, out, reward)
    assert out.starts.tolist() == np.cumsum([0, *map(len, keeps)]).tolist()
    copied = sparse.csr_array((out.probability, out.column.astype(int), out.indptr.astype(int)), (count[0], 8))
    assert np.array_equal(copied.toarray(), DENSE[kept])
    assert reward.tolist() == MDP.reward[kept].tolist() and out.decay.tolist() == DECAY[kept].tolist()


def test_a_policy_is_copied_out_and_swept_alone() -> None:
    chosen = [rows[len(rows) // 2] if len(rows) else 0 for rows in OF]
    used = [k for k, rows in zip(chosen, OF, strict=True) if len(rows)]
    size = int(np.diff(MDP.transition.indptr)[used].sum())
    indptr, column, weight = index([99] * 9), index([99] * size), np.empty(size)
    kernels.extract_policy(ROWS, index(chosen), indptr, column, weight)
    dense = np.array([DECAY[k] * DENSE[k] if len(rows) else np.zeros(8) for k, rows in zip(chosen, OF, strict=True)])
    assert np.array_equal(sparse.csr_array((weight, column.astype(int), indptr.astype(int)), (8, 8)).toarray(), dense)

    acts, reward, out = ~MDP.is_terminal, np.arange(8.0), np.empty(8)
    changes = (reward + dense @ V - V)[acts]
    assert kernels.policy_sweep(indptr, column, weight, reward, acts, V, out) == (changes.min(), changes.max())
    assert out.tolist() == (reward + dense @ V).tolist()


def test_one_backup_and_the_states_before_each() -> None:
    values = row_values(V)
    for s in np.flatnonzero(~MDP.is_terminal):
        best = max(values[k] for k in OF[s])
        assert asynchronous_kernels.back_up(ROWS, V, int(s)) == (best, next(k for k in OF[s] if values[k] == best))
    columns = [np.flatnonzero(DENSE[:, s]) for s in range(8)]
    begins = np.cumsum([0, *map(len, columns)])
    state, weight, cursor = index([99] * begins[-1]), np.empty(begins[-1]), begins[:-1].copy()
    predecessors(ROWS, cursor, state, weight)
    assert cursor.tolist() == begins[1:].tolist()
    assert state.tolist() == np.concatenate([MDP.s_tm1[rows] for rows in columns]).tolist()
    assert weight.tolist() == np.concatenate([DECAY[r] * DENSE[r, s] for s, r in enumerate(columns)]).tolist()


def test_the_queue_takes_the_largest_first_and_its_priorities_bound_the_residuals() -> None:
    mdp, gamma = FiniteMDP.garnet(40, 2, 3, seed=3), 0.7
    rows, threshold = rows_of(mdp, gamma), 0.05
    n, dense = mdp.num_states, mdp.transition.toarray()
    begins = np.concatenate([[0], np.cumsum(np.bincount(mdp.transition.indices, minlength=n))])
    state, weight = np.empty(begins[-1], dtype=rows.starts.dtype), np.empty(begins[-1])
    predecessors(rows, begins[:-1].copy(), state, weight)
    slow, waits = np.zeros(n), np.abs(mdp.reward.reshape(n, 2).max(axis=1))
    v, priority = slow.copy(), waits.copy()
    waiting = np.flatnonzero(priority > threshold)
    waiting = waiting[np.argsort(-priority[waiting])]
    size, heap, place = len(waiting), np.zeros(n, dtype=np.int64), np.full(n, -1, dtype=np.int64)
    heap[:size], place[waiting] = waiting, np.arange(size)
    queued = set(waiting.tolist())
    steps = 0
    while queued:
        assert set(heap[:size].tolist()) == queued and [place[s] for s in heap[:size]] == list(range(size))
        assert (place >= 0).sum() == size and all(waits[heap[i]] <= waits[heap[(i - 1) // 2]] for i in range(1, size))
        size, states, used = process_queue(rows, begins, state, weight, v, priority, heap, place, size, threshold, 1)
        s = max(queued, key=lambda s: waits[s])
        queued.remove(s)
        steps += 1
        best = max(mdp.reward[k] + gamma * dense[k] @ slow for k in (2 * s, 2 * s + 1))
        change, slow[s], waits[s] = abs(best - slow[s]), best, 0.0
        for k in np.flatnonzero(dense[:, s]) if change else ():
            waits[k // 2] += gamma * dense[k, s] * change
            queued |= {k // 2} if waits[k // 2] > threshold else set()
        assert (states, used) == (1, 2) and v == pytest.approx(slow, abs=1e-12)
        assert priority == pytest.approx(waits, abs=1e-12)
        waits = priority.copy()  # the same but for the order of sums
    assert steps > 60
    residual = np.abs((mdp.reward + gamma * dense @ v).reshape(n, 2).max(axis=1) - v)
    assert np.all(residual <= priority + 1e-12) and priority.max() <= threshold
    assert process_queue(rows, begins, state, weight, v, priority, heap, place, 0, threshold, 9) == (0, 0, 0)


def chain(*, slip: float) -> FiniteMDP:
    """0 → 1 → 2 → end at −1 each, staying with chance ``slip``; from 1 a second way, to the end, costs 9."""
    stay = {s: [(slip, s, -1.0, False), (1 - slip, s + 1, -1.0, s == 2)] for s in range(3)}
    moves = {**{(s, 0): stay[s] for s in range(3)}, (1, 1): [(1.0, 3, -9.0, True)]}
    return FiniteMDP.from_functions(4, 2, lambda s: [a for a in (0, 1) if (s, a) in moves], lambda s, a: moves[s, a])


def test_trials_follow_the_greedy_path_and_count_what_they_back_up() -> None:
    mdp = chain(slip=0.0)
    rows, v, path = rows_of(mdp, 1.0), np.zeros(4), np.full(9, -1, dtype=np.int64)
    rng = np.random.default_rng(0)
    ends = mdp.is_terminal.copy()
    # 0, 1, 2 have 1, 2 and 1 rows. V becomes −1 in each at the first trial, for what comes after is still 0.
    assert greedy_trials(rows, v, np.array([0]), ends, 9, path, rng) == (3, 3, 4)
    assert path[:4].tolist() == [0, 1, 2, -1] and v.tolist() == [-1.0, -1.0, -1.0, 0.0]
    # Two trials, the last of which is in the path; 2 is settled, and the one from there does nothing.
    ends[2] = True
    assert greedy_trials(rows, v, np.array([0, 1]), ends, 9, path, rng) == (1, 3, 5)
    assert path[:3].tolist() == [1, 1, 2] and v.tolist() == [-2.0, -2.0, -1.0, 0.0]
    assert greedy_trials(rows, v, np.array([2]), ends, 9, path, rng) == (0, 0, 0)
    assert greedy_trials(rows, v, np.array([0]), mdp.is_terminal, 2, path, rng)[:2] == (2, 2)  # no longer than that


def test_trials_draw_what_the_model_says() -> None:
    # To stay has chance ¼, so one state takes 4/3 visits; 3000 trials from 2 end after that many on average.
    mdp = chain(slip=0.25)
    rows, path = rows_of(mdp, 1.0), np.empty(99, dtype=np.int64)
    starts, rng = np.full(3000, 2), np.random.default_rng(1)
    _, states, used = greedy_trials(rows, np.zeros(4), starts, mdp.is_terminal, 99, path, rng)
    assert states == used and states / 3000 == pytest.approx(4 / 3, abs=0.05)
    # A discount of its own is a chance to end: half of the trials, at once.
    _, states, _ = greedy_trials(rows_of(mdp, 0.5), np.zeros(4), starts, mdp.is_terminal, 99, path, rng)
    assert states / 3000 == pytest.approx(1 / (1 - 0.125), abs=0.03)


def test_a_future_is_settled_whole_or_backed_up_from_its_end() -> None:
    mdp = chain(slip=0.0)
    rows, seen, path = rows_of(mdp, 1.0), np.zeros(4, dtype=bool), np.empty(4, dtype=np.int64)
    settled = mdp.is_terminal.copy()
    v = np.array([-3.0, -2.0, -1.0, 0.0])  # right: three states with 1, 2 and 1 rows, looked at once
    assert settle(rows, v, 0, 0.0, settled, seen, path) == (True, 4)
    assert settled.all() and not seen.any() and v.tolist() == [-3.0, -2.0, -1.0, 0.0]
    # 1 is off by exactly the threshold: good enough; by more: nothing is settled, and 1 and 0 are backed up, 1 first.
    for off, solved, used in ((0.25, True, 4), (0.5, False, 3 + 3)):
        settled, v = mdp.is_terminal.copy(), np.array([-3.0 + off, -2.0 + off, -1.0, 0.0])
        assert settle(rows, v, 0, 0.25, settled, seen, path) == (solved, used) and not seen.any()
        assert settled[:3].tolist() == [solved] * 3
        assert v.tolist() == ([-2.75, -1.75, -1.0, 0.0] if solved else [-3.0, -2.0, -1.0, 0.0])
    # Beside a state that is off, what follows the others is looked at too: 0 leads to 1 (off) and 2, and 2 to 3.
    fork = np.array([[0, 0.5, 0.5, 0, 0], [0, 0, 0, 0, 1.0], [0, 0, 0, 1.0, 0], [0, 0, 0, 0, 1.0], [0, 0, 0, 0, 0]])
    branching = FiniteMDP.from_arrays(fork[None], [[-1.0]] * 4 + [[np.nan]])
    v, path, settled = np.array([2.0, 0.0, 6.0, 7.0, 0.0]), np.empty(5, dtype=np.int64), branching.is_terminal.copy()
    assert settle(rows_of(branching, 1.0), v, 0, 0.25, settled, np.zeros(5, dtype=bool), path) == (False, 4 + 4)
    assert v.tolist() == [-2.5, -1.0, -2.0, -1.0, 0.0] and settled.tolist() == [False] * 4 + [True]
    settled = np.array([False, True, False, True])  # what is settled is not looked into
    assert settle(rows, np.array([-3.0, -2.0, 5.0, 0.0]), 0, 0.0, settled, seen, path) == (True, 1)
    assert settled.tolist() == [True, True, False, True]


def test_the_problem_of_a_model() -> None:
    problem = prepare(MDP, GAMMA)
    mass = DECAY * DENSE[:, ~MDP.is_terminal].sum(axis=1)
    assert (problem.reach, problem.least_modulus) == (1 / (1 - mass.max()), mass.min())
    assert problem.longest == np.diff(MDP.transition.indptr).max() and problem.largest_reward == 9.0
    down, up = problem.least_modulus / (1 - problem.least_modulus), problem.reach - 1
    assert problem.interval(-1.0, 2.0) == (-up, 2 * up) and problem.interval(1.0, 2.0) == (down, 2 * up)
    assert problem.interval(-2.0, -1.0) == (-2 * up, -down) and problem.interval(0.0, 0.0) == (0.0, 0.0)
    endless = prepare(FiniteMDP.from_arrays([[[1.0]]], [[0.0]]), 1.0)  # V = T V leaves no error there either
    assert endless.reach == np.inf and endless.interval(0.0, 0.0) == (0.0, 0.0)
    assert problem.rounding(V) == (problem.longest + 4) * 2.0**-52 * (9 + 4)


def test_the_copy_of_the_rows_that_are_left_is_a_model_of_its_own() -> None:
    for slack in (0.0, 0.5):
        left, values = sweeping._surviving(ROWS, V, slack), np.array(row_values(V))
        num_rows, num_entries = kernels.survivors(ROWS, values, slack)
        assert [len(x) for x in left] == [9, num_rows + 1, num_entries, num_entries, num_rows, num_rows]
        assert (left.starts[-1], left.indptr[-1]) == (num_rows, num_entries) and not left.reward.flags.writeable
        better, all_better = np.empty(8), np.empty(8)
        assert kernels.sweep(left, V, better, np.inf) == kernels.sweep(ROWS, V, all_better, np.inf)
        assert better.tolist() == all_better.tolist()
