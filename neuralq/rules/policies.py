"""Policies as probabilities: from action values ``[*n, A]`` to a distribution over actions ``[*n, A]``.

A policy here is not something that acts but a tensor of probabilities, so it can be sampled, averaged over (expected
Sarsa), divided by (importance ratios) and tested. Drawing an action is a separate function that is handed its uniform
numbers, so the randomness belongs to whoever owns the generator.

Illegal actions carry q = -∞ and get probability exactly 0 under every policy; exploration is spread over the legal
ones only. A row without any legal action gives a row of zeros, and a row with a NaN a row of NaN: `sample` refuses
both.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neuralq.checks import check_fraction, check_positive
from neuralq.rules.shapes import align_leading, check_same_shape

__all__ = ["epsilon_greedy", "greedy", "greedy_random_ties", "k_to_the_q", "sample", "softmax"]


def greedy(q: Tensor) -> Tensor:
    """All probability on the best action, the lowest index among ties.

    Args:
        q: action values, ``[*n, A]``, -∞ for illegal actions.

    Returns:
        Probabilities, ``[*n, A]``, in the dtype of ``q``.

    Example:
        >>> greedy(torch.tensor([1.0, 3.0, 3.0]))
        tensor([0., 1., 0.])
    """
    best, chosen = q.amax(-1, keepdim=True), q.argmax(-1, keepdim=True)
    return torch.zeros_like(q).scatter(-1, chosen, 1.0) * _mass(best)


def greedy_random_ties(q: Tensor) -> Tensor:
    """Equal probability on every best action: ties are broken at random, explicitly.

    Args:
        q: action values, ``[*n, A]``, -∞ for illegal actions.

    Returns:
        Probabilities, ``[*n, A]``, in the dtype of ``q``.

    Example:
        >>> greedy_random_ties(torch.tensor([1.0, 3.0, 3.0]))
        tensor([0.0000, 0.5000, 0.5000])
    """
    best = q.amax(-1, keepdim=True)
    tied = (q == best).to(q.dtype)
    return tied / tied.sum(-1, keepdim=True).clamp(min=1.0) * _mass(best)


def epsilon_greedy(q: Tensor, epsilon: Tensor | float, random_ties: bool = False) -> Tensor:
    """Greedy with probability 1 - ε, otherwise uniform over the legal actions (the greedy one included).

    Args:
        q: action values, ``[*n, A]``, -∞ for illegal actions.
        epsilon: a number in [0, 1], or one per row ``[*n]`` (values in [0, 1] are the caller's care).
        random_ties: share the greedy part among ties instead of giving it to the lowest index.

    Returns:
        Probabilities, ``[*n, A]``, in the dtype of ``q``.

    Raises:
        ValueError: if a number ``epsilon`` is outside [0, 1], or its shape does not match.

    Source: Watkins 1989, section 11.

    Example:
        >>> epsilon_greedy(torch.tensor([1.0, 3.0, -torch.inf]), 0.5)
        tensor([0.2500, 0.7500, 0.0000])
    """
    if isinstance(epsilon, Tensor):
        epsilon = epsilon.to(q.dtype)
    else:
        check_fraction("epsilon", epsilon, "0 is greedy, 1 is uniform")
    exploit = greedy_random_ties(q) if random_ties else greedy(q)
    legal = (~torch.isneginf(q)).to(q.dtype)
    uniform = legal / legal.sum(-1, keepdim=True).clamp(min=1.0)
    share = align_leading("epsilon", epsilon, "q", q)
    return (1.0 - share) * exploit + share * uniform


def k_to_the_q(q: Tensor, k: float) -> Tensor:
    """Each action is chosen in proportion to k raised to its value: ``P(a) = k^q[a] / Σ_b k^q[b]``.

    k > 1 exploits, the more the larger k; k = 1 is uniform over the legal actions; k < 1 prefers *low* values. Equal
    to a softmax with temperature 1 / ln k, computed relative to the likeliest action, so nothing overflows. (Some
    printings of the book flatten the exponent to "kQ".)

    Args:
        q: action values, ``[*n, A]``, -∞ for illegal actions, whose probability is 0 for every k.
        k: finite, above 0. It may grow with the iterations.

    Returns:
        Probabilities, ``[*n, A]``, in the dtype of ``q``; differentiable in ``q``.

    Raises:
        ValueError: if ``k`` is not a finite number above 0.

    Source: Mitchell 1997, section 13.3.5.

    Example:
        >>> k_to_the_q(torch.tensor([1.0, 2.0]), 3.0)  # 3 : 9
        tensor([0.2500, 0.7500])
        >>> k_to_the_q(torch.tensor([1.0, 2.0, -torch.inf]), 1.0)
        tensor([0.5000, 0.5000, 0.0000])
    """
    check_positive("k", k)
    return _boltzmann(q, math.log(k))


def softmax(q: Tensor, temperature: float) -> Tensor:
    """Each action is chosen in proportion to ``exp(q[a] / temperature)``, without overflow.

    Args:
        q: action values, ``[*n, A]``, -∞ for illegal actions.
        temperature: finite, above 0: small is nearly greedy, large nearly uniform.

    Returns:
        Probabilities, ``[*n, A]``, in the dtype of ``q``; differentiable in ``q``.

    Raises:
        ValueError: if ``temperature`` is not a finite number above 0.

    Example:
        >>> softmax(torch.tensor([0.0, 1000.0, 1000.0]), 1.0)
        tensor([0.0000, 0.5000, 0.5000])
    """
    check_positive("temperature", temperature)
    return _boltzmann(q, min(1.0 / temperature, torch.finfo(q.dtype).max))


def sample(probabilities: Tensor, u: Tensor) -> Tensor:
    """Actions drawn by inverting the cumulative distribution; one of probability 0 is never drawn.

    That holds whatever the rounding.

    The answer is the first action whose cumulative probability exceeds u times the row's sum, so rows that sum to
    0.9999999 in float32 are drawn without bias towards the last action.

    Args:
        probabilities: ``[*n, A]``, non-negative.
        u: uniform numbers in [0, 1), ``[*n]`` (1, which float32 rounding can produce, draws the last possible action).

    Returns:
        Actions, ``[*n]``, int64.

    Raises:
        ValueError: if a row is negative somewhere, not finite or sums to 0 (no legal action), or u is outside [0, 1].

    Example:
        >>> sample(torch.tensor([[0.25, 0.75, 0.0], [0.25, 0.75, 0.0]]), torch.tensor([0.2, 0.9999999]))
        tensor([0, 1])
    """
    cumulative = probabilities.cumsum(-1)
    total = cumulative[..., -1]
    check_same_shape("u", u, "each row of probabilities", total)
    sound = (probabilities.amin(-1) >= 0) & (total > 0) & (total < torch.inf) & (u >= 0) & (u <= 1)
    if not sound.all():
        row = int((~sound).reshape(-1).nonzero()[0, 0])
        flat = probabilities.reshape(-1, probabilities.shape[-1])
        raise ValueError(
            "probabilities must be non-negative and finite with a positive sum, and u in [0, 1]; got "
            f"{flat[row].tolist()} and u={u.reshape(-1)[row].item()} in row {row} of {flat.shape[0]} "
            "(NaN action values, or a state without legal actions?)"
        )
    possible = probabilities > 0
    num_possible = possible.cumsum(-1)
    final = num_possible == num_possible[..., -1:]  # from the last possible action on: taken if rounding skips the rest
    reached = possible & ((cumulative > (u * total)[..., None]) | final)
    return reached.to(torch.uint8).argmax(-1)


def _mass(best: Tensor) -> Tensor:
    """1 for a row with a best action, 0 for one without legal actions, NaN where the values are not finite."""
    return torch.where(torch.isneginf(best), 0.0, best * 0.0 + 1.0)


def _boltzmann(q: Tensor, scale: float) -> Tensor:
    """``exp(scale · q)``, normalised over the legal actions; ``scale`` may have either sign."""
    illegal = torch.isneginf(q)
    if scale >= 0:
        likeliest = q.amax(-1, keepdim=True)
    else:  # the smallest legal value: illegal ones must not count as small
        likeliest = q.masked_fill(illegal, torch.inf).amin(-1, keepdim=True)
    no_choice = illegal.all(-1, keepdim=True)
    gap = q.masked_fill(illegal, 0.0) - likeliest.masked_fill(no_choice, 0.0)
    span = torch.finfo(q.dtype).max
    logits = scale * gap.clamp(-span, span)  # at most 0 for a legal action, and never 0 · ∞
    # A row without legal actions gets equal logits, so that neither it nor its derivative is NaN.
    weights = torch.softmax(logits.masked_fill(illegal & ~no_choice, -torch.inf), -1)
    return weights.masked_fill(illegal, 0.0)
