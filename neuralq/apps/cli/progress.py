"""One progress bar for whatever takes long: how far it is, for how long yet, and what else is worth saying."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TextIO, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column, Table

if TYPE_CHECKING:
    from rich.console import RenderableType

    from neuralq.runs.kinds import Kind

__all__ = ["ProgressBar", "Told", "training_bar"]

_QUIET_SECONDS = 10.0
"""Where the output is no terminal: one line at most this often."""
_NOTEBOOK_SECONDS = 2.0
"""In a notebook, where somebody looks; the first line is due at once."""
_WIDE = 100
"""Characters of a terminal from which the bar is drawn at its full width."""

T = TypeVar("T")


class _BarAndTable(Progress):
    table: Table | None = None

    def get_renderables(self) -> Iterator[RenderableType]:
        yield from super().get_renderables()
        if self.table is not None and self.table.row_count:
            yield self.table


class Told(NamedTuple):
    """What is said of one report.

    Args:
        so_far: how much there is.
        parts: what stands beside the bar.
        amount: how much in words, which stands before the parts where there is no bar.
        event: where it changes from 0, or from what it was, a line is due at once.
        total: of how much, where that is not known before.
    """

    so_far: int
    parts: Sequence[str]
    amount: str = ""
    event: int = 0
    total: int | None = None


class ProgressBar(Generic[T]):
    """Called with reports of what goes on, it draws a bar; plain lines where the output is no terminal.

    Args:
        total: of how much.
        tell: what to say of a report.
        stream: where to draw; standard error by default, so that standard output stays clean.
        clock: tells the time in seconds.
        below: of a report, the table that stands below the bar; None for none.

    Example:
        >>> import io
        >>> out = io.StringIO()
        >>> with ProgressBar(100, lambda so_far: Told(so_far, ["so far"], event=so_far), out) as bar:
        ...     bar(50)
        >>> out.getvalue().strip()
        'so far'
    """

    def __init__(
        self,
        total: int,
        tell: Callable[[T], Told],
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
        below: Callable[[T], Table] | None = None,
    ) -> None:
        self._tell, self._clock, self._below = tell, clock, below
        # Not as a notebook: that would draw nothing where there is no terminal, as here.
        self._console = Console(file=stream or sys.stderr, force_jupyter=False)
        in_notebook = "ipykernel" in sys.modules
        self._quiet = _NOTEBOOK_SECONDS if in_notebook else _QUIET_SECONDS
        self._said = (-math.inf if in_notebook else clock(), 0)
        self._bar = _BarAndTable(
            BarColumn(bar_width=24 if self._console.width >= _WIDE else 8),
            MofNCompleteColumn(),
            TimeRemainingColumn(compact=True),
            # What does not fit is left out here, not the columns before it.
            TextColumn("{task.fields[text]}", table_column=Column(ratio=1, no_wrap=True, overflow="ellipsis")),
            console=self._console,
            refresh_per_second=4,
            disable=not self._console.is_terminal,
            expand=True,
        )
        self._task = self._bar.add_task("", total=total, text="")

    def __enter__(self) -> ProgressBar[T]:
        with contextlib.suppress(OSError):
            self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        with contextlib.suppress(OSError):
            self._bar.stop()

    def say(self, line: str, /) -> None:
        """A line above the bar."""
        with contextlib.suppress(OSError):
            self._console.print(f"neuralq: {line}", highlight=False, soft_wrap=True, markup=False)

    def __call__(self, report: T, /) -> None:
        """Take in a report; where the terminal has gone or the disk is full, what is told of it is lost and no more."""
        with contextlib.suppress(OSError):
            self._draw(report)

    def _draw(self, report: T) -> None:
        told, now = self._tell(report), self._clock()
        narrow = self._console.width < _WIDE  # what is said last matters most, and is not to be what is left out
        parts = reversed(told.parts) if narrow else told.parts
        self._bar.update(self._task, completed=told.so_far, text=" · ".join(parts), total=told.total)
        if self._below is not None and self._console.is_terminal:
            self._bar.table = self._below(report)
        if not self._console.is_terminal and (now - self._said[0] > self._quiet or told.event != self._said[1]):
            self._said = (now, told.event)
            line = " · ".join(filter(None, (told.amount, *told.parts)))
            self._console.print(line, highlight=False, soft_wrap=True)


def training_bar(
    kind: Kind[Any, Any, Any],
    config: Any,
    stream: TextIO | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> ProgressBar[Mapping[str, Any]]:
    """The bar of a run, which is a hook: amount and rate, time left, and what the kind of run has to say.

    Example:
        >>> import io
        >>> from neuralq.runs import RunConfig
        >>> from neuralq.runs.control import CONTROL
        >>> with training_bar(CONTROL, RunConfig(), io.StringIO()) as bar:
        ...     bar({"kind": "train", "env_steps": 50, "steps_per_second": 10.0, "episode_return": None})
    """
    plan, latest = kind.plan(config), dict[str, Any]()
    things = plan.unit.removeprefix("env_")

    def tell(row: Mapping[str, Any]) -> Told:
        latest.update({name: value for name, value in row.items() if value is not None})
        so_far, rate = row[plan.unit], latest.get(f"{things}_per_second", 0.0)
        amount = f"{so_far:,} of {plan.budget:,} {things}"
        if rate > 0:
            seconds = max(plan.budget - so_far, 0) / rate
            amount += f" · {seconds / 60:.0f} min left" if seconds >= 90 else f" · {seconds:.0f} s left"
        return Told(so_far, [f"{rate:,.0f} {things}/s", *kind.notes(config, latest)], amount)

    return ProgressBar(plan.budget, tell, stream, clock)
