"""V1, V2, V4–V6, V8: what the values say against what the episodes paid."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from neuralq.doctor.estimates import bounds_of, rank_correlation
from neuralq.doctor.exam.case import CannotMeasure, Case, greedy_of, legal_at, stacked
from neuralq.doctor.exam.retraining import further_reach, in_words, retrained
from neuralq.doctor.exam.stored import legal_in_data
from neuralq.doctor.findings import Finding
from neuralq.doctor.play import Episode, legal_in
from neuralq.types import Array, Floats

__all__ = ["better_actions", "bias", "generalisation", "has_learned", "rank", "reach", "soft_divergence"]


_BIAS, _EXCESS, _REACH, _RANK, _WORSE, _FRESH = 0.1, 1.1, 0.9, 0.3, 0.2, 2.0
"""Thresholds of V2, V4, V5, V6, V6a and V8."""


def has_learned(case: Case) -> Finding:
    """V1: the greedy return beside that of chance and of the best action played alone."""
    rng = case.rng(11)
    own, chance = (np.array([one.score for one in group]) for group in (case.greedy, case.chance))
    low, high = _mean_bounds(own, rng)
    alone = {a: np.array([one.score for one in group]) for a, group in case.constant.items() if group}
    best = max(alone, key=lambda a: float(alone[a].mean()))
    others = {"random": _mean_bounds(chance, rng)[1], f"action {best} alone": _mean_bounds(alone[best], rng)[1]}
    name = max(others, key=lambda key: others[key])
    learned = low > others[name]
    said = (
        f"{len(own)} greedy episodes return {own.mean():.4g} (from {low:.4g} to {high:.4g}), random ones "
        f"{chance.mean():.4g}, and action {best} alone {alone[best].mean():.4g}"
    )
    return Finding(
        "V1", "the policy is no better than none", "algorithm", "B", float(own.mean()), (low, high), others[name],
        f"the upper bound of {name}", not learned, said,
        "see what the other findings say; without one: train longer, with a larger step size, and explore more",
        f"neuralq train {case.world.name}  # does a learner with tuned settings do better?",
    )  # fmt: skip


def _mean_bounds(values: Floats, rng: np.random.Generator) -> tuple[float, float]:
    if len(values) < 2 or values.std() == 0:
        return float(values.mean()), float(values.mean())
    return bounds_of(np.column_stack([values, np.ones(len(values))]), lambda s: s[:, 0] / s[:, 1], rng)


def on_policy(case: Case, episodes: Sequence[Episode] | None = None) -> list[tuple[Floats, Floats]]:
    """Q and G of the steps whose return is known, episode by episode.

    Raises:
        CannotMeasure: there are too few of them.
    """
    found = []
    for one in case.greedy if episodes is None else episodes:
        returns = case.returns(one)
        if len(returns):
            n = len(returns)
            found.append((one.values[np.arange(n), one.actions[:n]], returns))
    if len(found) < 5:
        raise CannotMeasure(
            f"{len(found)} episodes have steps whose discounted return is known to the end (5 are needed): the "
            f"limit of "
            "steps is too short for γ and cannot be lifted"
        )
    return found


def bias(case: Case) -> Finding:
    """V2: b = mean(Q − G) / max(|mean G|, sd G), where it goes (van Hasselt et al. 2016; Chen et al. 2021)."""
    pairs = on_policy(case)
    sums = np.array([[(q - g).sum(), len(g), g.sum(), (g * g).sum()] for q, g in pairs])

    def share(s: Floats) -> Floats:
        mean = s[:, 2] / s[:, 1]
        spread = np.sqrt(np.maximum(s[:, 3] / s[:, 1] - mean**2, 0))
        return np.asarray(s[:, 0] / s[:, 1] / np.maximum(np.maximum(np.abs(mean), spread), 1e-12))

    value = float(share(sums.sum(0)[None])[0])
    low, high = bounds_of(sums, share, case.rng(12))
    off = low > _BIAS or high < -_BIAS
    mean_q, mean_g = (float(np.concatenate([p[k] for p in pairs]).mean()) for k in (0, 1))
    way = "over" if value > 0 else "under"
    said = f"values average {mean_q:.4g} where {mean_g:.4g} was returned, {100 * abs(value):.3g} % {way}"
    return Finding(
        "V2", "values are overestimated" if value > 0 else "values are underestimated", "algorithm", "B", value,
        (low, high), _BIAS, "our own; the quantity is that of REDQ (Chen et al. 2021)", off, said,
        "double Q-learning, or a lower γ" if value > 0 else "see reach (V5) and the hypotheses (V3)",
        f"neuralq train {case.world.name} --learner replay --target-rule double"
        if value > 0 else f"neuralq train {case.world.name}  # λ-returns, which bootstrap less",
    )  # fmt: skip


def soft_divergence(case: Case) -> Finding:
    """V4: max |Q| over what any return can be (van Hasselt et al. 2018)."""
    pool = [*case.greedy, *case.explored]
    values = np.concatenate([one.values[... if one.legal is None else one.legal[:-1]].reshape(-1) for one in pool])
    if not np.isfinite(values).all():
        return Finding(
            "V4", "values are not finite", "algorithm", "B", float("nan"), None, None, "any", True,
            "the network gives NaN or infinity", "a smaller step size, and gradients clipped", "train again with lr "
            "/ 10",
        )  # fmt: skip
    most = float(np.abs(values).max())
    bound = _largest_return(case)
    if bound == 0:
        raise CannotMeasure("no reward was seen, so that nothing bounds a value")
    ratio = most / bound
    said = f"the largest |Q| is {most:.4g}, and no return can exceed {bound:.4g}"
    return Finding(
        "V4", "values exceed every possible return", "algorithm", "B", ratio, None, _EXCESS, "van Hasselt et al. 2018",
        ratio > _EXCESS, said,
        "a target network that is copied less often, a smaller step size, and the end of episodes in the target",
        f"neuralq train {case.world.name}  # λ-returns with LayerNorm; and neuralq lab prescribe",
    )  # fmt: skip


def _largest_return(case: Case) -> float:
    longest = max(one.length for one in case.episodes)
    return case.largest_reward / (1 - case.gamma) if case.gamma < 1 else case.largest_reward * longest


def reach(case: Case) -> Finding:
    """V5: ρ = (1 − γ^(nK)) / (1 − γ^L), the share of a steady stream that nK steps see of the L that matter.

    Each copy into the target network carries rewards n steps further back. L is the longest episode that the world
    ended; where a limit cut episodes short, values have no end and L is infinite.
    """
    ahead = case.settings.steps_of_reach
    if ahead is None:
        raise CannotMeasure(
            "how often the target network was copied is not known; say --set target_period_updates=N --set updates=M"
        )
    cut = any(not one.terminated for one in case.episodes)
    longest = max(one.length for one in case.episodes)
    if case.gamma >= 1:
        if cut:
            raise CannotMeasure("with γ = 1 and episodes that are cut short, no number of copies is enough")
        value = min(ahead / longest, 1.0)
    else:
        value = (1 - case.gamma**ahead) / (1.0 if cut else 1 - case.gamma**longest)
    value = min(value, 1.0)
    said = (
        f"rewards can have been carried back at most {ahead:,.0f} steps, which see {100 * value:.3g} % of what a "
        f"steady "
        f"stream is worth at γ = {case.gamma:g}"
    )
    changes = further_reach(case)
    return Finding(
        "V5", "values cannot see far enough: the target network was copied too seldom", "algorithm", "B", value, None,
        _REACH, "our own; ρ = 1 − γ^(nK) was measured as predicted", value < _REACH, said,
        f"{in_words(changes)}; or λ-returns", _confirming_reach(case, changes),
    )  # fmt: skip


def _confirming_reach(case: Case, changes: Mapping[str, Any]) -> str:
    """Training again with these changes and everything else as it was, by whoever trained it and by a learner here."""
    known, ours = case.settings, retrained(case, changes)
    if not case.subject.origin.startswith("DQN of Stable-Baselines3"):
        return ours
    steps, updates = known.env_steps or 50_000, known.updates or 1.0
    told = {
        "n_steps": changes["num_steps"],
        "target_update_interval": round(changes["target_period_updates"] * steps / updates),
        **({"learning_rate": changes["learning_rate"]} if "learning_rate" in changes else {}),
    }
    said = ", ".join(f"{name}={value:g}" for name, value in told.items())
    total = changes.get("total_steps", int(steps))
    return f"DQN('MlpPolicy', env, {said}).learn({total})  # the rest as it was\n{ours}"


def rank(case: Case) -> Finding:
    """V6: Spearman's correlation of Q and G, within ε-greedy episodes."""
    pairs = on_policy(case, case.explored)
    q, g = (np.concatenate([pair[k] for pair in pairs]) for k in (0, 1))
    if g.std() < 0.1 * max(abs(float(g.mean())), 1e-12):
        raise CannotMeasure("returns hardly differ between states, so that there is no order to get right")
    rho = rank_correlation(q, g)
    return Finding(
        "V6", "values do not order states by their returns", "algorithm", "C", rho, None, _RANK, "our own", rho < _RANK,
        f"the rank correlation of values and returns is {rho:.2f}", "see the other findings", "plot Q against G: "
        "the page does",
    )  # fmt: skip


def better_actions(case: Case) -> Finding:
    """V6: in copies of the environment, the share of states where another action is significantly better.

    Each of some states of ε-greedy episodes is copied, every action tried, and the greedy policy followed from there,
    with the same random numbers for each action.
    """
    if case.clock.left < 0.25 * case.clock.budget_s:
        raise CannotMeasure("too little of the budget was left; give more with --budget")
    states = _snapshots(case)
    gains = _gains(case, states)  # [states, actions, repeats] relative to the greedy action
    scale = max(float(np.abs(gains).max()), 1e-12)
    mean, spread = gains.mean(2), gains.std(2, ddof=1) / np.sqrt(gains.shape[2])
    worse = ((mean > 2 * spread) & (mean > 0.02 * scale) & (mean > 1e-9)).any(1)
    low, high = bounds_of(np.column_stack([worse, np.ones(len(worse))]), lambda s: s[:, 0] / s[:, 1], case.rng(17))
    share = float(worse.mean())
    return Finding(
        "V6a", "another action is better in many states", "algorithm", "B", share, (low, high), _WORSE, "our own",
        low > _WORSE,
        f"in {int(worse.sum())} of {len(worse)} states another action returned significantly more than the greedy one",
        "the values order actions wrongly: train longer, explore more, or mend what the other findings name",
        f"neuralq train {case.world.name}  # and compare returns",
    )  # fmt: skip


_NUM_STATES, _REPEATS, _MOST_AHEAD = 24, 3, 300
_FEW_STATES, _LARGE = 8, 10_000
"""States where an observation has so many numbers: each is followed for thousands of steps, all through the network."""


def _snapshots(case: Case) -> list[tuple[Any, Array, Array]]:
    """Environments in states of ε-greedy episodes, played side by side, with what is seen there and which is legal."""
    rng, world = case.rng(16), case.world
    half = max(int(np.median([one.length for one in case.explored])) // 2, 1)
    tried: list[list[int]] = []  # per state and step the action in place of the greedy one; −1 for none
    for _ in range(_NUM_STATES if case.greedy[0].observations[0].size < _LARGE else _FEW_STATES):
        steps = int(rng.integers(0, half))
        tried.append([int(rng.integers(world.num_actions)) if rng.random() < 0.1 else -1 for _ in range(steps)])
    envs = [world.make() for _ in tried]
    told = [env.reset(seed=5000 + i) for i, env in enumerate(envs)]
    for t in range(max(map(len, tried))):
        going = [i for i, one in enumerate(tried) if t < len(one)]
        legal = np.stack([legal_in(envs[i], told[i][1], world.num_actions) for i in going])
        best = greedy_of(case.subject.values(np.stack([told[i][0] for i in going])), legal)
        for i, a, allowed in zip(going, best.tolist(), legal, strict=True):
            other = tried[i][t]
            a = other if other >= 0 and allowed[other] else a
            s, _, terminated, truncated, info = envs[i].step(a + world.first_action)
            told[i] = envs[i].reset() if terminated or truncated else (s, info)
    return [
        (env, np.array(s), legal_in(env, info, world.num_actions)) for env, (s, info) in zip(envs, told, strict=True)
    ]


def _copied(env: Any) -> Any:
    try:
        return copy.deepcopy(env)
    except Exception as error:
        raise CannotMeasure(f"the environment cannot be copied ({type(error).__name__})") from error


def _gains(case: Case, states: list[tuple[Any, Array, Array]]) -> Floats:
    """Discounted return of every action beside that of the greedy one, ``[states, actions, repeats]``; 0 if illegal."""
    world, num = case.world, case.world.num_actions
    legal = np.stack([mask for _, _, mask in states])
    greedy = greedy_of(case.subject.values(np.stack([s for _, s, _ in states])), legal)
    envs, seen, total = list[Any](), list[Array](), np.zeros((len(states), num, _REPEATS))
    for env, s, _ in states:
        for _ in range(num):
            for j in range(_REPEATS):
                one = _copied(env)
                one.unwrapped.np_random = np.random.default_rng(j)
                envs.append(one)
                seen.append(s)
    allowed = np.repeat(legal, num * _REPEATS, axis=0)  # in what follows
    flat, going = total.reshape(-1), np.flatnonzero(np.repeat(legal.reshape(-1), _REPEATS)).tolist()
    actions = np.tile(np.repeat(np.arange(num), _REPEATS), len(states))
    for t in range(min(_MOST_AHEAD, case.horizon)):
        if t:
            actions[going] = greedy_of(_values(case, [seen[i] for i in going]), allowed[going])
        still = []
        for i in going:
            seen[i], r, terminated, truncated, info = envs[i].step(int(actions[i]) + world.first_action)
            if case.masked:
                allowed[i] = legal_in(envs[i], info, num)
            flat[i] += case.gamma**t * float(r)
            if not (terminated or truncated):
                still.append(i)
        going = still
        if not going or case.clock.left <= 0:
            break
    gains: Floats = total - total[np.arange(len(states)), greedy][:, None, :]
    return np.where(legal[:, :, None], gains, 0.0)


def _values(case: Case, seen: Sequence[Array]) -> Floats:
    """Action values, of each observation once: copies that acted alike see the same."""
    distinct = {np.asarray(s).tobytes(): s for s in seen}
    places = {name: k for k, name in enumerate(distinct)}
    return case.subject.values(np.stack(list(distinct.values())))[[places[np.asarray(s).tobytes()] for s in seen]]


def generalisation(case: Case) -> Finding:
    """V8: the TD error on fresh experience over that on the data that was learned from (Li et al. 2023)."""
    stored = case.stored
    if stored is None:
        raise CannotMeasure("the data that was learned from was not given (--data file.npz)")
    masks = legal_in_data(case)
    known = (
        np.ones(len(stored["reward"]), bool) if masks is None else stored["terminated"].astype(bool) | masks[1].any(1)
    )
    if not known.any():
        raise CannotMeasure("of no stored step it is known which actions were legal after it")
    pick = case.rng(18).permutation(np.flatnonzero(known))[:2000]
    legal = None if masks is None else masks[1][pick]
    learned = _td_error(case, legal, *(stored[k][pick] for k in ("obs", "action", "reward", "next_obs", "terminated")))
    s, a, r, s_t, ended, _ = stacked(case.explored)
    within = np.concatenate([np.arange(one.length) < one.within for one in case.explored])
    fresh_rows = case.rng(19).permutation(np.flatnonzero(within))[:2000]
    legal = legal_at(case.explored, fresh_rows, later=1)
    fresh = _td_error(case, legal, *(x[fresh_rows] for x in (s, a + case.world.first_action, r, s_t, ended)))
    ratio = fresh / max(learned, 1e-12)
    return Finding(
        "V8", "errors are larger on fresh experience", "data", "C", ratio, None, _FRESH, "Li et al. 2023",
        ratio > _FRESH,
        f"the mean squared TD error is {fresh:.3g} on fresh experience and {learned:.3g} on the stored data",
        "a smaller network, fewer updates per step, or more data", "halve the updates per step, and compare",
    )  # fmt: skip


def _td_error(case: Case, legal: Array | None, s: Array, a: Array, r: Array, s_t: Array, ended: Array) -> float:
    """The mean square over steps; ``legal`` says of which actions after them the best is meant."""
    index = np.asarray(a, np.int64).reshape(-1) - case.world.first_action
    q = case.subject.values(s)[np.arange(len(s)), index]
    after = case.subject.values(s_t)
    best = after.max(1) if legal is None else np.where(legal, after, -np.inf).max(1)
    ahead = np.where(np.asarray(ended, bool).reshape(-1), 0.0, best)
    return float(((np.asarray(r, np.float64).reshape(-1) + case.gamma * ahead - q) ** 2).mean())
