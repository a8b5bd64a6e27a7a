"""Imported by the process that runs are forked of: what most of them need is in memory before the first is forked.

A short run on an environment of our own with the learner and network of the sweep loads its compiled kernels. Nothing
of it is kept, and no environment of the user's is touched. A process with threads may not be forked safely; with one
thread for linear algebra a run makes none.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import tempfile
import warnings
from pathlib import Path
from typing import Any

from neuralq.runs.control import CONTROL
from neuralq.runs.recipe.config import config_from_dict

__all__ = ["warm_up"]

_STEPS = 600


def warm_up(config: dict[str, Any]) -> bool:
    """A few hundred steps of a run like this, elsewhere and forgotten; whether there was nothing against it.

    Example:
        >>> warm_up({"env": "CartPole-v1", "learner": "nothing"})
        False
    """
    other = "FrozenLake-v1" if config.get("layout") == "table" else "CartPole-v1"
    plain: dict[str, Any] = {"env_kwargs": {}, "wrappers": [], "dataset": None, "warm_start": None, "device": "cpu"}
    periods = dict.fromkeys(("evaluate_every", "checkpoint_every", "log_every"), _STEPS)
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.suppress(Exception))
        stack.enter_context(warnings.catch_warnings(action="ignore"))
        stack.enter_context(contextlib.redirect_stderr(io.StringIO()))  # it says that its schedules do not end
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        short = {"env": other, "total_steps": _STEPS, "evaluation_episodes": 1, "resume_probe": False}
        CONTROL.train(config_from_dict({**config, **plain, **periods, **short}), Path(folder, "run"))
        return True
    return False


if "NEURALQ_WARM" in os.environ:
    warm_up(json.loads(os.environ["NEURALQ_WARM"]))
