"""Hooks that watch a run: a live progress bar in the terminal, TensorBoard, and Weights & Biases."""

from __future__ import annotations

import importlib
import secrets
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO, cast

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

from neuralq.checks import MissingExtra

__all__ = ["ProgressBar", "TensorBoard", "WeightsAndBiases", "own_hook"]

_QUIET_SECONDS = 10.0
"""Where the output is no terminal: one line at most this often."""


class ProgressBar:
    """Steps, rate, time left and returns while a run goes on; plain lines where the output is no terminal.

    Args:
        total_steps: the run's budget.
        target: greedy return at which it stops, shown beside the returns.
        stream: where to draw; standard error by default, so that standard output stays clean.
        epsilon: exploration at a number of steps, shown beside the rest.

    Example:
        >>> import io
        >>> with ProgressBar(100, stream=io.StringIO()) as bar:
        ...     bar({"kind": "train", "env_steps": 50, "steps_per_second": 10.0, "episode_return": None})
    """

    def __init__(
        self,
        total_steps: int,
        target: float | None = None,
        stream: TextIO | None = None,
        epsilon: Callable[[int], float] | None = None,
    ) -> None:
        self._epsilon = epsilon
        self._console = Console(file=stream or sys.stderr)
        self._target = target
        self._latest: dict[str, Any] = {}
        self._said = time.monotonic()
        self._bar = Progress(
            SpinnerColumn(),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.fields[returns]}"),
            console=self._console,
            refresh_per_second=4,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task("training", total=total_steps, rate="", returns="")

    def __enter__(self) -> ProgressBar:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._bar.stop()

    def __call__(self, row: Mapping[str, Any]) -> None:
        """Take in a row of metrics."""
        self._latest.update({k: v for k, v in row.items() if v is not None})
        latest = self._latest
        parts = [] if self._epsilon is None else [f"ε {self._epsilon(int(row['env_steps'])):.3g}"]
        for name, shown in (("abs_td_error", "|δ|"), ("max_q", "max Q")):
            if name in latest:
                parts.append(f"{shown} {latest[name]:.3g}")
        if "episode_return" in latest:
            parts.append(f"return {latest['episode_return']:.1f}")
        if "greedy_return" in latest:
            goal = "" if self._target is None else f" (target {self._target:g})"
            parts.append(f"greedy {latest['greedy_return']:.1f}{goal}")
        rate = f"{latest.get('steps_per_second', 0.0):,.0f} steps/s"
        self._bar.update(self._task, completed=row["env_steps"], rate=rate, returns=" · ".join(parts))
        if not self._console.is_terminal and time.monotonic() - self._said > _QUIET_SECONDS:
            self._said = time.monotonic()
            self._console.print(f"{row['env_steps']:,} steps · {rate} · {' · '.join(parts)}", highlight=False)


class TensorBoard:
    """Writes every number of every row into TensorBoard event files.

    Args:
        folder: where the event files go.

    Raises:
        MissingExtra: if TensorBoard is not installed.
    """

    def __init__(self, folder: str | Path) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise MissingExtra(
                'TensorBoard is not installed; install it with: pip install "neuralq[tensorboard]"'
            ) from error
        self._writer: Any = SummaryWriter(str(folder))

    def __call__(self, row: Mapping[str, Any]) -> None:
        """Write one row."""
        for name, value in row.items():
            if isinstance(value, int | float) and name != "env_steps":
                self._writer.add_scalar(f"{row['kind']}/{name}", value, row["env_steps"])

    def close(self) -> None:
        """Flush and close the files."""
        self._writer.close()


def own_hook(name: str) -> Callable[[Mapping[str, Any]], None]:
    """A hook of the user's own: a function that takes a row of metrics, or a class whose instances do.

    Args:
        name: "package.module:name", imported as environments and bodies of one's own are.

    Raises:
        ValueError: if there is nothing of that name, or it cannot be called.

    Example:
        >>> own_hook("builtins:print")({"kind": "train", "env_steps": 64})
        {'kind': 'train', 'env_steps': 64}
    """
    place, _, attribute = name.partition(":")
    try:
        found: Any = importlib.import_module(place) if attribute else None
        for part in attribute.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"cannot import the hook {name!r}: {error}; name it as 'module:function'") from error
    hook = found() if isinstance(found, type) else found
    if not callable(hook):
        raise ValueError(f"the hook {name!r} must take a row of metrics when called, got {hook!r}")
    return cast(Callable[[Mapping[str, Any]], None], hook)


class WeightsAndBiases:
    """Logs every number of every row to Weights & Biases; ``WANDB_MODE=offline`` keeps it on this machine.

    A resumed run goes on in the same record, whose id is kept in the run folder.

    Args:
        run_dir: folder of the run; the package keeps its files in ``wandb/`` there.
        config: shown as the run's configuration.
        project: where the run is filed.

    Raises:
        MissingExtra: if the package is not installed.
        ValueError: if it cannot begin a record, as without a login.
    """

    def __init__(self, run_dir: str | Path, config: Mapping[str, Any], project: str = "neuralq") -> None:
        try:
            import wandb
        except ImportError as error:
            raise MissingExtra(
                'Weights & Biases is not installed; install it with: pip install "neuralq[wandb]"'
            ) from error
        folder = Path(run_dir)
        kept = folder / "wandb" / "neuralq-run-id"
        if not kept.exists():
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(secrets.token_hex(8))
        try:
            self._run: Any = wandb.init(
                project=project, name=folder.name, id=kept.read_text(), resume="allow", dir=str(folder),
                config=dict(config),
            )  # fmt: skip
        except Exception as error:  # of the package's own kinds: not logged in, no network, …
            raise ValueError(
                f"Weights & Biases cannot keep a record: {str(error).rstrip('.')}; log in with: wandb login, or set "
                "WANDB_MODE=offline to keep it on this machine"
            ) from error
        # Steps are a column of their own: the package drops rows that go back in its own count, as a resumed run does.
        self._run.define_metric("*", step_metric="env_steps")

    def __call__(self, row: Mapping[str, Any]) -> None:
        """Log one row."""
        numbers = {f"{row['kind']}/{k}": v for k, v in row.items() if isinstance(v, int | float) and k != "env_steps"}
        self._run.log({**numbers, "env_steps": row["env_steps"]})

    def close(self) -> None:
        """Send what is left and end the record."""
        self._run.finish()
