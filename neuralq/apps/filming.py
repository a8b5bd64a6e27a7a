"""Films of a run from Python: what `neuralq.record` is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from neuralq.apps.cli import Failure
from neuralq.apps.cli.media import record as record_command
from neuralq.runs.api import environment_of, folder_of

__all__ = ["record"]


def record(
    run: Any,
    gif: str | Path | None = None,
    mp4: str | Path | None = None,
    num_episodes: int = 1,
    seed: int = 0,
    best: bool | None = None,
    *,
    env: Any = None,
) -> None:
    """Film greedy episodes of a run, as ``neuralq record`` does; step, return and max Q stand below the picture.

    Args:
        run: a run, its folder, or an agent that was loaded from it.
        gif: a file to write.
        mp4: another, in that format.
        num_episodes: how many.
        seed: of the episodes.
        best: which parameters, as for `neuralq.load`.
        env: likewise.

    Raises:
        ValueError: without a file to write, and where the environment draws no pictures.
        MissingExtra: if what films are made with is not installed.

    Example:
        >>> record("runs/demo")
        Traceback (most recent call last):
        ValueError: name a file: neuralq.record(run, gif="run.gif"), or mp4="run.mp4"
    """
    if gif is None and mp4 is None:
        raise ValueError('name a file: neuralq.record(run, gif="run.gif"), or mp4="run.mp4"')
    folder = folder_of(run)
    files = [
        word for kind, file in (("gif", gif), ("mp4", mp4)) if file is not None for word in (f"--{kind}", str(file))
    ]
    which = [] if best is None else ["--best"] if best else ["--final"]
    with environment_of(folder, env):
        try:
            record_command([str(folder), "--episodes", str(num_episodes), "--seed", str(seed), *files, *which])
        except Failure as failure:
            raise ValueError(str(failure)) from failure
