"""What trains on a Gymnasium environment: a stream of experience, folded through behaviour, source and learner."""

from __future__ import annotations

import contextlib
import warnings
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from neuralq.learners.averaging import evaluating_with, evaluation_parameters
from neuralq.learners.learner import Learner, Update
from neuralq.runs.agent import Agent
from neuralq.runs.evaluation import Evaluation, evaluate_greedy
from neuralq.runs.folder.best import Best
from neuralq.runs.folder.env_encode import NotCopyable, encode_env
from neuralq.runs.folder.env_probe import Resumability
from neuralq.runs.folder.env_restore import restore_env
from neuralq.runs.loop import Diverged, seed_for
from neuralq.runs.stop_request import StopRequest
from neuralq.runs.stream import Interaction, Policy, Step
from neuralq.runs.stream.early_returns import EarlyReturns
from neuralq.runs.stream.encoding import discrete_actions
from neuralq.runs.stream.experience import ExperienceSource, Sample
from neuralq.types import Array

__all__ = ["Session", "cap_on_evaluation"]


@dataclass
class Session:
    """The mutable parts of a run on an environment; a `neuralq.runs.loop.Trainee`.

    Args:
        stream: experience from the training environments.
        policy: the behaviour.
        experience: between stream and learner.
        learner: what learns.
        generators: every generator in use, by name.
        make_evaluation: makes an interaction with environments of its own for evaluation; called when first needed.
        resumability: whether the environments' state can be saved.
        seed: of the run.
        evaluation_episodes: episodes of each evaluation.
        evaluation_max_steps: bound on an evaluation episode where the environment has none; None to learn one from
            the episodes of training (`cap_on_evaluation`).
        evaluate_every: environment steps between evaluations.
        value_range: the smallest and the largest return that the learner can represent, where it cannot represent all.
        reward_scale: by what the learner multiplies rewards; metrics are in the environment's units.
    """

    stream: Interaction
    policy: Policy
    experience: ExperienceSource
    learner: Learner
    generators: dict[str, np.random.Generator]
    make_evaluation: Callable[[], Interaction]
    resumability: Resumability
    seed: int
    evaluation_episodes: int
    evaluation_max_steps: int | None
    evaluate_every: int
    reward_scale: float = 1.0
    value_range: tuple[float, float] | None = None
    _evaluation: Interaction | None = field(init=False, default=None)
    _cannot_evaluate: bool = field(init=False, default=False)
    _longest: int = field(init=False, default=0)
    _recent_returns: deque[float] = field(init=False, default_factory=lambda: deque(maxlen=100))
    _last: tuple[Update, Sample] | None = field(init=False, default=None)
    _metrics_before: dict[str, float] = field(init=False, default_factory=dict)
    say: Callable[[str], None] = field(init=False, default=lambda line: None)
    _early: EarlyReturns | None = field(init=False, default=None)
    on_step: Callable[[], None] | None = field(init=False, default=None)
    on_update: Callable[[], None] | None = field(init=False, default=None)
    last_step: Step | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        """Watch the first returns where some of them cannot be represented."""
        if self.value_range is not None:
            stream = self.stream
            self._early = EarlyReturns(
                *self.value_range, stream.discount, stream.num_envs, lambda line: self.say(f"warning: {line}")
            )

    @property
    def evaluation_stream(self) -> Interaction:
        """The interaction in which greedy episodes are played, made when it is first asked for.

        Raises:
            ValueError: if the environment cannot be made beside those of training.
        """
        if self._evaluation is None:
            self._evaluation = self.make_evaluation()
        return self._evaluation

    @property
    def amount(self) -> int:
        """Environment steps, summed over parallel environments."""
        return self.stream.num_steps

    @property
    def env_steps(self) -> int:
        """The same."""
        return self.stream.num_steps

    @property
    def observed(self) -> tuple[Learner, Sample] | None:
        """The learner and the sample it last learned from."""
        return None if self._last is None else (self.learner, self._last[1])

    def advance(self, until: int, request: StopRequest) -> None:
        """One step or more; a rollout that was begun is finished: half of one can be neither learned from nor saved."""
        stream, experience, learner = self.stream, self.experience, self.learner
        device = learner.engine.flat.values.device
        on_cpu = device.type == "cpu"
        while True:
            step = self.last_step = stream.step(self.policy)
            experience.add(step)
            if self._early is not None:
                self._early = self._early.add(step)
            for episode in step.episodes:
                self._recent_returns.append(episode.episode_return)
                self._longest = max(self._longest, episode.length)
            if self.on_step is not None:
                self.on_step()
            for sample in experience.draw():
                transition = sample.transition if on_cpu else sample.transition.map(lambda x: x.to(device))
                # Weights stay on the host: which are 0 is asked there, and learners that multiply by them move them.
                update = learner.update(transition, sample.weight)
                experience.return_errors(sample, update.errors)
                self._last = update, sample
                if self.on_update is not None:
                    self.on_update()
            if experience.between_samples and (stream.num_steps >= until or request.name is not None):
                return

    def training_row(self) -> dict[str, Any]:
        """Mean return of recent episodes, number of updates, and what the last one saw."""
        recent = float(np.mean(self._recent_returns)) if self._recent_returns else None
        return {"episode_return": recent, "num_updates": self.learner.num_updates, **self._last_metrics()}

    def _last_metrics(self) -> dict[str, float]:
        """Of the last update, which may have been before the run was resumed, in the environment's units."""
        if self._last is None:
            return self._metrics_before
        scale = self.value_scale
        return {
            name: value / (scale * scale if name == "loss" else scale)
            for name, value in self._last[0].metrics().items()
        }

    @property
    def value_scale(self) -> float:
        """By what the learner's values are divided to be in the environment's units."""
        seen = self.stream.normalisation
        return self.reward_scale * (1.0 if seen is None else seen.reward_scale)

    @property
    def last_update(self) -> Update | None:
        """What the last update saw."""
        return None if self._last is None else self._last[0]

    @property
    def num_updates(self) -> int:
        """Updates so far."""
        return self.learner.num_updates

    def values_of(self, observation: Any) -> Array:
        """Action values of observations in the environment's units, with the parameters that the learner plays with."""
        stream = self.stream
        seen = None if stream.normalisation is None else stream.normalisation.frozen()
        _, first_action = discrete_actions(stream.envs.single_action_space)
        agent = Agent(self.learner.engine.q, stream.encoder, stream.spec, first_action, self.value_scale, seen)
        with evaluating_with(self.learner):
            return agent.values(observation)

    def parameters(self) -> dict[str, Array]:
        """Copies of the parameters that the learner plays with, by name."""
        with evaluating_with(self.learner):
            named = self.learner.engine.q.state_dict()  # type: ignore[attr-defined]  # a module, as all of ours
            return {name: value.detach().cpu().numpy().copy() for name, value in named.items()}

    def play_greedily(self, seed: int) -> Evaluation:
        """Greedy episodes with the parameters that the learner plays with."""
        with evaluating_with(self.learner):
            return evaluate_greedy(
                self.learner.engine.all, self.evaluation_stream, self.evaluation_episodes, seed,
                self._cap(),
            )  # fmt: skip

    def evaluate(self, seed: int) -> tuple[dict[str, Any], Best | None]:
        """Returns of greedy episodes, and the parameters that played them.

        An environment that can exist only once is not evaluated, which a warning says.
        """
        if not self._can_evaluate():
            return {}, None
        found, seen = self.play_greedily(seed), self.stream.normalisation
        statistics = None if seen is None else seen.state_dict()
        columns: dict[str, Any] = {"greedy_return": found.mean, "returns": list(found.returns)}
        columns["num_cut"] = found.num_cut
        if self.evaluation_max_steps is None:
            columns["max_steps"] = self._cap()
        scalings = self.stream.encoder.scalings
        return columns, Best(self.env_steps, found.mean, evaluation_parameters(self.learner), statistics, scalings)

    def _cap(self) -> int:
        if self.evaluation_max_steps is not None:
            return self.evaluation_max_steps
        longest = max(self._longest, *(length for _, length in self.stream.running_episodes()))
        return cap_on_evaluation(longest, self.evaluate_every, self.evaluation_episodes)

    def _can_evaluate(self) -> bool:
        if self._evaluation is None and not self._cannot_evaluate:
            try:
                _ = self.evaluation_stream
            except ValueError as error:
                self._cannot_evaluate = True
                warnings.warn(
                    f"the run is not evaluated: beside the environments of training there can be no other ({error}); "
                    "neuralq evaluate plays it when training has ended",
                    stacklevel=2,
                )
        return not self._cannot_evaluate

    def require_finite(self) -> None:
        """Refuse parameters that are no longer finite.

        Raises:
            Diverged: if they are not.
        """
        if not bool(torch.isfinite(self.learner.engine.flat.values).all()):
            longest = getattr(getattr(self.learner, "settings", None), "lambda_", 0.0) == 1
            raise Diverged(
                f"after {self.env_steps:,} environment steps the parameters are no longer finite: training "
                "diverged; nothing was saved over the last checkpoint. Try a smaller step size, "
                + ("smaller rewards or a target network" if longest else "a target network or λ nearer 1")
            )

    def state_dict(self) -> dict[str, Any]:
        """Everything that a continued run needs, as one tree."""
        return {
            "progress": {
                "env_steps": self.env_steps,
                "recent_returns": list(self._recent_returns),
                "last_metrics": self._last_metrics(),
                "longest_episode": self._longest,
            },
            "layers": self.learner.engine.flat.layers,
            "learner": self.learner.state_dict(),
            "feed": self.experience.state_dict(),
            "stream": self.stream.state_dict(),
            "environments": self._environments(),
            "generators": {name: rng.bit_generator.state for name, rng in self.generators.items()},
        }

    def _environments(self) -> dict[str, Any] | None:
        """The environments' own state; None where it cannot be taken, or no longer can."""
        if not self.resumability.exact:
            return None
        try:
            return encode_env(self.stream.envs)
        except NotCopyable as error:
            self._inexact(f"after {self.env_steps:,} steps the environment's state can no longer be saved: {error}")
            return None

    def _inexact(self, why: str) -> None:
        self.resumability = Resumability(False, f"resumes at an episode boundary, not bit-exact: {why}")
        warnings.warn(self.resumability.reason, stacklevel=2)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`.

        Where the environments' state could not be saved, every environment starts a new episode, with a seed of its
        own.
        """
        progress = state["progress"]
        self._recent_returns.extend(progress["recent_returns"])
        self._metrics_before = progress["last_metrics"]
        self._longest = int(progress.get("longest_episode", 0))
        self.learner.load_state_dict(state["learner"])
        self.experience.load_state_dict(state["feed"])
        for name, rng in self.generators.items():
            rng.bit_generator.state = state["generators"][name]
        if self._restored(state["environments"]):
            self.stream.load_state_dict(state["stream"])
        else:
            self.stream.load_normalisation(state["stream"])
            self.stream.restart(seed_for(self.seed, 8, progress["env_steps"]))
            self.stream.num_steps = progress["env_steps"]
            self.learner.begin_streams()

    def _restored(self, environments: Mapping[str, Any] | None) -> bool:
        if environments is None:
            return False
        try:
            restore_env(self.stream.envs, environments)
        except NotCopyable as error:
            self._inexact(f"the environment's saved state could not be put back: {error}")
            return False
        return True

    def close(self) -> None:
        """Close the environments."""
        for stream in filter(None, (self.stream, self._evaluation)):
            with contextlib.suppress(Exception):
                stream.envs.close()


def cap_on_evaluation(longest: int, evaluate_every: int, num_episodes: int) -> int:
    """Steps after which an evaluation episode is cut where the environment has no time limit.

    Ten times the longest episode that training has seen, between 100 and 10,000; and all episodes together may take
    ten times the steps between two evaluations: a policy that never arrives would else be watched for hours.

    Example:
        >>> cap_on_evaluation(30, 4096, 20), cap_on_evaluation(4096, 4096, 20), cap_on_evaluation(0, 64, 20)
        (300, 2048, 100)
    """
    return max(100, min(10 * longest, 10 * evaluate_every // num_episodes, 10_000))
