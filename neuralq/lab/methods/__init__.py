"""Every method of the lab: its expected update and its sampled update, on any problem."""

from neuralq.lab.methods.control import Q_LEARNING, SARSA
from neuralq.lab.methods.emphatic import ETD
from neuralq.lab.methods.gq import GQ, GREEDY_GQ
from neuralq.lab.methods.gradient import GTD, GTD2, GTD2_MP, HTD, TDC, TDRC
from neuralq.lab.methods.least_squares import BRM, FITTED, FITTED_Q, LSPI, LSTD
from neuralq.lab.methods.method import Expected, Learner, Method, flow
from neuralq.lab.methods.multistep import EXPECTED_SARSA, NAIVE_Q, NSTEP, RETRACE, TREE_BACKUP, VTRACE
from neuralq.lab.methods.residual_adaptive import RESIDUAL_ADAPTIVE
from neuralq.lab.methods.targets import HARD_TARGET, POLYAK_TARGET, PROJECTED_TARGET
from neuralq.lab.methods.td import NAIVE_RESIDUAL, RESIDUAL, TD

__all__ = ["METHODS", "Expected", "Learner", "Method", "flow", "method"]

METHODS: tuple[Method, ...] = (
    *(TD, RESIDUAL, RESIDUAL_ADAPTIVE, NAIVE_RESIDUAL),
    *(GTD, GTD2, GTD2_MP, TDC, TDRC, HTD, GQ, GREEDY_GQ),
    *(ETD, NSTEP, VTRACE, HARD_TARGET, POLYAK_TARGET, PROJECTED_TARGET),
    *(LSTD, BRM, FITTED, FITTED_Q, LSPI),
    *(EXPECTED_SARSA, TREE_BACKUP, RETRACE, NAIVE_Q, Q_LEARNING, SARSA),
)


def method(name: str) -> Method:
    """The method of this name.

    Raises:
        ValueError: there is none; the message lists them.

    Example:
        >>> method("td").title
        'TD(λ)'
    """
    for one in METHODS:
        if one.name == name:
            return one
    raise ValueError(f"there is no method {name!r}; there are {', '.join(one.name for one in METHODS)}")
