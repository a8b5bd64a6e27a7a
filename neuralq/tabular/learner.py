"""A tabular learner as whoever drives it sees it: a compiled loop, and every array that the loop changes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuralq.tabular.kernels.acting import FORGET, Log, Table, Walk
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import ActingCode, StepCode

__all__ = ["Learner"]


@dataclass(frozen=True)
class Learner:
    """A loop and what it changes: the whole of a tabular learner.

    Args:
        loop: of `neuralq.tabular.kernels`.
        table: what is learned.
        policy: how to act.
        arguments: of the loop, from the step size to γ.
        on_policy: whether the next action is chosen before the update.
        backups: where all updates are counted, if they are not one for each transition.
        fast: the same loop, draw for draw, from a model whose transitions nobody wants to see.
        check: raises a `ValueError` if what was learned from is nothing to learn from.
        copies: other action values that the loop keeps, ``[…, S, A]``.
        connections: what connects one step of a stream to the next; all of it is 0 where a stream begins.
        acts_in: the table that legal actions stand in, if it is not the one that is learned (prediction).
    """

    loop: Callable[..., None]
    table: Table
    policy: ActingCode
    arguments: tuple[Any, ...]
    on_policy: bool = False
    backups: NDArray[np.int64] | None = None
    fast: Callable[..., None] | None = None
    check: Callable[[], None] | None = None
    copies: tuple[NDArray[np.float64], ...] = ()
    connections: tuple[NDArray[Any], ...] = ()
    acts_in: Table | None = None

    def run(self, model: ModelArrays, walk: Walk, log: Log, gamma: float, num_steps: int) -> None:
        """Consume ``num_steps`` transitions, from the model or from the log."""
        if self.fast is not None and log.mode == FORGET and model.observe.size == 0:
            self.fast(model, self.policy, self.table, walk, self.arguments[0], gamma, num_steps)
        else:
            self.loop(model, self.policy, self.table, walk, log, *self.arguments, gamma, num_steps)
        if self.check is not None:
            self.check()

    @property
    def acting_table(self) -> Table:
        """The table that actions are chosen by."""
        return self.table if self.acts_in is None else self.acts_in

    def legal(self, s: int) -> NDArray[np.bool_]:
        """Which actions a state has, ``[A]``, as far as it was told."""
        return np.asarray(self.acting_table.q[s] > -np.inf)

    def allow_only(self, s: int, legal: NDArray[np.bool_]) -> None:
        """From now on the other actions of a state are never chosen, nor the best."""
        table = self.acting_table
        for values in (table.q, *self.copies):
            values[..., s, ~legal] = -np.inf
        table.num_legal[s] = np.count_nonzero(legal)

    def begin_stream(self) -> None:
        """What comes next has nothing to do with what came last."""
        for array in self.connections:
            array[...] = 0

    def arrays(self) -> list[NDArray[Any]]:
        """Everything that the loop changes, as it is: what a continued run needs, beside the walk."""
        tables = [self.table] if self.acts_in is None else [self.table, self.acts_in]
        return [*(array for table in tables for array in table), *_arrays_in(self.arguments)]


def _arrays_in(arguments: Any) -> Iterator[NDArray[Any]]:
    for one in arguments:
        if isinstance(one, np.ndarray):
            yield one
        elif isinstance(one, tuple) and not isinstance(one, StepCode):
            yield from _arrays_in(one)
