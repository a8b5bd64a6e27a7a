"""A hook that takes the doctor's cheap measurements while a run trains, at its evaluations; it plays no episodes.

What the network itself shows, on states of the sample that was last learned from: silent units and the rank of the last
hidden layer beside fresh networks, the lag of the target network, what one step changes elsewhere. What rows of metrics
show: values against their bound. What the settings say before it is too late: how far values will be able to see.

They are vital signs and no verdicts. The hook reads and never writes: it works on copies, draws from a generator of its
own, and a run ends with the same bits with and without it.
"""

from __future__ import annotations

import contextlib
import copy
import time
import warnings
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.checks import check_positive, check_whole
from neuralq.doctor.exam.case import CannotMeasure
from neuralq.doctor.exam.signs import NUM_FRESH, dormant_share, fresh, hidden, lag_of, moved, rank_of
from neuralq.doctor.origins.neuralq_run import settings_of_run
from neuralq.lab.watch.advice import RunTraits
from neuralq.lab.watch.samples import held_rows, largest_return
from neuralq.learners import Learner
from neuralq.q.noisy import noisy_layers, remove_noise
from neuralq.runs import RunConfig
from neuralq.runs.stream.experience import Sample
from neuralq.types import Transition

__all__ = ["VitalSignWarning", "VitalSigns"]

_SHARE = 0.02
_FIRST_LOOK_SECONDS = 0.02
_BATCH, _MOST_NUMBERS = 32, 1_000_000
_THRESHOLDS = {"dormant_excess": 0.5, "target_lag": 0.5, "churn": 0.1, "value_ratio": 1.1}
_PATIENCE = {"reach": 1}
"""Evaluations in a row beyond the threshold before it is said; 2 of all others, since values that start at 0 move."""
_LINES = {
    "dormant_excess": "R1: {0:.0%} more of the hidden units are silent than in fresh networks (threshold 50 %); a step "
    "size ten times smaller, or LayerNorm, may help",
    "effective_rank": "R2: the last hidden layer spans {0:.0f} directions (threshold 3, and fewer than fresh networks)",
    "target_lag": "R6: values and those of the target network differ by {0:.0%} of their size (threshold 50 %); copy "
    "it more often, or take a smaller step",
    "churn": "R4: one step changes the greedy action in {0:.0%} of other states (threshold 10 %); a smaller step size, "
    "or larger batches, may help",
    "value_ratio": "V4: the largest |Q| is {0:.3g} times r_max / (1 − γ), which no return exceeds (threshold 1.1)",
    "reach": "V5: by its end the run's values will see {0:.0%} of what a steady stream is worth (threshold 90 %): the "
    "target network is copied too seldom; longer targets (--replay.num-steps) or a shorter "
    "--replay.target-period-updates carry rewards further",
}


class VitalSignWarning(UserWarning):
    """A vital sign of a run is beyond its threshold."""


class VitalSigns:
    """Columns of the rows of evaluations, and a line when a sign crosses its threshold; once of each sign.

    The columns are ``dormant_excess`` (R1), ``effective_rank`` (R2), ``target_lag`` (R6), ``churn`` (R4),
    ``value_ratio`` (V4) and ``reach`` (V5, at the end of the budget), as docs/doctor.md has them; what cannot be
    measured is left out. A sign must be beyond its threshold in two evaluations in a row, since values that start at 0
    have to move; reach, which the settings decide, is said at once. Where the divergence monitor watches as well, it is
    the one that says V4.

    Args:
        config: of the run.
        num_states: of the last sample, on which the network is looked at.
        seed: of the generator that picks them and draws fresh networks.
        share: at most this share of the CPU time of training is spent; None for as much as it takes. Which evaluations
            are looked at then depends on the clock, and what is measured in them does not.

    Raises:
        ValueError: an argument out of range.

    Example:
        >>> VitalSigns.of(RunConfig(learner="replay")).columns()
        {}
    """

    def __init__(
        self, config: RunConfig, *, num_states: int = 256, seed: int = 0, share: float | None = _SHARE
    ) -> None:
        check_whole("num_states", num_states, 2)
        check_whole("seed", seed, 0)
        if share is not None:
            check_positive("share", share)
        self._config, self._traits, self._share = config, RunTraits.of(config), share
        self._num_states, self._rng = num_states, np.random.default_rng(seed)
        self._latest: tuple[Learner, Sample] | None = None
        self._columns: dict[str, float] = {}
        self._in_a_row: dict[str, int] = {}
        self._fresh: dict[str, list[float]] = {}
        self._largest_value = self._bound = 0.0
        self._longest = 0
        self._look_seconds = _FIRST_LOOK_SECONDS
        self.said: dict[str, str] = {}
        """What was said, a line of each sign, by its column."""
        self.cpu_seconds = 0.0
        """What it has cost, also before the run was resumed."""

    @classmethod
    def of(cls, config: RunConfig) -> VitalSigns:
        """For the run that a configuration describes, as ``--hook neuralq.doctor:VitalSigns`` makes it."""
        return cls(config)

    def observe(self, learner: Learner, sample: Sample) -> None:
        """Remember what an evaluation will look at, and the largest reward; called before each row."""
        began = time.process_time()
        self._bound = largest_return(sample, self._traits.gamma, self._bound)
        self._latest = learner, sample
        self.cpu_seconds += time.process_time() - began

    def __call__(self, row: Mapping[str, Any]) -> None:
        """Take in a row of metrics; at an evaluation, measure, and say what is beyond its threshold."""
        began, latest = time.process_time(), self._latest
        self._columns, self._latest = {}, None
        if row.get("max_abs_q") is not None:
            self._largest_value = max(self._largest_value, float(row["max_abs_q"]))
        if row.get("kind") != "evaluation":
            return
        self._longest = max([self._longest, *row.get("lengths", ())])
        self._columns = self._known_without_looking()
        trained = float(row.get("cpu_seconds", 0.0))
        if latest is not None and (
            self._share is None or self.cpu_seconds + self._look_seconds <= self._share * trained
        ):
            self._columns |= self._looked(*latest)
            self._look_seconds = time.process_time() - began
        self._say(int(row.get("env_steps", 0)))
        self.cpu_seconds += time.process_time() - began

    def _known_without_looking(self) -> dict[str, float]:
        """V4, of the values that updates met since the evaluation before; and V5."""
        found, gamma = {}, self._traits.gamma
        if self._bound > 0 and self._largest_value > 0:
            found["value_ratio"] = self._largest_value / self._bound
        self._largest_value = 0.0
        ahead = settings_of_run(self._config, float(self._config.total_steps)).steps_of_reach
        if ahead is not None and self._longest and gamma < 1:
            found["reach"] = min((1 - gamma**ahead) / (1 - gamma**self._longest), 1.0)
        return found

    def _looked(self, learner: Learner, sample: Sample) -> dict[str, float]:
        """R1, R2, R4 and R6, on a copy of the network and some states of the sample."""
        rows = held_rows(sample)
        if len(rows.a_tm1) < 2:
            return {}
        most = min(self._num_states, max(_MOST_NUMBERS // max(rows.s_tm1[0].numel(), 1), _BATCH))
        few = torch.from_numpy(self._rng.permutation(len(rows.a_tm1))[:most])
        rows = rows.map(lambda x: x[few.to(x.device)].cpu())
        network, x, late = copy.deepcopy(cast(nn.Module, learner.engine.q)).cpu(), rows.s_tm1, None
        remove_noise(noisy_layers(network))
        if (target := learner.engine.target_values()) is not None:
            late = copy.deepcopy(network)
            nn.utils.vector_to_parameters(target.cpu().clone(), late.parameters())
        found: dict[str, float] = {}
        with torch.no_grad():
            if late is not None:
                found["target_lag"] = lag_of(_values(network, x), _values(late, x))
            with contextlib.suppress(CannotMeasure):
                found |= self._beside_fresh(network, x)
        batch = rows.map(lambda x: x[:_BATCH])
        step = Transition(
            batch.s_tm1, batch.a_tm1, batch.mu_tm1, (self._traits.reward_scale * batch.r_t).to(torch.float32),
            batch.discount_t.to(torch.float32), batch.s_t, batch.last_t,
        )  # fmt: skip
        found["churn"] = moved(network, _values, step, self._traits.step_size, x)[0]
        return {name: value for name, value in found.items() if np.isfinite(value)}

    def _beside_fresh(self, network: nn.Module, x: Tensor) -> dict[str, float]:
        """R1 and R2; fresh networks are made at the first look."""
        layers = hidden(network, _values, x)
        if not self._fresh:
            others = [hidden(fresh(network, self._rng), _values, x) for _ in range(NUM_FRESH)]
            self._fresh = {"dormant": [dormant_share(one) for one in others]}
            self._fresh["rank"] = [float(rank_of(one[-1])) for one in others]
        excess = dormant_share(layers) - max(self._fresh["dormant"])
        return {"dormant_excess": excess, "effective_rank": float(rank_of(layers[-1]))}

    def _say(self, env_steps: int) -> None:
        for name, value in self._columns.items():
            self._in_a_row[name] = self._in_a_row.get(name, 0) + 1 if self._is_beyond(name, value) else 0
            if self._in_a_row[name] >= _PATIENCE.get(name, 2) and name not in self.said:
                self.said[name] = f"after {env_steps:,} steps: {_LINES[name].format(value)}"
                with contextlib.suppress(VitalSignWarning):  # where warnings are errors: a hook changes nothing
                    warnings.warn(self.said[name], VitalSignWarning, stacklevel=2)

    def _is_beyond(self, name: str, value: float) -> bool:
        if name == "effective_rank":
            return value <= 3 and value < min(self._fresh["rank"])
        if name == "value_ratio" and self._config.monitor:
            return False
        return value < 0.9 if name == "reach" else value > _THRESHOLDS[name]

    def columns(self) -> dict[str, Any]:
        """The signs of this evaluation; none for other rows."""
        return dict(self._columns)

    def state_dict(self) -> dict[str, Any]:
        """What it has to remember: what was said and what was beyond, fresh networks, its generator and its cost."""
        return {
            "said": dict(self.said),
            "in_a_row": dict(self._in_a_row),
            "fresh": {name: list(values) for name, values in self._fresh.items()},
            "largest_value": self._largest_value,
            "bound": self._bound,
            "longest": self._longest,
            "cpu_seconds": self.cpu_seconds,
            "generator": self._rng.bit_generator.state,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`; what was said is not said again."""
        self.said, self._in_a_row = dict(state["said"]), dict(state["in_a_row"])
        self._fresh = {name: list(values) for name, values in state["fresh"].items()}
        self._largest_value, self._bound = float(state["largest_value"]), float(state["bound"])
        self._longest, self.cpu_seconds = int(state["longest"]), float(state["cpu_seconds"])
        self._rng.bit_generator.state = state["generator"]


def _values(network: nn.Module, x: Tensor) -> Tensor:
    return cast(Tensor, network.all(x))  # type: ignore[operator]
