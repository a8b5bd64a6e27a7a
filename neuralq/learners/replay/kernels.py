"""The loops of the replay buffer, compiled: storing steps, and gathering them into reused arrays.

Each environment has two rings. The ring of *records* holds one step each (action, probability, reward, discount, last)
and the number of its observation; the ring of *rows* holds observations as bytes. A step whose near observation is the
previous step's far one shares that row, so a stream of steps costs one row per step, and the far observation of record
``row`` is always row ``row + 1``. Rows and records are numbered from 0 without end; the ring's place is the number
modulo its length.

`memcpy` moves the rows: a loop over bytes, as compiled here, is five times slower on rows of 28 kB.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from neuralq.jit import kernel
from neuralq.learners.replay.sum_tree import set_leaf

__all__ = ["RECORD", "gather", "gather_blocks", "locate", "store", "store_one", "synchronise"]

RECORD = np.dtype(
    [
        ("a_tm1", np.int64),
        ("row", np.int64),
        ("mu_tm1", np.float32),
        ("r_t", np.float32),
        ("discount_t", np.float32),
        ("last_t", np.bool_),
    ],
    align=True,
)
"""One step in 32 bytes: half a cache line, so that gathering a step costs one miss."""

_memcpy: Any = types.ExternalFunction("memcpy", types.voidptr(types.voidptr, types.voidptr, types.uintp))
_memcmp: Any = types.ExternalFunction("memcmp", types.int32(types.voidptr, types.voidptr, types.uintp))


@kernel
def _put(records: Any, rows: Any, cursors: Any, env_index: int, s_tm1: Any, s_t: Any) -> int:
    """Observations of a step into the environment's rows, its record's place out; evicts what the ring no longer holds.

    ``cursors[env_index]``: steps stored so far, steps held, rows written so far, unmarked breaks.
    """
    capacity, num_rows, size = records.shape[1], rows.shape[1], rows.shape[2]
    count, held, written = cursors[env_index, 0], cursors[env_index, 1], cursors[env_index, 2]
    if written == 0 or _memcmp(rows[env_index, (written - 1) % num_rows].ctypes, s_tm1.ctypes, size) != 0:
        if held > 0:
            previous = (count - 1) % capacity
            if not records[env_index, previous].last_t:  # not the successor, yet no end was announced: the stream broke
                records[env_index, previous].last_t = True
                cursors[env_index, 3] += 1
        _memcpy(rows[env_index, written % num_rows].ctypes, s_tm1.ctypes, size)
        written += 1
    _memcpy(rows[env_index, written % num_rows].ctypes, s_t.ctypes, size)
    written += 1
    place = count % capacity
    records[env_index, place].row = written - 2
    count += 1
    held = min(held + 1, capacity)
    while records[env_index, (count - held) % capacity].row < written - num_rows:
        held -= 1
    cursors[env_index, 0], cursors[env_index, 1], cursors[env_index, 2] = count, held, written
    return int(place)


@kernel
def store_one(
    records: Any,
    rows: Any,
    cursors: Any,
    env_index: int,
    s_tm1: Any,
    a_tm1: int,
    mu_tm1: float,
    r_t: float,
    discount_t: float,
    s_t: Any,
    last_t: bool,
) -> bool:
    """One step given as numbers; False (and nothing stored) if the environment is wrong or an observation has gaps."""
    if env_index < 0 or env_index >= rows.shape[0] or not (s_tm1.flags.c_contiguous and s_t.flags.c_contiguous):
        return False
    place = _put(records, rows, cursors, env_index, s_tm1, s_t)
    record = records[env_index, place]
    record.a_tm1 = a_tm1
    record.mu_tm1 = mu_tm1
    record.r_t = r_t
    record.discount_t = discount_t
    record.last_t = last_t
    return True


@kernel
def store(
    records: Any,
    rows: Any,
    cursors: Any,
    env_indices: Any,
    s_tm1: Any,
    a_tm1: Any,
    mu_tm1: Any,
    r_t: Any,
    discount_t: Any,
    s_t: Any,
    last_t: Any,
) -> None:
    """Steps in time-major order, flat: step i belongs to environment ``env_indices[i % N]``; observations are bytes."""
    size = rows.shape[2]
    for i in range(a_tm1.size):
        env_index = env_indices[i % env_indices.size]
        here, there = i * size, (i + 1) * size
        place = _put(records, rows, cursors, env_index, s_tm1[here:there], s_t[here:there])
        record = records[env_index, place]
        record.a_tm1 = a_tm1[i]
        record.mu_tm1 = mu_tm1[i]
        record.r_t = r_t[i]
        record.discount_t = discount_t[i]
        record.last_t = last_t[i]


@kernel
def locate(cursors: Any, capacity: int, length: int, starts: int, uniforms: Any, indices: Any) -> None:
    """For each u in [0, 1): the ⌊u·starts⌋-th start of ``length`` held steps in a row, as environment·capacity + place.

    Starts are counted environment by environment, oldest first. ``starts`` is their number over all environments.
    """
    for i in range(uniforms.size):
        rank, env_index = min(int(uniforms[i] * starts), starts - 1), 0
        while rank >= max(0, cursors[env_index, 1] - length + 1):
            rank -= max(0, cursors[env_index, 1] - length + 1)
            env_index += 1
        place = (cursors[env_index, 0] - cursors[env_index, 1]) % capacity + rank
        indices[i] = env_index * capacity + (place - capacity if place >= capacity else place)


@kernel
def _copy_pair(rows: Any, env_index: int, near: int, far: int, pairs: Any, to: int, offset: int) -> None:
    """Two rows of an environment to place ``to`` of the output, see `gather`; in one go where they adjoin."""
    num_rows, size = rows.shape[1], rows.shape[2]
    near, far = near % num_rows, far % num_rows
    if offset == size:
        if far == near + 1:
            _memcpy(pairs[2 * to * size :].ctypes, rows[env_index, near].ctypes, 2 * size)
            return
        to *= 2
    _memcpy(pairs[to * size :].ctypes, rows[env_index, near].ctypes, size)
    _memcpy(pairs[to * size + offset :].ctypes, rows[env_index, far].ctypes, size)


@kernel
def gather(
    records: Any,
    rows: Any,
    cursors: Any,
    num_steps: int,
    indices: Any,
    pairs: Any,
    offset: int,
    a_tm1: Any,
    mu_tm1: Any,
    r_t: Any,
    discount_t: Any,
    last_t: Any,
) -> None:
    """The n-step transition from each index: sums until ``num_steps``, a break, or the newest step of the environment.

    ``pairs`` takes the observations as bytes: if ``offset`` is a row's size, near and far one after the other for each
    transition; otherwise all near ones, and from ``offset`` on all far ones.
    """
    capacity = records.shape[1]
    for i in range(indices.size):
        env_index, place = indices[i] // capacity, indices[i] % capacity
        newest = (cursors[env_index, 0] - 1) % capacity
        step = records[env_index, place]
        row = step.row
        a_tm1[i] = step.a_tm1
        mu_tm1[i] = step.mu_tm1
        total, discount, steps = float(step.r_t), float(step.discount_t), 1
        while steps < num_steps and place != newest and not records[env_index, place].last_t:
            place = (place + 1) % capacity
            total += discount * records[env_index, place].r_t
            discount *= records[env_index, place].discount_t
            steps += 1
        r_t[i] = total
        discount_t[i] = discount
        last_t[i] = records[env_index, place].last_t
        _copy_pair(rows, env_index, row, row + steps, pairs, i, offset)


@kernel
def gather_blocks(
    records: Any,
    rows: Any,
    block_length: int,
    indices: Any,
    pairs: Any,
    offset: int,
    a_tm1: Any,
    mu_tm1: Any,
    r_t: Any,
    discount_t: Any,
    last_t: Any,
) -> None:
    """``block_length`` steps in a row from each index, time-major: step k of block i is entry k·num_blocks + i."""
    capacity = records.shape[1]
    for i in range(indices.size):
        env_index, place = indices[i] // capacity, indices[i] % capacity
        for k in range(block_length):
            step = records[env_index, (place + k) % capacity]
            to = k * indices.size + i
            a_tm1[to] = step.a_tm1
            mu_tm1[to] = step.mu_tm1
            r_t[to] = step.r_t
            discount_t[to] = step.discount_t
            last_t[to] = step.last_t
            _copy_pair(rows, env_index, step.row, step.row + 1, pairs, to, offset)


@kernel
def synchronise(nodes: Any, cursors: Any, seen: Any, capacity: int, weight: float) -> None:
    """Leaves of steps that left since the last call become 0, those of steps that came become ``weight``.

    ``seen[environment]``: steps stored, and the oldest step held, at the last call.
    """
    for env_index in range(cursors.shape[0]):
        count = cursors[env_index, 0]
        oldest = count - cursors[env_index, 1]
        for step in range(max(seen[env_index, 1], seen[env_index, 0] - capacity), min(oldest, seen[env_index, 0])):
            set_leaf(nodes, env_index * capacity + step % capacity, 0.0)
        for step in range(max(seen[env_index, 0], oldest), count):
            set_leaf(nodes, env_index * capacity + step % capacity, weight)
        seen[env_index, 0], seen[env_index, 1] = count, oldest
