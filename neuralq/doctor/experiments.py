"""X1–X3 and X5: controlled experiments: one thing is changed at a time, with the same seeds and an interval.

* X2, *fit*: can the subject's architecture represent the returns of the policy at hand? A fresh copy of it and a body
  of ours (two layers of 256 with LayerNorm, observations normalised) are regressed on them, split by episode. Only the
  gap counts, because noise caps what either can explain.
* X3, *repair*: from the subject's settings, as far as they are known,
the one thing is changed that a measurement named.
  If the greedy return rises by more than chance, it is confirmed.
* X1, *factorial*: {its algorithm, ours (λ-returns)} × {its body, ours}. What changes the algorithm gains over both
  bodies speaks against the algorithm, what changes the body gains over both algorithms against the representation
  (oracles swapped in one at a time: Fu et al. 2019).

* X5, *luck*: of the runs that those made with one and the same settings, do some succeed and others not (`exam.seeds`)?

What is tried first, and so has most of the budget, is what tells the two leading causes apart (`separating`).

Learners are neuralq's own: what is tried is what was done,
not somebody else's code. Steps are so many that all runs fit
into the budget, and the same for every run that is compared.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.wrappers import TransformObservation, TransformReward
from torch import nn

from neuralq.doctor.exam.capacity import labelled, regressed, t_interval
from neuralq.doctor.exam.case import CannotMeasure, Case
from neuralq.doctor.exam.retraining import further_reach, in_words, settings_of
from neuralq.doctor.exam.seeds import luck_of
from neuralq.doctor.exam.signs import fresh
from neuralq.doctor.findings import CAUSES, Cause, Finding
from neuralq.runs import train
from neuralq.runs.recipe.stand_in import Maker
from neuralq.runs.sweep.statistics import interquartile_mean
from neuralq.types import Floats

__all__ = ["Experiments", "fit", "run_experiments", "separating"]

_FEWEST_STEPS, _MOST_STEPS = 2_000, 50_000
_OUR_HIDDEN = (256, 256)
_GAP = 0.10


@dataclass
class Experiments:
    """What experiments found.

    Args:
        findings: of grade A.
        missing: what could not be tried, and why.
        why: in which order they were tried, and why.
        factorial: mean greedy returns ``[2, 2]``: bodies (theirs, ours) by algorithms (theirs, ours).
    """

    findings: list[Finding] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)
    why: str = ""
    factorial: Floats | None = None


_PREDICTED: dict[str, dict[Cause, str]] = {
    "X2": dict.fromkeys(CAUSES, "no gap") | {"representation": "a gap"},
    "X1": {
        "environment": "no run does well",
        "algorithm": "another algorithm does better",
        "representation": "another body does better",
        "data": "another algorithm does better",
        "luck": "some seeds do well",
    },
}
"""What each cause predicts of an experiment. A learner brings its data along: X1 does not tell these apart."""


def separating(named: Sequence[Finding], repairs: Cause | None) -> tuple[list[str], str]:
    """The experiments in the order of their use, and why: first what the two leading causes predict differently.

    The leading causes are the first two of what is named; beside one alone the rival is the representation, or the
    algorithm where that one is the representation. Among what separates them the cheapest comes first: X2 fits, X3 is
    two runs of each seed, X1 four.

    Args:
        named: findings of grade A or B, the first cause first.
        repairs: the cause that X3's repair speaks for; None where there is no repair.

    Example:
        >>> separating([Finding("V1", "", "algorithm", "B", 1.0)], None)[0]
        ['X2', 'X1']
    """
    found: list[Cause] = list(dict.fromkeys(one.cause for one in named)) or ["algorithm"]
    rivals: tuple[Cause, ...] = ("representation", "algorithm")
    first, second = [*found, *(one for one in rivals if one not in found)][:2]
    predicted = {
        "X2": _PREDICTED["X2"],
        "X3": dict.fromkeys(CAUSES, "none") | {repairs: "a gain"} if repairs is not None else {},
        "X1": _PREDICTED["X1"],
    }
    usable = [name for name, table in predicted.items() if table]
    apart = [name for name in usable if predicted[name][first] != predicted[name][second]]
    order = [*apart, *(name for name in usable if name not in apart)]
    if not apart:
        return order, f"{', '.join(order)}: none tells {first} from {second}, the leading causes; the cheapest first"
    told = predicted[apart[0]]
    return order, (
        f"{', '.join(order)}: {apart[0]} first, of which the leading causes predict different things: {first} "
        f"{told[first]}, {second} {told[second]}"
    )


def run_experiments(case: Case, named: Sequence[Finding], seeds: int, say: Callable[[str], None]) -> Experiments:
    """X1 to X3 in the order that tells the leading causes apart, as far as the budget goes; then X5 of their runs."""
    found, plan = Experiments(), _Plan(case, seeds)
    repair = next((r for one in named if (r := _repair(case, one)) is not None), None)
    if repair is None:
        found.missing["X3"] = "no finding names one thing that could be changed in a learner of ours"
    order, found.why = separating(named, None if repair is None else repair.cause)
    experiments: dict[str, tuple[str, Callable[[], Finding | Sequence[Finding]]]] = {
        "X2": ("can the network represent the returns?", lambda: fit(case, seeds)),
        "X1": ("their algorithm and body, and ours", lambda: _factorial(plan, found)),
    }
    if repair is not None:
        experiments["X3"] = (repair.title, lambda: _repaired(plan, repair))
    for name in order:
        title, experiment = experiments[name]
        say(f"experiment {name}: {title}")
        _try(found, name, experiment)
    if not case.subject.siblings:
        _try(found, "X5", lambda: _luck(plan))
    return found


def _luck(plan: _Plan) -> Finding:
    """X5: of the runs with the subject's settings; where none of those succeeds, of ours."""
    own = luck_of(plan.case, plan.same["theirs"], f"the subject's settings, learned by neuralq ({plan.steps:,} steps),")
    if own.value == 0 and len(plan.same["ours"]) > 1:
        return luck_of(plan.case, plan.same["ours"], "our learner and body")
    return own


def _try(found: Experiments, name: str, experiment: Callable[[], Finding | Sequence[Finding]]) -> None:
    try:
        made = experiment()
        found.findings += [made] if isinstance(made, Finding) else made
    except CannotMeasure as reason:
        found.missing[name] = str(reason)
    except (RuntimeError, ValueError) as error:
        found.missing[name] = f"it failed: {type(error).__name__}: {str(error)[:200]}"


# X2


def fit(case: Case, seeds: int = 3) -> Finding:
    """X2: R² on held-out episodes of G regressed by the subject's architecture and by ours; the gap, over seeds."""
    network, encode, outputs = case.subject.network, case.subject.encode, case.subject.outputs
    if network is None or encode is None or outputs is None:
        raise CannotMeasure("the subject is a function, whose architecture is not known; hand over the torch.nn.Module")
    _refuse_pictures(case)
    s, a, g, names = labelled(case, 4000)
    x = case.world.as_rows(s)
    ours = torch.as_tensor((x - x.mean(0)) / np.where(x.std(0) > 1e-12, x.std(0), 1.0)).float()
    theirs = encode(s)
    gaps, scores = [], []
    for seed in range(max(seeds, 3)):
        rng = case.rng(70 + seed)
        held = np.isin(names, rng.permutation(np.unique(names))[: max(len(np.unique(names)) // 3, 1)])
        own = regressed(fresh(network, rng), outputs, theirs, a, g, held, rng)
        body = _our_body(ours.shape[1], case.world.num_actions, rng)
        better = regressed(body, lambda net, rows: net(rows), ours, a, g, held, rng)
        gaps.append(better - own)
        scores.append((own, better))
    low, high = t_interval(gaps)
    own, better = np.mean(scores, axis=0)
    return Finding(
        "X2", "the network cannot represent the returns", "representation", "A", float(np.mean(gaps)), (low, high),
        _GAP,
        "own", bool(low > _GAP),
        f"a fresh network of this architecture predicts held-out returns with R² {own:.2f}, one of ours with "
        f"{better:.2f}",
        "a wider body with LayerNorm, and observations scaled to about ±1",
        f"neuralq train {case.world.name} --body.hidden '[256, 256]' --body.layer-norm true",
    )  # fmt: skip


def _refuse_pictures(case: Case) -> None:
    if case.width > 2000:
        raise CannotMeasure("observations are pictures, for which no network of ours is tried here")


def _our_body(width: int, num_actions: int, rng: np.random.Generator) -> nn.Module:
    layers: list[nn.Module] = []
    for below, above in zip((width, *_OUR_HIDDEN), _OUR_HIDDEN, strict=False):
        layers += [nn.Linear(below, above), nn.LayerNorm(above), nn.ReLU()]
    return fresh(nn.Sequential(*layers, nn.Linear(_OUR_HIDDEN[-1], num_actions)), rng)


# X3 and X1


@dataclass(frozen=True)
class _Repair:
    """One change: of settings, or of the environment."""

    title: str
    cause: Cause
    named: Finding
    settings: Mapping[str, Any] = field(default_factory=dict)
    make: Maker | None = None


def _repair(case: Case, one: Finding) -> _Repair | None:
    """The change that a finding asks for; None where none can be made in a learner of ours."""
    known, make = case.settings, case.world.make
    rate = known.learning_rate or 5e-4
    further = {name: value for name, value in further_reach(case).items() if name != "total_steps"}
    changes: dict[str, tuple[str, dict[str, Any], Maker | None]] = {
        "R1": (f"step size {rate / 10:.2g} in place of {rate:.2g}", {"learning_rate": rate / 10}, None),
        "R6a": ("step size 5e-4", {"learning_rate": 5e-4}, None),
        "V4": ("the target network copied every 500 updates", {"target_period_updates": 500}, None),
        "V5": (in_words(further), further, None),
        "V2": ("double Q-learning", {"target_rule": "double"}, None),
        **dict.fromkeys(("D3", "D3a"), ("a buffer of 50,000 steps", {"capacity": 50_000}, None)),
        **dict.fromkeys(("D4", "D4a"), ("ε from 1 to 0.05", {"epsilon_start": 1.0, "epsilon_end": 0.05}, None)),
        "E4": ("observations normalised", {}, lambda: _normalised(case, make())),
        "E5": ("rewards of at most 1", {}, lambda: TransformReward(make(), lambda r: float(r) / case.largest_reward)),
    }
    if one.id not in changes:
        return None
    title, settings, made = changes[one.id]
    return _Repair(title, one.cause, one, settings, made)


def _normalised(case: Case, env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    x = case.world.as_rows(np.concatenate([one.observations for one in case.chance]))
    mean, spread = x.mean(0), np.where(x.std(0) > 1e-12, x.std(0), 1.0)
    shape = env.observation_space.shape or ()
    space = gym.spaces.Box(-np.inf, np.inf, shape, np.float32)
    return TransformObservation(
        env,
        lambda s: ((np.asarray(s, np.float64).reshape(-1) - mean) / spread).reshape(shape).astype(np.float32),
        space,
    )


class _Plan:
    """Runs of neuralq's learners: how they are set, and how many steps the budget allows each."""

    def __init__(self, case: Case, seeds: int) -> None:
        self.case, self.seeds, self.steps = case, seeds, 0
        self.same: dict[str, list[float]] = {"theirs": [], "ours": []}
        self._rate: float | None = None

    def theirs(self) -> dict[str, Any]:
        """The subject's settings as far as they are known; where not, those of neuralq's replay."""
        known = settings_of(self.case)
        return {name: value for name, value in known.items() if name not in ("hidden", "epsilon_decay_steps")}

    def their_body(self) -> dict[str, Any]:
        """The widths of the subject's dense layers; neuralq's default where they are not known."""
        return {name: value for name, value in settings_of(self.case).items() if name == "hidden"}

    def steps_for(self, runs: int) -> int:
        """Steps of each of so many runs in what is left of the budget.

        Raises:
            CannotMeasure: they would be too few to learn anything.
        """
        if self._rate is None:
            began = time.monotonic()
            self.run({**self.theirs(), **self.their_body()}, 0, 1000, None)
            self._rate = 1000 / (time.monotonic() - began)
        steps = int(0.7 * self.case.clock.left / runs * self._rate)
        if steps < _FEWEST_STEPS:
            raise CannotMeasure(
                f"the budget allows {steps:,} steps for each of {runs} runs, and {_FEWEST_STEPS:,} are the least; give "
                "more with --budget"
            )
        self.steps = min(steps, int(self.case.settings.env_steps or _MOST_STEPS), _MOST_STEPS)
        return self.steps

    def run(self, settings: Mapping[str, Any], seed: int, steps: int, make: Maker | None) -> float:
        """The greedy return that one run ends with."""
        known = self.case.settings
        decay = (known.epsilon_decay_steps or 0.0) / known.env_steps if known.env_steps else 0.0
        explores = max(int(min(decay or 0.2, 1.0) * steps), 1)
        with tempfile.TemporaryDirectory() as folder:
            made = train(
                make or self.case.world.make, Path(folder) / "run", preset=False, seed=seed, total_steps=steps,
                gamma=self.case.gamma, evaluate_every=steps, evaluation_episodes=10, evaluation_max_steps=1000,
                checkpoint_every=10 * steps, resume_probe=False, epsilon_decay_steps=explores, **settings,
            )  # fmt: skip
        return float(made.greedy_return if made.greedy_return is not None else np.nan)


def _repaired(plan: _Plan, repair: _Repair) -> Finding:
    steps = plan.steps_for(2 * plan.seeds)
    before = {**plan.theirs(), **plan.their_body()}
    baseline = [plan.run(before, seed, steps, None) for seed in range(plan.seeds)]
    plan.same["theirs"] += baseline
    after = [plan.run({**before, **repair.settings}, seed, steps, repair.make) for seed in range(plan.seeds)]
    if repair.make is not None and repair.named.id == "E5":
        after = [one * plan.case.largest_reward for one in after]
    gain, (low, high) = float(np.mean(after) - np.mean(baseline)), _difference(after, baseline)
    return Finding(
        "X3", f"confirmed: {repair.named.title}" if low > 0 else "the repair changed nothing for sure", repair.cause,
        "A",
        gain, (low, high), 0.0, "the interval of the gain lies above 0", low > 0,
        f"with {repair.title} {plan.seeds} runs of {steps:,} steps return {np.mean(after):.4g}, without it "
        f"{np.mean(baseline):.4g}", repair.named.remedy, repair.named.confirm,
    )  # fmt: skip


def _difference(more: Sequence[float], less: Sequence[float]) -> tuple[float, float]:
    """95 % interval of the difference of two interquartile means, the seeds of each drawn by themselves.

    Of three against three it lies above 0 where hardly any run without the change did as well as one with it, which by
    chance happens about once in twenty times.
    """
    rng = np.random.default_rng(0)
    drawn = [
        interquartile_mean(np.asarray(v, np.float64)[rng.integers(len(v), size=(10_000, len(v)))]) for v in (more, less)
    ]
    low, high = np.percentile(drawn[0] - drawn[1], [2.5, 97.5])
    return float(low), float(high)


def _factorial(plan: _Plan, found: Experiments) -> list[Finding]:
    case = plan.case
    _refuse_pictures(case)
    steps = plan.steps_for(4 * plan.seeds)
    ours = {"learner": "rollout", "normalise_observations": False}
    wide = {"hidden": _OUR_HIDDEN, "layer_norm": True}
    normalised: Maker | None = None if case.world.is_discrete else lambda: _normalised(case, case.world.make())
    cells: dict[tuple[int, int], list[float]] = {}
    for i, (body, make) in enumerate(((plan.their_body(), None), (wide, normalised))):
        for j, algorithm in enumerate((plan.theirs(), ours)):
            cells[i, j] = [plan.run({**algorithm, **body}, 100 + seed, steps, make) for seed in range(plan.seeds)]
    plan.same["theirs"] += cells[0, 0]
    plan.same["ours"] += cells[1, 1]
    found.factorial = np.array([[np.mean(cells[i, j]) for j in (0, 1)] for i in (0, 1)])
    made = []
    causes: tuple[tuple[Cause, list[float], list[float]], ...] = (
        ("algorithm", [*cells[0, 1], *cells[1, 1]], [*cells[0, 0], *cells[1, 0]]),
        ("representation", [*cells[1, 0], *cells[1, 1]], [*cells[0, 0], *cells[0, 1]]),
    )
    for cause, more, less in causes:
        low, high = _difference(more, less)
        what = "the learner of λ-returns" if cause == "algorithm" else "a body of two normalised layers of 256"
        made.append(
            Finding(
                "X1", f"another {cause} does better", cause, "A", float(np.mean(more) - np.mean(less)), (low, high),
                0.0,
                "the interval of the main effect lies above 0", low > 0,
                f"{what} returns {np.mean(more):.4g} over both others, what the subject has {np.mean(less):.4g} "
                f"({steps:,} steps, {plan.seeds} seeds)",
                f"take {what}", f"neuralq train {case.world.name} --body.hidden '[256, 256]' --body.layer-norm true",
            )
        )  # fmt: skip
    return made
