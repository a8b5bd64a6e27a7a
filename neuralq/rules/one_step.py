"""The one-step rules of `neuralq.rules.targets` for replay: what each follows in the successor, by which numbers."""

from __future__ import annotations

from neuralq.checks import check_positive
from neuralq.rules.policies import softmax
from neuralq.rules.target_rule import Followed, Option, Seen, TargetRule
from neuralq.rules.targets import double_q, q_learning

__all__ = ["DOUBLE", "DQRC", "EXPECTED_SARSA", "Q_LEARNING", "TEMPERATURE", "policy_average"]

TEMPERATURE = Option(
    0.03, check_positive, "τ of the policy softmax(q/τ), in units of scaled rewards", "has no softmax policy"
)
"""The option of every rule that follows a softmax policy."""


def policy_average(seen: Seen) -> Followed:
    """Expected Sarsa follows the policy softmax(q/τ) of the frozen values.

    With τ → 0 it is Q-learning, with τ → ∞ the policy that draws any legal action. The average leaves out the variance
    of the drawn action that Sarsa's target has.

    Source: van Seijen, van Hasselt, Whiteson, Wiering 2009, eq. 5, with a softmax policy.

    Example:
        >>> import torch
        >>> from neuralq.types import Transition
        >>> row = torch.tensor
        >>> step = Transition(row([0]), row([0]), row([1.0]), row([1.0]), row([0.5]), row([1]), row([False]))
        >>> seen = Seen(step, lambda s, target: row([[0.0, 1.0, -torch.inf]]), options={"temperature": 1.0})
        >>> EXPECTED_SARSA.target(seen)  # 1 + ½ e/(1 + e)
        tensor([1.3655])
    """
    return Followed(pi=softmax(seen.q_t, seen.options["temperature"]))


def _not_negative(name: str, value: float) -> None:
    if value != 0:
        check_positive(name, value)


_SECOND = "has no second function"

Q_LEARNING = TargetRule(
    name="q_learning",
    title="Q-learning: the best action of the frozen values",
    source="Watkins 1989; Mnih et al. 2015",
    follows=lambda seen: Followed(a=seen.q_t.argmax(-1)),
    mean=lambda seen: q_learning(seen.r_t, seen.discount_t, seen.q_t),
    place=1,
)
DOUBLE = TargetRule(
    name="double",
    title="double Q-learning: the best action of the present values",
    source="van Hasselt, Guez & Silver 2016",
    follows=lambda seen: Followed(a=seen.online_t.argmax(-1)),
    mean=lambda seen: double_q(seen.r_t, seen.discount_t, seen.q_t, seen.online_t),
    place=2,
)
EXPECTED_SARSA = TargetRule(
    name="expected_sarsa",
    title="expected Sarsa: the average by a softmax policy",
    source="van Seijen, van Hasselt, Whiteson & Wiering 2009",
    follows=policy_average,
    options={"temperature": TEMPERATURE},
    place=3,
)
DQRC = TargetRule(
    name="dqrc",
    title="Q-learning with a corrected gradient, without a frozen copy",
    source="Patterson, White & White 2022",
    options={
        "dqrc_beta": Option(1.0, _not_negative, "how strongly the second function is pulled to 0", _SECOND),
        "dqrc_learning_rate": Option("learning_rate", check_positive, "of the second function", _SECOND),
    },
    correction="corrects the gradient instead of freezing its targets",
    refuses={
        "distribution": "dqrc corrects the gradient of a squared error, which distribution={distribution!r} does not "
        "have; use distribution='none', or another target_rule"
    },
    place=20,
)
