"""Gymnasium's Blackjack (``sab=True``, as registered) as arithmetic on cards: the optimum, and any policy's value.

Cards are drawn with replacement: 1 … 9 with probability 1/13 each, 10 with 4/13. The dealer draws up to 17 or more. A
natural (ace and ten) wins against any hand of the dealer's but another natural.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

CARDS = {card: 1 / 13 for card in range(1, 10)} | {10: 4 / 13}
Hand = tuple[int, bool]  # its sum, and whether an ace counts as 11 in it


def with_card(hand: Hand, card: int) -> Hand:
    """The hand and one card more; an ace counts as 11 where that is not too much."""
    total, soft = hand
    total += card
    if card == 1 and not soft and total + 10 <= 21:
        return total + 10, True
    return (total - 10, False) if soft and total > 21 else (total, soft)


@functools.cache
def dealer(hand: Hand, num_cards: int) -> dict[tuple[int, bool], float]:
    """How probable each score of the dealer's is (0: too much), and whether it is a natural."""
    total = hand[0]
    if num_cards >= 2 and total >= 17:
        return {(total if total <= 21 else 0, num_cards == 2 and total == 21): 1.0}
    found: dict[tuple[int, bool], float] = {}
    for card, p in CARDS.items():
        for score, q in dealer(with_card(hand, card), num_cards + 1).items():
            found[score] = found.get(score, 0.0) + p * q
    return found


@functools.cache
def stick(total: int, natural: bool, shown: int) -> float:
    """Expected reward of taking no card."""
    value = 0.0
    for (score, dealer_natural), p in dealer(with_card((0, False), shown), 1).items():
        value += p * (1.0 if natural and not dealer_natural else (total > score) - (total < score))
    return value


def value(choose: Callable[[int, int, bool], int] | None) -> float:
    """Expected return of a policy, ``choose(sum, shown, usable ace) -> 0 (stick) or 1``; None for the best one."""

    @functools.cache
    def of(hand: Hand, natural: bool, shown: int) -> float:
        total, soft = hand
        if total > 21:
            return -1.0
        keep = stick(total, natural, shown)
        take = sum(p * of(with_card(hand, card), False, shown) for card, p in CARDS.items())
        if choose is None:
            return max(keep, take)
        return take if choose(total, shown, soft) else keep

    first = [(with_card(with_card((0, False), a), b), p * q) for a, p in CARDS.items() for b, q in CARDS.items()]
    return sum(p * q * of(hand, hand[0] == 21, shown) for hand, p in first for shown, q in CARDS.items())
