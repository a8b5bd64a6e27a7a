"""ZCS, a zeroth level classifier system: rules for strings of bits that bid, pay each other, and breed.

A classifier says what to do where some bits are as it wants them; to the others it is blind. Those that match a state
are the match set; one of them, drawn in proportion to its strength S, names the action, and those of the match set
that name it too are the action set. When the action has earned r_t, every member of the action set pays the share β of
its strength into a bucket, and the set of the step before is paid the bucket times γ, in equal parts: the implicit
bucket brigade. The action set itself is paid β r_t, in equal parts; the rest of the match set is taxed the share τ.

Where nobody matches, or who does has less strength together than φ times the mean, a new classifier is made for the
state (covering). With probability ρ a step, two parents drawn by strength give half of theirs to two children, which
are crossed with probability χ at one point and whose every sign and action mutate with probability μ; who goes for them
is drawn by 1 / S.

Source: Wilson 1994, "ZCS: a zeroth level classifier system", Evolutionary Computation 2; that actions mutate, and a
strength of at most a millionth counts as one where the one to go is drawn, is ours.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_positive, check_whole
from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.random_numbers import uniform

__all__ = ["Zcs", "ZcsRates", "new_zcs", "zcs_action", "zcs_strengths", "zcs_update"]

_MOST_BITS = 62
_LEAST = 1e-6
_OUT, _MATCHES, _ACTS = range(3)


class Zcs(NamedTuple):
    """A population of N classifiers; made by `new_zcs` and changed in place.

    Args:
        num_bits: n; states are whole numbers below 2ⁿ.
        num_actions: A.
        cares: the bits that each classifier looks at, ``[N]``.
        wants: what it wants them to be; bits that it does not look at are 0, ``[N]``.
        action: what it does, ``[N]``.
        strength: S, ``[N]``.
        now: 0 where it does not match the present state, 1 where it does, 2 where its action was chosen, ``[N]``.
        before: whether it was in the action set of the step before, ``[N]``.
    """

    num_bits: int
    num_actions: int
    cares: NDArray[np.int64]
    wants: NDArray[np.int64]
    action: NDArray[np.int64]
    strength: NDArray[np.float64]
    now: NDArray[np.int64]
    before: NDArray[np.bool_]


class ZcsRates(NamedTuple):
    """The constants of Wilson 1994.

    Args:
        beta: β, the share of a strength that is bid, in (0, 1].
        gamma: γ, what is left of a bid for those of the step before.
        tax: τ, the share that is taken from those that match and say something else.
        crossover: χ, the chance that two children are crossed.
        mutation: μ, the chance of each sign and of the action to change.
        breeding: ρ, the chance of two children in a step.
        covering: φ: who matches has at least this many times the mean strength.
        blind: the chance that a new classifier does not look at a bit.
    """

    beta: float = 0.2
    gamma: float = 0.71
    tax: float = 0.1
    crossover: float = 0.5
    mutation: float = 0.002
    breeding: float = 0.25
    covering: float = 0.5
    blind: float = 0.33


def new_zcs(
    num_bits: int,
    num_actions: int,
    rng: NDArray[np.uint64],
    num_classifiers: int = 400,
    strength: float = 20.0,
    rates: ZcsRates = ZcsRates(),  # noqa: B008 - frozen
) -> Zcs:
    """A population drawn at random.

    Args:
        num_bits: n, at most 62.
        num_actions: A.
        rng: a stream (`neuralq.tabular.new_stream`); advanced.
        num_classifiers: N, at least 2.
        strength: of each at first, above 0.
        rates: of which ``blind`` is used.

    Raises:
        ValueError: a count out of range, or no strength.

    Example:
        >>> from neuralq.tabular import new_stream
        >>> zcs = new_zcs(4, 2, new_stream(0), num_classifiers=3)
        >>> zcs.strength.tolist(), bool((zcs.wants & ~zcs.cares).any())
        ([20.0, 20.0, 20.0], False)
    """
    check_whole("num_bits", num_bits)
    check_whole("num_actions", num_actions)
    check_whole("num_classifiers", num_classifiers, 2)
    check_positive("strength", strength)
    if num_bits > _MOST_BITS:
        raise ValueError(f"num_bits must be at most {_MOST_BITS}, got {num_bits}; leave out bits that say little")
    n = num_classifiers
    zcs = Zcs(
        num_bits,
        num_actions,
        np.zeros(n, np.int64),
        np.zeros(n, np.int64),
        np.zeros(n, np.int64),
        np.full(n, float(strength)),
        np.zeros(n, np.int64),
        np.zeros(n, np.bool_),
    )
    for i in range(n):
        for bit in range(num_bits):
            if uniform(rng) >= rates.blind:
                zcs.cares[i] |= 1 << bit
                zcs.wants[i] |= int(uniform(rng) < 0.5) << bit
        zcs.action[i] = int(uniform(rng) * num_actions)
    return zcs


@lean_kernel
def zcs_action(zcs: Zcs, rates: ZcsRates, s: int, rng: NDArray[np.uint64]) -> Any:
    """The action in state ``s``, drawn by strength; remembers who matches and who named it.

    Args:
        zcs: changed in place: who matches, and where too few do, a new classifier.
        rates: of which ``covering`` and ``blind`` are used.
        s: state, a whole number below 2ⁿ.
        rng: a stream; advanced.

    Example:
        >>> from neuralq.tabular import new_stream
        >>> zcs, stream = new_zcs(2, 4, new_stream(0), 8), new_stream(1)
        >>> zcs.cares[:], zcs.wants[:], zcs.action[:] = 0b01, 0b00, 3  # all of them are for the even states
        >>> zcs_action(zcs, ZcsRates(), 0b10, stream), int((zcs.now == 2).sum())
        (3, 8)
        >>> a = zcs_action(zcs, ZcsRates(), 0b11, stream)
        >>> int((zcs.now == 2).sum())  # one was made for the state
        1
    """
    matching, total = 0.0, 0.0
    for i in range(len(zcs.strength)):
        total += zcs.strength[i]
        matches = (s & zcs.cares[i]) == zcs.wants[i]
        zcs.now[i] = _MATCHES if matches else _OUT
        if matches:
            matching += zcs.strength[i]
    mean = total / len(zcs.strength)
    if matching == 0.0 or matching < rates.covering * mean:
        matching += _cover(zcs, rates, s, mean, rng)
    left, chosen = uniform(rng) * matching, -1
    for i in range(len(zcs.strength)):
        if zcs.now[i] == _MATCHES:
            chosen = zcs.action[i]
            left -= zcs.strength[i]
            if left < 0.0:
                break
    for i in range(len(zcs.strength)):
        if zcs.now[i] == _MATCHES and zcs.action[i] == chosen:
            zcs.now[i] = _ACTS
    return chosen


@lean_kernel
def zcs_update(zcs: Zcs, rates: ZcsRates, r_t: float, last_t: bool, rng: NDArray[np.uint64]) -> None:
    """Pays for the action that `zcs_action` chose, and breeds now and then.

    Args:
        zcs: changed in place.
        rates: constants.
        r_t: what the action earned, at least 0: strengths are.
        last_t: whether the stream breaks here, so that nobody is paid by the next step.
        rng: a stream; advanced.

    Example:
        Two of them act, pay 4 of 20 each, and share β · 10. The next step pays γ · β · (18 + 18) to who acted before.

        >>> from neuralq.tabular import new_stream
        >>> zcs, stream, rates = new_zcs(1, 2, new_stream(0), 2), new_stream(1), ZcsRates(breeding=0.0)
        >>> zcs.cares[:], zcs.wants[:], zcs.action[:] = 0, 0, 1
        >>> for _ in range(2):
        ...     a = zcs_action(zcs, rates, 0, stream)
        ...     zcs_update(zcs, rates, 10.0, False, stream)
        ...     print(zcs.strength.round(4).tolist())
        [17.0, 17.0]
        [17.014, 17.014]
    """
    bucket, acting, were = 0.0, 0, 0
    for i in range(len(zcs.strength)):
        were += zcs.before[i]
        if zcs.now[i] == _ACTS:
            bid = rates.beta * zcs.strength[i]
            zcs.strength[i] -= bid
            bucket += bid
            acting += 1
    for i in range(len(zcs.strength)):
        if zcs.now[i] == _ACTS:
            zcs.strength[i] += rates.beta * r_t / acting
        elif zcs.now[i] == _MATCHES:
            zcs.strength[i] -= rates.tax * zcs.strength[i]
        if zcs.before[i]:
            zcs.strength[i] += rates.gamma * bucket / were
        zcs.before[i] = zcs.now[i] == _ACTS and not last_t
        zcs.now[i] = _OUT
    if uniform(rng) < rates.breeding:
        _breed(zcs, rates, rng)


@lean_kernel
def zcs_strengths(zcs: Zcs, s: int, strengths: NDArray[np.float64]) -> None:
    """Writes the strength behind each action in state ``s``.

    Args:
        zcs: what was learned.
        s: state.
        strengths: ``[A]``; written.

    Example:
        >>> from neuralq.tabular import new_stream
        >>> zcs, strengths = new_zcs(1, 2, new_stream(0), 3), np.zeros(2)
        >>> zcs.cares[:], zcs.wants[:], zcs.action[:] = [0, 1, 1], [0, 1, 0], [0, 1, 1]
        >>> zcs_strengths(zcs, 1, strengths)
        >>> strengths.tolist()
        [20.0, 20.0]
    """
    strengths[:] = 0.0
    for i in range(len(zcs.strength)):
        if (s & zcs.cares[i]) == zcs.wants[i]:
            strengths[zcs.action[i]] += zcs.strength[i]


@lean_kernel
def _cover(zcs: Zcs, rates: ZcsRates, s: int, strength: float, rng: NDArray[np.uint64]) -> float:
    """A new classifier that matches ``s``; returns by how much the match set has grown stronger."""
    i = _weak(zcs, rng)
    lost = zcs.strength[i] if zcs.now[i] == _MATCHES else 0.0
    zcs.cares[i], zcs.wants[i] = 0, 0
    for bit in range(zcs.num_bits):
        if uniform(rng) >= rates.blind:
            zcs.cares[i] |= 1 << bit
            zcs.wants[i] |= s & (1 << bit)
    zcs.action[i] = int(uniform(rng) * zcs.num_actions)
    zcs.strength[i], zcs.now[i], zcs.before[i] = strength, _MATCHES, False
    return strength - lost


@lean_kernel
def _breed(zcs: Zcs, rates: ZcsRates, rng: NDArray[np.uint64]) -> None:
    """Two children of two parents, in the place of two that are weak."""
    one, two = _strong(zcs, rng), _strong(zcs, rng)
    zcs.strength[one] *= 0.5
    first = zcs.strength[one]
    zcs.strength[two] *= 0.5
    second = zcs.strength[two]
    cares_one, wants_one, action_one = zcs.cares[one], zcs.wants[one], zcs.action[one]
    cares_two, wants_two, action_two = zcs.cares[two], zcs.wants[two], zcs.action[two]
    if uniform(rng) < rates.crossover:
        low = (1 << (1 + int(uniform(rng) * (zcs.num_bits - 1)))) - 1  # the signs below the point stay
        cares_one, cares_two = (cares_one & low) | (cares_two & ~low), (cares_two & low) | (cares_one & ~low)
        wants_one, wants_two = (wants_one & low) | (wants_two & ~low), (wants_two & low) | (wants_one & ~low)
        first = second = 0.5 * (first + second)
    _place(zcs, rates, cares_one, wants_one, action_one, first, rng)
    _place(zcs, rates, cares_two, wants_two, action_two, second, rng)


@lean_kernel
def _place(
    zcs: Zcs, rates: ZcsRates, cares: int, wants: int, action: int, strength: float, rng: NDArray[np.uint64]
) -> None:
    """A child, mutated, in the place of one that is weak; it was in no set of the step before."""
    for bit in range(zcs.num_bits):
        if uniform(rng) < rates.mutation:
            sign = 1 << bit
            other = uniform(rng) < 0.5  # which of the two other signs
            if cares & sign == 0:
                cares |= sign
                wants |= sign if other else 0
            elif other:
                cares, wants = cares & ~sign, wants & ~sign
            else:
                wants ^= sign
    if uniform(rng) < rates.mutation and zcs.num_actions > 1:
        action = (action + 1 + int(uniform(rng) * (zcs.num_actions - 1))) % zcs.num_actions
    i = _weak(zcs, rng)
    zcs.cares[i], zcs.wants[i], zcs.action[i], zcs.strength[i] = cares, wants, action, strength
    zcs.now[i], zcs.before[i] = _OUT, False


@lean_kernel
def _strong(zcs: Zcs, rng: NDArray[np.uint64]) -> int:
    """One of all, drawn by strength."""
    total = 0.0
    for i in range(len(zcs.strength)):
        total += zcs.strength[i]
    left = uniform(rng) * total
    for i in range(len(zcs.strength)):
        left -= zcs.strength[i]
        if left < 0.0:
            return i
    return len(zcs.strength) - 1


@lean_kernel
def _weak(zcs: Zcs, rng: NDArray[np.uint64]) -> int:
    """One of all, drawn by 1 / strength."""
    total = 0.0
    for i in range(len(zcs.strength)):
        total += 1.0 / max(zcs.strength[i], _LEAST)
    left = uniform(rng) * total
    for i in range(len(zcs.strength)):
        left -= 1.0 / max(zcs.strength[i], _LEAST)
        if left < 0.0:
            return i
    return len(zcs.strength) - 1
