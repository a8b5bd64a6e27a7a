"""The rules that take blocks of stored rows ``[T, *n]``: λ-returns of the frozen values (Daley & Amato 2019).

Peng's are never cut, Watkins' where the next action was not greedy; the others correct towards an ε-greedy target
policy and know of the policy that took the stored actions only the probabilities stored with them. Returns mix means,
so none of them says what becomes of a whole distribution.
"""

from __future__ import annotations

import torch
from torch import Tensor

from neuralq.checks import check_fraction
from neuralq.rules.policies import epsilon_greedy
from neuralq.rules.returns import (
    is_greedy,
    lambda_returns,
    off_policy_returns,
    retrace_coefficients,
    tree_backup_coefficients,
    watkins_lambda,
)
from neuralq.rules.target_rule import Option, Seen, TargetRule
from neuralq.rules.targets import expected_value

__all__ = ["HARUTYUNYAN", "PENG", "RETRACE", "TREE_BACKUP", "WATKINS"]


def _returns(seen: Seen, lambda_: Tensor | float) -> Tensor:
    return lambda_returns(seen.r_t, seen.discount_t, seen.q_t.amax(-1), lambda_, seen.transition.last_t)


def _watkins(seen: Seen) -> Tensor:
    greedy = is_greedy(seen.q_tm1, seen.transition.a_tm1)
    return _returns(seen, watkins_lambda(seen.lambda_, greedy, seen.q_t.dtype))


def _policy(seen: Seen) -> Tensor:
    """The target policy's probabilities of the actions taken, ``[T, *n]``."""
    return _taken(seen, epsilon_greedy(seen.q_tm1, seen.options["target_epsilon"]))


def _taken(seen: Seen, each: Tensor) -> Tensor:
    return each.gather(-1, seen.transition.a_tm1[..., None])[..., 0]


def _corrected(seen: Seen, c_tm1: Tensor) -> Tensor:
    v_t = expected_value(seen.q_t, epsilon_greedy(seen.q_t, seen.options["target_epsilon"]))
    q_tm1 = _taken(seen, seen.q_tm1)
    return off_policy_returns(q_tm1, seen.r_t, seen.discount_t, v_t, c_tm1, seen.transition.last_t)


def _retrace(seen: Seen) -> Tensor:
    return _corrected(seen, retrace_coefficients(seen.lambda_, _policy(seen), seen.transition.mu_tm1))


def _tree_backup(seen: Seen) -> Tensor:
    return _corrected(seen, tree_backup_coefficients(seen.lambda_, _policy(seen)))


def _harutyunyan(seen: Seen) -> Tensor:
    return _corrected(seen, torch.full_like(seen.q_tm1[..., 0], seen.lambda_))


def _epsilon(refused_at_0: str = "") -> dict[str, Option]:
    """ε of the target policy; with 0 some rules are another."""

    def check(name: str, value: float) -> None:
        check_fraction(name, value)
        if refused_at_0 and value == 0:
            raise ValueError(
                f"with the greedy target policy target_rule={refused_at_0!r} is Watkins' Q(λ); use "
                f"target_rule='watkins', or {name} above 0"
            )

    return {"target_epsilon": Option(0.05, check, "ε of the ε-greedy target policy", "has the greedy target policy")}


PENG = TargetRule(
    name="peng",
    title="Peng's Q(λ): λ-returns that are never cut",
    source="Peng & Williams 1996",
    mean=lambda seen: _returns(seen, seen.lambda_),
    blocks=True,
    place=10,
)
WATKINS = TargetRule(
    name="watkins",
    title="Watkins' Q(λ): λ-returns up to the next exploring action",
    source="Watkins 1989",
    mean=_watkins,
    blocks=True,
    place=11,
)
RETRACE = TargetRule(
    name="retrace",
    title="Retrace(λ): errors corrected by min(1, π/μ)",
    source="Munos et al. 2016",
    mean=_retrace,
    options=_epsilon("retrace"),
    blocks=True,
    place=12,
    behaviour=True,
)
TREE_BACKUP = TargetRule(
    name="tree_backup",
    title="tree backup(λ): errors corrected by π",
    source="Precup, Sutton & Singh 2000",
    mean=_tree_backup,
    options=_epsilon("tree_backup"),
    blocks=True,
    place=13,
)
HARUTYUNYAN = TargetRule(
    name="harutyunyan",
    title="Q(λ) of Harutyunyan et al.: errors corrected by λ alone",
    source="Harutyunyan et al. 2016",
    mean=_harutyunyan,
    options=_epsilon(),
    blocks=True,
    place=14,
)
