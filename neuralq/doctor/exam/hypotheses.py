"""V3: which mistake would make these values right?

On trajectories of the subject, the return is computed as it is (G) and as a learner with a particular mistake would see
it (G_h): another γ, the sign or the scale of rewards, a time limit taken for the end of the world, no end at all,
rewards
one step late or early. The mistake whose returns the values fit clearly better than G is named.

A second line asks the values alone: where Q(s, a) ≈ α r + β max Q(s', ·) fits within a step, α is the scale of rewards
and β the discount that was learned.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from neuralq.doctor.estimates import bounds_of
from neuralq.doctor.exam.case import CannotMeasure, Case
from neuralq.doctor.exam.values import on_policy, reach
from neuralq.doctor.findings import Finding
from neuralq.doctor.play import Episode, returns_from
from neuralq.types import Floats

__all__ = ["hypotheses", "lines", "one_step"]

_GAMMAS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995)
_BETTER, _ALIKE = 0.8, 0.05
_CORRECT = "as it is"


@dataclass(frozen=True)
class _Hypothesis:
    """A mistake, and the returns that a learner with it would see.

    Args:
        name: completes "a learner with …".
        family: hypotheses of one family differ by a number only.
        returns: of an episode, ``[T]``.
        remedy: what to change.
        confirm: what would confirm it.
        one_step: α and β of Q(s, a) = α r + β max Q(s', ·) under it, where that tells it from others.
    """

    name: str
    family: str
    returns: Callable[[Episode], Floats]
    remedy: str
    confirm: str
    one_step: tuple[float, float] | None = None


def hypotheses(case: Case) -> Finding:
    """V3: the hypothesis that explains the values best, if one does clearly better than "all is right"."""
    made, errors, count = _errors(case)
    right = math.sqrt(errors[_CORRECT].sum() / count.sum())
    rmse = {one.name: math.sqrt(errors[one.name].sum() / count.sum()) for one in made}
    order = sorted(made, key=lambda one: rmse[one.name])
    best, alike = _told_apart(case, order, rmse, 0.02 * right)
    sums = np.column_stack([errors[best.name], errors[_CORRECT], count])

    def difference(s: Floats) -> Floats:
        return np.asarray(np.sqrt(s[:, 0] / s[:, 2]) - np.sqrt(s[:, 1] / s[:, 2]))

    low, high = bounds_of(sums, difference, case.rng(13))
    better = _BETTER if best.family != "scale" else _BETTER / 2  # it has a number of its own to fit
    clear, far, scale = rmse[best.name] < better * right and high < 0, _sees_far(case), max(right, 1e-12)
    said = f"values differ from what was returned by {right:.3g}, and from {best.name} by {rmse[best.name]:.3g}"
    if clear and not far:
        said += "; but the target network was copied too seldom to tell (V5)"
    elif clear and alike is not None:
        said += f"; cannot tell that from {alike.name} ({rmse[alike.name]:.3g})"
    return Finding(
        "V3", f"values are those of a learner with {best.name}", "algorithm", "B", rmse[best.name] / scale,
        (low / scale + 1, high / scale + 1), _BETTER, "our own", clear and far and alike is None, said, best.remedy,
        best.confirm,
    )  # fmt: skip


def lines(case: Case, most: int = 2) -> dict[str, Floats]:
    """What values would be, by the return that followed, under the mistakes that fit them best: ``[≤ 20, 2]`` each.

    Means over twenty equal parts of the steps, in the order of their returns.

    Raises:
        CannotMeasure: returns are not known.
    """
    made, errors, _ = _errors(case)
    found = {}
    for one in sorted(made, key=lambda one: float(errors[one.name].sum()))[:most]:
        right = [case.returns(episode) for episode in case.greedy]
        wrong = [one.returns(episode)[: len(g)] for episode, g in zip(case.greedy, right, strict=True)]
        points = np.column_stack([np.concatenate(right), np.concatenate(wrong)])
        parts = np.array_split(points[np.argsort(points[:, 0], kind="stable")], 20)
        found[one.name] = np.array([part.mean(0) for part in parts if len(part)])
    return found


def _told_apart(
    case: Case, order: Sequence[_Hypothesis], rmse: Mapping[str, float], slack: float
) -> tuple[_Hypothesis, _Hypothesis | None]:
    """The best hypothesis, and another that cannot be told from it, by returns nor by the equation of one step."""
    best = order[0]
    alike = [one for one in order[1:] if rmse[one.name] <= (1 + _ALIKE) * rmse[best.name] + slack]
    alike = [one for one in alike if one.family != best.family]
    rows = np.concatenate([_steps(one) for one in (*case.explored, *case.chance_valued)])
    for other in alike:
        if best.one_step is None or other.one_step is None:
            return best, other
        mine, others = (_residual(rows, *one.one_step) for one in (best, other) if one.one_step is not None)
        if others < _BETTER * mine:
            best = other
        elif mine >= _BETTER * others:
            return best, other
    return best, None


def _residual(rows: Floats, alpha: float, beta: float) -> float:
    """The root mean square of what the equation leaves, no less than a thousandth of the values."""
    left = np.sqrt(((rows[:, 2] - alpha * rows[:, 0] - beta * rows[:, 1]) ** 2).mean())
    return max(float(left), 1e-3 * float(np.abs(rows[:, 2]).mean()))


def _steps(one: Episode) -> Floats:
    """r, max Q(s', ·) (0 past the end of the world) and Q(s, a), ``[T', 3]``."""
    n = one.length if one.terminated else one.length - 1
    ahead = np.append(one.legal_values[1:].max(1), 0.0)
    return np.column_stack([one.rewards, ahead, one.values[np.arange(one.length), one.actions]])[:n]


def _sees_far(case: Case) -> bool:
    try:
        return not reach(case).flagged
    except CannotMeasure:
        return True


def _errors(case: Case) -> tuple[list[_Hypothesis], dict[str, Floats], Floats]:
    """The hypotheses; per hypothesis and episode the squared errors; and the steps of each episode."""
    on_policy(case)  # refuses where returns are not known
    made = _hypotheses(case)
    errors: dict[str, list[float]] = {_CORRECT: [], **{one.name: [] for one in made}}
    count = []
    for one in case.greedy:
        right = case.returns(one)
        n = len(right)
        if not n:
            continue
        q = one.values[np.arange(n), one.actions[:n]]
        count.append(n)
        errors[_CORRECT].append(float(((q - right) ** 2).sum()))
        for other in made:
            errors[other.name].append(float(((q - other.returns(one)[:n]) ** 2).sum()))
    return made, {name: np.array(e) for name, e in errors.items()}, np.array(count, np.float64)


def _whole(one: Episode, gamma: float) -> Floats:
    return returns_from(replace(one, terminated=True, within=one.length), gamma)


def _hypotheses(case: Case) -> list[_Hypothesis]:
    gamma, name, limit = case.gamma, case.world.name, case.world.limit
    found = [_another_gamma(case, other) for other in _GAMMAS if abs(other - gamma) > 1e-9]
    seen = "print(batch.rewards.mean())  # in the learner"
    found.append(
        _Hypothesis(
            "the sign of rewards reversed", "sign", lambda one: -_whole(one, gamma),
            "the learner takes costs for rewards: turn the sign round", seen, (-1.0, gamma),
        )
    )  # fmt: skip
    scale = _scale(case)
    if 0 < scale < 0.5 or scale > 2:
        found.append(
            _Hypothesis(
                f"rewards times {scale:.3g}", "scale", lambda one: scale * _whole(one, gamma),
                "the learner scales rewards: divide its values by the same number, or leave it out", seen, (scale,
                gamma),
            )
        )  # fmt: skip
    if limit is not None:
        found.append(
            _Hypothesis(
                "the time limit taken for the end of the world", "limit", lambda one: _cut(one, gamma, limit),
                "bootstrap past truncation: store `terminated` alone as the end of an episode",
                f"neuralq train {name}  # bootstraps past time limits",
            )
        )  # fmt: skip
    if gamma < 1:
        steady = float(np.concatenate([one.rewards for one in case.greedy]).mean()) / (1 - gamma)
        found.append(
            _Hypothesis(
                "no end of episodes in the target", "mask", lambda one: _whole(one, gamma) + _rest(one, gamma) * steady,
                "multiply the bootstrap by (1 - terminated)", "print((target - batch.rewards)[batch.terminated])",
            )
        )  # fmt: skip
    for title, by in (("rewards one step late", 1), ("rewards one step early", -1)):
        found.append(_misplaced(case, title, by))
    return found


def _another_gamma(case: Case, other: float) -> _Hypothesis:
    return _Hypothesis(
        f"γ = {other:g}", "gamma", lambda one: _whole(one, other),
        f"γ = {case.gamma:g} was declared, and the values are those of γ = {other:g}: use one and the same; "
        "values whose training is not over yet look the same: train longer, and see whether they grow"
        + ("" if case.world.limit is None else "; so do those of a learner that takes the time limit for the end"),
        f"neuralq train {case.world.name} --learner replay --gamma {case.gamma:g}", (1.0, other),
    )  # fmt: skip


def _misplaced(case: Case, title: str, by: int) -> _Hypothesis:
    return _Hypothesis(
        title, title, lambda one: _whole(replace(one, rewards=_shifted(one.rewards, by)), case.gamma),
        "store the reward with the action that earned it", "print(buffer.rewards[:5], rewards[:5])",
    )  # fmt: skip


def _cut(one: Episode, gamma: float, limit: int) -> Floats:
    """Returns with nothing after the limit."""
    rewards = np.where(np.arange(one.length) < limit, one.rewards, 0.0)
    return _whole(replace(one, rewards=rewards), gamma)


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


def _scale(case: Case) -> float:
    """C of the least squares fit Q ~ c G."""
    pairs = on_policy(case)
    q, g = (np.concatenate([pair[k] for pair in pairs]) for k in (0, 1))
    return float(q @ g / (g @ g)) if g @ g > 0 else 1.0


def one_step(case: Case) -> Finding:
    """V3a: α and β of Q(s, a) ~ α r + β max Q(s', ·) within episodes, without intercept."""
    rows = [_steps(one) for one in (*case.explored, *case.chance_valued) if one.length > 1]
    if len(rows) < 5:
        raise CannotMeasure("there are fewer than 5 episodes of more than a step")
    grams = np.array([np.concatenate([(r[:, :2].T @ r).reshape(-1), [(r[:, 2] ** 2).sum()]]) for r in rows])
    if _condition(grams.sum(0)[:6].reshape(2, 3)[:, :2]) > 1e4:
        raise CannotMeasure("rewards and values do not vary apart, so that α and β cannot be told from each other")
    alpha, beta, r2 = _fit(grams.sum(0)[None])
    bounds = bounds_of(grams, lambda s: _fit(s)[1], case.rng(14))
    off = bool(r2[0] > 0.9 and (alpha[0] < 0 or bounds[1] < case.gamma - 0.05 or bounds[0] > case.gamma + 0.05))
    return Finding(
        "V3a", "values follow from the next ones by another equation", "algorithm", "C", float(beta[0]), bounds,
        case.gamma,
        "our own; α = 1 and β = γ where all is right", off,
        f"within a step Q(s, a) = {alpha[0]:.3f} r + {beta[0]:.3f} max Q(s', ·), with R² {r2[0]:.3f}",
        "compare reward scale, sign and γ of the learner with what was declared", "print the target of one transition",
    )  # fmt: skip


def _condition(gram: Floats) -> float:
    """Of the Gram matrix of columns of length 1."""
    lengths = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    return float(np.linalg.cond(gram / np.outer(lengths, lengths)))


def _fit(sums: Floats) -> tuple[Floats, Floats, Floats]:
    cross = sums[:, :6].reshape(-1, 2, 3)
    weights = np.linalg.solve(cross[:, :, :2] + 1e-12 * np.eye(2), cross[:, :, 2:])[:, :, 0]
    explained = (weights * cross[:, :, 2]).sum(1)
    r2: Floats = explained / np.maximum(sums[:, 6], 1e-300)
    return weights[:, 0].astype(np.float64), weights[:, 1].astype(np.float64), r2
