"""What a replay learner may be told, and which of it goes together.

The target rule decides most of the rest: one-step rules take single samples, λ-returns take blocks; some rules have
numbers of their own. A number that the rule has no use for is refused, and one that is left out is filled in, so that
the stored settings say what was done.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, TypeVar

from neuralq.checks import check_choice, check_fraction, check_positive, check_whole
from neuralq.learners.optim import Optimiser
from neuralq.learners.replay.arrays import Prioritised
from neuralq.learners.replay.distributions.record import MEAN, Distribution, distributions
from neuralq.rules import Option, TargetRule, target_rules

__all__ = ["ReplaySettings"]

_Class = TypeVar("_Class")


def _options() -> dict[str, Option]:
    """The options of all target rules by name."""
    return {name: option for rule in target_rules().values() for name, option in rule.options.items()}


def _listed(records: Iterable[Distribution] | Iterable[TargetRule]) -> str:
    return ", ".join(f'"{record.name}" ({record.source})' for record in records)


def _with_options(cls: type[_Class]) -> type[_Class]:
    """A field for every option of a target rule that has none yet; what can be chosen goes into the text."""
    text = inspect.cleandoc(cls.__doc__ or "")  # indented or not, as the version of Python has it
    rules, all_distributions = target_rules().values(), distributions().values()
    for name, option in _options().items():
        if name not in cls.__annotations__:
            cls.__annotations__[name] = "float | None"
            setattr(cls, name, None)
            text = f"{text.rstrip()}\n    {name}: {option.label}; None for {option.default}.\n"
    text = text.replace("SAMPLES", _listed(rule for rule in rules if not rule.blocks))
    text = text.replace("BLOCKS", _listed(rule for rule in rules if rule.blocks))
    text = text.replace("DISTRIBUTIONS", _listed(all_distributions))
    atoms = [f"{one.num_atoms} ({one.name})" for one in all_distributions if one.num_atoms is not None]
    cls.__doc__ = text.replace("ATOMS", ", ".join(atoms))
    return cls


@dataclass(frozen=True)
@_with_options
class ReplaySettings:
    """How a `ReplayLearner` and its relatives learn and what is stored. Defaults: DQN (Mnih et al., 2015), scaled down.

    Args:
        target_rule: SAMPLES; with block_length > 1 BLOCKS.
        num_steps: n of n-step targets.
        block_length: rows of a contiguous block for λ-returns; 1 for independent samples.
        burn_in: rows before each block that are not learned from and bring the memory of a "gru" body along.
        lambda_: λ of the λ-returns.
        num_envs: parallel environments.
        capacity: transitions stored.
        batch_size: transitions per update (with blocks: batch_size // block_length blocks).
        learning_starts: transitions stored before the first update.
        train_period: environment steps between updates.
        updates_per_period: updates at each of those times.
        target_period_updates: updates between copies into the target network; None for 500 (dqrc has none).
        target_rate: τ in (0, 1]; in place of copies the target network moves by τ of the way at every update (Lillicrap
            et al., 2016).
        average_updates: greedy play is by an average of the parameters that forgets over about so many updates (Polyak
            & Juditsky, 1992); None plays with the last.
        noisy: whether the dense layers of a network are noisy, which explores by itself, so that ε may be 0 (Fortunato
            et al., 2018).
        learning_rate: of the optimiser.
        optimiser: "adam", "radam" or "sgd".
        adam_epsilon: what Adam and RAdam add to the root of the second moment; None for 1e-8 (Mnih et al., 2015, have
            1e-2, Hessel et al., 2018, 1.5e-4).
        loss: "huber" or "squared"; None for the rule's own (Huber's; of dqrc squared, of categories cross-entropy).
        huber_delta: |δ| in units of scaled rewards from which Huber's loss of a mean is linear; None for 1.
        max_grad_norm: bound on the gradient's norm; None for none.
        prioritised: whether samples are drawn by |δ| (Schaul et al., 2016), with importance weights in the loss.
        priority_alpha: α, samples are drawn in proportion to (|δ| + ε)^α; None for 0.6, 0 is uniform.
        priority_beta: β of the importance weights (N·P)^−β; None for 0.4, 1 takes back the whole bias.
        priority_beta_end: β after ``priority_beta_steps``, reached linearly (Schaul et al., 2016, end at 1); None for
            the same as at the beginning.
        priority_beta_steps: environment steps; None for 100,000 where β moves.
        priority_epsilon: ε, so that no sample is forgotten for good; None for 1e-6.
        distribution: DISTRIBUTIONS.
        num_atoms: numbers that describe a distribution; None for ATOMS.
        value_min: smallest return of a categorical distribution, in the environment's units.
        value_max: largest return of a categorical distribution, in the environment's units.
        temperature: τ of a rule's policy softmax(q/τ), in units of scaled rewards; None for 0.03.
        munchausen_alpha: α, how much of τ log π is added to the reward; None for 0.9.
        munchausen_floor: the smallest τ log π that counts, in units of scaled rewards; None for -1.
        conservative_alpha: α of the penalty α·(log Σₐ exp Q(s, a) − Q(s, a_taken)), by which values of actions that
            nobody took stay low (CQL(H); Kumar et al., 2020); 0 for none.
        target_epsilon: ε of the ε-greedy target policy of retrace, tree_backup and harutyunyan; None for 0.05.
        dqrc_beta: how strongly the second function of dqrc is pulled to 0; None for 1.
        dqrc_learning_rate: of the second function of dqrc; None for the learning rate.
    """

    target_rule: str = "q_learning"
    num_steps: int = 1
    block_length: int = 1
    burn_in: int = 0
    lambda_: float = 0.8
    num_envs: int = 1
    capacity: int = 50_000
    batch_size: int = 64
    learning_starts: int = 1_000
    train_period: int = 1
    updates_per_period: int = 1
    target_period_updates: int | None = None
    target_rate: float | None = None
    average_updates: float | None = None
    noisy: bool = False
    learning_rate: float = 5e-4
    optimiser: str = "adam"
    adam_epsilon: float | None = None
    loss: str | None = None
    huber_delta: float | None = None
    max_grad_norm: float | None = 10.0
    prioritised: bool = False
    priority_alpha: float | None = None
    priority_beta: float | None = None
    priority_beta_end: float | None = None
    priority_beta_steps: int | None = None
    priority_epsilon: float | None = None
    distribution: str = "none"
    num_atoms: int | None = None
    value_min: float | None = None
    value_max: float | None = None
    conservative_alpha: float = 0.0
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
        check_whole("burn_in", self.burn_in, 0)
        check_fraction("lambda_", self.lambda_, "for Monte Carlo use lambda_=1")
        check_positive("learning_rate", self.learning_rate)
        if self.max_grad_norm is not None:
            check_positive("max_grad_norm", self.max_grad_norm)
        if not 0 <= self.conservative_alpha < float("inf"):
            raise ValueError(f"conservative_alpha must be at least 0 and finite, got {self.conservative_alpha!r}")
        check_choice("target_rule", self.target_rule, target_rules())
        check_choice("distribution", self.distribution, distributions())
        Optimiser(self.optimiser)
        _check_blocks(self)
        _check_combination(self)
        self._fill_in()
        self._check_own_numbers()

    @property
    def rule(self) -> TargetRule:
        """The record of the target rule."""
        return target_rules()[self.target_rule]

    @property
    def returns(self) -> Distribution:
        """The record of what is learned of returns."""
        return distributions()[self.distribution]

    @property
    def options(self) -> dict[str, float]:
        """The target rule's own numbers by name."""
        return {name: getattr(self, name) for name in self.rule.options}

    @property
    def optimiser_constants(self) -> Optimiser:
        """The optimiser with its constants."""
        return (
            Optimiser(self.optimiser) if self.adam_epsilon is None else Optimiser(self.optimiser, eps=self.adam_epsilon)
        )

    @property
    def priorities(self) -> Prioritised | None:
        """How samples are drawn; None for all alike."""
        if self.priority_alpha is None or self.priority_beta is None or self.priority_epsilon is None:
            return None
        return Prioritised(self.priority_alpha, self.priority_beta, self.priority_epsilon)

    def importance(self, num_steps: int) -> float | None:
        """β after so many environment steps; None where all samples weigh the same.

        Example:
            >>> settings = ReplaySettings(prioritised=True, priority_beta_end=1.0, priority_beta_steps=1000)
            >>> settings.importance(500), settings.importance(5000), ReplaySettings().importance(0)
            (0.7, 1.0, None)
        """
        begin, end, steps = self.priority_beta, self.priority_beta_end, self.priority_beta_steps
        if begin is None or end is None or steps is None:
            return begin
        return begin + (end - begin) * min(1.0, num_steps / steps)

    def _fill_in_priorities(self) -> None:
        for name, default in (("priority_alpha", 0.6), ("priority_beta", 0.4), ("priority_epsilon", 1e-6)):
            _settle(self, name, default, self.prioritised, "prioritised=False draws all samples alike")
        _settle(self, "priority_beta_end", self.priority_beta, self.prioritised, "prioritised=False weighs none")
        moves = self.prioritised and self.priority_beta_end != self.priority_beta
        _settle(self, "priority_beta_steps", 100_000, moves, "priority_beta_end is what priority_beta is")

    def _fill_in(self) -> None:
        """Numbers that the rule needs and nobody gave; those that it has no use for must not be given."""
        rule, learned, own = (
            f"target_rule={self.target_rule!r}",
            f"distribution={self.distribution!r}",
            self.rule.options,
        )
        losses = ("squared",) if self.rule.correction else self.returns.losses
        _settle(self, "loss", losses[0], True, "")
        if self.loss not in losses:
            check_choice(
                "loss", self.loss, dict.fromkeys(loss for one in distributions().values() for loss in one.losses)
            )
            what = rule if self.rule.correction else learned
            raise ValueError(f"loss={self.loss!r} does not go with {what}, which has {losses[0]!r}; leave loss out")
        _settle(self, "adam_epsilon", 1e-8, self.optimiser != "sgd", "optimiser='sgd' divides by nothing")
        linear = self.loss == "huber" and self.returns is MEAN
        _settle(self, "huber_delta", 1.0, linear, "it is of Huber's loss of a mean")
        self._fill_in_priorities()
        why = f"{rule} {self.rule.correction}"
        for name in ("target_rate", "average_updates"):
            _settle(self, name, None, not self.rule.correction, why)
        if self.noisy and self.rule.correction:
            raise ValueError(f"noisy=True would be ignored by the second function of {rule}; leave noisy out")
        if self.target_rate is not None:
            why = f"target_rate={self.target_rate:g} moves the target network at every update"
        copies = not self.rule.correction and self.target_rate is None
        _settle(self, "target_period_updates", 500, copies, why)
        atoms = self.returns.num_atoms
        _settle(self, "num_atoms", atoms, atoms is not None, f"{learned} has no atoms")
        for name in ("value_min", "value_max"):
            _settle(self, name, None, self.returns.bounded, f"{learned} needs no range of returns")
        own = self.rule.options
        for name, option in (_options() | dict(own)).items():
            default = getattr(self, option.default) if isinstance(option.default, str) else option.default
            _settle(self, name, default, name in own, f"{rule} {option.lack}")

    def _check_own_numbers(self) -> None:
        for name in ("priority_alpha", "priority_beta", "priority_beta_end"):
            if getattr(self, name) is not None:
                check_fraction(name, getattr(self, name))
        for name in ("priority_epsilon", "adam_epsilon", "huber_delta"):
            if getattr(self, name) is not None:
                check_positive(name, getattr(self, name))
        if self.priority_beta_steps is not None:
            check_whole("priority_beta_steps", self.priority_beta_steps)
        if self.target_rate is not None and not 0 < self.target_rate <= 1:
            raise ValueError(f"target_rate must lie in (0, 1], got {self.target_rate}; 0.005 is usual, 1 copies")
        if self.average_updates is not None and not 1 <= self.average_updates < float("inf"):
            raise ValueError(f"average_updates must be a finite number of at least 1, got {self.average_updates}")
        for name, least in (("target_period_updates", 1), ("num_atoms", self.returns.least_atoms)):
            if getattr(self, name) is not None:
                check_whole(name, getattr(self, name), least)
        for name, option in self.rule.options.items():
            option.check(name, getattr(self, name))
        low, high = self.value_min, self.value_max
        if self.returns.bounded and (low is None or high is None or not -float("inf") < low < high < float("inf")):
            raise ValueError(
                f"a {self.distribution} distribution needs value_min below value_max, got {low!r} and {high!r}; name "
                "the smallest and the largest return to expect, or take distribution='quantile', which needs neither"
            )


def _settle(settings: ReplaySettings, name: str, default: Any, applies: bool, why: str) -> None:
    """Fill in ``default`` where ``name`` is left out and applies; refuse it where it is given and does not."""
    if getattr(settings, name) is None and applies:
        object.__setattr__(settings, name, default)
    elif getattr(settings, name) is not None and not applies:
        raise ValueError(f"{name}={getattr(settings, name)!r} would be ignored: {why}; leave {name} out")


def _check_blocks(settings: ReplaySettings) -> None:
    blocks = settings.rule.blocks
    if blocks != (settings.block_length > 1):
        named = ", ".join(f'"{rule.name}"' for rule in target_rules().values() if rule.blocks)
        raise ValueError(
            f"target_rule={settings.target_rule!r} does not go with block_length={settings.block_length}: λ-returns "
            f"({named}) need blocks of at least 2 rows, the other rules take single samples"
        )
    if not blocks:
        if settings.burn_in:
            raise ValueError(f"burn_in={settings.burn_in} goes before blocks, and there are none; leave it out")
        return
    if settings.num_steps > 1 or settings.prioritised:
        raise ValueError(
            "λ-returns over blocks replace n-step targets and priorities; leave num_steps=1, prioritised=False"
        )
    if settings.batch_size < settings.block_length:
        raise ValueError(f"batch_size={settings.batch_size} holds no block of block_length={settings.block_length}")
    least = (settings.burn_in + settings.block_length) * settings.num_envs
    for name in ("learning_starts", "capacity"):
        if getattr(settings, name) < least:
            raise ValueError(
                f"{name}={getattr(settings, name)} steps over {settings.num_envs} environment(s) hold no block of "
                f"{settings.burn_in + settings.block_length} rows; take at least {least}"
            )


def _check_combination(settings: ReplaySettings) -> None:
    """What the rule says it does not go with, in its words."""
    if settings.conservative_alpha and (settings.returns is not MEAN or settings.rule.correction):
        what = "distribution" if settings.returns is not MEAN else "target_rule"
        raise ValueError(
            f"conservative_alpha is for means that are learned from frozen targets, got {what}="
            f"{getattr(settings, what)!r}; leave one of them out"
        )
    met = {
        "num_steps": settings.num_steps > 1,
        "distribution": settings.returns is not MEAN,
        "bounded": settings.returns.bounded,
    }
    for ground, why in settings.rule.refuses.items():
        if met[ground]:
            raise ValueError(why.format(distribution=settings.distribution, num_steps=settings.num_steps))
