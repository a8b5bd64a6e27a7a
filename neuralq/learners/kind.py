"""How runs know a learner: a record at the end of its file, which is all that a new one has to bring along.

A learner is one file: a frozen dataclass of settings, the class, and its `LearnerKind`. Configurations, options, help,
presets, sweeps and tests ask `learner_kinds` which there are; training asks the record for the rest.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from neuralq.checks import check_choice
from neuralq.learners.learner import Learner
from neuralq.q.engine import Engine, Loss
from neuralq.rules.records import discovered
from neuralq.types import QFunction

__all__ = ["LearnerKind", "Parts", "Representation", "Traits", "learner_kinds"]


class Representation(Protocol):
    """What a configuration says of the representation; a learner may refuse it."""

    @property
    def layout(self) -> str:
        """Name of the layout, such as "table" or "action-output"."""
        ...

    @property
    def dueling(self) -> bool:
        """Whether the outputs come from a value and an advantage stream."""
        ...

    @property
    def engine(self) -> str:
        """Which engine was asked for: "auto", "torch" or "compiled"."""
        ...


@dataclass(frozen=True)
class Parts:
    """What a run makes a learner from.

    Args:
        engine: values and gradients of the representation.
        settings: of the learner, of its kind's class.
        rng: the run's generator of samples; its state is part of a checkpoint.
        discount: γ.
        reward_scale: rewards are multiplied by it for learning.
        total_steps: the run's budget in environment steps.
        kernels: the engine that was asked for, "auto", "torch" or "compiled".
        another: makes another representation like the engine's, with weights drawn for itself.
        exploration: ε at the first step, in the end, and the environment steps in between, for learners that act by
            themselves.
    """

    engine: Engine
    settings: Any
    rng: np.random.Generator
    discount: float
    reward_scale: float
    total_steps: int
    kernels: str
    another: Callable[[], QFunction]
    exploration: tuple[float, float, int] = (1.0, 0.05, 20_000)


@dataclass(frozen=True)
class Traits:
    """What decides whether a learner's updates can diverge, as far as its settings say.

    Args:
        step_size: α, or the learning rate.
        plain_steps: whether updates are plain gradient steps; with Adam and its like α says little by itself.
        lambda_: λ of traces or λ-returns; 0 for one-step targets.
        target_period: updates between copies into a target network; None without one.
        replay: whether old experience of other policies is learned from.
        double: whether targets are those of double Q-learning.
    """

    step_size: float
    plain_steps: bool = True
    lambda_: float = 0.0
    target_period: int | None = None
    replay: bool = False
    double: bool = False


def _anything(settings: Any, representation: Representation) -> None:
    """Every representation will do."""


def _as_it_is(q: QFunction, settings: Any, reward_scale: float, rng: np.random.Generator) -> QFunction:
    return q


@dataclass(frozen=True, eq=False)
class LearnerKind:
    """A learner as runs know it. Everything but ``build`` is asked of the settings, before there is a learner.

    Args:
        name: one word for configurations, options and presets; the field of `neuralq.RunConfig` with the settings.
        title: what it is, in a few words.
        source: author and year.
        settings: frozen dataclass whose docstring describes each field, which is what ``--help`` shows.
        build: ``build(parts) -> learner``.
        experience: in which pieces it takes experience: "rollouts" ``[T, N]`` (the settings have num_envs and
            num_steps), "replay" (batch_size, block_length, capacity, learning_starts, num_envs, num_steps, prioritised,
            train_period and updates_per_period, as `ReplaySettings` has), "steps" ``[N]`` as they come (num_envs,
            or 1), or "table", where it acts by itself in one environment or its model (simulate).
        traits: what it is like where divergence is looked for.
        loss: of the engine.
        normalises: whether observations are normalised (None: unless they are state indices), and whether rewards are.
        outputs: ``outputs(settings, layout)``: how many numbers the representation has for every action.
        represent: the Q-function that those outputs describe: ``represent(q, settings, reward_scale, rng)``.
        check: ``check(settings, representation)`` raises a `ValueError` with the way out where they do not go together.
        layout: of the representation where none is chosen.
        place: where it stands in lists; those of one number by name.
        step_sizes: settings that a run may go on with otherwise than it began.
        on_table: ``on_table(given)``: defaults of settings over a table, where a sample moves one entry, so that a step
            that suits the weights of a network is much too small; left out where a step size is given.
        space: settings that are worth tuning and where to look, as `neuralq.runs.tune.space` reads them; each is tried
            over the preset of an environment, whose own value is looked at in any case.
        updates_per_step: gradient steps for each environment step, which is what a run costs beside the environment.
    """

    name: str
    title: str
    source: str
    settings: type[Any]
    build: Callable[[Parts], Learner]
    experience: str
    traits: Callable[[Any], Traits]
    loss: Callable[[Any], Loss] = lambda settings: Loss("squared")
    normalises: Callable[[Any], tuple[bool | None, bool]] = lambda settings: (False, False)
    outputs: Callable[[Any, str], int] = lambda settings, layout: 1
    represent: Callable[[QFunction, Any, float, np.random.Generator], QFunction] = _as_it_is
    check: Callable[[Any, Representation], None] = _anything
    layout: str = "action-output"
    place: int = 100
    step_sizes: tuple[str, ...] = ()
    on_table: Callable[[Mapping[str, Any]], Mapping[str, Any]] = lambda given: {}
    space: Mapping[str, Any] = field(default_factory=dict)
    updates_per_step: Callable[[Any], float] = lambda settings: 1.0

    def settings_for(self, layout: str, given: Mapping[str, Any]) -> Any:
        """The settings where some are given, for a layout.

        Example:
            >>> kind = learner_kinds()["online"]
            >>> kind.settings_for("table", {}).step_size, kind.settings_for("linear", {}).step_size
            (0.1, 0.001)
            >>> kind.settings_for("table", {"step_size": 0.5}).step_size
            0.5
        """
        own = self.on_table(given) if layout == "table" and not given.keys() & set(self.step_sizes) else {}
        return self.settings(**{**own, **given})

    def __post_init__(self) -> None:
        """Refuse experience that no run hands out."""
        kinds = ("rollouts", "replay", "steps", "table")
        check_choice(f"experience of the learner {self.name!r}", self.experience, kinds)


@functools.cache
def learner_kinds() -> Mapping[str, LearnerKind]:
    """Every learner of the library by name, as its own file describes it.

    Example:
        >>> learner_kinds()["replay"].settings.__name__
        'ReplaySettings'
    """
    return discovered("neuralq.learners", LearnerKind)
