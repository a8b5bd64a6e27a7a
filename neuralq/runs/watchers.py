"""What watches every training unasked. It lives on floors above, so it is named here and loaded when a run begins."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import Any

from neuralq.runs.watching import Hook

__all__ = ["WATCHERS", "monitor_verdict", "watchers"]

WATCHERS = {"monitor": "neuralq.lab.watch.monitor:DivergenceMonitor.sparing"}
"""By the field of the configuration that switches it off: "module:Class.method", the method makes it of the
configuration."""


def watchers(config: Any, hooks: Sequence[Hook]) -> list[Hook]:
    """Those that a run has; one that is among its hooks already is not there twice.

    Args:
        config: of the run.
        hooks: that the run was given.

    Example:
        >>> from neuralq.runs import RunConfig
        >>> [type(one).__name__ for one in watchers(RunConfig(), [])], watchers(RunConfig(monitor=False), [])
        (['DivergenceMonitor'], [])
    """
    found: list[Hook] = []
    for name, place in WATCHERS.items():
        if getattr(config, name):
            module, _, attribute = place.partition(":")
            class_name, _, method = attribute.partition(".")
            kind = getattr(importlib.import_module(module), class_name)
            if not any(isinstance(hook, kind) for hook in hooks):
                found.append(getattr(kind, method)(config))
    return found


def monitor_verdict(states: Mapping[str, Any]) -> dict[str, Any] | None:
    """What the monitor of a run says, of the states that its hooks have left; None where it had none."""
    state = states.get(WATCHERS["monitor"].rpartition(".")[0])
    return None if state is None else dict(state["verdict"])
