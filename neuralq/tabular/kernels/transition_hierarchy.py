"""Temporal transition hierarchies: linear units whose weights are modified by units that look one moment further back.

An output is a sum over inputs, as of any linear unit, only that each weight w_ij may have a unit of its own, l(ij),
whose value of the moment before is added to it:

    u_i(t) = Σ_j (w_ij + u_l(ij)(t − 1)) s_j(t)

Such units are linear units too, so that their weights may be modified by further ones. What is wrong with an output is
learned where it can be told apart best: the error of unit i changes w_ij, or, where l(ij) is there, is the error of
l(ij) for the moment before; of a unit whose value counts τ_i moments later,

    Δ_l(ij) = Δ_i s_j(t − τ_i),    w_ij ← w_ij + η Δ_i s_j(t − τ_i)  where nothing modifies it.

A weight that is pulled one way and the other is short of knowledge of what came before. Each keeps an average of what
it was told and one of its size, and where the size is more than θ times the first and ε, it is given a unit; what
averages the weights of its unit had kept begin anew. With one input at a time that is a tree over what came before,
for each output, that grows where it is needed.

At the beginning nothing came before: there the weight itself is changed, modified or not. (That is ours; the original
lives one life without trials.)

Source: Ring 1994, "Continual learning in reinforcement environments"; Ring 1997, "CHILD: A first step towards continual
learning", Machine Learning 28.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.jit import lean_kernel

__all__ = [
    "HierarchyRates",
    "TransitionHierarchy",
    "hierarchy_begin",
    "hierarchy_learn",
    "hierarchy_observe",
    "new_transition_hierarchy",
]

_UNITS, _MOMENTS = range(2)


class TransitionHierarchy(NamedTuple):
    """At most U units, the outputs before all others; made by `new_transition_hierarchy` and changed in place.

    Args:
        num_outputs: A.
        weight: w, ``[U, n]``.
        modifier: the unit that modifies each weight, −1 for none, ``[U, n]``.
        modifies: whose weight each unit modifies, and of which input; −1 for outputs, ``[U, 2]``.
        delay: τ, moments until its value counts for an output, ``[U]``.
        value: u of the latest moment; of outputs what is asked for, ``[U]``.
        before: u of the moment before, ``[U]``.
        error: Δ, ``[U]``.
        told: average of what each weight was told, ``[U, n]``.
        size: average of its size, ``[U, n]``.
        seen: the latest inputs, in a ring, ``[H, n]``.
        counts: how many units there are, outputs included, and moments since the beginning, ``[2]``.
    """

    num_outputs: int
    weight: NDArray[np.float64]
    modifier: NDArray[np.int64]
    modifies: NDArray[np.int64]
    delay: NDArray[np.int64]
    value: NDArray[np.float64]
    before: NDArray[np.float64]
    error: NDArray[np.float64]
    told: NDArray[np.float64]
    size: NDArray[np.float64]
    seen: NDArray[np.float64]
    counts: NDArray[np.int64]


class HierarchyRates(NamedTuple):
    """Constants of a `TransitionHierarchy`.

    Args:
        step_size: η.
        averaging: σ, the share of the latest in both averages, in (0, 1].
        ratio: θ.
        threshold: ε; infinity for no growth.
    """

    step_size: float = 0.15
    averaging: float = 0.1
    ratio: float = 0.7
    threshold: float = 0.1


def new_transition_hierarchy(
    num_inputs: int, num_outputs: int, max_units: int = 1000, max_delay: int = 50
) -> TransitionHierarchy:
    """Outputs of which all weights are 0, and room to grow.

    Args:
        num_inputs: n.
        num_outputs: A.
        max_units: how many units it may grow beside the outputs.
        max_delay: how many moments back they may look.

    Raises:
        ValueError: a count out of range.

    Example:
        >>> net = new_transition_hierarchy(3, 2, max_units=10)
        >>> net.weight.shape, net.counts.tolist()
        ((12, 3), [2, 0])
    """
    check_whole("num_inputs", num_inputs)
    check_whole("num_outputs", num_outputs)
    check_whole("max_units", max_units, 0)
    check_whole("max_delay", max_delay, 0)
    shape = (num_outputs + max_units, num_inputs)
    value, before, error = np.zeros((3, shape[0]))
    weight, told, size = np.zeros((3, *shape))
    return TransitionHierarchy(
        num_outputs,
        weight,
        np.full(shape, -1),
        np.full((shape[0], 2), -1),
        np.zeros(shape[0], np.int64),
        value,
        before,
        error,
        told,
        size,
        np.zeros((max_delay + 2, num_inputs)),
        np.array([num_outputs, 0]),
    )


@lean_kernel
def hierarchy_begin(net: TransitionHierarchy) -> None:
    """Nothing was seen yet: what comes next has nothing to do with what came before.

    Example:
        >>> net = new_transition_hierarchy(2, 1)
        >>> hierarchy_observe(net, np.array([1.0, 0.0]))
        >>> hierarchy_begin(net)
        >>> int(net.counts[1])
        0
    """
    net.counts[_MOMENTS] = 0
    net.value[:] = 0.0


@lean_kernel
def hierarchy_observe(net: TransitionHierarchy, s: NDArray[np.float64]) -> None:
    """What is seen now; ``net.value[:A]`` are then the outputs.

    Args:
        net: changed in place.
        s: inputs, ``[n]``.

    Example:
        >>> net = new_transition_hierarchy(2, 1)
        >>> net.weight[0] = 1.0, 2.0
        >>> hierarchy_observe(net, np.array([3.0, 4.0]))
        >>> float(net.value[0])
        11.0
    """
    latest = net.seen[net.counts[_MOMENTS] % len(net.seen)]
    net.counts[_MOMENTS] += 1
    num_units = net.counts[_UNITS]
    for i in range(num_units):
        net.before[i] = net.value[i]
        net.value[i] = 0.0
    for j in range(len(latest)):
        latest[j] = s[j]
        if s[j] != 0.0:
            for i in range(num_units):
                w, modifier = net.weight[i, j], net.modifier[i, j]
                if modifier >= 0:
                    w += net.before[modifier]
                net.value[i] += w * s[j]


@lean_kernel
def hierarchy_learn(net: TransitionHierarchy, rates: HierarchyRates, errors: NDArray[np.float64], ago: int) -> None:
    """Learns what the outputs should have been more, and grows where a weight is pulled both ways.

    Args:
        net: changed in place.
        rates: constants.
        errors: Δ of each output, ``[A]``.
        ago: of which moment: 0 for the latest, 1 for the one before (which a bootstrapped target has to wait for).

    Example:
        What follows 1 depends on what came before it.

        >>> net, rates = new_transition_hierarchy(3, 1), HierarchyRates(step_size=0.3)
        >>> sequences = ((0, 1, 1.0), (2, 1, -1.0))
        >>> for trial in range(400):
        ...     first, second, target = sequences[trial % 2]
        ...     hierarchy_begin(net)
        ...     hierarchy_observe(net, np.eye(3)[first])
        ...     hierarchy_observe(net, np.eye(3)[second])
        ...     hierarchy_learn(net, rates, target - net.value[:1], 0)
        >>> int(net.counts[0]) - 1, net.modifies[1].tolist()
        (1, [0, 1])
        >>> hierarchy_begin(net)
        >>> hierarchy_observe(net, np.eye(3)[2])
        >>> hierarchy_observe(net, np.eye(3)[1])
        >>> round(float(net.value[0]), 9)
        -1.0
    """
    num_units, moments = net.counts[_UNITS], net.counts[_MOMENTS]
    if ago >= moments:
        return
    net.error[:] = 0.0
    for i in range(net.num_outputs):
        net.error[i] = errors[i]
    for i in range(num_units):  # parents before their children, as they were made
        back = ago + net.delay[i]
        if net.error[i] == 0.0:
            continue
        then = net.seen[(moments - 1 - back) % len(net.seen)]
        for j in range(len(then)):
            if then[j] != 0.0:
                change = net.error[i] * then[j]
                modifier = net.modifier[i, j]
                if modifier >= 0 and back + 1 < moments:
                    net.error[modifier] = change
                else:
                    net.weight[i, j] += rates.step_size * change
                    if modifier < 0:
                        _notice(net, rates, i, j, change)


@lean_kernel
def _notice(net: TransitionHierarchy, rates: HierarchyRates, i: int, j: int, change: float) -> None:
    """What a weight was told goes into its averages, and may be the reason for a new unit."""
    net.told[i, j] += rates.averaging * (change - net.told[i, j])
    net.size[i, j] += rates.averaging * (abs(change) - net.size[i, j])
    new = net.counts[_UNITS]
    if (
        net.size[i, j] > rates.ratio * abs(net.told[i, j]) + rates.threshold
        and new < len(net.weight)
        and net.delay[i] + 2 < len(net.seen)
    ):
        net.modifier[i, j] = new
        net.modifies[new, 0], net.modifies[new, 1] = i, j
        net.delay[new] = net.delay[i] + 1
        net.counts[_UNITS] = new + 1
        net.told[i] = 0.0
        net.size[i] = 0.0
