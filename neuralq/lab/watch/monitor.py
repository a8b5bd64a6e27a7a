"""A hook that watches a run for divergence: what is measured, what the tangent kernel says, and what to change.

Three signs, from the surest to the earliest:

* *Soft divergence* (van Hasselt et al. 2018): no return can exceed r_max / (1 − γ), so a |Q| above it is wrong.
* *Explosive growth* of |δ| or |Q|: an exponential that does not slow down, over the last rows of metrics.
* *The kernel*: on transitions of late, would plain one-step updates make errors grow (`neuralq.lab.networks.sampled`)?
  Local
  and only a warning: what stabilises the run may be what the kernel leaves out. It must say so several times in a row.

All is said in the environment's units. What rewards and values say repeats from run to run; kernels come when the clock
affords them, and need not.

The monitor reads and never writes: it draws from a generator of its own, works on copies, and a run ends with the same
bits with and without it. It watches every training unasked (`DivergenceMonitor.sparing`), and then spends at most a
fiftieth of the run's CPU time: what it would cost more is left out until the run has gone on long enough.
"""

from __future__ import annotations

import contextlib
import math
import time
import warnings
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from torch import nn

from neuralq.checks import check_positive, check_whole
from neuralq.lab.watch.advice import RunTraits, advise
from neuralq.lab.watch.growth import GrowthFit, fit_growth
from neuralq.lab.watch.samples import held_rows, largest_return
from neuralq.learners import Learner
from neuralq.runs import RunConfig
from neuralq.runs.stream.experience import Sample
from neuralq.types import QFunction, Transition

if TYPE_CHECKING:  # SciPy and torch.func are loaded when the first kernel is computed
    from neuralq.lab.networks.sampled import SampleDiagnosis

__all__ = ["Alarm", "DivergenceMonitor", "DivergenceWarning"]

_PERSISTENT = 3  # unstable kernels in a row before the alarm: one may be chance
_MOST_NUMBERS = 4e7  # entries of the Jacobians of a sample; a larger network gets a smaller sample
_SHARE = 0.02  # of the CPU time of training
_FIRST_KERNEL_SECONDS = 0.3  # what the first kernel is taken to cost, SciPy's import with it
_FIRST_LOOK_SECONDS = 0.01
_MEASURES = {"abs_td_error": "The mean TD error", "largest_value": "The largest |Q|"}


class DivergenceWarning(UserWarning):
    """A run looks as if it diverges."""


@dataclass(frozen=True)
class Alarm:
    """One sign of divergence, the first of its kind in a run.

    Args:
        kind: "soft divergence", "growth of abs_td_error", "growth of largest_value", "kernel" or "not finite".
        env_steps: when it was raised.
        message: what was seen.
        advice: what to change, most promising first.
    """

    kind: str
    env_steps: int
    message: str
    advice: tuple[str, ...]

    def __str__(self) -> str:
        """What was seen and what to change."""
        return f"{self.message} What may help: {'; '.join(self.advice)}."


class DivergenceMonitor:
    """Warns at most once of each sign of divergence, and leaves a report.

    Args:
        traits: what the run is like, as far as it matters; `RunTraits` or `DivergenceMonitor.of(config)`.
        largest_reward: the largest |r| the environment gives, in its own units; None takes the largest seen so far.
        margin: |Q| must exceed the bound by this factor; 1 is the published criterion, and noisy where returns come
            close to the bound.
        num_samples: transitions B on which the kernel is computed; fewer for large networks.
        every: rows of metrics between two kernels; each costs about 2 B gradients. 0 for none.
        window: rows over which growth is fitted.
        seed: of the generator that picks the transitions.
        share: at most this share of the CPU time of training is spent, as far as rows of metrics tell it; None for as
            much as it takes.

    Raises:
        ValueError: an argument out of range.

    Example:
        >>> monitor = DivergenceMonitor(RunTraits(gamma=0.9, step_size=0.1), largest_reward=1.0)
        >>> with warnings.catch_warnings(record=True) as caught:
        ...     warnings.simplefilter("always")
        ...     monitor({"kind": "train", "env_steps": 64, "max_abs_q": 50.0})
        >>> monitor.alarms[0].kind, len(caught)
        ('soft divergence', 1)
    """

    def __init__(
        self,
        traits: RunTraits,
        *,
        largest_reward: float | None = None,
        margin: float = 1.1,
        num_samples: int = 32,
        every: int = 10,
        window: int = 20,
        seed: int = 0,
        share: float | None = None,
    ) -> None:
        for name, value in (("largest_reward", largest_reward), ("share", share)):
            if value is not None:
                check_positive(name, value)
        if not margin >= 1:
            raise ValueError(f"margin must be at least 1, got {margin!r}")
        check_whole("num_samples", num_samples, 2)
        check_whole("every", every, 0)
        check_whole("window", window, 8)
        check_whole("seed", seed, 0)
        self.traits = traits
        self.alarms: list[Alarm] = []
        self.diagnoses: list[tuple[int, SampleDiagnosis]] = []
        self._given, self._margin, self._share = largest_reward, margin, share
        self._num_samples, self._every = num_samples, every
        self._rng = np.random.default_rng(seed)
        self._rows: deque[tuple[float, dict[str, float]]] = deque(maxlen=window)
        self._recent: Transition | None = None
        self._latest: SampleDiagnosis | None = None
        self._resumed = False
        self._looks = self._next_kernel = self._kernels = self._env_steps = 0
        self._seen_bound = self._largest_value = self._run_seconds = 0.0
        self._since_seconds: float | None = None
        self._look_seconds, self._kernel_seconds = _FIRST_LOOK_SECONDS, _FIRST_KERNEL_SECONDS
        self.cpu_seconds = 0.0
        """What it has cost so far."""
        self.unavailable: str | None = None
        """Why there is no kernel, where there is none."""

    @classmethod
    def of(cls, config: RunConfig, *, largest_reward: float | None = None) -> DivergenceMonitor:
        """A monitor for the run that a configuration describes.

        Example:
            >>> DivergenceMonitor.of(RunConfig()).traits.lambda_
            0.65
        """
        return cls(RunTraits.of(config), largest_reward=largest_reward)

    @classmethod
    def sparing(cls, config: RunConfig) -> DivergenceMonitor:
        """The monitor that every training has: it spends at most a fiftieth of the CPU time of training.

        Example:
            >>> DivergenceMonitor.sparing(RunConfig()).columns()
            {'alarm': None}
        """
        return cls(RunTraits.of(config), share=_SHARE)

    @property
    def bound(self) -> float | None:
        """r_max / (1 − γ), in the environment's units; None without a reward or without discounting."""
        if self.traits.gamma == 1:
            return None
        if self._given is not None:
            return self._given / (1 - self.traits.gamma)
        return self._seen_bound or None

    def observe(self, learner: Learner, sample: Sample) -> None:
        """Read the learner's Q-function on what it last learned from; called by `neuralq.train` before each row."""
        began, kernels = time.process_time(), self._kernels
        self._note_rewards(sample)
        self.cpu_seconds += time.process_time() - began
        if not self._affords(self._look_seconds):
            return
        began = time.process_time()
        self._observe(learner, sample)
        spent = time.process_time() - began
        self.cpu_seconds += spent
        if self._kernels == kernels:
            self._look_seconds = spent
        else:
            self._kernel_seconds = spent

    def _affords(self, seconds: float) -> bool:
        """Whether so much more is within its share."""
        return self._share is None or self.cpu_seconds + seconds <= self._share * self._run_seconds

    def _observe(self, learner: Learner, sample: Sample) -> None:
        rows = held_rows(sample)
        if not len(rows.a_tm1):
            return
        few = self._rng.permutation(len(rows.a_tm1))[: self._num_samples]
        rows = rows.map(lambda x: x[torch.from_numpy(few).to(x.device)].cpu())
        if self._recent is not None:
            rows = Transition(
                *(
                    torch.cat([getattr(self._recent, f.name), getattr(rows, f.name)])[-self._num_samples :]
                    for f in fields(Transition)
                )
            )
        self._recent = rows
        q = learner.engine.q
        due = self._every and self._looks >= self._next_kernel and len(rows.a_tm1) >= min(self._num_samples, 8)
        if due and self._affords(self._kernel_seconds):
            self._latest = self._try_inspect(q, rows)
            self._kernels += 1
            self._next_kernel = self._looks + self._every
        self._looks += 1

    def inspect(self, q: QFunction, transitions: Transition, env_steps: int | None = None) -> SampleDiagnosis:
        """The kernel's verdict on transitions of your own, which joins the report.

        Args:
            q: any `QFunction` module; it is only read.
            transitions: at least 2.
            env_steps: when; default: that of the last row.

        Raises:
            ValueError: fewer than 2 transitions.
        """
        from neuralq.lab.networks.sampled import diagnose_sample

        found = diagnose_sample(
            cast(nn.Module, q), transitions, self.traits.step_size, reward_scale=self.traits.reward_scale
        )
        self._take(found, self._env_steps if env_steps is None else env_steps)
        return found

    def __call__(self, row: Mapping[str, Any]) -> None:
        """Take in a row of metrics and raise what alarms are due."""
        began = time.process_time()
        self._take_row(row)
        self.cpu_seconds += time.process_time() - began
        if "cpu_seconds" in row:
            if self._since_seconds is None:  # a resumed run has trained before
                self._since_seconds = float(row["cpu_seconds"]) if self._resumed else 0.0
            self._run_seconds = float(row["cpu_seconds"]) - self._since_seconds

    def _take_row(self, row: Mapping[str, Any]) -> None:
        self._env_steps = int(row.get("env_steps", self._env_steps))
        latest, self._latest = self._latest, None
        if latest is not None:
            self._take(latest, self._env_steps)
        if row.get("kind") == "train":
            self._measure(row)

    def _measure(self, row: Mapping[str, Any]) -> None:
        columns = {"abs_td_error": "abs_td_error", "largest_value": "max_abs_q"}
        known = {name: abs(float(row[column])) for name, column in columns.items() if row.get(column) is not None}
        for name, x in known.items():
            if not math.isfinite(x):
                self._raise("not finite", f"{_MEASURES[name]} is no longer a finite number.")
        finite = {name: x for name, x in known.items() if math.isfinite(x)}
        if not finite:
            return
        self._rows.append((float(row.get("num_updates", row["env_steps"])), finite))
        self._largest_value = max(self._largest_value, finite.get("largest_value", 0.0))
        self._check_bound(finite.get("largest_value"))
        for name in _MEASURES:
            self._check_growth(name)

    def _check_bound(self, value: float | None) -> None:
        bound = self.bound
        if value is not None and bound is not None and value > self._margin * bound:
            whose = "given" if self._given is not None else "seen so far"
            self._raise(
                "soft divergence",
                f"The largest |Q| is {value:.4g}, but with the largest reward {whose} and γ={self.traits.gamma:g} no "
                f"return exceeds r_max/(1 − γ) = {bound:.4g}.",
            )

    def _check_growth(self, name: str) -> None:
        bound = self.bound
        if len(self._rows) < (self._rows.maxlen or 0):
            return
        if bound is not None and self._rows[-1][1].get(name, 0.0) < 0.1 * bound:
            return  # values that start at 0 have to grow
        if not self._may_explode(name):
            return
        found = self.growth(name)
        if found is None or not found.explosive:
            return
        doubling = found.doubling or math.inf
        self._raise(
            f"growth of {name}",
            f"{_MEASURES[name]} rose {found.rise:.3g}-fold over the last {len(self._rows)} rows without "
            f"slowing down: it doubles every {doubling:.3g} updates.",
        )

    def _may_explode(self, name: str) -> bool:
        """Whether a fit is worth its cost: a tenfold rise of the fitted curve takes a spread of the values.

        Var log y ≥ Var of the fit, whose two ends, ln 10 apart, alone make it (ln 10)²/(2n); and a range is at least
        twice a standard deviation.
        """
        kept = [row[name] for _, row in self._rows if row.get(name, 0.0) > 0]
        return len(kept) > 1 and max(kept) >= min(kept) * math.exp(2 * math.log(10) / math.sqrt(2 * len(kept)))

    def growth(self, measure: str = "abs_td_error") -> GrowthFit | None:
        """The geometric curve through the last rows of "abs_td_error" or "largest_value", per update."""
        kept = [(at, row[measure]) for at, row in self._rows if measure in row]
        return fit_growth([at for at, _ in kept], [y for _, y in kept])

    def _take(self, found: SampleDiagnosis, env_steps: int) -> None:
        self.diagnoses.append((env_steps, found))
        last = [diagnosis for _, diagnosis in self.diagnoses[-_PERSISTENT:]]
        if len(last) == _PERSISTENT and all(one.unstable for one in last):
            self._raise("kernel", found.explain())
        if self.traits.plain_steps and len(last) == _PERSISTENT and all(one.too_large_step for one in last):
            self._raise("kernel", found.explain())

    def _raise(self, kind: str, message: str) -> None:
        if any(alarm.kind == kind for alarm in self.alarms):
            return
        latest = self.diagnoses[-1][1] if self.diagnoses else None
        alarm = Alarm(kind, self._env_steps, message, advise(self.traits, latest))
        self.alarms.append(alarm)
        # Where warnings are errors the alarm is still in the report, and the run goes on: a monitor changes nothing.
        with contextlib.suppress(DivergenceWarning):
            warnings.warn(f"after {self._env_steps:,} steps: {alarm}", DivergenceWarning, stacklevel=3)

    def _try_inspect(self, q: QFunction, rows: Transition) -> SampleDiagnosis | None:
        from neuralq.lab.networks.sampled import diagnose_sample

        module = cast(nn.Module, q)
        size = sum(p.numel() for p in module.parameters())
        few = max(2, min(len(rows.a_tm1), int(_MOST_NUMBERS / (2 * size))))
        try:
            return diagnose_sample(
                module, rows.map(lambda x: x[-few:]), self.traits.step_size, reward_scale=self.traits.reward_scale
            )
        except (RuntimeError, NotImplementedError, TypeError, ValueError) as error:  # a module vmap cannot run, or NaN
            self.unavailable = str(error).strip().split("\n")[0]
            return None

    def _note_rewards(self, sample: Sample) -> None:
        self._seen_bound = largest_return(sample, self.traits.gamma, self._seen_bound)

    def columns(self) -> dict[str, Any]:
        """What rows of metrics are to say: the alarms so far, by kind, or None."""
        return {"alarm": ", ".join(alarm.kind for alarm in self.alarms) or None}

    def state_dict(self) -> dict[str, Any]:
        """What it has to remember: alarms, the rows that growth is fitted on, bounds, and what to say of it all."""
        return {
            "alarms": [asdict(alarm) for alarm in self.alarms],
            "rows": [[at, dict(row)] for at, row in self._rows],
            "largest_value": self._largest_value,
            "seen_bound": self._seen_bound,
            "kernels": [{"env_steps": at, **asdict(one)} for at, one in self.diagnoses[-_PERSISTENT:]],
            "verdict": self.verdict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`; what was said already is not said again."""
        self._resumed = True
        self.alarms = [Alarm(**{**one, "advice": tuple(one["advice"])}) for one in state["alarms"]]
        self._rows.extend((float(at), dict(row)) for at, row in state["rows"])
        self._largest_value, self._seen_bound = float(state["largest_value"]), float(state["seen_bound"])
        if state["kernels"]:
            from neuralq.lab.networks.sampled import SampleDiagnosis

            kept = [dict(one) for one in state["kernels"]]
            self.diagnoses = [(one.pop("env_steps"), SampleDiagnosis(**one)) for one in kept]

    def verdict(self) -> dict[str, Any]:
        """In short, as plain values: "alarms" by kind, what was "seen", the "advice", and the CPU seconds it "cost"."""
        return {
            "alarms": [alarm.kind for alarm in self.alarms],
            "seen": self.explain(),
            "advice": list(self.alarms[-1].advice) if self.alarms else [],
            "largest_value": self._largest_value,
            "bound": self.bound,
            "cpu_seconds": self.cpu_seconds,
        }

    def report(self) -> dict[str, Any]:
        """What was seen, as plain values for JSON."""
        fits = {name: self.growth(name) for name in _MEASURES}
        return {
            "env_steps": self._env_steps,
            "alarms": [asdict(alarm) for alarm in self.alarms],
            "largest_value": self._largest_value,
            "bound": self.bound,
            "growth": {name: None if fit is None else asdict(fit) for name, fit in fits.items()},
            "kernels": [{"env_steps": at, **one.plain()} for at, one in self.diagnoses],
            "kernel_unavailable": self.unavailable,
        }

    def explain(self) -> str:
        """What was seen and what to change, in a paragraph or two."""
        parts = [f"{self._env_steps:,} steps watched: " + ("no alarm." if not self.alarms else "")]
        parts += [f"[{alarm.kind}, at {alarm.env_steps:,} steps] {alarm.message}" for alarm in self.alarms]
        if not self.alarms and self._largest_value:
            bound = self.bound
            most = "" if bound is None else f"; by the rewards of the same steps no return exceeds {bound:.4g}"
            parts.append(
                f"The largest |Q(s, a)| of the updates looked at, one before each row of metrics, was "
                f"{self._largest_value:.4g}{most}."
            )
        if self.diagnoses and not any(alarm.kind == "kernel" for alarm in self.alarms):
            parts.append(self.diagnoses[-1][1].explain())
            parts += [] if self._share is None else ["When that is computed depends on the clock."]
        if self.unavailable is not None:
            parts.append(f"The kernel could not be computed: {self.unavailable}.")
        if self.alarms:
            parts.append(f"What may help: {'; '.join(self.alarms[-1].advice)}.")
        return " ".join(part.strip() for part in parts)
