"""Hooks that watch a run: TensorBoard, Weights & Biases, and the user's own."""

from __future__ import annotations

import contextlib
import functools
import importlib
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from neuralq.checks import MissingExtra, check_module_name
from neuralq.runs.folder.files import write_durably
from neuralq.runs.recipe.config import RunConfig, config_to_dict
from neuralq.runs.watching import EVENTS, Hook

__all__ = ["TensorBoard", "WeightsAndBiases", "own_hook", "watching_hooks"]


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


def own_hook(name: str, config: Any = None) -> Hook:
    """A hook of the user's own: a function that takes a row of metrics, or a class whose instances are hooks.

    Args:
        name: "package.module:name", imported as environments and bodies of one's own are. A class is called without
            arguments, or its method ``of`` with the configuration, as that of `neuralq.lab.DivergenceMonitor`.
        config: of the run.

    Raises:
        ValueError: if there is nothing of that name, or it cannot be made or called.

    Example:
        >>> own_hook("builtins:print") is print
        True
    """
    place, _, attribute = name.partition(":")
    if attribute:
        check_module_name("the hook", place, name)
    try:
        found: Any = importlib.import_module(place) if attribute else None
        for part in attribute.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"cannot import the hook {name!r}: {error}; name it as 'module:function'") from error
    except (Exception, SystemExit) as error:  # the user's own code ran
        raise ValueError(f"cannot import the hook {name!r}: it raised {type(error).__name__}: {error}") from error
    hook = found
    if isinstance(found, type):
        try:
            hook = found.of(config) if hasattr(found, "of") else found()
        except (Exception, SystemExit) as error:
            raise ValueError(f"cannot make the hook {name!r}: it raised {type(error).__name__}: {error}") from error
    if not callable(hook) and not any(callable(getattr(hook, event, None)) for event in EVENTS):
        raise ValueError(
            f"the hook {name!r} must take a row of metrics when called, got {hook!r}, which has none of "
            f"{', '.join(EVENTS)} either"
        )
    return cast(Hook, hook)


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
            write_durably(kept, secrets.token_hex(8))
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


@contextlib.contextmanager
def watching_hooks(
    path: Path,
    config: RunConfig,
    tensorboard: bool = False,
    wandb: bool = False,
    own: Sequence[str] = (),
    say: Callable[[str], None] = print,
) -> Iterator[list[Hook]]:
    """The hooks of a run in the order of what was asked for; closed at the end where they can be.

    Args:
        path: the run folder.
        config: of the run.
        tensorboard: whether to write event files.
        wandb: whether to log to Weights & Biases.
        own: hooks of the user's own, as for `own_hook`.
        say: is told where closing a hook fails: the run is whole whatever that raises.
    """
    wanted: list[Callable[[], Hook]] = []
    if tensorboard:
        wanted.append(lambda: TensorBoard(path / "tensorboard"))
    if wandb:
        wanted.append(lambda: WeightsAndBiases(path, config_to_dict(config)))
    wanted += [functools.partial(own_hook, name, config) for name in own]
    with contextlib.ExitStack() as stack:
        hooks: list[Hook] = []
        for make in wanted:
            hooks.append(make())
            if callable(close := getattr(hooks[-1], "close", None)):
                stack.callback(_end, close, hooks[-1], say)
        yield hooks


def _end(close: Callable[[], object], hook: Hook, say: Callable[[str], None]) -> None:
    try:
        close()
    except Exception as error:
        say(f"the hook {type(hook).__qualname__} raised {type(error).__name__} when it was closed: {error}")
