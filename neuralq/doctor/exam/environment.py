"""E1–E5: whether the environment is what it says it is. None of them needs the values."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from neuralq.doctor.estimates import area_under_curve, held_out_scores
from neuralq.doctor.exam.case import CannotMeasure, Case, any_of
from neuralq.doctor.findings import Finding
from neuralq.doctor.play import Episode, legal_in
from neuralq.types import Floats

__all__ = ["contract", "determinism", "disguised_limit", "observation_scale", "reward_scale"]

_TIME_TO_IMPORT_S = 30.0
_CONFIRM_CHECK = (
    "import gymnasium as gym\nfrom gymnasium.utils.env_checker import check_env\n"
    "check_env(gym.make({name!r}).unwrapped)"
)


def contract(case: Case) -> Finding:
    """E1: Gymnasium's checker, NaN, and observations outside their space."""
    problem = _broken_numbers(case.episodes) or _outside(case)
    problem = problem or (None if case.masked else _checked(case))  # checkers try actions that are illegal
    return Finding(
        "E1", "the environment breaks its contract", "environment", "B", float(problem is not None), None, 0.5,
        "Gymnasium's contract: any fault counts", problem is not None,
        problem or f"{_checkers(case)}, and every number that was seen, found nothing",
        "mend the environment first: whatever is learned from it is in doubt",
        _CONFIRM_CHECK.format(name=case.world.name),
    )  # fmt: skip


def _checkers(case: Case) -> str:
    if case.masked:
        return "what was played (checkers would try illegal actions)"
    return "Gymnasium's checker" + (" and Stable-Baselines3's" if _second_checker(case) is not None else "")


def _broken_numbers(episodes: Sequence[Episode]) -> str | None:
    for one in episodes:
        if not np.isfinite(one.rewards).all():
            t = int(np.argmin(np.isfinite(one.rewards)))
            return f"the reward of step {t} is {one.rewards[t]}, which is no finite number"
        if one.observations.dtype.kind == "f" and not np.isfinite(one.observations).all():
            return "an observation holds NaN or infinity, which no network can learn from"
    return None


def _outside(case: Case) -> str | None:
    space = case.world.observation_space
    for one in case.episodes[:: max(1, len(case.episodes) // 40)]:
        for s in one.observations[:: max(1, len(one.observations) // 20)]:
            inside = space.contains(np.asarray(s, space.dtype)) if case.world.is_discrete else space.contains(s)
            if not inside:
                return f"an observation of shape {list(s.shape)} and dtype {s.dtype} lies outside {str(space)[:90]}"
    return None


def _second_checker(case: Case) -> Callable[..., None] | None:
    """Stable-Baselines3's, where it is installed and there is time to import it."""
    if case.clock.budget_s < _TIME_TO_IMPORT_S:
        return None
    try:
        from stable_baselines3.common.env_checker import check_env as found
    except ImportError:
        return None
    return cast(Callable[..., None], found)


def _checked(case: Case) -> str | None:
    env = case.world.make()
    asked = "Gymnasium's"
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            check_env(env.unwrapped, skip_render_check=True, skip_close_check=True)
            if (second := _second_checker(case)) is not None and _takes(env.unwrapped):
                asked = "Stable-Baselines3's"
                second(env.unwrapped, warn=False, skip_render_check=True)
    except Exception as error:
        return f"{asked} check_env says: {(str(error) or type(error).__name__).splitlines()[0][:200]}"
    finally:
        env.close()
    return None


def _takes(env: Any) -> bool:
    """Whether Stable-Baselines3 has such spaces: it refuses others, which says nothing against the environment."""
    space, actions = env.observation_space, env.action_space
    return isinstance(space, spaces.Box) or (isinstance(space, spaces.Discrete) and space.start == actions.start == 0)


def determinism(case: Case) -> Finding:
    """E2: the same seed and the same 200 actions must do the same, bit for bit."""
    world, seen = case.world, []
    for _ in range(2):
        env, rng = world.make(), case.rng(2)
        try:
            s, info = env.reset(seed=case.seed)
            trace = [np.asarray(s).tobytes()]
            for _ in range(200):
                a = int(any_of(legal_in(env, info, world.num_actions)[None], rng)[0])
                s, r, terminated, truncated, info = env.step(a + world.first_action)
                trace += [np.asarray(s).tobytes(), np.float64(r).tobytes()]
                if terminated or truncated:
                    s, info = env.reset()
                    trace.append(np.asarray(s).tobytes())
        finally:
            env.close()
        seen.append(trace)
    same = seen[0] == seen[1]
    return Finding(
        "E2", "the seed does not decide what happens", "environment", "C", float(not same), None, 0.5,
        "bit-equal or not",
        not same,
        f"two runs of one seed and the same 200 actions were {'the same' if same else 'different'}, bit for bit",
        "draw every random number from self.np_random, which reset(seed=...) seeds",
        "run reset(seed=0) and the same actions twice, and compare",
    )  # fmt: skip


def disguised_limit(case: Case) -> Finding:
    """E3: episodes that end by ``terminated`` at one constant step, where the last observation tells nothing of an end.

    Pardo et al. (2018): a time limit is no end of the world; values must be bootstrapped past it.
    """
    groups = [case.greedy, case.explored, case.chance, *case.constant.values()]
    ended = [(k, one) for k, group in enumerate(groups) for one in group if one.terminated]
    if not ended:
        return _limit_finding(1.0, 0, "no episode ended by `terminated`")
    longest = max(one.length for _, one in ended)
    near = [(k, one) for k, one in ended if one.length >= 0.8 * longest]
    at = [(k, one) for k, one in near if one.length == longest]
    share = len(at) / len(near)
    if len(at) < 20 or len({k for k, _ in at}) < 2 or share < 0.5 or longest < 4:
        said = f"of {len(near)} episodes that the world ended late, {len(at)} ended at step {longest} exactly"
        return _limit_finding(1.0, longest, said)
    episodes = [one for _, one in at][:60]
    auc, drift = (_told_apart(case, episodes, step) for step in (longest, longest - 1))
    alike = "look like" if auc < _alike(drift) else "do not look like"
    said = (
        f"{len(at)} of the {len(near)} longest episodes ended by `terminated` at step {longest} exactly, under several "
        f"policies, and their last observations {alike} those before (AUC {auc:.2f}, and {drift:.2f} a step earlier)"
    )
    return _limit_finding(auc, longest, said, drift)


def _alike(drift: float) -> float:
    """Below which AUC an observation looks like those before it, where others that end nothing are told by `drift`."""
    return min(max(0.85, drift + 0.05), 0.95)


def _limit_finding(auc: float, longest: int, said: str, drift: float = 0.0) -> Finding:
    return Finding(
        "E3", "a time limit is reported as termination", "environment", "B", auc, None, _alike(drift),
        "Pardo et al. 2018; half of the late ends at one step, and the AUC, are our own", auc < _alike(drift),
        said,
        "return truncated=True at the limit, or leave it to gymnasium.make(..., max_episode_steps=N)",
        f"env.reset(); print([env.step(env.action_space.sample())[2:4] for _ in range({max(longest, 1)})][-1])",
    )  # fmt: skip


def _told_apart(case: Case, episodes: Sequence[Episode], step: int) -> float:
    """How well the observation at a step is told from the few before it, by AUC."""
    if case.width > 2000:
        raise CannotMeasure("observations of more than 2,000 numbers are not regressed on")
    rng = case.rng(3)
    rows, labels, names = [], [], []
    for i, one in enumerate(episodes):
        earlier = step - 1 - rng.permutation(min(5, step - 2))[:4]  # near it: states drift over a long episode
        rows += [one.observations[step], *one.observations[earlier]]
        labels += [1.0, *[0.0] * len(earlier)]
        names += [i] * (1 + len(earlier))
    x, y = case.world.as_rows(np.stack(rows)), np.array(labels)
    return area_under_curve(held_out_scores(x, y[:, None], np.array(names), rng)[:, 0], y > 0)


def observation_scale(case: Case) -> Finding:
    """E4: how differently large the entries of an observation are, and how large."""
    if case.world.is_discrete:
        raise CannotMeasure("observations are numbers of states, which have no scale")
    if case.world.observation_space.dtype == np.uint8:
        raise CannotMeasure("observations are pictures in bytes, whose scale is known")
    rows = np.concatenate([one.observations[:-1] for one in (*case.greedy, *case.explored, *case.chance)])
    x = case.world.as_rows(rows)
    large = float(np.quantile(np.abs(x), 0.99))
    spread = x.std(0)
    moving = spread[spread > 1e-9 * max(float(spread.max()), 1e-300)]
    ratio = float(moving.max() / moving.min()) if moving.size else 1.0
    said = (
        f"99 % of the entries of observations lie below {large:.3g}, and their spreads differ by a factor {ratio:.3g}"
    )
    return Finding(
        "E4", "observations are badly scaled", "representation", "C", large, None, 10.0,
        "RLDebugger's ±10, and a ratio of spreads of 100", bool(large > 10 or ratio > 100), said,
        "scale observations to about ±1: gymnasium.wrappers.NormalizeObservation, VecNormalize, or their known bounds",
        "env = gymnasium.wrappers.NormalizeObservation(env)  # and train again",
    )  # fmt: skip


def reward_scale(case: Case) -> Finding:
    """E5: how large values can get, and whether there are rewards at all."""
    most = case.largest_reward
    bound = most / (1 - case.gamma) if case.gamma < 1 else most * max(one.length for one in case.episodes)
    random: Floats = np.concatenate([one.rewards for one in case.chance])
    dense = float((random != 0).mean())
    said = (
        f"the largest |reward| is {most:.4g}, so that values can reach {bound:.4g}; {100 * dense:.3g} % of random "
        "steps pay"
    )
    return Finding(
        "E5", "rewards are badly scaled" if dense >= 0.001 else "rewards are sparse", "environment", "C", bound, None,
        100.0,
        "van Hasselt et al. 2018 assume |r| ≤ 1", bool(bound > 100 * (1 + 1e-9) or dense < 0.001), said,
        "scale rewards to at most 1: gymnasium.wrappers.TransformReward, VecNormalize, or reward_scale in neuralq"
        if dense >= 0.001 else "explore longer, or give rewards on the way (potential-based, Ng et al. 1999)",
        f"env = gymnasium.wrappers.TransformReward(env, lambda r: r / {most or 1:.4g})  # and train again",
    )  # fmt: skip
