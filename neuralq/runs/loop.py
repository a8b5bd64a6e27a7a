"""The training loop: a fold of the stream of experience through feed, learner and hooks.

It knows no algorithm. What a run consists of is in `Session`, what is asked of it in `Plan`, how far it has come in
`Progress`; a checkpoint holds exactly the first and the last, so a run that stops anywhere goes on bit for bit.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.best import keep_best
from neuralq.runs.evaluation import Evaluation, evaluate_greedy
from neuralq.runs.stream.experience import ExperienceSource, Sample
from neuralq.runs.stream import Interaction, Policy
from neuralq.learners.averaging import evaluation_parameters, evaluating_with
from neuralq.learners.learner import Learner, Update
from neuralq.runs.folder.run_folder import RunFolder
from neuralq.runs.folder.env_encode import encode_env
from neuralq.runs.folder.env_probe import Resumability
from neuralq.runs.folder.env_restore import restore_env
from neuralq.runs.stop_request import StopRequest
from neuralq.runs.clock import Stopwatch
from neuralq.types import Transition

__all__ = ["Diverged", "Hook", "Observer", "Plan", "Progress", "Session", "fit", "restore", "seed_for"]


class Hook(Protocol):
    """Takes every row of metrics (``kind`` "train" or "evaluation") as it is recorded. Hooks read, never write."""

    def __call__(self, row: Mapping[str, Any], /) -> None:
        """Take in one row."""
        ...


@runtime_checkable
class Observer(Protocol):
    """A hook that also looks at the learner: what was last learned from is shown to it before each row.

    It reads, never writes: neither the learner nor the sample, of which it copies what it wants to keep.
    """

    def observe(self, learner: Learner, sample: Sample, /) -> None:
        """Read the learner and the sample it last learned from."""
        ...

    def __call__(self, row: Mapping[str, Any], /) -> None:
        """Take in one row."""
        ...


class Diverged(RuntimeError):
    """The parameters are no longer finite numbers; the last checkpoint is from before that."""


@dataclass
class Session:
    """The mutable parts of a run, and nothing else.

    Args:
        stream: experience from the training environments.
        policy: the behaviour.
        feed: between stream and learner.
        learner: what learns.
        generators: every generator in use, by name.
        evaluation_stream: an interaction with an environment made for evaluation.
        resumability: whether the environments' state can be saved.
    """

    stream: Interaction
    policy: Policy
    experience: ExperienceSource
    learner: Learner
    generators: dict[str, np.random.Generator]
    evaluation_stream: Interaction
    resumability: Resumability

    def evaluate(self, num_episodes: int, seed: int, max_steps: int) -> Evaluation:
        """Greedy evaluation of the parameters that the learner plays with."""
        with evaluating_with(self.learner):
            return evaluate_greedy(self.learner.engine.all, self.evaluation_stream, num_episodes, seed, max_steps)

    def close(self) -> None:
        """Close the environments."""
        for stream in (self.stream, self.evaluation_stream):
            with contextlib.suppress(Exception):
                stream.envs.close()


@dataclass(frozen=True)
class Plan:
    """What is asked of a run. Steps are environment steps, summed over parallel environments.

    Args:
        total_steps: budget.
        stop_at_return: stop once a greedy evaluation averages at least this; None to use the whole budget.
        evaluate_every: steps between greedy evaluations.
        evaluation_episodes: episodes of each.
        evaluation_max_steps: bound on an evaluation episode where the environment has none.
        checkpoint_every: steps between checkpoints.
        log_every: steps between rows of training metrics.
        seed: from which evaluation seeds are derived.
    """

    total_steps: int
    stop_at_return: float | None
    evaluate_every: int
    evaluation_episodes: int
    evaluation_max_steps: int
    checkpoint_every: int
    log_every: int
    seed: int


@dataclass
class Progress:
    """How far a run has come.

    Args:
        env_steps: environment steps.
        cpu_seconds: CPU time of training, evaluations excluded.
        wall_seconds: wall time of training and evaluation.
        greedy_return: mean of the last greedy evaluation, None before the first.
        best_return: best mean so far.
        evaluated_at: steps at which that was.
        reached_at: steps at which ``stop_at_return`` was first met.
        finished: whether the run has ended by itself.
    """

    env_steps: int = 0
    cpu_seconds: float = 0.0
    wall_seconds: float = 0.0
    greedy_return: float | None = None
    best_return: float | None = None
    evaluated_at: int | None = None
    reached_at: int | None = None
    finished: bool = False
    next_evaluation: int = 0
    next_checkpoint: int = 0
    next_log: int = 0
    recent_returns: list[float] = field(default_factory=list)
    last_metrics: dict[str, float] = field(default_factory=dict)
    interrupted_by: str | None = None


def seed_for(seed: int, *purpose: int) -> int:
    """A seed that belongs to one purpose of one run; different runs and purposes do not overlap.

    Example:
        >>> seed_for(0, 1) != seed_for(0, 2) != seed_for(1, 1)
        True
    """
    return int(np.random.SeedSequence([seed, *purpose]).generate_state(1)[0] >> 1)


def fit(session: Session, plan: Plan, progress: Progress, folder: RunFolder, hooks: Sequence[Hook] = ()) -> Progress:
    """Train until the plan is met, the budget is spent or a signal asks to stop; the folder then holds a checkpoint.

    Args:
        session: what trains; changed in place.
        plan: when to evaluate, save and stop.
        progress: where to begin; changed in place and returned.
        folder: an open run folder.
        hooks: called with each row of metrics.

    Raises:
        EnvironmentFault: if an environment breaks its contract. The last checkpoint stays as it is.
        Diverged: if the parameters stop being finite. Likewise.
    """
    loop = _Loop(session, plan, progress, folder, hooks)
    request = StopRequest()
    with request.listening():
        try:
            loop.run(request)
        except ValueError as error:  # NaN among the values: the policy notices before the next checkpoint would
            _refuse_divergence(session, progress)
            raise error
    return progress


def _refuse_divergence(session: Session, progress: Progress) -> None:
    if not bool(torch.isfinite(session.learner.engine.flat.values).all()):
        raise Diverged(
            f"after {progress.env_steps:,} environment steps the parameters are no longer finite: training "
            "diverged; nothing was saved over the last checkpoint. Try a smaller step size, a target network "
            "or λ nearer 1"
        )


class _Loop:
    def __init__(
        self, session: Session, plan: Plan, progress: Progress, folder: RunFolder, hooks: Sequence[Hook]
    ) -> None:
        self.session, self.plan, self.progress, self.folder, self.hooks = session, plan, progress, folder, hooks
        self.recent = deque(progress.recent_returns, maxlen=100)
        self.last_update: Update | None = None
        self.last_sample: Sample | None = None
        self.device = session.learner.engine.flat.values.device
        self._clock = Stopwatch(progress)
        self._log_clock = (progress.env_steps, time.perf_counter())
        progress.finished = False
        progress.interrupted_by = None
        for name, period in (("evaluation", plan.evaluate_every), ("checkpoint", plan.checkpoint_every)):
            if getattr(progress, f"next_{name}") == 0:
                setattr(progress, f"next_{name}", period)

    def run(self, request: StopRequest) -> None:
        session, plan, progress = self.session, self.plan, self.progress
        # A rollout that was begun is finished: half of one can be neither learned from nor saved.
        while progress.env_steps < plan.total_steps or not session.experience.between_samples:
            self._advance()
            if not session.experience.between_samples:
                continue
            if progress.env_steps >= progress.next_log:
                self._log()
            if progress.env_steps >= progress.next_evaluation:
                self._evaluate()
                if plan.stop_at_return is not None and progress.reached_at is not None:
                    break
            if request.name is not None:
                progress.interrupted_by = request.name
                self._save()
                return
            if progress.env_steps >= progress.next_checkpoint:
                self._save()
        if progress.evaluated_at != progress.env_steps:
            self._evaluate()
        self._clock.read()
        progress.finished = True
        self._save()

    def _advance(self) -> None:
        session = self.session
        step = session.stream.step(session.policy)
        session.experience.add(step)
        for episode in step.episodes:
            self.recent.append(episode.episode_return)
        for sample in session.experience.draw():
            update = session.learner.update(*self._on_device(sample))
            session.experience.return_errors(sample, update.errors)
            self.last_update, self.last_sample = update, sample
        self.progress.env_steps = session.stream.num_steps

    def _on_device(self, sample: Sample) -> tuple[Transition, Tensor | None]:
        """The sample where the learner computes; on the CPU it stays where it is.

        Weights stay on the host: which of them are 0 is asked there, and learners that multiply by them move them.
        """
        if self.device.type == "cpu":
            return sample.transition, sample.weight
        return sample.transition.map(lambda x: x.to(self.device)), sample.weight

    def _record(self, row: dict[str, Any]) -> None:
        self.folder.append_metrics(row)
        for hook in self.hooks:
            if self.last_sample is not None and isinstance(hook, Observer):
                hook.observe(self.session.learner, self.last_sample)
            hook(row)
        self._clock.read(training=False)  # whoever watches costs wall time only

    def _last_metrics(self) -> dict[str, float]:
        """Of the last update, which may have been before the run was resumed."""
        return self.progress.last_metrics if self.last_update is None else self.last_update.metrics()

    def _log(self) -> None:
        self._clock.read()
        progress = self.progress
        progress.next_log = progress.env_steps + self.plan.log_every
        then, now = self._log_clock, (progress.env_steps, time.perf_counter())
        self._log_clock = now
        row: dict[str, Any] = {
            "kind": "train",
            "env_steps": progress.env_steps,
            "cpu_seconds": progress.cpu_seconds,
            "wall_seconds": progress.wall_seconds,
            "steps_per_second": (now[0] - then[0]) / max(now[1] - then[1], 1e-9),
            "episode_return": float(np.mean(self.recent)) if self.recent else None,
            "num_updates": self.session.learner.num_updates,
        }
        self._record(row | self._last_metrics())

    def _evaluate(self) -> None:
        self._clock.read()
        session, plan, progress = self.session, self.plan, self.progress
        progress.next_evaluation = (progress.env_steps // plan.evaluate_every + 1) * plan.evaluate_every
        progress.evaluated_at = progress.env_steps
        seed = seed_for(plan.seed, 9, progress.env_steps)
        result = session.evaluate(plan.evaluation_episodes, seed, plan.evaluation_max_steps)
        progress.greedy_return = result.mean
        if progress.best_return is None or result.mean > progress.best_return:
            progress.best_return = result.mean
            seen = None if session.stream.normalisation is None else session.stream.normalisation.state_dict()
            keep_best(self.folder.path, progress.env_steps, result.mean, evaluation_parameters(session.learner), seen)
        if plan.stop_at_return is not None and progress.reached_at is None and result.mean >= plan.stop_at_return:
            progress.reached_at = progress.env_steps
        self._clock.read(training=False)
        self._record(
            {
                "kind": "evaluation",
                "env_steps": progress.env_steps,
                "cpu_seconds": progress.cpu_seconds,
                "wall_seconds": progress.wall_seconds,
                "greedy_return": result.mean,
                "returns": list(result.returns),
                "num_cut": result.num_cut,
            }
        )

    def _save(self) -> None:
        progress = self.progress
        progress.recent_returns = list(self.recent)
        progress.last_metrics = self._last_metrics()
        period = self.plan.checkpoint_every
        progress.next_checkpoint = (progress.env_steps // period + 1) * period
        _refuse_divergence(self.session, progress)
        self._clock.read()
        checkpoint.save(self.folder.checkpoints_path, progress.env_steps, _state(self.session, progress))


def _state(session: Session, progress: Progress) -> dict[str, Any]:
    """Everything that a continued run needs, as one tree."""
    exact = session.resumability.exact
    return {
        "progress": asdict(progress),
        "learner": session.learner.state_dict(),
        "feed": session.experience.state_dict(),
        "stream": session.stream.state_dict(),
        "environments": encode_env(session.stream.envs) if exact else None,
        "generators": {name: rng.bit_generator.state for name, rng in session.generators.items()},
    }


def restore(session: Session, state: Mapping[str, Any], seed: int) -> Progress:
    """Put a freshly built session where the saved one stood.

    Where the environments' state could not be saved, every environment starts a new episode, with a seed of its own.

    Args:
        session: built from the same configuration; changed in place.
        state: what a checkpoint holds.
        seed: of the run.
    """
    session.learner.load_state_dict(state["learner"])
    session.experience.load_state_dict(state["feed"])
    for name, rng in session.generators.items():
        rng.bit_generator.state = state["generators"][name]
    progress = Progress(**state["progress"])
    environments: VectorEnv[Any, Any, Any] = session.stream.envs
    if state["environments"] is not None:
        restore_env(environments, state["environments"])
        session.stream.load_state_dict(state["stream"])
    else:
        session.stream.load_normalisation(state["stream"])
        session.stream.restart(seed_for(seed, 8, progress.env_steps))
        session.stream.num_steps = progress.env_steps
        session.learner.begin_streams()
    return progress
