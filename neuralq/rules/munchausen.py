"""Munchausen Q-learning: rewards for being sure, and values that count entropy.

With π = softmax(q / τ) two things are added to Q-learning (Vieillard, Pietquin & Geist 2020, eq. 2). The maximum over
the successor's actions becomes the soft value ``Σₐ π[a] (q[a] − τ log π[a]) = τ log Σₐ exp(q[a] / τ)``, which lies
between the maximum and the maximum plus τ log A. And the reward is raised by ``α τ log π[a_tm1]``, at most 0: an
action that the present policy finds unlikely pays for it, which widens the gaps between actions and keeps successive
policies close (implicitly, a Kullback-Leibler penalty of weight α τ). The logarithm is bounded below, since it is −∞
in the limit.

As τ → 0 the soft value is the maximum and the bonus is ``α (q[a_tm1] − max q)``: advantage learning (Baird 1999).
"""

from __future__ import annotations

import torch
from torch import Tensor

from neuralq.checks import check_fraction, check_positive
from neuralq.rules.one_step import TEMPERATURE
from neuralq.rules.policies import softmax
from neuralq.rules.shapes import check_actions, check_same_shape
from neuralq.rules.target_rule import Followed, Option, Seen, TargetRule
from neuralq.rules.targets import expected_value, one_step

__all__ = ["MUNCHAUSEN", "munchausen", "munchausen_bonus", "soft_value"]


def soft_value(q: Tensor, temperature: float) -> Tensor:
    """A state is worth the softmax policy's average plus its entropy: ``τ log Σₐ exp(q[a] / τ)``, without overflow.

    Args:
        q: action values, ``[*n, A]``, -∞ for illegal actions.
        temperature: τ, finite and above 0.

    Returns:
        ``[*n]``, from max q to max q + τ log A; -∞ for a state without legal actions.

    Raises:
        ValueError: if ``temperature`` is not a finite number above 0.

    Source: Vieillard, Pietquin & Geist 2020, appendix B.1.

    Example:
        >>> soft_value(torch.tensor([3.0, 3.0, -torch.inf]), 1.0)  # 3 + log 2
        tensor(3.6931)
    """
    check_positive("temperature", temperature)
    return _best(q) + temperature * _log_mass(q, temperature)


def munchausen_bonus(q_tm1: Tensor, a_tm1: Tensor, temperature: float, alpha: float, floor: float) -> Tensor:
    """The reward for being sure of the action taken: ``α · max(τ log π[a_tm1], floor)``, at most 0.

    Args:
        q_tm1: action values before the step, ``[*n, A]``, -∞ for illegal actions.
        a_tm1: action taken, ``[*n]``, int64.
        temperature: τ of π = softmax(q_tm1 / τ), finite and above 0.
        alpha: α in [0, 1]; 0 gives no bonus.
        floor: below 0, the smallest τ log π that counts.

    Returns:
        ``[*n]``.

    Raises:
        ValueError: for values out of range, leading axes that differ, or actions that are not int64.

    Source: Vieillard, Pietquin & Geist 2020, eq. 2 and section 4.1 (clipping).

    Example:
        >>> munchausen_bonus(torch.tensor([0.0, 0.0]), torch.tensor(1), temperature=1.0, alpha=0.5, floor=-10.0)
        tensor(-0.3466)
    """
    check_positive("temperature", temperature)
    check_fraction("alpha", alpha)
    check_actions("a_tm1", a_tm1, "q_tm1", q_tm1)
    _check_floor("floor", floor)
    # q − max first, then the logarithm: q / τ alone would lose the differences in float32.
    chosen = q_tm1.gather(-1, a_tm1[..., None])[..., 0]
    log_policy = chosen - _best(q_tm1) - temperature * _log_mass(q_tm1, temperature)
    return alpha * log_policy.clamp(floor, 0.0)


def munchausen(
    r_t: Tensor,
    discount_t: Tensor,
    q_tm1: Tensor,
    a_tm1: Tensor,
    q_t: Tensor,
    temperature: float = 0.03,
    alpha: float = 0.9,
    floor: float = -1.0,
) -> Tensor:
    """The Munchausen target adds a reward for being sure to the soft target: ``r_t + bonus + discount_t · soft(q_t)``.

    Args:
        r_t: reward, ``[*n]``.
        discount_t: γ, or 0 at termination, ``[*n]``.
        q_tm1: action values before the step, ``[*n, A]``, from the network that gives ``q_t``.
        a_tm1: action taken, ``[*n]``, int64.
        q_t: action values of the successor, ``[*n, A]``, -∞ for illegal actions.
        temperature: as for `munchausen_bonus`, and so are the next two.
        alpha: weight of the bonus.
        floor: of τ log π.

    Returns:
        Targets, ``[*n]``. As τ → 0 with α = 0 this is Q-learning.

    Raises:
        ValueError: for values out of range, or shapes that differ.

    Source: Vieillard, Pietquin & Geist 2020, eq. 2; defaults of its section 4.1.

    Example:
        >>> q = torch.tensor([0.0, 0.0])
        >>> munchausen(torch.tensor(1.0), torch.tensor(0.5), q, torch.tensor(0), q, 1.0, 1.0)  # 1 − log 2 + ½ log 2
        tensor(0.6534)
    """
    check_same_shape("q_t", q_t, "q_tm1", q_tm1)
    bonus = munchausen_bonus(q_tm1, a_tm1, temperature, alpha, floor)
    check_same_shape("r_t", r_t, "a_tm1", a_tm1)
    return one_step(r_t + bonus, discount_t, soft_value(q_t, temperature))


def _best(q: Tensor) -> Tensor:
    return q.amax(-1)


def _log_mass(q: Tensor, temperature: float) -> Tensor:
    """``log Σₐ exp((q[a] − max q) / τ)``, from 0 to log A; 0 for a state without legal actions."""
    best = _best(q)[..., None]
    gap = (q - best.masked_fill(torch.isneginf(best), 0.0)) / temperature
    return torch.logsumexp(gap, -1).clamp(min=0.0)


def _check_floor(name: str, value: float) -> None:
    if not value < 0:
        raise ValueError(f"{name} must be below 0, the largest logarithm of a probability, got {value!r}; -1 is usual")


def _numbers(seen: Seen) -> tuple[float, float, float]:
    """τ, α and the floor of τ log π."""
    return seen.options["temperature"], seen.options["munchausen_alpha"], seen.options["munchausen_floor"]


def _follows(seen: Seen) -> Followed:
    """The softmax policy, with its entropy on top, and the bonus; quantiles are averaged, as published."""
    temperature, alpha, floor = _numbers(seen)
    pi = softmax(seen.q_t, temperature)
    entropy = soft_value(seen.q_t, temperature) - expected_value(seen.q_t, pi)
    bonus = munchausen_bonus(seen.q_tm1, seen.transition.a_tm1, temperature, alpha, floor)
    return Followed(pi=pi, bonus=bonus, entropy=entropy, averaged=True)


MUNCHAUSEN = TargetRule(
    name="munchausen",
    title="Munchausen Q-learning: soft values and a bonus for being sure",
    source="Vieillard, Pietquin & Geist 2020",
    follows=_follows,
    mean=lambda seen: munchausen(
        seen.r_t, seen.discount_t, seen.q_tm1, seen.transition.a_tm1, seen.q_t, *_numbers(seen)
    ),
    options={
        "temperature": TEMPERATURE,
        "munchausen_alpha": Option(
            0.9, check_fraction, "α, how much of τ log π is added to the reward", "has no Munchausen bonus"
        ),
        "munchausen_floor": Option(
            -1.0,
            _check_floor,
            "the smallest τ log π that counts, in units of scaled rewards",
            "has no Munchausen bonus",
        ),
    },
    refuses={
        "num_steps": "munchausen adds a bonus to every reward and an n-step sample holds only their sum, got num_steps="
        "{num_steps}; leave num_steps=1",
        "bounded": "munchausen's soft values lie up to temperature · log A above every return, outside the grid of a "
        "{distribution} distribution; use distribution='quantile'",
    },
    place=4,
)
