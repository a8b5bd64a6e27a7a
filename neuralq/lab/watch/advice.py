"""What to change in a run that diverges, in words, given what it is like and what its kernel says."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from neuralq.checks import check_discount, check_fraction, check_positive
from neuralq.runs import RunConfig

if TYPE_CHECKING:
    from neuralq.lab.networks.sampled import SampleDiagnosis

__all__ = ["RunTraits", "advise"]


@dataclass(frozen=True)
class RunTraits:
    """What decides whether a run can diverge, as far as its settings say.

    Args:
        gamma: γ.
        step_size: α, or the learning rate.
        plain_steps: whether updates are plain gradient steps; with Adam and its like α says little by itself.
        lambda_: λ of traces or λ-returns; 0 for one-step targets.
        target_period: updates between copies into a target network; None without one.
        layer_norm: whether the network normalises its layers; None where there is no network.
        replay: whether old experience of other policies is learned from.
        double: whether targets are those of double Q-learning.
        reward_scale: by which the learner multiplies rewards.

    Raises:
        ValueError: an argument out of range.
    """

    gamma: float
    step_size: float
    plain_steps: bool = True
    lambda_: float = 0.0
    target_period: int | None = None
    layer_norm: bool | None = None
    replay: bool = False
    double: bool = False
    reward_scale: float = 1.0

    def __post_init__(self) -> None:
        check_discount("gamma", self.gamma)
        check_positive("step_size", self.step_size)
        check_fraction("lambda_", self.lambda_)
        check_positive("reward_scale", self.reward_scale)

    @classmethod
    def of(cls, config: RunConfig) -> RunTraits:
        """Those of a configured run.

        Example:
            >>> RunTraits.of(RunConfig(learner="online")).plain_steps
            True
        """
        network = config.layout not in ("table", "linear")
        layer_norm = (config.body is not None and config.body.layer_norm) if network else None
        own = asdict(config.kind.traits(config.settings))
        return cls(gamma=config.gamma, layer_norm=layer_norm, reward_scale=config.reward_scale, **own)


def advise(traits: RunTraits, diagnosis: SampleDiagnosis | None = None) -> tuple[str, ...]:
    """What may help a diverging run, most promising first, without what it already does.

    Args:
        traits: of the run.
        diagnosis: of its kernel, if there is one.

    Example:
        >>> advise(RunTraits(gamma=0.99, step_size=0.1))[0]
        'a target network'
    """
    found: list[str] = []
    if diagnosis is not None and diagnosis.too_large_step:
        found.append(f"a step size below {diagnosis.step_size_bound:.3g} (it is {traits.step_size:g})")
    if traits.target_period is None:
        found.append("a target network")
    else:
        found.append(f"a longer period of the target network (it is {traits.target_period:,} updates)")
    if traits.layer_norm is False:
        found.append("layer normalisation (MLP(layer_norm=True)), which bounds how far an update reaches")
    if traits.lambda_ < 1:
        found.append(f"λ-returns with λ nearer 1 (it is {traits.lambda_:g}), which bootstrap less")
    if traits.replay:
        found.append("on-policy λ-returns (learner='rollout') instead of replay")
        if not traits.double:
            found.append("double Q-learning, where values are only too high")
    share = 1.0 if diagnosis is None else diagnosis.discount_share
    if share < 1:
        found.append(f"a smaller γ (the kernel turns stable near {share * traits.gamma:.2g})")
    else:
        found.append(f"a smaller γ (it is {traits.gamma:g})")
    if diagnosis is None or not diagnosis.unstable:
        found.append(f"a smaller step size (it is {traits.step_size:g})")
    return tuple(dict.fromkeys(found))
