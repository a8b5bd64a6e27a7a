"""A learner of neuralq with the settings that a subject was trained with, and the command that runs it.

What a measurement names is confirmed by training again with everything as it was but that one thing. Settings that are
not known are neuralq's own.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping
from typing import Any

from torch import nn

from neuralq.doctor.exam.case import Case

__all__ = ["further_reach", "in_words", "retrained", "settings_of"]

_AHEAD, _FOLLOWS, _LARGEST_RATE, _LEAST_UPDATES = 10, 0.1, 1e-3, 25
_WHOLE = ("batch_size", "capacity", "target_period_updates", "num_steps", "learning_starts", "epsilon_decay_steps")
_SAME = ("learning_rate", "epsilon_start", "epsilon_end", *_WHOLE)
_OF_RUN = ("hidden", "gamma", "total_steps", "epsilon_start", "epsilon_end", "epsilon_decay_steps")


def settings_of(case: Case) -> dict[str, Any]:
    """Keyword arguments of `neuralq.train` that do as the subject's settings say, as far as they are known."""
    known = case.settings
    found: dict[str, Any] = {n: v for n in _SAME if (v := getattr(known, n)) is not None}
    found |= {n: max(int(found[n]), 1) for n in _WHOLE if n in found}
    if known.updates and known.env_steps:
        found["train_period"] = max(round(known.env_steps / known.updates), 1)
    if "capacity" in found:
        found["capacity"] = min(found["capacity"], max(int(known.env_steps or 10**9), 1))  # more is never filled
        found["learning_starts"] = min(found.get("learning_starts", 1000), found["capacity"])
        found["batch_size"] = min(found.get("batch_size", 64), found["capacity"])
    return {"learner": "replay", **found, **_body(case)}


def _body(case: Case) -> dict[str, Any]:
    """The widths of the subject's dense layers; neuralq's default where they are not known."""
    network = case.subject.network
    linear = [] if network is None else [m for m in network.modules() if isinstance(m, nn.Linear)]
    return {"hidden": tuple(m.out_features for m in linear[:-1])} if len(linear) > 1 else {}


def further_reach(case: Case) -> dict[str, Any]:
    """What lets values see four times as far as rewards matter: n-step targets, copied often enough.

    Adam moves a weight by about its step size. So that the network follows its targets from one copy to the next, it
    must be able to move by 0.1 in between; a smaller step size goes up with the copies, to 1e-3 at most.
    """
    known, longest = case.settings, max(one.length for one in case.episodes)
    always_end = all(one.terminated for one in case.episodes)
    matter = min(case.horizon, case.world.limit or (longest if always_end else 10**4))
    ahead = max(_AHEAD, int(known.num_steps or 1))
    copies = math.ceil(4 * matter / ahead)
    updates = max(int(known.updates or 0), _LEAST_UPDATES * copies)
    period = updates // copies
    found: dict[str, Any] = {"num_steps": ahead, "target_period_updates": period}
    least = min(_FOLLOWS / period, _LARGEST_RATE)
    if known.learning_rate is not None and known.learning_rate < least:
        found["learning_rate"] = float(f"{least:.1g}")
    if known.updates and known.env_steps and updates > known.updates:
        found["total_steps"] = int(known.env_steps * updates / known.updates)
    return found


def in_words(changes: Mapping[str, Any]) -> str:
    """Changes as `further_reach` gives them.

    Example:
        >>> in_words({"num_steps": 10, "target_period_updates": 100, "learning_rate": 0.001})
        'targets of 10 steps, a target network that is copied every 100 updates and a step size of 0.001'
    """
    said = {
        "num_steps": "targets of {} steps",
        "target_period_updates": "a target network that is copied every {:,} updates",
        "learning_rate": "a step size of {:g}",
        "total_steps": "{:,} environment steps",
    }
    parts = [said[name].format(value) for name, value in changes.items()]
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def retrained(case: Case, changes: Mapping[str, Any]) -> str:
    """The command (or the call, where no name leads to the environment) that trains again with these changes."""
    given = {"total_steps": int(case.settings.env_steps or 50_000), "gamma": case.gamma, **settings_of(case), **changes}
    del given["learner"]
    if case.world.name.startswith("<"):
        told = ", ".join(f"{name}={value!r}" for name, value in given.items())
        return f"neuralq.train(env, preset=False, learner='replay', {told})"
    words = ["neuralq", "train", *case.world.named, "--preset", "false", "--learner", "replay"]
    for name, value in given.items():
        option = name.replace("_", "-") if name in _OF_RUN else f"replay.{name.replace('_', '-')}"
        words += [f"--{option}", ",".join(map(str, value)) if isinstance(value, tuple) else json.dumps(value)]
    return shlex.join(words)
