"""A run as hooks see it: everything to read, nothing to write, and a way to ask for its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from neuralq.learners.learner import Update
from neuralq.runs.stream import Step
from neuralq.runs.stream.stream import Episode
from neuralq.types import Array

if TYPE_CHECKING:
    from neuralq.runs.watching import Watch

__all__ = ["SessionView", "StepArrays", "Watchable"]


@runtime_checkable
class Watchable(Protocol):
    """A trainee whose single steps and updates can be watched; the first two are None where nobody does."""

    on_step: Callable[[], None] | None
    on_update: Callable[[], None] | None
    last_step: Step | None

    @property
    def last_update(self) -> Update | None:
        """What the last update saw."""
        ...

    @property
    def num_updates(self) -> int:
        """Updates so far."""
        ...

    @property
    def value_scale(self) -> float:
        """By what the learner's values are divided to be in the environment's units."""
        ...

    def values_of(self, observation: Any) -> Array:
        """Action values of observations, in the environment's units, as evaluations would see them now."""
        ...

    def parameters(self) -> dict[str, Array]:
        """Copies of the parameters that evaluations would use now, by name."""
        ...


@dataclass(frozen=True, slots=True)
class StepArrays:
    """One step of the environments that moved, as the learner sees it; read-only, valid until the next step.

    Args:
        s_tm1: observations before the actions ``[k, *obs]``, encoded and, where that is wanted, normalised.
        a_tm1: actions ``[k]``, counted from 0.
        mu_tm1: probabilities of the actions ``[k]``.
        r_t: rewards ``[k]``.
        discount_t: γ, or 0 where the world ended ``[k]``.
        s_t: successors ``[k, *obs]``, the true ones at an episode's end too.
        last_t: where an episode ended ``[k]``.
        env_indices: which environments moved ``[k]``.
        episodes: those that ended with this step.
    """

    s_tm1: Array
    a_tm1: Array
    mu_tm1: Array
    r_t: Array
    discount_t: Array
    s_t: Array
    last_t: Array
    env_indices: Array
    episodes: tuple[Episode, ...]


class SessionView:
    """A run as hooks see it: everything to read, nothing to write, and `stop`."""

    _watch: Watch

    def __init__(self, watch: Watch) -> None:
        object.__setattr__(self, "_watch", watch)

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{name} cannot be set: hooks read a session and change nothing; keep it in the hook")

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"{name} cannot be deleted: hooks read a session and change nothing")

    @property
    def config(self) -> Any:
        """The run's configuration; of a run on an environment a `neuralq.RunConfig`."""
        return self._watch.config

    @property
    def run_dir(self) -> Path:
        """The run folder; a hook may put files of its own there."""
        return self._watch.folder.path

    @property
    def env_steps(self) -> int:
        """Environment steps so far."""
        return int(self._watch.trainee.env_steps)

    @property
    def amount(self) -> int:
        """Training so far in the run's own unit: environment steps, or games."""
        return int(self._watch.trainee.amount)

    @property
    def metrics(self) -> list[dict[str, Any]]:
        """Every row of metrics so far, also of before the run was resumed."""
        return [dict(row) for row in self._watch.rows()]

    @property
    def evaluation(self) -> dict[str, Any] | None:
        """The row of the last evaluation (``greedy_return``, ``returns``, …), or None before the first."""
        found = next((row for row in reversed(self._watch.rows()) if row.get("kind") == "evaluation"), None)
        return None if found is None else dict(found)

    @property
    def best_return(self) -> float | None:
        """Score of the best evaluation so far."""
        found: float | None = self._watch.progress.best_return
        return found

    @property
    def ended_by(self) -> str | None:
        """What has ended the run: "budget", "target", a signal's name, or which hook and why; None while it goes."""
        return self._watch.ended_by

    @property
    def step(self) -> StepArrays | None:
        """The last step of the environments; None before the first since the run was begun or resumed."""
        step = self._watch.watchable("steps").last_step
        if step is None:
            return None
        s_tm1, a_tm1, mu_tm1, r_t, discount_t, s_t, last_t = map(_read_only, step.rows)
        rows = (s_tm1, a_tm1, mu_tm1, r_t, discount_t, s_t, last_t, _read_only(step.env_indices))
        return StepArrays(*rows, step.episodes)

    @property
    def num_updates(self) -> int:
        """Updates of the learner so far."""
        return self._watch.watchable("updates").num_updates

    @property
    def update(self) -> dict[str, Array] | None:
        """``errors`` and ``targets`` of the last update ``[B]``, in the learner's units; None before the first."""
        update = self._watch.watchable("updates").last_update
        if update is None:
            return None
        found = {"errors": update.errors, "targets": update.targets}
        return {name: _read_only(value.detach().cpu().numpy()) for name, value in found.items()}

    def values(self, observation: Any) -> Array:
        """Action values of an observation of the environment's, in its units, as an evaluation would see them."""
        return self._watch.watchable("action values").values_of(observation)

    def q(self, observation: Any) -> Array:
        """The same in the learner's own units: scaled as its rewards are."""
        trainee = self._watch.watchable("action values")
        return trainee.values_of(observation) * trainee.value_scale

    def parameters(self) -> dict[str, Array]:
        """Copies of the parameters that an evaluation would use now, by name."""
        return self._watch.watchable("named parameters").parameters()

    def stop(self, why: str) -> None:
        """Ask the run to end at the next point where it can be saved; it may be resumed.

        Args:
            why: told with the result, after the name of the hook.
        """
        if not why or not isinstance(why, str):
            raise ValueError(f"say in words why the run is to stop, got {why!r}; session.stop('no better for 5 looks')")
        self._watch.stop(why)


def _read_only(array: Array) -> Array:
    view = np.asarray(array).view()
    view.flags.writeable = False
    return view
