"""V7: where the environment is a finite model, exact values in place of estimates."""

from __future__ import annotations

from typing import cast

import numpy as np

from neuralq.doctor.exam.case import CannotMeasure, Case
from neuralq.doctor.findings import Finding
from neuralq.exact import solve
from neuralq.exact.evaluation import evaluate
from neuralq.mdp import FiniteMDP
from neuralq.types import Array, Indices

__all__ = ["against_optimum", "regret"]

_THRESHOLD = 0.1


def regret(case: Case) -> Finding:
    """V7: what the greedy policy loses from the start, over the span of the optimal values; exact."""
    model, values = _values(case)
    best = solve(model, case.gamma)
    greedy = np.where(_legal(case, model), values, -np.inf).argmax(1)
    v = evaluate(model, np.where(model.is_terminal, -1, greedy), case.gamma)
    start = model.start_distribution
    lost = float(start @ (best.v - v))
    scale = max(float(np.ptp(best.v)), float(np.abs(start @ best.v)), 1e-12)
    share = lost / scale
    off = share > _THRESHOLD
    said = f"from the start the greedy policy is worth {start @ v:.6g}, and the best {start @ best.v:.6g} (exact)"
    return Finding(
        "V7", "the greedy policy is worse than the best", "algorithm", "B", share, (share, share), _THRESHOLD,
        "our own", off,
        said, "see the other findings; the exact answer says in which states the policy errs",
        f"neuralq solve {case.world.name} --gamma {case.gamma:g}",
    )  # fmt: skip


def against_optimum(case: Case) -> Finding:
    """V7a: the errors |Q − Q*| over the largest |Q*|, at the states that its policy meets; exact."""
    model, values = _values(case)
    best = solve(model, case.gamma)
    met = np.zeros(model.num_states, bool)
    for one in (*case.greedy, *case.explored):
        met[_states(case, one.observations)] = True
    rows = (_legal(case, model) & met[:, None]) & ~model.is_terminal[:, None]
    if not rows.any():
        raise CannotMeasure("no state of the model was met")
    errors = np.abs(values - np.nan_to_num(best.q))[rows]
    scale = max(float(np.nanmax(np.abs(best.q))), 1e-12)
    worst, typical = float(errors.max()) / scale, float(np.sqrt((errors**2).mean())) / scale
    return Finding(
        "V7a", "values are far from the optimal ones", "algorithm", "B", typical, (typical, worst), 1.0, "our own",
        typical > 1,
        f"at {int(met.sum())} states that were met, values differ from Q* by {100 * typical:.3g} % of its largest "
        f"(exact)",
        "an update that diverges: see the lab's verdict (R3) and its remedies",
        f"neuralq solve {case.world.name} --gamma {case.gamma:g}",
    )  # fmt: skip


def _values(case: Case) -> tuple[FiniteMDP, np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
    model, seen = case.world.model, case.world.seen_as
    if model is None:
        raise CannotMeasure("the environment has no model that could be solved exactly")
    space = case.world.observation_space
    if seen is None or (case.world.is_discrete and int(space.n) != model.num_states):  # type: ignore[attr-defined]
        raise CannotMeasure("what the states of the model look like is not known")
    return model, case.subject.values(seen)


def _legal(case: Case, model: FiniteMDP) -> Array:
    """The model's legal actions, less those that masks forbid: where a state was met, or the environment says it."""
    legal = model.legal.copy()
    if not case.masked:
        return legal
    env = case.world.make()
    asked = getattr(env.unwrapped, "action_mask", None)  # as Taxi has it
    if callable(asked) and case.world.is_discrete:
        legal &= np.stack([np.asarray(asked(s)) != 0 for s in range(model.num_states)])
    env.close()
    met: dict[bytes, Array] = {}
    for one in case.episodes:
        seen = one.observations.astype(cast(Array, case.world.seen_as).dtype)
        met |= {s.tobytes(): mask for s, mask in zip(seen, one.legal if one.legal is not None else (), strict=False)}
    for state, looks in enumerate(cast(Array, case.world.seen_as)):
        legal[state] &= met.get(looks.tobytes(), True)
    return np.where(legal.any(1, keepdims=True), legal, model.legal)


def _states(case: Case, observations: Array) -> Indices:
    """The states that look so; of several that look alike all."""
    assert case.world.seen_as is not None
    met = {np.asarray(s).tobytes() for s in observations.astype(case.world.seen_as.dtype)}
    return np.flatnonzero([s.tobytes() in met for s in case.world.seen_as])
