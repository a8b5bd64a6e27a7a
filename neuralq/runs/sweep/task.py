"""What a process or a machine is told of a run that it is to make."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["Task"]


@dataclass(frozen=True)
class Task:
    """A run that is to be made; it can be sent to another process or machine.

    Args:
        name: of the run within its sweep.
        path: its run folder.
        config: its whole configuration, as `neuralq.runs.recipe.config.config_to_dict` writes it.
        options: what else was asked for, as words of the command line.
    """

    name: str
    path: Path
    config: dict[str, Any]
    options: tuple[str, ...] = ()

    @property
    def log_path(self) -> Path:
        """What its process prints."""
        return self.path.with_name(f"{self.path.name}.log")
