"""The one-step rules of `neuralq.rules.targets` for replay: what each follows in the successor, by which numbers."""

from __future__ import annotations

from neuralq.checks import check_positive
from neuralq.rules.target_rule import Followed, Option, TargetRule
from neuralq.rules.targets import double_q, q_learning

__all__ = ["DOUBLE", "DQRC", "Q_LEARNING", "TEMPERATURE"]

TEMPERATURE = Option(
    0.03, check_positive, "τ of the policy softmax(q/τ), in units of scaled rewards", "has no softmax policy"
)
"""The option of every rule that follows a softmax policy."""


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
DQRC = TargetRule(
    name="dqrc",
    title="Q-learning with a corrected gradient, without a frozen copy",
    source="Patterson, White & White 2022",
    mean=lambda seen: q_learning(seen.r_t, seen.discount_t, seen.online_t),
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
