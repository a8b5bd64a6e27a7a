"""Q-learning from stored experience: one-step, n-step and double targets, or λ-returns over contiguous blocks.

One-step and n-step samples come ready from the replay buffer (its discount is that of the whole stretch), so the same
rule serves both. Blocks ``[T, B]`` get λ-returns from the target copy, as in DQN(λ) (Daley & Amato, 2019).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuralq import rules
from neuralq.checks import check_choice, check_fraction, check_positive, check_whole
from neuralq.learners.bootstrap import q_learning_targets
from neuralq.learners.update import Descent, Update
from neuralq.optim import Optimiser
from neuralq.q.engine import Engine
from neuralq.types import Transition

__all__ = ["ReplayLearner", "ReplaySettings"]


@dataclass(frozen=True)
class ReplaySettings:
    """How a `ReplayLearner` learns and what it stores. Defaults: DQN (Mnih et al., 2015) scaled to small problems.

    Args:
        target_rule: "q_learning" or "double" (van Hasselt et al., 2016); with ``block_length`` > 1 "peng" or "watkins".
        num_steps: n of n-step targets.
        block_length: rows of a contiguous block for λ-returns; 1 for independent samples.
        lambda_: λ of the λ-returns.
        num_envs: parallel environments.
        capacity: transitions stored.
        batch_size: transitions per update (with blocks: batch_size // block_length blocks).
        learning_starts: transitions stored before the first update.
        train_period: environment steps between updates.
        updates_per_period: updates at each of those times.
        target_period_updates: updates between copies into the target network.
        learning_rate: of the optimiser.
        optimiser: "adam", "radam" or "sgd".
        loss: "huber" or "squared".
        max_grad_norm: bound on the gradient's norm; None for none.
        prioritised: whether samples are drawn by |δ| (Schaul et al., 2016), with importance weights in the loss.
    """

    target_rule: str = "q_learning"
    num_steps: int = 1
    block_length: int = 1
    lambda_: float = 0.8
    num_envs: int = 1
    capacity: int = 50_000
    batch_size: int = 64
    learning_starts: int = 1_000
    train_period: int = 1
    updates_per_period: int = 1
    target_period_updates: int = 500
    learning_rate: float = 5e-4
    optimiser: str = "adam"
    loss: str = "huber"
    max_grad_norm: float | None = 10.0
    prioritised: bool = False

    def __post_init__(self) -> None:
        """Refuse values outside their range and settings that contradict each other."""
        counts = ("num_steps", "block_length", "num_envs", "capacity", "batch_size", "train_period")
        for name in (*counts, "learning_starts", "updates_per_period", "target_period_updates"):
            check_whole(name, getattr(self, name))
        check_fraction("lambda_", self.lambda_, "for Monte Carlo use lambda_=1")
        check_positive("learning_rate", self.learning_rate)
        check_choice("loss", self.loss, ("huber", "squared"))
        check_choice("target_rule", self.target_rule, ("q_learning", "double", "peng", "watkins"))
        Optimiser(self.optimiser)
        blocks = self.target_rule in ("peng", "watkins")
        if blocks != (self.block_length > 1):
            raise ValueError(
                f"target_rule={self.target_rule!r} does not go with block_length={self.block_length}: λ-returns "
                '("peng", "watkins") need blocks of at least 2 rows, the other rules take single samples'
            )
        if blocks and (self.num_steps > 1 or self.prioritised):
            raise ValueError(
                "λ-returns over blocks replace n-step targets and priorities; leave num_steps=1, prioritised=False"
            )
        if blocks and self.batch_size < self.block_length:
            raise ValueError(f"batch_size={self.batch_size} holds no block of block_length={self.block_length}")
        for name in ("learning_starts", "capacity"):
            if blocks and getattr(self, name) < self.block_length * self.num_envs:
                raise ValueError(
                    f"{name}={getattr(self, name)} steps over {self.num_envs} environment(s) hold no block of "
                    f"block_length={self.block_length}; take at least {self.block_length * self.num_envs}"
                )


class ReplayLearner:
    """Q-learning on samples ``[B]`` or blocks ``[T, B]`` with a target network.

    Args:
        engine: values and gradients of the representation, with the loss in it.
        settings: how to learn.
        reward_scale: rewards are multiplied by it, so values are too.

    Example:
        >>> import torch
        >>> from neuralq.q import TableQ
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> settings = ReplaySettings(optimiser="sgd", learning_rate=1.0, loss="squared")
        >>> learner = ReplayLearner(TorchEngine(TableQ(2, 1), Loss()), settings)
        >>> one = torch.ones(1)
        >>> step = Transition(torch.tensor([0]), torch.tensor([0]), one, 5 * one, 0 * one, torch.tensor([1]), one > 0)
        >>> learner.update(step).errors.tolist(), learner.engine.all(torch.tensor(0)).item()
        ([5.0], 5.0)
    """

    def __init__(self, engine: Engine, settings: ReplaySettings, reward_scale: float = 1.0) -> None:
        self.engine = engine
        self.settings = settings
        self.reward_scale = reward_scale
        self.num_updates = 0
        self._descent = Descent(engine, Optimiser(settings.optimiser), settings.learning_rate, settings.max_grad_norm)
        engine.sync_target()
        one = torch.ones(1, dtype=engine.flat.values.dtype)
        q_learning_targets(one, one, one[:, None])  # compiled here, so that a run's clock measures training

    def targets(self, transition: Transition) -> Tensor:
        """Targets of the chosen rule, with the shape of ``r_t``."""
        q_t = self.engine.all(transition.s_t, target=True)
        rule = self.settings.target_rule
        if rule == "q_learning":
            return q_learning_targets(transition.r_t, transition.discount_t, q_t, self.reward_scale)
        r_t = transition.r_t.to(q_t.dtype) * self.reward_scale
        discount_t = transition.discount_t.to(q_t.dtype)
        if rule == "double":
            return rules.double_q(r_t, discount_t, q_t, self.engine.all(transition.s_t))
        lambda_: Tensor | float = self.settings.lambda_
        if rule == "watkins":
            greedy = rules.is_greedy(self.engine.all(transition.s_tm1, target=True), transition.a_tm1)
            lambda_ = rules.watkins_lambda(self.settings.lambda_, greedy, q_t.dtype)
        return rules.lambda_returns(r_t, discount_t, q_t.amax(-1), lambda_, transition.last_t)

    def update(self, transition: Transition, weight: Tensor | None = None) -> Update:
        """One descent step on a batch; ``weight``, shaped like ``r_t``, multiplies each sample's loss."""
        targets = self.targets(transition)
        s, a = transition.s_tm1, transition.a_tm1
        if targets.dim() == 2:
            s, a, targets = s.flatten(0, 1), a.reshape(-1), targets.reshape(-1)
            weight = None if weight is None else weight.reshape(-1)
        errors = self._descent.step(s, a, targets, weight)
        self.num_updates += 1
        if self.num_updates % self.settings.target_period_updates == 0:
            self.engine.sync_target()
        return Update(errors, targets)

    def begin_streams(self) -> None:
        """Nothing connects one sample to the next."""

    def state_dict(self) -> dict[str, Any]:
        """Parameters, optimiser, target copy and counters."""
        return {"num_updates": self.num_updates, "descent": self._descent.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit."""
        self.num_updates = int(state["num_updates"])
        self._descent.load_state_dict(state["descent"])
