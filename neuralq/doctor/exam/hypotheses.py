"""V3: which mistake would make these values right?

On trajectories of the subject, the return is computed as it is (G) and as a learner with a particular mistake would see
it (G_h): another γ, the sign or the scale of rewards, a time limit taken for the end of the world, no end at all, rewards
one step late or early. The mistake whose returns the values fit clearly better than G is named.

A second line asks the values alone: where Q(s, a) ≈ α r + β max Q(s', ·) fits within a step, α is the scale of rewards
and β the discount that was learned.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from neuralq.doctor.estimates import bounds_of
from neuralq.doctor.exam.case import CannotMeasure, Case
from neuralq.doctor.exam.values import on_policy, reach
from neuralq.doctor.findings import Cause, Finding
from neuralq.doctor.play import Episode, returns_from
from neuralq.types import Floats

__all__ = ["hypotheses", "one_step"]

_GAMMAS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995)
_BETTER, _ALIKE = 0.8, 0.05
_CORRECT = "as it is"


def hypotheses(case: Case) -> Finding:
    """V3: the hypothesis that explains the values best, if one does clearly better than "all is right"."""
    told, errors, count = _errors(case)
    right = math.sqrt(errors[_CORRECT].sum() / count.sum())
    rmse = {name: math.sqrt(e.sum() / count.sum()) for name, e in errors.items() if name != _CORRECT}
    order = sorted(rmse, key=lambda name: rmse[name])
    best = order[0]
    sums = np.column_stack([errors[best], errors[_CORRECT], count])

    def difference(s: Floats) -> Floats:
        return np.asarray(np.sqrt(s[:, 0] / s[:, 2]) - np.sqrt(s[:, 1] / s[:, 2]))

    low, high = bounds_of(sums, difference, case.rng(13))
    clear = rmse[best] < _BETTER * right and high < 0
    far = _sees_far(case)
    alike = [n for n in order[1:] if rmse[n] < (1 + _ALIKE) * rmse[best] and told[n][3] != told[best][3]]
    cause, remedy, confirm, family = told[best]
    said = f"values differ from returns {_CORRECT} by {right:.3g}, and from returns {best} by {rmse[best]:.3g}"
    if clear and not far:
        said += "; but the target network was copied too seldom to tell (V5)"
    elif clear and alike:
        said += f"; cannot tell that from {alike[0]} ({rmse[alike[0]]:.3g})"
    del family
    return Finding(
        "V3", f"values are those of a learner with: {best}", cause, "B", rmse[best] / max(right, 1e-12),
        (low / max(right, 1e-12) + 1, high / max(right, 1e-12) + 1), _BETTER, "our own", clear and far and not alike, said,
        remedy, confirm,
    )  # fmt: skip


def _sees_far(case: Case) -> bool:
    try:
        return not reach(case).flagged
    except CannotMeasure:
        return True


def _errors(case: Case) -> tuple[dict[str, tuple[Cause, str, str, str]], dict[str, Floats], Floats]:
    """Per hypothesis: cause, remedy, confirmation and family; and per episode the squared errors, and the steps."""
    on_policy(case)  # refuses where returns are not known
    made = _hypotheses(case)
    told = {name: one[0] for name, one in made.items()}
    errors: dict[str, list[float]] = {_CORRECT: [], **{name: [] for name in made}}
    count = []
    for one in case.greedy:
        right = returns_from(one, case.gamma, 0.01 if case.world.liftable else 0.05)
        n = len(right)
        if not n:
            continue
        q = one.values[np.arange(n), one.actions[:n]]
        count.append(n)
        errors[_CORRECT].append(float(((q - right) ** 2).sum()))
        for name, (_, returns) in made.items():
            errors[name].append(float(((q - returns(one)[:n]) ** 2).sum()))
    kept = {name: np.array(e) for name, e in errors.items() if np.isfinite(e).all()}
    return told, kept, np.array(count, np.float64)


def _whole(one: Episode, gamma: float) -> Floats:
    return returns_from(replace(one, terminated=True, within=one.length), gamma)


Made = Mapping[str, tuple[tuple[Cause, str, str, str], Callable[[Episode], Floats]]]


def _hypotheses(case: Case) -> Made:
    gamma, name = case.gamma, case.world.name
    found: dict[str, tuple[tuple[Cause, str, str, str], Callable[[Episode], Floats]]] = {}
    again = f"neuralq train {name} --learner replay --gamma"
    for other in _GAMMAS:
        if abs(other - gamma) > 1e-9:
            remedy = f"γ = {gamma:g} was declared, and the values are those of γ = {other:g}: use one and the same"
            found[f"γ = {other:g}"] = (
                ("algorithm", remedy, f"{again} {gamma:g}", "gamma"), lambda one, g=other: _whole(one, g)
            )  # fmt: skip
    found["the sign of rewards reversed"] = (
        ("algorithm", "the learner takes costs for rewards: turn the sign round", "print(batch.rewards.mean())", "sign"),
        lambda one: -_whole(one, gamma),
    )
    scale = _scale(case)
    if scale is not None and (0 < scale < 0.5 or scale > 2):
        found[f"rewards times {scale:.3g}"] = (
            ("algorithm", "the learner scales rewards: divide its values by the same number, or leave it out",
             "print(batch.rewards.mean())", "scale"),
            lambda one: scale * _whole(one, gamma),
        )  # fmt: skip
    if case.world.limit is not None:
        found["the time limit taken for the end of the world"] = (
            ("algorithm", "bootstrap past truncation: store `terminated` alone as the end, not `terminated or truncated`",
             f"neuralq train {name}  # bootstraps past time limits", "limit"),
            lambda one: _whole(replace(one, rewards=np.where(np.arange(one.length) < case.world.limit, one.rewards, 0.0)),
                               gamma),
        )  # fmt: skip
    if gamma < 1:
        mean = float(np.concatenate([one.rewards for one in case.greedy]).mean())
        found["no end of episodes in the target"] = (
            ("algorithm", "multiply the bootstrap by (1 - terminated)", "print(target[batch.terminated] == "
             "batch.rewards[batch.terminated])", "mask"),
            lambda one: _whole(one, gamma) + _rest(one, gamma) * mean / (1 - gamma),
        )  # fmt: skip
    for title, shift in (("rewards one step late", 1), ("rewards one step early", -1)):
        found[title] = (
            ("algorithm", "store the reward with the action that earned it", "print(buffer.rewards[:5], rewards[:5])", title),
            lambda one, by=shift: _whole(replace(one, rewards=_shifted(one.rewards, by)), gamma),
        )  # fmt: skip
    return found


def _rest(one: Episode, gamma: float) -> Floats:
    """γ^(T − t), by which what follows the end would be discounted; 0 where the world did not end it."""
    return np.asarray(gamma ** np.arange(one.length, 0, -1.0) * one.terminated)


def _shifted(rewards: Floats, by: int) -> Floats:
    moved = np.zeros_like(rewards)
    if by > 0:
        moved[by:] = rewards[:-by]
    else:
        moved[:by] = rewards[-by:]
    return moved


def _scale(case: Case) -> float | None:
    pairs = on_policy(case)
    q, g = (np.concatenate([pair[k] for pair in pairs]) for k in (0, 1))
    return float(q @ g / (g @ g)) if g @ g > 0 else None


def one_step(case: Case) -> Finding:
    """V3a: α and β of Q(s, a) ~ α r + β max Q(s', ·) where the episode goes on, without intercept."""
    rows, names = [], []
    for i, one in enumerate(case.explored):
        n = one.length - 1
        if n > 0:
            q = one.values[np.arange(n), one.actions[:n]]
            rows.append(np.column_stack([one.rewards[:n], one.values[1 : n + 1].max(1), q]))
            names.append(i)
    if len(rows) < 5:
        raise CannotMeasure("there are fewer than 5 episodes of more than a step")
    grams = np.array([np.concatenate([(r[:, :2].T @ r).reshape(-1), [(r[:, 2] ** 2).sum()]]) for r in rows])
    if np.linalg.cond(grams.sum(0)[:6].reshape(2, 3)[:, :2]) > 1e10:
        raise CannotMeasure("rewards and values do not vary apart, so that α and β cannot be told from each other")
    alpha, beta, r2 = _fit(grams.sum(0)[None])
    bounds = bounds_of(grams, lambda s: _fit(s)[1], case.rng(14))
    off = bool(r2[0] > 0.9 and (alpha[0] < 0 or bounds[1] < case.gamma - 0.05 or bounds[0] > case.gamma + 0.05))
    return Finding(
        "V3a", "values follow from the next ones by another equation", "algorithm", "C", float(beta[0]), bounds, case.gamma,
        "our own; α = 1 and β = γ where all is right", off,
        f"within a step Q(s, a) = {alpha[0]:.3f} r + {beta[0]:.3f} max Q(s', ·), with R² {r2[0]:.3f}",
        "compare reward scale, sign and γ of the learner with what was declared", "print the target of one transition",
    )  # fmt: skip


def _fit(sums: Floats) -> tuple[Floats, Floats, Floats]:
    cross = sums[:, :6].reshape(-1, 2, 3)
    weights = np.linalg.solve(cross[:, :, :2] + 1e-12 * np.eye(2), cross[:, :, 2:])[:, :, 0]
    explained = (weights * cross[:, :, 2]).sum(1)
    return weights[:, 0], weights[:, 1], np.asarray(explained / np.maximum(sums[:, 6], 1e-300))
