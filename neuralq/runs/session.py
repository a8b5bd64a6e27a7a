"""What trains on a Gymnasium environment: a stream of experience, folded through behaviour, source and learner."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from neuralq.learners.averaging import evaluating_with, evaluation_parameters
from neuralq.learners.learner import Learner, Update
from neuralq.runs.agent import Agent
from neuralq.runs.beside import Beside
from neuralq.runs.evaluation import Evaluation, evaluate_greedy
from neuralq.runs.folder.best import Best
from neuralq.runs.folder.env_encode import NotCopyable, encode_env
from neuralq.runs.folder.env_probe import Resumability
from neuralq.runs.folder.env_restore import restore_env
from neuralq.runs.loop import Diverged, seed_for
from neuralq.runs.offline.playback import Playback
from neuralq.runs.play_off import play_off
from neuralq.runs.stop_request import StopRequest
from neuralq.runs.stream import Episode, Interaction, Policy, Step
from neuralq.runs.stream.early_returns import EarlyReturns
from neuralq.runs.stream.encoding import discrete_actions
from neuralq.runs.stream.experience import ExperienceSource, Sample
from neuralq.runs.stream.table import TableWalk
from neuralq.types import Array

__all__ = ["Session", "cap_on_evaluation"]


@dataclass
class Session:
    """The mutable parts of a run on an environment; a `neuralq.runs.loop.Trainee`.

    Args:
        stream: experience from the training environments; or a walk, which acts and learns by itself.
        policy: the behaviour; None with a walk.
        experience: between stream and learner; None with a walk.
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
        beside: holds what is learned against the exact answer, where the environment has a model.
    """

    stream: Interaction | TableWalk | Playback
    policy: Policy | None
    experience: ExperienceSource | None
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
    beside: Beside | None = None
    _evaluation: Interaction | None = field(init=False, default=None)
    _cannot_evaluate: bool = field(init=False, default=False)
    _longest: int = field(init=False, default=0)
    _recent_returns: deque[float] = field(init=False, default_factory=lambda: deque(maxlen=100))
    _last: tuple[Update, Sample] | None = field(init=False, default=None)
    _metrics_before: dict[str, float] = field(init=False, default_factory=dict)
    say: Callable[[str], None] = field(init=False, default_factory=lambda: _unheard)
    _early: EarlyReturns | None = field(init=False, default=None)
    on_step: Callable[[], None] | None = field(init=False, default=None)
    on_update: Callable[[], None] | None = field(init=False, default=None)
    last_step: Step | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        """Watch the first returns where some of them cannot be represented, and what is met where that is compared."""
        if self.beside is not None:
            self.beside.watch()
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
        """The learner and the sample it last learned from, which says how its rewards are normalised by now."""
        if self._last is None:
            return None
        return self.learner, dataclasses.replace(self._last[1], reward_scale=self.value_scale / self.reward_scale)

    def advance(self, until: int, request: StopRequest) -> None:
        """One step or more; a rollout that was begun is finished: half of one can be neither learned from nor saved."""
        if isinstance(self.stream, TableWalk):
            self._walk(self.stream, until, request)
            return
        stream, experience, learner = self.stream, self.experience, self.learner
        assert self.policy is not None and experience is not None
        device, beside = learner.engine.flat.values.device, self.beside
        on_cpu = device.type == "cpu"
        while True:
            step = self.last_step = stream.step(self.policy)
            experience.add(step)
            if beside is not None:
                beside.see(step.rows[0], step.rows[1])
            if self._early is not None:
                self._early = self._early.add(step)
            self._count(step.episodes)
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

    def _walk(self, walk: TableWalk, until: int, request: StopRequest) -> None:
        """A walk learns as it goes, so whoever wants to see its steps sees them when they have been learned from."""
        watched = list(filter(None, (self.on_step, self.on_update)))
        while walk.num_steps < until and request.name is None:
            self._count(walk.advance(walk.num_steps + 1 if watched else until, request))
            if watched:
                self.last_step = walk.last_step()
            for tell in watched:
                tell()
        if self.beside is not None and self.beside.visited is not None:
            self.beside.see(*walk.met())

    def _count(self, episodes: Iterable[Episode]) -> None:
        for episode in episodes:
            self._recent_returns.append(episode.episode_return)
            self._longest = max(self._longest, episode.length)

    def training_row(self) -> dict[str, Any]:
        """Mean return of recent episodes, number of updates, and what the last one saw."""
        recent = float(np.mean(self._recent_returns)) if self._recent_returns else None
        return {"episode_return": recent, "num_updates": self.learner.num_updates, **self._last_metrics()}

    def _last_metrics(self) -> dict[str, float]:
        """Of the last update, which may have been before the run was resumed, in the environment's units."""
        update = self.last_update
        if update is None:
            return self._metrics_before
        scale = self.value_scale
        return {name: value / (scale * scale if name == "loss" else scale) for name, value in update.metrics().items()}

    @property
    def value_scale(self) -> float:
        """By what the learner's values are divided to be in the environment's units."""
        seen = self.stream.normalisation
        return self.reward_scale * (1.0 if seen is None else seen.reward_scale)

    @property
    def last_update(self) -> Update | None:
        """What the last update saw; of a walk, what the values of the moment say of its last steps."""
        if isinstance(self.stream, TableWalk):
            return self.stream.last_update()
        return None if self._last is None else self._last[0]

    @property
    def num_updates(self) -> int:
        """Updates so far."""
        return self.learner.num_updates

    def values_of(self, observation: Any) -> Array:
        """Action values of observations in the environment's units, with the parameters that the learner plays with."""
        stream = self.stream
        seen = None if stream.normalisation is None else stream.normalisation.frozen()
        space = stream.envs.action_space if isinstance(stream, TableWalk) else stream.envs.single_action_space
        _, first_action = discrete_actions(space)
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
            return self._play(self.evaluation_episodes, seed)

    def _play(self, num_episodes: int, seed: int) -> Evaluation:
        return evaluate_greedy(self.learner.engine.all, self.evaluation_stream, num_episodes, seed, self._cap())

    @contextlib.contextmanager
    def playing_with(self, best: Best | None) -> Iterator[None]:
        """Within the block values are those of other parameters, seen through their statistics; afterwards as before.

        Args:
            best: whose; None for those that the learner plays with.
        """
        flat, seen = self.learner.engine.flat.values, self.stream.normalisation
        if best is None:
            with evaluating_with(self.learner):
                yield
            return
        learned, statistics = flat.clone(), None if seen is None else copy.deepcopy(seen.state_dict())
        flat.copy_(best.parameters)
        if seen is not None and best.normalisation is not None:
            seen.load_state_dict(best.normalisation)
        try:
            yield
        finally:
            flat.copy_(learned)
            if seen is not None and statistics is not None:
                seen.load_state_dict(statistics)

    def play_off(self, best: Best, seed: int) -> dict[str, Any]:
        """The last and the best parameters on the same fresh episodes; the rule is `neuralq.runs.play_off.play_off`.

        There are up to 100 episodes, and together no more than half the steps of training, in rounds as long as an
        evaluation; one round there is in any case.
        """

        def play(which: Best | None, num_episodes: int, at: int) -> Evaluation:
            with self.playing_with(which):
                return self._play(num_episodes, at)

        found = play_off(
            lambda n, at: play(None, n, at), lambda n, at: play(best, n, at), max(2, self.evaluation_episodes),
            self.env_steps // 2, seed,
        )  # fmt: skip
        return {**found, "best_env_steps": best.env_steps}

    def evaluate(self, seed: int) -> tuple[dict[str, Any], Best | None]:
        """Returns of greedy episodes, and the parameters that played them.

        An environment that can exist only once is not evaluated, which a warning says.
        """
        measured = self.measures()
        if not getattr(getattr(self.learner, "settings", None), "acts", True):
            return measured, None
        if not self._can_evaluate():
            return measured, None
        found, seen = self.play_greedily(seed), self.stream.normalisation
        statistics = None if seen is None else seen.state_dict()
        columns: dict[str, Any] = {"greedy_return": found.mean, "returns": list(found.returns)}
        columns |= {"lengths": list(found.lengths), "num_cut": found.num_cut}
        if self.evaluation_max_steps is None:
            columns["max_steps"] = self._cap()
        columns |= measured | self._beside_exact()
        scalings = self.stream.encoder.scalings
        return columns, Best(self.env_steps, found.mean, evaluation_parameters(self.learner), statistics, scalings)

    def measures(self) -> dict[str, float]:
        """What a learner of something else than action values has learned; empty for others."""
        return self.stream.measures() if isinstance(self.stream, TableWalk) else {}

    def _beside_exact(self) -> dict[str, Any]:
        """Columns on what is learned beside the exact answer."""
        if self.beside is None:
            return {}
        if (line := self.beside.look()) is not None:
            self.say(line)
        with evaluating_with(self.learner):
            return self.beside.columns(self.learner.engine.all, self.value_scale)

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
            "feed": {} if self.experience is None else self.experience.state_dict(),
            "stream": self.stream.state_dict(),
            "environments": self._environments(),
            "generators": {name: rng.bit_generator.state for name, rng in self.generators.items()},
            "met": None if self.beside is None else self.beside.state_dict(),
        }

    def _environments(self) -> dict[str, Any] | None:
        """The environments' own state; None where it cannot be taken, or no longer can."""
        if not self.resumability.exact:
            return None
        if isinstance(self.stream, TableWalk | Playback) and self.stream.simulated:
            return {}
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
        if self.beside is not None:
            self.beside.load_state_dict(state.get("met"))
        if self.experience is not None:
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
        if not environments:  # none where a model is simulated
            return environments is not None
        try:
            restore_env(self.stream.envs, environments)
        except NotCopyable as error:
            self._inexact(f"the environment's saved state could not be put back: {error}")
            return False
        return True

    def close(self) -> None:
        """Close the environments."""
        for envs in (self.stream.envs, None if self._evaluation is None else self._evaluation.envs):
            if envs is not None:
                with contextlib.suppress(Exception):
                    envs.close()


def _unheard(line: str) -> None:
    """Where nobody listens."""


def cap_on_evaluation(longest: int, evaluate_every: int, num_episodes: int) -> int:
    """Steps after which an evaluation episode is cut where the environment has no time limit.

    Ten times the longest episode that training has seen, between 100 and 10,000; and all episodes together may take
    ten times the steps between two evaluations: a policy that never arrives would else be watched for hours.

    Example:
        >>> cap_on_evaluation(30, 4096, 20), cap_on_evaluation(4096, 4096, 20), cap_on_evaluation(0, 64, 20)
        (300, 2048, 100)
    """
    return max(100, min(10 * longest, 10 * evaluate_every // num_episodes, 10_000))
