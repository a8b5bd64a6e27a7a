"""From what was handed over to a subject: a path of any known origin, a module, a function, or an agent of neuralq."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import nn

from neuralq.doctor.origins import ORIGINS
from neuralq.doctor.origins.neuralq_run import of_agent
from neuralq.doctor.subject import Subject, of_callable, of_network
from neuralq.doctor.weights import EXPORT, CannotLoad
from neuralq.runs.agent import Agent

__all__ = ["load_subject"]


def load_subject(given: Any, net: str | None = None, env: Any = None) -> Subject:
    """The value function in a file or folder, or in memory. No code in a file is ever run.

    Args:
        given: a neuralq run folder, or a sweep's, of which the worst seed is the subject; a zip of Stable-Baselines3
            (DQN) or sb3-contrib (QR-DQN); a model of CleanRL; a state dict (``.pth``, ``.safetensors``, ``.npz``); an
            `nn.Module`, a function of ``[N, *obs]`` to ``[N, A]``, or what `neuralq.load` returns.
        net: "module:Class" of a network that a state dict belongs to; it is called without arguments.
        env: the environment, of a run in whose folder it has no name that could be followed.

    Raises:
        CannotLoad: which key or shape does not fit, and what to pass.

    Example:
        >>> load_subject(nn.Linear(4, 2)).origin
        'Linear, a PyTorch module'
    """
    if isinstance(given, Subject):
        return given
    if isinstance(given, Agent):
        return of_agent(given)
    if isinstance(given, nn.Module):
        return of_network(given, f"{type(given).__name__}, a PyTorch module")
    if hasattr(given, "run_dir"):
        given = given.run_dir
    if not isinstance(given, str | Path):
        if callable(given):
            return of_callable(given, f"{getattr(given, '__name__', type(given).__name__)}, a function")
        raise CannotLoad(f"a subject must be a path, a torch.nn.Module or a function, got {type(given).__name__}")
    path = Path(given)
    if not path.exists():
        raise CannotLoad(f"there is no {path}; give a run folder or the file of a saved agent")
    for origin in ORIGINS:
        if origin.recognises(path):
            return origin.load(path, net, env)
    known = "; ".join(origin.name for origin in ORIGINS)
    raise CannotLoad(
        f"{path} is none of: {known}. From PyTorch: {EXPORT.splitlines()[1]}, read with --net module:Class"
    )
