"""Distributions of returns: what a transition says the whole distribution of Q(s_tm1, a_tm1) should be.

The return of a pair is a random variable Z with mean Q. Its distribution obeys Z(s, a) = R + γ Z(s', a') in law, and
after a step each represented value z becomes ``r_t + discount_t · z``. Two finite descriptions of Z are learned:

* quantiles (Dabney et al. 2018): K values of probability 1/K each, the i-th of which stands for the level
  τ_i = (2i + 1)/(2K). A value that misses its level is pulled by τ upwards and by 1 − τ downwards (`quantile_huber`);
  the values move freely, so no range has to be known;
* categories (Bellemare, Dabney & Munos 2017): probabilities on a fixed grid. The moved values fall between the points
  of the grid and are shared between the two neighbours in inverse proportion to the distance
  (`categorical_projection`). Inside the range of the grid that keeps the mean exactly; outside it values are clipped.

What is followed in the successor is decided by the means, as in Q-learning; nothing in this file chooses. A policy that
draws its action has the mixture of the actions' distributions for its return.
"""

from __future__ import annotations

import torch
from torch import Tensor

from neuralq.checks import check_positive, check_whole
from neuralq.rules.losses import huber
from neuralq.rules.shapes import check_same_shape
from neuralq.rules.target_rule import Followed
from neuralq.rules.targets import one_step, weighted_value

__all__ = [
    "categorical_cross_entropy",
    "categorical_projection",
    "followed_mass",
    "followed_values",
    "quantile_huber",
    "quantile_levels",
]


def quantile_levels(num_quantiles: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """The levels of K quantiles are the midpoints of K equal slices of probability: ``τ_i = (2i + 1) / (2K)``.

    The values at these levels are the K equally likely ones that come closest to a distribution (in 1-Wasserstein
    distance).

    Args:
        num_quantiles: K.
        dtype: of the answer.

    Returns:
        ``[K]``, increasing, inside (0, 1).

    Raises:
        ValueError: if ``num_quantiles`` is not a whole number of at least 1.

    Source: Dabney et al. 2018, lemma 2.

    Example:
        >>> quantile_levels(2).tolist()
        [0.25, 0.75]
    """
    check_whole("num_quantiles", num_quantiles)
    return (torch.arange(num_quantiles, dtype=dtype) + 0.5) / num_quantiles


def quantile_huber(
    quantiles_tm1: Tensor,
    target: Tensor,
    delta: float = 1.0,
    levels: Tensor | None = None,
    probabilities: Tensor | None = None,
) -> Tensor:
    """Quantile regression: an error is punished by τ if the value was too low and by 1 − τ if it was too high.

    ``Σ_i mean_j |τ_i − 1{u_ij < 0}| · huber(u_ij)`` with ``u_ij = target[j] − quantiles_tm1[i]``.

    Args:
        quantiles_tm1: the values of one pair, ``[*n, K]``.
        target: the values they should describe, ``[*n, J]``.
        delta: where Huber's parabola becomes a line, above 0; the smaller, the nearer to exact quantiles.
        levels: τ of each value, ``[*n, K]``; None for `quantile_levels`.
        probabilities: of the target's values, ``[*n, J]``; None where they are equally likely.

    Returns:
        ``[*n]``.

    Raises:
        ValueError: if the leading axes differ or ``delta`` is not a finite number above 0.

    Source: Dabney et al. 2018, eq. 10 (their κ is ``delta``); with other levels Dabney, Ostrovski, Silver & Munos 2018.

    Example:
        Both errors are +1 and −1: ¾·½ + ¼·½, for the one quantile at level ½ they weigh the same.

        >>> quantile_huber(torch.tensor([2.0]), torch.tensor([3.0, 1.0]))
        tensor(0.2500)
        >>> quantile_huber(torch.tensor([2.0, 2.0]), torch.tensor([3.0]))
        tensor(0.5000)
    """
    check_positive("delta", delta)
    check_same_shape("each column of target", target[..., 0], "each column of quantiles_tm1", quantiles_tm1[..., 0])
    error = target[..., None, :] - quantiles_tm1[..., :, None]
    if levels is None:
        tau = quantile_levels(quantiles_tm1.shape[-1], quantiles_tm1.dtype).to(error.device)[:, None]
    else:
        check_same_shape("levels", levels, "quantiles_tm1", quantiles_tm1)
        tau = levels[..., None]
    each = torch.where(error < 0, 1.0 - tau, tau) * huber(error, delta)
    if probabilities is None:
        return each.mean(-1).sum(-1)
    check_same_shape("probabilities", probabilities, "target", target)
    return (each * probabilities[..., None, :]).sum(-1).sum(-1)


def followed_values(
    r_t: Tensor, discount_t: Tensor, values_t: Tensor, followed: Followed
) -> tuple[Tensor, Tensor | None]:
    """The values of what is followed, each moved by the step: ``r_t + discount_t · z``, and how likely they are.

    Args:
        r_t: reward, ``[*n]``.
        discount_t: γ, or 0 at termination, ``[*n]``.
        values_t: equally likely values of every action of the successor, ``[*n, A, K]``.
        followed: what is done there, and what is added.

    Returns:
        Values and their probabilities: ``[*n, K]`` and None for equally likely ones, or where a policy draws its action
        ``[*n, A·K]`` twice. Where no action is legal the first stands in, for nothing comes after.

    Source: Dabney et al. 2018, eq. 13; mixtures: Bellemare, Dabney & Rowland 2023, chapter 4.

    Example:
        >>> pi = torch.tensor([0.25, 0.75])
        >>> followed_values(torch.tensor(1.0), torch.tensor(0.5), torch.tensor([[2.0], [4.0]]), Followed(pi=pi))
        (tensor([2., 3.]), tensor([0.2500, 0.7500]))
    """
    num_atoms, probabilities = values_t.shape[-1], None
    if followed.a is not None:
        z = _of_action(values_t, followed.a)
    elif followed.averaged:
        z = (_policy(followed)[..., None] * values_t).sum(-2)
    else:
        z = values_t.flatten(-2)
        probabilities = (_or_first(_policy(followed)) / num_atoms).repeat_interleave(num_atoms, -1)
    if followed.entropy is not None:
        z = z + followed.entropy[..., None]
    r_t = r_t if followed.bonus is None else r_t + followed.bonus
    return one_step(r_t[..., None].expand_as(z), discount_t[..., None].expand_as(z), z), probabilities


def followed_mass(r_t: Tensor, discount_t: Tensor, logits_t: Tensor, support: Tensor, followed: Followed) -> Tensor:
    """The mass of what is followed, moved by the step and projected on the grid it came from.

    Args:
        r_t: reward, ``[*n]``.
        discount_t: γ, or 0 at termination, ``[*n]``.
        logits_t: of every action of the successor, ``[*n, A, K]``.
        support: the grid, ``[K]``.
        followed: what is done there, and what is added. A policy mixes the actions' mass.

    Returns:
        Probabilities, ``[*n, K]``.

    Source: Bellemare, Dabney & Munos 2017, algorithm 1.

    Example:
        >>> logits, grid = torch.zeros(1, 3), torch.tensor([0.0, 1.0, 2.0])
        >>> followed_mass(torch.tensor(1.0), torch.tensor(0.0), logits, grid, Followed(a=torch.tensor(0)))
        tensor([0., 1., 0.])
    """
    if followed.a is not None:
        mass = torch.softmax(_of_action(logits_t, followed.a), -1)
    else:
        mass = (_or_first(_policy(followed))[..., None] * torch.softmax(logits_t, -1)).sum(-2)
    r_t = r_t if followed.bonus is None else r_t + followed.bonus
    if followed.entropy is None:
        moved = discount_t[..., None] * support
    else:
        moved = weighted_value(discount_t[..., None], support + followed.entropy[..., None])
    return categorical_projection(r_t[..., None] + moved, mass, support)


def _of_action(numbers: Tensor, a: Tensor) -> Tensor:
    """The K numbers of the given actions: ``([*n, A, K], [*n]) -> [*n, K]``."""
    return numbers.gather(-2, a[..., None, None].expand(*a.shape, 1, numbers.shape[-1]))[..., 0, :]


def _policy(followed: Followed) -> Tensor:
    assert followed.pi is not None
    return followed.pi


def _or_first(pi: Tensor) -> Tensor:
    """``pi``, with all of it on the first action where none is legal."""
    none = (pi.sum(-1, keepdim=True) == 0).to(pi.dtype)
    return pi + torch.nn.functional.pad(none, (0, pi.shape[-1] - 1))


def categorical_projection(values: Tensor, probabilities: Tensor, support: Tensor) -> Tensor:
    """Mass at any values, moved to an even grid: each value is shared between its two neighbours on the grid.

    ``m[i] = Σ_j probabilities[j] · max(0, 1 − |clip(values[j]) − support[i]| / spacing)``. The total is kept, and so is
    the mean where no value lies outside the grid; such values count as its nearest end.

    Args:
        values: where the mass is, ``[*n, J]``, finite.
        probabilities: how much of it, ``[*n, J]``.
        support: the grid, ``[K]`` with K ≥ 2, increasing in equal steps (the caller's care).

    Returns:
        ``[*n, K]``.

    Raises:
        ValueError: if the shapes differ or the grid has fewer than two points.

    Source: Bellemare, Dabney & Munos 2017, eq. 7 and algorithm 1.

    Example:
        Half of the mass is a quarter of the way from 1 to 2, half of it beyond the end.

        >>> values, probabilities = torch.tensor([1.25, 9.0]), torch.tensor([0.5, 0.5])
        >>> categorical_projection(values, probabilities, torch.tensor([0.0, 1.0, 2.0]))
        tensor([0.0000, 0.3750, 0.6250])
    """
    check_same_shape("probabilities", probabilities, "values", values)
    if support.ndim != 1 or len(support) < 2:
        raise ValueError(f"support must be a grid [K] of at least 2 points, got shape {list(support.shape)}")
    spacing = (support[-1] - support[0]) / (len(support) - 1)
    inside = torch.clamp(values, support[0], support[-1])
    share = (1.0 - (inside[..., None, :] - support[:, None]).abs() / spacing).clamp(min=0.0)
    return (share * probabilities[..., None, :]).sum(-1)


def categorical_cross_entropy(logits_tm1: Tensor, target: Tensor) -> Tensor:
    """What it costs to describe the target's mass by softmax(logits): ``−Σ_i target[i] · log softmax(logits_tm1)[i]``.

    Its gradient by the logits is ``softmax(logits_tm1) − target``.

    Args:
        logits_tm1: of one pair, ``[*n, K]``.
        target: probabilities, ``[*n, K]``.

    Returns:
        ``[*n]``.

    Raises:
        ValueError: if the shapes differ.

    Source: Bellemare, Dabney & Munos 2017, section 4.1.

    Example:
        >>> categorical_cross_entropy(torch.zeros(4), torch.tensor([0.0, 1.0, 0.0, 0.0]))  # log 4
        tensor(1.3863)
    """
    check_same_shape("target", target, "logits_tm1", logits_tm1)
    return -(target * torch.log_softmax(logits_tm1, -1)).sum(-1)
