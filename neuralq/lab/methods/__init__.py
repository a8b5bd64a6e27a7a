"""Every method of the lab: its expected update and its sampled update, on any problem."""

from neuralq.lab.methods.method import Expected, Learner, Method, flow
from neuralq.lab.methods.td import NAIVE_RESIDUAL, RESIDUAL, TD

__all__ = ["METHODS", "Expected", "Learner", "Method", "flow", "method"]

METHODS: tuple[Method, ...] = (TD, RESIDUAL, NAIVE_RESIDUAL)


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
