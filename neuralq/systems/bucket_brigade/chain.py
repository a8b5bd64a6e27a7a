"""A chain of rules that fire one after the other, and pay for it: Holland's bucket brigade.

The strength of rule i is S_i, its bid b S_i. In a pass down the chain every rule pays its bid to the one before, all at
once, and the last one is paid R. From S = 0 the bid of rule i = 0, …, n − 1 after k passes is

    R P(Binomial(k, b) ≥ n − i),

for a payment needs n − i passes in which it moves on to reach rule i, and each pass moves the share b of it. With
V = b S that is TD(0) with step size b and no discount.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from neuralq.checks import check_fraction, check_positive, check_whole

__all__ = ["bids", "expected_bids", "passes_to_half"]


def bids(num_rules: int, num_passes: int, share: float = 0.1, reward: float = 100.0) -> NDArray[np.float64]:
    """What every rule bids after each pass, from no strength at all, ``[num_passes + 1, num_rules]``.

    Args:
        num_rules: n.
        num_passes: k.
        share: b, in (0, 1].
        reward: R, which the last rule is paid in every pass.

    Raises:
        ValueError: a count or share out of range.

    Example:
        >>> bids(2, 3, share=0.5, reward=8.0).tolist()
        [[0.0, 0.0], [0.0, 4.0], [2.0, 6.0], [4.0, 7.0]]
    """
    check_whole("num_rules", num_rules)
    check_whole("num_passes", num_passes, 0)
    check_fraction("share", share)
    check_positive("share", share)
    strength, bid = np.zeros(num_rules), np.zeros((num_passes + 1, num_rules))
    for k in range(num_passes):
        strength -= bid[k]
        strength += np.append(bid[k, 1:], reward)
        bid[k + 1] = share * strength
    return bid


def expected_bids(num_rules: int, num_passes: int, share: float = 0.1, reward: float = 100.0) -> NDArray[np.float64]:
    """The same in closed form.

    Example:
        >>> bool(np.allclose(expected_bids(3, 9), bids(3, 9)))
        True
    """
    away = num_rules - np.arange(num_rules)
    return reward * np.asarray(stats.binom.sf(away - 1, np.arange(num_passes + 1)[:, None], share))


def passes_to_half(num_rules: int, share: float = 0.1) -> int:
    """Passes until the first rule bids half of what it will bid in the end.

    Example:
        >>> passes_to_half(5)
        47
    """
    num_passes = 1
    while expected_bids(num_rules, num_passes, share, 1.0)[-1, 0] < 0.5:
        num_passes += 1
    return num_passes
