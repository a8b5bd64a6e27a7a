"""D1–D5: the experience that was learned from.

Columns of the ``.npz``: ``obs, action, reward, terminated, truncated, next_obs`` in the order of time, one
environment's rows after each other; ``age`` where rows are not in that order. Where actions are masked, ``action_mask``
says which were legal at ``obs``, and ``next_action_mask`` at ``next_obs``; without it the next row's mask is taken.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from neuralq.doctor.exam.case import CannotMeasure, Case
from neuralq.doctor.findings import Finding, Grade
from neuralq.runs.offline.recorded import Recorded
from neuralq.types import Array, Indices

__all__ = [
    "actions_taken",
    "check_columns",
    "few_batches",
    "greedy_only",
    "legal_in_data",
    "merged_ends",
    "of_recorded",
    "reset_leak",
    "rewards_seen",
    "window",
]

COLUMNS = ("obs", "action", "reward", "terminated", "truncated", "next_obs")
_MASKS = ("action_mask", "next_action_mask")


def check_columns(stored: Mapping[str, Array]) -> dict[str, Array]:
    """The columns, if they are all there and equally long.

    Raises:
        ValueError: one is missing or of another length, with the line that writes the file.

    Example:
        >>> check_columns({"obs": np.zeros((2, 3))})
        Traceback (most recent call last):
        ValueError: the data lack the column 'action'; write it with numpy.savez('data.npz', obs=…, action=…, ...
    """
    write = "numpy.savez('data.npz', " + ", ".join(f"{name}=…" for name in COLUMNS) + ")"
    for name in COLUMNS:
        if name not in stored:
            raise ValueError(f"the data lack the column {name!r}; write it with {write}")
    num, names = len(stored["reward"]), [*COLUMNS, *(name for name in _MASKS if name in stored)]
    for name in names:
        if len(stored[name]) != num or num == 0:
            raise ValueError(f"the column {name!r} has {len(stored[name])} rows and 'reward' {num}; write {write}")
    found = {name: np.asarray(stored[name]) for name in names}
    for name in ("action", "reward", "terminated", "truncated"):
        found[name] = found[name].reshape(num)
    order = np.argsort(np.asarray(stored["age"]).reshape(num))[::-1] if "age" in stored else np.arange(num)
    return {name: column[order] for name, column in found.items()}


def of_recorded(given: Recorded, masks: Array | None = None) -> dict[str, Array]:
    """The columns of a record, without the steps of which nobody knows what came next.

    Args:
        given: the record.
        masks: which actions were legal, ``[N, A]``; None where nothing says so.
    """
    columns = (
        given.observations, given.actions, given.rewards, given.terminations, given.truncations, given.successors
    )  # fmt: skip
    found = dict(zip(COLUMNS, columns, strict=True)) | ({} if masks is None else {"action_mask": masks})
    return {name: column[given.known] for name, column in check_columns(found).items()}


def _stored(case: Case) -> Mapping[str, Array]:
    if case.stored is None:
        raise CannotMeasure("the data that was learned from was not given (--data file.npz)")
    return case.stored


def _lengths(stored: Mapping[str, Array]) -> tuple[Array, Array]:
    """Steps of each episode that begins in the data, and the row of its last step."""
    ends = stored["terminated"].astype(bool) | stored["truncated"].astype(bool)
    same = (stored["next_obs"][:-1] == stored["obs"][1:]).reshape(len(ends) - 1, -1).all(1)
    last = np.flatnonzero(ends | np.append(~same, True))
    lengths = np.diff(np.concatenate([[-1], last]))
    return lengths, last


def legal_in_data(case: Case) -> tuple[Array, Array] | None:
    """Which actions were legal in each row and in what it led to, ``[N, A]`` bool; none in what nobody knows.

    Returns:
        None where neither the data nor the environment know of masks.

    Raises:
        CannotMeasure: the environment masks actions and the data do not say which were legal.
    """
    stored, num = _stored(case), case.world.num_actions
    if "action_mask" not in stored:
        if not case.masked:
            return None
        raise CannotMeasure(
            "the environment masks actions, and the data do not say which were legal; add a column action_mask, [N, A]"
        )
    for name in (name for name in _MASKS if name in stored):
        if stored[name].shape[1:] != (num,):
            shape = list(stored[name].shape[1:])
            raise CannotMeasure(f"a row of the column {name} has the shape {shape}, and there are {num} actions")
    now = stored["action_mask"] != 0
    if "next_action_mask" in stored:
        return now, stored["next_action_mask"] != 0
    goes_on = np.ones(len(now), bool)
    goes_on[_lengths(stored)[1]] = False
    return now, np.roll(now, -1, axis=0) & goes_on[:, None]


def merged_ends(case: Case) -> Finding:
    """D1: rows that are marked as terminated and were truncated."""
    stored = _stored(case)
    terminated, truncated = (stored[name].astype(bool) for name in ("terminated", "truncated"))
    both = int((terminated & truncated).sum())
    limit, at = case.world.limit, 0
    if limit is not None:
        lengths, last = _lengths(stored)
        by_end = lengths[terminated[last]]
        near = [int((by_end == limit - k).sum()) for k in range(1, 6)]
        at = int((by_end == limit).sum())
        at = at if at > 3 + 3 * max(near) else 0
    rows = max(both, at)
    return Finding(
        "D1", "truncation is stored as termination", "data", "B", float(rows), None, 0.0, "any", rows > 0,
        f"{rows} rows are marked as the end of the world where the time limit cut the episode",
        "store `terminated` alone as the end, and bootstrap past `truncated`",
        "buffer.add(obs, action, reward, terminated, next_obs)  # not terminated or truncated",
    )  # fmt: skip


def reset_leak(case: Case) -> Finding:
    """D2: rows that were cut and whose successor is the first observation of the next episode."""
    stored = _stored(case)
    cut = stored["truncated"].astype(bool)[:-1] | stored["terminated"].astype(bool)[:-1]
    same = (stored["next_obs"][:-1] == stored["obs"][1:]).reshape(len(cut), -1).all(1)
    rows = int((cut & same).sum())
    return Finding(
        "D2", "the next episode's start is stored as a successor", "data", "B", float(rows), None, 0.0, "any", rows > 0,
        f"in {rows} of {int(cut.sum())} rows at which an episode ended, next_obs is where the next one began",
        "store info['final_obs'] at the end of an episode (vector environments that reset by themselves)",
        "assert not (next_obs[:-1][ends[:-1]] == obs[1:][ends[:-1]]).all(-1).any()",
    )  # fmt: skip


def window(case: Case) -> Finding:
    """D3: how many episodes, and how many horizons, are stored at a time."""
    if case.stored is not None:
        lengths, _ = _lengths(case.stored)
        rows, episodes = float(len(case.stored["reward"])), float(len(lengths))
    elif case.settings.capacity is not None:
        rows = min(case.settings.capacity, case.settings.env_steps or case.settings.capacity)
        episodes = rows / max(float(np.mean([one.length for one in case.chance])), 1.0)
    else:
        raise CannotMeasure("neither the data nor the size of the buffer is known (--data, or --set capacity=N)")
    typical = min(case.horizon, float(np.median([one.within for one in case.greedy])))
    spans = rows / max(typical, 1.0)
    few = episodes < 10 or spans < 3
    return Finding(
        "D3", "the buffer holds too little", "data", "B", spans, None, 3.0, "our own: 10 episodes and 3 horizons", few,
        f"the buffer holds {rows:,.0f} steps, some {episodes:,.0f} episodes and {spans:,.1f} times as long as "
        f"rewards matter",
        "a larger buffer: 10,000 steps and more", f"neuralq train {case.world.name} --learner replay --capacity 50000",
    )  # fmt: skip


def few_batches(case: Case) -> Finding:
    """D3a: how many batches the replay buffer holds, as the settings say."""
    capacity, batch = case.settings.capacity, case.settings.batch_size
    if capacity is None or not batch:
        raise CannotMeasure("the size of the buffer or of a batch is not known (--set capacity=N --set batch_size=N)")
    return Finding(
        "D3a", "the buffer holds hardly more than a batch", "data", "B", capacity / batch, None, 10.0, "our own",
        capacity < 10 * batch,
        f"the buffer holds {capacity:,.0f} steps and a batch is {batch:,.0f}: updates see the latest steps alone, and "
        "what was learned of others is lost",
        "a larger buffer: 10,000 steps and more", f"neuralq train {case.world.name} --learner replay --capacity 50000",
    )  # fmt: skip


def greedy_only(case: Case) -> Finding:
    """D4a: whether the settings let anything but the greedy action be tried."""
    first, last = case.settings.epsilon_start, case.settings.epsilon_end
    if first is None or last is None:
        raise CannotMeasure("how it explored is not known (--set epsilon_start=E --set epsilon_end=E)")
    return Finding(
        "D4a", "nothing was explored", "data", "B", max(first, last), None, 0.0, "any", first == last == 0,
        f"ε went from {first:g} to {last:g}"
        + ("" if first or last else ": nothing but the greedy action was ever tried, and better ones stay unseen"),
        "explore: ε from 1 down to 0.05, over a tenth of training or more",
        "DQN(..., exploration_initial_eps=1.0, exploration_final_eps=0.05)  # and train again",
    )  # fmt: skip


def actions_taken(case: Case) -> Finding:
    """D4: how much of every action there is, in the data or else in greedy episodes."""
    num = case.world.num_actions
    grade: Grade
    if case.stored is not None:
        index = np.asarray(case.stored["action"], np.int64) - case.world.first_action
        legal = legal_in_data(case)
        counts = _chosen(np.clip(index, 0, num - 1), None if legal is None else legal[0], num)
        said, grade = "in the data", "B"
    else:
        masks = [one.legal[:-1] for one in case.greedy if one.legal is not None]
        taken = np.concatenate([one.actions for one in case.greedy])
        counts = _chosen(taken, np.concatenate(masks) if masks else None, num)
        said, grade = "in greedy episodes", "C"
    share = counts / counts.sum()
    most = float(share.max())
    kept = share[share > 0]
    entropy = float(-(kept * np.log(kept)).sum() / np.log(num)) if num > 1 else 1.0
    return Finding(
        "D4", "hardly any action but one is tried", "data", grade, most, None, 0.95, "our own", most > 0.95,
        f"{said} action {int(share.argmax())} makes {100 * most:.3g} %, the entropy is {entropy:.2f} of its most",
        "explore more: ε from 1 down to 0.05, over a tenth of training or more",
        "DQN(..., exploration_initial_eps=1.0, exploration_final_eps=0.05)  # and train again",
    )  # fmt: skip


def _chosen(actions: Indices, legal: Array | None, num: int) -> Indices:
    """How often each action was taken where there was a choice, ``[A]``."""
    chosen = actions if legal is None else actions[legal.sum(1) > 1]
    if not len(chosen):
        raise CannotMeasure("nowhere was more than one action legal")
    return np.bincount(chosen, minlength=num)


def rewards_seen(case: Case) -> Finding:
    """D5: the share of rows that hold a reward."""
    stored = _stored(case)
    share = float((stored["reward"] != 0).mean())
    return Finding(
        "D5", "no reward was ever seen", "data", "B", share, None, 0.0, "none at all", share == 0,
        f"{100 * share:.3g} % of the stored steps hold a reward", "explore longer, or give rewards on the way",
        "print((buffer.rewards != 0).mean())",
    )  # fmt: skip
