"""What a replay learner may be told, and which of it goes together.

The target rule decides most of the rest: one-step rules take single samples, λ-returns take blocks; some rules have
numbers of their own. A number that the rule has no use for is refused, and one that is left out is filled in, so that
the stored settings say what was done.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from neuralq.checks import check_choice, check_fraction, check_positive, check_whole
from neuralq.learners.optim import Optimiser

__all__ = ["BLOCK_RULES", "CORRECTED_RULES", "DISTRIBUTIONS", "TARGET_RULES", "ReplaySettings"]

CORRECTED_RULES = ("retrace", "tree_backup", "harutyunyan")
BLOCK_RULES = ("peng", "watkins", *CORRECTED_RULES)
TARGET_RULES = ("q_learning", "double", "munchausen", *BLOCK_RULES, "dqrc")
DISTRIBUTIONS = ("none", "quantile", "categorical")


@dataclass(frozen=True)
class ReplaySettings:
    """How a `ReplayLearner` and its relatives learn and what is stored. Defaults: DQN (Mnih et al., 2015), scaled down.

    Args:
        target_rule: "q_learning", "double" (van Hasselt et al., 2016), "munchausen" (Vieillard et al., 2020) or "dqrc"
            (Patterson et al., 2022); with block_length > 1 "peng", "watkins", "retrace", "tree_backup" or
            "harutyunyan".
        num_steps: n of n-step targets.
        block_length: rows of a contiguous block for λ-returns; 1 for independent samples.
        lambda_: λ of the λ-returns.
        num_envs: parallel environments.
        capacity: transitions stored.
        batch_size: transitions per update (with blocks: batch_size // block_length blocks).
        learning_starts: transitions stored before the first update.
        train_period: environment steps between updates.
        updates_per_period: updates at each of those times.
        target_period_updates: updates between copies into the target network; None for 500 (dqrc has none).
        learning_rate: of the optimiser.
        optimiser: "adam", "radam" or "sgd".
        loss: "huber" or "squared"; None for the rule's own (Huber's; of dqrc squared, of categories cross-entropy).
        max_grad_norm: bound on the gradient's norm; None for none.
        prioritised: whether samples are drawn by |δ| (Schaul et al., 2016), with importance weights in the loss.
        distribution: "none", "quantile" (QR-DQN, Dabney et al., 2018) or "categorical" (C51, Bellemare et al., 2017).
        num_atoms: numbers that describe a distribution; None for 32 quantiles, 51 categories.
        value_min: smallest return of a categorical distribution, in the environment's units.
        value_max: largest return of a categorical distribution, in the environment's units.
        temperature: τ of munchausen's policy softmax(q/τ), in units of scaled rewards; None for 0.03.
        munchausen_alpha: α, how much of τ log π is added to the reward; None for 0.9.
        munchausen_floor: the smallest τ log π that counts, in units of scaled rewards; None for -1.
        target_epsilon: ε of the ε-greedy target policy of retrace, tree_backup and harutyunyan; None for 0.05.
        dqrc_beta: how strongly the second function of dqrc is pulled to 0; None for 1.
        dqrc_learning_rate: of the second function of dqrc; None for the learning rate.
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
    target_period_updates: int | None = None
    learning_rate: float = 5e-4
    optimiser: str = "adam"
    loss: str | None = None
    max_grad_norm: float | None = 10.0
    prioritised: bool = False
    distribution: str = "none"
    num_atoms: int | None = None
    value_min: float | None = None
    value_max: float | None = None
    temperature: float | None = None
    munchausen_alpha: float | None = None
    munchausen_floor: float | None = None
    target_epsilon: float | None = None
    dqrc_beta: float | None = None
    dqrc_learning_rate: float | None = None

    def __post_init__(self) -> None:
        """Refuse values outside their range and settings that contradict each other; fill in what is left out."""
        counts = ("num_steps", "block_length", "num_envs", "capacity", "batch_size", "train_period")
        for name in (*counts, "learning_starts", "updates_per_period"):
            check_whole(name, getattr(self, name))
        check_fraction("lambda_", self.lambda_, "for Monte Carlo use lambda_=1")
        check_positive("learning_rate", self.learning_rate)
        check_choice("target_rule", self.target_rule, TARGET_RULES)
        check_choice("distribution", self.distribution, DISTRIBUTIONS)
        Optimiser(self.optimiser)
        _check_blocks(self)
        _check_combination(self)
        self._fill_in()
        self._check_own_numbers()

    @property
    def munchausen_numbers(self) -> tuple[float, float, float]:
        """Temperature τ, weight α and floor of the bonus.

        Raises:
            ValueError: if the target rule is another.
        """
        numbers = (self.temperature, self.munchausen_alpha, self.munchausen_floor)
        if numbers[0] is None or numbers[1] is None or numbers[2] is None:
            raise ValueError(f"target_rule={self.target_rule!r} has no Munchausen bonus")
        return numbers[0], numbers[1], numbers[2]

    def _fill_in(self) -> None:
        """Numbers that the rule needs and nobody gave; those that it has no use for must not be given."""
        rule, distribution = self.target_rule, self.distribution
        dqrc, categorical = rule == "dqrc", distribution == "categorical"
        losses = ("squared",) if dqrc else ("cross_entropy",) if categorical else ("huber", "squared")
        _settle(self, "loss", losses[0], True, "")
        if distribution == "quantile":
            losses = ("huber",)
        if self.loss not in losses:
            what = "target_rule='dqrc'" if dqrc else f"distribution={distribution!r}"
            check_choice("loss", self.loss, ("huber", "squared", "cross_entropy"))
            raise ValueError(f"loss={self.loss!r} does not go with {what}, which has {losses[0]!r}; leave loss out")
        no_copy = "target_rule='dqrc' corrects the gradient instead of freezing its targets"
        _settle(self, "target_period_updates", 500, not dqrc, no_copy)
        _settle(
            self, "num_atoms", 51 if categorical else 32, distribution != "none", "distribution='none' has no atoms"
        )
        unbounded = f"distribution={distribution!r} needs no range of returns"
        for name in ("value_min", "value_max"):
            _settle(self, name, None, categorical, unbounded)
        for name, default in (("temperature", 0.03), ("munchausen_alpha", 0.9), ("munchausen_floor", -1.0)):
            _settle(self, name, default, rule == "munchausen", f"target_rule={rule!r} has no softmax policy")
        hard = f"target_rule={rule!r} has the greedy target policy"
        _settle(self, "target_epsilon", 0.05, rule in CORRECTED_RULES, hard)
        for name, value in (("dqrc_beta", 1.0), ("dqrc_learning_rate", self.learning_rate)):
            _settle(self, name, value, dqrc, f"target_rule={rule!r} has no second function")

    def _check_own_numbers(self) -> None:
        for name, least in (
            ("target_period_updates", 1),
            ("num_atoms", 2 if self.distribution == "categorical" else 1),
        ):
            if getattr(self, name) is not None:
                check_whole(name, getattr(self, name), least)
        for name in ("temperature", "dqrc_learning_rate"):
            if getattr(self, name) is not None:
                check_positive(name, getattr(self, name))
        for name in ("munchausen_alpha", "target_epsilon"):
            if getattr(self, name) is not None:
                check_fraction(name, getattr(self, name))
        if self.dqrc_beta:
            check_positive("dqrc_beta", self.dqrc_beta)
        if self.munchausen_floor is not None and not self.munchausen_floor < 0:
            raise ValueError(f"munchausen_floor must be below 0, got {self.munchausen_floor!r}; -1 is usual")
        if self.distribution == "categorical":
            low, high = self.value_min, self.value_max
            if low is None or high is None or not -float("inf") < low < high < float("inf"):
                raise ValueError(
                    f"a categorical distribution needs value_min below value_max, got {low!r} and {high!r}; name the "
                    "smallest and the largest return to expect, or take distribution='quantile', which needs neither"
                )
        if self.target_rule in ("retrace", "tree_backup") and self.target_epsilon == 0:
            raise ValueError(
                f"with the greedy target policy target_rule={self.target_rule!r} is Watkins' Q(λ); use "
                "target_rule='watkins', or target_epsilon above 0"
            )


def _settle(settings: ReplaySettings, name: str, default: Any, applies: bool, why: str) -> None:
    """Fill in ``default`` where ``name`` is left out and applies; refuse it where it is given and does not."""
    if getattr(settings, name) is None and applies:
        object.__setattr__(settings, name, default)
    elif getattr(settings, name) is not None and not applies:
        raise ValueError(f"{name}={getattr(settings, name)!r} would be ignored: {why}; leave {name} out")


def _check_blocks(settings: ReplaySettings) -> None:
    blocks = settings.target_rule in BLOCK_RULES
    if blocks != (settings.block_length > 1):
        named = ", ".join(f'"{rule}"' for rule in BLOCK_RULES)
        raise ValueError(
            f"target_rule={settings.target_rule!r} does not go with block_length={settings.block_length}: λ-returns "
            f"({named}) need blocks of at least 2 rows, the other rules take single samples"
        )
    if not blocks:
        return
    if settings.num_steps > 1 or settings.prioritised:
        raise ValueError(
            "λ-returns over blocks replace n-step targets and priorities; leave num_steps=1, prioritised=False"
        )
    if settings.batch_size < settings.block_length:
        raise ValueError(f"batch_size={settings.batch_size} holds no block of block_length={settings.block_length}")
    least = settings.block_length * settings.num_envs
    for name in ("learning_starts", "capacity"):
        if getattr(settings, name) < least:
            raise ValueError(
                f"{name}={getattr(settings, name)} steps over {settings.num_envs} environment(s) hold no block of "
                f"block_length={settings.block_length}; take at least {least}"
            )


def _check_combination(settings: ReplaySettings) -> None:
    rule, distribution = settings.target_rule, settings.distribution
    if rule == "munchausen" and settings.num_steps > 1:
        raise ValueError(
            f"munchausen adds a bonus to every reward and an n-step sample holds only their sum, got num_steps="
            f"{settings.num_steps}; leave num_steps=1"
        )
    if distribution == "none":
        return
    if rule in BLOCK_RULES:
        raise ValueError(
            f"target_rule={rule!r} mixes means and distribution={distribution!r} needs whole distributions; use "
            "q_learning or double, with num_steps above 1 for longer returns"
        )
    if rule == "dqrc":
        raise ValueError(
            f"dqrc corrects the gradient of a squared error, which distribution={distribution!r} does not have; use "
            "distribution='none', or another target_rule"
        )
    if rule == "munchausen" and distribution == "categorical":
        raise ValueError(
            "munchausen's soft values lie up to temperature · log A above every return, outside the grid of a "
            "categorical distribution; use distribution='quantile'"
        )
